"""
Offline to online: pretrain on a dataset, then go on in the environment; one curve across both stages.

    export OMP_NUM_THREADS=1
    python -m sb3_causalgdp.datasets make hopper-medium-replay
    python -m benchmarks.offline.online --tasks maze2d-umaze hopper-medium-replay --methods causalgdp layer_norm --workers 2
    python -m benchmarks.offline.online --plot

See docs/benchmarks_offline.md.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd
import torch as th
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

import sb3_causalgdp.offline  # noqa: F401 (registers the environments)
from benchmarks.offline.data import ensure_dataset, environment_id
from benchmarks.offline.methods import CAUSALGDP_METHODS, study_arguments
from benchmarks.offline.plot import LABELS
from benchmarks.suite.jobs import grid
from benchmarks.suite.run import add_run_options, run_from_options
from sb3_causalgdp import CausalGDP
from sb3_causalgdp.causal.plots.figures import save_figure
from sb3_causalgdp.offline.make import MAZE_TASKS
from sb3_causalgdp.offline.mujoco_tasks import MUJOCO_TASKS
from sb3_causalgdp.offline.scores import normalized_score

RESULTS = Path(__file__).parent / "results_online"
TASKS = (*MAZE_TASKS, *(f"{name}-{kind}" for name in MUJOCO_TASKS for kind in ("medium", "medium-replay")))
EVALUATION_SEED = 10_000


def fine_tune(
    task: str,
    method: str,
    seed: int,
    scratch: Path,
    updates: int = 10_000,
    steps: int = 10_000,
    evaluations: int = 5,
    episodes: int = 20,
    dataset_steps: int = 1_000_000,
    overrides: dict[str, Any] | None = None,
) -> list[dict[str, Any]]:
    """
    Pretrain and fine-tune one model; at first batches are all offline data, in the end half of them.

    :param task: One of ``TASKS``; datasets of MuJoCo tasks have to be there
    :param method: One of ``CAUSALGDP_METHODS``
    :param seed: Seed
    :param scratch: Folder of the model's zip
    :param updates: Gradient updates of the offline stage
    :param steps: Environment steps of the online stage, with one update each
    :param evaluations: Number of evaluations in each stage
    :param episodes: Episodes of an evaluation
    :param dataset_steps: Transitions of a maze's dataset
    :param overrides: Arguments of CausalGDP that replace the study's
    :return: Rows of the results table
    """
    th.set_num_threads(1)
    is_maze = task in MAZE_TASKS
    dataset_id = ensure_dataset(task, dataset_steps) if is_maze else f"sb3_causalgdp/{task}-v0"
    arguments = {
        **study_arguments(task),
        **CAUSALGDP_METHODS[method],
        "learning_starts": 0,
        "offline_fraction": from_all_to_half,
    }
    arguments.update(overrides or {})
    model = CausalGDP("MlpPolicy", _make(task), seed=seed, device="cpu", **arguments)
    model.preload(dataset_id)
    evaluate = _Evaluate(task, episodes)
    for stage, total, train in (("offline", updates, model.pretrain), ("online", steps, model.learn)):
        counts = np.linspace(0, total, evaluations + 1).astype(int).tolist()[1:]
        train(total, callback=evaluate.at(stage, counts))
    model.save(scratch / "model")
    return evaluate.rows


def from_all_to_half(progress_remaining: float) -> float:
    """
    Share of offline data: with a half from the start, a few hundred transitions are half of what the critics see.

    :param progress_remaining: From 1 to 0
    :return: From 1 to 0.5
    """
    return 0.5 + 0.5 * progress_remaining


class _Evaluate(BaseCallback):
    """Scores after given numbers of gradient updates or environment steps."""

    def __init__(self, task: str, episodes: int) -> None:
        super().__init__()
        self.task = task
        self.episodes = episodes
        self.envs = DummyVecEnv([lambda: _make(task)] * min(episodes, 10))
        self.rows: list[dict[str, Any]] = []
        self.start = time.process_time()

    def at(self, stage: str, counts: list[int]) -> "_Evaluate":
        self.stage, self.counts = stage, counts
        return self

    def _on_step(self) -> bool:
        if self.num_timesteps in self.counts:
            state = th.get_rng_state()
            self.envs.seed(EVALUATION_SEED)
            returns, _ = evaluate_policy(self.model, self.envs, self.episodes, return_episode_rewards=True)
            th.set_rng_state(state)
            scores = normalized_score(self.task, returns).values
            row = {
                "stage": self.stage,
                "count": self.num_timesteps,
                "score": round(scores.mean(), 2),
                "std": round(scores.std(), 2),
            }
            self.rows.append({**row, "episodes": len(scores), "cpu_seconds": round(time.process_time() - self.start, 1)})
            print(json.dumps(self.rows[-1]), flush=True)
        return True


def _make(task: str) -> gym.Env[Any, Any]:
    if task in MAZE_TASKS:
        return Monitor(gym.make(environment_id(task), disable_env_checker=True))
    return MUJOCO_TASKS[task.partition("-")[0]].make()


def draw(table: pd.DataFrame, path: Path) -> None:
    """
    Scores over both stages, seeds thin, their mean thick; a line where the online stage begins.

    :param table: Table of the results
    :param path: The picture
    """
    tasks = sorted(set(table["task"]))
    figure = Figure(figsize=(1.0 + 4.5 * len(tasks), 3.8), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, task in zip(figure.subplots(1, len(tasks), squeeze=False)[0], tasks, strict=True):
        rows = table[table["task"] == task]
        length = rows[rows["stage"] == "offline"]["count"].max()
        rows = rows.assign(x=rows["count"] + length * (rows["stage"] == "online"))
        for colour, (method, runs) in zip(("C0", "C1", "C2"), rows.groupby("method"), strict=False):
            curves = runs.pivot(index="x", columns="seed", values="score")
            axes.plot(curves.index, curves, color=colour, alpha=0.35, linewidth=0.9)
            style = {"linewidth": 2, "marker": "o", "markersize": 3, "label": LABELS[method]}
            axes.plot(curves.index, curves.mean(axis=1), color=colour, **style)
        axes.axvline(length, color="black", linestyle="--", linewidth=1)
        axes.set(title=task, xlabel="gradient updates, then environment steps", ylabel="D4RL's normalised score")
        axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))  # a tenth of a point is no fall
        axes.grid(alpha=0.3)
        axes.legend(frameon=False)
    save_figure(figure, path)


def hand_over(table: pd.DataFrame) -> str:
    """
    :param table: Table of the results
    :return: In Markdown, for each run: the last offline score with the spread of its episodes, the first and last online one
    """
    lines = ["| task | method | seed | last offline | first online | last online |", "|---|---|---|---|---|---|"]
    for (task, method, seed), run in table.groupby(["task", "method", "seed"]):
        offline, online = (run[run["stage"] == stage].sort_values("count") for stage in ("offline", "online"))
        scores = (offline.iloc[-1], online.iloc[0], online.iloc[-1])
        cells = (f"{one['score']:.1f} +- {one['std']:.1f}" for one in scores)
        lines.append(f"| {task} | {method} | {seed} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--tasks", nargs="+", choices=TASKS, default=["maze2d-umaze", "hopper-medium-replay"], metavar="TASK")
    add("--methods", nargs="+", choices=list(CAUSALGDP_METHODS), default=["causalgdp"], metavar="METHOD")
    add("--seeds", nargs="+", type=int, default=[0, 1, 2], help="(0 1 2)")
    add("--updates", type=int, default=10_000, help="gradient updates of the offline stage (%(default)s)")
    add("--steps", type=int, default=10_000, help="environment steps of the online stage (%(default)s)")
    add("--evaluations", type=int, default=5, help="in each stage (%(default)s)")
    add("--episodes", type=int, default=20, help="of an evaluation (%(default)s)")
    add("--dataset-steps", type=int, default=1_000_000, help="transitions of a maze's dataset (%(default)s)")
    add("--overrides", type=json.loads, default={}, metavar="JSON", help="arguments of CausalGDP")
    add("--plot", action="store_true", help="draw what is there, run nothing")
    add_run_options(parser, RESULTS)
    arguments = parser.parse_args()
    if not arguments.plot:
        names = ("updates", "steps", "evaluations", "episodes", "dataset_steps", "overrides")
        options = {name: getattr(arguments, name) for name in names}
        run_from_options(
            grid(arguments.tasks, arguments.methods, arguments.seeds, "benchmarks.offline.online:fine_tune", options),
            arguments,
        )
    table = pd.read_csv(arguments.folder / "results.csv")
    draw(table, arguments.folder / "offline_to_online.png")
    print(hand_over(table))


if __name__ == "__main__":
    main()
