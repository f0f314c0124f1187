from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.statistics.moments import Moments, StreamingMoments
from sb3_causalgdp.causal.variables import TransitionVariables


class Perturbed:
    """
    Another method with noise on what it sees, to make the graph wrong on purpose: the paper's ablation CausalGDP-WN.

    Independent Gaussian noise is added to whatever can be a cause: s_t, a_t and s_{t+1}. For a method that reads
    :class:`~sb3_causalgdp.causal.StreamingMoments` nothing is drawn: the noise's variance is added to the diagonal of the
    covariance, which is the limit of infinitely many draws. For other methods noise is drawn as rows arrive, in the standard
    deviations of the rows up to then.

    :param method: Name of the method, or a callable
    :param noise: Standard deviation of the noise, in standard deviations of each variable, not negative
    :param seed: Of the drawn noise
    :param method_kwargs: Arguments of the method
    """

    def __init__(
        self, method: str | Callable[..., CausalGraph] = "notears", noise: float = 0.1, seed: int = 0, **method_kwargs: Any
    ) -> None:
        # The registry lists this class
        from sb3_causalgdp.causal.discovery import make_discovery

        if isinstance(noise, bool) or not (isinstance(noise, int | float | np.number) and 0 <= noise < np.inf):
            raise ValueError(f"noise must be a finite number 0 or above, got {noise!r}")
        self.method = make_discovery(method, **method_kwargs)
        self.noise = float(noise)
        self.seed = seed

    def make_statistics(
        self, variables: TransitionVariables, half_life: float | None = None, window: int | None = None
    ) -> "StreamingMoments | NoisyStatistics":
        """
        :param variables: Names and order of the variables
        :param half_life: Number of new rows after which an old row weighs half; None weighs all alike
        :param window: Number of newest rows that are kept; None keeps all
        :return: what the wrapped method gathers, if need be with noise in front of it
        """
        from sb3_causalgdp.causal.discovery import make_statistics

        statistics = make_statistics(self.method, variables, half_life, window)
        if isinstance(statistics, StreamingMoments):
            return statistics
        return NoisyStatistics(statistics, variables, self.noise, self.seed)

    def min_rows(self, variables: TransitionVariables) -> int:
        """
        :param variables: Names and order of the variables
        :return: number of rows that the wrapped method needs for a graph
        """
        from sb3_causalgdp.causal.discovery import min_rows

        return min_rows(self.method, variables)

    def __call__(
        self,
        statistics: "StreamingMoments | NoisyStatistics",
        variables: TransitionVariables,
        previous: CausalGraph | None = None,
    ) -> CausalGraph:
        """
        Find the graph.

        :param statistics: What :meth:`make_statistics` made, fed with transitions
        :param variables: Names and order of the variables
        :param previous: Graph over the same variables, for the wrapped method
        :return: the wrapped method's graph of the noisy data; its ``method`` says ``perturbed_`` in front
        :raises ValueError: where the wrapped method would raise
        """
        if isinstance(statistics, NoisyStatistics):
            graph = self.method(statistics.statistics, variables, previous)
        elif isinstance(statistics, StreamingMoments):
            graph = self.method(NoisyMoments(statistics, self.noise, _causes(variables)), variables, previous)
        else:
            raise ValueError(f"statistics must be those that make_statistics makes for {variables.names}, got {statistics!r}")
        graph.method = f"perturbed_{graph.method}"
        return graph


def _causes(variables: TransitionVariables) -> np.ndarray:
    """Which columns can be a cause: all but the reward, boolean, shape (2 n + d + 1,)."""
    return np.arange(variables.n_variables) != variables.reward


class NoisyMoments(StreamingMoments):
    """
    Moments as they would be with independent noise on some columns.

    :param moments: Moments without noise, without targets; never changed
    :param noise: Standard deviation of the noise in the columns' standard deviations
    :param noisy: Which columns have noise, boolean, shape (p,)
    """

    def __init__(self, moments: StreamingMoments, noise: float, noisy: np.ndarray) -> None:
        self.__dict__.update(moments.__dict__)
        if moments.n_filled > 0:
            variance = noise**2 * noisy * moments.standard_deviation() ** 2
            self._blocks = [_with_noise(block, variance) for block in moments.blocks]


def _with_noise(moments: Moments, variance: np.ndarray) -> Moments:
    added = moments.count * variance
    return replace(moments, squares=moments.squares + added, comoment=moments.comoment + np.diag(added))


class NoisyStatistics:
    """
    Statistics of rows to which noise is added as they arrive.

    :param statistics: What gathers the noisy rows
    :param variables: Names and order of the variables
    :param noise: Standard deviation of the noise in the variables' standard deviations so far
    :param seed: Of the noise
    """

    def __init__(self, statistics: Any, variables: TransitionVariables, noise: float, seed: int) -> None:
        self.statistics = statistics
        self.variables = variables
        self.noise = noise
        self.rng = np.random.default_rng(seed)
        self._clean = StreamingMoments(variables.n_variables, names=variables.names)

    @property
    def n_samples(self) -> int:
        """Number of rows that have been fed."""
        return self.statistics.n_samples

    @property
    def count(self) -> float:
        """Sum of the weights of the rows from which a graph is found."""
        return getattr(self.statistics, "count", self.statistics.n_samples)

    @property
    def fewest_rows(self) -> float:
        """Sum of the rows' weights that is not fallen below once rows are forgotten."""
        return getattr(self.statistics, "fewest_rows", np.inf)

    @property
    def wants_history(self) -> bool:
        """Whether the wrapped statistics want older rows again."""
        return getattr(self.statistics, "wants_history", False)

    @property
    def rows_since_change(self) -> float:
        """Number of newest rows that are of the world as it is now."""
        return getattr(self.statistics, "rows_since_change", np.inf)

    def update(self, rows: npt.ArrayLike) -> None:
        """
        Add a batch of rows; nothing changes when it raises.

        :param rows: shape (N, 2 n + d + 1), N may be 0; never changed
        :raises ValueError: on a wrong shape, or on NaN, infinite or absurdly large values, naming the variables
        """
        rows = np.asarray(rows, dtype=np.float64)
        self._clean.update(rows)
        if len(rows) > 0:
            self.statistics.update(self._with_noise(rows))

    def restart(self) -> None:
        """Let the wrapped statistics begin anew."""
        self.statistics.restart()

    def refill(self, rows: npt.ArrayLike) -> None:
        """
        :param rows: Older rows that the wrapped statistics want, with new noise, shape (N, 2 n + d + 1)
        """
        self.statistics.refill(self._with_noise(np.asarray(rows, dtype=np.float64)))

    def _with_noise(self, rows: np.ndarray) -> np.ndarray:
        scale = self.noise * self._clean.standard_deviation() * _causes(self.variables) * ~self._clean.constant
        return rows + scale * self.rng.standard_normal(rows.shape)
