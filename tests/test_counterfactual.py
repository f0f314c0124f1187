import io

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from scipy import stats
from small_models import SMALL
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.causal import CausalGraph
from sb3_causalgdp.causal.counterfactual_batches import Components

NOISE = 0.1
N_STATES, N_ACTIONS = 5, 3
# Two masses, each pushed by its action, a noise, and an action without effect
TRUE_LABELS = [0, 0, 1, 1, 2, 0, 1, 3]


def means(states, actions, coupling):
    x, v, y, w, noise = states.T
    push, pull, _ = actions.T
    return np.stack(
        [
            0.8 * x + 0.3 * v,
            0.8 * v - 0.2 * x + 0.5 * push,
            0.8 * y + 0.3 * w,
            0.8 * w - 0.2 * np.sin(y) + 0.5 * pull + coupling * x,
            0.9 * noise,
        ],
        axis=1,
    )


class TwoMasses(gym.Env):
    observation_space = spaces.Box(-np.inf, np.inf, (N_STATES,), np.float64)
    action_space = spaces.Box(-1.0, 1.0, (N_ACTIONS,), np.float32)

    def __init__(self, coupling=0.0):
        self.coupling = coupling

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.n_steps = self.np_random.normal(size=N_STATES), 0
        return self.state.copy(), {}

    def step(self, action):
        self.n_steps += 1
        mean = means(self.state[None], np.asarray(action, float)[None], self.coupling)[0]
        self.state = mean + NOISE * self.np_random.normal(size=N_STATES)
        return self.state.copy(), float(self.state[0] - self.state[2]), False, self.n_steps == 25, {}


def make(env=None, share=0.5, **arguments):
    rarely = {"batch_size": 4, "train_freq": 100, "gradient_steps": 1, "causal_refresh_freq": 500, "buffer_size": 5_000}
    rarely |= {"exploration_noise": 0.2, "target_policy_noise": 0.2}
    kwargs = {**SMALL, **rarely, **arguments}
    return CausalGDP("MlpPolicy", TwoMasses() if env is None else env, counterfactual_replay=share, **kwargs)


@pytest.fixture(scope="module")
def trained():
    return make().learn(2_500)


def p_of_true_system(states, actions, next_states, coupling=0.0):
    """The smallest p-value, times their number, of tests that what the system leaves of the next states is its noise."""
    left = (next_states - means(states, actions, coupling)) / NOISE
    p_values = [stats.kstest(column, "norm").pvalue for column in left.T]
    p_values += [stats.pearsonr(column, cause).pvalue for column in left.T for cause in (*states.T, *actions.T)]
    return min(p_values) * len(p_values)


def arrays_of(sample):
    return [part.double().numpy() for part in (sample.observations, sample.actions, sample.next_observations)]


def drawn_and_exchanged(model, n_rows=2_000):
    model.set_logger(Logger(None, []))
    th.manual_seed(0)
    np.random.seed(0)
    batches, buffer = model._updates.batches, model.replay_buffer
    if type(buffer) is ReplayBuffer and model.offline_buffer is None:
        # Each row once: copies would pass for dependence
        sample = buffer._get_samples(np.random.permutation(buffer.size())[:n_rows])
    else:
        sample = batches.sample(n_rows)
    return sample, batches.counterfactual.exchanged(sample)


def without_rewards_of_both(model):
    """Only rows whose rewards need no model."""
    with th.no_grad():
        model.world_model.reward_log_std.fill_(0.0)


def test_training_finds_the_components(trained):
    labels = trained.trusted_components.components.labels
    same = labels[:, None] == labels
    np.testing.assert_array_equal(same, np.equal.outer(TRUE_LABELS, TRUE_LABELS))


def test_exchanged_transitions_of_a_batch_have_the_true_systems_distribution(trained):
    with th.no_grad():
        trained.world_model.reward_log_std.fill_(-4.0)  # its rewards are taken
    before, after = drawn_and_exchanged(trained)
    changed = (before.observations != after.observations).any(dim=1)
    assert 0.2 < changed.float().mean() <= 0.5
    assert p_of_true_system(*arrays_of(before)) > 0.01 and p_of_true_system(*arrays_of(after)) > 0.01
    # Each value is there as often as before
    assert th.equal(after.observations[:, 4].sort().values, before.observations[:, 4].sort().values)
    # A mass with its action, and the other one with another
    rows = {tuple(row) for row in th.cat([before.observations, before.actions], dim=1).tolist()}
    mixed = [tuple(row) not in rows for row in th.cat([after.observations, after.actions], dim=1).tolist()]
    assert np.mean(mixed) > 0.2
    untouched = ~changed & (before.actions == after.actions).all(dim=1)
    for name in ("observations", "actions", "next_observations", "rewards", "dones"):
        old, new = getattr(before, name), getattr(after, name)
        assert new.shape == old.shape and new.dtype == old.dtype and th.equal(new[untouched], old[untouched])


def test_a_wrong_graph_shows_in_what_is_drawn():
    model = make(TwoMasses(coupling=0.4)).learn(1_600)
    with th.no_grad():
        model.world_model.reward_log_std.fill_(-4.0)
    right = arrays_of(drawn_and_exchanged(model)[1])
    assert p_of_true_system(*right, 0.4) > 0.01
    read = np.array([True, True, False, False])
    model.trusted_components.components = Components(np.array(TRUE_LABELS), read)
    wrong = arrays_of(drawn_and_exchanged(model)[1])
    assert p_of_true_system(*wrong, 0.4) < 1e-6


def test_rewards_that_nobody_knows_are_not_made_up(trained):
    without_rewards_of_both(trained)
    before, after = drawn_and_exchanged(trained)
    assert not th.equal(before.observations, after.observations)
    expected = (after.next_observations[:, 0] - after.next_observations[:, 2]).float()
    th.testing.assert_close(after.rewards.flatten(), expected, atol=1e-5, rtol=1e-5)


def test_ends_of_episodes_are_left_as_they_are(trained):
    before, _ = drawn_and_exchanged(trained)
    ends = before._replace(dones=th.ones_like(before.dones))
    after = trained._updates.batches.counterfactual.exchanged(ends)
    assert th.equal(after.observations, before.observations) and th.equal(after.actions, before.actions)


def test_until_a_graph_is_trusted_a_training_is_the_same_bit_for_bit():
    models = [make(share=share, train_freq=8, causal_refresh_freq=150).learn(400) for share in (0.0, 1.0)]
    assert models[1].causal_graph() is not None and models[1].trusted_components.components is None
    first, second = (model.policy.state_dict() for model in models)
    assert all(th.equal(value, second[name]) for name, value in first.items())


def test_exchange_changes_what_is_learned():
    models = [make(share=share, train_freq=8, causal_refresh_freq=400).learn(1_700) for share in (0.0, 1.0)]
    assert models[1].trusted_components.components is not None
    assert not th.equal(*(model.critic.qf0[-1].weight for model in models))


def test_offline_online_and_normalised_batches_are_exchanged(tmp_path):
    make(share=0.0).learn(1_500).save_replay_buffer(tmp_path / "buffer.npz")
    model = make(VecNormalize(DummyVecEnv([TwoMasses])), share=1.0, offline_dataset=str(tmp_path / "buffer.npz"))
    model.learn(1_700)
    assert model.trusted_components.components is not None
    before, after = drawn_and_exchanged(model, 200)
    assert (before.observations != after.observations).any(dim=1).float().mean() > 0.2
    model.learn(200, reset_num_timesteps=False)


class Reach(gym.Env):
    """A point and a light that its second action moves; the goal is for the point."""

    box = spaces.Box(-np.inf, np.inf, (2,), np.float64)
    goal = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    observation_space = spaces.Dict({"observation": box, "achieved_goal": goal, "desired_goal": goal})
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.wanted, self.n_steps = self.np_random.normal(size=2), self.np_random.normal(size=1), 0
        return self._observation(), {}

    def step(self, action):
        self.n_steps += 1
        self.state = 0.8 * self.state + 0.5 * action + 0.1 * self.np_random.normal(size=2)
        observation = self._observation()
        reward = self.compute_reward(observation["achieved_goal"], self.wanted, {})
        return observation, float(reward), False, self.n_steps == 10, {}

    def _observation(self):
        return {"observation": self.state.copy(), "achieved_goal": self.state[:1].copy(), "desired_goal": self.wanted.copy()}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -(np.abs(achieved_goal - desired_goal)[..., 0] > 0.3).astype(np.float32)


@pytest.mark.parametrize("normalized", [False, True])
def test_rewards_of_hindsight_goals_are_those_of_the_task(normalized):
    vec_env = DummyVecEnv([Reach])
    if normalized:
        vec_env = VecNormalize(vec_env, norm_reward=False)
    model = CausalGDP(
        "MultiInputPolicy",
        vec_env,
        counterfactual_replay=1.0,
        replay_buffer_class=HerReplayBuffer,
        **{**SMALL, "batch_size": 4, "train_freq": 100, "gradient_steps": 1, "causal_refresh_freq": 500, "buffer_size": 5_000},
    ).learn(2_000)
    components = model.trusted_components.components
    names = model.transition_variables.state_names
    of_name = dict(zip((*names, *model.transition_variables.action_names), components.labels.tolist(), strict=True))
    assert len(set(of_name.values())) >= 3
    before, after = drawn_and_exchanged(model, 400)
    moved = (before.observations["desired_goal"] != after.observations["desired_goal"]).flatten()
    assert moved.float().mean() > 0.2
    following = {key: values.numpy() for key, values in after.next_observations.items()}
    if normalized:
        following = vec_env.unnormalize_obs(following)
    expected = Reach().compute_reward(following["achieved_goal"], following["desired_goal"], {})
    margin = np.abs(np.abs(following["achieved_goal"] - following["desired_goal"])[:, 0] - 0.3) > 1e-3
    np.testing.assert_array_equal(after.rewards.numpy()[margin, 0], expected[margin])
    assert 0.0 < (after.rewards == 0.0).float().mean() < 1.0


def test_what_may_be_exchanged_survives_files(trained):
    stream = io.BytesIO()
    trained.save(stream)
    loaded = CausalGDP.load(stream, env=TwoMasses(), device="cpu")
    assert loaded.counterfactual_replay == 0.5
    assert loaded.trusted_components.state_dict() == trained.trusted_components.state_dict()
    assert loaded.trusted_components.components is not None
    off = CausalGDP.load(stream, env=TwoMasses(), device="cpu", counterfactual_replay=0.0)
    assert off.trusted_components.components is None


def test_mistakes_are_named():
    with pytest.raises(ValueError, match=r"counterfactual_replay must be a number from 0 to 1, got 1\.5"):
        make(share=1.5)
    with pytest.raises(ValueError, match="counterfactual_replay must be 0 with n-step returns"):
        make(n_steps=3)
    env = gym.make("Pendulum-v1")
    env.observation_space = spaces.Discrete(3)
    with pytest.raises(ValueError, match="counterfactual_replay must be 0 where observations are not boxes"):
        make(env)


def test_termination_binds_what_it_may_read():
    model = make()
    graph = CausalGraph(
        model.transition_variables, np.eye(N_STATES + 1, N_STATES + N_ACTIONS), np.zeros((6, 8)), "by hand", 1_000
    )
    for _ in range(2):
        assert model.judge_components(graph, np.array([True, False, True, False, False])) == ""
    labels = model.trusted_components.components.labels
    assert labels[0] == labels[2] and len(set(labels.tolist())) == 7
