"""What some of RL Zoo's scripts need around them to work with an algorithm that is not theirs, and on today's libraries."""

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_causalgdp.offline.callbacks import note_success
from sb3_causalgdp.saving.archives import errors_of, read_pickle
from sb3_causalgdp.zoo.algorithm import ALGORITHM, ZOO_HINT
from sb3_causalgdp.zoo.replacing import replaced
from sb3_causalgdp.zoo.settings import safe_files, whole_files

MODULE = "sb3_causalgdp.zoo"
# On a card for people who may not have it yet: the folder of the source, and what the zoo needs
INSTALL_SOURCE = 'pip install "./sb3_causalgdp[zoo]"'


def own_command(command: Any) -> Any:
    """
    :param command: A command that one of RL Zoo's scripts starts
    :return: The same through our entry point, where the algorithm is known, and with this Python
    """
    if not isinstance(command, Sequence) or isinstance(command, str) or not command or command[0] != "python":
        return command
    if command[1] == "-m" and command[2].startswith("rl_zoo3."):
        return [sys.executable, "-m", MODULE, command[2].removeprefix("rl_zoo3."), *command[3:]]
    if command[1] == "enjoy.py":
        return [sys.executable, "-m", MODULE, "enjoy", *command[2:]]
    return command


@contextmanager
def own_commands() -> Iterator[None]:
    """The scripts that start other scripts start ours."""
    call = subprocess.call

    def call_ours(command: Any, *args: Any, **kwargs: Any) -> int:
        return call(own_command(command), *args, **kwargs)

    with replaced(subprocess, "call", call_ours):
        yield


@contextmanager
def ffmpeg_on_path() -> Iterator[None]:
    """
    :raises ImportError: If there is no ffmpeg, neither on the path nor in the package imageio_ffmpeg
    """
    if shutil.which("ffmpeg") is not None:
        yield
        return
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise ImportError(f"ffmpeg is needed, from your system or by {ZOO_HINT}") from error
    path = os.environ.get("PATH", "")
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "ffmpeg").symlink_to(imageio_ffmpeg.get_ffmpeg_exe())
        os.environ["PATH"] = os.pathsep.join([folder, path])
        try:
            yield
        finally:
            os.environ["PATH"] = path


@contextmanager
def own_model_card() -> Iterator[None]:
    """The model card names commands that work with this algorithm."""
    import huggingface_hub.repocard as repocard

    save = repocard.metadata_save

    def save_ours(local_path: Any, data: Any) -> None:
        card = Path(local_path)
        text = card.read_text(encoding="utf-8")
        if f"--algo {ALGORITHM} " in text:
            text = text.replace("python -m rl_zoo3.", f"python -m {MODULE} ").replace("pip install rl_zoo3", INSTALL_SOURCE)
            card.write_text(text, encoding="utf-8")
        save(local_path, data)

    with replaced(repocard, "metadata_save", save_ours):
        yield


@contextmanager
def model_card_metadata() -> Iterator[None]:
    """RL Zoo imports a function that newer versions of the hub's package call otherwise; the older gave a dictionary."""
    from huggingface_sb3 import push_to_hub as _  # noqa: F401 (the module behind the function of that name)

    module = sys.modules["huggingface_sb3.push_to_hub"]
    if hasattr(module, "generate_metadata"):
        yield
        return
    module.generate_metadata = lambda *args: module._generate_metadata(*args).to_dict()  # type: ignore[attr-defined]
    try:
        yield
    finally:
        del module.generate_metadata  # type: ignore[attr-defined]


@contextmanager
def optional_hub_files() -> Iterator[None]:
    """RL Zoo expects ``requests``' error for a file that a model does not have; newer versions of the hub raise another."""
    import huggingface_sb3
    from huggingface_hub.errors import EntryNotFoundError, LocalEntryNotFoundError
    from requests.exceptions import HTTPError

    load = huggingface_sb3.load_from_hub

    def load_or_say_so(repo_id: str, filename: str) -> str:
        try:
            return load(repo_id, filename)
        except LocalEntryNotFoundError:
            raise  # there is no connection
        except EntryNotFoundError as error:
            raise HTTPError(str(error)) from error

    with replaced(huggingface_sb3, "load_from_hub", load_or_say_so):
        yield


@contextmanager
def plain_results() -> Iterator[None]:
    """What ``all_plots`` wrote is read without running anything."""
    import rl_zoo3.plots.plot_from_file as _  # noqa: F401 (the module behind the function of that name)

    module = sys.modules["rl_zoo3.plots.plot_from_file"]

    def load(file: Any) -> Any:
        with errors_of(file.name, "cannot be read as results"):
            return read_pickle(file)

    with replaced(module, "pickle", SimpleNamespace(load=load)):
        yield


@contextmanager
def own_title() -> Iterator[None]:
    """RL Zoo's bars of the last evaluations are called "PyBullet envs", whatever the environments are."""
    import matplotlib.pyplot as plt

    title = plt.title

    def title_ours(label: str, *args: Any, **kwargs: Any) -> Any:
        return title("Last evaluations" if label == "PyBullet envs" else label, *args, **kwargs)

    with replaced(plt, "title", title_ours):
        yield


class SuccessVecEnv(VecEnvWrapper):
    """
    Environments that say ``is_success``, as SB3 does, where they say ``success``, and count the episodes that ended.

    :param venv: The environments
    """

    def __init__(self, venv: VecEnv) -> None:
        super().__init__(venv)
        self.n_ended = 0

    def reset(self) -> VecEnvObs:
        return self.venv.reset()

    def step_wait(self) -> VecEnvStepReturn:
        observations, rewards, dones, infos = self.venv.step_wait()
        for info in infos:
            note_success(info)
        self.n_ended += int(dones.sum())
        return observations, rewards, dones, infos


@contextmanager
def told_success() -> Iterator[None]:
    """``enjoy`` prints the success rate of more environments, and does not end without a word."""
    import rl_zoo3

    create, made = rl_zoo3.create_test_env, []

    def create_ours(*args: Any, **kwargs: Any) -> VecEnv:
        made.append(SuccessVecEnv(create(*args, **kwargs)))
        return made[-1]

    with replaced(rl_zoo3, "create_test_env", create_ours):
        yield
    if made and not any(environment.n_ended for environment in made):
        print("No episode has ended, so there is no return: play more steps, by -n")


SURROUNDINGS: dict[str, list[Callable[[], Any]]] = {
    "benchmark": [own_commands, optional_hub_files, safe_files],
    "enjoy": [optional_hub_files, safe_files, told_success],
    "load_from_hub": [optional_hub_files],
    "plot_from_file": [plain_results, own_title],
    "push_to_hub": [safe_files, model_card_metadata, own_model_card, ffmpeg_on_path],
    "record_video": [safe_files],
    "record_training": [own_commands, ffmpeg_on_path],
    "train": [safe_files, whole_files],
}
"""By script."""


OF_STRANGERS = (safe_files, plain_results)
"""What is left out where files are trusted."""


@contextmanager
def surroundings(script: str, trusted: bool = False) -> Iterator[None]:
    """
    :param script: Name of a script of RL Zoo, which runs inside
    :param trusted: Whether the files that it reads may run code
    """
    with ExitStack() as stack:
        for make in SURROUNDINGS.get(script, []):
            if not (trusted and make in OF_STRANGERS):
                stack.enter_context(make())
        yield
