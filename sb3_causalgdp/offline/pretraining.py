"""The stage before the first step: training on recorded transitions alone."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeVar

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.common.utils import configure_logger

from sb3_causalgdp.offline.buffers import BufferedAlgorithm
from sb3_causalgdp.offline.replay import SpacesEnv, can_sample

SelfAlgorithm = TypeVar("SelfAlgorithm", bound="PretrainedAlgorithm")


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


class PretrainedAlgorithm(BufferedAlgorithm):
    """
    An algorithm that can be trained without an environment.

    :param args: As for ``OffPolicyAlgorithm``
    :param kwargs: As for ``OffPolicyAlgorithm``
    """

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self._n_pretrain_steps = 0
        self._env_steps_before_pretrain: int | None = None

    @property
    def n_pretrain_steps(self) -> int:
        """Gradient steps that were made by :meth:`pretrain`."""
        return self._n_pretrain_steps

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
