"""Interventions, effects and counterfactuals on the masked world model, in the environment's own units."""

import difflib
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt
import torch as th

from sb3_causalgdp.causal.answers import (
    ActionEffects,
    Counterfactual,
    EffectStatistics,
    InterventionalDistribution,
    Trajectory,
)
from sb3_causalgdp.causal.rows import (
    EffectAverage,
    as_array,
    as_column,
    as_numbers,
    as_vector,
    checked_positive,
    checked_rows,
    chunks,
    replace_columns,
    same_batch,
)
from sb3_causalgdp.causal.variables import TransitionVariables
from sb3_causalgdp.causal.world_model import MaskedWorldModel

__all__ = [
    "ActionEffects",
    "ActionRule",
    "Counterfactual",
    "EffectStatistics",
    "InterventionalDistribution",
    "PolicyFunction",
    "StructuralModel",
    "Trajectory",
]

ActionRule = Callable[[int, np.ndarray, np.ndarray], float]
"""Value of one action component, from the step t, the counterfactual state (n,) and the action (d,) that it would change."""
PolicyFunction = Callable[[np.ndarray], npt.ArrayLike]
"""Action (d,) at a state (n,), both in the environment's units."""


class StructuralModel:
    """
    The masked world model as a structural causal model with additive Gaussian noise, ``s' = f(s, a) + u_s`` and
    ``r = g(s', a) + u_r``, in the environment's own units.

    It answers Pearl's three questions: what follows from do(...), how strong is an effect, and what would have happened in a
    recorded episode had other actions been taken (J. Pearl, Causality, 2nd ed., 2009: sections 3.2, 4.5 and 7.1). Its answers
    are as good as the masks and the fit are. The world model is used, not copied: later training changes the answers.

    The reward's causes are s' and a, as in the paper. An environment that rewards the state before the step, like Pendulum, is
    only predicted through them: the reward under do(a) still holds, but not its split into direct and through the next state,
    nor the reward under do(s').

    Between the environment and the model lie maps of each variable by itself: actions from their bounds to [-1, 1], and, where
    the model saw normalised observations and rewards, ``clip((s - offset) / scale)`` and ``r / scale``.

    :param world_model: The masked world model, trained
    :param variables: Names of the n states and d actions
    :param action_low: Lower bounds of the actions in the environment, a number or shape ``(d,)``
    :param action_high: Upper bounds, a number or shape ``(d,)``
    :param state_offset: What was subtracted from the states, a number or shape ``(n,)``
    :param state_scale: What they were divided by, positive, a number or shape ``(n,)``
    :param state_clip: Bound of their absolute value thereafter, positive, a number or shape ``(n,)``
    :param reward_scale: What the rewards were divided by, positive
    :raises ValueError: If a shape does not fit, a scale is not positive or bounds are not finite and ordered
    """

    BOUND_TOLERANCE = 1e-6  # of the half range: actions come back from float32
    ROWS_PER_CHUNK = 1_024
    SAMPLES_PER_CHUNK = 65_536
    MAX_NAMES_IN_MESSAGE = 40

    def __init__(
        self,
        world_model: MaskedWorldModel,
        variables: TransitionVariables,
        action_low: npt.ArrayLike = -1.0,
        action_high: npt.ArrayLike = 1.0,
        state_offset: npt.ArrayLike = 0.0,
        state_scale: npt.ArrayLike = 1.0,
        state_clip: npt.ArrayLike = np.inf,
        reward_scale: float = 1.0,
    ) -> None:
        n_states, n_actions = variables.n_states, variables.n_actions
        if (world_model.state_dim, world_model.action_dim) != (n_states, n_actions):
            raise ValueError(
                f"The variables name {n_states} states and {n_actions} actions, but the world model has "
                f"{world_model.state_dim} and {world_model.action_dim}"
            )
        self.world_model = world_model
        self.variables = variables
        self.action_low = as_vector("action_low", action_low, n_actions)
        self.action_high = as_vector("action_high", action_high, n_actions)
        if not (np.isfinite([self.action_low, self.action_high]).all() and (self.action_low < self.action_high).all()):
            raise ValueError(f"Action bounds must be finite and ordered, got {self.action_low} and {self.action_high}")
        self.state_offset = as_vector("state_offset", state_offset, n_states)
        self.state_scale = checked_positive("state_scale", as_vector("state_scale", state_scale, n_states))
        self.state_clip = checked_positive("state_clip", as_vector("state_clip", state_clip, n_states))
        self.reward_scale = float(checked_positive("reward_scale", np.asarray(reward_scale, dtype=np.float64)))

    # The model in the environment's units -----------------------------------------------------------------------------------

    @property
    def action_half_range(self) -> np.ndarray:
        """Shape ``(d,)``."""
        return (self.action_high - self.action_low) / 2.0

    def _tensor(self, values: npt.ArrayLike) -> th.Tensor:
        # Double precision up to the model: offsets may be large against scales
        return th.as_tensor(values, dtype=th.float64, device=self.world_model.state_mean.device)

    def _model_state(self, states: th.Tensor) -> th.Tensor:
        normalised = (states - self._tensor(self.state_offset)) / self._tensor(self.state_scale)
        clip = self._tensor(self.state_clip)
        return normalised.clamp(-clip, clip).to(self.world_model.state_mean.dtype)

    def _model_action(self, actions: np.ndarray) -> th.Tensor:
        scaled = (actions - self.action_low) / self.action_half_range - 1.0
        return self._tensor(np.clip(scaled, -1.0, 1.0)).to(self.world_model.state_mean.dtype)

    @th.no_grad()
    def _predict_next_state(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean, shape ``(batch, n)``, and standard deviation, shape ``(n,)``."""
        state, action = self._model_state(self._tensor(states)), self._model_action(actions)
        mean, std = self.world_model.predict_next_state(state, action)
        return self.state_offset + self.state_scale * as_array(mean), self.state_scale * as_array(std)

    @th.no_grad()
    def _predict_reward(self, next_states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, float]:
        """Mean, shape ``(batch,)``, and standard deviation."""
        next_state, action = self._model_state(self._tensor(next_states)), self._model_action(actions)
        mean, std = self.world_model.predict_reward(next_state, action)
        return self.reward_scale * as_array(mean), self.reward_scale * float(std)

    # Checks -----------------------------------------------------------------------------------------------------------------

    def _state_rows(self, values: npt.ArrayLike, name: str) -> np.ndarray:
        return checked_rows(values, self.variables.n_states, name)

    def _action_rows(self, values: npt.ArrayLike, name: str) -> np.ndarray:
        """Finite and within the bounds; what rounding has pushed over a bound is put back on it."""
        rows = checked_rows(values, self.variables.n_actions, name)
        slack = self.BOUND_TOLERANCE * self.action_half_range
        outside = ((rows < self.action_low - slack) | (rows > self.action_high + slack)).reshape(-1, self.variables.n_actions)
        if outside.any():
            row, column = (int(index) for index in np.argwhere(outside)[0])
            value, low, high = rows.reshape(outside.shape)[row, column], self.action_low[column], self.action_high[column]
            action = self.variables.action_names[column]
            raise ValueError(f"{action} must be in [{low:g}, {high:g}], got {value:g} (in {name}, row {row})")
        return np.clip(rows, self.action_low, self.action_high)

    def _check_names(self, given: Mapping[str, object], known: Sequence[str]) -> None:
        unknown = [name for name in given if name not in known]
        if unknown:
            shown = list(known[: self.MAX_NAMES_IN_MESSAGE])
            more = "" if len(shown) == len(known) else f" and {len(known) - len(shown)} more"
            close = difflib.get_close_matches(unknown[0], known, n=1)
            meant = f"did you mean {close[0]!r}? Known" if close else "known"
            raise ValueError(f"Unknown variables {unknown}: {meant} are {shown}{more}")

    # Interventions ----------------------------------------------------------------------------------------------------------

    def intervene(
        self,
        observation: npt.ArrayLike,
        action: npt.ArrayLike,
        interventions: Mapping[str, npt.ArrayLike],
        n_samples: int | None = None,
        seed: int = 0,
    ) -> InterventionalDistribution:
        """
        The distribution of the next state and of the reward under do(...).

        A state or action that is set replaces the model's input. A next state variable (a name with a prime) that is set loses
        its causes: it has this value, without noise, when the reward is predicted.

        The reward's uncertainty is that of its own noise and that of the next state. By default the latter goes through the
        reward model's gradient (delta method: first order, no sampling); ``n_samples`` draws next states instead, which also
        moves the mean where the reward model is curved over the spread of s'.

        :param observation: s, in the environment's units, shape ``(n,)`` or ``(batch, n)``
        :param action: a, within its bounds, shape ``(d,)`` or ``(batch, d)``
        :param interventions: Values by name, each a number or shape ``(batch,)``; {} for none
        :param n_samples: Number of sampled next states for each observation, at least 2; None for the delta method
        :param seed: Seed of these samples
        :return: Means and standard deviations, in the environment's units
        :raises ValueError: On an unknown name, a value that is not finite, an action outside of its bounds or a wrong shape
        """
        names = (*self.variables.state_names, *self.variables.action_names, *self.variables.next_state_names)
        self._check_names(interventions, names)
        states = self._state_rows(observation, "observation")
        actions = self._action_rows(action, "action")
        is_single = states.ndim == 1 and actions.ndim == 1
        states, actions = same_batch(states, actions)
        values = {name: as_column(name, value, len(states)) for name, value in interventions.items()}
        replace_columns(states, self.variables.state_names, values)
        replace_columns(actions, self.variables.action_names, values)
        actions = self._action_rows(actions, "interventions")

        next_states, std = self._predict_next_state(states, actions)
        stds = np.tile(std, (len(states), 1))
        replace_columns(next_states, self.variables.next_state_names, values)
        replace_columns(stds, self.variables.next_state_names, dict.fromkeys(values, np.zeros(len(stds))))
        if n_samples is None:
            rewards, reward_stds = self._reward_by_delta_method(next_states, stds, actions)
        else:
            rewards, reward_stds = self._reward_by_sampling(next_states, stds, actions, n_samples, seed)
        without = self.intervene(observation, action, {}, n_samples, seed) if interventions else None
        if is_single:
            next_states, stds, rewards, reward_stds = (values[0] for values in (next_states, stds, rewards, reward_stds))
        running_std = self._running_std()
        return InterventionalDistribution(next_states, stds, rewards, reward_stds, self.variables, running_std, without)

    def _running_std(self) -> np.ndarray:
        """Of the states and, last, of the reward, in the environment's units, shape ``(n + 1,)``."""
        states = self.state_scale * as_array(self.world_model.state_std)
        return np.append(states, self.reward_scale * float(self.world_model.reward_scale))

    def _reward_by_delta_method(
        self, next_states: np.ndarray, stds: np.ndarray, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        with th.enable_grad():
            next_state = self._tensor(next_states).requires_grad_()
            mean, std = self.world_model.predict_reward(self._model_state(next_state), self._model_action(actions))
            (gradient,) = th.autograd.grad(mean.sum(), next_state)
        variance = ((as_array(gradient) * stds) ** 2).sum(axis=1) + float(std.detach()) ** 2
        return self.reward_scale * as_array(mean), self.reward_scale * np.sqrt(variance)

    def _reward_by_sampling(
        self, next_states: np.ndarray, stds: np.ndarray, actions: np.ndarray, n_samples: int, seed: int
    ) -> tuple[np.ndarray, np.ndarray]:
        if n_samples < 2:
            raise ValueError(f"n_samples must be at least 2, got {n_samples!r}")
        generator = np.random.default_rng(seed)
        at_mean, noise_std = self._predict_reward(next_states, actions)
        total, total_square = np.zeros_like(at_mean), np.zeros_like(at_mean)
        per_chunk = max(1, self.SAMPLES_PER_CHUNK // len(next_states))
        for first in range(0, n_samples, per_chunk):
            n_drawn = min(per_chunk, n_samples - first)
            drawn = next_states + stds * generator.standard_normal((n_drawn, *next_states.shape))
            rewards, _ = self._predict_reward(drawn.reshape(-1, drawn.shape[-1]), np.tile(actions, (n_drawn, 1)))
            # About the prediction at the mean, so that large rewards do not cancel
            deviations = rewards.reshape(n_drawn, -1) - at_mean
            total += deviations.sum(axis=0)
            total_square += (deviations**2).sum(axis=0)
        mean = total / n_samples
        variance = np.maximum(total_square - n_samples * mean**2, 0.0) / (n_samples - 1)
        return at_mean + mean, np.sqrt(variance + noise_std**2)

    # Effects ----------------------------------------------------------------------------------------------------------------

    def effect_of_actions(
        self, observations: npt.ArrayLike, actions: npt.ArrayLike, delta: npt.ArrayLike | None = None
    ) -> ActionEffects:
        """
        How strongly each action component moves the reward and each next state variable, per unit of the action.

        By default the derivative at the given actions. With ``delta`` the difference quotient between do(a_i + delta) and
        do(a_i - delta), both cut off at the bounds of the action. The reward is predicted at the mean of s'. Its direct effect
        and that through the next state are Pearl's natural direct and indirect effects; they add up to the total for
        derivatives and linear models.

        :param observations: s, in the environment's units, shape ``(n,)`` or ``(batch, n)``
        :param actions: a, within its bounds, shape ``(d,)`` or ``(batch, d)``
        :param delta: Change of the action, positive, in the environment's units, a number or shape ``(d,)``; None for the
            derivative
        :return: Averages over the observations
        :raises ValueError: On a wrong shape, a value that is not finite, an action outside of its bounds or a delta that is
            not positive
        """
        states, actions = same_batch(self._state_rows(observations, "observations"), self._action_rows(actions, "actions"))
        if delta is not None:
            step = checked_positive("delta", as_vector("delta", delta, self.variables.n_actions))
            if not np.isfinite(step).all():
                raise ValueError(f"delta must be finite, got {delta!r}")
        averages = tuple(EffectAverage() for _ in range(4))
        for rows in chunks(len(states), self.ROWS_PER_CHUNK):
            chunk = states[rows], actions[rows]
            effects = self._derivatives(*chunk) if delta is None else self._difference_quotients(*chunk, step)
            for average, values in zip(averages, effects, strict=True):
                average.update(values)
        total, direct, through_state, next_state = (average.statistics() for average in averages)
        running_std = self._running_std()
        return ActionEffects(
            self.variables,
            total,
            direct,
            through_state,
            next_state,
            action_half_range=self.action_half_range,
            state_std=running_std[:-1],
            reward_std=float(running_std[-1]),
            n_observations=len(states),
        )

    def _derivatives(self, states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, ...]:
        """Of the reward: total, direct and through s', each of shape ``(batch, d)``; of the next state ``(batch, n, d)``."""
        action = self._model_action(actions)
        response = self.world_model.action_response(self._model_state(self._tensor(states)), action)
        through_state = response.through_next_state(response.reward_by_next_state)
        per_unit = self.reward_scale / self.action_half_range
        next_state_effect = as_array(response.next_state_jacobian) * self.state_scale[:, None] / self.action_half_range
        direct, through = as_array(response.reward_by_action) * per_unit, as_array(through_state) * per_unit
        return direct + through, direct, through, next_state_effect

    def _difference_quotients(self, states: np.ndarray, actions: np.ndarray, delta: np.ndarray) -> tuple[np.ndarray, ...]:
        """As :meth:`_derivatives`."""
        at_action, _ = self._predict_next_state(states, actions)
        columns: list[list[np.ndarray]] = [[], [], [], []]
        for i in range(self.variables.n_actions):
            upper, lower = actions.copy(), actions.copy()
            upper[:, i] = np.minimum(upper[:, i] + delta[i], self.action_high[i])
            lower[:, i] = np.maximum(lower[:, i] - delta[i], self.action_low[i])
            width = upper[:, i] - lower[:, i]
            (above, _), (below, _) = self._predict_next_state(states, upper), self._predict_next_state(states, lower)

            def reward_change(above: np.ndarray, upper: np.ndarray, below: np.ndarray, lower: np.ndarray) -> np.ndarray:
                return self._predict_reward(above, upper)[0] - self._predict_reward(below, lower)[0]

            columns[0].append(reward_change(above, upper, below, lower) / width)
            columns[1].append(reward_change(at_action, upper, at_action, lower) / width)
            columns[2].append(reward_change(above, actions, below, actions) / width)
            columns[3].append((above - below) / width[:, None])
        return tuple(np.stack(column, axis=-1) for column in columns)

    # Counterfactuals --------------------------------------------------------------------------------------------------------

    def counterfactual(
        self,
        trajectory: tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike],
        changes: Mapping[str, npt.ArrayLike | ActionRule],
        policy: PolicyFunction | None = None,
        abduct_policy: bool = True,
    ) -> Counterfactual:
        """
        What would have happened in a recorded episode had other actions been taken: abduction of the noise of every step,
        change of the actions, prediction with the same noise (Pearl, 2009, section 7.1).

        With no change the recorded trajectory comes back, and so does each variable to which the masks let no path from the
        changed actions. Actions that are not changed stay as recorded, unless a policy reacts to the counterfactual states.
        The model knows nothing of the ends of episodes: the counterfactual is as long as the recording.

        :param trajectory: States ``(T + 1, n)``, actions ``(T, d)`` and rewards ``(T,)`` of one episode
        :param changes: For each changed action component, by name, a number, shape ``(T,)``, or a function of the step t, the
            counterfactual state ``(n,)`` and the action ``(d,)`` otherwise taken, like ``lambda t, s, a: 0.5 * a[0]``
        :param policy: Chooses the components that are not changed, from the counterfactual state; None keeps the recorded ones
        :param abduct_policy: Whether this policy made the recording: its deviation from the recorded action is then noise, and
            replayed too. False for another policy.
        :return: The counterfactual trajectory and the noise
        :raises ValueError: On an unknown name, a wrong shape, a value that is not finite or an action outside of its bounds
        """
        recorded = self._check_trajectory(trajectory)
        n_steps = len(recorded.actions)
        rules = self._action_rules(changes, n_steps)
        states, actions, rewards = recorded.states.copy(), recorded.actions.copy(), recorded.rewards.copy()
        state_noise, reward_noise = np.empty((n_steps, self.variables.n_states)), np.empty(n_steps)
        # Step by step for the recording too: a batch may round differently, and equal inputs must give equal predictions
        for t in range(n_steps):
            now, after = slice(t, t + 1), slice(t + 1, t + 2)
            if policy is not None:
                actions[t] = self._reaction(
                    policy, states[t], recorded.states[t], recorded.actions[t] if abduct_policy else None
                )
            actions[t] = self._changed_action(rules, t, states[t], actions[t])

            expected_state, state_std = self._predict_next_state(recorded.states[now], recorded.actions[now])
            state_noise[t] = (recorded.states[t + 1] - expected_state[0]) / state_std
            replayed_state, _ = self._predict_next_state(states[now], actions[now])
            states[after] = recorded.states[after] + (replayed_state - expected_state)

            expected_reward, reward_std = self._predict_reward(recorded.states[after], recorded.actions[now])
            reward_noise[t] = (recorded.rewards[t] - expected_reward[0]) / reward_std
            replayed_reward, _ = self._predict_reward(states[after], actions[now])
            rewards[now] = recorded.rewards[now] + (replayed_reward - expected_reward)
        noise_std = np.append(state_std, reward_std) if n_steps else np.zeros(self.variables.n_states + 1)
        return Counterfactual(
            states, actions, rewards, state_noise, reward_noise, self.variables, recorded, noise_std, self._running_std()
        )

    def _reaction(
        self, policy: PolicyFunction, state: np.ndarray, recorded_state: np.ndarray, recorded_action: np.ndarray | None
    ) -> np.ndarray:
        action = self._ask(policy, state)
        if recorded_action is None:
            return action
        # In this order an unchanged state gives the recorded action back, bit by bit
        return np.clip(recorded_action + (action - self._ask(policy, recorded_state)), self.action_low, self.action_high)

    def _ask(self, policy: PolicyFunction, state: np.ndarray) -> np.ndarray:
        action = np.asarray(policy(state.copy()), dtype=np.float64).ravel()
        return self._action_rows(action, "the policy's answer")

    def _changed_action(self, rules: Mapping[int, ActionRule], t: int, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        changed = action.copy()
        for column, rule in rules.items():
            changed[column] = rule(t, state.copy(), action.copy())
        return self._action_rows(changed, f"changes, step {t}")

    def _check_trajectory(self, trajectory: tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]) -> Trajectory:
        if len(trajectory) != 3:
            raise ValueError(f"trajectory must be (states, actions, rewards), got {len(trajectory)} parts")
        states = np.atleast_2d(self._state_rows(trajectory[0], "states of the trajectory"))
        actions = np.atleast_2d(self._action_rows(trajectory[1], "actions of the trajectory"))
        rewards = as_numbers("rewards of the trajectory", trajectory[2])
        if len(states) != len(actions) + 1 or rewards.shape != (len(actions),):
            raise ValueError(
                "trajectory must have T + 1 states, T actions and T rewards, "
                f"got {len(states)} states, {len(actions)} actions and rewards of shape {rewards.shape}"
            )
        if not np.isfinite(rewards).all():
            raise ValueError("rewards of the trajectory must be finite")
        return Trajectory(states, actions, rewards)

    def _action_rules(self, changes: Mapping[str, npt.ArrayLike | ActionRule], n_steps: int) -> dict[int, ActionRule]:
        names = self.variables.action_names
        states = [name for name in changes if name in (*self.variables.state_names, *self.variables.next_state_names)]
        if states:
            raise ValueError(f"a counterfactual changes actions, {list(names)}, got the state {states[0]!r}")
        self._check_names(changes, names)
        rules: dict[int, ActionRule] = {}
        for name, change in changes.items():
            if callable(change):
                rules[names.index(name)] = change
            else:
                rules[names.index(name)] = _fixed_values(as_column(name, change, n_steps))
        return rules


def _fixed_values(values: np.ndarray) -> ActionRule:
    return lambda t, state, action: values[t]
