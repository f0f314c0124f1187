"""Offline tasks as environments: RL Zoo finds hyperparameters by the environment's id, and one has many datasets."""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym

from sb3_causalgdp.offline.extras import need
from sb3_causalgdp.offline.make import KINDS, MAZE_TASKS
from sb3_causalgdp.offline.mujoco_tasks import MUJOCO_TASKS
from sb3_causalgdp.offline.registration import MAZE_IDS, maze_environment_id

NAMESPACE = "offline"
RESET, GOAL = "r", "g"


@dataclass(frozen=True)
class OfflineTask:
    """
    :param dataset: Id of the Minari dataset
    :param environment: Gymnasium's id of the environment in which the policy acts
    :param max_episode_steps: Length of an episode in steps, None for the environment's own
    :param kwargs: Arguments of the environment
    """

    dataset: str
    environment: str
    max_episode_steps: int | None = None
    kwargs: dict[str, Any] = field(default_factory=dict)

    @property
    def environment_id(self) -> str:
        """The task as an environment: the dataset's id, in the namespace ``offline``."""
        return f"{NAMESPACE}/{self.dataset.replace('/', '-')}"


def _maze_map(rows: str) -> list[list[Any]]:
    return [[{"#": 1, ".": 0, "R": RESET, "G": GOAL}[cell] for cell in row] for row in rows.split()]


# The mazes in which Minari's datasets are evaluated: one goal, not one that is drawn anew. Source:
# https://github.com/Farama-Foundation/minari-dataset-generation-scripts, scripts/pointmaze and scripts/antmaze
POINT_MAZES = {
    "umaze": _maze_map("##### #G..# ###.# #...# #####"),
    "medium": _maze_map("######## #..##..# #..#...# ##...### #..#...# #.#..#.# #...#.G# ########"),
    "large": _maze_map(
        "############ #....#.....# #.##.#.#.#.# #......#...# #.####.###.# #..#.#.....# ##.#.#.#.### #..#...#.G.# ############"
    ),
}
ANT_MAZES = {
    "umaze": _maze_map("##### #..R# #.### #..G# #####"),
    "medium": _maze_map("######## #R.##..# #..#...# ##...### #..#...# #.#..#.# #...#.G# ########"),
    "large": _maze_map(
        "############ #R...#.....# #.##.#.#.#.# #......#...# #.####.###.# #..#.#.....# ##.#.#.#.### #..#...#.G.# ############"
    ),
}
ANT_ENVIRONMENTS = {
    "umaze": "AntMaze_UMaze-v4",
    "umaze-diverse": "AntMaze_UMaze-v4",
    "medium-play": "AntMaze_Medium-v4",
    "medium-diverse": "AntMaze_Medium_Diverse_GR-v4",
    "large-play": "AntMaze_Large-v4",
    "large-diverse": "AntMaze_Large_Diverse_GR-v4",
}
KITCHEN_TASKS = {
    "complete": ["microwave", "kettle", "light switch", "slide cabinet"],
    "partial": ["microwave", "kettle", "light switch", "slide cabinet"],
    "mixed": ["microwave", "kettle", "bottom burner", "light switch"],
}
MUJOCO_ENVIRONMENTS = {
    "halfcheetah": "HalfCheetah-v5",
    "hopper": "Hopper-v5",
    "walker2d": "Walker2d-v5",
    "humanoid": "Humanoid-v5",
}


def _minari_tasks() -> list[OfflineTask]:
    tasks = [
        OfflineTask(
            f"D4RL/pointmaze/{maze}{dense.lower()}-v2",
            f"PointMaze_{MAZE_IDS[maze][0]}{dense[1:]}-v3",
            kwargs={"maze_map": POINT_MAZES[maze]},
        )
        for dense in ("", "-Dense")
        for maze in MAZE_IDS
    ]
    tasks += [
        OfflineTask(f"D4RL/antmaze/{name}-v1", environment, kwargs={"maze_map": ANT_MAZES[name.split("-")[0]]})
        for name, environment in ANT_ENVIRONMENTS.items()
    ]
    tasks += [OfflineTask(f"D4RL/pen/{kind}-v2", "AdroitHandPen-v1") for kind in ("human", "cloned")]
    # As the datasets were recorded: a task that is done stays rewarded, and the episode goes on
    kitchen = {"remove_task_when_completed": False, "terminate_on_tasks_completed": False}
    tasks += [
        OfflineTask(f"D4RL/kitchen/{kind}-v2", "FrankaKitchen-v1", kwargs={"tasks_to_complete": names, **kitchen})
        for kind, names in KITCHEN_TASKS.items()
    ]
    tasks += [OfflineTask(f"mujoco/{name}/medium-v0", environment) for name, environment in MUJOCO_ENVIRONMENTS.items()]
    return tasks


def _local_tasks() -> list[OfflineTask]:
    tasks = [OfflineTask(f"sb3_causalgdp/{task}-v0", maze_environment_id(*maze)) for task, maze in MAZE_TASKS.items()]
    tasks += [
        OfflineTask(f"sb3_causalgdp/{name}-{kind}-v0", task.environment_id, task.max_episode_steps)
        for name, task in MUJOCO_TASKS.items()
        for kind in KINDS
    ]
    return tasks


OFFLINE_TASKS: dict[str, OfflineTask] = {task.environment_id: task for task in [*_minari_tasks(), *_local_tasks()]}
"""By the id of the environment; the last ones are those of ``python -m sb3_causalgdp.datasets make``."""


def register_offline_tasks() -> None:
    """Register the tasks with Gymnasium, if that has not been done."""
    for environment_id, task in OFFLINE_TASKS.items():
        if environment_id not in gym.registry:
            gym.register(
                environment_id,
                entry_point=f"{__name__}:make_task_environment",
                kwargs={"dataset": task.dataset},
                # The environment inside has both
                order_enforce=False,
                disable_env_checker=True,
            )


def make_task_environment(dataset: str, **kwargs: Any) -> gym.Env[Any, Any]:
    """
    :param dataset: Id of a task's dataset
    :param kwargs: Arguments of the environment, on top of the task's
    :return: The environment in which the task's policy acts
    :raises ImportError: Without the package that it needs
    """
    task = next(task for task in OFFLINE_TASKS.values() if task.dataset == dataset)
    if task.environment not in gym.registry:
        gym.register_envs(need("gymnasium_robotics"))
    return gym.make(task.environment, max_episode_steps=task.max_episode_steps, **{**task.kwargs, **kwargs})
