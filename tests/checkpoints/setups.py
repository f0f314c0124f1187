"""Trainings that are interrupted and go on: small, and of every kind."""

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from small_models import SMALL
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import SubprocVecEnv, VecNormalize

from sb3_causalgdp import CausalGDP, TrainingCheckpointCallback

STEPS = 320
GOALS = spaces.Dict({key: spaces.Box(-9.0, 9.0, (2,), np.float64) for key in ("observation", "achieved_goal", "desired_goal")})


class DriftingGoals(gym.Env):
    """Observations come from the environment's own random number generator."""

    observation_space = GOALS
    action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.n_steps = 0
        return self._draw(), {}

    def step(self, action):
        self.n_steps += 1
        return self._draw(), 0.0, False, self.n_steps == 5, {}

    def _draw(self):
        return {key: self.np_random.uniform(-9.0, 9.0, 2) for key in GOALS.spaces}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return -np.linalg.norm(achieved_goal - desired_goal, axis=-1)


class Setup(NamedTuple):
    """A training."""

    env: Any = "Pendulum-v1"
    n_envs: int = 1
    arguments: dict[str, Any] = {}
    vec_env_cls: type | None = None
    normalized: bool = False
    algorithm: type = CausalGDP
    policy: str = "MlpPolicy"

    def make_env(self, seed):
        # Other ways to start processes import everything anew, which takes seconds
        kwargs = {"start_method": "fork"} if self.vec_env_cls is SubprocVecEnv else {}
        env = make_vec_env(self.env, n_envs=self.n_envs, seed=seed, vec_env_cls=self.vec_env_cls, vec_env_kwargs=kwargs)
        return VecNormalize(env) if self.normalized else env

    def make_model(self, seed=0, **changes):
        own = (
            SMALL if self.algorithm is CausalGDP else {"buffer_size": 1000, "batch_size": 8, "train_freq": 8, "device": "cpu"}
        )
        return self.algorithm(self.policy, self.make_env(seed), **{**own, "seed": seed, **self.arguments, **changes})

    def callbacks(self, folder, every=90, keep=2):
        evaluation = EvalCallback(self.make_env(7), n_eval_episodes=1, eval_freq=70, verbose=0)
        return [evaluation, TrainingCheckpointCallback(folder, every=every, keep=keep)]


# So that it hides something within these few steps
HIDES_EARLY = {"low": 0.5, "patience": 1, "detectable": 1.0, "known": 0.0, "min_reward_r2": 0.0}

SETUPS = {
    "Pendulum": Setup(),
    "HalfCheetah": Setup("HalfCheetah-v5", arguments={"train_freq": 4}),
    "VecNormalize": Setup(n_envs=2, normalized=True),
    "HER": Setup(DriftingGoals, arguments={"replay_buffer_class": HerReplayBuffer}, policy="MultiInputPolicy"),
    "offline to online": Setup(arguments={"offline_dataset": "data.npz", "pretrain_steps": 120}),
    "SubprocVecEnv": Setup(n_envs=2, vec_env_cls=SubprocVecEnv),
    "n-step returns, window, full buffer": Setup(arguments={"n_steps": 3, "causal_window": 200, "buffer_size": 150}),
    "memory efficient": Setup(
        arguments={
            "optimize_memory_usage": True,
            "replay_buffer_kwargs": {"handle_timeout_termination": False},
            "buffer_size": 150,
        }
    ),
    "action noise with a memory": Setup(
        n_envs=2, arguments={"action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.3 * np.ones(1))}
    ),
    "whole episodes, schedules": Setup(
        arguments={"train_freq": (1, "episode"), "gradient_steps": 5, "learning_rate": LinearSchedule(1e-3, 0.0, 1.0)}
    ),
    "abstraction": Setup("sb3_causalgdp.stress:Distracted/Pendulum-v1", arguments={"causal_abstraction": HIDES_EARLY}),
    "SAC": Setup(arguments={"learning_starts": 50}, algorithm=SAC),
}


def write_dataset(folder):
    generator, n_rows, no = np.random.default_rng(0), 300, np.zeros(300, bool)
    observations, following = generator.normal(size=(2, n_rows, 3)).astype(np.float32)
    np.savez(
        folder / "data.npz",
        observations=observations,
        actions=generator.uniform(-2.0, 2.0, (n_rows, 1)).astype(np.float32),
        rewards=generator.normal(size=n_rows),
        next_observations=following,
        terminations=no,
        truncations=~no,
    )
