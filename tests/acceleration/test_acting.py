"""The numpy path of predictions gives the actions of the plain one, and leaves to it what it does not cover."""

import copy
import pickle

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.acceleration.acting import NumpyActing
from sb3_causalgdp.diffusion import SAMPLERS
from sb3_causalgdp.offline.replay import SpacesEnv
from sb3_causalgdp.prediction import act, act_in_torch, candidate_noise, choice_noise

N_STATES, N_ACTIONS = 5, 3


def make_policy(
    seed=0, observation_space=None, net_arch=(16, 16), activation_fn="relu", critic_normalization=None, more=None, **kwargs
):
    """A policy whose weights, masks and statistics are all different from their start values, and whose guidance is on."""
    observation_space = observation_space or spaces.Box(-3.0, 3.0, (N_STATES,), np.float32)
    environment = SpacesEnv(observation_space, spaces.Box(-1.0, 1.0, (N_ACTIONS,), np.float32))
    policy_kwargs = {
        "net_arch": list(net_arch),
        "world_model_net_arch": [16, 16],
        "activation_fn": activation_fn,
        "critic_normalization": critic_normalization,
        **(more or {}),
    }
    kind = "MultiInputPolicy" if isinstance(observation_space, spaces.Dict) else "MlpPolicy"
    model = CausalGDP(kind, environment, policy_kwargs=policy_kwargs, buffer_size=10, device="cpu", **kwargs)
    th.manual_seed(seed)
    policy = model.policy
    with th.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.2 * th.randn_like(parameter))
        state, change = th.randn(64, N_STATES), 0.3 * th.randn(64, N_STATES)
        policy.world_model.update_statistics(state, state + change, th.randn(64))
        policy.reward_target.fill_(1.5)
        policy.return_std.fill_(2.0)
    shapes = ((N_STATES, N_STATES), (N_STATES, N_ACTIONS), (N_STATES,), (N_ACTIONS,))
    policy.world_model.set_masks(*(th.rand(shape) for shape in shapes))
    policy.guidance_ready.fill_(1.0)
    policy.set_training_mode(False)
    return policy


def both_paths(policy, observations, deterministic=False):
    observations = th.as_tensor(observations)
    with th.no_grad():
        th.manual_seed(3)
        fast = act(policy, observations, deterministic)
        th.manual_seed(3)
        noise, actor = candidate_noise(policy, len(observations), deterministic), policy.acting_actor(deterministic)
        of_choice = choice_noise(policy, len(observations), deterministic)
        of_torch = (actor.features(observations), noise, deterministic)
        return fast, act_in_torch(policy, observations, *of_torch, of_choice=of_choice)


@pytest.mark.parametrize("optimism", [-1.0, -0.4, 0.0, 0.3, 1.0])
@pytest.mark.parametrize("deterministic", [False, True])
def test_both_paths_hope_for_the_same(optimism, deterministic):
    policy = make_policy(exploration_optimism=optimism)
    fast, plain = both_paths(policy, np.random.default_rng(0).normal(size=(8, N_STATES)).astype(np.float32), deterministic)
    np.testing.assert_allclose(fast, plain, atol=2e-5)


@pytest.mark.parametrize("temperature", [0.5, 3.0])
def test_both_paths_draw_the_same_candidates(temperature):
    policy = make_policy(exploration_temperature=temperature)
    fast, plain = both_paths(policy, states(8))
    np.testing.assert_allclose(fast, plain, atol=2e-5)
    policy.exploration_temperature = 0.0
    best, _ = both_paths(policy, states(8))
    assert not np.allclose(fast, best, atol=1e-3)


@pytest.mark.parametrize(("state_unit", "reward_unit"), [(1.0, 1e-9), (1e-6, 1.0), (0.0, 1.0), (1.0, 0.0)])
def test_both_paths_agree_in_small_units_and_where_nothing_moves(state_unit, reward_unit):
    policy = make_policy(guidance_target="reward")
    model = policy.world_model
    with th.no_grad():
        state = state_unit * th.randn(64, N_STATES) + 0.25
        model.n_batches.zero_()
        model.update_statistics(state, state + 0.3 * state_unit * th.randn(64, N_STATES), reward_unit * th.randn(64) + 0.25)
    policy.reward_target.fill_(0.25 + reward_unit)
    fast, plain = both_paths(policy, state[:4])
    assert np.isfinite(fast).all()
    np.testing.assert_allclose(fast, plain, atol=2e-5)


DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU"))]


def states(n_rows, seed=0, device="cpu"):
    rows = np.random.default_rng(seed).normal(size=(n_rows, N_STATES)).astype(np.float32)
    return rows if device == "cpu" else th.as_tensor(rows, device=device)


@pytest.mark.parametrize("noise_schedule", ["vp", "linear", "cosine"])
@pytest.mark.parametrize(
    "sampler",
    [
        {"sampler": "ddpm"},
        {"sampler": "ddim"},
        {"sampler": "ddim", "ddim_eta": 0.5},
        {"sampler": "euler_maruyama"},
        {"sampler": "heun"},
        {"sampler": "dpm_solver"},
    ],
)
@pytest.mark.parametrize("diffusion_steps", [1, 2, 5])
# PyTorch goes by the noise from a velocity to the clean action, and little signal magnifies its rounding
@pytest.mark.parametrize(("prediction_type", "precision"), [("noise", 1e-5), ("velocity", 1e-4)])
def test_every_schedule_and_sampler(noise_schedule, sampler, diffusion_steps, prediction_type, precision):
    more = {"prediction_type": prediction_type}
    policy = make_policy(noise_schedule=noise_schedule, diffusion_steps=diffusion_steps, more=more, **sampler)
    fast, plain = both_paths(policy, states(4))
    assert policy._acting is not None
    th.testing.assert_close(fast, plain, rtol=precision, atol=precision)


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("sampling_steps", [1, 3, 9])
def test_other_numbers_of_steps(sampler, sampling_steps):
    scale = [0.5, 1.0, 2.0, 1.0, 0.5]
    policy = make_policy(sampler=sampler, guidance_scale=scale, more={"sampling_steps": sampling_steps})
    fast, plain = both_paths(policy, states(4))
    assert policy._acting is not None
    th.testing.assert_close(fast, plain, rtol=1e-5, atol=1e-5)
    policy.guidance_ready.fill_(0.0)
    assert not th.equal(both_paths(policy, states(4))[0], fast)


@pytest.mark.parametrize("denoiser", ["residual_mlp", "transformer"])
def test_other_denoisers_are_left_to_the_plain_path(denoiser):
    policy = make_policy(more={"denoiser": denoiser})
    fast, plain = both_paths(policy, states(4))
    assert policy._acting is None
    assert th.equal(fast, plain)


@pytest.mark.parametrize("guidance", [None, "posterior", "score", "normalized"])
@pytest.mark.parametrize("guidance_target", ["return", "reward"])
@pytest.mark.parametrize("state_guidance_scale", [0.0, 0.5])
def test_every_guidance(guidance, guidance_target, state_guidance_scale):
    # A gentle score: without the posterior's bound, a steep one only says at which wall the action ends
    scale = [0.1, 0.2, 0.3, 0.2, 0.1] if guidance == "score" else [0.5, 1.0, 2.0, 1.0, 0.5]
    policy = make_policy(
        guidance=guidance,
        guidance_target=guidance_target,
        state_guidance_scale=state_guidance_scale,
        outcome_guidance_scale=0.7,
        guidance_scale=scale,
    )
    fast, plain = both_paths(policy, states(4))
    assert policy._acting is not None
    th.testing.assert_close(fast, plain, rtol=1e-5, atol=1e-5)
    if guidance is not None:
        policy.guidance_ready.fill_(0.0)
        assert not th.allclose(both_paths(policy, states(4))[0], fast, atol=1e-3)


@pytest.mark.parametrize("activation_fn", ["relu", "tanh", "mish", "silu"])
@pytest.mark.parametrize("net_arch", [(16,), (16, 16, 16)])
@pytest.mark.parametrize("deterministic", [False, True])
@pytest.mark.parametrize("critic_normalization", [None, "layer", "batch"])
def test_every_activation_and_depth(activation_fn, net_arch, deterministic, critic_normalization):
    policy = make_policy(activation_fn=activation_fn, net_arch=net_arch, critic_normalization=critic_normalization)
    fast, plain = both_paths(policy, states(3), deterministic)
    assert policy._acting is not None
    th.testing.assert_close(fast, plain, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("n_action_candidates", [1, 2, 10])
@pytest.mark.parametrize("n_rows", [1, 4])
def test_every_number_of_candidates_and_rows(n_action_candidates, n_rows):
    policy = make_policy(n_action_candidates=n_action_candidates)
    fast, plain = both_paths(policy, states(n_rows))
    th.testing.assert_close(fast, plain, rtol=1e-5, atol=1e-5)


def test_training_is_seen_at_once():
    policy = make_policy()
    before, _ = both_paths(policy, states(2), deterministic=True)
    acting = policy._acting
    with th.no_grad():
        for parameter in policy.parameters():
            parameter.mul_(1.1)
    after, plain = both_paths(policy, states(2), deterministic=True)
    assert policy._acting is acting
    assert not th.allclose(before, after)
    th.testing.assert_close(after, plain, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
def test_a_copy_of_the_weights_acts_alike_and_sees_training_at_once(device):
    policy = make_policy().to(device)
    policy._acting = acting = NumpyActing(policy, copies=True)
    before, plain = both_paths(policy, states(2, device=device))
    th.testing.assert_close(before, plain, rtol=1e-4, atol=1e-5)
    with th.no_grad():
        for parameter in policy.parameters():
            parameter.mul_(1.1)
        policy.return_std.mul_(2.0), policy.world_model.state_mean.add_(0.5)
    after, plain = both_paths(policy, states(2, device=device))
    assert policy._acting is acting and after.device.type == device
    assert not th.allclose(before, after)
    th.testing.assert_close(after, plain, rtol=1e-4, atol=1e-5)
    # The copy is no part of the policy, and shares none of its memory
    assert all(parameter.grad is None for parameter in acting._copy.policy.parameters())
    assert not {id(one) for one in policy.parameters()} & {id(one) for one in acting._copy.policy.parameters()}


@pytest.mark.parametrize("change", ["copied", "pickled", "replaced", "moved"])
def test_networks_that_were_copied_moved_or_replaced_are_seen(change):
    policy = make_policy()
    both_paths(policy, states(2))
    if change == "copied":
        policy = copy.deepcopy(policy)
    elif change == "pickled":
        policy = pickle.loads(pickle.dumps(policy))
    elif change == "replaced":
        policy.critic_target = make_policy(seed=1).critic_target
    else:
        policy.double().float()
    with th.no_grad():
        for parameter in policy.parameters():
            parameter.mul_(1.1)
    fast, plain = both_paths(policy, states(2))
    assert policy._acting is not None
    th.testing.assert_close(fast, plain, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"activation_fn": th.nn.Softplus},
        {"guidance_covariance": "tweedie"},
        {"observation_space": spaces.Dict({"a": spaces.Box(-1.0, 1.0, (N_STATES,), np.float32)})},
    ],
    ids=["activation", "jacobian", "dictionary"],
)
def test_what_is_not_covered_takes_the_plain_path(kwargs):
    policy = make_policy(**kwargs)
    rows = states(2)
    observation = {"a": th.as_tensor(rows)} if isinstance(policy.observation_space, spaces.Dict) else th.as_tensor(rows)
    with th.no_grad():
        assert act(policy, observation, True).shape == (2, N_ACTIONS)
    assert policy._acting is None


@pytest.mark.parametrize("norm", ["before the layer", "behind the activation", "without weights", "behind one layer of two"])
def test_own_critics_with_other_normalisations_take_the_plain_path(norm):
    policy = make_policy()
    for network in policy.critic_target.q_networks:
        if norm == "before the layer":
            network.insert(0, th.nn.LayerNorm(N_STATES + N_ACTIONS))
        elif norm == "behind the activation":
            network.insert(4, th.nn.LayerNorm(16)).insert(2, th.nn.LayerNorm(16))
        elif norm == "without weights":
            network.insert(3, th.nn.LayerNorm(16, elementwise_affine=False)).insert(
                1, th.nn.LayerNorm(16, elementwise_affine=False)
            )
        else:
            network.insert(1, th.nn.LayerNorm(16))
    assert not NumpyActing.covers(policy)


def test_many_rows_take_the_plain_path(monkeypatch):
    policy = make_policy()
    monkeypatch.setattr(NumpyActing, "__call__", lambda *args: pytest.fail("numpy"))
    n_rows = NumpyActing.MOST_ROWS // policy.n_action_candidates + 1
    with th.no_grad():
        act(policy, th.as_tensor(states(n_rows)), True)


def test_collecting_and_predicting_use_it(monkeypatch):
    calls = []
    original = NumpyActing.__call__
    monkeypatch.setattr(NumpyActing, "__call__", lambda self, *args: calls.append(len(args[1])) or original(self, *args))
    model = CausalGDP("MlpPolicy", "Pendulum-v1", learning_starts=5, policy_kwargs={"net_arch": [8]}, batch_size=4)
    assert isinstance(model.env, DummyVecEnv)
    model.learn(8)
    n_calls = len(calls)
    model.predict(np.zeros((3, 3), dtype=np.float32))
    assert calls[:n_calls] == [1] * n_calls and n_calls >= 2 and calls[n_calls:] == [3]
