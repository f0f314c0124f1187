"""
Each wrapper draws from a random number generator of its own, which ``reset(seed=...)`` seeds: the wrapped environment's own
numbers stay the same. Counters of steps go on through resets.
"""

from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import RecordConstructorArgs


def _positive_integer(name: str, value: Any, smallest: int = 1) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < smallest:
        raise ValueError(f"{name} must be an integer of at least {smallest}, got {value!r}")
    return int(value)


def _numbered(what: str, n: int) -> tuple[str, ...]:
    return tuple(f"{what} {index}" for index in range(1, n + 1))


def _flat_box(env: gym.Env, of: str) -> spaces.Box:
    space = env.observation_space if of == "observation" else env.action_space
    if not isinstance(space, spaces.Box) or len(space.shape) != 1:
        raise ValueError(f"the {of} space must be a Box of one dimension, got {space}")
    return space


def _extended(space: spaces.Box, low: np.ndarray, high: np.ndarray) -> spaces.Box:
    dtype: Any = space.dtype
    return spaces.Box(
        np.concatenate([space.low, low.astype(dtype)]), np.concatenate([space.high, high.astype(dtype)]), dtype=dtype
    )


class _Stress(gym.Wrapper, RecordConstructorArgs):
    """A wrapper with a random number generator of its own."""

    # So that the numbers of two wrappers with the same seed differ
    STREAM: ClassVar[int] = 0

    added_state_names: tuple[str, ...] = ()
    """Names of what is appended to the observation."""
    added_action_names: tuple[str, ...] = ()
    """Names of what is appended to the action."""

    def __init__(self, env: gym.Env, **arguments: Any) -> None:
        RecordConstructorArgs.__init__(self, **arguments)
        gym.Wrapper.__init__(self, env)
        self._generator = np.random.default_rng()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if seed is not None:
            self._generator = np.random.default_rng([self.STREAM, seed])
        observation, info = self.env.reset(seed=seed, options=options)
        return self._after_reset(observation, seed), info

    def _after_reset(self, observation: np.ndarray, seed: int | None) -> np.ndarray:
        return observation


class _MoreObservations(_Stress):
    """Appends entries to the observation."""

    def _append(self, low: np.ndarray, high: np.ndarray) -> None:
        self.observation_space = _extended(_flat_box(self.env, "observation"), low, high)

    def _appended(self, observation: np.ndarray, more: np.ndarray) -> np.ndarray:
        return np.concatenate([observation, more.astype(observation.dtype)])


class _AutoregressiveNoise(_MoreObservations):
    """Appends stationary AR(1) noise of variance 1."""

    KIND: ClassVar[str] = "noise"

    def __init__(self, env: gym.Env, n: int, coefficient: float, **arguments: Any) -> None:
        n = _positive_integer("n", n)
        if not 0 <= coefficient < 1:
            raise ValueError(f"coefficient must be in [0, 1), got {coefficient!r}")
        super().__init__(env, n=n, coefficient=coefficient, **arguments)
        self._coefficient = float(coefficient)
        self._noise = np.zeros(n)
        self._append(np.full(n, -np.inf), np.full(n, np.inf))
        self.added_state_names = _numbered(self.KIND, n)

    def _after_reset(self, observation: np.ndarray, seed: int | None) -> np.ndarray:
        self._noise = self._generator.standard_normal(len(self._noise))
        return self._appended(observation, self._shown())

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        innovation = self._generator.standard_normal(len(self._noise))
        self._noise = self._coefficient * self._noise + np.sqrt(1.0 - self._coefficient**2) * innovation
        return self._appended(observation, self._shown()), reward, terminated, truncated, info

    def _shown(self) -> np.ndarray:
        return self._noise


class NoiseDistractors(_AutoregressiveNoise):
    """
    Appends observations that nothing moves and that move nothing: stationary AR(1) noise of variance 1, drawn anew at each
    reset.

    :param env: Environment with a flat Box as observations
    :param n: Number of observations, at least 1
    :param coefficient: Correlation with the step before, in [0, 1)
    :raises ValueError: on an argument out of range or other observations
    """

    STREAM = 1

    def __init__(self, env: gym.Env, n: int = 20, coefficient: float = 0.95) -> None:
        super().__init__(env, n, coefficient)


class Nuisance(_AutoregressiveNoise):
    """
    Appends AR(1) noise that a behaviour policy follows, see :class:`ConfoundedBehaviour`: in the data it predicts the action,
    and has no effect. The datasets are made with ``mode="present"``, and policies learned from them act with another one.

    :param env: Environment with a flat Box as observations
    :param mode: What the agent sees: ``"present"``, the noise; ``"gone"``, zeros; ``"changed"``, the noise with the other sign
        and twice the size
    :param n: Number of observations, at least 1
    :param coefficient: Correlation with the step before, in [0, 1)
    :raises ValueError: on an argument out of range or other observations
    """

    STREAM = 2
    KIND = "nuisance"
    FACTORS: ClassVar[dict[str, float]] = {"present": 1.0, "gone": 0.0, "changed": -2.0}

    def __init__(self, env: gym.Env, mode: str = "present", n: int = 1, coefficient: float = 0.95) -> None:
        if mode not in self.FACTORS:
            raise ValueError(f"mode must be one of {list(self.FACTORS)}, got {mode!r}")
        super().__init__(env, n, coefficient, mode=mode)
        self._factor = self.FACTORS[mode]

    def _shown(self) -> np.ndarray:
        return self._factor * self._noise


class ConfoundedBehaviour:
    """
    A behaviour policy for datasets, driven by the nuisance at the end of the observation besides its own choice: the action is
    ``policy(observation without the nuisance) + strength * nuisance``, clipped to the action space. The i-th action follows
    the nuisance i modulo n.

    :param policy: From an observation without the nuisance, shape (n_observations,), to an action, shape (d,)
    :param action_space: Where actions are clipped to
    :param strength: In units of half the range of the actions, for a nuisance of one standard deviation
    :param n: Number of nuisances, as in :class:`Nuisance`
    """

    def __init__(
        self, policy: Callable[[np.ndarray], np.ndarray], action_space: spaces.Box, strength: float = 0.5, n: int = 1
    ) -> None:
        self.policy, self.action_space = policy, action_space
        self.strength, self.n = float(strength), _positive_integer("n", n)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        low, high = self.action_space.low, self.action_space.high
        nuisance = observation[len(observation) - self.n :][np.arange(len(low)) % self.n]
        action = self.policy(observation[: len(observation) - self.n]) + self.strength * 0.5 * (high - low) * nuisance
        return np.clip(action, low, high).astype(self.action_space.dtype)


class OtherEnvironment(_MoreObservations):
    """
    Appends the observations of other environments that have nothing to do with the reward, moved by random actions or, with
    ``controlled=True``, by actions of their own behind those of the wrapped one: an agent can move them, and it pays nothing.
    They are reset when they end, and at each reset.

    A checkpoint holds environments whose state is plain Python, as those of classic control.

    :param env: Environment with flat Boxes as observations and actions
    :param other: Gymnasium's id of the others, with flat Boxes, too
    :param copies: Number of the others, at least 1
    :param controlled: Whether the agent moves them
    :raises ValueError: on an argument out of range or other spaces
    """

    STREAM = 3

    def __init__(self, env: gym.Env, other: str = "Pendulum-v1", copies: int = 1, controlled: bool = False) -> None:
        copies = _positive_integer("copies", copies)
        super().__init__(env, other=other, copies=copies, controlled=controlled)
        # Without the checks and the order of calls that gymnasium.make adds: nobody else steps them
        self._others = [gym.make(other, disable_env_checker=True) for _ in range(copies)]
        self._controlled = bool(controlled)
        of_one, actions = _flat_box(self._others[0], "observation"), _flat_box(self._others[0], "action")
        self._n_actions = copies * actions.shape[0]
        self._append(np.tile(of_one.low, copies), np.tile(of_one.high, copies))
        self.added_state_names = _numbered("other", copies * of_one.shape[0])
        self._n_own = _flat_box(env, "action").shape[0]
        if controlled:
            self.added_action_names = _numbered("other action", self._n_actions)
            self.action_space = _extended(
                _flat_box(env, "action"), np.tile(actions.low, copies), np.tile(actions.high, copies)
            )

    def _after_reset(self, observation: np.ndarray, seed: int | None) -> np.ndarray:
        return self._appended(observation, np.concatenate([self._restarted(other) for other in self._others]))

    def _restarted(self, other: gym.Env) -> np.ndarray:
        return other.reset(seed=int(self._generator.integers(2**31)))[0]

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action[: self._n_own])
        space = self._others[0].action_space
        assert isinstance(space, spaces.Box)
        if self._controlled:
            moves = np.asarray(action[self._n_own :], dtype=space.dtype).reshape(len(self._others), -1)
        else:
            moves = self._generator.uniform(space.low, space.high, (len(self._others), *space.shape)).astype(space.dtype)
        seen = []
        for other, move in zip(self._others, moves, strict=True):
            after, _, ended, cut, _ = other.step(move)
            seen.append(self._restarted(other) if ended or cut else after)
        return self._appended(observation, np.concatenate(seen)), reward, terminated, truncated, info

    def close(self) -> None:
        for other in self._others:
            other.close()
        super().close()


class IdleActions(_Stress):
    """
    Appends actions in [-1, 1] without any effect.

    :param env: Environment with a flat Box as actions
    :param n: Number of actions, at least 1
    :raises ValueError: on an argument out of range or other actions
    """

    def __init__(self, env: gym.Env, n: int = 6) -> None:
        n = _positive_integer("n", n)
        super().__init__(env, n=n)
        own = _flat_box(env, "action")
        self._n_own = own.shape[0]
        self.action_space = _extended(own, -np.ones(n), np.ones(n))
        self.added_action_names = _numbered("idle", n)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        return self.env.step(action[: self._n_own])


class LastAction(_MoreObservations):
    """
    Appends the last action to the observation, zeros after a reset: from data of a smooth behaviour, a policy can learn to
    copy it.

    :param env: Environment with flat Boxes as observations and actions
    :raises ValueError: on other spaces
    """

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        space = _flat_box(env, "action")
        self._append(np.minimum(space.low, 0.0), np.maximum(space.high, 0.0))
        self._n_own = space.shape[0]
        self.added_state_names = _numbered("last action", self._n_own)

    def _after_reset(self, observation: np.ndarray, seed: int | None) -> np.ndarray:
        return self._appended(observation, np.zeros(self._n_own))

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        return self._appended(observation, np.asarray(action)), reward, terminated, truncated, info


class SensorDeath(_Stress):
    """
    Some sensors show zero from a step of the training on, whatever happens.

    :param env: Environment with a flat Box as observations
    :param sensors: Their indices in the observation
    :param at_step: Number of steps before, over all episodes, at least 0
    :raises ValueError: on an argument out of range or other observations
    """

    def __init__(self, env: gym.Env, sensors: Sequence[int] = (0,), at_step: int = 10_000) -> None:
        sensors, n_sensors = [int(sensor) for sensor in sensors], _flat_box(env, "observation").shape[0]
        if not sensors or not all(0 <= sensor < n_sensors for sensor in sensors):
            raise ValueError(f"sensors must be indices from 0 to {n_sensors - 1}, at least one, got {sensors}")
        at_step = _positive_integer("at_step", at_step, smallest=0)
        super().__init__(env, sensors=sensors, at_step=at_step)
        self._sensors, self._at_step, self.n_steps = sensors, at_step, 0

    def _after_reset(self, observation: np.ndarray, seed: int | None) -> np.ndarray:
        return self._seen(observation)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.n_steps += 1
        return self._seen(observation), reward, terminated, truncated, info

    def _seen(self, observation: np.ndarray) -> np.ndarray:
        if self.n_steps < self._at_step:
            return observation
        observation = observation.copy()
        observation[self._sensors] = 0.0
        return observation


class WeakActuator(_Stress):
    """
    An action has only a part of its effect from a step of the training on, as a joint that gets weak.

    :param env: Environment with a flat Box as actions
    :param action: Its index
    :param at_step: Number of steps before, over all episodes, at least 0
    :param factor: What the action is multiplied with, in [0, 1]
    :raises ValueError: on an argument out of range or other actions
    """

    def __init__(self, env: gym.Env, action: int = 0, at_step: int = 10_000, factor: float = 0.2) -> None:
        n_actions = _flat_box(env, "action").shape[0]
        action = _positive_integer("action", action, smallest=0)
        if action >= n_actions:
            raise ValueError(f"action must be an index from 0 to {n_actions - 1}, got {action}")
        if not 0 <= factor <= 1:
            raise ValueError(f"factor must be in [0, 1], got {factor!r}")
        at_step = _positive_integer("at_step", at_step, smallest=0)
        super().__init__(env, action=action, at_step=at_step, factor=factor)
        self._action, self._at_step, self._weakness, self.n_steps = action, at_step, float(factor), 0

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        if self.n_steps >= self._at_step:
            action = np.array(action)
            action[self._action] *= self._weakness
        self.n_steps += 1
        return self.env.step(action)
