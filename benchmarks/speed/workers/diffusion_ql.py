"""
Diffusion-QL by its authors (https://github.com/Zhendong-Wang/Diffusion-Policies-for-Offline-RL) as a contestant.

Nothing of it is here: it is imported from the checkout that ``path`` of the configuration names. Its networks have no
arguments: a denoiser of 3 x 256 units, two critics of 3 x 256, Mish. Other settings are those that it publishes for
halfcheetah-medium-v2: vp schedule, eta 1, gradient norm 9, moving average of the actor every 5 updates (from the start here,
so that it is in the time: it comes after 1,000 updates otherwise).
"""

import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th

from benchmarks.speed.data import Arrays, load
from benchmarks.speed.workers.protocol import Config, NotAvailable, serve, versions
from benchmarks.speed.workers.torch_contestant import TorchContestant

SETTINGS = {"discount": 0.99, "tau": 0.005, "eta": 1.0, "beta_schedule": "vp", "lr": 3e-4, "grad_norm": 9.0}


class RollingBuffer:
    """
    Replay buffer with the interface of the authors' ``Data_Sampler``, which cannot take new rows.

    :param arrays: The transitions that it starts with, of which the oldest make room for new ones
    """

    def __init__(self, arrays: Arrays) -> None:
        names = ("observations", "actions", "next_observations", "rewards")
        rows = len(arrays["rewards"])
        values = [*(arrays[name] for name in names), 1.0 - arrays["terminations"]]
        self.columns = tuple(th.as_tensor(value).reshape(rows, -1).clone() for value in values)
        self.position = 0

    def add(self, *values: Any) -> None:
        """
        :param values: State, action, next state, reward, and 1 where it did not terminate
        """
        for column, value in zip(self.columns, values, strict=True):
            column[self.position] = th.as_tensor(value, dtype=th.float32)
        self.position = (self.position + 1) % len(self.columns[0])

    def sample(self, batch_size: int) -> tuple[th.Tensor, ...]:
        """
        :param batch_size: Number of rows
        """
        rows = th.randint(0, len(self.columns[0]), size=(batch_size,))
        return tuple(column[rows] for column in self.columns)


def import_agent(path: str, module: str, name: str) -> Any:
    """
    :param path: Root of a checkout
    :param module: Dotted name of the module, from there
    :param name: Name of the class
    :return: The class
    :raises NotAvailable: If there is no such checkout
    """
    if not (Path(path) / Path(*module.split(".")).with_suffix(".py")).is_file():
        raise NotAvailable(f"{path} has no module {module}")
    sys.path.insert(0, path)
    return getattr(__import__(module, fromlist=[name]), name)


class DiffusionQLContestant(TorchContestant):
    """
    :param config: Beside the common keys: ``path`` of the checkout, ``diffusion_steps``
    :param module: Module of the agent
    :param name: Its class
    """

    def __init__(self, config: Config, module: str = "agents.ql_diffusion", name: str = "Diffusion_QL") -> None:
        agent_class = import_agent(config["path"], module, name)
        sampler_class = import_agent(config["path"], "utils.data_sampler", "Data_Sampler")
        self.batch_size: int = config["batch_size"]
        arrays = load(config["transitions"])
        self.observations = arrays["observations"]
        self.sampler = sampler_class({**arrays, "terminals": arrays["terminations"]}, "cpu")
        self.env = None if config.get("env") is None else gym.make(config["env"])
        self.agent = agent_class(
            state_dim=arrays["observations"].shape[1],
            action_dim=arrays["actions"].shape[1],
            max_action=1.0,
            device="cpu",
            n_timesteps=config["diffusion_steps"],
            step_start_ema=0,
            **SETTINGS,
        )
        self.buffer = RollingBuffer(arrays)
        self.observation: np.ndarray | None = None

    def about(self) -> dict[str, Any]:
        """Versions and sizes."""
        networks = (self.agent.actor, self.agent.ema_model, self.agent.critic, self.agent.critic_target)
        parameters = sum(parameter.numel() for network in networks for parameter in network.parameters())
        return {"versions": versions("torch", "numpy"), "parameters": parameters}

    def update(self, n: int) -> None:
        """
        :param n: Number of updates of critics and actor
        """
        self.agent.train(self.sampler, iterations=n, batch_size=self.batch_size)

    def predict(self, n: int) -> None:
        """
        One observation; the authors' own prediction draws 50 candidates.

        :param n: Number of calls
        """
        for _ in range(n):
            self.agent.sample_action(self.observations[0])

    def learn(self, steps: int) -> dict[str, Any]:
        """
        The plainest online loop: the authors' own prediction, one step, one update of theirs.

        :param steps: Environment steps
        """
        assert self.env is not None
        if self.observation is None:
            self.observation, _ = self.env.reset(seed=0)
        for _ in range(steps):
            action = self.agent.sample_action(self.observation)
            following, reward, terminated, truncated, _ = self.env.step(action)
            self.buffer.add(self.observation, action, following, reward, 1.0 - terminated)
            self.observation = self.env.reset()[0] if terminated or truncated else following
            self.agent.train(self.buffer, iterations=1, batch_size=self.batch_size)
        return {"steps": steps}


if __name__ == "__main__":
    serve(DiffusionQLContestant)
