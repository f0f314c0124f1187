"""The Lasso on second moments, for many targets at once."""

from typing import NamedTuple

import numpy as np
import torch as th

TARGETS_AT_ONCE = 128  # so that the systems on the supports stay small in memory
CHECK_EVERY = 20
OVER_RELAXATION = 1.7
PENALTY = 0.3  # of the mean diagonal: with strongly correlated inputs, both larger and smaller ones take more iterations
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

    ADMM with over-relaxation and balanced residuals (Boyd et al., 2011, "Distributed optimization and statistical learning via
    the alternating direction method of multipliers", 3.4 and 6.4), which one factorisation of G serves for all targets; a
    target whose signs have settled is solved exactly on its support. Stops when the KKT residual (the largest violation of the
    optimality conditions) is at most ``tolerance`` times the target's largest \\|c\\|. Without sparsity there is a closed
    form.

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
    spectrum = tuple(part.numpy() for part in th.linalg.eigh(th.as_tensor(gram)))
    iterations, converged = 0, True
    for first in range(0, cross.shape[1], TARGETS_AT_ONCE):
        chunk = slice(first, first + TARGETS_AT_ONCE)
        problem = _Problem(gram, np.ascontiguousarray(cross[:, chunk]), sparsity, limit[chunk])
        solution = _admm(problem, weights[:, chunk], spectrum, max_iterations)
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


def _admm(
    problem: _Problem, initial: np.ndarray, spectrum: tuple[np.ndarray, np.ndarray], max_iterations: int
) -> LassoSolution:
    """Solved targets leave; the others start where they were with a new penalty."""
    weights = initial.copy()
    columns = np.arange(weights.shape[1])
    current, dual = weights.copy(), problem.cross - problem.gram @ weights
    np.clip(dual, -problem.sparsity, problem.sparsity, out=dual)
    penalty = PENALTY * max(float(spectrum[0].mean()), np.finfo(np.float64).tiny)
    signs_then = np.sign(weights)
    iteration = 0
    while True:
        product = problem.gram @ current
        open_ = ~problem.solved(current, product)
        signs = np.sign(current)
        settled = np.flatnonzero(open_ & (signs == signs_then).all(axis=0))
        exact, is_solved = _solve_on_support(problem.of_targets(settled), current[:, settled])
        current[:, settled[is_solved]] = exact[:, is_solved]
        open_[settled[is_solved]] = False
        weights[:, columns] = current
        columns, problem, signs_then = columns[open_], problem.of_targets(open_), signs[:, open_]
        if len(columns) == 0 or iteration >= max_iterations:
            return LassoSolution(weights, iteration, len(columns) == 0)
        n_steps = min(CHECK_EVERY, max_iterations - iteration)
        current, dual, ratio = _admm_steps(problem, current[:, open_], dual[:, open_], spectrum, penalty, n_steps)
        iteration += n_steps
        penalty *= float(np.clip(np.sqrt(ratio), 0.5, 2.0))


def _admm_steps(
    problem: _Problem,
    current: np.ndarray,
    dual: np.ndarray,
    spectrum: tuple[np.ndarray, np.ndarray],
    penalty: float,
    n_steps: int,
) -> tuple[np.ndarray, np.ndarray, float]:
    """
    :param current: Sparse weights, shape (p, m)
    :param dual: What the L1 norm pulls with, within +-sparsity, shape (p, m)
    :return: both after some steps, and the primal residual relative to the dual one
    """
    values, vectors = spectrum
    inverse = (vectors / (values.clip(min=0.0) + penalty)) @ vectors.T
    threshold = problem.sparsity / penalty
    for _ in range(n_steps):
        smooth = inverse @ (problem.cross - dual + penalty * current)
        shifted = OVER_RELAXATION * smooth + (1.0 - OVER_RELAXATION) * current + dual / penalty
        before, clipped = current, np.clip(shifted, -threshold, threshold)
        current, dual = shifted - clipped, penalty * clipped
    primal, change = np.linalg.norm(smooth - current), penalty * np.linalg.norm(current - before)
    scales = max(np.linalg.norm(smooth), np.linalg.norm(current)), np.linalg.norm(dual)
    tiny = np.finfo(np.float64).tiny
    return current, dual, float((primal / max(scales[0], tiny) + tiny) / (change / max(scales[1], tiny) + tiny))


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
