"""
Run a benchmark: every task with every method and every seed, where it was left.

    python -m benchmarks.suite.run --function package.module:function --tasks a b --methods x y --seeds 0 1 2 --folder results
    python -m benchmarks.suite.run ... --workers 4
    python -m benchmarks.suite.run ... --address auto

See benchmarks/suite/README.md.
"""

import argparse
import json
import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from benchmarks.suite.jobs import Job, LocalExecutor, grid, run_jobs


def add_run_options(parser: argparse.ArgumentParser, folder: Path | None = None) -> None:
    """
    Add the options that say where jobs run.

    :param parser: The command line's parser
    :param folder: Default folder of the benchmark, None if it has to be given
    """
    add = parser.add_argument_group("where jobs run").add_argument
    add("--folder", type=Path, default=folder, required=folder is None, help="results, logs and checkpoints (%(default)s)")
    add("--workers", type=_positive, default=os.cpu_count() or 1, metavar="N", help="processes on this machine (%(default)s)")
    add("--address", help="run on this Ray cluster instead, 'auto' for the one that this machine belongs to")
    add("--retries", type=int, default=1, metavar="N", help="how often a failed job is run again (%(default)s)")


def run_from_options(jobs: Sequence[Job], arguments: argparse.Namespace) -> None:
    """
    Run jobs where the options say; the exit status is 1 if one failed, 130 if it was interrupted.

    :param jobs: The jobs
    :param arguments: What a parser with :func:`add_run_options` made
    """
    folder = arguments.folder.resolve()
    # Without this, a terminated process would not end its jobs
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    try:
        if arguments.address is None:
            with LocalExecutor(folder, arguments.workers) as executor:
                failed = run_jobs(jobs, folder, executor, arguments.retries, _report)
        else:
            from benchmarks.suite.cluster import RayExecutor

            with RayExecutor(folder, arguments.address) as cluster:
                failed = run_jobs(jobs, folder, cluster, arguments.retries, _report)
    except (ValueError, ImportError, ConnectionError) as error:
        raise SystemExit(f"error: {error}") from error
    except KeyboardInterrupt:
        print("interrupted: the same command goes on from here", file=sys.stderr)
        raise SystemExit(130) from None
    if failed:
        raise SystemExit(
            f"{len(failed)} jobs failed: {', '.join(job.name for job in failed)}. The same command runs them again"
        )


def _report(line: str) -> None:
    print(line, flush=True)


def _positive(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be an integer of at least 1, got {text!r}")
    return int(text)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--function", required=True, help="what a job calls, package.module:function")
    parser.add_argument("--tasks", nargs="+", required=True)
    parser.add_argument("--methods", nargs="+", required=True)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--options", type=json.loads, default={}, metavar="JSON", help="arguments of the function")
    add_run_options(parser)
    arguments = parser.parse_args()
    try:
        jobs = grid(arguments.tasks, arguments.methods, arguments.seeds, arguments.function, arguments.options)
    except ValueError as error:
        parser.error(str(error))
    run_from_options(jobs, arguments)


if __name__ == "__main__":
    main()
