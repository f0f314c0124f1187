"""The model of a run, and its episodes in the run's environment: what a page about the run shows it do."""

import importlib
import importlib.util
import math
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import gymnasium as gym
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.zoo.algorithm import ALGORITHM, SetupError, WithoutReplayBuffer
from sb3_causalgdp.zoo.played import Played
from sb3_causalgdp.zoo.run_folder import RunFolder
from sb3_causalgdp.zoo.settings import check_modules, safe_files


def models_to_try(run: RunFolder, load_best: bool = False, newest: bool = False) -> list[tuple[str, Path]]:
    """
    :param run: A run
    :param load_best: Whether the model of the best evaluation is wanted, not the last one
    :param newest: Whether the one that was saved last is wanted, whatever it is
    :return: What each model is and its file: the one that is wanted, and behind it the others, the newest first
    :raises SetupError: If there is none, or they are of another algorithm
    """
    algorithm = run.arguments.get("algo", ALGORITHM)
    if algorithm != ALGORITHM:
        raise SetupError(f"{run.path} is a run of {algorithm}, the page is about {ALGORITHM}: plot_train plots its returns")
    models = run.models()
    if load_best and "best" not in models:
        raise SetupError(f"{run.path}: there is no best_model.zip, which a training with --eval-freq saves")
    if not models:
        raise SetupError(
            f"{run.path}: there is no model yet. Wait for the end of the training, or train with --save-freq or --eval-freq"
        )
    first = [] if newest else ["best" if load_best else next(iter(models))]
    others = {path: kind for kind, path in models.items() if kind not in first}
    others |= {path: "checkpoint" for _, path in run.checkpoints() if path not in models.values()}
    newest_first = sorted(others, key=lambda path: path.stat().st_mtime, reverse=True)
    return [*((kind, models[kind]) for kind in first), *((others[path], path) for path in newest_first)]


def load_first_whole(
    run: RunFolder, candidates: Sequence[tuple[str, Path]], environment: VecEnv | None, device: str
) -> tuple[str, Path, CausalGDP]:
    """
    :param run: A run, which notes what is wrong with the files before that one
    :param candidates: What :func:`models_to_try` gives
    :param environment: Of the model, None for none
    :param device: Of the model
    :return: The first model that can be loaded, without a replay buffer: what it is, its file, and it
    :raises SetupError: If none can
    """
    first_error: Exception | None = None
    for kind, path in candidates:
        try:
            return kind, path, _load_model(path, environment, device, run.trusted)
        except Exception as error:  # a damaged file can raise anything
            run.note(path.name, error)
            first_error = first_error or error
    raise SetupError(
        f"{candidates[0][1]} cannot be loaded: {type(first_error).__name__}: {first_error}. There is no other model that can"
    ) from first_error


def _load_model(path: Path, environment: VecEnv | None, device: str, trusted: bool) -> CausalGDP:
    # The plain buffer of one transition needs no environment, HER's does
    return WithoutReplayBuffer.load(
        path, environment, device, trusted=trusted, replay_buffer_class=None, replay_buffer_kwargs={}
    )


def make_environment(run: RunFolder, seed: int, for_film: bool = False) -> tuple[VecEnv | None, str | None]:
    """
    :param run: A run
    :param seed: Of the environment
    :param for_film: Whether it shall give pictures
    :return: The environment as RL Zoo's enjoy makes it, or what is in the way
    """
    with nullcontext() if run.trusted else safe_files():
        return _made_environment(run, seed, {"render_mode": "rgb_array"} if for_film else {})


def _made_environment(run: RunFolder, seed: int, rendering: dict[str, str]) -> tuple[VecEnv | None, str | None]:
    from rl_zoo3.utils import create_test_env, get_saved_hyperparams

    if run.environment_id is None or run.settings_path is None:
        return None, "the run has no args.yml, which names the environment"
    try:
        if not run.trusted:
            check_modules(run.entry or {}, run.arguments)
        for module in run.arguments.get("gym_packages") or []:
            importlib.import_module(module)
        if run.environment_id not in gym.registry and importlib.util.find_spec("gymnasium_robotics"):
            gym.register_envs(importlib.import_module("gymnasium_robotics"))
        hyperparameters, statistics = get_saved_hyperparams(str(run.settings_path), test_mode=True)
        kwargs = run.arguments.get("env_kwargs") or hyperparameters.pop("env_kwargs", None)
        hyperparameters.pop("env_kwargs", None)
        kwargs = {**(kwargs or {}), **rendering}
        environment = create_test_env(
            run.environment_id, 1, statistics, seed, should_render=False, hyperparams=hyperparameters, env_kwargs=kwargs
        )
    except Exception as error:  # whatever an environment raises, the rest of the page can be written
        return None, f"the environment {run.environment_id} cannot be made here: {type(error).__name__}: {error}"
    return environment, None


class _EnoughError(Exception):
    """More steps are not wanted."""


def play(
    model: CausalGDP,
    environment: VecEnv,
    episodes: int,
    played: Played,
    film: Callable[[VecEnv], None] | None = None,
    most_steps: float = math.inf,
) -> str | None:
    """
    :param model: A model
    :param environment: Where its deterministic policy plays
    :param episodes: How many episodes, 0 for none
    :param played: Takes what it did
    :param film: Called after each step, None for nothing
    :param most_steps: After so many steps it stops, and the episode in which it does has no return
    :return: What was in the way, None if nothing was
    """
    normalizer = unwrap_vec_normalize(environment)

    def keep(local: dict[str, Any], _: dict[str, Any]) -> None:
        given = local["observations"]
        played.observations.append(given if normalizer is None else normalizer.unnormalize_obs(given))
        played.actions.append(local["actions"])
        if film is not None:
            film(environment)
        if len(played.actions) >= most_steps:
            raise _EnoughError(f"it stopped after {most_steps:,} steps, in the middle of an episode")

    if episodes > 0:
        try:
            returns, lengths = evaluate_policy(model, environment, episodes, callback=keep, return_episode_rewards=True)
        except _EnoughError as error:
            return str(error)
        except Exception as error:  # whatever an environment raises, the rest of the page can be written
            return f"{type(error).__name__}: {error}"
        played.returns, played.lengths = list(returns), list(lengths)  # type: ignore[arg-type]
    return None
