"""CPU milliseconds of one update, CausalGDP's settings beside the peers."""

from typing import Any

from benchmarks.speed import contestants, plots
from benchmarks.speed.benchmark import HALF_CHEETAH, HUMANOID, Benchmark
from benchmarks.speed.client import Contestant, Field, median_ratio
from benchmarks.speed.contestants import CHAIN, DEFAULT, DIFFUSION_QL, ONE_STEP, SAC, compiled
from benchmarks.speed.results import Results, Verdict

COLUMNS = ("task", "contestant", "ms", "spread", "vs Diffusion-QL", "vs SB3 SAC", "MFLOP", "GFLOP/s", "parameters", "status")
HUMANOID_UPDATES = 10


def run(benchmark: Benchmark) -> None:
    """
    :param benchmark: What is shared
    """
    args, results = benchmark.args, benchmark.results("update")
    peers = [
        contestants.sb3("SAC"),
        contestants.sb3("SAC", f"{SAC}, one update a call", one_at_a_time=True),
        contestants.sb3("TD3"),
        contestants.sb3("TQC"),
        contestants.sbx_sac(args.python_sbx),
        contestants.sbx_sac(args.python_sbx, one_at_a_time=True),
        contestants.d3rlpy_td3bc(args.python_d3rlpy),
        contestants.d3rlpy_td3bc(args.python_d3rlpy, with_sampling=False),
        *benchmark.diffusion_ql(),
        *benchmark.authors(),
    ]
    ours = [*benchmark.ours(contestants.main_settings()), *contestants.more_settings()]
    small = _measure(benchmark, results, HALF_CHEETAH, [*ours, *peers], benchmark.updates)
    wide = [
        *benchmark.ours(contestants.main_settings()),
        contestants.sb3("SAC"),
        *benchmark.diffusion_ql(),
        *benchmark.authors(),
    ]
    large = _measure(benchmark, results, HUMANOID, wide, HUMANOID_UPDATES)
    wanted: tuple[tuple[str, dict[str, list[float]], str, str, float, float], ...] = (
        ("update: one_step, Mish, world model, vs Diffusion-QL", small, ONE_STEP, DIFFUSION_QL, 3.0, 4.5),
        ("update: exact chain, Mish, world model, vs Diffusion-QL", small, CHAIN, DIFFUSION_QL, 1.6, 2.3),
        ("update: default vs SB3 SAC 3x256", small, DEFAULT, SAC, 1.2, 1.6),
        ("update, Humanoid sizes: one_step, Mish, vs Diffusion-QL", large, ONE_STEP, DIFFUSION_QL, 2.5, 4.0),
    )
    for what, taken, name, reference, must, goal in wanted:
        results.verdicts.append(_verdict(what, taken, name, reference, must, goal))
        if not args.no_compile:
            results.verdicts.append(_verdict(f"{what}, compiled", taken, compiled(name), reference, must, goal))
    results.write(COLUMNS)
    plots.updates(results, HALF_CHEETAH)


def _measure(benchmark: Benchmark, results: Results, task: str, who: list[Contestant], updates: int) -> dict[str, list[float]]:
    """Adds a row for each contestant, and returns the CPU milliseconds of an update, by contestant and round."""
    with benchmark.field(who, transitions=benchmark.transitions(task)) as field:
        seconds = field.interleaved(benchmark.rounds, lambda worker: worker.ask("update", n=updates)["cpu"])
        taken = {name: [1e3 * value / updates for value in values] for name, values in seconds.items()}
        flops: dict[str, float] = {}
        for name, worker in field.workers.items():
            if has_countable_flops(worker.contestant):
                flops[name] = worker.ask("flops")["value"]["total"]
        results.rows += [_row(field, task, one.name, taken, flops) for one in who]
        results.about[task] = {name: worker.about for name, worker in field.workers.items()}
    return taken


def has_countable_flops(contestant: Contestant) -> bool:
    """
    :param contestant: Any
    :return: Whether its floating point operations can be counted: not in a compiled update, nor in JAX
    """
    return contestant.module != "sbx_sac" and not contestant.config.get("kwargs", {}).get("compile", False)


def _row(field: Field, task: str, name: str, taken: dict[str, list[float]], flops: dict[str, float]) -> dict[str, Any]:
    row: dict[str, Any] = {"task": task, "contestant": name}
    if name not in taken:
        return {**row, **field.absent[name]}
    values = sorted(taken[name])
    ms = values[len(values) // 2]
    row |= {"status": "ok", "ms": ms, "spread": f"{values[0]:.2f} to {values[-1]:.2f}", "all_ms": taken[name]}
    row["parameters"] = field.workers[name].about.get("parameters")
    for reference, column in ((DIFFUSION_QL, "vs Diffusion-QL"), (SAC, "vs SB3 SAC")):
        if reference in taken:
            row[column] = median_ratio(taken[reference], taken[name])
    if name in flops:
        row |= {"MFLOP": flops[name] / 1e6, "GFLOP/s": flops[name] / ms / 1e6}
    return row


def _verdict(what: str, taken: dict[str, list[float]], name: str, reference: str, must: float, goal: float) -> Verdict:
    missing = [one for one in (name, reference) if one not in taken]
    value = None if missing else median_ratio(taken[reference], taken[name])
    return Verdict(what, value, must, goal, note=f"not available: {missing[0]}" if missing else "")
