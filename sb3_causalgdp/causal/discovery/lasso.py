"""The Lasso on second moments, for many targets at once."""

from typing import NamedTuple

import numpy as np
import torch as th

from sb3_causalgdp.causal.statistics.matrices import product

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
    if sparsity == 0.0:
        return LassoSolution(least_squares_gram(gram, cross), 0, True)
    limit = tolerance * np.abs(cross).max(axis=0)
    weights = np.zeros_like(cross) if initial is None else np.array(initial, dtype=np.float64)
    iterations, converged = 0, True
    for first in range(0, cross.shape[1], TARGETS_AT_ONCE):
        chunk = slice(first, first + TARGETS_AT_ONCE)
        problem = _Problem(gram, np.ascontiguousarray(cross[:, chunk]), sparsity, limit[chunk])
        solution = _admm(problem, weights[:, chunk], max_iterations)
        weights[:, chunk] = solution.weights
        iterations, converged = max(iterations, solution.iterations), converged and solution.converged
    return LassoSolution(weights, iterations, converged)


def least_squares_gram(gram: np.ndarray, cross: np.ndarray) -> np.ndarray:
    """
    Solve ``G w = c`` by one Cholesky factorisation; of linearly dependent inputs with a ridge, which two steps of refinement
    take out again.

    :param gram: G, shape (p, p), positive semi-definite
    :param cross: c, shape (p, m)
    :return: w, shape (p, m); of linearly dependent inputs, a solution of about the smallest norm
    """
    matrix, right = th.as_tensor(gram), th.as_tensor(cross)
    ridge = 1e3 * RIDGE * max(float(np.trace(gram)), np.finfo(np.float64).tiny) / len(gram)
    factor, failed = th.linalg.cholesky_ex(matrix)
    if not failed and float(factor.diagonal().min()) ** 2 > ridge:
        return th.cholesky_solve(right, factor).numpy()
    factor = th.linalg.cholesky(matrix + ridge * th.eye(len(gram), dtype=matrix.dtype))
    weights = th.cholesky_solve(right, factor)
    for _ in range(2):
        weights += th.cholesky_solve(right - matrix @ weights, factor)
    return weights.numpy()


class _Problem(NamedTuple):
    gram: np.ndarray
    cross: np.ndarray
    sparsity: float
    limit: np.ndarray  # largest KKT residual of each target

    def violation(self, weights: np.ndarray) -> np.ndarray:
        """How much each weight violates the optimality conditions, shape (p, m)."""
        gradient = product(self.gram, weights) - self.cross
        at_zero = np.maximum(np.abs(gradient) - self.sparsity, 0.0)
        return np.where(weights == 0.0, at_zero, np.abs(gradient + self.sparsity * np.sign(weights)))

    def solved(self, weights: np.ndarray) -> np.ndarray:
        """Which targets meet the tolerance, shape (m,)."""
        return self.violation(weights).max(axis=0) <= self.limit

    def of_targets(self, chosen: np.ndarray) -> "_Problem":
        return self._replace(cross=self.cross[:, chosen], limit=self.limit[chosen])


def _admm(problem: _Problem, initial: np.ndarray, max_iterations: int) -> LassoSolution:
    """Solved targets leave; the others start where they were with a new penalty."""
    weights = initial.copy()
    columns = np.arange(weights.shape[1])
    current, dual = weights.copy(), problem.cross - product(problem.gram, weights)
    np.clip(dual, -problem.sparsity, problem.sparsity, out=dual)
    mean_diagonal = max(float(np.trace(problem.gram)) / len(problem.gram), np.finfo(np.float64).tiny)
    penalty = PENALTY * mean_diagonal
    signs_then = np.sign(weights)
    iteration = 0
    while True:
        open_ = ~problem.solved(current)
        signs = np.sign(current)
        settled = np.flatnonzero(open_ & (signs == signs_then).all(axis=0))
        if len(settled) > 0:
            exact, is_solved = _solve_on_support(problem.of_targets(settled), current[:, settled])
            current[:, settled[is_solved]] = exact[:, is_solved]
            open_[settled[is_solved]] = False
        weights[:, columns] = current
        columns, problem, signs_then = columns[open_], problem.of_targets(open_), signs[:, open_]
        if len(columns) == 0 or iteration >= max_iterations:
            return LassoSolution(weights, iteration, len(columns) == 0)
        n_steps = min(CHECK_EVERY, max_iterations - iteration)
        current, dual, ratio = _admm_steps(problem, current[:, open_], dual[:, open_], penalty, n_steps)
        iteration += n_steps
        penalty = max(penalty * min(max(ratio**0.5, 0.5), 2.0), RIDGE * mean_diagonal)


def _admm_steps(
    problem: _Problem, current: np.ndarray, dual: np.ndarray, penalty: float, n_steps: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """
    :param current: Sparse weights, shape (p, m)
    :param dual: What the L1 norm pulls with, within +-sparsity, shape (p, m)
    :return: both after some steps, and the primal residual relative to the dual one
    """
    gram, cross = th.from_numpy(problem.gram), th.from_numpy(np.ascontiguousarray(problem.cross))
    inverse = th.cholesky_inverse(th.linalg.cholesky(gram + penalty * th.eye(len(gram), dtype=gram.dtype)))
    offset, onward = (OVER_RELAXATION * (inverse @ cross)).numpy(), (OVER_RELAXATION * penalty * inverse).numpy()
    threshold, clipped = problem.sparsity / penalty, np.ascontiguousarray(dual) / penalty
    current = np.ascontiguousarray(current)
    for _ in range(n_steps):
        # The smooth part's minimum, G^-1 (c - dual + penalty w) with the penalty in G, over-relaxed
        relaxed = offset + product(onward, current - clipped)
        before, shifted = current, relaxed + (1.0 - OVER_RELAXATION) * current
        shifted += clipped
        clipped = np.maximum(np.minimum(shifted, threshold), -threshold)
        current = shifted - clipped
    smooth = relaxed / OVER_RELAXATION
    primal, change = np.linalg.norm(smooth - current), penalty * np.linalg.norm(current - before)
    scales = max(np.linalg.norm(smooth), np.linalg.norm(current)), penalty * np.linalg.norm(clipped)
    tiny = np.finfo(np.float64).tiny
    ratio = float((primal / max(scales[0], tiny) + tiny) / (change / max(scales[1], tiny) + tiny))
    return current, penalty * clipped, ratio


def _solve_on_support(problem: _Problem, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    The minimum with the weights' own signs.

    :return: weights of shape (p, m), and which columns are solved by it
    """
    support = weights != 0.0
    size = int(support.sum(axis=0).max(initial=0))
    if size == 0:
        return weights, np.zeros(weights.shape[1], dtype=bool)
    inputs, used, systems = _systems_on(problem.gram, support, size)
    targets = np.arange(weights.shape[1])[:, None]
    sides = np.where(used, problem.cross[inputs, targets] - problem.sparsity * np.sign(weights[inputs, targets]), 0.0)
    exact = np.zeros_like(weights)
    exact[inputs, targets] = np.linalg.solve(systems, sides[:, :, None])[:, :, 0]
    return exact, problem.solved(exact)


def _systems_on(gram: np.ndarray, support: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Systems of one size: the support's inputs first, then others that are decoupled.

    :return: inputs and whether they are in the support, each of shape (m, size), and matrices of shape (m, size, size)
    """
    inputs = np.argsort(~support, axis=0, kind="stable")[:size].T
    used = support[inputs, np.arange(support.shape[1])[:, None]]
    systems = gram[inputs[:, :, None], inputs[:, None, :]] * (used[:, :, None] & used[:, None, :])
    diagonal = np.arange(size)
    systems[:, diagonal, diagonal] += np.where(used, RIDGE * np.trace(gram) / len(gram), 1.0)
    return inputs, used, systems


def newton_steps(gram: np.ndarray, support: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """
    Solve ``G x = g`` for each target on its support; beside it, what a weight alone would do.

    :param gram: G, shape (p, p), positive semi-definite
    :param support: Which weights are not zero, boolean, shape (p, m)
    :param slopes: g, k of them for each target, shape (p, m, k)
    :return: x, shape (p, m, k)
    """
    if support.all():
        return least_squares_gram(gram, slopes.reshape(len(gram), -1)).reshape(slopes.shape)
    steps = slopes / np.diagonal(gram)[:, None, None]
    for first in range(0, support.shape[1], TARGETS_AT_ONCE):
        chosen = support[:, first : first + TARGETS_AT_ONCE]
        size = int(chosen.sum(axis=0).max(initial=0))
        if size > 0:
            inputs, used, systems = _systems_on(gram, chosen, size)
            targets = np.arange(first, first + chosen.shape[1])[:, None]
            solved = np.linalg.solve(systems, slopes[inputs, targets] * used[:, :, None])
            steps[inputs, targets] = np.where(used[:, :, None], solved, steps[inputs, targets])
    return steps
