"""A causal graph as a heat map, a layered graph, or both."""

import os

from matplotlib.figure import Figure

from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.plots.figures import check_choice, check_suffix, save_figure
from sb3_causalgdp.causal.plots.heat_maps import heat_map_size, plot_heat_map
from sb3_causalgdp.causal.plots.layered_graphs import layered_size, plot_graph
from sb3_causalgdp.causal.plots.summary import Groups, summarize

KINDS = ("both", "heat_map", "graph")


def plot_causal_graph(
    graph: CausalGraph,
    path: str | os.PathLike[str] | None = None,
    kind: str = "both",
    max_variables: int = 40,
    *,
    values: str = "masks",
    groups: Groups = "auto",
    aggregate: str = "mean",
) -> Figure:
    """
    Draw a causal graph as a heat map, as a layered graph, or both side by side.

    :param graph: The graph
    :param path: Image file to write, by its suffix; its folder is created; None writes nothing
    :param kind: ``"heat_map"``, ``"graph"`` or ``"both"``
    :param max_variables: More states and actions than this are summarised, see ``groups``
    :param values: What the heat map's colours are: ``"masks"``, with the signs of the effects, or ``"effects"``
    :param groups: How to summarise, see :func:`~sb3_causalgdp.causal.plots.summary.summarize`
    :param aggregate: ``"mean"`` or ``"max"`` of a group's entries
    :return: the figure
    :raises ValueError: on an argument out of range, or a suffix that is not an image's
    """
    check_choice("kind", kind, KINDS)
    check_suffix(path)
    summary = summarize(graph, max_variables, groups, aggregate)
    sizes = {"heat_map": heat_map_size(summary.variables), "graph": layered_size(summary.variables)}
    chosen = [kind] if kind != "both" else ["heat_map", "graph"]
    widths, heights = zip(*(sizes[name] for name in chosen), strict=True)
    figure = Figure(figsize=(sum(widths), max(heights)), layout="constrained")
    all_axes = figure.subplots(1, len(chosen), squeeze=False, width_ratios=widths)[0]
    for name, axes in zip(chosen, all_axes, strict=True):
        if name == "heat_map":
            plot_heat_map(graph, axes, max_variables, values=values, groups=groups, aggregate=aggregate)
        else:
            plot_graph(graph, axes, max_variables, groups=groups, aggregate=aggregate)
    save_figure(figure, path)
    return figure
