"""
Confounded data: offline learning where the recorded behaviour follows something that will be of no use when acting.

    OMP_NUM_THREADS=1 python -m benchmarks.causal.confounded --task HalfCheetah-v5 --kinds none last_action nuisance
    OMP_NUM_THREADS=1 python -m benchmarks.causal.confounded --task maze2d-umaze-dense --kinds none last_action
    OMP_NUM_THREADS=1 ~/d3rlpy-venv/bin/python -m benchmarks.causal.confounded --methods td3_bc

The behaviour on a MuJoCo task is an agent of ``rl-trained-agents/``, pushed by noise that lasts (AR(1)); on a maze, D4RL's
controller. What is observed is the task's own state (``none``), also the last action (``last_action``), or also the noise that
pushes (``nuisance``), which has another sign and twice the size when the policy acts. CausalGDP learns with its abstraction,
and without it (``causalgdp_sees_all``). One line for each evaluation of ten episodes, and a CSV with ``--output``.
"""

import argparse
import functools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.causal.relevance import append
from benchmarks.offline.data import FIELDS, ensure_dataset, environment_id, transitions
from benchmarks.offline.methods import D3RLPY_METHODS, D3rlpyLearner, study_arguments
from benchmarks.offline.study import SELECTION_SEED, returns_of
from sb3_causalgdp import CausalGDP
from sb3_causalgdp.offline.make import MAZE_TASKS
from sb3_causalgdp.stress import ConfoundedBehaviour, LastAction, Nuisance

AGENTS = Path(__file__).parents[2] / "rl-trained-agents" / "causalgdp"
KINDS = ("none", "last_action", "nuisance")
METHODS = {"causalgdp": {}, "causalgdp_sees_all": {"causal_abstraction": False}, "td3_bc": {}}
COEFFICIENT = 0.95
STRENGTH = 0.15
Data = dict[str, np.ndarray]


# Data -------------------------------------------------------------------------------------------------------------------


def record(task: str, n_steps: int) -> Data:
    """
    :param task: A MuJoCo task that has a trained agent
    :param n_steps: Number of transitions
    :return: Them, with the nuisance in the last columns of observations
    """
    agent = CausalGDP.load(AGENTS / f"{task}_1" / f"{task}.zip", device="cpu")
    base = gym.make(task)
    assert isinstance(base.action_space, gym.spaces.Box)
    n = base.action_space.shape[0]
    env = Nuisance(base, n=n, coefficient=COEFFICIENT)
    behaviour = ConfoundedBehaviour(
        lambda seen: agent.predict(seen, deterministic=True)[0], base.action_space, strength=STRENGTH, n=n
    )
    rows, (observation, _) = [], env.reset(seed=0)
    for _ in range(n_steps):
        action = behaviour(observation)
        following, reward, terminated, truncated, _ = env.step(action)
        rows.append((observation, action, reward, following, terminated, truncated))
        observation = env.reset()[0] if terminated or truncated else following
    return {name: np.array(column) for name, column in zip((*FIELDS, "truncations"), zip(*rows, strict=True), strict=True)}


def from_maze(task: str, n_steps: int) -> Data:
    """
    :param task: One of the mazes
    :param n_steps: Number of transitions
    :return: Them
    """
    data = transitions(ensure_dataset(task, n_steps))
    following, starts = data["next_observations"][:-1], data["observations"][1:]
    cut = np.append(np.any(following != starts, axis=1), True)
    rewards, terminations = data["rewards"].ravel(), data["terminations"].ravel().astype(bool)
    return {**data, "rewards": rewards, "terminations": terminations, "truncations": cut & ~terminations}


def with_last_actions(data: Data) -> Data:
    """
    :param data: Transitions in their order
    :return: Them, with the last action beside the observations, zeros where an episode begins
    """
    last = np.concatenate([np.zeros_like(data["actions"][:1]), data["actions"][:-1]])
    ends = (data["terminations"] | data["truncations"])[:-1]
    last[1:][ends] = 0.0
    observations = np.concatenate([data["observations"], last], axis=1)
    following = np.concatenate([data["next_observations"], data["actions"]], axis=1)
    return {**data, "observations": observations, "next_observations": following}


def without_last_columns(data: Data, n: int) -> Data:
    """
    :param data: Transitions
    :param n: How many columns of the observations are left out
    :return: Them without these
    """
    seen = ("observations", "next_observations")
    return {name: values[:, : values.shape[1] - n] if name in seen else values for name, values in data.items()}


def seen_of(recorded: Data, task: str, kind: str) -> Data:
    """
    :param recorded: By :func:`record`, or :func:`from_maze`
    :param task: A maze, or a MuJoCo task
    :param kind: One of ``KINDS``
    :return: The transitions that are learned from
    """
    if kind == "nuisance":
        return recorded
    data = recorded if task in MAZE_TASKS else without_last_columns(recorded, recorded["actions"].shape[1])
    return with_last_actions(data) if kind == "last_action" else data


# Acting -----------------------------------------------------------------------------------------------------------------


def make_env(task: str, kind: str, mode: str = "changed") -> gym.Env:
    """
    :param task: A maze, or a MuJoCo task
    :param kind: One of ``KINDS``
    :param mode: What a nuisance does
    :return: The task as the policy sees it
    """
    env = gym.make(environment_id(task) if task in MAZE_TASKS else task)
    if kind == "last_action":
        return LastAction(env)
    if kind == "nuisance":
        assert isinstance(env.action_space, gym.spaces.Box)
        return Nuisance(env, mode=mode, n=env.action_space.shape[0], coefficient=COEFFICIENT)
    return env


# Learning ---------------------------------------------------------------------------------------------------------------


def learn(method: str, arguments: argparse.Namespace, kind: str, seed: int, data: Data) -> Iterator[tuple[int, Any, int]]:
    """
    :return: Iterates over the number of updates, what predicts, and how many observations are hidden
    """
    every = arguments.updates // arguments.evaluations
    if method in D3RLPY_METHODS:
        name, kwargs = D3RLPY_METHODS[method]
        columns = {field: data[field].astype(np.float32).reshape(len(data["rewards"]), -1) for field in FIELDS}
        learner = D3rlpyLearner(columns, seed, name, kwargs)
        for number in range(1, arguments.evaluations + 1):
            learner.train(every)
            yield number * every, learner.predict, 0
        return
    chosen = {**study_arguments(arguments.task), **METHODS[method], **arguments.kwargs}
    model = CausalGDP("MlpPolicy", make_env(arguments.task, kind), seed=seed, device="cpu", **chosen)
    model.preload(data)
    for number in range(1, arguments.evaluations + 1):
        model.pretrain(every)
        gate = model.relevance_gate
        hidden = 0 if gate is None or gate.states is None else int((~np.asarray(gate.states)).sum())
        yield number * every, lambda seen: model.predict(seen, deterministic=True)[0], hidden


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="HalfCheetah-v5", help="HalfCheetah-v5, Hopper-v5, Walker2d-v5 or a maze")
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=["causalgdp", "causalgdp_sees_all"])
    parser.add_argument("--transitions", type=int, default=100_000)
    parser.add_argument("--updates", type=int, default=20_000)
    parser.add_argument("--evaluations", type=int, default=2)
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--kwargs", type=json.loads, default={}, help="more arguments of CausalGDP, as JSON")
    parser.add_argument("--output", type=Path, help="CSV file that the rows are appended to")
    return parser


def main(argv: Sequence[str] | None = None) -> None:
    parser = make_parser()
    arguments = parser.parse_args(argv)
    if arguments.task in MAZE_TASKS and "nuisance" in arguments.kinds:
        parser.error(f"--kinds of a maze are {' and '.join(KINDS[:2])}: its data has no nuisance")
    recorded = (from_maze if arguments.task in MAZE_TASKS else record)(arguments.task, arguments.transitions)
    for kind in arguments.kinds:
        data = seen_of(recorded, arguments.task, kind)
        env = make_vec_env(functools.partial(make_env, arguments.task, kind), n_envs=arguments.episodes)
        for seed in arguments.seeds:
            for method in arguments.methods:
                for n_updates, predict, hidden in learn(method, arguments, kind, seed, data):
                    returns = returns_of(predict, env, SELECTION_SEED)
                    row = {"task": arguments.task, "kind": kind, "method": method, "seed": seed, "updates": n_updates}
                    row |= {"return": round(returns.mean(), 1), "std": round(returns.std(), 1), "hidden": hidden}
                    print(*(f"{name} {value}" for name, value in row.items()), flush=True)
                    if arguments.output is not None:
                        append(arguments.output, row)


if __name__ == "__main__":
    main()
