"""What a gradient step trains, and on which rows of what was drawn for several of them."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch as th

from sb3_causalgdp.offline.replay import rows_of


class StepPlan(NamedTuple):
    """What one gradient step does beside updating the critics."""

    trains_world_model: bool
    trains_actor: bool
    guided: bool
    """Whether the denoising term is steered."""
    climbed: int
    """The critic whose value the actor climbs."""
    running_weight: float
    """Share of the batch's statistics that enters the running ones."""

    @property
    def trains_others(self) -> bool:
        """Whether it trains more than the critics."""
        return self.trains_world_model or self.trains_actor


class StepBatch(NamedTuple):
    """What one gradient step learns from."""

    replay_data: Any
    """Of the critics: a sample of a replay buffer."""
    for_critics: th.Tensor
    """What :meth:`~sb3_causalgdp.updates.Updates.bootstrap` gave for these rows."""
    transitions: Any
    """Of the world model and the actor: the same sample, or one of single steps where returns are of several."""
    next_actions: th.Tensor | None
    """Of the actor's moving average after the transitions, shape ``(batch, d)``; None if they are not known yet."""


def dealt(
    plans: Sequence[StepPlan],
    replay_data: Any,
    one_step: Sequence[Any],
    next_actions: th.Tensor | None,
    for_critics: th.Tensor,
) -> Iterator[tuple[StepPlan, StepBatch]]:
    """
    :param plans: Of some gradient steps
    :param replay_data: Batches of the critics, one behind the other
    :param one_step: A batch for each step that trains more than the critics, none if ``replay_data`` is for all
    :param next_actions: After ``replay_data``, None if they are not known yet
    :param for_critics: What :meth:`~sb3_causalgdp.updates.Updates.bootstrap` gave for them
    :return: Each plan with its batch
    """
    batch_size, of_others = len(for_critics) // len(plans), iter(one_step)
    for index, plan in enumerate(plans):
        rows = slice(index * batch_size, (index + 1) * batch_size)
        own = rows_of(replay_data, rows)
        single = next(of_others, None) if plan.trains_others else None
        others = (single, None) if single is not None else (own, None if next_actions is None else next_actions[rows])
        yield plan, StepBatch(own, for_critics[rows], *others)
