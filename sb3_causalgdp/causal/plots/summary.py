"""A small graph that stands for a large one: groups of variables, or the variables with the most edges."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from sb3_causalgdp.causal.edges import certain_sizes
from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.plots.grouping import groups_of_names
from sb3_causalgdp.causal.variables import TransitionVariables

Groups = Mapping[str, str] | Mapping[str, int] | Literal["auto", "names"] | None

AGGREGATES: dict[str, Callable[[np.ndarray], Any]] = {"mean": np.mean, "max": np.max}


@dataclass(frozen=True)
class Summary:
    """
    Which variables of a large graph stand behind each variable of a small one; call it with a large graph.

    :param variables: Names of the groups of states and of actions
    :param members: Columns of each group in the large graph, in the order of ``variables``
    :param aggregate: ``"mean"`` or ``"max"`` of the masks, and of the effects' sizes, between two groups
    :param remark: What was summarised, for a title; empty if nothing was
    """

    variables: TransitionVariables
    members: tuple[tuple[int, ...], ...]
    aggregate: str = "mean"
    remark: str = ""

    @property
    def is_grouped(self) -> bool:
        """Whether a group has more than one variable: then effects are what is sure of their sizes."""
        return any(len(columns) > 1 for columns in self.members)

    def __call__(self, graph: CausalGraph) -> CausalGraph:
        """
        :param graph: The large graph
        :return: the small one
        """
        effects = graph.effects
        if self.is_grouped:
            effects = graph.masks * certain_sizes(graph.effects, graph.standard_errors)
        errors = None if self.is_grouped or graph.standard_errors is None else self._aggregated(graph.standard_errors)
        return CausalGraph(
            self.variables,
            self._aggregated(graph.masks),
            self._aggregated(effects),
            method=graph.method,
            n_samples=graph.n_samples,
            standard_errors=errors,
            num_timesteps=graph.num_timesteps,
            found_at=graph.found_at,
            remarks=graph.remarks,
        )

    def _aggregated(self, matrix: np.ndarray) -> np.ndarray:
        rows = (*self.members[: self.variables.n_states], (len(matrix) - 1,))
        aggregate = AGGREGATES[self.aggregate]
        return np.array([[aggregate(matrix[np.ix_(row, columns)]) for columns in self.members] for row in rows])


def summarize(graph: CausalGraph, max_variables: int = 40, groups: Groups = "auto", aggregate: str = "mean") -> Summary:
    """
    Choose what of a graph a person can still read.

    :param graph: The graph
    :param max_variables: Number of states and actions that can be read one by one, at least 2
    :param groups: What to draw in place of the single variables:

        - ``"auto"`` groups more variables than ``max_variables`` by their names: neighbours that begin with the same words,
          such as one key, body or joint, and ranges such as ``obs[0..19]``; ``"names"`` does so for any number of variables;
        - None does not group: of more variables than ``max_variables``, those with the largest total mask are shown;
        - a mapping from names of variables to names of groups; variables that it lacks stay alone;
        - a mapping from names of sections to numbers of consecutive states, such as
          ``env.unwrapped.observation_structure`` of Gymnasium's MuJoCo environments (entries ``skipped_...`` do not count)
    :param aggregate: ``"mean"`` or ``"max"`` of the masks, and of the effects' sizes, between two groups
    :return: the choice, to be called with the graph
    :raises ValueError: when ``max_variables`` is below 2, ``aggregate`` is not known or the groups do not fit the variables
    """
    if max_variables < 2:
        raise ValueError(f"max_variables must be at least 2, got {max_variables!r}")
    if aggregate not in AGGREGATES:
        raise ValueError(f"aggregate must be one of {tuple(AGGREGATES)}, got {aggregate!r}")
    variables = graph.variables
    n_variables = variables.n_states + variables.n_actions
    if isinstance(groups, Mapping):
        return _summary_of_groups(variables, _named_groups(variables, groups), aggregate)
    if groups not in ("auto", "names", None):
        raise ValueError(f'groups must be "auto", "names", None or a mapping, got {groups!r}')
    if groups != "names" and n_variables <= max_variables:
        return Summary(variables, tuple((i,) for i in range(n_variables)), aggregate)
    if groups is None:
        return _most_connected(graph, max_variables)
    by_name = groups_of_names(variables.state_names) | groups_of_names(variables.action_names)
    return _summary_of_groups(variables, by_name, aggregate)


def _summary_of_groups(variables: TransitionVariables, group_of: Mapping[str, str], aggregate: str) -> Summary:
    """The groups in the order of their first variables; names without a group stay alone."""
    names: dict[str, list[str]] = {"state": [], "action": []}
    members: dict[str, list[int]] = {}
    for column, name in enumerate((*variables.state_names, *variables.action_names)):
        group = group_of.get(name, name)
        kind = "state" if column < variables.n_states else "action"
        if group not in members:
            names[kind].append(group)
        elif group not in names[kind]:
            raise ValueError(f"groups must not mix states and actions, {group!r} does")
        members.setdefault(group, []).append(column)
    return Summary(
        TransitionVariables(tuple(names["state"]), tuple(names["action"])),
        tuple(tuple(members[group]) for group in (*names["state"], *names["action"])),
        aggregate,
        remark=f"{aggregate} over groups of {variables.n_states} states and {variables.n_actions} actions",
    )


def _named_groups(variables: TransitionVariables, groups: Mapping[str, str] | Mapping[str, int]) -> dict[str, str]:
    """From the name of each variable to the name of its group."""
    names = (*variables.state_names, *variables.action_names)
    if all(isinstance(value, str) for value in groups.values()):
        unknown = [name for name in groups if name not in names]
        if unknown:
            raise ValueError(f"groups must map names of states and actions, got {unknown}, known are {names}")
        return {name: str(group) for name, group in groups.items()}
    if not all(isinstance(value, int | np.integer) and value >= 0 for value in groups.values()):
        raise ValueError(f"groups must map names to groups, or sections to their numbers of states, got {dict(groups)!r}")
    sections = {name: int(size) for name, size in groups.items() if not name.startswith("skipped_")}
    if sum(sections.values()) != variables.n_states:
        raise ValueError(f"the sections in groups must have {variables.n_states} states in all, got {sections}")
    repeated = [section for section, size in sections.items() for _ in range(size)]
    return dict(zip(variables.state_names, repeated, strict=True)) | groups_of_names(variables.action_names)


def _most_connected(graph: CausalGraph, max_variables: int) -> Summary:
    """The states and actions with the largest total mask, in their order."""
    variables = graph.variables
    n_states, n_variables = variables.n_states, variables.n_states + variables.n_actions
    total = graph.masks.sum(axis=0)
    total[:n_states] += graph.masks[:n_states].sum(axis=1)
    # A graph needs a state and an action: the best of each come first, whatever their total
    total[total[:n_states].argmax()] = total[n_states + total[n_states:].argmax()] = np.inf
    kept = sorted(np.argsort(-total, kind="stable")[:max_variables].tolist())
    names = (*variables.state_names, *variables.action_names)
    return Summary(
        TransitionVariables(_at(names, kept, range(n_states)), _at(names, kept, range(n_states, n_variables))),
        tuple((i,) for i in kept),
        remark=f"the {len(kept)} states and actions with the largest total mask, of {n_variables}",
    )


def _at(names: Sequence[str], kept: Iterable[int], among: range) -> tuple[str, ...]:
    return tuple(names[i] for i in kept if i in among)
