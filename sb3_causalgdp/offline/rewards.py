"""What others do to the rewards of offline datasets, by name."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True)
class RewardTransform:
    """
    ``scale * reward + shift``: the same for the dataset and for the environment in which training goes on.

    :param scale: The factor
    :param shift: What is added
    """

    scale: float = 1.0
    shift: float = 0.0

    def __call__(self, rewards: Any) -> np.ndarray:
        """
        :param rewards: Rewards of the environment
        :return: What the model learns from
        """
        return self.scale * np.asarray(rewards) + self.shift

    def undone(self, rewards: Any) -> np.ndarray:
        """
        :param rewards: What this made of rewards of the environment
        :return: Those, up to rounding
        """
        return (np.asarray(rewards, np.float64) - self.shift) / self.scale


@dataclass(frozen=True)
class SavedRewards:
    """
    What was done to the rewards of a replay buffer, as its file says.

    :param name: A key of :data:`REWARD_TRANSFORMS`
    :param transform: The numbers
    """

    name: str
    transform: RewardTransform

    def to_plain(self) -> list[Any]:
        """
        :return: The same as JSON has it
        """
        return [self.name, float(self.transform.scale), float(self.transform.shift)]

    @classmethod
    def from_plain(cls, value: Any) -> "SavedRewards":
        """
        :param value: What :meth:`to_plain` gave
        :return: The same
        :raises ValueError: If it is anything else, or a transform that cannot be undone
        """
        if isinstance(value, list | tuple) and len(value) == 3 and isinstance(value[0], str):
            numbers = [number for number in value[1:] if type(number) is float and np.isfinite(number)]
            if len(numbers) == 2 and numbers[0] != 0.0:
                return cls(value[0], RewardTransform(*numbers))
        raise ValueError(f"reward_transform must be a name, a scale other than 0 and a shift, got {str(value)[:80]}")


def _by_return_range(lowest: float, highest: float) -> RewardTransform:
    if not highest > lowest:
        raise ValueError("reward_transform='normalize' needs episodes with different returns")
    return RewardTransform(1000.0 / (highest - lowest))


REWARD_TRANSFORMS: dict[str, Callable[[float, float], RewardTransform]] = {
    "none": lambda lowest, highest: RewardTransform(),
    # 1000 / (highest - lowest return of an episode): IQL on MuJoCo (https://arxiv.org/abs/2110.06169), train_offline.py of
    # ikostrikov/implicit_q_learning; "iql_locomotion" of Diffusion-QL
    "normalize": _by_return_range,
    # (r - 0.5) * 4: CQL on AntMaze (https://arxiv.org/abs/2006.04779), d4rl/examples/cql_antmaze_new.py of
    # aviralkumar2907/CQL; "cql_antmaze" of Diffusion-QL
    "antmaze": lambda lowest, highest: RewardTransform(4.0, -2.0),
    # r - 1: IQL on AntMaze, where it found no difference to CQL's; "iql_antmaze" of Diffusion-QL
    "antmaze_iql": lambda lowest, highest: RewardTransform(1.0, -1.0),
}
"""By name, from the lowest and the highest return of an episode."""


def check_reward_transform(transform: str | RewardTransform) -> None:
    """
    :param transform: A transform or a name
    :raises ValueError: If the name is unknown
    """
    if isinstance(transform, str) and transform not in REWARD_TRANSFORMS:
        raise ValueError(f"Unknown reward_transform {transform!r}: it must be one of {sorted(REWARD_TRANSFORMS)}")


def make_reward_transform(name: str, returns: tuple[float, float]) -> RewardTransform:
    """
    :param name: A key of :data:`REWARD_TRANSFORMS`
    :param returns: Lowest and highest return of an episode
    :return: The transform
    """
    check_reward_transform(name)
    return REWARD_TRANSFORMS[name](*returns)
