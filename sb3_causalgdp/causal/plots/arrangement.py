"""Where the nodes of a layered graph stand: those that move each other close together, so that few arrows cross."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from sb3_causalgdp.causal.edges import Edge
from sb3_causalgdp.causal.variables import TransitionVariables

TIE = 1e-3  # pull between neighbours of the environment's order, which decides where no arrow does
OWN = 0.3  # pull between a state and its next value


def order_of_layers(variables: TransitionVariables, edges: Sequence[Edge]) -> tuple[list[str], list[str]]:
    """
    The order along the Fiedler vector of the arrows' Laplacian (M. Fiedler, 1973), which puts what belongs together side by
    side.

    :param variables: Names of the variables
    :param edges: The arrows that are drawn
    :return: names of states and actions, and names of next states, from above to below
    """
    left, right = (*variables.state_names, *variables.action_names), variables.next_state_names
    index = {name: i for i, name in enumerate((*left, *right))}
    pull = np.zeros((len(index), len(index)))
    for edge in edges:
        if edge.effect in index:
            pull[index[edge.cause], index[edge.effect]] += min(abs(edge.strength), 1.0) * edge.mask
    for name, later in zip(variables.state_names, right, strict=True):
        pull[index[name], index[later]] += OWN
    for layer in (left, right):
        for one, other in pairwise(layer):
            pull[index[one], index[other]] += TIE
    pull = pull + pull.T
    # Normalised, so that what has many arrows does not pull everything together
    degree = 1.0 / np.sqrt(pull.sum(axis=1))
    _, vectors = np.linalg.eigh(np.eye(len(pull)) - degree[:, None] * pull * degree)
    along = vectors[:, 1] * degree
    # The environment's first variable stands above
    if along[: variables.n_states] @ (np.arange(variables.n_states) - (variables.n_states - 1) / 2) < 0:
        along = -along
    places = _swept(along, pull, len(left))
    return [left[i] for i in places[0]], [right[i] for i in places[1]]


def _swept(along: np.ndarray, pull: np.ndarray, n_left: int, n_sweeps: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """The order with the shortest arrows of some sweeps in which each layer goes to the mean place of what pulls at it."""
    weights = pull[:n_left, n_left:] + 1e-9
    left, right = (np.argsort(part, kind="stable") for part in (along[:n_left], along[n_left:]))
    best, shortest = (left, right), np.inf
    for _ in range(n_sweeps):
        rows, columns = (_heights(order) for order in (left, right))
        length = float((weights * np.abs(rows[:, None] - columns)).sum())
        if length < shortest - 1e-9:
            best, shortest = (left, right), length
        right = np.argsort(weights.T @ rows / weights.sum(axis=0), kind="stable")
        left = np.argsort(weights @ _heights(right) / weights.sum(axis=1), kind="stable")
    return best


def _heights(order: np.ndarray) -> np.ndarray:
    """The place of each node, from 0 to 1."""
    heights = np.empty(len(order))
    heights[order] = (np.arange(len(order)) + 0.5) / len(order)
    return heights
