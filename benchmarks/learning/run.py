"""
Learning curves of CausalGDP beside other algorithms: the same environment, seeds, evaluation and process set-up.

    python benchmarks/learning/run.py --env HalfCheetah-v5 --steps 30000 --algorithms causalgdp sac --seeds 0 1 2
    python benchmarks/learning/run.py --env Pendulum-v1 --steps 10000 --algorithms causalgdp --seeds 0 1 2 3 4 --episodes 20

Each run is a process of its own with one torch thread. A run that has its file is not run again, so that an interrupted
benchmark goes on where it was. Results: one CSV per run in ``benchmarks/learning/results/``; ``plot.py`` draws them.
"""

import argparse
import csv
import json
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

COLUMNS = ("timesteps", "mean_return", "std_return", "wall_seconds", "cpu_seconds")
RESULTS = Path(__file__).parent / "results"


def result_path(folder: Path, env_id: str, algorithm: str, seed: int) -> Path:
    return folder / f"{env_id}_{algorithm}_{seed}.csv"


def run_one(args: argparse.Namespace) -> None:
    """Train one seed and write its evaluations."""
    import torch as th
    from sb3_contrib import TQC
    from stable_baselines3 import SAC, TD3
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy

    from sb3_causalgdp import CausalGDP

    th.set_num_threads(1)
    classes = {"causalgdp": CausalGDP, "sac": SAC, "td3": TD3, "tqc": TQC}
    algorithm, seed = args.algorithms[0], args.seeds[0]
    # Episodes are evaluated side by side, one for each environment
    evaluation_env = make_vec_env(args.env, n_envs=args.episodes, seed=10_000 + seed)
    rows: list[dict[str, float]] = []
    start = time.perf_counter()
    cpu_start = time.process_time()

    class Evaluate(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps % args.eval_freq == 0:
                spent = time.perf_counter() - start, time.process_time() - cpu_start
                state = th.get_rng_state()
                evaluation_env.seed(10_000 + seed)
                mean, std = evaluate_policy(self.model, evaluation_env, n_eval_episodes=args.episodes, warn=False)
                th.set_rng_state(state)
                values = (self.num_timesteps, mean, std, *spent)
                rows.append(dict(zip(COLUMNS, values, strict=True)))  # type: ignore[arg-type]
                print(algorithm, seed, {key: round(float(value), 1) for key, value in rows[-1].items()}, flush=True)
            return True

    model = classes[algorithm]("MlpPolicy", args.env, seed=seed, **args.kwargs)
    model.learn(args.steps, callback=Evaluate())
    path = result_path(args.folder, args.env, args.name or algorithm, seed)
    temporary = path.with_suffix(".tmp")
    with temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    os.replace(temporary, path)


def run_all(args: argparse.Namespace) -> None:
    """Run what has no result yet, ``--workers`` processes at a time."""
    args.folder.mkdir(parents=True, exist_ok=True)

    def launch(algorithm: str, seed: int) -> None:
        if result_path(args.folder, args.env, args.name or algorithm, seed).exists():
            return
        command = [sys.executable, __file__, "--one", "--env", args.env, "--steps", str(args.steps)]
        command += ["--algorithms", algorithm, "--seeds", str(seed), "--eval-freq", str(args.eval_freq)]
        command += ["--episodes", str(args.episodes), "--folder", str(args.folder), "--kwargs", json.dumps(args.kwargs)]
        command += ["--name", args.name] if args.name else []
        subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"})

    with ThreadPoolExecutor(args.workers) as pool:
        for future in [pool.submit(launch, name, seed) for seed in args.seeds for name in args.algorithms]:
            future.result()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--steps", type=int, default=30_000)
    parser.add_argument("--algorithms", nargs="+", default=["causalgdp", "sac"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--eval-freq", type=int, default=2_500)
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path, default=RESULTS)
    parser.add_argument("--kwargs", type=json.loads, default={}, help="arguments of the algorithm, as JSON")
    parser.add_argument("--name", help="name of this variant in the results, the algorithm's own by default")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    run_one(args) if args.one else run_all(args)


if __name__ == "__main__":
    main()
