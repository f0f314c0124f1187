from itertools import pairwise

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from ones import Ones
from small_models import SMALL
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback, MlpPolicy
from sb3_causalgdp.callbacks.diagnostics import (
    choice,
    dead_units,
    discounted_returns,
    gradient_norm,
    guidance_divergence,
    step_size_bound,
)


def make_policy(**kwargs):
    th.manual_seed(0)
    observation_space = spaces.Box(-1.0, 1.0, (3,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    return MlpPolicy(observation_space, action_space, lambda _: 1e-3, net_arch=[16], world_model_net_arch=[16], **kwargs)


@pytest.fixture
def observations():
    return th.rand(16, 3, generator=th.Generator().manual_seed(0)) * 2 - 1


def divergence(observations, **kwargs):
    policy = make_policy(**kwargs)
    th.manual_seed(1)
    return guidance_divergence(policy, observations)


def bound(observations, **kwargs):
    delta = kwargs.pop("delta", 1.0)
    policy = make_policy(**kwargs)
    th.manual_seed(1)
    return step_size_bound(policy, observations, delta)


@pytest.mark.parametrize("guidance", ["posterior", "score", "normalized"])
def test_divergence_grows_from_nothing_with_the_scale(guidance, observations):
    values = [divergence(observations, guidance=guidance, guidance_scale=scale) for scale in (1e-9, 0.01, 0.1, 1.0)]
    assert 0.0 <= values[0] < 1e-10
    assert values == sorted(values) and values[1] < values[3]
    # Quadratic in the shift, for small ones
    assert values[2] == pytest.approx(100 * values[1], rel=0.5)


def test_divergence_is_the_sum_over_all_steps(observations):
    scales = np.full(5, 0.01)
    whole = divergence(observations, guidance_scale=list(scales))
    parts = [divergence(observations, guidance_scale=list(scales * (np.arange(5) == step))) for step in range(5)]
    assert all(0.0 < part < whole for part in parts)
    assert sum(parts) == pytest.approx(whole, rel=0.2)


def test_divergence_leaves_no_gradient(observations):
    policy = make_policy()
    guidance_divergence(policy, observations)
    step_size_bound(policy, observations)
    assert all(parameter.grad is None for parameter in policy.parameters())


def test_the_value_of_a_choice_is_that_of_the_actions_that_are_taken(observations):
    policy = make_policy(n_action_candidates=4)
    policy.guidance_ready.fill_(1.0)
    policy.set_training_mode(False)
    assert policy.is_guided
    before = th.get_rng_state()
    found = choice(policy, observations)
    assert th.equal(th.get_rng_state(), before)
    actions = th.as_tensor(policy.predict(observations.numpy(), deterministic=True)[0])
    with th.no_grad():
        value = th.cat(policy.critic_target(observations, actions), dim=1).amin(dim=1).mean()
    assert found.q_value == pytest.approx(value.item(), abs=1e-5)
    policy.guidance_rule = None
    unguided = choice(policy, observations)
    assert unguided.guidance_advantage == 0.0
    assert (
        found.guidance_advantage == pytest.approx(found.q_value - unguided.q_value, abs=1e-6) and found.guidance_advantage != 0
    )
    assert found.candidate_spread == unguided.candidate_spread > 0.0
    alone = make_policy(n_action_candidates=1)
    alone.set_training_mode(False)
    assert choice(alone, observations[:1]).candidate_spread == 0.0


@pytest.mark.parametrize("guidance", ["posterior", "score"])
def test_step_size_bound_shrinks_with_the_scale(guidance, observations):
    bounds = [bound(observations, guidance=guidance, guidance_scale=scale) for scale in (0.01, 1.0, 100.0)]
    assert bounds[0].bound > bounds[1].bound > bounds[2].bound > 0.0
    # The guidance's share is inversely proportional to its scale
    for one, next_one in pairwise(bounds):
        assert next_one.guidance_bound == pytest.approx(one.guidance_bound / 100.0, rel=0.05)
        assert next_one.guidance_lipschitz == pytest.approx(100.0 * one.guidance_lipschitz, rel=0.05)
    assert all(one.bound < one.guidance_bound for one in bounds)


def test_bound_is_proportional_to_delta(observations):
    half, whole = bound(observations, delta=0.5), bound(observations, delta=1.0)
    assert half.bound == pytest.approx(0.5 * whole.bound)
    assert half.guidance_bound == pytest.approx(0.5 * whole.guidance_bound)


@pytest.mark.parametrize("n_steps", [1, 5, 10])
def test_step_size_is_one_over_the_number_of_steps(n_steps, observations):
    assert bound(observations, diffusion_steps=n_steps).step_size == pytest.approx(1.0 / n_steps)


def test_a_huge_plain_score_exceeds_the_bound_and_a_tiny_one_does_not(observations):
    assert bound(observations, guidance="score", guidance_scale=1e6).guidance_exceeds
    assert not bound(observations, guidance="score", guidance_scale=1e-6).guidance_exceeds


def test_posterior_guidance_is_less_steep_than_the_plain_score(observations):
    steep = {"state_guidance_scale": 1e4, "outcome_guidance_scale": 1e4}
    score, posterior = (bound(observations, guidance=name, **steep) for name in ("score", "posterior"))
    assert score.guidance_lipschitz > 10 * posterior.guidance_lipschitz
    assert score.guidance_exceeds


# Why it may not learn -----------------------------------------------------------------------------------------------------


def test_returns_are_those_that_were_obtained():
    rewards = np.array([[1.0, 1.0, 1.0]] * 6)
    dones, timeouts = np.zeros((6, 3)), np.zeros((6, 3))
    dones[2], timeouts[2, 1] = [1, 1, 0], 1
    returns = discounted_returns(rewards, dones, timeouts, 0.5)
    # Of an episode that ended, all is known; of one that was cut or goes on, only where little can follow
    np.testing.assert_allclose(returns[:3, 0], [1.75, 1.5, 1.0])
    np.testing.assert_array_equal(np.isnan(returns[:3, 1]), [False, True, True])
    assert returns[0, 1] == 1.75
    np.testing.assert_allclose(returns[:4, 2], [1.96875, 1.9375, 1.875, 1.75])
    assert np.isnan(returns[4:]).all()


@pytest.mark.parametrize("activation_fn", ["relu", "tanh", "mish"])
@pytest.mark.parametrize("kwargs", [{}, {"denoiser": "residual_mlp", "critic_normalization": "layer"}], ids=str)
def test_units_that_do_not_vary_are_dead(activation_fn, kwargs, observations):
    policy = make_policy(activation_fn=activation_fn, **kwargs)
    policy.set_training_mode(False)
    alive = dead_units(policy, observations)
    if activation_fn != "relu":
        assert alive == {"actor": 0.0, "critic": 0.0}
    with th.no_grad():
        for network in policy.critic_target.q_networks:
            layer = next(module for module in network if isinstance(module, th.nn.Linear))
            layer.weight[:4], layer.bias[:4] = 0.0, -1.0
            for norm in network:
                if isinstance(norm, th.nn.LayerNorm):
                    norm.weight[:4] = 0.0
    dead = dead_units(policy, observations)
    assert dead["critic"] >= max(4 / 16, alive["critic"])
    assert dead["actor"] == alive["actor"]


def test_gradient_norms_are_those_of_the_last_updates():
    network = th.nn.Linear(3, 2)
    optimizer = th.optim.Adam(network.parameters(), lr=0.0)
    assert gradient_norm(optimizer) is None
    for factor in (3.0, 4.0):
        for parameter in network.parameters():
            parameter.grad = factor * th.ones_like(parameter) / 8**0.5
        optimizer.step()
    assert gradient_norm(optimizer) == pytest.approx((25.0 / 2.0) ** 0.5, rel=1e-2)
    assert gradient_norm(th.optim.SGD(network.parameters(), lr=0.1)) is None


def test_the_error_of_q_is_logged_and_is_that_of_the_critics():
    model = CausalGDP("MlpPolicy", Ones(), **{**SMALL, "causal_refresh_freq": 50})
    logged = {}

    class Constant(BaseCallback):
        """Critics that say 20."""

        def _on_step(self):
            with th.no_grad():
                for network in model.critic_target.q_networks:
                    network[-1].weight.zero_()
                    network[-1].bias.fill_(20.0)
            return True

    class Remembering(Logger):
        def record(self, key, value, exclude=None):
            logged.setdefault(key, []).append(value)

    model.set_logger(Remembering(None, []))
    callback = CausalWorldModelCallback(min_transitions=30, diagnostics_batch_size=1000)
    model.learn(50, callback=[Constant(), callback])
    obtained = (1 - 0.99 ** np.arange(1, 11)) / 0.01
    assert logged["policy/q_error"] == [pytest.approx(20.0 - obtained.mean(), rel=1e-3)]
    assert set(logged) >= {"policy/dead_units_actor", "policy/dead_units_critic", "train/actor_gradient_norm"}
