"""The entry point: a script of RL Zoo, in a process where RL Zoo knows CausalGDP."""

import argparse
import importlib
import importlib.util
import runpy
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

import gymnasium as gym

from sb3_causalgdp import TrainingDivergedError
from sb3_causalgdp.offline.registration import register_environments
from sb3_causalgdp.saving.archives import FileError
from sb3_causalgdp.zoo.algorithm import ALGORITHM, TRUST_OPTION, ZOO_HINT, SetupError
from sb3_causalgdp.zoo.registration import register
from sb3_causalgdp.zoo.scripts import surroundings

PROGRAM = "causalgdp-zoo"
SCRIPTS = {
    "train": "train a model, or search hyperparameters",
    "enjoy": "play a trained model",
    "record_video": "film a trained model",
    "record_training": "film the checkpoints of a training",
    "push_to_hub": "upload a trained model to the Hugging Face hub",
    "load_from_hub": "download one",
    "benchmark": "evaluate all trained models of a folder",
    "plot_train": "plot the returns of a training",
    "all_plots": "compare evaluations, make a table",
    "plot_from_file": "plot what all_plots wrote",
    "report": "write a page about a training and its causal graph",
    "watch": "follow a training on a page in the browser",
}
OWN = ("report", "watch")
PLOTS = ("all_plots", "plot_from_file", "plot_train")
PLAYING = ("enjoy", "record_video")
# RL Zoo's defaults for these are PPO and CartPole
OF_ONE_ENVIRONMENT = ("train", "enjoy", "record_video", "record_training")
# Whatever fails in these is about the network, or about what lies on the hub
HUB_PACKAGES = ("huggingface_hub", "huggingface_sb3")


def main(argv: Sequence[str] | None = None) -> None:
    """
    Run a script of RL Zoo, such as ``train --algo causalgdp --env HalfCheetah-v5``.

    :param argv: Name and arguments of the script, by default those of the process
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    shows_traceback = arguments[:1] == ["--traceback"]
    script, *arguments = arguments[int(shows_traceback) :] or ["--help"]
    if script in ("-h", "--help"):
        print(_usage())
        return
    if script not in SCRIPTS:
        _fail(PROGRAM, f"unknown script {script!r}, it must be one of {', '.join(SCRIPTS)}")
    trusted = TRUST_OPTION in arguments
    if script not in OWN:
        arguments = [one for one in arguments if one != TRUST_OPTION]
    if script in OF_ONE_ENVIRONMENT:
        arguments = _with_algorithm(script, arguments)
    before, sys.argv = sys.argv, [f"{PROGRAM} {script}", *arguments]
    try:
        _prepare(script, arguments, trusted)
        with surroundings(script, trusted):
            _run(script, arguments)
    except KeyboardInterrupt:
        sys.exit(130)
    except Exception as error:
        if shows_traceback or not _is_about_usage(error):
            raise
        _fail(f"{PROGRAM} {script}", _one_line(error, arguments))
    finally:
        sys.argv = before


def _with_algorithm(script: str, arguments: list[str]) -> list[str]:
    """CausalGDP unless they name another; they have to name the environment."""
    parser = argparse.ArgumentParser(add_help=False, exit_on_error=False)
    parser.add_argument("-h", "--help", action="store_true")
    parser.add_argument("--algo", nargs="?", const="")
    parser.add_argument("--env", nargs="?", const="")
    given = parser.parse_known_args(arguments)[0]
    if given.help:
        return arguments
    if given.env is None:
        _fail(f"{PROGRAM} {script}", f"--env is needed, the id of an environment: {PROGRAM} {script} --env Pendulum-v1")
    return ["--algo", ALGORITHM, *arguments] if given.algo is None else arguments


def _usage() -> str:
    width = max(map(len, SCRIPTS))
    return "\n".join(
        [
            f"usage: {PROGRAM} [--traceback] SCRIPT ...",
            "",
            "RL Zoo's scripts, with --algo causalgdp beside RL Zoo's own algorithms, and pages about them. SCRIPT is one of:",
            *(f"  {name:<{width}}  {what}" for name, what in SCRIPTS.items()),
            "",
            f"{PROGRAM} SCRIPT --help lists the arguments of a script; --traceback shows where an error comes from.",
            f"{TRUST_OPTION}, behind SCRIPT, lets the files of runs bring code, as your own may.",
        ]
    )


def _prepare(script: str, arguments: Sequence[str], trusted: bool) -> None:
    register(script in PLAYING, trusted)
    register_environments()
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--env", default="")
    wanted = parser.parse_known_args(arguments)[0].env
    if wanted and wanted not in gym.registry and importlib.util.find_spec("gymnasium_robotics"):
        # Only when it may be needed: the import takes time, and prints a warning
        gym.register_envs(importlib.import_module("gymnasium_robotics"))


def _run(script: str, arguments: Sequence[str]) -> None:
    if script in OWN:
        getattr(importlib.import_module(f"sb3_causalgdp.zoo.{script}"), script)(arguments)
    elif script in PLOTS:
        getattr(importlib.import_module("rl_zoo3.plots"), script)()
    else:
        runpy.run_module(f"rl_zoo3.{script}", run_name="__main__")


def _is_about_usage(error: Exception) -> bool:
    """Whether the message says it all: what RL Zoo itself complains about, what is not installed, what is not on the hub."""
    if isinstance(error, SetupError | FileError | TrainingDivergedError | ImportError | gym.error.Error):
        return True
    frames = _frames(error)
    if any(name in Path(frame.filename).parts for frame in frames for name in HUB_PACKAGES):
        return True
    # RL Zoo evaluates what the command line gives it
    return frames[-1].filename == "<string>" or "rl_zoo3" in Path(frames[-1].filename).parts


def _frames(error: BaseException) -> list[traceback.FrameSummary]:
    """Where it was raised, and before that, where what caused it was."""
    causes = [] if error.__cause__ is None else _frames(error.__cause__)
    return [*causes, *traceback.extract_tb(error.__traceback__)]


def _one_line(error: Exception, arguments: Sequence[str]) -> str:
    text = " ".join(str(error).split()).replace("pass trusted=True", f"add {TRUST_OPTION}")
    if not text or isinstance(error, KeyError | NameError | SyntaxError):
        text = f"{type(error).__name__}: {text}"
    if isinstance(error, ModuleNotFoundError) and error.name not in arguments:
        text += f": {ZOO_HINT}"
    if any(frame.line == "arg_dict[key] = eval(value)" for frame in _frames(error)):
        text += """: values are Python, as in -params eta:0.5 "guidance:'score'" """.rstrip()
    return text


def _fail(program: str, message: str) -> NoReturn:
    print(f"{program}: error: {message}", file=sys.stderr)
    sys.exit(2)
