"""
Draw the learning curves that ``run.py`` wrote, against steps and against CPU seconds, and print their statistics.

    python benchmarks/learning/summary.py --env HalfCheetah-v5 Hopper-v5 --steps 100000
    python benchmarks/learning/summary.py --env Hopper-v5 --steps 100000 --names causalgdp tqc --against tqc
    python benchmarks/learning/summary.py --env Hopper-v5 --at 10000 20000 40000 60000 80000 100000

The statistics are those of Agarwal et al. (2021, https://arxiv.org/abs/2108.13264): the interquartile mean over seeds, 95 %
intervals by stratified bootstrap (``scipy.stats.bootstrap``: the authors' own package does not import beside pandas 3), and
the probability that a seed of one algorithm does better than a seed of another.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from scipy.stats import bootstrap, trim_mean

RESULTS = Path(__file__).parent / "results"
N_RESAMPLES = 2_000
CONFIDENCE = 0.95


class Curves(NamedTuple):
    """Runs of one algorithm on one environment, one row for each seed, at the same steps."""

    seeds: list[int]
    steps: np.ndarray
    returns: np.ndarray
    cpu_seconds: np.ndarray


class Estimate(NamedTuple):
    """A statistic and its interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.4g} [{self.low:.4g}, {self.high:.4g}]"


# Reading ------------------------------------------------------------------------------------------------------------------


def read(folder: Path, env_id: str, steps: int | None = None, names: Sequence[str] | None = None) -> dict[str, Curves]:
    """
    :param folder: Of the results
    :param env_id: The environment
    :param steps: Runs that did not come so far are left out, and what is behind it is; None takes what all have
    :param names: Of the algorithms and variants, None for all
    :return: By name
    """
    curves = {}
    for name, by_seed in tables_of(folder, env_id, names).items():
        far_enough = {seed: one for seed, one in by_seed.items() if steps is None or one["timesteps"][-1] >= steps}
        if far_enough:
            curves[name] = _curves(far_enough, steps)
    return curves


def tables_of(folder: Path, env_id: str, names: Sequence[str] | None = None) -> dict[str, dict[int, np.ndarray]]:
    """
    :param folder: Of the results
    :param env_id: The environment
    :param names: Of the algorithms and variants, None for all
    :return: What was written, by name and seed
    """
    tables: dict[str, dict[int, np.ndarray]] = {}
    for path in sorted(folder.glob(f"{env_id}_*.csv")):
        name, seed = path.stem.removeprefix(f"{env_id}_").rsplit("_", 1)
        table = np.atleast_1d(np.genfromtxt(path, delimiter=",", names=True))
        if (names is None or name in names) and len(table) > 0:
            tables.setdefault(name, {})[int(seed)] = table
    return tables


def _curves(tables: Mapping[int, np.ndarray], steps: int | None) -> Curves:
    common = sorted(set.intersection(*(set(table["timesteps"]) for table in tables.values())))
    kept = [step for step in common if steps is None or step <= steps]
    rows = [table[np.isin(table["timesteps"], kept)] for _, table in sorted(tables.items())]
    returns, seconds = (np.stack([row[column] for row in rows]) for column in ("mean_return", "cpu_seconds"))
    return Curves(sorted(tables), np.array(kept), returns, seconds)


# Statistics ---------------------------------------------------------------------------------------------------------------


def interquartile_mean(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Mean of the middle half."""
    return trim_mean(values, 0.25, axis=axis)


def with_interval(samples: Sequence[np.ndarray], statistic: Any) -> Estimate:
    """
    :param samples: One array of seeds for each stratum, which are resampled on their own
    :param statistic: Of them, as ``scipy.stats.bootstrap`` takes it
    :return: Its value and interval; without a spread the interval is the value
    """
    value = float(statistic(*samples, axis=-1))
    if all(np.ptp(sample) == 0.0 for sample in samples):
        return Estimate(value, value, value)
    result = bootstrap(samples, statistic, n_resamples=N_RESAMPLES, confidence_level=CONFIDENCE, method="percentile", rng=0)
    return Estimate(value, *map(float, result.confidence_interval))


def probability_of_improvement(values: np.ndarray, others: np.ndarray, axis: int = -1) -> np.ndarray:
    """How probable it is that one of the values is larger than one of the others; equal ones count half."""
    values, others = np.moveaxis(values, axis, -1), np.moveaxis(others, axis, -1)
    differences = values[..., :, None] - others[..., None, :]
    return (0.5 * (np.sign(differences) + 1.0)).mean(axis=(-2, -1))


def seconds_to(curves: Curves, level: float) -> list[float]:
    """CPU seconds up to the first evaluation of at least this return, of each seed; infinite where there is none."""
    reached = curves.returns >= level
    return [
        float(seconds[row.argmax()]) if row.any() else np.inf for row, seconds in zip(reached, curves.cpu_seconds, strict=True)
    ]


# Output -------------------------------------------------------------------------------------------------------------------


def table(results: Mapping[str, Curves], against: str | None = None, level: float | None = None) -> str:
    """A table in Markdown of the last evaluations."""
    header = ["", "seeds", "mean +- sd", "interquartile mean", "CPU seconds", "each seed"]
    header += [] if against is None else [f"better than {against}"]
    header += [] if level is None else [f"CPU seconds to {level:g}"]
    rows = [header, ["---"] * len(header)]
    for name, curves in results.items():
        last = curves.returns[:, -1]
        row = [name, str(len(last)), f"{last.mean():.0f} +- {last.std():.0f}"]
        row.append(str(with_interval([last], interquartile_mean)) if len(last) > 1 else "")
        row += [f"{curves.cpu_seconds[:, -1].mean():.0f}", ", ".join(f"{value:.0f}" for value in last)]
        if against is not None:
            others = results[against].returns[:, -1]
            row.append("" if name == against else str(with_interval([last, others], probability_of_improvement)))
        if level is not None:
            row.append(", ".join(f"{seconds:.0f}" for seconds in seconds_to(curves, level)))
        rows.append(row)
    return _in_markdown(rows)


def table_of_seeds(tables: Mapping[str, Mapping[int, np.ndarray]], at: Sequence[int]) -> str:
    """A table in Markdown of what each seed had reached after some steps, blank where it was not evaluated."""
    rows = [["", "seed", *(f"{step:,}" for step in at), "CPU seconds"], ["---"] * (len(at) + 3)]
    for name, by_seed in tables.items():
        for seed, one in sorted(by_seed.items()):
            reached = dict(zip(one["timesteps"], one["mean_return"], strict=True))
            cells = [f"{reached[step]:.0f}" if step in reached else "" for step in at]
            rows.append([name, str(seed), *cells, f"{one['cpu_seconds'][-1]:.0f}"])
    return _in_markdown(rows)


def _in_markdown(rows: Sequence[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def draw(env_id: str, results: Mapping[str, Curves], path: Path) -> None:
    """Interquartile means and their intervals."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    FigureCanvasAgg(figure)
    by_steps, by_seconds = figure.subplots(1, 2, sharey=True)
    for index, (name, curves) in enumerate(results.items()):
        points = [with_interval([column], interquartile_mean) for column in curves.returns.T]
        middle, low, high = map(np.array, zip(*points, strict=True))
        label = f"{name} ({len(curves.seeds)} seeds)"
        for axes, x in ((by_steps, curves.steps), (by_seconds, curves.cpu_seconds.mean(axis=0))):
            axes.plot(x, middle, color=f"C{index}", linewidth=2, label=label)
            axes.fill_between(x, low, high, color=f"C{index}", alpha=0.2, linewidth=0)
    by_steps.set(title=env_id, xlabel="environment steps", ylabel="return of deterministic episodes")
    by_seconds.set(title="the same against time", xlabel="CPU seconds of training")
    by_steps.legend()
    for axes in (by_steps, by_seconds):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", nargs="+", default=["HalfCheetah-v5"])
    parser.add_argument("--steps", type=int, help="leave out runs that did not come so far, and what is behind")
    parser.add_argument("--names", nargs="+", help="algorithms and variants, in this order; all by default")
    parser.add_argument("--against", help="print the probability of doing better than this one")
    parser.add_argument("--level", type=float, help="print the CPU seconds to this return")
    parser.add_argument("--folder", type=Path, default=RESULTS)
    parser.add_argument(
        "--at", nargs="+", type=int, help="print what each seed had reached after these steps, and draw nothing"
    )
    arguments = parser.parse_args()
    for env_id in arguments.env:
        if arguments.at:
            tables = tables_of(arguments.folder, env_id, arguments.names)
            print(f"\n{env_id}\n\n{table_of_seeds(tables, arguments.at)}")
            continue
        results = read(arguments.folder, env_id, arguments.steps, arguments.names)
        if not results:
            raise SystemExit(f"No results of {env_id} in {arguments.folder}: run run.py first")
        if arguments.names:
            results = {name: results[name] for name in arguments.names if name in results}
        print(f"\n{env_id}\n\n{table(results, arguments.against, arguments.level)}")
        draw(env_id, results, arguments.folder / f"{env_id}.png")


if __name__ == "__main__":
    main()
