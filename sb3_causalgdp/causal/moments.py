from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

LARGEST_VALUE = 1e140  # so that the sum of squares stays inside float64
CONSTANT_FLOOR = 1e-10  # a million times float64's rounding, yet below a sensor at 1e6 with sd 1e-3
FIRST_BLOCK_ROWS = 8  # so that a jackknife has blocks to leave out from the first graph on
FORGOTTEN = 1e-9  # weight of a block, relative to that of the newest batch, that says nothing any more


@dataclass(frozen=True, eq=False)
class Moments:
    """Weighted count, mean of shape (p,), and co-moment (sum of the products of deviations) of shape (p, p)."""

    count: float
    mean: np.ndarray
    comoment: np.ndarray

    def covariance(self) -> np.ndarray:
        """
        :return: population covariance (divided by the count), shape (p, p)
        """
        return self.comoment / self.count


def with_rows(before: Moments | None, rows: np.ndarray) -> Moments:
    """
    :param before: Moments of other rows, or None; its co-moment becomes that of the result
    :param rows: At least one row of float64, shape (N, p); never changed
    :return: moments of all these rows, by the formula of ``merge``
    """
    # The last row is for the distance between the means, so that one product gives all
    deviations = np.zeros((len(rows) + 1, rows.shape[1]))
    # Subtract the first row before averaging: a constant column then has exactly no variance
    np.subtract(rows, rows[0], out=deviations[:-1])
    mean = deviations[:-1].mean(axis=0)
    deviations[:-1] -= mean
    mean += rows[0]
    count = float(len(rows))
    if before is None:
        return Moments(count, mean, deviations.T @ deviations)
    total, shift = before.count + count, mean - before.mean
    deviations[-1] = np.sqrt(before.count * count / total) * shift
    comoment = before.comoment
    comoment += deviations.T @ deviations
    return Moments(total, before.mean + shift * (count / total), comoment)


def merge(parts: Sequence[Moments]) -> Moments:
    """
    :param parts: Moments of disjoint sets of rows, at least one; never changed
    :return: moments of all their rows, by the parallel formula of Chan, Golub and LeVeque (1983) for any number of parts
    """
    counts = np.array([part.count for part in parts])
    shifts = np.stack([part.mean for part in parts]) - parts[0].mean
    shift = counts @ shifts / counts.sum()
    between = np.sqrt(counts)[:, None] * (shifts - shift)
    comoment = between.T @ between
    for part in parts:
        comoment += part.comoment
    return Moments(float(counts.sum()), parts[0].mean + shift, comoment)


class StreamingMoments:
    """
    Weighted count, mean and co-moment of a stream of rows, in float64, kept as a ring of blocks of consecutive rows.

    Batches are merged by the parallel formula of Chan, Golub and LeVeque (1983), "Algorithms for computing the sample
    variance", so memory and the cost of reading the covariance do not depend on the number of rows seen.

    When all blocks are full, neighbours are merged and blocks become twice as long. With a half-life they stop growing when
    that would leave nearly all weight in the newest one; then the two oldest are merged. With a window, the oldest block
    goes when a new one begins (the paper's temporal window).

    :param n_variables: Number of columns p
    :param half_life: Number of new rows after which an old row weighs half; None weighs all rows alike.
        Rows of one batch are weighted alike, so a batch should be short in comparison.
    :param names: The p names used in error messages; ``variable[i]`` by default
    :param window: Number of newest rows that are kept, at least ``n_blocks``, to one block; None keeps all
    :param n_blocks: Number of blocks, 1 or an even number: what a jackknife leaves out one by one, and the grain of the
        window; by default 8 with a window, else 1. Memory is ``8 n_blocks p^2`` bytes
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
        if window is not None and not (isinstance(window, int | float | np.number) and 1 < n_blocks <= window < np.inf):
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
        self._newest_rows = 0  # of the last block; all others are full
        self._block_rows: float
        if self.window is not None:
            self._block_rows = -(-self.window // self.n_blocks)
        else:
            self._block_rows = np.inf if self.n_blocks == 1 else FIRST_BLOCK_ROWS

    def update(self, rows: npt.ArrayLike) -> None:
        """
        Merge a batch of rows; nothing changes when it raises.

        :param rows: shape (N, p), N may be 0; never changed
        :raises ValueError: on a wrong shape, or on NaN, infinite or absurdly large (1e140) values, naming the variables
        """
        rows = self.checked(rows)
        if len(rows) == 0:
            return
        if self.half_life is not None:
            self._decay(len(rows))
        self.n_samples += len(rows)
        while len(rows) > 0:
            if not self._blocks or self._newest_rows >= self._block_rows:
                self._make_room()
                self._newest_rows = 0
            taken = int(min(len(rows), self._block_rows - self._newest_rows))
            before = self._blocks.pop() if self._newest_rows > 0 else None
            self._blocks.append(with_rows(before, rows[:taken]))
            self._newest_rows += taken
            rows = rows[taken:]

    def checked(self, rows: npt.ArrayLike) -> np.ndarray:
        """
        :param rows: What ``update`` would take
        :return: the rows in float64, shape (N, p); no copy where they are already
        :raises ValueError: where ``update`` would raise
        """
        rows = np.asarray(rows, dtype=np.float64)
        if rows.ndim != 2 or rows.shape[1] != self.n_variables:
            raise ValueError(f"rows must have shape (N, {self.n_variables}), got {rows.shape}")
        self._check_finite(rows)
        return rows

    def _decay(self, n_new_rows: int) -> None:
        """Weigh old rows less; a block goes when its weight is nothing beside that of the new rows."""
        assert self.half_life is not None
        factor = 0.5 ** (n_new_rows / self.half_life)
        self._blocks = [Moments(factor * block.count, block.mean, factor * block.comoment) for block in self._blocks]
        while self._blocks and self._blocks[0].count < FORGOTTEN * n_new_rows:
            del self._blocks[0]

    def _make_room(self) -> None:
        """Free a block where all are taken."""
        if len(self._blocks) < self.n_blocks:
            return
        if self.window is not None:
            del self._blocks[0]
        elif self.half_life is not None and self._block_rows * self.n_blocks > 2.0 * self.half_life:
            self._blocks[:2] = [merge(self._blocks[:2])]
        else:
            for i in range(self.n_blocks // 2):
                self._blocks[i : i + 2] = [merge(self._blocks[i : i + 2])]
            self._block_rows *= 2

    def _check_finite(self, rows: np.ndarray) -> None:
        bad = ~(np.abs(rows) < LARGEST_VALUE)
        if bad.any():
            variables = [self.names[i] for i in np.flatnonzero(bad.any(axis=0))]
            row = int(np.flatnonzero(bad.any(axis=1))[0])
            raise ValueError(f"rows must be finite (below {LARGEST_VALUE:g}): first bad row {row}, bad variables {variables}")

    def total(self) -> Moments:
        """
        :return: moments of all rows that are not forgotten
        :raises ValueError: when no row has been seen
        """
        if not self._blocks:
            raise ValueError("no rows have been seen yet: call update(rows) first")
        return merge(self._blocks)

    @property
    def n_filled(self) -> int:
        """Number of blocks that hold rows, at most ``n_blocks``."""
        return len(self._blocks)

    def without_block(self, index: int) -> tuple[Moments, float]:
        """
        :param index: Of a block, below ``n_filled``, which must be at least 2
        :return: moments of the rows of all other blocks, and the share of the weight that this block has
        """
        # Not by subtraction: where a block has nearly all of a variable's variance, that would leave rounding errors
        others = self._blocks[:index] + self._blocks[index + 1 :]
        return merge(others), self._blocks[index].count / self.count

    def leave_one_out(self) -> list[tuple[Moments, float]]:
        """
        For a block jackknife.

        :return: ``without_block`` of each block; empty while there are fewer than two
        """
        return [self.without_block(i) for i in range(self.n_filled)] if self.n_filled > 1 else []

    @property
    def count(self) -> float:
        """Sum of the rows' weights."""
        return float(sum(block.count for block in self._blocks))

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
        :raises ValueError: when no row has been seen
        """
        total = self.total()
        return np.sqrt(np.diagonal(total.comoment) / total.count)

    @property
    def constant(self) -> np.ndarray:
        """Which columns do not move: standard deviation at most 1e-10 max(1, \\|mean\\|), boolean, shape (p,)."""
        total = self.total()
        deviation = np.sqrt(np.diagonal(total.comoment) / total.count)
        return deviation <= CONSTANT_FLOOR * np.maximum(1.0, np.abs(total.mean))

    def correlation(self) -> np.ndarray:
        """
        :return: correlation matrix, shape (p, p); rows and columns of constant variables are zero, diagonal included
        """
        moving = ~self.constant
        inverse = moving / np.where(moving, self.standard_deviation(), 1.0)
        return self.covariance() * np.outer(inverse, inverse)
