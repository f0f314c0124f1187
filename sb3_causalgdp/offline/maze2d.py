"""D4RL's maze2d: mazes, environments with D4RL's conditions, a planner and its controllers."""

from collections import deque
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.utils import EzPickle

from sb3_causalgdp.offline.extras import need

GOAL_RADIUS = 0.5
MAX_VELOCITY = 5.0
START_NOISE = 0.1  # of positions (half width of a uniform distribution) and velocities (standard deviation)
# D4RL puts the point's origin at 1.2 and the walls' centers at index + 1: the cell (i, j) has its center at (i, j) - 0.2
CENTER_OFFSET = -0.2
REWARD_TYPES = ("sparse", "dense")

Cell = tuple[int, int]


@dataclass(frozen=True)
class Maze:
    """
    A maze of unit cells, in D4RL's coordinates: x grows with the row, y with the column, and the cell (i, j) has its center at
    (i - 0.2, j - 0.2).

    :param rows: One string per row, ``#`` is wall
    :param goal: Position that is rewarded, in meters
    """

    rows: tuple[str, ...]
    goal: tuple[float, float]

    @cached_property
    def free_cells(self) -> list[Cell]:
        """All cells that are not wall, row by row."""
        return [(i, j) for i, row in enumerate(self.rows) for j, tile in enumerate(row) if tile != "#"]

    @cached_property
    def next_cells(self) -> dict[Cell, dict[Cell, Cell]]:
        """For each target cell: the neighbour of each cell that is one step nearer to it."""
        return {cell: self._towards(cell) for cell in self.free_cells}

    def _towards(self, target: Cell) -> dict[Cell, Cell]:
        free, nearer, queue = set(self.free_cells), {target: target}, deque([target])
        while queue:
            i, j = cell = queue.popleft()
            for neighbour in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
                if neighbour in free and neighbour not in nearer:
                    nearer[neighbour] = cell
                    queue.append(neighbour)
        return nearer

    def cell_of(self, x: float, y: float) -> Cell:
        """
        :param x: Position along the rows, in meters
        :param y: Position along the columns, in meters
        :return: the free cell that holds it, or the nearest one (contacts are soft: the point can be pressed into a wall)
        """
        x, y = x - CENTER_OFFSET, y - CENTER_OFFSET
        cell = (round(x), round(y))
        if cell in self._free:
            return cell
        return min(self.free_cells, key=lambda free: (free[0] - x) ** 2 + (free[1] - y) ** 2)

    @cached_property
    def _free(self) -> frozenset[Cell]:
        return frozenset(self.free_cells)

    def draw_position(self, rng: np.random.Generator) -> np.ndarray:
        """
        :param rng: Source of randomness
        :return: position within 0.1 m of the indices of a uniformly drawn free cell, as D4RL draws starts and goals
        """
        cell = self.free_cells[rng.integers(len(self.free_cells))]
        return np.array(cell) + rng.uniform(-START_NOISE, START_NOISE, 2)


# The maps and goals of D4RL's maze2d-*-v1: https://github.com/Farama-Foundation/D4RL, d4rl/pointmaze
MAZES = {
    "umaze": Maze(("#####", "#   #", "### #", "#   #", "#####"), (1.0, 1.0)),
    "medium": Maze(
        ("########", "#  ##  #", "#  #   #", "##   ###", "#  #   #", "# #  # #", "#   #  #", "########"), (6.0, 6.0)
    ),
    "large": Maze(
        (
            "############",
            "#    #     #",
            "# ## # # # #",
            "#      #   #",
            "# #### ### #",
            "#  # #     #",
            "## # # # ###",
            "#  #   #   #",
            "############",
        ),
        (7.0, 9.0),
    ),
}


def find_maze(name: str) -> Maze:
    """
    :param name: One of ``MAZES``
    :return: the maze
    :raises ValueError: on another name
    """
    if name not in MAZES:
        raise ValueError(f"maze must be one of {', '.join(MAZES)}, got {name!r}")
    return MAZES[name]


def maze_rewards(positions: np.ndarray, goal: tuple[float, float], reward_type: str) -> np.ndarray:
    """
    :param positions: Positions in meters, (..., 2)
    :param goal: Rewarded position, in meters
    :param reward_type: ``"sparse"``: 1 within 0.5 m of the goal, else 0; ``"dense"``: exp(-distance)
    :return: rewards, (...)
    :raises ValueError: on another type
    """
    if reward_type not in REWARD_TYPES:
        raise ValueError(f"reward_type must be one of {', '.join(REWARD_TYPES)}, got {reward_type!r}")
    distances = np.hypot(positions[..., 0] - goal[0], positions[..., 1] - goal[1])
    return (distances <= GOAL_RADIUS).astype(np.float64) if reward_type == "sparse" else np.exp(-distances)


# Simulation -------------------------------------------------------------------------------------------------------------

# Without warm starts, a step depends on nothing but state and action: recorded transitions can be replayed bit for bit
MODEL = """
<mujoco model="maze2d">
  <compiler inertiafromgeom="true" angle="radian"/>
  <option timestep="0.01" gravity="0 0 0" iterations="20" integrator="Euler"><flag warmstart="disable"/></option>
  <default>
    <joint damping="1" limited="false"/>
    <geom friction=".5 .1 .1" density="1000" margin="0.002" condim="1" contype="2" conaffinity="1"/>
  </default>
  <worldbody>
    <light pos="{x} {y} 10"/>
    <camera name="top" pos="{x} {y} {height}" euler="0 0 1.5708"/>
    <geom name="ground" type="plane" size="40 40 0.25" pos="0 0 -0.1" contype="1" conaffinity="0" rgba=".2 .3 .4 1"/>
    <site name="goal" type="cylinder" size="{radius} .01" pos="{goal_x} {goal_y} -.08" rgba=".2 .7 .3 .6"/>
    <body name="point" pos="1.2 1.2 0">
      <geom name="point" type="sphere" size="0.1" contype="1" rgba=".9 .3 .2 1"/>
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
    </body>
    {walls}
  </worldbody>
  <actuator>
    <motor joint="x" ctrlrange="-1 1" ctrllimited="true" gear="100"/>
    <motor joint="y" ctrlrange="-1 1" ctrllimited="true" gear="100"/>
  </actuator>
</mujoco>
"""


def maze_model(maze: Maze) -> str:
    """
    :param maze: The maze
    :return: its MuJoCo model with D4RL's physical constants, as XML
    """
    walls = [
        f'<geom type="box" pos="{i + 1} {j + 1} 0" size="0.5 0.5 0.2" rgba=".7 .5 .3 1"/>'
        for i, row in enumerate(maze.rows)
        for j, tile in enumerate(row)
        if tile == "#"
    ]
    n_rows, n_columns = len(maze.rows), len(maze.rows[0])
    return MODEL.format(
        x=(n_rows + 1) / 2,
        y=(n_columns + 1) / 2,
        height=1.3 * max(n_rows, n_columns),
        radius=GOAL_RADIUS,
        goal_x=maze.goal[0] + 1.2,
        goal_y=maze.goal[1] + 1.2,
        walls="\n    ".join(walls),
    )


class PointSimulator:
    """
    The force-actuated point in its maze.

    :param maze: The maze
    :raises ImportError: without MuJoCo
    """

    def __init__(self, maze: Maze) -> None:
        mujoco = need("mujoco")
        self.model = mujoco.MjModel.from_xml_string(maze_model(maze))
        self.data = mujoco.MjData(self.model)
        self._mj_step = mujoco.mj_step

    @property
    def state(self) -> np.ndarray:
        """x, y in meters, vx, vy in meters per second."""
        return np.concatenate([self.data.qpos, self.data.qvel])

    @state.setter
    def state(self, state: np.ndarray) -> None:
        self.data.qpos[:], self.data.qvel[:] = state[:2], state[2:]

    def step(self, action: np.ndarray) -> None:
        """
        Simulate one step of 0.01 s.

        :param action: Forces along x and y in units of 100 N, clipped to [-1, 1]
        """
        data = self.data
        velocity = data.qvel
        # Two comparisons instead of np.clip, which would take longer than the physics
        for axis in (0, 1):
            if abs(velocity[axis]) > MAX_VELOCITY:
                velocity[axis] = MAX_VELOCITY if velocity[axis] > 0 else -MAX_VELOCITY
        data.ctrl[:] = action  # MuJoCo clips to ctrlrange
        self._mj_step(self.model, data)


class Maze2dEnv(gym.Env[np.ndarray, np.ndarray], EzPickle):
    """
    D4RL's ``maze2d-*-v1`` with Gymnasium's interface: a fixed goal, starts everywhere, no termination.

    Differs from Gymnasium-Robotics' PointMaze in all of these. The reward is that of the state before the step, as in D4RL's
    datasets; D4RL's own simulator rewards the state after it, which shifts the rewards of an episode by one step.

    Code: https://github.com/Farama-Foundation/D4RL, d4rl/pointmaze/maze_model.py

    :param maze: ``"umaze"``, ``"medium"`` or ``"large"``
    :param reward_type: ``"sparse"`` or ``"dense"``, see :func:`maze_rewards`
    :param render_mode: None, ``"human"`` or ``"rgb_array"``
    :raises ImportError: without MuJoCo
    """

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 100}  # noqa: RUF012 (Gymnasium's interface)

    def __init__(self, maze: str = "umaze", reward_type: str = "sparse", render_mode: str | None = None) -> None:
        EzPickle.__init__(self, maze, reward_type, render_mode)
        self.maze = find_maze(maze)
        maze_rewards(np.zeros(2), self.maze.goal, reward_type)  # a wrong type fails here, not at the first step
        self.reward_type = reward_type
        self.render_mode = render_mode
        self.simulator = PointSimulator(self.maze)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
        self.state_names = ("x", "y", "vel x", "vel y")
        self.action_names = ("force x", "force y")
        self.action_space = gym.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._renderer: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        """
        :param seed: Seed of the starts
        :param options: ``{"state": (x, y, vx, vy)}`` starts there, in meters and meters per second
        :return: observation and an empty info
        """
        super().reset(seed=seed)
        if options is not None and "state" in options:
            self.simulator.state = np.asarray(options["state"], dtype=np.float64)
        else:
            velocity = self.np_random.normal(0.0, START_NOISE, 2)
            self.simulator.state = np.concatenate([self.maze.draw_position(self.np_random), velocity])
        if self.render_mode == "human":
            self.render()
        return self.simulator.state, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """
        :param action: Forces along x and y, in [-1, 1]
        :return: observation, reward of the state before the step, False, False and an empty info
        """
        reward = float(maze_rewards(self.simulator.data.qpos, self.maze.goal, self.reward_type))
        self.simulator.step(action)
        if self.render_mode == "human":
            self.render()
        return self.simulator.state, reward, False, False, {}

    def render(self) -> Any:
        """
        :return: picture from above, (480, 480, 3), with ``render_mode="rgb_array"``
        """
        if self.render_mode is None:
            gym.logger.warn('Maze2dEnv renders with render_mode="rgb_array" or "human" only')
            return None
        need("mujoco").mj_forward(self.simulator.model, self.simulator.data)
        if self._renderer is None:
            rendering = need("gymnasium.envs.mujoco.mujoco_rendering")
            self._renderer = rendering.MujocoRenderer(
                self.simulator.model, self.simulator.data, width=480, height=480, camera_name="top"
            )
        return self._renderer.render(self.render_mode)

    def close(self) -> None:
        """Close the window."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


# Controllers ------------------------------------------------------------------------------------------------------------


class WaypointController:
    """
    Plans a shortest path through the cells and follows it by proportional-derivative control, one jittered waypoint after the
    other, as the agent that recorded D4RL's datasets.

    :param maze: The maze
    :param rng: Source of the waypoints' jitter
    """

    PROPORTIONAL_GAIN = 10.0  # per meter
    DERIVATIVE_GAIN = 1.0  # seconds per meter
    REACHED_RADIUS = 0.1  # meters

    def __init__(self, maze: Maze, rng: np.random.Generator) -> None:
        self.maze = maze
        self.rng = rng
        self._waypoints: deque[tuple[float, float]] = deque()

    def plan(self, position: np.ndarray, target: np.ndarray) -> None:
        """
        :param position: Where the point is, in meters
        :param target: Where it shall go, in meters
        """
        cell, last = self.maze.cell_of(*position), self.maze.cell_of(*target)
        nearer = self.maze.next_cells[last]
        self._waypoints.clear()
        while cell != last:
            cell = nearer[cell]
            if cell != last:
                x, y = np.array(cell) + CENTER_OFFSET + self.rng.uniform(-0.1, 0.1, 2)
                self._waypoints.append((float(x), float(y)))
        self._waypoints.append((float(target[0]), float(target[1])))

    def act(self, x: float, y: float, vx: float, vy: float) -> tuple[float, float, bool]:
        """
        :param x: Position along the rows, in meters
        :param y: Position along the columns, in meters
        :param vx: Velocity along the rows, in meters per second
        :param vy: Velocity along the columns, in meters per second
        :return: forces along x and y, not clipped, and whether the target is reached
        """
        to_x, to_y = self._waypoints[0]
        near = (to_x - x) ** 2 + (to_y - y) ** 2 < self.REACHED_RADIUS**2
        reached = near and len(self._waypoints) == 1
        if near and not reached:
            self._waypoints.popleft()
            to_x, to_y = self._waypoints[0]
        p, d = self.PROPORTIONAL_GAIN, self.DERIVATIVE_GAIN
        return p * (to_x - x) - d * vx, p * (to_y - y) - d * vy, reached


class ReplanningAgent:
    """
    Heads for the next cell's center at every step, or for the goal from its own cell on.

    Scores 158, 177 and 234 in umaze, medium and large (100 episodes). D4RL's expert, which is 100, kept the plan of its first
    episode: later on, it headed straight for the goal, into walls.

    :param maze: The maze
    """

    def __init__(self, maze: Maze) -> None:
        self.maze = maze
        self._nearer = maze.next_cells[maze.cell_of(*maze.goal)]

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """
        :param observation: x, y, vx, vy
        :return: action, (2,)
        """
        cell = self.maze.cell_of(*observation[:2])
        ahead = self._nearer[cell]
        waypoint = np.array(self.maze.goal if ahead == cell else np.array(ahead) + CENTER_OFFSET)
        force = WaypointController.PROPORTIONAL_GAIN * (waypoint - observation[:2])
        return np.clip(force - WaypointController.DERIVATIVE_GAIN * observation[2:], -1.0, 1.0).astype(np.float32)
