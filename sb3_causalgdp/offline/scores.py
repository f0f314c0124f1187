"""
Normalised scores: 0 for a random policy, 100 for an expert.

Source of the references: D4RL, https://github.com/Farama-Foundation/D4RL, d4rl/infos.py. Minari's datasets carry references of
their own, which differ: a return of 225 on D4RL/pointmaze/umaze-v2 is 145.8 by D4RL's and 99.7 by Minari's.
"""

import os
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from sb3_causalgdp.offline.extras import need


@dataclass(frozen=True)
class Reference:
    """
    Returns that a score is measured by.

    :param random: Mean return of a random policy, score 0
    :param expert: Mean return of an expert, score 100
    :param source: Where they come from
    """

    random: float
    expert: float
    source: str = "D4RL"


@dataclass(frozen=True)
class NormalizedScore:
    """
    Scores, and what they were measured by. ``float()`` gives their mean.

    :param values: 100 (return - random) / (expert - random), of the shape of the returns
    :param reference: The returns that were used, with their source
    """

    values: np.ndarray
    reference: Reference

    @property
    def mean(self) -> float:
        """Mean over all returns."""
        return float(np.mean(self.values))

    def __float__(self) -> float:
        return self.mean

    def __str__(self) -> str:
        reference = self.reference
        return f"{self.mean:.1f} ({reference.source}'s references: random {reference.random:g}, expert {reference.expert:g})"


# By task, or by the first part of its name: datasets of one task share their references
D4RL_REFERENCES = {
    "maze2d-umaze": Reference(23.85, 161.86),
    "maze2d-medium": Reference(13.13, 277.39),
    "maze2d-large": Reference(6.7, 273.99),
    "maze2d-umaze-dense": Reference(68.537689, 193.66285642381482),
    "maze2d-medium-dense": Reference(44.264742, 297.4552547777125),
    "maze2d-large-dense": Reference(30.569041, 303.4857382709002),
    "antmaze": Reference(0.0, 1.0),
    "pen": Reference(96.262799, 3076.8331017826877),
    "kitchen": Reference(0.0, 4.0),
    "halfcheetah": Reference(-280.178953, 12135.0),
    "hopper": Reference(-20.272305, 3234.3),
    "walker2d": Reference(1.629008, 4592.3),
}
# Minari's and Gymnasium's names for the same tasks
SYNONYMS = {
    r"^pointmaze-": "maze2d-",
    r"^pointmaze_(umaze|medium|large)": r"maze2d-\1",
    r"^(maze2d-\w+?)_?dense": r"\1-dense",
    r"^antmaze_": "antmaze-",
    r"^adroithandpen": "pen",
    r"^frankakitchen": "kitchen",
}


def find_reference(task: str) -> Reference | None:
    """
    :param task: D4RL's or Minari's name of a dataset, or Gymnasium's id of an environment
    :return: D4RL's reference returns, None for a task without
    """
    name = task.lower()
    # D4RL's first version of the mazes ran 150 steps and had other references
    if re.fullmatch(r"maze2d-.*-v0", name):
        return None
    *folders, name = re.sub(r"-v\d+$", "", name).split("/")
    name = "-".join([*(folder for folder in folders if folder not in ("d4rl", "mujoco", "sb3_causalgdp")), name])
    for pattern, replacement in SYNONYMS.items():
        name = re.sub(pattern, replacement, name)
    if name in D4RL_REFERENCES:
        return D4RL_REFERENCES[name]
    family = name.split("-")[0]
    return None if family == "maze2d" else D4RL_REFERENCES.get(family)


def minari_reference(dataset: Any) -> Reference:
    """
    :param dataset: A Minari dataset, or the id of one on this machine
    :return: the references that it carries
    :raises ValueError: if it is not on this machine or carries none
    """
    if isinstance(dataset, str | os.PathLike):
        try:
            dataset = need("minari").load_dataset(str(dataset))
        except FileNotFoundError as error:
            raise ValueError(f"{dataset} is not on this machine: minari download {dataset}") from error
    name, metadata = dataset.spec.dataset_id, dataset.storage.metadata
    if metadata.get("ref_min_score") is None or metadata.get("ref_max_score") is None:
        raise ValueError(f'{name} carries no reference returns; with reference="d4rl", D4RL\'s are used')
    return Reference(float(metadata["ref_min_score"]), float(metadata["ref_max_score"]), f"Minari ({name})")


def normalized_score(task: Any, returns: ArrayLike, reference: str = "d4rl") -> NormalizedScore:
    """
    :param task: D4RL's or Minari's name of a dataset, Gymnasium's id of an environment, or a Minari dataset
    :param returns: Undiscounted returns of episodes
    :param reference: ``"d4rl"`` for D4RL's table, ``"minari"`` for what the Minari dataset ``task`` carries
    :return: the scores, and the references that were used
    :raises ValueError: on an unknown task or reference
    """
    if reference == "minari":
        used: Reference | None = minari_reference(task)
    elif reference == "d4rl":
        name = task if isinstance(task, str) else task.spec.dataset_id
        used = find_reference(name)
        if used is None:
            raise ValueError(f"no D4RL references for {name!r}; known: {', '.join(D4RL_REFERENCES)}")
    else:
        raise ValueError(f"reference must be d4rl or minari, got {reference!r}")
    assert used is not None
    values = 100.0 * (np.asarray(returns, dtype=np.float64) - used.random) / (used.expert - used.random)
    return NormalizedScore(values, used)
