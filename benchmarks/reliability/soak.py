"""
Whether memory stays flat in a long training that does everything all the time.

    python benchmarks/reliability/soak.py --steps 200000

Eight environments of Pendulum, a causal graph every 50 steps, pictures, evaluations, saves and checkpoints. Prints two
kinds of memory over the training: what the process has ("resident"), and what of it the program has asked the C library for
and not given back ("in use"). The first also holds what the C library keeps for later, which moves up and down by some
percent; a leak makes both grow. The trend is the mean of the last third against that of the one before; the first third fills
the buffer.
"""

import argparse
import ctypes
import gc
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


class _MallInfo2(ctypes.Structure):
    """What glibc says of its heap, ``mallinfo2(3)``."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks", "keepcost")
    ]


def megabytes_in_use() -> float:
    """Of this process's heap, of all its threads; glibc 2.33 or newer."""
    mallinfo2 = ctypes.CDLL(None).mallinfo2
    mallinfo2.restype = _MallInfo2
    info = mallinfo2()
    return (info.uordblks + info.hblkhd) / 1e6


class Memory(BaseCallback):
    """Keeps how much memory the process has, and how much of it is in use."""

    def __init__(self, every: int) -> None:
        super().__init__()
        self.every = every
        self.megabytes: dict[str, list[float]] = {"resident": [], "in use": []}

    def _on_step(self) -> bool:
        if self.num_timesteps % self.every == 0:
            gc.collect()  # or it would be counted whether the collector has just been here
            self.megabytes["resident"].append(resident_megabytes())
            self.megabytes["in use"].append(megabytes_in_use())
            now = ", ".join(f"{name} {values[-1]:.1f} MB" for name, values in self.megabytes.items())
            print(f"{self.num_timesteps:,} steps: {now}", flush=True)
        return True


def trend(megabytes: list[float]) -> str:
    """The last third against the one before, and how far single values are from the mean of both."""
    third = len(megabytes) // 3
    before, last = np.array(megabytes[-2 * third : -third]), np.array(megabytes[-third:])
    mean = (before.mean() + last.mean()) / 2
    single = np.concatenate((before, last)) / mean - 1
    return (
        f"{before.mean():.1f} MB, then {last.mean():.1f} MB ({last.mean() / before.mean() - 1:+.2%}); "
        f"single values {single.min():+.1%} to {single.max():+.1%}"
    )


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
    for name, values in memory.megabytes.items():
        print(f"{name}: {trend(values)}")


if __name__ == "__main__":
    main()
