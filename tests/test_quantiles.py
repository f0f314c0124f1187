"""Critics that learn quantiles of the return."""

import importlib.util

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib.common.utils import quantile_huber_loss
from small_models import small

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.losses import quantile_td_target
from sb3_causalgdp.networks import hoped_q, network_outputs, q_values, smallest_q
from tests.acceleration.test_acting import both_paths, make_policy, states


class Coin(gym.Env):
    """Each step is an episode, whose reward is 10 or -10, whatever one does."""

    observation_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32), {}

    def step(self, action):
        observation = self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32)
        return observation, float(self.np_random.choice([-10.0, 10.0])), True, False, {}


def make(n_quantiles=5, dropped=2, env="Pendulum-v1", policy_kwargs=None, **kwargs):
    of_critics = {"n_quantiles": n_quantiles, "top_quantiles_to_drop_per_net": dropped}
    return CausalGDP("MlpPolicy", env, **small({**of_critics, **(policy_kwargs or {})}, **kwargs))


@pytest.mark.parametrize("normalization", ["batch", "layer", None])
def test_quantiles_are_those_of_the_return(normalization):
    more = {"critic_normalization": normalization, "net_arch": [32]}
    model = make(4, 1, Coin(), more, learning_rate=1e-2, batch_size=64, train_freq=1, learning_starts=200).learn(900)
    data = model.replay_buffer.sample(64)
    critic = model.critic
    outputs = network_outputs(critic, critic.extract_features(data.observations, critic.features_extractor), data.actions)
    for quantiles in outputs:
        # Half of the returns are -10: the two lower quantiles are below 0, the two upper ones above
        lowest, low, high, highest = quantiles.sort(dim=1).values.mean(dim=0).tolist()
        assert -14.0 < lowest < low < -6.0 and 6.0 < high < highest < 14.0
    for quantiles, value in zip(outputs, model.critic(data.observations, data.actions), strict=True):
        th.testing.assert_close(value, quantiles.sort(dim=1).values[:, :3].mean(dim=1, keepdim=True))


@pytest.fixture(scope="module")
def trained():
    return make(policy_kwargs={"critic_normalization": "layer"}).learn(80)


def test_the_target_is_the_smallest_quantiles_of_all_critics_and_the_loss_is_that_of_tqc(trained):
    data = trained.replay_buffer.sample(32)
    trained.target_policy_noise = 0.0
    actions, target = trained._updates.bootstrap(data)
    features = trained.critic_target.extract_features(data.next_observations, trained.critic_target.features_extractor)
    following = network_outputs(trained.critic_target, features, actions)
    pooled = th.cat(following, dim=1).sort(dim=1).values[:, : 2 * 3]
    th.testing.assert_close(target, data.rewards + (1.0 - data.dones) * trained.gamma * pooled)

    _, loss, _ = trained._updates.critic_gradients(data, target)
    outputs = th.stack(trained.critic.outputs(data.observations, data.actions), dim=1)
    expected = quantile_huber_loss(outputs, target.unsqueeze(1), sum_over_quantiles=False)
    th.testing.assert_close(loss, expected.detach())


def test_of_several_actions_the_one_with_the_largest_mean_of_what_counts_is_the_target():
    quantiles = th.tensor([[0.0, 1.0, 90.0], [1.0, 2.0, 3.0], [5.0, 0.0, 0.0], [4.0, 4.0, 0.0]])
    rewards, dones = th.zeros(2, 1), th.zeros(2, 1)
    target = quantile_td_target([quantiles], rewards, dones, 1.0, n_backup_actions=2, n_kept=2)
    assert target.tolist() == [[1.0, 2.0], [0.0, 4.0]]


def test_the_more_quantiles_are_dropped_the_less_is_an_action_worth_to_all_who_ask():
    model = make(dropped=0).learn(60)
    data, critic = model.replay_buffer.sample(16), model.critic
    features = critic.extract_features(data.observations, critic.features_extractor)
    worth = []
    for critic.n_kept in (5, 3, 1):
        of_each = th.cat(q_values(critic, features, data.actions), dim=1)
        th.testing.assert_close(smallest_q(critic, features, data.actions), of_each.amin(dim=1, keepdim=True))
        th.testing.assert_close(hoped_q(critic, features, data.actions, 1.0), of_each.amax(dim=1, keepdim=True))
        th.testing.assert_close(th.cat(critic(data.observations, data.actions), dim=1), of_each)
        worth.append(of_each)
    assert (worth[0] > worth[1]).all() and (worth[1] > worth[2]).all()


@pytest.mark.parametrize("normalization", ["batch", "layer", None])
@pytest.mark.parametrize(("n_quantiles", "dropped"), [(1, 0), (4, 0), (5, 2), (3, 2)])
def test_both_acting_paths_see_the_same_quantiles(n_quantiles, dropped, normalization):
    more = {"n_quantiles": n_quantiles, "top_quantiles_to_drop_per_net": dropped}
    policy = make_policy(critic_normalization=normalization, more=more)
    for deterministic in (True, False):
        fast, plain = both_paths(policy, states(8), deterministic)
        np.testing.assert_allclose(fast, plain, atol=1e-4)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"expectile": 0.7, "actor_update": "weighted", "policy_kwargs": {"critic_normalization": "layer"}},
        {"max_q_backup": True, "policy_kwargs": {"critic_normalization": "layer"}},
        {"actor_update": "imitation"},
        {"n_steps": 3},
        {"policy_kwargs": {"n_critics": 1}},
    ],
    ids=str,
)
def test_quantiles_train_with_every_kind_of_update(kwargs):
    model = make(**kwargs).learn(60)
    assert all(th.isfinite(parameter).all() for parameter in model.policy.parameters())


def test_a_saved_model_goes_on_with_its_quantiles(tmp_path):
    model = make().learn(40)
    model.save(tmp_path / "model")
    loaded = CausalGDP.load(tmp_path / "model", env="Pendulum-v1")
    assert (loaded.critic.n_quantiles, loaded.critic.n_kept) == (5, 3)
    observation = model.observation_space.sample()
    np.testing.assert_array_equal(
        loaded.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True)[0]
    )
    loaded.learn(40)


def test_what_cannot_work_is_refused(monkeypatch):
    with pytest.raises(ValueError, match=r"top_quantiles_to_drop_per_net must be below n_quantiles=2, got 2"):
        make(2, 2)
    with pytest.raises(ValueError, match="pessimism must be a number with n_quantiles, got 'auto'"):
        make(pessimism="auto")
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *args: None if name == "sb3_contrib" else find_spec(name, *args)
    )
    with pytest.raises(ImportError, match="n_quantiles=5 needs the loss of sb3-contrib: pip install sb3-contrib"):
        make()
