"""Replay buffers in files to which only what is new is added."""

import weakref
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_causalgdp.checkpoints.pickles import from_bytes, to_bytes
from sb3_causalgdp.files import replaced_when_done
from sb3_causalgdp.offline.replay import arrays_of
from sb3_causalgdp.saving.archives import read_arrays

FOLDER = "transitions"
# Rows of these are never changed once they were written; what other classes do is not known
KNOWN_CLASSES = (ReplayBuffer, DictReplayBuffer, NStepReplayBuffer, HerReplayBuffer)
# Of hindsight replay: changed when an episode ends
CHANGED_LATER = ("ep_start", "ep_length")
NOT_WRITTEN = ("env", "device", "observation_space", "action_space")


@dataclass(frozen=True)
class Segment:
    """
    A file of consecutive rows.

    :param name: Of the file, in the folder of transitions
    :param first: Number of its first row, counted from the first that was ever stored
    :param end: Number behind that of its last row
    """

    name: str
    first: int
    end: int


@dataclass
class Log:
    """
    Where the rows of a replay buffer are.

    :param segments: Files, oldest rows first
    :param stored: Number of rows that were ever stored
    :param position: Where the buffer stores its next row
    :param version: Changes when rows that were stored already change
    """

    segments: list[Segment] = field(default_factory=list)
    stored: int = 0
    position: int = 0
    version: str = ""
    buffer: "weakref.ref[ReplayBuffer] | None" = None

    # Pieces up to that size are put together, so that their number grows with the logarithm of the rows
    MOST_ROWS = 131_072

    def to_json(self) -> dict[str, Any]:
        """
        :return: All but the buffer
        """
        segments = [asdict(segment) for segment in self.segments]
        return {"segments": segments, "stored": self.stored, "position": self.position, "version": self.version}

    @classmethod
    def from_json(cls, content: dict[str, Any], buffer: ReplayBuffer | None = None) -> "Log":
        """
        :param content: What :meth:`to_json` said
        :param buffer: That holds these rows now
        :return: The log
        """
        segments = [Segment(**segment) for segment in content["segments"]]
        reference = None if buffer is None else weakref.ref(buffer)
        return cls(segments, content["stored"], content["position"], content["version"], reference)

    def append(self, buffer: ReplayBuffer, folder: Path, prefix: str, stored: int, version: str) -> "Log":
        """
        Write the rows that are in no file yet.

        :param buffer: The replay buffer
        :param folder: Of the files
        :param prefix: Of the names of new files
        :param stored: Number of rows that were ever stored in the buffer
        :param version: See the class
        :return: The log with new files; older ones that it does not name are needed by older logs alone
        """
        oldest = stored - buffer.size()
        segments = self.segments if self._is_continued_by(buffer, stored, version) else []
        segments = [segment for segment in segments if segment.end > oldest]
        first = segments[-1].end if segments else oldest
        while segments and segments[-1].first >= oldest and self._are_put_together(segments[-1], first, stored):
            first = segments.pop().first
        if stored > first:
            # Rows that change get a file of their own: older checkpoints need the former one
            of_version = f"-{zlib.crc32(version.encode()):08x}" if version else ""
            name = f"{prefix}{of_version}-{first:010d}-{stored:010d}.npz"
            with replaced_when_done(folder / name) as file:
                np.savez(file, allow_pickle=False, **_rows(buffer, _indices(buffer, first, stored, stored)))
            segments.append(Segment(name, first, stored))
        return Log(segments, stored, buffer.pos, version, weakref.ref(buffer))

    def _is_continued_by(self, buffer: ReplayBuffer, stored: int, version: str) -> bool:
        same = self.buffer is not None and self.buffer() is buffer and version == self.version
        fits = (self.position + stored - self.stored) % buffer.buffer_size == buffer.pos
        return same and fits and stored >= self.stored and type(buffer) in KNOWN_CLASSES

    def _are_put_together(self, segment: Segment, first: int, end: int) -> bool:
        return segment.end - segment.first <= end - first and end - segment.first <= self.MOST_ROWS

    def fill(self, buffer: ReplayBuffer, read: Any) -> None:
        """
        Put the rows into an empty buffer of the same kind and size.

        :param buffer: The replay buffer
        :param read: Opens a file by its name
        """
        columns = dict(_columns(buffer))
        for segment in self.segments:
            first = max(segment.first, self.stored - buffer.buffer_size)
            if not (Path(segment.name).name == segment.name and 0 <= segment.first <= segment.end <= self.stored):
                raise ValueError(f"{segment} is not about {self.stored} rows")
            indices = (self.position - (self.stored - np.arange(first, segment.end))) % buffer.buffer_size
            with read(f"{FOLDER}/{segment.name}") as file:
                for name, column in columns.items():
                    rows = read_arrays(file, (name,))
                    if name not in rows:
                        raise ValueError(f"{segment.name} lacks {name}")
                    column[indices] = _decoded(rows[name])[first - segment.first :]


def rest_of(buffer: ReplayBuffer) -> dict[str, Any]:
    """
    :param buffer: A replay buffer
    :return: What it holds beside rows, by attribute
    """
    row_columns = {name.partition("/")[0] for name, _ in _columns(buffer)}
    rest = {
        name: value
        for name, value in vars(buffer).items()
        if name not in row_columns
        and name not in NOT_WRITTEN
        and not (isinstance(value, np.ndarray) and value.dtype.hasobject)
    }
    if buffer.optimize_memory_usage:
        # The newest next observation lies where the next row will be
        rest["next_observation"] = np.array(buffer.observations[buffer.pos])
    return rest


def set_rest(buffer: ReplayBuffer, rest: dict[str, Any]) -> None:
    """
    :param buffer: A replay buffer
    :param rest: What :func:`rest_of` said of another
    """
    if "next_observation" in rest:
        buffer.observations[rest["pos"]] = rest["next_observation"]
    vars(buffer).update({name: value for name, value in rest.items() if name != "next_observation"})


def _columns(buffer: ReplayBuffer) -> Iterator[tuple[str, np.ndarray]]:
    """By name, those of dictionaries with their key: ``(positions, n_envs, ...)``."""
    left_out = CHANGED_LATER if getattr(buffer, "copy_info_dict", True) else (*CHANGED_LATER, "infos")
    for name, column in arrays_of(buffer):
        if "/" in name or (column.shape[:2] == (buffer.buffer_size, buffer.n_envs) and name not in left_out):
            yield name, column


def _indices(buffer: ReplayBuffer, first: int, end: int, stored: int) -> np.ndarray:
    return (buffer.pos - (stored - np.arange(first, end))) % buffer.buffer_size


def _rows(buffer: ReplayBuffer, indices: np.ndarray) -> dict[str, np.ndarray]:
    return {name: _encoded(column[indices]) for name, column in _columns(buffer)}


def _encoded(values: np.ndarray) -> np.ndarray:
    # Dictionaries of hindsight replay with copy_info_dict
    return np.frombuffer(to_bytes(values.tolist()), dtype=np.uint8) if values.dtype.hasobject else values


def _decoded(values: np.ndarray) -> np.ndarray:
    if values.dtype != np.uint8 or values.ndim != 1:
        return values
    return np.array(from_bytes(values.tobytes()), dtype=object)
