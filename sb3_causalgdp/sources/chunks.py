"""What recorded transitions are to whoever reads them: chunks of rows, from arrays and tables."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from sb3_causalgdp.sources.tables import Table

if TYPE_CHECKING:
    import gymnasium

NEEDED = ("observations", "actions", "rewards", "next_observations")
ENDS = ("terminations", "truncations")
ARRAYS = (*NEEDED, *ENDS)
CHUNK_ROWS = 10_000


@dataclass(frozen=True)
class Chunk:
    """
    Consecutive transitions of one trajectory or of several.

    :param observations: One row for each transition, in dictionaries and tuples like those of the space
    :param next_observations: Likewise
    :param actions: Shape ``(T, ...)``
    :param rewards: Shape ``(T,)``
    :param terminations: Whether the episode ended there, shape ``(T,)``; None where the source does not say
    :param truncations: Whether it was cut there, shape ``(T,)``; likewise
    """

    observations: Any
    next_observations: Any
    actions: np.ndarray
    rewards: np.ndarray
    terminations: np.ndarray | None = None
    truncations: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.rewards)


class Source:
    """
    Recorded transitions: a name, the spaces where they are known, and the rows in their order.

    :param name: What to call it
    :param n_transitions: Number of transitions
    :param observation_space: None if it is not known
    :param action_space: None if it is not known
    :param environment: Name of the environment that it was collected in, None if it is not known
    :raises ValueError: If actions are not continuous
    """

    has_scaled_actions = False
    """Whether actions are in [-1, 1] already, as SB3's replay buffers store them."""
    layout: "gymnasium.spaces.Space | None" = None
    """What flat observations were flattened from, with its order of keys; None if it is not known."""
    state_names: tuple[str, ...] | None = None
    """Names of the components of an observation, where the source has them."""
    action_names: tuple[str, ...] | None = None
    """Names of the components of an action, where the source has them."""
    is_in_order = True
    """Whether a transition that does not end an episode is followed by the next one of that episode."""
    lack: str | None = None
    """What training needs and it does not hold, as an error that names it; discovery does without. None if it has all."""

    def __init__(
        self,
        name: str,
        n_transitions: int,
        observation_space: "gymnasium.spaces.Space | None" = None,
        action_space: "gymnasium.spaces.Space | None" = None,
        environment: str | None = None,
    ) -> None:
        if action_space is not None:
            # What has no spaces, such as a table, does not wait for gymnasium
            from gymnasium import spaces

            if not isinstance(action_space, spaces.Box):
                raise ValueError(f"{name} has the action space {action_space}, but continuous actions (a Box) are needed")
        self.name = name
        self.n_transitions = n_transitions
        self.observation_space = observation_space
        self.action_space = action_space
        self.environment = environment

    def chunks(self) -> Iterator[Chunk]:
        """
        :return: All transitions trajectory by trajectory, as often as one likes
        """
        raise NotImplementedError

    def as_recorded(self) -> Iterator[Chunk]:
        """
        :return: All transitions, the oldest first: of environments that ran side by side step by step. Where an episode ends
            may be left out
        """
        return self.chunks()


class ArraySource(Source):
    """
    N transitions in arrays.

    :param arrays: ``observations`` and ``next_observations`` (arrays, or dictionaries of arrays), ``actions``, ``rewards``,
        and for training ``terminations`` and ``truncations``
    :param name: What to call them
    :raises ValueError: If one is missing, lengths differ, actions are not continuous, or something is no number
    """

    is_in_order = False

    def __init__(self, arrays: Mapping[str, Any], name: str = "The arrays") -> None:
        missing = [key for key in ARRAYS if key not in arrays]
        lack = f"{name} lack {missing}: {list(ARRAYS)} are needed" if missing else None
        if set(missing) & set(NEEDED):
            raise ValueError(f"{lack}, the last two for training alone")
        self.lack = lack
        self.arrays = {key: _as_arrays(arrays[key]) for key in ARRAYS if key in arrays}
        lengths = {key: [len(one) if one.ndim else 0 for one in arrays_in(tree)] for key, tree in self.arrays.items()}
        if len({length for given in lengths.values() for length in given}) != 1:
            raise ValueError(f"{name} must have one row for each transition, got lengths {lengths}")
        if not np.issubdtype(self.arrays["actions"].dtype, np.floating):
            raise ValueError(f"{name} have actions of {self.arrays['actions'].dtype}, but continuous actions are needed")
        for key in (key for key in ENDS if key in self.arrays):
            self.arrays[key] = as_flags(self.arrays[key], f"{name}: {key}")
        self.arrays["rewards"] = _one_each(self.arrays["rewards"], f"{name}: rewards")
        for key in ("observations", "next_observations", "rewards"):
            check_numbers(self.arrays[key], f"{name}: {key}")
        super().__init__(name, len(self.arrays["actions"]))

    def chunks(self) -> Iterator[Chunk]:
        for first in range(0, self.n_transitions, CHUNK_ROWS):
            rows = slice(first, first + CHUNK_ROWS)
            yield Chunk(**{key: rows_of(tree, rows) for key, tree in self.arrays.items()})


class TableSource(ArraySource):
    """
    The transitions of a table.

    :param table: The table
    :param dtype: Of its states and actions
    """

    is_in_order = True

    def __init__(self, table: Table, dtype: npt.DTypeLike = np.float32) -> None:
        columns = {"observations": table.observations, "next_observations": table.next_observations, "actions": table.actions}
        columns = {name: values.astype(dtype, copy=False) for name, values in columns.items()}
        ends = {"terminations": np.zeros(len(table), dtype=bool), "truncations": table.is_last}
        self.state_names, self.action_names = tuple(table.state_names), tuple(table.action_names)
        super().__init__({**columns, "rewards": table.rewards, **ends}, table.name)


# Arrays, and what they are nested in ------------------------------------------------------------------------------------


def as_flags(values: Any, name: str) -> np.ndarray:
    """
    :param values: Whether something is so, for each of N transitions: bool, or 0 and 1, shape ``(N,)`` or ``(N, 1)``
    :param name: What to call them
    :return: The same as bool, shape ``(N,)``
    :raises ValueError: If one is anything else, such as NaN, -1 or a string
    """
    values = np.asarray(values)
    flags = _one_each(values, name)
    if values.dtype == bool:
        return flags
    known = np.zeros(len(flags), dtype=bool)
    if values.dtype.kind in "fiuO":
        known = ((flags == 0) | (flags == 1)).astype(bool)
    if not known.all():
        row = int(np.argmin(known))
        raise ValueError(f"{name} must be bool, or 0 and 1, got {flags.tolist()[row]!r} at transition {row}")
    return (flags == 1).astype(bool)


def check_numbers(tree: Any, name: str) -> None:
    """
    :param tree: An array, or arrays in dictionaries and tuples
    :param name: What to call it
    :raises ValueError: If one holds something else than real numbers
    """
    for values in arrays_in(tree):
        if values.dtype.kind not in "fiub":
            raise ValueError(f"{name} must be numbers, got an array of {values.dtype}")


def arrays_in(tree: Any) -> Iterator[np.ndarray]:
    """
    :param tree: An array, or arrays in dictionaries and tuples
    :return: The arrays
    """
    if isinstance(tree, Mapping | tuple):
        for part in tree.values() if isinstance(tree, Mapping) else tree:
            yield from arrays_in(part)
    else:
        yield np.asarray(tree)


def mapped(function: Callable[[Any], Any], tree: Any) -> Any:
    """
    :param function: What is done to each array
    :param tree: An array, or arrays in dictionaries and tuples
    :return: The results, in the same form
    """
    if isinstance(tree, Mapping):
        return {key: mapped(function, part) for key, part in tree.items()}
    if isinstance(tree, tuple):
        return tuple(mapped(function, part) for part in tree)
    return function(tree)


def rows_of(tree: Any, rows: Any) -> Any:
    """
    :param tree: An array, or arrays in dictionaries and tuples
    :param rows: Which of their rows
    :return: These, in the same form
    """
    return mapped(lambda values: values[rows], tree)


def _as_arrays(values: Any) -> Any:
    if isinstance(values, Mapping):
        return {key: _as_arrays(part) for key, part in values.items()}
    return np.asarray(values)


def _one_each(values: np.ndarray, name: str) -> np.ndarray:
    """Shape (N,)."""
    if values.shape[1:] not in ((), (1,)):
        raise ValueError(f"{name} must have the shape (N,) or (N, 1), got {values.shape}")
    return values.reshape(-1)
