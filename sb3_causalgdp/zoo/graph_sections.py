"""What stands on a page about the causal graph and its history."""

from collections.abc import Sequence

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.causal import CausalGraph
from sb3_causalgdp.causal.edges import GraphDiff
from sb3_causalgdp.causal.plots import plot_causal_graph, plot_history
from sb3_causalgdp.causal.relevance import ASSUMPTION
from sb3_causalgdp.zoo.parts import Picture, Section, Table, Text, make_picture, moment_of, strength
from sb3_causalgdp.zoo.run_folder import RunFolder

MOST_EDGES = 20
MOST_CHANGES = 12  # that are shown at once


def graph_section(model: CausalGDP) -> Section:
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
    rows = [(edge.cause, edge.effect, f"{edge.mask:.2f}", strength(edge.strength, edge.standard_error)) for edge in edges]
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
            f"{len(graphs)} graphs, from {source}. Below the picture: what changed from {moment_of(first)} to "
            f"{moment_of(last)}.",
            *run.problems_with(".zip"),
        ],
        [make_picture(plot_history(graphs), caption)],
        [graph_changes(last.diff(first))],
    )


def history_of_model(run: RunFolder, model: CausalGDP) -> Section:
    return history_section(run, *known_graphs(run, model._causal_graph))


def graph_changes(changes: GraphDiff) -> Text:
    """
    :param changes: From one graph to a later one
    :return: Them, folded where they are many
    """
    counts = [f"{len(edges)} {name}" for name, edges in changes._asdict().items() if edges]
    return Text(str(changes), f"Edges: {', '.join(counts)}" if sum(map(len, changes)) > MOST_CHANGES else "")
