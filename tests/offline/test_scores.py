import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.logger import HumanOutputFormat, Logger
from stable_baselines3.common.monitor import Monitor

from sb3_causalgdp.offline.callbacks import NormalizedEvalCallback
from sb3_causalgdp.offline.scores import NormalizedScore, find_reference, normalized_score


@pytest.mark.parametrize(
    "task, random, expert",
    [
        ("maze2d-umaze-v1", 23.85, 161.86),
        ("maze2d-medium-v1", 13.13, 277.39),
        ("maze2d-large-v1", 6.7, 273.99),
        ("maze2d-umaze-dense-v1", 68.537689, 193.662856),
        ("maze2d-medium-dense-v1", 44.264742, 297.455255),
        ("maze2d-large-dense-v1", 30.569041, 303.485738),
        ("antmaze-medium-diverse-v2", 0, 1),
        ("kitchen-mixed-v0", 0, 4),
        ("pen-human-v1", 96.262799, 3076.833102),
        ("halfcheetah-medium-replay-v2", -280.178953, 12135.0),
        ("hopper-medium-v2", -20.272305, 3234.3),
        ("walker2d-expert-v2", 1.629008, 4592.3),
    ],
)
def test_the_references_are_those_of_d4rl(task, random, expert):
    np.testing.assert_allclose(normalized_score(task, [random, expert]).values, [0, 100], atol=1e-4)


@pytest.mark.parametrize(
    "name, task",
    [
        ("sb3_causalgdp/maze2d-umaze-v0", "maze2d-umaze"),
        ("sb3_causalgdp/maze2d-large-dense-v0", "maze2d-large-dense"),
        ("sb3_causalgdp/Maze2d-UMaze-Dense-v1", "maze2d-umaze-dense"),
        ("D4RL/pointmaze/medium-v2", "maze2d-medium"),
        ("D4RL/pointmaze/large-dense-v2", "maze2d-large-dense"),
        ("PointMaze_UMazeDense-v3", "maze2d-umaze-dense"),
        ("D4RL/antmaze/umaze-diverse-v1", "antmaze"),
        ("D4RL/pen/human-v2", "pen"),
        ("AdroitHandPen-v1", "pen"),
        ("FrankaKitchen-v1", "kitchen"),
        ("mujoco/hopper/medium-v0", "hopper"),
        ("HalfCheetah-v5", "halfcheetah"),
    ],
)
def test_names_of_minari_and_gymnasium_mean_the_same_task(name, task):
    assert find_reference(name) == find_reference(task) is not None


def test_a_score_says_which_references_it_was_measured_by():
    score = normalized_score("maze2d-umaze", [225.0, 225.0])
    assert isinstance(score, NormalizedScore) and score.values.shape == (2,)
    assert float(score) == pytest.approx(145.75, abs=0.01)
    assert score.reference.source == "D4RL"
    assert str(score) == "145.8 (D4RL's references: random 23.85, expert 161.86)"


@pytest.mark.parametrize("task", ["CartPole-v1", "maze2d-open-v0", "maze2d-umaze-v0", "maze2d"])
def test_an_unknown_task_lists_the_known_ones(task):
    with pytest.raises(ValueError, match=rf"{task}.*maze2d-umaze, .*antmaze.*walker2d"):
        normalized_score(task, 0.0)


def test_an_unknown_reference_names_the_known_ones():
    with pytest.raises(ValueError, match="d4rl or minari, got 'atari'"):
        normalized_score("pen", 0.0, reference="atari")


class _Spike(gym.Env):
    """One step, a return of 100."""

    observation_space = gym.spaces.Box(-1, 1, (1,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def reset(self, *, seed=None, options=None):
        return np.zeros(1, dtype=np.float32), {}

    def step(self, action):
        return np.zeros(1, dtype=np.float32), 100.0, True, False, {}


def test_the_callback_logs_the_score_in_the_row_of_its_evaluation(tmp_path):
    callback = NormalizedEvalCallback(Monitor(_Spike()), "antmaze-umaze", eval_freq=16, n_eval_episodes=2, verbose=0)
    rows = []
    model = PPO("MlpPolicy", _Spike(), n_steps=16, batch_size=16)
    logger = Logger(folder=None, output_formats=[HumanOutputFormat(str(tmp_path / "log.txt"))])
    dump = logger.dump
    logger.dump = lambda step=0: (rows.append(dict(logger.name_to_value)), dump(step))
    model.set_logger(logger)
    model.learn(16, callback=callback)
    evaluations = [row for row in rows if "eval/mean_reward" in row]
    assert [row["eval/normalized_score"] for row in evaluations] == [10_000.0]
    assert float(callback.last_normalized_score) == 10_000.0


def test_the_callback_rejects_an_unknown_task_at_once():
    with pytest.raises(ValueError, match="no D4RL references for 'CartPole-v1'"):
        NormalizedEvalCallback(Monitor(_Spike()), "CartPole-v1")
