"""Sampling from a copy of a replay buffer that lies where the networks are."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import DictReplayBufferSamples, ReplayBufferSamples

from sb3_causalgdp.acceleration import switch
from sb3_causalgdp.offline.replay import leaves_of, map_leaves

Columns = dict[str, Any]
"""By name: ``(positions, n_envs, ...)``, or a dictionary of those."""


class DeviceReplay:
    """
    The transitions of one of SB3's replay buffers on a GPU: batches are drawn there, by its own generator, so that nothing but
    new transitions crosses the bus.

    :param buffer: The replay buffer; what is added to it later is copied when a batch is drawn
    :param device: Where the copy is
    """

    # Of the GPU's free memory: the networks and their optimizers need little, but others may share it
    LARGEST_SHARE = 0.5

    def __init__(self, buffer: ReplayBuffer, device: th.device) -> None:
        self.buffer = buffer
        self.device = device
        self.columns: Columns = {name: map_leaves(self._empty_like, values) for name, values in _columns(buffer).items()}
        self._copied = 0  # position up to which rows were copied
        self._was_full = False
        self._newest: list[np.ndarray] | None = None

    @classmethod
    def covers(cls, buffer: ReplayBuffer, device: th.device) -> bool:
        """
        :param buffer: A replay buffer
        :param device: Where batches are needed
        :return: Whether that is a GPU with room for the buffer, and the buffer is one of those whose rows are transitions
        """
        if device.type != "cuda" or not cls.has_plain_rows(buffer) or not switch.is_on():
            return False
        free, _ = th.cuda.mem_get_info(device)
        needed = sum(values.size * _dtype_of(values).itemsize for values in _arrays(buffer))
        return needed <= cls.LARGEST_SHARE * free

    @staticmethod
    def has_plain_rows(buffer: ReplayBuffer) -> bool:
        """
        :param buffer: A replay buffer
        :return: Whether each of its rows is a transition: not where goals are relabelled, rewards summed or observations
            shared
        """
        return type(buffer) in (ReplayBuffer, DictReplayBuffer) and not buffer.optimize_memory_usage

    def sample(self, batch_size: int) -> ReplayBufferSamples | DictReplayBufferSamples:
        """
        :param batch_size: Number of transitions
        :return: As the buffer's own ``sample`` gives them, drawn by the device's generator; 64-bit observations in 32 bits
        """
        self.copy_new_rows()
        n_envs = self.buffer.n_envs
        rows = th.randint(self.buffer.size() * n_envs, (batch_size,), device=self.device)
        return self.transitions(rows // n_envs, rows % n_envs)

    def transitions(self, positions: th.Tensor, envs: th.Tensor) -> ReplayBufferSamples | DictReplayBufferSamples:
        """
        :param positions: In the buffer, shape ``(batch,)``
        :param envs: Of which environment, shape ``(batch,)``
        :return: These transitions
        """
        drawn = {name: map_leaves(lambda values: values[positions, envs], values) for name, values in self.columns.items()}
        # Only dones that are not due to timeouts, see SB3's ReplayBuffer
        drawn["dones"] = (drawn["dones"] * (1.0 - drawn.pop("timeouts"))).unsqueeze(1)
        drawn["rewards"] = drawn["rewards"].unsqueeze(1)
        return (DictReplayBufferSamples if isinstance(self.buffer, DictReplayBuffer) else ReplayBufferSamples)(**drawn)

    def copy_new_rows(self) -> None:
        """Copy what was added since the last time."""
        position, size = self.buffer.pos, self.buffer.size()
        if self._was_overtaken():
            self._copy(0, size)
        elif position < self._copied or (self.buffer.full and not self._was_full and position == self._copied):
            self._copy(self._copied, size)
            self._copy(0, position)
        else:
            self._copy(self._copied, position)
        if position != self._copied or self._newest is None:
            self._newest = self._row_before(position)
        self._copied, self._was_full = position, self.buffer.full

    def _was_overtaken(self) -> bool:
        """Whether more rows were added than the buffer holds: then the newest one of the last time is another one now."""
        if self._newest is None:
            return False
        now = self._row_before(self._copied)
        return not all(np.array_equal(old, new, equal_nan=True) for old, new in zip(self._newest, now, strict=True))

    def _row_before(self, position: int) -> list[np.ndarray]:
        return [values[position - 1].copy() for values in _arrays(self.buffer)]

    def _copy(self, first: int, end: int) -> None:
        if first == end:
            return
        for name, column in _columns(self.buffer).items():
            for there, here in zip(leaves_of(self.columns[name]), leaves_of(column), strict=True):
                there[first:end].copy_(th.from_numpy(here[first:end]))

    def _empty_like(self, values: np.ndarray) -> th.Tensor:
        return th.zeros(values.shape, dtype=_dtype_of(values), device=self.device)


def _columns(buffer: ReplayBuffer) -> Columns:
    names = ("observations", "actions", "next_observations", "dones", "timeouts", "rewards")
    return {name: getattr(buffer, name) for name in names}


def _arrays(buffer: ReplayBuffer) -> Iterator[np.ndarray]:
    for column in _columns(buffer).values():
        yield from leaves_of(column)


def _dtype_of(values: np.ndarray) -> th.dtype:
    dtype = th.from_numpy(values[:0]).dtype
    return th.float32 if dtype is th.float64 else dtype
