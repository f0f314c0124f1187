"""Recorded transitions that discovery reads in batches of rows, and those of tables."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from sb3_causalgdp.causal.variables import TransitionVariables
from sb3_causalgdp.saving.archives import one_line
from sb3_causalgdp.sources.chunks import Source
from sb3_causalgdp.sources.chunks import TableSource as ChunksOfTable
from sb3_causalgdp.sources.tables import Table

BATCH_ROWS = 4096


class SourceError(ValueError):
    """The source is missing, or does not hold transitions that discovery can use."""


class TransitionSource(ABC):
    """
    Recorded transitions that can be read in batches, as often as one likes.

    :param name: What to call the source
    :param variables: Names and order of the variables
    :param n_stored: Number of transitions that it holds
    :param max_rows: Read at most this many, spread evenly over all; None reads all
    """

    def __init__(self, name: str, variables: TransitionVariables, n_stored: int, max_rows: int | None = None) -> None:
        if max_rows is not None and max_rows < 1:
            raise ValueError(f"max_rows must be None or at least 1, got {max_rows!r}")
        self.name = name
        self.variables = variables
        self.n_stored = n_stored
        self.n_rows = n_stored if max_rows is None else min(n_stored, max_rows)

    def batches(self, batch_rows: int = BATCH_ROWS) -> Iterator[np.ndarray]:
        """
        :param batch_rows: Number of rows of a batch; the last one may be shorter
        :return: rows ``[s, a, s', r]`` in the order they were recorded, float64, shape (batch_rows, 2 n + d + 1)
        """
        waiting: list[np.ndarray] = []
        n_waiting = 0
        for part in self._chosen_rows():
            waiting.append(part)
            n_waiting += len(part)
            if n_waiting >= batch_rows:
                rows = np.concatenate(waiting)
                n_whole = n_waiting - n_waiting % batch_rows
                yield from (rows[first : first + batch_rows] for first in range(0, n_whole, batch_rows))
                waiting, n_waiting = [rows[n_whole:]], n_waiting - n_whole
        if n_waiting > 0:
            yield np.concatenate(waiting)

    def _chosen_rows(self) -> Iterator[np.ndarray]:
        if self.n_rows == self.n_stored:
            yield from self._read_parts()
            return
        chosen = np.linspace(0, self.n_stored - 1, self.n_rows).astype(np.int64)
        first = 0
        for part in self._read_parts():
            lower, upper = np.searchsorted(chosen, [first, first + len(part)])
            yield part[chosen[lower:upper] - first]
            first += len(part)

    def _read_parts(self) -> Iterator[np.ndarray]:
        n_read = 0
        try:
            for part in self._parts():
                n_read += len(part)
                yield part
        except SourceError:
            raise
        except Exception as error:  # of the file's library, or of parts that do not fit together
            text = one_line(error)
            if not text.startswith(self.name):
                text = f"{self.name} is incomplete or damaged behind transition {n_read}: {text}"
            raise SourceError(text) from error
        if n_read != self.n_stored:
            raise SourceError(f"{self.name} is incomplete: it announces {self.n_stored} transitions and holds {n_read}")

    @abstractmethod
    def _parts(self) -> Iterator[np.ndarray]:
        """All rows in their order, in parts of any length."""


class ChunkedRows(TransitionSource):
    """
    The rows of a source of chunks.

    :param source: The source
    :param variables: Names and order of the variables
    :param flat: Makes rows of numbers, shape (N, n), of N observations as the source has them
    :param max_rows: Read at most this many transitions, spread evenly over all; None reads all
    """

    def __init__(
        self,
        source: Source,
        variables: TransitionVariables,
        flat: Callable[[Any], np.ndarray],
        max_rows: int | None = None,
    ) -> None:
        self.source = source
        self.flat = flat
        super().__init__(source.name, variables, source.n_transitions, max_rows)

    def _parts(self) -> Iterator[np.ndarray]:
        for chunk in self.source.as_recorded():
            states, next_states = self.flat(chunk.observations), self.flat(chunk.next_observations)
            yield self.variables.stack(states, as_rows(chunk.actions), next_states, chunk.rewards)


class TableSource(ChunkedRows):
    """
    The transitions of a table.

    :param table: The table
    :param max_rows: Read at most this many transitions, spread evenly over all; None reads all
    """

    def __init__(self, table: Table, max_rows: int | None = None) -> None:
        self.table = table
        variables = TransitionVariables(table.state_names, table.action_names)
        super().__init__(ChunksOfTable(table, np.float64), variables, as_rows, max_rows)


def as_rows(values: np.ndarray) -> np.ndarray:
    """
    :param values: Shape (N, ...)
    :return: the same numbers, shape (N, n)
    """
    return values.reshape(len(values), math.prod(values.shape[1:]))
