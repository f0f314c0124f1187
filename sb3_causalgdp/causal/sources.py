"""Where recorded transitions come from: Minari datasets, saved replay buffers of SB3, and arrays, read in batches of rows."""

import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_causalgdp.causal.transitions import BATCH_ROWS, SourceError, TransitionSource
from sb3_causalgdp.causal.variables import TransitionVariables
from sb3_causalgdp.hints import how_to_install, how_to_make
from sb3_causalgdp.saving.archives import (
    DownloadError,
    errors_of,
    existing,
    is_zip,
    load_minari,
    one_line,
    read_arrays,
    read_pickle,
)
from sb3_causalgdp.saving.plain import SPACES, Known, decoded, read_json

OFFLINE_HINT = how_to_install("offline")
MINARI_ID = re.compile(r"[-\w]+(/[-\w]+)*-v\d+")
ARRAYS = ("observations", "actions", "next_observations", "rewards")
BUFFER_ATTRIBUTES = (
    *("observations", "actions", "rewards", "dones", "pos", "full", "buffer_size", "n_envs"),
    *("optimize_memory_usage", "observation_space", "action_space"),
)
SUFFIXES = (".npz", ".pkl")
RESERVED = ("action", "reward")  # names of other variables

__all__ = [
    "BATCH_ROWS",
    "ArraySource",
    "FlatSpace",
    "MinariSource",
    "ReplayBufferSource",
    "SourceError",
    "TransitionSource",
    "open_source",
]


class FlatSpace:
    """
    The numbers of an observation space in the order of gymnasium's ``flatten``, for many observations at once.

    Names are ``obs[i]``, for dictionaries ``key[i]`` and ``outer.inner[i]``, without the index where a key has one number;
    discrete parts are one-hot.

    :param space: Observation space, may be nested
    :raises SourceError: when a part of it is an image, or has no fixed number of numbers
    """

    def __init__(self, space: spaces.Space) -> None:
        self._leaves = list(_leaves(space))
        names: list[str] = []
        for path, leaf in self._leaves:
            name = ".".join(map(str, path))
            if not path or isinstance(path[0], int) or name == "action":
                # "action[0]" would be the name of an action as well
                name = f"obs[{name}]" if name else "obs"
            _check_leaf(name, leaf)
            one = spaces.flatdim(leaf) == 1 and isinstance(path[0] if path else 0, str) and name not in RESERVED
            names += [name] if one and not name.startswith("obs[") else [f"{name}[{i}]" for i in range(spaces.flatdim(leaf))]
        self.names = tuple(names)

    def __call__(self, observations: Any) -> np.ndarray:
        """
        :param observations: N observations: an array, or arrays in dictionaries and tuples like those of the space
        :return: shape (N, n)
        """
        parts = []
        for path, leaf in self._leaves:
            values = observations
            for key in path:
                values = values[key]
            parts.append(_flat_leaf(leaf, np.asarray(values)))
        return np.concatenate(parts, axis=1)


def _leaves(space: spaces.Space, path: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], spaces.Space]]:
    """The parts of a space that are not dictionaries or tuples, and the keys that lead there."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        named = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        for key, part in named:
            yield from _leaves(part, (*path, key))
    else:
        yield path, space


def _check_leaf(name: str, leaf: spaces.Space) -> None:
    if not isinstance(leaf, spaces.Box | spaces.MultiBinary | spaces.Discrete | spaces.MultiDiscrete):
        raise SourceError(f"observations {name!r} cannot be flattened to numbers: {leaf}")
    if isinstance(leaf, spaces.Box) and leaf.dtype == np.uint8 and len(leaf.shape) > 1:
        raise _image_error(name, leaf.shape)


def _image_error(name: str, shape: tuple[int, ...]) -> SourceError:
    return SourceError(f"observations {name!r} are images of shape {shape}: pixels are no variables of a causal graph")


def _flat_leaf(leaf: spaces.Space, values: np.ndarray) -> np.ndarray:
    """Shape (N, flatdim)."""
    if isinstance(leaf, spaces.Discrete):
        counts, starts = np.array([leaf.n]), np.array([leaf.start])
    elif isinstance(leaf, spaces.MultiDiscrete):
        counts, starts = leaf.nvec.ravel(), np.ravel(leaf.start)
    else:
        return _as_rows(values)
    columns = values.reshape(len(values), len(counts)) - starts
    return np.concatenate([columns[:, [i]] == np.arange(count) for i, count in enumerate(counts)], axis=1)


def _as_rows(values: np.ndarray) -> np.ndarray:
    return values.reshape(len(values), math.prod(values.shape[1:]))


def _action_names(space: spaces.Space) -> tuple[str, ...]:
    if not isinstance(space, spaces.Box):
        raise SourceError(f"continuous actions are needed (a Box), got {space}")
    return tuple(f"action[{index}]" for index in range(spaces.flatdim(space)))


class ReplayBufferSource(TransitionSource):
    """
    A replay buffer of SB3, or of its shape: one-step transitions straight from its arrays, oldest first. The preloaded
    transitions that CausalGDP saved with it come before its own.

    SB3 stores actions scaled to [-1, 1] and observations as the environment gave them.

    :param buffer: The buffer, of vectors or dictionaries of vectors, with any number of environments
    :param name: What to call it
    :param max_rows: Read at most this many transitions, spread evenly over all; None reads all
    :raises SourceError: when it is not a replay buffer, actions are not continuous, or observations are images
    """

    def __init__(self, buffer: Any, name: str = "replay buffer", max_rows: int | None = None) -> None:
        _check_is_buffer(buffer, name)
        preloaded, _ = getattr(buffer, "offline_part", (None, []))
        buffers = [buffer] if preloaded is None or preloaded is buffer else [preloaded, buffer]
        self._flat = FlatSpace(buffer.observation_space)
        variables = TransitionVariables(self._flat.names, _action_names(buffer.action_space))
        self._held = [(one, _held_positions(one)) for one in buffers]
        super().__init__(name, variables, sum(_n_known(one, positions) for one, positions in self._held), max_rows)

    def _parts(self, n_rows: int) -> Iterator[np.ndarray]:
        for buffer, positions in self._held:
            positions_per_part = max(1, n_rows // buffer.n_envs)
            for first in range(0, len(positions), positions_per_part):
                yield self._read(buffer, positions[first : first + positions_per_part])

    def _read(self, buffer: Any, positions: np.ndarray) -> np.ndarray:
        if buffer.optimize_memory_usage:
            after, next_positions = buffer.observations, (positions + 1) % buffer.buffer_size
        else:
            after, next_positions = buffer.next_observations, positions
        rows = self.variables.stack(
            self._states(buffer.observations, positions),
            _as_rows(_all_environments(buffer.actions, positions)),
            self._states(after, next_positions),
            buffer.rewards[positions].reshape(-1),
        )
        if buffer.optimize_memory_usage:
            # This buffer does not keep the last observation of an episode
            rows = rows[buffer.dones[positions].reshape(-1) == 0.0]
        return rows

    def _states(self, observations: np.ndarray | dict[str, np.ndarray], positions: np.ndarray) -> np.ndarray:
        if isinstance(observations, dict):
            return self._flat({key: _all_environments(values, positions) for key, values in observations.items()})
        return self._flat(_all_environments(observations, positions))


def _check_is_buffer(buffer: Any, name: str) -> None:
    missing = [attribute for attribute in BUFFER_ATTRIBUTES if not hasattr(buffer, attribute)]
    if missing:
        kind = type(buffer).__name__
        raise SourceError(f"{name} holds no replay buffer but a {kind}: save one with model.save_replay_buffer(path)")


def _held_positions(buffer: Any) -> np.ndarray:
    """The positions that can be read, oldest first."""
    n_positions = buffer.buffer_size if buffer.full else buffer.pos
    if buffer.full and buffer.optimize_memory_usage:
        n_positions -= 1  # the oldest observation has been overwritten
    return np.arange(buffer.pos - n_positions, buffer.pos) % buffer.buffer_size


def _n_known(buffer: Any, positions: np.ndarray) -> int:
    """Number of transitions there whose next observation is kept."""
    if buffer.optimize_memory_usage:
        return int(np.count_nonzero(buffer.dones[positions] == 0.0))
    return len(positions) * buffer.n_envs


def _all_environments(values: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """One row for each position and environment."""
    return values[positions].reshape(len(positions) * values.shape[1], *values.shape[2:])


class MinariSource(TransitionSource):
    """
    A Minari dataset, episode by episode; the last step of an episode has its true next observation.

    :param dataset: The dataset
    :param name: What to call it
    :param max_rows: Read at most this many transitions, spread evenly over all; None reads all
    :raises SourceError: when actions are not continuous, or observations are images
    """

    def __init__(self, dataset: Any, name: str = "dataset", max_rows: int | None = None) -> None:
        self.dataset = dataset
        self._flat = FlatSpace(dataset.observation_space)
        variables = TransitionVariables(self._flat.names, _action_names(dataset.action_space))
        super().__init__(name, variables, int(dataset.total_steps), max_rows)

    def _parts(self, n_rows: int) -> Iterator[np.ndarray]:
        for episode in self._episodes():
            # T steps have T + 1 observations
            states = self._flat(episode.observations)
            yield self.variables.stack(states[:-1], _as_rows(np.asarray(episode.actions)), states[1:], episode.rewards)

    def _episodes(self) -> Iterator[Any]:
        try:
            yield from self.dataset.iterate_episodes()
        except Exception as error:  # h5py raises all kinds on files that are cut off or damaged
            raise SourceError(f"{self.name} cannot be read, its file is damaged: {one_line(error)}") from error


class ArraySource(TransitionSource):
    """
    N transitions in four arrays.

    :param observations: s, shape (N, ...)
    :param actions: a, shape (N, ...)
    :param next_observations: s', of the shape of s
    :param rewards: r, shape (N,) or (N, 1)
    :param name: What to call them
    :param max_rows: Read at most this many transitions, spread evenly over all; None reads all
    :raises SourceError: when shapes do not fit, actions are not continuous, or observations are images
    """

    def __init__(
        self,
        observations: np.ndarray,
        actions: np.ndarray,
        next_observations: np.ndarray,
        rewards: np.ndarray,
        name: str = "arrays",
        max_rows: int | None = None,
    ) -> None:
        given = dict(zip(ARRAYS, (observations, actions, next_observations, rewards), strict=True))
        if len({values.shape[:1] for values in given.values()}) > 1 or rewards.ndim == 0:
            shapes = {key: values.shape for key, values in given.items()}
            raise SourceError(f"{name}: all arrays must have a row for each transition, got shapes {shapes}")
        if observations.dtype == np.uint8 and observations.ndim > 2:
            raise _image_error("observations", observations.shape[1:])
        if not np.issubdtype(actions.dtype, np.floating):
            raise SourceError(f"continuous actions are needed, got an array of {actions.dtype}")
        self._arrays = [_as_rows(values) for values in given.values()]
        names = [
            tuple(f"{prefix}[{index}]" for index in range(values.shape[1]))
            for prefix, values in zip(("obs", "action"), self._arrays[:2], strict=True)
        ]
        super().__init__(name, TransitionVariables(*names), len(rewards), max_rows)

    def _parts(self, n_rows: int) -> Iterator[np.ndarray]:
        for first in range(0, self.n_stored, n_rows):
            yield self.variables.stack(*(values[first : first + n_rows] for values in self._arrays))


def open_source(
    path_or_id: str | os.PathLike[str], *, download: bool = False, max_rows: int | None = None, trusted: bool = False
) -> TransitionSource:
    """
    Open recorded transitions by name.

    :param path_or_id: A replay buffer that ``model.save_replay_buffer`` wrote (``.npz``, ``.pkl``), arrays that
        ``numpy.savez`` wrote under the names ``observations``, ``actions``, ``next_observations`` and ``rewards`` (``.npz``),
        or the id of a Minari dataset
    :param download: Whether to download a Minari dataset that is not on this machine
    :param max_rows: Read at most this many transitions, spread evenly over all; None reads all
    :param trusted: Whether a pickled buffer may hold more than what SB3's own are made of, which could run code
    :return: the source
    :raises SourceError: when there is no such source, or discovery cannot use it
    """
    name = os.fspath(path_or_id)
    path = existing(name, SUFFIXES)  # save_replay_buffer adds the suffix, too
    if path.is_file():
        if path.suffix not in SUFFIXES:
            raise SourceError(f"{name} is neither a saved replay buffer (.npz, .pkl) nor arrays (.npz)")
        try:
            return _open_file(path, max_rows, trusted)
        except SourceError:
            raise
        except ValueError as error:
            raise SourceError(str(error)) from error
        except (AttributeError, IndexError, KeyError, TypeError) as error:
            # Something with the attributes of a buffer need not be one
            raise SourceError(f"{path} is incomplete or damaged: {one_line(error)}") from error
    if path.suffix in SUFFIXES or not MINARI_ID.fullmatch(name):
        raise SourceError(f"no file {name!r}, and the id of a Minari dataset ends in -v and a number")
    return _open_minari(name, download, max_rows, trusted)


def _open_file(path: Path, max_rows: int | None, trusted: bool) -> TransitionSource:
    if path.suffix == ".pkl":
        with errors_of(path, "cannot be read as a replay buffer"), path.open("rb") as file:
            buffer = _saved_buffer(read_arrays(path)) if is_zip(file) else read_pickle(file, trusted)
        return ReplayBufferSource(buffer, str(path), max_rows)
    with errors_of(path, "cannot be read as arrays"):
        arrays = read_arrays(path)
    if "buffer" in arrays:
        with errors_of(path, "cannot be read as a replay buffer"):
            buffer = _saved_buffer(arrays)
        return ReplayBufferSource(buffer, str(path), max_rows)
    missing = [name for name in ARRAYS if name not in arrays]
    if missing:
        raise SourceError(f"{path} lacks the arrays {missing}: it needs {list(ARRAYS)}")
    columns = {name: arrays[name] for name in ARRAYS}
    return ArraySource(*columns.values(), name=str(path), max_rows=max_rows)  # type: ignore[misc, arg-type]


def _saved_buffer(arrays: dict[str, np.ndarray], prefix: str = "") -> Any:
    """What ``save_replay_buffer`` wrote, with the rows that were stored."""
    own = {name.removeprefix(prefix): values for name, values in arrays.items() if name.startswith(prefix)}
    own = {name: values for name, values in own.items() if not name.startswith("offline/")}
    content = read_json(own["buffer"].tobytes())
    attributes = decoded(content, own["block"].tobytes(), Known(SPACES), only=BUFFER_ATTRIBUTES)
    missing = [name for name in BUFFER_ATTRIBUTES if name not in (*attributes, *own) and f"{name}/" not in str(list(own))]
    if missing:
        raise ValueError(f"it lacks {missing}")
    for name in ("observations", "next_observations"):
        keys = [key for key in own if key.startswith(f"{name}/")]
        if keys:
            own[name] = {key.removeprefix(f"{name}/"): own[key] for key in keys}  # type: ignore[assignment]
    buffer = SimpleNamespace(**{**own, **attributes})
    n_rows = buffer.buffer_size if buffer.full else buffer.pos
    for name in ("actions", "rewards", "dones"):
        if own[name].shape[:1] < (n_rows,) or own[name].shape[1:2] != (buffer.n_envs,):
            raise ValueError(f"{name} has shape {own[name].shape}, of {n_rows} rows and {buffer.n_envs} environments")
    if not prefix and "offline/buffer" in arrays:
        buffer.offline_part = (_saved_buffer(arrays, "offline/"), [])
    return buffer


def _open_minari(dataset_id: str, download: bool, max_rows: int | None, trusted: bool) -> TransitionSource:
    try:
        import minari  # noqa: F401
    except ImportError as error:
        raise SourceError(f"no file {dataset_id!r}, and a Minari dataset needs the package minari: {OFFLINE_HINT}") from error
    try:
        dataset = load_minari(dataset_id, download, trusted)
    except FileNotFoundError as error:
        raise SourceError(
            f"no Minari dataset {dataset_id!r} on this machine: ask for its download (--download); {how_to_make(dataset_id)}"
        ) from error
    except DownloadError as error:
        raise SourceError(
            f"the Minari dataset {dataset_id!r} is not on this machine and cannot be downloaded ({error}): "
            f"{how_to_make(dataset_id)}"
        ) from None
    except Exception as error:  # of a broken file
        raise SourceError(f"the Minari dataset {dataset_id!r} cannot be loaded: {one_line(error)}") from error
    try:
        return MinariSource(dataset, dataset_id, max_rows)
    except SourceError:
        raise
    except Exception as error:  # of damaged metadata
        raise SourceError(f"the Minari dataset {dataset_id!r} cannot be read: {one_line(error)}") from error
