import warnings
from dataclasses import dataclass
from datetime import datetime, timezone

import numpy as np
import torch as th

from sb3_causalgdp.causal.basis import BasisExpansion, BasisMoments
from sb3_causalgdp.causal.degenerate import Degeneracy, find_degeneracy, variance_inflation
from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.moments import Moments
from sb3_causalgdp.causal.variables import TransitionVariables

RIDGE = 1e-9
SMALLEST_RESIDUAL = 1e-9  # of the target's variance: what float32 rounding and the ridge leave of an exact function
FLOOR_SHARE = 1.0 / 30.0  # of the threshold: below it, the noise of the logarithm says nothing
CONFOUNDED_VIF = 40.0


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


@dataclass
class _Regression:
    """Of m targets on the features: partial R^2, effects and R^2, from one set of moments."""

    partial_r2: np.ndarray  # (m, p)
    effects: np.ndarray  # (m, p)
    r_squared: np.ndarray  # (m,)


class PartialR2:
    """
    Nonlinear discovery: how much of what the other causes leave does each cause explain?

    The targets are regressed on nonlinear features of all their possible causes: each variable as itself, its square, sine and
    tanh, and the products of pairs. Leaving out all features that a variable is part of raises the residual by
    ``SS_j = b_G' [(S^-1)_GG]^-1 b_G``, with S the correlations of the features and b the coefficients, so one Cholesky
    factorisation answers for all edges. ``SS_j`` relative to the residual without j is the partial R^2, adjusted for the
    number of features.

    A mask is the probability ``Phi[ln(partial R^2 / threshold) / sqrt(se^2 + spread^2)]``, with the standard error of the
    logarithm by block jackknife (Busing, Meijer and van der Leeden, 1999). An effect is the mean difference of the target, in
    its standard deviations, when a cause moves from half a standard deviation below to half a one above, the others as they
    are: its size is the mean of the absolute difference, its sign that of the mean, so an even function has an effect too.

    Linearly dependent variables are tested as a group and share its masks; variables that never move have no edges.

    :param threshold: Partial R^2 at which a mask is one half, in (0, 1)
    :param spread: Uncertainty of the mask in ln(partial R^2), beside that of the sample, positive
    :param products: Whether products of pairs are among the features; None: where states and actions are at most 60
    :param max_memory: Bytes that the moments may take
    :param on_degenerate: ``share`` lets linearly dependent variables share a mask, ``raise`` is an error that names them
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
        :raises ValueError: on fewer than 2 (n + d) + 4 rows, when the arguments are not about the same variables, or on
            linearly dependent variables if ``on_degenerate="raise"``
        """
        if not isinstance(statistics, BasisMoments) or statistics.variables != variables:
            raise ValueError(f"statistics must be those that make_statistics makes for {variables.names}, got {statistics!r}")
        statistics.start()
        n_states = variables.n_states
        needed = 2 * (n_states + variables.n_actions) + 4
        n_rows = statistics.dynamics.n_samples
        if n_rows < needed:
            raise ValueError(f"partial_r2 needs at least {needed} rows (2 (states + actions) + 4), got {n_rows}")
        assert statistics.expansions is not None
        raw = statistics.raw.correlation()
        parts = []
        sources = (
            (statistics.dynamics, statistics.inputs_of_dynamics, np.arange(variables.n_variables)[variables.next_state]),
            (statistics.reward, statistics.inputs_of_reward, np.array([variables.reward])),
        )
        for (moments, inputs, targets), expansion in zip(sources, statistics.expansions, strict=True):
            degeneracy = find_degeneracy(raw[np.ix_(inputs, inputs)])
            system = _System(statistics, expansion, degeneracy, inputs, targets)
            parts.append((degeneracy, *self._estimate(moments, system)))
        self._check(statistics, parts)
        vif = variance_inflation(raw[: n_states + variables.n_actions, : n_states + variables.n_actions])[n_states:]
        self._say_confounded(vif, variables)
        input_names = (*variables.state_names, *variables.action_names)
        return CausalGraph(
            variables,
            masks=np.concatenate([part[1] for part in parts]),
            effects=np.concatenate([part[2] for part in parts]),
            standard_errors=np.concatenate([part[3] for part in parts]),
            r_squared=np.concatenate([part[4] for part in parts]),
            action_vif=vif,
            method="partial_r2",
            n_samples=n_rows,
            constant_variables=tuple(np.array(variables.names)[statistics.raw.constant].tolist()),
            duplicated_variables=parts[0][0].names_of_groups(input_names),
            found_at=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        )

    def _estimate(self, moments, system: "_System") -> tuple[np.ndarray, ...]:
        """Masks, effects, standard errors of the effects, and R^2, of one set of targets."""
        whole = system.regress(moments.total())
        parts, shares = [], []
        for rest, share in moments.leave_one_out():
            parts.append(system.regress(rest))
            shares.append(share)
        log_error = _jackknife_error(self._log(whole), [self._log(part) for part in parts], shares)
        error = _jackknife_error(whole.effects, [part.effects for part in parts], shares)
        masks = edge_probability(whole.partial_r2, log_error, self.threshold, self.spread)
        return system.degeneracy.share(masks), whole.effects, error, whole.r_squared

    def _log(self, regression: "_Regression") -> np.ndarray:
        return np.log(np.maximum(regression.partial_r2, FLOOR_SHARE * self.threshold))

    def _check(self, statistics: BasisMoments, parts) -> None:
        groups = parts[0][0].groups
        constant = np.array(statistics.variables.names)[statistics.raw.constant]
        if self.on_degenerate == "raise" and (groups or len(constant)):
            names = (*statistics.variables.state_names, *statistics.variables.action_names)
            raise ValueError(
                f"variables cannot be told apart: constant {constant.tolist()}, "
                f"linearly dependent {[list(group) for group in parts[0][0].names_of_groups(names)]}"
            )

    def _say_confounded(self, vif: np.ndarray, variables: TransitionVariables) -> None:
        if self._said_confounded or vif.max() <= CONFOUNDED_VIF:
            return
        self._said_confounded = True
        named = ", ".join(f"{variables.action_names[i]} ({vif[i]:.3g})" for i in np.flatnonzero(vif > CONFOUNDED_VIF))
        warnings.warn(
            f"The states almost determine the actions (variance inflation over {CONFOUNDED_VIF:g}): {named}. Their effects cannot "
            "be told from those of the states; more exploration noise in the data would help.",
            stacklevel=3,
        )


class _System:
    """The regression of some targets on the features of their possible causes, for any moments of these."""

    def __init__(
        self,
        statistics: BasisMoments,
        expansion: BasisExpansion,
        degeneracy: Degeneracy,
        inputs: np.ndarray,
        targets: np.ndarray,
    ) -> None:
        self.degeneracy = degeneracy
        self.expansion = expansion
        self.n_inputs = len(inputs)
        self.moving_target = ~statistics.raw.constant[targets]
        self.target_scale = np.where(self.moving_target, statistics.raw.standard_deviation()[targets], 1.0)
        self.feature_columns = self._affordable(statistics)
        self.row_of_feature = np.full(expansion.n_features, -1)
        self.row_of_feature[self.feature_columns] = np.arange(len(self.feature_columns))
        self.groups = {int(i): self._rows_of(i) for i in degeneracy.kept}
        standardised = expansion.standardise(statistics.recent[:, inputs])
        half = 0.5 * statistics.raw.standard_deviation()[inputs] / expansion.scale
        self.differences = {int(i): self._difference(standardised, int(i), half[i]) for i in degeneracy.kept}

    def _affordable(self, statistics: BasisMoments) -> np.ndarray:
        """The richest features of which there are twice as many rows."""
        kept, n_rows = self.degeneracy.kept, statistics.dynamics.total().count
        for functions, products in ((4, True), (4, False), (2, False)):
            columns = self.expansion.subset(kept, functions, products)
            if n_rows >= 2 * len(columns) + 2:
                return columns
        return self.expansion.subset(kept, 1, False)

    def _rows_of(self, variable: int) -> np.ndarray:
        rows = self.row_of_feature[self.expansion.features_of(variable)]
        return rows[rows >= 0]

    def _difference(self, standardised: np.ndarray, variable: int, half: float) -> np.ndarray:
        """How the features of a variable differ between half a standard deviation above and below, shape (N, |G|)."""
        above, below = standardised.copy(), standardised.copy()
        above[:, variable] += half
        below[:, variable] -= half
        change = self.expansion.features(above) - self.expansion.features(below)
        return change[:, self.feature_columns[self.groups[variable]]]

    def regress(self, moments: Moments) -> _Regression:
        n_features = self.expansion.n_features
        covariance = moments.covariance()
        used = np.concatenate([self.feature_columns, np.arange(n_features, len(covariance))])
        covariance = covariance[np.ix_(used, used)]
        deviation = np.sqrt(np.diagonal(covariance))
        deviation = np.where(deviation > 1e-9, deviation, np.inf)
        n_used = len(self.feature_columns)
        inverse_scale = 1.0 / deviation[:n_used]
        gram = th.as_tensor(covariance[:n_used, :n_used] * np.outer(inverse_scale, inverse_scale))
        gram.diagonal().copy_(th.full((n_used,), 1.0 + RIDGE, dtype=gram.dtype))
        cross = th.as_tensor(covariance[:n_used, n_used:] * inverse_scale[:, None] / self.target_scale)
        # A constant target has nothing to explain; any variance keeps its division defined
        variance = np.where(self.moving_target, np.diagonal(covariance)[n_used:] / self.target_scale**2, 1.0)
        inverse = th.cholesky_inverse(th.linalg.cholesky(gram))
        coefficients = inverse @ cross
        explained = (coefficients * cross).sum(dim=0).numpy()
        residual = np.maximum(variance - explained, SMALLEST_RESIDUAL * variance)
        partial = self._partial_r2(inverse, coefficients, residual, moments.count)
        effects = self._effects(coefficients.numpy() * inverse_scale[:, None])
        closed = ~self.moving_target
        partial[closed], effects[closed] = 0.0, 0.0
        r_squared = np.where(closed, 0.0, 1.0 - residual / variance)
        return _Regression(partial, effects, r_squared)

    def _partial_r2(self, inverse: th.Tensor, coefficients: th.Tensor, residual: np.ndarray, count: float) -> np.ndarray:
        partial = np.zeros((coefficients.shape[1], self.n_inputs))
        dependent = {member: group for group in self.degeneracy.groups for member in group}
        alone = [i for i in self.groups if i not in dependent]
        if alone:
            rows = th.as_tensor(np.stack([self.groups[i] for i in alone]))
            partial[:, alone] = self._adjusted(_explained_by(inverse, coefficients, rows), residual, rows.shape[1], count).T
        for group in self.degeneracy.groups:
            members = [self.groups[i] for i in group if i in self.groups]
            rows = th.as_tensor(np.unique(np.concatenate(members)))[None]
            value = self._adjusted(_explained_by(inverse, coefficients, rows), residual, rows.shape[1], count)[0]
            partial[:, list(group)] = value[:, None]
        return partial

    def _adjusted(self, explained: np.ndarray, residual: np.ndarray, n_features: int, count: float) -> np.ndarray:
        """As the adjusted R^2: variances, not sums of squares, so that a null edge has 0 on average."""
        freedom = max(count - len(self.feature_columns) - 1.0, 1.0)
        ratio = (residual / freedom) / ((residual + explained) / (freedom + n_features))
        return np.maximum(1.0 - ratio, 0.0)

    def _effects(self, coefficients: np.ndarray) -> np.ndarray:
        effects = np.zeros((coefficients.shape[1], self.n_inputs))
        for variable, difference in self.differences.items():
            change = difference @ coefficients[self.groups[variable]]
            effects[:, variable] = np.sign(change.mean(axis=0)) * np.abs(change).mean(axis=0)
        for variable, (stand_in, sign) in self.degeneracy.stand_in.items():
            effects[:, variable] = sign * effects[:, stand_in]
        return effects


def _explained_by(inverse: th.Tensor, coefficients: th.Tensor, rows: th.Tensor) -> np.ndarray:
    """
    ``b_G' [(S^-1)_GG]^-1 b_G`` for groups of features of one size.

    :param inverse: S^-1, shape (F, F)
    :param coefficients: b, shape (F, m)
    :param rows: Features of each of q groups, shape (q, g)
    :return: shape (q, m)
    """
    blocks = inverse[rows[:, :, None], rows[:, None, :]]
    of_group = coefficients[rows]
    return (of_group * th.linalg.solve(blocks, of_group)).sum(dim=1).numpy()


def _jackknife_error(whole: np.ndarray, parts: list[np.ndarray], shares: list[float]) -> np.ndarray:
    """Standard error by the jackknife for blocks of unequal size (Busing et al., 1999); 0 without blocks."""
    if not parts:
        return np.zeros_like(whole)
    inverse_share = 1.0 / np.array(shares)
    stacked = np.stack(parts)
    weights = inverse_share.reshape(-1, *[1] * whole.ndim)
    pseudo = weights * whole - (weights - 1.0) * stacked
    estimate = len(parts) * whole - ((1.0 - 1.0 / weights) * stacked).sum(axis=0)
    return np.sqrt(((pseudo - estimate) ** 2 / (weights - 1.0)).mean(axis=0))
