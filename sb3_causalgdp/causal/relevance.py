"""Which variables can matter for any future reward, by the paths of a causal graph."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_causalgdp.causal.variables import TransitionVariables

if TYPE_CHECKING:
    import pandas as pd

CausalGraph = Any  # whose file imports this one

OPEN = 0.5  # an edge above it counts for the shortest path
FAINT = 0.05  # edges below it may lie in the cut of the upper bound
ASSUMPTION = (
    "Assumes that the variables are the whole state, or keep what predicts it: what matters only through something that is "
    "not observed, or only two steps later, is not seen."
)


@dataclass(frozen=True, eq=False)
class Relevance:
    """
    How surely each variable can matter for any future reward.

    :param variables: Names and order of the variables, n states and d actions
    :param states: Probability of the surest path from each state to a reward, in [0, 1], shape (n,)
    :param actions: The same from each action, shape (d,)
    :param states_upper: Upper bound of the probability that there is any path, were the edges independent, shape (n,)
    :param actions_upper: The same from each action, shape (d,)
    :param state_lengths: Edges of the shortest path from each state over edges above one half, 0 where there is none, shape
        (n,)
    :param action_lengths: The same from each action, shape (d,)
    :param state_paths: Of each state, the names along the surest path, the state's first and ``"reward"`` last; empty where
        there is none
    :param action_paths: The same of each action
    """

    variables: TransitionVariables
    states: np.ndarray
    actions: np.ndarray
    states_upper: np.ndarray
    actions_upper: np.ndarray
    state_lengths: np.ndarray
    action_lengths: np.ndarray
    state_paths: tuple[tuple[str, ...], ...]
    action_paths: tuple[tuple[str, ...], ...]

    def to_dataframe(self) -> "pd.DataFrame":
        """
        :return: a row for each state and action, in the order of the variables, with the columns ``variable``, ``kind``,
            ``relevance``, ``upper``, ``length`` and ``path``
        :raises ImportError: when pandas is missing
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise ImportError("pandas is needed for this: pip install pandas") from error
        names = (*self.variables.state_names, *self.variables.action_names)
        kinds = ["state"] * self.variables.n_states + ["action"] * self.variables.n_actions
        return pd.DataFrame(
            {
                "variable": names,
                "kind": kinds,
                "relevance": np.concatenate([self.states, self.actions]),
                "upper": np.concatenate([self.states_upper, self.actions_upper]),
                "length": np.concatenate([self.state_lengths, self.action_lengths]),
                "path": [" -> ".join(path) for path in (*self.state_paths, *self.action_paths)],
            }
        )

    def rows(self) -> list[tuple[str, float, int, str]]:
        """
        :return: name, relevance, length and path of each variable, the most relevant first
        """
        names = (*self.variables.state_names, *self.variables.action_names)
        values = np.concatenate([self.states, self.actions])
        lengths = np.concatenate([self.state_lengths, self.action_lengths])
        paths = (*self.state_paths, *self.action_paths)
        order = np.argsort(-values, kind="stable")
        return [(names[i], float(values[i]), int(lengths[i]), " -> ".join(paths[i])) for i in order]

    def __str__(self) -> str:
        width = max(len(name) for name in (*self.variables.state_names, *self.variables.action_names))
        return "\n".join(f"{value:.2f}  {name:>{width}}  {path}" for name, value, _, path in self.rows())


def relevance_of(graph: CausalGraph) -> Relevance:
    """
    The surest paths to the reward: with p(i -> j) the probability that state i causes the next state j and q(j) that the
    reward reads state j, ``R_j = max(q(j), max_l p(j -> l) R_l)`` is the relevance of a state, and ``max(q_a(k), max_j p(k ->
    j) R_j)`` that of action k. A state that the reward reads is relevant, whether or not it was seen to last for a step.

    Probabilities are the graph's ``evidence`` that there is any effect, or its masks where the method has none. The surest
    path is a lower bound of the probability of any path, were the edges independent; the upper bound is that of a cut: the
    edges that leave the variable, or those that leave all that it reaches by edges above 0.05, whichever is smaller.

    Assumes that the variables are the whole state, or keep what predicts it: what matters only through something that is not
    observed, or only two steps later, is not seen.

    :param graph: Any causal graph
    :return: the relevance of its states and actions
    """
    variables = graph.variables
    n_states = variables.n_states
    edges = graph.masks if graph.evidence is None else graph.evidence
    # Row i: from i to each next state, and last to the reward
    of_states, of_actions = edges[:, :n_states].T, edges[:, n_states:].T
    states, successors = _surest_paths(of_states)
    through = of_actions * np.append(states, 1.0)
    first = through.argmax(axis=1)
    actions = through.max(axis=1)
    state_paths = [_path(i, successors, variables) if states[i] > 0.0 else () for i in range(n_states)]
    ends = [*state_paths, ("reward",)]
    action_paths = [
        (name, *ends[j]) if value > 0.0 else () for name, j, value in zip(variables.action_names, first, actions, strict=True)
    ]
    lengths = _shortest_lengths(of_states > OPEN)
    return Relevance(
        variables,
        states=states,
        actions=actions,
        states_upper=_upper_bounds(of_states, of_states, is_state=True),
        actions_upper=_upper_bounds(of_actions, of_states, is_state=False),
        state_lengths=lengths,
        action_lengths=_one_longer(of_actions > OPEN, lengths),
        state_paths=tuple(state_paths),
        action_paths=tuple(action_paths),
    )


def _surest_paths(edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Dijkstra's algorithm backwards from the reward, with products in place of sums.

    :param edges: From each of n states to each next state and the reward, shape (n, n + 1)
    :return: probability of the surest path from each state, and the next state on it, n for the reward; each of shape (n,)
    """
    n_states = len(edges)
    best, successors = edges[:, n_states].copy(), np.full(n_states, n_states)
    waiting = best.copy()
    for _ in range(n_states):
        state = int(waiting.argmax())
        if waiting[state] <= 0.0:
            break
        waiting[state] = -1.0
        through = edges[:, state] * best[state]
        better = (through > best) & (waiting >= 0.0)
        best[better] = waiting[better] = through[better]
        successors[better] = state
    return best, successors


def _path(state: int, successors: np.ndarray, variables: TransitionVariables) -> tuple[str, ...]:
    names = []
    while state < variables.n_states:
        names.append(variables.state_names[state])
        state = int(successors[state])
    return (*names, "reward")


def _shortest_lengths(is_open: np.ndarray) -> np.ndarray:
    """Of n states, shape (n, n + 1), in edges; 0 where there is no path."""
    lengths = is_open[:, -1].astype(np.int64)
    length, reached = 1, lengths > 0
    while True:
        new = is_open[:, :-1][:, reached].any(axis=1) & ~reached
        if not new.any():
            return lengths
        length += 1
        lengths[new] = length
        reached |= new


def _one_longer(is_open: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Of d actions, shape (d, n + 1), over the states' own."""
    longest = len(lengths) + 2
    of_targets = np.append(np.where(lengths > 0, lengths, longest), 0)
    shortest = np.where(is_open, of_targets, longest).min(axis=1) + 1
    return np.where(shortest > longest, 0, shortest)


def _upper_bounds(edges: np.ndarray, of_states: np.ndarray, is_state: bool) -> np.ndarray:
    """
    :param edges: From each of q variables to each next state and the reward, shape (q, n + 1)
    :param of_states: The same from the states, shape (n, n + 1)
    :param is_state: Whether the variables are the states: an edge from one to itself leaves nothing
    :return: shape (q,)
    """
    closed = 1.0 - edges
    n_states = len(of_states)
    if is_state:
        np.fill_diagonal(closed, 1.0)
    alone = 1.0 - closed.prod(axis=1)
    reached = _reachable(edges[:, :n_states] > FAINT, of_states[:, :n_states] > FAINT)
    if is_state:
        reached |= np.eye(n_states, dtype=bool)
    with np.errstate(divide="ignore"):
        logs = np.log1p(-of_states)
        own = np.log1p(-edges)
    # Edges from what is reached to what is not, and to the reward
    leaving = np.where(reached, 0.0, _masked_product(reached, logs[:, :n_states])).sum(axis=1)
    leaving += _masked_product(reached, logs[:, n_states:])[:, 0]
    if not is_state:
        leaving += np.where(reached, 0.0, own[:, :n_states]).sum(axis=1) + own[:, n_states]
    return np.minimum(alone, 1.0 - np.exp(leaving))


def _masked_product(chosen: np.ndarray, logs: np.ndarray) -> np.ndarray:
    """Sums of the chosen rows of ``logs``, in which an infinite entry that is not chosen is nothing."""
    finite = np.isfinite(logs)
    sums = chosen @ np.where(finite, logs, 0.0)
    return np.where(chosen @ (~finite).astype(float) > 0.0, -np.inf, sums)


def _reachable(first: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Which states can be reached by a first step and any number of further ones, shape (q, n)."""
    reached = first
    steps = edges.astype(np.float32)
    while True:
        further = reached | (reached.astype(np.float32) @ steps > 0.0)
        if np.array_equal(further, reached):
            return reached
        reached = further
