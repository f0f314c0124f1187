import gymnasium as gym
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete
from small_models import small
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.offline.sources import ArraySource

KWARGS = small(learning_starts=5)
N_ROWS = 12


class Keyed(gym.Env):
    """Observations whose keys are not in alphabetical order."""

    action_space = Box(-1.0, 1.0, (1,))

    def __init__(self, keys=("z", "a", "k")):
        parts = {"z": Box(-9.0, 9.0, (1,)), "a": Box(-9.0, 9.0, (2,)), "k": Discrete(3, start=1)}
        self.observation_space = Dict([(key, parts[key]) for key in keys])

    def _observation(self):
        values = {"z": np.float32([7.0]), "a": np.float32([1.0, 2.0]), "k": 3}
        return {key: values[key] for key in self.observation_space.spaces}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self._observation(), {}

    def step(self, action):
        return self._observation(), 0.0, False, False, {}


class Recorded(ArraySource):
    """A dataset of the same observations, with its keys in alphabetical order."""

    def __init__(self):
        observations = {
            "a": np.tile(np.float32([1.0, 2.0]), (N_ROWS, 1)),
            "k": np.full(N_ROWS, 3),
            "z": np.full((N_ROWS, 1), 7.0, np.float32),
        }
        ends = np.arange(N_ROWS) == N_ROWS - 1
        super().__init__(
            {
                "observations": observations,
                "next_observations": observations,
                "actions": np.zeros((N_ROWS, 1), np.float32),
                "rewards": np.zeros(N_ROWS),
                "terminations": np.zeros(N_ROWS, dtype=bool),
                "truncations": ends,
            }
        )
        self.observation_space, self.action_space = Keyed(("a", "k", "z")).observation_space, Keyed.action_space


def flat(keys=("z", "a", "k")):
    return gym.wrappers.FlattenObservation(Keyed(keys))


def own_flattening():
    return gym.wrappers.TransformObservation(
        Keyed(), lambda values: np.concatenate([values["z"], values["a"], np.eye(3)[values["k"] - 1]]), Box(-9.0, 9.0, (6,))
    )


def made(kind):
    return {
        "dummy": lambda: DummyVecEnv([flat]),
        "processes": lambda: SubprocVecEnv([flat, flat]),
        "monitored": lambda: make_vec_env(flat, 2, vec_env_cls=SubprocVecEnv),
    }[kind]()


@pytest.mark.parametrize("kind", ["dummy", "processes", "monitored"])
def test_columns_of_a_dataset_are_those_of_the_environment(kind):
    env = made(kind)
    row = env.reset()[0]
    buffer = CausalGDP("MlpPolicy", env, **KWARGS).preload(Recorded()).offline_buffer
    for values in (buffer.observations, buffer.next_observations):
        np.testing.assert_array_equal(values[: buffer.size()].reshape(-1, 6), np.tile(row, (N_ROWS, 1)))
    env.step(np.zeros((env.num_envs, 1)))
    env.close()


@pytest.mark.parametrize("env", [own_flattening, lambda: SubprocVecEnv([own_flattening])])
def test_a_dataset_is_refused_where_nobody_knows_the_order_of_the_columns(env):
    model = CausalGDP("MlpPolicy", env(), **KWARGS)
    with pytest.raises(
        ValueError, match=r"parts \[a, k, z\], and it is not known in which order the environment flattens them"
    ):
        model.preload(Recorded())
    assert model.offline_buffer is None


@pytest.mark.parametrize("kind", ["dummy", "processes"])
def test_a_model_of_a_dataset_refuses_an_environment_of_another_order(kind):
    env = DummyVecEnv([flat]) if kind == "dummy" else SubprocVecEnv([flat])
    model = CausalGDP.from_dataset(Recorded(), **KWARGS).preload(Recorded())
    with pytest.raises(ValueError, match=r"in the order \[a, k, z\], and this environment's in the order \[z, a, k\]"):
        model.set_env(env)
    env.close()
    env = DummyVecEnv([lambda: flat(("a", "k", "z"))])
    model.set_env(env)
    np.testing.assert_array_equal(model.offline_buffer.observations[0, 0], env.reset()[0])


def test_an_unknown_order_is_a_warning():
    model = CausalGDP.from_dataset(Recorded(), **KWARGS).preload(Recorded())
    env = own_flattening()
    env.observation_space = model.observation_space
    with pytest.warns(UserWarning, match="it is not known whether those of this environment are"):
        model.set_env(env)


def test_the_order_travels_with_the_model_and_its_buffer(tmp_path):
    model = CausalGDP("MlpPolicy", flat(), **KWARGS).preload(Recorded())
    model.pretrain(2)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    assert "observation_layout" not in vars(model.replay_buffer)
    with pytest.raises(ValueError, match=r"in the order \[z, a, k\], and this environment's in the order \[a, z, k\]"):
        CausalGDP.load(tmp_path / "model", env=flat(("a", "z", "k")), device="cpu")
    CausalGDP.load(tmp_path / "model", env=flat(), device="cpu").load_replay_buffer(tmp_path / "buffer")
    other = CausalGDP("MlpPolicy", flat(("a", "z", "k")), **KWARGS)
    message = r"holds observations flattened in the order \[z, a, k\], and the model's are in the order \[a, z, k\]"
    with pytest.raises(ValueError, match=message):
        other.load_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match=message):
        other.preload(tmp_path / "buffer")
