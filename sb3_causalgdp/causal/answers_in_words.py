"""What the structural model answers, in words: a line for each outcome or action, on a screen."""

from collections.abc import Sequence
from typing import Any

import numpy as np

MOST_LINES = 20
SHOWN = 3  # next states that an action moves most


def intervention_in_words(outcome: Any) -> str:
    """
    :param outcome: An interventional distribution
    :return: its outcomes with and without the intervention, those that change most; of a batch the mean
    """
    means, stds = (np.atleast_2d(values) for values in outcome.columns())
    before = means if outcome.without is None else np.atleast_2d(outcome.without.columns()[0])
    change, names = (means - before).mean(axis=0), (*outcome.variables.next_state_names, "reward")
    order = np.argsort(-np.abs(change[:-1] / outcome.running_std[:-1]), kind="stable")[: MOST_LINES - 1]
    rows = [
        (names[j], f"{means[:, j].mean():.4g} ± {stds[:, j].mean():.2g}", f"{before[:, j].mean():.4g}", f"{change[j]:+.3g}")
        for j in (len(names) - 1, *sorted(order))
    ]
    title = f"Outcomes of an intervention, {_count(len(means), 'observation')}, in the environment's units"
    return _table(title, ("outcome", "mean ± std", "without", "change"), rows, len(names))


def effects_in_words(effects: Any, unit: str) -> str:
    """
    :param effects: Effects of actions
    :param unit: Of them
    :return: what each action does to the reward, and the next states that it moves most; the strongest actions first
    """
    names, rows = effects.variables, []
    standardised = effects.standardised()
    for i in np.argsort(-standardised.reward.mean_absolute, kind="stable")[:MOST_LINES]:
        moved = np.argsort(-standardised.next_state.mean_absolute[:, i], kind="stable")[:SHOWN]
        parts = (part.mean[i] for part in (effects.reward, effects.reward_direct, effects.reward_through_state))
        on_states = ", ".join(f"{names.next_state_names[j]} {effects.next_state.mean[j, i]:+.3g}" for j in moved)
        rows.append((names.action_names[i], *(f"{part:+.3g}" for part in parts), on_states))
    title = f"Mean effects of actions, {_count(effects.n_observations, 'observation')}, in {unit}"
    header = ("action", "on the reward", "directly", "through s'", "on the next states")
    return _table(title, header, rows, names.n_actions)


def counterfactual_in_words(answer: Any) -> str:
    """
    :param answer: A counterfactual
    :return: its return and the recorded one, and the mean distance of each variable from what was recorded, the largest first
    """
    names = answer.variables
    labels = (*names.state_names, *names.action_names)
    distances = np.concatenate(
        [
            np.abs(answer.states - answer.recorded.states).mean(axis=0),
            np.abs(answer.actions - answer.recorded.actions).mean(axis=0)
            if len(answer.actions)
            else np.zeros(names.n_actions),
        ]
    )
    scale = np.append(answer.running_std[:-1], np.full(names.n_actions, 1.0))
    order = np.argsort(-distances / scale, kind="stable")[:MOST_LINES]
    title = (
        f"Counterfactual of {_count(len(answer.rewards), 'step')}: return {answer.rewards.sum():.4g}, "
        f"recorded {answer.recorded.rewards.sum():.4g}"
    )
    return _table(title, ("variable", "mean distance"), [(labels[j], f"{distances[j]:.3g}") for j in order], len(labels))


def _count(n: int, what: str) -> str:
    return f"{n:,} {what}{'s'[: n != 1]}"


def _table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]], n_all: int) -> str:
    widths = [max(len(row[column]) for row in (header, *rows)) for column in range(len(header))]
    lines = ["  " + "  ".join(f"{text:<{width}}" for text, width in zip(row, widths, strict=True)) for row in (header, *rows)]
    hidden = n_all - len(rows)
    more = [f"  and {hidden} more, which change less: to_dataframe() has all"] if hidden > 0 else []
    return "\n".join([title, *(line.rstrip() for line in lines), *more])
