import numpy as np
import numpy.typing as npt

from sb3_causalgdp.causal.statistics.moments import StreamingMoments
from sb3_causalgdp.causal.variables import TransitionVariables


class RecentRows:
    """
    The newest rows themselves, in float32, beside the moments of the stream.

    Memory is ``4 window (2 n + d + 1)`` bytes once the ring is full.

    :param variables: Names and order of the variables
    :param half_life: Number of new rows after which an old row weighs half in the moments; None weighs all alike
    :param window: Number of newest rows that are kept, at least 2; None keeps ``default_window``, and the moments of all
    :param default_window: Number of rows that are kept without a window
    :raises ValueError: on a window below 2
    """

    def __init__(
        self,
        variables: TransitionVariables,
        half_life: float | None = None,
        window: int | None = None,
        default_window: int = 20_000,
    ) -> None:
        if window is not None and not (isinstance(window, int | np.integer) and window >= 2):
            raise ValueError(f"window must be None or an integer of at least 2 rows, got {window!r}")
        self.variables = variables
        n_blocks = None if window is None else min(8, window - window % 2)
        self.moments = StreamingMoments(variables.n_variables, half_life, variables.names, window, n_blocks)
        self.window = int(default_window if window is None else window)
        self.clear()

    def clear(self) -> None:
        """Forget all rows."""
        self.moments.clear()
        self._ring: np.ndarray | None = None
        self._next = 0
        self._n_rows = 0
        # Deviations from the first row are kept: float32 would lose a small motion far from 0
        self._origin = np.zeros(self.variables.n_variables)

    @property
    def n_samples(self) -> int:
        """Number of rows seen."""
        return self.moments.n_samples

    @property
    def fewest_rows(self) -> float:
        """Number of rows that are kept once the ring is full."""
        return float(self.window)

    def update(self, rows: npt.ArrayLike) -> None:
        """
        Add a batch of rows; nothing changes when it raises.

        :param rows: shape (N, p), N may be 0; never changed
        :raises ValueError: on a wrong shape, or on NaN, infinite or absurdly large (1e140) values, naming the variables
        """
        rows = np.asarray(rows, dtype=np.float64)
        self.moments.update(rows)
        if len(rows) == 0:
            return
        if self._ring is None:
            self._origin = rows[0].copy()
            self._ring = np.empty((self.window, self.variables.n_variables), dtype=np.float32)
        largest = np.finfo(np.float32).max
        new = np.clip(rows[-self.window :] - self._origin, -largest, largest)
        self._ring[(self._next + np.arange(len(new))) % self.window] = new
        self._next = (self._next + len(new)) % self.window
        self._n_rows = min(self._n_rows + len(new), self.window)

    def rows(self) -> np.ndarray:
        """
        :return: the rows that are kept, oldest first, float64, shape (at most ``window``, p)
        :raises ValueError: when no row has been seen
        """
        if self._ring is None:
            raise ValueError("no rows have been seen yet: call update(rows) first")
        return self._ring[(self._next - self._n_rows + np.arange(self._n_rows)) % self.window] + self._origin

    def __len__(self) -> int:
        return self._n_rows

    def __getstate__(self) -> dict:
        state = self.__dict__.copy()
        if self._ring is not None and self._n_rows < self.window:
            state["_ring"] = self._ring[: self._n_rows]
        return state

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)
        if self._ring is not None and len(self._ring) < self.window:
            kept, self._ring = self._ring, np.empty((self.window, self.variables.n_variables), dtype=np.float32)
            self._ring[: len(kept)] = kept


def checked_rows(statistics: RecentRows, variables: TransitionVariables, method: str, needed: int) -> np.ndarray:
    """
    :param statistics: What a method that needs rows has been given
    :param variables: Names and order of the variables
    :param method: Its name, for the error
    :param needed: Number of rows that it needs at least
    :return: the rows that are kept, shape (N, 2 n + d + 1)
    :raises ValueError: on fewer rows, or when the statistics are not of these variables
    """
    if not isinstance(statistics, RecentRows) or statistics.variables != variables:
        raise ValueError(f"statistics must be those that make_statistics makes for {variables.names}, got {statistics!r}")
    if len(statistics) < needed:
        raise ValueError(f"{method} needs at least {needed} rows, got {len(statistics)}")
    return statistics.rows()
