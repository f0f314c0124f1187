"""The study's datasets, made when they are not there, and their transitions as arrays."""

import numpy as np

from benchmarks.suite.jobs import locked
from sb3_causalgdp.offline.make import MAZE_TASKS, make_maze_dataset
from sb3_causalgdp.offline.registration import maze_environment_id
from sb3_causalgdp.offline.sources import open_source
from sb3_causalgdp.offline.storage import datasets_root

FIELDS = ("observations", "actions", "rewards", "next_observations", "terminations")


def environment_id(task: str) -> str:
    """
    :param task: Such as ``"maze2d-umaze-dense"``
    :return: Gymnasium's id of the environment with D4RL's conditions
    """
    return maze_environment_id(*MAZE_TASKS[task])


def ensure_dataset(task: str, steps: int) -> str:
    """
    Make the dataset in Minari's folder, unless it is there, as ``python -m sb3_causalgdp.datasets make TASK --steps STEPS``.

    :param task: Such as ``"maze2d-umaze-dense"``
    :param steps: Number of transitions
    :return: Minari's id of the dataset
    """
    dataset_id, root = f"sb3_causalgdp/{task}-{steps}-v0", datasets_root()
    with locked(root / f".{task}-{steps}.lock"):
        if not (root / dataset_id).exists():
            make_maze_dataset(task, dataset_id, root, steps, quiet=True)
    return dataset_id


def transitions(dataset_id: str) -> dict[str, np.ndarray]:
    """
    :param dataset_id: Minari's id of a dataset on this machine
    :return: ``FIELDS`` in float32, one row for each transition; rewards and terminations have one column
    """
    chunks = list(open_source(dataset_id, download=False).chunks())
    arrays = {name: np.concatenate([getattr(chunk, name) for chunk in chunks]).astype(np.float32) for name in FIELDS}
    return {name: values.reshape(len(values), -1) for name, values in arrays.items()}
