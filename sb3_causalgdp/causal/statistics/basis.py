"""Nonlinear features of transitions, and their streaming moments."""

import copy
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sb3_causalgdp.causal.statistics.moments import StreamingMoments
from sb3_causalgdp.causal.variables import TransitionVariables

BASES = ("auto", "linear", "additive", "products")
N_FUNCTIONS = 4  # each variable as itself, its square, sine and tanh
MOST_INPUTS_WITH_PRODUCTS = 60
FEATURE_BOUND = 5.0  # standard deviations: outliers must not rule the squares and products
FEED_ROWS = 512  # so that the features of a batch need little memory beside the moments


@dataclass
class BasisExpansion:
    """
    Features of p standardised inputs z: ``z`` alone, or ``[z, z^2, sin z, tanh z]``, or these and the products ``z_i z_j``,
    i < j.

    All but the first are functions of z limited to [-5, 5].

    :param location: Means of the inputs, shape (p,)
    :param scale: Standard deviations of the inputs, 1 for inputs that do not move, shape (p,)
    :param basis: ``"linear"``, ``"additive"`` or ``"products"``
    """

    location: np.ndarray
    scale: np.ndarray
    basis: str

    def __post_init__(self) -> None:
        n_inputs = len(self.location)
        self.products = self.basis == "products"
        self.n_functions = 1 if self.basis == "linear" else N_FUNCTIONS
        first, second = np.triu_indices(n_inputs, k=1)
        self._first, self._second = (first, second) if self.products else (first[:0], second[:0])
        self.n_features = number_of_features(n_inputs, self.basis)

    @property
    def squares_and_products(self) -> np.ndarray:
        """Which features are of second order, boolean, shape (n_features,)."""
        n_inputs, feature = len(self.location), np.arange(self.n_features)
        return ((feature >= n_inputs) & (feature < 2 * n_inputs)) | (feature >= self.n_functions * n_inputs)

    def standardise(self, inputs: np.ndarray) -> np.ndarray:
        """
        :param inputs: shape (N, p)
        :return: z, shape (N, p)
        """
        return (inputs - self.location) / self.scale

    def features(self, standardised: np.ndarray) -> np.ndarray:
        """
        :param standardised: z, shape (N, p)
        :return: shape (N, n_features)
        """
        own = self._functions(standardised)
        if not self.products:
            return own
        bounded = _bounded(standardised)
        return np.concatenate([own, bounded[:, self._first] * bounded[:, self._second]], axis=1)

    def differences(self, standardised: np.ndarray, variables: np.ndarray, half_steps: np.ndarray) -> np.ndarray:
        """
        How much larger the features are when a variable is half a step above its value instead of half a step below.

        :param standardised: z, shape (N, p)
        :param variables: Indices of q inputs
        :param half_steps: Of all inputs, in units of z, shape (p,)
        :return: for each variable, of the features in ``features_of``, the others do not change; shape (q, N, g)
        """
        above, below = standardised + half_steps, standardised - half_steps
        own = self._functions(above) - self._functions(below)
        own = own.reshape(len(standardised), self.n_functions, -1).transpose(2, 0, 1)[variables]
        if not self.products:
            return own
        bounded, change = _bounded(standardised), _bounded(above) - _bounded(below)
        shared = np.empty((len(own), len(bounded), bounded.shape[1] - 1))
        for of_variable, i in zip(shared, variables, strict=True):
            np.multiply(change[:, [i]], np.delete(bounded, i, axis=1), out=of_variable)
        return np.concatenate([own, shared], axis=2)

    def features_of(self, variables: np.ndarray) -> np.ndarray:
        """
        :param variables: Indices of q inputs
        :return: for each, the indices of the g features that it is part of: 1 or 4, and p - 1 products, each group in the
            order of the inputs; shape (q, g)
        """
        n_inputs = len(self.location)
        own = np.asarray(variables)[:, None] + n_inputs * np.arange(self.n_functions)
        if not self.products:
            return own
        pairs = np.zeros((n_inputs, n_inputs), dtype=own.dtype)
        pairs[self._first, self._second] = pairs[self._second, self._first] = np.arange(len(self._first))
        others = ~np.eye(n_inputs, dtype=bool)[variables]
        shared = pairs[variables][others].reshape(len(own), n_inputs - 1)
        return np.concatenate([own, self.n_functions * n_inputs + shared], axis=1)

    def subset(self, inputs: np.ndarray, functions: int, products: bool) -> np.ndarray:
        """
        :param inputs: Indices of the inputs that are kept
        :param functions: How many of the functions are kept, from 1 (linear) to 4, if there are as many
        :param products: Whether the products are kept, if there are any
        :return: indices of the features of these inputs alone
        """
        n_inputs = len(self.location)
        own = (np.asarray(inputs) + n_inputs * np.arange(min(functions, self.n_functions))[:, None]).ravel()
        if not products:
            return own
        both = np.flatnonzero(np.isin(self._first, inputs) & np.isin(self._second, inputs))
        return np.concatenate([own, self.n_functions * n_inputs + both])

    def _functions(self, standardised: np.ndarray) -> np.ndarray:
        """The features that are functions of one variable, shape (N, p) or (N, 4 p)."""
        if self.n_functions == 1:
            return standardised
        bounded = _bounded(standardised)
        return np.concatenate([standardised, bounded**2, np.sin(bounded), np.tanh(bounded)], axis=1)


def number_of_features(n_inputs: int, basis: str) -> int:
    """
    :param n_inputs: Number p of inputs
    :param basis: ``"linear"``, ``"additive"`` or ``"products"``
    """
    if basis == "linear":
        return n_inputs
    return N_FUNCTIONS * n_inputs + (n_inputs * (n_inputs - 1) // 2 if basis == "products" else 0)


def bytes_needed(n_states: int, n_inputs: int, basis: str) -> int:
    """
    :param n_states: Number n of states
    :param n_inputs: Number p of states and actions
    :param basis: ``"linear"``, ``"additive"`` or ``"products"``
    :return: bytes of the moments of the features of (s, a) and of (s', a), in two blocks, the fewest
    """
    n_features = number_of_features(n_inputs, basis)
    return 2 * 8 * n_features * (2 * n_features + n_states + 1)


def affordable_basis(n_states: int, n_inputs: int, max_memory: float) -> tuple[str, str]:
    """
    :param n_states: Number n of states
    :param n_inputs: Number p of states and actions
    :param max_memory: Bytes that the moments may take
    :return: the richest features that ``basis="auto"`` may take, ``"linear"`` where none fits; and a remark, empty unless it
        is the memory that decides
    """
    preferred = "products" if n_inputs <= MOST_INPUTS_WITH_PRODUCTS else "additive"
    basis = preferred
    while basis != "linear" and bytes_needed(n_states, n_inputs, basis) > max_memory:
        basis = "additive" if basis == "products" else "linear"
    if basis == preferred:
        return basis, ""
    return basis, f"{_shortage(n_states, n_inputs, preferred, max_memory)}: found with basis={basis!r}"


def _shortage(n_states: int, n_inputs: int, basis: str, max_memory: float) -> str:
    needed = bytes_needed(n_states, n_inputs, basis)
    return (
        f"{number_of_features(n_inputs, basis)} features of {n_inputs} states and actions need {needed / 1e6:.0f} MB, "
        f"and max_memory is {max_memory / 1e6:.0f} MB"
    )


def _bounded(standardised: np.ndarray) -> np.ndarray:
    return np.clip(standardised, -FEATURE_BOUND, FEATURE_BOUND)


class BasisMoments:
    """
    Streaming moments of nonlinear features: of (s, a) together with s', and of (s', a) together with r.

    The first rows fix the standardisation of the inputs. When their location or scale has moved by more than a factor of 3, as
    it does while a policy learns, the features start anew on the new scale; ``wants_history`` says that older rows may then be
    fed again: through :meth:`restart`, and :meth:`refill` with each batch.

    :param variables: Names and order of the variables
    :param half_life: Number of new rows after which an old row weighs half; None weighs all alike
    :param window: Number of newest rows that are kept; None keeps all
    :param basis: The features, see :class:`BasisExpansion`; ``"auto"`` is ``"products"`` where states and actions are at most
        60, else ``"additive"``, or the next simpler ones where ``max_memory`` is too small for these
    :param max_memory: Bytes that the features' moments may take; fewer blocks are kept where 8 of them need more
    :raises ValueError: when two blocks need more memory than that
    """

    FIRST_ROWS = 200
    LARGEST_SHIFT = 3.0
    MAX_BLOCKS = 8
    RECENT_ROWS = 256
    remark = ""
    """What was simplified to keep within the memory; empty where nothing was."""
    rows_since_change = math.inf
    """Number of newest rows that are of the world as it is now; infinite as long as no older ones were forgotten."""

    def __init__(
        self,
        variables: TransitionVariables,
        half_life: float | None = None,
        window: int | None = None,
        basis: str = "auto",
        max_memory: float = 200e6,
    ) -> None:
        n_states, n_inputs = variables.n_states, variables.n_states + variables.n_actions
        self.variables = variables
        self.basis = basis
        if basis == "auto":
            self.basis, self.remark = affordable_basis(n_states, n_inputs, max_memory)
        self.raw = StreamingMoments(variables.n_variables, half_life, variables.names, window)
        n_features = number_of_features(n_inputs, self.basis)
        n_blocks = min(self.MAX_BLOCKS, 2 * int(max_memory // bytes_needed(n_states, n_inputs, self.basis)))
        if n_blocks < 2:
            simpler = {"products": "use basis='additive', or ", "additive": "use basis='linear', or "}.get(self.basis, "")
            raise ValueError(f"{_shortage(n_states, n_inputs, self.basis, max_memory)}: {simpler}give it more memory")
        self.dynamics, self.reward = (
            StreamingMoments(n_features + n_targets, half_life, window=window, n_blocks=n_blocks, n_targets=n_targets)
            for n_targets in (n_states, 1)
        )
        self.inputs_of_dynamics, self.inputs_of_reward = variables.causes_of_state, variables.causes_of_reward
        self.expansions: tuple[BasisExpansion, BasisExpansion] | None = None
        self.recent = np.empty((0, variables.n_variables))
        """The newest rows, at most 256."""
        self.wants_history = False
        self._waiting: list[np.ndarray] = []

    @property
    def n_samples(self) -> int:
        """Number of rows that have been fed."""
        return self.raw.n_samples

    @property
    def count(self) -> float:
        """Sum of the weights of the rows from which a graph is found."""
        return self.raw.count if self.expansions is None else self.dynamics.count

    @property
    def fewest_rows(self) -> float:
        """Sum of the rows' weights that is not fallen below once rows are forgotten."""
        return min(self.raw.fewest_rows, self.dynamics.fewest_rows)

    def update(self, rows: npt.ArrayLike) -> None:
        """
        Merge a batch of rows; nothing changes when it raises.

        :param rows: shape (N, 2 n + d + 1), N may be 0; never changed
        :raises ValueError: on a wrong shape, or on NaN, infinite or absurdly large values, naming the variables
        """
        rows = self.raw.checked(rows)
        if len(rows) == 0:
            return
        for part in _in_parts(rows):
            self.raw.update(part)
        self.rows_since_change += len(rows)
        self.recent = np.concatenate([self.recent, rows[-self.RECENT_ROWS :]])[-self.RECENT_ROWS :].copy()
        if self.expansions is None and self.raw.n_samples < self.FIRST_ROWS:
            self._waiting.append(rows.copy())
            return
        if self.expansions is None:
            self.start()
        elif self._has_moved():
            self.restart()
            self.wants_history = True
        self._feed(rows)

    def start(self) -> None:
        """Fix the standardisation now, with the rows that there are."""
        if self.expansions is not None or self.raw.n_samples == 0:
            return
        self._set_expansions()
        for rows in self._waiting:
            self._feed(rows)
        self._waiting = []

    def restart(self) -> None:
        """Take the standardisation of all rows fed so far, and forget the features' moments."""
        self._set_expansions()
        self.dynamics.clear()
        self.reward.clear()
        self._waiting = []

    def refill(self, rows: npt.ArrayLike) -> None:
        """
        Feed rows to the features alone that had been fed before the features started anew; oldest first.

        :param rows: shape (N, 2 n + d + 1)
        :raises ValueError: where ``update`` would raise
        """
        rows = self.raw.checked(rows)
        self.wants_history = False
        self._feed(rows)

    def with_blocks(self, blocks: slice) -> "BasisMoments":
        """
        :param blocks: Which of the blocks of rows, oldest first
        :return: statistics of these rows alone, only to be read
        """
        part = copy.copy(self)
        part.raw, part.dynamics, part.reward = (each.with_blocks(blocks) for each in (self.raw, self.dynamics, self.reward))
        return part

    def forget_old(self, n_rows: float) -> None:
        """
        Forget older rows, also where they would be fed again, up to whole blocks.

        :param n_rows: Number of newest rows that are kept, at least
        """
        for moments in (self.raw, self.dynamics, self.reward):
            moments.forget_old(n_rows)
        self.rows_since_change = self.dynamics.count

    def _set_expansions(self) -> None:
        spread = self.raw.spread()
        mean, scale = spread.mean, np.where(spread.constant, 1.0, spread.standard_deviation())
        first, second = (
            BasisExpansion(mean[inputs], scale[inputs], self.basis)
            for inputs in (self.inputs_of_dynamics, self.inputs_of_reward)
        )
        self.expansions = (first, second)

    def _has_moved(self) -> bool:
        assert self.expansions is not None
        spread = self.raw.spread()
        mean, deviation, moving = spread.mean, spread.standard_deviation(), ~spread.constant
        for expansion, inputs in zip(self.expansions, (self.inputs_of_dynamics, self.inputs_of_reward), strict=True):
            here = moving[inputs]
            ratio = deviation[inputs][here] / expansion.scale[here]
            shift = np.abs(mean[inputs] - expansion.location)[here] / expansion.scale[here]
            limit = self.LARGEST_SHIFT
            if (ratio > limit).any() or (ratio < 1.0 / limit).any() or (shift > limit).any():
                return True
        return False

    def _feed(self, rows: np.ndarray) -> None:
        assert self.expansions is not None
        of_dynamics, of_reward = self.expansions
        for part in _in_parts(rows):
            features = of_dynamics.features(of_dynamics.standardise(part[:, self.inputs_of_dynamics]))
            self.dynamics.update(np.concatenate([features, part[:, self.variables.next_state]], axis=1))
            features = of_reward.features(of_reward.standardise(part[:, self.inputs_of_reward]))
            self.reward.update(np.concatenate([features, part[:, [self.variables.reward]]], axis=1))


def _in_parts(rows: np.ndarray) -> list[np.ndarray]:
    return [rows[first : first + FEED_ROWS] for first in range(0, len(rows), FEED_ROWS)]
