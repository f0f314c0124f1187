"""What an edge is, and which ones are the strongest."""

from typing import Any, NamedTuple

import numpy as np

EDGE_PROBABILITY = 0.5
"""A mask above it is an edge: more likely there than not."""
SAME = 1e-9  # effects that differ by less are equally strong


class Edge(NamedTuple):
    """One edge: names of cause and effect, mask in [0, 1], signed strength and its standard error (NaN: not known)."""

    cause: str
    effect: str
    mask: float
    strength: float
    standard_error: float

    def __str__(self) -> str:
        error = "" if np.isnan(self.standard_error) else f" +- {self.standard_error:.2g}"
        return f"{self.cause} -> {self.effect}: mask {self.mask:.2f}, strength {self.strength:+.2f}{error}"


class GraphDiff(NamedTuple):
    """
    What changed from an earlier graph to a later one. Edges are as in the later graph, closed ones as in the earlier.

    :param opened: Edges that were closed
    :param closed: Edges that were open and are not any more
    :param strengthened: Open in both, with a larger effect
    :param weakened: Open in both, with a smaller effect
    :param flipped: Open in both, with an effect of the other sign
    """

    opened: list[Edge]
    closed: list[Edge]
    strengthened: list[Edge]
    weakened: list[Edge]
    flipped: list[Edge]

    def __str__(self) -> str:
        lines = []
        for name, edges in self._asdict().items():
            if edges:
                lines += [f"{name} ({len(edges)}):", *(f"  {edge}" for edge in edges)]
        return "\n".join(lines) or "no edge changed"


def certain_sizes(effects: np.ndarray, standard_errors: np.ndarray | None) -> np.ndarray:
    """
    :param effects: Signed effects
    :param standard_errors: Of the same shape; None where they are not known
    :return: how large each effect is at least: two standard errors nearer to zero
    """
    sizes = np.abs(effects)
    return sizes if standard_errors is None else np.maximum(sizes - 2.0 * standard_errors, 0.0)


def strongest_in_rows(graph: Any, per_row: int, last_row: int | None = None) -> list[list[int]]:
    """
    :param graph: A causal graph
    :param per_row: Number of causes of each next state, at least 1; those that tie with the last one are in, too
    :param last_row: The same for the reward; None for as many
    :return: for each effect the columns of its edges, those first that are strong at least, see :func:`certain_sizes`; of
        an effect without an edge the candidate with the largest product of mask and absolute effect
    :raises ValueError: when a number is below 1
    """
    numbers = [per_row] * (len(graph.masks) - 1) + [per_row if last_row is None else last_row]
    if min(numbers) < 1:
        raise ValueError(f"causes must be at least 1, got {min(numbers)!r}")
    certain = certain_sizes(graph.effects, graph.standard_errors)
    return [_strongest(*rows) for rows in zip(graph.masks, np.abs(graph.effects), certain, numbers, strict=True)]


def _strongest(masks: np.ndarray, sizes: np.ndarray, certain: np.ndarray, number: int) -> list[int]:
    edges = np.flatnonzero(masks > EDGE_PROBABILITY)
    if len(edges) == 0:
        expected = masks * sizes
        edges = np.flatnonzero((expected > 0) & (expected >= expected.max() - SAME))
    order = edges[np.lexsort((-masks[edges], -sizes[edges], -certain[edges]))]
    if len(order) > number:
        last = order[number - 1]
        ties = np.all([np.abs(values[order] - values[last]) <= SAME for values in (masks, sizes, certain)], axis=0)
        order = order[: max(number, int(np.flatnonzero(ties)[-1]) + 1)]
    return order.tolist()
