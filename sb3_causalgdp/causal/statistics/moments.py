import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import torch as th

LARGEST_VALUE = 1e140  # so that the sum of squares stays inside float64
CONSTANT_SHARE = 1e-10  # of the mean: a million times float64's rounding, yet below a sensor at 1e6 with sd 1e-3
CONSTANT_FLOOR = 1e-12  # what rounding leaves of numbers around 1 that cancel, yet below rewards in units of 1e-9
FIRST_BLOCK_ROWS = 8  # so that a jackknife has blocks to leave out from the first graph on
MANY_ROWS = 128  # from where half of a product costs more time than another matrix of its size
FORGOTTEN = 1e-9  # weight of a block, relative to that of the newest batch, that says nothing any more


@dataclass(frozen=True, eq=False)
class Spread:
    """
    Where the rows of p columns lie.

    :param count: Sum of the rows' weights
    :param mean: shape (p,)
    :param squares: Weighted sums of the squared deviations from the mean, shape (p,)
    """

    count: float
    mean: np.ndarray
    squares: np.ndarray

    def standard_deviation(self) -> np.ndarray:
        """
        :return: population standard deviation, shape (p,)
        """
        return np.sqrt(self.squares / self.count)

    @property
    def constant(self) -> np.ndarray:
        """Which columns do not move: standard deviation at most 1e-10 \\|mean\\| or 1e-12, boolean, shape (p,)."""
        return self.standard_deviation() <= np.maximum(CONSTANT_FLOOR, CONSTANT_SHARE * np.abs(self.mean))


@dataclass(frozen=True, eq=False)
class Moments(Spread):
    """
    The spread, and the sums of products of deviations. The last m columns may be targets, whose products with each other are
    not kept.

    :param comoment: Of the columns that are no targets, shape (p - m, p - m)
    :param cross: Of these with the targets, shape (p - m, m)
    """

    comoment: np.ndarray
    cross: np.ndarray

    def covariance(self) -> np.ndarray:
        """
        :return: population covariance (divided by the count) of the columns that are no targets, shape (p - m, p - m)
        """
        return self.comoment / self.count

    def correlation(self) -> np.ndarray:
        """
        :return: correlation matrix of the columns that are no targets, shape (p - m, p - m); rows and columns of constant
            variables are zero, diagonal included
        """
        n_inputs = len(self.comoment)
        moving = ~self.constant[:n_inputs]
        inverse = moving / np.where(moving, np.sqrt(self.squares[:n_inputs]), 1.0)
        correlation = self.comoment * inverse
        correlation *= inverse[:, None]
        # Exactly, so that rounding does not decide between copies
        np.fill_diagonal(correlation, moving)
        return correlation

    def faded(self, factor: float) -> "Moments":
        """
        :param factor: What all weights are multiplied with
        :return: moments of the same rows
        """
        sums = (factor * self.squares, factor * self.comoment, factor * self.cross)
        return Moments(factor * self.count, self.mean, *sums)


def with_rows(before: Moments | None, rows: np.ndarray, n_targets: int = 0) -> Moments:
    """
    :param before: Moments of other rows, or None; its products become those of the result
    :param rows: At least one row of float64, shape (N, p); never changed
    :param n_targets: Number m of the last columns that are targets
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
        n_inputs = len(mean) - n_targets
        none = np.zeros_like(mean), np.zeros((n_inputs, n_inputs)), np.zeros((n_inputs, n_targets))
        before = Moments(0.0, mean, *none)
    total, shift = before.count + count, mean - before.mean
    deviations[-1] = np.sqrt(before.count * count / total) * shift
    _add_products(deviations, before.comoment, before.cross)
    squares = before.squares + np.einsum("ij,ij->j", deviations, deviations)
    return Moments(total, before.mean + shift * (count / total), squares, before.comoment, before.cross)


def merge(parts: Sequence[Moments], into_first: bool = False) -> Moments:
    """
    :param parts: Moments of disjoint sets of rows, at least one
    :param into_first: Whether the products of the first part may become those of the result; else no part is changed
    :return: moments of all their rows, by the parallel formula of Chan, Golub and LeVeque (1983) for any number of parts
    """
    comoment, cross = parts[0].comoment, parts[0].cross
    if not into_first:
        comoment, cross = comoment.copy(), cross.copy()
    for part in parts[1:]:
        comoment += part.comoment
        cross += part.cross
    spread, between = _between(parts)
    if len(parts) > 1:
        _add_products(between, comoment, cross)
    return Moments(spread.count, spread.mean, spread.squares, comoment, cross)


def merge_spread(parts: Sequence[Spread]) -> Spread:
    """
    :param parts: Of disjoint sets of rows, at least one; never changed
    :return: the spread of all their rows
    """
    return _between(parts)[0]


def leave_one_out(parts: Sequence[Spread]) -> list[Spread]:
    """
    :param parts: Of disjoint sets of rows, at least two; never changed
    :return: for each part, the spread of the rows of all others
    """
    counts, means, squares = (np.stack([getattr(part, name) for part in parts]) for name in ("count", "mean", "squares"))
    others = 1.0 - np.eye(len(parts))
    weights = others * counts
    totals = weights.sum(axis=1)
    # From the mean of one of the others: what is constant in all of them then has exactly no variance
    origins = means[[1] + [0] * (len(parts) - 1)]
    shifts = means - origins[:, None]
    shift = np.einsum("ij,ijk->ik", weights, shifts) / totals[:, None]
    squares = others @ squares + np.einsum("ij,ijk->ik", weights, (shifts - shift[:, None]) ** 2)
    return [Spread(float(total), *arrays) for total, *arrays in zip(totals, origins + shift, squares, strict=True)]


def _between(parts: Sequence[Spread]) -> tuple[Spread, np.ndarray]:
    """The spread of all, and the deviations of the parts' means, weighted so that their products are those of the rows."""
    counts = np.array([part.count for part in parts])
    shifts = np.stack([part.mean for part in parts]) - parts[0].mean
    shift = counts @ shifts / counts.sum()
    between = np.sqrt(counts)[:, None] * (shifts - shift)
    squares = np.sum([part.squares for part in parts], axis=0) + (between**2).sum(axis=0)
    return Spread(float(counts.sum()), parts[0].mean + shift, squares), between


def _add_products(deviations: np.ndarray, comoment: np.ndarray, cross: np.ndarray) -> None:
    """In place."""
    n_inputs = len(comoment)
    inputs, targets = deviations[:, :n_inputs], deviations[:, n_inputs:]
    if len(deviations) >= MANY_ROWS:
        # Numpy computes one half of a product of a matrix with itself, and copies the other
        comoment += inputs.T @ inputs
    else:
        # Torch adds without another matrix of this size, which would be felt more than the other half
        th.from_numpy(comoment).addmm_(th.from_numpy(inputs).T, th.from_numpy(inputs))
    if targets.shape[1] > 0:
        cross += inputs.T @ targets


def check_rows(rows: npt.ArrayLike, names: Sequence[str]) -> np.ndarray:
    """
    :param rows: Rows of p columns, shape (N, p)
    :param names: The p names of the columns
    :return: the rows in float64; no copy where they are already
    :raises ValueError: on a wrong shape, or on NaN, infinite or absurdly large (1e140) values, naming the variables
    """
    rows = np.asarray(rows, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != len(names):
        raise ValueError(f"rows must have shape (N, {len(names)}), got {rows.shape}")
    bad = ~(np.abs(rows) < LARGEST_VALUE)
    if bad.any():
        variables = [names[i] for i in np.flatnonzero(bad.any(axis=0)).tolist()]
        row = int(np.flatnonzero(bad.any(axis=1))[0])
        raise ValueError(f"rows must be finite (below {LARGEST_VALUE:g}): first bad row {row}, bad variables {variables}")
    return rows


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
    :param n_targets: Number m, below p, of the last columns whose products with each other are not kept
    """

    def __init__(
        self,
        n_variables: int,
        half_life: float | None = None,
        names: Sequence[str] | None = None,
        window: int | None = None,
        n_blocks: int | None = None,
        n_targets: int = 0,
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
        if not 0 <= n_targets < n_variables:
            raise ValueError(f"n_targets must be at least 0 and below n_variables={n_variables}, got {n_targets!r}")
        self.n_variables = int(n_variables)
        self.half_life = half_life
        self.names = tuple(names) if names is not None else tuple(f"variable[{i}]" for i in range(n_variables))
        self.window = window
        self.n_blocks = n_blocks
        self.n_targets = n_targets
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
            self._blocks.append(with_rows(before, rows[:taken], self.n_targets))
            self._newest_rows += taken
            rows = rows[taken:]

    def checked(self, rows: npt.ArrayLike) -> np.ndarray:
        """
        :param rows: What ``update`` would take
        :return: the rows in float64, shape (N, p); no copy where they are already
        :raises ValueError: where ``update`` would raise
        """
        return check_rows(rows, self.names)

    def _decay(self, n_new_rows: int) -> None:
        """Weigh old rows less; a block goes when its weight is nothing beside that of the new rows."""
        assert self.half_life is not None
        factor = 0.5 ** (n_new_rows / self.half_life)
        self._blocks = [block.faded(factor) for block in self._blocks]
        while self._blocks and self._blocks[0].count < FORGOTTEN * n_new_rows:
            del self._blocks[0]

    def _make_room(self) -> None:
        """Free a block where all are taken."""
        if len(self._blocks) < self.n_blocks:
            return
        if self.window is not None:
            del self._blocks[0]
        elif self.half_life is not None and self._block_rows * self.n_blocks > 2.0 * self.half_life:
            self._blocks[:2] = [merge(self._blocks[:2], into_first=True)]
        else:
            for i in range(self.n_blocks // 2):
                self._blocks[i : i + 2] = [merge(self._blocks[i : i + 2], into_first=True)]
            self._block_rows *= 2

    def with_blocks(self, blocks: slice) -> "StreamingMoments":
        """
        :param blocks: Which of the blocks that hold rows, oldest first
        :return: moments of these rows alone, which share their arrays with these moments: only to be read
        """
        part = copy.copy(self)
        part._blocks = self._blocks[blocks]
        return part

    def forget_old(self, n_rows: float) -> None:
        """
        Forget the oldest blocks, as long as those that are left weigh so much.

        :param n_rows: Sum of the weights of the newest rows that are kept, at least
        """
        while self._blocks and self.count - self._blocks[0].count >= n_rows:
            del self._blocks[0]

    @property
    def blocks(self) -> tuple[Moments, ...]:
        """Moments of the blocks that hold rows, oldest first, at most ``n_blocks``; the next update changes them."""
        return tuple(self._blocks)

    @property
    def n_filled(self) -> int:
        """Number of blocks that hold rows, at most ``n_blocks``."""
        return len(self._blocks)

    def total(self) -> Moments:
        """
        :return: moments of all rows that are not forgotten
        :raises ValueError: when no row has been seen
        """
        return merge(self._filled())

    def _filled(self) -> list[Moments]:
        if not self._blocks:
            raise ValueError("no rows have been seen yet: call update(rows) first")
        return self._blocks

    def spread(self) -> Spread:
        """
        :return: that of all rows that are not forgotten, for less than ``total`` costs
        :raises ValueError: when no row has been seen
        """
        return merge_spread(self._filled())

    @property
    def count(self) -> float:
        """Sum of the rows' weights."""
        return float(sum(block.count for block in self._blocks))

    @property
    def fewest_rows(self) -> float:
        """Sum of the rows' weights that is not fallen below once rows are forgotten; infinite where none are."""
        # A new block begins with one row, when the oldest has gone
        n_rows = np.inf if self.window is None else (self.n_blocks - 1) * self._block_rows + 1.0
        if self.half_life is None:
            return float(n_rows)
        # By expm1, because a fading of one row after a very long half-life is 1 in double precision
        rate = np.log(0.5) / self.half_life
        return float(np.expm1(rate * n_rows) / np.expm1(rate))

    @property
    def mean(self) -> np.ndarray:
        """Shape (p,)."""
        return self.spread().mean

    def covariance(self) -> np.ndarray:
        """
        :return: population covariance (divided by the count) of the columns that are no targets, shape (p - m, p - m)
        :raises ValueError: when no row has been seen
        """
        return self.total().covariance()

    def standard_deviation(self) -> np.ndarray:
        """
        :return: population standard deviation, shape (p,)
        :raises ValueError: when no row has been seen
        """
        return self.spread().standard_deviation()

    @property
    def constant(self) -> np.ndarray:
        """Which columns do not move: standard deviation at most 1e-10 \\|mean\\| or 1e-12, boolean, shape (p,)."""
        return self.spread().constant

    def correlation(self) -> np.ndarray:
        """
        :return: correlation matrix of the columns that are no targets, shape (p - m, p - m); rows and columns of constant
            variables are zero, diagonal included
        """
        return self.total().correlation()
