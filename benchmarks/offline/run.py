"""
The offline study: methods x tasks x seeds on maze2d, one command that goes on where it was left.

    export OMP_NUM_THREADS=1
    python -m benchmarks.offline.run --methods causalgdp no_guidance --tasks maze2d-umaze --seeds 0 1 2 --updates 20000
    python -m benchmarks.offline.run --methods td3_bc iql --peer-python ~/d3rlpy-venv/bin/python
    python -m benchmarks.offline.plot

See docs/benchmarks_offline.md.
"""

import argparse
import json
import subprocess
from dataclasses import replace
from pathlib import Path

from benchmarks.offline.methods import D3RLPY_METHODS, METHODS
from benchmarks.suite.jobs import grid
from benchmarks.suite.run import add_run_options, run_from_options
from sb3_causalgdp.offline.make import MAZE_TASKS

TASKS = ("maze2d-umaze", "maze2d-large", "maze2d-umaze-dense")
RESULTS = Path(__file__).parent / "results"


def make_parser() -> argparse.ArgumentParser:
    """
    :return: The command line's parser
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("--methods", nargs="+", choices=METHODS, default=list(METHODS), metavar="METHOD", help=", ".join(METHODS))
    add("--tasks", nargs="+", choices=MAZE_TASKS, default=list(TASKS), metavar="TASK", help=", ".join(MAZE_TASKS))
    add("--seeds", nargs="+", type=int, default=[0, 1, 2], help="(0 1 2)")
    add("--updates", type=int, default=20_000, help="gradient updates of each run (%(default)s)")
    add("--dataset-steps", type=int, default=1_000_000, help="transitions of each dataset (%(default)s)")
    add("--evaluations", type=int, default=10, help="number of evaluations while training (%(default)s)")
    add("--selection-episodes", type=int, default=20, help="episodes of each of these (%(default)s)")
    add("--episodes", type=int, default=100, help="episodes of the last and of the best checkpoint (%(default)s)")
    add(
        "--overrides", type=json.loads, default={}, metavar="JSON", help="arguments of the algorithms that replace the study's"
    )
    add("--peer-python", metavar="PATH", help="interpreter that has d3rlpy, for td3_bc, iql and cql")
    add_run_options(parser, RESULTS)
    return parser


def main() -> None:
    """Run the command line."""
    parser = make_parser()
    arguments = parser.parse_args()
    names = ("updates", "dataset_steps", "evaluations", "selection_episodes", "episodes")
    for name in names:
        if getattr(arguments, name) < 1:
            parser.error(f"--{name.replace('_', '-')} must be at least 1, got {getattr(arguments, name)}")
    if arguments.evaluations > arguments.updates:
        parser.error(f"--evaluations must be at most --updates, got {arguments.evaluations}")
    options = {**{name: getattr(arguments, name) for name in names}, "overrides": arguments.overrides}
    jobs = grid(arguments.tasks, arguments.methods, arguments.seeds, "benchmarks.offline.study:train", options)
    if arguments.peer_python is not None:
        _check_peer_python(parser, arguments.peer_python)
        jobs = [replace(job, python=arguments.peer_python) if job.method in D3RLPY_METHODS else job for job in jobs]
    run_from_options(jobs, arguments)


def _check_peer_python(parser: argparse.ArgumentParser, path: str) -> None:
    try:
        subprocess.run([path, "-c", "import d3rlpy, sb3_causalgdp"], check=True, capture_output=True, text=True)
    except OSError as error:
        parser.error(f"--peer-python cannot be run: {error}")
    except subprocess.CalledProcessError as error:
        parser.error(f"--peer-python needs d3rlpy and sb3_causalgdp: {error.stderr.strip().splitlines()[-1]}")


if __name__ == "__main__":
    main()
