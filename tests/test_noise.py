"""How much noise actions get."""

import math

import numpy as np
import pytest
import torch as th

from sb3_causalgdp import CausalGDP

# So that exploring changes the action by the noise alone
PLAIN = {"n_action_candidates": 1, "guidance": None, "policy_kwargs": {"net_arch": [8], "world_model_net_arch": [8]}}
N_ROWS = 2_000


def make(env, **kwargs):
    return CausalGDP("MlpPolicy", env, seed=0, device="cpu", buffer_size=10, **{**PLAIN, **kwargs})


def noise_in_predictions(model):
    """Of those components that no bound cuts, in units of [-1, 1]."""
    observations = np.tile(model.observation_space.sample(), (N_ROWS, 1)).astype(np.float32)
    th.manual_seed(0)
    actions = model.policy.scale_action(model.predict(observations, deterministic=False)[0])
    return (actions - actions.mean(axis=0))[:, np.abs(actions.mean(axis=0)) < 0.3]


@pytest.mark.parametrize(("env", "action_dim"), [("Pendulum-v1", 1), ("Hopper-v5", 3), ("Ant-v5", 8)])
def test_by_default_all_components_together_are_moved_as_far_in_every_task(env, action_dim):
    model = make(env, target_noise_clip=10.0)
    assert model.policy.exploration_noise == pytest.approx(0.3 / math.sqrt(action_dim))
    smoothed = model._updates.smoothed(th.zeros(N_ROWS, action_dim))
    assert float(smoothed.square().sum(dim=1).mean().sqrt()) == pytest.approx(0.3, rel=0.05)


def test_predictions_have_the_noise_that_the_model_says():
    model = make("Pendulum-v1", diffusion_steps=1)
    # A chain begins with noise, too: one that always says 0 ends where it is
    with th.no_grad():
        for parameter in [*model.actor.parameters(), *model.actor_target.parameters()]:
            parameter.zero_()
    assert noise_in_predictions(model).std() > 0.25
    model.policy.exploration_noise = 0.0
    without = noise_in_predictions(model).std()
    model.policy.exploration_noise = 0.1
    assert noise_in_predictions(model).std() == pytest.approx(math.hypot(0.1, without), rel=0.1)


def test_hidden_actions_do_not_count():
    model = make("Hopper-v5", causal_abstraction=True)
    model.policy.show(th.ones(11), th.tensor([1, 0, 0]))
    assert model.policy.exploration_noise == pytest.approx(0.3)
    copy = make("Hopper-v5", causal_abstraction=True)
    copy.policy.load_state_dict(model.policy.state_dict())
    assert copy.policy.exploration_noise == pytest.approx(0.3)
    with model._updates.made_fast(lambda: {}):
        assert float(model._updates.target_noise) == pytest.approx(0.3)


@pytest.mark.parametrize("noise", [0.0, 0.07])
def test_a_number_is_that_of_each_component(noise):
    model = make("Ant-v5", exploration_noise=noise, target_policy_noise=noise)
    model.policy.n_shown_actions = 2
    assert model.policy.exploration_noise == noise
    assert float(model._updates.smoothed(th.zeros(N_ROWS, 8)).std()) == pytest.approx(noise, rel=0.05)


def test_what_was_asked_for_is_saved_and_not_what_came_of_it(tmp_path):
    model = make("Hopper-v5", target_policy_noise=0.05)
    model.save(tmp_path / "model")
    loaded = CausalGDP.load(tmp_path / "model", device="cpu")
    assert (loaded.exploration_noise, loaded.target_policy_noise) == ("auto", 0.05)
    assert loaded.policy.exploration_noise == model.policy.exploration_noise


@pytest.mark.parametrize("name", ["exploration_noise", "target_policy_noise"])
@pytest.mark.parametrize("value", ["much", -0.1, math.nan, None])
def test_what_is_no_noise_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=rf"^{name} must be a number from 0 to 10.* or 'auto', got"):
        make("Pendulum-v1", **{name: value})
