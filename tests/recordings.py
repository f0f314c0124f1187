"""Recorded transitions that tests write: steps of numbers that never repeat, and rows with known causes."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import concatenate, create_empty_array

BOX = spaces.Box(-1, 1, (2,), dtype=np.float32)
GOALS = spaces.Dict({name: BOX for name in ("achieved_goal", "desired_goal", "observation")})


def fill(buffer, n_steps):
    """Adds steps of numbers that never repeat, five to an episode. Returns each step's rows, and whether it is the last."""
    rows, ends = [], []

    def observe(step):
        values = step + 100.0 * np.arange(buffer.n_envs)[:, None] + np.array([0.0, 0.5])
        if isinstance(buffer.observation_space, spaces.Dict):
            return {key: values + 1000.0 * i for i, key in enumerate(buffer.observation_space.spaces)}
        return values

    def flat(observation):
        return np.concatenate(list(observation.values()), axis=1) if isinstance(observation, dict) else observation

    for step in range(n_steps):
        first, done = 2.0 * step, step % 5 == 4
        # Where the episode goes on, the next step starts where this one ends
        after = first + (1.0 if done else 2.0)
        actions, rewards = np.full((buffer.n_envs, 1), step / 7.0), step + np.arange(buffer.n_envs)
        infos = [{"TimeLimit.truncated": False}] * buffer.n_envs
        buffer.add(observe(first), observe(after), actions, rewards, np.full(buffer.n_envs, done), infos)
        rows.append(np.column_stack([flat(observe(first)), actions, flat(observe(after)), rewards]))
        ends.append(done)
    return rows, ends


def rows_of(source, batch_rows=7):
    batches = list(source.batches(batch_rows))
    assert all(len(rows) == batch_rows for rows in batches[:-1])
    return np.concatenate(batches)


def make_rows(n_rows, seed=0):
    """Two states, one action; only the first state and the action cause the first, only the second the second."""
    rng = np.random.default_rng(seed)
    states, actions = rng.normal(size=(n_rows, 2)), rng.uniform(-1, 1, size=(n_rows, 1))
    next_states = states * [0.8, 0.9] + np.column_stack([actions, np.zeros(n_rows)]) + 0.05 * rng.normal(size=(n_rows, 2))
    return {
        "observations": states,
        "actions": actions,
        "next_observations": next_states,
        "rewards": -next_states[:, 0] + 0.05 * rng.normal(size=n_rows),
    }


class NestedEnv(gym.Env):
    """Numbers that never repeat; episodes of six steps end, those of nine are cut."""

    observation_space = spaces.Dict(
        {
            "goal": spaces.Box(-1e6, 1e6, (1,), np.float64),
            "arm": spaces.Dict({"angle": spaces.Box(-1e6, 1e6, (2,), np.float64)}),
        }
    )
    action_space = spaces.Box(-1, 1, (2,), np.float64)

    def __init__(self):
        self.episode, self.step_number = -1, 0

    def observe(self):
        number = 100.0 * self.episode + self.step_number
        return {"goal": np.array([number]), "arm": {"angle": np.array([number + 0.25, number + 0.5])}}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.step_number = self.episode + 1, 0
        return self.observe(), {}

    def step(self, action):
        self.step_number += 1
        ends = self.step_number == (6 if self.episode % 2 else 9)
        return self.observe(), float(action[0]), ends and self.episode % 2 == 1, ends and self.episode % 2 == 0, {}


def record(minari, dataset_id, env, n_episodes):
    """Writes a dataset of random actions. Returns it and its rows."""
    space, episodes, rows = env.observation_space, [], []
    env.action_space.seed(0)
    for episode in range(n_episodes):
        observations, steps, done = [env.reset(seed=episode)[0]], [], False
        while not done:
            action = env.action_space.sample()
            observation, reward, terminated, truncated, _ = env.step(action)
            before, after = (spaces.flatten(space, which) for which in (observations[-1], observation))
            rows.append(np.concatenate([before, action, after, [reward]]))
            observations.append(observation)
            steps.append((action, reward, terminated, truncated))
            done = terminated or truncated
        batch = concatenate(space, observations, create_empty_array(space, len(observations)))
        actions, *rest = (np.array(values) for values in zip(*steps, strict=True))
        episodes.append(minari.data_collector.EpisodeBuffer(episode, None, None, batch, actions, *rest, infos={}))
    dataset = minari.create_dataset_from_buffers(
        dataset_id, episodes, observation_space=space, action_space=env.action_space, data_format="hdf5"
    )
    return dataset, np.array(rows)
