"""
CausalGDP by the paper's authors (https://github.com/xx987/CausalGDP) as a contestant.

Nothing of it is here: it is imported from the checkout that ``path`` of the configuration names. Two programs of theirs:

- updates: ``agents/causal_diffusion.py``, the agent of the offline tasks. Diffusion-QL with masked critics, and a transition
  and a reward model that are trained beside it. Nothing is guided in its update, so it does less than ours;
- environment steps: ``Gym_Tasks/HalfCheetah.py``, a script of its own for the online tasks: guided predictions with K = 10,
  networks of at most 2 x 256, HalfCheetah-v4, masks every 200 steps, one update a step whose Q term goes through one denoising
  step instead of the chain. It is run as it is, but for a replay buffer that is not empty, so that it updates from the start.
"""

import importlib.util
import sys
from pathlib import Path
from typing import Any

import gymnasium

from benchmarks.speed.data import Arrays, load
from benchmarks.speed.workers.diffusion_ql import DiffusionQLContestant
from benchmarks.speed.workers.protocol import Config, NotAvailable, serve, versions


class AuthorsContestant(DiffusionQLContestant):
    """
    :param config: As for Diffusion-QL
    """

    def __init__(self, config: Config) -> None:
        super().__init__(config, "agents.causal_diffusion", "Diffusion_Causal")

    def about(self) -> dict[str, Any]:
        """Versions and sizes."""
        networks = (self.agent.f_phi, self.agent.g_omega)
        about = super().about()
        about["parameters"] += sum(parameter.numel() for network in networks for parameter in network.parameters())
        return about


class AuthorsScript:
    """
    The script of the online task.

    :param config: ``path`` of the checkout, ``transitions``
    """

    EPISODES = 2  # of one call: rewards guide from the second episode on

    def __init__(self, config: Config) -> None:
        self.script = load_script(Path(config["path"]) / "Gym_Tasks")
        self.batch_size: int = config["batch_size"]
        self.script.ReplayBuffer = _filled(self.script.ReplayBuffer, load(config["transitions"]), self.batch_size)

    def about(self) -> dict[str, Any]:
        """Versions."""
        return {"versions": versions("torch", "numpy", "gymnasium", "mujoco")}

    def learn(self, steps: int) -> dict[str, Any]:
        """
        :param steps: Environment steps
        """
        before = len(self.script.actions)
        env = gymnasium.wrappers.TimeLimit(self.script.env.unwrapped, steps // self.EPISODES)
        self.script.train_diffusion_qlearning_online(
            env, num_episodes=self.EPISODES, batch_size=self.batch_size, alpha_policy=5
        )
        return {"steps": len(self.script.actions) - before}


def load_script(folder: Path) -> Any:
    """
    :param folder: Of the online tasks
    :return: The module of HalfCheetah's
    :raises NotAvailable: If it is not there
    """
    if not (folder / "HalfCheetah.py").is_file():
        raise NotAvailable(f"{folder} has no HalfCheetah.py")
    sys.path.insert(0, str(folder))
    # A module of theirs imports the unmaintained gym, of which it uses nothing
    sys.modules.setdefault("gym", gymnasium)
    spec = importlib.util.spec_from_file_location("authors_half_cheetah", folder / "HalfCheetah.py")
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    return script


def _filled(buffer_class: Any, arrays: Arrays, n_rows: int) -> Any:
    class FilledBuffer(buffer_class):
        def __init__(self, *args: Any, **kwargs: Any) -> None:
            super().__init__(*args, **kwargs)
            names = ("observations", "actions", "rewards", "next_observations", "terminations")
            for row in zip(*(arrays[name][:n_rows] for name in names), strict=True):
                self.push(*row)

    return FilledBuffer


def make(config: Config) -> AuthorsContestant | AuthorsScript:
    """
    :param config: With a task, the script; without one, the agent
    """
    return AuthorsContestant(config) if config.get("env") is None else AuthorsScript(config)


if __name__ == "__main__":
    serve(make)
