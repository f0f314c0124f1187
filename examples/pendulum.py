"""Train on Pendulum, evaluate, save, load, and draw the causal graph."""

import argparse
from pathlib import Path

import numpy as np
import torch
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_causalgdp import CausalGDP

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--total-timesteps", type=int, default=10_000)
    parser.add_argument("--output-folder", type=Path, default=Path("."))
    args = parser.parse_args()
    args.output_folder.mkdir(parents=True, exist_ok=True)

    # For networks this small, more threads only wait for each other
    torch.set_num_threads(1)

    model = CausalGDP("MlpPolicy", "Pendulum-v1", seed=args.seed, verbose=0)
    model.learn(args.total_timesteps, progress_bar=True)

    # One episode in each environment: predictions are batched
    eval_env = make_vec_env("Pendulum-v1", n_envs=20, seed=args.seed + 1_000)
    mean_return, std_return = evaluate_policy(model, eval_env, n_eval_episodes=20, deterministic=True)

    model_path = args.output_folder / "causalgdp_pendulum"
    model.save(model_path)
    loaded_model = CausalGDP.load(model_path)
    obs = eval_env.observation_space.sample()
    action, _ = model.predict(obs, deterministic=True)
    loaded_action, _ = loaded_model.predict(obs, deterministic=True)
    np.testing.assert_allclose(loaded_action, action, rtol=1e-5, atol=1e-6)

    model.causal_graph().plot(args.output_folder / "causal_graph.png")
    print(f"mean return over 20 episodes: {mean_return:.1f} +- {std_return:.1f}")
