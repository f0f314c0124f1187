"""The causal world model's schedule: every N environment steps, statistics, discovery, masks."""

import math
import time
import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import PyTorchObs

from sb3_causalgdp.callbacks.calibration import FEWEST_HORIZONS, QErrors, calibrated
from sb3_causalgdp.callbacks.diagnostics import (
    choice,
    dead_units,
    discounted_returns,
    gradient_norm,
    guidance_divergence,
    step_size_bound,
)
from sb3_causalgdp.causal import Verdict, min_rows
from sb3_causalgdp.causal.description import count_of_edges
from sb3_causalgdp.causal.endings import states_that_end


class CausalWorldModelCallback(BaseCallback):
    """
    Every ``refresh_freq`` environment steps: feed the new transitions to the discovery's statistics, rediscover the causal
    graph and write its masks into the world model. In ``pretrain()``, before the first gradient step and every
    ``refresh_freq`` of them.

    :class:`~sb3_causalgdp.CausalGDP` adds one by itself; passing an own instance to ``learn()`` replaces it. The schedule and
    the moments live on the model, so that they go on after ``save`` and ``load`` and with ``reset_num_timesteps=False``.

    :param refresh_freq: Environment steps between refreshes, None for the model's ``causal_refresh_freq``
    :param min_transitions: Transitions that are needed before the first discovery, None for ten for each cause, 200 at least
    :param diagnostics_batch_size: Replay transitions on which the logged divergence and step-size bound are computed, 0 for
        none
    :param verbose: Verbosity level: 1 prints each refresh
    """

    model: Any  # a CausalGDP, whose file imports this one
    FEED_ROWS = 10_000
    FEED_IMAGE_ROWS = 256
    HISTORY_ROWS = 20_000
    RETURN_POSITIONS = 2_000
    RETURNS_COMPARED = 256
    OFFLINE_HISTORY_ROWS = 100_000
    ENDS_COMPARED = 2_000

    def __init__(
        self,
        refresh_freq: int | None = None,
        min_transitions: int | None = None,
        diagnostics_batch_size: int = 64,
        verbose: int = 0,
    ) -> None:
        super().__init__(verbose)
        if refresh_freq is not None and refresh_freq < 1:
            raise ValueError(f"refresh_freq must be at least 1 environment step, got {refresh_freq!r}")
        self.refresh_freq = refresh_freq
        self.min_transitions = min_transitions
        self.diagnostics_batch_size = diagnostics_batch_size
        self._said_too_few = False
        self._said_step_size = False
        self._counted_steps = 0

    def _init_callback(self) -> None:
        self._counted_steps = self.model.num_timesteps

    def _on_training_start(self) -> None:
        # A resumed call goes on in the middle, between two refreshes
        if self.model.is_pretraining and self.model._resumed_at_gradient_step != self.model.n_pretrain_steps:
            self.refresh()

    def _on_step(self) -> bool:
        # By the model's counter: inside an event callback this is not called at every step
        self.model._steps_since_refresh += self.model.num_timesteps - self._counted_steps
        self._counted_steps = self.model.num_timesteps
        if self.model._steps_since_refresh >= (self.refresh_freq or self.model.causal_refresh_freq):
            self.refresh()
        return True

    def refresh(self) -> None:
        """
        Feed, discover and write the masks now.
        """
        model = self.model
        if model.pessimism == "auto" or self.diagnostics_batch_size > 0:
            self._calibrate_critics()
        start = time.perf_counter()
        self._feed_statistics()
        model._steps_since_refresh = 0
        variables, statistics = model.transition_variables, model.causal_statistics
        n_causes = variables.n_states + variables.n_actions
        wanted = max(200, 10 * n_causes) if self.min_transitions is None else self.min_transitions
        needed = min_rows(model.discovery, variables)
        # Statistics that started anew hold fewer than they have seen; the weights of a half-life do not add up to an integer
        n_held = min(statistics.n_samples, getattr(statistics, "count", math.inf))
        if statistics.n_samples < wanted or n_held < needed - 0.5:
            self._say_too_few(statistics.n_samples if statistics.n_samples < wanted else round(n_held), max(wanted, needed))
            return
        before = model.causal_graph()
        graph = model.discovery(statistics, variables, model._causal_graph)
        graph = replace(graph, num_timesteps=int(model.n_environment_steps))
        model.set_causal_graph(graph)
        is_asked = model.relevance_gate is not None, model.counterfactual_replay > 0.0
        ends = self._states_that_end() if any(is_asked) else None
        if is_asked[0]:
            self._report_verdict(model.judge_relevance(graph, ends))
        if is_asked[1]:
            self._report_components(model.judge_components(graph, ends))
        self.logger.record("causal/n_edges", graph.n_edges)
        self.logger.record("causal/expected_edges", graph.expected_edges)
        self.logger.record("causal/change", graph.change_since(before))
        self.logger.record("causal/refresh_seconds", time.perf_counter() - start)
        if self.verbose >= 1:
            words = (f"{count_of_edges(graph)}, from {graph.n_samples} transitions", *graph.remarks)
            print(f"Causal graph at {model.num_timesteps} steps: {'; '.join(words)}")
        self._log_diagnostics()

    def _states_that_end(self) -> np.ndarray:
        """Which states are others where episodes terminate, shape ``(n,)``."""
        n_states = self.model.transition_variables.n_states
        ends = np.zeros(n_states, dtype=bool)
        for buffer in {self.model.replay_buffer, self.model.offline_buffer} - {None}:
            n_held, n_envs = buffer.size(), buffer.n_envs
            if n_held == 0:
                continue
            terminated = buffer.dones[:n_held] > 0.0
            if hasattr(buffer, "timeouts"):
                terminated &= buffer.timeouts[:n_held] == 0.0
            # The memory efficient buffer does not keep the last observation of an episode
            values = buffer.observations if buffer.optimize_memory_usage else buffer.next_observations
            positions = np.flatnonzero(terminated.any(axis=1))[-self.ENDS_COMPARED :]
            last = self._states(values, positions).reshape(len(positions), n_envs, n_states)[terminated[positions]]
            n_usual = min(n_held, max(1, self.ENDS_COMPARED // n_envs))
            usual = self._states(values, np.linspace(0, n_held - 1, n_usual).astype(np.int64))
            ends |= states_that_end(usual, last)
        return ends

    def _report_verdict(self, verdict: Verdict) -> None:
        self.logger.record("causal/n_closed_states", int((~verdict.states).sum()))
        self.logger.record("causal/n_closed_actions", int((~verdict.actions).sum()))
        if self.verbose >= 1:
            changes = [("hides", verdict.closed), ("shows", verdict.opened)]
            words = [f"{verb} {', '.join(names)}" for verb, names in changes if names]
            print("Causal abstraction: " + ("; ".join(words) or verdict.withheld or "as before"))

    def _report_components(self, untrusted: str) -> None:
        components = self.model.trusted_components.components
        self.logger.record("causal/n_components", 0 if components is None else len(components.read))
        if self.verbose >= 1 and untrusted:
            print(f"Counterfactual replay waits: {untrusted}")

    def _say_too_few(self, n_samples: int, needed: int) -> None:
        if not self._said_too_few:
            self._said_too_few = True
            warnings.warn(
                f"Causal discovery waits: it has {n_samples} transitions and needs {needed}. Until then every edge is open "
                "and the policy is not guided."
            )

    def _feed_statistics(self) -> None:
        """Hand the statistics the rows that they have not seen: preloaded ones first, then those of the replay buffer."""
        model, statistics = self.model, self.model.causal_statistics
        if statistics.n_samples == 0:
            # Not by the buffer's position: one that is just full is at its start again
            model._fed_offline_position, model._fed_position = 0, -math.inf
        offline, online = model.offline_buffer, model.replay_buffer
        if offline is not None:
            for rows in self._rows_at(offline, np.arange(model._fed_offline_position, offline.size())):
                statistics.update(rows)
            model._fed_offline_position, model._fed_marks = offline.size(), list(model._offline_marks)
        if online is not offline:
            for rows in self._newest_rows(online, model._stored_position - model._fed_position):
                statistics.update(rows)
        model._fed_position = model._stored_position
        if getattr(statistics, "wants_history", False):
            statistics.restart()
            for rows in self._history(offline, online, getattr(statistics, "rows_since_change", math.inf)):
                statistics.refill(rows)

    def _history(self, offline: ReplayBuffer | None, online: ReplayBuffer, most_rows: float) -> Iterator[np.ndarray]:
        """What is fed again, oldest first; of the newest rows alone, and no preloaded ones, if ``most_rows`` is finite."""
        if offline is not None and (most_rows == math.inf or online is offline):
            n_rows = min(offline.size(), max(1, min(most_rows, self.OFFLINE_HISTORY_ROWS) // offline.n_envs))
            first = offline.size() - n_rows if most_rows < math.inf else 0
            yield from self._rows_at(offline, np.linspace(first, offline.size() - 1, int(n_rows)).astype(np.int64))
        if online is not offline:
            yield from self._newest_rows(online, max(1, min(most_rows, self.HISTORY_ROWS) // online.n_envs))

    def _newest_rows(self, buffer: ReplayBuffer, n_positions: float) -> Iterator[np.ndarray]:
        """The transitions of at most so many newest positions, oldest first, in parts that fit into memory."""
        # The full memory efficient buffer has overwritten its oldest observation
        n_held = buffer.size() - int(buffer.full and buffer.optimize_memory_usage)
        n_positions = int(min(n_positions, n_held))
        yield from self._rows_at(buffer, np.arange(buffer.pos - n_positions, buffer.pos) % buffer.buffer_size)

    def _rows_at(self, buffer: ReplayBuffer, positions: np.ndarray) -> Iterator[np.ndarray]:
        chunk = self.FEED_IMAGE_ROWS if self.model.policy.has_image_state else self.FEED_ROWS
        positions_per_chunk = max(1, chunk // buffer.n_envs)
        for first in range(0, len(positions), positions_per_chunk):
            rows = self._read(buffer, positions[first : first + positions_per_chunk])
            if len(rows) > 0:
                yield rows

    def _read(self, buffer: ReplayBuffer, positions: np.ndarray) -> np.ndarray:
        """One-step transitions as rows ``[s, a, s', r]``, straight from the buffer's arrays, in the environment's units."""
        if buffer.optimize_memory_usage:
            next_values, next_positions = buffer.observations, (positions + 1) % buffer.buffer_size
        else:
            next_values, next_positions = buffer.next_observations, positions
        actions = buffer.actions[positions].reshape(len(positions) * buffer.n_envs, -1)
        rows = self.model.transition_variables.stack(
            self._states(buffer.observations, positions),
            actions,
            self._states(next_values, next_positions),
            buffer.rewards[positions].reshape(-1),
        )
        if buffer.optimize_memory_usage:
            # This buffer does not keep the last observation of an episode
            rows = rows[buffer.dones[positions].reshape(-1) == 0.0]
        return rows

    def _states(self, observations: np.ndarray | dict[str, np.ndarray], positions: np.ndarray) -> np.ndarray:
        policy = self.model.policy
        # Only networks have to be asked on their device; not all devices know double precision
        device = self.model.device if policy.has_image_state else "cpu"

        def rows(values: np.ndarray) -> th.Tensor:
            return th.as_tensor(values[positions].reshape(-1, *values.shape[2:]), device=device)

        if isinstance(observations, dict):
            return policy.exact_causal_state({key: rows(values) for key, values in observations.items()}).cpu().numpy()
        return policy.exact_causal_state(rows(observations)).cpu().numpy()

    def _draw_observations(self, buffer: ReplayBuffer, generator: Any) -> PyTorchObs:
        """A batch as the policy sees it, straight from the arrays: a HER buffer cannot sample before an episode has ended."""
        rows = generator.randint(buffer.size(), size=self.diagnostics_batch_size)
        envs = generator.randint(buffer.n_envs, size=self.diagnostics_batch_size)
        return self._observations_at(buffer, rows, envs)

    def _observations_at(self, buffer: ReplayBuffer, rows: np.ndarray, envs: np.ndarray) -> PyTorchObs:
        """As the policy sees them."""
        drawn: np.ndarray | dict[str, np.ndarray]
        if isinstance(buffer.observations, dict):
            drawn = {key: values[rows, envs] for key, values in buffer.observations.items()}
        else:
            drawn = buffer.observations[rows, envs]
        drawn = buffer._normalize_obs(drawn, self.model._vec_normalize_env)
        if isinstance(drawn, dict):
            return {key: buffer.to_torch(values) for key, values in drawn.items()}
        return buffer.to_torch(drawn)

    def _log_diagnostics(self) -> None:
        model = self.model
        if self.diagnostics_batch_size == 0:
            return
        buffer = model.replay_buffer if model.replay_buffer.size() > 0 else model.offline_buffer
        if buffer is None:
            # A loaded model starts with an empty buffer
            return
        # An unguided training draws no more random numbers than one without diagnostics
        observations = self._draw_observations(buffer, np.random if model.policy.is_guided else np.random.RandomState(0))
        model.policy.set_training_mode(False)
        for name, value in choice(model.policy, observations)._asdict().items():
            self.logger.record(f"policy/{name}", value)
        for name, value in dead_units(model.policy, observations).items():
            self.logger.record(f"policy/dead_units_{name}", value)
        for name, module in (("actor", model.actor), ("critic", model.critic), ("world_model", model.world_model)):
            norm = gradient_norm(module.optimizer)
            if norm is not None:
                self.logger.record(f"train/{name}_gradient_norm", norm)
        if model.policy.is_guided:
            self._log_guidance(observations)

    def _calibrate_critics(self) -> None:
        """Log how far the critics are from what was obtained in the newest episodes, and let TD targets make up for it."""
        model, errors = self.model, self._q_errors()
        if errors is None:
            return
        self.logger.record("policy/q_error", errors.of_smallest)
        if model.pessimism != "auto":
            return
        discount = model.gamma**model.n_steps
        if model._n_updates * (1.0 - discount) >= FEWEST_HORIZONS:
            model.calibrated_pessimism = calibrated(model.calibrated_pessimism, errors, discount)
        self.logger.record("train/pessimism", model.calibrated_pessimism)

    def _q_errors(self) -> QErrors | None:
        """None where no return is known."""
        model, buffer = self.model, self.model.replay_buffer
        if model.is_pretraining or buffer is model.offline_buffer or not buffer.handle_timeout_termination:
            return None
        n_positions = min(buffer.size(), self.RETURN_POSITIONS)
        positions = np.arange(buffer.pos - n_positions, buffer.pos) % buffer.buffer_size
        rewards = buffer._normalize_reward(buffer.rewards[positions], model._vec_normalize_env)
        returns = discounted_returns(rewards, buffer.dones[positions], buffer.timeouts[positions], model.gamma)
        known = np.argwhere(~np.isnan(returns))
        if len(known) == 0:
            return None
        chosen = known[np.linspace(0, len(known) - 1, min(len(known), self.RETURNS_COMPARED)).astype(int)]
        rows, envs = positions[chosen[:, 0]], chosen[:, 1]
        observations = self._observations_at(buffer, rows, envs)
        model.policy.set_training_mode(False)
        with th.no_grad():
            values = model.policy.critic_target(observations, buffer.to_torch(buffer.actions[rows, envs]))
        return QErrors.of(th.cat(values, dim=1).cpu().numpy(), returns[chosen[:, 0], chosen[:, 1]])

    def _log_guidance(self, observations: PyTorchObs) -> None:
        model = self.model
        self.logger.record("guidance/kl", guidance_divergence(model.policy, observations))
        bound = step_size_bound(model.policy, observations)
        self.logger.record("guidance/step_size", bound.step_size)
        self.logger.record("guidance/step_size_bound", bound.bound)
        self.logger.record("guidance/lipschitz", bound.guidance_lipschitz)
        too_steep = bound.guidance_exceeds and not model.policy.guidance_rule.samples_a_posterior
        if too_steep and not self._said_step_size:
            self._said_step_size = True
            warnings.warn(
                f"The guidance is too steep for the sampler's step of {bound.step_size:.3g} (Proposition 1): it alone allows "
                f"{bound.guidance_bound:.3g}. Use guidance='posterior', a guidance_scale up to 1, or more diffusion_steps."
            )
