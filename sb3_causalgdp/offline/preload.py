"""Offline transitions into a replay buffer of SB3: checked, whole arrays at a time, all of them or none."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_causalgdp.hints import how_to_install
from sb3_causalgdp.offline.observations import ObservationMap, observation_map
from sb3_causalgdp.offline.rewards import check_reward_transform, make_reward_transform
from sb3_causalgdp.sources.chunks import Chunk, Source
from sb3_causalgdp.sources.rewards import RewardTransform
from sb3_causalgdp.sources.spaces import shape_of_arrays

ACTION_TOLERANCE = 1e-5
UPDATE_ROWS = 10_000


@dataclass(frozen=True)
class Preloaded:
    """
    What was loaded.

    :param first: Position of the first row in the buffer
    :param end: Position after the last one
    :param reward_transform: What was done to the rewards
    :param mark: Tells these rows from others
    """

    first: int
    end: int
    reward_transform: RewardTransform
    mark: str


def positions_needed(buffer: ReplayBuffer, source: Source) -> int:
    """
    :param buffer: The buffer
    :param source: What is to be loaded
    :return: How many positions the buffer must have to hold what it holds and the source
    """
    # The memory efficient buffer keeps the last next observation at one position more
    return buffer.size() + _n_positions(buffer, source) + int(buffer.optimize_memory_usage)


def _n_positions(buffer: ReplayBuffer, source: Source) -> int:
    return -(-source.n_transitions // buffer.n_envs)


def copy_rows(buffer: ReplayBuffer, larger: ReplayBuffer) -> None:
    """
    :param buffer: A buffer whose rows have not gone round
    :param larger: An empty one of the same kind, which gets its rows
    """
    names = ["observations", "actions", "rewards", "dones", "timeouts"]
    if not buffer.optimize_memory_usage:
        names.append("next_observations")
    if isinstance(buffer, HerReplayBuffer):
        names += ["ep_start", "ep_length"]
    n_rows = buffer.size()
    for name in names:
        values, others = getattr(buffer, name), getattr(larger, name)
        for key in values if isinstance(values, dict) else [...]:
            others[key][:n_rows] = values[key][:n_rows]
    _advance(larger, n_rows)


def preload_buffer(
    buffer: ReplayBuffer,
    source: Source,
    env: VecEnv | None,
    normalizer: VecNormalize | None = None,
    reward_transform: str | RewardTransform = "none",
    progress_bar: bool = False,
    layout_of: Callable[[spaces.Space], spaces.Space | None] = lambda given: None,
) -> Preloaded:
    """
    Append the source's transitions to a buffer that has room for them. When it raises, the buffer holds what it held.

    Trajectories stay in one column of the buffer; where one has to be cut between two columns, it is marked as truncated. With
    several columns, up to ``n_envs - 1`` of the first transitions are stored twice, to fill the last column.

    :param buffer: The buffer, of which no row has been overwritten
    :param source: The transitions
    :param env: The model's environment, if it has one
    :param normalizer: The model's ``VecNormalize``, whose statistics get these rows if it is training
    :param reward_transform: A name of :data:`~sb3_causalgdp.offline.rewards.REWARD_TRANSFORMS`, or the one to go on with
    :param progress_bar: Whether to show a progress bar
    :param layout_of: Gives what the model's observations are flattened from, with its order of keys, for the source's space;
        None where it is not known
    :return: What was loaded
    :raises ValueError: If the source does not fit, or a transition is NaN or infinite
    """
    check_buffer(buffer, reward_transform, normalizer)
    _check_environment(source, env)
    writer = _Writer(buffer, source, layout_of)
    with _progress(source, progress_bar) as advance:
        for chunk in source.chunks():
            writer.write(chunk)
            advance(len(chunk))
    writer.finish()
    returns = writer.return_range
    transform = make_reward_transform(reward_transform, returns) if isinstance(reward_transform, str) else reward_transform
    first, end = writer.first, writer.first + writer.n_positions
    raw_rewards = buffer.rewards[first:end].astype(np.float64)
    mark = f"{source.name}: {source.n_transitions} transitions, rewards {raw_rewards.sum()}"
    if normalizer is not None:
        prime_normalizer(normalizer, buffer, (first, end), [mark])
    buffer.rewards[first:end] = transform(raw_rewards)
    _advance(buffer, end)
    if isinstance(buffer, HerReplayBuffer):
        _mark_episodes(buffer, first, end)
    return Preloaded(first, end, transform, mark)


class _Writer:
    """Writes chunks into the positions behind the buffer's last row, which nobody reads before the buffer is advanced."""

    def __init__(self, buffer: ReplayBuffer, source: Source, layout_of: Callable[[spaces.Space], spaces.Space | None]) -> None:
        self.buffer, self.source = buffer, source
        self.first, self.n_positions = buffer.size(), _n_positions(buffer, source)
        assert self.first + self.n_positions <= buffer.buffer_size
        self.layout_of = layout_of
        self.needs_order = buffer.optimize_memory_usage or isinstance(buffer, NStepReplayBuffer | HerReplayBuffer)
        self.map: ObservationMap | None = None
        if source.observation_space is not None:
            self._make_map(source.observation_space)
        assert isinstance(buffer.action_space, spaces.Box)
        self.low, self.high = buffer.action_space.low.ravel(), buffer.action_space.high.ravel()
        self._check_action_space()
        self.n_written = self.n_clipped = self.episode = self.step = 0
        self.episode_return, self.returns = 0.0, [np.inf, -np.inf]
        self._expected: np.ndarray | None = None
        self._last_done = True

    def _make_map(self, given: spaces.Space) -> None:
        flattens = isinstance(self.buffer.observation_space, spaces.Box) and isinstance(given, spaces.Dict | spaces.Tuple)
        layout = self.layout_of(given) if flattens else None
        self.map = observation_map(given, self.buffer.observation_space, layout, self.source.name)

    @property
    def return_range(self) -> tuple[float, float]:
        """Lowest and highest return of an episode."""
        return self.returns[0], self.returns[1]

    def _check_action_space(self) -> None:
        given, wanted = self.source.action_space, self.buffer.action_space
        if given is None:
            return
        assert isinstance(given, spaces.Box) and isinstance(wanted, spaces.Box)
        if given.shape != wanted.shape or not np.allclose([given.low, given.high], [wanted.low, wanted.high]):
            raise ValueError(
                f"{self.source.name} does not fit the model's action space: it is {given}, and {wanted} is needed"
            )

    def write(self, chunk: Chunk) -> None:
        """Check a chunk and write it, in as many pieces as there are columns that it touches."""
        if self.n_written + len(chunk) > self.source.n_transitions:
            raise ValueError(
                f"{self.source.name} holds more than the {self.source.n_transitions} transitions that it announces"
            )
        if self.map is None:
            self._make_map(shape_of_arrays(chunk.observations))
        assert self.map is not None
        observations, next_observations = self._mapped(chunk.observations), self._mapped(chunk.next_observations)
        actions = self._scaled(chunk)
        assert chunk.terminations is not None and chunk.truncations is not None  # as offline.sources.open_source has seen
        dones = chunk.terminations | chunk.truncations
        if self.needs_order and not self.source.is_in_order:
            self._check_order(observations, next_observations, dones)
        done = 0
        while done < len(chunk):
            column, offset = divmod(self.n_written, self.n_positions)
            count = min(len(chunk) - done, self.n_positions - offset)
            here, there = slice(done, done + count), slice(self.first + offset, self.first + offset + count)
            self._write_observations(observations, next_observations, here, there, column)
            self.buffer.actions[there, column] = actions[here]
            self.buffer.rewards[there, column] = chunk.rewards[here]
            self.buffer.dones[there, column] = dones[here]
            timeouts = chunk.truncations[here] & ~chunk.terminations[here]
            self.buffer.timeouts[there, column] = timeouts if self.buffer.handle_timeout_termination else 0.0
            self._check_finite(there, column, dones[here])
            self._count(chunk.rewards[here], dones[here])
            self.n_written += count
            done += count

    def _mapped(self, tree: Any) -> Any:
        assert self.map is not None
        try:
            return self.map(tree)
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise ValueError(
                f"{self.source.name} does not hold what its observation space announces, in episode {self.episode}: "
                f"{type(error).__name__}: {error}. Nothing was loaded"
            ) from error

    def _scaled(self, chunk: Chunk) -> np.ndarray:
        """Actions in [-1, 1], as SB3 stores them."""
        actions = np.asarray(chunk.actions).reshape(len(chunk), -1)
        if actions.shape[1] != len(self.low):
            raise ValueError(
                f"{self.source.name} does not fit the model's action space: its actions have {actions.shape[1]} components, "
                f"and {self.buffer.action_space} is needed"
            )
        if not self.source.has_scaled_actions:
            actions = 2.0 * (actions - self.low) / (self.high - self.low) - 1.0
        self.n_clipped += int(np.count_nonzero((np.abs(actions) > 1.0 + ACTION_TOLERANCE).any(axis=1)))
        return np.clip(actions, -1.0, 1.0)  # NaN stays NaN

    def _write_observations(self, observations: Any, next_observations: Any, here: slice, there: slice, column: int) -> None:
        buffer = self.buffer
        if isinstance(buffer.observations, dict):
            for key in buffer.observations:
                self._assign(buffer.observations[key], observations[key], here, there, column)
                self._assign(buffer.next_observations[key], next_observations[key], here, there, column)
            return
        self._assign(buffer.observations, observations, here, there, column)
        if buffer.optimize_memory_usage:
            # Of all but the last row, the next position holds the next observation
            last, after = slice(here.stop - 1, here.stop), slice(there.stop, there.stop + 1)
            self._assign(buffer.observations, next_observations, last, after, column)
        else:
            self._assign(buffer.next_observations, next_observations, here, there, column)

    @staticmethod
    def _assign(array: np.ndarray, values: np.ndarray, here: slice, there: slice, column: int) -> None:
        with np.errstate(over="ignore"):  # found afterwards, as an infinite value
            array[there, column] = values[here].reshape(-1, *array.shape[2:])

    def _check_order(self, observations: Any, next_observations: Any, dones: np.ndarray) -> None:
        """n-step returns, HER and the memory efficient buffer read the row after a row as what came after it."""
        now, after = _as_columns(observations), _as_columns(next_observations)
        expected = after if self._expected is None else np.concatenate([self._expected, after])
        found = now[1:] if self._expected is None else now
        broken = (expected[:-1] != found).any(axis=1)
        ends = dones[:-1] if self._expected is None else np.concatenate([[self._last_done], dones[:-1]])
        if (broken & ~ends.astype(bool)).any():
            row = self.n_written + int((broken & ~ends.astype(bool)).argmax())
            raise ValueError(
                f"{self.source.name} are not in the order of their episodes (transition {row}), which "
                f"{type(self.buffer).__name__} and its options need"
            )
        self._expected, self._last_done = after[-1:], dones[-1]

    def _check_finite(self, there: slice, column: int, dones: np.ndarray) -> None:
        for field, values in self._written(there, column):
            if not np.issubdtype(values.dtype, np.floating) or np.isfinite(values).all():
                continue
            row, *where = np.argwhere(~np.isfinite(values))[0].tolist()
            ends = np.flatnonzero(dones[:row])
            episode = self.episode + len(ends)
            step = row - int(ends[-1]) - 1 if len(ends) > 0 else self.step + row
            raise ValueError(
                f"{self.source.name} has a NaN or infinite value in {field}{where or ''} of episode {episode}, step {step}. "
                "Nothing was loaded"
            )

    def _written(self, there: slice, column: int) -> Iterator[tuple[str, np.ndarray]]:
        for name in ("observations", "next_observations", "actions", "rewards"):
            values = getattr(self.buffer, name, None)
            if isinstance(values, dict):
                yield from ((f"{name}[{key!r}]", part[there, column]) for key, part in values.items())
            elif values is None:
                yield name, self.buffer.observations[there.start + 1 : there.stop + 1, column]
            else:
                yield name, values[there, column]

    def _count(self, rewards: np.ndarray, dones: np.ndarray) -> None:
        """Which episode and step comes next, and the returns of the episodes that ended."""
        episodes = np.split(rewards.astype(np.float64), np.flatnonzero(dones) + 1)
        returns = [float(part.sum()) for part in episodes]
        returns[0] += self.episode_return
        *finished, self.episode_return = returns
        self.returns = [min(self.returns[0], *finished), max(self.returns[1], *finished)] if finished else self.returns
        self.episode += len(finished)
        self.step = len(episodes[-1]) + (0 if finished else self.step)

    def finish(self) -> None:
        """Check that all is there, fill the last column and cut the trajectories at the columns' ends."""
        buffer, n_rows = self.buffer, self.n_positions * self.buffer.n_envs
        if self.n_written != self.source.n_transitions:
            raise ValueError(
                f"{self.source.name} is incomplete: it announces {self.source.n_transitions} transitions and holds "
                f"{self.n_written}"
            )
        for row in range(self.n_written, n_rows):
            self._copy_row(row - self.n_written, row)
        last = self.first + self.n_positions - 1
        was_cut = buffer.dones[last] == 0.0
        buffer.dones[last] = 1.0
        if buffer.handle_timeout_termination:
            buffer.timeouts[last, was_cut] = 1.0
        if self.n_clipped > 0:
            warnings.warn(
                f"{self.n_clipped} of {self.n_written} actions of {self.source.name} are outside of the action space and were "
                "clipped"
            )

    def _copy_row(self, row: int, to_row: int) -> None:
        buffer = self.buffer
        (column, offset), (to_column, to_offset) = divmod(row, self.n_positions), divmod(to_row, self.n_positions)
        now, to = self.first + offset, self.first + to_offset
        for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
            values = getattr(buffer, name, None)
            for part in values.values() if isinstance(values, dict) else [values]:
                if part is not None:
                    part[to, to_column] = part[now, column]
        if buffer.optimize_memory_usage:
            buffer.observations[to + 1, to_column] = buffer.observations[now + 1, column]


def _as_columns(observations: Any) -> np.ndarray:
    parts = observations.values() if isinstance(observations, dict) else [observations]
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


def _advance(buffer: ReplayBuffer, end: int) -> None:
    buffer.full = end == buffer.buffer_size
    buffer.pos = 0 if buffer.full else end
    if isinstance(buffer, HerReplayBuffer):
        buffer._current_ep_start[:] = buffer.pos


def _mark_episodes(buffer: HerReplayBuffer, first: int, end: int) -> None:
    """Every episode of these rows is complete, and may be sampled."""
    for column in range(buffer.n_envs):
        ends = first + np.flatnonzero(buffer.dones[first:end, column]) + 1
        starts = np.concatenate([[first], ends[:-1]])
        buffer.ep_start[first:end, column] = np.repeat(starts, ends - starts)
        buffer.ep_length[first:end, column] = np.repeat(ends - starts, ends - starts)


def check_buffer(buffer: ReplayBuffer, reward_transform: str | RewardTransform, normalizer: VecNormalize | None) -> None:
    """
    :param buffer: The buffer that is to hold offline transitions
    :param reward_transform: What is to be done to the rewards
    :param normalizer: The model's ``VecNormalize``
    :raises ValueError: If they do not go together
    """
    check_reward_transform(reward_transform)
    changes_rewards = reward_transform not in ("none", RewardTransform())
    if isinstance(buffer, HerReplayBuffer):
        if buffer.copy_info_dict:
            raise ValueError("HerReplayBuffer(copy_info_dict=True) needs the infos of every step, which are not preloaded")
        if changes_rewards:
            raise ValueError("HerReplayBuffer computes rewards anew: reward_transform must be 'none' with it")
    if changes_rewards and normalizer is not None and normalizer.norm_reward:
        raise ValueError("VecNormalize scales the rewards already: pass norm_reward=False to it, or reward_transform='none'")


def _check_environment(source: Source, env: VecEnv | None) -> None:
    """Environments may share their spaces, as HalfCheetah and Walker2d do."""
    if source.environment is None or env is None:
        return
    try:
        spec = env.get_attr("spec")[0]
    except AttributeError:
        return
    if spec is not None and spec.name != source.environment:
        warnings.warn(f"{source.name} was collected in {source.environment}, and the model's environment is {spec.name}")


def prime_normalizer(normalizer: VecNormalize, buffer: ReplayBuffer, rows: tuple[int, int], marks: list[str]) -> None:
    """
    Count rows in the statistics of a ``VecNormalize`` that is training, unless it has counted them before: it remembers that,
    also when it is saved and loaded.

    :param normalizer: The ``VecNormalize``
    :param buffer: The buffer, whose rewards are as recorded
    :param rows: Position of the first row, and that after the last one
    :param marks: Which transitions these are, see :class:`Preloaded`
    """
    counted: list[str] = vars(normalizer).setdefault("preloaded_marks", [])
    if not normalizer.training or set(marks) <= set(counted):
        return
    first, end = rows
    _prime_returns(normalizer, buffer.rewards[first:end].astype(np.float64), buffer.dones[first:end])
    _prime_observations(normalizer, buffer, first, end)
    counted += marks


def normalised_parts(normalizer: VecNormalize | None) -> list[str]:
    """
    :param normalizer: A model's ``VecNormalize``
    :return: What of its observations is normalised: keys of a dictionary, else ``["observation"]``; empty if nothing is
    """
    if normalizer is None or not normalizer.norm_obs:
        return []
    return sorted(normalizer.norm_obs_keys) if normalizer.norm_obs_keys is not None else ["observation"]


def _prime_observations(normalizer: VecNormalize, buffer: ReplayBuffer, first: int, end: int) -> None:
    if not normalizer.norm_obs:
        return
    rows_at_once = max(1, UPDATE_ROWS // buffer.n_envs)
    for start in range(first, end, rows_at_once):
        rows = slice(start, min(start + rows_at_once, end))
        if isinstance(buffer.observations, dict):
            for key, statistics in normalizer.obs_rms.items():
                values = buffer.observations[key][rows]
                statistics.update(values.reshape(-1, *values.shape[2:]))
        else:
            values = buffer.observations[rows]
            normalizer.obs_rms.update(values.reshape(-1, *values.shape[2:]))


def _prime_returns(normalizer: VecNormalize, rewards: np.ndarray, dones: np.ndarray) -> None:
    """The running discounted sums of each environment, as ``VecNormalize`` gathers them step by step."""
    if not normalizer.norm_reward:
        return
    sums, running = np.empty_like(rewards), np.zeros(rewards.shape[1])
    for step, (reward, done) in enumerate(zip(rewards, dones, strict=True)):
        sums[step] = running = running * normalizer.gamma + reward
        running = running * (done == 0.0)
    normalizer.ret_rms.update(sums.ravel())


@contextmanager
def _progress(source: Source, progress_bar: bool) -> Iterator[Any]:
    if not progress_bar:
        yield lambda n_rows: None
        return
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise ImportError(f"progress_bar=True needs tqdm: {how_to_install('train')}") from error
    with tqdm(total=source.n_transitions, desc=source.name, unit=" transitions", unit_scale=True) as bar:
        yield bar.update
