from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import SPREAD, small
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback
from sb3_causalgdp.networks import hoped_q, q_values
from sb3_causalgdp.prediction import _chosen_candidate, choice_noise

KWARGS = {**SPREAD, "batch_size": 16, "gradient_steps": 2, "policy_delay": 1}


class BatchNormDropoutExtractor(BaseFeaturesExtractor):
    def __init__(self, observation_space):
        super().__init__(observation_space, get_flattened_obs_dim(observation_space))
        self.layers = nn.Sequential(nn.Flatten(), nn.BatchNorm1d(self.features_dim), nn.Dropout(0.5))

    def forward(self, observations):
        return self.layers(observations)


EXTRACTORS = {
    "plain": {},
    "batch norm and dropout": {"features_extractor_class": BatchNormDropoutExtractor},
    "shared": {"share_features_extractor": True, "features_extractor_class": BatchNormDropoutExtractor},
}


def train(total_timesteps=128, policy_kwargs=None, **kwargs):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **small(policy_kwargs, **{**KWARGS, **kwargs}))
    return model.learn(total_timesteps, callback=CausalWorldModelCallback(min_transitions=40))


@pytest.fixture(scope="module", params=EXTRACTORS)
def trained(request):
    model = train(policy_kwargs=EXTRACTORS[request.param])
    assert model.policy.is_guided
    return model


@pytest.fixture(scope="module")
def observations():
    angle = np.linspace(-3.0, 3.0, 12)
    return np.stack([np.cos(angle), np.sin(angle), np.linspace(-4.0, 4.0, 12)], axis=1).astype(np.float32)


def batch_norm_statistics(module):
    return {name: value.clone() for name, value in module.named_buffers() if "running_" in name or "num_batches" in name}


def assert_same_tensors(tensors, others):
    assert list(tensors) == list(others)
    for name, value in tensors.items():
        assert th.equal(value, others[name]), name


# Deterministic ----------------------------------------------------------------------------------------------------------


def test_a_deterministic_prediction_repeats(trained, observations):
    first, state = trained.predict(observations, deterministic=True)
    assert state is None
    assert np.unique(first).size > 3
    for seed in range(5):
        th.manual_seed(seed)
        np.testing.assert_array_equal(trained.predict(observations, deterministic=True)[0], first)


def test_a_deterministic_prediction_draws_no_random_numbers(trained, observations):
    th.manual_seed(1)
    expected = th.rand(3)
    th.manual_seed(1)
    trained.predict(observations, deterministic=True)
    assert th.equal(th.rand(3), expected)


def test_one_observation_gives_what_a_batch_gives(trained, observations):
    batch, _ = trained.predict(observations, deterministic=True)
    for observation, action in zip(observations, batch, strict=True):
        single, _ = trained.predict(observation, deterministic=True)
        assert single.shape == (1,)
        np.testing.assert_allclose(single, action, rtol=1e-4, atol=1e-5)
    backwards, _ = trained.predict(observations[::-1].copy(), deterministic=True)
    np.testing.assert_allclose(backwards[::-1], batch, rtol=1e-4, atol=1e-5)


def test_predicting_changes_nothing(trained, observations):
    before = deepcopy(dict(trained.policy.state_dict()))
    trained.policy.set_training_mode(True)
    for deterministic in (True, False):
        trained.predict(observations, deterministic=deterministic)
    assert not trained.actor.training and not trained.critic.training
    assert_same_tensors(dict(trained.policy.state_dict()), before)


# Stochastic -------------------------------------------------------------------------------------------------------------


def test_stochastic_predictions_differ_and_repeat_with_the_seed(trained, observations):
    drawn = []
    for seed in (1, 1, 2):
        th.manual_seed(seed)
        drawn.append(trained.predict(observations)[0])
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.array_equal(drawn[0], drawn[2])
    assert not np.array_equal(drawn[0], trained.predict(observations)[0])


def test_predictions_stay_inside_the_action_space(trained, observations):
    for deterministic in (True, False):
        actions, _ = trained.predict(np.repeat(observations, 20, axis=0), deterministic=deterministic)
        assert actions.shape == (240, 1) and actions.dtype == np.float32
        assert all(trained.action_space.contains(action) for action in actions)


def test_exploration_noise_is_added_to_the_diffusion_policys_own(observations):
    spread = {}
    for noise in (0.0, 1.0):
        policy = train(total_timesteps=8, exploration_noise=noise, n_action_candidates=50).policy
        repeated = np.repeat(observations[:1], 200, axis=0)
        spread[noise] = policy.predict(repeated)[0].std()
    # The best of many candidates is nearly always the same
    assert spread[1.0] > spread[0.0] + 0.3


def with_other_actor(model, source, target):
    """A copy whose actor of one name has the weights of another name's."""
    changed = deepcopy(model.policy)
    getattr(changed, target).load_state_dict(getattr(model.policy, source).state_dict())
    return changed


@pytest.mark.parametrize("kwargs", [{}, {"actor_update": "trust_region"}], ids=["denoiser", "one pass"])
def test_the_actor_s_moving_average_plays_and_the_actor_explores(kwargs, observations):
    model = train(learning_rate=1e-2, eta=0.01, **kwargs)
    of_average = with_other_actor(model, "actor_target", "actor")
    of_actor = with_other_actor(model, "actor", "actor_target")

    def predict(policy, deterministic):
        th.manual_seed(0)
        return policy.predict(observations, deterministic=deterministic)[0]

    np.testing.assert_array_equal(predict(model.policy, True), predict(of_average, True))
    assert np.abs(predict(model.policy, True) - predict(of_actor, True)).max() > 1e-3
    np.testing.assert_array_equal(predict(model.policy, False), predict(of_actor, False))
    assert np.abs(predict(model.policy, False) - predict(of_average, False)).max() > 1e-3
    model.policy.use_ema = False
    np.testing.assert_array_equal(predict(model.policy, True), predict(of_actor, True))


def test_the_actor_alone_predicts_without_noise_when_asked_to(trained, observations):
    first, _ = trained.actor.predict(observations, deterministic=True)
    np.testing.assert_array_equal(trained.actor.predict(observations, deterministic=True)[0], first)
    assert not np.array_equal(trained.actor.predict(observations)[0], trained.actor.predict(observations)[0])


# Batch norm and dropout -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("extractor", ["batch norm and dropout", "shared"])
def test_targets_copy_batch_norm_statistics_and_stay_in_evaluation_mode(extractor):
    model = train(policy_kwargs={**EXTRACTORS[extractor], "critic_normalization": None}, tau=0.0)
    for online, target in ((model.actor, model.actor_target), (model.critic, model.critic_target)):
        statistics = batch_norm_statistics(online)
        assert statistics["features_extractor.layers.1.num_batches_tracked"] > 0
        copied = batch_norm_statistics(target)
        for name, value in statistics.items():
            if "running_" in name:
                assert th.equal(copied[name], value)
        model.policy.set_training_mode(True)
        assert online.training and not target.training
        assert not any(module.training for module in target.modules())
        # Weights are not copied with tau=0
        for old, new in zip(target.parameters(), online.parameters(), strict=True):
            assert old is new or not th.equal(old, new)


def test_collecting_leaves_batch_norm_statistics_alone():
    model = train(policy_kwargs=EXTRACTORS["batch norm and dropout"], gradient_steps=0, total_timesteps=64)
    fresh = CausalGDP("MlpPolicy", "Pendulum-v1", **small(EXTRACTORS["batch norm and dropout"], **KWARGS))
    assert_same_tensors(batch_norm_statistics(model.policy), batch_norm_statistics(fresh.policy))


def test_shared_features_are_the_same_module():
    model = train(total_timesteps=32, policy_kwargs={**EXTRACTORS["shared"], "critic_normalization": None})
    assert model.actor.features_extractor is model.critic.features_extractor
    assert model.actor_target.features_extractor is model.critic_target.features_extractor
    assert model.actor.features_extractor is not model.actor_target.features_extractor
    apart = train(total_timesteps=32, policy_kwargs=EXTRACTORS["batch norm and dropout"])
    assert apart.actor.features_extractor is not apart.critic.features_extractor


# Shapes -----------------------------------------------------------------------------------------------------------------


class MatrixEnv(gym.Env):
    def __init__(self, dtype=np.float32):
        self.observation_space = spaces.Box(-1.0, 1.0, (2, 3), dtype)
        self.action_space = spaces.Box(-2.0, 2.0, (2, 2), dtype)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        return self.observation_space.sample(), float(action.sum()), False, False, {}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_actions_have_the_spaces_shape_and_type(dtype):
    model = CausalGDP("MlpPolicy", MatrixEnv(dtype), **small(**KWARGS))
    model.learn(64, callback=CausalWorldModelCallback(min_transitions=40))
    assert model.policy.is_guided
    observation = model.observation_space.sample()
    for deterministic in (True, False):
        single, _ = model.predict(observation, deterministic=deterministic)
        assert single.shape == (2, 2) and single.dtype == dtype
        batch, _ = model.predict(np.stack([observation] * 5), deterministic=deterministic)
        assert batch.shape == (5, 2, 2) and batch.dtype == dtype
    assert model.causal_graph().state_to_state.shape == (6, 6)
    assert model.causal_graph().action_to_state.shape == (6, 4)


def test_vectorised_environments_get_an_action_each():
    env = make_vec_env("Pendulum-v1", n_envs=3, seed=0)
    model = CausalGDP("MlpPolicy", env, **small(**KWARGS))
    actions, _ = model.predict(env.reset(), deterministic=True)
    assert actions.shape == (3, 1)
    env.step(actions)


def test_what_reset_returns_is_not_an_observation():
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **small(**KWARGS))
    with pytest.raises(ValueError, match="mixing Gym API"):
        model.predict(gym.make("Pendulum-v1").reset())
    with pytest.raises(ValueError, match="Unexpected observation shape"):
        model.predict(np.zeros(7, dtype=np.float32))


def test_exploration_hopes_and_playing_does_not(observations):
    """What is hoped of an action decides which candidate is tried."""
    model = train()
    policy = model.policy
    tensor = th.as_tensor(observations)
    features = policy.critic.extract_features(tensor, policy.critic.features_extractor)
    actions = 2.0 * th.rand(len(observations), 1) - 1.0
    q = th.cat(q_values(policy.critic, features, actions), dim=1).detach()
    for optimism, expected in ((1.0, q.amax(dim=1)), (0.0, q.mean(dim=1)), (-1.0, q.amin(dim=1))):
        th.testing.assert_close(hoped_q(policy.critic, features, actions, optimism)[:, 0], expected)
    halfway = hoped_q(policy.critic, features, actions, 0.5)[:, 0]
    th.testing.assert_close(halfway, 0.5 * (q.mean(dim=1) + q.amax(dim=1)))

    def predict(optimism, deterministic):
        policy.exploration_optimism = optimism
        th.manual_seed(0)
        return policy.predict(np.tile(observations, (8, 1)), deterministic=deterministic)[0]

    assert np.abs(predict(1.0, False) - predict(-1.0, False)).max() > 1e-3
    np.testing.assert_array_equal(predict(1.0, True), predict(-1.0, True))


def test_a_temperature_draws_candidates_by_a_softmax_of_their_q(monkeypatch):
    model = train(n_action_candidates=3)
    policy, values = model.policy, th.tensor([[1.0], [3.0], [2.0]])
    monkeypatch.setattr("sb3_causalgdp.prediction.hoped_q", lambda critic, features, actions, optimism: values.repeat(2000, 1))
    features, actions = th.zeros(2000, 3), th.zeros(6000, 1)

    def shares(temperature):
        policy.exploration_temperature = temperature
        noise = choice_noise(policy, 2000, deterministic=False)
        rows = _chosen_candidate(policy, features, actions, -1.0, noise) - 3 * th.arange(2000)
        return th.bincount(rows, minlength=3) / 2000

    assert shares(0.0).tolist() == [0.0, 1.0, 0.0] and choice_noise(policy, 1, deterministic=False) is None
    th.manual_seed(0)
    for temperature in (0.5, 2.0):
        expected = th.softmax(values[:, 0] / (temperature * values.std(correction=0)), dim=0)
        th.testing.assert_close(shares(temperature), expected, atol=0.03, rtol=0.0)
        assert choice_noise(policy, 5, deterministic=True) is None
