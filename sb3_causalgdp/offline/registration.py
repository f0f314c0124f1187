"""Environments with D4RL's conditions, by name."""

import gymnasium as gym

# Part of the id and length of an episode in steps
MAZE_IDS = {"umaze": ("UMaze", 300), "medium": ("Medium", 600), "large": ("Large", 800)}


def maze_environment_id(maze: str, reward_type: str = "sparse") -> str:
    """
    :param maze: ``"umaze"``, ``"medium"`` or ``"large"``
    :param reward_type: ``"sparse"`` or ``"dense"``
    :return: Gymnasium's id, such as ``sb3_causalgdp/Maze2d-UMaze-Dense-v1``
    """
    return f"sb3_causalgdp/Maze2d-{MAZE_IDS[maze][0]}{'-Dense' if reward_type == 'dense' else ''}-v1"


def register_environments() -> None:
    """Register the environments with Gymnasium, if that has not been done."""
    for maze, (_, max_episode_steps) in MAZE_IDS.items():
        for reward_type in ("sparse", "dense"):
            environment_id = maze_environment_id(maze, reward_type)
            if environment_id not in gym.registry:
                gym.register(
                    environment_id,
                    entry_point="sb3_causalgdp.offline.maze2d:Maze2dEnv",
                    max_episode_steps=max_episode_steps,
                    kwargs={"maze": maze, "reward_type": reward_type},
                )
