"""
CPU seconds of an environment step of ``learn()``, a causal refresh's share included, from turns shorter than its period.

Before anything is timed come uniform actions, at the end of which is a causal graph: all that is timed is guided.
"""

from typing import Any

import numpy as np

from benchmarks.speed.client import Field, Worker
from benchmarks.speed.results import Row

REFRESH_PERIOD = 1_000  # the default of ``causal_refresh_freq``, which the contestants are made with


def warm_up(worker: Worker, random_steps: int) -> None:
    """
    Take the uniform actions, and an algorithm's first updates. The last refresh among them is kept in ``worker.about``: it is
    not the first one, which imports and allocates.

    :param worker: Made with ``learning_starts=random_steps``; a peer without them starts with a filled replay buffer
    :param random_steps: How many uniform actions
    """
    if worker.contestant.config.get("kwargs", {}).get("learning_starts"):
        refreshes = worker.ask("learn", steps=random_steps)["value"].get("refresh_seconds", [])
        worker.about["refresh_seconds"] = refreshes[-1] if refreshes else 0.0
    worker.ask("learn", steps=20)


def turn(worker: Worker, steps: int) -> dict[str, Any]:
    """
    :param worker: After its warm-up
    :param steps: Environment steps
    :return: ``steps`` that were taken and their ``seconds``, without those of refreshes among them
    """
    answer = worker.ask("learn", steps=steps)
    taken = answer["value"]
    return {"steps": taken["steps"], "seconds": answer["cpu"] - sum(taken.get("refresh_seconds", []))}


def row(field: Field, name: str, turns: dict[str, list[dict[str, Any]]]) -> Row:
    """
    :param field: The contestants
    :param name: Of one of them
    :param turns: What :func:`turn` returned, by name
    :return: Columns of a table: medians over the turns
    """
    if name not in turns:
        return dict(field.absent[name])
    refresh = field.workers[name].about.get("refresh_seconds", 0.0)
    seconds = [one["seconds"] / one["steps"] for one in turns[name]]
    per_step = float(np.median(seconds)) + refresh / REFRESH_PERIOD
    return {
        "status": "ok",
        "turns": turns[name],
        "ms per step": 1e3 * per_step,
        "steps per CPU second": 1.0 / per_step,
        "ms per refresh": 1e3 * refresh or None,
        "share of refreshes": refresh / REFRESH_PERIOD / per_step if refresh else None,
    }
