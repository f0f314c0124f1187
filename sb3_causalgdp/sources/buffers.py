"""Replay buffers of SB3 as recorded transitions, read by their attributes alone: no class of SB3 is needed."""

import math
import zipfile
from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_causalgdp.saving.archives import errors_of, is_model, is_zip, named, opened, read_arrays, read_pickle
from sb3_causalgdp.saving.plain import SPACES, Known, decoded, read_json
from sb3_causalgdp.sources.chunks import CHUNK_ROWS, Chunk, Source, as_flags, check_numbers, mapped
from sb3_causalgdp.sources.rewards import RewardTransform, SavedRewards

SUFFIXES = (".npz", ".pkl")
CONTENT, BLOCK, OFFLINE = "buffer", "block", "offline/"
# Attributes that our algorithm gives a buffer while it is written
ADDED = ("saved_after", "observation_layout", "reward_transform")
HOW_TO_SAVE = "save one with model.save_replay_buffer(path)"
MOST_ROWS = 100_000_000
RECORDED_ROWS = 4096  # a batch of discovery, which copies nothing then
COLUMNS = ("observations", "actions", "rewards", "dones")
NUMBERS = ("pos", "full", "buffer_size", "n_envs", "optimize_memory_usage")
ATTRIBUTES = (*COLUMNS, *NUMBERS, "observation_space", "action_space")


class BufferSource(Source):
    """
    A replay buffer of SB3, or what has its attributes: the trajectory of each environment, one after the other. The preloaded
    transitions that were saved with it come first. Rewards are those of the environment, also where the buffer was saved with
    transformed ones.

    A buffer with ``optimize_memory_usage=True`` does not keep the last observation of an episode: the transitions that lead
    there are left out, and training refuses it.

    :param buffer: The buffer, with any number of environments
    :param name: What to call it
    :raises ValueError: If it lacks something, its attributes do not fit together, or actions are not continuous
    """

    has_scaled_actions = True

    def __init__(self, buffer: Any, name: str = "The replay buffer") -> None:
        self.layout = getattr(buffer, "observation_layout", None)
        done = getattr(buffer, "reward_transform", None)
        self.reward_transform = None if done is None else SavedRewards.from_plain(done).transform
        self.buffers = [part for part in (preloaded_part_of(buffer), buffer) if part is not None]
        for part in self.buffers:
            self._check(part, name)
        n_transitions = sum(_n_transitions(part) for part in self.buffers)
        super().__init__(name, n_transitions, buffer.observation_space, buffer.action_space)

    def _check(self, buffer: Any, name: str) -> None:
        missing = [field for field in ATTRIBUTES if not hasattr(buffer, field)]
        saves_memory = getattr(buffer, "optimize_memory_usage", False)
        if not saves_memory and not hasattr(buffer, "next_observations"):
            missing.append("next_observations")
        lack = f"{name} lacks {missing or ['timeouts']}: it was not written by this version of SB3"
        if missing:
            raise ValueError(lack)
        with errors_of(name, "is incomplete or damaged"):
            check_attributes(buffer)
        if saves_memory:
            self.lack = (
                f"{name} was made with optimize_memory_usage=True and does not hold the last observations of its episodes: "
                "continue it with load_replay_buffer(), or record it without that option"
            )
        elif not hasattr(buffer, "timeouts"):
            self.lack = lack

    def chunks(self) -> Iterator[Chunk]:
        for buffer in self.buffers:
            for column in range(buffer.n_envs):
                yield from self._trajectory(buffer, column)

    def as_recorded(self) -> Iterator[Chunk]:
        for buffer in self.buffers:
            positions = _positions(buffer)
            n_positions = max(1, RECORDED_ROWS // buffer.n_envs)
            for first in range(0, len(positions), n_positions):
                yield self._read(buffer, positions[first : first + n_positions])

    def _trajectory(self, buffer: Any, column: int) -> Iterator[Chunk]:
        positions = _positions(buffer)
        for first in range(0, len(positions), CHUNK_ROWS):
            rows = positions[first : first + CHUNK_ROWS]
            chunk = self._read(buffer, rows, column)
            if self.lack is not None:
                yield chunk
                continue
            dones = as_flags(buffer.dones[rows, column], f"{self.name}: dones of environment {column}")
            truncations = as_flags(buffer.timeouts[rows, column], f"{self.name}: timeouts of environment {column}")
            terminations = dones & ~truncations
            if rows[-1] == positions[-1] and not dones[-1]:
                truncations[-1] = True  # the next one belongs to another environment
            yield replace(chunk, terminations=terminations, truncations=truncations)

    def _read(self, buffer: Any, positions: np.ndarray, column: int | None = None) -> Chunk:
        """Of one environment, or of all of them step by step."""

        def at(positions: np.ndarray, values: np.ndarray) -> np.ndarray:
            if column is not None:
                return values[positions, column]
            return values[positions].reshape(len(positions) * values.shape[1], *values.shape[2:])

        saves_memory = buffer.optimize_memory_usage
        after = buffer.observations if saves_memory else buffer.next_observations
        following = (positions + 1) % buffer.buffer_size if saves_memory else positions
        columns = {
            "observations": mapped(lambda values: at(positions, values), buffer.observations),
            "next_observations": mapped(lambda values: at(following, values), after),
            "actions": at(positions, buffer.actions),
            "rewards": self._of_environment(at(positions, buffer.rewards)),
        }
        if saves_memory:
            is_kept = at(positions, buffer.dones) == 0.0
            columns = {name: mapped(lambda values: values[is_kept], tree) for name, tree in columns.items()}
        return Chunk(**columns)

    def _of_environment(self, rewards: np.ndarray) -> np.ndarray:
        changed = self.reward_transform not in (None, RewardTransform())
        return self.reward_transform.undone(rewards) if changed else rewards  # type: ignore[union-attr]


def is_replay_buffer(source: Any) -> bool:
    """
    :param source: Anything
    :return: Whether it looks like a replay buffer of SB3
    """
    return all(hasattr(source, name) for name in ("observations", *NUMBERS))


def preloaded_part_of(buffer: Any) -> Any:
    """
    :param buffer: A replay buffer that was saved
    :return: The buffer of preloaded transitions that was saved with it; None if there is none, or it is the same
    """
    part, _ = getattr(buffer, "offline_part", (None, []))
    return None if part is buffer else part


def n_stored_rows(buffer: Any) -> int:
    """
    :param buffer: A replay buffer
    :return: How many rows of its arrays hold something
    """
    # The memory efficient buffer keeps the newest next observation at the position of the next row
    return buffer.buffer_size if buffer.full else min(buffer.pos + int(buffer.optimize_memory_usage), buffer.buffer_size)


def _positions(buffer: Any) -> np.ndarray:
    """Of the transitions, the oldest first."""
    n_positions = buffer.buffer_size if buffer.full else buffer.pos
    if buffer.full and buffer.optimize_memory_usage:
        n_positions -= 1  # the oldest observation has been overwritten
    return np.arange(buffer.pos - n_positions, buffer.pos) % buffer.buffer_size


def _n_transitions(buffer: Any) -> int:
    positions = _positions(buffer)
    if buffer.optimize_memory_usage:
        return int(np.count_nonzero(buffer.dones[positions] == 0.0))
    return len(positions) * buffer.n_envs


def check_attributes(buffer: Any) -> None:
    """
    :param buffer: What has the attributes of a replay buffer
    :raises ValueError: If they are not of the kinds that rows can be read from, or do not fit each other
    """
    for name in ("n_envs", "buffer_size"):
        check_count(getattr(buffer, name), name, 1, MOST_ROWS)
    check_count(buffer.pos, "pos", 0, buffer.buffer_size - 1)
    for name in ("full", "optimize_memory_usage"):
        if not isinstance(getattr(buffer, name), bool | np.bool_):
            raise ValueError(f"{name} must be of bool, got {type(getattr(buffer, name)).__name__}")
    for name in ("observation_space", "action_space"):
        space = getattr(buffer, name)
        if not isinstance(space, spaces.Space) or space != space:
            raise ValueError(f"its {name} is no space, but of {type(space).__name__}")
    wanted = (n_stored_rows(buffer), buffer.n_envs)
    for name in (*COLUMNS, "next_observations", "timeouts"):
        for key, values in _arrays_by_key(getattr(buffer, name, {})):
            width = values.shape[2:]
            if values.shape[:1] < wanted[:1] or values.shape[1:2] != wanted[1:] or not _fits(buffer, name, key, width):
                raise ValueError(f"{name} has shape {values.shape}, of {wanted[0]} rows and {wanted[1]} environments")
            check_numbers(values, name)


def check_count(value: Any, name: str, least: int, most: int) -> None:
    """
    :param value: An attribute of a buffer
    :param name: Its name
    :param least: The least that it may be
    :param most: The most
    :raises ValueError: If it is no integer in this range
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or not least <= value <= most:
        raise ValueError(f"{name} must be an integer from {least} to {most:,}, got {str(value)[:80]!r}")


def _arrays_by_key(column: Any) -> Iterator[tuple[str, np.ndarray]]:
    if not isinstance(column, dict):
        column = {"": column}
    for key, values in column.items():
        if not isinstance(values, np.ndarray):
            raise ValueError(f"its arrays are of {type(values).__name__}")
        yield key, values


def _fits(buffer: Any, name: str, key: str, width: tuple[int, ...]) -> bool:
    """Whether a row has as many numbers as its space says."""
    if "observations" in name:
        space = buffer.observation_space
        space = space.spaces.get(key) if isinstance(space, spaces.Dict) else space
        return space is None or space.shape is None or math.prod(width) == math.prod(space.shape)
    return name == "actions" or width == ()


# Files ------------------------------------------------------------------------------------------------------------------


def is_saved_buffer(path: Path) -> bool:
    """
    :param path: A file
    :return: Whether it holds a replay buffer as arrays
    """
    with errors_of(path):
        return zipfile.is_zipfile(path) and f"{CONTENT}.npy" in zipfile.ZipFile(path).namelist()


def read_saved_buffer(path: Any, trusted: bool = False) -> Any:
    """
    Read what ``save_replay_buffer`` wrote, for its transitions alone: to train on with it, there is
    :func:`~sb3_causalgdp.offline.saved_buffers.read_buffer`.

    :param path: Path or file-like object
    :param trusted: Whether a pickle may hold more than what SB3's own are made of, which could run code
    :return: What :class:`BufferSource` takes, with the rows that were stored
    :raises ValueError: If it cannot be read
    """
    with errors_of(path, "cannot be read as a replay buffer"):
        arrays, pickled = content_of(path, trusted)
        if arrays is None and not is_replay_buffer(pickled):
            raise no_buffer_error(pickled, path)
        if arrays is None:
            return pickled
        own, preloaded = split_arrays(arrays)
        buffer = _as_buffer(own)
        buffer.offline_part = (_as_buffer(preloaded) if preloaded else None, [])
        return buffer


def content_of(path: Any, trusted: bool = False) -> tuple[dict[str, np.ndarray] | None, Any]:
    """
    :param path: Path or file-like object of a saved replay buffer
    :param trusted: Whether a pickle may hold more than what SB3's own are made of, which could run code
    :return: Its arrays by name, or None and what was pickled
    :raises ValueError: If it is neither
    """
    with opened(path) as file:
        if is_model(file):
            raise ValueError(f"{named(path)} is a model, which is saved without its buffer: {HOW_TO_SAVE}")
        return (read_arrays(file), None) if is_zip(file) else (None, read_pickle(file, trusted))


def no_buffer_error(content: Any, path: Any) -> ValueError:
    """
    :param content: What was pickled in place of a replay buffer
    :param path: The file
    :return: What to raise
    """
    kind = type(content).__name__
    return ValueError(f"{named(path)} holds no replay buffer but a {kind}: {HOW_TO_SAVE}")


def split_arrays(arrays: dict[str, np.ndarray]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """
    :param arrays: Of a file
    :return: Those of the replay buffer, and those of the preloaded transitions, which may be none
    """
    own = {name: values for name, values in arrays.items() if not name.startswith(OFFLINE)}
    return own, {name.removeprefix(OFFLINE): values for name, values in arrays.items() if name.startswith(OFFLINE)}


def attributes_of(arrays: dict[str, np.ndarray], known: Known, only: Collection[str] | None = None) -> dict[str, Any]:
    """
    :param arrays: Of one buffer, from which those that hold its attributes are taken away
    :param known: Classes that may be named
    :param only: Attributes that are read, None for all
    :return: Its attributes beside the arrays that are left
    :raises ValueError: If they cannot be read, or are not of their kinds
    """
    if CONTENT not in arrays or BLOCK not in arrays:
        raise ValueError("it says of no replay buffer what it is")
    content = decoded(read_json(arrays.pop(CONTENT).tobytes()), arrays.pop(BLOCK).tobytes(), known, only=only)
    if type(content.get("saved_after", 0)) is not int:
        raise ValueError(f"saved_after must be a number of steps, got {str(content['saved_after'])[:80]}")
    if not isinstance(content.get("observation_layout"), spaces.Space | None):
        raise ValueError(f"observation_layout must be a space, got {str(content['observation_layout'])[:80]}")
    if "reward_transform" in content:
        SavedRewards.from_plain(content["reward_transform"])
    return content


def _as_buffer(arrays: dict[str, np.ndarray]) -> SimpleNamespace:
    attributes = attributes_of(arrays, Known(SPACES), (*NUMBERS, "observation_space", "action_space", *ADDED))
    columns: dict[str, Any] = {}
    for name, values in arrays.items():
        column, slash, key = name.partition("/")
        if slash:
            columns.setdefault(column, {})[key] = values
        else:
            columns[column] = values
    return SimpleNamespace(**{**columns, **attributes})
