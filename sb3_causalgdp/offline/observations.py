"""From a dataset's observations to a model's: the same flattening and the same image layout as its environment's wrappers."""

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_causalgdp.sources.spaces import flatten_batch

ObservationMap = Callable[[Any], Any]
Path = tuple[str | int, ...]
OTHER_VARIABLES = ("action", "reward")


def flattened_space(env: gym.Env | VecEnv | None, parts: spaces.Space | None = None) -> spaces.Space | None:
    """
    :param env: A model's environment
    :param parts: A space with the parts that it may flatten, in any order, by which one in another process is asked
    :return: The space that its ``FlattenObservation`` wrapper flattens, with the environment's own order of keys; None if
        there is no such wrapper, or it cannot be asked
    """
    if not isinstance(env, VecEnv):
        return _wrapped_space(env)
    base = env.unwrapped
    if isinstance(base, DummyVecEnv):
        return _wrapped_space(base.envs[0])
    if parts is None or not _can_be_asked(base):
        return None
    return _layout_by_asking(base, parts)


def _wrapped_space(env: gym.Env | None) -> spaces.Space | None:
    while isinstance(env, gym.Wrapper):
        if isinstance(env, gym.wrappers.FlattenObservation):
            return env.env.observation_space
        env = env.env
    return None


def _can_be_asked(base: VecEnv) -> bool:
    """Whether the outermost wrapper that has a method ``observation`` is ``FlattenObservation``."""
    if not base.env_is_wrapped(gym.wrappers.FlattenObservation, indices=[0])[0]:
        return False
    for name in re.findall(r"<(\w+)", base.env_method("__str__", indices=[0])[0]):
        if name == "FlattenObservation":
            return True
        wrapper = Monitor if name == "Monitor" else getattr(gym.wrappers, name, None)
        if wrapper is None or hasattr(wrapper, "observation"):
            return False
    return False


class _Probe(dict):
    """An observation; parts that it does not have are one zero."""

    def __missing__(self, key: Any) -> "_Probe":
        return _Probe()

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.zeros(1, dtype)


def _layout_by_asking(base: VecEnv, parts: spaces.Space) -> spaces.Space | None:
    """Where the flattened observation changes when one part does."""

    def flattened(changed: Path | None) -> np.ndarray:
        return np.asarray(base.env_method("observation", _probe(parts, changed), indices=[0])[0])

    plain, first_of = flattened(None), {}
    for path, _ in leaves_of_space(parts):
        moved = np.flatnonzero(flattened(path) != plain)
        if len(moved) > 0:
            first_of[path] = int(moved[0])
    layout = _in_order(parts, first_of)
    return layout if layout is not None and spaces.flatdim(layout) == len(plain) else None


def _probe(space: spaces.Space, changed: Path | None, path: Path = ()) -> Any:
    if isinstance(space, spaces.Dict):
        return _Probe({key: _probe(part, changed, (*path, key)) for key, part in space.spaces.items()})
    if isinstance(space, spaces.Tuple):
        return tuple(_probe(part, changed, (*path, index)) for index, part in enumerate(space.spaces))
    step = int(path == changed)
    if isinstance(space, spaces.Discrete):
        return space.start + min(step, space.n - 1)
    if isinstance(space, spaces.MultiDiscrete):
        return space.start + np.minimum(step, space.nvec - 1)
    assert space.shape is not None
    return np.full(space.shape, step, space.dtype)


def _in_order(space: spaces.Space, first_of: dict[Path, int], path: Path = ()) -> spaces.Space | None:
    """The space with its keys in the order of these positions, and without parts that have none."""
    if isinstance(space, spaces.Dict):
        below = {key: [at for found, at in first_of.items() if found[: len(path) + 1] == (*path, key)] for key in space.spaces}
        keys = sorted((key for key, positions in below.items() if positions), key=lambda key: min(below[key]))
        parts = [(key, _in_order(space[key], first_of, (*path, key))) for key in keys]
        return spaces.Dict([(key, part) for key, part in parts if part is not None]) if parts else None
    return space


def leaves_of_space(space: spaces.Space, path: Path = ()) -> list[tuple[Path, int]]:
    """
    :param space: A space, may be nested
    :return: The keys that lead to each part, and its flattened size, in the order of the space: its layout
    """
    if isinstance(space, spaces.Dict | spaces.Tuple):
        named = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        return [leaf for key, part in named for leaf in leaves_of_space(part, (*path, key))]  # type: ignore[misc]
    return [(path, spaces.flatdim(space))]


def layout_name(space: spaces.Space) -> str:
    """
    :param space: A space that is flattened
    :return: Its parts by name, in their order
    """
    return "[" + ", ".join(".".join(map(str, path)) for path, _ in leaves_of_space(space)) + "]"


def same_layout(space: spaces.Space | None, other: spaces.Space | None) -> bool:
    """
    :param space: A space that is flattened, None if it is not known
    :param other: Another
    :return: Whether they have the same parts in the same order, or one is not known
    """
    return space is None or other is None or leaves_of_space(space) == leaves_of_space(other)


def _has_an_order(space: spaces.Space) -> bool:
    """Whether there are keys that can be in another order."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces
        return (isinstance(space, spaces.Dict) and len(space.spaces) > 1) or any(map(_has_an_order, parts))
    return False


def observation_map(given: spaces.Space, wanted: spaces.Space, layout: spaces.Space | None, name: str) -> ObservationMap:
    """
    :param given: A dataset's observation space
    :param wanted: The model's
    :param layout: What the model's environment flattens, with its order of keys; None if it is not known
    :param name: What to call the dataset
    :return: A function from batches of the dataset's observations to batches of the model's
    :raises ValueError: If they do not fit
    """
    if isinstance(wanted, spaces.Dict) and isinstance(given, spaces.Dict):
        _check_keys(given, wanted, name)
        maps = {key: _leaf_map(given[key], part, f"{name}, observations[{key!r}]") for key, part in wanted.items()}
        return lambda tree: {key: one(tree[key]) for key, one in maps.items()}
    if isinstance(wanted, spaces.Box) and isinstance(given, spaces.Dict | spaces.Tuple):
        if layout is None and _has_an_order(given) and wanted.shape == (spaces.flatdim(given),):
            raise ValueError(
                f"{name} has the parts {layout_name(given)}, and it is not known in which order the environment flattens "
                "them: use gymnasium's FlattenObservation, the outermost but for wrappers that leave observations alone, or a "
                "MultiInputPolicy"
            )
        layout = layout or given
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


def flat_space(space: spaces.Space) -> spaces.Space:
    """
    :param space: Any space
    :return: What ``FlattenObservation`` makes of dictionaries and tuples; others stay as they are
    """
    return spaces.flatten_space(space) if isinstance(space, spaces.Dict | spaces.Tuple) else space


def key_names(space: spaces.Space, known: Mapping[str, Sequence[str]] | None = None) -> tuple[str, ...] | None:
    """
    :param space: Of observations
    :param known: Names of the components of some keys
    :return: A name for each component of a dictionary, in the order in which it is flattened: ``key``, and ``key[i]`` where it
        has several; None for what is no dictionary of vectors
    """
    if not isinstance(space, spaces.Dict):
        return None
    names: list[str] = []
    for key, part in space.spaces.items():
        if isinstance(part, spaces.Dict):
            inner = key_names(part)
            if inner is None:
                return None
            names += [f"{key}.{name}" for name in inner]
            continue
        if not part.is_np_flattenable or len(part.shape or ()) > 2:
            return None
        size = spaces.flatdim(part)
        own = tuple((known or {}).get(key, ()))
        names += own if len(own) == size else _of_key(key, size)
    return tuple(names)


def _of_key(key: str, size: int) -> list[str]:
    if size == 1 and key not in OTHER_VARIABLES:
        return [key]
    # "action[0]" would be the name of an action as well
    return [f"{f'obs[{key}]' if key == 'action' else key}[{index}]" for index in range(size)]
