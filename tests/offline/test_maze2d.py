import pickle

import gymnasium as gym
import numpy as np
import pytest

import sb3_causalgdp.offline  # noqa: F401 (registers the environments)
from sb3_causalgdp.offline.maze2d import (
    CENTER_OFFSET,
    MAZES,
    Maze2dEnv,
    PointSimulator,
    ReplanningAgent,
    WaypointController,
    find_maze,
    maze_rewards,
)
from sb3_causalgdp.offline.scores import find_reference

pytest.importorskip("mujoco")

IDS = {"umaze": ("UMaze", 300), "medium": ("Medium", 600), "large": ("Large", 800)}


@pytest.mark.parametrize("maze, name", [("umaze", "U_MAZE"), ("medium", "MEDIUM_MAZE"), ("large", "LARGE_MAZE")])
def test_the_maps_are_those_of_gymnasium_robotics(maze, name):
    maps = pytest.importorskip("gymnasium_robotics.envs.maze.maps")
    walls = [[tile == "#" for tile in row] for row in MAZES[maze].rows]
    assert walls == [[cell == 1 for cell in row] for row in getattr(maps, name)]


@pytest.mark.parametrize("maze, goal", [("umaze", (1, 1)), ("medium", (6, 6)), ("large", (7, 9))])
def test_the_goals_are_those_of_d4rl_and_free(maze, goal):
    assert MAZES[maze].goal == goal
    assert MAZES[maze].cell_of(*goal) == goal
    assert goal in MAZES[maze].free_cells


@pytest.mark.parametrize("maze", MAZES)
@pytest.mark.parametrize("reward_type", ["sparse", "dense"])
def test_the_environments_are_registered_with_d4rls_lengths(maze, reward_type):
    name, length = IDS[maze]
    env = gym.make(f"sb3_causalgdp/Maze2d-{name}{'-Dense' if reward_type == 'dense' else ''}-v1")
    assert env.spec.max_episode_steps == length
    assert env.unwrapped.maze is MAZES[maze] and env.unwrapped.reward_type == reward_type


def test_the_reward_is_that_of_the_state_before_the_step():
    env = Maze2dEnv("umaze", "sparse")
    x, y = goal = env.maze.goal
    env.reset(options={"state": [x, y + 0.499, 0.0, 5.0]})
    observation, reward, *_ = env.step(np.array([0.0, 1.0], dtype=np.float32))
    assert reward == 1.0 and np.hypot(*(observation[:2] - goal)) > 0.5
    assert env.step(np.array([0.0, -1.0], dtype=np.float32))[1] == 0.0


def test_the_dense_reward_is_the_exponential_of_the_negative_distance():
    env = Maze2dEnv("umaze", "dense")
    env.reset(options={"state": [1.0, 2.0, 0.0, 0.0]})
    assert env.step(np.zeros(2, dtype=np.float32))[1] == pytest.approx(np.exp(-1))


def test_it_never_terminates_and_is_truncated_at_its_length():
    env = gym.make("sb3_causalgdp/Maze2d-UMaze-v1")
    env.reset(seed=0, options={"state": [1.0, 1.0, 0.0, 0.0]})
    steps = [env.step(np.zeros(2, dtype=np.float32))[1:4] for _ in range(300)]
    assert not any(terminated for _, terminated, _ in steps)
    assert [truncated for *_, truncated in steps] == [False] * 299 + [True]
    assert sum(reward for reward, *_ in steps) == 300


@pytest.mark.parametrize("maze", MAZES)
def test_starts_are_uniform_over_the_free_cells(maze):
    env = Maze2dEnv(maze)
    env.reset(seed=0)
    starts = np.array([env.reset()[0] for _ in range(3_000)])
    cells, offsets = np.rint(starts[:, :2]).astype(int), starts[:, :2] - np.rint(starts[:, :2])
    found, counts = np.unique(cells, axis=0, return_counts=True)
    assert [tuple(cell) for cell in found.tolist()] == env.maze.free_cells
    expected = len(starts) / len(found)
    # chi-squared with len(found) - 1 degrees of freedom, mean + 5 standard deviations
    assert ((counts - expected) ** 2 / expected).sum() < len(found) + 5 * np.sqrt(2 * len(found))
    assert np.abs(offsets).max() <= 0.1 and offsets.std() == pytest.approx(0.2 / np.sqrt(12), rel=0.05)
    np.testing.assert_allclose(starts[:, 2:].std(axis=0), 0.1, rtol=0.1)


def test_equal_seeds_give_equal_episodes():
    first, second = Maze2dEnv("medium"), Maze2dEnv("medium")
    np.testing.assert_array_equal(first.reset(seed=3)[0], second.reset(seed=3)[0])
    actions = np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32)
    for action in actions:
        np.testing.assert_array_equal(first.step(action)[0], second.step(action)[0])


def test_actions_and_velocities_are_clipped():
    env = Maze2dEnv("large")
    results = []
    for velocity, action in ((9.0, 7.0), (5.0, 1.0)):
        env.reset(options={"state": [1.0, 1.0, 0.0, velocity]})
        results.append(env.step(np.array([0.0, action]))[0])
    np.testing.assert_array_equal(*results)


def test_walls_hold_the_point():
    env = Maze2dEnv("umaze")
    env.reset(options={"state": [0.8, 0.8, -5.0, 0.0]})
    for _ in range(200):
        observation = env.step(np.array([-1.0, 0.0], dtype=np.float32))[0]
    # half a cell from the center, less the radius of 0.1
    assert observation[0] == pytest.approx(1 + CENTER_OFFSET - 0.4, abs=0.02)


@pytest.mark.parametrize("maze", MAZES)
def test_the_planner_knows_a_way_from_everywhere_to_everywhere(maze):
    maze = MAZES[maze]
    for target in maze.free_cells:
        for cell in maze.free_cells:
            way = [cell]
            while way[-1] != target:
                way.append(maze.next_cells[target][way[-1]])
                assert abs(np.subtract(*way[-2:])).sum() == 1 and len(way) <= len(maze.free_cells)


@pytest.mark.parametrize("maze", MAZES)
def test_the_agent_reaches_the_goal_from_everywhere(maze):
    simulator, agent = PointSimulator(MAZES[maze]), ReplanningAgent(MAZES[maze])
    for cell in MAZES[maze].free_cells:
        simulator.state = np.array([*np.array(cell) + CENTER_OFFSET, 0.0, 0.0])
        for _ in range(IDS[maze][1]):
            simulator.step(agent(simulator.state))
            if maze_rewards(simulator.data.qpos, MAZES[maze].goal, "sparse") == 1.0:
                break
        else:
            pytest.fail(f"not reached from {cell}")


def test_a_random_policy_earns_what_d4rl_says():
    maze, rng = MAZES["umaze"], np.random.default_rng(0)
    simulator = PointSimulator(maze)
    returns = []
    for _ in range(100):
        simulator.state = np.concatenate([maze.draw_position(rng), rng.normal(0.0, 0.1, 2)])
        positions = np.empty((300, 2))
        for step, action in enumerate(rng.uniform(-1, 1, (300, 2))):
            positions[step] = simulator.data.qpos
            simulator.step(action)
        returns.append(maze_rewards(positions, maze.goal, "dense").sum())
    assert np.mean(returns) == pytest.approx(find_reference("maze2d-umaze-dense").random, abs=4 * np.std(returns) / 10)


def test_the_controller_follows_its_waypoints_to_the_target():
    maze = MAZES["medium"]
    simulator, controller = PointSimulator(maze), WaypointController(maze, np.random.default_rng(0))
    simulator.state = np.array([1.0, 1.0, 0.0, 0.0])
    target = np.array([6.05, 5.95])
    controller.plan(simulator.data.qpos, target)
    for _ in range(600):
        x, y, reached = controller.act(*simulator.state)
        if reached:
            break
        simulator.step(np.clip([x, y], -1, 1))
    assert reached and np.linalg.norm(simulator.data.qpos - target) < 0.1


def test_the_environment_can_be_pickled():
    env = pickle.loads(pickle.dumps(Maze2dEnv("large", "dense")))
    assert env.maze == MAZES["large"] and env.reward_type == "dense"


def test_it_passes_the_environment_checkers():
    from gymnasium.utils.env_checker import check_env
    from stable_baselines3.common.env_checker import check_env as check_env_of_sb3

    check_env(gym.make("sb3_causalgdp/Maze2d-UMaze-v1").unwrapped, skip_render_check=True)
    check_env_of_sb3(Maze2dEnv("umaze"))


@pytest.mark.parametrize("call", [lambda: find_maze("tiny"), lambda: Maze2dEnv("umaze", "shaped")])
def test_wrong_arguments_name_the_right_ones(call):
    with pytest.raises(ValueError, match=r"must be one of .*, got '(tiny|shaped)'"):
        call()
