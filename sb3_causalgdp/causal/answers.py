"""What the structural model answers: numbers with their names, as tables and as pictures."""

import difflib
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sb3_causalgdp.causal.answers_in_words import counterfactual_in_words, effects_in_words, intervention_in_words
from sb3_causalgdp.causal.drawing import frame_of, picture
from sb3_causalgdp.causal.variables import TransitionVariables

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

RAW = "units of the outcome per unit of the action"
STANDARDISED = "standard deviations of the outcome per half range of the action"


@dataclass(frozen=True, eq=False, repr=False)
class InterventionalDistribution:
    """
    Gaussian next state and reward under do(...); for one observation without the axis of the batch. It can be unpacked into
    the first four.

    :param next_state: Mean of s', shape ``(batch, n)``
    :param next_state_std: Standard deviation of s', 0 where s'_j was set, shape ``(batch, n)``
    :param reward: Mean of r, shape ``(batch,)``
    :param reward_std: Standard deviation of r, that of s' propagated, shape ``(batch,)``
    :param variables: Names of the variables
    :param running_std: Running standard deviations of the states and, last, of the reward, shape ``(n + 1,)``
    :param without: The same without an intervention; None where there was none
    """

    next_state: np.ndarray
    next_state_std: np.ndarray
    reward: np.ndarray
    reward_std: np.ndarray
    variables: TransitionVariables
    running_std: np.ndarray
    without: "InterventionalDistribution | None" = None

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter((self.next_state, self.next_state_std, self.reward, self.reward_std))

    def __repr__(self) -> str:
        return intervention_in_words(self)

    def __getitem__(self, name: Any) -> Any:
        """
        :param name: A next state, such as ``"velocity'"``, or ``"reward"``; or a number, as of a tuple
        :return: its mean and its standard deviation, in the environment's units
        :raises KeyError: on another name
        """
        if not isinstance(name, str):
            return tuple(self)[name]
        names = (*self.variables.next_state_names, "reward")
        if name not in names:
            close = difflib.get_close_matches(name, names, n=1)
            raise KeyError(f"unknown outcome {name}, {f'did you mean {close[0]}' if close else f'known are {list(names)}'}")
        column = names.index(name)
        return tuple(values[..., column] for values in self.columns())

    def columns(self) -> tuple[np.ndarray, np.ndarray]:
        """
        :return: means and standard deviations of s' and, last, of r side by side, shape ``(batch, n + 1)``
        """
        means = np.concatenate([self.next_state, np.asarray(self.reward)[..., None]], axis=-1)
        stds = np.concatenate([self.next_state_std, np.asarray(self.reward_std)[..., None]], axis=-1)
        return means, stds

    def to_dataframe(self) -> "pd.DataFrame":
        """
        :return: a row for each outcome (and observation of a batch): mean and standard deviation in the environment's units,
            what they are without the intervention, and the change in those units and in running standard deviations
        :raises ImportError: when pandas is missing
        """
        means, stds = (np.atleast_2d(values) for values in self.columns())
        before = means if self.without is None else np.atleast_2d(self.without.columns()[0])
        names = (*self.variables.next_state_names, "reward")
        rows = []
        for row in range(len(means)):
            for j, name in enumerate(names):
                change = means[row, j] - before[row, j]
                values = (means[row, j], stds[row, j], before[row, j], change, change / self.running_std[j])
                rows.append((row, name, *values))
        return frame_of(rows, ("observation", "outcome", "mean", "std", "without", "change", "standardised_change"))

    def plot(self, path: str | os.PathLike[str] | None = None, max_outcomes: int = 30) -> "Figure":
        """
        Draw the outcomes with and without the intervention, in running standard deviations, with bands of two standard
        deviations; of a batch the mean.

        :param path: Image file to write, by its suffix; None writes nothing
        :param max_outcomes: Draw at most this many, those that change most, and the reward
        :return: the matplotlib figure
        :raises ImportError: when matplotlib is missing
        """
        return picture("plot_intervention")(self, path, max_outcomes)


class EffectStatistics(NamedTuple):
    """Effects of the d action components, averaged over observations; the last axis has length d."""

    mean: np.ndarray
    """Signed mean."""
    standard_error: np.ndarray
    """Of the signed mean, for independent observations; NaN for a single one."""
    mean_absolute: np.ndarray
    """Mean of the absolute values: large where the sign changes with the state but the effect is strong."""

    def scaled(self, factor: np.ndarray) -> "EffectStatistics":
        """
        :param factor: Positive, broadcast against the statistics
        """
        return EffectStatistics(*(values * factor for values in self))


@dataclass(frozen=True, eq=False, repr=False)
class ActionEffects:
    """
    Total causal effect of each action component on the reward and on each next state variable.

    :param variables: Names of the variables
    :param reward: Total effect on the reward, shape ``(d,)``
    :param reward_direct: Of it a -> r, with the next state held where it is
    :param reward_through_state: Of it a -> s' -> r, with the reward's own action held where it is
    :param next_state: Effect on the next state, shape ``(n, d)``
    :param action_half_range: Half of each action's range, in the environment's units, shape ``(d,)``
    :param state_std: Running standard deviation of the states, in the environment's units, shape ``(n,)``
    :param reward_std: Running standard deviation of the rewards, in the environment's units
    :param n_observations: Number of observations that were averaged
    :param is_standardised: Whether the units are standardised, see :meth:`standardised`
    """

    variables: TransitionVariables
    reward: EffectStatistics
    reward_direct: EffectStatistics
    reward_through_state: EffectStatistics
    next_state: EffectStatistics
    action_half_range: np.ndarray
    state_std: np.ndarray
    reward_std: float
    n_observations: int
    is_standardised: bool = False

    def __repr__(self) -> str:
        return effects_in_words(self, self.unit)

    @property
    def unit(self) -> str:
        """Of the numbers."""
        return STANDARDISED if self.is_standardised else RAW

    def standardised(self) -> "ActionEffects":
        """
        :return: The effects in running standard deviations of the outcome for half of the action's range, so that actions and
            outcomes of all units compare
        """
        if self.is_standardised:
            return self
        by_reward = self.action_half_range / self.reward_std
        return replace(
            self,
            reward=self.reward.scaled(by_reward),
            reward_direct=self.reward_direct.scaled(by_reward),
            reward_through_state=self.reward_through_state.scaled(by_reward),
            next_state=self.next_state.scaled(self.action_half_range / self.state_std[:, None]),
            is_standardised=True,
        )

    def to_dataframe(self) -> "pd.DataFrame":
        """
        :return: a row for each action and outcome; ``part`` tells the ``total`` effect on the reward from its parts ``direct``
            and ``through the next state``; ``unit`` says whether the numbers are standardised
        :raises ImportError: when pandas is missing
        """
        parts = {"total": self.reward, "direct": self.reward_direct, "through the next state": self.reward_through_state}
        rows: list[tuple[Any, ...]] = []
        for i, action in enumerate(self.variables.action_names):
            rows += [(action, "reward", part, *(values[i] for values in effect), self.unit) for part, effect in parts.items()]
            for j, state in enumerate(self.variables.next_state_names):
                rows.append((action, state, "total", *(values[j, i] for values in self.next_state), self.unit))
        return frame_of(rows, ("action", "outcome", "part", *EffectStatistics._fields, "unit"))

    def plot(self, path: str | os.PathLike[str] | None = None, max_actions: int = 20, max_states: int = 30) -> "Figure":
        """
        Draw the standardised effects: bars for the reward, a heat map for the next state.

        :param path: Image file to write, by its suffix; None writes nothing
        :param max_actions: Draw at most this many actions, those with the largest mean absolute effect
        :param max_states: Draw at most this many next state variables, those with the largest mean absolute effect
        :return: the matplotlib figure
        :raises ImportError: when matplotlib is missing
        """
        return picture("plot_action_effects")(self, path, max_actions, max_states)


class Trajectory(NamedTuple):
    """T consecutive steps of one episode, in the environment's units."""

    states: np.ndarray
    """Shape ``(T + 1, n)``."""
    actions: np.ndarray
    """Shape ``(T, d)``."""
    rewards: np.ndarray
    """Shape ``(T,)``."""


@dataclass(frozen=True, eq=False, repr=False)
class Counterfactual:
    """
    What would have been, in the environment's units, and the noise under which it would. It can be unpacked into the first
    five.

    :param states: Shape ``(T + 1, n)``; the first is the recorded one
    :param actions: Shape ``(T, d)``
    :param rewards: Shape ``(T,)``
    :param state_noise: Abducted noise of s', in the model's standard deviations: large where it does not explain a step,
        shape ``(T, n)``
    :param reward_noise: Abducted noise of r, in the model's standard deviations, shape ``(T,)``
    :param variables: Names of the variables
    :param recorded: What was
    :param noise_std: The model's standard deviations of s' and, last, of r in one step, shape ``(n + 1,)``
    :param running_std: Running standard deviations of the states and, last, of the reward, shape ``(n + 1,)``
    """

    states: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    state_noise: np.ndarray
    reward_noise: np.ndarray
    variables: TransitionVariables
    recorded: Trajectory
    noise_std: np.ndarray
    running_std: np.ndarray

    def __repr__(self) -> str:
        return counterfactual_in_words(self)

    def __iter__(self) -> Iterator[np.ndarray]:
        return iter((self.states, self.actions, self.rewards, self.state_noise, self.reward_noise))

    def __getitem__(self, index: Any) -> Any:
        return tuple(self)[index]

    def to_dataframe(self) -> "pd.DataFrame":
        """
        :return: a row for each step and variable: the recorded and the counterfactual value in the environment's units, the
            change in those units and, of states and the reward, in running standard deviations; states have a row more
        :raises ImportError: when pandas is missing
        """
        names, rows = self.variables, []
        parts = (
            (names.state_names, self.recorded.states, self.states, self.running_std[:-1]),
            (names.action_names, self.recorded.actions, self.actions, np.full(names.n_actions, np.nan)),
            (("reward",), self.recorded.rewards[:, None], self.rewards[:, None], self.running_std[-1:]),
        )
        for labels, recorded, changed, std in parts:
            for j, name in enumerate(labels):
                for step, (before, after) in enumerate(zip(recorded[:, j], changed[:, j], strict=True)):
                    rows.append((step, name, before, after, after - before, (after - before) / std[j]))
        return frame_of(rows, ("step", "variable", "recorded", "counterfactual", "change", "standardised_change"))

    def plot(
        self, path: str | os.PathLike[str] | None = None, variables: "list[str] | None" = None, max_variables: int = 6
    ) -> "Figure":
        """
        Draw the recorded and the counterfactual trajectory. The band is two standard deviations of the model's noise in one
        step wide, where the two differ.

        :param path: Image file to write, by its suffix; None writes nothing
        :param variables: Names of the states and actions to draw, and ``"reward"``; None takes the reward, the actions that
            were changed and the states that change most
        :param max_variables: Number of panels where ``variables`` is None, at least 1
        :return: the matplotlib figure
        :raises ImportError: when matplotlib is missing
        :raises ValueError: on an unknown name
        """
        return picture("plot_counterfactual")(self, path, variables, max_variables)
