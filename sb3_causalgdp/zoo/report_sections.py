"""What stands on the page about a run."""

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.callbacks.diagnostics import step_divergences
from sb3_causalgdp.callbacks.pictures import draw_transitions, plot_guidance_strength, policy_input
from sb3_causalgdp.causal import CausalGraph
from sb3_causalgdp.causal.description import count_of_edges
from sb3_causalgdp.causal.edges import GraphDiff
from sb3_causalgdp.causal.plots import plot_causal_graph, plot_history
from sb3_causalgdp.causal.relevance import ASSUMPTION
from sb3_causalgdp.offline.saved_buffers import read_buffer
from sb3_causalgdp.saving.archives import existing
from sb3_causalgdp.sources.buffers import SUFFIXES
from sb3_causalgdp.zoo.hyperparameters import constructor_arguments
from sb3_causalgdp.zoo.run_folder import Evaluations, RunFolder, saved_attributes, saved_versions
from sb3_causalgdp.zoo.versions import installed_versions

OBSERVATIONS = 2_000  # on which the effects of the actions are averaged
GUIDANCE_OBSERVATIONS = 256
MOST_EDGES = 20
MOST_CHANGES = 12  # that are shown at once
DPI = 144
NO_TRANSITIONS = (
    "Not computed: there are no observations. Train with --save-replay-buffer, or let the model play (--episodes)."
)
TRAINING_COLOUR, EVALUATION_COLOUR = "#8c8c8c", "#b2182b"

Observations = np.ndarray | dict[str, np.ndarray]


@dataclass(frozen=True)
class Picture:
    """A picture in base64, ``width`` CSS pixels wide."""

    caption: str
    data: str
    width: int
    format: str = "png"


@dataclass(frozen=True)
class Table:
    """Rows of text; a folded one opens with a click on its title."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    folded: bool = False


@dataclass(frozen=True)
class Text:
    """Preformatted lines; those with a title are folded, and open with a click on it."""

    lines: str
    title: str = ""


@dataclass(frozen=True)
class Section:
    """A part of the page: remarks, then pictures, preformatted texts and tables."""

    title: str
    remarks: Sequence[str] = ()
    pictures: Sequence[Picture] = ()
    texts: Sequence[Text] = ()
    tables: Sequence[Table] = ()

    @property
    def id(self) -> str:
        """Where links to the section lead."""
        return self.title.lower().replace(" ", "-")


@dataclass
class Played:
    """
    What the deterministic policy did.

    :param returns: Of each episode, in the environment's own rewards
    :param lengths: Of each episode, in steps
    :param observations: As the environment gives them, a batch of one for each step
    :param actions: What the policy did in them, the same
    """

    returns: list[float] = field(default_factory=list)
    lengths: list[int] = field(default_factory=list)
    observations: list[Observations] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)


@dataclass(frozen=True)
class Transitions:
    """
    On what effects and guidance are computed.

    :param observations: As the environment gives them, evenly chosen
    :param actions: The action of each
    :param source: Where they are from
    """

    observations: Observations
    actions: np.ndarray
    source: str


def make_sections(
    run: RunFolder, model: CausalGDP, kind: str, model_path: Path, played: Played, problem: str | None
) -> list[Section]:
    """
    :param run: The run
    :param model: The model that the page shows
    :param kind: Which of the run's models it is, see :meth:`RunFolder.models`
    :param model_path: Its file
    :param played: What it did in the environment
    :param problem: Why there is no environment, None if there is one
    :return: The sections of the page
    """
    transitions = _transitions(run, model, played)
    return [
        guarded("Summary", _summary_section, run, model, kind, model_path),
        guarded("Learning curve", learning_section, run),
        guarded("Causal graph", _graph_section, model),
        guarded("History of the graph", _history_section, run, model),
        guarded("Effects of the actions", effects_section, run, model, transitions),
        guarded("Guidance along the denoising chain", guidance_section, run, model, transitions),
        guarded("Evaluation", _evaluation_section, played, problem),
        guarded("Hyperparameters", _hyperparameter_section, run, model_path),
        guarded("Versions", _version_section, run, model_path),
        guarded("Command", _command_section, run),
    ]


def guarded(title: str, make: Callable[..., Section], *args: Any) -> Section:
    """
    :param title: Of the section
    :param make: What makes it
    :param args: Of that
    :return: The section, or why there is none: one that fails must not take the others with it
    """
    try:
        return make(*args)
    except Exception as error:
        return Section(title, [f"Cannot be shown: {type(error).__name__}: {error}"])


def _transitions(run: RunFolder, model: CausalGDP, played: Played) -> Transitions | None:
    path = existing(run.path / "replay_buffer", SUFFIXES)
    try:
        buffer = read_buffer(path, run.trusted) if path.is_file() else None
        if buffer is not None and buffer.size() > 0:
            observations, actions = draw_transitions(buffer, model.policy, OBSERVATIONS)
            return Transitions(observations, actions, f"{len(actions):,} transitions drawn from {path.name}")
    except Exception as error:  # a damaged file can raise anything
        run.note(path.name, error)
    return transitions_played(played)


def transitions_played(played: Played) -> Transitions | None:
    """
    :param played: What the policy did
    :return: Some of it, None if it did nothing
    """
    if not played.actions:
        return None
    chosen = np.linspace(0, len(played.actions) - 1, min(OBSERVATIONS, len(played.actions))).astype(int)
    source = f"{len(chosen):,} steps of the episodes that the model played for this page"
    observations = _joined([played.observations[step] for step in chosen])
    return Transitions(observations, np.concatenate([played.actions[step] for step in chosen]), source)


def _joined(batches: Sequence[Any]) -> Observations:
    if isinstance(batches[0], dict):
        return {key: np.concatenate([batch[key] for batch in batches]) for key in batches[0]}
    return np.concatenate(batches)


# Sections -------------------------------------------------------------------------------------------------------------


def _summary_section(run: RunFolder, model: CausalGDP, kind: str, model_path: Path) -> Section:
    rows = [
        ("Environment", run.environment_id or "not recorded"),
        ("Model", f"{model_path.name} ({kind}), {model.num_timesteps:,} environment steps, {model._n_updates:,} updates"),
    ]
    if model.n_pretrain_steps > 0:
        data = model.offline_dataset or "preloaded data"
        rows.append(("Offline stage", f"{model.n_pretrain_steps:,} gradient steps on {data}"))
    episodes, evaluations = run.training_episodes(), run.evaluations()
    if episodes is not None:
        rows.append(("Training", f"{_episodes(len(episodes.returns))}, the last ended after {episodes.seconds[-1]:,.0f} s"))
    if evaluations is not None:
        means = evaluations.returns.mean(axis=1)
        best = int(means.argmax())
        rows += [("Last evaluation", _evaluation(evaluations, -1)), ("Best evaluation", _evaluation(evaluations, best))]
    if model._causal_graph is not None:
        graph = model.causal_graph()
        rows.append(("Causal graph", f"{count_of_edges(graph)}, from {graph.n_samples:,} transitions"))
    return Section("Summary", run.problems_with(".zip"), tables=[Table((), rows)])


def _evaluation(evaluations: Evaluations, index: int) -> str:
    text = f"{_spread(evaluations.returns[index])} at {evaluations.steps[index]:,} steps"
    rates = evaluations.success_rates
    return text if rates is None else f"{text}, success rate {rates[index]:.0%}"


def learning_section(run: RunFolder) -> Section:
    """
    :param run: A run
    :return: Its returns
    """
    remarks, pictures = [], []
    episodes, evaluations = run.training_episodes(), run.evaluations()
    if episodes is None:
        remarks.append("No training episode has ended, or the monitor files are missing.")
    if evaluations is None:
        remarks.append("The policy was not evaluated while it trained (--eval-freq).")
    offline = run.evaluations("offline")
    remarks += run.problems_with("monitor.csv", "evaluations.npz")
    if episodes is not None or evaluations is not None:
        figure = Figure(figsize=(8.0, 4.0), layout="constrained")
        axes = figure.add_subplot()
        if episodes is not None:
            _draw_training(axes, episodes.steps, episodes.returns)
        if evaluations is not None:
            _draw_evaluations(axes, evaluations)
        _finish_curve(axes, "environment steps")
        pictures.append(
            make_picture(figure, "Returns of the training episodes, with exploration noise, and of the evaluations.")
        )
    if offline is not None:
        figure = Figure(figsize=(8.0, 3.2), layout="constrained")
        axes = figure.add_subplot()
        _draw_evaluations(axes, offline)
        _finish_curve(axes, "gradient steps")
        pictures.append(make_picture(figure, "Evaluations of the offline stage, before the first step in the environment."))
    return Section("Learning curve", remarks, pictures)


def _draw_training(axes: Axes, steps: np.ndarray, returns: np.ndarray) -> None:
    axes.plot(steps, returns, ".", color=TRAINING_COLOUR, markersize=5, alpha=0.8, label="training episode")
    window = max(len(returns) // 20, 5)
    if len(returns) >= 2 * window:
        means = np.convolve(returns, np.full(window, 1 / window), mode="valid")
        axes.plot(steps[window - 1 :], means, color="black", linewidth=1.2, label=f"mean of {window} of them")


def _draw_evaluations(axes: Axes, evaluations: Evaluations) -> None:
    means, spreads = evaluations.returns.mean(axis=1), evaluations.returns.std(axis=1)
    n_episodes = evaluations.returns.shape[1]
    axes.plot(evaluations.steps, means, ".-", color=EVALUATION_COLOUR, label=f"evaluation, mean of {_episodes(n_episodes)}")
    if n_episodes > 1:
        label = "± one standard deviation of the episodes"
        band = (means - spreads, means + spreads)
        axes.fill_between(evaluations.steps, *band, color=EVALUATION_COLOUR, alpha=0.15, linewidth=0, label=label)
        # A band of one evaluation has no width
        axes.vlines(evaluations.steps, *band, color=EVALUATION_COLOUR, alpha=0.3)


def _finish_curve(axes: Axes, unit: str) -> None:
    axes.set_xlabel(unit)
    axes.set_ylabel("return")
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(color="0.9", linewidth=0.5)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9)


def _graph_section(model: CausalGDP) -> Section:
    title = "Causal graph"
    if model._causal_graph is None:
        return Section(title, ["None was found yet: the training was shorter than causal_refresh_freq, or had too few data."])
    graph, gate = model.causal_graph(), model.relevance_gate
    remarks = graph_remarks(graph)
    if gate is not None:
        hidden = [name for name, shown in zip(gate.names, (*gate.states, *gate.actions), strict=True) if not shown]
        remarks.append(f"Hidden from actor and critics: {', '.join(hidden) or 'nothing'}.")
    return Section(title, remarks, graph_pictures(graph), tables=[edge_table(graph), _relevance_table(graph, model)])


def graph_remarks(graph: CausalGraph) -> list[str]:
    """
    :param graph: A causal graph
    :return: What limits it, in sentences
    """
    when = "" if graph.num_timesteps is None else f" after {graph.num_timesteps:,} environment steps"
    remarks = [
        f"Found{when} by {graph.method} from {graph.n_samples:,} transitions. A mask is the probability of an edge, a "
        "strength the change of the effect, in its standard deviations, for a change of the cause by one of its own."
    ]
    if graph.constant_variables:
        remarks.append(f"Never moved, and have no edges: {', '.join(graph.constant_variables)}.")
    for group in graph.duplicated_variables:
        remarks.append(f"Are linear functions of each other, and share their masks: {', '.join(group)}.")
    return remarks + [f"{remark}." for remark in graph.remarks]


def graph_pictures(graph: CausalGraph) -> list[Picture]:
    """
    :param graph: A causal graph
    :return: Its effects, and its strongest edges
    """
    return [
        make_picture(plot_causal_graph(graph, kind="heat_map"), "Effects, in standard deviations: a column causes a row."),
        make_picture(
            plot_causal_graph(graph, kind="graph"), "The strongest causes of each effect: from now, on the left, on."
        ),
    ]


def edge_table(graph: CausalGraph, folded: bool = True) -> Table:
    """
    :param graph: A causal graph
    :param folded: Whether a click opens it
    :return: Its strongest edges
    """
    edges = sorted(graph.edges(), key=lambda edge: -abs(edge.strength))
    rows = [(edge.cause, edge.effect, f"{edge.mask:.2f}", _strength(edge.strength, edge.standard_error)) for edge in edges]
    title = f"The {min(MOST_EDGES, len(rows))} strongest of {len(rows)} edges"
    return Table(("cause", "effect", "mask", "strength"), rows[:MOST_EDGES], title, folded)


def _relevance_table(graph: CausalGraph, model: CausalGDP) -> Table:
    rows, gate = graph.relevance().rows(), model.relevance_gate
    is_open = {} if gate is None else dict(zip(gate.names, (*gate.states, *gate.actions), strict=True))
    return Table(
        ("variable", "relevance", "edges", "surest path", "for the policy"),
        [
            (name, f"{value:.2f}", str(length or "-"), path or "-", "shown" if is_open.get(name, True) else "hidden")
            for name, value, length, path in rows[:MOST_EDGES]
        ],
        f"What can matter for any future reward: {min(MOST_EDGES, len(rows))} of {len(rows)} variables. {ASSUMPTION}",
        folded=True,
    )


def known_graphs(run: RunFolder, newest: CausalGraph | None = None) -> tuple[list[CausalGraph], str]:
    """
    :param run: A run
    :param newest: A graph that may be newer than those of its files
    :return: The graphs of the training that are known, oldest first, and where they are from
    """
    graphs, source = run.graph_history(), "the model at the end of the training"
    if len(graphs) < 2:
        graphs, source = run.checkpoint_graphs(), "the checkpoints (--save-freq), each of which holds the graph of its time"
        if newest is not None and (not graphs or graphs[-1].num_timesteps != newest.num_timesteps):
            before = [graph for graph in graphs if (graph.num_timesteps or 0) < (newest.num_timesteps or 0)]
            graphs = [*before, newest]
    return graphs, source


def history_section(run: RunFolder, graphs: Sequence[CausalGraph], source: str) -> Section:
    """
    :param run: A run
    :param graphs: What :func:`known_graphs` gives
    :param source: The same
    :return: How the graph changed
    """
    title = "History of the graph"
    if len(graphs) < 2:
        known = "one graph is known" if graphs else "no graph is known"
        return Section(
            title,
            [
                f"There is none: {known}. The model at the end of a training holds them, and so do checkpoints.",
                *run.problems_with(".zip"),
            ],
        )
    first, last = graphs[0], graphs[-1]
    caption = "Masks over the training, with the signs of the effects; number of edges, and how much the masks changed."
    return Section(
        title,
        [
            f"{len(graphs)} graphs, from {source}. Below the picture: what changed from {_moment(first)} to {_moment(last)}.",
            *run.problems_with(".zip"),
        ],
        [make_picture(plot_history(graphs), caption)],
        [graph_changes(last.diff(first))],
    )


def _history_section(run: RunFolder, model: CausalGDP) -> Section:
    return history_section(run, *known_graphs(run, model._causal_graph))


def graph_changes(changes: GraphDiff) -> Text:
    """
    :param changes: From one graph to a later one
    :return: Them, folded where they are many
    """
    counts = [f"{len(edges)} {name}" for name, edges in changes._asdict().items() if edges]
    return Text(str(changes), f"Edges: {', '.join(counts)}" if sum(map(len, changes)) > MOST_CHANGES else "")


def effects_section(run: RunFolder, model: CausalGDP, transitions: Transitions | None) -> Section:
    """
    :param run: A run
    :param model: Its model
    :param transitions: On which it is computed
    :return: What the actions do
    """
    title = "Effects of the actions"
    problems = run.problems_with("replay_buffer.npz", "replay_buffer.pkl")
    if transitions is None:
        return Section(title, [NO_TRANSITIONS, *problems])
    try:
        effects = model.effect_of_actions(transitions.observations, transitions.actions)
    except (RuntimeError, ValueError) as error:
        return Section(title, [f"Not computed: {error}.", *problems])
    standardised = effects.standardised()
    rows = [
        (name, *(_strength(part.mean[i], part.standard_error[i]) for part in (standardised.reward, effects.reward)))
        for i, name in enumerate(effects.variables.action_names)
    ]
    header = ("action", "on the reward, standardised", "on the reward, per unit of the action")
    caption = "What the causal world model says that the actions do to the reward, and to the next state, one step ahead."
    return Section(
        title,
        [f"From {transitions.source}.", *problems],
        [make_picture(effects.plot(), caption)],
        tables=[Table(header, rows, "The numbers, ± one standard error", folded=True)],
    )


def guidance_section(run: RunFolder, model: CausalGDP, transitions: Transitions | None) -> Section:
    """
    :param run: A run
    :param model: Its model
    :param transitions: On which it is computed
    :return: How far the guidance moves the steps of the denoising chain
    """
    title = "Guidance along the denoising chain"
    problems = run.problems_with("replay_buffer.npz", "replay_buffer.pkl")
    if transitions is None:
        return Section(title, [NO_TRANSITIONS, *problems])
    if not model.policy.is_guided:
        off = model.policy.guidance_rule is None
        reason = "guidance is off" if off else "there is no causal graph, or guidance_scale is 0"
        return Section(title, [f"The policy is not guided: {reason}."])
    model.policy.set_training_mode(False)
    observations = policy_input(model, _some(transitions.observations, GUIDANCE_OBSERVATIONS))
    figure = plot_guidance_strength(step_divergences(model.policy, observations).cpu())
    caption = "How far the guidance moves each step of the chain; the sum over the steps is TensorBoard's guidance/kl."
    return Section(title, [f"From {transitions.source}.", *problems], [make_picture(figure, caption)])


def _evaluation_section(played: Played, problem: str | None) -> Section:
    title = "Evaluation"
    if not played.returns:
        # A sentence of an exception may end by itself
        problem = None if problem is None else problem.rstrip(".")
        return Section(title, [f"Not played: {problem}." if problem else "Not played: --episodes is 0."])
    numbers = range(1, len(played.returns) + 1)
    episodes = zip(numbers, played.returns, played.lengths, strict=True)
    rows = [(str(number), f"{value:.2f}", str(length)) for number, value, length in episodes]
    spread = _spread(np.array(played.returns))
    remark = f"Deterministic policy, {_episodes(len(rows))}: return {spread} (mean ± standard deviation)."
    return Section(title, [remark], tables=[Table(("episode", "return", "steps"), rows)])


def _hyperparameter_section(run: RunFolder, model_path: Path) -> Section:
    title = "Hyperparameters"
    remarks, tables = run.problems_with("config.yml", "args.yml"), []
    rows: list[tuple[str, ...]]
    if run.entry is None:
        remarks.append("The run has no config.yml: what follows is read from the model.")
    else:
        rows = [(str(key), _text(value)) for key, value in sorted(run.entry.items(), key=str)]
        tables.append(Table(("config.yml", ""), rows, "The entry of the YAML file, with what the command line's -params set:"))
    saved = saved_attributes(model_path, run.trusted)
    rows = []
    for name, parameter in constructor_arguments().items():
        value = getattr(saved.get("policy_class"), "__name__", "") if name == "policy" else _text(saved.get(name))
        default = "" if parameter.default is parameter.empty else _text(parameter.default)
        rows.append((name, value, "" if value == default else default or "(required)"))
    tables.append(Table(("argument", "value", "default, where it differs"), rows, "All arguments of the model", folded=True))
    if run.arguments:
        rows = [
            (key, _text(value)) for key, value in sorted(run.arguments.items(), key=str) if value not in (None, "", [], False)
        ]
        tables.append(Table(("args.yml", ""), rows, "Arguments of the command line", folded=True))
    return Section(title, remarks, tables=tables)


def _version_section(run: RunFolder, model_path: Path) -> Section:
    then, now = {**saved_versions(model_path), **run.versions}, installed_versions()
    remarks = run.problems_with("versions.yml")
    rows = [(name, str(then.get(name, "not recorded")), now.get(name, "")) for name in {**then, **now}]
    return Section("Versions", remarks, tables=[Table(("", "where it was trained", "where this page was written"), rows)])


def _command_section(run: RunFolder) -> Section:
    if run.command is None:
        return Section("Command", ["Not recorded: the run has no command.txt."])
    return Section("Command", texts=[Text(run.command)])


# Text and pictures ------------------------------------------------------------------------------------------------------


def make_picture(figure: Figure, caption: str) -> Picture:
    """
    :param figure: A figure
    :param caption: What it shows
    :return: The figure as a picture of a page
    """
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=DPI)
    return Picture(caption, base64.b64encode(data.getvalue()).decode(), round(figure.get_figwidth() * 96))


def _spread(returns: np.ndarray) -> str:
    return f"{returns.mean():.1f}" if len(returns) == 1 else f"{returns.mean():.1f} ± {returns.std():.1f}"


def _episodes(n_episodes: int) -> str:
    return "1 episode" if n_episodes == 1 else f"{n_episodes:,} episodes"


def _strength(value: float, error: float) -> str:
    return f"{value:+.3g}" if np.isnan(error) else f"{value:+.3g} ± {error:.2g}"


def _text(value: Any) -> str:
    """A value without what differs from one run to the next, such as addresses."""
    if callable(value):
        return getattr(value, "__qualname__", None) or repr(value)
    return repr(value) if isinstance(value, str) else str(value)


def _moment(graph: CausalGraph) -> str:
    return "an unknown step" if graph.num_timesteps is None else f"step {graph.num_timesteps:,}"


def _some(observations: Observations, n_rows: int) -> Observations:
    """At most so many, evenly chosen."""

    def chosen(values: np.ndarray) -> np.ndarray:
        return values[np.linspace(0, len(values) - 1, min(n_rows, len(values))).astype(int)]

    if isinstance(observations, dict):
        return {key: chosen(values) for key, values in observations.items()}
    return chosen(observations)
