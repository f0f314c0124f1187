"""Nonlinear features of transitions, and their streaming moments."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sb3_causalgdp.causal.moments import StreamingMoments
from sb3_causalgdp.causal.variables import TransitionVariables

N_FUNCTIONS = 4  # each variable as itself, its square, sine and tanh
FEATURE_BOUND = 5.0  # standard deviations: outliers must not rule the squares and products
FEED_ROWS = 512  # so that the features of a batch need little memory beside the moments


@dataclass
class BasisExpansion:
    """
    Features of p standardised inputs z: ``[z, z^2, sin z, tanh z]`` and, if asked for, the products ``z_i z_j``, i < j.

    All but the first are functions of z limited to [-5, 5].

    :param location: Means of the inputs, shape (p,)
    :param scale: Standard deviations of the inputs, 1 for inputs that do not move, shape (p,)
    :param products: Whether there are products
    """

    location: np.ndarray
    scale: np.ndarray
    products: bool

    def __post_init__(self) -> None:
        n_inputs = len(self.location)
        first, second = np.triu_indices(n_inputs, k=1)
        self._first, self._second = (first, second) if self.products else (first[:0], second[:0])
        self.n_features = N_FUNCTIONS * n_inputs + len(self._first)

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
        bounded = _bounded(standardised)
        products = bounded[:, self._first] * bounded[:, self._second]
        return np.concatenate([_functions(standardised), products], axis=1)

    def difference(self, standardised: np.ndarray, variable: int, half_step: float) -> np.ndarray:
        """
        How much larger the features are when a variable is half a step above its value instead of half a step below.

        :param standardised: z, shape (N, p)
        :param variable: Index of an input
        :param half_step: In units of z
        :return: of the features in ``features_of(variable)``, the others do not change; shape (N, len(features_of(variable)))
        """
        above, below = standardised[:, [variable]] + half_step, standardised[:, [variable]] - half_step
        own = _functions(above) - _functions(below)
        if not self.products:
            return own
        others = np.delete(_bounded(standardised), variable, axis=1)
        return np.concatenate([own, (_bounded(above) - _bounded(below)) * others], axis=1)

    def features_of(self, variable: int) -> np.ndarray:
        """
        :param variable: Index of an input
        :return: indices of the features that it is part of: 4, and p - 1 products, each group in the order of the inputs
        """
        n_inputs = len(self.location)
        own = variable + n_inputs * np.arange(N_FUNCTIONS)
        shared = np.flatnonzero((self._first == variable) | (self._second == variable))
        return np.concatenate([own, N_FUNCTIONS * n_inputs + shared])

    def subset(self, inputs: np.ndarray, functions: int, products: bool) -> np.ndarray:
        """
        :param inputs: Indices of the inputs that are kept
        :param functions: How many of the functions are kept, from 1 (linear) to 4
        :param products: Whether the products are kept, if there are any
        :return: indices of the features of these inputs alone
        """
        n_inputs = len(self.location)
        own = (np.asarray(inputs) + n_inputs * np.arange(functions)[:, None]).ravel()
        if not products:
            return own
        both = np.flatnonzero(np.isin(self._first, inputs) & np.isin(self._second, inputs))
        return np.concatenate([own, N_FUNCTIONS * n_inputs + both])


def _bounded(standardised: np.ndarray) -> np.ndarray:
    return np.clip(standardised, -FEATURE_BOUND, FEATURE_BOUND)


def _functions(standardised: np.ndarray) -> np.ndarray:
    """The features that are functions of one variable, shape (N, 4 p)."""
    bounded = _bounded(standardised)
    return np.concatenate([standardised, bounded**2, np.sin(bounded), np.tanh(bounded)], axis=1)


class BasisMoments:
    """
    Streaming moments of nonlinear features: of (s, a) together with s', and of (s', a) together with r.

    The first rows fix the standardisation of the inputs. When their location or scale has moved by more than a factor of 3, as
    it does while a policy learns, the features start anew on the new scale; ``wants_history`` says that older rows may then be
    fed again: through :meth:`restart`, and :meth:`refill` with each batch.

    :param variables: Names and order of the variables
    :param half_life: Number of new rows after which an old row weighs half; None weighs all alike
    :param window: Number of newest rows that are kept; None keeps all
    :param products: Whether products of pairs are among the features; None: where states and actions are at most 60
    :param max_memory: Bytes that the moments may take; fewer blocks are kept where 8 of them need more
    :raises ValueError: when two blocks need more memory than that
    """

    FIRST_ROWS = 200
    LARGEST_SHIFT = 3.0
    MAX_BLOCKS = 8
    RECENT_ROWS = 256

    def __init__(
        self,
        variables: TransitionVariables,
        half_life: float | None = None,
        window: int | None = None,
        products: bool | None = None,
        max_memory: float = 200e6,
    ) -> None:
        n_states, n_inputs = variables.n_states, variables.n_states + variables.n_actions
        self.variables = variables
        self.products = n_inputs <= 60 if products is None else products
        self.raw = StreamingMoments(variables.n_variables, half_life, variables.names, window)
        n_features = N_FUNCTIONS * n_inputs + (n_inputs * (n_inputs - 1) // 2 if self.products else 0)
        block_bytes = 8 * ((n_features + n_states) ** 2 + (n_features + 1) ** 2)
        n_blocks = min(self.MAX_BLOCKS, 2 * int(max_memory // (2 * block_bytes)))
        if n_blocks < 2:
            advice = "use products=False, or more memory" if self.products else "give it more memory"
            raise ValueError(
                f"{n_features} features of {n_inputs} states and actions need {2 * block_bytes / 1e6:.0f} MB, "
                f"and max_memory is {max_memory / 1e6:.0f} MB: {advice}"
            )
        self.dynamics = StreamingMoments(n_features + n_states, half_life, window=window, n_blocks=n_blocks)
        self.reward = StreamingMoments(n_features + 1, half_life, window=window, n_blocks=n_blocks)
        columns = np.arange(variables.n_variables)
        self.inputs_of_dynamics = columns[:n_inputs]
        self.inputs_of_reward = np.concatenate([columns[variables.next_state], columns[variables.action]])
        self.expansions: tuple[BasisExpansion, BasisExpansion] | None = None
        self.recent = np.empty((0, variables.n_variables))
        """The newest rows, at most 256."""
        self.wants_history = False
        self._waiting: list[np.ndarray] = []

    @property
    def n_samples(self) -> int:
        """Number of rows that have been fed."""
        return self.raw.n_samples

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

    def _set_expansions(self) -> None:
        mean, scale = self.raw.mean, np.where(self.raw.constant, 1.0, self.raw.standard_deviation())
        first, second = (
            BasisExpansion(mean[inputs], scale[inputs], self.products)
            for inputs in (self.inputs_of_dynamics, self.inputs_of_reward)
        )
        self.expansions = (first, second)

    def _has_moved(self) -> bool:
        assert self.expansions is not None
        mean, deviation, moving = self.raw.mean, self.raw.standard_deviation(), ~self.raw.constant
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
