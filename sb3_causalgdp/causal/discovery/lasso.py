"""The Lasso on second moments, for many targets at once."""

from typing import NamedTuple

import numpy as np
import torch as th

TARGETS_AT_ONCE = 32  # so that the work of one iteration stays in the processor's cache
CHECK_EVERY = 10
RIDGE = 1e-12  # of the mean diagonal: rounding of float64 times a thousand


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
    Minimise ``1/2 w^T G w - c^T w + sparsity ||w||_1`` for m targets.

    FISTA (Beck and Teboulle, 2009) with the gradient restart of O'Donoghue and Candes (2015), each target with momentum of its
    own; a target whose signs have settled is solved exactly on its support. Stops when the KKT residual (the largest violation
    of the optimality conditions) is at most ``tolerance`` times the target's largest \\|c\\|. Without sparsity there is a
    closed form.

    :param gram: G, second moments of the inputs, shape (p, p), positive semi-definite
    :param cross: c, cross moments of inputs and targets, shape (p, m)
    :param sparsity: Weight of the L1 norm, not negative
    :param initial: Start, shape (p, m); zeros by default
    :param max_iterations: Upper limit of the iterations
    :param tolerance: Largest relative KKT residual
    :return: the solution; one that did not converge is returned as it is
    """
    limit = tolerance * np.abs(cross).max(axis=0)
    if sparsity == 0.0:
        weights = least_squares_gram(gram, cross)
        return LassoSolution(weights, 0, bool((np.abs(gram @ weights - cross).max(axis=0) <= limit).all()))
    weights = np.zeros_like(cross) if initial is None else np.array(initial, dtype=np.float64)
    curvature = np.linalg.eigvalsh(gram)[-1]
    step = 1.0 / curvature if curvature > 0.0 else 0.0
    iterations, converged = 0, True
    for first in range(0, cross.shape[1], TARGETS_AT_ONCE):
        chunk = slice(first, first + TARGETS_AT_ONCE)
        problem = _Problem(gram, np.ascontiguousarray(cross[:, chunk]), sparsity, limit[chunk])
        solution = _fista(problem, weights[:, chunk], step, max_iterations)
        weights[:, chunk] = solution.weights
        iterations, converged = max(iterations, solution.iterations), converged and solution.converged
    return LassoSolution(weights, iterations, converged)


def least_squares_gram(gram: np.ndarray, cross: np.ndarray) -> np.ndarray:
    """
    Solve ``G w = c`` by one Cholesky factorisation, with a ridge that two steps of refinement take out again.

    :param gram: G, shape (p, p), positive semi-definite
    :param cross: c, shape (p, m)
    :return: w, shape (p, m); of linearly dependent inputs, a solution of about the smallest norm
    """
    ridge = 1e3 * RIDGE * max(float(np.trace(gram)), np.finfo(np.float64).tiny) / len(gram)
    factor = th.linalg.cholesky(th.as_tensor(gram + np.diag(np.full(len(gram), ridge))))
    weights = th.cholesky_solve(th.as_tensor(cross), factor).numpy()
    for _ in range(2):
        weights += th.cholesky_solve(th.as_tensor(cross - gram @ weights), factor).numpy()
    return weights


class _Problem(NamedTuple):
    gram: np.ndarray
    cross: np.ndarray
    sparsity: float
    limit: np.ndarray  # largest KKT residual of each target

    def violation(self, weights: np.ndarray, product: np.ndarray) -> np.ndarray:
        """How much each weight violates the optimality conditions, shape (p, m)."""
        gradient = product - self.cross
        at_zero = np.maximum(np.abs(gradient) - self.sparsity, 0.0)
        return np.where(weights == 0.0, at_zero, np.abs(gradient + self.sparsity * np.sign(weights)))

    def solved(self, weights: np.ndarray, product: np.ndarray) -> np.ndarray:
        """Which targets meet the tolerance, shape (m,)."""
        return self.violation(weights, product).max(axis=0) <= self.limit

    def of_targets(self, chosen: np.ndarray) -> "_Problem":
        return self._replace(cross=self.cross[:, chosen], limit=self.limit[chosen])


def _fista(problem: _Problem, initial: np.ndarray, step: float, max_iterations: int) -> LassoSolution:
    """Products with G are carried along, so an iteration costs one of them, and solved targets leave."""
    weights = initial.copy()
    columns = np.arange(weights.shape[1])
    gram = problem.gram
    current, product = weights.copy(), gram @ weights
    ahead, ahead_product = current, product
    momentum = np.ones(len(columns))
    signs_then = np.sign(weights)
    iteration = 0
    while True:
        if iteration % CHECK_EVERY == 0:
            open_ = ~problem.solved(current, product)
            signs = np.sign(current)
            settled = np.flatnonzero(open_ & (signs == signs_then).all(axis=0))
            exact, is_solved = _solve_on_support(problem.of_targets(settled), current[:, settled])
            current[:, settled[is_solved]] = exact[:, is_solved]
            open_[settled[is_solved]] = False
            weights[:, columns] = current
            columns, problem, momentum, signs_then = (
                columns[open_],
                problem.of_targets(open_),
                momentum[open_],
                signs[:, open_],
            )
            current, product = current[:, open_], product[:, open_]
            ahead, ahead_product = ahead[:, open_], ahead_product[:, open_]
        if len(columns) == 0 or iteration >= max_iterations:
            break
        iteration += 1
        downhill = ahead - step * (ahead_product - problem.cross)
        new = downhill - np.clip(downhill, -step * problem.sparsity, step * problem.sparsity)
        new_product = gram @ new
        change = new - current
        uphill = np.einsum("ij,ij->j", ahead - new, change) > 0.0
        next_momentum = np.where(uphill, 1.0, (1.0 + np.sqrt(1.0 + 4.0 * momentum**2)) / 2.0)
        inertia = np.where(uphill, 0.0, (momentum - 1.0) / next_momentum)
        ahead = new + inertia * change
        ahead_product = new_product + inertia * (new_product - product)
        current, product, momentum = new, new_product, next_momentum
    weights[:, columns] = current
    return LassoSolution(weights, iteration, len(columns) == 0)


def _solve_on_support(problem: _Problem, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    The minimum with the weights' own signs.

    :return: weights of shape (p, m), and which columns are solved by it
    """
    support = weights != 0.0
    size = int(support.sum(axis=0).max(initial=0))
    if size == 0:
        return weights, np.zeros(weights.shape[1], dtype=bool)
    # Systems of one size: the support's inputs first, then others that are decoupled and get 0
    inputs = np.argsort(~support, axis=0, kind="stable")[:size].T
    targets = np.arange(weights.shape[1])[:, None]
    used = support[inputs, targets]
    systems = problem.gram[inputs[:, :, None], inputs[:, None, :]] * (used[:, :, None] & used[:, None, :])
    diagonal = np.arange(size)
    systems[:, diagonal, diagonal] += np.where(used, RIDGE * np.trace(problem.gram) / len(problem.gram), 1.0)
    sides = np.where(used, problem.cross[inputs, targets] - problem.sparsity * np.sign(weights[inputs, targets]), 0.0)
    exact = np.zeros_like(weights)
    exact[inputs, targets] = np.linalg.solve(systems, sides[:, :, None])[:, :, 0]
    return exact, problem.solved(exact, problem.gram @ exact)
