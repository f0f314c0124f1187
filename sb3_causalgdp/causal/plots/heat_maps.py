"""Causal graphs as matrices."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_causalgdp.causal.description import count_of_edges
from sb3_causalgdp.causal.edges import EDGE_PROBABILITY
from sb3_causalgdp.causal.graph import PLOTS_HINT, CausalGraph
from sb3_causalgdp.causal.plots.figures import AS_TEXT, FONT_SIZE, ROW_INCHES, label_inches
from sb3_causalgdp.causal.plots.summary import Summary
from sb3_causalgdp.causal.plots.view import View, view_of
from sb3_causalgdp.causal.variables import TransitionVariables

try:
    from matplotlib.axes import Axes
    from matplotlib.colors import LinearSegmentedColormap, Normalize, PowerNorm
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage
except ImportError as error:
    raise ImportError(PLOTS_HINT) from error

COLOUR_MAP = "RdBu_r"
GROUP_COLOURS = ("white", "#fdd49e", "#fc8d59", "#d7301f", "#7f0000")  # without a sign
MAX_NUMBERED_CAUSES = 6  # of a heat map whose cells hold an effect and its standard error


def plot_heat_map(graph: CausalGraph, axes: Axes | None = None, view: View | None = None, **options: Any) -> Axes:
    """
    Draw a heat map: a column per cause, a row per effect. The colour is the effect, the paler the less probable the edge is,
    or the mask with the effect's sign.

    Effects beyond one standard deviation have the darkest colour. A dot marks those that are smaller than two of their
    standard errors. Groups of variables have lost the signs; the scale then ends at the largest value.

    :param graph: The graph
    :param axes: Where to draw; a new figure by default
    :param view: What is drawn
    :param options: Fields of the view by name
    :return: the axes
    :raises ValueError: on an argument out of range
    """
    view = view_of(view, options)
    summary = view.summary_of(graph)
    shown = summary(graph)
    if axes is None:
        size = view.size_or(*heat_map_size(shown.variables))
        axes = Figure(figsize=size, layout="constrained").add_subplot()
    image = draw_matrix(shown, axes, view, summary.is_grouped, largest_value([shown], view, summary.is_grouped))
    name_causes(shown.variables, axes)
    name_effects(shown.variables, axes)
    axes.set_xlabel("cause (for the reward row: the next state, and the action)", fontsize=FONT_SIZE)
    axes.set_ylabel("effect", fontsize=FONT_SIZE)
    axes.set_title(title_of(f"Causal {view.values}", graph, summary), fontsize=FONT_SIZE + 2)
    if not graph.is_discovered:
        say_nothing_is_known(axes)
        return axes
    if summary.is_grouped:
        _number_groups(image, axes)
    elif view.values == "effects" and shown.standard_errors is not None:
        _show_standard_errors(shown, axes)
    is_cut = largest_value([shown], view, summary.is_grouped) < np.abs(matrix_of(shown, view, summary.is_grouped)).max()
    extend = ("max" if summary.is_grouped else "both") if is_cut else "neither"
    bar = axes.figure.colorbar(image, ax=axes, fraction=0.04, pad=0.02, extend=extend)
    bar.set_label(scale_label(view, summary), fontsize=FONT_SIZE)
    bar.ax.tick_params(labelsize=FONT_SIZE - 1)
    return axes


def title_of(what: str, graph: CausalGraph, summary: Summary) -> str:
    """What it is, how many edges the whole graph has, and what was summarised."""
    remark = f"\n({summary.remark})" if summary.remark else ""
    return f"{what}: {count_of_edges(graph)}{remark}"


def say_nothing_is_known(axes: Axes) -> None:
    """Instead of everything that would be open."""
    box = {"facecolor": "white", "edgecolor": "0.6", "boxstyle": "round,pad=0.6"}
    axes.text(
        0.5,
        0.5,
        "No discovery yet:\nevery edge is open, no effect is known",
        transform=axes.transAxes,
        ha="center",
        va="center",
        fontsize=FONT_SIZE + 1,
        color="0.3",
        bbox=box,
        zorder=6,
    )


def matrix_of(shown: CausalGraph, view: View, is_grouped: bool) -> np.ndarray:
    """What the colours show, shape (n + 1, n + d)."""
    if not shown.is_discovered:
        return np.zeros_like(shown.masks)
    if view.values == "effects":
        return shown.effects
    return shown.masks if is_grouped else np.where(shown.effects < 0, -shown.masks, shown.masks)


def opacity_of(shown: CausalGraph, view: View, is_grouped: bool) -> np.ndarray | None:
    """Effects that are probably none are pale; of groups, the effects are weighted already."""
    return shown.masks if view.values == "effects" and not is_grouped else None


def largest_value(shown: Sequence[CausalGraph], view: View, is_grouped: bool) -> float:
    """The end of the colour scale: of effects one standard deviation at most, so that a huge one does not hide all others."""
    if view.values == "masks" and not is_grouped:
        return 1.0
    largest = max(float(np.abs(matrix_of(graph, view, is_grouped)).max()) for graph in shown) or 1.0
    return min(largest, 1.0)


def draw_matrix(shown: CausalGraph, axes: Axes, view: View, is_grouped: bool, largest: float) -> AxesImage:
    n_states = shown.variables.n_states
    image = axes.imshow(
        matrix_of(shown, view, is_grouped),
        alpha=opacity_of(shown, view, is_grouped),
        cmap=LinearSegmentedColormap.from_list("groups", GROUP_COLOURS) if is_grouped else COLOUR_MAP,
        norm=_scale(view, is_grouped, largest),
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


def _scale(view: View, is_grouped: bool, largest: float) -> Normalize:
    if not is_grouped:
        return Normalize(-largest, largest)
    # A few edges between two large groups have a small mean: the square root makes them visible
    return PowerNorm(0.5, 0.0, largest) if view.aggregate == "mean" else Normalize(0.0, largest)


def name_causes(variables: TransitionVariables, axes: Axes, font_size: float = FONT_SIZE) -> None:
    causes = (*variables.state_names, *variables.action_names)
    axes.set_xticks(range(len(causes)), causes, rotation=90, fontsize=font_size, **AS_TEXT)


def name_effects(variables: TransitionVariables, axes: Axes, font_size: float = FONT_SIZE) -> None:
    effects = (*variables.next_state_names, "reward")
    axes.set_yticks(range(len(effects)), effects, fontsize=font_size, **AS_TEXT)


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
        dark = np.abs(effects) * shown.masks > 0.6 * min(np.abs(effects).max(), 1.0)
        for row, column in np.ndindex(effects.shape):
            text = f"{effects[row, column]:+.2f}\n\u00b1{errors[row, column]:.2f}"
            colour = "white" if dark[row, column] else "0.2"
            axes.text(column, row, text, ha="center", va="center", fontsize=FONT_SIZE - 1, color=colour)
        return
    rows, columns = np.nonzero((np.abs(effects) < 2 * errors) & (shown.masks > EDGE_PROBABILITY))
    axes.scatter(columns, rows, s=6, color="0.35", label="smaller than two standard errors")
    if len(rows) > 0:
        axes.set_xlabel(f"{axes.get_xlabel()}; a dot: smaller than two standard errors", fontsize=FONT_SIZE)


def scale_label(view: View, summary: Summary) -> str:
    if not summary.is_grouped:
        return "mask, signed by the effect" if view.values == "masks" else "effect, in standard deviations; pale: improbable"
    what = {"max": "largest", "mean": "mean"}[view.aggregate]
    return f"{what} {'mask' if view.values == 'masks' else 'sure size of an effect'} between two groups"


def heat_map_size(variables: TransitionVariables) -> tuple[float, float]:
    label = label_inches(variables)
    width = 2.0 + label + max(3.4, ROW_INCHES * (variables.n_states + variables.n_actions))
    return width, 1.2 + label + max(2.0, ROW_INCHES * (variables.n_states + 1))
