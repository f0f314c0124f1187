"""Any off-policy algorithm with the interface of Stable-Baselines3 as a contestant."""

from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from benchmarks.speed.data import Arrays, Shapes, load
from benchmarks.speed.workers.protocol import Config, versions


class OffPolicyContestant:
    """
    :param algorithm: Class of the algorithm
    :param config: Beside the common keys: ``kwargs``, arguments of the constructor; ``updates_per_call``, gradient steps of
        one call of ``train()``, None for all at once
    """

    def __init__(self, algorithm: Any, config: Config) -> None:
        self.batch_size: int = config["batch_size"]
        self.updates_per_call: int | None = config.get("updates_per_call")
        self.transitions = load(config["transitions"])
        kwargs = {"device": "cpu", "seed": 0, "batch_size": self.batch_size, **config.get("kwargs", {})}
        if config.get("env") is None:
            # No larger than its contents: a million observations of Humanoid do not fit beside those of the peers
            kwargs["buffer_size"] = len(self.transitions["rewards"])
        self.env = make_env(config, self.transitions)
        self.model = algorithm("MlpPolicy", self.env, **kwargs)
        if config.get("env") is None:
            self.model.set_logger(Logger(None, []))
            fill(self.model.replay_buffer, self.transitions)

    def about(self) -> dict[str, Any]:
        """What is measured: versions, and the sizes of the networks where they are PyTorch's."""
        about: dict[str, Any] = {"versions": versions("stable_baselines3", "sb3_contrib", "sbx-rl", "jax", "torch", "numpy")}
        if count := sum(parameter.numel() for parameter in self.model.policy.parameters()):
            about["parameters"] = count  # JAX keeps its own elsewhere
        return about

    def update(self, n: int) -> None:
        """
        :param n: Number of gradient steps
        """
        at_once = self.updates_per_call or n
        for _ in range(n // at_once):
            self.model.train(gradient_steps=at_once, batch_size=self.batch_size)

    def predict(self, n: int, n_observations: int = 1, deterministic: bool = True) -> None:
        """
        :param n: Number of calls
        :param n_observations: Observations of one call, 1 for a single one without a batch dimension
        :param deterministic: Whether the prediction is noise-free
        """
        observation = self.transitions["observations"][:n_observations]
        if n_observations == 1:
            observation = observation[0]
        for _ in range(n):
            self.model.predict(observation, deterministic=deterministic)

    def learn(self, steps: int) -> dict[str, Any]:
        """
        Go on learning.

        :param steps: Environment steps
        :return: The steps that were taken: with several environments they are a multiple
        """
        before = self.model.num_timesteps
        self.model.learn(steps, reset_num_timesteps=before == 0, log_interval=None)
        return {"steps": self.model.num_timesteps - before}


def make_env(config: Config, transitions: Arrays) -> VecEnv:
    """
    :param config: Of the worker
    :param transitions: Their shapes are the spaces where no task is asked for
    :return: The environments, all in this process
    """
    if config.get("env") is not None:
        return make_vec_env(config["env"], n_envs=config.get("n_envs", 1), seed=0)
    shapes = transitions["observations"].shape[1], transitions["actions"].shape[1]

    def make() -> gym.Env:
        return Shapes(*shapes)

    return DummyVecEnv([make])


def fill(replay_buffer: Any, transitions: Arrays) -> None:
    """
    :param replay_buffer: Of one environment
    :param transitions: What is added to it
    """
    columns = ("observations", "next_observations", "actions", "rewards")
    dones = np.maximum(transitions["terminations"], transitions["truncations"])
    for row, done in enumerate(dones):
        values = [transitions[name][row : row + 1] for name in columns]
        replay_buffer.add(*values, np.array([done]), [{"TimeLimit.truncated": bool(transitions["truncations"][row])}])
