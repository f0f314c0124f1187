"""``compile="auto"``: who trains for long compiles, and nobody else notices."""

from threading import Thread

import pytest
import torch as th
from compiling import compile_for_tests
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch._dynamo.exc import BackendCompilerFailed

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.acceleration.fast_steps import FastSteps

SMALL = {"net_arch": [8], "n_critics": 1, "world_model_net_arch": [8]}
N_STEPS = 40


class OwnExtractor(FlattenExtractor):
    pass


@pytest.fixture(autouse=True)
def worth_compiling(monkeypatch):
    monkeypatch.setattr(FastSteps, "WORTH_COMPILING", N_STEPS)


@pytest.fixture
def n_compiled(monkeypatch):
    """How many graphs were compiled, by a compiler that takes no time."""
    graphs = []

    def count(graph, _):
        graphs.append(graph)
        return graph

    compile_for_tests(monkeypatch, backend=count)
    return lambda: len(graphs)


def make(env="Pendulum-v1", policy="MlpPolicy", **kwargs):
    arguments = {"seed": 0, "device": "cpu", "learning_starts": 20, "batch_size": 8, "policy_kwargs": SMALL, **kwargs}
    return CausalGDP(policy, env, **arguments)


def states_of(model):
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def test_a_long_training_is_compiled_and_ends_where_a_plain_one_does(n_compiled, capsys):
    model = make(verbose=1).learn(N_STEPS, log_interval=None)
    assert n_compiled() > 0
    assert "Compiling the updates" in capsys.readouterr().out
    plain = make(compile=False).learn(N_STEPS)
    for name, value in states_of(plain).items():
        th.testing.assert_close(states_of(model)[name], value, rtol=1e-4, atol=1e-5, msg=name)


@pytest.mark.parametrize(
    ("n_steps", "kwargs"),
    [
        (N_STEPS - 1, {}),
        (N_STEPS, {"compile": False}),
        (N_STEPS, {"train_freq": 2}),
        (N_STEPS, {"train_freq": (1, "episode")}),
        (N_STEPS, {"policy_kwargs": {**SMALL, "features_extractor_class": OwnExtractor}}),
        (N_STEPS, {"policy_kwargs": {**SMALL, "denoiser": "residual_mlp"}}),
    ],
)
def test_what_is_short_or_ones_own_is_not(n_compiled, n_steps, kwargs):
    make(**kwargs).learn(n_steps)
    assert n_compiled() == 0


def test_two_gradient_steps_for_each_of_the_environments_count_twice(n_compiled):
    make(gradient_steps=2, learning_starts=10).learn(N_STEPS // 2)
    assert n_compiled() > 0


def test_earlier_steps_of_a_model_do_not_count(n_compiled):
    model = make().learn(N_STEPS - 1)
    model.learn(10, reset_num_timesteps=False)
    assert n_compiled() == 0


def test_pretraining_counts_its_own_steps(n_compiled):
    model = make(train_freq=1_000)
    model.learn(30)
    model.pretrain(N_STEPS - 1)
    assert n_compiled() == 0
    model.pretrain(N_STEPS)
    assert n_compiled() > 0


def test_images_are_not_compiled(n_compiled):
    make(FakeImageEnv(discrete=False), "CnnPolicy", buffer_size=100).learn(N_STEPS)
    assert n_compiled() == 0


def test_a_thread_beside_the_main_one_does_not_compile(n_compiled):
    thread = Thread(target=lambda: make().learn(N_STEPS))
    thread.start(), thread.join()
    assert n_compiled() == 0


def test_without_a_compiler_nothing_is_said(n_compiled, recwarn, capsys):
    with th._inductor.config.patch({"cpp.cxx": ("no-such-compiler",)}):
        make(verbose=1).learn(N_STEPS, log_interval=None)
    assert n_compiled() == 0
    assert "ompil" not in capsys.readouterr().out and not [one for one in recwarn if "ompil" in str(one.message)]


def test_where_the_compiler_fails_the_training_says_so_once_and_is_the_plain_one(monkeypatch):
    def fails(graph, _):
        raise RuntimeError("no headers")

    compile_for_tests(monkeypatch, backend=fails)
    model = make()
    with pytest.warns(UserWarning, match=r"cannot compile the updates, which go on as they are .*: .*no headers") as warned:
        model.learn(N_STEPS)
    assert len([one for one in warned if "compile" in str(one.message)]) == 1
    plain = states_of(make(compile=False).learn(N_STEPS))
    for name, value in states_of(model).items():
        assert th.equal(value, plain[name]), name
    with pytest.raises(BackendCompilerFailed):
        make(compile=True).learn(N_STEPS)


def test_what_resumes_a_compiled_training_compiles_however_little_remains(n_compiled, tmp_path):
    model = make().learn(N_STEPS)
    model.save(tmp_path / "model")
    model.save_checkpoint(tmp_path / "checkpoints")
    before = n_compiled()
    CausalGDP.load(tmp_path / "model", env="Pendulum-v1").learn(30)
    assert n_compiled() == before
    resumed = CausalGDP.resume(tmp_path / "checkpoints", env="Pendulum-v1")
    resumed.learn(5, reset_num_timesteps=False)
    assert n_compiled() > before
