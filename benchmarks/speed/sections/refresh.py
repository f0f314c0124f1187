"""Share of the CPU time of ``learn()`` that goes into the causal refresh, at its default frequency."""

from benchmarks.speed import contestants, learning
from benchmarks.speed.benchmark import HALF_CHEETAH, HUMANOID, Benchmark
from benchmarks.speed.contestants import DEFAULT
from benchmarks.speed.results import Verdict

# Humanoid's 365 causes need 3,650 transitions before the first graph, and their first 5,000 move so far that the features are
# standardised anew, with all rows fed again: that happens no more in the next 7,000
STARTS = {HALF_CHEETAH: 2_000, HUMANOID: 8_000}
LIMIT = 0.02
COLUMNS = ("task", "ms per step", "ms per refresh", "share of refreshes", "status")


def run(benchmark: Benchmark) -> None:
    """
    :param benchmark: What is shared
    """
    results, args = benchmark.results("refresh"), benchmark.args
    for task, starts in STARTS.items():
        who = contestants.causalgdp(DEFAULT, learning_starts=starts, causal_refresh_freq=learning.REFRESH_PERIOD)
        with benchmark.field([who], transitions=benchmark.transitions(task), env=task) as field:
            turns = field.interleaved(
                args.learn_rounds,
                lambda worker: learning.turn(worker, args.steps),
                lambda worker, starts=starts: learning.warm_up(worker, starts),  # type: ignore[misc]
            )
            results.rows.append({"task": task, **learning.row(field, DEFAULT, turns)})
    results.verdicts = [
        Verdict(f"refresh: share of training, {row['task']}", row.get("share of refreshes"), LIMIT, at_least=False)
        for row in results.rows
    ]
    results.write(COLUMNS)
