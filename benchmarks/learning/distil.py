"""
What a policy of one pass keeps of the return of the policy that it is distilled from: the same seeds, without noise.

    python benchmarks/learning/distil.py Pendulum-v1 --steps 10000
    python benchmarks/learning/distil.py HalfCheetah-v5 --checkpoint benchmarks/learning/checkpoints/HalfCheetah-v5_previous_0

A line of JSON for the teacher and for each student. "kept" is 1 where the student's return is the teacher's, 0 where it is
that of uniform actions; "relative" is the difference in shares of the teacher's return.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.checkpoints import resume


class Uniform:
    """Plays any action."""

    def __init__(self, space: Any) -> None:
        self.space = space
        self.generator = np.random.default_rng(0)

    def predict(self, observation: np.ndarray, *args: Any, **kwargs: Any) -> tuple[np.ndarray, None]:
        return self.generator.uniform(self.space.low, self.space.high, (len(observation), *self.space.shape)), None


def returns_of(policy: Any, env_id: str, n_episodes: int) -> np.ndarray:
    """Of one episode for each seed, side by side."""
    env = make_vec_env(env_id, n_episodes)
    env.seed(10_000)
    returns, _ = evaluate_policy(policy, env, n_episodes, deterministic=True, return_episode_rewards=True, warn=False)
    env.close()
    return np.array(returns)


def teacher_of(given: argparse.Namespace) -> CausalGDP:
    env = make_vec_env(given.env, seed=given.seed)
    if given.checkpoint is not None:
        return resume(CausalGDP, given.checkpoint, env, "cpu")
    model = CausalGDP("MlpPolicy", env, seed=given.seed, device="cpu")
    return model.learn(given.steps)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("env")
    parser.add_argument("--steps", type=int, default=10_000, help="of training the teacher, without --checkpoint")
    parser.add_argument("--checkpoint", type=Path, help="of the teacher, as run.py writes them")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=30)
    parser.add_argument("--students", type=json.loads, nargs="+", help="arguments of distil(), as JSON")
    given = parser.parse_args()
    th.set_num_threads(1)
    model = teacher_of(given)
    random = returns_of(Uniform(model.action_space), given.env, given.episodes).mean()
    before = returns_of(model.policy, given.env, given.episodes)
    row = {"env": given.env, "policy": "teacher", "return": round(before.mean(), 1), "std": round(before.std(), 1)}
    print(json.dumps({**row, "random": round(random, 1)}), flush=True)
    # With and without an environment in which the student acts
    for arguments in given.students or [{}, {"env": given.env}]:
        start = time.process_time()
        student = model.distil(**arguments)
        seconds = time.process_time() - start
        after = returns_of(student, given.env, given.episodes)
        difference = after - before
        row = {
            "env": given.env,
            "policy": f"student {json.dumps(arguments)}",
            "return": round(after.mean(), 1),
            "std": round(after.std(), 1),
            "relative": round(difference.mean() / abs(before.mean()), 4),
            "standard_error": round(difference.std() / len(before) ** 0.5 / abs(before.mean()), 4),
            "kept": round((after.mean() - random) / (before.mean() - random), 4),
            "seconds": round(seconds),
        }
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
