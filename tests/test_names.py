import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecFrameStack, VecNormalize

from sb3_causalgdp.causal import TransitionVariables
from sb3_causalgdp.names import found_names

MUJOCO = [
    *("HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Ant-v5", "Humanoid-v5", "HumanoidStandup-v5", "Swimmer-v5"),
    *("InvertedPendulum-v5", "InvertedDoublePendulum-v5", "Reacher-v5", "Pusher-v5"),
]


def after_some_steps(env_id):
    env = gym.make(env_id)
    observation, _ = env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(3):
        observation = env.step(env.action_space.sample())[0]
    return env, observation


@pytest.mark.parametrize("env_id", [*MUJOCO, "Pendulum-v1", "MountainCarContinuous-v0"])
def test_each_column_has_its_own_name(env_id):
    states, actions = found_names(gym.make(env_id))
    variables = TransitionVariables(states, actions)
    env = gym.make(env_id)
    assert (variables.n_states, variables.n_actions) == (*env.observation_space.shape, *env.action_space.shape)


@pytest.mark.parametrize(
    "env_id", ["HalfCheetah-v5", "Hopper-v5", "Ant-v5", "Humanoid-v5", "Swimmer-v5", "Reacher-v5", "Pusher-v5"]
)
def test_a_joint_s_name_is_on_its_angle_and_on_its_velocity(env_id):
    env, observation = after_some_steps(env_id)
    names, _ = found_names(env)
    model, data = env.unwrapped.model, env.unwrapped.data
    found = 0
    for index in range(model.njnt):
        joint = model.joint(index).name
        for name, value in ((joint, data.joint(index).qpos), (f"vel {joint}", np.clip(data.joint(index).qvel, -10, 10))):
            if name in names:
                assert observation[names.index(name)] == pytest.approx(value[0])
                found += 1
    assert found >= 2


@pytest.mark.parametrize("env_id", ["HalfCheetah-v5", "Ant-v5", "Humanoid-v5", "Reacher-v5"])
def test_an_action_has_the_name_of_the_joint_that_it_moves(env_id):
    env = gym.make(env_id)
    _, actions = found_names(env)
    model = env.unwrapped.model
    for index, name in enumerate(actions):
        assert name == f"torque {model.joint(model.actuator_trnid[index, 0]).name}"


def test_parts_of_the_humanoid_s_observation_are_named_by_body_and_axis():
    env, observation = after_some_steps("Humanoid-v5")
    names, _ = found_names(env)
    data = env.unwrapped.data
    assert observation[names.index("velocity torso z")] == pytest.approx(data.body("torso").cvel[5])
    assert observation[names.index("contact left_foot rotation y")] == pytest.approx(
        np.clip(data.body("left_foot").cfrc_ext[1], -1, 1)
    )
    assert observation[names.index("inertia left_foot 9")] == pytest.approx(data.body("left_foot").cinert[9])
    assert observation[names.index("actuator force right_knee")] == pytest.approx(data.joint("right_knee").qfrc_actuator[0])


def test_a_double_pendulum_s_angles_are_named_in_their_order():
    env, observation = after_some_steps("InvertedDoublePendulum-v5")
    names, _ = found_names(env)
    data = env.unwrapped.data
    assert observation[names.index("sin hinge2")] == pytest.approx(np.sin(data.joint("hinge2").qpos[0]))
    assert observation[names.index("cos hinge")] == pytest.approx(np.cos(data.joint("hinge").qpos[0]))


class Named(gym.Wrapper):
    state_names = ("a", "b", "c")
    action_names = ("push",)


class Squared(gym.ObservationWrapper):
    def __init__(self, env):
        super().__init__(env)
        self.observation_space = gym.spaces.Box(0.0, 100.0, (3,))

    def observation(self, observation):
        return observation**2


def test_an_attribute_of_the_environment_comes_first():
    assert found_names(Named(gym.make("Pendulum-v1"))) == (("a", "b", "c"), ("push",))


def test_an_attribute_of_the_wrong_length_is_not_taken():
    class Short(Named):
        state_names = ("a", "b")

    assert found_names(Short(gym.make("Pendulum-v1"))) == (None, ("push",))


def test_a_wrapper_that_changes_observations_hides_their_names():
    assert found_names(Squared(gym.make("Pendulum-v1"))) == (None, ("torque",))


def test_names_are_found_through_vectorised_environments_and_in_other_processes():
    venv = make_vec_env("Pendulum-v1", 2, vec_env_cls=SubprocVecEnv)
    expected = found_names(gym.make("Pendulum-v1"))
    assert expected[0] is not None
    assert found_names(VecNormalize(venv)) == expected
    assert found_names(VecFrameStack(make_vec_env("Pendulum-v1", 2), 2)) == (None, None)
    venv.close()


def test_dict_observations_keep_their_keys():
    class AsDict(gym.ObservationWrapper):
        def __init__(self, env):
            super().__init__(env)
            self.observation_space = gym.spaces.Dict({"position": env.observation_space})

        def observation(self, observation):
            return {"position": observation}

    assert found_names(AsDict(gym.make("Pendulum-v1"))) == (None, ("torque",))
