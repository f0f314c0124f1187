import warnings
from datetime import datetime, timezone
from typing import NamedTuple

import numpy as np

from sb3_causalgdp.causal.degenerate import Degeneracy, find_degeneracy, variance_inflation
from sb3_causalgdp.causal.discovery.acyclic import notears, without_cycles
from sb3_causalgdp.causal.discovery.lasso import least_squares_gram, solve_lasso_gram
from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.jackknife import jackknife_error
from sb3_causalgdp.causal.moments import StreamingMoments
from sb3_causalgdp.causal.variables import TransitionVariables


class _Part(NamedTuple):
    """Some rows of the graph: those of the m targets, from p inputs."""

    weights: np.ndarray  # (m, p)
    masks: np.ndarray  # (m, p)
    r_squared: np.ndarray  # (m,)
    standard_errors: np.ndarray | None  # (m, p)
    degeneracy: Degeneracy


def weight_masks(weights: np.ndarray, edge_threshold: float, mask_scale: float) -> np.ndarray:
    """
    ``w^2 / (w^2 + mask_scale^2)``, and 0 where \\|w\\| < ``edge_threshold``.

    :param weights: Weights in standardised units, any shape
    :param edge_threshold: Smallest \\|w\\| of an open edge
    :param mask_scale: The \\|w\\| at which a mask is one half
    :return: masks in [0, 1), the same shape
    """
    squares = weights**2
    return np.where(np.abs(weights) < edge_threshold, 0.0, squares / (squares + mask_scale**2))


class Notears:
    """
    NOTEARS (Zheng et al., 2018, https://arxiv.org/abs/1803.01422) on the edges that time allows:
    (s_t, a_t) -> s_{t+1} and (s_{t+1}, a_t) -> r_t.

    Minimises ``1/2 tr((I - W)^T S (I - W)) + sparsity ||W||_1`` with S the second moments. Every graph of these edges is
    acyclic, so NOTEARS' constraint h(W) = 0 holds identically and the problem is convex: one Lasso per target.

    With ``instantaneous``, edges s'_k -> s'_j are estimated as well, and there h(W) = 0 binds: NOTEARS on what (s_t, a_t)
    leaves of s_{t+1} finds their weights B, and a Lasso of (I - B) s_{t+1} on (s_t, a_t) finds the direct weights A. The graph
    holds the effects over all paths, ``(I - B)^{-1} A``: those are what a model of s_{t+1} given (s_t, a_t) alone needs. B
    itself is left in the attribute ``instantaneous_weights``.

    A weight w (in standardised units) becomes a mask by one map: 0 where \\|w\\| < ``edge_threshold``, otherwise
    ``w^2 / (w^2 + mask_scale^2)``, which is half at \\|w\\| = ``mask_scale`` and, by default, 0.90 at 0.15 and 0.99 at 0.5.
    Linearly dependent causes share a mask, the largest among them.

    Standard errors come from moments of at least two blocks (``StreamingMoments(n_blocks=8)``), by a jackknife that takes one
    Newton step from the solution, at its support and signs; that of a closed edge is the error of what the L1 norm set to 0.

    :param sparsity: Weight of the L1 norm, not negative; in units of a correlation when ``standardize``. 0 is least squares,
        which has a closed form
    :param edge_threshold: Smallest \\|w\\| of an open edge, not negative
    :param mask_scale: The \\|w\\| at which a mask is one half, positive
    :param max_iterations: Upper limit of the solver's iterations
    :param tolerance: Largest KKT residual, relative to the target's largest second moment with an input
    :param standardize: Solve on the correlation matrix. False solves on the covariance, as the original does, where the
        variables' units decide what is sparse and, among simultaneous variables, what causes what (Reisach et al., 2021,
        https://arxiv.org/abs/2102.13647)
    :param instantaneous: Whether edges inside s_{t+1} are estimated; costs hundreds of matrix exponentials of size n
    """

    def __init__(
        self,
        sparsity: float = 0.01,
        edge_threshold: float = 0.02,
        mask_scale: float = 0.05,
        max_iterations: int = 20_000,
        tolerance: float = 1e-5,
        standardize: bool = True,
        instantaneous: bool = False,
    ) -> None:
        for name, number, zero_allowed in (
            ("sparsity", sparsity, True),
            ("edge_threshold", edge_threshold, True),
            ("mask_scale", mask_scale, False),
            ("tolerance", tolerance, False),
        ):
            if not (isinstance(number, int | float | np.number) and 0 <= number < np.inf and (zero_allowed or number > 0)):
                accepted = "0 or above" if zero_allowed else "above 0"
                raise ValueError(f"{name} must be a finite number {accepted}, got {number!r}")
        if not (isinstance(max_iterations, int | np.integer) and max_iterations > 0):
            raise ValueError(f"max_iterations must be an integer above 0, got {max_iterations!r}")
        self.sparsity = sparsity
        self.edge_threshold = edge_threshold
        self.mask_scale = mask_scale
        self.max_iterations = max_iterations
        self.tolerance = tolerance
        self.standardize = standardize
        self.instantaneous = instantaneous
        self.instantaneous_weights: np.ndarray | None = None
        """Of the last graph: row j holds the direct weights of s'_k on s'_j in standardised units, without cycles, (n, n)."""

    def __call__(
        self, moments: StreamingMoments, variables: TransitionVariables, previous: CausalGraph | None = None
    ) -> CausalGraph:
        """
        Find the graph.

        :param moments: Moments of rows in the order of ``variables``
        :param variables: Names and order of the variables
        :param previous: Graph over the same variables whose weights are the solver's start
        :return: the graph; constant variables have no edges
        :raises ValueError: on fewer than n + d + 2 rows, or when the arguments are not about the same variables
        """
        self._check(moments, variables, previous)
        n_states, n_inputs = variables.n_states, variables.n_states + variables.n_actions
        now = np.arange(n_inputs)
        after = np.concatenate([np.arange(variables.next_state.start, variables.next_state.stop), now[variables.action]])
        start = np.zeros((n_states + 1, n_inputs)) if previous is None else previous.effects
        problem = _Standardised(moments, self.standardize)
        dynamics = self._solve(problem, now, after[:n_states], start[:-1], self.instantaneous)
        reward = self._solve(problem, after, np.array([variables.reward]), start[-1:])
        known = dynamics.standard_errors is not None and reward.standard_errors is not None
        return CausalGraph(
            variables,
            np.concatenate([dynamics.masks, reward.masks]),
            np.concatenate([dynamics.weights, reward.weights]),
            method="notears",
            n_samples=moments.n_samples,
            standard_errors=np.concatenate([dynamics.standard_errors, reward.standard_errors]) if known else None,
            r_squared=np.concatenate([dynamics.r_squared, reward.r_squared]),
            action_vif=variance_inflation(problem.correlation[:n_inputs, :n_inputs])[n_states:],
            found_at=datetime.now(timezone.utc).isoformat(timespec="seconds"),
            constant_variables=tuple(np.array(variables.names)[moments.constant].tolist()),
            duplicated_variables=dynamics.degeneracy.names_of_groups(variables.names),
        )

    def mask(self, weights: np.ndarray) -> np.ndarray:
        """
        :param weights: Weights in standardised units, any shape
        :return: masks in [0, 1), the same shape
        """
        return weight_masks(weights, self.edge_threshold, self.mask_scale)

    def _check(self, moments: StreamingMoments, variables: TransitionVariables, previous: CausalGraph | None) -> None:
        if moments.n_variables != variables.n_variables:
            raise ValueError(f"moments must hold {variables.n_variables} variables, got {moments.n_variables}")
        needed = variables.n_states + variables.n_actions + 2
        if moments.n_samples < needed:
            raise ValueError(f"moments must hold at least {needed} rows (states + actions + 2), got {moments.n_samples}")
        if previous is not None and previous.variables != variables:
            raise ValueError(f"previous must be over {variables.names}, got {previous.variables.names}")

    def _solve(
        self,
        problem: "_Standardised",
        inputs: np.ndarray,
        targets: np.ndarray,
        initial: np.ndarray,
        instantaneous: bool = False,
    ) -> _Part:
        """
        :param inputs: Columns of the p possible causes
        :param targets: Columns of the m effects
        :param initial: Start in standardised units, shape (m, p)
        :param instantaneous: Whether the targets may cause each other
        """
        degeneracy = find_degeneracy(problem.correlation[np.ix_(inputs, inputs)])
        moves = np.flatnonzero(problem.moving[targets])
        free, targets = inputs[degeneracy.kept], targets[moves]
        gram, cross = problem.second_moments(free, free), problem.second_moments(free, targets)
        among = np.zeros((len(targets), len(targets)))
        if instantaneous:
            among = self._among(problem.second_moments(targets, targets), gram, cross)
            self.instantaneous_weights = np.zeros((len(initial), len(initial)))
            self.instantaneous_weights[np.ix_(moves, moves)] = among * problem.to_standardised(targets, targets)
        through = np.linalg.inv(np.eye(len(targets)) - among)
        units = problem.to_standardised(targets, free)
        start = np.linalg.solve(through, initial[np.ix_(moves, degeneracy.kept)] / units)
        direct = self._lasso(gram, cross @ np.linalg.inv(through).T, start)
        chosen = np.ix_(moves, degeneracy.kept)
        weights, r_squared = np.zeros_like(initial), np.zeros(len(initial))
        weights[chosen] = total = (through @ direct) * units
        r_squared[moves] = problem.r_squared(free, targets, total)
        errors = None
        if not instantaneous and (changes := problem.jackknife(free, targets, direct)) is not None:
            errors = np.zeros_like(initial)
            errors[chosen] = changes * units
        for variable, (stand_in, sign) in degeneracy.stand_in.items():
            weights[:, variable] = sign * weights[:, stand_in]
            if errors is not None:
                errors[:, variable] = errors[:, stand_in]
        return _Part(weights, degeneracy.share(self.mask(weights)), r_squared, errors, degeneracy)

    def _lasso(self, gram: np.ndarray, cross: np.ndarray, initial: np.ndarray) -> np.ndarray:
        solution = solve_lasso_gram(gram, cross, self.sparsity, initial.T, self.max_iterations, self.tolerance)
        if not solution.converged:
            warnings.warn(
                f"NOTEARS stopped at max_iterations={self.max_iterations} before tolerance={self.tolerance:g}", stacklevel=4
            )
        return solution.weights.T

    def _among(self, target_moments: np.ndarray, gram: np.ndarray, cross: np.ndarray) -> np.ndarray:
        """Weights among the targets, from the second moments of what the inputs leave of them, shape (m, m)."""
        left = target_moments - cross.T @ least_squares_gram(gram, cross)
        return without_cycles(notears((left + left.T) / 2.0, self.sparsity), self.edge_threshold)


class _Standardised:
    """Second moments in the units in which the problem is solved: all with deviation 1, or the variables' own."""

    def __init__(self, moments: StreamingMoments, standardize: bool) -> None:
        self.moments = moments
        self.moving = ~moments.constant
        self.correlation = moments.correlation()
        self.deviation = np.where(self.moving, moments.standard_deviation(), 1.0)
        self.scale = np.ones_like(self.deviation) if standardize else self.deviation

    def second_moments(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        return self.correlation[np.ix_(rows, columns)] * np.outer(self.scale[rows], self.scale[columns])

    def to_standardised(self, targets: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        """Factors that bring weights into standardised units, shape (m, p)."""
        return np.outer(1.0 / self.scale[targets], self.scale[inputs])

    def r_squared(self, inputs: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """
        :param weights: In standardised units, shape (m, p)
        :return: 1 - residual variance / variance, shape (m,)
        """
        twice_cross = 2.0 * self.correlation[np.ix_(targets, inputs)] - weights @ self.correlation[np.ix_(inputs, inputs)]
        return np.clip((weights * twice_cross).sum(axis=1), 0.0, 1.0)

    def jackknife(self, inputs: np.ndarray, targets: np.ndarray, weights: np.ndarray) -> np.ndarray | None:
        """
        :param weights: Solution in the problem's units, shape (m, p)
        :return: standard errors of the weights, shape (m, p); None when there are not two blocks
        """
        parts = self.moments.leave_one_out()
        if not parts:
            return None
        inverse_scale = self.scale / self.deviation
        columns = np.concatenate([inputs, targets])
        residual_of = np.hstack([weights, -np.eye(len(targets))])
        everything = self.second_moments(columns, columns)
        gram = everything[: len(inputs), : len(inputs)]
        gradients = np.empty((len(parts), *weights.shape))
        units = np.empty_like(gradients)
        for gradient, unit, (rest, _) in zip(gradients, units, parts, strict=True):
            factor = inverse_scale[columns]
            covariance = rest.covariance()[np.ix_(columns, columns)] * np.outer(factor, factor)
            gradient[:] = residual_of @ (covariance - everything)[:, : len(inputs)]
            # A standard deviation, the unit of an effect, is an estimate as well
            deviation = np.sqrt(np.diagonal(covariance) / np.diagonal(everything))
            unit[:] = deviation[: len(inputs)] / np.maximum(deviation[len(inputs) :, None], np.finfo(np.float64).tiny)
        changes = np.zeros_like(gradients)
        for target, row in enumerate(weights):
            support, closed = np.flatnonzero(row), np.flatnonzero(row == 0.0)
            slopes = gradients[:, target].T
            changes[:, target, closed] = -(slopes[closed] / np.diagonal(gram)[closed, None]).T
            if len(support):
                changes[:, target, support] = -least_squares_gram(gram[np.ix_(support, support)], slopes[support]).T
        return jackknife_error(weights, list((weights + changes) * units), [share for _, share in parts])
