"""What the guidance does to a trained policy, by the benchmark's command line."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from small_models import small

pytest.importorskip("rl_zoo3")
from sb3_causalgdp import CausalGDP, TrainingCheckpointCallback

ROOT = Path(__file__).parents[2]


def test_a_precise_target_moves_actions_further_than_a_vague_one(tmp_path):
    networks = {"net_arch": [16], "world_model_net_arch": [16]}
    model = CausalGDP(
        "MlpPolicy", "Pendulum-v1", **small(networks, learning_starts=250, train_freq=1, causal_refresh_freq=260, seed=3)
    )
    folder = tmp_path / "Pendulum-v1_causalgdp_3"
    model.learn(300, TrainingCheckpointCallback(folder))
    options = ["--precisions", "0", "1", "100", "--episodes", "2"]
    command = [sys.executable, "-m", "benchmarks.learning.guidance", str(folder), *options]
    surroundings = {**os.environ, "OMP_NUM_THREADS": "1"}
    output = subprocess.run(command, cwd=ROOT, env=surroundings, capture_output=True, text=True, check=True).stdout
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in output.splitlines() if line.startswith("|")][2:]
    assert [row[1] for row in rows] == ["0", "1", "100"] and rows[0][0] == folder.name
    assert 0.0 < float(rows[1][2]) < float(rows[2][2])
    assert all(row[4].count("+-") == 1 for row in rows)
