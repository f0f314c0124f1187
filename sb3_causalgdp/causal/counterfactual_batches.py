"""
Batches in which transitions exchange what does not influence each other: data that could have been seen (CoDA: S. Pitis, E.
Creager and A. Garg, 2020, "Counterfactual Data Augmentation using Locally Factored Dynamics").
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch as th
from scipy.sparse.csgraph import connected_components

if TYPE_CHECKING:
    from sb3_causalgdp.causal.graph import CausalGraph
    from sb3_causalgdp.causal.world_model import MaskedWorldModel

BINDING = 0.2  # an edge of at least this probability binds two variables together

RewardModel = Callable[[th.Tensor, th.Tensor], th.Tensor]
"""From next states, shape (batch, n), and actions, shape (batch, d), to rewards, shape (batch,)."""


class Transitions(NamedTuple):
    """
    :param states: s, shape (batch, n)
    :param actions: a, shape (batch, d)
    :param next_states: s', shape (batch, n)
    :param rewards: r, shape (batch,)
    """

    states: th.Tensor
    actions: th.Tensor
    next_states: th.Tensor
    rewards: th.Tensor


class Exchange(NamedTuple):
    """
    :param transitions: The batch after the exchange; rows without one are as they were
    :param exchanged: Which rows hold something of another, boolean, shape (batch,)
    :param modelled: Which rewards are those of the reward model, boolean, shape (batch,)
    """

    transitions: Transitions
    exchanged: th.Tensor
    modelled: th.Tensor


class Components(NamedTuple):
    """
    Parts of the world that do not influence each other within a step.

    :param labels: Component of each state and action, counted from 0, shape (n + d,)
    :param read: Which components the reward reads, boolean, shape (number of components,)
    """

    labels: np.ndarray
    read: np.ndarray


def _edges(graph: "CausalGraph") -> np.ndarray:
    return graph.masks if graph.evidence is None else graph.evidence


def components_of(graph: "CausalGraph", binding: float = BINDING) -> Components:
    """
    The connected components of a graph's states and actions, in which a variable's next value belongs to itself. The reward
    binds nothing together: where it reads several components, it is computed anew for what is exchanged between them.

    :param graph: Any causal graph
    :param binding: Evidence (or mask, where a method has no evidence) from which an edge is there, in (0, 1]; small is careful
    :return: the component of each state and action
    :raises ValueError: when ``binding`` is out of range
    """
    if not 0 < binding <= 1:
        raise ValueError(f"binding must be in (0, 1], got {binding!r}")
    edges = _edges(graph) >= binding
    n_causes = edges.shape[1]
    adjacency = np.zeros((n_causes, n_causes), dtype=bool)
    adjacency[: len(edges) - 1] = edges[:-1]
    number, labels = connected_components(adjacency, directed=False)
    read = np.zeros(number, dtype=bool)
    read[labels[edges[-1]]] = True
    return Components(labels, read)


def irrelevant_part(graph: "CausalGraph", irrelevant: np.ndarray, binding: float = BINDING) -> np.ndarray:
    """
    What of the irrelevant variables can be exchanged exactly: all but what relevant ones move, and what that is bound to.

    :param graph: Any causal graph
    :param irrelevant: Which states and actions have no path to the reward, such as those that a ``RelevanceGate`` has closed,
        boolean, shape (n + d,)
    :param binding: As in :func:`components_of`
    :return: a part of ``irrelevant`` whose components hold nothing else, boolean, shape (n + d,)
    :raises ValueError: when a shape does not fit or ``binding`` is out of range
    """
    labels = components_of(graph, binding).labels
    irrelevant = np.asarray(irrelevant, dtype=bool)
    if irrelevant.shape != labels.shape:
        raise ValueError(f"irrelevant must have shape {labels.shape}, got {irrelevant.shape}")
    mixed = np.unique(labels[~irrelevant])
    return ~np.isin(labels, mixed)


def exchange_part(
    transitions: Transitions,
    part: th.Tensor,
    donors: th.Tensor,
    read: th.Tensor,
    reward_model: RewardModel | None = None,
    keep: th.Tensor | None = None,
) -> Exchange:
    """
    Take a part of each transition from another one: of s, a and s' together.

    A reward that reads nothing of the part is kept, one that reads nothing else comes with it, and any other is computed.

    :param transitions: The batch
    :param part: Which states and actions are taken, boolean, shape (n + d,) or (batch, n + d)
    :param donors: Row from which each transition takes them, shape (batch,)
    :param read: Which states and actions the reward reads, boolean, shape (n + d,)
    :param reward_model: The masked reward model; None leaves transitions as they are whose rewards would have to be computed
    :param keep: Rows that give and take nothing, such as ends of episodes, of which nobody knows what they depend on; boolean,
        shape (batch,), or None
    :return: the batch after the exchange
    :raises ValueError: when a shape does not fit
    """
    n_rows, n_states = transitions.states.shape
    n_causes = n_states + transitions.actions.shape[1]
    if part.shape not in ((n_causes,), (n_rows, n_causes)):
        raise ValueError(f"part must have shape ({n_causes},) or ({n_rows}, {n_causes}), got {tuple(part.shape)}")
    for name, values, shape in (("donors", donors, (n_rows,)), ("read", read, (n_causes,)), ("keep", keep, (n_rows,))):
        if values is not None and values.shape != shape:
            raise ValueError(f"{name} must have shape {shape}, got {tuple(values.shape)}")
    part = part.expand(n_rows, n_causes)
    reads_part, reads_rest = (part & read).any(dim=1), (~part & read).any(dim=1)
    modelled = reads_part & reads_rest
    exchanged = part.any(dim=1) & (donors != th.arange(n_rows, device=donors.device))
    if keep is not None:
        exchanged &= ~(keep | keep[donors])
    if reward_model is None:
        exchanged &= ~modelled
    modelled &= exchanged
    taken = part & exchanged.unsqueeze(1)
    of_states, of_actions = taken[:, :n_states], taken[:, n_states:]
    states = th.where(of_states, transitions.states[donors], transitions.states)
    actions = th.where(of_actions, transitions.actions[donors], transitions.actions)
    next_states = th.where(of_states, transitions.next_states[donors], transitions.next_states)
    comes_along = exchanged & reads_part & ~reads_rest
    rewards = th.where(comes_along, transitions.rewards[donors], transitions.rewards)
    if reward_model is not None and bool(modelled.any()):
        rewards = th.where(modelled, reward_model(next_states, actions).to(rewards.dtype), rewards)
    return Exchange(Transitions(states, actions, next_states, rewards), exchanged, modelled)


def exchange_components(
    transitions: Transitions,
    components: Components,
    reward_model: RewardModel | None = None,
    keep: th.Tensor | None = None,
    generator: th.Generator | None = None,
) -> Exchange:
    """
    Exchange whole components between the transitions of a batch: pairs of rows swap each component with probability one half,
    so that each value is in the batch as often as before. Where all is one component, nothing changes.

    :param transitions: The batch
    :param components: What :func:`components_of` says of the graph
    :param reward_model: As in :func:`exchange_part`
    :param keep: As in :func:`exchange_part`
    :param generator: Random numbers, None for torch's own
    :return: the batch after the exchange
    """
    device, n_rows = transitions.states.device, len(transitions.states)
    labels = th.as_tensor(components.labels, dtype=th.long, device=device)
    partners, leaders = _pairs(n_rows, device, generator)
    drawn = (th.rand(n_rows, len(components.read), generator=generator, device=device) < 0.5)[leaders]
    read = th.as_tensor(components.read, device=device)[labels]
    # To take all is to be another row
    part = (drawn & ~drawn.all(dim=1, keepdim=True))[:, labels]
    return exchange_part(transitions, part, partners, read, reward_model, keep)


def _pairs(n_rows: int, device: th.device, generator: th.Generator | None) -> tuple[th.Tensor, th.Tensor]:
    """The partner of each row, itself where one is left over, and the row that speaks for both; each of shape (batch,)."""
    order = th.randperm(n_rows, generator=generator, device=device)
    first, second = order[: n_rows // 2], order[n_rows // 2 : 2 * (n_rows // 2)]
    partners, leaders = th.arange(n_rows, device=device), th.arange(n_rows, device=device)
    partners[first], partners[second], leaders[second] = second, first, first
    return partners, leaders


def exchange_locally(
    transitions: Transitions,
    world_model: "MaskedWorldModel",
    graph: "CausalGraph",
    threshold: float = 0.05,
    binding: float = BINDING,
    keep: th.Tensor | None = None,
    generator: th.Generator | None = None,
    reward_model: RewardModel | None = None,
    read: th.Tensor | None = None,
) -> Exchange:
    """
    Exchange what is independent at these transitions, where the graph of all of them is connected: objects that do not touch.

    A derivative of the world model is an edge at a transition. Pairs of rows swap the local component of a random variable,
    where it is cut off from the rest in both transitions and in both that result.

    :param transitions: The batch, in the world model's units, actions in [-1, 1]
    :param world_model: Trained on such transitions
    :param graph: Its graph, for what the reward reads
    :param threshold: Smallest derivative that counts, positive: in standard deviations of the change of the next state, per
        standard deviation of the cause
    :param binding: As in :func:`components_of`
    :param keep: As in :func:`exchange_part`
    :param generator: Random numbers, None for torch's own
    :param reward_model: Computes rewards, None for the world model
    :param read: Which states and actions the reward reads, boolean, shape (n + d,); None for what the graph says
    :return: the batch after the exchange
    :raises ValueError: when ``threshold`` is not positive
    """
    if not threshold > 0:
        raise ValueError(f"threshold must be positive, got {threshold!r}")
    device, n_rows = transitions.states.device, len(transitions.states)
    adjacency = local_edges(world_model, transitions.states, transitions.actions, threshold)
    labels = _local_labels(adjacency)
    n_causes = adjacency.shape[2]
    variables = th.randint(n_causes, (n_rows, 1), generator=generator, device=device)
    partners, leaders = _pairs(n_rows, device, generator)
    part = (labels == labels.gather(1, variables))[leaders]
    part &= ~part.all(dim=1, keepdim=True)
    cut_off = _is_cut_off(adjacency, part)
    part &= (cut_off & cut_off[partners]).unsqueeze(1)
    if read is None:
        read = th.as_tensor(_edges(graph)[-1] >= binding, device=device)

    def by_world_model(next_states: th.Tensor, actions: th.Tensor) -> th.Tensor:
        with th.no_grad():
            return world_model.predict_reward(next_states, actions)[0]

    proposed = exchange_part(transitions, part, partners, read, reward_model or by_world_model, keep)
    after = local_edges(world_model, proposed.transitions.states, proposed.transitions.actions, threshold)
    accepted = _is_cut_off(after, part) & proposed.exchanged
    accepted &= accepted[partners]
    merged = (
        th.where(accepted.view(-1, *[1] * (new.ndim - 1)), new, old)
        for new, old in zip(proposed.transitions, transitions, strict=True)
    )
    return Exchange(Transitions(*merged), accepted, proposed.modelled & accepted)


@th.no_grad()
def local_edges(world_model: "MaskedWorldModel", states: th.Tensor, actions: th.Tensor, threshold: float) -> th.Tensor:
    """
    :param world_model: The masked world model
    :param states: s in its units, shape (batch, n)
    :param actions: a in [-1, 1], shape (batch, d)
    :param threshold: Smallest derivative that counts, see :func:`exchange_locally`
    :return: whether each next state depends on each state and action there, boolean, shape (batch, n, n + d)
    """
    _, inputs = world_model._network_input(states, actions)
    unit = th.ones(world_model.state_dim, 1, device=states.device, dtype=inputs.dtype)
    _, jacobian = world_model.transition.forward_and_jacobian(inputs, world_model._transition_mask(), slice(None), unit)
    edges = jacobian.abs() >= threshold
    # The next value of a variable always belongs to itself
    edges.diagonal(dim1=1, dim2=2).fill_(True)
    return edges


def _square(edges: th.Tensor) -> th.Tensor:
    """Symmetric, shape (batch, n + d, n + d)."""
    n_rows, n_states, n_causes = edges.shape
    square = th.zeros(n_rows, n_causes, n_causes, dtype=th.bool, device=edges.device)
    square[:, :n_states] = edges
    return square | square.mT


def _local_labels(edges: th.Tensor) -> th.Tensor:
    """The smallest index in each variable's component, by propagation, shape (batch, n + d)."""
    square = _square(edges)
    n_causes = square.shape[1]
    square.diagonal(dim1=1, dim2=2).fill_(True)
    labels = th.arange(n_causes, device=edges.device).expand(len(edges), -1)
    while True:
        spread = th.where(square, labels.unsqueeze(1), n_causes).amin(dim=2)
        if th.equal(spread, labels):
            return labels
        labels = spread


def _is_cut_off(edges: th.Tensor, part: th.Tensor) -> th.Tensor:
    """Whether no edge joins a part, shape (batch, n + d), with the rest; shape (batch,)."""
    across = part[:, : edges.shape[1]].unsqueeze(2) ^ part.unsqueeze(1)
    return ~(edges & across).flatten(1).any(dim=1)
