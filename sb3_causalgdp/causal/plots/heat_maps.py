"""Causal graphs as matrices."""

from collections.abc import Sequence

import numpy as np

from sb3_causalgdp.causal.graph import PLOTS_HINT, CausalGraph
from sb3_causalgdp.causal.plots.figures import AS_TEXT, FONT_SIZE, ROW_INCHES, check_choice, label_inches
from sb3_causalgdp.causal.plots.summary import Groups, Summary, summarize
from sb3_causalgdp.causal.variables import TransitionVariables

try:
    from matplotlib.axes import Axes
    from matplotlib.colors import LinearSegmentedColormap, Normalize, PowerNorm
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage
except ImportError as error:
    raise ImportError(PLOTS_HINT) from error

VALUES = ("masks", "effects")
COLOUR_MAP = "RdBu_r"
GROUP_COLOURS = ("white", "#fdd49e", "#fc8d59", "#d7301f", "#7f0000")  # without a sign
MAX_NUMBERED_CAUSES = 6  # of a heat map whose cells hold an effect and its standard error


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
    :param groups: How to summarise, see :func:`~sb3_causalgdp.causal.plots.summary.summarize`
    :param aggregate: ``"mean"`` or ``"max"`` of a group's entries
    :return: the axes
    :raises ValueError: on an argument out of range
    """
    check_choice("values", values, VALUES)
    summary = summarize(graph, max_variables, groups, aggregate)
    shown = summary(graph)
    if axes is None:
        axes = Figure(figsize=heat_map_size(shown.variables), layout="constrained").add_subplot()
    image = draw_matrix(shown, axes, values, summary.is_grouped, largest_value([shown], values, summary.is_grouped))
    name_causes(shown.variables, axes)
    name_effects(shown.variables, axes)
    axes.set_xlabel("cause (for the reward row: the next state, and the action)")
    axes.set_ylabel("effect")
    remark = f"\n({summary.remark})" if summary.remark else ""
    axes.set_title(f"Causal {values}{remark}", fontsize=FONT_SIZE + 2)
    if summary.is_grouped:
        _number_groups(image, axes)
    elif values == "effects" and shown.standard_errors is not None:
        _show_standard_errors(shown, axes)
    bar = axes.figure.colorbar(image, ax=axes, fraction=0.04, pad=0.02)
    bar.set_label(scale_label(values, summary))
    return axes


def matrix_of(shown: CausalGraph, values: str, is_grouped: bool) -> np.ndarray:
    """What the colours show, shape (n + 1, n + d)."""
    if values == "effects":
        return shown.effects
    return shown.masks if is_grouped else np.where(shown.effects < 0, -shown.masks, shown.masks)


def largest_value(shown: Sequence[CausalGraph], values: str, is_grouped: bool) -> float:
    """The end of the colour scale."""
    if values == "masks" and not is_grouped:
        return 1.0
    return max(float(np.abs(matrix_of(graph, values, is_grouped)).max()) for graph in shown) or 1.0


def draw_matrix(shown: CausalGraph, axes: Axes, values: str, is_grouped: bool, largest: float) -> AxesImage:
    n_states = shown.variables.n_states
    image = axes.imshow(
        matrix_of(shown, values, is_grouped),
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
        dark = np.abs(effects) > 0.6 * np.abs(effects).max()
        for row, column in np.ndindex(effects.shape):
            text = f"{effects[row, column]:+.2f}\n\u00b1{errors[row, column]:.2f}"
            colour = "white" if dark[row, column] else "0.2"
            axes.text(column, row, text, ha="center", va="center", fontsize=FONT_SIZE - 1, color=colour)
        return
    rows, columns = np.nonzero((np.abs(effects) < 2 * errors) & (effects != 0))
    axes.scatter(columns, rows, s=6, color="0.35", label="smaller than two standard errors")
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=FONT_SIZE - 1, borderpad=0)


def scale_label(values: str, summary: Summary) -> str:
    if summary.is_grouped:
        return f"{summary.aggregate} {'mask' if values == 'masks' else 'size of the effects'} between two groups"
    return "mask, signed by the effect" if values == "masks" else "effect, in standard deviations"


def heat_map_size(variables: TransitionVariables) -> tuple[float, float]:
    label = label_inches(variables)
    width = 2.0 + label + max(3.4, ROW_INCHES * (variables.n_states + variables.n_actions))
    return width, 1.2 + label + max(2.0, ROW_INCHES * (variables.n_states + 1))
