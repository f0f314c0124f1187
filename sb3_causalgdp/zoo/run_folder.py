"""What RL Zoo left in the folder of a run."""

import json
import re
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from stable_baselines3.common.monitor import get_monitor_files
from stable_baselines3.common.save_util import json_to_data

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.causal import CausalGraph
from sb3_causalgdp.saving.archives import checked_entries, errors_of, one_line, opened, read_arrays, size_of
from sb3_causalgdp.saving.models import LARGE, is_pickled, read_plain
from sb3_causalgdp.saving.plain import read_json
from sb3_causalgdp.zoo.settings import read_settings

# RL Zoo's name of a run: the environment, a number, and with --uuid the identifier
RUN_NAME = re.compile(r"(?P<environment>.+)_(?P<number>\d+)(_[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12})?")
CHECKPOINT_NAME = re.compile(r"rl_model_(\d+)_steps\.zip")


@dataclass(frozen=True)
class Episodes:
    """
    :param steps: Environment steps at the end of each training episode, of all environments together
    :param returns: Its return, in the environment's own rewards
    :param seconds: Wall time since the start of the training
    """

    steps: np.ndarray
    returns: np.ndarray
    seconds: np.ndarray


@dataclass(frozen=True)
class Evaluations:
    """
    :param steps: When it was evaluated, shape ``(m,)``
    :param returns: Of each episode, shape ``(m, n_episodes)``
    :param success_rates: Of each evaluation, shape ``(m,)``; None where the environment does not tell success
    """

    steps: np.ndarray
    returns: np.ndarray
    success_rates: np.ndarray | None = None


class RunFolder:
    """
    The folder of a run, such as ``logs/causalgdp/Pendulum-v1_1``. Its files are read when they are asked for; those that are
    empty, cut off or damaged, or that need to be trusted and are not, count as missing, and ``problems`` says so.

    Nothing that they bring is run, unless they are trusted.

    :param path: The folder
    :param trusted: Whether its files may bring Python objects that could run code
    """

    def __init__(self, path: Path, trusted: bool = False) -> None:
        self.path = path
        self.trusted = trusted
        self.problems: dict[str, str] = {}
        """What is wrong with files, by their names."""
        found = sorted(path.glob("*/config.yml")) or sorted(path.glob("*/args.yml"))
        self.settings_path = found[0].parent if found else None
        self.arguments: Mapping[str, Any] = self._settings("args.yml") or {}
        self.entry: Mapping[str, Any] | None = self._settings("config.yml")

    def _settings(self, name: str) -> Mapping[str, Any] | None:
        path = None if self.settings_path is None else self.settings_path / name
        if path is None or not path.is_file():
            return None
        try:
            settings = read_settings(path, self.trusted)
        except Exception as error:  # of the parser, or of what the file asks to be made
            self.note(name, error)
            return None
        if not isinstance(settings, Mapping):
            self.problems[name] = f"{name} is empty or damaged: it holds no settings"
            return None
        return settings

    def _text(self, name: str) -> str | None:
        path = None if self.settings_path is None else self.settings_path / name
        return path.read_text(encoding="utf-8", errors="replace") if path is not None and path.is_file() else None

    def note(self, name: str, error: Exception) -> None:
        """
        :param name: A file of the run
        :param error: What its reader raised
        """
        self.problems[name] = f"{name} is left out, because it is empty, cut off, damaged or not trusted: {one_line(error)}"

    def problems_with(self, *endings: str) -> list[str]:
        """
        :param endings: How the names of files end
        :return: What is wrong with these
        """
        return [problem for name, problem in self.problems.items() if name.endswith(endings)]

    @property
    def environment_id(self) -> str | None:
        """Gymnasium's id of the environment, None if the run does not say."""
        environment = self.arguments.get("env")
        return None if environment is None else str(environment)

    @property
    def command(self) -> str | None:
        """The command of the training."""
        return self._text("command.txt")

    @property
    def versions(self) -> Mapping[str, Any]:
        """What was installed when the training started, empty if the run does not say."""
        return self._settings("versions.yml") or {}

    # Models ---------------------------------------------------------------------------------------------------------------

    def models(self) -> dict[str, Path]:
        """
        :return: Saved models by what they are: ``final``, ``best``, and the ``checkpoint`` of the most steps
        """
        final = [] if self.settings_path is None else [self.path / f"{self.settings_path.name}.zip"]
        checkpoints = [path for _, path in self.checkpoints()]
        candidates = {"final": final, "best": [self.path / "best_model.zip"], "checkpoint": checkpoints[-1:]}
        return {name: paths[0] for name, paths in candidates.items() if paths and paths[0].is_file()}

    def checkpoints(self) -> list[tuple[int, Path]]:
        """
        :return: Steps and file of each checkpoint, in their order
        """
        matches = [(CHECKPOINT_NAME.fullmatch(path.name), path) for path in self.path.glob("rl_model_*_steps.zip")]
        return sorted((int(match[1]), path) for match, path in matches if match is not None)

    def graph_history(self) -> list[CausalGraph]:
        """
        :return: The causal graphs that the model at the end of the training holds, oldest first; empty without that model
        """
        final = self.models().get("final")
        return [] if final is None else self._attributes(final).get("causal_graph_history", [])

    def checkpoint_graphs(self) -> list[CausalGraph]:
        """
        :return: The causal graphs of the checkpoints, oldest first, each of them once
        """
        graphs: dict[int, CausalGraph] = {}
        for _, path in self.checkpoints():
            graph = self._graph(path)
            if graph is not None and graph.num_timesteps is not None:
                graphs[graph.num_timesteps] = graph
        return [graphs[steps] for steps in sorted(graphs)]

    def newest_graph(self) -> CausalGraph | None:
        """
        :return: Of the causal graphs of all models, the one of the most steps; None if they have none
        """
        graphs = [graph for path in self.models().values() if (graph := self._graph(path)) is not None]
        return max(graphs, key=lambda graph: graph.num_timesteps or 0, default=None)

    def _graph(self, path: Path) -> CausalGraph | None:
        try:
            facts = path.stat()
            return _saved_graph(path, facts.st_mtime_ns, facts.st_size, self.trusted)
        except Exception as error:  # a damaged file can raise anything
            self.note(path.name, error)
            return None

    # Progress -------------------------------------------------------------------------------------------------------------

    @property
    def wanted_steps(self) -> int | None:
        """Environment steps that the training is to take, None if the run does not say."""
        for settings in (self.arguments, self.entry or {}):
            with suppress(TypeError, ValueError, OverflowError):
                steps = int(float(settings.get("n_timesteps", -1)))
                if steps > 0:
                    return steps
        return None

    @property
    def is_complete(self) -> bool:
        """Whether the model of the end of the training is there."""
        return "final" in self.models()

    @property
    def changed_at(self) -> float:
        """When one of its files was written last, in seconds since the epoch."""
        return max(_changes_of(self.path), default=0.0)

    def _attributes(self, path: Path) -> dict[str, Any]:
        try:
            return saved_attributes(path, self.trusted)
        except Exception as error:  # a damaged file can raise anything
            self.note(path.name, error)
            return {}

    # Curves ---------------------------------------------------------------------------------------------------------------

    def training_episodes(self) -> Episodes | None:
        """
        :return: The episodes of the training, None if none ended
        """
        parts = list(self._monitored())
        if not parts:
            return None
        episodes = pd.concat(parts).sort_values("t")
        seconds = episodes["t"].to_numpy() - min(part.attrs["t_start"] for part in parts)
        return Episodes(episodes["l"].cumsum().to_numpy(), episodes["r"].to_numpy(), seconds)

    def _monitored(self) -> Iterator[pd.DataFrame]:
        """What each monitor file that can be read holds, with the clock's time of each episode, as SB3's ``load_results``."""
        for name in get_monitor_files(str(self.path)):
            path = Path(name)
            try:
                with path.open(encoding="utf-8") as file:
                    started = float(json.loads(file.readline().removeprefix("#"))["t_start"])
                    given = pd.read_csv(file, usecols=["r", "l", "t"])
            except Exception as error:  # a damaged file can raise anything
                self.note(path.name, error)
                continue
            episodes = given.apply(pd.to_numeric, errors="coerce").replace([np.inf, -np.inf], np.nan).dropna()
            if len(episodes) < len(given):
                n_bad = len(given) - len(episodes)
                self.problems[path.name] = f"{path.name} is cut off or damaged: {n_bad} of {len(given)} rows are left out"
            if len(episodes) > 0:
                episodes["t"] += started
                episodes.attrs["t_start"] = started
                yield episodes

    def evaluations(self, folder: str = ".") -> Evaluations | None:
        """
        :param folder: Below the run's: ``offline`` has those of the offline stage, numbered by gradient steps
        :return: The evaluations, None if there are none
        """
        path = self.path / folder / "evaluations.npz"
        if not path.is_file():
            return None
        try:
            arrays = read_arrays(path, ("timesteps", "results", "successes"))
            steps, returns = np.asarray(arrays["timesteps"], float), np.asarray(arrays["results"], float)
            if not (steps.ndim == 1 and returns.ndim == 2 and len(steps) == len(returns) and returns.size > 0):
                raise ValueError(f"evaluations of shapes {steps.shape} and {returns.shape}")
            successes = np.asarray(arrays["successes"], float) if "successes" in arrays else None
            if successes is not None and (successes.ndim != 2 or len(successes) != len(steps) or successes.size == 0):
                raise ValueError(f"evaluations of shapes {steps.shape}, and successes of {successes.shape}")
            rates = None if successes is None else successes.mean(axis=1)
            return Evaluations(steps.astype(np.int64), returns, rates)
        except Exception as error:  # a damaged file can raise anything
            self.note(path.relative_to(self.path).as_posix(), error)
            return None


def saved_attributes(path: Path, trusted: bool = False) -> dict[str, Any]:
    """
    :param path: A saved model
    :param trusted: Whether it may bring Python objects that could run code
    :return: The attributes of the model, without its networks; of those that need a pickle, their type as text
    :raises ValueError: If the file cannot be read
    """
    with errors_of(path), opened(path) as file, zipfile.ZipFile(file) as archive:
        checked_entries(archive, size_of(file))
        saved = read_json(archive.read("data"))
        if trusted:
            return {**json_to_data(json.dumps(saved)), **read_plain(archive, CausalGDP._known_classes())}
        left_out = {name: value[":type:"] for name, value in saved.items() if is_pickled(value) and name not in LARGE}
        known = {name: value for name, value in saved.items() if not is_pickled(value)}
        return {**known, **left_out, **read_plain(archive, CausalGDP._known_classes())}


@lru_cache(maxsize=1_000)
def _saved_graph(path: Path, written_at: int, size: int, trusted: bool) -> CausalGraph | None:
    """The causal graph of a model; a file that was written at the same time and has the same size is the same."""
    graph = saved_attributes(path, trusted).get("_causal_graph")
    return graph if isinstance(graph, CausalGraph) else None


def saved_versions(path: Path) -> dict[str, str]:
    """
    :param path: A saved model
    :return: What SB3 says of the system on which it was saved
    """
    with errors_of(path), opened(path) as file, zipfile.ZipFile(file) as archive:
        checked_entries(archive, size_of(file))
        lines = archive.read("system_info.txt").decode().splitlines() if "system_info.txt" in archive.namelist() else []
    pairs = (line.removeprefix("- ").partition(": ") for line in lines)
    return {name: value for name, separator, value in pairs if separator}


def find_runs(folder: Path, trusted: bool = False) -> list[RunFolder]:
    """
    :param folder: The folder of a run, or of an algorithm, which holds those of runs
    :param trusted: Whether their files may bring Python objects that could run code
    :return: The run; or of each environment the run with the largest number, of those that have a model if there are any.
        Empty if there is none
    """
    if _is_run(folder):
        return [RunFolder(folder, trusted)]
    latest: dict[str, tuple[bool, int, float, Path]] = {}
    for path in folder.iterdir() if folder.is_dir() else ():
        name = RUN_NAME.fullmatch(path.name)
        if name is not None and _is_run(path):
            has_model = next(path.glob("*.zip"), None) is not None
            candidate = (has_model, int(name["number"]), path.stat().st_mtime, path)
            latest[name["environment"]] = max(candidate, latest.get(name["environment"], candidate))
    return [RunFolder(path, trusted) for _, (*_, path) in sorted(latest.items())]


def run_folders(folder: Path) -> list[Path]:
    """
    :param folder: The folder of a run, of an algorithm, or of several algorithms
    :return: The folders of all runs in it, that which changed last first
    """
    if _is_run(folder):
        return [folder]
    below = _folders_in(folder)
    found = [path for path in [*below, *(path for one in below for path in _folders_in(one))] if _is_run(path)]
    return sorted(found, key=lambda path: (max(_changes_of(path), default=0.0), path.name), reverse=True)


def _folders_in(folder: Path) -> list[Path]:
    try:
        return sorted(path for path in folder.iterdir() if path.is_dir())
    except OSError:
        return []


def _changes_of(folder: Path) -> Iterator[float]:
    """When each file of a run was written; one that is replaced meanwhile counts with the next look."""
    for path in [*folder.glob("*"), *folder.glob("offline/*")]:
        with suppress(OSError):
            if path.is_file():
                yield path.stat().st_mtime


def _is_run(folder: Path) -> bool:
    patterns = ("*/config.yml", "*/args.yml", "best_model.zip", "rl_model_*_steps.zip", "evaluations.npz", "*.monitor.csv")
    return folder.is_dir() and any(next(folder.glob(pattern), None) is not None for pattern in patterns)
