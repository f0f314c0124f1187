"""Datasets that are made on this machine: ``python -m sb3_causalgdp.datasets make --help``."""

import argparse
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from sb3_causalgdp.offline.maze2d import MAZES, REWARD_TYPES, Maze, PointSimulator, WaypointController, find_maze, maze_rewards
from sb3_causalgdp.offline.registration import MAZE_IDS, maze_environment_id
from sb3_causalgdp.offline.scores import find_reference, normalized_score
from sb3_causalgdp.offline.storage import Episode, check_new_dataset, datasets_root, write_dataset

STEPS = 1_000_000
ACTION_NOISE = 0.5  # D4RL, scripts/generation/generate_maze2d_datasets.py --noisy
TRAINING_STEPS = 1_000_000
MEDIUM_LEVEL = 100 / 3

MAZE_TASKS = {
    f"maze2d-{maze}{'-dense' if reward_type == 'dense' else ''}": (maze, reward_type)
    for reward_type in REWARD_TYPES
    for maze in MAZES
}
MUJOCO_NAMES = ("halfcheetah", "hopper", "walker2d", "pen")
KINDS = ("medium", "medium-replay")
TASKS = (*MAZE_TASKS, *(f"{name}-{kind}" for name in MUJOCO_NAMES for kind in KINDS))


# Mazes ------------------------------------------------------------------------------------------------------------------


def maze_episodes(
    maze: Maze, max_episode_steps: int, steps: int, reward_type: str = "sparse", seed: int = 0, noise: float = ACTION_NOISE
) -> Iterator[Episode]:
    """
    One long walk to goals that are drawn anew whenever one is reached, or has not been for the length of an episode, cut into
    episodes and rewarded for the maze's own goal. As in D4RL, a reward is that of the state before the step.

    :param maze: The maze
    :param max_episode_steps: Length of an episode in steps
    :param steps: Number of transitions
    :param reward_type: ``"sparse"`` or ``"dense"``
    :param seed: Seed
    :param noise: Standard deviation of the noise on actions
    :return: the episodes; each starts where the one before it was cut
    """
    rng = np.random.default_rng(seed)
    simulator, controller = PointSimulator(maze), WaypointController(maze, rng)
    simulator.state = np.concatenate([maze.draw_position(rng), rng.normal(0.0, 0.1, 2)])
    target, age = maze.draw_position(rng), 0
    controller.plan(simulator.data.qpos, target)
    for first in range(0, steps, max_episode_steps):
        length = min(max_episode_steps, steps - first)
        observations, targets = np.empty((length + 1, 4)), np.empty((length + 1, 2))
        actions = rng.normal(0.0, noise, (length, 2)).astype(np.float32)
        for step in range(length):
            observations[step], targets[step] = simulator.state, target
            x, y, reached = controller.act(*observations[step].tolist())
            action = actions[step]
            action[0], action[1] = min(max(x + action[0], -1.0), 1.0), min(max(y + action[1], -1.0), 1.0)
            simulator.step(action)
            age += 1
            if reached or age >= max_episode_steps:
                target, age = maze.draw_position(rng), 0
                controller.plan(simulator.data.qpos, target)
        observations[length], targets[length] = simulator.state, target
        rewards = maze_rewards(observations[:-1, :2], maze.goal, reward_type)
        yield Episode(observations, actions, rewards, infos={"target": targets})


def make_maze_dataset(
    task: str,
    dataset_id: str,
    root: Path,
    steps: int = STEPS,
    seed: int = 0,
    noise: float = ACTION_NOISE,
    quiet: bool = False,
) -> Path:
    """
    :param task: One of ``MAZE_TASKS``
    :param dataset_id: Minari's id of the new dataset
    :param root: Folder of Minari datasets
    :param steps: Number of transitions
    :param seed: Seed
    :param noise: Standard deviation of the noise on actions, which are in [-1, 1]
    :param quiet: Whether to show no progress bar
    :return: the dataset's folder
    """
    name, reward_type = MAZE_TASKS[task]
    episodes = maze_episodes(find_maze(name), MAZE_IDS[name][1], steps, reward_type, seed, noise)
    with progress_bar(task, steps, quiet) as advance:
        return write_dataset(
            dataset_id,
            _counted(episodes, advance),
            maze_environment_id(name, reward_type),
            root,
            algorithm_name="waypoints along shortest paths, PD control",
            description=f"{task} as D4RL's v1: targets drawn anew, rewards for the fixed goal; seed {seed}, noise {noise:g}",
            requirements=["mujoco"],
        )


# MuJoCo -----------------------------------------------------------------------------------------------------------------


def make_mujoco_dataset(
    task: str,
    dataset_id: str,
    root: Path,
    steps: int | None = None,
    seed: int = 0,
    level: float = MEDIUM_LEVEL,
    training_steps: int = TRAINING_STEPS,
    quiet: bool = False,
) -> Path:
    """
    Train SAC to a score, then record its policy (``-medium``) or keep what it saw while it learned (``-medium-replay``).

    The training lies in ``.training`` in the folder of datasets: both kinds share it, and an interrupted one goes on.

    :param task: Such as ``"hopper-medium-replay"``
    :param dataset_id: Minari's id of the new dataset
    :param root: Folder of Minari datasets
    :param steps: Number of transitions, None for 1,000,000 of the policy's, or the whole training
    :param seed: Seed
    :param level: Normalised score at which the training stops
    :param training_steps: Number of training steps after which it gives up
    :param quiet: Whether to show no progress
    :return: the dataset's folder
    :raises ValueError: if the level is not reached
    """
    from sb3_causalgdp.offline.mujoco_tasks import Training, policy_episodes, replay_episodes

    check_new_dataset(dataset_id, root)
    name, _, kind = task.partition("-")
    training = Training(name, level, training_steps, seed, root / ".training" / f"{name}-level{level:.4g}-seed{seed}")
    model = training.run(_no_report if quiet else _report_score)
    if kind == "medium":
        steps = steps or STEPS
        episodes = policy_episodes(model, training.task.make, steps, seed)
    else:
        assert model.replay_buffer is not None
        steps = min(steps or model.replay_buffer.size(), model.replay_buffer.size())
        episodes = replay_episodes(model, steps)
    with progress_bar(task, steps, quiet) as advance:
        return write_dataset(
            dataset_id,
            _counted(episodes, advance),
            training.task.environment_id,
            root,
            training.task.max_episode_steps,
            algorithm_name="SAC",
            description=f"{task}: SAC of Stable-Baselines3 after {model.num_timesteps} steps with a score of "
            f"{training.score:.1f} by D4RL's references; seed {seed}",
            requirements=[training.task.needs],
        )


def _report_score(steps: int, score: float) -> None:
    print(f"{steps:,} training steps: score {score:.1f}", file=sys.stderr, flush=True)


def _no_report(steps: int, score: float) -> None:
    pass


# Command line -----------------------------------------------------------------------------------------------------------


@contextmanager
def progress_bar(label: str, total: int, quiet: bool) -> Iterator[Callable[[int], object]]:
    """
    :param label: What is made
    :param total: Number of steps
    :param quiet: Whether to show none
    :return: what to call with the number of new steps
    """
    try:
        from tqdm import tqdm
    except ImportError:
        yield lambda steps: None
        return
    # None: no bar where there is no terminal
    with tqdm(total=total, desc=label, unit=" steps", unit_scale=True, disable=True if quiet else None) as bar:
        yield bar.update


def _counted(episodes: Iterable[Episode], advance: Callable[[int], object]) -> Iterator[Episode]:
    for episode in episodes:
        yield episode
        advance(len(episode))


def make_parser() -> argparse.ArgumentParser:
    """
    :return: the command line's parser
    """
    parser = argparse.ArgumentParser(
        prog="python -m sb3_causalgdp.datasets", description="Make offline datasets on this machine, in Minari's format."
    )
    make = parser.add_subparsers(dest="command", required=True, metavar="COMMAND").add_parser(
        "make", help="make a dataset", description="Make a dataset. An interrupted one leaves nothing half-written."
    )
    add = make.add_argument
    add("task", metavar="TASK", choices=TASKS, help=", ".join(TASKS))
    add("--steps", type=_positive, metavar="N", help="number of transitions (1,000,000; -medium-replay: the whole training)")
    add("--seed", type=_not_negative, default=0, metavar="N", help="(%(default)s)")
    add("--path", metavar="FOLDER", help="folder of Minari datasets (MINARI_DATASETS_PATH, or ~/.minari/datasets)")
    add("--name", metavar="ID", help="id of the dataset (sb3_causalgdp/TASK-v0)")
    add("--quiet", action="store_true", help="print nothing but errors")
    mazes = make.add_argument_group("mazes")
    mazes.add_argument("--noise", type=float, metavar="STD", help=f"of the actions, which are in [-1, 1] ({ACTION_NOISE:g})")
    mujoco = make.add_argument_group("MuJoCo and Adroit")
    mujoco.add_argument(
        "--level", type=float, metavar="SCORE", help=f"normalised score at which the training stops ({MEDIUM_LEVEL:.1f})"
    )
    mujoco.add_argument(
        "--training-steps", type=_positive, metavar="N", help=f"after which the training gives up ({TRAINING_STEPS:,})"
    )
    return parser


def _positive(text: str) -> int:
    return _at_least(1, text)


def _not_negative(text: str) -> int:
    return _at_least(0, text)


def _at_least(least: int, text: str) -> int:
    try:
        number = int(text.replace("_", ""))
    except ValueError:
        number = least - 1
    if number < least:
        raise argparse.ArgumentTypeError(f"must be an integer of at least {least}, got {text!r}")
    return number


def main(argv: Sequence[str] | None = None) -> None:
    """
    Run the command line.

    :param argv: Its arguments, by default those of the process
    """
    parser = make_parser()
    arguments = parser.parse_args(argv)
    # Without this, a terminated process would leave the unfinished dataset's folder
    before = signal.signal(signal.SIGTERM, _terminate)
    try:
        run(arguments)
    except (ValueError, OSError, ImportError) as error:
        parser.error(" ".join(str(error).split()))
    except KeyboardInterrupt:
        print("interrupted: no dataset was written", file=sys.stderr)
        sys.exit(130)
    finally:
        signal.signal(signal.SIGTERM, before)


def _terminate(*_: Any) -> NoReturn:
    print("terminated: no dataset was written", file=sys.stderr)
    sys.exit(143)


def run(arguments: argparse.Namespace) -> None:
    """
    Make what was asked for, and say what it is.

    :param arguments: What the parser made
    :raises ValueError: on what the user got wrong
    """
    task, root = arguments.task, datasets_root(arguments.path)
    dataset_id = arguments.name or f"sb3_causalgdp/{task}-v0"
    check_new_dataset(dataset_id, root)
    is_maze = task in MAZE_TASKS
    _check_options(arguments, is_maze)
    names = ("noise",) if is_maze else ("level", "training_steps")
    given = {name: value for name in ("steps", *names) if (value := getattr(arguments, name)) is not None}
    make: Callable[..., Path] = make_maze_dataset if is_maze else make_mujoco_dataset
    folder = make(task, dataset_id, root, seed=arguments.seed, quiet=arguments.quiet, **given)
    if not arguments.quiet:
        print(_summary(task, dataset_id, folder))
        if not is_maze:
            print(f"the training stays in {root / '.training'}: the task's other dataset uses it")
        if arguments.path is not None:
            print(f"to load it, set MINARI_DATASETS_PATH={root}")


def _check_options(arguments: argparse.Namespace, is_maze: bool) -> None:
    foreign = {"level": "--level", "training_steps": "--training-steps"} if is_maze else {"noise": "--noise"}
    for name, option in foreign.items():
        if getattr(arguments, name) is not None:
            raise ValueError(f"{option} does not apply to {arguments.task}")
    if arguments.noise is not None and not 0 <= arguments.noise < np.inf:
        raise ValueError(f"--noise must be a standard deviation of at least 0, got {arguments.noise:g}")
    if arguments.level is not None and not np.isfinite(arguments.level):
        raise ValueError(f"--level must be a normalised score, got {arguments.level:g}")


def _summary(task: str, dataset_id: str, folder: Path) -> str:
    from minari import MinariDataset

    dataset: Any = MinariDataset(folder / "data")
    line = f"{dataset_id}: {dataset.total_episodes:,} episodes, {dataset.total_steps:,} steps in {folder}"
    if find_reference(task) is not None:
        returns = [episode["rewards"].sum() for episode in dataset.storage.get_episodes(range(dataset.total_episodes))]
        line += f"\nmean return {np.mean(returns):.1f}, score {normalized_score(task, returns)}"
    return line
