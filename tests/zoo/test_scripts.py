"""RL Zoo's scripts through our entry point, in an empty folder."""

import importlib.util
import os
import pickle
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from importlib.metadata import version
from pathlib import Path

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np
import pytest
import yaml

import sb3_causalgdp
from sb3_causalgdp import CausalGDP

pytest.importorskip("rl_zoo3")

PENDULUM = ("--algo", "causalgdp", "--env", "Pendulum-v1")
FIRST = ("-n", 260, "--eval-freq", 130, "--save-freq", 200, "--save-replay-buffer")


def needs(*modules):
    missing = [name for name in modules if importlib.util.find_spec(name) is None]
    return pytest.mark.skipif(bool(missing), reason=f"needs {missing}")


@pytest.fixture(scope="module")
def trained(zoo, tiny, tmp_path_factory):
    """Two runs on Pendulum with episodes of 50 steps: 260 steps, of which the first 200 are random, and 100 more."""
    folder = tmp_path_factory.mktemp("trained")
    before = os.getcwd()
    os.chdir(folder)
    try:
        common = ("train", *PENDULUM, "-f", "logs", "--eval-episodes", 2, "--env-kwargs", "max_episode_steps:50", *tiny)
        zoo(*common, "learning_starts:200", "causal_refresh_freq:250", *FIRST)
        zoo(*common, "learning_starts:0", "-i", "logs/causalgdp/Pendulum-v1_1/Pendulum-v1.zip", "-n", 100, "--eval-freq", 50)
    finally:
        os.chdir(before)
    return folder / "logs"


@pytest.fixture
def logs(trained, folder):
    shutil.copytree(trained, folder / "logs")
    return folder / "logs"


def test_training_saves_models_evaluations_and_what_they_were_made_with(trained):
    run = trained / "causalgdp" / "Pendulum-v1_1"
    assert {path.name for path in run.iterdir()} >= {"0.monitor.csv", "best_model.zip", "evaluations.npz", "replay_buffer.pkl"}
    assert np.load(run / "evaluations.npz")["timesteps"].tolist() == [130, 260]
    config = yaml.load((run / "Pendulum-v1" / "config.yml").read_text(), Loader=yaml.UnsafeLoader)
    assert config["diffusion_steps"] == 2 and config["n_timesteps"] == 10_000
    model = CausalGDP.load(run / "Pendulum-v1.zip", device="cpu")
    assert (model.num_timesteps, model.diffusion_steps, model.actor.net_arch) == (260, 2, [8])
    assert [graph.num_timesteps for graph in model.causal_graph_history] == [250]
    assert CausalGDP.load(run / "rl_model_200_steps.zip", device="cpu").num_timesteps == 200


def test_a_continued_training_starts_from_the_model_and_its_transitions(trained):
    model = CausalGDP.load(trained / "causalgdp" / "Pendulum-v1_2" / "Pendulum-v1.zip", device="cpu")
    first = CausalGDP.load(trained / "causalgdp" / "Pendulum-v1_1" / "Pendulum-v1.zip", device="cpu")
    assert model._n_updates > first._n_updates > 0
    assert model._stored_position == first._stored_position + 100
    # Its steps begin at 0, and so does its history
    assert model.causal_graph().num_timesteps == 250 and model.causal_graph_history == []


def test_a_training_records_the_exact_command_and_what_was_installed(trained):
    settings = trained / "causalgdp" / "Pendulum-v1_1" / "Pendulum-v1"
    assert shlex.split((settings / "command.txt").read_text()) == sys.orig_argv
    versions = yaml.safe_load((settings / "versions.yml").read_text())
    assert versions["sb3_causalgdp"] == sb3_causalgdp.__version__
    for name in ("rl_zoo3", "mujoco"):
        assert versions[name] == (version(name) if importlib.util.find_spec(name) else "not installed")


def test_playing_takes_no_memory_for_transitions(zoo, logs, capsys, monkeypatch):
    from sb3_causalgdp.zoo.algorithm import WithoutReplayBuffer

    loaded = []
    load = WithoutReplayBuffer.load.__func__
    monkeypatch.setattr(
        WithoutReplayBuffer,
        "load",
        classmethod(lambda cls, *args, **kwargs: loaded.append(load(cls, *args, **kwargs)) or loaded[0]),
    )
    zoo("enjoy", *PENDULUM, "-f", "logs", "--exp-id", 1, "--load-best", "--no-render", "-n", 50)
    assert "1 Episodes" in capsys.readouterr().out
    assert loaded[0].buffer_size == 1 and loaded[0].replay_buffer.buffer_size == 1
    assert loaded[0].policy.is_guided


def test_playing_without_an_end_says_that_there_is_no_return(zoo, logs, capsys):
    zoo("enjoy", *PENDULUM, "-f", "logs", "--exp-id", 1, "--load-best", "--no-render", "-n", 5)
    assert "No episode has ended" in capsys.readouterr().out
    zoo("enjoy", *PENDULUM, "-f", "logs", "--exp-id", 1, "--load-best", "--no-render", "-n", 50)
    assert "No episode has ended" not in capsys.readouterr().out


@needs("moviepy", "pygame")
def test_a_video_is_recorded(zoo, logs):
    zoo("record_video", *PENDULUM, "-f", "logs", "-n", 3)
    assert list((logs / "causalgdp" / "Pendulum-v1_2" / "videos").glob("final-model-causalgdp-*.mp4"))


def test_other_scripts_are_started_through_our_entry_point(monkeypatch):
    from sb3_causalgdp.zoo.scripts import own_command

    ours = [sys.executable, "-m", "sb3_causalgdp.zoo"]
    assert own_command(["python", "-m", "rl_zoo3.record_video", "--env", "A"]) == [*ours, "record_video", "--env", "A"]
    assert own_command(["python", "enjoy.py", "-n", "1"]) == [*ours, "enjoy", "-n", "1"]
    assert own_command(["ls", "-m", "rl_zoo3.train"]) == ["ls", "-m", "rl_zoo3.train"]
    assert own_command("python -m rl_zoo3.train") == "python -m rl_zoo3.train"


@needs("moviepy", "pygame")
def test_a_training_is_filmed(zoo, logs, monkeypatch):
    from sb3_causalgdp.zoo import scripts

    call = scripts.subprocess.call
    started = []

    def in_this_process(command, *args, **kwargs):
        # imageio looks whether ffmpeg can be called, in its first use in a process
        if command[:3] != [sys.executable, "-m", "sb3_causalgdp.zoo"]:
            return call(command, *args, **kwargs)
        started.append(command[3])
        zoo(*command[3:])
        return 0

    with monkeypatch.context() as patches:
        patches.setattr(scripts.subprocess, "call", in_this_process)
        zoo("record_training", *PENDULUM, "-f", "logs", "--exp-id", 1, "-n", 3)
    assert started == ["record_video"] * 3
    videos = logs / "causalgdp" / "Pendulum-v1_1" / "videos"
    assert (videos / "training.mp4").stat().st_size > 0
    assert len(list(videos.glob("*-Pendulum-v1-step-*.mp4"))) == 3  # checkpoint, final and best model


@needs("seaborn")
def test_results_are_plotted(zoo, logs, capsys, monkeypatch):
    zoo("plot_train", "-a", "causalgdp", "-e", "Pendulum-v1", "-f", "logs", "-w", 1)
    # Both runs have two evaluations
    zoo("all_plots", "-a", "causalgdp", "-e", "Pendulum-v1", "-f", "logs", "-o", "results", "--no-million")
    assert "CAUSALGDP" in capsys.readouterr().out
    with open("results.pkl", "rb") as file:
        assert pickle.load(file)["Pendulum-v1"]["CAUSALGDP-logs"]["last_evals"].shape == (2,)
    titles = []
    monkeypatch.setattr(plt, "title", lambda label, **kwargs: titles.append(label))
    zoo("plot_from_file", "-i", "results.pkl", "-o", "curves.png", "--format", "png", "--no-million")
    assert Path("curves.png").stat().st_size > 0
    assert titles == ["Pendulum-v1", "Sensitivity plot", "Last evaluations"]


def test_mazes_have_success_rates(zoo, tiny, folder, capsys):
    pytest.importorskip("gymnasium_robotics")
    maze = ("--env", "PointMaze_UMaze-v3", "-f", "logs", "--env-kwargs", "max_episode_steps:10")
    (folder / "entry.yml").write_text("PointMaze_UMaze-v3: {policy: MultiInputPolicy, n_timesteps: 60}")
    training = ("train", *maze, "-conf", "entry.yml", "--eval-freq", 30, "--eval-episodes", 2, "--log-interval", 1)
    zoo(*training, *tiny, "learning_starts:50")
    printed = " ".join(capsys.readouterr().out.split())
    for part in ("rollout/", "eval/"):
        assert "| success_rate | 0 | " in printed.split(f"| {part} | |")[1].split("time/")[0]
    with np.load(folder / "logs" / "causalgdp" / "PointMaze_UMaze-v3_1" / "evaluations.npz") as evaluations:
        assert evaluations["successes"].shape == (2, 2)
    zoo("enjoy", "--env", "PointMaze_UMaze-v3", "-f", "logs", "-n", 12, "--no-render")
    assert "Success rate: " in capsys.readouterr().out


def test_a_model_goes_to_the_hub_and_comes_back(zoo, tiny, folder, monkeypatch, capsys):
    pytest.importorskip("mujoco")
    import huggingface_hub
    import huggingface_sb3
    from huggingface_hub.errors import EntryNotFoundError

    hub = folder / "hub_server"

    class LocalHub:
        def create_repo(self, repo_id, **kwargs):
            return f"file://{repo_id}"

        def snapshot_download(self, repo_id, local_dir):
            Path(local_dir).mkdir(parents=True)

        def upload_folder(self, repo_id, folder_path, **kwargs):
            shutil.copytree(folder_path, hub / repo_id)

    def download(repo_id, filename):
        path = hub / repo_id / filename
        if not path.is_file():
            raise EntryNotFoundError(f"404: {filename}")
        return str(path)

    monkeypatch.setattr(huggingface_hub, "HfApi", LocalHub)
    monkeypatch.setattr(huggingface_sb3, "load_from_hub", download)
    # Its episodes are short
    pendulum = ("--algo", "causalgdp", "--env", "InvertedPendulum-v5")
    zoo("train", *pendulum, "-f", "logs", "-n", 20, "--eval-freq", -1, *tiny)
    zoo("push_to_hub", *pendulum, "-f", "logs", "-orga", "me", "--no-render")
    card = (hub / "me" / "causalgdp-InvertedPendulum-v5" / "README.md").read_text()
    assert "**CausalGDP** Agent" in card and "python -m sb3_causalgdp.zoo enjoy --algo causalgdp" in card
    assert "rl_zoo3." not in card and 'pip install "./sb3_causalgdp[zoo]"' in card
    zoo("load_from_hub", *pendulum, "-f", "downloaded", "-orga", "me")
    zoo("enjoy", *pendulum, "-f", "downloaded", "--no-render", "-n", 30)
    assert "Mean reward" in capsys.readouterr().out
    pushed = CausalGDP.load("downloaded/causalgdp/InvertedPendulum-v5_1/InvertedPendulum-v5.zip", device="cpu")
    assert pushed.buffer_size == 1000


def test_a_stock_algorithm_trains_and_plays_through_the_same_entry(zoo, folder, capsys):
    sac = ("--algo", "sac", "--env", "Pendulum-v1", "-f", "logs")
    parameters = (
        "policy_kwargs:dict(net_arch=[8])",
        "batch_size:8",
        "learning_starts:20",
        "buffer_size:100",
        "learning_rate:1e-3",
    )
    zoo("train", *sac, "-n", 30, "--eval-freq", -1, "--num-threads", 1, "-params", *parameters)
    zoo("enjoy", *sac, "--no-render", "-n", 10)
    assert "Loading logs/sac/Pendulum-v1_1/Pendulum-v1.zip" in capsys.readouterr().out


def test_interrupted_training_leaves_a_model_that_loads(folder):
    command = [sys.executable, "-u", "-m", "sb3_causalgdp.zoo", "train", *PENDULUM, "-f", "logs", "--eval-freq", "-1"]
    # Longer than a busy machine could need to read the line
    command += ["-n", "1000000"]
    # With a progress bar, and a callback that says when the training runs
    (folder / "says.py").write_text(
        "from stable_baselines3.common.callbacks import BaseCallback\n"
        "class Says(BaseCallback):\n"
        "    def _on_step(self):\n"
        "        self.num_timesteps == 120 and print('at step 120', flush=True)\n"
        "        return True\n"
    )
    parameters = (
        "-params",
        "callback:'says.Says'",
        "policy_kwargs:dict(net_arch=[8],world_model_net_arch=[8])",
        "batch_size:8",
    )
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    output = []
    with subprocess.Popen(
        [*command, *parameters],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=env,
        # A shell's background jobs, as these tests may be one, hand down a SIGINT that is ignored
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        give_up = threading.Timer(600, process.kill)
        give_up.start()
        for line in process.stdout:
            output.append(line)
            if "at step 120" in line:
                process.send_signal(signal.SIGINT)
        give_up.cancel()
    assert process.returncode == 0, "".join(output)
    model = CausalGDP.load("logs/causalgdp/Pendulum-v1_1/Pendulum-v1.zip", device="cpu")
    assert 120 <= model.num_timesteps < 1_000_000
    env = gym.make("Pendulum-v1")
    action, _ = model.predict(env.reset(seed=0)[0])
    assert env.action_space.contains(action)
