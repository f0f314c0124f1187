"""
How soon, and how surely, the gate tells what matters from what does not: HalfCheetah with distractors, without any training.

    OMP_NUM_THREADS=1 python benchmarks/causal/relevance.py --noises 100 --seeds 0 1 2 3 4
    OMP_NUM_THREADS=1 python benchmarks/causal/relevance.py --env Hopper-v5 --noises 0 --steps 20000

Behaviours: ``random`` actions; ``policy``, 1,000 random ones and then ``tanh(W s)`` of a random matrix, with noise of 0.1. A
graph is found every ``--every`` steps. For each run: the most of the environment's own observations and actions that were
closed at any time, and how many distractors were open after each graph.
"""

import argparse
import csv
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_causalgdp.causal import RelevanceGate, TransitionVariables, make_discovery, make_statistics
from sb3_causalgdp.stress import make_stressed

RANDOM_STEPS = 1_000
POLICY_NOISE = 0.1


def collect(
    env_id: str, n_rows: int, seed: int, behaviour: str, **stress: Any
) -> tuple[np.ndarray, TransitionVariables, int, int]:
    """
    :param env_id: Task inside
    :param n_rows: Number of transitions
    :param seed: Of the environment and the behaviour
    :param behaviour: ``"random"`` or ``"policy"``
    :param stress: Arguments of :func:`~sb3_causalgdp.stress.make_stressed`
    :return: rows, their variables, and how many observations and actions are the task's own
    """
    plain, env = gym.make(env_id), make_stressed(env_id, **stress)
    n_own, d_own = plain.observation_space.shape[0], plain.action_space.shape[0]  # type: ignore[index]
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    rng = np.random.default_rng([seed, 7])
    weights = 0.5 * rng.normal(size=(d_own, n_own))
    columns: tuple[list[Any], ...] = ([], [], [], [])
    observation, _ = env.reset(seed=seed)
    for step in range(n_rows):
        action = rng.uniform(space.low, space.high)
        if behaviour == "policy" and step >= RANDOM_STEPS:
            wanted = np.tanh(weights @ observation[:n_own]) + POLICY_NOISE * rng.normal(size=d_own)
            action[:d_own] = np.clip(wanted, -1.0, 1.0) * space.high[:d_own]
        after, reward, terminated, truncated, _ = env.step(action.astype(space.dtype))
        for column, value in zip(columns, (observation, action, after, reward), strict=True):
            column.append(value)
        observation = env.reset()[0] if terminated or truncated else after
    n_states, n_actions = len(observation), len(space.low)
    variables = TransitionVariables(
        tuple(f"{'observation' if i < n_own else 'distractor'}[{i}]" for i in range(n_states)),
        tuple(f"{'action' if i < d_own else 'idle'}[{i}]" for i in range(n_actions)),
    )
    # As a replay buffer keeps them
    return variables.stack(*(np.asarray(column, np.float32) for column in columns)), variables, n_own, d_own


def judge(
    rows: np.ndarray, variables: TransitionVariables, every: int, gate: RelevanceGate, method: str = "partial_r2"
) -> list[dict[str, Any]]:
    """
    :param rows: Transitions
    :param variables: Theirs
    :param every: Rows between graphs
    :param gate: Fed with each graph
    :param method: Discovery method
    :return: for each graph: rows, open states and actions, why the verdict was withheld, CPU seconds of graph and of gate
    """
    discovery = make_discovery(method)
    statistics: Any = make_statistics(discovery, variables)
    records = []
    for end in range(every, len(rows) + 1, every):
        statistics.update(rows[end - every : end])
        if getattr(statistics, "wants_history", False):
            statistics.restart()
            statistics.refill(rows[:end])
        start = time.thread_time()
        graph = discovery(statistics, variables)
        found = time.thread_time()
        verdict = gate.update(graph)
        records.append(
            {
                "rows": end,
                "states": verdict.states,
                "actions": verdict.actions,
                "withheld": verdict.withheld,
                "graph_seconds": found - start,
                "gate_seconds": time.thread_time() - found,
            }
        )
    return records


def run(arguments: argparse.Namespace, behaviour: str, seed: int) -> dict[str, Any]:
    """One behaviour and seed, as a row of the table."""
    stress = {"noises": arguments.noises, "idle_actions": arguments.idle_actions, "coefficient": arguments.coefficient}
    rows, variables, n_own, d_own = collect(arguments.env, arguments.steps, seed, behaviour, **stress)
    records = judge(rows, variables, arguments.every, RelevanceGate(variables))
    own_closed = [int((~r["states"][:n_own]).sum() + (~r["actions"][:d_own]).sum()) for r in records]
    others_open = [int(r["states"][n_own:].sum() + r["actions"][d_own:].sum()) for r in records]
    return {
        "environment": arguments.env,
        "noises": arguments.noises,
        "idle_actions": arguments.idle_actions,
        "behaviour": behaviour,
        "seed": seed,
        "own_closed": max(own_closed),
        "others_open": " ".join(map(str, others_open)),
        "graph_seconds": round(float(np.median([r["graph_seconds"] for r in records])), 4),
        "gate_seconds": round(float(np.median([r["gate_seconds"] for r in records])), 4),
        "withheld": "; ".join(f"{r['rows']}: {r['withheld']}" for r in records if r["withheld"]),
    }


def append(path: Path, record: dict[str, Any]) -> None:
    """
    :param path: A CSV file, made if it is not there
    :param record: A line of it
    """
    is_new = not path.exists()
    with path.open("a", newline="") as stream:
        writer = csv.DictWriter(stream, list(record), lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerow(record)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--noises", type=int, default=100)
    parser.add_argument("--coefficient", type=float, default=0.95)
    parser.add_argument("--idle-actions", type=int, default=0)
    parser.add_argument("--behaviours", nargs="+", choices=("random", "policy"), default=["random", "policy"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2, 3, 4])
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--every", type=int, default=1_000)
    parser.add_argument("--output", type=Path, help="CSV file, appended to")
    arguments = parser.parse_args(argv)
    for behaviour in arguments.behaviours:
        for seed in arguments.seeds:
            record = run(arguments, behaviour, seed)
            print(*(f"{key} {value}" for key, value in record.items() if key != "withheld"), flush=True)
            if arguments.output is not None:
                append(arguments.output, record)


if __name__ == "__main__":
    main()
