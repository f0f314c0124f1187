"""All that is in acceleration/ can be switched off, and only the clock notices."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch as th

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.acceleration import switch
from sb3_causalgdp.acceleration.acting import NumpyActing
from sb3_causalgdp.acceleration.activations import FastMish
from sb3_causalgdp.acceleration.device_replay import DeviceReplay
from sb3_causalgdp.acceleration.products import LIBRARIES, use_library, uses_onednn

OBSERVATIONS = np.random.default_rng(0).uniform(-1.0, 1.0, (4, 3)).astype(np.float32)


@pytest.fixture
def onednn():
    """Where this PyTorch has it: on some processors it is not chosen by itself."""
    try:
        use_library("onednn")
    except ValueError:
        pass
    yield
    use_library(LIBRARIES[0])


def trained(activation_fn="mish"):
    policy_kwargs = {"net_arch": [32, 32], "world_model_net_arch": [16, 16], "activation_fn": activation_fn}
    # What batch statistics make of a rounding grows with each update
    policy_kwargs["critic_normalization"] = "layer"
    arguments = {"causal_refresh_freq": 205, "learning_starts": 206, "batch_size": 32, "policy_kwargs": policy_kwargs}
    # So that neither the actor nor the choice of a candidate follows a rounding of Q
    arguments |= {"denoising_weight": 0.01, "pessimism": 1.0, "exploration_optimism": -1.0}
    # Random actions alone: a rounding in an action would change all that comes after it
    model = CausalGDP("MlpPolicy", "Pendulum-v1", seed=0, device="cpu", **arguments).learn(206)
    assert model.policy.is_guided
    th.manual_seed(1), np.random.seed(1)
    model.train(gradient_steps=100, batch_size=32)
    return model


def actions_of(model):
    th.manual_seed(2)
    return [model.predict(OBSERVATIONS[:1]), model.predict(OBSERVATIONS), model.predict(OBSERVATIONS, deterministic=True)]


@pytest.mark.usefixtures("onednn")
@pytest.mark.parametrize("activation_fn", ["mish", "relu"])
def test_training_and_predictions_are_the_same_without_all_of_it_up_to_rounding(activation_fn, monkeypatch):
    fast = trained(activation_fn)
    actions = actions_of(fast)
    assert fast.policy._acting is not None
    monkeypatch.setattr(switch, "_on", False)
    plain = trained(activation_fn)
    for found, expected in zip(actions_of(plain), actions, strict=True):
        np.testing.assert_allclose(found[0], expected[0], atol=2e-3)
    assert plain.policy._acting is None and not uses_onednn()
    assert not any(isinstance(module, FastMish) for module in plain.policy.modules())
    states = plain.policy.state_dict()
    for name, value in fast.policy.state_dict().items():
        th.testing.assert_close(states[name], value, rtol=1e-2, atol=1e-3, msg=name)


def test_switched_off_nothing_is_compiled_recorded_copied_or_covered(monkeypatch):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", device="cpu", buffer_size=100)
    assert NumpyActing.covers(model.policy)
    monkeypatch.setattr(switch, "_on", False)
    assert not NumpyActing.covers(model.policy)
    assert not DeviceReplay.covers(model.replay_buffer, th.device("cuda"))
    # Neither is looked at: on a CPU the second would be refused
    asking = CausalGDP("MlpPolicy", "Pendulum-v1", device="cpu", buffer_size=100, compile=True, cuda_graph=True)
    assert asking._updates.fast.graphs is None
    assert asking._updates.bootstrap.__func__ is type(asking._updates).bootstrap


def is_on(value):
    code = "from sb3_causalgdp.acceleration import switch; print(switch.is_on())"
    environment = {**os.environ, switch.VARIABLE: value}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)


def test_an_environment_variable_switches_it_off_and_other_values_are_refused():
    assert is_on("off").stdout.strip() == "False"
    refused = is_on("no")
    assert refused.returncode == 1
    assert "SB3_CAUSALGDP_ACCELERATION must be one of ['on', 'off'], got 'no'" in refused.stderr
