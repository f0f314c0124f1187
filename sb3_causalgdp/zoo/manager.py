"""RL Zoo's experiment manager, for CausalGDP's entries, its offline stage and its search space."""

import os
import shlex
import shutil
import sys
import time
import traceback
import warnings
from collections import OrderedDict
from collections.abc import Callable
from contextlib import suppress
from functools import partial, partialmethod
from pathlib import Path
from pprint import pprint
from typing import Any

import optuna
import torch as th
import yaml
from rl_zoo3 import ALGOS, exp_manager
from rl_zoo3.exp_manager import ExperimentManager
from rl_zoo3.utils import get_latest_run_id
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_causalgdp import CausalGDP, TrainingCheckpointCallback
from sb3_causalgdp.checkpoints.store import is_checkpoint
from sb3_causalgdp.files import replaced_when_done, temporary_folder
from sb3_causalgdp.offline.callbacks import NormalizedEvalCallback, WholeEvalCallback
from sb3_causalgdp.offline.scores import find_reference
from sb3_causalgdp.zoo.algorithm import ALGORITHM, SetupError, TrustingCausalGDP
from sb3_causalgdp.zoo.going_on import FOLDER as CHECKPOINTS
from sb3_causalgdp.zoo.going_on import RunLock, cut_monitors, interrupted_run, new_folder, write_command
from sb3_causalgdp.zoo.hyperparameters import SCHEDULES, hyperparameter_file, make_schedule, merged, read_entry
from sb3_causalgdp.zoo.offline_tasks import OFFLINE_TASKS
from sb3_causalgdp.zoo.replacing import replaced
from sb3_causalgdp.zoo.search_space import sample_causalgdp_params
from sb3_causalgdp.zoo.versions import installed_versions


class CausalGDPExperimentManager(ExperimentManager):
    """
    RL Zoo's manager. For other algorithms it is that one, except that what is wrong before the training is a ``SetupError``,
    and that versions and the exact command are recorded.

    Without ``config``, the hyperparameters of CausalGDP are those of our own file.

    :param args: As for ``ExperimentManager``
    :param kwargs: As for ``ExperimentManager``
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._uuid = kwargs.get("uuid_str", "")
        self._made_folder = False
        self._lock: RunLock | None = None
        self._manifest: dict[str, Any] | None = None
        if self.algo != ALGORITHM:
            return
        if kwargs.get("config") is None:
            self.config = str(hyperparameter_file())
        if not (self.continue_training or self.optimize_hyperparameters):
            self._look_for_interrupted_run()

    def _look_for_interrupted_run(self) -> None:
        found = interrupted_run(Path(self.log_path), self.env_name)
        if found is None:
            return
        folder, self._lock, self._manifest = found
        self.save_path, self.params_path = str(folder), str(folder / self.env_name)
        self.trained_agent, self.continue_training = str(folder / CHECKPOINTS), True
        # Episodes are added to those that are there
        self.monitor_kwargs["override_existing"] = False
        print(f"Going on with {folder}")

    def setup_experiment(self) -> tuple[BaseAlgorithm, dict[str, Any]] | None:
        task = OFFLINE_TASKS.get(self.env_name.gym_id)
        if task is not None:
            # The task's environment is the right one, under another name
            warnings.filterwarnings("ignore", message=f"{task.dataset} was collected in")
        try:
            experiment = super().setup_experiment()
        except Exception as error:
            self._remove_empty_run()
            raise SetupError(f"{self.algo} on {self.env_name.gym_id}: {_message(error)}") from error
        if experiment is None:
            # A search: its results are in the storage and in a report
            self._remove_empty_run()
        return experiment

    def _remove_empty_run(self) -> None:
        """It would be the latest one, which the other scripts look for."""
        if self._made_folder:
            shutil.rmtree(self.save_path, ignore_errors=True)

    def create_log_folder(self) -> None:
        if self._manifest is not None:
            cut_monitors(Path(self.save_path), self._manifest["num_timesteps"] // self.n_envs)
            return
        self.save_path = new_folder(self.save_path, self._numbered)
        self._made_folder = True
        self.params_path = f"{self.save_path}/{self.env_name}"
        os.mkdir(self.params_path)
        if self.algo == ALGORITHM and not self.optimize_hyperparameters:
            self._lock = RunLock(Path(self.save_path))
            write_command(Path(self.save_path))

    def _numbered(self) -> str:
        number = get_latest_run_id(self.log_path, self.env_name) + 1
        return os.path.join(self.log_path, f"{self.env_name}_{number}{self._uuid}")

    # Hyperparameters ----------------------------------------------------------------------------------------------------

    def read_hyperparameters(self) -> tuple[dict[str, Any], dict[str, Any]]:
        if self.algo != ALGORITHM:
            return super().read_hyperparameters()
        # RL Zoo takes trial 0 for none, and lets a trial's policy_kwargs replace those of the entry
        trial_id, self.trial_id = self.trial_id, None
        hyperparams, _ = super().read_hyperparameters()
        hyperparams = read_entry(hyperparams)
        if self.storage and self.study_name and trial_id is not None:
            sampled = self._sampled_in(self.storage, self.study_name, trial_id)
            hyperparams = merged(_with_mappings(hyperparams), sampled)
            hyperparams = read_entry({**hyperparams, **(self.custom_hyperparams or {})})
            print(f"With the hyperparameters of trial {trial_id} of {self.study_name}:")
            pprint(hyperparams)
        return hyperparams, OrderedDict(sorted(hyperparams.items()))

    def _sampled_in(self, storage: str, study_name: str, trial_id: int) -> dict[str, Any]:
        print("Loading from Optuna study...")
        try:
            return self.load_trial(storage, study_name, trial_id)
        except (IndexError, KeyError) as error:
            raise ValueError(f"there is no trial {trial_id} of study {study_name!r} in {storage}") from error

    def _preprocess_hyperparams(
        self, hyperparams: dict[str, Any]
    ) -> tuple[dict[str, Any], Callable | None, list[BaseCallback], Callable | None]:
        if self.algo != ALGORITHM:
            return super()._preprocess_hyperparams(hyperparams)
        # RL Zoo makes schedules of the learning rate alone, which cannot be loaded without it
        schedules = {key: make_schedule(key, hyperparams.pop(key)) for key in SCHEDULES if key in hyperparams}
        rest, env_wrapper, callbacks, vec_env_wrapper = super()._preprocess_hyperparams(hyperparams)
        return {**rest, **schedules}, env_wrapper, callbacks, vec_env_wrapper

    # Files ----------------------------------------------------------------------------------------------------------------

    def _save_config(self, saved_hyperparams: dict[str, Any]) -> None:
        if self._manifest is not None:
            return
        with temporary_folder(Path(self.params_path)) as folder:
            with replaced(self, "params_path", str(folder)):
                super()._save_config(saved_hyperparams)
            for name in ("args.yml", "config.yml"):
                with replaced_when_done(Path(self.params_path, name)) as file:
                    shutil.copyfile(folder / name, file)
        versions = yaml.safe_dump(installed_versions(), sort_keys=False, allow_unicode=True)
        # RL Zoo's command lacks the shell's quotes
        for name, text in {"command.txt": shlex.join(sys.orig_argv), "versions.yml": versions}.items():
            with replaced_when_done(Path(self.params_path, name)) as file:
                file.write_text(text, encoding="utf-8")

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        if self.algo == ALGORITHM and (self._manifest is not None or is_checkpoint(Path(self.trained_agent))):
            trusted = ALGOS[ALGORITHM] is TrustingCausalGDP
            return CausalGDP.resume(self.trained_agent, env, self.device, trusted=trusted)
        model = super()._load_pretrained_agent(hyperparams, env)
        if isinstance(model, CausalGDP):
            # The steps of the new run begin at 0, and so does the history that it saves
            model.causal_graph_history = []
            # What it writes is of that name
            model.__class__ = CausalGDP
        return model

    def save_trained_model(self, model: BaseAlgorithm) -> None:
        super().save_trained_model(model)
        if isinstance(model, CausalGDP):
            # Again, with what RL Zoo does not ask for
            model.save(f"{self.save_path}/{self.env_name}", include=["causal_graph_history"])

    def _maybe_normalize(self, env: VecEnv, eval_env: bool) -> VecEnv:
        if self._manifest is None:
            return super()._maybe_normalize(env, eval_env)
        # The checkpoint has newer statistics than the file that RL Zoo would look for
        with replaced(self, "trained_agent", os.path.join(self.trained_agent, "none")):
            return super()._maybe_normalize(env, eval_env)

    # Training -----------------------------------------------------------------------------------------------------------

    def learn(self, model: BaseAlgorithm) -> None:
        if isinstance(model, CausalGDP) and not self._pretrain(model):
            assert model.env is not None
            with suppress(EOFError):  # Ctrl-C has ended the environments' processes, too
                model.env.close()
            return
        if self._manifest is None:
            super().learn(model)
            return
        self.n_timesteps = max(0, self.n_timesteps - model.num_timesteps)
        with replaced(CausalGDP, "learn", partialmethod(CausalGDP.learn, reset_num_timesteps=False)):
            super().learn(model)

    def create_callbacks(self) -> None:
        every = self.save_freq
        super().create_callbacks()
        if self.algo == ALGORITHM:
            self.callbacks.append(self._checkpoints(every))

    def _checkpoints(self, every: int) -> TrainingCheckpointCallback:
        """Without --save-freq, one is written when the process is asked to end."""
        return TrainingCheckpointCallback(
            Path(self.save_path, CHECKPOINTS), every if every > 0 else sys.maxsize, at_end=False, verbose=self.verbose
        )

    def _pretrain(self, model: CausalGDP) -> bool:
        """The offline stage, with evaluations and checkpoints; False if it was interrupted, and the model is to be saved."""
        gradient_steps = model.pretrain_steps - model.n_pretrain_steps
        if gradient_steps <= 0:
            return True
        try:
            model.pretrain(gradient_steps, callback=self._offline_callbacks(model), progress_bar=self.show_progress)
        except KeyboardInterrupt:
            return False
        return True

    def _offline_callbacks(self, model: CausalGDP) -> list[BaseCallback]:
        """As in the training, but numbered by gradient steps, in a folder of their own."""
        folder = os.path.join(self.save_path, "offline")
        callbacks: list[BaseCallback] = [self._checkpoints(self.save_freq * self.n_envs)]
        if self.save_freq > 0:
            callbacks.append(CheckpointCallback(self.save_freq * self.n_envs, folder, name_prefix="rl_model", verbose=1))
        for online in self.callbacks:
            if isinstance(online, EvalCallback):
                kwargs: dict[str, Any] = {
                    "n_eval_episodes": online.n_eval_episodes,
                    "eval_freq": self.eval_freq * self.n_envs,
                    "log_path": folder,
                    "best_model_save_path": folder,
                    "deterministic": online.deterministic,
                }
                task = model.offline_dataset or ""
                if find_reference(task) is None:
                    callbacks.append(WholeEvalCallback(online.eval_env, **kwargs))
                else:
                    callbacks.append(NormalizedEvalCallback(online.eval_env, task, **kwargs))
        return callbacks

    # Hyperparameter optimization ----------------------------------------------------------------------------------------

    def hyperparameters_optimization(self) -> None:
        if self.algo == ALGORITHM:
            exp_manager.HYPERPARAMS_SAMPLER[ALGORITHM] = partial(sample_causalgdp_params, hyperparams=self._hyperparams)
        if self.storage is not None and not self.storage.endswith(".log"):
            open_database(self.storage)
        try:
            super().hyperparameters_optimization()
        except ValueError as error:
            if "No trials are completed" not in str(error):
                raise
            raise SetupError("no trial was completed, all were pruned or stopped: there is no best one to report") from error

    def objective(self, trial: optuna.Trial) -> float:
        try:
            return super().objective(trial)
        except th.linalg.LinAlgError as error:
            # RL Zoo prunes on AssertionError and ValueError alone; this RuntimeError is what NaN does to a linear solver
            raise optuna.exceptions.TrialPruned(str(error)) from error


def open_database(storage: str, n_attempts: int = 10, pause: float = 1.0) -> None:
    """
    Open a database of Optuna's, for the first time perhaps: processes that create its tables at once disturb each other.

    :param storage: Its URL
    :param n_attempts: How often to try
    :param pause: Seconds between attempts
    :raises SetupError: If it is no URL
    """
    from sqlalchemy.exc import ArgumentError, IntegrityError, OperationalError

    for attempt in range(1, n_attempts + 1):
        try:
            optuna.storages.get_storage(storage)
            return
        except (IntegrityError, OperationalError):
            if attempt == n_attempts:
                raise
            time.sleep(pause)
        except ArgumentError as error:
            raise SetupError(f"--storage must end in .log or be a database's URL: {error}") from error


def _with_mappings(hyperparams: dict[str, Any]) -> dict[str, Any]:
    """RL Zoo's entries may hold Python code, in the names of its own module."""
    return {
        key: eval(value, vars(exp_manager)) if key.endswith("_kwargs") and isinstance(value, str) else value
        for key, value in hyperparams.items()
    }


def _message(error: Exception) -> str:
    text = " ".join(str(error).split())
    if text and not isinstance(error, KeyError):
        return text
    where = traceback.extract_tb(error.__traceback__)[-1]
    text = f"{type(error).__name__} {text or where.line}"
    if isinstance(error, AssertionError) and "gymnasium_robotics" in Path(where.filename).parts:
        # Fetch and Kitchen compare MuJoCo's enums with numpy's integers
        text += ": pip install 'mujoco<3.12'"
    return text
