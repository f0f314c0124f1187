"""
Recorded gradient steps train as plain ones. Where there is no GPU, a recording is the list of PyTorch's operations that a step
made: like a CUDA graph it knows tensors alone, so that a number that was looked up while recording is never looked up again.
"""

import copy

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch.fx.experimental.proxy_tensor import make_fx

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.acceleration.cuda_graphs import UpdateGraphs, why_not_recorded
from tests.test_update import COMPILABLE, assert_same_weights, dictionary_pendulum, trained_model

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU"))]
SETTINGS = {
    **COMPILABLE,
    "score, by step": {"guidance": "score", "guidance_scale": [0.1, 0.2, 0.3, 0.4, 0.5]},
    "three critics": {"policy_kwargs": {"net_arch": [8], "n_critics": 3}},
    "every step": {"policy_delay": 1, "world_model_delay": 3},
    "AdamW": {"policy_kwargs": {"net_arch": [8], "optimizer_class": th.optim.AdamW}},
}


def states_of(model):
    """Every tensor that a gradient step writes."""
    states = [state for optimizer in model._updates.optimizers() for state in optimizer.state.values()]
    return [*model.policy.state_dict().values(), *(value for state in states for value in state.values())]


def recorder_of(model):
    """None for a CUDA graph; the other recorder changes nothing while it records either."""
    if model.device.type == "cuda":
        return None

    def record_operations(function):
        states = states_of(model)
        before, random_state = [state.clone() for state in states], th.get_rng_state()
        names = []

        def step():
            losses = function()
            names[:] = losses
            return list(losses.values())

        operations = make_fx(step)()
        th.set_rng_state(random_state)
        for state, value in zip(states, before, strict=True):
            state.copy_(value)
        return th.no_grad()(lambda: dict(zip(names, operations(), strict=True)))

    return record_operations


def copies(model, path):
    """Two models that go on from this one, the second with recordings."""
    model.save(path / "model")
    model.save_replay_buffer(path / "buffer")
    # Its learning rate is a function
    loaded = [CausalGDP.load(path / "model", env=model.get_env(), device=model.device, trusted=True) for _ in range(2)]
    for one in loaded:
        one.load_replay_buffer(path / "buffer")
        one.set_logger(Logger(None, []))
        one._n_updates += 100  # behind the first hundred, whose running averages have weights of their own
    loaded[0]._updates.fast.graphs = None
    loaded[1]._updates.fast.graphs = UpdateGraphs(loaded[1]._updates.optimizers(), recorder_of(loaded[1]))
    return loaded


def train(model, n_calls=14):
    th.manual_seed(3), np.random.seed(3)
    logged = []
    for call in range(n_calls):
        model._current_progress_remaining = 1.0 - call / n_calls
        model.train(gradient_steps=2, batch_size=32)
        logged.append({name: value for name, value in model.logger.name_to_value.items() if "loss" in name})
    return logged


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", SETTINGS)
def test_recorded_steps_train_as_plain_ones(name, device, tmp_path):
    model = trained_model(device=device, learning_rate=lambda progress: 1e-3 * progress, **SETTINGS[name])
    plain, recorded = copies(model, tmp_path)
    expected, logged = train(plain), train(recorded)
    # One for each critic that is climbed and each pair of networks that are updated together
    assert len(recorded._updates.fast.graphs._recordings) >= 2
    assert_same_weights(recorded.policy.state_dict(), plain.policy.state_dict(), rtol=1e-4, atol=1e-5)
    for ours, theirs in zip(logged, expected, strict=True):
        assert ours == pytest.approx(theirs, rel=1e-3, abs=1e-5)
    assert all(group["lr"] == pytest.approx(1e-3 / 14) for group in recorded.actor.optimizer.param_groups)


@pytest.mark.parametrize("device", DEVICES)
def test_recorded_steps_train_on_dictionaries_and_see_new_masks_and_weights(device, tmp_path):
    both = copies(trained_model("MultiInputPolicy", dictionary_pendulum(), device=device), tmp_path)
    for model in both:
        train(model)
        closed = copy.deepcopy(model.causal_graph())
        closed.state_to_state[:] = 0.0
        model.set_causal_graph(closed)
        model.eta *= 10.0
        train(model)
    assert_same_weights(both[1].policy.state_dict(), both[0].policy.state_dict(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
def test_recorded_steps_train_on_images(device, tmp_path):
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False)
    env.observation_space.seed(0)
    policy_kwargs = {"net_arch": [8], "features_extractor_kwargs": {"features_dim": 8}}
    both = copies(trained_model("CnnPolicy", env, device=device, policy_kwargs=policy_kwargs), tmp_path)
    for model in both:
        train(model)
    assert len(both[1]._updates.fast.graphs._recordings) >= 2
    assert_same_weights(both[1].policy.state_dict(), both[0].policy.state_dict(), rtol=1e-3, atol=1e-4)


def test_recordings_that_keep_changing_do_not_pile_up():
    total, batch = th.zeros(()), ReplayBufferSamples(*[th.ones(1)] * 5)
    optimizer = th.optim.Adam([th.nn.Parameter(th.zeros(()))], fused=True)
    graphs = UpdateGraphs([optimizer], recorder=lambda function: function)
    for kind in range(2 * UpdateGraphs.MOST_RECORDINGS):
        for _ in range(UpdateGraphs.WARM_UPS + 2):
            graphs.run(kind, lambda batch: {"sum": total.add_(batch.rewards.sum())}, [batch])
        assert 1 <= len(graphs._recordings) <= UpdateGraphs.MOST_RECORDINGS
    assert total == 2 * UpdateGraphs.MOST_RECORDINGS * (UpdateGraphs.WARM_UPS + 2)


# Where nothing is recorded ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", ["yes", 1, None])
def test_other_values_are_refused(value):
    with pytest.raises(ValueError, match="cuda_graph must be True or False or 'auto'"):
        CausalGDP("MlpPolicy", "Pendulum-v1", cuda_graph=value)


def test_a_model_that_asks_for_it_plays_on_a_cpu_and_says_why_it_cannot_train_there(tmp_path):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", device="cpu")
    model.cuda_graph = True
    model.save(tmp_path / "model")
    loaded = CausalGDP.load(tmp_path / "model", env=model.get_env(), device="cpu")
    assert loaded.predict(loaded.get_env().reset())[0].shape == (1, 1)
    for train in (lambda: loaded.learn(1), lambda: CausalGDP("MlpPolicy", "Pendulum-v1", device="cpu", cuda_graph=True)):
        with pytest.raises(ValueError, match="cuda_graph=True needs device='cuda', and this model is on 'cpu'"):
            train()
    custom_objects = {"cuda_graph": "auto"}
    assert CausalGDP.load(tmp_path / "model", model.get_env(), "cpu", custom_objects).learn(1).num_timesteps == 1


def optimizer(kind, **kwargs):
    return kind([th.nn.Parameter(th.zeros(()))], **kwargs)


@pytest.mark.parametrize(
    "changed, reason",
    [
        ({}, None),
        ({"compile_mode": True}, None),
        ({"optimizers": [optimizer(th.optim.RMSprop, capturable=True)]}, None),
        ({"device": th.device("cpu")}, "needs device='cuda'"),
        ({"compile_mode": "reduce-overhead"}, "makes CUDA graphs of its own"),
        ({"optimizers": [optimizer(th.optim.Adam, fused=True), optimizer(th.optim.SGD)]}, "SGD has neither"),
    ],
)
def test_what_stands_in_the_way_is_said(changed, reason):
    arguments = {"device": th.device("cuda"), "compile_mode": False}
    found = why_not_recorded(**{**arguments, "optimizers": [optimizer(th.optim.Adam, fused=True)], **changed})
    assert found is None if reason is None else reason in found


def test_parameters_that_are_set_have_recordings_of_their_own(tmp_path):
    model = copies(trained_model(device="cpu"), tmp_path)[1]
    before, graphs = model.get_parameters(), model._updates.fast.graphs
    model.set_parameters(before)
    assert model._updates.fast.graphs is not graphs
