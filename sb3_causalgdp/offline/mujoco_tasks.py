"""Data of locomotion tasks, as D4RL's: from a policy that SAC trained half-way, or from that training itself."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor

from sb3_causalgdp.files import remove_folder, renamed_when_done
from sb3_causalgdp.offline.extras import need
from sb3_causalgdp.offline.scores import normalized_score
from sb3_causalgdp.offline.storage import Episode, make_environment

EVALUATION_FREQUENCY = 5_000  # environment steps, also between checkpoints
EVALUATION_EPISODES = 5
N_ROLLOUT_ENVS = 8
ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


@dataclass(frozen=True)
class MujocoTask:
    """
    :param environment_id: Gymnasium's id
    :param max_episode_steps: Episode length in steps, None for the environment's own
    :param needs: Package that registers the environment
    """

    environment_id: str
    max_episode_steps: int | None = None
    needs: str = "mujoco"

    def make(self) -> gym.Env[Any, Any]:
        """
        :return: a new environment
        :raises ImportError: without the package that it needs
        """
        self.register()
        return Monitor(make_environment(self.environment_id, self.max_episode_steps))

    def register(self) -> None:
        """
        :raises ImportError: without the package that the environment needs
        """
        module = need(self.needs)
        if self.environment_id not in gym.registry:
            gym.register_envs(module)


# v4 has the rewards of D4RL's v2; D4RL's pen runs 100 steps, Gymnasium-Robotics' 200
MUJOCO_TASKS = {
    "halfcheetah": MujocoTask("HalfCheetah-v4"),
    "hopper": MujocoTask("Hopper-v4"),
    "walker2d": MujocoTask("Walker2d-v4"),
    "pen": MujocoTask("AdroitHandPen-v1", max_episode_steps=100, needs="gymnasium_robotics"),
}


# Training ---------------------------------------------------------------------------------------------------------------


class Training:
    """
    Training of SAC until its policy reaches a score, in a folder where an interrupted training goes on.

    A training that was interrupted does not repeat the steps of one that was not: the episode at the interruption is cut.

    :param name: One of ``MUJOCO_TASKS``
    :param level: Normalised score at which to stop; D4RL's "medium" is a third of the expert's
    :param max_steps: Number of environment steps after which to give up
    :param seed: Seed
    :param folder: Where checkpoints lie
    """

    def __init__(self, name: str, level: float, max_steps: int, seed: int, folder: Path) -> None:
        self.name, self.level, self.max_steps, self.seed = name, level, max_steps, seed
        self.folder = folder
        self.task = MUJOCO_TASKS[name]
        self.env = self.task.make()
        self.score = -np.inf
        self.model = self._restored() or SAC(
            "MlpPolicy", self.env, seed=seed, buffer_size=max_steps, learning_starts=min(10_000, max_steps // 2)
        )

    def run(self, report: Callable[[int, float], None] = lambda steps, score: None) -> SAC:
        """
        :param report: Called with the number of steps so far and the score after each evaluation
        :return: the trained model, with all its transitions in its replay buffer
        :raises ValueError: if the score is not reached; the training can go on with more steps
        """
        while not self.score >= self.level:
            left = self.max_steps - self.model.num_timesteps
            if left <= 0:
                raise ValueError(
                    f"{self.name} scores {self.score:.1f} after {self.model.num_timesteps:,} training steps, not "
                    f"{self.level:g}: with more training steps it goes on where it stopped, or ask for a lower level"
                )
            self.model.learn(min(EVALUATION_FREQUENCY, left), reset_num_timesteps=False)
            self.score = self._evaluate()
            self._save()
            report(self.model.num_timesteps, self.score)
        return self.model

    def _evaluate(self) -> float:
        env = self.task.make()
        env.reset(seed=self.seed + 1)
        # Not deterministic: what counts is the policy that records the data
        returns, _ = evaluate_policy(
            self.model, env, EVALUATION_EPISODES, deterministic=False, return_episode_rewards=True, warn=False
        )
        env.close()
        return normalized_score(self.name, returns).mean

    def _save(self) -> None:
        """Under a temporary name first, so that the newest checkpoint is always whole."""
        path = self.folder / f"{self.model.num_timesteps:010d}"
        with renamed_when_done(path) as folder:
            self.model.save(folder / "model.zip")
            np.savez(folder / "transitions.npz", **_transitions(self.model), score=np.float64(self.score))
        for other in self.folder.iterdir():
            if other != path:
                remove_folder(other)

    def _restored(self) -> SAC | None:
        checkpoints = sorted(path for path in self.folder.glob("*") if path.name.isdigit())
        if not checkpoints:
            return None
        with np.load(checkpoints[-1] / "transitions.npz") as stored:
            n_stored = len(stored["rewards"])
            model = SAC.load(checkpoints[-1] / "model.zip", env=self.env, buffer_size=max(self.max_steps, n_stored))
            buffer = model.replay_buffer
            assert buffer is not None
            for name in ARRAYS:
                getattr(buffer, name)[:n_stored, 0] = stored[name]
            self.score = float(stored["score"])
        buffer.pos = n_stored % buffer.buffer_size
        buffer.full = n_stored == buffer.buffer_size
        return model


def _transitions(model: SAC) -> dict[str, Any]:
    """What the replay buffer holds of its one environment, oldest first: nothing is overwritten during the training."""
    assert model.replay_buffer is not None
    return {name: getattr(model.replay_buffer, name)[: model.replay_buffer.size(), 0] for name in ARRAYS}


# Episodes ---------------------------------------------------------------------------------------------------------------


def replay_episodes(model: SAC, steps: int | None = None) -> Iterator[Episode]:
    """
    :param model: A trained model whose replay buffer holds one environment's transitions
    :param steps: How many of the newest transitions, None for all
    :return: the episodes of its replay buffer; the first and the last can be cut
    """
    arrays = {name: array if steps is None else array[-steps:] for name, array in _transitions(model).items()}
    observations, following, dones = arrays["observations"], arrays["next_observations"], arrays["dones"] > 0
    # Where an interrupted training went on, an episode stops without being done
    jumps = (observations[1:] != following[:-1]).any(axis=1)
    ends = np.append(np.flatnonzero(dones[:-1] | jumps), len(dones) - 1) + 1
    actions = np.asarray(model.policy.unscale_action(arrays["actions"]), dtype=np.float32)
    for start, end in zip(np.append(0, ends[:-1]), ends, strict=True):
        yield Episode(
            np.concatenate([observations[start:end], following[end - 1 : end]]),
            actions[start:end],
            arrays["rewards"][start:end].astype(np.float64),
            terminated=bool(dones[end - 1] and not arrays["timeouts"][end - 1]),
        )


class _Recorder:
    """One environment and its current episode."""

    def __init__(self, env: gym.Env[Any, Any], seed: int) -> None:
        self.env = env
        self.observations: list[np.ndarray] = [env.reset(seed=seed)[0]]
        self.actions: list[np.ndarray] = []
        self.rewards: list[float] = []

    def step(self, action: np.ndarray) -> Episode | None:
        observation, reward, terminated, truncated, _ = self.env.step(action)
        self.observations.append(observation)
        self.actions.append(action)
        self.rewards.append(float(reward))
        return self.finish(terminated) if terminated or truncated else None

    def finish(self, terminated: bool = False) -> Episode:
        episode = Episode(np.array(self.observations), np.array(self.actions), np.array(self.rewards), terminated)
        self.observations, self.actions, self.rewards = [self.env.reset()[0]], [], []
        return episode


def policy_episodes(
    model: Any, make_env: Callable[[], gym.Env[Any, Any]], steps: int, seed: int, n_envs: int = N_ROLLOUT_ENVS
) -> Iterator[Episode]:
    """
    Roll a policy out, with exploration.

    :param model: Has SB3's ``predict``
    :param make_env: Makes an environment
    :param steps: Number of transitions over all environments
    :param seed: Seed of the environments; the policy's is PyTorch's global one
    :param n_envs: Number of environments that share one forward pass
    :return: the episodes as they end, then the unfinished ones
    """
    recorders = [_Recorder(make_env(), seed + i) for i in range(min(n_envs, steps))]
    for done in range(0, steps, len(recorders)):
        observations = np.stack([recorder.observations[-1] for recorder in recorders])
        actions, _ = model.predict(observations, deterministic=False)
        for recorder, action in zip(recorders[: steps - done], actions, strict=False):
            episode = recorder.step(action)
            if episode is not None:
                yield episode
    for recorder in recorders:
        if recorder.rewards:
            yield recorder.finish()
        recorder.env.close()
