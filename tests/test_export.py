import copy
import importlib.util
import json
import subprocess
import sys
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import SMALL
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from torch import nn

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback
from sb3_causalgdp.export import ExportedPolicy, _solve_by_elimination
from sb3_causalgdp.prediction import choice_noise

TOLERANCE = 1e-5
HAS_ONNX = all(importlib.util.find_spec(name) is not None for name in ("onnx", "onnxscript", "onnxruntime"))
needs_onnx = pytest.mark.skipif(not HAS_ONNX, reason="onnx, onnxscript or onnxruntime is missing")
SUFFIXES = [".pt", ".pt2", pytest.param(".onnx", marks=needs_onnx)]


class Sums(gym.Env):
    """What was done is added up, in units of its own; observations of any space."""

    def __init__(self, space):
        self.observation_space = space
        self.action_space = spaces.Box(np.array([-1.0, 0.0], np.float32), np.array([3.0, 0.5], np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        self.n_steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.n_steps += 1
        return self.observation_space.sample(), float(action.sum()), False, self.n_steps == 20, {}


def trained(env, policy="MlpPolicy", total_timesteps=128, policy_kwargs=None, **kwargs):
    policy_kwargs = {**SMALL["policy_kwargs"], **(policy_kwargs or {})}
    # Fewer steps are less to trace; with the standard learning rate all actions would be alike
    small = {**SMALL, "diffusion_steps": 2, "n_action_candidates": 3, "learning_rate": 1e-2, "policy_kwargs": policy_kwargs}
    model = CausalGDP(policy, env, **{**small, "eta": 0.01, "denoising_weight": 1.0, **kwargs})
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # one action is nearly enough for the discovery
        model.learn(total_timesteps, callback=CausalWorldModelCallback(min_transitions=40))
    return model


def run(path, *inputs):
    """What a file gives, by PyTorch or ONNX alone."""
    if path.suffix == ".pt":
        return th.jit.load(path)(*map(th.as_tensor, inputs)).numpy()
    if path.suffix == ".pt2":
        return th.export.load(path).module()(*map(th.as_tensor, inputs)).detach().numpy()
    session = pytest.importorskip("onnxruntime").InferenceSession(path, providers=["CPUExecutionProvider"])
    names = [one.name for one in session.get_inputs()]
    return session.run(None, dict(zip(names, inputs, strict=True)))[0]


def metadata_of(path):
    files = {"metadata.json": ""}
    if path.suffix == ".pt":
        th.jit.load(path, _extra_files=files)
    elif path.suffix == ".pt2":
        th.export.load(path, extra_files=files)
    else:
        session = pytest.importorskip("onnxruntime").InferenceSession(path, providers=["CPUExecutionProvider"])
        files = session.get_modelmeta().custom_metadata_map
    return json.loads(files["metadata.json"])


def rows(space, n_rows):
    space = copy.deepcopy(space)
    space.seed(1)
    return np.stack([space.sample() for _ in range(n_rows)])


@pytest.fixture(scope="module")
def pendulum():
    model = trained("Pendulum-v1")
    assert model.policy.is_guided
    return model


@pytest.fixture(scope="module")
def observations():
    angle = np.linspace(-3.0, 3.0, 7)
    return np.stack([np.cos(angle), np.sin(angle), np.linspace(-4.0, 4.0, 7)], axis=1).astype(np.float32)


@pytest.fixture(scope="module", params=SUFFIXES)
def exported(request, pendulum, tmp_path_factory):
    path = tmp_path_factory.mktemp("exported") / f"policy{request.param}"
    pendulum.export(path)
    return path


# The same actions -------------------------------------------------------------------------------------------------------


def test_a_file_acts_as_the_model_at_any_batch_size(exported, pendulum, observations):
    expected, _ = pendulum.predict(observations, deterministic=True)
    assert np.ptp(expected) > 0.1
    np.testing.assert_allclose(run(exported, observations), expected, atol=TOLERANCE)
    np.testing.assert_allclose(run(exported, observations[:1]), expected[:1], atol=TOLERANCE)
    metadata = metadata_of(exported)
    assert metadata["guided"] and metadata["deterministic"] and not metadata["normalizes_observations"]
    assert metadata["inputs"] == [{"name": "observation", "dtype": "float32", "shape": ["batch", 3]}]
    assert metadata["action"] == {"shape": ["batch", 1], "low": [-2.0], "high": [2.0]}
    assert metadata["state_names"] == ["cos angle", "sin angle", "vel angle"]
    assert metadata["action_names"] == ["torque"]
    assert metadata["versions"]["torch"] == str(th.__version__)


def test_unguided_is_the_policy_without_its_guidance(pendulum, observations, tmp_path):
    pendulum.export(tmp_path / "policy.pt", guided=False)
    actions = run(tmp_path / "policy.pt", observations)
    unguided = copy.deepcopy(pendulum.policy)
    unguided.guidance_ready.zero_()
    np.testing.assert_allclose(actions, unguided.predict(observations, deterministic=True)[0], atol=TOLERANCE)
    assert np.abs(actions - pendulum.predict(observations, deterministic=True)[0]).max() > 100 * TOLERANCE
    assert not metadata_of(tmp_path / "policy.pt")["guided"]
    assert pendulum.policy.is_guided


@pytest.mark.parametrize(("exploration_noise", "temperature"), [(0.0, 0.0), (0.3, 0.0), (0.3, 1.0), (0.0, 1.0)])
def test_noise_is_an_input_of_what_is_not_deterministic(exploration_noise, temperature, observations, tmp_path):
    model = trained("Pendulum-v1", exploration_noise=exploration_noise, exploration_temperature=temperature)
    path = tmp_path / "policy.pt"
    model.export(path, deterministic=False)
    n_rows, n_candidates, n_steps = len(observations), model.n_action_candidates, model.diffusion_steps
    th.manual_seed(7)
    expected, _ = model.predict(observations)
    th.manual_seed(7)
    noise = th.randn(n_steps, n_rows * n_candidates, 1).view(n_steps, n_rows, n_candidates, 1).transpose(0, 1).contiguous()
    of_choice = choice_noise(model.policy, n_rows, deterministic=False)
    exploration = [] if of_choice is None else [of_choice.numpy()]
    exploration += [th.randn(n_rows, 1).numpy()] if exploration_noise else []
    np.testing.assert_allclose(run(path, observations, noise.numpy(), *exploration), expected, atol=TOLERANCE)
    names = [one["name"] for one in metadata_of(path)["inputs"]]
    asked = ["choice_noise"] * (temperature > 0.0) + ["exploration_noise"] * (exploration_noise > 0.0)
    assert names == ["observation", "noise", *asked]


def test_normalisation_of_observations_is_inside(observations, tmp_path):
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=2, seed=0), clip_obs=1.5)
    model = trained(env, critic_learning_rate=1e-3)
    path = tmp_path / "policy.pt"
    model.export(path)
    normalised = env.normalize_obs(observations)
    assert (np.abs(normalised) == 1.5).any()
    expected, _ = model.predict(normalised, deterministic=True)
    np.testing.assert_allclose(run(path, observations), expected, atol=TOLERANCE)
    assert metadata_of(path)["normalizes_observations"]
    model.export(tmp_path / "normalised_outside.pt", vec_normalize=None)
    np.testing.assert_allclose(run(tmp_path / "normalised_outside.pt", normalised), expected, atol=TOLERANCE)
    model.policy.export(tmp_path / "policy_alone.pt", vec_normalize=env)
    np.testing.assert_allclose(run(tmp_path / "policy_alone.pt", observations), expected, atol=TOLERANCE)


def test_far_from_zero_normalisation_keeps_double_precision(tmp_path):
    space = spaces.Box(1e6, 1e6 + 1.0, (3,), np.float64)
    env = VecNormalize(DummyVecEnv([lambda: Sums(space)]))
    model = trained(env)
    model.export(tmp_path / "policy.pt")
    raw = rows(space, 5)
    expected, _ = model.predict(env.normalize_obs(raw), deterministic=True)
    np.testing.assert_allclose(run(tmp_path / "policy.pt", raw), expected, atol=TOLERANCE)
    assert metadata_of(tmp_path / "policy.pt")["inputs"][0]["dtype"] == "float64"


@pytest.mark.parametrize("is_normalized", [False, True])
def test_a_file_is_compared_where_the_policy_was_trained(is_normalized, tmp_path):
    space = spaces.Dict(small=spaces.Box(-1e9, 1e9, (2,)), large=spaces.Box(-1e9, 1e9, (1,)))
    env = DummyVecEnv([lambda: Sums(spaces.Dict(small=spaces.Box(3.0, 3.1, (2,)), large=spaces.Box(1e4, 2e4, (1,))))])
    env.observation_space = space
    env = VecNormalize(env) if is_normalized else env
    model = trained(env, "MultiInputPolicy")
    inputs, _ = ExportedPolicy(model.policy, True, True, model.get_vec_normalize_env()).examples()
    examples = dict(zip(space, inputs, strict=True))
    assert np.abs(examples["small"] - 3.05).max() < 0.2 and np.abs(examples["large"] - 1.5e4).max() < 2e4


@pytest.mark.parametrize(
    "arguments",
    [
        {"guidance": None, "n_action_candidates": 1},
        {"guidance": "score", "sampler": "ddim", "guidance_target": "reward"},
        {"guidance": "normalized", "noise_schedule": "cosine", "state_guidance_scale": 0.0},
        {"guidance_covariance": "tweedie", "policy_kwargs": {"activation_fn": "mish", "critic_normalization": "layer"}},
        {"guidance_covariance": "isotropic", "policy_kwargs": {"prediction_type": "noise", "critic_normalization": None}},
    ],
    ids=lambda arguments: next(iter(arguments.values())),
)
def test_every_kind_of_guidance_and_network(arguments, observations, tmp_path):
    model = trained("Pendulum-v1", **arguments)
    model.export(tmp_path / "policy.pt")
    expected, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose(run(tmp_path / "policy.pt", observations), expected, atol=10 * TOLERANCE)


@needs_onnx
def test_onnx_solves_for_several_actions_and_has_the_jacobian_of_the_denoiser(tmp_path):
    space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    model = trained(Sums(space), guidance_covariance="tweedie")
    assert model.policy.is_guided
    model.export(tmp_path / "policy.onnx")
    expected, _ = model.predict(rows(space, 5), deterministic=True)
    np.testing.assert_allclose(run(tmp_path / "policy.onnx", rows(space, 5)), expected, atol=10 * TOLERANCE)


@pytest.mark.parametrize("size", [1, 2, 7])
def test_elimination_solves_as_pytorch_does_also_where_the_first_pivot_is_zero(size):
    generator = th.Generator().manual_seed(size)
    system = th.randn(20, size, size, generator=generator, dtype=th.float64)
    right_side = th.randn(20, size, 1, generator=generator, dtype=th.float64)
    if size > 1:
        system[0, 0, 0] = 0.0
    solution, *_ = _solve_by_elimination(system, right_side)
    th.testing.assert_close(solution, th.linalg.solve(system, right_side), rtol=1e-8, atol=1e-8)


# Every kind of observation ----------------------------------------------------------------------------------------------

SPACES = {
    "matrix": spaces.Box(-1.0, 1.0, (2, 2), np.float64),
    "discrete": spaces.Discrete(4),
    "multi-discrete": spaces.MultiDiscrete([2, 3]),
    "multi-binary": spaces.MultiBinary(3),
}


@pytest.mark.parametrize("kind", SPACES)
def test_observations_that_are_no_vectors(kind, tmp_path):
    space = SPACES[kind]
    model = trained(Sums(space))
    model.export(tmp_path / "policy.pt")
    expected, _ = model.predict(rows(space, 5), deterministic=True)
    assert np.abs(expected).max() > 0.0
    np.testing.assert_allclose(run(tmp_path / "policy.pt", rows(space, 5)), expected, atol=TOLERANCE)


def test_each_part_of_a_dictionary_is_an_input(tmp_path):
    # Not in the alphabet's order, which SB3 keeps
    parts = {"b": spaces.Box(-1.0, 1.0, (2,), np.float32), "a": spaces.Discrete(3)}
    model = trained(Sums(spaces.Dict(parts)), "MultiInputPolicy")
    path = tmp_path / "policy.pt"
    model.export(path)
    inputs = {key: rows(space, 5) for key, space in model.observation_space.spaces.items()}
    expected, _ = model.predict(inputs, deterministic=True)
    assert [one["name"] for one in metadata_of(path)["inputs"]] == list(inputs)
    np.testing.assert_allclose(run(path, *inputs.values()), expected, atol=TOLERANCE)


def test_images(tmp_path):
    space = spaces.Box(0, 255, (1, 36, 36), np.uint8)
    kwargs = {"features_extractor_kwargs": {"features_dim": 8}}
    model = trained(Sums(space), "CnnPolicy", policy_kwargs=kwargs, buffer_size=200)
    model.export(tmp_path / "policy.pt")
    expected, _ = model.predict(rows(space, 5), deterministic=True)
    np.testing.assert_allclose(run(tmp_path / "policy.pt", rows(space, 5)), expected, atol=TOLERANCE)
    assert metadata_of(tmp_path / "policy.pt")["inputs"][0]["dtype"] == "uint8"


# Refused ----------------------------------------------------------------------------------------------------------------


def test_a_suffix_may_be_in_capitals_and_an_untrained_model_is_noted(observations, tmp_path):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **SMALL)
    with pytest.warns(UserWarning, match="The model has not been trained"):
        model.export(tmp_path / "policy.PT")
    actions, _ = model.predict(observations, deterministic=True)
    np.testing.assert_allclose(th.jit.load(tmp_path / "policy.PT")(th.as_tensor(observations)), actions, atol=TOLERANCE)


def test_what_cannot_be_exported_is_refused_and_nothing_written(pendulum, tmp_path):
    with pytest.raises(ValueError, match=r"path must end in one of \['.onnx', '.pt', '.pt2'\], got 'policy.h5'"):
        pendulum.export("policy.h5")
    before = CausalGDP("MlpPolicy", "Pendulum-v1", **SMALL)
    with pytest.raises(ValueError, match="got True: no causal graph has been found yet"):
        before.export(tmp_path / "policy.pt", guided=True)
    stacked = VecFrameStack(VecNormalize(make_vec_env("Pendulum-v1")), 2)
    with pytest.raises(ValueError, match=r"shape \(3,\) are normalised, and the policy sees \(6,\).*vec_normalize=None"):
        CausalGDP("MlpPolicy", stacked, **SMALL).export(tmp_path / "policy.pt")
    assert list(tmp_path.iterdir()) == []


class ChoosesByValue(BaseFeaturesExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space, 3)

    def forward(self, observations):
        return observations if observations.mean() > 0.0 else -observations


def test_a_network_that_chooses_by_value_is_refused(tmp_path):
    kwargs = {**SMALL, "policy_kwargs": {**SMALL["policy_kwargs"], "features_extractor_class": ChoosesByValue}}
    with pytest.raises(ValueError, match="The policy cannot be exported"):
        CausalGDP("MlpPolicy", "Pendulum-v1", **kwargs).export(tmp_path / "policy.pt")


def test_a_policy_that_predicts_otherwise_is_refused_and_the_old_file_stays(pendulum, tmp_path, monkeypatch):
    path = tmp_path / "policy.pt"
    path.write_bytes(b"old")
    forward = type(pendulum.policy)._predict
    monkeypatch.setattr(type(pendulum.policy), "_predict", lambda *args, **kwargs: -forward(*args, **kwargs))
    with pytest.raises(RuntimeError, match="actions differ from predict's"):
        pendulum.export(path)
    assert path.read_bytes() == b"old"


def test_without_onnx_the_error_says_what_to_install(pendulum, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    with pytest.raises(ImportError, match=r"onnx is needed .* pip install onnx onnxscript onnxruntime"):
        pendulum.export(tmp_path / "policy.onnx")


class Deterministic(nn.Module):
    def __init__(self, policy):
        super().__init__()
        self.policy = policy

    def forward(self, observation):
        return self.policy(observation, deterministic=True)


@pytest.mark.parametrize(
    "tracer",
    [
        th.jit.trace,
        lambda module, observation: th.export.export(module, (observation,)),
        lambda module, observation: th.export.export(module, (observation,), strict=True),
        lambda module, observation: th.onnx.export(module, (observation,), "policy.onnx", dynamo=False),
    ],
    ids=["trace", "export", "strict export", "onnx"],
)
@pytest.mark.filterwarnings("ignore")
def test_pytorch_tracers_get_an_error_in_place_of_a_constant(tracer, pendulum, observations, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pendulum.policy.set_training_mode(False)
    module = Deterministic(pendulum.policy)
    with pytest.raises(Exception, match=r"use model\.export"):
        tracer(module, th.as_tensor(observations))
    assert list(tmp_path.iterdir()) == []


# Alone ------------------------------------------------------------------------------------------------------------------

ALONE = """
import sys
import numpy as np
import {runtime}
refused = [name for name in ("sb3_causalgdp", "stable_baselines3", "gymnasium", *{others}) if name in sys.modules]
assert not refused, refused
{load}
np.save("actions.npy", act(np.load("observations.npy")))
"""
LOADERS = {
    ".onnx": "session = onnxruntime.InferenceSession('policy.onnx')\n"
    "act = lambda observations: session.run(None, {'observation': observations})[0]",
    ".pt": "program = torch.jit.load('policy.pt')\nact = lambda observations: program(torch.as_tensor(observations)).numpy()",
    ".pt2": "program = torch.export.load('policy.pt2').module()\n"
    "act = lambda observations: program(torch.as_tensor(observations)).detach().numpy()",
}
BLOCK = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"sb3_causalgdp", "stable_baselines3", "gymnasium", *%s}:
            raise ImportError(name + " is not here")

sys.meta_path.insert(0, Refuse())
"""


def test_a_file_runs_without_this_package(exported, pendulum, observations):
    np.save(exported.with_name("observations.npy"), observations)
    runtime, others = ("onnxruntime", ["torch"]) if exported.suffix == ".onnx" else ("torch", [])
    code = BLOCK % others + ALONE.format(runtime=runtime, others=others, load=LOADERS[exported.suffix])
    subprocess.run([sys.executable, "-c", code], cwd=exported.parent, check=True, timeout=120)
    expected, _ = pendulum.predict(observations, deterministic=True)
    np.testing.assert_allclose(np.load(exported.with_name("actions.npy")), expected, atol=TOLERANCE)


class FixesRows(nn.Module):
    """A denoiser that takes the number of rows for a constant."""

    def __init__(self, action_dim, condition_dim, n_steps, net_arch, activation_fn):
        super().__init__()
        self.network = nn.Linear(action_dim + condition_dim + 1, action_dim)

    def forward(self, noisy_action, step, condition):
        time = th.as_tensor(step, dtype=noisy_action.dtype).expand(len(noisy_action)).unsqueeze(1)
        return self.network(th.cat([noisy_action, condition, time], dim=1))


@pytest.mark.parametrize("denoiser", ["residual_mlp", "transformer"])
def test_other_denoisers_are_exported_for_any_number_of_rows(denoiser, tmp_path):
    arguments = {**SMALL, "policy_kwargs": {"net_arch": [16, 16], "denoiser": denoiser}}
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **arguments)
    model.export(tmp_path / "policy.pt")
    loaded = th.jit.load(tmp_path / "policy.pt")
    for n_rows in (1, 5):
        observations = np.random.default_rng(0).normal(size=(n_rows, 3)).astype(np.float32)
        expected = model.predict(observations, deterministic=True)[0]
        np.testing.assert_allclose(loaded(th.as_tensor(observations)).numpy(), expected, atol=TOLERANCE)


@pytest.mark.parametrize("suffix", [".pt", ".pt2"])
def test_a_denoiser_that_fixes_the_number_of_rows_is_not_exported(suffix, tmp_path):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **{**SMALL, "policy_kwargs": {"denoiser": FixesRows}})
    with pytest.raises(ValueError, match=r"fixes the number of rows: .* take x.shape\[0\]"):
        model.export(tmp_path / f"policy{suffix}")
    assert not any(tmp_path.iterdir())
