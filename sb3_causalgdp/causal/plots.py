import os

import numpy as np

from sb3_causalgdp.causal.graph import PLOTS_HINT, CausalGraph
from sb3_causalgdp.causal.variables import TransitionVariables

try:
    import networkx as nx
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Rectangle
except ImportError as error:
    raise ImportError(PLOTS_HINT) from error

KINDS = ("both", "heat_map", "graph")
COLOUR_MAP = "RdBu_r"
POSITIVE, NEGATIVE = "#b2182b", "#2166ac"  # the ends of the colour map
NODE_COLOURS = {"state": "#e8e8e8", "action": "#fde0b2", "next state": "#d9ecd2", "reward": "#fff3a8"}
FONT_SIZE = 9
INCHES_PER_CHARACTER = 0.095  # at FONT_SIZE, on the generous side
ROW_INCHES = 0.34
GAP_INCHES = 2.0  # between the layers


def plot_causal_graph(
    graph: CausalGraph, path: str | os.PathLike[str] | None = None, kind: str = "both", max_variables: int = 40
) -> Figure:
    """
    Draw a causal graph as a heat map, as a layered graph, or both side by side.

    :param graph: The graph
    :param path: Image file to write, by its suffix; None writes nothing
    :param kind: ``"heat_map"``, ``"graph"`` or ``"both"``
    :param max_variables: Draw at most this many states and actions, those with the largest total mask
    :return: the figure
    :raises ValueError: on an unknown kind or a ``max_variables`` below 2
    """
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {KINDS}, got {kind!r}")
    shown, _ = _most_connected(graph, max_variables)
    drawers = {"heat_map": (plot_heat_map, _heat_map_size), "graph": (plot_graph, _layered_size)}
    chosen = [drawers[name] for name in (("heat_map", "graph") if kind == "both" else (kind,))]
    sizes = [size(shown.variables) for _, size in chosen]
    figure = Figure(figsize=(sum(width for width, _ in sizes), max(height for _, height in sizes)), layout="constrained")
    all_axes = figure.subplots(1, len(chosen), squeeze=False, width_ratios=[width for width, _ in sizes])[0]
    for (draw, _), axes in zip(chosen, all_axes, strict=True):
        draw(graph, axes, max_variables)
    if path is not None:
        figure.savefig(path, dpi=120)
    return figure


def plot_heat_map(graph: CausalGraph, axes: Axes | None = None, max_variables: int = 40) -> Axes:
    """
    Draw the masks as a heat map: a column per cause, a row per effect, the colour is the mask with the weight's sign.

    :param graph: The graph
    :param axes: Where to draw; a new figure by default
    :param max_variables: Draw at most this many states and actions, those with the largest total mask
    :return: the axes
    """
    shown, remark = _most_connected(graph, max_variables)
    variables = shown.variables
    if axes is None:
        axes = Figure(figsize=_heat_map_size(variables), layout="constrained").add_subplot()
    masks = np.where(shown.weights < 0, -shown.masks, shown.masks)
    image = axes.imshow(masks, cmap=COLOUR_MAP, vmin=-1, vmax=1, aspect="auto")
    causes = (*variables.state_names, *variables.action_names)
    effects = (*variables.next_state_names, "reward")
    axes.set_xticks(range(len(causes)), causes, rotation=90, fontsize=FONT_SIZE)
    axes.set_yticks(range(len(effects)), effects, fontsize=FONT_SIZE)
    axes.set_xticks(np.arange(len(causes) + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(effects) + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="0.9", linewidth=0.5)
    axes.tick_params(which="both", length=0)
    axes.axvline(variables.n_states - 0.5, color="black", linewidth=1)
    axes.axhline(variables.n_states - 0.5, color="black", linewidth=1)
    axes.set_xlabel("cause (for the reward row: the next state, and the action)")
    axes.set_ylabel("effect")
    axes.set_title(f"Causal masks{remark}", fontsize=FONT_SIZE + 2)
    bar = axes.figure.colorbar(image, ax=axes, fraction=0.04, pad=0.02)
    bar.set_label("mask, signed by the weight")
    return axes


def plot_graph(graph: CausalGraph, axes: Axes | None = None, max_variables: int = 40) -> Axes:
    """
    Draw the open edges in layers: s_t and a_t left, s_{t+1} in the middle, the reward right.

    Width and opacity of an edge are its mask, its colour is the sign of its weight.

    :param graph: The graph
    :param axes: Where to draw; a new figure by default
    :param max_variables: Draw at most this many states and actions, those with the largest total mask
    :return: the axes
    """
    shown, remark = _most_connected(graph, max_variables)
    variables = shown.variables
    if axes is None:
        axes = Figure(figsize=_layered_size(variables), layout="constrained").add_subplot()
    positions = _positions(variables)
    _draw_edges(shown.to_networkx(), positions, _label_inches(variables) / 2, axes)
    _draw_names(variables, positions, axes)
    axes.set_axis_off()
    axes.set_title(f"Causal graph: {shown.n_edges} edges{remark}", fontsize=FONT_SIZE + 2)
    axes.legend(
        handles=[
            Line2D([], [], color=POSITIVE, linewidth=_edge_width(1.0), label="positive weight"),
            Line2D([], [], color=NEGATIVE, linewidth=_edge_width(1.0), label="negative weight"),
            Line2D([], [], color="0.4", linewidth=_edge_width(0.2), alpha=_edge_opacity(0.2), label="mask 0.2"),
        ],
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        ncols=3,
        frameon=False,
        fontsize=FONT_SIZE,
    )
    return axes


def _draw_edges(network: nx.DiGraph, positions: dict[str, tuple[float, float]], half_width: float, axes: Axes) -> None:
    """Arrows from the right side of a cause's box to the left side of its effect's; strong ones on top."""
    edges = sorted(network.edges(data=True), key=lambda edge: edge[2]["mask"])
    masks = [attributes["mask"] for _, _, attributes in edges]
    sides = nx.DiGraph()
    sides.add_edges_from((("right", cause), ("left", effect)) for cause, effect, _ in edges)
    side_positions = {("right", name): (x + half_width, y) for name, (x, y) in positions.items()}
    side_positions |= {("left", name): (x - half_width, y) for name, (x, y) in positions.items()}
    nx.draw_networkx_edges(
        sides,
        side_positions,
        edgelist=[(("right", cause), ("left", effect)) for cause, effect, _ in edges],
        ax=axes,
        width=[_edge_width(mask) for mask in masks],
        alpha=[_edge_opacity(mask) for mask in masks],
        edge_color=[NEGATIVE if attributes["weight"] < 0 else POSITIVE for _, _, attributes in edges],
        node_size=0,
        arrowsize=9,
    )


def _draw_names(variables: TransitionVariables, positions: dict[str, tuple[float, float]], axes: Axes) -> None:
    width = _label_inches(variables)
    colours = _node_colours(variables)
    for name, (x, y) in positions.items():
        corner = (x - width / 2, y - 0.36)
        axes.add_patch(Rectangle(corner, width, 0.72, facecolor=colours[name], edgecolor="0.5", linewidth=0.8, zorder=3))
        axes.text(x, y, name, ha="center", va="center", fontsize=FONT_SIZE, zorder=4)
    for layer, header in enumerate(("state and action, t", "state, t+1", "reward, t")):
        axes.text(layer * (width + GAP_INCHES), 1.0, header, ha="center", va="center", fontsize=FONT_SIZE, color="0.35")
    axes.set_xlim(-width / 2 - 0.5, 2.5 * width + 2 * GAP_INCHES + 0.5)
    axes.set_ylim(-(variables.n_states + variables.n_actions) - 0.2, 1.5)


def _edge_width(mask: float) -> float:
    return 0.4 + 2.2 * mask


def _edge_opacity(mask: float) -> float:
    return 0.25 + 0.65 * mask


def _positions(variables: TransitionVariables) -> dict[str, tuple[float, float]]:
    """Next states stand beside their states, the reward beside the actions, so that a -> r passes below s_{t+1}."""
    layer = _label_inches(variables) + GAP_INCHES
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


def _label_inches(variables: TransitionVariables) -> float:
    return INCHES_PER_CHARACTER * max(map(len, variables.names))


def _heat_map_size(variables: TransitionVariables) -> tuple[float, float]:
    label = _label_inches(variables)
    width = 2.0 + label + max(3.4, ROW_INCHES * (variables.n_states + variables.n_actions))
    return width, 1.2 + label + max(2.0, ROW_INCHES * (variables.n_states + 1))


def _layered_size(variables: TransitionVariables) -> tuple[float, float]:
    rows = variables.n_states + variables.n_actions + 2
    return 1.2 + 2 * GAP_INCHES + 3 * _label_inches(variables), 1.4 + max(2.0, ROW_INCHES * rows)


def _most_connected(graph: CausalGraph, max_variables: int) -> tuple[CausalGraph, str]:
    """The graph of the states and actions with the largest total mask, in their order, and a remark for the title."""
    if max_variables < 2:
        raise ValueError(f"max_variables must be at least 2, got {max_variables!r}")
    variables = graph.variables
    n_states, n_variables = variables.n_states, variables.n_states + variables.n_actions
    if n_variables <= max_variables:
        return graph, ""
    masks, weights = graph.masks, graph.weights
    total = masks.sum(axis=0)
    total[:n_states] += masks[:n_states].sum(axis=1)
    # A graph needs a state and an action: the best of each come first, whatever their total
    total[total[:n_states].argmax()] = total[n_states + total[n_states:].argmax()] = np.inf
    kept = np.sort(np.argsort(-total, kind="stable")[:max_variables])
    effects = np.append(kept[kept < n_states], n_states)
    names = (*variables.state_names, *variables.action_names)
    shown = CausalGraph.from_matrices(
        TransitionVariables(tuple(names[i] for i in kept if i < n_states), tuple(names[i] for i in kept if i >= n_states)),
        masks[np.ix_(effects, kept)],
        weights[np.ix_(effects, kept)],
        method=graph.method,
        n_samples=graph.n_samples,
    )
    return shown, f"\n(the {len(kept)} states and actions with the largest total mask, of {n_variables})"
