"""A causal graph as a heat map, a layered graph, or both."""

import os
from typing import Any

from matplotlib.figure import Figure

from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.plots.figures import check_choice, check_suffix, save_figure
from sb3_causalgdp.causal.plots.heat_maps import heat_map_size, plot_heat_map
from sb3_causalgdp.causal.plots.layered_graphs import layered_size, plot_graph
from sb3_causalgdp.causal.plots.view import View, view_of

KINDS = ("both", "heat_map", "graph")


def plot_causal_graph(
    graph: CausalGraph,
    path: str | os.PathLike[str] | None = None,
    kind: str = "both",
    view: View | None = None,
    **options: Any,
) -> Figure:
    """
    Draw a causal graph as a heat map, as a layered graph, or both side by side.

    :param graph: The graph
    :param path: Image file to write, by its suffix; its folder is created; None writes nothing
    :param kind: ``"heat_map"``, ``"graph"`` or ``"both"``
    :param view: What is drawn
    :param options: Fields of the view by name, such as ``values="masks"`` or ``causes=5``
    :return: the figure
    :raises ValueError: on an argument out of range, or a suffix that is not an image's
    """
    check_choice("kind", kind, KINDS)
    check_suffix(path)
    view = view_of(view, options)
    summary = view.summary_of(graph)
    sizes = {"heat_map": heat_map_size(summary.variables), "graph": layered_size(summary.variables)}
    chosen = [kind] if kind != "both" else ["heat_map", "graph"]
    widths, heights = zip(*(sizes[name] for name in chosen), strict=True)
    figure = Figure(figsize=view.size_or(sum(widths), max(heights)), layout="constrained")
    all_axes = figure.subplots(1, len(chosen), squeeze=False, width_ratios=widths)[0]
    for name, axes in zip(chosen, all_axes, strict=True):
        (plot_heat_map if name == "heat_map" else plot_graph)(graph, axes, view)
    save_figure(figure, path)
    return figure
