"""A small environment with a goal, for hindsight replay."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces

GOALS = spaces.Dict({key: spaces.Box(-9.0, 9.0, (2,), np.float64) for key in ("observation", "achieved_goal", "desired_goal")})


class GoalEnv(gym.Env):
    """Observations are drawn from their space, whatever is done."""

    observation_space = GOALS
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def __init__(self, episode_length=5):
        self.episode_length = episode_length

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.n_steps = 0
        return self.observation_space.sample(), {}

    def step(self, action):
        self.n_steps += 1
        return self.observation_space.sample(), 0.0, False, self.n_steps == self.episode_length, {}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.linalg.norm(achieved_goal - desired_goal, axis=-1)
