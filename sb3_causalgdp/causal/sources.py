"""Recorded transitions as discovery needs them: rows of numbers, with a name for each variable."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_causalgdp.causal.transitions import BATCH_ROWS, ChunkedRows, SourceError, TransitionSource
from sb3_causalgdp.causal.variables import TransitionVariables
from sb3_causalgdp.sources import recorded
from sb3_causalgdp.sources.spaces import flatten_batch, shape_of_arrays

RESERVED = ("action", "reward")  # names of other variables

__all__ = [
    "BATCH_ROWS",
    "ArraySource",
    "FlatSpace",
    "MinariSource",
    "RecordedRows",
    "ReplayBufferSource",
    "SourceError",
    "TransitionSource",
    "open_source",
]


class FlatSpace:
    """
    The numbers of an observation space in the order of gymnasium's ``flatten``, for many observations at once.

    Names are ``obs[i]``, for dictionaries ``key[i]`` and ``outer.inner[i]``, without the index where a key has one number;
    discrete parts are one-hot.

    :param space: Observation space, may be nested
    :raises SourceError: when a part of it is an image, or has no fixed number of numbers
    """

    def __init__(self, space: spaces.Space) -> None:
        self.space = space
        names: list[str] = []
        for path, leaf in _leaves(space):
            name = ".".join(map(str, path))
            if not path or isinstance(path[0], int) or name == "action":
                # "action[0]" would be the name of an action as well
                name = f"obs[{name}]" if name else "obs"
            _check_leaf(name, leaf)
            one = spaces.flatdim(leaf) == 1 and isinstance(path[0] if path else 0, str) and name not in RESERVED
            names += [name] if one and not name.startswith("obs[") else [f"{name}[{i}]" for i in range(spaces.flatdim(leaf))]
        self.names = tuple(names)

    def __call__(self, observations: Any) -> np.ndarray:
        """
        :param observations: N observations: an array, or arrays in dictionaries and tuples like those of the space
        :return: shape (N, n)
        """
        return flatten_batch(self.space, observations)


def _leaves(space: spaces.Space, path: tuple[str | int, ...] = ()) -> Iterator[tuple[tuple[str | int, ...], spaces.Space]]:
    """The parts of a space that are not dictionaries or tuples, and the keys that lead there."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        named = space.spaces.items() if isinstance(space, spaces.Dict) else enumerate(space.spaces)
        for key, part in named:
            yield from _leaves(part, (*path, key))
    else:
        yield path, space


def _check_leaf(name: str, leaf: spaces.Space) -> None:
    if not isinstance(leaf, spaces.Box | spaces.MultiBinary | spaces.Discrete | spaces.MultiDiscrete):
        raise SourceError(f"observations {name!r} cannot be flattened to numbers: {leaf}")
    if isinstance(leaf, spaces.Box) and leaf.dtype == np.uint8 and len(leaf.shape) > 1:
        raise SourceError(f"observations {name!r} are images of shape {leaf.shape}: pixels are no variables of a causal graph")


class RecordedRows(ChunkedRows):
    """
    The rows of recorded transitions, oldest first, under the names of their variables.

    SB3's replay buffers store actions scaled to [-1, 1] and observations as the environment gave them.

    :param source: The recorded transitions
    :param max_rows: Read at most this many transitions, spread evenly over all; None reads all
    :raises SourceError: when observations are images, or cannot be flattened to numbers
    """

    def __init__(self, source: recorded.Source, max_rows: int | None = None) -> None:
        observation_space: spaces.Space | None = source.observation_space
        action_space: spaces.Space | None = source.action_space
        if observation_space is None or action_space is None:
            first = next(source.as_recorded(), None)
            if first is None:
                raise SourceError(f"{source.name} holds no transitions")
            observation_space = shape_of_arrays(first.observations) if observation_space is None else observation_space
            action_space = shape_of_arrays(first.actions) if action_space is None else action_space
        flat = FlatSpace(observation_space)
        action_names = source.action_names or tuple(f"action[{i}]" for i in range(spaces.flatdim(action_space)))
        variables = TransitionVariables(source.state_names or flat.names, action_names)
        super().__init__(source, variables, flat, max_rows)


class ReplayBufferSource(RecordedRows):
    """
    A replay buffer of SB3, or of its shape. The preloaded transitions that CausalGDP saved with it come before its own.

    :param buffer: The buffer, of vectors or dictionaries of vectors, with any number of environments
    :param name: What to call it
    :param max_rows: Read at most this many transitions, spread evenly over all; None reads all
    :raises SourceError: when it is not a replay buffer, actions are not continuous, or observations are images
    """

    def __init__(self, buffer: Any, name: str = "replay buffer", max_rows: int | None = None) -> None:
        with _source_errors():
            source = recorded.BufferSource(buffer, name)
        super().__init__(source, max_rows)


class MinariSource(RecordedRows):
    """
    A Minari dataset, episode by episode.

    :param dataset: The dataset
    :param name: What to call it; None for its id
    :param max_rows: Read at most this many transitions, spread evenly over all; None reads all
    :raises SourceError: when actions are not continuous, or observations are images
    """

    def __init__(self, dataset: Any, name: str | None = None, max_rows: int | None = None) -> None:
        with _source_errors():
            source = recorded.MinariSource(dataset, name)
        super().__init__(source, max_rows)


class ArraySource(RecordedRows):
    """
    N transitions in four arrays.

    :param observations: s, shape (N, ...)
    :param actions: a, shape (N, ...)
    :param next_observations: s', of the shape of s
    :param rewards: r, shape (N,) or (N, 1)
    :param name: What to call them
    :param max_rows: Read at most this many transitions, spread evenly over all; None reads all
    :raises SourceError: when shapes do not fit, actions are not continuous, or observations are images
    """

    def __init__(
        self,
        observations: np.ndarray,
        actions: np.ndarray,
        next_observations: np.ndarray,
        rewards: np.ndarray,
        name: str = "arrays",
        max_rows: int | None = None,
    ) -> None:
        with _source_errors():
            arrays = {"observations": observations, "next_observations": next_observations}
            source = recorded.ArraySource({**arrays, "actions": actions, "rewards": rewards}, name)
        super().__init__(source, max_rows)


def open_source(
    path_or_id: str | os.PathLike[str], *, download: bool = False, max_rows: int | None = None, trusted: bool = False
) -> TransitionSource:
    """
    Open recorded transitions by name.

    :param path_or_id: A replay buffer that ``model.save_replay_buffer`` wrote (``.npz``, ``.pkl``), arrays that
        ``numpy.savez`` wrote under the names ``observations``, ``actions``, ``next_observations`` and ``rewards`` (``.npz``),
        or the id of a Minari dataset
    :param download: Whether to download a Minari dataset that is not on this machine
    :param max_rows: Read at most this many transitions, spread evenly over all; None reads all
    :param trusted: Whether a pickled buffer may hold more than what SB3's own are made of, which could run code
    :return: the source
    :raises SourceError: when there is no such source, or discovery cannot use it
    """
    with _source_errors():
        return RecordedRows(recorded.open_source(path_or_id, download, trusted), max_rows)


@contextmanager
def _source_errors() -> Iterator[None]:
    try:
        yield
    except SourceError:
        raise
    except (ValueError, FileNotFoundError, ImportError) as error:
        raise SourceError(str(error)) from error
