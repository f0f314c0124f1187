"""The copy of a replay buffer on a device holds its rows; here the device is a CPU, and nothing else differs."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import small
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.acceleration.device_replay import DeviceReplay

CPU = th.device("cpu")
ACTIONS = spaces.Box(-1.0, 1.0, (2,))
VECTORS = spaces.Box(-np.inf, np.inf, (3,), np.float64)
DICTIONARIES = spaces.Dict({"image": spaces.Box(0, 255, (4, 4, 3), np.uint8), "vector": VECTORS})
KWARGS = small(batch_size=16, train_freq=1)


def make_buffer(space, n_envs, size=10):
    kind = DictReplayBuffer if isinstance(space, spaces.Dict) else ReplayBuffer
    return kind(size * n_envs, space, ACTIONS, device="cpu", n_envs=n_envs)


def add_rows(buffer, n_rows, rng):
    """Rows that differ, some of them ends of episodes, some of these by their time limit."""
    n_envs = buffer.n_envs

    def observations(space):
        if isinstance(space, spaces.Dict):
            return {key: observations(part) for key, part in space.items()}
        return rng.uniform(0, 200, (n_envs, *space.shape)).astype(space.dtype)

    for _ in range(n_rows):
        infos = [{"TimeLimit.truncated": bool(rng.integers(2))} for _ in range(n_envs)]
        rows = (rng.uniform(-1, 1, (n_envs, 2)), rng.standard_normal(n_envs), rng.integers(2, size=n_envs))
        buffer.add(observations(buffer.observation_space), observations(buffer.observation_space), *rows, infos)


def all_rows(buffer, monkeypatch):
    """What the buffer's own sampling says of each row."""
    positions, envs = (grid.ravel() for grid in np.meshgrid(range(buffer.size()), range(buffer.n_envs)))
    with monkeypatch.context() as patch:
        patch.setattr(np.random, "randint", lambda *args, **kwargs: envs)
        return positions, envs, buffer._get_samples(positions)


@pytest.mark.parametrize("space", [VECTORS, DICTIONARIES], ids=["vectors", "dictionaries"])
@pytest.mark.parametrize("n_envs", [1, 3])
# Not full, just full, over the end, unchanged, exactly once around, more than once around
@pytest.mark.parametrize("added", [[4, 3], [10], [7, 5], [6, 0, 2], [4, 10], [10, 10], [7, 25], [3, 27, 1]])
def test_the_copy_has_the_rows_of_the_buffer_however_many_were_added(space, n_envs, added, monkeypatch):
    buffer, rng = make_buffer(space, n_envs), np.random.default_rng(0)
    copy = DeviceReplay(buffer, CPU)
    for n_rows in added:
        add_rows(buffer, n_rows, rng)
        copy.copy_new_rows()
        positions, envs, expected = all_rows(buffer, monkeypatch)
        found = copy.transitions(th.as_tensor(positions), th.as_tensor(envs))
        assert type(found) is type(expected)
        for name in ("observations", "actions", "next_observations", "dones", "rewards"):
            theirs, ours = getattr(expected, name), getattr(found, name)
            th.testing.assert_close(ours, theirs, rtol=1e-6, atol=1e-6, check_dtype=False)
        assert expected.dones.min() == 0.0


def test_every_row_is_drawn_about_as_often_as_another():
    buffer = make_buffer(VECTORS, 2, size=5)
    add_rows(buffer, 4, np.random.default_rng(0))
    th.manual_seed(0)
    rewards, counts = DeviceReplay(buffer, CPU).sample(8_000).rewards.unique(return_counts=True)
    assert len(rewards) == 8
    assert counts.min() > 850 and counts.max() < 1_150


def test_only_a_gpu_needs_a_copy_and_only_buffers_whose_rows_are_transitions_have_one():
    assert not DeviceReplay.covers(make_buffer(VECTORS, 1), CPU)
    assert DeviceReplay.has_plain_rows(make_buffer(VECTORS, 1))
    assert DeviceReplay.has_plain_rows(make_buffer(DICTIONARIES, 1))
    assert not DeviceReplay.has_plain_rows(NStepReplayBuffer(10, VECTORS, ACTIONS, device="cpu"))
    shared = ReplayBuffer(10, VECTORS, ACTIONS, device="cpu", optimize_memory_usage=True, handle_timeout_termination=False)
    assert not DeviceReplay.has_plain_rows(shared)


@pytest.mark.parametrize("free, fits", [(2_000, True), (1_000, False)])
def test_a_buffer_that_does_not_fit_stays_where_it_is(free, fits, monkeypatch):
    # 10 rows of 3 + 2 + 3 + 1 + 1 + 1 numbers in 32 bits are 440 bytes, and nearly half of the memory stays free
    monkeypatch.setattr(DeviceReplay, "LARGEST_SHARE", 0.25)
    monkeypatch.setattr(th.cuda, "mem_get_info", lambda device: (free, 10**9))
    assert DeviceReplay.covers(make_buffer(VECTORS, 1), th.device("cuda")) is fits


@pytest.fixture
def copies_on_a_cpu(monkeypatch):
    monkeypatch.setattr(DeviceReplay, "covers", classmethod(lambda cls, buffer, device: cls.has_plain_rows(buffer)))


@pytest.fixture
def no_other_sampling(monkeypatch):
    def fail(*args, **kwargs):
        raise AssertionError("sampled from the buffer itself")

    monkeypatch.setattr(ReplayBuffer, "_get_samples", fail)


@pytest.mark.usefixtures("copies_on_a_cpu", "no_other_sampling")
def test_training_draws_from_the_copy_and_the_same_for_the_same_seed():
    weights = []
    for _ in range(2):
        model = CausalGDP("MlpPolicy", "Pendulum-v1", **{**KWARGS, "buffer_size": 150, "learning_starts": 100})
        model.learn(220)  # over the end of the buffer
        copy = model._updates.batches.on_device(model.replay_buffer)
        copy.copy_new_rows()
        np.testing.assert_allclose(copy.columns["observations"].numpy(), model.replay_buffer.observations)
        weights.append(th.nn.utils.parameters_to_vector(model.policy.parameters()))
    th.testing.assert_close(*weights, rtol=0, atol=0)


@pytest.mark.usefixtures("copies_on_a_cpu", "no_other_sampling")
def test_offline_and_online_transitions_have_a_copy_each_and_none_is_saved(tmp_path):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **{**KWARGS, "buffer_size": 200, "learning_starts": 0})
    rng = np.random.default_rng(0)
    rows = {name: rng.standard_normal((50, 3)) for name in ("observations", "next_observations")}
    rows |= {"actions": rng.uniform(-2, 2, (50, 1)), "rewards": rng.standard_normal(50)}
    rows |= {"terminations": np.zeros(50), "truncations": np.arange(50) == 49}
    model.preload(rows).pretrain(3)
    assert list(model._updates.batches._on_device) == ["offline"]
    model.preload({**rows, "rewards": rows["rewards"] + 1.0})
    model.learn(20)
    assert set(model._updates.batches._on_device) == {"offline", "online"}
    assert model._updates.batches.on_device(model.offline_buffer).sample(1_000).rewards.unique().numel() == 100
    model.save(tmp_path / "model")
    assert CausalGDP.load(tmp_path / "model")._updates.batches._on_device == {}


@pytest.mark.usefixtures("copies_on_a_cpu")
def test_observations_that_are_normalised_anew_are_not_copied():
    env = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    model = CausalGDP("MlpPolicy", env, **KWARGS).learn(30)
    assert model._updates.batches._on_device == {}
