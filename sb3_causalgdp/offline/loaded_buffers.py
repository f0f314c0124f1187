"""A replay buffer that was read from a file: whether it is whole, fits the model, and has as many columns as environments."""

from collections.abc import Callable, Iterator

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import get_obs_shape

from sb3_causalgdp.checks import many_are_finite
from sb3_causalgdp.offline.preload import preload_buffer
from sb3_causalgdp.sources.buffers import BufferSource
from sb3_causalgdp.sources.chunks import as_flags


def check_loaded_buffer(
    buffer: ReplayBuffer, observation_space: spaces.Space, action_space: spaces.Space, name: str = "The replay buffer"
) -> None:
    """
    :param buffer: The buffer, whatever file it is from
    :param observation_space: The model's
    :param action_space: The model's
    :param name: What to call it
    :raises ValueError: If it is of another environment, its arrays do not fit together, or a transition is NaN or infinite
    """
    _check_spaces(buffer, observation_space, action_space, name)
    if not (0 <= buffer.pos < buffer.buffer_size):
        raise ValueError(f"{name} is damaged: its position is {buffer.pos}, and its size {buffer.buffer_size}")
    for field, values, shape in _columns(buffer):
        if values.shape != (buffer.buffer_size, buffer.n_envs, *shape):
            wanted = (buffer.buffer_size, buffer.n_envs, *shape)
            raise ValueError(f"{name} is damaged: its {field} have the shape {values.shape}, and {wanted} is needed")
        held = values[: buffer.size()]
        if not many_are_finite(held):
            position, column, *where = np.argwhere(~np.isfinite(held))[0].tolist()
            raise ValueError(
                f"{name} has a NaN or infinite value in {field}{where or ''} at position {position} of environment {column}"
            )
        if field in ("dones", "timeouts"):
            as_flags(held.reshape(-1), f"{name}: {field}")


def _check_spaces(buffer: ReplayBuffer, observation_space: spaces.Space, action_space: spaces.Space, name: str) -> None:
    if get_obs_shape(buffer.observation_space) != get_obs_shape(observation_space):
        raise ValueError(
            f"{name} is of another environment: its observation space is {buffer.observation_space}, and the model's is "
            f"{observation_space}"
        )
    given, wanted = buffer.action_space, action_space
    assert isinstance(wanted, spaces.Box)
    # Actions are stored scaled from these bounds
    if not (
        isinstance(given, spaces.Box)
        and given.shape == wanted.shape
        and np.allclose([given.low, given.high], [wanted.low, wanted.high])
    ):
        raise ValueError(f"{name} is of another environment: its action space is {given}, and the model's is {wanted}")


def _columns(buffer: ReplayBuffer) -> Iterator[tuple[str, np.ndarray, tuple[int, ...]]]:
    """Name, values and shape of one row; the memory efficient buffer has no next observations."""
    shapes = get_obs_shape(buffer.observation_space)
    for field in ("observations", "next_observations"):
        values = getattr(buffer, field, None)
        if isinstance(values, dict):
            assert isinstance(shapes, dict)
            yield from ((f"{field}[{key!r}]", values[key], shape) for key, shape in shapes.items())
        elif values is not None:
            yield field, values, shapes  # type: ignore[misc]
    yield "actions", buffer.actions, (buffer.action_dim,)
    for field in ("rewards", "dones", "timeouts"):
        yield field, getattr(buffer, field), ()


def in_columns(
    buffer: ReplayBuffer, n_envs: int, new_buffer: Callable[[int], ReplayBuffer], name: str = "The replay buffer"
) -> ReplayBuffer:
    """
    The transitions of a buffer in another number of columns. Trajectories stay whole, except for those that are cut between
    two columns and end there as truncated. Up to ``n_envs - 1`` transitions are in it twice, to fill the last column.

    :param buffer: The buffer
    :param n_envs: Number of environments that it shall hold the transitions of
    :param new_buffer: Makes an empty one for these, of the size that it is given
    :param name: What to call it
    :return: A buffer of at least the same size
    :raises ValueError: If it does not hold what is needed for that
    """
    if buffer.optimize_memory_usage or getattr(buffer, "copy_info_dict", False):
        option = "optimize_memory_usage" if buffer.optimize_memory_usage else "copy_info_dict"
        raise ValueError(
            f"{name} holds transitions of {buffer.n_envs} environments, and the model has {n_envs}, which with {option}=True "
            f"cannot be changed: load the model with {buffer.n_envs}"
        )
    n_positions = -(-buffer.size() * buffer.n_envs // n_envs)
    empty = new_buffer(max(buffer.buffer_size * buffer.n_envs, n_positions * n_envs))
    if buffer.size() > 0:
        preload_buffer(empty, BufferSource(buffer, name), env=None)
    return empty
