"""Writing Minari datasets that are either complete or not there."""

import os
import warnings
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from sb3_causalgdp.files import errors_about, move_folder, temporary_folder
from sb3_causalgdp.offline.extras import need
from sb3_causalgdp.offline.scores import find_reference

ROOT_VARIABLE = "MINARI_DATASETS_PATH"
OUTDATED = r".*The environment [\w-]+ is out of date"


@dataclass
class Episode:
    """
    Consecutive transitions, T in number.

    :param observations: (T + 1, n_observations)
    :param actions: (T, n_actions)
    :param rewards: (T,)
    :param terminated: Whether the last one ended in a terminal state; the episode was cut there if not
    :param infos: More arrays by name, (T + 1, ...)
    """

    observations: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    terminated: bool = False
    infos: dict[str, np.ndarray] | None = None

    def __len__(self) -> int:
        return len(self.rewards)


def datasets_root(path: str | os.PathLike[str] | None = None) -> Path:
    """
    :param path: Folder of Minari datasets, None for Minari's own (``MINARI_DATASETS_PATH``, or ``~/.minari/datasets``)
    :return: the folder, which need not exist
    """
    return Path(path or os.environ.get(ROOT_VARIABLE) or Path.home() / ".minari" / "datasets").expanduser().absolute()


@contextmanager
def minari_root(root: Path) -> Iterator[None]:
    """
    Let Minari work in a folder.

    :param root: The folder
    """
    before = os.environ.get(ROOT_VARIABLE)
    os.environ[ROOT_VARIABLE] = str(root)
    try:
        yield
    finally:
        if before is None:
            del os.environ[ROOT_VARIABLE]
        else:
            os.environ[ROOT_VARIABLE] = before


def check_new_dataset(dataset_id: str, root: Path) -> None:
    """
    :param dataset_id: Minari's id of a dataset that shall be made
    :param root: Folder of Minari datasets
    :raises ValueError: if the id is malformed or taken
    """
    need("minari")
    parse_dataset_id = need("minari.dataset.minari_dataset").parse_dataset_id
    try:
        parse_dataset_id(dataset_id)
    except (ValueError, TypeError) as error:  # TypeError: without a version
        raise ValueError(
            f"{dataset_id!r} is no name of a dataset: Minari wants (namespace/)name-v0, of letters, digits, - and _"
        ) from error
    if (root / dataset_id).exists():
        raise ValueError(f"{dataset_id} exists in {root}: delete it, or choose another name or path")


def make_environment(environment_id: str, max_episode_steps: int | None = None) -> gym.Env[Any, Any]:
    """
    :param environment_id: Gymnasium's id; an older version is meant, and gives no warning
    :param max_episode_steps: Episode length in steps, None for the environment's own
    :return: the environment
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=OUTDATED)
        return gym.make(environment_id, max_episode_steps=max_episode_steps)


def write_dataset(
    dataset_id: str,
    episodes: Iterable[Episode],
    environment_id: str,
    root: Path,
    max_episode_steps: int | None = None,
    **metadata: Any,
) -> Path:
    """
    Write a dataset beside the others under a hidden name, and rename it when it is complete.

    :param dataset_id: Minari's id
    :param episodes: Written as they come
    :param environment_id: Environment that the data were recorded in, registered with Gymnasium
    :param root: Folder of Minari datasets
    :param max_episode_steps: Episode length in steps, None for the environment's own
    :param metadata: Of :func:`minari.create_dataset_from_buffers`
    :return: the dataset's folder
    :raises ValueError: if the id is malformed or taken
    :raises OSError: if it cannot be written, on a full disk for instance; nothing is left of it then
    """
    check_new_dataset(dataset_id, root)
    minari = need("minari")
    environment = make_environment(environment_id, max_episode_steps)
    reference = find_reference(dataset_id)
    with temporary_folder(root) as staging, errors_about(root / dataset_id), closing(environment):
        with minari_root(staging), _own_files(), warnings.catch_warnings():
            # An author's e-mail and a permalink are for datasets that get published
            warnings.filterwarnings("ignore", message="`(author|author_email|code_permalink)` is set to None")
            warnings.filterwarnings("ignore", message=OUTDATED)
            minari.create_dataset_from_buffers(
                dataset_id,
                buffer=_buffers(episodes),
                env=environment,
                eval_env=environment,
                data_format="hdf5",
                ref_min_score=None if reference is None else reference.random,
                ref_max_score=None if reference is None else reference.expert,
                **metadata,
            )
        _publish(dataset_id, staging, root)
    return root / dataset_id


def _buffers(episodes: Iterable[Episode]) -> Iterator[Any]:
    episode_buffer = need("minari.data_collector.episode_buffer").EpisodeBuffer
    for episode in episodes:
        ends = np.zeros((2, len(episode)), dtype=bool)
        ends[0 if episode.terminated else 1, -1] = True
        yield episode_buffer(
            observations=episode.observations,
            actions=episode.actions,
            rewards=episode.rewards,
            terminations=ends[0],
            truncations=ends[1],
            infos=episode.infos,
        )


class _File:
    """
    What HDF5 writes to. It never hears of a disk that takes no more, because it ends the process when it cannot write what it
    still has in memory; ``error`` keeps what was raised.

    :param file: Opened for reading and writing, without a buffer
    """

    def __init__(self, file: Any) -> None:
        self.file = file
        self.error: OSError | None = None
        self.seek, self.tell = file.seek, file.tell

    def readinto(self, buffer: Any) -> int:
        return self.file.readinto(buffer)

    def read(self, size: int = -1) -> bytes:
        return self.file.read(size)

    def write(self, data: Any) -> int:
        left = memoryview(data).cast("B")
        n_bytes = len(left)
        try:
            while self.error is None and len(left) > 0:
                left = left[self.file.write(left) :]
        except OSError as error:
            self.error = error
        return n_bytes

    def truncate(self, size: int) -> int:
        try:
            if self.error is None:
                self.file.truncate(size)
        except OSError as error:
            self.error = error
        return size

    def flush(self) -> None:
        """There is no buffer."""

    def check(self) -> None:
        if self.error is not None:
            raise self.error


@contextmanager
def _own_files() -> Iterator[None]:
    """Let Minari give its HDF5 library a :class:`_File` in place of a path."""
    storage_class = need("minari.dataset._storages.hdf5_storage").HDF5Storage
    update = storage_class.update_episodes

    def update_episodes(storage: Any, episodes: Iterable[Any]) -> None:
        path = storage._file_path
        with path.open("r+b", buffering=0) as opened:
            file = storage._file_path = _File(opened)
            try:
                update(storage, _until_error(episodes, file))
            except Exception:
                # HDF5 may have stumbled over what is not there
                file.check()
                raise
            finally:
                storage._file_path = path
            file.check()

    storage_class.update_episodes = update_episodes
    try:
        yield
    finally:
        storage_class.update_episodes = update


def _until_error(episodes: Iterable[Any], file: _File) -> Iterator[Any]:
    for episode in episodes:
        yield episode
        file.check()


def _publish(dataset_id: str, staging: Path, root: Path) -> None:
    namespaces = need("minari.namespace")
    namespace = dataset_id.rpartition("/")[0]
    with minari_root(root):
        if namespace and namespace not in namespaces.list_local_namespaces():
            namespaces.create_namespace(namespace)
    move_folder(staging / dataset_id, root / dataset_id)
