"""Trained agents that are small, as good as their checkpoints, and found by enjoy."""

import hashlib
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import yaml
from small_models import small

pytest.importorskip("rl_zoo3")
from publish import publish_checkpoint, write_table

from sb3_causalgdp import CausalGDP, TrainingCheckpointCallback

ROOT = Path(__file__).parents[2]
AGENTS = ROOT / "rl-trained-agents"


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """300 steps on Pendulum, with a causal graph, and the folder of its checkpoint."""
    networks = {"net_arch": [16], "world_model_net_arch": [16]}
    model = CausalGDP(
        "MlpPolicy", "Pendulum-v1", **small(networks, learning_starts=250, train_freq=1, causal_refresh_freq=260, seed=3)
    )
    checkpoints = tmp_path_factory.mktemp("checkpoints")
    model.learn(300, TrainingCheckpointCallback(checkpoints / "Pendulum-v1_causalgdp_3"))
    return model, checkpoints


@pytest.fixture(scope="module")
def folder(trained, tmp_path_factory):
    folder = tmp_path_factory.mktemp("published") / "rl-trained-agents"
    publish_checkpoint("Pendulum-v1", 3, {"learning_starts": 250}, trained[1], folder, episodes=2)
    write_table(folder)
    return folder


def enjoyed(folder, tmp_path, environment):
    command = [sys.executable, "-m", "sb3_causalgdp.zoo", "enjoy", "--env", environment, "-f", folder, "--no-render"]
    surroundings = {**os.environ, "OMP_NUM_THREADS": "1"}
    run = [*map(str, command), "-n", "600", "--num-threads", "1", "--device", "cpu"]
    done = subprocess.run(run, cwd=tmp_path, env=surroundings, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return float(re.search(r"Mean reward: (-?[\d.]+) ", done.stdout)[1])


def test_a_published_model_acts_as_its_checkpoint_and_has_lost_what_only_training_needs(trained, folder):
    model, _ = trained
    path = folder / "causalgdp" / "Pendulum-v1_1" / "Pendulum-v1.zip"
    published = CausalGDP.load(path, env="Pendulum-v1", device="cpu")
    observations = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    np.testing.assert_array_equal(*(one.predict(observations, deterministic=True)[0] for one in (published, model)))
    assert str(published.causal_graph()) == str(model.causal_graph())
    actions = np.zeros((50, 1), dtype=np.float32)
    effects = (one.effect_of_actions(observations, actions).reward.mean for one in (published, model))
    np.testing.assert_allclose(*effects, rtol=1e-5)
    with zipfile.ZipFile(path) as archive:
        sizes = {info.filename: info.file_size for info in archive.infolist()}
    assert all(sizes[f"{name}.optimizer.pth"] < 5_000 for name in ("actor", "critic", "world_model"))
    assert sizes["plain.bin"] < 5_000
    # A training can go on from it
    published.learn(300)
    assert published.num_timesteps == 300 and published._n_updates > model._n_updates


def test_the_card_says_how_it_was_made_and_what_it_reached(folder):
    card = yaml.safe_load((folder / "causalgdp" / "Pendulum-v1_1" / "Pendulum-v1" / "card.yml").read_text())
    command = "python benchmarks/learning/run.py --env Pendulum-v1 --steps 300 --seeds 3 --kwargs '{\"learning_starts\": 250}'"
    assert card["command"] == command and card["steps"] == 300 and card["episodes"] == 2
    assert -2_000 < card["return"] < -200 and card["versions"]["Stable-Baselines3"]
    table = (folder / "README.md").read_text()
    assert command in table and f"| Pendulum-v1 | 300 | 3 | {card['return']:,} ± {card['spread']:,} (2) |" in table


def test_enjoy_finds_what_was_published(folder, tmp_path):
    assert -2_000 < enjoyed(folder, tmp_path, "Pendulum-v1") < -200


def test_the_agents_of_this_repository_are_what_their_checksums_say():
    lines = [line.split() for line in (AGENTS / "checksums.sha256").read_text().splitlines()]
    assert {name for _, name in lines} == {path.relative_to(AGENTS).as_posix() for path in AGENTS.glob("*/*/*.zip")}
    for checksum, name in lines:
        assert hashlib.sha256((AGENTS / name).read_bytes()).hexdigest() == checksum
        assert (AGENTS / name).stat().st_size < 3_000_000


def test_enjoy_finds_an_agent_of_this_repository_that_can_swing_up(tmp_path):
    assert enjoyed(AGENTS, tmp_path, "Pendulum-v1") > -400
