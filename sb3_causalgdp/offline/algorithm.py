"""From offline data to online learning, for any off-policy algorithm: preload, pretrain, and batches of both kinds."""

import warnings
from typing import Any, TypeVar

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_causalgdp.offline.callbacks import TrainingBar, note_success
from sb3_causalgdp.offline.observations import flat_space, key_names
from sb3_causalgdp.offline.preload import (
    check_buffer,
    prime_normalizer,
)
from sb3_causalgdp.offline.pretraining import PretrainedAlgorithm, callback_list
from sb3_causalgdp.offline.replay import SpacesEnv, can_sample
from sb3_causalgdp.offline.rewards import check_reward_transform
from sb3_causalgdp.offline.sources import open_source, with_columns
from sb3_causalgdp.offline.spaces import spaces_of

SelfAlgorithm = TypeVar("SelfAlgorithm", bound="OfflineToOnlineAlgorithm")


class OfflineToOnlineAlgorithm(PretrainedAlgorithm):
    """
    An off-policy algorithm with a stage before the first step: on recorded transitions, which stay beside the new ones.

    :param args: As for ``OffPolicyAlgorithm``
    :param pretrain_steps: Gradient steps of :meth:`pretrain` before the first step of ``learn()``
    :param offline_fraction: Share of a batch that comes from preloaded transitions once there are others
    :param kwargs: As for ``OffPolicyAlgorithm``
    """

    def __init__(
        self,
        *args,
        pretrain_steps: int = 0,
        offline_fraction: float | Schedule = 0.5,
        **kwargs,
    ) -> None:
        super().__init__(*args, **kwargs)
        self.pretrain_steps = pretrain_steps
        self.offline_fraction = offline_fraction
        # A buffer of hindsight replay that is known to hold a whole episode: to look for one takes as long as to sample
        self._buffer_with_episode: ReplayBuffer | None = None

    def _setup_model(self) -> None:
        if self.pretrain_steps < 0:
            raise ValueError(f"pretrain_steps must be at least 0, got {self.pretrain_steps!r}")
        check_reward_transform(self.reward_transform)
        self._offline_share(progress_remaining=1.0)
        if self._env_steps_before_pretrain is not None:
            # Saved by a callback in the middle of pretrain()
            self.num_timesteps, self._env_steps_before_pretrain = self._env_steps_before_pretrain, None
        if self.env is not None:
            self._check_normalisation(self._vec_normalize_env)
            self.observation_layout = self._checked_layout(self.env)
        super()._setup_model()
        if self.offline_dataset is not None:
            assert self.replay_buffer is not None
            check_buffer(self.replay_buffer, self.reward_transform, self._vec_normalize_env)

    @classmethod
    def from_dataset(
        cls: type[SelfAlgorithm],
        source: Any,
        policy: str | type[BasePolicy] = "MlpPolicy",
        n_envs: int = 1,
        observation_space: spaces.Space | None = None,
        action_space: spaces.Box | None = None,
        **kwargs,
    ) -> SelfAlgorithm:
        """
        A model with the spaces of a dataset and without an environment, ready for :meth:`preload` and :meth:`pretrain`. It
        learns online after ``set_env``. Dictionaries of observations are flattened, except for a ``MultiInputPolicy``.

        Arrays and tables do not tell their spaces. What is not given is inferred, with a warning that says what: observations
        of any numbers, and actions between the smallest and the largest. The names of the columns are those of the variables.

        :param source: As for :meth:`preload`; only its spaces are read
        :param policy: The policy model to use
        :param n_envs: Number of environments that it will learn from
        :param observation_space: Space of the observations; None for the source's
        :param action_space: Space of the actions; None for the source's
        :param kwargs: Arguments of the constructor; with a data frame or the path of a table also those of
            :class:`~sb3_causalgdp.sources.tables.Table`, which :meth:`preload` takes, too
        :return: The model
        """
        opened = open_source(with_columns(source, kwargs))
        observation_space, action_space = spaces_of(opened, observation_space, action_space)
        layout = observation_space
        names = opened.state_names or key_names(layout), opened.action_names
        policy_class = cls.policy_aliases.get(policy) if isinstance(policy, str) else policy
        if not (policy_class is not None and issubclass(policy_class, cls.policy_aliases["MultiInputPolicy"])):
            layout, observation_space = observation_space, flat_space(observation_space)
        model = cls(policy, SpacesEnv(observation_space, action_space, n_envs, *names), **kwargs)
        model.env, model.observation_layout = None, layout if layout is not observation_space else None
        return model

    def set_env(self, env: GymEnv | str, force_reset: bool = True) -> None:
        """
        Set the environment, see SB3's ``set_env``. A training ``VecNormalize`` counts the preloaded transitions.

        :param env: The environment, or its id
        :param force_reset: Whether it is reset before training goes on
        :raises ValueError: If its ``VecNormalize`` would normalise the observations of a policy that was trained on others
        """
        env = maybe_make_env(env, self.verbose)
        normalizer = unwrap_vec_normalize(env) if isinstance(env, VecEnv) else None
        self._check_normalisation(normalizer)
        layout = self._checked_layout(env)
        if normalizer is not None and self.offline_buffer is not None and self._reward_transform is not None:
            check_buffer(self.offline_buffer, self._reward_transform, normalizer)
        super().set_env(env, force_reset)
        self.observation_layout = layout
        if normalizer is not None and self.offline_buffer is not None:
            prime_normalizer(normalizer, self.offline_buffer, (0, self.offline_buffer.size()), self._offline_marks)

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        return super()._init_callback([*callback_list(callback), TrainingBar()] if progress_bar else callback)

    def progress_parts(self) -> list[str]:
        """
        :return: What the progress bar says, the most important first: mean return and success rate of the last episodes
        """
        if self.is_pretraining:
            return ["gradient steps"]
        returns = [episode["r"] for episode in self.ep_info_buffer or ()]
        parts = [f"return {np.mean(returns):.4g}" if returns else "no episode yet"]
        return [*parts, f"success {np.mean(self.ep_success_buffer):.0%}"] if self.ep_success_buffer else parts

    def _update_info_buffer(self, infos: list[dict[str, Any]], dones: np.ndarray | None = None) -> None:
        if dones is not None and dones.any():
            for info in infos:
                note_success(info)
        super()._update_info_buffer(infos, dones)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if self.env is None:
            raise ValueError("learn() needs an environment: give it to load(), or call set_env() first")
        self._load_offline_dataset(progress_bar)
        if self._n_pretrain_steps < self.pretrain_steps:
            steps = self.pretrain_steps - self._n_pretrain_steps
            # Callbacks that say so are for both stages
            both = [one for one in callback_list(callback) if getattr(one, "during_pretraining", False)]
            self.pretrain(steps, both, progress_bar=progress_bar)
        if self.offline_buffer is not None and self.offline_buffer is self.replay_buffer:
            self.replay_buffer = self._new_buffer(self.buffer_size)
        noise = self.action_noise
        if isinstance(noise, VectorizedActionNoise) and noise.n_envs != self.env.num_envs:
            # Of a model that was saved with another number of environments
            self.action_noise = VectorizedActionNoise(noise.base_noise, self.env.num_envs)
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        # A pretrained policy collects the transitions that learning starts with: it knows better than to act at random
        return super()._sample_action(0 if self._n_pretrain_steps > 0 else learning_starts, action_noise, n_envs)

    def _waits_for_episode(self) -> bool:
        """Whether nothing can be sampled before an episode ends, as in hindsight replay that was loaded without a buffer."""
        buffer = self.replay_buffer
        known = buffer is self._buffer_with_episode or self.offline_buffer is not None
        if known or not isinstance(buffer, HerReplayBuffer):
            return False
        if can_sample(buffer):
            self._buffer_with_episode = buffer
            return False
        warnings.warn("Updates wait: HerReplayBuffer holds no whole episode yet. They begin when the first one has ended.")
        return True

    def _n_offline(self, batch_size: int) -> int:
        if self.offline_buffer is None:
            return 0
        assert self.replay_buffer is not None
        if self.is_pretraining or self.offline_buffer is self.replay_buffer or not can_sample(self.replay_buffer):
            return batch_size
        return round(batch_size * self._offline_share(self._current_progress_remaining))

    def _offline_share(self, progress_remaining: float) -> float:
        share = FloatSchedule(self.offline_fraction)(progress_remaining)
        if not 0.0 <= share <= 1.0:
            raise ValueError(f"offline_fraction must be between 0 and 1, got {share!r}")
        return share

    def _store_transition(self, replay_buffer, buffer_action, new_obs, reward, dones, infos) -> None:
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        if self._reward_transform is not None:
            last = replay_buffer.pos - 1
            replay_buffer.rewards[last] = self._reward_transform(replay_buffer.rewards[last])

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "offline_buffer", "_offline_marks", "_buffer_with_episode"]
