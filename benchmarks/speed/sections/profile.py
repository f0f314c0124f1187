"""Where the time of an update goes, by part and by function."""

from typing import Any

import numpy as np

from benchmarks.speed import contestants, plots
from benchmarks.speed.benchmark import HALF_CHEETAH, Benchmark
from benchmarks.speed.results import markdown
from benchmarks.speed.workers.call_timer import OTHER, PARTS

FUNCTIONS = 25
FUNCTION_COLUMNS = ("function", "calls", "ms without calls", "ms with calls")


def run(benchmark: Benchmark) -> None:
    """
    :param benchmark: What is shared
    """
    results = benchmark.results("profile")
    who = contestants.main_settings()
    names = [part.name for part in PARTS] + [OTHER]
    with benchmark.field(who, transitions=benchmark.transitions(HALF_CHEETAH)) as field:
        turns = field.interleaved(benchmark.rounds, lambda worker: worker.ask("profile", n=benchmark.updates)["value"])
        for one in who:
            if one.name not in turns:
                results.rows.append({"contestant": one.name, **field.absent[one.name]})
                continue
            row: dict[str, Any] = {"contestant": one.name, "status": "ok"}
            for column in ("plain", "wrapped"):
                row[f"ms, {column}"] = 1e3 * float(np.median([turn[column] for turn in turns[one.name]]))
            for part in names:
                row[part] = 1e3 * float(np.median([turn["parts"].get(part, 0.0) for turn in turns[one.name]]))
            results.rows.append(row)
            results.about[one.name] = _functions(turns[one.name][-1]["functions"])
            print(f"\n{one.name}: functions of one update\n{markdown(results.about[one.name], FUNCTION_COLUMNS)}", flush=True)
    results.write(("contestant", "ms, plain", "ms, wrapped", *names, "status"))
    plots.parts(results, names)


def _functions(taken: dict[str, dict[str, float]]) -> list[dict[str, Any]]:
    """Those that take longest by themselves."""
    order = sorted(taken.items(), key=lambda item: -item[1]["exclusive"])[:FUNCTIONS]
    return [
        {
            "function": name,
            "calls": one["calls"],
            "ms without calls": 1e3 * one["exclusive"],
            "ms with calls": 1e3 * one["inclusive"],
        }
        for name, one in order
    ]
