"""Causal graphs as nodes and arrows, in the order of time."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_causalgdp.causal.edges import EDGE_PROBABILITY, Edge
from sb3_causalgdp.causal.graph import PLOTS_HINT, CausalGraph
from sb3_causalgdp.causal.plots.arrangement import order_of_layers
from sb3_causalgdp.causal.plots.figures import AS_TEXT, FONT_SIZE, ROW_INCHES, label_inches
from sb3_causalgdp.causal.plots.heat_maps import say_nothing_is_known
from sb3_causalgdp.causal.plots.view import View, view_of
from sb3_causalgdp.causal.variables import TransitionVariables

try:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import FancyArrowPatch, Rectangle
    from matplotlib.path import Path
except ImportError as error:
    raise ImportError(PLOTS_HINT) from error

POSITIVE, NEGATIVE, UNSIGNED = "#b2182b", "#2166ac", "#b3441c"
NODE_COLOURS = {"state": "#e8e8e8", "action": "#fde0b2", "next state": "#d9ecd2", "reward": "#fff3a8"}
DASHES = (0, (4, 2))
GAP_INCHES = 2.0  # between the layers


def plot_graph(graph: CausalGraph, axes: Axes | None = None, view: View | None = None, **options: Any) -> Axes:
    """
    Draw the strongest causes of every effect in layers: s_t and a_t left, s_{t+1} in the middle, the reward right.

    The width of an arrow is the size of its effect, its colour the sign. It is the fainter the less is sure: the mask times
    the share of the effect beyond two standard errors. A dashed arrow is the likeliest cause of an effect without an edge.

    :param graph: The graph
    :param axes: Where to draw; a new figure by default
    :param view: What is drawn; ``causes`` says how many arrows end at one effect
    :param options: Fields of the view by name
    :return: the axes
    :raises ValueError: on an argument out of range
    """
    view = view_of(view, options)
    summary = view.summary_of(graph)
    shown = summary(graph)
    variables = shown.variables
    if axes is None:
        axes = Figure(figsize=view.size_or(*layered_size(variables)), layout="constrained").add_subplot()
    edges = sorted(shown.strongest_edges(view.causes, 2 * view.causes), key=lambda edge: abs(edge.strength))
    if not graph.is_discovered:
        edges = []
    positions = _positions(variables, edges)
    _draw_names(variables, positions, axes)
    axes.set_axis_off()
    remark = f"\n({summary.remark})" if summary.remark else ""
    if not graph.is_discovered:
        axes.set_title(f"Causal graph{remark}", fontsize=FONT_SIZE + 2)
        say_nothing_is_known(axes)
        return axes
    largest = min(max((abs(edge.strength) for edge in edges), default=1.0) or 1.0, 1.0)
    _draw_edges(edges, positions, label_inches(variables) / 2, axes, largest, summary.is_grouped)
    what = f"The strongest causes of each of the {variables.n_states + 1} {'groups' if summary.is_grouped else 'effects'}"
    axes.set_title(f"{what}{remark}", fontsize=FONT_SIZE + 2)
    axes.legend(
        handles=_edge_legend(edges, largest, summary.is_grouped),
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        ncols=5,
        frameon=False,
        fontsize=FONT_SIZE,
        handlelength=2.4,
    )
    return axes


def _draw_edges(
    edges: Sequence[Edge],
    positions: dict[str, tuple[float, float]],
    half_width: float,
    axes: Axes,
    largest: float,
    is_grouped: bool,
) -> None:
    """Arrows from the right side of a cause's box to the left side of its effect's, the strongest on top."""
    for number, edge in enumerate(edges):
        weight = min(abs(edge.strength) / largest, 1.0)
        is_sure = edge.mask > EDGE_PROBABILITY
        axes.add_patch(
            FancyArrowPatch(
                path=_path(positions, edge, half_width),
                arrowstyle="-|>",
                mutation_scale=6 + 5 * weight,
                linewidth=_edge_width(weight),
                linestyle="-" if is_sure else DASHES,
                color=UNSIGNED if is_grouped else NEGATIVE if edge.strength < 0 else POSITIVE,
                alpha=_edge_opacity(edge),
                zorder=1 + number / (len(edges) + 1),
                capstyle="butt",
                fill=True,
            )
        )


def _path(positions: dict[str, tuple[float, float]], edge: Edge, half_width: float) -> Path:
    """Leaves and arrives level; from an action to the reward it passes between the boxes of the next states."""
    (x, y), (to_x, to_y) = positions[edge.cause], positions[edge.effect]
    x, to_x = x + half_width, to_x - half_width
    middle = (x + to_x) / 2
    if to_x - x <= GAP_INCHES + 1e-6:
        return Path([(x, y), (middle, y), (middle, to_y), (to_x, to_y)], [Path.MOVETO, *[Path.CURVE4] * 3])
    gap = round((y + to_y) / 2 - 0.5) + 0.5
    near, far = x + GAP_INCHES, to_x - GAP_INCHES
    first, second = (x + near) / 2, (far + to_x) / 2
    points = [(x, y), (first, y), (first, gap), (near, gap), (far, gap), (second, gap), (second, to_y), (to_x, to_y)]
    return Path(points, [Path.MOVETO, *[Path.CURVE4] * 3, Path.LINETO, *[Path.CURVE4] * 3])


def _draw_names(variables: TransitionVariables, positions: dict[str, tuple[float, float]], axes: Axes) -> None:
    width = label_inches(variables)
    colours = _node_colours(variables)
    for name, (x, y) in positions.items():
        corner = (x - width / 2, y - 0.36)
        axes.add_patch(Rectangle(corner, width, 0.72, facecolor=colours[name], edgecolor="0.5", linewidth=0.8, zorder=3))
        axes.text(x, y, name, ha="center", va="center", fontsize=FONT_SIZE, zorder=4, **AS_TEXT)
    for layer, header in enumerate(("state and action, t", "state, t+1", "reward, t")):
        axes.text(layer * (width + GAP_INCHES), 1.0, header, ha="center", va="center", fontsize=FONT_SIZE, color="0.35")
    axes.set_xlim(-width / 2 - 0.5, 2.5 * width + 2 * GAP_INCHES + 0.5)
    axes.set_ylim(-(variables.n_states + variables.n_actions) + 0.3, 1.5)


def _edge_legend(edges: Sequence[Edge], largest: float, is_grouped: bool) -> list[Line2D]:
    def line(weight: float, colour: str, label: str, style: Any = "-") -> Line2D:
        return Line2D([], [], color=colour, linewidth=_edge_width(weight), linestyle=style, label=label)

    grey = "0.45"
    handles = [line(0.6, UNSIGNED, "effect")] if is_grouped else []
    handles += [] if is_grouped else [line(0.6, POSITIVE, "positive"), line(0.6, NEGATIVE, "negative")]
    handles += [line(weight, grey, f"{weight * largest:.1g} std") for weight in (0.1, 1.0)]
    if any(edge.mask <= EDGE_PROBABILITY for edge in edges):
        handles.append(line(0.3, grey, "probability below 0.5", DASHES))
    return handles


def _edge_width(weight: float) -> float:
    return 0.5 + 3.0 * weight


def _edge_opacity(edge: Edge) -> float:
    """By how sure the edge is, and the effect."""
    error = 0.0 if math.isnan(edge.standard_error) else edge.standard_error
    size = abs(edge.strength)
    certainty = edge.mask * (1.0 if size == 0.0 else max(1.0 - 2.0 * error / size, 0.0))
    return 0.15 + 0.75 * certainty


def _positions(variables: TransitionVariables, edges: Sequence[Edge]) -> dict[str, tuple[float, float]]:
    """Both layers in the order with few crossings, as high as each other, and the reward in the middle of its causes."""
    layer = label_inches(variables) + GAP_INCHES
    left, right = order_of_layers(variables, edges)
    n_rows = max(len(left), len(right))
    positions: dict[str, tuple[float, float]] = {}
    for column, names in enumerate((left, right)):
        # Whole rows, so that arrows find a gap between any two boxes
        rows = np.round((np.arange(len(names)) + 0.5) * n_rows / len(names) - 0.5)
        positions |= {name: (column * layer, -float(row)) for name, row in zip(names, rows, strict=True)}
    causes = [positions[edge.cause][1] for edge in edges if edge.effect == "reward"]
    positions["reward"] = (2 * layer, float(np.mean(causes)) if causes else -(n_rows - 1) / 2)
    return positions


def _node_colours(variables: TransitionVariables) -> dict[str, str]:
    colours = dict.fromkeys(variables.state_names, NODE_COLOURS["state"])
    colours |= dict.fromkeys(variables.action_names, NODE_COLOURS["action"])
    colours |= dict.fromkeys(variables.next_state_names, NODE_COLOURS["next state"])
    return colours | {"reward": NODE_COLOURS["reward"]}


def layered_size(variables: TransitionVariables) -> tuple[float, float]:
    rows = variables.n_states + variables.n_actions + 1
    return 1.2 + 2 * GAP_INCHES + 3 * label_inches(variables), 1.4 + max(2.0, ROW_INCHES * rows)
