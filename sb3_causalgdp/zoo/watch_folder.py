"""What the page of a watched folder shows: what the files of its runs say by now, made anew only where they have changed."""

import threading
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sb3_causalgdp.causal import CausalGraph
from sb3_causalgdp.causal.description import count_of_edges
from sb3_causalgdp.zoo.graph_sections import (
    edge_table,
    graph_changes,
    graph_pictures,
    graph_remarks,
    history_section,
    known_graphs,
)
from sb3_causalgdp.zoo.pages import section_html
from sb3_causalgdp.zoo.parts import Section, Table, guarded
from sb3_causalgdp.zoo.report_sections import learning_section
from sb3_causalgdp.zoo.run_folder import RunFolder, run_folders
from sb3_causalgdp.zoo.watch_player import Player, Request

CURVES = ("*.monitor.csv", "evaluations.npz", "offline/evaluations.npz")
MODELS = ("*.zip",)
# Of the time of this process, the share that playing and drawing episodes may take
PLAYING_SHARE = 0.1
QUIET_SECONDS = 120.0
NO_GRAPH = "None is known yet. Checkpoints (--save-freq) and the model of the best evaluation (--eval-freq) hold them."

NO_MODEL = "There is no model yet. Checkpoints (--save-freq) and evaluations (--eval-freq) save them."
PLAYS = "The newest model is playing an episode ..."

Fingerprint = tuple[tuple[str, float, int], ...]


@dataclass(frozen=True)
class View:
    """
    What is to be seen.

    :param runs: Names of all runs, that which changed last first
    :param run: Name of the one that is shown, None if there is none
    :param moments: When its graphs were found, oldest first
    :param sections: HTML by the ids of sections
    """

    runs: tuple[str, ...] = ()
    run: str | None = None
    moments: tuple[str, ...] = ()
    sections: dict[str, str] = field(default_factory=dict)


@dataclass
class _Run:
    """What is known of a run, and of which files it was made."""

    graphs: list[CausalGraph] = field(default_factory=list)
    made_of: dict[str, Any] = field(default_factory=dict)
    html: dict[str, str] = field(default_factory=dict)
    drawn: dict[int, str] = field(default_factory=dict)
    playing: "Future[dict[str, str]] | None" = None
    may_play_at: float = 0.0


class WatchedFolder:
    """
    Runs below a folder, which need not be there yet. Several pages can look at it.

    :param folder: The folder of a run, of an algorithm, or of several algorithms
    :param trusted: Whether files of runs may bring code
    :param plays: Whether the newest model plays an episode
    :param seed: Of this episode
    :param player: Where it plays
    """

    def __init__(
        self, folder: Path, trusted: bool = False, plays: bool = True, seed: int = 0, player: Player | None = None
    ) -> None:
        self.folder = folder
        self.trusted = trusted
        self.plays = plays
        self.seed = seed
        self._player = player or Player()
        self._pool = ThreadPoolExecutor(1)
        self._lock = threading.Lock()
        self._runs: dict[Path, _Run] = {}

    def look(self, name: str | None = None, number: int | None = None) -> View:
        """
        :param name: Name of a run, None for the one that changed last
        :param number: Number of its graph, None for the newest
        :return: What is to be seen now
        """
        with self._lock:
            paths = {self._name(path): path for path in run_folders(self.folder)}
            if not paths:
                return View(sections={"summary": section_html(self._nothing())})
            name = name if name in paths else next(iter(paths))
            run = RunFolder(paths[name], self.trusted)
            known = self._runs.setdefault(run.path, _Run())
            self._read(run, known)
            waiting = self._play(run, known) if self.plays else {}
            summary = section_html(guarded("Summary", summary_section, run, known.graphs))
            graph = self._graph(known, number) if known.graphs else section_html(_no_graph(run))
            moments = tuple(_moment(graph) for graph in known.graphs)
            return View(tuple(paths), name, moments, {**waiting, **known.html, "summary": summary, "causal-graph": graph})

    def close(self) -> None:
        """
        Stop playing.
        """
        self._player.close()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _name(self, path: Path) -> str:
        return path.resolve().name if path == self.folder else path.relative_to(self.folder).as_posix()

    def _nothing(self) -> Section:
        where = f"There is no run in {self.folder.resolve()} yet: a training that writes there appears here by itself."
        return Section("Summary", [where])

    def _read(self, run: RunFolder, known: _Run) -> None:
        def make_curve() -> None:
            known.html["learning-curve"] = section_html(guarded("Learning curve", learning_section, run))

        def make_graphs() -> None:
            known.drawn.clear()
            known.graphs, source = known_graphs(run, run.newest_graph())
            history = guarded("History of the graph", history_section, run, known.graphs, source)
            known.html["history-of-the-graph"] = section_html(history)

        _when_changed(known, "curve", fingerprint(run.path, CURVES), make_curve)
        _when_changed(known, "graphs", fingerprint(run.path, MODELS), make_graphs)

    def _graph(self, known: _Run, number: int | None) -> str:
        last = len(known.graphs) - 1
        chosen = last if number is None else min(max(number, 0), last)
        if chosen not in known.drawn:
            known.drawn[chosen] = section_html(guarded("Causal graph", graph_section, known.graphs, chosen))
        return known.drawn[chosen]

    def _play(self, run: RunFolder, known: _Run) -> dict[str, str]:
        """Lets the newest model play where it is due; what that is to show until it has."""
        if known.playing is not None and known.playing.done():
            known.html.update(known.playing.result())
            known.playing = None
        if run.models() and known.playing is None and time.monotonic() >= known.may_play_at:

            def start() -> None:
                known.playing = self._pool.submit(self._played, Request(run.path, self.trusted, self.seed), known)

            _when_changed(known, "play", fingerprint(run.path, MODELS), start)
        return {"rollout": section_html(Section("Rollout", [PLAYS if run.models() else NO_MODEL]))}

    def _played(self, request: Request, known: _Run) -> dict[str, str]:
        start = time.monotonic()
        sections = self._player.play(request)
        now = time.monotonic()
        known.may_play_at = now + (now - start) * (1 / PLAYING_SHARE - 1)
        return sections


def _when_changed(known: _Run, part: str, now: Fingerprint, make: Callable[[], None]) -> None:
    if known.made_of.get(part) != now:
        known.made_of[part] = now
        make()


def fingerprint(folder: Path, patterns: Iterable[str]) -> Fingerprint:
    """
    :param folder: Of a run
    :param patterns: Of the names of files
    :return: What changes when one of them does
    """
    found = []
    for path in sorted(path for pattern in patterns for path in folder.glob(pattern)):
        try:
            facts = path.stat()
        except OSError:  # it is being replaced: the next look sees it
            continue
        found.append((path.name, facts.st_mtime, facts.st_size))
    return tuple(found)


# Sections ---------------------------------------------------------------------------------------------------------------


def summary_section(run: RunFolder, graphs: list[CausalGraph]) -> Section:
    """
    :param run: A run
    :param graphs: What is known of its graph, oldest first
    :return: Where the training is
    """
    rows = [("Environment", run.environment_id or "not recorded"), ("Training", _state(run))]
    done, wanted = _steps_done(run, graphs), run.wanted_steps
    if wanted is not None:
        rows.append(("Steps", f"{done:,} of {wanted:,} ({min(done / wanted, 1.0):.0%})"))
    elif done > 0:
        rows.append(("Steps", f"{done:,}"))
    if graphs:
        rows.append(("Causal graph", f"{count_of_edges(graphs[-1])}, {_moment(graphs[-1])}"))
    return Section("Summary", run.problems_with(".yml"), tables=[Table((), rows)])


def _state(run: RunFolder) -> str:
    if run.is_complete:
        return "finished"
    age = max(0.0, time.time() - run.changed_at)
    if age < QUIET_SECONDS:
        return "runs"
    return f"nothing was written for {age / 60:,.0f} minutes: it has stopped, or evaluations and checkpoints are rare"


def _steps_done(run: RunFolder, graphs: list[CausalGraph]) -> int:
    episodes, evaluations = run.training_episodes(), run.evaluations()
    return max(
        0 if episodes is None else int(episodes.steps[-1]),
        0 if evaluations is None else int(evaluations.steps[-1]),
        max((steps for steps, _ in run.checkpoints()), default=0),
        max((graph.num_timesteps or 0 for graph in graphs), default=0),
    )


def _no_graph(run: RunFolder) -> Section:
    return Section("Causal graph", [NO_GRAPH, *run.problems_with(".zip")])


def graph_section(graphs: list[CausalGraph], number: int) -> Section:
    """
    :param graphs: Graphs of a training, oldest first
    :param number: Which of them
    :return: It, and what has changed since the one before
    """
    graph = graphs[number]
    remarks = [f"Graph {number + 1} of {len(graphs)}: {count_of_edges(graph)}.", *graph_remarks(graph)]
    changes = [] if number == 0 else [graph_changes(graph.diff(graphs[number - 1]))]
    if changes:
        remarks.append(f"Below the pictures: what changed since the graph before, {_moment(graphs[number - 1])}.")
    return Section("Causal graph", remarks, graph_pictures(graph), changes, [edge_table(graph, folded=False)])


def _moment(graph: CausalGraph) -> str:
    return "at an unknown step" if graph.num_timesteps is None else f"after {graph.num_timesteps:,} steps"
