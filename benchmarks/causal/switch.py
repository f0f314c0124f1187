"""
How soon the graph follows a world that changes: edges that go and come when an action loses its effect or a sensor dies.

    OMP_NUM_THREADS=1 python benchmarks/causal/switch.py --windows 10000 5000 0 --seeds 0 1 2

Uniform actions; the change comes at ``--at-step``, a graph is found every ``--every`` steps from the newest ``--windows``
transitions (0 keeps all). ``action``: an action has no effect any more. ``sensor``: a sensor shows zero. ``distractor``: an
idle action begins to move what another one moved. For the edges that go, and for those that come: steps from the change
until all of them have followed, an edge being a mask above 0.5, and stay so. ``never``: not in ``--after`` steps.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pandas as pd

from sb3_causalgdp.callbacks import CausalWorldModelCallback
from sb3_causalgdp.causal import CausalGraph, TransitionVariables, make_discovery, make_statistics

CHANGES = ("action", "sensor", "distractor")


class Swapped(gym.Wrapper):
    """The first action does nothing from a step on, and the last one, which did nothing before, does it in its place."""

    def __init__(self, env: gym.Env, at_step: int) -> None:
        super().__init__(env)
        own = env.action_space
        assert isinstance(own, gym.spaces.Box)
        self.at_step, self.n_steps = at_step, 0
        self.action_space = gym.spaces.Box(np.append(own.low, own.low[0]), np.append(own.high, own.high[0]), dtype=np.float32)

    def step(self, action: Any) -> Any:
        self.n_steps += 1
        own = np.array(action[:-1])
        if self.n_steps > self.at_step:
            own[0] = action[-1]
        return self.env.step(own)


def make(env_id: str, change: str, at_step: int) -> gym.Env:
    """
    :param env_id: Task, whose first action or sensor it is about
    :param change: One of ``CHANGES``
    :param at_step: Steps before
    :return: the task that changes
    """
    from sb3_causalgdp.stress import SensorDeath, WeakActuator

    env = gym.make(env_id)
    if change == "action":
        return WeakActuator(env, action=0, at_step=at_step, factor=0.0)
    return SensorDeath(env, sensors=[0], at_step=at_step) if change == "sensor" else Swapped(env, at_step)


def collect(env: gym.Env, n_rows: int, seed: int) -> tuple[np.ndarray, TransitionVariables]:
    """
    :param env: The task
    :param n_rows: Number of transitions
    :param seed: Of the task and the actions
    :return: rows, and their variables
    """
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    rng = np.random.default_rng([seed, 7])
    columns: tuple[list[Any], ...] = ([], [], [], [])
    observation, _ = env.reset(seed=seed)
    for _ in range(n_rows):
        action = rng.uniform(space.low, space.high)
        after, reward, terminated, truncated, _ = env.step(action.astype(space.dtype))
        for column, value in zip(columns, (observation, action, after, reward), strict=True):
            column.append(value)
        observation = env.reset()[0] if terminated or truncated else after
    variables = TransitionVariables(
        tuple(f"s{i}" for i in range(len(observation))), tuple(f"a{i}" for i in range(len(space.low)))
    )
    return variables.stack(*(np.asarray(column, np.float32) for column in columns)), variables


def edges_that_change(graph: CausalGraph, change: str) -> tuple[np.ndarray, np.ndarray]:
    """
    :param graph: Found before the change
    :param change: One of ``CHANGES``
    :return: which edges must go and which must come, boolean, of the masks' shape
    """
    n_states = graph.variables.n_states
    was, gone, come = graph.masks > 0.5, np.zeros(graph.masks.shape, dtype=bool), np.zeros(graph.masks.shape, dtype=bool)
    column = 0 if change == "sensor" else n_states
    gone[:, column] = was[:, column]
    if change == "sensor":
        gone[0] = was[0]
    if change == "distractor":
        come[:, -1] = was[:, n_states]
    return gone, come


def follow(
    rows: np.ndarray, variables: TransitionVariables, at_step: int, every: int, window: int, change: str
) -> dict[str, Any]:
    """
    :param rows: Transitions
    :param variables: Theirs
    :param at_step: When the change came
    :param every: Rows between graphs
    :param window: Newest rows from which a graph is found, 0 for all
    :param change: One of ``CHANGES``
    :return: number of edges that go and that come, and steps until they did for good
    """
    discovery = make_discovery("partial_r2")
    statistics: Any = make_statistics(discovery, variables, None, window or None)
    graph, wrong = None, []  # numbers of edges that have not gone, and not come
    for end in range(every, len(rows) + 1, every):
        statistics.update(rows[end - every : end])
        if statistics.wants_history:
            # As the callback does it
            statistics.restart()
            n_held = min(end, window or CausalWorldModelCallback.HISTORY_ROWS, statistics.rows_since_change)
            statistics.refill(rows[end - int(n_held) : end])
        graph = discovery(statistics, variables, graph)
        if end == at_step:
            gone, come = edges_that_change(graph, change)
        elif end > at_step:
            wrong.append(((graph.masks[gone] > 0.5).sum(), (graph.masks[come] <= 0.5).sum()))
    left, right = np.transpose(wrong)
    return {
        "edges_gone": int(gone.sum()),
        "steps_gone": _followed_after(left, every),
        "edges_come": int(come.sum()),
        "steps_come": _followed_after(right, every) if come.any() else "",
    }


def _followed_after(wrong: np.ndarray, every: int) -> int | str:
    still_wrong = np.flatnonzero(wrong)
    n_graphs = 0 if len(still_wrong) == 0 else int(still_wrong[-1]) + 1
    return "never" if n_graphs == len(wrong) else every * (n_graphs + 1)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--changes", nargs="+", choices=CHANGES, default=list(CHANGES))
    parser.add_argument("--windows", nargs="+", type=int, default=[10_000, 5_000, 0])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--at-step", type=int, default=15_000)
    parser.add_argument("--after", type=int, default=15_000)
    parser.add_argument("--every", type=int, default=1_000)
    parser.add_argument("--output", type=Path, help="CSV file, written anew")
    arguments = parser.parse_args(argv)
    records = []
    for change in arguments.changes:
        for seed in arguments.seeds:
            env = make(arguments.env, change, arguments.at_step)
            rows, variables = collect(env, arguments.at_step + arguments.after, seed)
            for window in arguments.windows:
                found = follow(rows, variables, arguments.at_step, arguments.every, window, change)
                about = {"environment": arguments.env, "change": change, "window": window, "seed": seed}
                records.append({**about, **found})
                print(*(f"{key} {value}" for key, value in records[-1].items()), flush=True)
    if arguments.output is not None:
        pd.DataFrame(records).to_csv(arguments.output, index=False)


if __name__ == "__main__":
    main()
