"""Pictures of a section's results, beside its table."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.speed.contestants import DIFFUSION_QL
from benchmarks.speed.results import Results

AXIS_LABELS = {
    "n": "state variables n",
    "d": "action components d",
    "K": "diffusion steps K",
    "batch": "batch size",
    "candidates": "candidates of one prediction",
    "observations": "observations of one prediction (environments)",
}
OURS, PEERS = "#1f6f8b", "#b0b0b0"


def _pyplot() -> Any:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def _save(figure: Any, path: Path) -> None:
    figure.savefig(path, dpi=110)
    _pyplot().close(figure)


def updates(results: Results, task: str) -> None:
    """
    How many times faster than Diffusion-QL: one bar for each contestant.

    :param results: Of the section ``update``
    :param task: Whose rows
    """
    column = "vs Diffusion-QL"
    rows = [row for row in results.rows if row["task"] == task and row.get(column)]
    if not rows:
        return
    rows.sort(key=lambda row: row[column])
    figure, axes = _pyplot().subplots(figsize=(9.0, 0.8 + 0.34 * len(rows)), layout="constrained")
    names, values = [row["contestant"] for row in rows], [row[column] for row in rows]
    is_ours = [name.startswith("CausalGDP") and "authors" not in name for name in names]
    bars = axes.barh(names, values, color=[OURS if one else PEERS for one in is_ours])
    axes.bar_label(bars, [f"{value:.2f}  ({row['ms']:.1f} ms)" for value, row in zip(values, rows, strict=True)], padding=3)
    axes.axvline(1.0, color="black", linewidth=0.8, linestyle=":", zorder=0)
    axes.set(xlim=(0.0, 1.25 * max(values)), xlabel=f"updates in the CPU time of one of Diffusion-QL's, {task} sizes")
    axes.spines[["top", "right"]].set_visible(False)
    _save(figure, results.folder / "update.png")


def parts(results: Results, names: Sequence[str]) -> None:
    """
    CPU milliseconds of an update by part: one stacked bar for each setting.

    :param results: Of the section ``profile``
    :param names: Of the parts
    """
    rows = [row for row in results.rows if row["status"] == "ok"]
    if not rows:
        return
    pyplot = _pyplot()
    figure, axes = pyplot.subplots(figsize=(10.0, 1.6 + 0.7 * len(rows)), layout="constrained")
    left = [0.0] * len(rows)
    longest = max(row["ms, wrapped"] for row in rows)
    colors = pyplot.get_cmap("tab20").colors
    for index, name in enumerate(names):
        widths = [row[name] for row in rows]
        bars = axes.barh([row["contestant"] for row in rows], widths, left=left, label=name, color=colors[2 * index % 20])
        labels = [f"{width:.1f}" if width > 0.04 * longest else "" for width in widths]
        axes.bar_label(bars, labels, label_type="center", fontsize=8)
        left = [start + width for start, width in zip(left, widths, strict=True)]
    axes.invert_yaxis()
    axes.set(xlabel="CPU milliseconds of one update")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=5, fontsize=8, frameon=False)
    _save(figure, results.folder / "profile.png")


def scaling(results: Results, axes_names: Sequence[str], of_predictions: Sequence[str]) -> None:
    """
    One panel for each size.

    :param results: Of the section ``scaling``
    :param axes_names: Names of the sizes, one panel for each
    :param of_predictions: Those of a prediction; the others are those of an update
    """
    pyplot = _pyplot()
    figure, panels = pyplot.subplots(2, 3, figsize=(12.0, 7.2), layout="constrained")
    names = list(dict.fromkeys(row["contestant"] for row in results.rows if row["status"] == "ok"))
    lines: dict[str, Any] = {}
    for panel, axis in zip(panels.flat, axes_names, strict=True):
        for index, name in enumerate(names):
            points = [
                (row["value"], row["ms"]) for row in results.rows if row.get("axis") == axis and row["contestant"] == name
            ]
            if points:
                style = {"color": f"C{index}", "marker": "o", "linestyle": "--" if name == DIFFUSION_QL else "-"}
                (lines[name],) = panel.plot(*zip(*points, strict=True), **style)
        ticks = sorted({row["value"] for row in results.rows if row.get("axis") == axis})
        panel.set_xscale("log")
        panel.set_xticks(ticks, [str(tick) for tick in ticks])
        panel.minorticks_off()
        panel.set(ylim=(0.0, None), xlabel=AXIS_LABELS[axis])
        panel.set_ylabel(f"CPU ms of one {'prediction' if axis in of_predictions else 'update'}")
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(alpha=0.25)
    figure.legend(lines.values(), lines.keys(), loc="outside upper center", ncols=3, frameon=False)
    _save(figure, results.folder / "scaling.png")
