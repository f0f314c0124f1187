"""
Draw what ``run.py`` wrote, and print its table in Markdown.

    python -m benchmarks.offline.plot
"""

import argparse
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.offline.methods import METHODS
from sb3_causalgdp.causal.plots.figures import save_figure

RESULTS = Path(__file__).parent / "results"
LABELS = {
    "causalgdp": "CausalGDP",
    "notears": "CausalGDP, NOTEARS",
    "direct_lingam": "CausalGDP, DirectLiNGAM",
    "perturbed": "CausalGDP, perturbed graph",
    "open": "CausalGDP, all edges open",
    "scaled": "CausalGDP, masks that scale",
    "notears_scaled": "masks that scale, NOTEARS",
    "perturbed_scaled": "masks that scale, perturbed graph",
    "no_guidance": "no guidance",
    "layer_norm": "CausalGDP, critics with layer norm",
    "bc": "diffusion behaviour cloning",
    "td3_bc": "TD3+BC",
    "td3_bc_200": "TD3+BC, alpha 200",
    "td3_bc_published": "TD3+BC, published rates",
    "iql": "IQL",
    "iql_published": "IQL, published rates",
    "cql": "CQL",
    "planner": "planner, knows the maze",
}
COLOURS = {method: colormaps["tab20"](index) for index, method in enumerate(METHODS)} | {"planner": "black"}


def read(path: Path) -> pd.DataFrame:
    """
    :param path: Table of the results
    :return: The same, methods in the order of ``METHODS``
    """
    table = pd.read_csv(path)
    table["method"] = pd.Categorical(table["method"], [method for method in METHODS if method in set(table["method"])])
    return table.sort_values(["task", "method", "seed", "updates"])


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """
    :param table: What :func:`read` returned
    :return: For each task, method and reported checkpoint: mean and standard deviation of the score over seeds, their number
    """
    reported = table[table["checkpoint"].isin(["last", "best"])]
    groups = reported.groupby(["task", "method", "checkpoint"], observed=True)
    return groups.agg(mean=("score", "mean"), std=("score", "std"), seeds=("seed", "nunique")).reset_index()


def markdown(table: pd.DataFrame) -> str:
    """
    :param table: What :func:`read` returned
    :return: Scores of the last and of the best checkpoint, a row for each method, with its updates and CPU minutes a run
    """
    cells = summary(table).set_index(["task", "method", "checkpoint"])
    tasks = _tasks(table)
    header = ["method", *(f"{task}: last | best" for task in tasks), "seeds", "updates", "CPU min"]
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * (2 * len(tasks) + 4)]
    for method in table["method"].cat.categories:
        rows = table[(table["method"] == method) & (table["checkpoint"] == "last")]
        numbers = [
            "/".join(str(count) for count in sorted(set(rows.groupby("task")["seed"].nunique()))),
            "/".join(f"{count:,}" for count in sorted(set(rows["updates"]))) if method != "planner" else "",
            f"{rows['train_cpu_seconds'].mean() / 60:.1f}" if method != "planner" else "",
        ]
        scores = [_score(cells, (task, method, checkpoint)) for task in tasks for checkpoint in ("last", "best")]
        lines.append(f"| {LABELS[method]} | " + " | ".join([*scores, *numbers]) + " |")
    return "\n".join(lines)


def _score(cells: pd.DataFrame, key: tuple[str, str, str]) -> str:
    if key not in cells.index:
        return "not run"
    cell = cells.loc[key]
    return f"{cell['mean']:.0f}" + (f" +- {cell['std']:.0f}" if cell["seeds"] > 1 else "")


def _tasks(table: pd.DataFrame) -> list[str]:
    """Sparse before dense, small before large."""
    sizes = ["umaze", "medium", "large"]
    return sorted(set(table["task"]), key=lambda task: ("dense" in task, sizes.index(task.split("-")[1])))


def draw_curves(table: pd.DataFrame, path: Path) -> None:
    """
    Score by updates: seeds thin, their mean thick.

    :param table: What :func:`read` returned
    :param path: The picture
    """
    tasks = _tasks(table)
    figure = _figure(len(tasks))
    for axes, task in zip(figure.subplots(1, len(tasks), squeeze=False)[0], tasks, strict=True):
        rows = table[(table["task"] == task) & (table["checkpoint"] == "training")]
        for method in table["method"].cat.categories:
            runs = rows[rows["method"] == method].pivot(index="updates", columns="seed", values="score")
            if runs.empty:
                continue
            if method == "planner":
                axes.axhline(runs.to_numpy().mean(), color="black", linestyle="--", linewidth=1, label=LABELS[method])
                continue
            axes.plot(runs.index, runs, color=COLOURS[method], alpha=0.25, linewidth=0.8)
            # Where a seed is missing, the mean would jump
            complete = runs.dropna()
            axes.plot(complete.index, complete.mean(axis=1), color=COLOURS[method], linewidth=2, label=LABELS[method])
        axes.set(title=task, xlabel="updates", ylabel="D4RL's normalised score")
        axes.grid(alpha=0.3)
    _save(figure, path)


def draw_scores(table: pd.DataFrame, path: Path) -> None:
    """
    Scores of the last (filled) and best (open) checkpoint, one dot for each seed.

    :param table: What :func:`read` returned
    :param path: The picture
    """
    tasks = _tasks(table)
    methods = list(table["method"].cat.categories)
    figure = _figure(len(tasks))
    for axes, task in zip(figure.subplots(1, len(tasks), squeeze=False, sharey=True)[0], tasks, strict=True):
        for height, method in enumerate(methods):
            rows = table[(table["task"] == task) & (table["method"] == method)]
            for checkpoint, shift, face in (("last", 0.13, COLOURS[method]), ("best", -0.13, "none")):
                scores = rows[rows["checkpoint"] == checkpoint]["score"]
                axes.plot(scores, [height + shift] * len(scores), "o", color=COLOURS[method], markerfacecolor=face)
        axes.axvline(0, color="gray", linewidth=0.8)
        axes.axvline(100, color="gray", linewidth=0.8)
        axes.set(title=task, xlabel="D4RL's normalised score", yticks=range(len(methods)))
        axes.set_yticklabels([LABELS[method] for method in methods])
        axes.grid(alpha=0.3, axis="x")
    axes.invert_yaxis()
    axes.plot([], [], "o", color="gray", label="last checkpoint")
    axes.plot([], [], "o", color="gray", markerfacecolor="none", label="best checkpoint")
    _save(figure, path)


def _figure(n_panels: int) -> Figure:
    figure = Figure(figsize=(1.5 + 4 * n_panels, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: Path) -> None:
    """One legend for all panels, then the picture, complete or not there."""
    handles: dict[str, Any] = {}
    for axes in figure.axes:
        assert isinstance(axes, Axes)
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    n_columns = min(len(figure.axes) + 1, 4)  # more than fit would be cut off
    figure.legend(list(handles.values()), list(handles), loc="outside lower center", ncols=n_columns, frameon=False)
    save_figure(figure, path)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--folder", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    path = arguments.folder / "results.csv"
    if not path.exists():
        raise SystemExit(f"no results in {arguments.folder}: run benchmarks.offline.run first")
    table = read(path)
    draw_curves(table, arguments.folder / "curves.png")
    draw_scores(table, arguments.folder / "scores.png")
    print(markdown(table))


if __name__ == "__main__":
    main()
