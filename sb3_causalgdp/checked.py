"""Errors before anything goes wrong: arguments that do not fit together, NaN and infinity from the environment."""

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_causalgdp.arguments import check_keywords, counts_episodes
from sb3_causalgdp.checkpoints.checkpoint import end_last_episodes
from sb3_causalgdp.checks import check_from_environment, is_finite
from sb3_causalgdp.divergence import TrainingDivergedError
from sb3_causalgdp.saving.algorithm import SavedAlgorithm


class CheckedAlgorithm(SavedAlgorithm):
    """An algorithm that looks at what it is given by its user and its environment."""

    actor_update: str
    expectile: float | None
    counterfactual_replay: float

    def _check_together(self) -> None:
        """Arguments that are valid alone, but not together."""
        if self.actor_update == "weighted" and self.expectile is None:
            raise ValueError("expectile must be a number with actor_update='weighted', got None")
        n_positions = self.buffer_size // self.n_envs
        if counts_episodes(self.train_freq) and self.n_envs > 1:
            raise ValueError(f"train_freq must be in steps with {self.n_envs} environments, got {self.train_freq!r}")
        if self.replay_buffer_class is None and self.n_steps > 1:
            if isinstance(self.observation_space, spaces.Dict) or self.optimize_memory_usage:
                what = "optimize_memory_usage" if self.optimize_memory_usage else "a Dict of observations"
                raise ValueError(f"n_steps must be 1 with {what}, got {self.n_steps}")
            if self.n_steps > n_positions:
                raise ValueError(f"n_steps must be at most {n_positions}, buffer_size / n_envs, got {self.n_steps}")
        if self.optimize_memory_usage and n_positions < 2:
            raise ValueError(f"buffer_size must be at least 2 n_envs with optimize_memory_usage, got {self.buffer_size}")
        buffer_class = self.replay_buffer_class or (ReplayBuffer if self.n_steps == 1 else NStepReplayBuffer)
        check_keywords("replay_buffer_kwargs", self.replay_buffer_kwargs, buffer_class)
        if self.counterfactual_replay > 0.0 and issubclass(buffer_class, NStepReplayBuffer):
            raise ValueError(
                f"counterfactual_replay must be 0 with n-step returns, got {self.counterfactual_replay}: the steps in between "
                "are not known for exchanged transitions"
            )

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        *args,
        **kwargs,
    ) -> tuple[int, BaseCallback]:
        if self.replay_buffer is not None and (reset_num_timesteps or self._last_obs is None):
            # SB3 resets the environments
            end_last_episodes(self.replay_buffer)
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, *args, **kwargs)
        check_from_environment(
            self._last_obs if self._vec_normalize_env is None else self._last_original_obs, "observation", self.num_timesteps
        )
        return result

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        try:
            action, buffer_action = super()._sample_action(learning_starts, action_noise, n_envs)
        except TrainingDivergedError as error:
            raise TrainingDivergedError(error.quantity, error.value, self._n_updates) from None
        if not is_finite(buffer_action):
            # The policy's own actions are looked at in predict()
            raise ValueError(f"action_noise gave an action of NaN at step {self.num_timesteps}: {action_noise}")
        return action, buffer_action

    def _store_transition(self, replay_buffer, buffer_action, new_obs, reward, dones, infos) -> None:
        # Before anything is written: one NaN would spread from the buffer to every network and to the graph
        normalizer = self._vec_normalize_env
        # What is stored: infinity was clipped in what was normalised
        check_from_environment(new_obs if normalizer is None else normalizer.old_obs, "observation", self.num_timesteps)
        check_from_environment(reward if normalizer is None else normalizer.old_reward, "reward", self.num_timesteps)
        for info, done in zip(infos, dones, strict=True):
            if done and info.get("terminal_observation") is not None:
                check_from_environment(info["terminal_observation"], "terminal observation", self.num_timesteps)
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
