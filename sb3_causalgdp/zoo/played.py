"""Transitions on which a page asks the model: from a saved buffer, or from episodes that were played."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.callbacks.pictures import draw_transitions
from sb3_causalgdp.offline.saved_buffers import read_buffer
from sb3_causalgdp.saving.archives import existing
from sb3_causalgdp.sources.buffers import SUFFIXES
from sb3_causalgdp.zoo.run_folder import RunFolder

OBSERVATIONS = 2_000  # on which the effects of the actions are averaged

Observations = np.ndarray | dict[str, np.ndarray]


@dataclass
class Played:
    """
    What the deterministic policy did.

    :param returns: Of each episode, in the environment's own rewards
    :param lengths: Of each episode, in steps
    :param observations: As the environment gives them, a batch of one for each step
    :param actions: What the policy did in them, the same
    """

    returns: list[float] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    observations: list[Observations] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)


@dataclass(frozen=True)
class Transitions:
    """
    On what effects and guidance are computed.

    :param observations: As the environment gives them, evenly chosen
    :param actions: The action of each
    :param source: Where they are from
    """

    observations: Observations
    actions: np.ndarray
    source: str


def transitions_of(run: RunFolder, model: CausalGDP, played: Played) -> Transitions | None:
    path = existing(run.path / "replay_buffer", SUFFIXES)
    try:
        buffer = read_buffer(path, run.trusted) if path.is_file() else None
        if buffer is not None and buffer.size() > 0:
            observations, actions = draw_transitions(buffer, model.policy, OBSERVATIONS)
            return Transitions(observations, actions, f"{len(actions):,} transitions drawn from {path.name}")
    except Exception as error:  # a damaged file can raise anything
        run.note(path.name, error)
    return transitions_played(played)


def transitions_played(played: Played) -> Transitions | None:
    """
    :param played: What the policy did
    :return: Some of it, None if it did nothing
    """
    if not played.actions:
        return None
    chosen = np.linspace(0, len(played.actions) - 1, min(OBSERVATIONS, len(played.actions))).astype(int)
    source = f"{len(chosen):,} steps of the episodes that the model played for this page"
    observations = joined([played.observations[step] for step in chosen])
    return Transitions(observations, np.concatenate([played.actions[step] for step in chosen]), source)


def joined(batches: Sequence[Any]) -> Observations:
    if isinstance(batches[0], dict):
        return {key: np.concatenate([batch[key] for batch in batches]) for key in batches[0]}
    return np.concatenate(batches)


def some_rows(observations: Observations, n_rows: int) -> Observations:
    """At most so many, evenly chosen."""

    def chosen(values: np.ndarray) -> np.ndarray:
        return values[np.linspace(0, len(values) - 1, min(n_rows, len(values))).astype(int)]

    if isinstance(observations, dict):
        return {key: chosen(values) for key, values in observations.items()}
    return chosen(observations)
