from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

LARGEST_VALUE = 1e140  # so that the sum of squares stays inside float64
CONSTANT_FLOOR = 1e-10  # a million times float64's rounding, yet below a sensor at 1e6 with sd 1e-3
FIRST_BLOCK_ROWS = 256


class Moments(NamedTuple):
    """Weighted count, mean of shape (p,), and co-moment (sum of the products of deviations) of shape (p, p)."""

    count: float
    mean: np.ndarray
    comoment: np.ndarray

    def covariance(self) -> np.ndarray:
        """
        :return: population covariance (divided by the count), shape (p, p)
        """
        return self.comoment / self.count

    def scaled(self, weight: float) -> "Moments":
        """
        :param weight: Factor of every row's weight
        """
        return self if weight == 1.0 else Moments(weight * self.count, self.mean, weight * self.comoment)

    def merged(self, other: "Moments") -> "Moments":
        """
        Of both sets of rows, by the parallel formula of Chan, Golub and LeVeque (1983).

        :param other: Moments of other rows
        """
        if self.count == 0.0:
            return other
        total = self.count + other.count
        delta = other.mean - self.mean
        comoment = self.comoment + other.comoment
        comoment += np.outer(delta, delta * (self.count * other.count / total))
        return Moments(total, self.mean + delta * (other.count / total), comoment)

    def without(self, part: "Moments") -> "Moments":
        """
        Of the rows that are left when a part of them is taken out: the inverse of ``merged``.

        :param part: Moments of some of the rows, not of all
        """
        rest = self.count - part.count
        delta = (self.mean - part.mean) * (self.count / rest)
        comoment = self.comoment - part.comoment
        comoment -= np.outer(delta, delta * (rest * part.count / self.count))
        return Moments(rest, self.mean + (self.mean - part.mean) * (part.count / rest), comoment)


def moments_of(rows: np.ndarray) -> Moments:
    """
    :param rows: At least one row of float64, shape (N, p); never changed
    :return: their moments
    """
    # Subtract the first row before averaging: a constant column then has exactly no variance
    shifted = rows - rows[0]
    mean = shifted.mean(axis=0)
    shifted -= mean
    return Moments(float(len(rows)), rows[0] + mean, shifted.T @ shifted)


class StreamingMoments:
    """
    Weighted count, mean and co-moment of a stream of rows, in float64, kept as a ring of blocks of consecutive rows.

    Batches are merged by the parallel formula of Chan, Golub and LeVeque (1983), "Algorithms for computing the sample
    variance", so memory and the cost of reading the covariance do not depend on the number of rows seen.

    Without a window nothing is dropped: when all blocks are full, neighbours are merged and blocks become twice as long. With a
    window, the oldest block goes when a new one begins (the paper's temporal window).

    :param n_variables: Number of columns p
    :param half_life: Number of new rows after which an old row weighs half; None weighs all rows alike.
        Rows of one batch are weighted alike, so a batch should be short in comparison.
    :param names: The p names used in error messages; ``variable[i]`` by default
    :param window: Number of newest rows that are kept, at least ``n_blocks``, to one block; None keeps all
    :param n_blocks: Number of blocks, 1 or an even number: what a jackknife leaves out one by one, and the grain of the window.
        Memory is ``8 n_blocks p^2`` bytes
    """

    def __init__(
        self,
        n_variables: int,
        half_life: float | None = None,
        names: Sequence[str] | None = None,
        window: int | None = None,
        n_blocks: int | None = None,
    ) -> None:
        if isinstance(n_variables, bool) or not isinstance(n_variables, int | np.integer):
            raise TypeError(f"n_variables must be an integer, got {n_variables!r}")
        if n_variables < 1:
            raise ValueError(f"n_variables must be at least 1, got {n_variables}")
        if half_life is not None and not (isinstance(half_life, int | float | np.number) and 0 < half_life < np.inf):
            raise ValueError(f"half_life must be None or a positive number of rows, got {half_life!r}")
        if names is not None and len(names) != n_variables:
            raise ValueError(f"names must hold {n_variables} names, got {len(names)}")
        n_blocks = (1 if window is None else 8) if n_blocks is None else n_blocks
        if n_blocks != 1 and (n_blocks < 2 or n_blocks % 2):
            raise ValueError(f"n_blocks must be 1 or an even number, got {n_blocks!r}")
        if window is not None and (n_blocks == 1 or not n_blocks <= window < np.inf):
            raise ValueError(f"window must be None or at least {max(n_blocks, 2)} rows in at least 2 blocks, got {window!r}")
        self.n_variables = int(n_variables)
        self.half_life = half_life
        self.names = tuple(names) if names is not None else tuple(f"variable[{i}]" for i in range(n_variables))
        self.window = window
        self.n_blocks = n_blocks
        self.clear()

    def clear(self) -> None:
        """Forget all rows."""
        self.n_samples = 0
        self._blocks: list[Moments] = []
        self._rows_in_block: list[int] = []
        if self.window is not None:
            self._block_rows: float = -(-self.window // self.n_blocks)
        else:
            self._block_rows = np.inf if self.n_blocks == 1 else FIRST_BLOCK_ROWS
        self._total: Moments | None = None

    def update(self, rows: npt.ArrayLike) -> None:
        """
        Merge a batch of rows; nothing changes when it raises.

        :param rows: shape (N, p), N may be 0; never changed
        :raises ValueError: on a wrong shape, or on NaN, infinite or absurdly large (1e140) values, naming the variables
        """
        rows = np.asarray(rows, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != self.n_variables:
            raise ValueError(f"rows must have shape (N, {self.n_variables}), got {rows.shape}")
        self._check_finite(rows)
        if len(rows) == 0:
            return
        if self.half_life is not None:
            decay = 0.5 ** (len(rows) / self.half_life)
            self._blocks = [block.scaled(decay) for block in self._blocks]
        self.n_samples += len(rows)
        self._total = None
        while len(rows) > 0:
            if not self._blocks or self._rows_in_block[-1] >= self._block_rows:
                self._open_block()
            taken = int(min(len(rows), self._block_rows - self._rows_in_block[-1]))
            self._blocks[-1] = self._blocks[-1].merged(moments_of(rows[:taken]))
            self._rows_in_block[-1] += taken
            rows = rows[taken:]

    def _open_block(self) -> None:
        if len(self._blocks) == self.n_blocks:
            if self.window is None:
                self._blocks = [a.merged(b) for a, b in zip(self._blocks[::2], self._blocks[1::2], strict=True)]
                self._block_rows *= 2
                self._rows_in_block = [int(self._block_rows)] * len(self._blocks)
            else:
                del self._blocks[0], self._rows_in_block[0]
        self._blocks.append(Moments(0.0, np.zeros(self.n_variables), np.zeros((self.n_variables, self.n_variables))))
        self._rows_in_block.append(0)

    def _check_finite(self, rows: np.ndarray) -> None:
        bad = ~(np.abs(rows) < LARGEST_VALUE)
        if bad.any():
            variables = [self.names[i] for i in np.flatnonzero(bad.any(axis=0))]
            row = int(np.flatnonzero(bad.any(axis=1))[0])
            raise ValueError(f"rows must be finite (below {LARGEST_VALUE:g}): first bad row {row}, bad variables {variables}")

    def __getstate__(self) -> dict:
        return {**self.__dict__, "_total": None}

    def total(self) -> Moments:
        """
        :return: moments of all rows that are not forgotten
        :raises ValueError: when no row has been seen
        """
        if not self._blocks:
            raise ValueError("no rows have been seen yet: call update(rows) first")
        if self._total is None:
            self._total = self._blocks[0]
            for block in self._blocks[1:]:
                self._total = self._total.merged(block)
        return self._total

    def leave_one_out(self) -> list[tuple[Moments, float]]:
        """
        For a block jackknife.

        :return: for each block, the moments of all other rows, and the share of the weight that the block has; empty while
            there are fewer than two blocks
        """
        total = self.total()
        if len(self._blocks) < 2:
            return []
        return [(total.without(block), block.count / total.count) for block in self._blocks]

    @property
    def count(self) -> float:
        """Sum of the rows' weights."""
        return self.total().count if self._blocks else 0.0

    @property
    def mean(self) -> np.ndarray:
        """Shape (p,)."""
        return self.total().mean

    def covariance(self) -> np.ndarray:
        """
        :return: population covariance (divided by the count), shape (p, p)
        :raises ValueError: when no row has been seen
        """
        return self.total().covariance()

    def standard_deviation(self) -> np.ndarray:
        """
        :return: population standard deviation, shape (p,)
        """
        total = self.total()
        return np.sqrt(np.diagonal(total.comoment) / total.count)

    @property
    def constant(self) -> np.ndarray:
        """Which columns do not move: standard deviation at most 1e-10 max(1, \\|mean\\|), boolean, shape (p,)."""
        return self.standard_deviation() <= CONSTANT_FLOOR * np.maximum(1.0, np.abs(self.mean))

    def correlation(self) -> np.ndarray:
        """
        :return: correlation matrix, shape (p, p); rows and columns of constant variables are zero, diagonal included
        """
        moving = ~self.constant
        inverse = moving / np.where(moving, self.standard_deviation(), 1.0)
        return self.covariance() * np.outer(inverse, inverse)
