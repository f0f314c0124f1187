"""Causal graphs as nodes and arrows, in the order of time."""

from collections.abc import Sequence

from sb3_causalgdp.causal.graph import PLOTS_HINT, CausalGraph, Edge
from sb3_causalgdp.causal.plots.figures import AS_TEXT, FONT_SIZE, ROW_INCHES, label_inches
from sb3_causalgdp.causal.plots.heat_maps import largest_value
from sb3_causalgdp.causal.plots.summary import Groups, summarize
from sb3_causalgdp.causal.variables import TransitionVariables

try:
    import networkx as nx
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Rectangle
except ImportError as error:
    raise ImportError(PLOTS_HINT) from error

POSITIVE, NEGATIVE, UNSIGNED = "#b2182b", "#2166ac", "#b3441c"
NODE_COLOURS = {"state": "#e8e8e8", "action": "#fde0b2", "next state": "#d9ecd2", "reward": "#fff3a8"}
GAP_INCHES = 2.0  # between the layers


def plot_graph(
    graph: CausalGraph,
    axes: Axes | None = None,
    max_variables: int = 40,
    *,
    max_edges: int = 80,
    groups: Groups = "auto",
    aggregate: str = "mean",
) -> Axes:
    """
    Draw the open edges in layers: s_t and a_t left, s_{t+1} in the middle, the reward right.

    Width and opacity of an edge are its mask (between groups: relative to the largest), its colour is the sign of its effect.

    :param graph: The graph
    :param axes: Where to draw; a new figure by default
    :param max_variables: More states and actions than this are summarised, see ``groups``
    :param max_edges: Draw at most this many edges, those with the largest masks, at least 1
    :param groups: How to summarise, see :func:`~sb3_causalgdp.causal.plots.summary.summarize`
    :param aggregate: ``"mean"`` or ``"max"`` of a group's entries
    :return: the axes
    :raises ValueError: on an argument out of range
    """
    if max_edges < 1:
        raise ValueError(f"max_edges must be at least 1, got {max_edges!r}")
    summary = summarize(graph, max_variables, groups, aggregate)
    shown = summary(graph)
    variables = shown.variables
    if axes is None:
        axes = Figure(figsize=layered_size(variables), layout="constrained").add_subplot()
    positions = _positions(variables)
    largest = largest_value([shown], "masks", summary.is_grouped)
    edges = sorted(shown.edges(), key=lambda edge: edge.mask)[-max_edges:]
    _draw_edges(edges, positions, label_inches(variables) / 2, axes, largest, summary.is_grouped)
    _draw_names(variables, positions, axes)
    axes.set_axis_off()
    remark = f"\n({summary.remark})" if summary.remark else ""
    count = f"{len(edges)} edges" if len(edges) == shown.n_edges else f"the {len(edges)} strongest of {shown.n_edges} edges"
    axes.set_title(f"Causal graph: {count}{remark}", fontsize=FONT_SIZE + 2)
    axes.legend(
        handles=_edge_legend(largest, summary.is_grouped),
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        ncols=3,
        frameon=False,
        fontsize=FONT_SIZE,
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
    """Arrows from the right side of a cause's box to the left side of its effect's, the last on top."""
    weights = [edge.mask / largest for edge in edges]
    ends = [(("right", edge.cause), ("left", edge.effect)) for edge in edges]
    side_positions = {("right", name): (x + half_width, y) for name, (x, y) in positions.items()}
    side_positions |= {("left", name): (x - half_width, y) for name, (x, y) in positions.items()}
    nx.draw_networkx_edges(
        nx.DiGraph(ends),
        side_positions,
        edgelist=ends,
        ax=axes,
        width=[_edge_width(weight) for weight in weights],
        alpha=[_edge_opacity(weight) for weight in weights],
        edge_color=[UNSIGNED if is_grouped else NEGATIVE if edge.strength < 0 else POSITIVE for edge in edges],
        node_size=0,
        arrowsize=9,
    )


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
    axes.set_ylim(-(variables.n_states + variables.n_actions) - 0.2, 1.5)


def _edge_legend(largest: float, is_grouped: bool) -> list[Line2D]:
    def line(weight: float, colour: str, label: str) -> Line2D:
        return Line2D([], [], color=colour, linewidth=_edge_width(weight), alpha=_edge_opacity(weight), label=label)

    if is_grouped:
        return [line(weight, UNSIGNED, f"mask {weight * largest:.2g}") for weight in (0.2, 1.0)]
    return [line(1.0, POSITIVE, "positive effect"), line(1.0, NEGATIVE, "negative effect"), line(0.2, "0.4", "mask 0.2")]


def _edge_width(weight: float) -> float:
    return 0.4 + 2.2 * weight


def _edge_opacity(weight: float) -> float:
    return 0.25 + 0.65 * weight


def _positions(variables: TransitionVariables) -> dict[str, tuple[float, float]]:
    """Next states stand beside their states, the reward beside the actions, so that a -> r passes below s_{t+1}."""
    layer = label_inches(variables) + GAP_INCHES
    first_action = variables.n_states + 0.5
    positions = {name: (0.0, -float(i)) for i, name in enumerate(variables.state_names)}
    positions |= {name: (0.0, -first_action - i) for i, name in enumerate(variables.action_names)}
    positions |= {name: (layer, -float(i)) for i, name in enumerate(variables.next_state_names)}
    positions["reward"] = (2 * layer, -first_action - (variables.n_actions - 1) / 2)
    return positions


def _node_colours(variables: TransitionVariables) -> dict[str, str]:
    colours = dict.fromkeys(variables.state_names, NODE_COLOURS["state"])
    colours |= dict.fromkeys(variables.action_names, NODE_COLOURS["action"])
    colours |= dict.fromkeys(variables.next_state_names, NODE_COLOURS["next state"])
    return colours | {"reward": NODE_COLOURS["reward"]}


def layered_size(variables: TransitionVariables) -> tuple[float, float]:
    rows = variables.n_states + variables.n_actions + 2
    return 1.2 + 2 * GAP_INCHES + 3 * label_inches(variables), 1.4 + max(2.0, ROW_INCHES * rows)
