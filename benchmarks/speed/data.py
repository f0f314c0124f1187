"""What every contestant learns from: the same transitions, in a file that any interpreter with NumPy can read."""

from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

Arrays = dict[str, np.ndarray]


class Shapes(gym.Env):
    """
    The spaces of a task without the task: constructors ask for an environment, updates and predictions do not.

    :param n_states: Size of the observation n
    :param n_actions: Number of action components d, each in [-1, 1]
    """

    def __init__(self, n_states: int, n_actions: int) -> None:
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (n_states,), np.float32)
        self.action_space = gym.spaces.Box(-1.0, 1.0, (n_actions,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        raise NotImplementedError("Shapes has spaces only: a section that takes steps needs the task itself")

    def step(self, action: Any) -> Any:
        raise NotImplementedError("Shapes has spaces only: a section that takes steps needs the task itself")


def collect(env_id: str, n_rows: int, seed: int = 0) -> Arrays:
    """
    Transitions of uniform actions.

    :param env_id: Id of a Gymnasium task
    :param n_rows: How many
    :param seed: Of the task and of the actions
    :return: Arrays by name, see :func:`save`; actions are scaled to [-1, 1]
    """
    env = gym.make(env_id)
    space = env.action_space
    assert isinstance(space, gym.spaces.Box)
    rng = np.random.default_rng(seed)
    rows = []
    observation, _ = env.reset(seed=seed)
    for _ in range(n_rows):
        action = rng.uniform(-1.0, 1.0, space.shape)
        raw = space.low + 0.5 * (action + 1.0) * (space.high - space.low)
        following, reward, terminated, truncated, _ = env.step(raw.astype(space.dtype))
        rows.append((observation, action, reward, following, terminated, truncated))
        observation = env.reset()[0] if terminated or truncated else following
    env.close()
    return _as_arrays(*zip(*rows, strict=True))


def synthetic(n_states: int, n_actions: int, n_rows: int, seed: int = 0) -> Arrays:
    """
    Transitions of a stable linear system with noise, of any size.

    :param n_states: n
    :param n_actions: d
    :param n_rows: How many
    :param seed: Of the system and of the rows
    :return: As :func:`collect` returns them
    """
    rng = np.random.default_rng(seed)
    state_weights = 0.5 * rng.standard_normal((n_states, n_states)) / np.sqrt(n_states)
    action_weights = rng.standard_normal((n_actions, n_states)) / np.sqrt(n_actions)
    states = rng.standard_normal((n_rows, n_states))
    actions = rng.uniform(-1.0, 1.0, (n_rows, n_actions))
    following = states @ state_weights + actions @ action_weights + 0.1 * rng.standard_normal((n_rows, n_states))
    rewards = following[:, 0] - 0.1 * np.square(actions).sum(axis=1)
    truncations = np.arange(1, n_rows + 1) % 1_000 == 0
    return _as_arrays(states, actions, rewards, following, np.zeros(n_rows), truncations)


def _as_arrays(states: Any, actions: Any, rewards: Any, following: Any, terminations: Any, truncations: Any) -> Arrays:
    columns = {
        "observations": states,
        "actions": actions,
        "rewards": rewards,
        "next_observations": following,
        "terminations": terminations,
        "truncations": truncations,
    }
    return {name: np.asarray(values, dtype=np.float32) for name, values in columns.items()}


def save(path: Path, arrays: Arrays) -> str:
    """
    :param path: Where to, ends in ``.npz``
    :param arrays: ``observations``, ``actions``, ``rewards``, ``next_observations``, ``terminations``, ``truncations``
    :return: The path as text, for a worker's configuration
    """
    np.savez(path, **arrays)  # type: ignore[arg-type]
    return str(path)


def load(path: str) -> Arrays:
    """
    :param path: What :func:`save` wrote
    :return: The arrays
    """
    with np.load(path) as file:
        return dict(file)
