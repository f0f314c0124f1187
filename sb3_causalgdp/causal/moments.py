from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

LARGEST_VALUE = 1e140  # so that the sum of squares stays inside float64
CONSTANT_FLOOR = 1e-10  # a million times float64's rounding, yet below a sensor at 1e6 with sd 1e-3


class StreamingMoments:
    """
    Weighted count, mean and co-moment of a stream of rows, in float64.

    Batches are merged by the parallel formula of Chan, Golub and LeVeque (1983), "Algorithms for computing the sample
    variance", so memory and the cost of reading the covariance do not depend on the number of rows seen.

    :param n_variables: Number of columns p
    :param half_life: Number of new rows after which an old row weighs half; None weighs all rows alike.
        Rows of one batch are weighted alike, so a batch should be short in comparison.
    :param names: The p names used in error messages; ``variable[i]`` by default
    """

    def __init__(self, n_variables: int, half_life: float | None = None, names: Sequence[str] | None = None) -> None:
        if isinstance(n_variables, bool) or not isinstance(n_variables, int | np.integer):
            raise TypeError(f"n_variables must be an integer, got {n_variables!r}")
        if n_variables < 1:
            raise ValueError(f"n_variables must be at least 1, got {n_variables}")
        if half_life is not None and not (isinstance(half_life, int | float | np.number) and 0 < half_life < np.inf):
            raise ValueError(f"half_life must be None or a positive number of rows, got {half_life!r}")
        if names is not None and len(names) != n_variables:
            raise ValueError(f"names must hold {n_variables} names, got {len(names)}")
        self.n_variables = int(n_variables)
        self.half_life = half_life
        self.names = tuple(names) if names is not None else tuple(f"variable[{i}]" for i in range(n_variables))
        self.count = 0.0
        self.n_samples = 0
        self.mean = np.zeros(n_variables)
        self.comoment = np.zeros((n_variables, n_variables))

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
        n_rows = len(rows)
        if n_rows == 0:
            return

        # Subtract the first row before averaging: a constant column then has exactly no variance
        shifted = rows - rows[0]
        shifted_mean = shifted.mean(axis=0)
        centred = shifted - shifted_mean
        delta = rows[0] + shifted_mean - self.mean

        decay = 1.0 if self.half_life is None else 0.5 ** (n_rows / self.half_life)
        old_count = decay * self.count
        total = old_count + n_rows
        self.comoment = decay * self.comoment + centred.T @ centred + np.outer(delta, delta) * (old_count * n_rows / total)
        self.mean = self.mean + delta * (n_rows / total)
        self.count = total
        self.n_samples += n_rows

    def _check_finite(self, rows: np.ndarray) -> None:
        bad = ~(np.abs(rows) < LARGEST_VALUE)
        if bad.any():
            variables = [self.names[i] for i in np.flatnonzero(bad.any(axis=0))]
            row = int(np.flatnonzero(bad.any(axis=1))[0])
            raise ValueError(f"rows must be finite (below {LARGEST_VALUE:g}): first bad row {row}, bad variables {variables}")

    def covariance(self) -> np.ndarray:
        """
        :return: population covariance (divided by the count), shape (p, p)
        :raises ValueError: when no row has been seen
        """
        if self.n_samples == 0:
            raise ValueError("no rows have been seen yet: call update(rows) first")
        return self.comoment / self.count

    def standard_deviation(self) -> np.ndarray:
        """
        :return: population standard deviation, shape (p,)
        """
        return np.sqrt(np.diagonal(self.covariance()))

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
