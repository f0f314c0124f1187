"""What was done to the rewards of recorded transitions, and how to undo it."""

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

    :param name: A key of :data:`~sb3_causalgdp.offline.rewards.REWARD_TRANSFORMS`
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
