"""
Several objects and hindsight goals: steps to a success rate with and without counterfactual replay.

    OMP_NUM_THREADS=1 python benchmarks/causal/objects.py --env Pucks --steps 20000 --seeds 0 1 2 3 4
    OMP_NUM_THREADS=1 python benchmarks/causal/objects.py --env FetchPush-v4 --steps 1000000 --seeds 0

``Pucks`` is a point that pushes a puck to a place, beside two others that roll by themselves: the puck moves only where the
point touches it. FetchPush needs gymnasium-robotics. Both algorithms are CausalGDP with SB3's HerReplayBuffer (4 goals
``future``); one has ``counterfactual_replay``. One line for each evaluation, and a CSV with ``--output``.
"""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
from gymnasium import spaces
from stable_baselines3 import HerReplayBuffer

from sb3_causalgdp import CausalGDP

BOX = spaces.Box(-2.0, 2.0, (2,), np.float64)


class Pucks(gym.Env):
    """
    A point in a square pushes a puck where it touches it; other pucks roll by themselves.

    :param n_others: Number of these
    """

    RADIUS, TOLERANCE, LENGTH = 0.25, 0.2, 50
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, n_others: int = 2) -> None:
        self.n_others = n_others
        seen = spaces.Box(-2.0, 2.0, (4 + 4 * n_others,), np.float64)
        self.observation_space = spaces.Dict({"observation": seen, "achieved_goal": BOX, "desired_goal": BOX})

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        super().reset(seed=seed)
        self.point, self.puck, self.goal = self.np_random.uniform(-1.0, 1.0, (3, 2))
        self.others, self.velocities = self.np_random.uniform(-1.0, 1.0, (2, self.n_others, 2))
        self.n_steps = 0
        return self._observation(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        self.n_steps += 1
        self.point = np.clip(self.point + 0.15 * np.asarray(action, dtype=float), -1.0, 1.0)
        away = self.puck - self.point
        distance = np.linalg.norm(away)
        if distance < self.RADIUS:
            # Out of the point's way
            self.puck = np.clip(self.point + self.RADIUS * away / max(distance, 1e-6), -1.0, 1.0)
        self.velocities = 0.9 * self.velocities + 0.2 * self.np_random.normal(size=self.velocities.shape)
        self.others = 0.9 * self.others + 0.1 * self.velocities
        reward = float(self.compute_reward(self.puck, self.goal, {}))
        return self._observation(), reward, False, self.n_steps == self.LENGTH, {"is_success": reward == 0.0}

    def _observation(self) -> dict[str, np.ndarray]:
        parts = (self.point, self.puck, self.others, self.velocities)
        seen = np.concatenate([np.ravel(part) for part in parts])
        return {"observation": seen, "achieved_goal": self.puck.copy(), "desired_goal": self.goal.copy()}

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        return -(np.linalg.norm(achieved_goal - desired_goal, axis=-1) > self.TOLERANCE).astype(np.float32)


def make(env_id: str) -> gym.Env:
    """
    :param env_id: ``Pucks`` or an id of Gymnasium
    :return: the task
    """
    if env_id == "Pucks":
        return Pucks()
    if env_id.startswith("Fetch"):
        import gymnasium_robotics

        gym.register_envs(gymnasium_robotics)
    return gym.make(env_id)


def success_rate(model: CausalGDP, env: gym.Env, episodes: int) -> float:
    """
    :param model: Acts without noise
    :param env: Its task
    :param episodes: Number of episodes, always the same ones
    :return: Share of those that end in success
    """
    n_successes = 0
    for episode in range(episodes):
        observation, _ = env.reset(seed=10_000 + episode)
        over, info = False, dict[str, Any]()
        while not over:
            action, _ = model.predict(observation, deterministic=True)
            observation, _, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        n_successes += bool(info.get("is_success", False))
    return n_successes / episodes


def run(arguments: argparse.Namespace, share: float, seed: int) -> list[dict[str, Any]]:
    """One training, as rows of the table."""
    model = CausalGDP(
        "MultiInputPolicy",
        make(arguments.env),
        counterfactual_replay=share,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        buffer_size=min(arguments.steps, 1_000_000),
        gamma=0.95,
        seed=seed,
        device="cpu",
    )
    records, env = [], make(arguments.env)
    while model.num_timesteps < arguments.steps:
        start = time.perf_counter()
        model.learn(arguments.eval_freq, reset_num_timesteps=model.num_timesteps == 0, log_interval=sys.maxsize)
        components = model.trusted_components.components
        records.append(
            {
                "environment": arguments.env,
                "counterfactual_replay": share,
                "seed": seed,
                "steps": model.num_timesteps,
                "success": success_rate(model, env, arguments.episodes),
                "components": 0 if components is None else len(components.read),
                "seconds": round(time.perf_counter() - start, 1),
            }
        )
        print(*(f"{key} {value}" for key, value in records[-1].items()), flush=True)
    return records


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="Pucks")
    parser.add_argument("--shares", nargs="+", type=float, default=[0.0, 0.5], help="of counterfactual_replay")
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--eval-freq", type=int, default=2_000)
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--output", type=Path, help="CSV file, written anew")
    arguments = parser.parse_args(argv)
    records = [record for seed in arguments.seeds for share in arguments.shares for record in run(arguments, share, seed)]
    if arguments.output is not None:
        pd.DataFrame(records).to_csv(arguments.output, index=False)


if __name__ == "__main__":
    main()
