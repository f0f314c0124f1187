import numpy as np
import torch as th

from sb3_causalgdp.causal.discovery.changes import forget_what_changed
from sb3_causalgdp.causal.discovery.evidence import edge_probability
from sb3_causalgdp.causal.discovery.regression import Estimates, Regression, regression_of_dynamics, regression_of_reward
from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.statistics.basis import BASES, BasisMoments, bytes_needed
from sb3_causalgdp.causal.statistics.degenerate import Limits, LimitsFinder
from sb3_causalgdp.causal.statistics.grouped import GroupedStatistics
from sb3_causalgdp.causal.statistics.jackknife import jackknife_error
from sb3_causalgdp.causal.variables import TransitionVariables

FLOOR_SHARE = 1.0 / 30.0  # of the threshold: below it, the noise of the logarithm says nothing


class PartialR2:
    """
    Nonlinear discovery: how much of what the other causes leave does each cause explain?

    The targets are regressed on features of all their possible causes: each variable as itself, its square, sine and tanh, and
    the products of pairs. Leaving out all features that a variable is part of raises the residual by
    ``SS_j = b_G' [(S^-1)_GG]^-1 b_G``, with S the correlations of the features and b the coefficients, so one Cholesky
    factorisation answers for all edges. ``SS_j`` relative to the residual without j is the partial R^2, adjusted for the
    number of features.

    A mask is the probability ``Phi[ln(partial R^2 / threshold) / sqrt(se^2 + spread^2)]``, with the standard error of the
    logarithm by a jackknife that leaves out blocks of rows (Busing, Meijer and van der Leeden, 1999). Each estimate without a
    block is one Newton step from the solution, which makes the errors those of cluster-robust inference (Cameron and Miller,
    2015, "A practitioner's guide to cluster-robust inference").

    Evidence is another probability: that of an effect at all, however weak. It comes from F-tests of the same features (where
    there are products, no larger than the mask), of those that are functions of the cause alone and of the one that is linear
    in it, corrected for the number of tests and for rows that depend on each other: by the factor by which the sums of
    features times residuals over blocks of rows vary more than those of independent rows (the design effect of cluster
    sampling, Kish, 1965), and by the factor by which residuals are larger in blocks that a fit has not seen: many slow
    features follow the slow errors of a model that is not quite right.

    An effect is the difference of the target, in its standard deviations, when a cause moves from half a standard deviation
    below to half a one above, the others as they are: its size is the mean of the absolute difference over the newest 256
    rows, its sign that of the mean, so an even function has an effect too. R^2 is adjusted for the number of features as well.
    Where several functions agree on all rows, as those of the cosine and the sine of an angle can, the one with the smallest
    squares and products is taken.

    With a window, edges that are sure in its newest rows and surely not there in those before, or the other way around, say
    that the world has changed: the rows before are forgotten (``causal.discovery.changes``).

    Linearly dependent variables are tested as a group and share its masks; variables that never move have no edges. Where rows
    are few, the products are left out, then sine and tanh, then the square, so that there are two rows for each feature. With
    less than three, and residuals that are for most targets three times as large in blocks that a fit has not seen, those of
    the simpler features are taken that err least there.

    :param threshold: Partial R^2 at which a mask is one half, in (0, 1)
    :param spread: Uncertainty of the mask in ln(partial R^2), beside that of the sample, positive
    :param basis: The features: ``"linear"``, each variable as itself alone; ``"additive"``, with square, sine and tanh;
        ``"products"``, with the products of pairs, too; ``"auto"``: these where states and actions are at most 60, else
        ``"additive"``; where ``max_memory`` is too small for these, the next simpler features, and for ``"linear"`` ones of
        all variables, those of groups of neighbours. The graph's ``remarks`` say so
    :param max_memory: Bytes that the moments of the features may take, positive. Beside them there are those of the variables
        themselves, ``8 (2 n + d + 1)^2`` bytes, eight times as much with a window, and while a graph is found about twice what
        the features take
    :param on_degenerate: ``"share"`` lets linearly dependent causes share a mask and gives constant ones none, ``"raise"`` is
        an error that names both
    """

    def __init__(
        self,
        threshold: float = 0.03,
        spread: float = 0.5,
        basis: str = "auto",
        max_memory: float = 200e6,
        on_degenerate: str = "share",
    ) -> None:
        if not 0.0 < threshold < 1.0:
            raise ValueError(f"threshold must be in (0, 1), got {threshold!r}")
        if not 0.0 < spread < np.inf:
            raise ValueError(f"spread must be a positive number, got {spread!r}")
        if basis not in BASES:
            raise ValueError(f"basis must be one of {BASES}, got {basis!r}")
        if not 0.0 < max_memory < np.inf:
            raise ValueError(f"max_memory must be a positive number of bytes, got {max_memory!r}")
        self.threshold = threshold
        self.spread = spread
        self.basis = basis
        self.max_memory = max_memory
        self._find_limits = LimitsFinder(on_degenerate)

    def make_statistics(
        self, variables: TransitionVariables, half_life: float | None = None, window: int | None = None
    ) -> BasisMoments | GroupedStatistics:
        """
        :param variables: Names and order of the variables
        :param half_life: Number of new rows after which an old row weighs half; None weighs all alike
        :param window: Number of newest rows that are kept; None keeps all
        :return: what this method gathers
        :raises ValueError: when ``max_memory`` is too small for the features that ``basis`` names
        """
        n_states, n_inputs = variables.n_states, variables.n_states + variables.n_actions
        if self.basis == "auto" and bytes_needed(n_states, n_inputs, "linear") > self.max_memory:
            return GroupedStatistics(variables, half_life, window, self.max_memory)
        return BasisMoments(variables, half_life, window, self.basis, self.max_memory)

    def min_rows(self, variables: TransitionVariables) -> int:
        """
        :param variables: Names and order of the variables
        :return: number of rows, not forgotten, that a graph needs
        """
        return 2 * (variables.n_states + variables.n_actions) + 4

    def __call__(
        self,
        statistics: BasisMoments | GroupedStatistics,
        variables: TransitionVariables,
        previous: CausalGraph | None = None,
    ) -> CausalGraph:
        """
        Find the graph.

        :param statistics: What :meth:`make_statistics` made, fed with transitions
        :param variables: Names and order of the variables
        :param previous: Not used: there is a closed form
        :return: the graph
        :raises ValueError: on fewer than 2 (n + d) + 4 rows that are not forgotten, when the arguments are not about the same
            variables, or on linearly dependent or constant causes if ``on_degenerate="raise"``
        """
        if isinstance(statistics, GroupedStatistics) and statistics.variables == variables:
            statistics.start()
            return statistics.spread_out(self(statistics.statistics, statistics.group_variables))
        statistics = self._checked(statistics, variables)
        limits = self._find_limits(statistics.raw.correlation(), variables)
        changed = forget_what_changed(statistics, lambda part: self._estimates(part, limits)[0], self.min_rows(variables))
        if changed:
            limits = self._find_limits(statistics.raw.correlation(), variables)
        masks, effects, errors, r_squared, evidence, detectable = self._estimates(statistics, limits)
        return CausalGraph(
            variables,
            masks=masks,
            effects=effects,
            standard_errors=errors,
            r_squared=r_squared,
            evidence=evidence,
            detectable_r2=detectable,
            method="partial_r2",
            n_samples=statistics.dynamics.n_samples,
            remarks=tuple(filter(None, (statistics.remark, changed))),
            **limits.remarks(),
        )

    def _estimates(self, statistics: BasisMoments, limits: Limits) -> list[np.ndarray]:
        """Those of ``_estimate``, of all next states and the reward."""
        variables = statistics.variables
        n_tests = (variables.n_states + 1) * (variables.n_states + variables.n_actions)
        of_dynamics = self._estimate(regression_of_dynamics(statistics, limits.of_dynamics), n_tests)
        of_reward = self._estimate(regression_of_reward(statistics, limits.of_reward), n_tests)
        return [np.concatenate(pair) for pair in zip(of_dynamics, of_reward, strict=True)]

    def _estimate(self, regression: "Regression", n_tests: int) -> tuple[np.ndarray, ...]:
        """Masks, effects, their standard errors, each of shape (m, p), R^2, evidence, shape (m, p), and what it could see."""
        whole = regression.whole
        logs, effects, shares = [], [], []
        for part, share in regression.parts():
            logs.append(self._log(part))
            effects.append(part.effects)
            shares.append(share)
        log_error = jackknife_error(self._log(whole), logs, shares)
        masks = edge_probability(whole.partial_r2, log_error, self.threshold, self.spread)
        effect_errors = jackknife_error(whole.effects, effects, shares).T
        evidence, detectable = regression.evidence(n_tests, masks)
        return masks.T, whole.effects.T, effect_errors, regression.r_squared(), evidence.T, detectable

    def _log(self, estimates: "Estimates") -> np.ndarray:
        return th.from_numpy(estimates.partial_r2).clamp(min=FLOOR_SHARE * self.threshold).log().numpy()

    def _checked(self, statistics: BasisMoments | GroupedStatistics, variables: TransitionVariables) -> BasisMoments:
        if not isinstance(statistics, BasisMoments) or statistics.variables != variables:
            raise ValueError(f"statistics must be those that make_statistics makes for {variables.names}, got {statistics!r}")
        statistics.start()
        needed = self.min_rows(variables)
        n_rows = statistics.dynamics.count
        # Weights of a half-life do not add up to an integer
        if n_rows < needed - 0.5:
            raise ValueError(
                f"partial_r2 needs at least {needed} rows (2 (states + actions) + 4) that are not forgotten, got {n_rows:.0f}"
            )
        return statistics
