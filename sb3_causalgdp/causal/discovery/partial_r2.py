import warnings
from datetime import datetime, timezone
from typing import NamedTuple

import numpy as np
import torch as th

from sb3_causalgdp.causal.basis import BasisExpansion, BasisMoments
from sb3_causalgdp.causal.degenerate import Degeneracy, find_degeneracy, variance_inflation
from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.jackknife import jackknife_error
from sb3_causalgdp.causal.moments import Moments, StreamingMoments
from sb3_causalgdp.causal.variables import TransitionVariables

RIDGE = 1e-9
SMALLEST_RESIDUAL = 1e-9  # of the target's variance: what float32 rounding and the ridge leave of an exact function
SMALLEST_DEVIATION = 1e-9  # in units of the standard deviation of all rows: below it, a column does not move in these rows
FLOOR_SHARE = 1.0 / 30.0  # of the threshold: below it, the noise of the logarithm says nothing
CONFOUNDED_VIF = 40.0
THINNING = 8


def edge_probability(partial_r2: np.ndarray, log_error: np.ndarray, threshold: float, spread: float) -> np.ndarray:
    """
    Probability that an edge is there: ``Phi[ln(partial R^2 / threshold) / sqrt(se^2 + spread^2)]``.

    :param partial_r2: Adjusted partial R^2, at least 0, any shape
    :param log_error: Standard error of its logarithm, the same shape
    :param threshold: Partial R^2 at which the probability is one half
    :param spread: Uncertainty in the logarithm beside that of the sample: how far off the threshold may be
    :return: the same shape; exactly 0 where the partial R^2 is 0 or the probability is below 1e-3
    """
    present = partial_r2 > 0.0
    log_ratio = np.log(np.where(present, partial_r2, 1.0) / threshold)
    score = th.as_tensor(log_ratio / np.sqrt(log_error**2 + spread**2))
    probability = th.special.ndtr(score).numpy()
    return np.where(present & (probability >= 1e-3), probability, 0.0)


class PartialR2:
    """
    Nonlinear discovery: how much of what the other causes leave does each cause explain?

    The targets are regressed on nonlinear features of all their possible causes: each variable as itself, its square, sine and
    tanh, and the products of pairs. Leaving out all features that a variable is part of raises the residual by
    ``SS_j = b_G' [(S^-1)_GG]^-1 b_G``, with S the correlations of the features and b the coefficients, so one Cholesky
    factorisation answers for all edges. ``SS_j`` relative to the residual without j is the partial R^2, adjusted for the
    number of features.

    A mask is the probability ``Phi[ln(partial R^2 / threshold) / sqrt(se^2 + spread^2)]``, with the standard error of the
    logarithm by block jackknife (Busing, Meijer and van der Leeden, 1999). An effect is the difference of the target, in
    its standard deviations, when a cause moves from half a standard deviation below to half a one above, the others as they
    are: its size is the mean of the absolute difference over the newest 256 rows, its sign that of the mean, so an even
    function has an effect too. R^2 is adjusted for the number of features as well.

    Linearly dependent variables are tested as a group and share its masks; variables that never move have no edges. Where rows
    are few, the products are left out, then sine and tanh, then the square, so that there are two rows for each feature.

    :param threshold: Partial R^2 at which a mask is one half, in (0, 1)
    :param spread: Uncertainty of the mask in ln(partial R^2), beside that of the sample, positive
    :param products: Whether products of pairs are among the features; None: where states and actions are at most 60
    :param max_memory: Bytes that the moments may take
    :param on_degenerate: ``share`` lets linearly dependent causes share a mask and gives constant ones none, ``raise`` is an
        error that names both
    """

    def __init__(
        self,
        threshold: float = 0.03,
        spread: float = 0.5,
        products: bool | None = None,
        max_memory: float = 200e6,
        on_degenerate: str = "share",
    ) -> None:
        if not 0.0 < threshold < 1.0:
            raise ValueError(f"threshold must be in (0, 1), got {threshold!r}")
        if not 0.0 < spread < np.inf:
            raise ValueError(f"spread must be a positive number, got {spread!r}")
        if on_degenerate not in ("share", "raise"):
            raise ValueError(f"on_degenerate must be 'share' or 'raise', got {on_degenerate!r}")
        self.threshold = threshold
        self.spread = spread
        self.products = products
        self.max_memory = max_memory
        self.on_degenerate = on_degenerate
        self._said_confounded = False

    def make_statistics(
        self, variables: TransitionVariables, half_life: float | None = None, window: int | None = None
    ) -> BasisMoments:
        """
        :param variables: Names and order of the variables
        :param half_life: Number of new rows after which an old row weighs half; None weighs all alike
        :param window: Number of newest rows that are kept; None keeps all
        :return: what this method gathers
        """
        return BasisMoments(variables, half_life, window, self.products, self.max_memory)

    def __call__(
        self, statistics: BasisMoments, variables: TransitionVariables, previous: CausalGraph | None = None
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
        self._check(statistics, variables)
        raw = statistics.raw.correlation()
        causes = (statistics.inputs_of_dynamics, statistics.inputs_of_reward)
        of_dynamics, of_reward = (find_degeneracy(raw[np.ix_(inputs, inputs)]) for inputs in causes)
        constant = tuple(np.array(variables.names)[statistics.raw.constant].tolist())
        duplicated = _names_of_duplicates(of_dynamics, of_reward, variables)
        if self.on_degenerate == "raise":
            _refuse_degenerate(set(constant) & {*variables.state_names, *variables.action_names}, duplicated)
        inflation = variance_inflation(raw[np.ix_(causes[0], causes[0])])[variables.n_states :]
        self._say_confounded(inflation, variables)
        rows = [
            self._estimate(statistics.dynamics, _dynamics(statistics, of_dynamics)),
            self._estimate(statistics.reward, _reward(statistics, of_reward)),
        ]
        masks, effects, errors, r_squared = (np.concatenate(parts) for parts in zip(*rows, strict=True))
        return CausalGraph(
            variables,
            masks=masks,
            effects=effects,
            standard_errors=errors,
            r_squared=r_squared,
            action_vif=inflation,
            method="partial_r2",
            n_samples=statistics.dynamics.n_samples,
            constant_variables=constant,
            duplicated_variables=duplicated,
            found_at=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        )

    def _estimate(self, moments: StreamingMoments, regression: "_Regression") -> tuple[np.ndarray, ...]:
        """Masks, effects, standard errors of the effects, and R^2."""
        whole = regression.whole
        parts, shares = [], []
        for i in range(moments.n_filled if moments.n_filled > 1 else 0):
            rest, share = moments.without_block(i)
            parts.append(regression.estimate(rest))
            shares.append(share)
        log_error = jackknife_error(self._log(whole), [self._log(part) for part in parts], shares)
        error = jackknife_error(whole.effects, [part.effects for part in parts], shares)
        masks = edge_probability(whole.partial_r2, log_error, self.threshold, self.spread)
        return masks, whole.effects, error, whole.r_squared

    def _log(self, estimates: "_Estimates") -> np.ndarray:
        return np.log(np.maximum(estimates.partial_r2, FLOOR_SHARE * self.threshold))

    def _check(self, statistics: BasisMoments, variables: TransitionVariables) -> None:
        if not isinstance(statistics, BasisMoments) or statistics.variables != variables:
            raise ValueError(f"statistics must be those that make_statistics makes for {variables.names}, got {statistics!r}")
        statistics.start()
        needed = 2 * (variables.n_states + variables.n_actions) + 4
        n_rows = statistics.dynamics.count
        # Weights of a half-life do not add up to an integer
        if n_rows < needed - 0.5:
            raise ValueError(
                f"partial_r2 needs at least {needed} rows (2 (states + actions) + 4) that are not forgotten, got {n_rows:.0f}"
            )

    def _say_confounded(self, inflation: np.ndarray, variables: TransitionVariables) -> None:
        if self._said_confounded or inflation.max() <= CONFOUNDED_VIF:
            return
        self._said_confounded = True
        over = np.flatnonzero(inflation > CONFOUNDED_VIF)
        named = ", ".join(f"{variables.action_names[i]} ({inflation[i]:.3g})" for i in over)
        warnings.warn(
            f"The states almost determine the actions (variance inflation over {CONFOUNDED_VIF:g}): {named}. Their effects "
            "cannot be told from those of the states; more exploration noise in the data would help.",
            stacklevel=3,
        )


def _names_of_duplicates(
    of_dynamics: Degeneracy, of_reward: Degeneracy, variables: TransitionVariables
) -> tuple[tuple[str, ...], ...]:
    """Groups among (s, a), and those that are among (s', a) alone."""
    before = (*variables.state_names, *variables.action_names)
    after = (*variables.next_state_names, *variables.action_names)
    known = {tuple(sorted(group)) for group in of_dynamics.groups}
    groups = [*of_dynamics.names_of_groups(before)]
    for group, names in zip(of_reward.groups, of_reward.names_of_groups(after), strict=True):
        if tuple(sorted(group)) not in known:
            groups.append(names)
    return tuple(groups)


def _refuse_degenerate(constant: set[str], duplicated: tuple[tuple[str, ...], ...]) -> None:
    if constant or duplicated:
        raise ValueError(
            f"causes cannot be told apart: constant {sorted(constant)}, linearly dependent {[list(g) for g in duplicated]}"
        )


class _Estimates(NamedTuple):
    """Of m targets and their p possible causes: partial R^2 (m, p), effects (m, p), R^2 (m,)."""

    partial_r2: np.ndarray
    effects: np.ndarray
    r_squared: np.ndarray


class _Group(NamedTuple):
    """
    Causes that are tested alike, each with g features, or together.

    :param causes: Indices of q causes; of one group of duplicates, whose features are one row below
    :param features: Indices of their features, shape (q, g), or (1, g)
    :param spread: Covariance of these features given all others, ``[(S^-1)_GG]^-1``, shape (q, g, g), or (1, g, g)
    """

    causes: list[int]
    features: th.Tensor
    spread: th.Tensor


class _Fit(NamedTuple):
    """
    Least squares for m targets.

    :param coefficients: In units of the features' and the targets' standard deviations in all rows, shape (F, m)
    :param deviation: Standard deviations of the features in these rows, in the same units, shape (F,)
    :param variance: Of the targets in these rows, in the same units, shape (m,)
    :param residual: Variance that the features leave, shape (m,)
    :param freedom: Rows less features less 1, at least 1
    """

    coefficients: th.Tensor
    deviation: np.ndarray
    variance: np.ndarray
    residual: np.ndarray
    freedom: float


def _dynamics(statistics: BasisMoments, degeneracy: Degeneracy) -> "_Regression":
    assert statistics.expansions is not None
    targets = np.arange(statistics.variables.n_variables)[statistics.variables.next_state]
    moments, inputs = statistics.dynamics.total(), statistics.inputs_of_dynamics
    return _Regression(statistics, moments, statistics.expansions[0], inputs, targets, degeneracy)


def _reward(statistics: BasisMoments, degeneracy: Degeneracy) -> "_Regression":
    assert statistics.expansions is not None
    targets = np.array([statistics.variables.reward])
    moments, inputs = statistics.reward.total(), statistics.inputs_of_reward
    return _Regression(statistics, moments, statistics.expansions[1], inputs, targets, degeneracy)


class _Regression:
    """
    Regresses some targets on the features of their possible causes: on all rows, and then on parts of them.

    The covariance of a cause's features given all others is that of all rows: its error is far smaller than that of the
    coefficients, and the parts need no inverse.

    :param statistics: Where the scales and the newest rows come from
    :param moments: Of the features and, behind them, the targets, of all rows
    :param expansion: The features
    :param inputs: Columns of the possible causes
    :param targets: Columns of the targets
    :param degeneracy: What cannot be told apart among the inputs
    """

    def __init__(
        self,
        statistics: BasisMoments,
        moments: Moments,
        expansion: BasisExpansion,
        inputs: np.ndarray,
        targets: np.ndarray,
        degeneracy: Degeneracy,
    ) -> None:
        self.shape = len(targets), len(inputs)
        self.n_features = expansion.n_features
        self.degeneracy = degeneracy
        used = _affordable_features(expansion, degeneracy.kept, moments.count)
        self.used = np.isin(np.arange(self.n_features), used)
        feature_deviation = np.sqrt(np.diagonal(moments.comoment)[: self.n_features] / moments.count)
        # A feature that is not used, or does not move, has nothing in common with any other
        moves = self.used & (feature_deviation > SMALLEST_DEVIATION)
        self.inverse_scale = moves / np.where(moves, feature_deviation, 1.0)

        deviation = statistics.raw.standard_deviation()
        self.target_moves = ~statistics.raw.constant[targets]
        self.target_scale = np.where(self.target_moves, deviation[targets], 1.0)
        self.features_of = {int(i): expansion.features_of(int(i)) for i in degeneracy.kept}
        standardised = expansion.standardise(statistics.recent[:, inputs])
        if not expansion.products:
            # What changes with a cause is then a function of it alone: one of its ordered values can stand for its neighbours
            standardised = np.sort(standardised, axis=0)[THINNING // 2 - 1 :: THINNING]
        half_steps = 0.5 * deviation[inputs] / expansion.scale
        self.differences = {i: expansion.difference(standardised, i, half_steps[i]) for i in self.features_of}

        factor = self._factor(moments)
        fit = self._fit(moments, factor)
        # In place: another matrix of this size would be felt
        self.groups = self._groups(th.cholesky_inverse(factor, out=factor))
        self.whole = self._estimates(fit)

    def estimate(self, moments: Moments) -> _Estimates:
        """
        :param moments: Of the features and, behind them, the targets, of some of the rows
        :return: what they say
        """
        return self._estimates(self._fit(moments, self._factor(moments)))

    def _factor(self, moments: Moments) -> th.Tensor:
        """Cholesky factor of the features' second moments S, in units of their standard deviations, shape (F, F)."""
        gram = moments.comoment[: self.n_features, : self.n_features] * (self.inverse_scale / moments.count)
        gram *= self.inverse_scale[:, None]
        diagonal = np.einsum("ii->i", gram)
        diagonal[self.inverse_scale == 0.0] = 1.0
        diagonal += RIDGE
        return th.linalg.cholesky(th.as_tensor(gram), out=th.as_tensor(gram))

    def _groups(self, inverse: th.Tensor) -> list[_Group]:
        in_group = {member for group in self.degeneracy.groups for member in group}
        alone = [i for i in self.features_of if i not in in_group]
        causes_and_features = [(alone, np.stack([self.features_of[i] for i in alone]))] if alone else []
        for group in self.degeneracy.groups:
            members = [self.features_of[i] for i in group if i in self.features_of]
            causes_and_features.append((list(group), np.unique(np.concatenate(members))[None]))
        groups = []
        for causes, indices in causes_and_features:
            features = th.as_tensor(indices)
            spread = th.linalg.inv(inverse[features[:, :, None], features[:, None, :]])
            groups.append(_Group(causes, features, spread))
        return groups

    def _fit(self, moments: Moments, factor: th.Tensor) -> _Fit:
        n_features, n_used = self.n_features, int(self.used.sum())
        cross = moments.comoment[:n_features, n_features:] * self.inverse_scale[:, None] / (moments.count * self.target_scale)
        variance = np.diagonal(moments.comoment) / moments.count
        deviation, variance = np.sqrt(variance[:n_features]) * self.inverse_scale, variance[n_features:] / self.target_scale**2
        moves = self.target_moves & (variance > SMALLEST_DEVIATION**2)
        variance = np.where(moves, variance, 1.0)
        cross[:, ~moves] = 0.0
        coefficients = th.cholesky_solve(th.as_tensor(cross), factor)
        explained = (coefficients.numpy() * cross).sum(axis=0)
        residual = np.maximum(variance - explained, SMALLEST_RESIDUAL * variance)
        return _Fit(coefficients, deviation, variance, residual, max(moments.count - n_used - 1.0, 1.0))

    def _estimates(self, fit: _Fit) -> _Estimates:
        total_freedom = fit.freedom + int(self.used.sum())
        r_squared = np.maximum(1.0 - (fit.residual / fit.freedom) / (fit.variance / total_freedom), 0.0)
        return _Estimates(self._partial_r2(fit), self._effects(fit), r_squared)

    def _partial_r2(self, fit: _Fit) -> np.ndarray:
        partial = np.zeros(self.shape)
        for causes, features, spread in self.groups:
            of_group = fit.coefficients[features]
            explained = (of_group * (spread @ of_group)).sum(dim=1).numpy()
            # Variances instead of sums of squares, as in the adjusted R^2, so that a null edge has 0 on average
            n_features = self.used[features.numpy()].sum(axis=1)[:, None]
            ratio = (fit.residual / fit.freedom) / ((fit.residual + explained) / (fit.freedom + n_features))
            partial[:, causes] = np.maximum(1.0 - ratio, 0.0).T
        return partial

    def _effects(self, fit: _Fit) -> np.ndarray:
        effects = np.zeros(self.shape)
        coefficients = fit.coefficients.numpy() * self.inverse_scale[:, None]
        for i, difference in self.differences.items():
            of_cause = coefficients[self.features_of[i]]
            change = difference @ of_cause
            average = np.full(len(change), 1.0 / len(change))
            # A product with the weights is several times faster than mean(axis=0)
            effects[:, i] = np.copysign(average @ np.abs(change, out=change), (average @ difference) @ of_cause)
        # In standard deviations of these rows: the errors of the scales and of the coefficients partly cancel
        effects *= fit.deviation[: self.shape[1]] / np.sqrt(fit.variance)[:, None]
        for variable, (stand_in, sign) in self.degeneracy.stand_in.items():
            effects[:, variable] = sign * effects[:, stand_in]
        return effects


def _affordable_features(expansion: BasisExpansion, inputs: np.ndarray, n_rows: float) -> np.ndarray:
    """The richest features of which there are twice as many rows."""
    for functions, products in ((4, True), (4, False), (2, False)):
        features = expansion.subset(inputs, functions, products)
        if n_rows >= 2 * len(features) + 2:
            return features
    return expansion.subset(inputs, 1, False)
