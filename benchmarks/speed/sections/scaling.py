"""Cost of an update, and of a prediction, against the sizes: one of them moves, the others stay at HalfCheetah's."""

from typing import Any

import numpy as np

from benchmarks.speed import contestants, plots
from benchmarks.speed.benchmark import Benchmark
from benchmarks.speed.client import Contestant, Field
from benchmarks.speed.contestants import DIFFUSION_QL, SAC

BASE = {"n": 17, "d": 6, "K": 5, "batch": 256, "candidates": 10, "observations": 1}
POINTS = {
    "n": (4, 17, 64, 128, 348),
    "d": (1, 6, 17, 40),
    "K": (1, 2, 5, 10, 20),
    "batch": (64, 256, 1024),
    "candidates": (1, 10, 50),
    "observations": (1, 4, 16, 64),
}
OF_PREDICTIONS = ("candidates", "observations")
# Which sizes a peer has at all
HAS = {SAC: ("n", "d", "batch", "observations"), DIFFUSION_QL: ("n", "d", "K", "batch")}
UPDATES, CALLS = 5, 50
COLUMNS = ("axis", "value", "contestant", "ms", "status")


def run(benchmark: Benchmark) -> None:
    """
    :param benchmark: What is shared
    """
    results = benchmark.results("scaling")
    ours = contestants.main_settings()
    who = [*ours, contestants.sb3("SAC"), *benchmark.diffusion_ql()]
    # Set up once at the base, so that who is not available is known
    transitions = benchmark.synthetic(BASE["n"], BASE["d"])
    with benchmark.field(who, transitions=transitions) as field:
        for axis, values in POINTS.items():
            for value in values:
                for name, seconds in _point(benchmark, field, {**BASE, axis: value}, axis).items():
                    row = {"axis": axis, "value": value, "contestant": name, "status": "ok", "ms": 1e3 * seconds}
                    results.rows.append(row)
                    print(row, flush=True)
        results.rows += [{"contestant": name, **absence} for name, absence in field.absent.items()]
    results.write(COLUMNS)
    plots.scaling(results, tuple(POINTS), OF_PREDICTIONS)


def _point(benchmark: Benchmark, field: Field, sizes: dict[str, int], axis: str) -> dict[str, float]:
    """Median CPU seconds of an update or a prediction of those who have this size."""
    transitions = benchmark.synthetic(sizes["n"], sizes["d"])
    taken: dict[str, list[float]] = {}
    here = {name: worker for name, worker in field.workers.items() if axis in HAS.get(name, POINTS)}
    for worker in here.values():
        worker.setup(transitions=transitions, **_config(worker.contestant, sizes))
    for round_ in range(1 + benchmark.args.scaling_rounds):
        for name, worker in here.items():
            if axis in OF_PREDICTIONS:
                seconds = worker.ask("predict", n=CALLS, n_observations=sizes["observations"])["cpu"] / CALLS
            else:
                seconds = worker.ask("update", n=UPDATES)["cpu"] / UPDATES
            if round_ > 0:
                taken.setdefault(name, []).append(seconds)
    return {name: float(np.median(values)) for name, values in taken.items()}


def _config(contestant: Contestant, sizes: dict[str, int]) -> dict[str, Any]:
    config: dict[str, Any] = {"batch_size": sizes["batch"]}
    if contestant.module == "causalgdp":
        more = {"diffusion_steps": sizes["K"], "n_action_candidates": sizes["candidates"]}
        config["kwargs"] = {**contestant.config["kwargs"], **more}
    elif contestant.module == "diffusion_ql":
        config["diffusion_steps"] = sizes["K"]
    return config
