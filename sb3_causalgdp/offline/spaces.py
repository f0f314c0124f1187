"""The spaces of offline transitions: told by the source, given by the user, or inferred."""

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_causalgdp.sources.chunks import ArraySource, Source


def spaces_of(
    source: Source, observation_space: spaces.Space | None = None, action_space: spaces.Box | None = None
) -> tuple[spaces.Space, spaces.Box]:
    """
    :param source: Offline transitions
    :param observation_space: What its observations are, where one knows it
    :param action_space: What its actions are, where one knows it
    :return: Its observation and its action space; what arrays do not tell is inferred, with a warning that says it
    :raises ValueError: If it does not know them and they cannot be inferred
    """
    given = {"observation_space": observation_space, "action_space": action_space}
    known = {name: getattr(source, name) if space is None else space for name, space in given.items()}
    unknown = [name for name, space in known.items() if space is None]
    if unknown and not isinstance(source, ArraySource):
        raise ValueError(f"{source.name} does not tell its spaces: give observation_space= and action_space=")
    if unknown:
        assert isinstance(source, ArraySource)
        known |= {name: inferred_space(source, name) for name in unknown}
        said = ", ".join(f"{name}={known[name]}" for name in unknown)
        warnings.warn(f"{source.name}: spaces are inferred, {said}; give observation_space= or action_space= if this is wrong")
    if not isinstance(known["action_space"], spaces.Box):
        raise ValueError(f"continuous actions (a Box) are needed, got action_space={known['action_space']}")
    return known["observation_space"], known["action_space"]  # type: ignore[return-value]


def inferred_space(source: ArraySource, name: str) -> spaces.Space:
    """
    :param source: Arrays
    :param name: ``"observation_space"`` or ``"action_space"``
    :return: Observations of any numbers in the shape that they have, by key where they have keys; actions between the smallest
        and the largest of each component
    :raises ValueError: If an action never changes, or is not finite
    """
    if name == "observation_space":
        return _any_numbers(source.arrays["observations"])
    actions = source.arrays["actions"].astype(np.float32)
    low, high = actions.min(axis=0), actions.max(axis=0)
    if not (np.isfinite([low, high]).all() and (low < high).all()):
        raise ValueError(f"{source.name} has actions from {low} to {high}: no range can be inferred, give action_space=")
    return spaces.Box(low, high)


def _any_numbers(tree: Any) -> spaces.Space:
    if isinstance(tree, Mapping):
        return spaces.Dict({key: _any_numbers(part) for key, part in tree.items()})
    if tree.dtype == np.uint8:
        return spaces.Box(0, 255, tree.shape[1:], np.uint8)
    return spaces.Box(-np.inf, np.inf, tree.shape[1:], np.float32)
