"""One page about a run of RL Zoo: returns, causal graph, effects of the actions, settings, in a file that needs no other."""

import argparse
import importlib
import importlib.util
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import gymnasium as gym
import jinja2
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.files import replaced_when_done
from sb3_causalgdp.zoo.registration import ALGORITHM, SetupError, WithoutReplayBuffer
from sb3_causalgdp.zoo.report_sections import Played, make_sections
from sb3_causalgdp.zoo.run_folder import RunFolder, find_runs
from sb3_causalgdp.zoo.settings import check_modules, safe_files

PROGRAM = "causalgdp-zoo report"


# The command ------------------------------------------------------------------------------------------------------------


def report(argv: Sequence[str]) -> None:
    """
    ``causalgdp-zoo report LOGDIR``: write the page of a run.

    :param argv: Arguments of the command
    :raises SetupError: If there is nothing to report on
    """
    parser = argparse.ArgumentParser(PROGRAM, description="Write one self-contained HTML page about a run of RL Zoo.")
    parser.add_argument(
        "logdir",
        type=Path,
        metavar="LOGDIR",
        help="folder of a run, like logs/causalgdp/Pendulum-v1_1, or of an algorithm: the latest run of each environment",
    )
    parser.add_argument("-o", "--output", type=Path, help="the page; by default report.html in the folder of the run")
    parser.add_argument("--load-best", action="store_true", help="show the model of the best evaluation, not the last one")
    parser.add_argument("--episodes", type=int, default=5, help="episodes that the model plays for the page (default: 5)")
    parser.add_argument("--seed", type=int, default=0, help="seed of these episodes (default: 0)")
    parser.add_argument("--device", default="auto", help="device of the model (default: auto)")
    parser.add_argument("--trusted", action="store_true", help="let the files of the run bring code, as your own may")
    arguments = parser.parse_args(argv)
    if arguments.episodes < 0:
        raise SetupError(f"--episodes must be at least 0, got {arguments.episodes}")
    try:
        runs = find_runs(arguments.logdir, arguments.trusted)
    except ValueError as error:
        raise SetupError(str(error)) from error
    if not runs:
        problem = "there is no run in it" if arguments.logdir.is_dir() else "there is no such folder"
        raise SetupError(f"{arguments.logdir}: {problem}. Give the folder of a run, like logs/{ALGORITHM}/Pendulum-v1_1")
    if arguments.output is not None and len(runs) > 1:
        names = ", ".join(run.path.name for run in runs)
        raise SetupError(f"-o is for one run, but {arguments.logdir} holds {len(runs)}: give the folder of one of {names}")
    for run in runs:
        path = arguments.output or run.path / "report.html"
        try:
            write_report(run, path, arguments.load_best, arguments.episodes, arguments.seed, arguments.device)
            print(f"Wrote {path}")
        except SetupError as error:
            if len(runs) == 1:
                raise
            print(f"Skipped {error}")


def write_report(
    run: RunFolder, path: Path, load_best: bool = False, episodes: int = 5, seed: int = 0, device: str = "auto"
) -> None:
    """
    Write the page of a run. What the run lacks is said on the page.

    :param run: The run
    :param path: The page; its folder is created
    :param load_best: Whether to show the model of the best evaluation, not the last one
    :param episodes: How many episodes the model plays, 0 for none
    :param seed: Seed of these episodes
    :param device: Device of the model
    :raises SetupError: If the run has no model of this algorithm
    """
    candidates = _models_to_try(run, load_best)
    environment, problem = _make_environment(run, seed)
    try:
        kind, model_path, model = _load_first_whole(run, candidates, environment, device)
        played = Played()
        if environment is not None:
            problem = _play(model, environment, episodes, played)
        sections = make_sections(run, model, kind, model_path, played, problem)
    finally:
        if environment is not None:
            environment.close()
    title = f"CausalGDP on {run.environment_id or 'an unknown environment'}: {run.path.resolve().name}"
    template = jinja2.Template(
        Path(__file__).with_name("report.html").read_text(encoding="utf-8"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    with replaced_when_done(path) as temporary:
        temporary.write_text(template.render(title=title, sections=sections), encoding="utf-8")


# The model and what it does ---------------------------------------------------------------------------------------------


def _models_to_try(run: RunFolder, load_best: bool) -> list[tuple[str, Path]]:
    """The model that the page is to show, and behind it the others, the newest first."""
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
    kind = "best" if load_best else next(iter(models))
    others = {path: other for other, path in models.items() if other != kind}
    others |= {path: "checkpoint" for _, path in run.checkpoints() if path != models[kind]}
    newest_first = sorted(others, key=lambda path: path.stat().st_mtime, reverse=True)
    return [(kind, models[kind]), *((others[path], path) for path in newest_first)]


def _load_first_whole(
    run: RunFolder, candidates: Sequence[tuple[str, Path]], environment: VecEnv | None, device: str
) -> tuple[str, Path, CausalGDP]:
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


def _make_environment(run: RunFolder, seed: int) -> tuple[VecEnv | None, str | None]:
    """The environment as RL Zoo's enjoy makes it, or what is in the way."""
    with nullcontext() if run.trusted else safe_files():
        return _made_environment(run, seed)


def _made_environment(run: RunFolder, seed: int) -> tuple[VecEnv | None, str | None]:
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
        environment = create_test_env(
            run.environment_id, 1, statistics, seed, should_render=False, hyperparams=hyperparameters, env_kwargs=kwargs
        )
    except Exception as error:  # whatever an environment raises, the rest of the page can be written
        return None, f"the environment {run.environment_id} cannot be made here: {type(error).__name__}: {error}"
    return environment, None


def _play(model: CausalGDP, environment: VecEnv, episodes: int, played: Played) -> str | None:
    """Gives what was in the way, None if nothing was."""
    normalizer = unwrap_vec_normalize(environment)

    def keep(local: dict[str, Any], _: dict[str, Any]) -> None:
        given = local["observations"]
        played.observations.append(given if normalizer is None else normalizer.unnormalize_obs(given))
        played.actions.append(local["actions"])

    if episodes > 0:
        try:
            returns, lengths = evaluate_policy(model, environment, episodes, callback=keep, return_episode_rewards=True)
        except Exception as error:  # whatever an environment raises, the rest of the page can be written
            return f"{type(error).__name__}: {error}"
        played.returns, played.lengths = list(returns), list(lengths)  # type: ignore[arg-type]
    return None
