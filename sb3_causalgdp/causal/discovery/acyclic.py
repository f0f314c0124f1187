"""Linear acyclic graphs among variables of one time: NOTEARS proper."""

import numpy as np
import torch as th

LARGEST_PENALTY = 1e12
SMALLEST_STEP = 1e-30
LARGEST_ACYCLICITY = 1e100  # its square times the penalty stays inside float64


def acyclicity(weights: np.ndarray) -> tuple[float, np.ndarray]:
    """
    ``h(W) = tr(exp(W * W)) - n``, which is 0 for acyclic graphs alone (Zheng et al., 2018, eq. 8), and its gradient; infinity
    and zeros where the exponential overflows.

    :param weights: Shape (n, n)
    :return: h, at least 0, and dh / dW, shape (n, n)
    """
    exponential = th.matrix_exp(th.as_tensor(weights**2)).numpy()
    h = float(np.trace(exponential)) - len(weights)
    # Large weights overflow: a solver then has to take a smaller step
    return (h, 2.0 * weights * exponential.T) if np.isfinite(exponential).all() else (np.inf, np.zeros_like(weights))


def is_acyclic(edges: np.ndarray) -> bool:
    """
    :param edges: Which edges there are, boolean, shape (n, n)
    :return: whether no path leads back to its start
    """
    left = edges.copy()
    while left.any():
        # Whatever has no parents, or no children, is in no cycle
        inside = np.logical_and(left.any(axis=0), left.any(axis=1))
        pruned = left & np.outer(inside, inside)
        if np.array_equal(pruned, left):
            return False
        left = pruned
    return True


def without_cycles(weights: np.ndarray, threshold: float) -> np.ndarray:
    """
    Drop weak edges: those below the threshold, and then the weakest until no cycle is left.

    :param weights: Shape (n, n)
    :param threshold: Smallest \\|w\\| that is kept, at least 0
    :return: a copy without cycles, shape (n, n)
    """
    kept = np.where(np.abs(weights) < threshold, 0.0, weights)
    for weakest in np.unique(np.abs(kept[kept != 0.0])):
        if is_acyclic(kept != 0.0):
            break
        kept[np.abs(kept) <= weakest] = 0.0
    return kept


def notears(
    second_moments: np.ndarray,
    sparsity: float,
    acyclicity_tolerance: float = 1e-6,
    max_iterations: int = 300,
    tolerance: float = 1e-5,
) -> np.ndarray:
    """
    Minimise ``1/2 tr((I - W) S (I - W)^T) + sparsity ||W||_1`` under ``h(W) = 0`` (Zheng et al., 2018,
    https://arxiv.org/abs/1803.01422), by the augmented Lagrangian with proximal gradient steps.

    One iteration costs a matrix exponential of size n. The problem is not convex: this is a stationary point.

    :param second_moments: S, shape (n, n), positive semi-definite
    :param sparsity: Weight of the L1 norm, not negative
    :param acyclicity_tolerance: Largest h of the solution
    :param max_iterations: Upper limit of the gradient steps for one multiplier
    :param tolerance: A multiplier's problem is solved when no weight moves by more
    :return: W with a row for each effect and a zero diagonal, shape (n, n); almost acyclic, see :func:`without_cycles`
    """
    weights = np.zeros_like(second_moments)
    multiplier, penalty, violation = 0.0, 1.0, np.inf
    while violation > acyclicity_tolerance and penalty < LARGEST_PENALTY:
        found = _solve_lagrangian(second_moments, sparsity, multiplier, penalty, weights, max_iterations, tolerance)
        found_violation = acyclicity(found)[0]
        if found_violation > 0.25 * violation:
            penalty *= 10.0
        else:
            multiplier += penalty * found_violation
        weights, violation = found, min(violation, found_violation)
    return weights


def _solve_lagrangian(
    second_moments: np.ndarray,
    sparsity: float,
    multiplier: float,
    penalty: float,
    weights: np.ndarray,
    max_iterations: int,
    tolerance: float,
) -> np.ndarray:
    """Proximal gradient descent with momentum, backtracking, and a restart whenever the objective rises."""
    identity = np.eye(len(weights))

    def smooth(point: np.ndarray) -> tuple[float, np.ndarray]:
        residual = identity - point
        product = residual @ second_moments
        h, h_gradient = acyclicity(point)
        if not h < LARGEST_ACYCLICITY:
            return np.inf, h_gradient
        value = 0.5 * float((product * residual).sum()) + multiplier * h + 0.5 * penalty * h**2
        return value, -product + (multiplier + penalty * h) * h_gradient

    step = 1.0 / max(np.linalg.eigvalsh(second_moments)[-1], np.finfo(np.float64).tiny)
    ahead, momentum, objective = weights, 1.0, np.inf
    for _ in range(max_iterations):
        value, gradient = smooth(ahead)
        if value == np.inf:
            ahead, momentum = weights, 1.0
            value, gradient = smooth(ahead)
        while True:
            target = ahead - step * gradient
            new = target - np.clip(target, -step * sparsity, step * sparsity)
            np.fill_diagonal(new, 0.0)
            change = new - ahead
            new_value = smooth(new)[0]
            bound = value + float((gradient * change).sum()) + 0.5 / step * float((change**2).sum())
            if new_value <= bound + 1e-12 * abs(value):
                break
            if step < SMALLEST_STEP:
                return weights
            step *= 0.5
        new_objective = new_value + sparsity * float(np.abs(new).sum())
        if new_objective > objective:
            ahead, momentum, objective = weights, 1.0, np.inf
            continue
        moved = float(np.abs(new - weights).max())
        next_momentum = (1.0 + np.sqrt(1.0 + 4.0 * momentum**2)) / 2.0
        ahead = new + (momentum - 1.0) / next_momentum * (new - weights)
        weights, momentum, objective = new, next_momentum, new_objective
        step *= 1.1
        if moved <= tolerance:
            break
    return weights
