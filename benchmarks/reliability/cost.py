"""
What checkpoints cost: every 10,000 steps, with a replay buffer that holds 1,000,000 transitions.

    python benchmarks/reliability/cost.py --env HalfCheetah-v5

The buffer is filled with random numbers. A checkpoint writes the transitions of the last 10,000 steps; its time, with all that
reaches the disk, is divided by that of 10,000 steps of training.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch as th

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.checkpoints import save_checkpoint


def fill(model: CausalGDP, n_rows: int) -> None:
    """Random rows behind those that are there."""
    buffer, generator = model.replay_buffer, np.random.default_rng(0)
    assert buffer is not None
    rows = (buffer.pos + np.arange(n_rows)) % buffer.buffer_size
    for column in (buffer.observations, buffer.next_observations, buffer.actions, buffer.rewards):
        column[rows] = generator.uniform(-1.0, 1.0, (n_rows, *column.shape[1:])).astype(column.dtype)
    buffer.full = buffer.full or buffer.pos + n_rows >= buffer.buffer_size
    buffer.pos = int((buffer.pos + n_rows) % buffer.buffer_size)
    model._stored_position += n_rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--rows", type=int, default=1_000_000)
    parser.add_argument("--every", type=int, default=10_000)
    parser.add_argument("--steps", type=int, default=2_000, help="of training that are timed")
    parser.add_argument("--checkpoints", type=int, default=10)
    parser.add_argument("--folder", type=Path, help="where to write; a temporary folder by default")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    model = CausalGDP("MlpPolicy", arguments.env, seed=0, buffer_size=arguments.rows, device="cpu").learn(1_000)
    start = time.perf_counter()
    model.learn(arguments.steps, reset_num_timesteps=False)
    training = (time.perf_counter() - start) / arguments.steps * arguments.every
    fill(model, arguments.rows)
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        seconds = []
        for _ in range(arguments.checkpoints + 1):
            start = time.perf_counter()
            save_checkpoint(model, folder)
            seconds.append(time.perf_counter() - start)
            fill(model, arguments.every)
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
    first, *others = seconds
    print(f"{arguments.every:,} steps of training: {training:.1f} s")
    print(f"first checkpoint, {arguments.rows:,} transitions: {first:.2f} s; folder: {size / 1e6:.0f} MB")
    print(
        f"those after it: {np.median(others):.3f} s, at most {max(others):.3f} s: {np.mean(others) / training:.2%} of training"
    )


if __name__ == "__main__":
    main()
