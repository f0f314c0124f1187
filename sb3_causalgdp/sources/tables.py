"""A table of rows in the order of time, of which one is told what its columns are, as transitions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np

from sb3_causalgdp.sources.columns import columns_of

MOST_CATEGORIES = 50
SHOWN = 5  # rows and names in messages
FEW_LEVELS = 10  # so many numbers and words may be the names of modes
MISTAKES = 0.1  # with a smaller share of words among its numbers, a column is no text
GAP = 1.5  # times the median step between two rows: there, recording paused
MISSING = ("raise", "drop")


class Table:
    """
    Transitions from a table: row t holds the state, the action that was taken there and the reward that it brought; the next
    state is the state ``lag`` rows later in the same episode.

    Text and categories become a column of 0 and 1 for each value but the most frequent one. ``remarks`` says so, and what
    else was done.

    :param source: A data frame of pandas or polars, an Arrow table, a mapping of arrays, an array of shape (N, m), or the path
        of a file (``.csv``, ``.tsv``, ``.parquet``, ``.npy``, ``.npz``)
    :param states: Names of the columns of the state
    :param actions: Names of the columns of the action
    :param reward: Name of the column of the reward
    :param episode: Name of the column that tells episodes apart, each in consecutive rows; None takes all rows for one
    :param time: Name of a column that grows within an episode; where it jumps by more than one and a half median steps, no
        transition is made. None trusts the order of the rows
    :param next_states: Names of the columns of the next state, in the order of ``states``, where the table has them
    :param lag: Number of rows from a state to the next one, at least 1
    :param missing: ``"raise"``, or ``"drop"`` to leave out transitions with a missing value
    :param name: What to call the table; None calls a file by its path
    :raises ValueError: when a column is not there or no number, a value is missing, or rows are out of order
    """

    def __init__(
        self,
        source: Any,
        *,
        states: Sequence[str],
        actions: Sequence[str],
        reward: str,
        episode: str | None = None,
        time: str | None = None,
        next_states: Sequence[str] | None = None,
        lag: int = 1,
        missing: str = "raise",
        name: str | None = None,
    ) -> None:
        self.name = name if name is not None else str(source) if isinstance(source, str) else "the table"
        self.remarks: tuple[str, ...] = ()
        _check_options(missing, lag)
        columns = columns_of(source)
        reward = _one_name("reward", reward)
        roles = _checked_roles(self.name, columns, states, actions, reward, next_states)
        for role, chosen in (("episode", episode), ("time", time)):
            if chosen is not None:
                _check_known(self.name, columns, role, [chosen])
        if len(columns[reward]) == 0:
            raise ValueError(f"{self.name} has no rows")
        parts = {role: self._numbers(columns, names) for role, names in roles.items()}
        order = _Order(self.name, columns, episode, time)
        rows, following, is_last = order.transitions(lag, in_row=next_states is not None)
        if len(rows) == 0:
            raise ValueError(f"{self.name} holds no transition: episodes need more than {lag} rows")
        after, place = ("next_states", rows) if next_states is not None else ("states", following)
        if order.n_gaps > 0:
            self._remark(f"no transitions over {order.n_gaps} gaps in {time!r}")
        self.state_names, self.action_names = parts["states"].names, parts["actions"].names
        if next_states is not None and len(parts["next_states"].names) != len(self.state_names):
            raise ValueError("states and next_states must have the same categories")
        arrays = {
            "observations": parts["states"].values[rows],
            "actions": parts["actions"].values[rows],
            "next_observations": parts[after].values[place],
            "rewards": parts["reward"].values[rows, 0],
        }
        whole = np.all([np.isfinite(values).reshape(len(rows), -1).all(axis=1) for values in arrays.values()], axis=0)
        if not whole.all():
            self._check_missing(parts, missing, int((~whole).sum()), len(whole))
        self.observations, self.actions, self.next_observations, self.rewards = (part[whole] for part in arrays.values())
        # What follows a row that was left out does not follow the row before it
        self.is_last = (is_last | ~np.append(whole[1:], True))[whole]
        if len(self.rewards) == 0:
            raise ValueError(f"{self.name} holds no transition without a missing value")

    def __len__(self) -> int:
        return len(self.rewards)

    def _remark(self, text: str) -> None:
        if text not in self.remarks:
            self.remarks = (*self.remarks, text)

    def _numbers(self, columns: Mapping[str, np.ndarray], names: Sequence[str]) -> "_Numbers":
        parts, labels = [], []
        for name in names:
            values, own, remark = _as_numbers(self.name, name, columns[name])
            parts.append(values)
            labels += own
            if remark:
                self._remark(remark)
        return _Numbers(tuple(labels), np.concatenate(parts, axis=1))

    def _check_missing(self, parts: Mapping[str, "_Numbers"], missing: str, n_bad: int, n_all: int) -> None:
        counts = {
            name: int(count)
            for part in parts.values()
            for name, count in zip(part.names, (~np.isfinite(part.values)).sum(axis=0), strict=True)
            if count > 0
        }
        listed = ", ".join(f"{name!r} {count}" for name, count in counts.items())
        if missing == "raise":
            raise ValueError(
                f"{self.name} has missing or infinite values, by column: {listed}; "
                f'missing="drop" (on the command line --drop-missing) leaves out {n_bad} of {n_all} transitions'
            )
        self._remark(f"{n_bad} of {n_all} transitions left out for missing values, by column: {listed}")


@dataclass(frozen=True)
class _Numbers:
    names: tuple[str, ...]
    values: np.ndarray


def _check_options(missing: str, lag: int) -> None:
    if missing not in MISSING:
        raise ValueError(f"missing must be one of {MISSING}, got {missing!r}")
    if isinstance(lag, bool) or not isinstance(lag, int) or lag < 1:
        raise ValueError(f"lag must be an integer of at least 1, got {lag!r}")


def _one_name(role: str, name: Any) -> str:
    names = [name] if isinstance(name, str) else list(name) if isinstance(name, list | tuple) else [str(name)]
    if len(names) != 1:
        raise ValueError(f"{role} must be the name of one column, got {name!r}")
    return names[0]


def _checked_roles(
    table: str,
    columns: Mapping[str, np.ndarray],
    states: Sequence[str],
    actions: Sequence[str],
    reward: str,
    next_states: Sequence[str] | None,
) -> dict[str, list[str]]:
    roles = {"states": states, "actions": actions, "reward": [reward]}
    if next_states is not None:
        roles["next_states"] = next_states
        if len(next_states) != len(states):
            raise ValueError(f"next_states must name a column for each of the {len(states)} states, got {len(next_states)}")
    lists = {role: [names] if isinstance(names, str) else list(names) for role, names in roles.items()}
    for role, names in lists.items():
        if not names:
            raise ValueError(f"{role} is empty: at least one column is needed, {table} has {_some(list(columns))}")
        _check_known(table, columns, role, names)
    given = [name for names in lists.values() for name in names]
    repeated = sorted({name for name in given if given.count(name) > 1})
    if repeated:
        raise ValueError(f"a column must have one role, {repeated} have several")
    return lists


def _check_known(table: str, columns: Mapping[str, np.ndarray], role: str, names: Sequence[str]) -> None:
    for name in names:
        if name not in columns:
            near = get_close_matches(str(name), columns, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"it has {_some(list(columns))}"
            raise ValueError(f"{role}: {table} has no column {name!r}, {hint}")


def _some(names: Sequence[Any]) -> str:
    more = f" and {len(names) - 4 * SHOWN} more" if len(names) > 4 * SHOWN else ""
    return ", ".join(repr(name) for name in names[: 4 * SHOWN]) + more


def _as_numbers(table: str, name: str, values: np.ndarray) -> tuple[np.ndarray, list[str], str]:
    """Shape (N, number of columns), their names, and what is to be said of them."""
    if values.dtype.kind in "fiub":
        return values.astype(np.float64).reshape(-1, 1), [name], ""
    if values.dtype.kind in "mM":
        raise ValueError(f"column {name!r} of {table} holds dates: make numbers of them, or give it as time")
    texts = np.array([None if _is_missing(value) else value for value in values.tolist()], dtype=object)
    present = texts != np.array(None)
    if all(isinstance(value, int | float) for value in texts[present]):
        numbers = np.array([np.nan if value is None else float(value) for value in texts])
        return numbers.reshape(-1, 1), [name], ""
    _check_mostly_text(table, name, texts)
    labels = np.array([str(value) for value in texts])
    levels, counts = np.unique(labels[present], return_counts=True)
    if len(levels) > MOST_CATEGORIES:
        some = ", ".join(map(repr, levels[:SHOWN].tolist()))
        raise ValueError(f"column {name!r} of {table} is text with {len(levels)} values ({some}, ...): numbers are needed")
    reference = str(levels[counts.argmax()])
    others = [str(level) for level in levels if level != reference] or [reference]
    columns = (labels[:, None] == np.array(others)).astype(np.float64)
    columns[~present] = np.nan
    remark = f"{name!r} is categorical: a column of 0 and 1 for {', '.join(map(repr, others))}, against {reference!r}"
    return columns, [f"{name}={level}" for level in others], remark


def _check_mostly_text(table: str, name: str, values: np.ndarray) -> None:
    """A few words among numbers are mistakes, no categories."""
    wrong = [(row, value) for row, value in enumerate(values) if value is not None and not _is_number(value)]
    present = [value for value in values if value is not None]
    n_levels = len({str(value) for value in present})
    if n_levels > FEW_LEVELS and 0 < len(wrong) < MISTAKES * len(present):
        listed = ", ".join(f"{value!r} in row {row}" for row, value in wrong[:SHOWN])
        more = f" and {len(wrong) - SHOWN} more" if len(wrong) > SHOWN else ""
        raise ValueError(
            f"column {name!r} of {table} has {listed}{more} among numbers (the first row is 0): "
            "correct them, or leave them empty"
        )


def _is_number(value: Any) -> bool:
    try:
        float(value)
    except (TypeError, ValueError):
        return False
    return True


def _is_missing(value: Any) -> bool:
    return value is None or str(value) in ("<NA>", "NaT", "nan")


class _Order:
    """Which rows follow each other."""

    def __init__(self, table: str, columns: Mapping[str, np.ndarray], episode: str | None, time: str | None) -> None:
        self.n_gaps = 0
        n_rows = len(next(iter(columns.values())))
        self.starts = np.zeros(n_rows, dtype=bool)
        self.starts[0] = True
        if episode is not None:
            ids = columns[episode]
            self.starts[1:] = ids[1:] != ids[:-1]
            firsts = np.flatnonzero(self.starts)
            seen: set[Any] = set()
            for first in firsts.tolist():
                value = ids[first : first + 1].tolist()[0]
                if value in seen:
                    raise ValueError(
                        f"{table}: episode {value!r} goes on in row {first} after another one: sort the rows by {episode!r} "
                        "and time"
                    )
                seen.add(value)
        if time is not None:
            self._check_time(table, columns[time], time)

    def _check_time(self, table: str, values: np.ndarray, name: str) -> None:
        if values.dtype.kind == "O":
            raise ValueError(f"time: column {name!r} of {table} must hold numbers or dates, got text")
        steps = np.diff(values)
        within = ~self.starts[1:]
        zero = np.zeros(1, dtype=steps.dtype)[0]
        wrong = np.flatnonzero(within & ~(steps > zero))
        if len(wrong) > 0:
            row = int(wrong[0]) + 1
            raise ValueError(
                f"{table}: {name!r} does not grow from row {row - 1} ({values[row - 1]}) to row {row} ({values[row]}), nor in "
                f"{len(wrong) - 1} other places: sort the rows, or name the column of the episodes"
            )
        if within.any():
            numbers = steps.astype(np.float64)
            gaps = within & (numbers > GAP * np.median(numbers[within]))
            self.n_gaps = int(gaps.sum())
            self.starts[1:] |= gaps

    def transitions(self, lag: int, in_row: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """
        :param lag: Number of rows to the next state
        :param in_row: Whether each row holds its next state
        :return: rows of the states, rows of the next states, and whether a transition is the last one of its episode
        """
        number = np.cumsum(self.starts)
        rows = np.arange(len(number))
        if not in_row:
            rows = rows[: max(len(rows) - lag, 0)]
            rows = rows[number[rows] == number[rows + lag]]
        is_last = np.append(number[rows[1:]] != number[rows[:-1]], True)[: len(rows)]
        return rows, rows if in_row else rows + lag, is_last
