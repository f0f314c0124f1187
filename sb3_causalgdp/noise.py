"""How much noise actions get, where nobody says it."""

import math

OF_ALL_COMPONENTS = 0.3


def noise_scale(noise: float | str, action_dim: int) -> float:
    """
    Noise costs as much of Q as its variance, summed over the components of an action: with the same scale for each, a robot
    with many joints would be shaken most.

    :param noise: Standard deviation of each component, for actions in [-1, 1]; ``"auto"`` for 0.3 of all components together
    :param action_dim: Number of components
    :return: Standard deviation of each component
    """
    return OF_ALL_COMPONENTS / math.sqrt(action_dim) if isinstance(noise, str) else noise
