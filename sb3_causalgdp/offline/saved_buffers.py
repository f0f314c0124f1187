"""Replay buffers of SB3 in files: arrays that need no pickle, and what SB3 pickles."""

import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_causalgdp.checks import many_are_finite
from sb3_causalgdp.offline.replay import arrays_of
from sb3_causalgdp.saving.archives import errors_of, named, write_arrays
from sb3_causalgdp.saving.plain import FORMAT, SPACES, Known, NotPlainError, Writer
from sb3_causalgdp.sources.buffers import (
    ADDED,
    BLOCK,
    CONTENT,
    MOST_ROWS,
    OFFLINE,
    attributes_of,
    check_count,
    content_of,
    n_stored_rows,
    no_buffer_error,
    split_arrays,
)

BUFFERS = (ReplayBuffer, DictReplayBuffer, NStepReplayBuffer, HerReplayBuffer)
KNOWN = Known([*SPACES, GoalSelectionStrategy], BUFFERS)
NOT_WRITTEN = ("env", "device", "offline_part", "infos")
MOST_GOALS = 1_000


# Writing ----------------------------------------------------------------------------------------------------------------


def can_be_arrays(buffer: ReplayBuffer) -> bool:
    """
    :param buffer: A replay buffer
    :return: Whether it needs no pickle: a class of SB3, without the infos of the steps
    """
    return type(buffer) in BUFFERS and not getattr(buffer, "copy_info_dict", False)


def write_buffer(buffer: ReplayBuffer, file: Any) -> None:
    """
    Write the rows that are stored, without a pickle, and those of its ``offline_part``.

    :param buffer: A replay buffer
    :param file: Path or file-like object
    :raises ValueError: If it needs a pickle
    """
    offline, marks = getattr(buffer, "offline_part", (None, []))
    arrays = _arrays_of(buffer, {"marks": list(marks), "is_offline": offline is buffer})
    if offline is not None and offline is not buffer:
        arrays |= {f"{OFFLINE}{name}": values for name, values in _arrays_of(offline, {}).items()}
    write_arrays(file, arrays)


def _arrays_of(buffer: ReplayBuffer, more: Mapping[str, Any]) -> dict[str, Any]:
    if not can_be_arrays(buffer):
        raise ValueError(f"{type(buffer).__name__} with what it holds needs a pickle: give the file the suffix .pkl")
    n_rows = n_stored_rows(buffer)
    columns = dict(_columns(buffer))
    of_columns = {name.partition("/")[0] for name in columns}
    writer = Writer(KNOWN)
    rest = {"class": type(buffer), **more}
    rest |= {name: value for name, value in vars(buffer).items() if name not in of_columns and name not in NOT_WRITTEN}
    try:
        content = {name: writer.encode(value) for name, value in rest.items()}
    except NotPlainError as error:
        raise ValueError(f"the replay buffer needs a pickle: give the file the suffix .pkl ({error})") from error
    text = json.dumps({"format": FORMAT, "attributes": content})
    return {
        CONTENT: np.frombuffer(text.encode(), np.uint8),
        BLOCK: np.frombuffer(b"".join(writer.blocks), np.uint8),
        **{name: column[:n_rows] for name, column in columns.items()},
    }


def _columns(buffer: ReplayBuffer) -> Iterator[tuple[str, np.ndarray]]:
    """By name, those of dictionaries with their key: ``(positions, n_envs, ...)``."""
    for name, column in arrays_of(buffer):
        if "/" in name or (column.ndim >= 2 and name not in NOT_WRITTEN):
            yield name, column


# Reading ----------------------------------------------------------------------------------------------------------------


def read_buffer(path: Any, trusted: bool = False) -> ReplayBuffer:
    """
    Read what :func:`write_buffer` or SB3 wrote; that which was saved with it is in ``offline_part``, as in pickles of ours.

    :param path: Path or file-like object
    :param trusted: Whether a pickle may hold more than what SB3's own are made of, which could run code
    :return: The buffer, for no environment yet
    :raises ValueError: If it cannot be read
    """
    with errors_of(path, "cannot be read as a replay buffer"):
        arrays, buffer = content_of(path, trusted)
        if arrays is not None:
            return _from_arrays(arrays, named(path))
        if not isinstance(buffer, ReplayBuffer):
            raise no_buffer_error(buffer, path)
        if not trusted:
            for one in (buffer, getattr(buffer, "offline_part", (None,))[0]):
                if one is not None:
                    check_columns(one, named(path))
        return buffer


def _from_arrays(arrays: dict[str, np.ndarray], name_of_buffer: str) -> ReplayBuffer:
    own, parts = split_arrays(arrays)
    buffer, content = _one_buffer(own, name_of_buffer)
    offline = buffer if content.get("is_offline") is True else _one_buffer(parts, name_of_buffer)[0] if parts else None
    marks = content.get("marks")
    if not isinstance(marks, list) or not all(isinstance(mark, str) for mark in marks):
        raise ValueError(f"marks must be names, got {str(marks)[:80]}")
    buffer.offline_part = (offline, marks)  # type: ignore[attr-defined]
    return buffer


def _one_buffer(arrays: dict[str, np.ndarray], name_of_buffer: str) -> tuple[ReplayBuffer, dict[str, Any]]:
    content = attributes_of(arrays, KNOWN)
    buffer = _empty(content)
    names = [name for name in (*vars(buffer), *ADDED) if name in content]
    vars(buffer).update({name: content[name] for name in names})
    _fill(buffer, arrays)
    check_columns(buffer, name_of_buffer)
    return buffer, content


def _empty(content: Mapping[str, Any]) -> ReplayBuffer:
    cls, n_envs, size = content.get("class"), content.get("n_envs"), content.get("buffer_size")
    if cls not in BUFFERS:
        raise ValueError(f"it is no replay buffer of SB3, but {cls!r}")
    for name, value in {"n_envs": n_envs, "buffer_size": size}.items():
        check_count(value, name, 1, MOST_ROWS)
    assert isinstance(n_envs, int) and isinstance(size, int)
    saves_memory = content.get("optimize_memory_usage") is True
    common: dict[str, Any] = {
        "observation_space": content["observation_space"],
        "action_space": content["action_space"],
        "device": "cpu",
        "n_envs": n_envs,
        "optimize_memory_usage": saves_memory,
        "handle_timeout_termination": content.get("handle_timeout_termination") is True,
    }
    return _empty_her(size, common) if cls is HerReplayBuffer else cls(size * n_envs, **common)  # type: ignore[misc]


def _empty_her(size: int, common: Mapping[str, Any]) -> HerReplayBuffer:
    """Without the dictionaries of each step, which take seconds to make and are not used."""
    n_envs = common["n_envs"]
    buffer = HerReplayBuffer.__new__(HerReplayBuffer)
    DictReplayBuffer.__init__(buffer, size * n_envs, **common)
    small = HerReplayBuffer(n_envs, **{**common, "env": None})
    vars(buffer).update({name: value for name, value in vars(small).items() if name not in vars(buffer)})
    buffer.ep_start, buffer.ep_length = (np.zeros((size, n_envs), np.int64) for _ in range(2))
    buffer.infos = np.empty((size, n_envs), dtype=object)
    return buffer


def _fill(buffer: ReplayBuffer, arrays: dict[str, np.ndarray]) -> None:
    n_rows = n_stored_rows(buffer)
    columns = dict(_columns(buffer))
    if columns.keys() != arrays.keys():
        raise ValueError(f"it must hold the arrays {sorted(columns)}, got {sorted(arrays)}")
    for name, column in columns.items():
        values = arrays[name]
        if values.shape != (n_rows, *column.shape[1:]) or values.dtype != column.dtype:
            wanted = f"{(n_rows, *column.shape[1:])} and {column.dtype}"
            raise ValueError(f"{name} must be of shape {wanted}, got {values.shape} and {values.dtype}")
        if n_rows < len(column):
            column[:n_rows] = values
            continue
        attribute, _, key = name.partition("/")
        if key:
            getattr(buffer, attribute)[key] = values
        else:
            setattr(buffer, attribute, values)


def check_columns(buffer: ReplayBuffer, name_of_buffer: str) -> None:
    """
    :param buffer: A replay buffer of one of SB3's classes
    :param name_of_buffer: What to call it
    :raises ValueError: If its attributes do not fit each other and its spaces, or a stored row is NaN or infinite
    """
    lacks = {"observation_space", "action_space", "n_envs", "buffer_size", "pos", "full"} - vars(buffer).keys()
    if lacks:
        raise ValueError(f"it lacks {sorted(lacks)}")
    small = _small(buffer)
    lacks = vars(small).keys() - vars(buffer).keys() - {"env"}
    if lacks:
        raise ValueError(f"it lacks {sorted(lacks)}")
    for name, value in vars(small).items():
        given = vars(buffer).get(name)
        if name not in NOT_WRITTEN and type(given) is not type(value) and not {type(given), type(value)} <= {int, float}:
            raise ValueError(f"{name} must be of {type(value).__name__}, got {type(given).__name__}")
    columns = dict(_columns(buffer))
    for name, column in _columns(small):
        wanted = (buffer.buffer_size, *column.shape[1:])
        there = columns.get(name)
        if there is None or there.shape != wanted or there.dtype != column.dtype:
            shape, dtype = (None, None) if there is None else (there.shape, there.dtype)
            raise ValueError(f"its {name} have the shape {shape}, and {wanted} is needed, of {column.dtype}, got {dtype}")
    if not 0 <= buffer.pos < buffer.buffer_size:
        raise ValueError(f"its position is {buffer.pos}, and its size {buffer.buffer_size}")
    _check_finite(columns, n_stored_rows(buffer), name_of_buffer)
    _check_ranges(buffer, columns)


def _check_ranges(buffer: Any, columns: Mapping[str, np.ndarray]) -> None:
    """What rows and numbers of rows are computed from."""
    size, n_rows = buffer.buffer_size, n_stored_rows(buffer)
    for name, most in {"dones": 1, "timeouts": 1, "ep_start": size - 1, "ep_length": size}.items():
        rows = columns[name][:n_rows] if name in columns else np.zeros(0)
        if rows.size > 0 and not 0 <= rows.min() <= rows.max() <= most:
            raise ValueError(f"its {name} must be from 0 to {most}, got {rows.min()} to {rows.max()}")
    for name, most in {"n_sampled_goal": MOST_GOALS, "her_ratio": 1, "n_steps": size, "gamma": 1}.items():
        value = getattr(buffer, name, 0)
        if not 0 <= value <= most:
            raise ValueError(f"its {name} must be from 0 to {most}, got {value}")
    starts = getattr(buffer, "_current_ep_start", np.zeros(1, np.int64))
    if not 0 <= starts.min() <= starts.max() < size:
        raise ValueError(f"its episodes must begin at a position from 0 to {size - 1}, got {starts.tolist()}")


def _small(buffer: ReplayBuffer) -> ReplayBuffer:
    """One row of the same kind."""
    kwargs: dict[str, Any] = {"env": None} if isinstance(buffer, HerReplayBuffer) else {}
    if type(buffer) not in BUFFERS or type(buffer.n_envs) is not int or not 1 <= buffer.n_envs <= MOST_ROWS:
        raise ValueError(f"it is of {type(buffer).__name__} for {buffer.n_envs} environments")
    return type(buffer)(
        buffer.n_envs,
        buffer.observation_space,
        buffer.action_space,
        device="cpu",
        n_envs=buffer.n_envs,
        optimize_memory_usage=getattr(buffer, "optimize_memory_usage", False),
        handle_timeout_termination=getattr(buffer, "handle_timeout_termination", False),
        **kwargs,
    )


def _check_finite(columns: Mapping[str, np.ndarray], n_rows: int, name_of_buffer: str) -> None:
    for name, column in columns.items():
        stored = column[:n_rows]
        if not many_are_finite(stored):
            position, column_of, *where = np.argwhere(~np.isfinite(stored))[0].tolist()
            place = f"{name}{where or ''} at position {position} of environment {column_of}"
            raise ValueError(f"{name_of_buffer} has a NaN or infinite value in {place}")
