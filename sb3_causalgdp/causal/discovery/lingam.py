import warnings
from typing import Any

import numpy as np

from sb3_causalgdp.causal.discovery.lasso import least_squares_gram
from sb3_causalgdp.causal.discovery.notears import weight_masks
from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.statistics.degenerate import LimitsFinder, find_degeneracy
from sb3_causalgdp.causal.statistics.moments import StreamingMoments
from sb3_causalgdp.causal.statistics.recent_rows import RecentRows, checked_rows
from sb3_causalgdp.causal.variables import TransitionVariables
from sb3_causalgdp.hints import how_to_install

LINGAM_HINT = f"the package lingam is needed for direct_lingam: {how_to_install('lingam')}"


def _lingam() -> Any:
    try:
        import lingam
        import lingam.utils
    except ImportError as error:
        raise ImportError(LINGAM_HINT) from error
    return lingam


class DirectLingam:
    """
    DirectLiNGAM (Shimizu et al., 2011, https://www.jmlr.org/papers/v12/shimizu11a.html) with the order of time, as VAR-LiNGAM
    (Hyvärinen et al., 2010) uses it: linear, with noise that must not be Gaussian.

    What (s_t, a_t) explain of s_{t+1} is regressed out first, so nothing can cause an earlier variable. DirectLiNGAM then
    orders what is left of the s'_j by their non-Gaussian noise. Each s'_j is regressed on (s_t, a_t) and on the s' before it,
    by the adaptive Lasso with BIC, which gives sparse direct weights A and B. The graph holds the effects over all paths,
    ``(I - B)^{-1} A``: those are what a model of s_{t+1} given (s_t, a_t) alone needs. B is left in the attribute
    ``instantaneous_weights``. The reward is regressed on (s_{t+1}, a_t).

    Weights become masks by the map of :class:`~sb3_causalgdp.causal.discovery.notears.Notears`. Linearly dependent causes
    share a mask. The order costs O(n^3) entropies of all rows: seconds with 17 states and 5,000 rows, hours with hundreds
    of states.

    :param edge_threshold: Smallest \\|w\\| of an open edge, not negative
    :param mask_scale: The \\|w\\| at which a mask is one half, positive
    :param window: Newest rows that are kept where the caller sets no window, at least 20
    :param max_states: Largest number of states that is accepted
    :param on_degenerate: ``"share"`` lets linearly dependent causes share a mask and gives constant ones none, ``"raise"`` is
        an error that names both
    :raises ImportError: when the package ``lingam`` is missing
    """

    def __init__(
        self,
        edge_threshold: float = 0.02,
        mask_scale: float = 0.05,
        window: int = 5_000,
        max_states: int = 60,
        on_degenerate: str = "share",
    ) -> None:
        _lingam()
        for name, number, zero_allowed in (("edge_threshold", edge_threshold, True), ("mask_scale", mask_scale, False)):
            if not (isinstance(number, int | float | np.number) and 0 <= number < np.inf and (zero_allowed or number > 0)):
                raise ValueError(f"{name} must be a finite number {'0 or' if zero_allowed else ''} above 0, got {number!r}")
        for name, count, least in (("window", window, 20), ("max_states", max_states, 1)):
            if not (isinstance(count, int | np.integer) and count >= least):
                raise ValueError(f"{name} must be an integer of at least {least}, got {count!r}")
        self.edge_threshold = edge_threshold
        self.mask_scale = mask_scale
        self.window = window
        self.max_states = max_states
        self._find_limits = LimitsFinder(on_degenerate)
        self.instantaneous_weights: np.ndarray | None = None
        """Of the last graph: row j holds the direct weights of s'_k on s'_j in standardised units, without cycles, (n, n)."""

    def make_statistics(
        self, variables: TransitionVariables, half_life: float | None = None, window: int | None = None
    ) -> RecentRows:
        """
        :param variables: Names and order of the variables
        :param half_life: Not used by this method: all kept rows weigh alike
        :param window: Number of newest rows that are kept; None keeps this method's own ``window``
        :return: what this method gathers
        :raises ValueError: on more than ``max_states`` states
        """
        if variables.n_states > self.max_states:
            raise ValueError(
                f"direct_lingam accepts max_states={self.max_states} states, for its cost grows with the cube, "
                f"got {variables.n_states}"
            )
        return RecentRows(variables, half_life, window, default_window=self.window)

    def min_rows(self, variables: TransitionVariables) -> int:
        """
        :param variables: Names and order of the variables
        :return: number of rows that a graph needs
        """
        return 2 * variables.n_states + variables.n_actions + 10

    def __call__(
        self, statistics: RecentRows, variables: TransitionVariables, previous: CausalGraph | None = None
    ) -> CausalGraph:
        """
        Find the graph.

        :param statistics: What :meth:`make_statistics` made, fed with transitions
        :param variables: Names and order of the variables
        :param previous: Not used
        :return: the graph; constant variables have no edges
        :raises ValueError: on fewer than 2 n + d + 10 rows, when the arguments are not about the same variables, or on
            linearly dependent or constant causes if ``on_degenerate="raise"``
        """
        n_states = variables.n_states
        rows = checked_rows(statistics, variables, "direct_lingam", self.min_rows(variables))
        newest = StreamingMoments(variables.n_variables)
        newest.update(rows)
        moments = newest.total()
        moving = ~moments.constant
        rows = (rows - moments.mean) * moving / np.where(moving, moments.standard_deviation(), 1.0)
        inputs, after = variables.causes_of_state, variables.causes_of_reward
        targets = np.arange(variables.n_variables)[variables.next_state]
        limits = self._find_limits(moments.correlation(), variables)
        of_now, of_after = limits.of_dynamics, limits.of_reward
        weights = np.zeros((n_states + 1, len(inputs)))
        weights[:n_states, of_now.kept] = self._dynamics(rows, inputs[of_now.kept], targets, moving[targets])
        weights[-1, of_after.kept] = _adaptive_lasso(rows, after[of_after.kept], variables.reward)
        for part, degeneracy in ((slice(0, n_states), of_now), (slice(n_states, None), of_after)):
            for variable, (stand_in, sign) in degeneracy.stand_in.items():
                weights[part, variable] = sign * weights[part, stand_in]
        masks = weight_masks(weights, self.edge_threshold, self.mask_scale)
        return CausalGraph(
            variables,
            np.concatenate([of_now.share(masks[:n_states]), of_after.share(masks[n_states:])]),
            weights,
            method="direct_lingam",
            n_samples=statistics.n_samples,
            r_squared=np.append(
                _r_squared(rows[:, targets], rows[:, inputs[of_now.kept]] @ weights[:n_states, of_now.kept].T),
                _r_squared(rows[:, [variables.reward]], rows[:, after[of_after.kept]] @ weights[-1:, of_after.kept].T),
            ),
            **limits.remarks(),
        )

    def _dynamics(self, rows: np.ndarray, inputs: np.ndarray, targets: np.ndarray, moving: np.ndarray) -> np.ndarray:
        """
        :param rows: Standardised, shape (N, 2 n + d + 1)
        :param inputs: Columns of the p possible causes
        :param targets: Columns of the n next states
        :param moving: Which targets move, shape (n,)
        :return: effects over all paths, shape (n, p)
        """
        gram, cross = (rows[:, inputs].T @ rows[:, columns] / len(rows) for columns in (inputs, targets))
        left = rows[:, targets] - rows[:, inputs] @ least_squares_gram(gram, cross)
        ordered = _order(left)
        among = np.zeros((len(targets), len(targets)))
        direct = np.zeros((len(targets), len(inputs)))
        for target in np.flatnonzero(moving):
            before = ordered[: ordered.index(int(target))] if target in ordered else []
            found = _adaptive_lasso(rows, np.concatenate([inputs, targets[before]]), targets[target])
            direct[target], among[target, before] = found[: len(inputs)], found[len(inputs) :]
        self.instantaneous_weights = among
        return np.linalg.solve(np.eye(len(targets)) - among, direct)


def _order(left: np.ndarray) -> list[int]:
    """Causal order of the columns, by DirectLiNGAM; those without noise of their own have no place in it."""
    variance = (left**2).mean(axis=0)
    scale = np.where(variance > 1e-8, np.sqrt(variance), np.inf)
    kept = find_degeneracy((left / scale).T @ (left / scale) / len(left)).kept
    if len(kept) < 2:
        return kept.tolist()
    model = _lingam().DirectLiNGAM()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.fit(left[:, kept])
    return kept[model.causal_order_].tolist()


def _adaptive_lasso(rows: np.ndarray, causes: np.ndarray, target: int) -> np.ndarray:
    """Sparse weights of the causes, shape (p,)."""
    if not rows[:, target].any() or len(causes) == 0:
        return np.zeros(len(causes))
    with warnings.catch_warnings():
        # The least-angle path stops early at nearly dependent causes and says so
        warnings.simplefilter("ignore")
        return _lingam().utils.predict_adaptive_lasso(rows, causes, target)


def _r_squared(values: np.ndarray, predicted: np.ndarray) -> np.ndarray:
    """Shape (m,); 0 for targets that do not move."""
    variance = (values**2).mean(axis=0)
    residual = ((values - predicted) ** 2).mean(axis=0)
    return np.where(variance > 0.0, np.clip(1.0 - residual / np.where(variance > 0.0, variance, 1.0), 0.0, 1.0), 0.0)
