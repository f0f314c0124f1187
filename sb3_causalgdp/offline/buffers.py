"""A model's buffers of transitions, and their files."""

import io
import os
import pathlib
import warnings
from collections.abc import Iterable
from typing import Any, TypeVar

from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_causalgdp.files import saved_when_done
from sb3_causalgdp.offline.layouts import LaidOutAlgorithm
from sb3_causalgdp.offline.loaded_buffers import check_loaded_buffer, in_columns
from sb3_causalgdp.offline.preload import (
    copy_rows,
    positions_needed,
    preload_buffer,
)
from sb3_causalgdp.offline.saved_buffers import can_be_arrays, read_buffer, write_buffer
from sb3_causalgdp.offline.sources import open_source, with_columns
from sb3_causalgdp.saving.archives import errors_of, existing
from sb3_causalgdp.sources.buffers import SUFFIXES
from sb3_causalgdp.sources.chunks import Source
from sb3_causalgdp.sources.rewards import RewardTransform, SavedRewards

SelfAlgorithm = TypeVar("SelfAlgorithm", bound="BufferedAlgorithm")


class BufferedAlgorithm(LaidOutAlgorithm):
    """
    An algorithm with preloaded transitions beside those of the environment, which are saved and loaded together.

    :param args: As for ``OffPolicyAlgorithm``
    :param offline_dataset: What :meth:`preload` loads when training starts and nothing is there
    :param reward_transform: What is done to the rewards once transitions were preloaded
    :param kwargs: As for ``OffPolicyAlgorithm``
    """

    def __init__(self, *args, offline_dataset: str | None = None, reward_transform: str = "none", **kwargs) -> None:
        super().__init__(*args, **kwargs)
        self.offline_dataset = offline_dataset
        self.reward_transform = reward_transform
        # Preloaded transitions, which those of the environment never overwrite
        self.offline_buffer: ReplayBuffer | None = None
        self._offline_marks: list[str] = []
        self._reward_transform: RewardTransform | None = None

    @property
    def n_environment_steps(self) -> int:
        """How many steps were made in environments."""
        return self.num_timesteps

    def preload(
        self: SelfAlgorithm,
        source: Any,
        reward_transform: str | None = None,
        progress_bar: bool = False,
        download: bool = True,
        trusted: bool = False,
        **columns: Any,
    ) -> SelfAlgorithm:
        """
        Load recorded transitions into ``offline_buffer``: all of them, or none when something is wrong with them. Until
        ``learn()`` collects others, it is the replay buffer too; from then on, the environment's transitions go to a replay
        buffer of their own, and batches are made from both (``offline_fraction``). A second call adds to the first.

        Observations are flattened as the environment's ``FlattenObservation`` does, actions are scaled to [-1, 1], and a
        training ``VecNormalize`` gets their statistics.

        :param source: The id of a Minari dataset (``"D4RL/pointmaze/umaze-v2"``), a ``minari.MinariDataset``, a replay buffer
            of SB3 or the path of a saved one, or arrays: a mapping (or the path of an ``.npz`` file) of ``observations``,
            ``actions``, ``rewards``, ``next_observations``, ``terminations`` and ``truncations``; or a
            :class:`~sb3_causalgdp.sources.tables.Table`, or a data frame or the path of a table with ``columns``
        :param reward_transform: What is done to the rewards, here and in ``learn()``; None takes the constructor's
        :param progress_bar: Whether to show a progress bar (needs tqdm)
        :param download: Whether to download a dataset that is not on this machine
        :param trusted: Whether a pickled buffer may hold more than what SB3's own are made of, which could run code
        :param columns: Of a table: ``states=``, ``actions=``, ``reward=`` and the other arguments of
            :class:`~sb3_causalgdp.sources.tables.Table`
        :return: The model
        """
        table = with_columns(source, columns)
        if columns:
            raise TypeError(f"preload() got an unexpected keyword argument {next(iter(columns))!r}")
        data = open_source(table, download, trusted)
        self._check_names(data)
        name = self.reward_transform if reward_transform is None else reward_transform
        if self._reward_transform is not None and name != self.reward_transform:
            raise ValueError(f"The model's rewards are transformed by {self.reward_transform!r} already, got {name!r}")
        with errors_of(data.name, "cannot be loaded"):
            buffer = self._buffer_with_room(data)
        transform = name if self._reward_transform is None else self._reward_transform
        self._check_layout(data.layout, data.name)
        done = preload_buffer(buffer, data, self.env, self._vec_normalize_env, transform, progress_bar, self._layout_of)
        collected = self.replay_buffer
        if collected is self.offline_buffer or self._replay_buffer_is_empty():
            self.replay_buffer = buffer
        elif collected is not buffer and self._reward_transform is None and done.reward_transform != RewardTransform():
            self._transform_collected(done.reward_transform)
        self.offline_buffer = buffer
        self.reward_transform, self._reward_transform = name, done.reward_transform
        self._offline_marks.append(done.mark)
        return self

    def _check_names(self, data: Source) -> None:
        """Whether the columns of a table are the model's variables, where these have names."""

    def _transform_collected(self, transform: RewardTransform) -> None:
        """The rewards of transitions that were collected before the model knew of a transform."""
        assert self.replay_buffer is not None
        rows = self.replay_buffer.rewards[: self.replay_buffer.size()]
        rows[:] = transform(rows)

    def _buffer_with_room(self, data: Source) -> ReplayBuffer:
        buffer = self.offline_buffer
        if buffer is None:
            buffer = self.replay_buffer if self._replay_buffer_is_empty() else self._new_buffer(self.n_envs)
        assert buffer is not None
        needed = positions_needed(buffer, data)
        if needed <= buffer.buffer_size:
            return buffer
        if buffer is self.replay_buffer and buffer is not self.offline_buffer:
            warnings.warn(
                f"{data.name}: {data.n_transitions} transitions, which do not fit in buffer_size={self.buffer_size}. They "
                "get a larger buffer; that of the transitions to come keeps its size"
            )
        larger = self._new_buffer(needed * self.n_envs)
        copy_rows(buffer, larger)
        return larger

    def _load_offline_dataset(self, progress_bar: bool) -> None:
        if self.offline_dataset is not None and self.offline_buffer is None and self._replay_buffer_is_empty():
            self.preload(self.offline_dataset, progress_bar=progress_bar)

    def _replay_buffer_is_empty(self) -> bool:
        return self.replay_buffer is None or self.replay_buffer.size() == 0

    def _new_buffer(self, buffer_size: int) -> ReplayBuffer:
        assert self.replay_buffer_class is not None
        kwargs = dict(self.replay_buffer_kwargs)
        if issubclass(self.replay_buffer_class, HerReplayBuffer):
            kwargs["env"] = self.env
        return self.replay_buffer_class(
            buffer_size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            optimize_memory_usage=self.optimize_memory_usage,
            **kwargs,
        )

    def save_replay_buffer(self, path: str | pathlib.Path | io.BufferedIOBase) -> None:
        """
        Save the replay buffer, and with it the preloaded transitions: the stored rows as arrays that need no pickle (``.npz``,
        also where the name has no suffix: such a file can be given away), or with the suffix ``.pkl`` as SB3 does. Buffers of
        your own classes need a pickle. A file is replaced only once the new one is complete.

        :param path: Path to the file where the replay buffer should be saved
        :raises ValueError: If a buffer of your own class is to be saved as ``.npz``
        """
        assert self.replay_buffer is not None
        is_path = isinstance(path, str | os.PathLike)
        suffix = pathlib.Path(path).suffix if is_path else ""  # type: ignore[arg-type]
        pickled = suffix == ".pkl"
        if suffix == "" and not can_be_arrays(self.replay_buffer):
            pickled = True
            warnings.warn(f"{type(self.replay_buffer).__name__} is pickled: load_replay_buffer needs trusted=True to read it")
        self.replay_buffer.offline_part = (self.offline_buffer, self._offline_marks)  # type: ignore[attr-defined]
        more = {
            "saved_after": self.n_environment_steps,
            "observation_layout": self.observation_layout,
            "reward_transform": self._saved_rewards().to_plain(),
        }
        vars(self.replay_buffer).update(more)
        try:
            with saved_when_done(path, ".pkl" if pickled else ".npz") as file:
                if pickled:
                    super().save_replay_buffer(file)
                else:
                    write_buffer(self.replay_buffer, file)
        finally:
            for name in ("offline_part", *more):
                del vars(self.replay_buffer)[name]

    def _saved_rewards(self) -> SavedRewards:
        if self._reward_transform is None:
            return SavedRewards("none", RewardTransform())
        return SavedRewards(self.reward_transform, self._reward_transform)

    def _check_rewards(self, saved: Any, name: str) -> tuple[SavedRewards, SavedRewards] | None:
        """What was done to the rewards of a file, and what the model does; None if they may stay, or the file does not say."""
        if saved is None:
            return None
        given, own = SavedRewards.from_plain(saved), self._saved_rewards()
        if self._reward_transform is None and self.reward_transform != "none":
            # The model's own numbers come with the first data
            own = given
            if given.name not in ("none", self.reward_transform):
                raise ValueError(
                    f"{name} holds rewards that were transformed by {given.name!r}, and the model's reward_transform is "
                    f"{self.reward_transform!r}: pass reward_transform={given.name!r} or 'none' to the model, or preload() it"
                )
        return given, own

    def load_replay_buffer(
        self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True, *, trusted: bool = False
    ) -> None:
        """
        Load a replay buffer, and the preloaded transitions that were saved with it. When it raises, the model has what it had.
        Transitions of another number of environments are put into as many columns as the model has environments, and rewards
        that were saved with another ``reward_transform`` get that of the model.

        :param path: Path to the file, as ``.npz`` or pickled; without its suffix, the first of these that is there
        :param truncate_last_traj: See SB3's ``load_replay_buffer``, for ``HerReplayBuffer``
        :param trusted: Whether a pickle may hold more than the replay buffers of SB3, which could run code
        :raises ValueError: If the file is not whole, or not trusted and needs to be; if the buffer is of another environment,
            is damaged, holds NaN or infinite values, or is of another number of environments and cannot be brought to that of
            the model
        """
        name = "The replay buffer"
        if isinstance(path, str | os.PathLike):
            name, path = str(path), existing(path, SUFFIXES)
        self._use_loaded_buffer(read_buffer(path, trusted), name, truncate_last_traj)

    def _use_loaded_buffer(self, buffer: ReplayBuffer, name: str, truncate_last_traj: bool) -> None:
        """All or nothing."""
        offline, marks = vars(buffer).pop("offline_part", (None, []))
        self._check_layout(vars(buffer).pop("observation_layout", None), name)
        rewards = self._check_rewards(vars(buffer).pop("reward_transform", None), name)
        saved_after = vars(buffer).pop("saved_after", self.num_timesteps)
        for one in {id(one): one for one in (buffer, offline) if one is not None}.values():
            if isinstance(one, HerReplayBuffer):
                assert self.env is not None, "You must pass an environment at load time when using `HerReplayBuffer`"
                one.set_env(self.env)
            # Update saved replay buffer device to match current setting, see GH#1561
            one.device = self.device
        online = self._fitting(buffer, name)
        if offline is buffer:
            offline = online
        elif offline is not None:
            offline = self._fitting(offline, f"{name}, preloaded part")
        if isinstance(online, HerReplayBuffer) and truncate_last_traj:
            online.truncate_last_trajectory()
        if rewards is not None:
            self._use_rewards(*rewards, {id(one): one for one in (online, offline) if one is not None}.values())
        self.replay_buffer, self.offline_buffer, self._offline_marks = online, offline, marks
        if saved_after != self.num_timesteps:
            warnings.warn(
                f"{name} was saved after {saved_after} steps, the model after {self.num_timesteps}: they are not of one "
                "moment, as they are in a checkpoint of save_checkpoint()"
            )

    def _use_rewards(self, given: SavedRewards, own: SavedRewards, buffers: Iterable[ReplayBuffer]) -> None:
        if given.transform != own.transform:
            for buffer in buffers:
                rows = buffer.rewards[: buffer.size()]
                rows[:] = own.transform(given.transform.undone(rows))
        if self._reward_transform is None and own.name == self.reward_transform != "none":
            self._reward_transform = own.transform

    def _fitting(self, buffer: ReplayBuffer, name: str) -> ReplayBuffer:
        check_loaded_buffer(buffer, self.observation_space, self.action_space, name)
        buffer = self._with_own_returns(buffer)
        return buffer if buffer.n_envs == self.n_envs else in_columns(buffer, self.n_envs, self._new_buffer, name)

    def _with_own_returns(self, buffer: ReplayBuffer) -> ReplayBuffer:
        """Rows are of single steps in both kinds of buffer: of how many steps returns are, the model says."""
        plain = (ReplayBuffer, NStepReplayBuffer)
        if type(buffer) in plain and self.replay_buffer_class in plain and type(buffer) is not self.replay_buffer_class:
            own = self._new_buffer(buffer.buffer_size * self.n_envs)
            copied = {name: value for name, value in vars(buffer).items() if name not in ("n_steps", "gamma", "device")}
            vars(own).update(copied)
            return own
        if isinstance(buffer, NStepReplayBuffer):
            returns = {name: value for name, value in self.replay_buffer_kwargs.items() if name in ("n_steps", "gamma")}
            vars(buffer).update(returns)
        return buffer
