"""
How strong the guidance should be while acting: returns of trained models, loaded with several guidance scales.

    python -m benchmarks.offline.guidance benchmarks/offline/results/scratch/*_causalgdp_*/checkpoint-8000 --candidates 1 10

Checkpoints are what ``benchmarks.offline.run`` left in its folder: nothing is trained. See docs/benchmarks_offline.md.
"""

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import torch as th

from benchmarks.offline.study import SELECTION_SEED, Evaluation
from sb3_causalgdp import CausalGDP
from sb3_causalgdp.offline.make import MAZE_TASKS
from sb3_causalgdp.offline.scores import normalized_score


class LoadedModel:
    """
    A trained model that acts with other settings than it was trained with.

    :param path: Checkpoint of the study
    :param kwargs: Arguments of CausalGDP that replace those of the training
    """

    def __init__(self, path: Path, **kwargs: Any) -> None:
        with path.open("rb") as file:
            self.model = CausalGDP.load(file, device="cpu", **kwargs)

    def predict(self, observations: np.ndarray) -> np.ndarray:
        """
        :param observations: Shape ``(batch, n)``
        :return: Deterministic actions, shape ``(batch, d)``
        """
        return self.model.predict(observations, deterministic=True)[0]


def sweep(paths: list[Path], task: str, scales: list[float], candidates: list[int], episodes: int) -> list[str]:
    """
    :param paths: Checkpoints
    :param task: Name of the task
    :param scales: Values of ``outcome_guidance_scale``; 0 leaves the guidance by the return away
    :param candidates: Values of ``n_action_candidates``
    :param episodes: Number of episodes, the same starts for all
    :return: Lines of a table of scores in Markdown
    """
    evaluation = Evaluation(task, episodes, SELECTION_SEED)
    lines = ["| model | candidates | " + " | ".join(f"{scale:g}" for scale in scales) + " |", "|---" * (2 + len(scales)) + "|"]
    for path in paths:
        for n_candidates in candidates:
            settings = ({"outcome_guidance_scale": scale, "n_action_candidates": n_candidates} for scale in scales)
            returns = [evaluation.returns(LoadedModel(path, **one)) for one in settings]
            scores = " | ".join(f"{normalized_score(task, values).mean:.0f}" for values in returns)
            lines.append(f"| {path.parent.name}, {path.name} | {n_candidates} | {scores} |")
            print(lines[-1], flush=True)
    return lines


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add = parser.add_argument
    add("paths", nargs="+", type=Path, metavar="CHECKPOINT")
    add("--task", choices=MAZE_TASKS, default="maze2d-umaze", metavar="TASK", help="(%(default)s)")
    add("--scales", nargs="+", type=float, default=[0, 1, 10, 30, 60, 120], help="outcome_guidance_scale (0 1 10 30 60 120)")
    add("--candidates", nargs="+", type=int, default=[1], help="n_action_candidates (1)")
    add("--episodes", type=int, default=20, help="(%(default)s)")
    add("--output", type=Path, help="also write the table there")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    lines = sweep(arguments.paths, arguments.task, arguments.scales, arguments.candidates, arguments.episodes)
    if arguments.output is not None:
        arguments.output.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
