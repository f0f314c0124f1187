import pickle
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from small_models import SMALL
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env

from sb3_causalgdp import CausalGDP, TrainingCheckpointCallback, stress
from sb3_causalgdp.checkpoints import resume
from sb3_causalgdp.stress import (
    ConfoundedBehaviour,
    IdleActions,
    LastAction,
    NoiseDistractors,
    Nuisance,
    OtherEnvironment,
    SensorDeath,
    WeakActuator,
)

WRAPPERS = {
    "noise": lambda env: NoiseDistractors(env, 5),
    "nuisance": lambda env: Nuisance(env, "changed"),
    "other": lambda env: OtherEnvironment(env, copies=2),
    "controlled": lambda env: OtherEnvironment(env, copies=2, controlled=True),
    "idle": lambda env: IdleActions(env, 3),
    "last action": LastAction,
    "death": lambda env: SensorDeath(env, [1], at_step=30),
    "weak": lambda env: WeakActuator(env, 0, at_step=30),
}


def play(env, seed, n_steps=230):
    """Observations and rewards, over the end of an episode."""
    generator = np.random.default_rng(seed)
    observation, _ = env.reset(seed=seed)
    seen, rewards = [observation], []
    for _ in range(n_steps):
        action = generator.uniform(env.action_space.low, env.action_space.high).astype(np.float32)
        observation, reward, terminated, truncated, _ = env.step(action)
        rewards.append(reward)
        if terminated or truncated:
            observation, _ = env.reset()
        seen.append(observation)
    return np.array(seen), np.array(rewards)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", WRAPPERS)
def test_wrapped_environments_keep_gymnasiums_rules(name):
    env = WRAPPERS[name](gym.make("Pendulum-v1"))
    check_env(env, skip_render_check=True)
    assert env.spec is not None and env.spec.additional_wrappers


@pytest.mark.parametrize("name", WRAPPERS)
def test_the_same_seed_gives_the_same_and_another_another(name):
    first, again, other = (play(WRAPPERS[name](gym.make("Pendulum-v1")), seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    assert not np.array_equal(first[0], other[0])


@pytest.mark.parametrize("name", ["noise", "nuisance", "other", "last action"])
def test_what_is_appended_changes_nothing_of_the_environment(name):
    plain, rewards = play(gym.make("Pendulum-v1"), 0)
    seen, wrapped_rewards = play(WRAPPERS[name](gym.make("Pendulum-v1")), 0)
    np.testing.assert_array_equal(seen[:, :3], plain)
    np.testing.assert_array_equal(wrapped_rewards, rewards)


def test_noise_is_autoregressive_and_stationary():
    seen, _ = play(NoiseDistractors(gym.make("Pendulum-v1", max_episode_steps=30_000), 4, 0.8), 0, 20_000)
    noise = seen[:, 3:]
    assert np.abs(noise.std(axis=0) - 1.0).max() < 0.1
    for column in noise.T:
        assert np.corrcoef(column[1:], column[:-1])[0, 1] == pytest.approx(0.8, abs=0.03)
    assert np.abs(np.corrcoef(noise.T) - np.eye(4)).max() < 0.1


def test_other_environments_follow_their_own_actions_only_when_controlled():
    def last(env, extra):
        env.reset(seed=0)
        for _ in range(20):
            observation, *_ = env.step(np.concatenate([[0.1], extra]).astype(np.float32))
        return observation

    base = gym.make("Pendulum-v1")
    env = OtherEnvironment(base, controlled=True)
    assert env.action_space.shape == (2,) and env.observation_space.shape == (6,)
    pushed, still = last(env, [2.0]), last(env, [0.0])
    np.testing.assert_array_equal(pushed[:3], still[:3])
    assert not np.allclose(pushed[3:], still[3:])


def test_idle_actions_do_nothing():
    env = IdleActions(gym.make("Pendulum-v1"), 2)
    results = []
    for idle in (-1.0, 1.0):
        env.reset(seed=0)
        results.append(env.step(np.array([0.5, idle, idle], np.float32))[:2])
    np.testing.assert_array_equal(results[0][0], results[1][0])
    assert results[0][1] == results[1][1] and env.action_space.shape == (3,)


def test_the_last_action_is_seen_and_forgotten_at_a_reset():
    env = LastAction(gym.make("Pendulum-v1"))
    assert env.reset(seed=0)[0][3] == 0.0
    assert env.step(np.array([0.75], np.float32))[0][3] == 0.75
    assert env.reset()[0][3] == 0.0


def test_a_dead_sensor_shows_nothing_and_the_world_goes_on():
    env, plain = SensorDeath(gym.make("Pendulum-v1"), [1], at_step=30), gym.make("Pendulum-v1")
    seen, rewards = play(env, 0)
    whole, true_rewards = play(plain, 0)
    np.testing.assert_array_equal(seen[:30], whole[:30])
    assert (seen[30:, 1] == 0).all() and (whole[30:, 1] != 0).all()
    np.testing.assert_array_equal(seen[30:, [0, 2]], whole[30:, [0, 2]])
    np.testing.assert_array_equal(rewards, true_rewards)


def test_a_weak_joint_moves_less_from_its_step_on():
    env, plain = WeakActuator(gym.make("Pendulum-v1"), 0, at_step=2, factor=0.5), gym.make("Pendulum-v1")
    env.reset(seed=0)
    plain.reset(seed=0)
    push, half = np.array([2.0], np.float32), np.array([1.0], np.float32)
    for of_plain in (push, push, half):
        np.testing.assert_array_equal(env.step(push)[0], plain.step(of_plain)[0])
    assert push[0] == 2.0


def test_the_nuisance_drives_the_behaviour_and_is_gone_when_acting():
    present, gone, changed = (Nuisance(gym.make("Pendulum-v1"), mode) for mode in ("present", "gone", "changed"))
    behaviour = ConfoundedBehaviour(lambda observation: np.zeros(1), present.action_space, strength=0.5)
    seen, actions = [], []
    observation, _ = present.reset(seed=0)
    for _ in range(500):
        seen.append(observation[3])
        actions.append(behaviour(observation)[0])
        observation, *_ = present.step(actions[-1:])
    assert np.corrcoef(seen, actions)[0, 1] > 0.95
    np.testing.assert_allclose(actions, np.clip(seen, -2, 2), rtol=1e-6)
    assert gone.reset(seed=0)[0][3] == 0.0
    assert changed.reset(seed=0)[0][3] == pytest.approx(-2.0 * present.reset(seed=0)[0][3])


@pytest.mark.parametrize("name", WRAPPERS)
def test_environments_can_be_pickled_in_the_middle(name):
    env = WRAPPERS[name](gym.make("Pendulum-v1"))
    play(env, 0, 40)
    copy = pickle.loads(pickle.dumps(env))
    action = env.action_space.sample()
    for _ in range(3):
        np.testing.assert_array_equal(copy.step(action)[0], env.step(action)[0])


@pytest.mark.parametrize(
    "make, argument",
    [
        (lambda env: NoiseDistractors(env, 0), "n must be"),
        (lambda env: NoiseDistractors(env, 2, 1.0), "coefficient must be"),
        (lambda env: Nuisance(env, "away"), "mode must be one of"),
        (lambda env: OtherEnvironment(env, copies=0), "copies must be"),
        (lambda env: OtherEnvironment(env, "CartPole-v1"), "action space must be a Box"),
        (lambda env: IdleActions(env, -1), "n must be"),
        (lambda env: SensorDeath(env, [3]), "sensors must be"),
        (lambda env: SensorDeath(env, [0], -1), "at_step must be"),
        (lambda env: WeakActuator(env, 1), "action must be"),
        (lambda env: WeakActuator(env, 0, 5, 2.0), "factor must be"),
    ],
)
def test_arguments_out_of_range_are_refused(make, argument):
    with pytest.raises(ValueError, match=argument):
        make(gym.make("Pendulum-v1"))


def test_other_spaces_are_refused():
    with pytest.raises(ValueError, match="action space must be a Box"):
        IdleActions(gym.make("CartPole-v1"))
    env = gym.wrappers.TransformObservation(gym.make("Pendulum-v1"), lambda x: {"x": x}, spaces.Dict({"x": spaces.Box(-1, 1)}))
    with pytest.raises(ValueError, match="observation space must be a Box"):
        NoiseDistractors(env)


def test_environments_have_names_with_arguments():
    env = gym.make("sb3_causalgdp.stress:Distracted/Pendulum-v1")
    assert env.observation_space.shape == (103,) and env.action_space.shape == (1,)
    env = gym.make(
        "Distracted/Pendulum-v1", noises=2, idle_actions=3, last_action=True, other="Pendulum-v1", nuisance="gone", g=5.0
    )
    # 3 + 2 noises + 3 of the other + 4 actions + 1 nuisance
    assert env.observation_space.shape == (13,) and env.action_space.shape == (4,) and env.unwrapped.g == 5.0
    assert len(stress.DISTRACTED_IDS) == len(set(stress.DISTRACTED_IDS))


def test_stable_baselines_is_not_imported():
    code = "import sys, sb3_causalgdp.stress.wrappers as w; print('stable_baselines3' in vars(w))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "False"


STRESSED = {
    "noises": 4,
    "other": "Pendulum-v1",
    "idle_actions": 1,
    "last_action": True,
    "dead_sensors": [0],
    "dies_at": 130,
    "weak_action": 0,
    "weak_from": 140,
    "nuisance": "present",
}


@pytest.mark.parametrize("algorithm", [SAC, CausalGDP])
def test_a_resumed_training_ends_bit_for_bit_where_the_uninterrupted_one_does(algorithm, tmp_path):
    def train(folder, steps, resumed=False):
        env = make_vec_env("Distracted/Pendulum-v1", seed=5, env_kwargs=STRESSED)
        arguments = SMALL if algorithm is CausalGDP else {"batch_size": 8, "train_freq": 8, "device": "cpu"}
        if resumed:
            model = resume(algorithm, folder, env)
        else:
            model = algorithm("MlpPolicy", env, **{**arguments, "seed": 0})
        model.learn(steps - model.num_timesteps, TrainingCheckpointCallback(folder, every=100), reset_num_timesteps=False)
        return model

    whole = train(tmp_path / "whole", 240)
    train(tmp_path / "parts", 110)
    resumed = train(tmp_path / "parts", 240, resumed=True)
    assert resumed.num_timesteps == whole.num_timesteps == 240
    size = whole.replay_buffer.pos
    np.testing.assert_array_equal(resumed.replay_buffer.observations[:size], whole.replay_buffer.observations[:size])
    # The interruption lies before the sensor dies
    observations = whole.replay_buffer.observations[:size, 0]
    assert (observations[131:, 0] == 0).all() and (observations[:130, 0] != 0).all()
