import warnings
from datetime import datetime, timezone
from typing import NamedTuple

import numpy as np

from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.moments import StreamingMoments
from sb3_causalgdp.causal.variables import TransitionVariables


class LassoSolution(NamedTuple):
    """Weights of shape (p, m), iterations done, and whether every column's KKT residual met the tolerance."""

    weights: np.ndarray
    iterations: int
    converged: bool


def solve_lasso_gram(
    gram: np.ndarray,
    cross: np.ndarray,
    sparsity: float,
    initial: np.ndarray | None = None,
    max_iterations: int = 20_000,
    tolerance: float = 1e-5,
) -> LassoSolution:
    """
    Minimise ``1/2 w^T G w - c^T w + sparsity ||w||_1`` for m targets at once, each with momentum of its own.

    FISTA (Beck and Teboulle, 2009) with the gradient restart of O'Donoghue and Candes (2015). Stops when the KKT residual
    (the largest violation of the optimality conditions) is at most ``tolerance`` times the target's largest \\|c\\|.

    :param gram: G, second moments of the inputs, shape (p, p), positive semi-definite
    :param cross: c, cross moments of inputs and targets, shape (p, m)
    :param sparsity: Weight of the L1 norm, not negative
    :param initial: Start, shape (p, m); zeros by default
    :param max_iterations: Upper limit of the iterations
    :param tolerance: Largest relative KKT residual
    :return: the solution; one that did not converge is returned as it is
    """
    weights = np.zeros_like(cross) if initial is None else np.array(initial, dtype=np.float64)
    curvature = np.linalg.eigvalsh(gram)[-1]
    step = 1.0 / curvature if curvature > 0 else 0.0
    limit = tolerance * np.abs(cross).max(axis=0)

    # Work on the columns that are still open; products with G are carried along, so an iteration costs one of them
    columns = np.arange(cross.shape[1])
    current, current_product = weights, gram @ weights
    ahead, ahead_product = current, current_product
    momentum = np.ones(len(columns))
    iteration = 0
    while True:
        still_open = _kkt_residual(current, current_product - cross[:, columns], sparsity) > limit[columns]
        if not still_open.all():
            weights[:, columns] = current
            columns, momentum = columns[still_open], momentum[still_open]
            current, current_product = current[:, still_open], current_product[:, still_open]
            ahead, ahead_product = ahead[:, still_open], ahead_product[:, still_open]
        if len(columns) == 0 or iteration >= max_iterations:
            break
        iteration += 1
        new = _soft_threshold(ahead - step * (ahead_product - cross[:, columns]), step * sparsity)
        new_product = gram @ new
        uphill = ((ahead - new) * (new - current)).sum(axis=0) > 0
        next_momentum = np.where(uphill, 1.0, (1.0 + np.sqrt(1.0 + 4.0 * momentum**2)) / 2.0)
        inertia = np.where(uphill, 0.0, (momentum - 1.0) / next_momentum)
        ahead = new + inertia * (new - current)
        ahead_product = new_product + inertia * (new_product - current_product)
        current, current_product, momentum = new, new_product, next_momentum
    weights[:, columns] = current
    return LassoSolution(weights, iteration, len(columns) == 0)


def _soft_threshold(values: np.ndarray, threshold: float) -> np.ndarray:
    return np.sign(values) * np.maximum(np.abs(values) - threshold, 0.0)


def _kkt_residual(weights: np.ndarray, gradient: np.ndarray, sparsity: float) -> np.ndarray:
    """Largest violation of the optimality conditions per column, shape (m,)."""
    violation = np.where(
        weights == 0, np.maximum(np.abs(gradient) - sparsity, 0.0), np.abs(gradient + sparsity * np.sign(weights))
    )
    return violation.max(axis=0)


class Notears:
    """
    NOTEARS (Zheng et al., 2018, https://arxiv.org/abs/1803.01422) on the edges that time allows:
    (s_t, a_t) -> s_{t+1} and (s_{t+1}, a_t) -> r_t.

    Minimises ``1/2 tr((I - W)^T S (I - W)) + sparsity ||W||_1`` with S the second moments. Every graph of these edges is
    acyclic, so NOTEARS' constraint h(W) = 0 holds identically and the problem is convex: one Lasso per target.

    A weight w (in standardised units) becomes a mask by one map: 0 where \\|w\\| < ``edge_threshold``, otherwise
    ``w^2 / (w^2 + mask_scale^2)``, which is half at \\|w\\| = ``mask_scale`` and, by default, 0.90 at 0.15 and 0.99 at 0.5.

    :param sparsity: Weight of the L1 norm, not negative; in units of a correlation when ``standardize``
    :param edge_threshold: Smallest \\|w\\| of an open edge, not negative
    :param mask_scale: The \\|w\\| at which a mask is one half, positive
    :param max_iterations: Upper limit of the solver's iterations
    :param tolerance: Largest KKT residual, relative to the target's largest second moment with an input
    :param standardize: Solve on the correlation matrix. False solves on the covariance, as the original does, where the
        variables' units decide what is sparse (Reisach et al., 2021, https://arxiv.org/abs/2102.13647)
    """

    def __init__(
        self,
        sparsity: float = 0.01,
        edge_threshold: float = 0.02,
        mask_scale: float = 0.05,
        max_iterations: int = 20_000,
        tolerance: float = 1e-5,
        standardize: bool = True,
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
        start = np.zeros((n_states + 1, n_inputs)) if previous is None else previous.weights
        weights = np.concatenate(
            [
                self._weights(moments, inputs=now, targets=after[:n_states], initial=start[:-1]),
                self._weights(moments, inputs=after, targets=np.array([variables.reward]), initial=start[-1:]),
            ]
        )
        return CausalGraph.from_matrices(
            variables,
            self.mask(weights),
            weights,
            method="notears",
            n_samples=moments.n_samples,
            found_at=datetime.now(timezone.utc).isoformat(timespec="seconds"),
            constant_variables=tuple(np.array(variables.names)[moments.constant].tolist()),
        )

    def mask(self, weights: np.ndarray) -> np.ndarray:
        """
        :param weights: Weights in standardised units, any shape
        :return: masks in [0, 1), the same shape
        """
        squares = weights**2
        return np.where(np.abs(weights) < self.edge_threshold, 0.0, squares / (squares + self.mask_scale**2))

    def _check(self, moments: StreamingMoments, variables: TransitionVariables, previous: CausalGraph | None) -> None:
        if moments.n_variables != variables.n_variables:
            raise ValueError(f"moments must hold {variables.n_variables} variables, got {moments.n_variables}")
        needed = variables.n_states + variables.n_actions + 2
        if moments.n_samples < needed:
            raise ValueError(f"moments must hold at least {needed} rows (states + actions + 2), got {moments.n_samples}")
        if previous is not None and previous.variables != variables:
            raise ValueError(f"previous must be over {variables.names}, got {previous.variables.names}")

    def _weights(self, moments: StreamingMoments, inputs: np.ndarray, targets: np.ndarray, initial: np.ndarray) -> np.ndarray:
        """
        :param inputs: Columns of the p possible causes
        :param targets: Columns of the m effects
        :param initial: Start in standardised units, shape (m, p)
        :return: weights in standardised units, shape (m, p)
        """
        moving = ~moments.constant
        deviation = np.where(moving, moments.standard_deviation(), 1.0)
        scale = np.ones_like(deviation) if self.standardize else deviation
        second_moments = moments.correlation() * np.outer(scale, scale)
        to_standardised = np.outer(1.0 / scale[targets], scale[inputs])
        allowed = np.outer(moving[targets], moving[inputs])
        solution = solve_lasso_gram(
            second_moments[np.ix_(inputs, inputs)],
            second_moments[np.ix_(inputs, targets)],
            self.sparsity,
            (initial * allowed / to_standardised).T,
            self.max_iterations,
            self.tolerance,
        )
        if not solution.converged:
            warnings.warn(
                f"NOTEARS stopped at max_iterations={self.max_iterations} before tolerance={self.tolerance:g}", stacklevel=3
            )
        return solution.weights.T * to_standardised
