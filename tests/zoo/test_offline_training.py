"""The offline stage, said in a YAML file."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.utils import LinearSchedule

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.zoo.offline_tasks import OFFLINE_TASKS, make_task_environment, register_offline_tasks

ENTRY = """
offline/sb3_causalgdp-maze2d-umaze-v0:
  policy: MlpPolicy
  n_timesteps: 4e1
  offline_dataset: sb3_causalgdp/maze2d-umaze-v0
  pretrain_steps: 3e1
  learning_rate: lin_3e-4
  critic_learning_rate: lin_1e-3
  world_model_learning_rate: 1e-3
  offline_fraction: lin_0.5
  denoising_weight: 1
  normalize: {norm_obs: true, norm_reward: false}
  env_kwargs: {max_episode_steps: 20}
  callback:
    - sb3_causalgdp.CausalWorldModelCallback: {refresh_freq: 20, verbose: 1}
  n_envs: 1
"""
TASK = ("--algo", "causalgdp", "--env", "offline/sb3_causalgdp-maze2d-umaze-v0", "-f", "logs")


@pytest.fixture
def dataset(folder, monkeypatch):
    pytest.importorskip("minari")
    pytest.importorskip("mujoco")
    from sb3_causalgdp.offline import make

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder / "datasets"))
    make.main(["make", "maze2d-umaze", "--steps", "600", "--quiet"])
    (folder / "entry.yml").write_text(ENTRY)


def test_an_offline_task_pretrains_then_trains(dataset, zoo, tiny, folder, capsys, recwarn):
    zoo(
        "train",
        *TASK,
        "-conf",
        "entry.yml",
        "--eval-freq",
        15,
        "--eval-episodes",
        1,
        "--save-freq",
        20,
        *tiny,
        "learning_starts:5",
    )
    run = folder / "logs" / "causalgdp" / "offline-sb3_causalgdp-maze2d-umaze-v0_1"
    output = capsys.readouterr().out
    assert "normalized_score" in output
    # Numbered by gradient steps and by environment steps
    assert np.load(run / "offline" / "evaluations.npz")["timesteps"].tolist() == [15, 30]
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == [15, 30]
    assert (run / "offline" / "rl_model_20_steps.zip").is_file() and (run / "rl_model_40_steps.zip").is_file()
    assert (run / "offline-sb3_causalgdp-maze2d-umaze-v0" / "vecnormalize.pkl").is_file()
    model = CausalGDP.load(run / "offline-sb3_causalgdp-maze2d-umaze-v0.zip", device="cpu")
    assert (model.n_pretrain_steps, model.num_timesteps) == (30, 40)
    assert all(isinstance(rate, LinearSchedule) for rate in (model.critic_learning_rate, model.offline_fraction))
    assert model.lr_schedule(1.0) == pytest.approx(3e-4) and model.lr_schedule(0.5) == pytest.approx(1.5e-4)
    assert model.causal_graph().n_samples > 600
    assert not [one for one in recwarn if "was collected in" in str(one.message)]
    zoo("enjoy", *TASK, "--no-render", "-n", 20)
    assert "1 Episodes" in capsys.readouterr().out


def test_an_offline_stage_that_is_interrupted_is_saved_and_goes_on(dataset, zoo, tiny, folder, monkeypatch):
    train = CausalGDP.train

    def interrupted(self, *args, **kwargs):
        if self._n_pretrain_steps == 10:
            raise KeyboardInterrupt
        train(self, *args, **kwargs)

    common = ("train", *TASK, "-conf", "entry.yml", "--eval-freq", -1, "-P", *tiny, "n_timesteps:0")
    with monkeypatch.context() as patches:
        patches.setattr(CausalGDP, "train", interrupted)
        zoo(*common)
    name = "offline-sb3_causalgdp-maze2d-umaze-v0"
    first = folder / "logs" / "causalgdp" / f"{name}_1" / f"{name}.zip"
    assert CausalGDP.load(first, device="cpu")._n_pretrain_steps == 10
    zoo(*common, "-i", first)
    model = CausalGDP.load(folder / "logs" / "causalgdp" / f"{name}_2" / f"{name}.zip", device="cpu")
    assert (model.n_pretrain_steps, model.num_timesteps, model._n_updates) == (30, 0, 30)


@pytest.mark.filterwarnings("ignore")
def test_a_task_is_an_environment_with_the_goal_of_its_evaluation():
    gym.register_envs(pytest.importorskip("gymnasium_robotics"))
    register_offline_tasks()
    goals = {
        "offline/D4RL-pointmaze-medium-v2": (2.5, -2.5),
        "offline/D4RL-antmaze-umaze-diverse-v1": (4.0, -4.0),
    }
    for name, goal in goals.items():
        env = gym.make(name)
        for seed in range(3):
            observation, _ = env.reset(seed=seed)
            np.testing.assert_allclose(observation["desired_goal"], goal, atol=1.1)
        assert gym.spec(name).entry_point.endswith(make_task_environment.__name__)
        env.close()
    assert gym.make("offline/sb3_causalgdp-pen-medium-v0").get_wrapper_attr("_max_episode_steps") == 100
    assert OFFLINE_TASKS["offline/D4RL-antmaze-large-diverse-v1"].environment == "AntMaze_Large_Diverse_GR-v4"


def test_arguments_of_the_environment_reach_it():
    gym.register_envs(pytest.importorskip("gymnasium_robotics"))
    register_offline_tasks()
    env = gym.make("offline/D4RL-antmaze-umaze-v1", continuing_task=False)
    assert env.unwrapped.continuing_task is False
    assert gym.make("offline/D4RL-antmaze-umaze-v1").unwrapped.continuing_task is True
