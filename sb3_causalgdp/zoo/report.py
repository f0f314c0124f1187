"""One page about a run of RL Zoo: returns, causal graph, effects of the actions, settings, in a file that needs no other."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from sb3_causalgdp.files import replaced_when_done
from sb3_causalgdp.zoo.algorithm import ALGORITHM, SetupError
from sb3_causalgdp.zoo.pages import report_page
from sb3_causalgdp.zoo.played import Played
from sb3_causalgdp.zoo.playing import load_first_whole, make_environment, models_to_try, play
from sb3_causalgdp.zoo.report_sections import make_sections
from sb3_causalgdp.zoo.run_folder import RunFolder, find_runs

PROGRAM = "causalgdp-zoo report"


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
    candidates = models_to_try(run, load_best)
    environment, problem = make_environment(run, seed)
    try:
        kind, model_path, model = load_first_whole(run, candidates, environment, device)
        played = Played()
        if environment is not None:
            problem = play(model, environment, episodes, played)
        sections = make_sections(run, model, kind, model_path, played, problem)
    finally:
        if environment is not None:
            environment.close()
    title = f"CausalGDP on {run.environment_id or 'an unknown environment'}: {run.path.resolve().name}"
    with replaced_when_done(path) as temporary:
        temporary.write_text(report_page(title, sections), encoding="utf-8")
