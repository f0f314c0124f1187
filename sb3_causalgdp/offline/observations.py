"""From a dataset's observations to a model's: the same flattening and the same image layout as its environment's wrappers."""

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

ObservationMap = Callable[[Any], Any]


def flattened_space(env: VecEnv | None) -> spaces.Space | None:
    """
    :param env: A model's environment
    :return: The space that a ``FlattenObservation`` wrapper of it flattens, with the environment's own order of keys; None if
        there is no such wrapper, or it lives in another process
    """
    base = None if env is None else env.unwrapped
    one = base.envs[0] if isinstance(base, DummyVecEnv) else None
    while isinstance(one, gym.Wrapper):
        if isinstance(one, gym.wrappers.FlattenObservation):
            return one.env.observation_space
        one = one.env
    return None


def observation_map(given: spaces.Space, wanted: spaces.Space, env: VecEnv | None, name: str) -> ObservationMap:
    """
    :param given: A dataset's observation space
    :param wanted: The model's
    :param env: The model's environment, which knows what it flattens
    :param name: What to call the dataset
    :return: A function from batches of the dataset's observations to batches of the model's
    :raises ValueError: If they do not fit
    """
    if isinstance(wanted, spaces.Dict) and isinstance(given, spaces.Dict):
        _check_keys(given, wanted, name)
        maps = {key: _leaf_map(given[key], part, f"{name}, observations[{key!r}]") for key, part in wanted.items()}
        return lambda tree: {key: one(tree[key]) for key, one in maps.items()}
    if isinstance(wanted, spaces.Box) and isinstance(given, spaces.Dict | spaces.Tuple):
        layout = flattened_space(env) or given
        _check_parts(layout, given, name)
        if wanted.shape == (spaces.flatdim(layout),):
            return lambda tree: flatten_batch(layout, tree)
    return _leaf_map(given, wanted, name)


def _check_keys(given: spaces.Dict, wanted: spaces.Dict, name: str) -> None:
    if set(given.spaces) != set(wanted.spaces):
        raise ValueError(
            f"{name} does not fit the model's observation space: it has the keys {sorted(given.spaces)}, and "
            f"{sorted(wanted.spaces)} are needed"
        )


def _check_parts(layout: spaces.Space, given: spaces.Space, name: str) -> None:
    """The dataset has every part that the environment flattens; it may have more, which a filter took away."""
    if isinstance(layout, spaces.Dict):
        missing = sorted(set(layout.spaces) - set(given.spaces)) if isinstance(given, spaces.Dict) else list(layout.spaces)
        if missing:
            raise ValueError(f"{name} does not fit the environment, which flattens {layout}: it lacks {missing} in {given}")
        for key, part in layout.spaces.items():
            _check_parts(part, given[key], name)  # type: ignore[index]
    elif layout.shape != given.shape:
        raise ValueError(f"{name} does not fit the environment, which flattens {layout} where the dataset has {given}")


def _leaf_map(given: spaces.Space, wanted: spaces.Space, name: str) -> ObservationMap:
    numeric = (spaces.Box, spaces.MultiBinary)
    both_numeric = isinstance(given, numeric) and isinstance(wanted, numeric)
    if given.shape == wanted.shape and (type(given) is type(wanted) or both_numeric):
        return np.asarray
    if isinstance(given, spaces.Box) and isinstance(wanted, spaces.Box):
        if len(given.shape) == 3 and wanted.shape == (given.shape[2], *given.shape[:2]):
            return lambda values: np.moveaxis(values, -1, 1)  # as VecTransposeImage does
        if wanted.shape == (spaces.flatdim(given),):
            return lambda values: values.reshape(len(values), -1)
    raise ValueError(f"{name} does not fit the model's observation space: it is {given}, and {wanted} is needed")


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


def flat_space(space: spaces.Space) -> spaces.Space:
    """
    :param space: Any space
    :return: What ``FlattenObservation`` makes of dictionaries and tuples; others stay as they are
    """
    return spaces.flatten_space(space) if isinstance(space, spaces.Dict | spaces.Tuple) else space


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
