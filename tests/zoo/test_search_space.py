"""``train --optimize-hyperparameters``."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest
import torch as th
import yaml
from stable_baselines3.common.callbacks import BaseCallback

from sb3_causalgdp import CausalGDP, TrainingDivergedError

pytest.importorskip("rl_zoo3")
optuna = pytest.importorskip("optuna")

import sb3_causalgdp.zoo.manager  # noqa: E402
from sb3_causalgdp.zoo.run_folder import find_runs  # noqa: E402
from sb3_causalgdp.zoo.search_space import convert_causalgdp_params, sample_causalgdp_params  # noqa: E402

PENDULUM = ("--algo", "causalgdp", "--env", "Pendulum-v1", "-f", "logs", "--num-threads", "1", "--device", "cpu")
STUDY = ("--storage", "logs/study.log", "--study-name", "pendulum")


def sampled(seed, hyperparams=None, her=False):
    study = optuna.create_study(sampler=optuna.samplers.RandomSampler(seed=seed))
    trial = study.ask()
    additional = {"using_her_replay_buffer": her, "her_kwargs": {}}
    return trial, sample_causalgdp_params(trial, 1, 1, additional, hyperparams)


@pytest.mark.parametrize("seed", range(4))
def test_every_sample_makes_a_model(seed):
    _, hyperparams = sampled(seed)
    model = CausalGDP("MlpPolicy", "Pendulum-v1", device="cpu", buffer_size=10, **hyperparams)
    assert model.gradient_steps == model.train_freq.frequency
    assert (model.guidance is None) == (hyperparams.get("guidance", "posterior") is None)


def test_a_trial_is_converted_to_what_was_sampled():
    for seed in range(8):
        trial, hyperparams = sampled(seed)
        assert convert_causalgdp_params(trial.params) == hyperparams
        assert trial.user_attrs["batch_size"] == hyperparams["batch_size"] == 2 ** trial.params["batch_size_pow"]


def test_what_is_sampled_stands_beside_what_the_entry_says():
    entry = {"policy_kwargs": {"activation_fn": "relu", "net_arch": [7]}, "replay_buffer_kwargs": {"copy_info_dict": False}}
    _, hyperparams = sampled(0, entry, her=True)
    assert hyperparams["policy_kwargs"]["activation_fn"] == "relu" and hyperparams["policy_kwargs"]["net_arch"] != [7]
    assert set(hyperparams["replay_buffer_kwargs"]) == {"copy_info_dict", "n_sampled_goal", "goal_selection_strategy"}


def test_the_space_depends_on_the_entry():
    names = {name: set(sampled(0, entry)[0].params) for name, entry in {
        "online": None,
        "offline": {"offline_dataset": "D4RL/pen/human-v2"},
        "method": {"causal_discovery": "perturbed", "causal_discovery_kwargs": {"noise": 0.1}},
    }.items()}  # fmt: skip
    assert names["offline"] - names["online"] == {"offline_fraction"}
    assert names["online"] - names["method"] == {"causal_discovery"}
    wanted = {
        "diffusion_steps",
        "eta",
        "guidance_scale",
        "guidance_target",
        "causal_refresh_freq",
        "causal_discovery",
        "actor_update",
        "world_model",
    }
    assert wanted <= names["online"]


def test_a_search_is_stored_and_its_trials_are_trained_again(zoo, folder, capsys):
    (folder / "entry.yml").write_text(
        yaml.safe_dump(
            {
                "Pendulum-v1": {
                    "policy": "MlpPolicy",
                    "n_timesteps": "60",
                    "learning_starts": 50,
                    "env_kwargs": {"max_episode_steps": 20},
                    "policy_kwargs": "dict(activation_fn='tanh', net_arch=[9])",
                }
            }
        ).replace("'60'", "6e1")
    )
    search = ("--optimize", "--n-trials", "2", "--n-startup-trials", "2", "--n-evaluations", "1", "--eval-episodes", "1")
    zoo("train", *PENDULUM, *STUDY, *search, "--seed", 3, "--no-optim-plots", "-conf", "entry.yml")
    assert "Number of finished trials:  2" in capsys.readouterr().out
    assert list((folder / "logs" / "causalgdp").glob("report_Pendulum-v1_2-trials-60-tpe-median_*.csv"))
    study = study_of(folder)
    assert [trial.state.name for trial in study.trials] == ["COMPLETE", "COMPLETE"]
    # No run, which enjoy and report would take for the latest
    assert not list((folder / "logs" / "causalgdp").glob("Pendulum-v1_*"))
    # The very first trial, too; the command line has the last word
    for trial_id in (0, 1):
        again = ("--trial-id", trial_id, "--eval-freq", -1, "-n", 20, "-params", "eta:0.125")
        zoo("train", *PENDULUM, *STUDY, *again, "-conf", "entry.yml")
    for run, trial in zip((1, 2), study.trials, strict=True):
        model = CausalGDP.load(folder / "logs" / "causalgdp" / f"Pendulum-v1_{run}" / "Pendulum-v1.zip", device="cpu")
        wanted = convert_causalgdp_params(trial.params)
        assert model.eta == 0.125 and model.learning_rate == wanted["learning_rate"]
        assert model.policy_kwargs == {"activation_fn": "tanh", **wanted["policy_kwargs"]}
    zoo("train", *PENDULUM, *STUDY, *search, "--no-optim-plots", "-conf", "entry.yml", "--n-trials", 1)
    zoo("enjoy", *PENDULUM, "-f", "logs", "-n", 3, "--no-render")
    assert [one.path.name for one in find_runs(folder / "logs" / "causalgdp")] == ["Pendulum-v1_2"]


def test_two_processes_at_once_share_a_search(folder):
    search = ("--optimize", "--max-total-trials", "2", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots")
    tiny = ("learning_starts:20", "buffer_size:100", "env_kwargs:dict(max_episode_steps=10)")
    command = [sys.executable, "-m", "sb3_causalgdp.zoo", "train", *PENDULUM, *STUDY, *search, "-uuid", "-n", "24"]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    (folder / "logs").mkdir()
    processes = [
        subprocess.Popen([*command, "-params", *tiny], env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        for _ in range(2)
    ]
    outputs = [process.communicate()[0] for process in processes]
    assert [process.returncode for process in processes] == [0, 0], "\n".join(outputs)
    trials = study_of(folder).trials
    # A process may begin its last trial while the other one ends the search's last
    assert 2 <= len(trials) <= 3 and {trial.state.name for trial in trials} == {"COMPLETE"}


def study_of(folder):
    backend = optuna.storages.journal.JournalFileBackend(str(folder / "logs" / "study.log"))
    return optuna.load_study(storage=optuna.storages.JournalStorage(backend), study_name="pendulum")


def test_processes_that_create_a_database_at_once_wait_for_each_other(folder, monkeypatch):
    from sqlalchemy.exc import IntegrityError, OperationalError

    from sb3_causalgdp.zoo.manager import open_database

    storage = f"sqlite:///{folder / 'study.db'}"
    get_storage, failures = optuna.storages.get_storage, [IntegrityError, OperationalError]

    def disturbed(url):
        if failures:
            raise failures.pop()("CREATE TABLE", {}, Exception("table already exists"))
        return get_storage(url)

    monkeypatch.setattr(optuna.storages, "get_storage", disturbed)
    open_database(storage, pause=0.0)
    assert optuna.get_all_study_names(storage) == []
    failures += [IntegrityError] * 2
    with pytest.raises(IntegrityError):
        open_database(storage, n_attempts=2, pause=0.0)


class BreakTheActor(BaseCallback):
    """At some step, as an exploding update would."""

    def __init__(self, at_step, with_error=False):
        super().__init__()
        self.at_step, self.with_error = at_step, with_error

    def _on_step(self):
        if self.num_timesteps == self.at_step:
            if self.with_error:
                raise th.linalg.LinAlgError("The input matrix is singular")
            with th.no_grad():
                next(self.model.critic.parameters()).fill_(math.nan)
        return True


def test_divergence_stops_with_a_value_error():
    pytest.importorskip("mujoco")
    # MuJoCo clips actions, and goes on with NaN
    model = CausalGDP(
        "MlpPolicy",
        "InvertedPendulum-v5",
        learning_starts=5,
        batch_size=4,
        buffer_size=100,
        device="cpu",
        policy_kwargs={"net_arch": [8], "world_model_net_arch": [8]},
    )
    with pytest.raises(TrainingDivergedError, match=r"training diverged: \w+_loss is nan at update 1\d"):
        model.learn(100, callback=BreakTheActor(20))
    assert np.isfinite(model.replay_buffer.observations).all()


@pytest.mark.parametrize("with_error", [False, True])
def test_a_trial_that_diverges_is_pruned_and_the_search_goes_on(with_error, zoo, folder, capsys, monkeypatch):
    monkeypatch.setattr(sb3_causalgdp.zoo.manager, "BreakTheActor", BreakTheActor, raising=False)
    callback = {"sb3_causalgdp.zoo.manager.BreakTheActor": {"at_step": 20, "with_error": with_error}}
    search = ("--optimize", "--n-trials", "2", "--n-evaluations", "1", "-n", "30", "--no-optim-plots", "--seed", "0")
    tiny = ("learning_starts:5", "buffer_size:100", "env_kwargs:dict(max_episode_steps=10)", f"callback:{callback}")
    with pytest.raises(SystemExit):
        zoo("train", *PENDULUM, *STUDY, *search, "-params", *tiny)
    assert "no trial was completed" in capsys.readouterr().err
    study = study_of(folder)
    assert [trial.state.name for trial in study.trials] == ["PRUNED", "PRUNED"]
