"""How a causal graph changed over training, as a figure and as a film."""

import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from sb3_causalgdp.causal.description import count_of_edges
from sb3_causalgdp.causal.edges import EDGE_PROBABILITY
from sb3_causalgdp.causal.graph import PLOTS_HINT, CausalGraph
from sb3_causalgdp.causal.plots.figures import FONT_SIZE, check_suffix, save_figure
from sb3_causalgdp.causal.plots.heat_maps import (
    draw_matrix,
    heat_map_size,
    largest_value,
    matrix_of,
    name_causes,
    name_effects,
    opacity_of,
    scale_label,
)
from sb3_causalgdp.causal.plots.summary import Summary
from sb3_causalgdp.causal.plots.view import View, view_of
from sb3_causalgdp.causal.variables import TransitionVariables
from sb3_causalgdp.files import replaced_when_done

try:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.ticker import EngFormatter, MaxNLocator
    from PIL import Image
except ImportError as error:
    raise ImportError(PLOTS_HINT) from error

GIF_DPI = 80


def plot_history(
    graphs: Sequence[CausalGraph],
    path: str | os.PathLike[str] | None = None,
    view: View | None = None,
    *,
    max_panels: int = 8,
    **options: Any,
) -> Figure:
    """
    Draw how the graph changed over training: heat maps of some of the graphs, evenly chosen, on one colour scale, and beside
    them the number of edges and the change since the graph before, of all graphs.

    :param graphs: Graphs over the same variables, oldest first, at least one
    :param path: Image file to write, by its suffix; its folder is created; None writes nothing
    :param view: What is drawn
    :param max_panels: Draw at most this many heat maps, from 1 to 8; two or more show the first and the last graph
    :param options: Fields of the view by name
    :return: the figure
    :raises ValueError: on an argument out of range, graphs over different variables, or a suffix that is not an image's
    """
    view = view_of(view, options)
    check_suffix(path)
    if not 1 <= max_panels <= 8:
        raise ValueError(f"max_panels must be from 1 to 8, got {max_panels!r}")
    summary = _summary_of_history(graphs, view)
    n_panels = min(max_panels, len(graphs))
    chosen = np.linspace(len(graphs) - 1, 0, n_panels).round().astype(int)[::-1]
    panels = [(_moment(graphs, number), summary(graphs[number])) for number in chosen]
    n_rows = 1 if n_panels <= 4 else 2
    n_columns = -(-n_panels // n_rows)
    width, height = _panel_size(summary.variables)
    size = view.size_or(n_columns * width + 5.0, max(4.4, n_rows * height + 0.8))
    figure = Figure(figsize=size, layout="constrained")
    maps, curves = figure.subfigures(1, 2, squeeze=False, width_ratios=(n_columns * width + 0.6, 4.4))[0]
    _draw_panels(panels, maps, n_rows, n_columns, view, summary)
    _draw_curves(graphs, curves)
    remark = f" ({summary.remark})" if summary.remark else ""
    maps.suptitle(f"Causal {view.values} over training{remark}", fontsize=FONT_SIZE + 2)
    save_figure(figure, path)
    return figure


def animate_history(
    graphs: Sequence[CausalGraph],
    path: str | os.PathLike[str],
    view: View | None = None,
    *,
    frames_per_second: float = 2.0,
    **options: Any,
) -> None:
    """
    Write the graphs as an animated heat map, a frame for each, on one colour scale; the last one stays for two seconds.

    :param graphs: Graphs over the same variables, oldest first, at least one
    :param path: GIF to write; its folder is created
    :param view: What is drawn
    :param frames_per_second: Speed, above 0 and at most 50
    :param options: Fields of the view by name
    :raises ValueError: on an argument out of range, graphs over different variables, or another suffix
    """
    view = view_of(view, options)
    if os.path.splitext(path)[1].lower() != ".gif":
        raise ValueError(f"path must end in .gif, got {os.fspath(path)!r}")
    if not 0 < frames_per_second <= 50:
        raise ValueError(f"frames_per_second must be above 0 and at most 50, got {frames_per_second!r}")
    summary = _summary_of_history(graphs, view)
    frames = [summary(graph) for graph in graphs]
    figure = Figure(figsize=view.size_or(*heat_map_size(summary.variables)), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(GIF_DPI)
    axes = figure.add_subplot()
    largest = largest_value(frames, view, summary.is_grouped)
    image = draw_matrix(frames[0], axes, view, summary.is_grouped, largest)
    name_causes(summary.variables, axes)
    name_effects(summary.variables, axes)
    axes.set_xlabel("cause")
    axes.set_ylabel("effect")
    figure.colorbar(image, ax=axes, fraction=0.04, pad=0.02).set_label(scale_label(view, summary))
    pictures = []
    for number, (graph, frame) in enumerate(zip(graphs, frames, strict=True)):
        image.set_data(matrix_of(frame, view, summary.is_grouped))
        image.set_alpha(opacity_of(frame, view, summary.is_grouped))
        axes.set_title(f"{_moment(graphs, number)}: {count_of_edges(graph)}", fontsize=FONT_SIZE + 2)
        canvas.draw()
        # All frames keep the layout of the first
        figure.set_layout_engine("none")
        pictures.append(Image.fromarray(np.array(canvas.buffer_rgba())).convert("RGB"))
    milliseconds = [round(1000 / frames_per_second)] * (len(graphs) - 1) + [2000]
    with replaced_when_done(path) as temporary:
        pictures[0].save(temporary, format="GIF", save_all=True, append_images=pictures[1:], duration=milliseconds, loop=0)


def _summary_of_history(graphs: Sequence[CausalGraph], view: View) -> Summary:
    """One choice of variables for all graphs, by their mean masks."""
    if len(graphs) == 0:
        raise ValueError("graphs is empty: at least one is needed")
    if any(graph.variables != graphs[0].variables for graph in graphs):
        raise ValueError("graphs must be over the same variables")
    mean = replace(graphs[0], masks=np.mean([graph.masks for graph in graphs], axis=0))
    return view.summary_of(mean)


def _draw_panels(
    panels: Sequence[tuple[str, CausalGraph]], figure: SubFigure, n_rows: int, n_columns: int, view: View, summary: Summary
) -> None:
    """Heat maps under their titles, with names at the left and at the bottom."""
    all_axes = figure.subplots(n_rows, n_columns, squeeze=False)
    largest = largest_value([shown for _, shown in panels], view, summary.is_grouped)
    for number, axes in enumerate(all_axes.flat):
        if number >= len(panels):
            axes.set_axis_off()
            continue
        title, shown = panels[number]
        image = draw_matrix(shown, axes, view, summary.is_grouped, largest)
        if number % n_columns == 0:
            name_effects(summary.variables, axes, FONT_SIZE - 2)
        if number + n_columns >= len(panels):
            name_causes(summary.variables, axes, FONT_SIZE - 2)
        axes.set_title(title, fontsize=FONT_SIZE)
    bar = figure.colorbar(image, ax=all_axes, fraction=0.03, pad=0.02)
    bar.set_label(scale_label(view, summary), fontsize=FONT_SIZE)
    bar.ax.tick_params(labelsize=FONT_SIZE - 1)
    figure.supxlabel("cause", fontsize=FONT_SIZE)
    figure.supylabel("effect", fontsize=FONT_SIZE)


def _draw_curves(graphs: Sequence[CausalGraph], figure: SubFigure) -> None:
    has_steps = _has_steps(graphs)
    at = [graph.num_timesteps if has_steps else number + 1 for number, graph in enumerate(graphs)]
    changes = [now.change_since(before) for before, now in pairwise(graphs)]
    upper, lower = figure.subplots(2, 1, sharex=True)
    counts = [graph.n_edges for graph in graphs]
    upper.plot(at, counts, color="black", marker=".", label=f"with a probability above {EDGE_PROBABILITY:g}")
    upper.plot(at, [graph.expected_edges for graph in graphs], color="0.6", linestyle="--", label="expected")
    upper.set_title("edges", fontsize=FONT_SIZE)
    upper.legend(frameon=False, fontsize=FONT_SIZE - 1, loc="lower right")
    lower.plot(at[1:], changes, color="black", marker=".")
    lower.set_title("mean change of a mask since the graph before", fontsize=FONT_SIZE)
    lower.set_xlabel("environment steps" if has_steps else "number of the graph", fontsize=FONT_SIZE)
    for axes, curve in ((upper, counts), (lower, changes)):
        axes.set_ylim(0, 1.08 * max(curve, default=0) or 1)
        axes.grid(color="0.9", linewidth=0.5)
        axes.tick_params(labelsize=FONT_SIZE - 1)
        axes.spines[["top", "right"]].set_visible(False)
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    if has_steps:
        lower.xaxis.set_major_formatter(EngFormatter(sep=""))


def _has_steps(graphs: Sequence[CausalGraph]) -> bool:
    """Whether every graph knows when it was found, one after the other."""
    steps = [graph.num_timesteps for graph in graphs]
    return all(step is not None for step in steps) and bool(np.all(np.diff(np.array(steps, dtype=np.int64)) > 0))


def _moment(graphs: Sequence[CausalGraph], number: int) -> str:
    steps = graphs[number].num_timesteps
    return f"graph {number + 1} of {len(graphs)}" if steps is None else f"{steps:,} steps"


def _panel_size(variables: TransitionVariables) -> tuple[float, float]:
    """Width and height of one heat map in the history, in inches."""
    cell = 0.14
    return max(1.9, cell * (variables.n_states + variables.n_actions)), max(1.9, cell * (variables.n_states + 1) + 0.4)
