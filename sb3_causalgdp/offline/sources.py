"""Where offline transitions come from: Minari datasets, replay buffers of SB3 and arrays, read in chunks of rows."""

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer

from sb3_causalgdp.hints import how_to_make
from sb3_causalgdp.offline.extras import OFFLINE_HINT
from sb3_causalgdp.offline.rewards import RewardTransform, SavedRewards
from sb3_causalgdp.offline.saved_buffers import SUFFIXES, is_buffer, read_buffer
from sb3_causalgdp.saving.archives import DownloadError, errors_of, existing, load_minari, one_line, read_arrays
from sb3_causalgdp.sources.columns import SUFFIXES as TABLE_SUFFIXES
from sb3_causalgdp.sources.columns import is_frame
from sb3_causalgdp.sources.tables import Table

MINARI_ID = re.compile(r"(\w+://[-\w]+/)?[-\w]+(/[-\w]+)*-v\d+")
ARRAYS = ("observations", "actions", "rewards", "next_observations", "terminations", "truncations")
BUFFER_FIELDS = (
    *("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "pos", "full", "buffer_size", "n_envs"),
    *("optimize_memory_usage", "observation_space", "action_space"),
)
CHUNK_ROWS = 10_000
TABLE_HINT = "Table(source, states=[...], actions=[...], reward=...) of sb3_causalgdp.sources.tables"


@dataclass(frozen=True)
class Chunk:
    """
    Consecutive transitions of one trajectory or of several.

    :param observations: One row for each transition, in dictionaries and tuples like those of the space
    :param next_observations: Likewise
    :param actions: Shape ``(T, ...)``
    :param rewards: Shape ``(T,)``
    :param terminations: Whether the episode ended there, shape ``(T,)``
    :param truncations: Whether it was cut there, shape ``(T,)``
    """

    observations: Any
    next_observations: Any
    actions: np.ndarray
    rewards: np.ndarray
    terminations: np.ndarray
    truncations: np.ndarray

    def __len__(self) -> int:
        return len(self.rewards)


def as_flags(values: Any, name: str) -> np.ndarray:
    """
    :param values: Whether something is so, for each of N transitions: bool, or 0 and 1, shape ``(N,)`` or ``(N, 1)``
    :param name: What to call them
    :return: The same as bool, shape ``(N,)``
    :raises ValueError: If one is anything else, such as NaN, -1 or a string
    """
    values = np.asarray(values)
    flags = _one_each(values, name)
    if values.dtype == bool:
        return flags
    known = np.zeros(len(flags), dtype=bool)
    if values.dtype.kind in "fiuO":
        known = ((flags == 0) | (flags == 1)).astype(bool)
    if not known.all():
        row = int(np.argmin(known))
        raise ValueError(f"{name} must be bool, or 0 and 1, got {flags.tolist()[row]!r} at transition {row}")
    return (flags == 1).astype(bool)


def _one_each(values: np.ndarray, name: str) -> np.ndarray:
    """Shape (N,)."""
    if values.shape[1:] not in ((), (1,)):
        raise ValueError(f"{name} must have the shape (N,) or (N, 1), got {values.shape}")
    return values.reshape(-1)


class Source:
    """
    Offline transitions: a name, the spaces where they are known, and the rows in their order.

    :param name: What to call it
    :param n_transitions: Number of transitions
    :param observation_space: None if it is not known
    :param action_space: None if it is not known
    :param environment: Name of the environment that it was collected in, None if it is not known
    """

    has_scaled_actions = False
    """Whether actions are in [-1, 1] already, as SB3's replay buffers store them."""
    layout: spaces.Space | None = None
    """What flat observations were flattened from, with its order of keys; None if it is not known."""
    state_names: tuple[str, ...] | None = None
    """Names of the components of an observation, where the source has them."""
    action_names: tuple[str, ...] | None = None
    """Names of the components of an action, where the source has them."""
    is_in_order = True
    """Whether a transition that does not end an episode is followed by the next one of that episode."""

    def __init__(
        self,
        name: str,
        n_transitions: int,
        observation_space: spaces.Space | None = None,
        action_space: spaces.Space | None = None,
        environment: str | None = None,
    ) -> None:
        if action_space is not None and not isinstance(action_space, spaces.Box):
            raise ValueError(f"{name} has the action space {action_space}, but continuous actions (a Box) are needed")
        if n_transitions == 0:
            raise ValueError(f"{name} is empty: it holds no transitions")
        self.name = name
        self.n_transitions = n_transitions
        self.observation_space = observation_space
        self.action_space = action_space
        self.environment = environment

    def chunks(self) -> Iterator[Chunk]:
        """
        :return: All transitions in their order, as often as one likes
        """
        raise NotImplementedError


class MinariSource(Source):
    """
    A Minari dataset, one episode a chunk.

    :param dataset: A ``minari.MinariDataset``
    """

    def __init__(self, dataset: Any) -> None:
        environment = dataset.env_spec.name if dataset.env_spec is not None else None
        n_transitions = int(dataset.total_steps) if len(dataset) > 0 else 0
        super().__init__(dataset.id, n_transitions, dataset.observation_space, dataset.action_space, environment)
        self.dataset = dataset

    def chunks(self) -> Iterator[Chunk]:
        episodes = self._episodes()
        for number, episode in enumerate(episodes):
            # T steps have T + 1 observations; float64 and nested like the space
            truncations = as_flags(episode.truncations, f"{self.name}: truncations of episode {number}").copy()
            terminations = as_flags(episode.terminations, f"{self.name}: terminations of episode {number}")
            if len(truncations) == 0:
                continue
            if not (terminations[-1:].any() or truncations[-1]):
                truncations[-1] = True  # the recording stopped there
            lengths = {len(values) - 1 for values in _arrays_of(episode.observations)}
            lengths |= {len(values) for values in (episode.actions, episode.rewards, terminations)}
            if lengths != {len(truncations)}:
                raise ValueError(
                    f"{self.name}: episode {number} is incomplete, its arrays have lengths that do not fit together"
                )
            yield Chunk(
                _rows_of(episode.observations, slice(None, -1)),
                _rows_of(episode.observations, slice(1, None)),
                np.asarray(episode.actions),
                np.asarray(episode.rewards),
                terminations,
                truncations,
            )

    def _episodes(self) -> Iterator[Any]:
        try:
            yield from self.dataset.iterate_episodes()
        except Exception as error:  # h5py raises all kinds on files that are cut off or damaged
            raise ValueError(
                f"{self.name} cannot be read, its file is incomplete or damaged: {one_line(error)}. Delete "
                f"{self.dataset.storage.data_path} and download it again"
            ) from error


class BufferSource(Source):
    """
    A replay buffer of SB3: the trajectory of each environment, one after the other. The preloaded transitions that were saved
    with it come first. Rewards are those of the environment, also where the buffer was saved with transformed ones.

    :param buffer: The buffer
    :param name: What to call it
    """

    has_scaled_actions = True

    def __init__(self, buffer: ReplayBuffer, name: str = "The replay buffer") -> None:
        self.layout = getattr(buffer, "observation_layout", None)
        done = getattr(buffer, "reward_transform", None)
        self.reward_transform = None if done is None else SavedRewards.from_plain(done).transform
        dropped = "next_observations" if getattr(buffer, "optimize_memory_usage", False) else None
        missing = [field for field in BUFFER_FIELDS if field != dropped and not hasattr(buffer, field)]
        if missing:
            raise ValueError(f"{name} lacks {missing}: it was not written by this version of SB3's {type(buffer).__name__}")
        self.buffers = [part for part in (preloaded_part_of(buffer), buffer) if part is not None]
        if any(part.optimize_memory_usage for part in self.buffers):
            raise ValueError(
                f"{name} was made with optimize_memory_usage=True and does not hold the last observations of its episodes: "
                "continue it with load_replay_buffer(), or record it without that option"
            )
        n_transitions = sum(part.size() * part.n_envs for part in self.buffers)
        super().__init__(name, n_transitions, buffer.observation_space, buffer.action_space)

    def chunks(self) -> Iterator[Chunk]:
        for buffer in self.buffers:
            for column in range(buffer.n_envs):
                yield from self._trajectory(buffer, column)

    def _trajectory(self, buffer: ReplayBuffer, column: int) -> Iterator[Chunk]:
        positions = np.arange(buffer.pos - buffer.size(), buffer.pos) % buffer.buffer_size
        for first in range(0, len(positions), CHUNK_ROWS):
            rows = positions[first : first + CHUNK_ROWS]
            dones = as_flags(buffer.dones[rows, column], f"{self.name}: dones of environment {column}")
            truncations = as_flags(buffer.timeouts[rows, column], f"{self.name}: timeouts of environment {column}")
            terminations = dones & ~truncations
            if rows[-1] == positions[-1] and not dones[-1]:
                truncations[-1] = True  # the next one belongs to another environment
            yield Chunk(
                _rows_of(buffer.observations, (rows, column)),
                _rows_of(buffer.next_observations, (rows, column)),
                buffer.actions[rows, column],
                self._raw(buffer.rewards[rows, column]),
                terminations,
                truncations,
            )

    def _raw(self, rewards: np.ndarray) -> np.ndarray:
        changed = self.reward_transform not in (None, RewardTransform())
        return self.reward_transform.undone(rewards) if changed else rewards  # type: ignore[union-attr]


def preloaded_part_of(buffer: ReplayBuffer) -> ReplayBuffer | None:
    """
    :param buffer: A replay buffer that was saved
    :return: The buffer of preloaded transitions that was saved with it; None if there is none, or it is the same
    """
    part, _ = getattr(buffer, "offline_part", (None, []))
    return None if part is buffer else part


class ArraySource(Source):
    """
    N transitions in arrays.

    :param arrays: ``observations`` and ``next_observations`` (arrays, or dictionaries of arrays), ``actions``, ``rewards``,
        ``terminations`` and ``truncations``
    :param name: What to call them
    """

    is_in_order = False

    def __init__(self, arrays: Mapping[str, Any], name: str = "The arrays") -> None:
        missing = [key for key in ARRAYS if key not in arrays]
        if missing:
            raise ValueError(f"{name} lack {missing}: {list(ARRAYS)} are needed")
        self.arrays = {key: _as_arrays(arrays[key]) for key in ARRAYS}
        lengths = {key: [len(values) if values.ndim else 0 for values in _arrays_of(self.arrays[key])] for key in ARRAYS}
        if len({length for given in lengths.values() for length in given}) != 1:
            raise ValueError(f"{name} must have one row for each transition, got lengths {lengths}")
        if not np.issubdtype(self.arrays["actions"].dtype, np.floating):
            raise ValueError(f"{name} have actions of {self.arrays['actions'].dtype}, but continuous actions are needed")
        for key in ("terminations", "truncations"):
            self.arrays[key] = as_flags(self.arrays[key], f"{name}: {key}")
        self.arrays["rewards"] = _one_each(self.arrays["rewards"], f"{name}: rewards")
        for key in ("observations", "next_observations", "rewards"):
            _check_numbers(self.arrays[key], f"{name}: {key}")
        super().__init__(name, len(self.arrays["actions"]))

    def chunks(self) -> Iterator[Chunk]:
        for first in range(0, self.n_transitions, CHUNK_ROWS):
            rows = slice(first, first + CHUNK_ROWS)
            observations, actions, rewards, next_observations, terminations, truncations = (
                _rows_of(self.arrays[key], rows) for key in ARRAYS
            )
            yield Chunk(
                observations,
                next_observations,
                actions,
                rewards,
                terminations,
                truncations,
            )


class TableSource(ArraySource):
    """
    The transitions of a table, in single precision.

    :param table: The table
    """

    is_in_order = True

    def __init__(self, table: Table) -> None:
        none = np.zeros(len(table), dtype=bool)
        columns = {"observations": table.observations, "next_observations": table.next_observations}
        columns = {name: values.astype(np.float32) for name, values in columns.items()}
        self.state_names, self.action_names = tuple(table.state_names), tuple(table.action_names)
        rest = {"actions": table.actions.astype(np.float32), "rewards": table.rewards}
        super().__init__({**columns, **rest, "terminations": none, "truncations": table.is_last}, table.name)


def _check_numbers(tree: Any, name: str) -> None:
    for values in _arrays_of(tree):
        if values.dtype.kind not in "fiub":
            raise ValueError(f"{name} must be numbers, got an array of {values.dtype}")


def open_source(source: Any, download: bool = True, trusted: bool = False) -> Source:
    """
    :param source: The id of a Minari dataset, a ``minari.MinariDataset``, a replay buffer of SB3 or the path of a saved one
        (``.npz``, ``.pkl``), arrays: a mapping or the path of what ``numpy.savez`` wrote (``.npz``), or a
        :class:`~sb3_causalgdp.sources.tables.Table`
    :param download: Whether to download a Minari dataset that is not on this machine
    :param trusted: Whether a pickled buffer may hold more than what SB3's own are made of, which could run code
    :return: The source, of which no row has been read
    :raises FileNotFoundError: If there is no such file or dataset
    :raises ValueError: If it cannot be used
    :raises ImportError: If it needs a package that is not installed
    """
    if isinstance(source, Source):
        return source
    if isinstance(source, ReplayBuffer):
        return BufferSource(source)
    if isinstance(source, Table):
        return TableSource(source)
    if is_frame(source):
        raise ValueError(f"Of a table the columns are needed: {TABLE_HINT}")
    if isinstance(source, Mapping):
        return ArraySource(source)
    if isinstance(source, str | os.PathLike):
        if Path(source).suffix.lower() in set(TABLE_SUFFIXES) - set(SUFFIXES):
            raise ValueError(f"{source} is a table, whose columns are needed: {TABLE_HINT}")
        return _open_name(os.fspath(source), download, trusted)
    if hasattr(source, "iterate_episodes"):
        return MinariSource(source)
    raise TypeError(
        "A source is the id of a Minari dataset, a MinariDataset, a replay buffer, a path or a mapping of arrays, "
        f"got {type(source).__name__}"
    )


def _open_name(name: str, download: bool, trusted: bool) -> Source:
    path = existing(name, SUFFIXES)  # save_replay_buffer adds the suffix, too
    if path.is_file():
        return _open_file(path, trusted)
    if path.suffix in SUFFIXES or not MINARI_ID.fullmatch(name):
        raise FileNotFoundError(f"There is no file {name!r}, and the id of a Minari dataset ends in -v and a number")
    return _open_minari(name, download, trusted)


def _open_file(path: Path, trusted: bool) -> Source:
    if path.suffix == ".npz" and not is_buffer(path):
        with errors_of(path, "cannot be read as arrays"):
            arrays = read_arrays(path, ARRAYS)
        return ArraySource(arrays, str(path))
    return BufferSource(read_buffer(path, trusted), str(path))


def _open_minari(dataset_id: str, download: bool, trusted: bool) -> Source:
    try:
        import minari  # noqa: F401
    except ImportError as error:
        raise ImportError(f"The Minari dataset {dataset_id!r} needs the package minari: {OFFLINE_HINT}") from error
    try:
        dataset = load_minari(dataset_id, download, trusted)
    # The hub's libraries raise long chains, of which the last line says all
    except FileNotFoundError:
        raise FileNotFoundError(
            f"The Minari dataset {dataset_id!r} is not on this machine: {how_to_make(dataset_id)}"
        ) from None
    except DownloadError as error:
        raise ValueError(
            f"The Minari dataset {dataset_id!r} is not on this machine and cannot be downloaded ({error}): "
            f"{how_to_make(dataset_id)}"
        ) from None
    except ImportError as error:
        raise ImportError(f"The Minari dataset {dataset_id!r} needs another package ({error}): {OFFLINE_HINT}") from error
    except Exception as error:  # of a broken file
        raise ValueError(f"The metadata of the Minari dataset {dataset_id!r} are damaged: {one_line(error)}") from error
    with errors_of(dataset_id):
        return MinariSource(dataset)


def _as_arrays(values: Any) -> Any:
    if isinstance(values, Mapping):
        return {key: _as_arrays(part) for key, part in values.items()}
    return np.asarray(values)


def _arrays_of(tree: Any) -> Iterator[np.ndarray]:
    """The arrays in dictionaries and tuples."""
    if isinstance(tree, Mapping | tuple):
        for part in tree.values() if isinstance(tree, Mapping) else tree:
            yield from _arrays_of(part)
    else:
        yield np.asarray(tree)


def _rows_of(tree: Any, rows: Any) -> Any:
    if isinstance(tree, Mapping):
        return {key: _rows_of(part, rows) for key, part in tree.items()}
    if isinstance(tree, tuple):
        return tuple(_rows_of(part, rows) for part in tree)
    return tree[rows]
