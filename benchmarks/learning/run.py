"""
Learning curves of CausalGDP beside other algorithms: the same environments, seeds, evaluation and process set-up.

    python benchmarks/learning/run.py --env HalfCheetah-v5 --steps 100000 --algorithms causalgdp sac tqc --seeds 0 1 2
    python benchmarks/learning/run.py --env Hopper-v5 --name wide --kwargs '{"policy_kwargs": {"net_arch": [512, 512]}}'
    python benchmarks/learning/run.py --queue benchmarks/learning/queue.txt

CausalGDP runs with its defaults, the others with RL Zoo's settings. Each run is a process of its own with one torch thread.
Its CSV in ``benchmarks/learning/results/`` grows with each evaluation. A run that was interrupted goes on from its newest
checkpoint in ``benchmarks/learning/checkpoints/``; one that is complete is not run again, unless it is asked for with more
steps. A queue is a file with the arguments of one call in each line; it is read anew after each run, and several processes can
work on it.
``summary.py`` draws the results and prints their statistics.
"""

import argparse
import csv
import fcntl
import json
import os
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from contestants import NAMES, class_of, make_model

COLUMNS = ("timesteps", "mean_return", "std_return", "wall_seconds", "cpu_seconds")
HERE = Path(__file__).parent
RESULTS, CHECKPOINTS = HERE / "results", HERE / "checkpoints"
CHECKPOINT_EVERY = 10_000


class Run(NamedTuple):
    """One seed of one setting."""

    env: str
    algorithm: str
    name: str
    seed: int
    steps: int
    eval_freq: int
    episodes: int
    kwargs: dict[str, Any]
    folder: Path
    checkpoints: Path
    env_kwargs: dict[str, Any]

    @property
    def title(self) -> str:
        # An id may name a module and a namespace, which are no part of a file's name
        return f"{self.env.rpartition('/')[2]}_{self.name}_{self.seed}"

    @property
    def result(self) -> Path:
        return self.folder / f"{self.title}.csv"

    def is_complete(self) -> bool:
        return self.result.exists() and last_timestep(self.result) >= self.steps


def last_timestep(path: Path) -> float:
    """Of the last evaluation in a CSV file."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return float(lines[-1].split(",")[0]) if len(lines) > 1 else 0.0


class Clock:
    """Of this process: no part of a checkpoint."""

    def __init__(self) -> None:
        self.before = (time.perf_counter(), time.process_time())

    def elapsed(self) -> tuple[float, float]:
        """Wall-clock and CPU seconds since the last time."""
        before, self.before = self.before, (time.perf_counter(), time.process_time())
        return self.before[0] - before[0], self.before[1] - before[1]


# One run ------------------------------------------------------------------------------------------------------------------


def train(run: Run) -> None:
    """Train one seed, from its newest checkpoint if there is one, and write its evaluations."""
    import torch as th
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    from sb3_causalgdp import TrainingCheckpointCallback
    from sb3_causalgdp.checkpoints import resume
    from sb3_causalgdp.files import replaced_when_done

    th.set_num_threads(1)

    class Evaluate(BaseCallback):
        """What it counts is part of the checkpoints."""

        def __init__(self) -> None:
            super().__init__()
            # Episodes are evaluated side by side, one for each environment
            self.env = make_vec_env(run.env, n_envs=run.episodes, env_kwargs=run.env_kwargs)
            self.rows: list[tuple[float, ...]] = []
            self.spent = (0.0, 0.0)
            self._clock = Clock()

        def _on_rollout_start(self) -> None:
            wall, cpu = self._clock.elapsed()
            self.spent = (self.spent[0] + wall, self.spent[1] + cpu)

        def _on_step(self) -> bool:
            if self.num_timesteps % run.eval_freq == 0:
                self._on_rollout_start()
                self._evaluate()
                # Evaluations do not count
                self._clock.elapsed()
            return True

        def _evaluate(self) -> None:
            state = th.get_rng_state()
            self.env.seed(10_000 + run.seed)
            mean, std = evaluate_policy(self.model, self.env, n_eval_episodes=run.episodes, warn=False)
            th.set_rng_state(state)
            values: tuple[Any, ...] = (self.num_timesteps, mean, std, *self.spent)
            self.rows = [*self.rows, tuple(round(float(value), 3) for value in values)]
            with replaced_when_done(run.result) as file, file.open("w", newline="") as stream:
                writer = csv.writer(stream, lineterminator="\n")
                writer.writerows([COLUMNS, *self.rows])
            print(time.strftime("%H:%M"), run.title, *self.rows[-1], flush=True)

    checkpoints = run.checkpoints / run.title
    training_env = make_vec_env(run.env, seed=run.seed, env_kwargs=run.env_kwargs)
    try:
        model = resume(class_of(run.algorithm), checkpoints, training_env, "cpu")
        print(f"{run.title} goes on after {model.num_timesteps} steps", flush=True)
    except FileNotFoundError:
        model = make_model(run.algorithm, training_env, run.seed, device="cpu", **run.kwargs)
    saving = TrainingCheckpointCallback(checkpoints, every=CHECKPOINT_EVERY, keep=1)
    model.learn(max(0, run.steps - model.num_timesteps), [Evaluate(), saving], reset_num_timesteps=False)


# All runs -----------------------------------------------------------------------------------------------------------------


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--algorithms", nargs="+", choices=NAMES, default=["causalgdp"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--eval-freq", type=int, default=5_000)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=RESULTS)
    parser.add_argument("--checkpoints", type=Path, default=CHECKPOINTS)
    parser.add_argument("--kwargs", type=json.loads, default={}, help="arguments of the algorithm, as JSON")
    parser.add_argument("--env-kwargs", type=json.loads, default={}, help="arguments of the environment, as JSON")
    parser.add_argument("--name", help="name of this variant in the results, the algorithm's own by default")
    parser.add_argument("--queue", type=Path, help="file with the arguments of one call in each line")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    return parser


def runs_of(arguments: argparse.Namespace) -> Iterator[Run]:
    for seed in arguments.seeds:
        for algorithm in arguments.algorithms:
            yield Run(
                arguments.env,
                algorithm,
                arguments.name or algorithm,
                seed,
                arguments.steps,
                arguments.eval_freq,
                arguments.episodes,
                arguments.kwargs,
                arguments.folder,
                arguments.checkpoints,
                arguments.env_kwargs,
            )


def runs_of_queue(arguments: argparse.Namespace) -> Iterator[Run]:
    parser = make_parser()
    parser.set_defaults(folder=arguments.folder, checkpoints=arguments.checkpoints)
    for line in arguments.queue.read_text(encoding="utf-8").splitlines():
        words = shlex.split(line, comments=True)
        if words:
            yield from runs_of(parser.parse_args(words))


def launch(run: Run) -> bool:
    """Run it in a process of its own, unless it is complete or somebody else is at it; whether it was run."""
    if run.is_complete():
        return False
    run.checkpoints.mkdir(parents=True, exist_ok=True)
    with open(run.checkpoints / f"{run.title}.lock", "w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        command = [sys.executable, __file__, "--one", "--env", run.env, "--steps", str(run.steps), "--name", run.name]
        command += ["--algorithms", run.algorithm, "--seeds", str(run.seed), "--eval-freq", str(run.eval_freq)]
        command += ["--episodes", str(run.episodes), "--folder", str(run.folder), "--checkpoints", str(run.checkpoints)]
        command += ["--kwargs", json.dumps(run.kwargs), "--env-kwargs", json.dumps(run.env_kwargs)]
        subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})
    return True


def work_on(arguments: argparse.Namespace) -> None:
    """Until all runs of the queue are complete or failed."""
    failed: set[str] = set()
    while True:
        for run in runs_of_queue(arguments):
            if run.title in failed:
                continue
            try:
                if launch(run):
                    break
            except subprocess.CalledProcessError as error:
                failed.add(run.title)
                print(f"{run.title} failed: {error}", file=sys.stderr, flush=True)
        else:
            return


def main() -> None:
    arguments = make_parser().parse_args()
    if arguments.one:
        train(next(runs_of(arguments)))
    elif arguments.queue:
        work_on(arguments)
    else:
        with ThreadPoolExecutor(arguments.workers) as pool:
            for future in [pool.submit(launch, run) for run in runs_of(arguments)]:
                future.result()


if __name__ == "__main__":
    main()
