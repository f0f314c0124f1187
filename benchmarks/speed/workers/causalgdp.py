"""
CausalGDP as a contestant.

Arguments that the installed version does not have are told apart: what asks for the behaviour that it has anyway is dropped
(``actor_update="chain"``, ``compile=False``), anything else is not available.
"""

import inspect
import time
from dataclasses import asdict
from typing import Any

import torch as th

from benchmarks.speed.workers.call_timer import CallTimer
from benchmarks.speed.workers.off_policy import OffPolicyContestant
from benchmarks.speed.workers.protocol import Config, NotAvailable, serve
from benchmarks.speed.workers.torch_contestant import TorchContestant
from sb3_causalgdp import CausalGDP
from sb3_causalgdp.callbacks import CausalWorldModelCallback
from sb3_causalgdp.causal import discover

BEHAVIOUR_WITHOUT_ARGUMENT = {"actor_update": "chain", "compile": False}


class TimedRefreshes(CausalWorldModelCallback):
    """The algorithm's own callback, with the CPU seconds of its refreshes."""

    def __init__(self) -> None:
        super().__init__()
        self.seconds: list[float] = []

    def refresh(self) -> None:
        start = time.process_time()
        super().refresh()
        self.seconds.append(time.process_time() - start)


class CausalGDPContestant(OffPolicyContestant, TorchContestant):
    """
    :param config: See :class:`OffPolicyContestant`; and ``masks``, whether the causal graph of the transitions is found and
        set, so that the sampling is guided
    """

    def __init__(self, config: Config) -> None:
        super().__init__(CausalGDP, {**config, "kwargs": supported(config.get("kwargs", {}))})
        if config.get("masks", True) and config.get("env") is None:
            names = ("observations", "actions", "next_observations", "rewards")
            variables = self.model.transition_variables
            rows = variables.stack(*(self.transitions[name] for name in names))
            self.model.set_causal_graph(discover(self.model.causal_discovery, rows, variables))

    def about(self) -> dict[str, Any]:
        """Versions and what the defaults of the installed version are."""
        policy = self.model.policy
        settings = {
            name: getattr(self.model, name, None) for name in ("actor_update", "compile", "diffusion_steps", "guidance")
        }
        settings["net_arch"] = getattr(policy, "net_arch", None)
        settings["activation"] = getattr(getattr(policy, "activation_fn", None), "__name__", None)
        settings["guided"] = bool(policy.is_guided)
        return {**super().about(), "settings": settings}

    def learn(self, steps: int) -> dict[str, Any]:
        """
        Go on learning.

        :param steps: Environment steps
        :return: The steps that were taken, and the CPU seconds of each causal refresh among them
        """
        before, refreshes = self.model.num_timesteps, TimedRefreshes()
        self.model.learn(steps, callback=refreshes, reset_num_timesteps=before == 0, log_interval=None)
        return {"steps": self.model.num_timesteps - before, "refresh_seconds": refreshes.seconds}

    def profile(self, n: int) -> dict[str, Any]:
        """
        :param n: Number of updates
        :return: CPU seconds of one update, ``plain`` and with all functions ``wrapped``; ``parts``: seconds by part;
            ``functions``: what was called, by qualified name, per update
        """
        timer = CallTimer()
        extra = (
            (th.Tensor, "backward"),
            (th.autograd, "grad"),
            (th.nn.utils, "clip_grad_norm_"),
            (th.optim.Adam, "step"),
            (th.optim.Optimizer, "zero_grad"),
        )
        start = time.process_time()
        self.update(n)
        middle = time.process_time()
        with timer.attached(("sb3_causalgdp", "stable_baselines3"), extra, owner=self.model._updates):
            timer.wrap(self.update, "update")(n)
        functions = {name: {key: value / n for key, value in asdict(taken).items()} for name, taken in timer.functions.items()}
        parts = {name: seconds / n for name, seconds in timer.seconds.items()}
        return {
            "plain": (middle - start) / n,
            "wrapped": functions["update"]["inclusive"],
            "parts": parts,
            "functions": functions,
        }


def supported(kwargs: dict[str, Any]) -> dict[str, Any]:
    """
    :param kwargs: Arguments of the algorithm's constructor
    :return: Those that the installed version has
    :raises NotAvailable: If one is missing that would change what it does
    """
    known = inspect.signature(CausalGDP.__init__).parameters
    missing = [name for name in kwargs if name not in known]
    for name in missing:
        if name not in BEHAVIOUR_WITHOUT_ARGUMENT or kwargs[name] != BEHAVIOUR_WITHOUT_ARGUMENT[name]:
            raise NotAvailable(f"CausalGDP has no argument {name}={kwargs[name]!r}")
    return {name: value for name, value in kwargs.items() if name in known}


if __name__ == "__main__":
    serve(CausalGDPContestant)
