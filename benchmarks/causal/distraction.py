"""
Learning under distraction: returns with more and more observations that do not matter, and actions without effect.

    python benchmarks/causal/distraction.py --noises 0 20 100 300 --algorithms causalgdp causalgdp_sees_all sac tqc
    python benchmarks/causal/distraction.py --idle-actions 0 6 20 --steps 50000
    python benchmarks/causal/distraction.py --noises 100 --algorithms causalgdp causalgdp_{true,open,perturbed}
    python benchmarks/causal/distraction.py --noises 100 --name patient --kwargs '{"causal_abstraction": {"patience": 5}}'
    python benchmarks/causal/distraction.py --noises 20 100 --print-queue > queue.txt

Each run is one of ``benchmarks/learning/run.py``, on ``Distracted/<task>`` of ``sb3_causalgdp.stress``: a process of its own,
a CSV that grows with each evaluation in ``benchmarks/causal/results/``, and checkpoints from which it goes on.
``--print-queue`` writes the lines for that file's ``--queue``, on which several processes can work. Where several numbers of
noises and of idle actions are given, all pairs are run. ``--env-kwargs`` gives more arguments of ``make_stressed``, such as
``{"other": "Pendulum-v1", "copies": 7}``.
"""

import argparse
import json
import shlex
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "learning"))

from run import NAMES, Run, launch  # type: ignore[attr-defined]

HERE = Path(__file__).parent


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--env", default="HalfCheetah-v5", help="the task inside, one of sb3_causalgdp.stress.registration.BASES"
    )
    parser.add_argument("--noises", nargs="+", type=int, default=[0])
    parser.add_argument("--idle-actions", nargs="+", type=int, default=[0])
    parser.add_argument("--env-kwargs", type=json.loads, default={}, help="more arguments of make_stressed, as JSON")
    parser.add_argument("--steps", type=int, default=50_000)
    parser.add_argument("--algorithms", nargs="+", choices=NAMES, default=["causalgdp"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--eval-freq", type=int, default=5_000)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=HERE / "results")
    parser.add_argument("--checkpoints", type=Path, default=HERE / "checkpoints")
    parser.add_argument("--kwargs", type=json.loads, default={}, help="arguments of the algorithm, as JSON")
    parser.add_argument("--name", help="name of this variant in the results, the algorithm's own by default")
    parser.add_argument("--print-queue", action="store_true", help="print the lines of a queue, and run nothing")
    return parser


def runs_of(arguments: argparse.Namespace) -> Iterator[Run]:
    """Seeds change last: what is stopped early has all settings of the first seeds."""
    for seed in arguments.seeds:
        for noises in arguments.noises:
            for idle in arguments.idle_actions:
                for algorithm in arguments.algorithms:
                    yield Run(
                        env=f"sb3_causalgdp.stress:Distracted/{arguments.env}",
                        algorithm=algorithm,
                        name=f"{arguments.name or algorithm}_m{noises}_k{idle}",
                        seed=seed,
                        steps=arguments.steps,
                        eval_freq=arguments.eval_freq,
                        episodes=arguments.episodes,
                        kwargs=arguments.kwargs,
                        folder=arguments.folder,
                        checkpoints=arguments.checkpoints,
                        env_kwargs={**arguments.env_kwargs, "noises": noises, "idle_actions": idle},
                    )


def line_of(run: Run) -> str:
    """The arguments of ``benchmarks/learning/run.py`` for one run."""
    words = ["--env", run.env, "--algorithms", run.algorithm, "--name", run.name, "--seeds", run.seed, "--steps", run.steps]
    words += ["--eval-freq", run.eval_freq, "--episodes", run.episodes, "--folder", run.folder]
    words += ["--checkpoints", run.checkpoints, "--kwargs", json.dumps(run.kwargs)]
    return shlex.join(map(str, [*words, "--env-kwargs", json.dumps(run.env_kwargs)]))


def main() -> None:
    arguments = make_parser().parse_args()
    runs = list(runs_of(arguments))
    if arguments.print_queue:
        print("\n".join(map(line_of, runs)))
        return
    with ThreadPoolExecutor(arguments.workers) as pool:
        for future in [pool.submit(launch, run) for run in runs]:
            future.result()


if __name__ == "__main__":
    main()
