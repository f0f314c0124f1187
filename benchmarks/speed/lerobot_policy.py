"""
Cost of guidance in a call of LeRobot's DiffusionPolicy: python benchmarks/speed/lerobot_policy.py [--widths 512 1024 2048]

Needs lerobot 0.4. Weights are random: time does not depend on them. CPU time of one thread, one observation; plain and guided
calls take turns, and what is printed is the median of each and the median of their quotients. "linearised" asks the world
model once a call, at the middle of the actions.
"""

import argparse
import json
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import torch as th
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.diffusion.configuration_diffusion import DiffusionConfig
from lerobot.policies.diffusion.modeling_diffusion import DiffusionPolicy

from sb3_causalgdp.causal import CausalGuidance, MaskedWorldModel, RewardTarget
from sb3_causalgdp.causal.guidance import LinearisedGuidance
from sb3_causalgdp.diffusion import ActionUnits, GuidedScheduler

N_STATES, N_GOAL, N_ACTIONS = 4, 16, 2  # PushT's goal is 16 numbers


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--widths", type=int, nargs="+", default=[512, 1024, 2048], help="of the U-Net, LeRobot's by default")
    parser.add_argument("--inference-steps", type=int, default=10)
    parser.add_argument("--calls", type=int, default=10)
    given = parser.parse_args()
    th.set_num_threads(1)
    config = DiffusionConfig(
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (N_STATES,)),
            "observation.environment_state": PolicyFeature(FeatureType.ENV, (N_GOAL,)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (N_ACTIONS,))},
        down_dims=tuple(given.widths),
        num_inference_steps=given.inference_steps,
        device="cpu",
    )
    policy = DiffusionPolicy(config).eval()
    batch = {"observation.state": th.randn(1, N_STATES), "observation.environment_state": th.randn(1, N_GOAL)}
    world_model, state = MaskedWorldModel(N_STATES, N_ACTIONS), batch["observation.state"]
    guidance = CausalGuidance(world_model, state, state, RewardTarget(th.tensor(1.0)))
    units = ActionUnits.from_min_max(th.zeros(N_ACTIONS), th.full((N_ACTIONS,), 512.0))
    scheduler = GuidedScheduler(policy.diffusion.noise_scheduler, position=config.n_obs_steps - 1, units=units)
    policy.diffusion.noise_scheduler = scheduler

    wishes: dict[str, Callable[[], Any]] = {
        "plain": lambda: None,
        "guided": lambda: guidance,
        "linearised": lambda: LinearisedGuidance(guidance, th.full((1, N_ACTIONS), 256.0)),
    }

    def milliseconds(name: str) -> float:
        policy.reset()
        start = time.process_time()
        scheduler.guidance = wishes[name]()
        policy.select_action(batch)
        return 1e3 * (time.process_time() - start)

    for name in wishes:
        milliseconds(name)
    rounds = [{name: milliseconds(name) for name in wishes} for _ in range(given.calls)]
    result = {
        "widths": given.widths,
        "parameters": sum(parameter.numel() for parameter in policy.parameters()),
        "steps": given.inference_steps,
        "ms": {name: round(median(one[name] for one in rounds), 1) for name in wishes},
        "costs": {
            name: round(median(one[name] / one["plain"] for one in rounds) - 1.0, 3) for name in ("guided", "linearised")
        },
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
