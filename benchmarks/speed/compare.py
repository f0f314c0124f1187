"""
How fast CausalGDP is beside its peers, on one CPU thread.

    python -m benchmarks.speed.compare --diffusion-ql-path /tmp/diffusion-ql --python-sbx /tmp/sbx/bin/python

Sections: ``update``, ``predict``, ``env_steps``, ``floor``, ``profile``, ``scaling``, ``refresh``. Each one writes
``<section>.json``, ``<section>.md`` and maybe ``<section>.png`` into ``--folder``, and ``summary.md`` has the targets of all.
Every contestant is a process of its own with one thread; they take turns (A B C A B C ...), CPU seconds are those of the
process, and ratios are medians of the ratios within a round. A peer that is not installed is left out, and the table says so.
"""

import argparse
import importlib
import sys
import tempfile
from pathlib import Path

from benchmarks.speed.benchmark import Benchmark
from benchmarks.speed.results import write_summary

SECTIONS = ("update", "predict", "env_steps", "floor", "profile", "scaling", "refresh")
RESULTS = Path(__file__).parent / "results"


def parse_arguments(arguments: list[str] | None = None) -> argparse.Namespace:
    """
    :param arguments: Of the command line, those of this process if None
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--section", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--folder", type=Path, default=RESULTS)
    parser.add_argument("--python-sbx", default=sys.executable, help="interpreter that has sbx-rl, which needs JAX")
    parser.add_argument("--python-d3rlpy", default=sys.executable, help="interpreter that has d3rlpy")
    parser.add_argument("--diffusion-ql-path", help="checkout of github.com/Zhendong-Wang/Diffusion-Policies-for-Offline-RL")
    parser.add_argument("--causalgdp-authors-path", help="checkout of github.com/xx987/CausalGDP, by the paper's authors")
    parser.add_argument("--rounds", type=int, default=15, help="turns of each contestant; tables have medians")
    parser.add_argument("--updates", type=int, default=20, help="updates of one turn")
    parser.add_argument("--steps", type=int, default=250, help="env_steps, refresh: environment steps of one turn")
    parser.add_argument("--learn-rounds", type=int, default=5, help="env_steps, refresh: turns of each contestant")
    parser.add_argument("--scaling-rounds", type=int, default=3, help="scaling: turns of each contestant at each point")
    parser.add_argument("--no-compile", action="store_true", help="without compile=True, which takes a minute to start")
    return parser.parse_args(arguments)


def main() -> None:
    args = parse_arguments()
    with tempfile.TemporaryDirectory() as scratch:
        benchmark = Benchmark(args, Path(scratch))
        for section in args.section:
            importlib.import_module(f"benchmarks.speed.sections.{section}").run(benchmark)
    write_summary(args.folder)


if __name__ == "__main__":
    main()
