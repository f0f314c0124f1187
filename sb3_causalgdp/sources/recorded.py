"""Where recorded transitions come from: Minari datasets, replay buffers of SB3, arrays and tables, opened by one function."""

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sb3_causalgdp.hints import how_to_install, how_to_make
from sb3_causalgdp.saving.archives import DownloadError, errors_of, existing, load_minari, one_line, read_arrays
from sb3_causalgdp.sources.buffers import SUFFIXES, BufferSource, is_replay_buffer, is_saved_buffer, read_saved_buffer
from sb3_causalgdp.sources.chunks import ARRAYS, ArraySource, Chunk, Source, TableSource, arrays_in, as_flags, rows_of
from sb3_causalgdp.sources.columns import SUFFIXES as TABLE_SUFFIXES
from sb3_causalgdp.sources.columns import is_frame
from sb3_causalgdp.sources.tables import Table

OFFLINE_HINT = how_to_install("offline")
MINARI_ID = re.compile(r"(\w+://[-\w]+/)?[-\w]+(/[-\w]+)*-v\d+")
TABLE_HINT = (
    "its columns must be known: give states=[...], actions=[...], reward=..., or "
    "sb3_causalgdp.sources.tables.Table(source, states=[...], actions=[...], reward=...)"
)

__all__ = ["ArraySource", "BufferSource", "Chunk", "MinariSource", "Source", "TableSource", "open_source"]


class MinariSource(Source):
    """
    A Minari dataset, one episode a chunk; the last step of an episode has its true next observation.

    :param dataset: A ``minari.MinariDataset``
    :param name: What to call it; None for its id
    :raises ValueError: If actions are not continuous
    """

    def __init__(self, dataset: Any, name: str | None = None) -> None:
        environment = dataset.env_spec.name if dataset.env_spec is not None else None
        n_transitions = int(dataset.total_steps) if len(dataset) > 0 else 0
        name = dataset.id if name is None else name
        super().__init__(name, n_transitions, dataset.observation_space, dataset.action_space, environment)
        self.dataset = dataset

    def chunks(self) -> Iterator[Chunk]:
        for number, episode in enumerate(self._episodes()):
            # T steps have T + 1 observations; float64 and nested like the space
            truncations = as_flags(episode.truncations, f"{self.name}: truncations of episode {number}").copy()
            terminations = as_flags(episode.terminations, f"{self.name}: terminations of episode {number}")
            if len(truncations) == 0:
                continue
            if not (terminations[-1:].any() or truncations[-1]):
                truncations[-1] = True  # the recording stopped there
            lengths = {len(values) - 1 for values in arrays_in(episode.observations)}
            lengths |= {len(values) for values in (episode.actions, episode.rewards, terminations)}
            if lengths != {len(truncations)}:
                raise ValueError(
                    f"{self.name}: episode {number} is incomplete, its arrays have lengths that do not fit together"
                )
            yield Chunk(
                rows_of(episode.observations, slice(None, -1)),
                rows_of(episode.observations, slice(1, None)),
                np.asarray(episode.actions),
                np.asarray(episode.rewards),
                terminations,
                truncations,
            )

    def _episodes(self) -> Iterator[Any]:
        try:
            yield from self.dataset.iterate_episodes()
        except Exception as error:  # h5py raises all kinds on files that are cut off or damaged
            raise ValueError(
                f"{self.name} cannot be read, its file is incomplete or damaged: {one_line(error)}. Delete "
                f"{self.dataset.storage.data_path} and download it again"
            ) from error


def open_source(source: Any, download: bool = True, trusted: bool = False) -> Source:
    """
    :param source: The id of a Minari dataset, a ``minari.MinariDataset``, a replay buffer of SB3 or the path of a saved one
        (``.npz``, ``.pkl``), arrays: a mapping or the path of what ``numpy.savez`` wrote (``.npz``), or a
        :class:`~sb3_causalgdp.sources.tables.Table`
    :param download: Whether to download a Minari dataset that is not on this machine
    :param trusted: Whether a pickled buffer may hold more than what SB3's own are made of, which could run code
    :return: The source, of which no row has been read
    :raises FileNotFoundError: If there is no such file or dataset
    :raises ValueError: If it cannot be used
    :raises ImportError: If it needs a package that is not installed
    :raises TypeError: If it is none of these
    """
    if isinstance(source, Source):
        return source
    if is_replay_buffer(source):
        return BufferSource(source)
    if isinstance(source, Table):
        return TableSource(source)
    if is_frame(source):
        raise ValueError(f"{type(source).__name__} is a table, {TABLE_HINT}")
    if isinstance(source, Mapping):
        return ArraySource(source)
    if isinstance(source, str | os.PathLike):
        if Path(source).suffix.lower() in set(TABLE_SUFFIXES) - set(SUFFIXES):
            raise ValueError(f"{source} is a table, {TABLE_HINT}")
        return _open_name(os.fspath(source), download, trusted)
    if hasattr(source, "iterate_episodes"):
        return MinariSource(source)
    raise TypeError(
        "A source is the id of a Minari dataset, a MinariDataset, a replay buffer, a path, a mapping of arrays, or a table "
        "(a data frame or a path, with states=[...], actions=[...], reward=...), "
        f"got {type(source).__name__}"
    )


def _open_name(name: str, download: bool, trusted: bool) -> Source:
    path = existing(name, SUFFIXES)  # save_replay_buffer adds the suffix, too
    if path.is_file():
        return _open_file(path, trusted)
    if path.suffix in SUFFIXES or not MINARI_ID.fullmatch(name):
        raise FileNotFoundError(f"There is no file {name!r}, and the id of a Minari dataset ends in -v and a number")
    return _open_minari(name, download, trusted)


def _open_file(path: Path, trusted: bool) -> Source:
    if path.suffix == ".npz" and not is_saved_buffer(path):
        with errors_of(path, "cannot be read as arrays"):
            arrays = read_arrays(path, ARRAYS)
        return ArraySource(arrays, str(path))
    buffer = read_saved_buffer(path, trusted)
    with errors_of(path, "is incomplete or damaged"):
        # Something with the attributes of a buffer need not be one
        return BufferSource(buffer, str(path))


def _open_minari(dataset_id: str, download: bool, trusted: bool) -> Source:
    try:
        import minari  # noqa: F401
    except ImportError as error:
        raise ImportError(f"The Minari dataset {dataset_id!r} needs the package minari: {OFFLINE_HINT}") from error
    try:
        dataset = load_minari(dataset_id, download, trusted)
    # The hub's libraries raise long chains, of which the last line says all
    except FileNotFoundError:
        raise FileNotFoundError(
            f"The Minari dataset {dataset_id!r} is not on this machine: ask for its download (download=True, --download); "
            f"{how_to_make(dataset_id)}"
        ) from None
    except DownloadError as error:
        raise ValueError(
            f"The Minari dataset {dataset_id!r} is not on this machine and cannot be downloaded ({error}): "
            f"{how_to_make(dataset_id)}"
        ) from None
    except ImportError as error:
        raise ImportError(f"The Minari dataset {dataset_id!r} needs another package ({error}): {OFFLINE_HINT}") from error
    except Exception as error:  # of a broken file
        raise ValueError(f"The metadata of the Minari dataset {dataset_id!r} are damaged: {one_line(error)}") from error
    with errors_of(dataset_id):
        return MinariSource(dataset, dataset_id)
