"""The verdict over time on which variables may be hidden, with hysteresis."""

import json
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np

from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.statistics.degenerate import CONFOUNDED_VIF
from sb3_causalgdp.causal.variables import TransitionVariables

ROWS_PER_CAUSE = 10  # where a method does not say what it could have seen


class Verdict(NamedTuple):
    """
    :param states: Which states are open, shape (n,)
    :param actions: Which actions are open, shape (d,)
    :param opened: Names of what was closed before this refresh
    :param closed: Names of what was open before this refresh
    :param withheld: Why nothing could be closed; empty where it could
    """

    states: np.ndarray
    actions: np.ndarray
    opened: tuple[str, ...]
    closed: tuple[str, ...]
    withheld: str


class RelevanceGate:
    """
    Judges with each new graph which variables may be hidden from the networks: all are open at first, one is closed when its
    relevance was below ``low`` in ``patience`` graphs in a row, and opened as soon as it is above ``high``.

    It closes nothing that it cannot judge. A whole graph says nothing when

    - the reward has not varied yet, or less than ``min_reward_r2`` of its variance is explained (a sparse reward that never
      came makes everything irrelevant);
    - no action is known to matter (relevance below ``known``): then how the reward comes about has not been found.

    It counts, but nothing is closed by it, when an effect of a partial R^2 of ``detectable`` on the reward or on half of the
    relevant states could have been missed; or, where the method does not say, with fewer than ten rows for each state and
    action.

    Single variables are not judged that never moved, are linearly dependent on others or nearly so (variance inflation over
    40), or are named in ``keep_open``, such as goals that were not reached yet. What cannot be judged keeps its verdict.

    :param variables: Names and order of the variables, n states and d actions
    :param low: Relevance below which a variable may be closed, in [0, ``high``]
    :param high: Relevance above which it is opened, in (0, 1]; to be closed, its upper bound must be below, too
    :param patience: Number of graphs in a row, at least 1
    :param detectable: Partial R^2 that must be visible, in (0, 1]
    :param known: Relevance that some action must have, in [0, 1]
    :param min_reward_r2: Share of the reward's variance that its causes must explain, in [0, 1]
    :raises ValueError: when a number is out of range
    """

    def __init__(
        self,
        variables: TransitionVariables,
        low: float = 0.05,
        high: float = 0.5,
        patience: int = 2,
        detectable: float = 0.03,
        known: float = 0.25,
        min_reward_r2: float = 0.1,
    ) -> None:
        if not 0 <= low <= high <= 1 or high == 0:
            raise ValueError(f"low and high must be in [0, 1], low at most high and high above 0, got {low!r} and {high!r}")
        if isinstance(patience, bool) or not isinstance(patience, int | np.integer) or patience < 1:
            raise ValueError(f"patience must be an integer of at least 1, got {patience!r}")
        if not 0 < detectable <= 1:
            raise ValueError(f"detectable must be in (0, 1], got {detectable!r}")
        for name, value in (("known", known), ("min_reward_r2", min_reward_r2)):
            if not 0 <= value <= 1:
                raise ValueError(f"{name} must be in [0, 1], got {value!r}")
        self.variables = variables
        self.low, self.high, self.patience = float(low), float(high), int(patience)
        self.detectable, self.known, self.min_reward_r2 = float(detectable), float(known), float(min_reward_r2)
        n_causes = variables.n_states + variables.n_actions
        self._open = np.ones(n_causes, dtype=bool)
        self._n_low = np.zeros(n_causes, dtype=np.int64)

    @property
    def names(self) -> tuple[str, ...]:
        """Of states and actions, in their order."""
        return (*self.variables.state_names, *self.variables.action_names)

    @property
    def states(self) -> np.ndarray:
        """Which states are open, a copy, shape (n,)."""
        return self._open[: self.variables.n_states].copy()

    @property
    def actions(self) -> np.ndarray:
        """Which actions are open, a copy, shape (d,)."""
        return self._open[self.variables.n_states :].copy()

    @property
    def settings(self) -> dict[str, float | int]:
        """What the constructor was given, by name."""
        return {name: getattr(self, name) for name in ("low", "high", "patience", "detectable", "known", "min_reward_r2")}

    def update(self, graph: CausalGraph, *, reward_varied: bool = True, keep_open: Iterable[str] = ()) -> Verdict:
        """
        Judge by a new graph.

        :param graph: Over the gate's variables
        :param reward_varied: False where it is known that the reward has not varied in a way that says anything
        :param keep_open: Names of variables that are opened and not closed, whatever the graph says
        :return: the verdict, also kept in ``states`` and ``actions``
        :raises ValueError: when the graph is over other variables, or a name is not that of a state or an action
        """
        if graph.variables != self.variables:
            raise ValueError(f"graph must be over the variables {self.variables.names}, got {graph.variables.names}")
        kept = self._chosen(keep_open)
        relevance = graph.relevance()
        values = np.concatenate([relevance.states, relevance.actions])
        upper = np.concatenate([relevance.states_upper, relevance.actions_upper])
        before = self._open.copy()
        withheld = "the reward has not varied" if not reward_varied else self._unknown(graph, relevance.actions)
        if not withheld:
            judged = ~(kept | self._unjudged(graph))
            low = (values < self.low) & (upper < self.high)
            self._n_low = np.where(judged, np.where(low, self._n_low + 1, 0), self._n_low)
            withheld = self._too_few(graph, relevance.states)
            if not withheld:
                self._open &= ~(judged & (self._n_low >= self.patience))
        opened = kept | (values > self.high)
        self._n_low[opened] = 0
        self._open |= opened
        return Verdict(
            self.states, self.actions, self._named(self._open & ~before), self._named(before & ~self._open), withheld
        )

    def _unknown(self, graph: CausalGraph, actions: np.ndarray) -> str:
        """Why how the reward comes about is not known; empty where it is."""
        if "reward" in graph.constant_variables:
            return "the reward has not varied"
        if graph.r_squared is not None and graph.r_squared[-1] < self.min_reward_r2:
            return f"only {graph.r_squared[-1]:.2f} of the reward's variance is explained"
        if actions.max() < self.known:
            return "no action is known to matter for the reward"
        return ""

    def _too_few(self, graph: CausalGraph, states: np.ndarray) -> str:
        """Why effects that matter could have been missed; empty where they would have been seen."""
        n_causes = len(self._open)
        if graph.detectable_r2 is None:
            needed = ROWS_PER_CAUSE * n_causes
            return f"{graph.n_samples} transitions are fewer than {needed}" if graph.n_samples < needed else ""
        relevant = states > self.high
        of_states = float(np.median(graph.detectable_r2[:-1][relevant])) if relevant.any() else 0.0
        missed = max(of_states, float(graph.detectable_r2[-1]))
        return (
            f"too few transitions: effects of a partial R^2 of {missed:.3f} could be missed"
            if missed > self.detectable
            else ""
        )

    def _unjudged(self, graph: CausalGraph) -> np.ndarray:
        """Which variables this graph says nothing about, shape (n + d,)."""
        n_states = self.variables.n_states
        primed = dict(zip(self.variables.next_state_names, self.variables.state_names, strict=True))
        groups = (name for group in graph.duplicated_variables for name in group)
        named = {primed.get(name, name) for name in (*graph.constant_variables, *groups)}
        unjudged = np.array([name in named for name in self.names])
        for vif, part in ((graph.state_vif, slice(0, n_states)), (graph.action_vif, slice(n_states, None))):
            if vif is not None:
                unjudged[part] |= vif > CONFOUNDED_VIF
        return unjudged

    def _chosen(self, names: Iterable[str]) -> np.ndarray:
        if isinstance(names, str):
            raise ValueError(f"keep_open must be names of states and actions, got the string {names!r}")
        names = tuple(names)
        unknown = sorted(set(names) - set(self.names))
        if unknown:
            raise ValueError(f"keep_open must be names of states and actions, got {unknown}, known are {list(self.names)}")
        return np.isin(np.array(self.names), names) if names else np.zeros(len(self.names), dtype=bool)

    def _named(self, chosen: np.ndarray) -> tuple[str, ...]:
        return tuple(self.names[i] for i in np.flatnonzero(chosen))

    def state_dict(self) -> dict[str, Any]:
        """
        :return: settings, names, verdict and counts as lists and numbers, which JSON can hold
        """
        return {
            "state_names": list(self.variables.state_names),
            "action_names": list(self.variables.action_names),
            **self.settings,
            "open": self._open.tolist(),
            "n_low": self._n_low.tolist(),
        }

    @classmethod
    def from_state_dict(cls, state: dict[str, Any]) -> "RelevanceGate":
        """
        :param state: What ``state_dict`` gave
        :return: a gate that goes on where the other was
        :raises ValueError: when it is not the state of a gate
        """
        try:
            content = dict(state)
            variables = TransitionVariables(content.pop("state_names"), content.pop("action_names"))
            is_open, n_low = content.pop("open"), content.pop("n_low")
            gate = cls(variables, **content)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"state is not that of a relevance gate: {type(error).__name__}: {error}") from error
        n_causes = len(gate._open)
        if not (isinstance(is_open, list) and len(is_open) == n_causes and all(isinstance(x, bool) for x in is_open)):
            raise ValueError(f"state is not that of a relevance gate: open must be {n_causes} booleans")
        counts = [x for x in n_low if type(x) is int and x >= 0] if isinstance(n_low, list) else []
        if len(counts) != n_causes or len(n_low) != n_causes:
            raise ValueError(f"state is not that of a relevance gate: n_low must be {n_causes} integers of at least 0")
        gate._open, gate._n_low = np.array(is_open, dtype=bool), np.array(counts, dtype=np.int64)
        return gate

    def to_json(self) -> str:
        """
        :return: JSON text; ``from_json`` gives a gate that goes on alike
        """
        return json.dumps(self.state_dict())

    @classmethod
    def from_json(cls, text: str) -> "RelevanceGate":
        """
        :param text: What ``to_json`` wrote
        :raises ValueError: when the text is not JSON or not the state of a gate
        """
        try:
            content = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"text is not JSON: {error}") from error
        if not isinstance(content, dict):
            raise ValueError(f"text is not the state of a relevance gate: it holds a {type(content).__name__}, not an object")
        return cls.from_state_dict(content)
