"""Sampling from several replay buffers, and an environment that has spaces alone."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer


def can_sample(buffer: ReplayBuffer) -> bool:
    """
    :param buffer: A replay buffer
    :return: Whether it can be sampled: HER needs the end of an episode
    """
    if isinstance(buffer, HerReplayBuffer):
        return bool((buffer.ep_length > 0).any())
    # The memory efficient buffer cannot give the row that it writes next
    return buffer.size() > int(buffer.full and buffer.optimize_memory_usage)


def concatenate_samples(samples: Sequence[Any]) -> Any:
    """
    :param samples: Samples of SB3's replay buffers, all of one kind
    :return: One sample with all rows
    """
    if len(samples) == 1:
        return samples[0]
    return type(samples[0])(*(_concatenate(parts) for parts in zip(*samples, strict=True)))


def _concatenate(parts: Sequence[Any]) -> Any:
    if isinstance(parts[0], dict):
        return {key: th.cat([part[key] for part in parts]) for key in parts[0]}
    return None if parts[0] is None else th.cat(list(parts))


def map_leaves(function: Callable[[Any], Any], part: Any) -> Any:
    """
    :param function: What is done to each array or tensor
    :param part: A part of a sample or a column of a buffer: one of these, or a dictionary of them
    :return: The results, in the same form
    """
    return {key: function(values) for key, values in part.items()} if isinstance(part, dict) else function(part)


def map_sample(function: Callable[[th.Tensor], th.Tensor], sample: Any) -> Any:
    """
    :param function: What is done to each tensor
    :param sample: Sample of a replay buffer
    :return: A sample of the results
    """
    return type(sample)(*(None if part is None else map_leaves(function, part) for part in sample))


def leaves_of(part: Any) -> Iterator[Any]:
    """
    :param part: As for :func:`map_leaves`
    :return: Its arrays or tensors
    """
    yield from part.values() if isinstance(part, dict) else (part,)


def arrays_of(buffer: ReplayBuffer) -> Iterator[tuple[str, np.ndarray]]:
    """
    :param buffer: A replay buffer
    :return: Its arrays by the attribute's name, those of dictionaries by name and key, as in ``observations/position``
    """
    for name, value in vars(buffer).items():
        if isinstance(value, dict):
            yield from ((f"{name}/{key}", part) for key, part in value.items() if isinstance(part, np.ndarray))
        elif isinstance(value, np.ndarray):
            yield name, value


def deal_rows(sample: Any, n_parts: int) -> Any:
    """
    Put the rows of one large sample into the order of batches, one behind the other, each with its share of every kind of row:
    a HER sample, or one of several buffers, has its kinds one behind the other, so that a batch takes every
    ``n_parts``-th row.

    :param sample: Sample of a replay buffer
    :param n_parts: Number of batches
    :return: The same rows
    """
    if n_parts == 1:
        return sample
    return map_sample(lambda values: values.unflatten(0, (-1, n_parts)).transpose(0, 1).flatten(0, 1), sample)


def rows_of(sample: Any, rows: slice) -> Any:
    """
    :param sample: Sample of a replay buffer
    :param rows: Which of its rows
    :return: These, in the sample's own memory
    """
    return map_sample(lambda values: values[rows], sample)


class SpacesEnv(VecEnv):
    """
    Stands where SB3 wants an environment and only its spaces are known; it cannot be stepped.

    :param observation_space: Observation space
    :param action_space: Action space
    :param num_envs: Number of environments
    :param state_names: Names of the observation's components, None if they have none
    :param action_names: Names of the action's components, None if they have none
    """

    MESSAGE = "There is no environment, only spaces: call model.set_env(env) first"

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        num_envs: int = 1,
        state_names: Sequence[str] | None = None,
        action_names: Sequence[str] | None = None,
    ) -> None:
        self.render_mode = None
        self.names = {"state_names": state_names, "action_names": action_names}
        super().__init__(num_envs, observation_space, action_space)

    def reset(self):
        raise RuntimeError(self.MESSAGE)

    def step_async(self, actions) -> None:
        raise RuntimeError(self.MESSAGE)

    def step_wait(self):
        raise RuntimeError(self.MESSAGE)

    def close(self) -> None:
        pass

    def get_attr(self, attr_name, indices=None):
        if attr_name == "render_mode":
            return [None] * self.num_envs
        if self.names.get(attr_name) is not None:
            return [self.names[attr_name]] * self.num_envs
        raise AttributeError(self.MESSAGE)

    def set_attr(self, attr_name, value, indices=None) -> None:
        raise RuntimeError(self.MESSAGE)

    def env_method(self, method_name, *method_args, indices=None, **method_kwargs):
        raise RuntimeError(self.MESSAGE)

    def env_is_wrapped(self, wrapper_class, indices=None):
        return [False] * self.num_envs
