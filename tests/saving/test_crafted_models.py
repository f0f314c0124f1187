"""Files whose checksums are right, and whose values are those of something else."""

import json
import re
import zipfile

import numpy as np
import pytest
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.causal import CausalGraph, StreamingMoments, TransitionVariables
from sb3_causalgdp.offline.saved_buffers import read_buffer

SMALL = {"policy_kwargs": {"net_arch": [8], "world_model_net_arch": [8]}, "device": "cpu", "buffer_size": 40, "seed": 0}
OTHER = TransitionVariables(("x",), ("u",))


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("_causal_graph", CausalGraph.fully_connected(OTHER), "its causal graph is of other variables"),
        ("_causal_graph", 3, "its causal graph is of other variables"),
        ("causal_graph_history", [TransitionVariables(("x",), ("u",))], "its causal graph is of other variables"),
        ("causal_graph_history", 3, "causal_graph_history must be a list, got int"),
        ("causal_statistics", "x", "causal_statistics must be BasisMoments"),
        ("causal_statistics", StreamingMoments(3), "causal_statistics must be BasisMoments"),
    ],
)
def test_what_is_known_of_causes_is_about_the_model(tmp_path, name, value, message):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **SMALL)
    setattr(model, name, value)
    model.save(tmp_path / "model.zip", include=["causal_graph_history"])
    with pytest.raises(ValueError, match=rf"model\.zip cannot be loaded: {re.escape(message)}"):
        CausalGDP.load(tmp_path / "model.zip")


def test_statistics_of_other_variables_are_refused(tmp_path):
    model, other = (CausalGDP("MlpPolicy", env, **SMALL) for env in ("Pendulum-v1", "MountainCarContinuous-v0"))
    model.causal_statistics = other.causal_statistics
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match="of the model's variables"):
        CausalGDP.load(tmp_path / "model.zip")


@pytest.fixture(scope="module")
def hindsight():
    env = BitFlippingEnv(continuous=True, n_bits=4, max_steps=4)
    model = CausalGDP("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, learning_starts=20, **SMALL)
    return model.learn(12)


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("ep_length", 10**17, "its ep_length must be from 0 to 40"),
        ("ep_start", -1, "its ep_start must be from 0 to 39"),
        ("dones", 2.0, "its dones must be from 0 to 1"),
        ("her_ratio", 1e9, "its her_ratio must be from 0 to 1"),
        ("n_sampled_goal", 10**9, "its n_sampled_goal must be from 0 to 1000"),
        ("_current_ep_start", 10**9, "its episodes must begin at a position from 0 to 39"),
    ],
)
def test_rows_are_those_of_the_buffer(hindsight, tmp_path, name, value, message):
    buffer = hindsight.replay_buffer
    before = getattr(buffer, name)
    changed = np.full_like(before, value) if isinstance(before, np.ndarray) else value
    setattr(buffer, name, changed)
    try:
        hindsight.save_replay_buffer(tmp_path / "buffer.npz")
    finally:
        setattr(buffer, name, before)
    with pytest.raises(ValueError, match=rf"buffer\.npz cannot be read as a replay buffer: {re.escape(message)}"):
        read_buffer(tmp_path / "buffer.npz")


def test_a_sound_buffer_is_read(hindsight, tmp_path):
    hindsight.save_replay_buffer(tmp_path / "buffer.npz")
    with zipfile.ZipFile(tmp_path / "buffer.npz") as archive:
        assert json.loads(np.load(archive.open("buffer.npy")).tobytes())["format"] == 1
    np.testing.assert_array_equal(read_buffer(tmp_path / "buffer.npz").ep_length, hindsight.replay_buffer.ep_length)
