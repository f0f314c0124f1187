"""What no data can tell apart: variables that never move, and variables that are linear functions of each other."""

import warnings
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular

from sb3_causalgdp.causal.statistics.matrices import cholesky_in_place
from sb3_causalgdp.causal.variables import TransitionVariables

DEPENDENT_SHARE = 1e-8  # of a variable's variance left by the others; rounding of float32 leaves 1e-14
SUSPICIOUS_SHARE = 1e-2  # of a variable's variance left by those before it: of more, it is independent of these
RIDGE = 1e-8  # takes the factorisation past dependent variables
SMALLEST_COEFFICIENT = 1e-3
CONFOUNDED_VIF = 40.0


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


def find_degeneracy(correlation: np.ndarray) -> Degeneracy:
    """
    Find linear dependence by Cholesky factorisation with pivoting (Higham, 2002, "Accuracy and Stability of Numerical
    Algorithms", 10.3): a variable is dependent when the pivots leave less than 1e-8 of its variance. Variables that are
    clearly independent of those before them come first, without pivoting.

    :param correlation: Correlation matrix, its diagonal 0 for variables that do not move, shape (p, p); never changed
    :return: what is independent and what hangs together
    """
    return _degeneracy(correlation, _factor(correlation))


def variance_inflation(correlation: np.ndarray, n_last: int) -> np.ndarray:
    """
    Variance inflation factors ``1 / (1 - R^2)`` of the last variables, each regressed on all others.

    :param correlation: Correlation matrix, its diagonal 0 for variables that do not move, shape (p, p); never changed
    :param n_last: Number k of the last variables, at most p
    :return: at least 1 and at most 1e8, which stands for exact dependence; 1 for variables that do not move; shape (k,)
    """
    return _inflation(_factor(correlation), n_last)


def _factor(correlation: np.ndarray) -> np.ndarray:
    """Lower Cholesky factor without pivoting, shape (p, p); its squared diagonal is what the variables before one leave."""
    matrix = correlation.copy()
    diagonal = np.einsum("ii->i", matrix)
    diagonal[diagonal == 0.0] = 1.0
    diagonal += RIDGE
    return cholesky_in_place(matrix)


def _degeneracy(correlation: np.ndarray, factor: np.ndarray) -> Degeneracy:
    moving = np.flatnonzero(np.diagonal(correlation) > 0.0)
    left = factor.diagonal()[moving] ** 2
    sure, others = moving[left > SUSPICIOUS_SHARE], moving[left <= SUSPICIOUS_SHARE]
    if len(others) == 0:
        return Degeneracy(moving, (), {})
    of_others = correlation[others]
    of_sure = cholesky_in_place(correlation[sure][:, sure])
    explained = solve_triangular(of_sure, of_others[:, sure].T, lower=True)
    pivots, factor = _pivots(of_others[:, others] - explained.T @ explained)
    kept, rest = np.concatenate([sure, others[pivots]]), np.setdiff1d(np.arange(len(others)), pivots)
    if len(rest) == 0:
        return Degeneracy(np.sort(kept), (), {})
    # What the kept ones say about each dependent one: back through both factors
    of_pivots = solve_triangular(factor[:, pivots], factor[:, rest])
    of_rest = solve_triangular(of_sure, explained[:, rest] - explained[:, pivots] @ of_pivots, lower=True, trans="T")
    stand_in, members = {}, []
    for variable, coefficients in zip(others[rest].tolist(), np.concatenate([of_rest, of_pivots]).T, strict=True):
        sizes = np.abs(coefficients)
        strongest = int(sizes.argmax())
        stand_in[variable] = int(kept[strongest]), float(np.sign(coefficients[strongest]))
        members.append({variable, *kept[sizes > SMALLEST_COEFFICIENT].tolist()})
    return Degeneracy(np.sort(kept), _merged_groups(members, set(stand_in)), stand_in)


def _pivots(remaining: np.ndarray) -> tuple[list[int], np.ndarray]:
    """
    Cholesky factorisation with pivoting.

    :param remaining: Covariance matrix of variables that have had variance 1, shape (q, q)
    :return: indices of k linearly independent variables, each time the one of which most is left; and the factor, shape (k, q)
    """
    left = np.diagonal(remaining).copy()
    factor = np.empty_like(remaining)
    pivots: list[int] = []
    while len(pivots) < len(remaining):
        pivot, row = int(left.argmax()), len(pivots)
        if left[pivot] <= DEPENDENT_SHARE:
            break
        factor[row] = (remaining[pivot] - factor[:row, pivot] @ factor[:row]) / np.sqrt(left[pivot])
        left -= factor[row] ** 2
        left[pivot] = -np.inf
        pivots.append(pivot)
    return pivots, factor[: len(pivots)]


def _inflation(factor: np.ndarray, n_last: int) -> np.ndarray:
    # The last block of the factor is that of what the variables before it leave of the last ones
    last = factor[len(factor) - n_last :, len(factor) - n_last :]
    inverse = solve_triangular(last, np.eye(n_last), lower=True)
    return np.clip((inverse**2).sum(axis=0), 1.0, 1.0 / DEPENDENT_SHARE)


def _merged_groups(members: list[set[int]], dependent: set[int]) -> tuple[tuple[int, ...], ...]:
    """Sets that share a variable become one; within a group the kept variables come first."""
    groups: list[set[int]] = []
    for new in members:
        joined = new.union(*(group for group in groups if group & new))
        groups = [group for group in groups if not group & new] + [joined]
    return tuple(tuple(sorted(group, key=lambda i: (i in dependent, i))) for group in sorted(groups, key=min))


@dataclass(frozen=True)
class Limits:
    """
    What the data of a refresh cannot say, whatever the method.

    :param of_dynamics: Degeneracy among (s, a), the possible causes of s'
    :param of_reward: Degeneracy among (s', a), the possible causes of r
    :param action_vif: Variance inflation factors of the actions among (s, a), shape (d,)
    :param state_vif: The same of the states, shape (n,)
    :param constant_variables: Names of the variables that never moved
    :param duplicated_variables: Groups of names that are linear functions of each other, among (s, a) or among (s', a)
    """

    of_dynamics: Degeneracy
    of_reward: Degeneracy
    action_vif: np.ndarray
    state_vif: np.ndarray
    constant_variables: tuple[str, ...]
    duplicated_variables: tuple[tuple[str, ...], ...]

    def remarks(self) -> dict[str, Any]:
        """
        :return: the fields of a :class:`~sb3_causalgdp.causal.graph.CausalGraph` that say this, and when it was found
        """
        return {
            "action_vif": self.action_vif,
            "state_vif": self.state_vif,
            "constant_variables": self.constant_variables,
            "duplicated_variables": self.duplicated_variables,
            "found_at": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        }


def find_limits(correlation: np.ndarray, variables: TransitionVariables) -> Limits:
    """
    :param correlation: Correlation matrix of all variables, its diagonal 0 for those that do not move; never changed
    :param variables: Names and order of the variables
    :return: what the data cannot say
    """
    causes = variables.causes_of_state, variables.causes_of_reward
    now, after = (correlation[columns][:, columns] for columns in causes)
    factor = _factor(now)
    of_dynamics, of_reward = _degeneracy(now, factor), find_degeneracy(after)
    names = variables.names
    constant = np.flatnonzero(np.diagonal(correlation) == 0.0)
    # A group of states that is one of next states as well is listed once
    known = [set(group) for group in of_dynamics.groups]
    alone = [group for group in of_reward.groups if set(group) not in known]
    listed = [(causes[0], group) for group in of_dynamics.groups] + [(causes[1], group) for group in alone]
    return Limits(
        of_dynamics,
        of_reward,
        action_vif=_inflation(factor, variables.n_actions),
        state_vif=_inflation(factor, len(factor))[: variables.n_states],
        constant_variables=tuple(names[i] for i in constant),
        duplicated_variables=tuple(tuple(names[columns[i]] for i in sorted(group)) for columns, group in listed),
    )


class LimitsFinder:
    """
    Finds what the data cannot say at each refresh of a method, and speaks of it.

    The first time that the states and the other actions almost determine an action (variance inflation over 40), there is a
    warning.

    :param on_degenerate: ``"share"`` leaves it to the masks; ``"raise"`` is an error on constant or linearly dependent causes
    """

    def __init__(self, on_degenerate: str = "share") -> None:
        if on_degenerate not in ("share", "raise"):
            raise ValueError(f"on_degenerate must be 'share' or 'raise', got {on_degenerate!r}")
        self.on_degenerate = on_degenerate
        self._said_confounded = False

    def __call__(self, correlation: np.ndarray, variables: TransitionVariables) -> Limits:
        """
        :param correlation: Correlation matrix of all variables, its diagonal 0 for those that do not move; never changed
        :param variables: Names and order of the variables
        :return: what the data cannot say
        :raises ValueError: on constant or linearly dependent causes if ``on_degenerate="raise"``, naming both
        """
        limits = find_limits(correlation, variables)
        constant = {*variables.state_names, *variables.action_names}.intersection(limits.constant_variables)
        if self.on_degenerate == "raise" and (constant or limits.duplicated_variables):
            dependent = [list(group) for group in limits.duplicated_variables]
            raise ValueError(f"causes cannot be told apart: constant {sorted(constant)}, linearly dependent {dependent}")
        over = np.flatnonzero(limits.action_vif > CONFOUNDED_VIF)
        if len(over) > 0 and not self._said_confounded:
            self._said_confounded = True
            named = ", ".join(f"{variables.action_names[i]} ({limits.action_vif[i]:.3g})" for i in over)
            warnings.warn(
                "The states and the other actions almost determine these actions (variance inflation over "
                f"{CONFOUNDED_VIF:g}): {named}. Their effects cannot be told from the others'; more exploration noise in the "
                "data would help.",
                stacklevel=3,
            )
        return limits
