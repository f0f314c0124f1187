import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import small
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv, FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.utils import obs_as_tensor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize, VecTransposeImage, is_vecenv_wrapped

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback


class SampledEnv(gym.Env):
    """Observations are drawn from their space."""

    EPISODE_LENGTH = 10

    def __init__(self, observation_space):
        self.observation_space = observation_space
        self.action_space = spaces.Box(-1.0, 1.0, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if seed is not None:
            self.observation_space.seed(seed)
        self.n_steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.n_steps += 1
        return self.observation_space.sample(), float(action[0]), self.n_steps == self.EPISODE_LENGTH, False, {}


def guided_callback():
    # Fewer transitions than the hundred that it would wait for: only that it works is of interest
    return CausalWorldModelCallback(min_transitions=30, diagnostics_batch_size=8)


def learn(env, policy="MlpPolicy", total_timesteps=64, policy_kwargs=None, **kwargs):
    model = CausalGDP(policy, env, **small(policy_kwargs, **{"buffer_size": 200, **kwargs}))
    model.learn(total_timesteps, callback=guided_callback())
    assert model.policy.is_guided and model._n_updates > 0
    assert all(bool(th.isfinite(value).all()) for value in model.policy.state_dict().values())
    assert model.causal_statistics.raw.n_variables == 2 * len(model.policy.state_names()) + model.actor.action_dim + 1
    return model


def assert_predicts(model):
    """One observation and a batch, deterministic and not, as the environment gives them."""
    observation = model.env.reset()
    for deterministic in (True, False):
        actions, _ = model.predict(observation, deterministic=deterministic)
        assert actions.shape == (model.n_envs, *model.action_space.shape)
        assert all(model.action_space.contains(action) for action in actions)
    repeated, _ = model.predict(observation, deterministic=True)
    np.testing.assert_array_equal(repeated, model.predict(observation, deterministic=True)[0])


# Vectors ----------------------------------------------------------------------------------------------------------------


SPACES = {
    "float32": (spaces.Box(-1.0, 1.0, (3,), np.float32), 3),
    "float64": (spaces.Box(-1.0, 1.0, (3,), np.float64), 3),
    "unbounded": (spaces.Box(-np.inf, np.inf, (3,), np.float32), 3),
    "whole numbers": (spaces.Box(0, 255, (3,), np.uint8), 3),
    "matrix": (spaces.Box(-1.0, 1.0, (2, 2), np.float32), 4),
    "Discrete": (spaces.Discrete(4), 4),
    "MultiDiscrete": (spaces.MultiDiscrete([3, 2]), 5),
    "MultiBinary": (spaces.MultiBinary(4), 4),
    "MultiBinary matrix": (spaces.MultiBinary((3, 2)), 6),
    "Dict": (spaces.Dict({"b": spaces.Box(-1.0, 1.0, (2,), np.float64), "a": spaces.Discrete(3)}), 5),
}


@pytest.mark.parametrize("name", SPACES)
def test_every_observation_space_works(name):
    space, n_states = SPACES[name]
    model = learn(SampledEnv(space), "MultiInputPolicy" if name == "Dict" else "MlpPolicy")
    assert len(model.policy.state_names()) == n_states
    assert_predicts(model)


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("name", ["Discrete", "MultiDiscrete", "MultiBinary matrix", "matrix", "Dict"])
def test_the_moments_get_every_transition_as_the_environment_gave_it(name, n_envs):
    """Discrete parts one-hot, in the order of the names, whatever the buffer's shapes are."""
    env = make_vec_env(lambda: SampledEnv(SPACES[name][0]), n_envs=n_envs, seed=0)
    policy = "MultiInputPolicy" if name == "Dict" else "MlpPolicy"
    model = CausalGDP(policy, env, **small(buffer_size=200, learning_starts=99))
    fed, update = [], model.causal_statistics.update
    model.causal_statistics.update = lambda rows: fed.append(rows) or update(rows)
    callback = CausalWorldModelCallback(refresh_freq=30, min_transitions=1000)
    with pytest.warns(UserWarning, match="Causal discovery waits"):
        model.learn(30, callback=callback)
    rows, buffer, n_states = np.concatenate(fed), model.replay_buffer, SPACES[name][1]
    assert len(rows) == 30 - n_envs
    for row, (position, index) in zip(rows, np.ndindex(len(rows) // n_envs, n_envs), strict=True):
        np.testing.assert_allclose(row[:n_states], flat(name, buffer.observations, position, index), rtol=1e-6)
        np.testing.assert_array_equal(row[n_states : n_states + 2], buffer.actions[position, index])
        np.testing.assert_allclose(row[n_states + 2 : -1], flat(name, buffer.next_observations, position, index), rtol=1e-6)
        assert row[-1] == buffer.rewards[position, index]


def flat(name, stored, position, index):
    if name == "Dict":
        # Gymnasium sorts the keys
        mode, vector = stored["a"][position, index], stored["b"][position, index]
        return np.concatenate([np.eye(3)[int(mode.item())], vector])
    observation = stored[position, index]
    if name == "Discrete":
        return np.eye(4)[int(observation.item())]
    if name == "MultiDiscrete":
        return np.concatenate([np.eye(3)[observation[0]], np.eye(2)[observation[1]]])
    return observation.ravel()


def test_names_of_the_variables_follow_keys_and_indices():
    parts = {"position": spaces.Box(-1.0, 1.0, (2,)), "action": spaces.Box(-1.0, 1.0, (1,)), "mode": spaces.Discrete(2)}
    model = learn(SampledEnv(spaces.Dict(parts)), "MultiInputPolicy")
    states = ("position[0]", "position[1]", "obs[action][0]", "mode[0]", "mode[1]")
    assert sorted(model.policy.state_names()) == sorted(states)
    assert model.transition_variables.action_names == ("action[0]", "action[1]")
    assert_predicts(model)


def test_the_vector_of_a_dictionary_trains_as_the_vector_alone():
    space = spaces.Box(-1.0, 1.0, (3,))
    models = [
        learn(gym.wrappers.TimeLimit(SampledEnv(observation_space), 20), policy)
        for observation_space, policy in ((space, "MlpPolicy"), (spaces.Dict({"vector": space}), "MultiInputPolicy"))
    ]
    observation = np.array([0.1, -0.5, 0.9], dtype=np.float32)
    plain, _ = models[0].predict(observation, deterministic=True)
    assert plain.shape == models[1].predict({"vector": observation}, deterministic=True)[0].shape
    shapes = [[value.shape for value in model.policy.state_dict().values()] for model in models]
    assert shapes[0] == shapes[1]


# Images -----------------------------------------------------------------------------------------------------------------


CNN_KWARGS = {"features_extractor_kwargs": {"features_dim": 8}}


@pytest.mark.parametrize("share_features_extractor", [False, True])
def test_the_causal_state_of_images_is_the_target_critics_features(share_features_extractor):
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False)
    model = learn(env, "CnnPolicy", policy_kwargs={**CNN_KWARGS, "share_features_extractor": share_features_extractor})
    assert is_vecenv_wrapped(model.get_env(), VecTransposeImage)
    assert model.policy.state_names() == tuple(f"feature[{index}]" for index in range(8))
    assert_predicts(model)
    # Channels last, as the environment gives them to a user
    raw, _ = env.reset()
    assert model.predict(raw, deterministic=True)[0].shape == model.action_space.shape
    images = obs_as_tensor(model.env.reset(), model.device)
    expected = model.critic_target.extract_features(images, model.critic_target.features_extractor)
    state = model.policy.causal_state(images)
    th.testing.assert_close(state, expected.detach())
    assert not state.requires_grad


def test_images_that_are_normalised_already():
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False, channel_first=True)
    env = VecNormalize(DummyVecEnv([lambda: env]))
    model = learn(env, "CnnPolicy", policy_kwargs={**CNN_KWARGS, "normalize_images": False})
    assert model.policy.has_image_state
    assert_predicts(model)


def test_a_dictionary_with_an_image():
    env = SimpleMultiObsEnv(random_start=True, discrete_actions=False, channel_last=False)
    model = learn(env, "MultiInputPolicy", policy_kwargs={"features_extractor_kwargs": {"cnn_output_dim": 8}})
    # The image's features and the vector's five components
    assert model.policy.state_names() == tuple(f"feature[{index}]" for index in range(8 + 5))
    assert_predicts(model)


def test_stacked_frames():
    env = VecFrameStack(make_vec_env("Pendulum-v1", n_envs=2, seed=0), n_stack=3)
    model = learn(env)
    assert len(model.policy.state_names()) == 9
    assert_predicts(model)
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False, channel_first=True)
    env = VecFrameStack(DummyVecEnv([lambda: env]), n_stack=2, channels_order="first")
    assert_predicts(learn(env, "CnnPolicy", policy_kwargs=CNN_KWARGS))


# Normalised environments ------------------------------------------------------------------------------------------------


def test_with_vec_normalize_the_graph_is_found_in_raw_units_and_the_world_model_learns_in_normalised_ones(monkeypatch):
    space = spaces.Box(np.array([99.0, -0.001]), np.array([101.0, 0.001]), dtype=np.float64)
    env = VecNormalize(DummyVecEnv([lambda: SampledEnv(space)]))
    model = learn(env, total_timesteps=128)
    means = model.causal_statistics.raw.mean[:2]
    np.testing.assert_allclose(means, [100.0, 0.0], atol=0.3)
    np.testing.assert_allclose(model.world_model.state_mean.numpy(), 0.0, atol=1.0)
    np.testing.assert_allclose(model.world_model.state_std.numpy(), 1.0, atol=0.6)
    assert_predicts(model)
    # The diagnostics see what the policy sees
    callback, seen = guided_callback(), []
    callback.init_callback(model)
    monkeypatch.setattr(
        "sb3_causalgdp.callbacks.world_model.guidance_divergence", lambda policy, batch: seen.append(batch) or 0.0
    )
    callback.refresh()
    assert seen[0].shape == (8, 2) and float(seen[0].abs().max()) <= env.clip_obs
    # The mean and the statistics of another environment are used from then on
    other = VecNormalize(DummyVecEnv([lambda: SampledEnv(space)]), training=False, norm_reward=False)
    model.set_env(other)
    model.learn(16, callback=guided_callback(), reset_num_timesteps=False)


# Goals ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("goal_selection_strategy", ["future", "final", "episode"])
def test_hindsight_experience_replay(n_envs, goal_selection_strategy):
    env = make_vec_env(lambda: BitFlippingEnv(n_bits=3, continuous=True), n_envs=n_envs, seed=0)
    model = learn(
        env,
        "MultiInputPolicy",
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 2, "goal_selection_strategy": goal_selection_strategy},
        total_timesteps=96,
    )
    assert len(model.policy.state_names()) == 9
    assert_predicts(model)
    evaluate_policy(model, make_vec_env(lambda: BitFlippingEnv(n_bits=3, continuous=True), seed=1), n_eval_episodes=1)


def test_hindsight_replay_whose_first_episode_outlasts_the_first_refresh(tmp_path):
    def make_env():
        return BitFlippingEnv(n_bits=3, continuous=True, max_steps=1000)

    model = CausalGDP(
        "MultiInputPolicy",
        make_env(),
        replay_buffer_class=HerReplayBuffer,
        **small(buffer_size=200, learning_starts=1000, guidance_scale=0.1),
    )
    model.env.envs[0].unwrapped.desired_goal = np.full(3, 2)  # never reached
    model.learn(64, callback=guided_callback())
    assert model.causal_graph().num_timesteps == 60
    assert model.logger.name_to_value["guidance/kl"] >= 0.0
    model.save(tmp_path / "model.zip")
    loaded = CausalGDP.load(tmp_path / "model.zip", env=make_env(), device="cpu")
    assert isinstance(loaded.replay_buffer, HerReplayBuffer)
    assert loaded.causal_graph() == model.causal_graph()
