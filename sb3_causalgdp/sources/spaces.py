"""Batches of observations and their spaces: as rows of numbers, and where no space is known."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium import spaces


def flatten_batch(space: spaces.Space, tree: Any) -> np.ndarray:
    """
    :param space: Space of one observation
    :param tree: A batch of observations, in dictionaries and tuples like those of the space
    :return: What ``gymnasium.spaces.flatten`` gives for each, shape ``(batch, flatdim)``
    """
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        return np.concatenate([flatten_batch(part, tree[key]) for key, part in parts], axis=1)  # type: ignore[misc]
    values = np.asarray(tree)
    if isinstance(space, spaces.Discrete):
        return (values.reshape(-1, 1) == np.arange(space.start, space.start + space.n)).astype(space.dtype)
    if isinstance(space, spaces.MultiDiscrete):
        columns = values.reshape(len(values), -1) - space.start.ravel()
        one_hot = [columns[:, [i]] == np.arange(count) for i, count in enumerate(space.nvec.ravel())]
        return np.concatenate(one_hot, axis=1).astype(space.dtype)
    return values.reshape(len(values), -1)


def shape_of_arrays(tree: Any) -> spaces.Space:
    """
    :param tree: A batch of observations: an array or a dictionary of arrays
    :return: The unbounded space of one, for data that come without a space
    """
    if isinstance(tree, Mapping):
        return spaces.Dict({key: shape_of_arrays(part) for key, part in tree.items()})
    info = np.iinfo(tree.dtype) if np.issubdtype(tree.dtype, np.integer) else None
    low, high = (-np.inf, np.inf) if info is None else (info.min, info.max)
    dtype: Any = tree.dtype if tree.dtype.kind in "fiu" else np.float32
    return spaces.Box(low, high, tree.shape[1:], dtype)
