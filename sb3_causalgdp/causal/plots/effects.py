import os

import numpy as np

from sb3_causalgdp.causal.answers import ActionEffects
from sb3_causalgdp.causal.drawing import PLOTS_HINT
from sb3_causalgdp.causal.plots.figures import AS_TEXT, FONT_SIZE, INCHES_PER_CHARACTER, save_figure

try:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch
except ImportError as error:
    raise ImportError(PLOTS_HINT) from error

COLOUR_MAP = "RdBu_r"
POSITIVE, NEGATIVE, PALE, NO_PATH = "#b2182b", "#2166ac", "#dddddd", "#e2e2e2"
ROW_INCHES = 0.32
CELL_INCHES = 0.52
MAX_NUMBERS = 300
SMALLEST_MARK = 0.02  # of the longest bar: smaller parts would only cover the axis


def plot_action_effects(
    effects: ActionEffects,
    path: str | os.PathLike[str] | None = None,
    max_actions: int = 20,
    max_states: int = 30,
) -> Figure:
    """
    Draw the standardised effects of the actions: bars for the reward on the left, a heat map for the next state on the right.

    :param effects: The effects
    :param path: Image file to write, by its suffix; None writes nothing
    :param max_actions: Draw at most this many actions, those with the largest mean absolute effect
    :param max_states: Draw at most this many next state variables, those with the largest mean absolute effect
    :return: the figure
    :raises ValueError: when a maximum is below 1
    """
    n_actions, n_states = len(_strongest_actions(effects, max_actions)), len(_strongest_states(effects, max_states))
    label = INCHES_PER_CHARACTER * max(map(len, effects.variables.names))
    widths = [label + 4.8, 2 * label + 1.6 + max(2.4, CELL_INCHES * n_actions)]
    height = 1.9 + max(ROW_INCHES * max(n_actions, 4), ROW_INCHES * max(n_states, 4) + label)
    figure = Figure(figsize=(sum(widths), height), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=widths)
    plot_reward_effects(effects, left, max_actions)
    plot_next_state_effects(effects, right, max_actions, max_states)
    figure.suptitle(
        f"Causal effects of the actions: outcome in standard deviations for half of an action's range, "
        f"mean of {effects.n_observations} observations",
        fontsize=FONT_SIZE + 1,
    )
    save_figure(figure, path)
    return figure


def plot_reward_effects(effects: ActionEffects, axes: Axes | None = None, max_actions: int = 20) -> Axes:
    """
    Draw the standardised effect of each action on the reward, the strongest on top.

    The coloured bar is the signed mean with two standard errors, the pale bar behind it the mean absolute effect: where only
    the pale one is long, the action matters but its sign depends on the state. Marks show the direct part and that through
    the next state, unless they are next to nothing.

    :param effects: The effects
    :param axes: Where to draw; a new figure by default
    :param max_actions: Draw at most this many actions, those with the largest mean absolute effect on the reward
    :return: the axes
    :raises ValueError: when the maximum is below 1
    """
    shown = _strongest_actions(effects, max_actions)
    if axes is None:
        axes = Figure(figsize=(6.5, 1.8 + ROW_INCHES * max(len(shown), 4)), layout="constrained").add_subplot()
    effects = effects.standardised()
    mean, absolute = effects.reward.mean[shown], effects.reward.mean_absolute[shown]
    rows = np.arange(len(shown))
    axes.barh(rows, np.where(mean < 0, -absolute, absolute), height=0.74, color=PALE)
    axes.barh(rows, mean, height=0.46, color=np.where(mean < 0, NEGATIVE, POSITIVE).tolist())
    axes.errorbar(mean, rows, xerr=2 * effects.reward.standard_error[shown], fmt="none", ecolor="black", elinewidth=1)
    for part, marker, colour, edge in (
        (effects.reward_direct, "o", "white", "black"),
        (effects.reward_through_state, "D", "black", "white"),
    ):
        large = np.abs(part.mean[shown]) > SMALLEST_MARK * absolute.max()
        axes.plot(part.mean[shown][large], rows[large], marker, color=colour, markeredgecolor=edge, markersize=6)
    axes.axvline(0.0, color="black", linewidth=0.8)
    # Few bars stay slim
    margin = 0.6 + max(4 - len(shown), 0) / 2
    axes.set_ylim(len(shown) - 1 + margin, -margin)
    axes.set_yticks(rows, [effects.variables.action_names[i] for i in shown], fontsize=FONT_SIZE, **AS_TEXT)
    axes.tick_params(axis="x", labelsize=FONT_SIZE)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x", color="0.9")
    axes.set_axisbelow(True)
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.set_xlabel("standard deviations of the reward", fontsize=FONT_SIZE)
    axes.set_title(
        f"Effect on the reward{_remark(len(shown), effects.variables.n_actions, 'actions')}", fontsize=FONT_SIZE + 2
    )
    axes.legend(
        handles=[
            Patch(color=POSITIVE, label="raises the reward"),
            Patch(color=NEGATIVE, label="lowers the reward"),
            Patch(color=PALE, label="mean absolute effect"),
            Line2D([], [], marker="o", linestyle="", color="white", markeredgecolor="black", label="direct"),
            Line2D([], [], marker="D", linestyle="", color="black", label="through the next state"),
            Line2D([], [], color="black", linewidth=1, label="± 2 standard errors"),
        ],
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        borderaxespad=5.0,
        ncols=2,
        frameon=False,
        fontsize=FONT_SIZE - 1,
    )
    return axes


def plot_next_state_effects(
    effects: ActionEffects, axes: Axes | None = None, max_actions: int = 20, max_states: int = 30
) -> Axes:
    """
    Draw the standardised signed mean effect of each action (column) on each next state variable (row).

    :param effects: The effects
    :param axes: Where to draw; a new figure by default
    :param max_actions: Draw at most this many actions, those with the largest mean absolute effect on the reward
    :param max_states: Draw at most this many variables, those with the largest mean absolute effect of an action
    :return: the axes
    :raises ValueError: when a maximum is below 1
    """
    # In the order of the environment: related variables stand together
    actions = np.sort(_strongest_actions(effects, max_actions))
    states = np.sort(_strongest_states(effects, max_states))
    if axes is None:
        size = (3.6 + CELL_INCHES * len(actions), 2.0 + ROW_INCHES * max(len(states), 4))
        axes = Figure(figsize=size, layout="constrained").add_subplot()
    variables, effects = effects.variables, effects.standardised()
    mean = effects.next_state.mean[np.ix_(states, actions)]
    no_path = effects.next_state.mean_absolute[np.ix_(states, actions)] == 0.0
    largest = max(float(np.abs(mean).max()), 1e-12)
    axes.set_facecolor(NO_PATH)
    shown = np.ma.masked_array(mean, no_path)
    image = axes.imshow(shown, cmap=COLOUR_MAP, vmin=-largest, vmax=largest, aspect="auto")
    if mean.size <= MAX_NUMBERS:
        decimals = int(np.clip(1 - np.floor(np.log10(largest)), 0, 6))
        for row, column in np.argwhere(~no_path):
            value = mean[row, column]
            colour = "white" if abs(value) > 0.6 * largest else "black"
            axes.text(column, row, f"{value:.{decimals}f}", ha="center", va="center", fontsize=FONT_SIZE - 1.5, color=colour)
    names = [variables.action_names[i] for i in actions]
    axes.set_xticks(range(len(actions)), names, rotation=0 if len(actions) == 1 else 90, fontsize=FONT_SIZE, **AS_TEXT)
    axes.set_yticks(range(len(states)), [variables.next_state_names[j] for j in states], fontsize=FONT_SIZE, **AS_TEXT)
    axes.set_xticks(np.arange(len(actions) + 1) - 0.5, minor=True)
    axes.set_yticks(np.arange(len(states) + 1) - 0.5, minor=True)
    axes.grid(which="minor", color="white", linewidth=1)
    axes.tick_params(which="both", length=0)
    axes.spines[:].set_visible(False)
    remark = _remark(len(states), variables.n_states, "variables")
    axes.set_title(f"Effect on the next state{remark}", fontsize=FONT_SIZE + 2)
    if no_path.any():
        axes.set_xlabel("grey: no path from the action", fontsize=FONT_SIZE)
    bar = axes.figure.colorbar(image, ax=axes, fraction=0.05, pad=0.03, aspect=30)
    bar.set_label("standard deviations", fontsize=FONT_SIZE)
    bar.ax.tick_params(labelsize=FONT_SIZE)
    return axes


def _strongest_actions(effects: ActionEffects, maximum: int) -> np.ndarray:
    if maximum < 1:
        raise ValueError(f"max_actions must be at least 1, got {maximum!r}")
    return np.argsort(-effects.standardised().reward.mean_absolute, kind="stable")[:maximum]


def _strongest_states(effects: ActionEffects, maximum: int) -> np.ndarray:
    if maximum < 1:
        raise ValueError(f"max_states must be at least 1, got {maximum!r}")
    strongest = effects.standardised().next_state.mean_absolute.max(axis=1)
    return np.argsort(-strongest, kind="stable")[:maximum]


def _remark(n_shown: int, n_all: int, what: str) -> str:
    return "" if n_shown == n_all else f"\n(the {n_shown} {what} with the strongest effect, of {n_all})"
