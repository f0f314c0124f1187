"""What stands on the page about a run."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.callbacks.diagnostics import step_divergences
from sb3_causalgdp.callbacks.pictures import plot_guidance_strength, policy_input
from sb3_causalgdp.causal.description import count_of_edges
from sb3_causalgdp.zoo.graph_sections import graph_section, history_of_model
from sb3_causalgdp.zoo.hyperparameters import constructor_arguments
from sb3_causalgdp.zoo.parts import (
    Section,
    Table,
    Text,
    as_text,
    count_of_episodes,
    guarded,
    make_picture,
    mean_and_spread,
    strength,
)
from sb3_causalgdp.zoo.played import Played, Transitions, some_rows, transitions_of
from sb3_causalgdp.zoo.run_folder import Evaluations, RunFolder, saved_attributes, saved_versions
from sb3_causalgdp.zoo.versions import installed_versions

GUIDANCE_OBSERVATIONS = 256
NO_TRANSITIONS = (
    "Not computed: there are no observations. Train with --save-replay-buffer, or let the model play (--episodes)."
)
TRAINING_COLOUR, EVALUATION_COLOUR = "#8c8c8c", "#b2182b"


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
    transitions = transitions_of(run, model, played)
    return [
        guarded("Summary", _summary_section, run, model, kind, model_path),
        guarded("Learning curve", learning_section, run),
        guarded("Causal graph", graph_section, model),
        guarded("History of the graph", history_of_model, run, model),
        guarded("Effects of the actions", effects_section, run, model, transitions),
        guarded("Guidance along the denoising chain", guidance_section, run, model, transitions),
        guarded("Evaluation", _evaluation_section, played, problem),
        guarded("Hyperparameters", _hyperparameter_section, run, model_path),
        guarded("Versions", _version_section, run, model_path),
        guarded("Command", _command_section, run),
    ]


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
        rows.append(
            ("Training", f"{count_of_episodes(len(episodes.returns))}, the last ended after {episodes.seconds[-1]:,.0f} s")
        )
    if evaluations is not None:
        means = evaluations.returns.mean(axis=1)
        best = int(means.argmax())
        rows += [("Last evaluation", _evaluation(evaluations, -1)), ("Best evaluation", _evaluation(evaluations, best))]
    if model._causal_graph is not None:
        graph = model.causal_graph()
        rows.append(("Causal graph", f"{count_of_edges(graph)}, from {graph.n_samples:,} transitions"))
    return Section("Summary", run.problems_with(".zip"), tables=[Table((), rows)])


def _evaluation(evaluations: Evaluations, index: int) -> str:
    text = f"{mean_and_spread(evaluations.returns[index])} at {evaluations.steps[index]:,} steps"
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
    axes.plot(
        evaluations.steps, means, ".-", color=EVALUATION_COLOUR, label=f"evaluation, mean of {count_of_episodes(n_episodes)}"
    )
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
        (name, *(strength(part.mean[i], part.standard_error[i]) for part in (standardised.reward, effects.reward)))
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
    observations = policy_input(model, some_rows(transitions.observations, GUIDANCE_OBSERVATIONS))
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
    spread = mean_and_spread(np.array(played.returns))
    remark = f"Deterministic policy, {count_of_episodes(len(rows))}: return {spread} (mean ± standard deviation)."
    return Section(title, [remark], tables=[Table(("episode", "return", "steps"), rows)])


def _hyperparameter_section(run: RunFolder, model_path: Path) -> Section:
    title = "Hyperparameters"
    remarks, tables = run.problems_with("config.yml", "args.yml"), []
    rows: list[tuple[str, ...]]
    if run.entry is None:
        remarks.append("The run has no config.yml: what follows is read from the model.")
    else:
        rows = [(str(key), as_text(value)) for key, value in sorted(run.entry.items(), key=str)]
        tables.append(Table(("config.yml", ""), rows, "The entry of the YAML file, with what the command line's -params set:"))
    saved = saved_attributes(model_path, run.trusted)
    rows = []
    for name, parameter in constructor_arguments().items():
        value = getattr(saved.get("policy_class"), "__name__", "") if name == "policy" else as_text(saved.get(name))
        default = "" if parameter.default is parameter.empty else as_text(parameter.default)
        rows.append((name, value, "" if value == default else default or "(required)"))
    tables.append(Table(("argument", "value", "default, where it differs"), rows, "All arguments of the model", folded=True))
    if run.arguments:
        rows = [
            (key, as_text(value))
            for key, value in sorted(run.arguments.items(), key=str)
            if value not in (None, "", [], False)
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
