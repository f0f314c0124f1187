"""CPU microseconds of ``predict()`` for one observation."""

from typing import Any

import numpy as np

from benchmarks.speed import contestants
from benchmarks.speed.benchmark import HALF_CHEETAH, Benchmark
from benchmarks.speed.client import median_ratio
from benchmarks.speed.contestants import DIFFUSION_QL, SAC, SAME_NETS
from benchmarks.speed.results import Verdict

CALLS = 100
COLUMNS = ("contestant", "us", "us, with noise", "times SB3 SAC", "times SB3 SAC, with noise", "status")


def run(benchmark: Benchmark) -> None:
    """
    :param benchmark: What is shared
    """
    results = benchmark.results("predict")
    who = [contestants.sb3("SAC"), *benchmark.diffusion_ql()]
    for n_candidates in (1, 10):
        for guidance in (None, "posterior"):
            name = f"CausalGDP, {'guided' if guidance else 'unguided'}, {n_candidates} candidates"
            kwargs: dict[str, Any] = {"guidance": guidance, "n_action_candidates": n_candidates, "policy_kwargs": SAME_NETS}
            who.append(contestants.causalgdp(name, **kwargs))
    who.append(contestants.causalgdp(contestants.DEFAULT))

    def turn(worker: Any) -> tuple[float, float]:
        if worker.contestant.name == DIFFUSION_QL:  # it draws its actions in any case
            return (np.nan, 1e6 * worker.ask("predict", n=CALLS)["cpu"] / CALLS)
        plain, noisy = (worker.ask("predict", n=CALLS, deterministic=one)["cpu"] for one in (True, False))
        return (1e6 * plain / CALLS, 1e6 * noisy / CALLS)

    with benchmark.field(who, transitions=benchmark.transitions(HALF_CHEETAH)) as field:
        taken = field.interleaved(benchmark.rounds, turn)
        results.about = {name: worker.about for name, worker in field.workers.items()}
        for one in who:
            if one.name not in taken:
                results.rows.append({"contestant": one.name, **field.absent[one.name]})
                continue
            row: dict[str, Any] = {"contestant": one.name, "status": "ok"}
            for index, suffix in enumerate(("", ", with noise")):
                own, sac = ([pair[index] for pair in taken[name]] for name in (one.name, SAC))
                if not np.isnan(own).any():
                    row |= {f"us{suffix}": float(np.median(own)), f"times SB3 SAC{suffix}": median_ratio(own, sac)}
            results.rows.append(row)
    ratios = {row["contestant"]: row.get("times SB3 SAC") for row in results.rows}
    results.verdicts = [
        Verdict(f"predict: {name.removeprefix('CausalGDP, ')}, times SB3 SAC", value, limit, at_least=False)
        for name, value in ratios.items()
        for kind, limit in (("unguided", 1.0), (" guided", 2.5))
        if kind in name
    ]
    results.write(COLUMNS)
