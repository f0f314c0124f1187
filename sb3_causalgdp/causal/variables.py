from collections import Counter
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt


@dataclass(frozen=True)
class TransitionVariables:
    """
    The variables of one transition and the order of their columns: ``[s (n), a (d), s' (n), r (1)]``.

    :param state_names: Names of the n state variables, at least one
    :param action_names: Names of the d action variables, at least one
    :raises ValueError: when a list of names is empty or two columns would have the same name
    """

    state_names: tuple[str, ...]
    action_names: tuple[str, ...]

    def __post_init__(self) -> None:
        for argument in ("state_names", "action_names"):
            names = getattr(self, argument)
            if isinstance(names, str) or not all(isinstance(name, str) for name in names):
                raise TypeError(f"{argument} must be a sequence of strings, got {names!r}")
            if len(names) == 0:
                raise ValueError(f"{argument} is empty: at least one name is needed")
            object.__setattr__(self, argument, tuple(names))
        repeated = sorted(name for name, count in Counter(self.names).items() if count > 1)
        if repeated:
            raise ValueError(f"state_names and action_names must give every column its own name, repeated: {repeated}")

    @property
    def n_states(self) -> int:
        return len(self.state_names)

    @property
    def n_actions(self) -> int:
        return len(self.action_names)

    @property
    def n_variables(self) -> int:
        """Number of columns, ``2 n + d + 1``."""
        return 2 * self.n_states + self.n_actions + 1

    @property
    def state(self) -> slice:
        return slice(0, self.n_states)

    @property
    def action(self) -> slice:
        return slice(self.n_states, self.n_states + self.n_actions)

    @property
    def next_state(self) -> slice:
        return slice(self.n_states + self.n_actions, 2 * self.n_states + self.n_actions)

    @property
    def reward(self) -> int:
        return self.n_variables - 1

    @property
    def causes_of_state(self) -> np.ndarray:
        """Columns of (s, a), shape (n + d,)."""
        return np.arange(self.n_states + self.n_actions)

    @property
    def causes_of_reward(self) -> np.ndarray:
        """Columns of (s', a), shape (n + d,)."""
        columns = np.arange(self.n_variables)
        return np.concatenate([columns[self.next_state], columns[self.action]])

    @property
    def next_state_names(self) -> tuple[str, ...]:
        """The state names with a prime."""
        return tuple(f"{name}'" for name in self.state_names)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all columns, in their order."""
        return (*self.state_names, *self.action_names, *self.next_state_names, "reward")

    def stack(
        self, states: npt.ArrayLike, actions: npt.ArrayLike, next_states: npt.ArrayLike, rewards: npt.ArrayLike
    ) -> np.ndarray:
        """
        Put N transitions side by side as rows of all variables.

        :param states: s, shape (N, n)
        :param actions: a, shape (N, d)
        :param next_states: s', shape (N, n)
        :param rewards: r, shape (N,) or (N, 1)
        :return: float64 copy, shape (N, 2 n + d + 1)
        :raises ValueError: when a shape does not fit; the message names the argument
        """
        states = np.asarray(states, dtype=np.float64)
        if states.ndim != 2 or states.shape[1] != self.n_states:
            raise ValueError(f"states must have shape (N, {self.n_states}), got {states.shape}")
        n_rows = len(states)
        rewards = np.asarray(rewards, dtype=np.float64)
        if rewards.shape not in ((n_rows,), (n_rows, 1)):
            raise ValueError(f"rewards must have shape ({n_rows},) or ({n_rows}, 1), got {rewards.shape}")
        columns = {
            "actions": (np.asarray(actions, dtype=np.float64), self.n_actions),
            "next_states": (np.asarray(next_states, dtype=np.float64), self.n_states),
        }
        for argument, (values, width) in columns.items():
            if values.shape != (n_rows, width):
                raise ValueError(f"{argument} must have shape ({n_rows}, {width}), got {values.shape}")
        return np.concatenate([states, columns["actions"][0], columns["next_states"][0], rewards.reshape(n_rows, 1)], axis=1)
