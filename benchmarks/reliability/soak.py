"""
Whether memory stays flat in a long training that does everything all the time.

    python benchmarks/reliability/soak.py --steps 200000

Eight environments of Pendulum, a causal graph every 50 steps, pictures, evaluations, saves and checkpoints. Prints the
memory of the process over the training, and how much the second half differs from its own mean.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_causalgdp import CausalGDP, TrainingCheckpointCallback
from sb3_causalgdp.callbacks.pictures import CausalPicturesCallback


def resident_megabytes() -> float:
    """Of this process."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


class Memory(BaseCallback):
    """Keeps how much memory the process has."""

    def __init__(self, every: int) -> None:
        super().__init__()
        self.every = every
        self.megabytes: list[float] = []

    def _on_step(self) -> bool:
        if self.num_timesteps % self.every == 0:
            self.megabytes.append(resident_megabytes())
            print(f"{self.num_timesteps:,} steps: {self.megabytes[-1]:.0f} MB", flush=True)
        return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=200_000)
    parser.add_argument("--every", type=int, default=4_000)
    arguments = parser.parse_args()
    th.set_num_threads(1)
    memory = Memory(arguments.every)
    with tempfile.TemporaryDirectory() as folder:
        env, evaluation = make_vec_env("Pendulum-v1", n_envs=8, seed=0), make_vec_env("Pendulum-v1", seed=1)
        # A buffer that is full early: pages that it has not touched yet are no leak
        model = CausalGDP("MlpPolicy", env, seed=0, buffer_size=20_000, causal_refresh_freq=50, train_freq=4, device="cpu")
        callbacks = [
            EvalCallback(
                evaluation, n_eval_episodes=1, eval_freq=500, best_model_save_path=folder, log_path=folder, verbose=0
            ),
            CheckpointCallback(500, f"{folder}/models"),
            TrainingCheckpointCallback(f"{folder}/checkpoints", every=4_000),
            CausalPicturesCallback(4_000, f"{folder}/pictures"),
            memory,
        ]
        model.learn(arguments.steps, callbacks)
    half = np.array(memory.megabytes[len(memory.megabytes) // 2 :])
    print(f"second half: {half.mean():.0f} MB, {half.min() / half.mean() - 1:+.1%} to {half.max() / half.mean() - 1:+.1%}")


if __name__ == "__main__":
    main()
