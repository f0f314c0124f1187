import os
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from sb3_causalgdp.causal.graph import PLOTS_HINT, CausalGraph, Edge, replaced_when_done
from sb3_causalgdp.causal.summary import Groups, Summary, summarize
from sb3_causalgdp.causal.variables import TransitionVariables

try:
    import networkx as nx
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.colors import LinearSegmentedColormap, Normalize, PowerNorm
    from matplotlib.figure import Figure, SubFigure
    from matplotlib.image import AxesImage
    from matplotlib.lines import Line2D
    from matplotlib.patches import Rectangle
    from matplotlib.ticker import EngFormatter, MaxNLocator
    from PIL import Image
except ImportError as error:
    raise ImportError(PLOTS_HINT) from error

KINDS = ("both", "heat_map", "graph")
VALUES = ("masks", "effects")
COLOUR_MAP = "RdBu_r"
GROUP_COLOURS = ("white", "#fdd49e", "#fc8d59", "#d7301f", "#7f0000")  # without a sign
POSITIVE, NEGATIVE, UNSIGNED = "#b2182b", "#2166ac", "#b3441c"
NODE_COLOURS = {"state": "#e8e8e8", "action": "#fde0b2", "next state": "#d9ecd2", "reward": "#fff3a8"}
FONT_SIZE = 9
INCHES_PER_CHARACTER = 0.095  # at FONT_SIZE, on the generous side
ROW_INCHES = 0.34
GAP_INCHES = 2.0  # between the layers
DPI, GIF_DPI = 120, 80
MAX_NUMBERED_CAUSES = 6  # of a heat map whose cells hold an effect and its standard error


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
    :param groups: How to summarise, see :func:`~sb3_causalgdp.causal.summary.summarize`
    :param aggregate: ``"mean"`` or ``"max"`` of a group's entries
    :return: the figure
    :raises ValueError: on an argument out of range, or a suffix that is not an image's
    """
    _check_choice("kind", kind, KINDS)
    _check_suffix(path)
    summary = summarize(graph, max_variables, groups, aggregate)
    sizes = {"heat_map": _heat_map_size(summary.variables), "graph": _layered_size(summary.variables)}
    chosen = [kind] if kind != "both" else ["heat_map", "graph"]
    widths, heights = zip(*(sizes[name] for name in chosen), strict=True)
    figure = Figure(figsize=(sum(widths), max(heights)), layout="constrained")
    all_axes = figure.subplots(1, len(chosen), squeeze=False, width_ratios=widths)[0]
    for name, axes in zip(chosen, all_axes, strict=True):
        if name == "heat_map":
            plot_heat_map(graph, axes, max_variables, values=values, groups=groups, aggregate=aggregate)
        else:
            plot_graph(graph, axes, max_variables, groups=groups, aggregate=aggregate)
    _save(figure, path)
    return figure


def plot_heat_map(
    graph: CausalGraph,
    axes: Axes | None = None,
    max_variables: int = 40,
    *,
    values: str = "masks",
    groups: Groups = "auto",
    aggregate: str = "mean",
) -> Axes:
    """
    Draw a heat map: a column per cause, a row per effect, the colour is the mask with the effect's sign, or the effect.

    Groups of variables have lost the signs; the scale then ends at the largest value. Where effects are drawn, a dot marks
    those that are smaller than two of their standard errors.

    :param graph: The graph
    :param axes: Where to draw; a new figure by default
    :param max_variables: More states and actions than this are summarised, see ``groups``
    :param values: What the colours are: ``"masks"``, with the signs of the effects, or ``"effects"``
    :param groups: How to summarise, see :func:`~sb3_causalgdp.causal.summary.summarize`
    :param aggregate: ``"mean"`` or ``"max"`` of a group's entries
    :return: the axes
    :raises ValueError: on an argument out of range
    """
    _check_choice("values", values, VALUES)
    summary = summarize(graph, max_variables, groups, aggregate)
    shown = summary(graph)
    if axes is None:
        axes = Figure(figsize=_heat_map_size(shown.variables), layout="constrained").add_subplot()
    image = _draw_matrix(shown, axes, values, summary.is_grouped, _largest([shown], values, summary.is_grouped))
    _name_causes(shown.variables, axes)
    _name_effects(shown.variables, axes)
    axes.set_xlabel("cause (for the reward row: the next state, and the action)")
    axes.set_ylabel("effect")
    remark = f"\n({summary.remark})" if summary.remark else ""
    axes.set_title(f"Causal {values}{remark}", fontsize=FONT_SIZE + 2)
    if summary.is_grouped:
        _number_groups(image, axes)
    elif values == "effects" and shown.standard_errors is not None:
        _show_standard_errors(shown, axes)
    bar = axes.figure.colorbar(image, ax=axes, fraction=0.04, pad=0.02)
    bar.set_label(_scale_label(values, summary))
    return axes


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
    :param groups: How to summarise, see :func:`~sb3_causalgdp.causal.summary.summarize`
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
        axes = Figure(figsize=_layered_size(variables), layout="constrained").add_subplot()
    positions = _positions(variables)
    largest = _largest([shown], "masks", summary.is_grouped)
    edges = sorted(shown.edges(), key=lambda edge: edge.mask)[-max_edges:]
    _draw_edges(edges, positions, _label_inches(variables) / 2, axes, largest, summary.is_grouped)
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


def plot_history(
    graphs: Sequence[CausalGraph],
    path: str | os.PathLike[str] | None = None,
    max_variables: int = 40,
    *,
    max_panels: int = 8,
    threshold: float = 0.5,
    values: str = "masks",
    groups: Groups = "auto",
    aggregate: str = "mean",
) -> Figure:
    """
    Draw how the graph changed over training: heat maps of some of the graphs, evenly chosen, on one colour scale, and beside
    them the number of edges and the change since the graph before, of all graphs.

    :param graphs: Graphs over the same variables, oldest first, at least one
    :param path: Image file to write, by its suffix; its folder is created; None writes nothing
    :param max_variables: More states and actions than this are summarised, see ``groups``
    :param max_panels: Draw at most this many heat maps, from 1 to 8; two or more show the first and the last graph
    :param threshold: Masks above it are counted as edges, in [0, 1)
    :param values: What the colours are: ``"masks"``, with the signs of the effects, or ``"effects"``
    :param groups: How to summarise, see :func:`~sb3_causalgdp.causal.summary.summarize`
    :param aggregate: ``"mean"`` or ``"max"`` of a group's entries
    :return: the figure
    :raises ValueError: on an argument out of range, graphs over different variables, or a suffix that is not an image's
    """
    _check_choice("values", values, VALUES)
    _check_suffix(path)
    if not 1 <= max_panels <= 8:
        raise ValueError(f"max_panels must be from 1 to 8, got {max_panels!r}")
    _check_threshold(threshold)
    summary = _summary_of_history(graphs, max_variables, groups, aggregate)
    n_panels = min(max_panels, len(graphs))
    chosen = np.linspace(len(graphs) - 1, 0, n_panels).round().astype(int)[::-1]
    panels = [(_moment(graphs, number), summary(graphs[number])) for number in chosen]
    n_rows = 1 if n_panels <= 4 else 2
    n_columns = -(-n_panels // n_rows)
    width, height = _panel_size(summary.variables)
    figure = Figure(figsize=(n_columns * width + 5.0, max(4.4, n_rows * height + 0.8)), layout="constrained")
    maps, curves = figure.subfigures(1, 2, squeeze=False, width_ratios=(n_columns * width + 0.6, 4.4))[0]
    _draw_panels(panels, maps, n_rows, n_columns, values, summary)
    _draw_curves(graphs, curves, threshold)
    remark = f" ({summary.remark})" if summary.remark else ""
    maps.suptitle(f"Causal {values} over training{remark}", fontsize=FONT_SIZE + 2)
    _save(figure, path)
    return figure


def animate_history(
    graphs: Sequence[CausalGraph],
    path: str | os.PathLike[str],
    max_variables: int = 40,
    *,
    frames_per_second: float = 2.0,
    threshold: float = 0.5,
    values: str = "masks",
    groups: Groups = "auto",
    aggregate: str = "mean",
) -> None:
    """
    Write the graphs as an animated heat map, a frame for each, on one colour scale; the last one stays for two seconds.

    :param graphs: Graphs over the same variables, oldest first, at least one
    :param path: GIF to write; its folder is created
    :param max_variables: More states and actions than this are summarised, see ``groups``
    :param frames_per_second: Speed, above 0 and at most 50
    :param threshold: Masks above it are counted as edges, in [0, 1)
    :param values: What the colours are: ``"masks"``, with the signs of the effects, or ``"effects"``
    :param groups: How to summarise, see :func:`~sb3_causalgdp.causal.summary.summarize`
    :param aggregate: ``"mean"`` or ``"max"`` of a group's entries
    :raises ValueError: on an argument out of range, graphs over different variables, or another suffix
    """
    _check_choice("values", values, VALUES)
    _check_threshold(threshold)
    if os.path.splitext(path)[1].lower() != ".gif":
        raise ValueError(f"path must end in .gif, got {os.fspath(path)!r}")
    if not 0 < frames_per_second <= 50:
        raise ValueError(f"frames_per_second must be above 0 and at most 50, got {frames_per_second!r}")
    summary = _summary_of_history(graphs, max_variables, groups, aggregate)
    frames = [summary(graph) for graph in graphs]
    figure = Figure(figsize=_heat_map_size(summary.variables), layout="constrained")
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(GIF_DPI)
    axes = figure.add_subplot()
    largest = _largest(frames, values, summary.is_grouped)
    image = _draw_matrix(frames[0], axes, values, summary.is_grouped, largest)
    _name_causes(summary.variables, axes)
    _name_effects(summary.variables, axes)
    axes.set_xlabel("cause")
    axes.set_ylabel("effect")
    figure.colorbar(image, ax=axes, fraction=0.04, pad=0.02).set_label(_scale_label(values, summary))
    pictures = []
    for number, (graph, frame) in enumerate(zip(graphs, frames, strict=True)):
        image.set_data(_matrix(frame, values, summary.is_grouped))
        axes.set_title(f"{_moment(graphs, number)}: {_count(graph, threshold)} edges", fontsize=FONT_SIZE + 2)
        canvas.draw()
        # All frames keep the layout of the first
        figure.set_layout_engine("none")
        pictures.append(Image.fromarray(np.array(canvas.buffer_rgba())).convert("RGB"))
    milliseconds = [round(1000 / frames_per_second)] * (len(graphs) - 1) + [2000]
    with replaced_when_done(path) as temporary:
        pictures[0].save(temporary, format="GIF", save_all=True, append_images=pictures[1:], duration=milliseconds, loop=0)


# Heat maps --------------------------------------------------------------------------------------------------------------


def _matrix(shown: CausalGraph, values: str, is_grouped: bool) -> np.ndarray:
    """What the colours show, shape (n + 1, n + d)."""
    if values == "effects":
        return shown.effects
    return shown.masks if is_grouped else np.where(shown.effects < 0, -shown.masks, shown.masks)


def _largest(shown: Sequence[CausalGraph], values: str, is_grouped: bool) -> float:
    """The end of the colour scale."""
    if values == "masks" and not is_grouped:
        return 1.0
    return max(float(np.abs(_matrix(graph, values, is_grouped)).max()) for graph in shown) or 1.0


def _draw_matrix(shown: CausalGraph, axes: Axes, values: str, is_grouped: bool, largest: float) -> AxesImage:
    n_states = shown.variables.n_states
    image = axes.imshow(
        _matrix(shown, values, is_grouped),
        cmap=LinearSegmentedColormap.from_list("groups", GROUP_COLOURS) if is_grouped else COLOUR_MAP,
        # A few edges between two large groups have a small mean: the square root makes them visible
        norm=PowerNorm(0.5, 0.0, largest) if is_grouped else Normalize(-largest, largest),
        aspect="auto",
        interpolation="nearest",
    )
    bottom, right = n_states + 0.5, n_states + shown.variables.n_actions - 0.5
    axes.hlines(np.arange(n_states) + 0.5, -0.5, right, color="0.9", linewidth=0.5)
    axes.vlines(np.arange(right) + 0.5, -0.5, bottom, color="0.9", linewidth=0.5)
    axes.axvline(n_states - 0.5, color="black", linewidth=1)
    axes.axhline(n_states - 0.5, color="black", linewidth=1)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.set_xlim(-0.5, right)
    axes.set_ylim(bottom, -0.5)
    axes.tick_params(length=0)
    return image


def _name_causes(variables: TransitionVariables, axes: Axes, font_size: float = FONT_SIZE) -> None:
    causes = (*variables.state_names, *variables.action_names)
    axes.set_xticks(range(len(causes)), causes, rotation=90, fontsize=font_size)


def _name_effects(variables: TransitionVariables, axes: Axes, font_size: float = FONT_SIZE) -> None:
    effects = (*variables.next_state_names, "reward")
    axes.set_yticks(range(len(effects)), effects, fontsize=font_size)


def _number_groups(image: AxesImage, axes: Axes) -> None:
    """The values in the cells, where they are not rounded to zero."""
    matrix = np.asarray(image.get_array())
    for row, column in np.argwhere(matrix >= 0.005):
        dark = np.asarray(image.norm(matrix[row, column])) > 0.65
        text = f"{matrix[row, column]:.2f}".removeprefix("0")
        axes.text(column, row, text, ha="center", va="center", fontsize=FONT_SIZE - 2, color="white" if dark else "0.2")


def _show_standard_errors(shown: CausalGraph, axes: Axes) -> None:
    """As numbers where the cells have room for them, else as dots on the effects that are smaller than two of them."""
    assert shown.standard_errors is not None
    errors, effects = shown.standard_errors, shown.effects
    if effects.shape[1] <= MAX_NUMBERED_CAUSES:
        dark = np.abs(effects) > 0.6 * np.abs(effects).max()
        for row, column in np.ndindex(effects.shape):
            text = f"{effects[row, column]:+.2f}\n\u00b1{errors[row, column]:.2f}"
            colour = "white" if dark[row, column] else "0.2"
            axes.text(column, row, text, ha="center", va="center", fontsize=FONT_SIZE - 1, color=colour)
        return
    rows, columns = np.nonzero((np.abs(effects) < 2 * errors) & (effects != 0))
    axes.scatter(columns, rows, s=6, color="0.35", label="smaller than two standard errors")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=FONT_SIZE - 1, borderpad=0)


def _scale_label(values: str, summary: Summary) -> str:
    if summary.is_grouped:
        return f"{summary.aggregate} {'mask' if values == 'masks' else 'size of the effects'} between two groups"
    return "mask, signed by the effect" if values == "masks" else "effect, in standard deviations"


# Layered graphs ---------------------------------------------------------------------------------------------------------


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


# The history ------------------------------------------------------------------------------------------------------------


def _summary_of_history(graphs: Sequence[CausalGraph], max_variables: int, groups: Groups, aggregate: str) -> Summary:
    """One choice of variables for all graphs, by their mean masks."""
    if len(graphs) == 0:
        raise ValueError("graphs is empty: at least one is needed")
    if any(graph.variables != graphs[0].variables for graph in graphs):
        raise ValueError("graphs must be over the same variables")
    mean = replace(graphs[0], masks=np.mean([graph.masks for graph in graphs], axis=0))
    return summarize(mean, max_variables, groups, aggregate)


def _draw_panels(
    panels: Sequence[tuple[str, CausalGraph]], figure: SubFigure, n_rows: int, n_columns: int, values: str, summary: Summary
) -> None:
    """Heat maps under their titles, with names at the left and at the bottom."""
    all_axes = figure.subplots(n_rows, n_columns, squeeze=False)
    largest = _largest([shown for _, shown in panels], values, summary.is_grouped)
    for number, axes in enumerate(all_axes.flat):
        if number >= len(panels):
            axes.set_axis_off()
            continue
        title, shown = panels[number]
        image = _draw_matrix(shown, axes, values, summary.is_grouped, largest)
        if number % n_columns == 0:
            _name_effects(summary.variables, axes, FONT_SIZE - 2)
        if number + n_columns >= len(panels):
            _name_causes(summary.variables, axes, FONT_SIZE - 2)
        axes.set_title(title, fontsize=FONT_SIZE)
    bar = figure.colorbar(image, ax=all_axes, fraction=0.03, pad=0.02)
    bar.set_label(_scale_label(values, summary), fontsize=FONT_SIZE)
    bar.ax.tick_params(labelsize=FONT_SIZE - 1)
    figure.supxlabel("cause", fontsize=FONT_SIZE)
    figure.supylabel("effect", fontsize=FONT_SIZE)


def _draw_curves(graphs: Sequence[CausalGraph], figure: SubFigure, threshold: float) -> None:
    has_steps = _has_steps(graphs)
    at = [graph.num_timesteps if has_steps else number + 1 for number, graph in enumerate(graphs)]
    changes = [now.change_since(before) for before, now in pairwise(graphs)]
    upper, lower = figure.subplots(2, 1, sharex=True)
    counts = [_count(graph, threshold) for graph in graphs]
    upper.plot(at, counts, color="black", marker=".")
    upper.set_title(f"edges (mask > {threshold:g})", fontsize=FONT_SIZE)
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


def _count(graph: CausalGraph, threshold: float) -> int:
    return int(np.count_nonzero(graph.masks > threshold))


def _panel_size(variables: TransitionVariables) -> tuple[float, float]:
    """Width and height of one heat map in the history, in inches."""
    cell = 0.14
    return max(1.9, cell * (variables.n_states + variables.n_actions)), max(1.9, cell * (variables.n_states + 1) + 0.4)


# Files ------------------------------------------------------------------------------------------------------------------


def _check_choice(argument: str, given: str, known: Sequence[str]) -> None:
    if given not in known:
        raise ValueError(f"{argument} must be one of {known}, got {given!r}")


def _check_threshold(threshold: float) -> None:
    if not 0 <= threshold < 1:
        raise ValueError(f"threshold must be in [0, 1), got {threshold!r}")


def _check_suffix(path: str | os.PathLike[str] | None) -> None:
    if path is None:
        return
    known = sorted(FigureCanvasAgg.get_supported_filetypes())
    if os.path.splitext(path)[1].lower().lstrip(".") not in known:
        raise ValueError(f"path must end in one of .{', .'.join(known)}, got {os.fspath(path)!r}")


def _save(figure: Figure, path: str | os.PathLike[str] | None) -> None:
    """Write the picture; a reader sees the old file or the new one, never a half."""
    if path is not None:
        with replaced_when_done(path) as temporary:
            figure.savefig(temporary, dpi=DPI)
