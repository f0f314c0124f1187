"""Evaluation, also in normalised scores."""

import shutil
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.callbacks import EvalCallback, ProgressBarCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_causalgdp.files import replaced_when_done
from sb3_causalgdp.offline.scores import NormalizedScore, normalized_score


def note_success(info: dict[str, Any]) -> None:
    """
    :param info: Of the last step of an episode. What Gymnasium-Robotics' mazes and hands call ``success`` is noted as
        ``is_success``, from which SB3 computes success rates
    """
    if "success" in info:
        info.setdefault("is_success", info["success"])


class WholeEvalCallback(EvalCallback):
    """
    SB3's :class:`~stable_baselines3.common.callbacks.EvalCallback`, whose ``evaluations.npz`` is replaced only once the new
    one is complete, and which also knows the success of environments that call it ``success``.
    """

    def _log_success_callback(self, locals_: dict[str, Any], globals_: dict[str, Any]) -> None:
        if locals_["done"]:
            note_success(locals_["info"])
        super()._log_success_callback(locals_, globals_)

    def _on_step(self) -> bool:
        path = self.log_path
        if path is None or self.eval_freq <= 0 or self.n_calls % self.eval_freq != 0:
            return super()._on_step()
        with replaced_when_done(f"{path}.npz") as file:
            self.log_path = str(file)
            try:
                return super()._on_step()
            finally:
                self.log_path = path


class TrainingBar(ProgressBarCallback):
    """
    SB3's progress bar, and in front of it what the model's ``progress_parts`` say, as many as there is room for. In
    ``pretrain()`` a call is one step, whatever the number of environments.
    """

    CALLS_BETWEEN_TEXTS = 100
    WIDTH = 56
    """Columns of the bar itself."""
    model: Any

    def _on_training_start(self) -> None:
        super()._on_training_start()
        self._tell()

    def _on_step(self) -> bool:
        self.pbar.update(1 if self.model.is_pretraining else self.training_env.num_envs)
        if self.n_calls % self.CALLS_BETWEEN_TEXTS == 0:
            self._tell()
        return True

    def _on_training_end(self) -> None:
        self._tell()
        super()._on_training_end()

    def _tell(self) -> None:
        text, *parts = self.model.progress_parts()
        for part in parts:
            if len(text) + len(part) + 2 > shutil.get_terminal_size().columns - self.WIDTH:
                break
            text = f"{text}, {part}"
        self.pbar.set_description(text, refresh=False)


class NormalizedEvalCallback(WholeEvalCallback):
    """
    SB3's :class:`~stable_baselines3.common.callbacks.EvalCallback`, which also logs ``eval/normalized_score`` and keeps it as
    ``last_normalized_score``.

    The environment must give the task's own rewards: wrap it in a ``Monitor`` below wrappers that change them.

    :param eval_env: The environment used for evaluation
    :param task: Name of the task, see :func:`~sb3_causalgdp.offline.scores.normalized_score`
    :param reference: ``"d4rl"`` or ``"minari"``
    :param kwargs: Arguments of ``EvalCallback``
    :raises ValueError: on an unknown task
    """

    def __init__(self, eval_env: gym.Env[Any, Any] | VecEnv, task: str, reference: str = "d4rl", **kwargs: Any) -> None:
        normalized_score(task, 0.0, reference)  # an unknown task fails here, not after the first evaluation
        self.task = task
        self.reference = reference
        self.last_normalized_score: NormalizedScore | None = None
        super().__init__(eval_env, **kwargs)

    # EvalCallback sets this between evaluating and writing the log: recorded later, the score would miss its row
    @property
    def last_mean_reward(self) -> float:
        """Mean return of the last evaluation."""
        return self._last_mean_reward

    @last_mean_reward.setter
    def last_mean_reward(self, value: float) -> None:
        self._last_mean_reward = value
        if np.isfinite(value):
            # Scores are linear in returns: the mean's score is the mean score
            self.last_normalized_score = normalized_score(self.task, value, self.reference)
            self.logger.record("eval/normalized_score", self.last_normalized_score.mean)
            if self.verbose >= 1:
                print(f"Normalized score: {self.last_normalized_score}")
