"""A causal graph in words: the strongest causes of the reward and of each next state, on a screen."""

from collections.abc import Iterator, Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np

from sb3_causalgdp.causal.edges import EDGE_PROBABILITY, certain_sizes, strongest_in_rows

MOST_LINES = 25
MOST_CHARACTERS = 127
CAUSES = 4
NOTHING = "nothing known"
NOT_DISCOVERED = "No discovery yet: every edge is open, and nothing is known of the effects"
STYLES = "text-align: left; padding: 2px 10px 2px 0"


def count_of_edges(graph: Any) -> str:
    """
    :param graph: A causal graph
    :return: how many edges it has, as everything in this package says it
    """
    if not graph.is_discovered:
        return f"no discovery yet, {graph.masks.size} possible edges"
    edges = "edge" if graph.n_edges == 1 else "edges"
    expected = f"{graph.expected_edges:.1f}".removesuffix(".0")
    return f"{graph.n_edges} {edges} with a probability above {EDGE_PROBABILITY:g} of {graph.masks.size}, {expected} expected"


def as_text(graph: Any) -> str:
    """
    :param graph: A causal graph
    :return: at most 25 lines
    """
    head, limits = [_title(graph), _counts(graph)], [_shortened(line) for line in _limits(graph)][:5]
    if not graph.is_discovered:
        return "\n".join([*head, *limits])
    rows = _rows(graph, MOST_LINES - len(head) - len(limits) - 2)
    width = min(max(len(row.effect) for row in rows), 30)
    lines = [f"  {row.effect:>{width}} <- {row.causes_within(MOST_CHARACTERS - width - 20)}{row.fit}" for row in rows]
    hidden = graph.variables.n_states + 1 - len(rows)
    if hidden > 0:
        lines.append(f"  and {hidden} more next states, which actions move less: graph.to_dataframe() has all")
    return "\n".join([*head, "effect in standard deviations for one of the cause, the strongest first:", *lines, *limits])


def as_html(graph: Any) -> str:
    """
    :param graph: A causal graph
    :return: the same as a table, for notebooks
    """
    parts = [f"<b>{escape(_title(graph))}</b><br>{escape(_counts(graph))}"]
    if graph.is_discovered:
        head = "".join(f'<th style="{STYLES}">{name}</th>' for name in ("effect", "its strongest causes", "R²"))
        cells = [(row.effect, ", ".join(row.causes) or NOTHING, row.fit.strip(" ()R²")) for row in _rows(graph, MOST_LINES)]
        rows = "".join(
            "<tr>" + "".join(f'<td style="{STYLES}">{escape(text)}</td>' for text in texts) + "</tr>" for texts in cells
        )
        parts.append(f"<table><tr>{head}</tr>{rows}</table>")
        hidden = graph.variables.n_states + 1 - MOST_LINES
        if hidden > 0:
            parts.append(f"and {hidden} more next states: <code>graph.to_dataframe()</code> has all<br>")
    return "<div>" + "".join(parts) + "<br>".join(map(escape, _limits(graph))) + "</div>"


def _title(graph: Any) -> str:
    if not graph.is_discovered:
        return NOT_DISCOVERED
    when = "" if graph.num_timesteps is None else f" after {graph.num_timesteps:,} steps"
    return f"Causal graph by {graph.method} from {graph.n_samples:,} transitions{when}"


def _counts(graph: Any) -> str:
    states, actions = graph.variables.n_states, graph.variables.n_actions
    return f"{states} state{'s'[: states != 1]}, {actions} action{'s'[: actions != 1]}; {count_of_edges(graph)}"


class _Row(NamedTuple):
    effect: str
    causes: list[str]
    fit: str

    def causes_within(self, n_characters: int) -> str:
        """As many causes as there is room for, one at least."""
        texts = self.causes or [NOTHING]
        while len(texts) > 1 and len(", ".join(texts)) > n_characters:
            texts = texts[:-1]
        return ", ".join(texts)


def _rows(graph: Any, most: int) -> list[_Row]:
    """The reward, and the next states that actions move most, in their order."""
    n_states = graph.variables.n_states
    sizes = np.where(graph.masks > EDGE_PROBABILITY, certain_sizes(graph.effects, graph.standard_errors), 0.0)[:n_states]
    np.fill_diagonal(sizes[:, :n_states], 0.0)
    by_actions, by_states = sizes[:, n_states:].max(axis=1), sizes[:, :n_states].max(axis=1)
    moved = np.sort(np.lexsort((-by_states, -by_actions))[: max(most - 1, 1)])
    chosen = strongest_in_rows(graph, CAUSES)
    return [_row(graph, row, chosen[row][: 2 * CAUSES]) for row in (n_states, *moved)]


def _row(graph: Any, row: int, columns: Sequence[int]) -> _Row:
    texts = []
    for edge in (graph._edge(row, column) for column in columns):
        error = "" if np.isnan(edge.standard_error) else f"±{edge.standard_error:.1g}"
        unsure = "" if edge.mask > EDGE_PROBABILITY else f" (probability {edge.mask:.2f})"
        texts.append(f"{edge.cause} {edge.strength:+.2f}{error}{unsure}")
    fit = "" if graph.r_squared is None else f"  (R² {graph.r_squared[row]:.2f})"
    return _Row((*graph.variables.next_state_names, "reward")[row], texts, fit)


def _limits(graph: Any) -> Iterator[str]:
    """What the graph does not say."""
    if graph.constant_variables:
        yield f"never moved, without edges: {', '.join(graph.constant_variables)}"
    if graph.duplicated_variables:
        yield f"linearly dependent, share their masks: {', '.join(' = '.join(one) for one in graph.duplicated_variables)}"
    yield from (f"remark: {remark}" for remark in graph.remarks)


def _shortened(line: str) -> str:
    return line if len(line) <= MOST_CHARACTERS else f"{line[: MOST_CHARACTERS - 4]} ..."
