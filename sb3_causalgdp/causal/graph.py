import json
import os
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_causalgdp.causal import description
from sb3_causalgdp.causal.drawing import PLOTS_HINT, frame_of, picture
from sb3_causalgdp.causal.edges import EDGE_PROBABILITY, Edge, GraphDiff, strongest_in_rows
from sb3_causalgdp.causal.variables import TransitionVariables
from sb3_causalgdp.files import replaced_when_done
from sb3_causalgdp.saving.archives import errors_of

if TYPE_CHECKING:
    import networkx as nx
    import pandas as pd
    from matplotlib.figure import Figure

    from sb3_causalgdp.causal.relevance import Relevance

__all__ = ["EDGE_PROBABILITY", "PLOTS_HINT", "CausalGraph", "Edge", "GraphDiff"]


@dataclass(eq=False, repr=False)
class CausalGraph:
    """
    What causes what in one transition: soft masks, and the signed effects beside them; ``print`` shows the strongest.

    An *edge* is a pair whose mask is above :data:`EDGE_PROBABILITY` (0.5), everywhere in this package; as masks are
    probabilities, their sum is the expected number of edges.

    Everything lies in one layout, shape (n + 1, n + d): a row for each next state s'_j and, last, the reward; a column for
    each state and action. In the reward's row the states are those of the *next* step: it says which s_{t+1} cause r_t. The
    blocks have names of their own: ``state_to_state`` (C_ss), ``action_to_state`` (C_as), ``state_to_reward`` (U_sr) and
    ``action_to_reward`` (U_ar), and the same with ``effect_`` and ``se_`` in front. They are views, not copies.

    :param variables: Names and order of the variables, n states and d actions
    :param masks: Probability or strength of an edge in [0, 1], 0 is a closed edge, shape (n + 1, n + d)
    :param effects: Signed strengths in standardised units (standard deviations of the effect per standard deviation of the
        cause), shape (n + 1, n + d)
    :param method: Name of the discovery method
    :param n_samples: Number of transitions it was found from
    :param standard_errors: Of the effects, shape (n + 1, n + d); None where the method does not know them
    :param r_squared: Share of each row's variance that its causes explain, shape (n + 1,), or None
    :param action_vif: Variance inflation factor of each action: how well the states and the other actions predict it, shape
        (d,), or None; where it is large, the behaviour policy confounds the action with the states
    :param evidence: Probability of each edge that there is an effect at all, however weak, in [0, 1], shape (n + 1, n + d);
        None where the method makes no such test
    :param detectable_r2: Smallest partial R^2 of an effect on each row that the evidence would have shown, shape (n + 1,), or
        None
    :param state_vif: Variance inflation factor of each state among states and actions, shape (n,), or None
    :param constant_variables: Names of the variables that never moved; they have no edges
    :param duplicated_variables: Groups of names that are linear functions of each other; a group shares its masks
    :param num_timesteps: Environment steps when it was found
    :param found_at: ISO 8601 time when it was found
    :param remarks: What else limits it, such as features that were left out for want of memory
    :raises ValueError: when a shape does not fit, a value is not finite, a mask is outside [0, 1], a name is not that of a
        variable, or a number of samples or steps is not a whole one
    """

    variables: TransitionVariables
    masks: np.ndarray
    effects: np.ndarray
    method: str
    n_samples: int
    standard_errors: np.ndarray | None = None
    r_squared: np.ndarray | None = None
    action_vif: np.ndarray | None = None
    evidence: np.ndarray | None = None
    detectable_r2: np.ndarray | None = None
    state_vif: np.ndarray | None = None
    constant_variables: tuple[str, ...] = ()
    duplicated_variables: tuple[tuple[str, ...], ...] = ()
    num_timesteps: int | None = None
    found_at: str | None = None
    remarks: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n_states, n_actions = self.variables.n_states, self.variables.n_actions
        matrix = (n_states + 1, n_states + n_actions)
        self.masks = _checked("masks", self.masks, matrix)
        self.effects = _checked("effects", self.effects, matrix)
        row: tuple[int, ...] = matrix[:1]
        optional: dict[str, tuple[int, ...]] = {"standard_errors": matrix, "evidence": matrix}
        optional |= {"r_squared": row, "detectable_r2": row, "action_vif": (n_actions,), "state_vif": (n_states,)}
        for name, shape in optional.items():
            if getattr(self, name) is not None:
                setattr(self, name, _checked(name, getattr(self, name), shape))
        if self.evidence is not None and (self.evidence.min() < 0 or self.evidence.max() > 1):
            raise ValueError(f"evidence must lie in [0, 1], got {self.evidence.min():g} to {self.evidence.max():g}")
        if self.masks.min() < 0 or self.masks.max() > 1:
            raise ValueError(f"masks must lie in [0, 1], got values from {self.masks.min():g} to {self.masks.max():g}")
        if self.standard_errors is not None and self.standard_errors.min() < 0:
            raise ValueError(f"standard_errors must be at least 0, got {self.standard_errors.min():g}")
        self._check_scalars()
        if isinstance(self.remarks, str) or not all(isinstance(remark, str) for remark in self.remarks):
            raise ValueError(f"remarks must be strings, got {self.remarks!r}")
        self.remarks = tuple(self.remarks)
        known = frozenset(self.variables.names)
        self.constant_variables = _checked_names("constant_variables", self.constant_variables, known)
        if isinstance(self.duplicated_variables, str) or not isinstance(self.duplicated_variables, Iterable):
            raise ValueError(f"duplicated_variables must be groups of names, got {self.duplicated_variables!r}")
        self.duplicated_variables = tuple(
            _checked_names("duplicated_variables", group, known) for group in self.duplicated_variables
        )

    def _check_scalars(self) -> None:
        for name in ("method", "found_at"):
            value = getattr(self, name)
            if not (isinstance(value, str) or (value is None and name == "found_at")):
                raise ValueError(f"{name} must be a string, got {value!r}")
        for name in ("n_samples", "num_timesteps"):
            value = getattr(self, name)
            if value is None and name == "num_timesteps":
                continue
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
                raise ValueError(f"{name} must be an integer of at least 0, got {value!r}")
            setattr(self, name, int(value))

    @classmethod
    def fully_connected(cls, variables: TransitionVariables) -> "CausalGraph":
        """
        Everything may cause everything: all masks 1, all effects 0, the start before any discovery.

        :param variables: Names and order of the variables
        """
        shape = (variables.n_states + 1, variables.n_states + variables.n_actions)
        return cls(variables, np.ones(shape), np.zeros(shape), method="none", n_samples=0)

    @property
    def state_to_state(self) -> np.ndarray:
        """C_ss, shape (n, n)."""
        return self.masks[:-1, : self.variables.n_states]

    @property
    def action_to_state(self) -> np.ndarray:
        """C_as, shape (n, d)."""
        return self.masks[:-1, self.variables.n_states :]

    @property
    def state_to_reward(self) -> np.ndarray:
        """U_sr, shape (n,)."""
        return self.masks[-1, : self.variables.n_states]

    @property
    def action_to_reward(self) -> np.ndarray:
        """U_ar, shape (d,)."""
        return self.masks[-1, self.variables.n_states :]

    @property
    def effect_state_to_state(self) -> np.ndarray:
        """Effects in standardised units, shape (n, n)."""
        return self.effects[:-1, : self.variables.n_states]

    @property
    def effect_action_to_state(self) -> np.ndarray:
        """Effects in standardised units, shape (n, d)."""
        return self.effects[:-1, self.variables.n_states :]

    @property
    def effect_state_to_reward(self) -> np.ndarray:
        """Effects in standardised units, shape (n,)."""
        return self.effects[-1, : self.variables.n_states]

    @property
    def effect_action_to_reward(self) -> np.ndarray:
        """Effects in standardised units, shape (d,)."""
        return self.effects[-1, self.variables.n_states :]

    def _known_standard_errors(self) -> np.ndarray:
        if self.standard_errors is None:
            raise ValueError(f"the method {self.method!r} knows no standard errors")
        return self.standard_errors

    @property
    def se_state_to_state(self) -> np.ndarray:
        """Standard errors of ``effect_state_to_state``, shape (n, n); ValueError where they are not known."""
        return self._known_standard_errors()[:-1, : self.variables.n_states]

    @property
    def se_action_to_state(self) -> np.ndarray:
        """Standard errors of ``effect_action_to_state``, shape (n, d); ValueError where they are not known."""
        return self._known_standard_errors()[:-1, self.variables.n_states :]

    @property
    def se_state_to_reward(self) -> np.ndarray:
        """Standard errors of ``effect_state_to_reward``, shape (n,); ValueError where they are not known."""
        return self._known_standard_errors()[-1, : self.variables.n_states]

    @property
    def se_action_to_reward(self) -> np.ndarray:
        """Standard errors of ``effect_action_to_reward``, shape (d,); ValueError where they are not known."""
        return self._known_standard_errors()[-1, self.variables.n_states :]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, CausalGraph):
            return NotImplemented
        return all(_equal(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

    @property
    def is_discovered(self) -> bool:
        """Whether it was found in data; False for what stands for a graph before the first discovery."""
        return not (self.method == "none" and self.n_samples == 0)

    @property
    def n_edges(self) -> int:
        """Number of edges: masks above 0.5."""
        return int(np.count_nonzero(self.masks > EDGE_PROBABILITY))

    @property
    def expected_edges(self) -> float:
        """Expected number of edges: the sum of the masks."""
        return float(self.masks.sum())

    def __repr__(self) -> str:
        n_states, n_actions = self.variables.n_states, self.variables.n_actions
        return f"<CausalGraph {self.method!r}: {n_states} states, {n_actions} actions, {description.count_of_edges(self)}>"

    def __str__(self) -> str:
        return description.as_text(self)

    def _repr_html_(self) -> str:
        return description.as_html(self)

    def change_since(self, other: "CausalGraph") -> float:
        """
        :param other: A graph over the same variables
        :return: mean absolute difference over all mask entries, from 0 (same masks) to 1 (all open against all closed)
        :raises ValueError: when the variables differ
        """
        self._check_same_variables(other)
        return float(np.abs(self.masks - other.masks).mean())

    def diff(self, other: "CausalGraph", threshold: float = EDGE_PROBABILITY, min_change: float = 0.1) -> GraphDiff:
        """
        What changed since an earlier graph, edge by edge; ``print`` shows it.

        :param other: The earlier graph, over the same variables
        :param threshold: Masks above it are edges, in [0, 1)
        :param min_change: Smallest change of an open edge's effect that counts, in standardised units, at least 0
        :return: the edges that opened, closed, or whose effect changed
        :raises ValueError: when the variables differ or a number is out of range
        """
        self._check_same_variables(other)
        _check_threshold(threshold)
        if not min_change >= 0:
            raise ValueError(f"min_change must be at least 0, got {min_change!r}")
        before, now = other.masks > threshold, self.masks > threshold
        changed = before & now & (np.abs(self.effects - other.effects) > min_change)
        flipped = changed & (self.effects * other.effects < 0)
        larger = np.abs(self.effects) > np.abs(other.effects)
        return GraphDiff(
            opened=self._edges(now & ~before),
            closed=other._edges(before & ~now),
            strengthened=self._edges(changed & ~flipped & larger),
            weakened=self._edges(changed & ~flipped & ~larger),
            flipped=self._edges(flipped),
        )

    def _check_same_variables(self, other: "CausalGraph") -> None:
        if other.variables != self.variables:
            raise ValueError(f"other must be over the same variables {self.variables.names}, got {other.variables.names}")

    def edges(self, threshold: float = EDGE_PROBABILITY) -> list[Edge]:
        """
        :param threshold: Masks above it are edges, in [0, 1); 0 gives all that are not closed
        :return: the edges, grouped by effect, in the order of the variables
        :raises ValueError: when the threshold is out of range
        """
        _check_threshold(threshold)
        return self._edges(self.masks > threshold)

    def strongest_edges(self, per_effect: int = 3, for_reward: int | None = None) -> list[Edge]:
        """
        The strongest causes of every effect, by how strong they are at least (two standard errors nearer to zero). An effect
        without an edge gives the one candidate that comes closest, with a mask of 0.5 or below.

        :param per_effect: Number of causes of a next state, at least 1; causes as strong as the last one are there, too
        :param for_reward: Number of causes of the reward; None for as many
        :return: the edges, grouped by effect, the strongest first
        :raises ValueError: when a number is below 1
        """
        columns = strongest_in_rows(self, per_effect, for_reward)
        return [self._edge(row, column) for row, chosen in enumerate(columns) for column in chosen]

    def _edges(self, chosen: np.ndarray) -> list[Edge]:
        """The edges at the True entries of an array of the masks' shape."""
        return [self._edge(row, column) for row, column in np.argwhere(chosen)]

    def _edge(self, row: int, column: int) -> Edge:
        variables = self.variables
        causes = variables.state_names if row < variables.n_states else variables.next_state_names
        errors = self.standard_errors
        return Edge(
            cause=(*causes, *variables.action_names)[column],
            effect=(*variables.next_state_names, "reward")[row],
            mask=float(self.masks[row, column]),
            strength=float(self.effects[row, column]),
            standard_error=float("nan") if errors is None else float(errors[row, column]),
        )

    def relevance(self) -> "Relevance":
        """
        How surely each state and action can matter for any future reward, and by which path; see
        :func:`~sb3_causalgdp.causal.relevance.relevance_of`, which says what it assumes.

        :return: with ``states``, shape (n,), and ``actions``, shape (d,), in [0, 1], in the order of the variables
        """
        from sb3_causalgdp.causal.relevance import relevance_of

        return relevance_of(self)

    def to_dataframe(self) -> "pd.DataFrame":
        """
        :return: a row for each pair of variables that time allows, open or closed, in the order of ``edges``; the columns are
            the fields of :class:`Edge`
        :raises ImportError: when pandas is missing
        """
        return frame_of(self._edges(np.ones_like(self.masks)), Edge._fields)

    def to_networkx(self, threshold: float = EDGE_PROBABILITY) -> "nx.DiGraph":
        """
        :param threshold: Masks above it are edges, in [0, 1)
        :return: directed graph of all variables and the edges; nodes have ``layer`` (0: s_t and a_t, 1: s_{t+1},
            2: reward), edges have ``mask`` and ``strength``
        :raises ImportError: when networkx is missing
        """
        try:
            import networkx as nx
        except ImportError as error:
            raise ImportError(PLOTS_HINT) from error
        graph = nx.DiGraph()
        graph.add_nodes_from((*self.variables.state_names, *self.variables.action_names), layer=0)
        graph.add_nodes_from(self.variables.next_state_names, layer=1)
        graph.add_node("reward", layer=2)
        for edge in self.edges(threshold):
            graph.add_edge(edge.cause, edge.effect, mask=edge.mask, strength=edge.strength)
        return graph

    def to_json(self) -> str:
        """
        :return: JSON text; ``from_json`` gives an equal graph
        """
        content: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        content["variables"] = {"state_names": self.variables.state_names, "action_names": self.variables.action_names}
        for name, value in content.items():
            if isinstance(value, np.ndarray):
                content[name] = value.tolist()
        return json.dumps(content)

    @classmethod
    def from_json(cls, text: str) -> "CausalGraph":
        """
        :param text: What ``to_json`` wrote
        :raises ValueError: when the text is not JSON, or its fields are not those of a graph
        """
        try:
            content = json.loads(text)
        except (ValueError, RecursionError) as error:  # a number can have too many digits, lists too many brackets
            raise ValueError(f"text is not JSON: {error}") from error
        if not isinstance(content, dict):
            raise ValueError(f"text is not a causal graph: it holds a {type(content).__name__}, not an object")
        for name, value in (("remarks", ()), ("evidence", None), ("detectable_r2", None), ("state_vif", None)):
            content.setdefault(name, value)  # files of earlier versions have none
        expected = {f.name for f in fields(cls)}
        if set(content) != expected:
            missing, unknown = sorted(expected - set(content)), sorted(set(content) - expected)
            raise ValueError(f"text is not a causal graph of this version: missing fields {missing}, unknown fields {unknown}")
        try:
            content["variables"] = TransitionVariables(**content["variables"])
            return cls(**content)
        except (TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"text is not a causal graph: {error}") from error

    def save(self, path: str | os.PathLike[str]) -> None:
        """
        Write the graph as JSON; a reader sees the old file or the new one, never a half.

        :param path: File to write; its folder is created
        """
        with replaced_when_done(path) as temporary:
            temporary.write_text(self.to_json(), encoding="utf-8")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "CausalGraph":
        """
        :param path: File that ``save`` wrote
        :raises ValueError: when the file does not hold a graph
        """
        with errors_of(path, "cannot be read as a causal graph"):
            return cls.from_json(Path(path).read_text(encoding="utf-8"))

    def plot(
        self, path: str | os.PathLike[str] | None = None, kind: str = "both", view: Any = None, **options: Any
    ) -> "Figure":
        """
        Draw the graph, without pyplot's global state (a notebook shows the figure after ``%matplotlib inline``).

        :param path: Image file to write, by its suffix; None writes nothing
        :param kind: ``"heat_map"``, ``"graph"`` or ``"both"``
        :param view: What is drawn: a :class:`~sb3_causalgdp.causal.plots.View`
        :param options: Fields of the view by name, such as ``values="masks"`` or ``causes=5``
        :return: the matplotlib figure
        :raises ImportError: when matplotlib or networkx is missing
        :raises ValueError: on an argument out of range
        """
        return picture("plot_causal_graph")(self, path, kind, view, **options)


def _check_threshold(threshold: float) -> None:
    if not 0 <= threshold < 1:
        raise ValueError(f"threshold must be in [0, 1), got {threshold!r}")


def _equal(one: Any, other: Any) -> bool:
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return np.array_equal(one, other)
    return type(one) is type(other) and one == other


def _checked(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The values as a new float64 array of this shape, all finite."""
    try:
        values = np.array(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{name} must be numbers of shape {shape}: {error}") from error
    if values.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {values.shape}")
    if not np.isfinite(values).all():
        raise ValueError(f"{name} must be finite, got NaN or infinite entries")
    return values


def _checked_names(argument: str, names: Any, known: frozenset[str]) -> tuple[str, ...]:
    """The names as a tuple, all of them known."""
    if isinstance(names, str) or not isinstance(names, Iterable):
        raise ValueError(f"{argument} must be names of variables, got {names!r}")
    names = tuple(names)
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ValueError(f"{argument} must be names of variables, got {unknown}, known are {sorted(known)}")
    return names
