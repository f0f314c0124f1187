import gymnasium as gym
import numpy as np
from gymnasium import spaces


class Ones(gym.Env):
    """A reward of 1 in each of ten steps, and the time that is left to be seen."""

    observation_space, action_space = spaces.Box(0.0, 1.0, (1,)), spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.left = 10
        return np.array([1.0], np.float32), {}

    def step(self, action):
        self.left -= 1
        return np.array([self.left / 10], np.float32), 1.0, self.left == 0, False, {}
