"""Which parts of the world may be exchanged between transitions: components on which two graphs in a row agree."""

from typing import Any

import numpy as np
from scipy.sparse.csgraph import connected_components

from sb3_causalgdp.causal.counterfactual_batches import BINDING, Components, components_of
from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.statistics.degenerate import CONFOUNDED_VIF
from sb3_causalgdp.causal.variables import TransitionVariables

ROWS_PER_CAUSE = 10  # where a method does not say what it could have seen
DETECTABLE_R2 = 0.05
LEAST_REWARD_R2 = 0.1


class TrustedComponents:
    """
    Judges with each new graph which components its transitions fall into. There are none until two graphs in a row could be
    trusted; then an edge in either of them binds.

    A graph is not trusted when an effect of a partial R^2 of 0.05 on any variable could have been missed; or, where the method
    does not say, with fewer than ten rows for each state and action. Where the reward is known from the graph alone, it must
    have varied, and a tenth of its variance be explained. Bound together is, beside what edges join: what is linearly
    dependent, or nearly so (variance inflation over 40), since no graph can tell whose an effect is; and the states that end
    episodes, which are not modelled.

    :param variables: Names and order of the variables, n states and d actions
    """

    def __init__(self, variables: TransitionVariables) -> None:
        self.variables = variables
        self.components: Components | None = None
        """What may be exchanged, None as long as nobody knows."""
        self._last: Components | None = None

    def update(self, graph: CausalGraph, ends: np.ndarray | None = None, reward_is_known: bool = False) -> str:
        """
        Judge by a new graph.

        :param graph: Over these variables
        :param ends: Which states are known to end episodes, boolean, shape (n,), or None
        :param reward_is_known: Whether rewards are computed by the task itself, as for hindsight goals
        :return: Why the graph is not trusted, empty if it is
        """
        untrusted = _why_untrusted(graph, reward_is_known)
        found = None if untrusted else _bound(components_of(graph, BINDING), self._groups(graph, ends))
        self.components = None if found is None or self._last is None else _joined(found, self._last)
        self._last = found
        return untrusted

    def _groups(self, graph: CausalGraph, ends: np.ndarray | None) -> list[np.ndarray]:
        """What is bound together though no edge says so, each boolean, of shape (n + d,)."""
        n_states, n_actions = self.variables.n_states, self.variables.n_actions
        primed = dict(zip(self.variables.next_state_names, self.variables.state_names, strict=True))
        names = (*self.variables.state_names, *self.variables.action_names)
        duplicates = [{primed.get(name, name) for name in group} for group in graph.duplicated_variables]
        groups = [np.array([name in group for name in names]) for group in duplicates]
        inflation = [
            np.zeros(size) if values is None else np.asarray(values)
            for values, size in ((graph.state_vif, n_states), (graph.action_vif, n_actions))
        ]
        # Copies of different things are not bound to each other
        is_copy = np.any(groups, axis=0) if groups else False
        groups.append((np.concatenate(inflation) > CONFOUNDED_VIF) & ~np.asarray(is_copy))
        if ends is not None:
            groups.append(np.concatenate([ends, np.zeros(n_actions, dtype=bool)]))
        return groups

    def state_dict(self) -> dict[str, Any]:
        """
        :return: What it knows, as lists, which JSON can hold
        """
        known = {"components": self.components, "last": self._last}
        return {
            name: None if one is None else {"labels": one.labels.tolist(), "read": one.read.tolist()}
            for name, one in known.items()
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """
        Go on where another one was.

        :param state: What ``state_dict`` gave
        :raises ValueError: when it is not that of these variables
        """
        n_causes = self.variables.n_states + self.variables.n_actions
        try:
            known = [
                None
                if state[name] is None
                else Components(np.array(state[name]["labels"], dtype=np.int64), np.array(state[name]["read"], dtype=bool))
                for name in ("components", "last")
            ]
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"state is not that of trusted components: {type(error).__name__}: {error}") from error
        for one in known:
            fits = one is None or (one.labels.shape == (n_causes,) and set(one.labels.tolist()) == set(range(len(one.read))))
            if not fits:
                raise ValueError(f"state is not that of trusted components of {n_causes} states and actions")
        self.components, self._last = known


def _why_untrusted(graph: CausalGraph, reward_is_known: bool) -> str:
    rows = slice(None, -1) if reward_is_known else slice(None)
    if not reward_is_known:
        if "reward" in graph.constant_variables:
            return "the reward has not varied"
        if graph.r_squared is not None and graph.r_squared[-1] < LEAST_REWARD_R2:
            return f"only {graph.r_squared[-1]:.2f} of the reward's variance is explained"
    if graph.detectable_r2 is None:
        needed = ROWS_PER_CAUSE * graph.masks.shape[1]
        return f"{graph.n_samples} transitions are fewer than {needed}" if graph.n_samples < needed else ""
    effects = (*graph.variables.next_state_names, "reward")
    moved = np.array([name not in graph.constant_variables for name in effects])[rows]
    seen = graph.detectable_r2[rows][moved]
    missed = float(seen.max()) if len(seen) > 0 else 1.0
    return f"effects of a partial R^2 of {missed:.3f} could be missed" if not missed <= DETECTABLE_R2 else ""


def _bound(components: Components, groups: list[np.ndarray]) -> Components:
    """With each group in one component."""
    for group in groups:
        labels = np.where(group, len(group), np.arange(len(group)))
        components = _joined(components, Components(np.unique(labels, return_inverse=True)[1], np.zeros(0, dtype=bool)))
    return components


def _joined(first: Components, second: Components) -> Components:
    """The smallest components that those of both are parts of."""
    together = (first.labels[:, None] == first.labels) | (second.labels[:, None] == second.labels)
    number, labels = connected_components(together, directed=False)
    read = np.zeros(number, dtype=bool)
    for one in (first, second):
        if len(one.read) > 0:
            read[labels[one.read[one.labels]]] = True
    return Components(labels.astype(np.int64), read)
