import warnings

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from small_models import small
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback

KWARGS = small(learning_starts=30, batch_size=16, buffer_size=500, causal_refresh_freq=1_000)
TORQUE = "action[0]"


class GoalPendulum(gym.ObservationWrapper):
    """Pendulum whose observation is a dictionary, one part of which is discrete."""

    def __init__(self, is_discrete=True):
        super().__init__(gym.make("Pendulum-v1"))
        parts = {"place": spaces.Box(-1.0, 1.0, (2,)), "speed": spaces.Box(-8.0, 8.0, (1,))}
        self.observation_space = spaces.Dict({**parts, **({"side": spaces.Discrete(2)} if is_discrete else {})})

    def observation(self, observation):
        parts = {"place": observation[:2], "speed": observation[2:], "side": int(observation[1] > 0.0)}
        return {key: parts[key] for key in self.observation_space.spaces}


def learn(env, policy="MlpPolicy"):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Causal discovery waits")
        return CausalGDP(policy, env, **KWARGS).learn(120)


def play(env, n_steps=12, seed=0):
    """Recorded as one does by hand: lists of what the environment gives."""
    env.action_space.seed(seed)
    observations, actions, rewards = [env.reset(seed=seed)[0]], [], []
    for _ in range(n_steps):
        action = env.action_space.sample()
        observation, reward, _, _, _ = env.step(action)
        observations.append(observation)
        actions.append(action)
        rewards.append(reward)
    return observations, actions, rewards


class FarPendulum(gym.ObservationWrapper):
    """Pendulum far from 0, in a dictionary perhaps."""

    def __init__(self, offset, in_dictionary=False):
        super().__init__(gym.make("Pendulum-v1"))
        self.offset, self.in_dictionary = offset, in_dictionary
        box = spaces.Box(-np.inf, np.inf, (3,), np.float64)
        self.observation_space = spaces.Dict({"far": box, "side": spaces.Discrete(2)}) if in_dictionary else box

    def observation(self, observation):
        far = observation.astype(np.float64) + self.offset
        return {"far": far, "side": int(observation[1] > 0.0)} if self.in_dictionary else far


@pytest.mark.parametrize("in_dictionary", [False, True])
def test_far_from_zero_nothing_is_lost_on_the_way(in_dictionary):
    policy = "MultiInputPolicy" if in_dictionary else "MlpPolicy"
    env = VecNormalize(
        DummyVecEnv([lambda: FarPendulum(5e6, in_dictionary)]), norm_obs_keys=["far"] if in_dictionary else None
    )
    model = learn(env, policy)
    observations, actions, rewards = play(FarPendulum(5e6, in_dictionary))
    far = np.stack([one["far"] if in_dictionary else one for one in observations])
    counterfactual = model.counterfactual((observations, actions, rewards), {})
    np.testing.assert_array_equal(counterfactual.states[:, :3], far)
    buffer = model.replay_buffer
    stored = buffer.observations["far"] if in_dictionary else buffer.observations
    (rows,) = CausalWorldModelCallback._rows_at(_with(model), buffer, np.arange(100))
    np.testing.assert_array_equal(rows[:, :3], stored[:100, 0])
    if in_dictionary:
        np.testing.assert_array_equal(rows[:, 3:5], np.eye(2)[buffer.observations["side"][:100, 0].ravel()])


def _with(model):
    callback = CausalWorldModelCallback()
    callback.model = model
    return callback


@pytest.fixture(scope="module")
def pendulum():
    return learn("Pendulum-v1")


@pytest.fixture(scope="module")
def normalised():
    return learn(VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")])))


def test_the_world_model_must_have_been_trained():
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **KWARGS)
    for ask in (
        model.structural_model,
        lambda: model.intervene(np.zeros(3), [0.0], {}),
        lambda: model.effect_of_actions(np.zeros(3), [0.0]),
        lambda: model.counterfactual(play(gym.make("Pendulum-v1")), {}),
    ):
        with pytest.raises(RuntimeError, match="The world model has not been trained"):
            ask()


def test_one_observation_and_a_batch(pendulum):
    observations, actions, _ = play(gym.make("Pendulum-v1"))
    batch = pendulum.intervene(np.array(observations[:-1]), actions, {TORQUE: 1.5})
    single = pendulum.intervene(observations[3], actions[3], {TORQUE: 1.5})
    assert batch.next_state.shape == (12, 3) and batch.reward.shape == (12,)
    assert single.next_state.shape == (3,) and single.reward.shape == ()
    for one, many in zip(single, batch, strict=True):
        np.testing.assert_allclose(one, many[3], rtol=1e-5)


def test_the_actions_have_the_bounds_of_their_space(pendulum):
    structural = pendulum.structural_model()
    np.testing.assert_array_equal(structural.action_low, [-2.0])
    action = np.array([[-2.0], [0.3], [2.0]], dtype=np.float32)
    scaled = structural._model_action(action.astype(np.float64)).numpy()
    np.testing.assert_allclose(scaled, pendulum.policy.scale_action(action), atol=1e-6)
    with pytest.raises(ValueError, match=r"torque must be in \[-2, 2\], got 2.5"):
        pendulum.intervene(np.zeros(3), [0.0], {TORQUE: 2.5})
    with pytest.raises(ValueError, match=r"Actions must have the shape \(1,\) or \(batch, 1\), got \(3,\)"):
        pendulum.intervene(np.zeros((3, 3)), [0.0, 0.0, 0.0], {})
    with pytest.raises(ValueError, match="known are"):
        pendulum.intervene(np.zeros(3), [0.0], {"speed": 1.0})


def test_predictions_are_those_of_the_world_model(pendulum):
    observations, actions, _ = play(gym.make("Pendulum-v1"))
    outcome = pendulum.intervene(np.array(observations[:-1]), actions, {})
    state = pendulum.policy.causal_state(pendulum.policy.obs_to_tensor(np.array(observations[:-1]))[0])
    action = state.new_tensor(pendulum.policy.scale_action(np.array(actions)))
    mean, std = pendulum.world_model.predict_next_state(state, action)
    reward, _ = pendulum.world_model.predict_reward(mean, action)
    np.testing.assert_allclose(outcome.next_state, mean.detach().numpy(), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(outcome.next_state_std[0], std.detach().numpy(), rtol=1e-5)
    np.testing.assert_allclose(outcome.reward, reward.detach().numpy(), rtol=1e-4)


def test_effects(pendulum):
    observations, actions, _ = play(gym.make("Pendulum-v1"))
    effects = pendulum.effect_of_actions(np.array(observations[:-1]), actions, delta=0.5)
    assert effects.n_observations == 12 and effects.next_state.mean.shape == (3, 1)
    assert effects.variables is pendulum.transition_variables
    np.testing.assert_array_equal(effects.action_half_range, [2.0])


def test_counterfactual_of_a_recorded_episode(pendulum):
    recorded = play(gym.make("Pendulum-v1"))
    unchanged = pendulum.counterfactual(recorded, {})
    for values, expected in zip(unchanged[:3], recorded, strict=True):
        np.testing.assert_array_equal(values, np.array(expected))
    changed = pendulum.counterfactual(recorded, {TORQUE: lambda t, state, action: 0.5 * action[0]})
    np.testing.assert_allclose(changed.actions, 0.5 * np.array(recorded[1]))
    assert not np.array_equal(changed.states, unchanged.states)


def test_the_policy_can_react_to_the_counterfactual_states(pendulum):
    observations, actions, rewards = play(gym.make("Pendulum-v1"))
    own = [pendulum.predict(observation, deterministic=True)[0] for observation in observations[:-1]]
    # Recorded with the policy's own actions, nothing deviates; a change of the first step makes it react later
    first = pendulum.counterfactual(
        (observations, own, rewards), {TORQUE: lambda t, s, a: -a[0] if t == 0 else a[0]}, follow_policy=True
    )
    for t in (1, 6):
        expected, _ = pendulum.predict(first.states[t].astype(np.float32), deterministic=True)
        np.testing.assert_allclose(first.actions[t], expected, atol=1e-4)
    unchanged = pendulum.counterfactual((observations, actions, rewards), {}, follow_policy=True)
    np.testing.assert_array_equal(unchanged.actions, np.array(actions))


# VecNormalize -----------------------------------------------------------------------------------------------------------


def test_with_vec_normalize_everything_is_in_the_units_of_the_environment(normalised):
    recorded = play(gym.make("Pendulum-v1"))
    observations, actions = np.array(recorded[0][:-1]), np.array(recorded[1])
    env = normalised.get_vec_normalize_env()
    outcome = normalised.intervene(observations, actions, {})
    state = normalised.policy.causal_state(normalised.policy.obs_to_tensor(env.normalize_obs(observations))[0])
    action = state.new_tensor(actions / 2.0)
    mean, _ = normalised.world_model.predict_next_state(state, action)
    reward, std = normalised.world_model.predict_reward(mean, action)
    np.testing.assert_allclose(outcome.next_state, env.unnormalize_obs(mean.detach().numpy()), atol=1e-4)
    np.testing.assert_allclose(outcome.reward, env.unnormalize_reward(reward.detach().numpy()), rtol=1e-4)
    assert outcome.reward_std.min() >= env.unnormalize_reward(std.detach().numpy())


def test_with_vec_normalize_effects_are_per_unit_of_the_environment(normalised):
    recorded = play(gym.make("Pendulum-v1"))
    observations, actions = np.array(recorded[0][:-1]), 0.5 * np.array(recorded[1])
    effects = normalised.effect_of_actions(observations, actions, delta=0.2)
    above, below = (normalised.intervene(observations, actions + change, {}) for change in (0.2, -0.2))
    np.testing.assert_allclose(effects.reward.mean, ((above.reward - below.reward) / 0.4).mean(), rtol=1e-3)
    expected = ((above.next_state - below.next_state) / 0.4).mean(axis=0)
    np.testing.assert_allclose(effects.next_state.mean[:, 0], expected, atol=1e-5)


def test_with_vec_normalize_the_recording_comes_back(normalised, tmp_path):
    recorded = play(gym.make("Pendulum-v1"))
    for follow_policy in (False, True):
        unchanged = normalised.counterfactual(recorded, {}, follow_policy=follow_policy)
        for values, expected in zip(unchanged[:3], recorded, strict=True):
            np.testing.assert_array_equal(values, np.array(expected))
    before = normalised.counterfactual(recorded, {TORQUE: 0.5})
    assert np.isfinite(before.state_noise).all()
    # The environment brings the statistics along
    normalised.save(tmp_path / "model")
    loaded = CausalGDP.load(tmp_path / "model", env=normalised.get_env(), device="cpu")
    np.testing.assert_allclose(loaded.counterfactual(recorded, {TORQUE: 0.5}).states, before.states)


@pytest.mark.parametrize("arguments", [{"norm_obs": False}, {"norm_reward": False}])
def test_vec_normalize_of_one_of_both(arguments):
    model = learn(VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]), **arguments))
    structural, env = model.structural_model(), model.get_vec_normalize_env()
    assert (structural.state_scale == 1.0).all() == (not env.norm_obs)
    assert (structural.reward_scale == 1.0) == (not env.norm_reward)


# Dictionaries and images ------------------------------------------------------------------------------------------------


def test_dictionaries_of_observations():
    model = learn(DummyVecEnv([GoalPendulum]), "MultiInputPolicy")
    recorded = play(GoalPendulum())
    names = model.transition_variables.state_names
    assert set(names) == {"place[0]", "place[1]", "speed", "side[0]", "side[1]"}
    single = model.intervene(recorded[0][0], recorded[1][0], {"speed": 3.0, "place[1]'": 0.2})
    assert single.next_state.shape == (5,) and single.next_state[names.index("place[1]")] == 0.2
    unchanged = model.counterfactual(recorded, {})
    np.testing.assert_array_equal(unchanged.states[:, names.index("speed")], [o["speed"][0] for o in recorded[0]])
    np.testing.assert_array_equal(unchanged.states[:, names.index("side[1]")], [o["side"] for o in recorded[0]])
    with pytest.raises(ValueError, match=r"torque must be in \[-2, 2\], got -3"):
        model.counterfactual(recorded, {TORQUE: -3.0})
    with pytest.raises(ValueError, match="The policy cannot act in predicted states"):
        model.counterfactual(recorded, {}, follow_policy=True)


def test_normalised_dictionaries_of_boxes():
    env = VecNormalize(DummyVecEnv([lambda: GoalPendulum(is_discrete=False)]), norm_obs_keys=["speed"])
    model = learn(env, "MultiInputPolicy")
    recorded = play(GoalPendulum(is_discrete=False))
    structural, names = model.structural_model(), model.transition_variables.state_names
    expected = {"place[0]": 1.0, "place[1]": 1.0, "speed": float(np.sqrt(env.obs_rms["speed"].var + env.epsilon)[0])}
    np.testing.assert_allclose(structural.state_scale, [expected[name] for name in names])
    unchanged = model.counterfactual(recorded, {}, follow_policy=True)
    np.testing.assert_array_equal(unchanged.actions, np.array(recorded[1]))
    np.testing.assert_array_equal(unchanged.rewards, recorded[2])


def test_the_state_of_images_is_their_features():
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False, channel_first=True)
    kwargs = {**KWARGS, "policy_kwargs": {"features_extractor_kwargs": {"features_dim": 8}, "net_arch": [16]}}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Causal discovery waits")
        model = CausalGDP("CnnPolicy", env, **kwargs).learn(64)
    recorded = play(env, 4)
    outcome = model.intervene(recorded[0][0], recorded[1][0], {"feature[2]": 0.5})
    assert outcome.next_state.shape == (8,)
    np.testing.assert_array_equal(model.counterfactual(recorded, {}).rewards, recorded[2])
    with pytest.raises(ValueError, match="The policy cannot act in predicted states"):
        model.counterfactual(recorded, {}, follow_policy=True)
