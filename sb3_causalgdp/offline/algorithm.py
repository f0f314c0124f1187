"""From offline data to online learning, for any off-policy algorithm: preload, pretrain, and batches of both kinds."""

import io
import os
import pathlib
import time
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from inspect import signature
from typing import Any, TypeVar

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, configure_logger
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_causalgdp.files import saved_when_done
from sb3_causalgdp.offline.callbacks import TrainingBar, note_success
from sb3_causalgdp.offline.loaded_buffers import check_loaded_buffer, in_columns
from sb3_causalgdp.offline.observations import flat_space, flattened_space, key_names, layout_name, same_layout
from sb3_causalgdp.offline.preload import (
    check_buffer,
    copy_rows,
    normalised_parts,
    positions_needed,
    preload_buffer,
    prime_normalizer,
)
from sb3_causalgdp.offline.replay import SpacesEnv, can_sample
from sb3_causalgdp.offline.rewards import RewardTransform, SavedRewards, check_reward_transform
from sb3_causalgdp.offline.saved_buffers import SUFFIXES, can_be_arrays, read_buffer, write_buffer
from sb3_causalgdp.offline.sources import Source, open_source
from sb3_causalgdp.offline.spaces import spaces_of
from sb3_causalgdp.saving.archives import errors_of, existing
from sb3_causalgdp.sources.tables import Table

SelfAlgorithm = TypeVar("SelfAlgorithm", bound="OfflineToOnlineAlgorithm")


def callback_list(callback: MaybeCallback) -> list[BaseCallback]:
    """
    :param callback: What ``learn()`` takes
    :return: The callbacks in a list
    """
    if callback is None:
        return []
    if isinstance(callback, list):
        return callback
    return [callback if isinstance(callback, BaseCallback) else ConvertCallback(callback)]


class OfflineToOnlineAlgorithm(OffPolicyAlgorithm):
    """
    An off-policy algorithm with a stage before the first step: on recorded transitions, which stay beside the new ones.

    :param args: As for ``OffPolicyAlgorithm``
    :param offline_dataset: What :meth:`preload` loads when training starts and nothing is there
    :param pretrain_steps: Gradient steps of :meth:`pretrain` before the first step of ``learn()``
    :param offline_fraction: Share of a batch that comes from preloaded transitions once there are others
    :param reward_transform: What is done to the rewards once transitions were preloaded
    :param kwargs: As for ``OffPolicyAlgorithm``
    """

    def __init__(
        self,
        *args,
        offline_dataset: str | None = None,
        pretrain_steps: int = 0,
        offline_fraction: float | Schedule = 0.5,
        reward_transform: str = "none",
        **kwargs,
    ) -> None:
        super().__init__(*args, **kwargs)
        self.offline_dataset = offline_dataset
        self.pretrain_steps = pretrain_steps
        self.offline_fraction = offline_fraction
        self.reward_transform = reward_transform
        # Preloaded transitions, which those of the environment never overwrite
        self.offline_buffer: ReplayBuffer | None = None
        self._offline_marks: list[str] = []
        self._reward_transform: RewardTransform | None = None
        self._n_pretrain_steps = 0
        self._env_steps_before_pretrain: int | None = None
        # Which parts of the observations were normalised when the networks were trained last, None before they were
        self._trained_normalised: list[str] | None = None
        # The space of dictionaries or tuples that observations are flattened from: its order of keys is theirs
        self.observation_layout: spaces.Space | None = None
        # A buffer of hindsight replay that is known to hold a whole episode: to look for one takes as long as to sample
        self._buffer_with_episode: ReplayBuffer | None = None

    @property
    def n_pretrain_steps(self) -> int:
        """Gradient steps that were made by :meth:`pretrain`."""
        return self._n_pretrain_steps

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
            :class:`~sb3_causalgdp.sources.tables.Table`, which :meth:`preload` takes then
        :return: The model
        """
        if "states" in kwargs and not isinstance(source, Table):
            source = Table(source, **{name: kwargs.pop(name) for name in signature(Table).parameters if name in kwargs})
        opened = open_source(source)
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

    def _checked_layout(self, env: GymEnv) -> spaces.Space | None:
        """What the observations of an environment are flattened from, by key; the model's own where that cannot be told."""
        own = self.observation_layout
        found = flattened_space(env, own)
        if same_layout(own, found):
            if own is not None and found is None and not isinstance(env, SpacesEnv):
                warnings.warn(
                    f"The model's observations are flattened in the order {layout_name(own)}, and it is not known whether "
                    "those of this environment are"
                )
            return own if found is None else found
        assert own is not None and found is not None
        raise ValueError(
            f"The model's observations are flattened in the order {layout_name(own)}, and this environment's in the order "
            f"{layout_name(found)}: give the environment that order of keys, or make the model with this environment"
        )

    def _layout_of(self, given: spaces.Space) -> spaces.Space | None:
        if self.observation_layout is None:
            self.observation_layout = flattened_space(self.env, given)
        return self.observation_layout

    def _check_layout(self, layout: spaces.Space | None, name: str) -> None:
        own = self.observation_layout
        if not same_layout(own, layout):
            assert own is not None and layout is not None
            raise ValueError(
                f"{name} holds observations flattened in the order {layout_name(layout)}, and the model's are in the order "
                f"{layout_name(own)}"
            )
        self.observation_layout = own or layout

    def _check_normalisation(self, normalizer: VecNormalize | None) -> None:
        before, now = self._trained_normalised, normalised_parts(normalizer)
        if before is None or before == now:
            return
        if not set(now) <= set(before):
            argument = f"norm_obs_keys={before}" if before else "norm_obs=False"
            raise ValueError(
                f"The policy was trained on {_normalised(before)}, and this VecNormalize would give it {_normalised(now)}: "
                f"pass {argument} to it, or give the model this environment before it is trained or pretrained"
            )
        warnings.warn(
            f"The policy was trained on {_normalised(before)}, and this environment gives it {_normalised(now)}: wrap it with "
            "VecNormalize.load(path, env) of the training's statistics"
        )

    def preload(
        self: SelfAlgorithm,
        source: Any,
        reward_transform: str | None = None,
        progress_bar: bool = False,
        download: bool = True,
        trusted: bool = False,
    ) -> SelfAlgorithm:
        """
        Load recorded transitions into ``offline_buffer``: all of them, or none when something is wrong with them. Until
        ``learn()`` collects others, it is the replay buffer too; from then on, the environment's transitions go to a replay
        buffer of their own, and batches are made from both (``offline_fraction``). A second call adds to the first.

        Observations are flattened as the environment's ``FlattenObservation`` does, actions are scaled to [-1, 1], and a
        training ``VecNormalize`` gets their statistics.

        :param source: The id of a Minari dataset (``"D4RL/pointmaze/umaze-v2"``), a ``minari.MinariDataset``, a replay buffer
            of SB3 or the path of a saved one, or arrays: a mapping (or the path of an ``.npz`` file) of ``observations``,
            ``actions``, ``rewards``, ``next_observations``, ``terminations`` and ``truncations``; or a
            :class:`~sb3_causalgdp.sources.tables.Table`
        :param reward_transform: What is done to the rewards, here and in ``learn()``; None takes the constructor's
        :param progress_bar: Whether to show a progress bar (needs tqdm)
        :param download: Whether to download a dataset that is not on this machine
        :param trusted: Whether a pickled buffer may hold more than what SB3's own are made of, which could run code
        :return: The model
        """
        data = open_source(source, download, trusted)
        name = self.reward_transform if reward_transform is None else reward_transform
        if self._reward_transform is not None and name != self.reward_transform:
            raise ValueError(f"The model's rewards are transformed by {self.reward_transform!r} already, got {name!r}")
        with errors_of(data.name, "cannot be loaded"):
            buffer = self._buffer_with_room(data)
        transform = name if self._reward_transform is None else self._reward_transform
        self._check_layout(data.layout, data.name)
        done = preload_buffer(buffer, data, self.env, self._vec_normalize_env, transform, progress_bar, self._layout_of)
        if self.replay_buffer is self.offline_buffer or self._replay_buffer_is_empty():
            self.replay_buffer = buffer
        self.offline_buffer = buffer
        self.reward_transform, self._reward_transform = name, done.reward_transform
        self._offline_marks.append(done.mark)
        return self

    def _replay_buffer_is_empty(self) -> bool:
        return self.replay_buffer is None or self.replay_buffer.size() == 0

    def _buffer_with_room(self, data: Source) -> ReplayBuffer:
        buffer = self.offline_buffer
        if buffer is None:
            buffer = self.replay_buffer if self._replay_buffer_is_empty() else self._new_buffer(self.n_envs)
        assert buffer is not None
        needed = positions_needed(buffer, data)
        if needed <= buffer.buffer_size:
            return buffer
        if buffer is self.replay_buffer and buffer is not self.offline_buffer:
            warnings.warn(
                f"{data.name}: {data.n_transitions} transitions, which do not fit in buffer_size={self.buffer_size}. They "
                "get a larger buffer; that of the transitions to come keeps its size"
            )
        larger = self._new_buffer(needed * self.n_envs)
        copy_rows(buffer, larger)
        return larger

    def _new_buffer(self, buffer_size: int) -> ReplayBuffer:
        assert self.replay_buffer_class is not None
        kwargs = dict(self.replay_buffer_kwargs)
        if issubclass(self.replay_buffer_class, HerReplayBuffer):
            kwargs["env"] = self.env
        return self.replay_buffer_class(
            buffer_size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            optimize_memory_usage=self.optimize_memory_usage,
            **kwargs,
        )

    @property
    def is_pretraining(self) -> bool:
        """Whether :meth:`pretrain` is running."""
        return self._env_steps_before_pretrain is not None

    @property
    def n_environment_steps(self) -> int:
        """``num_timesteps``, which counts gradient steps while :meth:`pretrain` runs, without those."""
        before = self._env_steps_before_pretrain
        return self.num_timesteps if before is None else before

    def pretrain(
        self: SelfAlgorithm,
        gradient_steps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 1_000,
        tb_log_name: str = "offline",
        progress_bar: bool = False,
    ) -> SelfAlgorithm:
        """
        The offline stage: train everything on what was preloaded (or on the replay buffer, if nothing was), without an
        environment. The causal masks come first, and again every ``causal_refresh_freq`` gradient steps.

        Callbacks are called once after each gradient step, and may stop by returning False. Of an environment, which is not
        stepped, their ``locals`` have ``dones``, all False, and empty ``infos``. While it runs, ``num_timesteps``
        is the number of gradient steps of all calls, so that evaluations, checkpoints and logs are numbered by it; afterwards
        it is that of environment steps again. Schedules (learning rates) go from 1 to 0 over the steps of this call; after
        earlier calls they start where ``learn(reset_num_timesteps=False)`` would, so that an interrupted call and one with the
        rest follow one schedule. ``learn()`` starts schedules anew; optimizers, targets and statistics go on.

        :param gradient_steps: Number of gradient steps
        :param callback: Callback(s) called after every gradient step
        :param log_interval: Gradient steps between logs, None for none
        :param tb_log_name: Name of the run for TensorBoard
        :param progress_bar: Whether to show a progress bar (needs tqdm and rich)
        :return: The model
        """
        if gradient_steps < 0:
            raise ValueError(f"gradient_steps must be at least 0, got {gradient_steps!r}")
        self._load_offline_dataset(progress_bar)
        if self.offline_buffer is None and (self.replay_buffer is None or not can_sample(self.replay_buffer)):
            raise ValueError("There is nothing to train on: call preload(source) or load_replay_buffer(path) first")
        if not self._custom_logger:
            self._logger = configure_logger(self.verbose, self.tensorboard_log, tb_log_name, self._n_pretrain_steps == 0)
        with self._pretraining_clock(gradient_steps) as total_timesteps:
            callback = self._init_callback(callback_list(callback), progress_bar)
            # No episode ends here, and there are no infos: callbacks that ask for them find none
            without_steps = {"dones": np.zeros(self.n_envs, dtype=bool), "infos": [{} for _ in range(self.n_envs)]}
            callback.on_training_start({**locals(), **without_steps}, globals())
            while self.num_timesteps < total_timesteps:
                self.train(gradient_steps=1, batch_size=self.batch_size)
                self.num_timesteps += 1
                self._n_pretrain_steps += 1
                self._update_current_progress_remaining(self.num_timesteps, total_timesteps)
                callback.update_locals({**locals(), **without_steps})
                if not callback.on_step():
                    break
                if log_interval is not None and self.num_timesteps % log_interval == 0:
                    self._dump_pretrain_logs()
            self._steps_since_refresh = 0
            callback.on_training_end()
        return self

    @contextmanager
    def _pretraining_clock(self, gradient_steps: int) -> Iterator[int]:
        """For a while, the model's counters count the gradient steps of the offline stage."""
        names = ("num_timesteps", "_total_timesteps", "_num_timesteps_at_start", "_current_progress_remaining", "start_time")
        before = {name: getattr(self, name) for name in names}
        had_env = self.env is not None
        total_timesteps = self._n_pretrain_steps + gradient_steps
        self._env_steps_before_pretrain = self.num_timesteps
        self.num_timesteps = self._num_timesteps_at_start = self._n_pretrain_steps
        self._total_timesteps, self.start_time = total_timesteps, time.time_ns()
        self._update_current_progress_remaining(self.num_timesteps, max(1, total_timesteps))
        if not had_env:
            # Callbacks ask for the training environment
            self.env = SpacesEnv(self.observation_space, self.action_space, self.n_envs)
        try:
            yield total_timesteps
        finally:
            self.__dict__.update(before)
            self._env_steps_before_pretrain = None
            self._steps_since_refresh = 0
            if not had_env:
                self.env = None

    def _dump_pretrain_logs(self) -> None:
        seconds = max((time.time_ns() - self.start_time) / 1e9, 1e-9)
        n_steps = self.num_timesteps - self._num_timesteps_at_start
        self.logger.record("time/gradient_steps_per_second", n_steps / seconds)
        self.logger.record("time/time_elapsed", int(seconds), exclude="tensorboard")
        self.logger.record("time/gradient_steps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(step=self.num_timesteps)

    def _load_offline_dataset(self, progress_bar: bool) -> None:
        if self.offline_dataset is not None and self.offline_buffer is None and self._replay_buffer_is_empty():
            self.preload(self.offline_dataset, progress_bar=progress_bar)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        assert self.env is not None, "You must set the environment before calling learn()"
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

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save the replay buffer, and with it the preloaded transitions: the stored rows as arrays that need no pickle (``.npz``,
        also where the name has no suffix: such a file can be given away), or with the suffix ``.pkl`` as SB3 does. Buffers of
        your own classes need a pickle. A file is replaced only once the new one is complete.

        :param path: Path to the file where the replay buffer should be saved
        :raises ValueError: If a buffer of your own class is to be saved as ``.npz``
        """
        assert self.replay_buffer is not None
        is_path = isinstance(path, str | os.PathLike)
        suffix = pathlib.Path(path).suffix if is_path else ""  # type: ignore[arg-type]
        pickled = suffix == ".pkl"
        if suffix == "" and not can_be_arrays(self.replay_buffer):
            pickled = True
            warnings.warn(f"{type(self.replay_buffer).__name__} is pickled: load_replay_buffer needs trusted=True to read it")
        self.replay_buffer.offline_part = (self.offline_buffer, self._offline_marks)  # type: ignore[attr-defined]
        more = {
            "saved_after": self.n_environment_steps,
            "observation_layout": self.observation_layout,
            "reward_transform": self._saved_rewards().to_plain(),
        }
        vars(self.replay_buffer).update(more)
        try:
            with saved_when_done(path, ".pkl" if pickled else ".npz") as file:
                if pickled:
                    super().save_replay_buffer(file)
                else:
                    write_buffer(self.replay_buffer, file)
        finally:
            for name in ("offline_part", *more):
                del vars(self.replay_buffer)[name]

    def _saved_rewards(self) -> SavedRewards:
        if self._reward_transform is None:
            return SavedRewards("none", RewardTransform())
        return SavedRewards(self.reward_transform, self._reward_transform)

    def _check_rewards(self, saved: Any, name: str) -> tuple[SavedRewards, SavedRewards] | None:
        """What was done to the rewards of a file, and what the model does; None if they may stay, or the file does not say."""
        if saved is None:
            return None
        given, own = SavedRewards.from_plain(saved), self._saved_rewards()
        if self._reward_transform is None and self.reward_transform != "none":
            # The model's own numbers come with the first data
            own = given
            if given.name not in ("none", self.reward_transform):
                raise ValueError(
                    f"{name} holds rewards that were transformed by {given.name!r}, and the model's reward_transform is "
                    f"{self.reward_transform!r}: pass reward_transform={given.name!r} or 'none' to the model, or preload() it"
                )
        return given, own

    def load_replay_buffer(
        self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True, *, trusted: bool = False
    ) -> None:
        """
        Load a replay buffer, and the preloaded transitions that were saved with it. When it raises, the model has what it had.
        Transitions of another number of environments are put into as many columns as the model has environments, and rewards
        that were saved with another ``reward_transform`` get that of the model.

        :param path: Path to the file, as ``.npz`` or pickled; without its suffix, the first of these that is there
        :param truncate_last_traj: See SB3's ``load_replay_buffer``, for ``HerReplayBuffer``
        :param trusted: Whether a pickle may hold more than the replay buffers of SB3, which could run code
        :raises ValueError: If the file is not whole, or not trusted and needs to be; if the buffer is of another environment,
            is damaged, holds NaN or infinite values, or is of another number of environments and cannot be brought to that of
            the model
        """
        name = "The replay buffer"
        if isinstance(path, str | os.PathLike):
            name, path = str(path), existing(path, SUFFIXES)
        self._use_loaded_buffer(read_buffer(path, trusted), name, truncate_last_traj)

    def _use_loaded_buffer(self, buffer: ReplayBuffer, name: str, truncate_last_traj: bool) -> None:
        """All or nothing."""
        offline, marks = vars(buffer).pop("offline_part", (None, []))
        self._check_layout(vars(buffer).pop("observation_layout", None), name)
        rewards = self._check_rewards(vars(buffer).pop("reward_transform", None), name)
        saved_after = vars(buffer).pop("saved_after", self.num_timesteps)
        for one in {id(one): one for one in (buffer, offline) if one is not None}.values():
            if isinstance(one, HerReplayBuffer):
                assert self.env is not None, "You must pass an environment at load time when using `HerReplayBuffer`"
                one.set_env(self.env)
            # Update saved replay buffer device to match current setting, see GH#1561
            one.device = self.device
        online = self._fitting(buffer, name)
        if offline is buffer:
            offline = online
        elif offline is not None:
            offline = self._fitting(offline, f"{name}, preloaded part")
        if isinstance(online, HerReplayBuffer) and truncate_last_traj:
            online.truncate_last_trajectory()
        if rewards is not None:
            self._use_rewards(*rewards, {id(one): one for one in (online, offline) if one is not None}.values())
        self.replay_buffer, self.offline_buffer, self._offline_marks = online, offline, marks
        if saved_after != self.num_timesteps:
            warnings.warn(
                f"{name} was saved after {saved_after} steps, the model after {self.num_timesteps}: they are not of one "
                "moment, as they are in a checkpoint of save_checkpoint()"
            )

    def _use_rewards(self, given: SavedRewards, own: SavedRewards, buffers: Iterable[ReplayBuffer]) -> None:
        if given.transform != own.transform:
            for buffer in buffers:
                rows = buffer.rewards[: buffer.size()]
                rows[:] = own.transform(given.transform.undone(rows))
        if self._reward_transform is None and own.name == self.reward_transform != "none":
            self._reward_transform = own.transform

    def _fitting(self, buffer: ReplayBuffer, name: str) -> ReplayBuffer:
        check_loaded_buffer(buffer, self.observation_space, self.action_space, name)
        buffer = self._with_own_returns(buffer)
        return buffer if buffer.n_envs == self.n_envs else in_columns(buffer, self.n_envs, self._new_buffer, name)

    def _with_own_returns(self, buffer: ReplayBuffer) -> ReplayBuffer:
        """Rows are of single steps in both kinds of buffer: of how many steps returns are, the model says."""
        plain = (ReplayBuffer, NStepReplayBuffer)
        if type(buffer) in plain and self.replay_buffer_class in plain and type(buffer) is not self.replay_buffer_class:
            own = self._new_buffer(buffer.buffer_size * self.n_envs)
            copied = {name: value for name, value in vars(buffer).items() if name not in ("n_steps", "gamma", "device")}
            vars(own).update(copied)
            return own
        if isinstance(buffer, NStepReplayBuffer):
            returns = {name: value for name, value in self.replay_buffer_kwargs.items() if name in ("n_steps", "gamma")}
            vars(buffer).update(returns)
        return buffer

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "offline_buffer", "_offline_marks", "_buffer_with_episode"]


def _normalised(parts: list[str]) -> str:
    return f"observations with {parts} normalised" if parts else "raw observations"
