"""What no data can tell apart: variables that never move, and variables that are linear functions of each other."""

from dataclasses import dataclass

import numpy as np

DEPENDENT_SHARE = 1e-8  # of a variable's variance left by the others; rounding of float32 leaves 1e-14
SMALLEST_COEFFICIENT = 1e-3


@dataclass(frozen=True)
class Degeneracy:
    """
    :param kept: Indices of linearly independent variables that span all that move
    :param groups: Groups of indices, each of at least two variables that are linearly dependent, the kept ones first
    :param stand_in: For each variable outside ``kept`` that moves, the kept one that says most about it, and the sign
    """

    kept: np.ndarray
    groups: tuple[tuple[int, ...], ...]
    stand_in: dict[int, tuple[int, float]]

    def share(self, masks: np.ndarray) -> np.ndarray:
        """
        Give all members of a group the largest mask in it.

        :param masks: A column for each variable, shape (m, p)
        :return: a copy, shape (m, p)
        """
        shared = masks.copy()
        for group in self.groups:
            shared[:, group] = masks[:, group].max(axis=1, keepdims=True)
        return shared

    def names_of_groups(self, names: tuple[str, ...]) -> tuple[tuple[str, ...], ...]:
        """
        :param names: Names of the p variables
        :return: the groups by name, in the order of the variables
        """
        return tuple(tuple(names[i] for i in sorted(group)) for group in self.groups)


def find_degeneracy(correlation: np.ndarray) -> Degeneracy:
    """
    Find linear dependence by Cholesky factorisation with pivoting (Higham, 2002, "Accuracy and Stability of Numerical
    Algorithms", 10.3): a variable is dependent when the pivots leave less than 1e-8 of its variance.

    :param correlation: Correlation matrix, its diagonal 0 for variables that do not move, shape (p, p); never changed
    :return: what is independent and what hangs together
    """
    left = np.diagonal(correlation).copy()
    factor = np.zeros_like(correlation)
    pivots: list[int] = []
    while len(pivots) < len(correlation):
        pivot = int(left.argmax())
        if left[pivot] <= DEPENDENT_SHARE:
            break
        n_done = len(pivots)
        column = (correlation[pivot] - factor[:n_done, pivot] @ factor[:n_done]) / np.sqrt(left[pivot])
        factor[n_done] = column
        left -= column**2
        pivots.append(pivot)
        left[pivots] = 0.0
    kept = np.sort(np.array(pivots, dtype=int))
    dependent = np.setdiff1d(np.flatnonzero(np.diagonal(correlation) > 0.0), kept)
    if len(dependent) == 0:
        return Degeneracy(kept, (), {})
    coefficients = np.linalg.solve(correlation[np.ix_(kept, kept)], correlation[np.ix_(kept, dependent)])
    strongest = np.abs(coefficients).argmax(axis=0)
    stand_in = {
        int(variable): (int(kept[row]), float(np.sign(coefficients[row, j])))
        for j, (variable, row) in enumerate(zip(dependent, strongest, strict=True))
    }
    members = [{int(v), *kept[np.abs(coefficients[:, j]) > SMALLEST_COEFFICIENT].tolist()} for j, v in enumerate(dependent)]
    return Degeneracy(kept, _merged_groups(members, set(dependent.tolist())), stand_in)


def _merged_groups(members: list[set[int]], dependent: set[int]) -> tuple[tuple[int, ...], ...]:
    """Sets that share a variable become one; within a group the kept variables come first."""
    groups: list[set[int]] = []
    for new in members:
        joined = new.union(*(group for group in groups if group & new))
        groups = [group for group in groups if not group & new] + [joined]
    return tuple(tuple(sorted(group, key=lambda i: (i in dependent, i))) for group in groups)


def variance_inflation(correlation: np.ndarray) -> np.ndarray:
    """
    Variance inflation factor of each variable, ``1 / (1 - R^2)`` of its regression on the others.

    :param correlation: Correlation matrix, its diagonal 0 for variables that do not move, shape (p, p)
    :return: at least 1 and at most 1e8, which stands for exact dependence; 1 for variables that do not move; shape (p,)
    """
    moving = np.diagonal(correlation) > 0.0
    ridge = np.where(moving, DEPENDENT_SHARE, 1.0)
    precision = np.diagonal(np.linalg.inv(correlation + np.diag(ridge)))
    return np.where(moving, np.clip(precision, 1.0, 1.0 / DEPENDENT_SHARE), 1.0)
