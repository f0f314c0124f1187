"""One run of the study: train on a dataset, evaluate now and then, and in the end the last and the best checkpoint."""

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

import sb3_causalgdp.offline  # noqa: F401 (registers the environments)
from benchmarks.offline.data import ensure_dataset, environment_id
from benchmarks.offline.methods import Learner, Player, make_learner
from benchmarks.suite.jobs import write_atomically
from sb3_causalgdp.offline.scores import normalized_score

# Episode i starts from the seed SELECTION_SEED + i while training and from TEST_SEED + i in the end, for all methods and seeds
SELECTION_SEED = 10_000
TEST_SEED = 20_000


def returns_of(predict: Callable[[np.ndarray], np.ndarray], envs: VecEnv, seed: int) -> np.ndarray:
    """
    :param predict: Actions for a batch of observations
    :param envs: An environment for each episode
    :param seed: Seed of the first episode's start; the others have the next ones
    :return: Undiscounted return of each episode
    """
    envs.seed(seed)
    observations = envs.reset()
    returns, running = np.zeros(envs.num_envs), np.ones(envs.num_envs, dtype=bool)
    while running.any():
        observations, rewards, dones, _ = envs.step(predict(observations))  # type: ignore[arg-type]
        returns += rewards * running
        running &= ~dones
    return returns


class Evaluation:
    """
    Episodes that run side by side, one environment each, so that a policy is asked once for all of them.

    :param task: Name of the task
    :param episodes: Number of episodes
    :param seed: Seed of the first episode's start; the others have the next ones
    """

    def __init__(self, task: str, episodes: int, seed: int) -> None:
        self.task = task
        self.seed = seed
        self.envs = DummyVecEnv([lambda: gym.make(environment_id(task), disable_env_checker=True)] * episodes)

    def returns(self, learner: Player) -> np.ndarray:
        """
        :param learner: A trained method
        :return: Undiscounted return of each episode
        """
        return returns_of(learner.predict, self.envs, self.seed)

    def row(self, learner: Learner, checkpoint: str, n_updates: int, seconds: float) -> dict[str, Any]:
        """
        :param learner: A trained method
        :param checkpoint: ``"training"``, ``"last"`` or ``"best"``
        :param n_updates: After how many updates
        :param seconds: CPU time of these updates
        :return: Row of the results table
        """
        returns = self.returns(learner)
        return {
            "checkpoint": checkpoint,
            "updates": n_updates,
            "score": round(normalized_score(self.task, returns).mean, 2),
            "mean_return": round(float(returns.mean()), 3),
            "std_return": round(float(returns.std()), 3),
            "episodes": len(returns),
            "train_cpu_seconds": round(seconds, 1),
        }


def train(
    task: str,
    method: str,
    seed: int,
    scratch: Path,
    updates: int = 20_000,
    dataset_steps: int = 1_000_000,
    evaluations: int = 10,
    selection_episodes: int = 20,
    episodes: int = 100,
    overrides: dict[str, Any] | None = None,
) -> list[dict[str, Any]]:
    """
    Train and evaluate; a run that was interrupted goes on from its last evaluation.

    The best checkpoint is chosen by the evaluations while training, and reported from other episodes.

    :param task: Name of the task
    :param method: Name of the method
    :param seed: Seed of the method; the dataset is the same for all
    :param scratch: Folder of the checkpoints
    :param updates: Number of gradient updates
    :param dataset_steps: Number of transitions in the dataset
    :param evaluations: Number of evaluations while training
    :param selection_episodes: Episodes of each of these
    :param episodes: Episodes of the last and of the best checkpoint
    :param overrides: Arguments of the algorithm that replace the study's
    :return: Rows of the results table
    """
    th.set_num_threads(1)
    learner = make_learner(method, task, seed, ensure_dataset(task, dataset_steps), overrides)
    rows = _restore(learner, scratch)
    selection = Evaluation(task, selection_episodes, SELECTION_SEED)
    for n_updates in np.linspace(0, updates, evaluations + 1).astype(int).tolist()[1:]:
        done, seconds = (rows[-1]["updates"], rows[-1]["train_cpu_seconds"]) if rows else (0, 0.0)
        if n_updates <= done:
            continue
        start = time.process_time()
        learner.train(n_updates - done)
        seconds += time.process_time() - start
        rows.append(selection.row(learner, "training", n_updates, seconds))
        print(json.dumps(rows[-1]), flush=True)
        _keep(learner, scratch, rows)
    test, last, best = Evaluation(task, episodes, TEST_SEED), rows[-1], _best(rows)
    reported = [test.row(learner, "last", last["updates"], last["train_cpu_seconds"])]
    if best is last:
        reported.append({**reported[0], "checkpoint": "best"})
    else:
        learner.load(_checkpoint(scratch, best), best["updates"])
        reported.append(test.row(learner, "best", best["updates"], best["train_cpu_seconds"]))
    return rows + reported


def _best(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Of equal ones the last."""
    return max(reversed(rows), key=lambda row: row["score"])


def _checkpoint(scratch: Path, row: dict[str, Any]) -> Path:
    return scratch / f"checkpoint-{row['updates']}"


def _keep(learner: Learner, scratch: Path, rows: list[dict[str, Any]]) -> None:
    """Save the last checkpoint, beside the best one and the rows up to here."""
    learner.save(_checkpoint(scratch, rows[-1]))
    write_atomically(scratch / "rows.json", json.dumps(rows))
    needed = {_checkpoint(scratch, row) for row in (rows[-1], _best(rows))}
    for path in set(scratch.glob("checkpoint-*")) - needed:
        path.unlink()


def _restore(learner: Learner, scratch: Path) -> list[dict[str, Any]]:
    path = scratch / "rows.json"
    if not path.exists():
        return []
    rows = json.loads(path.read_text())
    learner.load(_checkpoint(scratch, rows[-1]), rows[-1]["updates"])
    return rows
