from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecFrameStack, VecNormalize

from sb3_causalgdp import CausalGDP, stress
from sb3_causalgdp.causal import TransitionVariables
from sb3_causalgdp.causal.sources import FlatSpace
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

    keyed = AsDict(gym.make("Pendulum-v1"))
    assert found_names(keyed) == (("position[0]", "position[1]", "position[2]"), ("torque",))
    # The same numbers under the same names when they are flattened
    assert found_names(gym.wrappers.FlattenObservation(keyed)) == found_names(keyed)


TANK = gym.spaces.Dict({name: gym.spaces.Box(-1.0, 1.0, (1,)) for name in ("temperature", "level", "action", "reward")})


class Tank(gym.Env):
    observation_space = TANK
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {}


TANK_NAMES = ("obs[action][0]", "level", "reward[0]", "temperature")


def test_a_key_of_one_number_is_its_name_but_for_those_of_other_variables():
    assert found_names(Tank())[0] == TANK_NAMES
    model = CausalGDP("MultiInputPolicy", Tank())
    assert model.transition_variables.names[:5] == (*TANK_NAMES, "action[0]")
    assert FlatSpace(TANK).names == TANK_NAMES


def test_names_of_keys_are_found_in_other_processes():
    venv = SubprocVecEnv([Tank])
    assert found_names(venv) == (TANK_NAMES, None)
    venv.close()
    venv = SubprocVecEnv([lambda: Named(gym.make("Pendulum-v1"))])
    assert found_names(venv) == (("a", "b", "c"), ("push",))
    venv.close()


def test_a_wrapper_that_makes_others_of_a_dictionary_s_numbers_hides_their_names():
    class Sorted(gym.Wrapper):
        def __init__(self, env):
            super().__init__(env)
            self.observation_space = gym.spaces.Box(-1.0, 1.0, (4,))

    assert found_names(Sorted(Tank()))[0] is None


def test_an_action_does_not_get_the_name_of_a_key():
    class Same(Tank):
        action_names = ("level",)

    assert found_names(Same()) == (TANK_NAMES, None)


@pytest.mark.parametrize("flat", [False, True])
def test_a_point_maze_s_numbers_have_the_names_of_what_they_are(flat):
    gym.register_envs(pytest.importorskip("gymnasium_robotics"))
    env = gym.make("PointMaze_UMaze-v3")
    wrapped = gym.wrappers.FlattenObservation(env) if flat else env
    names, _ = found_names(wrapped)
    observation, _ = wrapped.reset(seed=0)
    values = dict(zip(names, observation if flat else gym.spaces.flatten(env.observation_space, observation), strict=True))
    assert (values["x"], values["y"]) == (values["achieved x"], values["achieved y"])
    assert [values["goal x"], values["goal y"]] == env.unwrapped.goal.tolist()
    assert [values["vel x"], values["vel y"]] == env.unwrapped.point_env.data.qvel.tolist()


def test_our_mazes_have_names():
    assert found_names(gym.make("sb3_causalgdp/Maze2d-UMaze-v1")) == (("x", "y", "vel x", "vel y"), ("force x", "force y"))


def test_a_graph_that_was_found_by_indices_is_a_graph_of_the_model_with_names(pendulum):
    graph = pendulum.causal_graph()
    by_index = replace(graph, variables=TransitionVariables(("obs[0]", "obs[1]", "obs[2]"), ("action[0]",)))
    model = CausalGDP("MlpPolicy", "Pendulum-v1")
    model.set_causal_graph(by_index)
    assert model.causal_graph() == graph
    with pytest.raises(ValueError, match="The graph is about"):
        model.set_causal_graph(replace(graph, variables=TransitionVariables(("a", "b", "c"), ("d",))))


@pytest.fixture(scope="module")
def pendulum():
    model = CausalGDP(
        "MlpPolicy",
        "Pendulum-v1",
        learning_starts=100,
        causal_refresh_freq=250,
        policy_kwargs={"net_arch": [16], "world_model_net_arch": [16]},
        seed=0,
    )
    return model.learn(260)


def test_graphs_and_answers_have_the_environment_s_names(pendulum, tmp_path):
    names = ("cos angle", "sin angle", "vel angle", "torque")
    assert pendulum.causal_graph().variables.names[:4] == names
    observation = np.array([1.0, 0.0, 0.0], dtype=np.float32)
    by_name = pendulum.intervene(observation, [0.3], {"torque": 1.0, "vel angle'": 0.5})
    by_index = pendulum.intervene(observation, [0.3], {"action[0]": 1.0, "obs[2]'": 0.5})
    assert by_name.reward == by_index.reward
    with pytest.raises(ValueError, match="did you mean 'torque'"):
        pendulum.intervene(observation, [0.3], {"torqe": 1.0})
    pendulum.save(tmp_path / "model.zip")
    # Also where the environment is not there, and where it has other names
    for env in (None, Named(gym.make("Pendulum-v1"))):
        assert CausalGDP.load(tmp_path / "model.zip", env).causal_graph() == pendulum.causal_graph()


def test_given_names_come_before_the_environment_s():
    model = CausalGDP("MlpPolicy", "Pendulum-v1", state_names=["x", "y", "z"])
    assert model.transition_variables.names[:4] == ("x", "y", "z", "torque")


@pytest.mark.parametrize("names", [["x"], ["x", "x", "y"], "xyz", [1, 2, 3]])
def test_wrong_names_are_refused(names):
    with pytest.raises(ValueError, match="state_names must be"):
        CausalGDP("MlpPolicy", "Pendulum-v1", state_names=names)


def test_models_that_were_trained_without_names_keep_their_indices():
    model = CausalGDP.load(Path(__file__).parent / "data" / "model_of_0_1.zip", make_vec_env("Pendulum-v1"))
    assert model.transition_variables.names[:4] == ("obs[0]", "obs[1]", "obs[2]", "action[0]")


def test_what_a_stress_wrapper_appends_has_a_name_and_the_rest_keeps_its_own():
    env = stress.IdleActions(stress.LastAction(stress.NoiseDistractors(gym.make("Pendulum-v1"), n=2)), n=2)
    names = ("cos angle", "sin angle", "vel angle", "noise 1", "noise 2", "last action 1"), ("torque", "idle 1", "idle 2")
    assert found_names(env) == names
    assert found_names(make_vec_env(lambda: env)) == names
    other = stress.OtherEnvironment(gym.make("Pendulum-v1"), controlled=True)
    assert found_names(other)[0][3:] == ("other 1", "other 2", "other 3")
    assert found_names(other)[1] == ("torque", "other action 1")
    # Of what lies below, nothing is known
    below = gym.wrappers.TransformObservation(gym.make("Pendulum-v1"), lambda obs: obs[:2], spaces.Box(-1.0, 1.0, (2,)))
    assert found_names(stress.NoiseDistractors(below, n=1))[0] is None
    assert CausalGDP("MlpPolicy", env, buffer_size=10).transition_variables.state_names == names[0]


def test_what_is_appended_to_an_environment_with_names_of_its_own_keeps_both():
    class Named(gym.Wrapper):
        state_names, action_names = ("x", "y", "turn"), ("push",)

    named = Named(gym.make("Pendulum-v1"))
    env = stress.IdleActions(stress.NoiseDistractors(stress.NoiseDistractors(named, n=2), n=1), n=1)
    assert found_names(env) == (("x", "y", "turn", "noise 1", "noise 2", "noise 1 #2"), ("push", "idle 1"))
