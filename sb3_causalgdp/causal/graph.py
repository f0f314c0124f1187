import json
import os
import uuid
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sb3_causalgdp.causal.variables import TransitionVariables

if TYPE_CHECKING:
    import networkx as nx
    from matplotlib.figure import Figure

PLOTS_HINT = 'matplotlib and networkx are needed for this: pip install "sb3_causalgdp[plots]"'
BLOCKS = ("state_to_state", "action_to_state", "state_to_reward", "action_to_reward")


class Edge(NamedTuple):
    """One open edge: names of cause and effect, mask in (0, 1], signed weight in standardised units."""

    cause: str
    effect: str
    mask: float
    weight: float


@dataclass(eq=False)
class CausalGraph:
    """
    What causes what in one transition: soft masks, and the signed weights that they were made from.

    Row j of ``state_to_state`` and ``action_to_state`` says which s_i and a_i cause s'_j. ``state_to_reward`` refers to the
    *next* state: it says which s_{t+1} cause r_t. Masks lie in [0, 1], 0 is a closed edge. Weights are in standardised
    units (standard deviations of the effect per standard deviation of the cause).

    :param variables: Names and order of the variables, n states and d actions
    :param state_to_state: Mask C_ss, shape (n, n)
    :param action_to_state: Mask C_as, shape (n, d)
    :param state_to_reward: Mask U_sr, shape (n,)
    :param action_to_reward: Mask U_ar, shape (d,)
    :param weight_state_to_state: shape (n, n)
    :param weight_action_to_state: shape (n, d)
    :param weight_state_to_reward: shape (n,)
    :param weight_action_to_reward: shape (d,)
    :param method: Name of the discovery method
    :param n_samples: Number of transitions it was found from
    :param num_timesteps: Environment steps when it was found
    :param found_at: ISO 8601 time when it was found
    :param constant_variables: Names of the variables that never moved; they have no edges
    :raises ValueError: when a shape does not fit, a value is not finite or a mask is outside [0, 1]
    """

    variables: TransitionVariables
    state_to_state: np.ndarray
    action_to_state: np.ndarray
    state_to_reward: np.ndarray
    action_to_reward: np.ndarray
    weight_state_to_state: np.ndarray
    weight_action_to_state: np.ndarray
    weight_state_to_reward: np.ndarray
    weight_action_to_reward: np.ndarray
    method: str
    n_samples: int
    num_timesteps: int | None = None
    found_at: str | None = None
    constant_variables: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        n_states, n_actions = self.variables.n_states, self.variables.n_actions
        shapes = ((n_states, n_states), (n_states, n_actions), (n_states,), (n_actions,))
        for block, shape in zip(BLOCKS, shapes, strict=True):
            for name in (block, f"weight_{block}"):
                values = np.array(getattr(self, name), dtype=np.float64)
                if values.shape != shape:
                    raise ValueError(f"{name} must have shape {shape}, got {values.shape}")
                if not np.isfinite(values).all():
                    raise ValueError(f"{name} must be finite, got NaN or infinite entries")
                setattr(self, name, values)
            mask = getattr(self, block)
            if mask.min() < 0 or mask.max() > 1:
                raise ValueError(f"{block} is a mask and must lie in [0, 1], got [{mask.min():g}, {mask.max():g}]")
        self.constant_variables = tuple(self.constant_variables)

    @classmethod
    def from_matrices(
        cls,
        variables: TransitionVariables,
        masks: np.ndarray,
        weights: np.ndarray,
        method: str,
        n_samples: int,
        **details: Any,
    ) -> "CausalGraph":
        """
        Cut a graph out of one matrix of masks and one of weights, laid out as the properties of these names.

        :param variables: Names and order of the variables
        :param masks: shape (n + 1, n + d)
        :param weights: shape (n + 1, n + d)
        :param method: Name of the discovery method
        :param n_samples: Number of transitions it was found from
        :param details: The class's further arguments
        """
        n_states = variables.n_states
        shape = (n_states + 1, n_states + variables.n_actions)
        for name, matrix in (("masks", masks), ("weights", weights)):
            if matrix.shape != shape:
                raise ValueError(f"{name} must have shape {shape}, got {matrix.shape}")
        return cls(
            variables=variables,
            state_to_state=masks[:-1, :n_states],
            action_to_state=masks[:-1, n_states:],
            state_to_reward=masks[-1, :n_states],
            action_to_reward=masks[-1, n_states:],
            weight_state_to_state=weights[:-1, :n_states],
            weight_action_to_state=weights[:-1, n_states:],
            weight_state_to_reward=weights[-1, :n_states],
            weight_action_to_reward=weights[-1, n_states:],
            method=method,
            n_samples=n_samples,
            **details,
        )

    @classmethod
    def fully_connected(cls, variables: TransitionVariables) -> "CausalGraph":
        """
        Everything may cause everything: all masks 1, all weights 0, the start before any discovery.

        :param variables: Names and order of the variables
        """
        shape = (variables.n_states + 1, variables.n_states + variables.n_actions)
        return cls.from_matrices(variables, np.ones(shape), np.zeros(shape), method="none", n_samples=0)

    @property
    def masks(self) -> np.ndarray:
        """A copy of all masks, shape (n + 1, n + d): rows s' and reward; columns s (in the reward's row s') and a."""
        return np.block(
            [[self.state_to_state, self.action_to_state], [self.state_to_reward[None], self.action_to_reward[None]]]
        )

    @property
    def weights(self) -> np.ndarray:
        """A copy of all weights, laid out as ``masks``."""
        return np.block(
            [
                [self.weight_state_to_state, self.weight_action_to_state],
                [self.weight_state_to_reward[None], self.weight_action_to_reward[None]],
            ]
        )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, CausalGraph):
            return NotImplemented
        return all(np.array_equal(getattr(self, f.name), getattr(other, f.name)) for f in fields(self))

    @property
    def n_edges(self) -> int:
        """Number of open edges (mask > 0)."""
        return int(np.count_nonzero(self.masks))

    def change_since(self, other: "CausalGraph") -> float:
        """
        :param other: A graph over the same variables
        :return: mean absolute difference over all mask entries, from 0 (same masks) to 1 (all open against all closed)
        :raises ValueError: when the variables differ
        """
        if other.variables != self.variables:
            raise ValueError(f"other must be over the same variables {self.variables.names}, got {other.variables.names}")
        return float(np.abs(self.masks - other.masks).mean())

    def edges(self) -> list[Edge]:
        """
        :return: all open edges, grouped by effect, in the order of the variables
        """
        variables, masks, weights = self.variables, self.masks, self.weights
        causes_of_state = (*variables.state_names, *variables.action_names)
        causes_of_reward = (*variables.next_state_names, *variables.action_names)
        effects = (*variables.next_state_names, "reward")
        return [
            Edge(
                cause=(causes_of_reward if effects[j] == "reward" else causes_of_state)[i],
                effect=effects[j],
                mask=float(masks[j, i]),
                weight=float(weights[j, i]),
            )
            for j, i in np.argwhere(masks > 0)
        ]

    def to_networkx(self) -> "nx.DiGraph":
        """
        :return: directed graph of all variables and the open edges; nodes have ``layer`` (0: s_t and a_t, 1: s_{t+1},
            2: reward), edges have ``mask`` and ``weight``
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
        for edge in self.edges():
            graph.add_edge(edge.cause, edge.effect, mask=edge.mask, weight=edge.weight)
        return graph

    def to_json(self) -> str:
        """
        :return: JSON text; ``from_json`` gives an equal graph
        """
        content: dict[str, Any] = {f.name: getattr(self, f.name) for f in fields(self)}
        content["variables"] = {"state_names": self.variables.state_names, "action_names": self.variables.action_names}
        for block in BLOCKS:
            for name in (block, f"weight_{block}"):
                content[name] = content[name].tolist()
        return json.dumps(content)

    @classmethod
    def from_json(cls, text: str) -> "CausalGraph":
        """
        :param text: What ``to_json`` wrote
        :raises ValueError: when the text is not JSON, or its fields are not those of a graph
        """
        try:
            content = json.loads(text)
        except json.JSONDecodeError as error:
            raise ValueError(f"text is not JSON: {error}") from error
        expected = {f.name for f in fields(cls)}
        if not isinstance(content, dict) or set(content) != expected:
            given = sorted(content) if isinstance(content, dict) else type(content).__name__
            raise ValueError(f"text is not a causal graph: its fields must be {sorted(expected)}, got {given}")
        content["variables"] = TransitionVariables(**content["variables"])
        return cls(**content)

    def save(self, path: str | os.PathLike[str]) -> None:
        """
        Write the graph as JSON; a reader sees the old file or the new one, never a half.

        :param path: File to write; its folder is created
        """
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}")
        try:
            temporary.write_text(self.to_json(), encoding="utf-8")
            os.replace(temporary, path)
        finally:
            temporary.unlink(missing_ok=True)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> "CausalGraph":
        """
        :param path: File that ``save`` wrote
        """
        return cls.from_json(Path(path).read_text(encoding="utf-8"))

    def plot(self, path: str | os.PathLike[str] | None = None, kind: str = "both", max_variables: int = 40) -> "Figure":
        """
        Draw the graph, without pyplot's global state (a notebook shows the figure after ``%matplotlib inline``).

        :param path: Image file to write, by its suffix; None writes nothing
        :param kind: ``"heat_map"``, ``"graph"`` or ``"both"``
        :param max_variables: Draw at most this many states and actions, those with the largest total mask
        :return: the matplotlib figure
        :raises ImportError: when matplotlib or networkx is missing
        """
        from sb3_causalgdp.causal.plots import plot_causal_graph

        return plot_causal_graph(self, path, kind, max_variables)
