"""What interventions and counterfactuals change."""

import os
from collections.abc import Sequence

import numpy as np

from sb3_causalgdp.causal.answers import Counterfactual, InterventionalDistribution
from sb3_causalgdp.causal.drawing import PLOTS_HINT
from sb3_causalgdp.causal.plots.figures import AS_TEXT, FONT_SIZE, ROW_INCHES, check_suffix, label_inches, save_figure

try:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
except ImportError as error:
    raise ImportError(PLOTS_HINT) from error

WITH, WITHOUT = "#b2182b", "0.45"
PANEL_INCHES = 1.35


def plot_intervention(
    outcome: InterventionalDistribution, path: str | os.PathLike[str] | None = None, max_outcomes: int = 30
) -> Figure:
    """
    Draw the outcomes with and without an intervention, in running standard deviations from the mean without it, with bands of
    two standard deviations; of a batch the mean.

    :param outcome: The answer
    :param path: Image file to write, by its suffix; None writes nothing
    :param max_outcomes: Draw at most this many, those that change most, and the reward; at least 1
    :return: the figure
    :raises ValueError: when the maximum is below 1, or a suffix is not an image's
    """
    check_suffix(path)
    if max_outcomes < 1:
        raise ValueError(f"max_outcomes must be at least 1, got {max_outcomes!r}")
    names = (*outcome.variables.next_state_names, "reward")
    scale = outcome.running_std
    means, stds = (np.atleast_2d(values).mean(axis=0) / scale for values in outcome.columns())
    without = outcome if outcome.without is None else outcome.without
    base, base_stds = (np.atleast_2d(values).mean(axis=0) / scale for values in without.columns())
    order = np.argsort(-np.abs(means - base)[:-1], kind="stable")[: max_outcomes - 1]
    shown = np.append(np.sort(order), len(names) - 1)
    height = 1.6 + ROW_INCHES * max(len(shown), 3)
    figure = Figure(figsize=(4.6 + label_inches(outcome.variables), height), layout="constrained")
    axes = figure.add_subplot()
    rows = np.arange(len(shown))
    for shift, colour, mean, std, label in (
        (-0.14, WITHOUT, base, base_stds, "without"),
        (0.14, WITH, means, stds, "with the intervention"),
    ):
        axes.hlines(rows + shift, *_band((mean - base)[shown], std[shown]), color=colour, alpha=0.3, linewidth=6)
        axes.plot((mean - base)[shown], rows + shift, "o", color=colour, markersize=5, label=label)
    axes.set_yticks(rows, [names[j] for j in shown], fontsize=FONT_SIZE, **AS_TEXT)
    axes.set_ylim(len(shown) - 0.5, -0.5)
    axes.axvline(0.0, color="black", linewidth=0.8)
    axes.set_xlabel(
        "change, in running standard deviations\n(bands: two standard deviations of the outcome)", fontsize=FONT_SIZE
    )
    remark = "" if len(shown) == len(names) else f" (the {len(shown)} of {len(names)} outcomes that change most)"
    axes.set_title(f"What the intervention changes{remark}", fontsize=FONT_SIZE + 2)
    _finish(axes)
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=FONT_SIZE)
    save_figure(figure, path)
    return figure


def _band(mean: np.ndarray, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return mean - 2.0 * std, mean + 2.0 * std


def plot_counterfactual(
    answer: Counterfactual,
    path: str | os.PathLike[str] | None = None,
    variables: Sequence[str] | None = None,
    max_variables: int = 6,
) -> Figure:
    """
    Draw the recorded and the counterfactual trajectory, by variable. The band is two standard deviations of the model's
    noise in one step wide, where the two differ.

    :param answer: The answer
    :param path: Image file to write, by its suffix; None writes nothing
    :param variables: Names of the states and actions to draw, and ``"reward"``; None takes the reward, the actions that were
        changed and the states that change most
    :param max_variables: Number of panels where ``variables`` is None, at least 1
    :return: the figure
    :raises ValueError: on an unknown name, a maximum below 1, or a suffix that is not an image's
    """
    check_suffix(path)
    curves = _curves(answer)
    if variables is None:
        variables = _most_changed(answer, max_variables)
    unknown = [name for name in variables if name not in curves]
    if unknown or not variables:
        raise ValueError(f"variables must be some of {tuple(curves)}, got {list(variables)}")
    figure = Figure(figsize=(7.2, 1.0 + PANEL_INCHES * len(variables)), layout="constrained")
    panels = figure.subplots(len(variables), 1, sharex=True, squeeze=False)[:, 0]
    for axes, name in zip(panels, variables, strict=True):
        recorded, changed, std = curves[name]
        steps = np.arange(len(recorded))
        axes.plot(steps, recorded, color=WITHOUT, label="recorded")
        axes.plot(steps, changed, color=WITH, label="counterfactual")
        lower, upper = _band(changed, np.where(changed == recorded, 0.0, std))
        axes.fill_between(steps, lower, upper, color=WITH, alpha=0.15, linewidth=0, label="± 2 std of the model's noise")
        axes.set_ylabel(name, fontsize=FONT_SIZE, **AS_TEXT)
        _finish(axes)
    panels[-1].set_xlabel("step", fontsize=FONT_SIZE)
    difference = answer.rewards.sum() - answer.recorded.rewards.sum()
    returns = f"{answer.recorded.rewards.sum():.4g} recorded, {answer.rewards.sum():.4g} counterfactual ({difference:+.3g})"
    figure.suptitle(f"Return: {returns}", fontsize=FONT_SIZE + 2)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=FONT_SIZE)
    save_figure(figure, path)
    return figure


def _curves(answer: Counterfactual) -> dict[str, tuple[np.ndarray, np.ndarray, float]]:
    """Recorded, counterfactual and the model's noise, by name."""
    names, recorded = answer.variables, answer.recorded
    curves = {"reward": (recorded.rewards, answer.rewards, float(answer.noise_std[-1]))}
    for j, name in enumerate(names.action_names):
        curves[name] = (recorded.actions[:, j], answer.actions[:, j], 0.0)
    for j, name in enumerate(names.state_names):
        curves[name] = (recorded.states[:, j], answer.states[:, j], float(answer.noise_std[j]))
    return curves


def _most_changed(answer: Counterfactual, maximum: int) -> list[str]:
    if maximum < 1:
        raise ValueError(f"max_variables must be at least 1, got {maximum!r}")
    by_action = np.abs(answer.actions - answer.recorded.actions).max(axis=0, initial=0.0)
    by_state = np.abs(answer.states - answer.recorded.states).max(axis=0) / answer.running_std[:-1]
    actions = [name for name, change in zip(answer.variables.action_names, by_action, strict=True) if change > 0]
    states = [answer.variables.state_names[j] for j in np.argsort(-by_state, kind="stable")]
    n_states = max(maximum - 1 - len(actions), maximum // 2)
    return ["reward", *states[:n_states], *actions][:maximum]


def _finish(axes: Axes) -> None:
    axes.tick_params(labelsize=FONT_SIZE)
    axes.grid(color="0.93", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
