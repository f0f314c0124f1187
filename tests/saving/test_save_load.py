import inspect
import io
import json
import os
import pickle
import subprocess
import sys
import warnings
import zipfile
from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import SPREAD, small
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import NormalActionNoise
from torch import nn

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback
from sb3_causalgdp.causal import CausalGraph, TransitionVariables

KWARGS = small(**SPREAD, learning_starts=50, batch_size=16, gradient_steps=2, causal_refresh_freq=100, causal_half_life=400.0)


class RecordingCallback(CausalWorldModelCallback):
    """Keeps when it refreshed, and from how many transitions."""

    def __init__(self):
        super().__init__(min_transitions=50, diagnostics_batch_size=16)
        self.refreshes = []

    def refresh(self):
        super().refresh()
        self.refreshes.append((self.model.num_timesteps, self.model.causal_statistics.n_samples))


class PlaneEnv(gym.Env):
    """Wants the actions to be small."""

    def __init__(self, n_observations=3, n_actions=1):
        self.observation_space = spaces.Box(-1.0, 1.0, (n_observations,))
        self.action_space = spaces.Box(-1.0, 1.0, (n_actions,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), -float(np.square(action).sum()), False, False, {}


def train(total_timesteps=250, env="Pendulum-v1", **kwargs):
    model = CausalGDP("MlpPolicy", env, **{**KWARGS, **kwargs})
    return model.learn(total_timesteps, callback=RecordingCallback())


@pytest.fixture(scope="module")
def trained(observations):
    model = train()
    assert all(np.unique(actions).size > 6 for actions in predictions(model, observations))
    return model


@pytest.fixture(scope="module")
def saved(trained, tmp_path_factory):
    folder = tmp_path_factory.mktemp("saved")
    trained.save(folder / "model.zip")
    trained.save_replay_buffer(folder / "buffer.pkl")
    return folder


@pytest.fixture(scope="module")
def observations():
    angle = np.linspace(-3.0, 3.0, 12)
    return np.stack([np.cos(angle), np.sin(angle), np.linspace(-4.0, 4.0, 12)], axis=1).astype(np.float32)


def predictions(model, observations, seed=3):
    deterministic, _ = model.predict(observations, deterministic=True)
    th.manual_seed(seed)
    stochastic, _ = model.predict(observations, deterministic=False)
    return deterministic, stochastic


def assert_same_predictions(model, other, observations):
    for actions, others in zip(predictions(model, observations), predictions(other, observations), strict=True):
        np.testing.assert_array_equal(actions, others)


def assert_same_tree(tree, other):
    """State dicts, lists and tensors, bit by bit."""
    assert type(tree) is type(other)
    if isinstance(tree, dict):
        assert list(tree) == list(other)
        for key, value in tree.items():
            assert_same_tree(value, other[key])
    elif isinstance(tree, (list, tuple)):
        assert len(tree) == len(other)
        for value, other_value in zip(tree, other, strict=True):
            assert_same_tree(value, other_value)
    elif isinstance(tree, th.Tensor):
        assert tree.dtype == other.dtype and th.equal(tree, other)
    else:
        assert tree == other


# The whole model --------------------------------------------------------------------------------------------------------


def test_every_network_optimizer_and_buffer_survives(trained, saved):
    loaded = CausalGDP.load(saved / "model.zip", device="cpu")
    assert_same_tree(dict(trained.policy.state_dict()), dict(loaded.policy.state_dict()))
    for name in ("actor", "critic", "world_model"):
        state = getattr(trained, name).optimizer.state_dict()
        assert any(values["exp_avg_sq"].any() for values in state["state"].values())
        assert_same_tree(state, getattr(loaded, name).optimizer.state_dict())
    assert not loaded.policy.actor_target.training
    # What was learned, not what a new model starts with
    fresh = CausalGDP("MlpPolicy", "Pendulum-v1", **KWARGS).policy.state_dict()
    for key in ("reward_target", "return_std", "guidance_ready", "world_model.state_mean", "world_model.n_batches"):
        assert not th.equal(loaded.policy.state_dict()[key], fresh[key]), key


def test_every_module_of_the_model_is_part_of_what_is_saved(trained):
    names, _ = trained._get_torch_save_params()
    modules = [value for value in vars(trained).values() if isinstance(value, nn.Module)]
    known = {id(tensor) for tensor in (*trained.policy.parameters(), *trained.policy.buffers())}
    for module in modules:
        assert {id(tensor) for tensor in (*module.parameters(), *module.buffers())} <= known
    optimizers = {
        f"{name}.optimizer"
        for name, module in trained.policy.named_modules()
        if isinstance(vars(module).get("optimizer"), th.optim.Optimizer)
    }
    assert set(names) == {"policy"} | optimizers


def test_what_is_known_of_the_causes_survives(trained, saved):
    loaded = CausalGDP.load(saved / "model.zip", device="cpu")
    assert loaded.causal_graph() == trained.causal_graph()
    assert loaded.causal_graph().num_timesteps == 200
    assert loaded.transition_variables == trained.transition_variables
    for part in ("raw", "dynamics", "reward"):
        moments, others = getattr(trained.causal_statistics, part), getattr(loaded.causal_statistics, part)
        for name in ("mean", "count", "n_samples", "half_life", "names"):
            np.testing.assert_array_equal(getattr(moments, name), getattr(others, name))
        np.testing.assert_array_equal(moments.covariance(), others.covariance())
        assert moments.n_filled == others.n_filled
    counters = ("num_timesteps", "_n_updates", "_steps_since_refresh", "_fed_position", "_episode_num")
    for name in counters:
        assert getattr(loaded, name) == getattr(trained, name), name
    assert (loaded.num_timesteps, loaded._steps_since_refresh) == (256, 56)


def test_predictions_survive_bit_by_bit(trained, saved, observations):
    assert_same_predictions(trained, CausalGDP.load(saved / "model.zip", device="cpu"), observations)


def test_a_loaded_model_trains_on_as_the_original_would(saved):
    states = []
    for _ in range(2):
        original = CausalGDP.load(saved / "model.zip", env=gym.make("Pendulum-v1"), device="cpu")
        original.load_replay_buffer(saved / "buffer.pkl")
        original.set_logger(configure(None, []))
        original.set_random_seed(5)
        original.train(gradient_steps=2, batch_size=16)
        copy = io.BytesIO()
        original.save(copy)
        loaded = CausalGDP.load(copy, env=gym.make("Pendulum-v1"), device="cpu")
        loaded.load_replay_buffer(saved / "buffer.pkl")
        loaded.set_logger(configure(None, []))
        for model in (original, loaded):
            model.set_random_seed(6)
            model.train(gradient_steps=3, batch_size=16)
            states.append(deepcopy(dict(model.policy.state_dict())))
    for state in states[1:]:
        assert_same_tree(states[0], state)


ARGUMENTS = {
    "learning_rate": 2e-3,
    "buffer_size": 500,
    "learning_starts": 7,
    "batch_size": 32,
    "tau": 0.01,
    "gamma": 0.9,
    "gradient_steps": 2,
    "replay_buffer_class": ReplayBuffer,
    "replay_buffer_kwargs": {"handle_timeout_termination": False},
    "optimize_memory_usage": True,
    "critic_learning_rate": 5e-4,
    "world_model_learning_rate": 3e-4,
    "eta": 0.5,
    "denoising_weight": 0.7,
    "actor_update": "chain",
    "q_scale": "advantage",
    "expectile": 0.6,
    "advantage_temperature": 2.0,
    "improvement_step": 0.2,
    "bound_penalty": 0.2,
    "pessimism": 0.3,
    "exploration_optimism": 0.4,
    "exploration_temperature": 0.7,
    "target_policy_noise": 0.15,
    "target_noise_clip": 0.4,
    "policy_delay": 4,
    "world_model_delay": 4,
    "max_q_backup": True,
    "max_grad_norm": 3.0,
    "diffusion_steps": 3,
    "noise_schedule": "cosine",
    "sampler": "ddim",
    "ddim_eta": 0.5,
    "n_action_candidates": 4,
    "exploration_noise": 0.3,
    "guidance": "score",
    "guidance_target": "reward",
    "guidance_covariance": "tweedie",
    "guidance_scale": [0.1, 0.2, 0.3],
    "state_guidance_scale": 0.4,
    "outcome_guidance_scale": 0.6,
    "causal_discovery_kwargs": {"threshold": 0.05},
    "causal_window": 5_000,
    "sample_masks": False,
    "state_names": ["x", "y", "speed"],
    "action_names": ["push"],
    "causal_abstraction": {"patience": 3},
    "counterfactual_replay": 0.25,
    "offline_dataset": "D4RL/pointmaze/umaze-v2",
    "pretrain_steps": 9,
    "offline_fraction": 0.25,
    "reward_transform": "antmaze",
    "causal_refresh_freq": 77,
    "causal_half_life": 1234.0,
    "tensorboard_log": "somewhere",
    "policy_kwargs": {"net_arch": [8], "activation_fn": "tanh", "world_model_net_arch": [8], "critic_normalization": "layer"},
    "compile": True,
    "cuda_graph": False,
    "torch_threads": 2,
    "verbose": 0,
    "seed": 11,
}


def test_every_argument_is_an_attribute_and_survives():
    model = CausalGDP("MlpPolicy", "Pendulum-v1", device="cpu", **ARGUMENTS)
    stream = io.BytesIO()
    model.save(stream)
    loaded = CausalGDP.load(stream, device="cpu")
    defaults = inspect.signature(CausalGDP.__init__).parameters
    # SB3 keeps these in another form, and a custom buffer and n_steps exclude each other
    elsewhere = {"self", "policy", "env", "train_freq", "action_noise", "stats_window_size", "device", "_init_setup_model"}
    assert set(defaults) - elsewhere - set(ARGUMENTS) == {"n_steps", "causal_discovery"}
    for name, value in ARGUMENTS.items():
        assert value != defaults[name].default or name == "verbose"
        assert getattr(model, name) == getattr(loaded, name) == value, name
    policy = loaded.policy
    assert (policy.actor.schedule.name, policy.actor.schedule.n_steps, policy.actor.sampler) == ("cosine", 3, "ddim")
    assert (policy.discount, policy.n_action_candidates, policy.guidance_rule.scales) == (0.9, 4, [0.1, 0.2, 0.3])


def test_steps_that_a_buffer_of_ones_own_ignores_are_not_ignored_in_silence():
    with pytest.warns(UserWarning, match="`n_steps=3` is ignored"):
        CausalGDP("MlpPolicy", "Pendulum-v1", n_steps=3, replay_buffer_class=ReplayBuffer, buffer_size=100, device="cpu")


def test_schedules_and_noise_survive():
    model = CausalGDP(
        "MlpPolicy",
        "Pendulum-v1",
        learning_rate=lambda progress: 1e-3 * progress,
        critic_learning_rate=lambda progress: 2e-3 * progress,
        world_model_learning_rate=lambda progress: 3e-3 * progress,
        action_noise=NormalActionNoise(np.zeros(1), 0.3 * np.ones(1)),
        n_steps=3,
        train_freq=(2, "episode"),
        **{key: KWARGS[key] for key in ("buffer_size", "device", "policy_kwargs")},
    )
    stream = io.BytesIO()
    model.save(stream)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        # Not of a buffer class that SB3 has chosen itself before it was saved
        loaded = CausalGDP.load(stream, device="cpu", trusted=True)
    rates = (loaded.lr_schedule(0.5), loaded.critic_lr_schedule(0.5), loaded.world_model_lr_schedule(0.5))
    np.testing.assert_allclose(rates, [5e-4, 1e-3, 1.5e-3])
    assert loaded.action_noise._sigma == pytest.approx(0.3)
    assert loaded.train_freq.frequency == 2 and loaded.train_freq.unit.value == "episode"
    assert loaded.n_steps == loaded.replay_buffer.n_steps == 3


def test_a_file_like_object_and_a_name_without_suffix_work(trained, tmp_path, observations):
    stream = io.BytesIO()
    trained.save(stream)
    assert_same_predictions(trained, CausalGDP.load(stream, device="cpu"), observations)
    trained.save(str(tmp_path / "model"))
    assert os.listdir(tmp_path) == ["model.zip"]
    assert_same_predictions(trained, CausalGDP.load(tmp_path / "model", device="cpu"), observations)


def test_a_save_that_fails_leaves_the_old_file(trained, tmp_path, observations):
    class Unsaveable:
        def __reduce__(self):
            raise RuntimeError("cannot be saved")

    model = CausalGDP.load(_bytes_of(trained), device="cpu")
    model.save(tmp_path / "model.zip")
    model.something = Unsaveable()
    with pytest.raises(RuntimeError, match="cannot be saved"):
        model.save(tmp_path / "model.zip")
    assert os.listdir(tmp_path) == ["model.zip"]
    assert_same_predictions(trained, CausalGDP.load(tmp_path / "model.zip", device="cpu"), observations)


def _bytes_of(model):
    stream = io.BytesIO()
    model.save(stream)
    return stream


def test_a_saved_file_holds_neither_the_environment_nor_the_replay_buffer_nor_a_network_twice(saved):
    with zipfile.ZipFile(saved / "model.zip") as archive:
        names = archive.namelist()
        data = json.loads(archive.read("data"))
        for name in names:
            if name.endswith("optimizer.pth") or name == "policy.pth":
                assert th.load(io.BytesIO(archive.read(name)), weights_only=True)
    for name in ("actor.optimizer.pth", "critic.optimizer.pth", "world_model.optimizer.pth", "policy.pth"):
        assert name in names
    left_out = {"env", "replay_buffer", "policy", "actor", "actor_target", "critic", "critic_target", "world_model"}
    assert not left_out & set(data)


def test_saving_while_training_is_possible(tmp_path):
    class SavingCallback(CausalWorldModelCallback):
        def _on_step(self):
            if self.n_calls == 60:
                self.model.save(tmp_path / "model.zip")
            return super()._on_step()

    CausalGDP("MlpPolicy", "Pendulum-v1", **KWARGS).learn(64, callback=SavingCallback())
    assert CausalGDP.load(tmp_path / "model.zip", device="cpu").num_timesteps == 60


# Another process, another time ------------------------------------------------------------------------------------------


IN_A_NEW_PROCESS = """
import sys
import gymnasium as gym
import numpy as np
import torch as th
from sb3_causalgdp import CausalGDP, CausalWorldModelCallback

class RecordingCallback(CausalWorldModelCallback):
    refreshes = []
    def refresh(self):
        super().refresh()
        self.refreshes.append((self.model.num_timesteps, self.model.causal_statistics.n_samples))

th.set_num_threads(1)
folder = sys.argv[1]
observations = np.load(folder + "/observations.npy")
model = CausalGDP.load(folder + "/model.zip", env=gym.make("Pendulum-v1"), device="cpu")
deterministic, _ = model.predict(observations, deterministic=True)
th.manual_seed(3)
stochastic, _ = model.predict(observations, deterministic=False)
model.load_replay_buffer(folder + "/buffer.pkl")
model.learn(150, callback=RecordingCallback(min_transitions=50), reset_num_timesteps=False)
np.savez(folder + "/result.npz", deterministic=deterministic, stochastic=stochastic, refreshes=RecordingCallback.refreshes)
"""


def test_a_new_process_predicts_the_same_and_goes_on_with_the_schedule(trained, saved, observations, tmp_path):
    for name in ("model.zip", "buffer.pkl"):
        os.link(saved / name, tmp_path / name)
    np.save(tmp_path / "observations.npy", observations)
    subprocess.run(
        [sys.executable, "-c", IN_A_NEW_PROCESS, str(tmp_path)],
        check=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        timeout=120,
    )
    result = np.load(tmp_path / "result.npz")
    deterministic, stochastic = predictions(trained, observations)
    np.testing.assert_array_equal(result["deterministic"], deterministic)
    np.testing.assert_array_equal(result["stochastic"], stochastic)
    # As without interruption: every 100 steps, each from all that was stored by then
    assert result["refreshes"].tolist() == [[300, 299], [400, 399]]


def test_without_the_replay_buffer_the_moments_go_on_from_what_they_know(saved):
    model = CausalGDP.load(saved / "model.zip", env=gym.make("Pendulum-v1"), device="cpu")
    known, callback = model.causal_statistics.n_samples, RecordingCallback()
    model.learn(150, callback=callback, reset_num_timesteps=False)
    # The 56 steps since the last refresh were in the buffer that was not loaded, and the last step is not stored yet
    assert callback.refreshes == [(300, known + 43), (400, known + 143)]


def test_a_refresh_that_is_due_at_once_needs_no_replay_buffer(saved):
    model = CausalGDP.load(saved / "model.zip", env=gym.make("Pendulum-v1"), device="cpu")
    model._steps_since_refresh, callback = 99, RecordingCallback()
    model.learn(4, callback=callback, reset_num_timesteps=False)
    assert [refresh[0] for refresh in callback.refreshes] == [257]


def test_a_second_save_and_load_changes_nothing(saved, observations):
    once = CausalGDP.load(saved / "model.zip", device="cpu")
    twice = CausalGDP.load(_bytes_of(once), device="cpu")
    assert_same_tree(dict(once.policy.state_dict()), dict(twice.policy.state_dict()))
    assert once.causal_graph() == twice.causal_graph()
    assert_same_predictions(once, twice, observations)


def test_a_graph_written_by_hand_survives(saved):
    model = CausalGDP.load(saved / "model.zip", device="cpu")
    closed = CausalGraph(model.transition_variables, np.zeros((4, 4)), np.zeros((4, 4)), "by hand", 0)
    model.set_causal_graph(closed)
    loaded = CausalGDP.load(_bytes_of(model), device="cpu")
    assert loaded.causal_graph() == closed
    assert not loaded.world_model.state_to_state.any()


# Loading with changes ---------------------------------------------------------------------------------------------------


def test_a_model_loads_without_environment_and_for_another_number_of_environments(trained, saved, observations):
    alone = CausalGDP.load(saved / "model.zip", device="cpu")
    assert alone.env is None
    assert_same_predictions(trained, alone, observations)
    several = CausalGDP.load(saved / "model.zip", env=make_vec_env("Pendulum-v1", n_envs=3), device="cpu")
    callback = RecordingCallback()
    several.learn(60, callback=callback, reset_num_timesteps=False)
    # 56 steps had passed, and 15 times three are the first that make it a hundred
    assert [refresh[0] for refresh in callback.refreshes] == [301]


# Loading a replay buffer ------------------------------------------------------------------------------------------------


def test_an_environment_may_be_its_id_wherever_it_is_given(saved, tmp_path):
    loaded = CausalGDP.load(saved / "model", "Pendulum-v1")
    loaded.set_env("Pendulum-v1")
    other = CausalGDP.load(saved / "model")
    other.set_env("Pendulum-v1")
    for model in (loaded, other):
        assert model.get_env().get_attr("spec")[0].id == "Pendulum-v1"
        model.learn(5)
    path = loaded.save_checkpoint(tmp_path / "there.zip")
    assert CausalGDP.resume(path, "Pendulum-v1").get_env().get_attr("spec")[0].id == "Pendulum-v1"
    for read in (lambda env: CausalGDP.load(saved / "model", env), lambda env: CausalGDP.resume(path, env), loaded.set_env):
        with pytest.raises(gym.error.NameNotFound, match="Pendulums"):
            read("Pendulums-v1")


def transitions_of(buffer):
    """Sorted rows of observation, action, reward, next observation and whether the episode terminated."""
    rows = slice(0, buffer.size())
    terminations = buffer.dones * (1.0 - buffer.timeouts)
    parts = (buffer.observations, buffer.actions, buffer.rewards, buffer.next_observations, terminations)
    stacked = np.concatenate([part[rows].reshape(buffer.size() * buffer.n_envs, -1) for part in parts], axis=1)
    return {tuple(row) for row in stacked.tolist()}


@pytest.mark.parametrize(("n_saved", "n_envs"), [(1, 4), (4, 1), (3, 2), (2, 3)])
@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("buffer_size", [150, 1000])
def test_a_buffer_of_another_number_of_environments_is_put_into_as_many_columns(
    n_saved, n_envs, n_steps, buffer_size, tmp_path
):
    model = train(150 * n_saved + 250, env=make_vec_env("Pendulum-v1", n_saved), n_steps=n_steps, buffer_size=buffer_size)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CausalGDP.load(tmp_path / "model", env=make_vec_env("Pendulum-v1", n_envs), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert type(loaded.replay_buffer) is type(model.replay_buffer) and loaded.replay_buffer.n_envs == n_envs
    assert transitions_of(loaded.replay_buffer) == transitions_of(model.replay_buffer)
    buffer = loaded.replay_buffer
    is_followed = buffer.dones[: buffer.size() - 1] == 0.0
    after, now = buffer.next_observations[: buffer.size() - 1], buffer.observations[1 : buffer.size()]
    np.testing.assert_array_equal(after[is_followed], now[is_followed])
    assert buffer.dones[buffer.size() - 1].all()
    loaded.learn(120, reset_num_timesteps=False)
    assert loaded.replay_buffer is buffer and np.isfinite(loaded.causal_statistics.raw.mean).all()


def test_a_memory_efficient_buffer_needs_the_number_of_environments_that_it_was_saved_with(tmp_path):
    kwargs = {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}}
    model = train(env=make_vec_env("Pendulum-v1", 2), **kwargs)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CausalGDP.load(tmp_path / "model", env=make_vec_env("Pendulum-v1", 3), device="cpu")
    with pytest.raises(ValueError, match=r"transitions of 2 environments, and the model has 3, .* load the model with 2"):
        loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.replay_buffer.n_envs == 3 and loaded.replay_buffer.size() == 0


def test_exploration_noise_follows_the_number_of_environments(tmp_path):
    noise = NormalActionNoise(np.zeros(1), 0.1 * np.ones(1))
    train(60, env=make_vec_env("Pendulum-v1", 2), action_noise=noise).save(tmp_path / "model")
    for n_envs in (3, 1):
        loaded = CausalGDP.load(tmp_path / "model", env=make_vec_env("Pendulum-v1", n_envs), device="cpu")
        loaded.learn(60, reset_num_timesteps=False)
        assert loaded.action_noise.n_envs == n_envs


@pytest.mark.parametrize("field", ["observations", "next_observations", "actions", "rewards"])
def test_a_replay_buffer_with_a_nan_is_refused_and_the_model_keeps_its_own(trained, saved, field, tmp_path):
    with (saved / "buffer.pkl").open("rb") as file:
        buffer = pickle.load(file)
    getattr(buffer, field)[7, 0] = np.nan
    with (tmp_path / "buffer.pkl").open("wb") as file:
        pickle.dump(buffer, file)
    loaded = CausalGDP.load(saved / "model.zip", device="cpu")
    own = loaded.replay_buffer
    with pytest.raises(
        ValueError, match=rf"buffer\.pkl has a NaN or infinite value in {field}.* at position 7 of environment 0"
    ):
        loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    assert loaded.replay_buffer is own and loaded.offline_buffer is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda buffer: buffer.dones.__setitem__((3, 0), 0.5), "dones must be bool, or 0 and 1, got 0.5 at transition 3"),
        (lambda buffer: setattr(buffer, "rewards", buffer.rewards[:9]), r"rewards have the shape \(9, 1\), and \(1000, 1\)"),
        (lambda buffer: setattr(buffer, "pos", 1000), "its position is 1000, and its size 1000"),
    ],
)
def test_a_damaged_replay_buffer_is_refused(saved, change, message, tmp_path):
    with (saved / "buffer.pkl").open("rb") as file:
        buffer = pickle.load(file)
    change(buffer)
    with (tmp_path / "buffer.pkl").open("wb") as file:
        pickle.dump(buffer, file)
    with pytest.raises(ValueError, match=message):
        CausalGDP.load(saved / "model.zip", device="cpu").load_replay_buffer(tmp_path / "buffer.pkl")


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (
            lambda: PlaneEnv(4),
            r"its observation space is Box\(.*\(3,\), float32\), and the model's is Box\(.*\(4,\), float32\)",
        ),
        (lambda: PlaneEnv(3, 2), r"its action space is Box\(.*\(1,\), float32\), and the model's is Box\(.*\(2,\), float32\)"),
        (lambda: PlaneEnv(3, 1), r"its action space is Box\(-2\.0, .*, and the model's is Box\(-1\.0"),
    ],
)
def test_the_replay_buffer_of_another_environment_is_refused(saved, env, message):
    model = CausalGDP("MlpPolicy", env(), **KWARGS)
    with pytest.raises(ValueError, match=message):
        model.load_replay_buffer(saved / "buffer.pkl")


def test_arguments_and_custom_objects_replace_what_was_saved(saved):
    model = CausalGDP.load(
        saved / "model.zip",
        device="cpu",
        custom_objects={"learning_rate": 2e-5, "unheard_of": 1.0},
        eta=0.25,
        gamma=0.5,
        causal_half_life=77.0,
        n_action_candidates=2,
        guidance=None,
    )
    assert model.learning_rate == model.lr_schedule(1.0) == 2e-5
    assert not hasattr(model, "unheard_of")
    assert (model.eta, model.policy.discount, model.policy.n_action_candidates) == (0.25, 0.5, 2)
    assert model.causal_half_life == model.causal_statistics.raw.half_life == 77.0
    assert not model.policy.is_guided


def test_excluded_and_included_attributes(trained):
    stream = io.BytesIO()
    trained.save(stream, exclude=["eta", "_causal_graph"], include=["replay_buffer"])
    loaded = CausalGDP.load(stream, device="cpu", eta=9.0, trusted=True)
    assert loaded.eta == 9.0
    assert loaded.causal_graph().method == "none"
    assert loaded.replay_buffer.pos == trained.replay_buffer.pos


@pytest.mark.parametrize(
    ("environment", "message"),
    [
        (PlaneEnv(n_observations=5), "Observation spaces do not match"),
        (PlaneEnv(n_actions=2), "Observation spaces do not match|Action spaces do not match"),
        ("MountainCarContinuous-v0", "Observation spaces do not match"),
    ],
)
def test_another_environment_is_refused(saved, environment, message):
    environment = gym.make(environment) if isinstance(environment, str) else environment
    with pytest.raises(ValueError, match=message):
        CausalGDP.load(saved / "model.zip", env=environment, device="cpu")


def test_parameters_of_another_shape_are_refused(saved, tmp_path):
    model = CausalGDP.load(saved / "model.zip", device="cpu")
    wider = CausalGDP("MlpPolicy", "Pendulum-v1", **{**KWARGS, "policy_kwargs": {"net_arch": [8]}})
    with pytest.raises(RuntimeError, match="size mismatch"):
        model.set_parameters(wider.get_parameters())
    with pytest.raises(ValueError, match="policy kwargs do not equal"):
        CausalGDP.load(saved / "model.zip", device="cpu", policy_kwargs={"net_arch": [8]})
    (tmp_path / "broken.zip").write_bytes((saved / "model.zip").read_bytes()[:1000])
    with pytest.raises(ValueError, match=r"broken\.zip cannot be loaded: BadZipFile"):
        CausalGDP.load(tmp_path / "broken.zip", device="cpu")


def test_a_graph_about_other_variables_is_refused(saved):
    model = CausalGDP.load(saved / "model.zip", device="cpu")
    graph = CausalGraph.fully_connected(TransitionVariables(("x",), ("a",)))
    before = model.causal_graph()
    with pytest.raises(ValueError, match="The graph is about"):
        model.set_causal_graph(graph)
    assert model.causal_graph() == before


# The policy alone -------------------------------------------------------------------------------------------------------


def test_the_policy_alone_predicts_the_same_with_its_guidance(trained, tmp_path, observations):
    trained.policy.save(tmp_path / "policy.pth")
    policy = type(trained.policy).load(tmp_path / "policy.pth", device="cpu")
    assert policy.is_guided
    assert_same_predictions(trained, policy, observations)
    unguided = deepcopy(policy)
    unguided.guidance_rule = None
    assert not np.array_equal(predictions(unguided, observations)[0], predictions(policy, observations)[0])


def test_the_actor_alone_predicts_the_same(trained, tmp_path, observations):
    trained.actor.save(tmp_path / "actor.pth")
    actor = type(trained.actor).load(tmp_path / "actor.pth", device="cpu", trusted=True)
    assert_same_predictions(trained.actor, actor, observations)


def test_policy_parameters_move_between_models(trained, observations):
    other = CausalGDP("MlpPolicy", "Pendulum-v1", **{**KWARGS, "seed": 1})
    other.set_parameters(trained.get_parameters())
    assert_same_predictions(trained, other, observations)
