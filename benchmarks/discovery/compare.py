"""
Our discovery methods beside their peers: accuracy and CPU seconds in one process of one thread.

    OMP_NUM_THREADS=1 python -m benchmarks.discovery.compare --section accuracy
    OMP_NUM_THREADS=1 python -m benchmarks.discovery.compare --section speed --repeats 5 --notears-path /tmp/notears
    OMP_NUM_THREADS=1 python -m benchmarks.discovery.compare --section scaling humanoid oracle

Each section writes ``<section>.json`` and ``<section>.md`` into ``--folder``. ``--resume`` keeps the records that are there.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.discovery import metrics, oracle
from benchmarks.discovery.methods import (
    PEERS,
    Estimate,
    Fit,
    Outcome,
    agreement,
    gather,
    load_all,
    objective,
    product_gflops,
    refresh,
    resident_mib,
    run_limited,
    seconds_per_call,
)
from benchmarks.discovery.systems import KINDS, ControlSystem, make_system
from sb3_causalgdp.causal import DISCOVERY_METHODS, TransitionVariables, make_discovery

RESULTS = Path(__file__).parent / "results"
PACKAGES = ("numpy", "scipy", "scikit-learn", "torch", "mujoco", "gymnasium", "lingam", "gcastle", "dagma")
SYSTEMS: dict[str, dict[str, Any]] = {kind: {"kind": kind} for kind in KINDS}
SYSTEMS["confounded_0.05"] = {"kind": "confounded", "action_noise": 0.05}
MIN_TIMED_SECONDS = 0.2  # a faster call is repeated, and its median counts
SLOW_SECONDS = 10.0  # a slower call is timed once
ALTERNATIONS = 30  # of refreshes after few and many rows
SAME_PROBLEM = ("zheng_notears_allowed", "lasso")  # their weights should be those of notears
HUMANOID: dict[str, tuple[str, dict[str, Any]]] = {
    "notears": ("notears", {}),
    "notears, least squares": ("notears", {"sparsity": 0.0}),
    "partial_r2": ("partial_r2", {}),
    "partial_r2, linear": ("partial_r2", {"basis": "linear"}),
}
Record = dict[str, Any]


class Results:
    """
    Records of one section, written after each one.

    :param folder: Where the JSON and the table go
    :param section: Name of the files
    :param keys: Columns that tell records apart; the last ones of the table are averaged over the others
    :param resume: Keep the records of an earlier run
    """

    def __init__(self, folder: Path, section: str, keys: tuple[str, ...], resume: bool) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.path = folder / f"{section}.json"
        self.keys = keys
        self.records: list[Record] = []
        if resume and self.path.exists():
            self.records = json.loads(self.path.read_text(encoding="utf-8"))["records"]

    def find(self, **wanted: Any) -> list[Record]:
        """Records whose columns have these values."""
        return [record for record in self.records if all(record[key] == value for key, value in wanted.items())]

    def add(self, record: Record) -> None:
        """
        :param record: Has the keys and whatever was measured
        """
        self.records.append(record)
        print(", ".join(f"{key} {_format(value)}" for key, value in record.items()), flush=True)
        content = {"machine": machine(), "command": sys.argv, "records": self.records}
        self.path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")

    def write_table(self, group_by: tuple[str, ...], columns: tuple[str, ...], reduce: Callable) -> None:
        """
        Markdown: one line per group, each column reduced over the group's records.

        :param group_by: Columns of the keys that stay
        :param columns: Measured columns
        :param reduce: Function of a list of numbers to one
        """
        groups: dict[tuple, list[Record]] = {}
        for record in self.records:
            groups.setdefault(tuple(record[key] for key in group_by), []).append(record)
        lines = [f"| {' | '.join((*group_by, 'runs', *columns))} |", "|" + "---|" * (len(group_by) + 1 + len(columns))]
        for group, records in sorted(groups.items(), key=lambda item: tuple(map(str, item[0]))):
            done = [record for record in records if record["status"] == "ok"]
            if done:
                cells = [_format(reduce([r[c] for r in done if r.get(c) is not None])) for c in columns]
            else:
                cells = [records[0]["status"], *[""] * (len(columns) - 1)]
            lines.append(f"| {' | '.join([*map(_format, group), str(len(done)), *cells])} |")
        self.path.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")
        print("\n".join(lines))


def _format(value: Any) -> str:
    if isinstance(value, float):
        return "-" if np.isnan(value) else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) else str(value)


def mean_or_nan(values: list[float]) -> float:
    """
    :param values: Numbers, maybe none
    """
    return float(np.mean(values)) if values else float("nan")


def median_or_nan(values: list[float]) -> float:
    """
    :param values: Numbers, maybe none
    """
    return float(np.median(values)) if values else float("nan")


def machine() -> Record:
    """Processor, interpreter, versions and threads."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    cpu_info = Path("/proc/cpuinfo")
    models = [line for line in cpu_info.read_text().splitlines() if "model name" in line] if cpu_info.exists() else []
    processor = models[0].partition(":")[2].strip() if models else platform.processor()
    return {"processor": processor, "threads": os.environ.get("OMP_NUM_THREADS"), "versions": versions}


def _auroc(scores: np.ndarray, truth: np.ndarray) -> float | None:
    """None, which the table leaves out, where there are no edges or nothing else."""
    return metrics.auroc(scores, truth) if 0 < truth.sum() < truth.size else None


def graph_scores(estimate: Estimate, system: ControlSystem) -> Record:
    """
    :param estimate: What a method says
    :param system: The true one
    :return: every metric of ``metrics`` that has a meaning for the method
    """
    where = system.scored
    truth = system.adjacency[where]
    folded = system.fold_copies(estimate.ranking)
    ranking, masks, effects = (system.fold_copies(matrix)[where] for matrix in estimate[:3])
    n_states = len(where) - 1
    blocks: dict[str, Any] = {
        "state": np.s_[:n_states, :n_states],
        "action": np.s_[:n_states, n_states:],
        "reward": np.s_[n_states:],
    }
    by_block = {f"auroc_{name}": _auroc(folded[b][where[b]], system.adjacency[b][where[b]]) for name, b in blocks.items()}
    return {
        "auroc": _auroc(ranking, truth),
        **by_block,
        "auroc_effects": _auroc(effects, truth),
        "f1": metrics.f1(masks, truth),
        "shd": metrics.shd(masks, truth),
        "brier": metrics.brier(masks, truth) if estimate.probabilities else None,
        "ece": metrics.ece(masks, truth) if estimate.probabilities else None,
    }


def oracle_scores(estimate: Estimate, truth: oracle.Oracle, n_states: int) -> Record:
    """
    :param estimate: What a method says
    :param truth: What the simulator says
    :param n_states: n
    :return: Spearman correlations of the estimated effects, by block, and of the masks
    """
    effects, true = estimate.effects, truth.effects
    return {
        "dynamics": metrics.spearman(effects[:-1], true[:-1]),
        "state_to_state": metrics.spearman(effects[:-1, :n_states], true[:-1, :n_states]),
        "action_to_state": metrics.spearman(effects[:-1, n_states:], true[:-1, n_states:]),
        "reward": metrics.spearman(effects[-1], true[-1]),
        "all": metrics.spearman(effects, true),
        "dynamics_of_masks": metrics.spearman(estimate.masks[:-1], true[:-1]),
        "reward_r2": truth.reward_r2,
    }


def timed(outcome: Outcome) -> Record:
    """
    :param outcome: Of one run
    :return: its columns
    """
    columns: Record = {"status": outcome.status, "cpu_seconds": outcome.cpu_seconds, "peak_mib": outcome.peak_mib}
    return columns | ({"error": outcome.error} if outcome.error else {})


def run_accuracy(args: argparse.Namespace, fits: dict[str, Fit]) -> None:
    """Every method on every system, number of rows and seed; a method over the limit is not asked again with as many rows."""
    results = Results(args.folder, "accuracy", ("system", "rows", "seed", "method"), args.resume)
    for name in args.systems:
        for seed in range(args.seeds):
            rng = np.random.default_rng(seed)
            system = make_system(rng=rng, **SYSTEMS[name])
            all_rows = {n_rows: system.sample(n_rows, rng) for n_rows in sorted(args.rows or (1_000, 20_000))}
            for n_rows, rows in all_rows.items():
                for method, fit in fits.items():
                    key = {"system": name, "rows": n_rows, "seed": seed, "method": method}
                    if results.find(**key) or results.find(method=method, rows=n_rows, status="> limit"):
                        continue
                    outcome = run_limited(partial(fit, rows, system.variables), args.time_limit)
                    scores = graph_scores(outcome.value, system) if outcome.status == "ok" else {}
                    results.add(key | timed(outcome) | scores)
    blocks = ("auroc_state", "auroc_action", "auroc_reward")
    columns = ("auroc", *blocks, "auroc_effects", "f1", "shd", "brier", "ece", "cpu_seconds")
    results.write_table(("rows", "system", "method"), columns, mean_or_nan)


def interleaved(names: Iterable[str], repeats: int) -> Iterable[tuple[int, str]]:
    """
    A B C A B C ...: so that a busy minute of the machine hits all alike.

    :param names: What is repeated
    :param repeats: How often
    """
    names = list(names)
    return ((repeat, name) for repeat in range(repeats) for name in names)


def run_speed(args: argparse.Namespace, fits: dict[str, Fit]) -> None:
    """
    HalfCheetah's transitions: from rows to graph, and for ours also the refresh alone; the oracle's Spearman beside it, and
    whether those who solve the problem of notears find its weights.
    """
    results = Results(args.folder, "speed", ("rows", "repeat", "method"), args.resume)
    env_id = "HalfCheetah-v5"
    truth = oracle.cached(env_id, folder=args.folder)
    for n_rows in args.rows or (2_000, 20_000):
        rows, variables = oracle.collect(env_id, n_rows, seed=1)
        calls: dict[str, Callable[[], Any]] = {name: partial(fit, rows, variables) for name, fit in fits.items()}
        ours = fits["notears"](rows, variables) if "notears" in fits else None
        for name in fits:
            if name in DISCOVERY_METHODS:
                statistics = gather(name, rows, variables, **args.kwargs.get(name, {}))
                calls[f"{name}, refresh alone"] = partial(refresh, name, statistics, variables, **args.kwargs.get(name, {}))
        for repeat, name in interleaved(calls, args.repeats):
            key = {"rows": n_rows, "repeat": repeat, "method": name}
            done = results.find(method=name, rows=n_rows)
            if results.find(**key) or any(r["status"] == "> limit" or r["cpu_seconds"] > SLOW_SECONDS for r in done):
                continue
            outcome = run_limited(calls[name], args.time_limit, MIN_TIMED_SECONDS)
            scores: Record = {}
            if isinstance(outcome.value, Estimate):
                scores = {"dynamics": metrics.spearman(outcome.value.effects[:-1], truth.effects[:-1])}
                if name in ("notears", *SAME_PROBLEM):
                    scores["objective"] = objective(outcome.value.weights, rows, variables)
                if name in SAME_PROBLEM and ours is not None:
                    scores |= agreement(outcome.value, ours)
            results.add(key | timed(outcome) | scores)
    columns = ("cpu_seconds", "dynamics", "weight_gap", "support_gap", "objective", "peak_mib")
    results.write_table(("rows", "method"), columns, median_or_nan)


def run_scaling(args: argparse.Namespace, fits: dict[str, Fit]) -> None:
    """Ours on a nonlinear system of HalfCheetah's size: seconds to gather so many rows, and of a refresh after them."""
    results = Results(args.folder, "scaling", ("rows", "repeat", "method"), args.resume)
    system = make_system("nonlinear", np.random.default_rng(0), n_states=17, n_actions=6)
    ours = [name for name in fits if name in DISCOVERY_METHODS]
    counts = args.rows or (20_000, 1_000_000)
    for repeat, name in interleaved(ours, args.repeats):
        if results.find(repeat=repeat, method=name):
            continue
        call = partial(_gather_and_refresh, system, counts, name, args.kwargs.get(name, {}))
        outcome = run_limited(call, args.time_limit)
        for n_rows in counts:
            key = {"rows": n_rows, "repeat": repeat, "method": name}
            results.add(key | timed(outcome) | (outcome.value or {}).get(n_rows, {}))
    columns = ("gather_seconds", "refresh_seconds", "peak_mib")
    results.write_table(("method", "rows"), columns, median_or_nan)


def _gather_and_refresh(system: ControlSystem, counts: Iterable[int], name: str, kwargs: dict[str, Any]) -> dict[int, Record]:
    """
    By the number of rows: CPU seconds of the statistics' updates, by 10,000 rows (made beforehand, not timed), and of a
    refresh; refreshes after few and many rows alternate.
    """
    rng = np.random.default_rng(0)
    variables = system.variables
    block = 10_000
    records: dict[int, Record] = {}
    calls: dict[int, Callable[[], Any]] = {}
    for n_rows in counts:
        statistics = gather(name, system.sample(min(block, n_rows), rng), variables, **kwargs)
        gathering = 0.0
        for _ in range(n_rows // block - 1):
            rows = system.sample(block, rng)
            start = time.thread_time()
            statistics.update(rows)
            gathering += time.thread_time() - start
        records[n_rows] = {"gather_seconds": gathering}
        calls[n_rows] = partial(refresh, name, statistics, variables, **kwargs)
    seconds: dict[int, list[float]] = {n_rows: [] for n_rows in calls}
    for _ in range(ALTERNATIONS):
        for n_rows, call in calls.items():
            seconds[n_rows].append(seconds_per_call(call)[0])
    return {n_rows: record | {"refresh_seconds": float(np.median(seconds[n_rows]))} for n_rows, record in records.items()}


def run_humanoid(args: argparse.Namespace, fits: dict[str, Fit]) -> None:
    """Ours on Humanoid-v5: 348 states, 17 actions, some of them constant or linearly dependent."""
    results = Results(args.folder, "humanoid", ("rows", "repeat", "method"), args.resume)
    for n_rows in args.rows or (20_000,):
        rows, variables = oracle.collect("Humanoid-v5", n_rows, seed=0)
        chosen = [name for name, (method, _) in HUMANOID.items() if method in fits]
        for repeat, name in interleaved(chosen, args.repeats):
            key = {"rows": n_rows, "repeat": repeat, "method": name}
            if results.find(**key) or results.find(method=name, rows=n_rows, status="> limit"):
                continue
            method, kwargs = HUMANOID[name]
            call = partial(_humanoid, method, rows, variables, args.kwargs.get(method, {}) | kwargs)
            outcome = run_limited(call, args.time_limit)
            results.add(key | timed(outcome) | (outcome.value or {}))
    columns = ("first_seconds", "warm_seconds", "growth_mib", "n_edges", "product_gflops")
    results.write_table(("method", "rows"), columns, median_or_nan)


def _humanoid(name: str, rows: np.ndarray, variables: TransitionVariables, kwargs: dict[str, Any]) -> Record:
    """
    A graph of the first nine tenths of the rows, and one of all, from the first; how the process grew meanwhile, and how fast
    this core is just then at what the refreshes are made of.
    """
    first, rest = rows[: len(rows) * 9 // 10], rows[len(rows) * 9 // 10 :]
    gflops, before = product_gflops(), resident_mib()
    statistics = gather(name, first, variables, **kwargs)
    method, seconds, graph = make_discovery(name, **kwargs), [], None
    for new in (first[:0], rest):
        statistics.update(new)
        start = time.thread_time()
        graph = method(statistics, variables, graph)
        seconds.append(time.thread_time() - start)
    assert graph is not None
    return {
        "first_seconds": seconds[0],
        "warm_seconds": seconds[1],
        "growth_mib": resident_mib(largest=True) - before,
        "n_edges": int((graph.masks >= 0.5).sum()),
        "product_gflops": gflops,
    }


def run_oracle(args: argparse.Namespace, fits: dict[str, Fit]) -> None:
    """Spearman correlation with the simulator's own effects, on transitions of the same behaviour."""
    results = Results(args.folder, "oracle", ("environment", "behaviour", "rows", "seed", "method"), args.resume)
    for env_id in args.env:
        truth = oracle.cached(env_id, behaviour=args.behaviour, folder=args.folder)
        for n_rows in args.rows or (20_000,):
            for seed in range(1, 1 + args.seeds):
                rows, variables = oracle.collect(env_id, n_rows, seed, args.behaviour)
                for name, fit in fits.items():
                    key = {"environment": env_id, "behaviour": args.behaviour, "rows": n_rows, "seed": seed, "method": name}
                    if results.find(**key) or results.find(environment=env_id, method=name, rows=n_rows, status="> limit"):
                        continue
                    outcome = run_limited(partial(fit, rows, variables), args.time_limit)
                    ok = outcome.status == "ok"
                    results.add(key | timed(outcome) | (oracle_scores(outcome.value, truth, variables.n_states) if ok else {}))
    columns = (
        "dynamics",
        "state_to_state",
        "action_to_state",
        "reward",
        "all",
        "dynamics_of_masks",
        "reward_r2",
        "cpu_seconds",
    )
    results.write_table(("environment", "rows", "method"), columns, mean_or_nan)


SECTIONS = {
    "accuracy": run_accuracy,
    "speed": run_speed,
    "scaling": run_scaling,
    "humanoid": run_humanoid,
    "oracle": run_oracle,
}


def parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    known = [*DISCOVERY_METHODS, *PEERS]
    parser.add_argument("--section", nargs="+", choices=sorted(SECTIONS), required=True)
    parser.add_argument("--methods", nargs="+", default=known, help=f"of {', '.join(known)}")
    parser.add_argument("--systems", nargs="+", choices=sorted(SYSTEMS), default=list(SYSTEMS))
    parser.add_argument("--env", nargs="+", default=list(oracle.ENVIRONMENTS), help="tasks of the section oracle")
    parser.add_argument("--behaviour", default="uniform", help="of the section oracle: uniform, smooth or <algorithm>:<zip>")
    parser.add_argument("--rows", nargs="+", type=int, help="numbers of rows instead of the section's own")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--repeats", type=int, default=3, help="interleaved repetitions of a timing; the table has medians")
    parser.add_argument("--time-limit", type=float, default=600.0, help="CPU seconds of one call")
    parser.add_argument("--kwargs", type=json.loads, default={}, help='e.g. \'{"notears": {"sparsity": 0.02}}\'')
    parser.add_argument("--notears-path", help="folder that holds the package notears of github.com/xunzheng/notears")
    parser.add_argument("--folder", type=Path, default=RESULTS)
    parser.add_argument("--resume", action="store_true", help="go on with the records in --folder")
    return parser.parse_args()


def main() -> None:
    args = parse_arguments()
    if os.environ.get("OMP_NUM_THREADS") != "1":
        raise SystemExit("set OMP_NUM_THREADS=1: CPU seconds of several threads cannot be compared")
    if args.notears_path:
        sys.path.append(args.notears_path)
    fits = load_all(args.methods, args.kwargs)
    for section in args.section:
        SECTIONS[section](args, fits)


if __name__ == "__main__":
    main()
