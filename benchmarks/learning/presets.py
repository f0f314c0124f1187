"""Steps to a return of -170 on Pendulum-v1 by a preset: python benchmarks/learning/presets.py NAME [--guided] [--seed N]"""

import argparse
import json
import time

import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.presets import PRESETS, preset


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("name", choices=PRESETS)
    parser.add_argument("--guided", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--every", type=int, default=2_500)
    parser.add_argument("--until", type=float, default=-170.0)
    given = parser.parse_args()
    th.set_num_threads(1)
    model = CausalGDP("MlpPolicy", "Pendulum-v1", seed=given.seed, **preset(given.name, guided=given.guided))
    environment = make_vec_env("Pendulum-v1")
    seconds = 0.0
    for _ in range(0, given.steps, given.every):
        start = time.process_time()
        model.learn(given.every, reset_num_timesteps=model.num_timesteps == 0)
        seconds += time.process_time() - start
        environment.seed(1_000)
        mean, std = evaluate_policy(model, environment, n_eval_episodes=20)
        assert isinstance(mean, float) and isinstance(std, float)
        result = {"preset": given.name, "guided": given.guided, "seed": given.seed, "steps": model.num_timesteps}
        print(json.dumps({**result, "return": round(mean, 1), "std": round(std, 1), "seconds": round(seconds)}), flush=True)
        if mean >= given.until:
            break


if __name__ == "__main__":
    main()
