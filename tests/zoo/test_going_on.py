"""Trainings that a signal ends go on in their own folder when the same command is given again."""

import csv
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import torch as th

from sb3_causalgdp import CausalGDP

pytest.importorskip("rl_zoo3")

STEPS = 500


@pytest.fixture
def command(tiny):
    train = ("train", "--algo", "causalgdp", "--env", "Pendulum-v1", "-f", "logs", "-n", str(STEPS), "--eval-freq", "130")
    options = ("--eval-episodes", "1", "--save-freq", "100", "--env-kwargs", "max_episode_steps:60", *tiny)
    return [sys.executable, "-m", "sb3_causalgdp.zoo", *train, *options, "learning_starts:50", "causal_refresh_freq:120"]


def start(command):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)


def end_at_checkpoint(process, number, folder, signal_number):
    path = folder / "checkpoints" / f"checkpoint_{number:06d}"
    end = time.monotonic() + 120
    while not path.exists():
        assert process.poll() is None and time.monotonic() < end, process.communicate()
        time.sleep(0.005)
    process.send_signal(signal_number)
    return process.communicate()


def weights(folder):
    return CausalGDP.load(folder / "Pendulum-v1.zip", device="cpu").policy.state_dict()


def lengths_of_episodes(folder):
    with (folder / "0.monitor.csv").open() as file:
        file.readline()
        return [int(row["l"]) for row in csv.DictReader(file)]


def cut_all_but_checkpoints(folder):
    """As a disk does that was full, or another program."""
    (folder / "Pendulum-v1" / "vecnormalize.pkl").write_bytes(b"\x80\x04cut")
    for path in [*(folder / "Pendulum-v1").glob("*.yml"), folder / "evaluations.npz"]:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with (folder / "0.monitor.csv").open("a") as file:
        file.write("-300.1,6")


def test_the_same_command_goes_on_after_it_was_killed_and_after_it_was_terminated(command, folder):
    run, uninterrupted = folder / "logs/causalgdp/Pendulum-v1_1", folder / "logs/causalgdp/Pendulum-v1_2"
    process = start(command)
    end_at_checkpoint(process, 1, run, signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    process = start(command)
    output, errors = end_at_checkpoint(process, 3, run, signal.SIGTERM)
    assert process.returncode == 143, errors
    assert "Going on with logs/causalgdp/Pendulum-v1_1" in output
    last_line = errors.strip().splitlines()[-1]
    assert last_line.startswith("Terminated after ") and "go on from logs/causalgdp/Pendulum-v1_1/checkpoints" in last_line
    cut_all_but_checkpoints(run)
    process = start(command)
    outputs = process.communicate()
    assert process.returncode == 0, outputs
    with np.load(run / "evaluations.npz") as evaluations:
        assert evaluations["timesteps"].tolist() == [130, 260, 390]
    # A run that is complete is not continued
    process = start(command)
    assert process.communicate() and process.returncode == 0
    assert sorted(path.name for path in run.parent.iterdir()) == [run.name, uninterrupted.name]
    for (key, value), other in zip(weights(run).items(), weights(uninterrupted).values(), strict=True):
        assert th.equal(value, other), key
    assert lengths_of_episodes(run) == lengths_of_episodes(uninterrupted) == [60] * (STEPS // 60)


def test_two_runs_that_start_at_once_have_a_folder_each(command, folder):
    processes = [start(command) for _ in range(2)]
    outputs = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0, 0], outputs
    runs = sorted(path.name for path in (folder / "logs/causalgdp").iterdir())
    assert runs == ["Pendulum-v1_1", "Pendulum-v1_2"]


def test_a_checkpoint_in_one_file_is_a_trained_agent(zoo, tiny, folder):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", learning_starts=50, seed=0, policy_kwargs={"net_arch": [8]}).learn(150)
    model.save_checkpoint("there.zip")
    zoo("train", "--algo", "causalgdp", "--env", "Pendulum-v1", "-f", "logs", "-n", 130, "-i", "there.zip", *tiny[:6])
    other = CausalGDP.load("logs/causalgdp/Pendulum-v1_1/Pendulum-v1.zip")
    assert other.actor.net_arch == [8] and other._n_updates > model._n_updates
