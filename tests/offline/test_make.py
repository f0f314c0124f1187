import importlib
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest

from sb3_causalgdp.offline import make
from sb3_causalgdp.offline.maze2d import MAZES
from sb3_causalgdp.offline.storage import Episode, write_dataset

minari = pytest.importorskip("minari")
pytest.importorskip("mujoco")

ENVIRONMENT = "sb3_causalgdp/Maze2d-UMaze-v1"


@pytest.fixture
def root(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    return tmp_path


def run(*arguments):
    make.main(["make", *arguments])


@pytest.mark.parametrize("task, environment", [("maze2d-umaze", ENVIRONMENT), ("maze2d-large-dense", None)])
def test_a_maze_dataset_loads_with_minari(task, environment, root):
    run(task, "--steps", "900", "--quiet")
    dataset = minari.load_dataset(f"sb3_causalgdp/{task}-v0")
    length = 300 if task == "maze2d-umaze" else 800
    assert dataset.total_steps == 900
    assert [len(episode) for episode in dataset] == [length] * (900 // length) + [900 % length] * (900 % length > 0)
    for episode in dataset:
        assert not episode.terminations.any()
        assert episode.truncations[-1] and not episode.truncations[:-1].any()
        assert episode.observations.shape == (len(episode) + 1, 4)
        assert episode.actions.dtype == np.float32 and np.abs(episode.actions).max() <= 1
    env = dataset.recover_environment(eval_env=True)
    assert env.spec.max_episode_steps == length and env.unwrapped.maze is MAZES[task.split("-")[1]]


@pytest.mark.parametrize("task, maze", [("maze2d-umaze", "UMaze"), ("maze2d-medium-dense", "Medium-Dense")])
def test_the_registered_environment_replays_a_dataset_bit_for_bit(task, maze, root):
    run(task, "--steps", "600", "--quiet", "--seed", "1")
    env = gym.make(f"sb3_causalgdp/Maze2d-{maze}-v1")
    rng = np.random.default_rng(0)
    for episode in minari.load_dataset(f"sb3_causalgdp/{task}-v0"):
        for step in rng.choice(len(episode), 100, replace=False):
            env.reset(options={"state": episode.observations[step]})
            observation, reward, *_ = env.step(episode.actions[step])
            np.testing.assert_array_equal(observation, episode.observations[step + 1])
            assert reward == episode.rewards[step]


def test_the_walk_goes_on_across_episodes_to_new_targets(root):
    run("maze2d-umaze", "--steps", "1200", "--quiet")
    episodes = list(minari.load_dataset("sb3_causalgdp/maze2d-umaze-v0"))
    for before, after in pairwise(episodes):
        np.testing.assert_array_equal(before.observations[-1], after.observations[0])
    targets = np.concatenate([episode.infos["target"][:-1] for episode in episodes])
    positions = np.concatenate([episode.observations[:-1, :2] for episode in episodes])
    changes = np.flatnonzero((targets[1:] != targets[:-1]).any(axis=1))
    assert len(changes) > 5
    assert np.linalg.norm(positions[changes] - targets[changes], axis=1).max() < 0.1


def test_seeds_decide_the_data(root):
    for name, seed in (("a-v0", "0"), ("b-v0", "0"), ("c-v0", "1")):
        run("maze2d-umaze", "--steps", "50", "--quiet", "--seed", seed, "--name", name)
    a, b, c = (minari.load_dataset(name)[0].observations for name in ("a-v0", "b-v0", "c-v0"))
    np.testing.assert_array_equal(a, b)
    assert (a != c).any()


def test_scores_of_minari_and_d4rl_agree_on_our_datasets(root):
    run("maze2d-umaze", "--steps", "50", "--quiet")
    from sb3_causalgdp.offline.scores import normalized_score

    by_minari = normalized_score("sb3_causalgdp/maze2d-umaze-v0", 100.0, reference="minari")
    assert by_minari.reference.source == "Minari (sb3_causalgdp/maze2d-umaze-v0)"
    assert float(by_minari) == pytest.approx(float(normalized_score("maze2d-umaze-v1", 100.0)))
    with pytest.raises(ValueError, match="is not on this machine: minari download D4RL/pen/human-v2"):
        normalized_score("D4RL/pen/human-v2", 0.0, reference="minari")


def test_the_summary_says_what_was_made_and_how_good_it_is(root, capsys):
    run("maze2d-umaze", "--steps", "700")
    output = capsys.readouterr().out
    assert "sb3_causalgdp/maze2d-umaze-v0: 3 episodes, 700 steps" in output
    assert "D4RL's references: random 23.85" in output


# Nothing half-written ---------------------------------------------------------------------------------------------------


def episodes_until(error):
    yield Episode(np.zeros((4, 4)), np.zeros((3, 2), dtype=np.float32), np.zeros(3))
    raise error


@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(143), RuntimeError("disk full")])
def test_an_interrupted_dataset_leaves_nothing(error, root):
    with pytest.raises(type(error)):
        write_dataset("sb3_causalgdp/x-v0", episodes_until(error), ENVIRONMENT, root, algorithm_name="a", description="d")
    assert list(root.iterdir()) == []
    write_dataset("sb3_causalgdp/x-v0", [next(episodes_until(error))], ENVIRONMENT, root, algorithm_name="a", description="d")
    assert list(minari.list_local_datasets()) == ["sb3_causalgdp/x-v0"]


def test_an_existing_dataset_is_not_touched(root, capsys):
    run("maze2d-umaze", "--steps", "20", "--quiet")
    with pytest.raises(SystemExit) as error:
        run("maze2d-umaze", "--steps", "30", "--quiet")
    assert error.value.code == 2
    assert "sb3_causalgdp/maze2d-umaze-v0 exists in" in capsys.readouterr().err
    assert minari.load_dataset("sb3_causalgdp/maze2d-umaze-v0").total_steps == 20


def test_another_path_leaves_minaris_own_alone(root, tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "own"))
    run("maze2d-umaze", "--steps", "20", "--path", str(tmp_path / "other"))
    assert not (tmp_path / "own").exists()
    assert (tmp_path / "other" / "sb3_causalgdp" / "maze2d-umaze-v0").is_dir()
    assert f"set MINARI_DATASETS_PATH={tmp_path / 'other'}" in capsys.readouterr().out


# Bad input --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["maze2d-tiny"], "invalid choice: 'maze2d-tiny'"),
        (["maze2d-umaze", "--steps", "0"], "must be an integer of at least 1, got '0'"),
        (["maze2d-umaze", "--steps", "many"], "must be an integer of at least 1, got 'many'"),
        (["maze2d-umaze", "--seed", "-1"], "must be an integer of at least 0, got '-1'"),
        (["maze2d-umaze", "--noise", "-0.5"], "--noise must be a standard deviation of at least 0"),
        (["maze2d-umaze", "--noise", "nan"], "--noise must be a standard deviation of at least 0"),
        (["maze2d-umaze", "--level", "30"], "--level does not apply to maze2d-umaze"),
        (["hopper-medium", "--noise", "1"], "--noise does not apply to hopper-medium"),
        (["hopper-medium", "--level", "nan"], "--level must be a normalised score"),
        (["maze2d-umaze", "--name", "my data"], "'my data' is no name of a dataset: Minari wants"),
        (["maze2d-umaze", "--name", "unversioned"], "'unversioned' is no name of a dataset: Minari wants"),
    ],
)
def test_bad_arguments_give_one_clear_error(arguments, message, root, capsys):
    with pytest.raises(SystemExit) as error:
        run(*arguments)
    assert error.value.code == 2
    last_line = capsys.readouterr().err.strip().splitlines()[-1]
    assert message in last_line
    assert list(root.iterdir()) == []


@pytest.mark.parametrize("package", ["minari", "mujoco"])
def test_missing_extras_are_named(package, root, capsys, monkeypatch):
    import_module = importlib.import_module

    def without(name, *rest):
        if name.split(".")[0] == package:
            raise ImportError(f"No module named {name!r}")
        return import_module(name, *rest)

    monkeypatch.setattr(importlib, "import_module", without)
    with pytest.raises(SystemExit) as error:
        run("maze2d-umaze", "--steps", "20")
    assert error.value.code == 2
    assert 'pip install "minari[hdf5]" gymnasium-robotics' in capsys.readouterr().err


def test_importing_the_package_imports_no_simulator():
    import subprocess
    import sys

    code = "import sys, sb3_causalgdp.offline; print({'mujoco', 'minari', 'gymnasium_robotics'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "set()"


# MuJoCo -----------------------------------------------------------------------------------------------------------------


@pytest.fixture
def small_training(monkeypatch):
    mujoco_tasks = importlib.import_module("sb3_causalgdp.offline.mujoco_tasks")
    monkeypatch.setattr(mujoco_tasks, "EVALUATION_FREQUENCY", 60)
    monkeypatch.setattr(mujoco_tasks, "EVALUATION_EPISODES", 1)
    return mujoco_tasks


def test_both_kinds_of_mujoco_datasets_share_one_training(root, small_training):
    options = ("--training-steps", "120", "--level", "-1000", "--quiet")
    run("hopper-medium-replay", *options)
    replay = minari.load_dataset("sb3_causalgdp/hopper-medium-replay-v0")
    assert replay.total_steps == 60
    assert any(episode.terminations[-1] for episode in replay)
    (checkpoint,) = (root / ".training" / "hopper-level-1000-seed0").iterdir()
    before = checkpoint.stat().st_mtime_ns
    run("hopper-medium", *options, "--steps", "37")
    medium = minari.load_dataset("sb3_causalgdp/hopper-medium-v0")
    assert medium.total_steps == 37
    assert medium.recover_environment(eval_env=True).spec.id == "Hopper-v4"
    assert checkpoint.stat().st_mtime_ns == before


def test_a_training_that_gave_up_goes_on_with_more_steps(root, small_training, capsys):
    with pytest.raises(SystemExit) as error:
        run("hopper-medium-replay", "--training-steps", "60", "--level", "500", "--quiet")
    assert error.value.code == 2
    assert "after 60 training steps, not 500" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        run("hopper-medium-replay", "--training-steps", "120", "--level", "500", "--quiet")
    (checkpoint,) = (root / ".training" / "hopper-level500-seed0").iterdir()
    with np.load(checkpoint / "transitions.npz") as stored:
        assert len(stored["rewards"]) == 120
        assert stored["observations"].any(axis=1).all()


def test_transitions_of_a_replay_dataset_are_those_of_the_environment(root, small_training):
    run("hopper-medium-replay", "--training-steps", "60", "--level", "-1000", "--quiet", "--steps", "50")
    dataset = minari.load_dataset("sb3_causalgdp/hopper-medium-replay-v0")
    assert dataset.total_steps == 50
    for episode in dataset:
        assert episode.observations.shape == (len(episode) + 1, 11)
        # Hopper earns 1 for being alive, and at most a few m/s of progress
        assert (episode.rewards < 10).all() and np.abs(episode.actions).max() <= 1
