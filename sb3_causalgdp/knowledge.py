"""What a model knows of the causal structure, and which transitions it knows it from."""

import io
import pathlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_causalgdp.arguments import check_keywords
from sb3_causalgdp.causal import (
    CausalGraph,
    RelevanceGate,
    Statistics,
    TransitionVariables,
    Verdict,
    make_discovery,
    make_statistics,
)
from sb3_causalgdp.causal.endings import with_endings
from sb3_causalgdp.causal.trusted_components import TrustedComponents
from sb3_causalgdp.causal.world_model import MaskedWorldModel
from sb3_causalgdp.counterfactual import check_exchangeable
from sb3_causalgdp.names import found_names
from sb3_causalgdp.offline.algorithm import OfflineToOnlineAlgorithm
from sb3_causalgdp.policies import CausalGDPPolicy, DiffusionActor
from sb3_causalgdp.sources.chunks import Source
from sb3_causalgdp.sources.rewards import RewardTransform
from sb3_causalgdp.updates import Updates

SelfAlgorithm = TypeVar("SelfAlgorithm", bound="DiscoveringAlgorithm")


class DiscoveringAlgorithm(OfflineToOnlineAlgorithm):
    """
    An algorithm that discovers a causal graph from its transitions and writes it into the masks of its world model.

    :param args: As for :class:`~sb3_causalgdp.offline.algorithm.OfflineToOnlineAlgorithm`
    :param kwargs: As for :class:`~sb3_causalgdp.offline.algorithm.OfflineToOnlineAlgorithm`
    """

    policy: CausalGDPPolicy
    actor: DiffusionActor
    world_model: MaskedWorldModel
    causal_discovery: str | Callable[..., CausalGraph]
    causal_discovery_kwargs: dict[str, Any]
    causal_half_life: float | None
    causal_window: int | None
    state_names: Sequence[str] | None
    action_names: Sequence[str] | None
    causal_abstraction: bool | str | dict[str, Any]
    relevance_gate: RelevanceGate | None
    """The verdict on what actor and critics see; None without ``causal_abstraction``."""
    counterfactual_replay: float
    trusted_components: TrustedComponents
    """What transitions may exchange, judged where ``counterfactual_replay`` is above 0."""
    _updates: Updates

    GRAPHS_IN_HISTORY = 32

    def __init__(self, *args, **kwargs) -> None:
        super().__init__(*args, **kwargs)
        # Saved with the model
        self.causal_statistics: Statistics | None = None
        self._statistics_made_by: list[Any] | None = None
        self._causal_graph: CausalGraph | None = None
        self.causal_graph_history: list[CausalGraph] = []
        self._relevance_verdict: dict[str, Any] | None = None
        self._exchangeable: dict[str, Any] | None = None
        self._steps_since_refresh = 0
        # Positions of the replay buffer that were ever written, and how many of them the statistics have seen
        self._stored_position = 0
        self._fed_position = 0
        # The same of the preloaded transitions, and which these were
        self._fed_offline_position = 0
        self._fed_marks: list[str] = []

    def set_causal_graph(self, graph: CausalGraph) -> None:
        """
        Write a causal graph into the masks of the world model and let it steer the sampling. The graphs of up to 32 moments of
        the training are in ``causal_graph_history``, saved on request: ``save(path, include=["causal_graph_history"])``.

        :param graph: The graph, on this model's variables
        :raises ValueError: If the graph is about other variables
        """
        if graph.variables == self._indices:
            # Found on a buffer, which has no names
            graph = replace(graph, variables=self.transition_variables)
        if graph.variables != self.transition_variables:
            raise ValueError(
                f"The graph is about {graph.variables.names}, but this model's variables are {self.transition_variables.names}"
            )
        arrays = (graph.state_to_state, graph.action_to_state, graph.state_to_reward, graph.action_to_reward)
        masks = [th.as_tensor(mask, dtype=th.float32, device=self.device) for mask in arrays]
        self.world_model.set_masks(*masks)
        self.policy.set_attention(masks)
        self.policy.guidance_ready.fill_(1.0)
        self._causal_graph = graph
        self.causal_graph_history.append(graph)
        if len(self.causal_graph_history) > self.GRAPHS_IN_HISTORY:
            # Every second one goes, so that what is left spans the whole training; the newest stays
            self.causal_graph_history = self.causal_graph_history[::-2][::-1]

    def progress_parts(self) -> list[str]:
        """
        :return: What the progress bar says, the most important first: returns, edges and age of the causal graph
        """
        graph = self._causal_graph
        if graph is None or graph.num_timesteps is None:
            return [*super().progress_parts(), "no graph yet"]
        edges = "1 edge" if graph.n_edges == 1 else f"{graph.n_edges} edges"
        age = self.n_environment_steps - graph.num_timesteps
        return [*super().progress_parts(), edges, f"graph {age:,} steps old"]

    def judge_relevance(self, graph: CausalGraph, ends: np.ndarray | None = None) -> Verdict | None:
        """
        Let the gate judge by a new graph, and hide what it has closed from actor and critics.

        :param graph: On this model's variables
        :param ends: Which states are known to end episodes, boolean, shape ``(n,)``; these matter, too
        :return: The verdict, None without ``causal_abstraction``
        """
        gate = self.relevance_gate
        if gate is None:
            return None
        if ends is not None:
            graph = with_endings(graph, ends)
        # Where no state is known to matter, as before a sparse reward was seen, all that was found may be a cost of actions
        is_known = bool((graph.relevance().states > gate.high).any())
        verdict = gate.update(graph, reward_varied=is_known, keep_open=self._never_hidden())
        self._relevance_verdict = gate.state_dict()
        self.policy.show(th.as_tensor(verdict.states), th.as_tensor(verdict.actions))
        return verdict

    def judge_components(self, graph: CausalGraph, ends: np.ndarray | None = None) -> str:
        """
        Judge by a new graph what transitions may exchange.

        :param graph: On this model's variables
        :param ends: Which states are known to end episodes, boolean, shape ``(n,)``
        :return: Why nothing may be exchanged by this graph, empty if it is trusted
        """
        untrusted = self.trusted_components.update(graph, ends, isinstance(self.replay_buffer, HerReplayBuffer))
        self._exchangeable = self.trusted_components.state_dict()
        return untrusted

    def _setup_exchange(self) -> None:
        self.trusted_components = TrustedComponents(self.transition_variables)
        if self.counterfactual_replay == 0.0:
            self._exchangeable = None
            return
        check_exchangeable(self.policy)
        if self._exchangeable is not None:
            self.trusted_components.load_state_dict(self._exchangeable)

    def _never_hidden(self) -> list[str]:
        names, indices = self.transition_variables, self._indices
        kept = list(self._abstraction_options()[1])
        keys = self.observation_space.spaces if isinstance(self.observation_space, spaces.Dict) else ()
        if "desired_goal" in keys:
            # The reward reads them, also where no episode has come near a goal yet
            goals = ("desired_goal[", "achieved_goal[")
            pairs = zip(indices.state_names, names.state_names, strict=True)
            kept += [name for index, name in pairs if index.startswith(goals)]
        if self.policy.exploration_noise == 0.0 and self.action_noise is None:
            # What never moves again is never found to matter
            kept += names.action_names
        return kept

    def _abstraction_options(self) -> tuple[dict[str, Any], Sequence[str]]:
        """Arguments of the gate, and what it keeps open."""
        options = dict(self.causal_abstraction) if isinstance(self.causal_abstraction, dict) else {}
        keep_open = options.pop("keep_open", ())
        return options, keep_open

    def _setup_abstraction(self) -> None:
        self.relevance_gate = None
        if not self.policy.causal_abstraction:
            self._relevance_verdict = None
            return
        options, keep_open = self._abstraction_options()
        check_keywords("causal_abstraction", options, RelevanceGate)
        if isinstance(keep_open, str) or not isinstance(keep_open, Sequence):
            raise ValueError(f"causal_abstraction: keep_open must be a list of names of states and actions, got {keep_open!r}")
        variables = self.transition_variables
        names = {*variables.state_names, *variables.action_names}
        unknown = [name for name in keep_open if name not in names]
        if unknown:
            raise ValueError(f"causal_abstraction: keep_open must be names among {sorted(names)}, got {unknown}")
        try:
            gate = RelevanceGate(variables, **options)
        except (TypeError, ValueError) as error:
            raise ValueError(f"causal_abstraction: {error}") from error
        if self._relevance_verdict is not None:
            # A loaded model goes on, with the arguments that it has now
            saved = RelevanceGate.from_state_dict({**self._relevance_verdict, **gate.settings})
            if saved.variables != variables:
                raise ValueError(f"its relevance gate is of other variables: {saved.names}")
            gate = saved
        self.relevance_gate = gate

    def _setup_discovery(self) -> None:
        try:
            self.discovery = make_discovery(self.causal_discovery, **self.causal_discovery_kwargs)
        except (TypeError, ValueError) as error:
            raise ValueError(f"causal_discovery_kwargs: {error}") from error
        self.transition_variables = self._named_variables()
        self._setup_abstraction()
        self._setup_exchange()
        method = self.causal_discovery
        # A callable that was saved is not the same object when it is loaded
        name = method if isinstance(method, str) else getattr(method, "__qualname__", type(method).__qualname__)
        forgetting = (self.causal_half_life, self.causal_window)
        made_by = [name, self.causal_discovery_kwargs, *forgetting]  # a list, as it comes back from the zip
        if self.causal_statistics is None or self._statistics_made_by != made_by:
            # Another method, which load() may have brought, gathers anew from the replay buffer
            self._forget_statistics()
            self._statistics_made_by = made_by

    def _forget_statistics(self) -> None:
        self.causal_statistics = self._new_statistics()
        self._fed_position = self._fed_offline_position = 0
        self._fed_marks = []

    def _named_variables(self) -> TransitionVariables:
        """By the names that were given, the environment's own, or indices."""
        if self._statistics_made_by is None:
            # A loaded model keeps the names under which it was trained
            found = found_names(self.env)
            is_known = not self.policy.has_image_state and len(found[0] or ()) == len(self.policy.state_names())
            self.state_names = self.state_names or (found[0] if is_known else None)
            self.action_names = self.action_names or found[1]
        states, actions = self.policy.state_names(), tuple(f"action[{index}]" for index in range(self.actor.action_dim))
        for argument, indices in (("state_names", states), ("action_names", actions)):
            names = getattr(self, argument)
            if names is not None and len(names) != len(indices):
                raise ValueError(f"{argument} must be {len(indices)} names, got {len(names)}: {list(names)}")
        # Users may say either
        self._indices = TransitionVariables(states, actions)
        return TransitionVariables(tuple(self.state_names or states), tuple(self.action_names or actions))

    def _new_statistics(self) -> Statistics:
        try:
            return make_statistics(self.discovery, self.transition_variables, self.causal_half_life, self.causal_window)
        except ValueError as error:
            raise ValueError(f"causal_half_life and causal_window: {error}") from error

    # Which transitions the statistics have seen ---------------------------------------------------------------------------

    def _store_transition(self, replay_buffer, buffer_action, new_obs, reward, dones, infos) -> None:
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
        self._stored_position += 1

    def preload(self: SelfAlgorithm, source: Any, *args, **kwargs) -> SelfAlgorithm:
        first = 0 if self.offline_buffer is None else self.offline_buffer.size()
        super().preload(source, *args, **kwargs)
        assert self.offline_buffer is not None
        self._updates.batches.forget_preloaded()
        if self._offline_marks[-1] in self._fed_marks and self._fed_offline_position == first:
            # A loaded model, whose statistics know these rows
            self._fed_offline_position = self.offline_buffer.size()
        return self

    def _check_names(self, data: Source) -> None:
        variables = self.transition_variables
        for what, given, own in (
            ("states", data.state_names, variables.state_names),
            ("actions", data.action_names, variables.action_names),
        ):
            # The values of a text column are coded against its most frequent one: level=high
            common = {name.partition("=")[0] for name in given or ()} & {name.partition("=")[0] for name in own}
            if common and tuple(given or ()) != tuple(own):
                raise ValueError(
                    f"{data.name}: {what} must be {list(own)}, in this order, as the model has them, got {list(given or ())}"
                )

    def _transform_collected(self, transform: RewardTransform) -> None:
        super()._transform_collected(transform)
        self._forget_statistics()

    def load_replay_buffer(
        self, path: str | pathlib.Path | io.BufferedIOBase, truncate_last_traj: bool = True, *, trusted: bool = False
    ) -> None:
        super().load_replay_buffer(path, truncate_last_traj, trusted=trusted)
        assert self.replay_buffer is not None
        if self.replay_buffer is not self.offline_buffer:
            # A buffer that was saved later than the model, or by another
            self._stored_position = max(self._stored_position, self.replay_buffer.size())
        self._fed_offline_position = 0
        if self.offline_buffer is not None and all(mark in self._fed_marks for mark in self._offline_marks):
            self._fed_offline_position = self.offline_buffer.size()

    def _fitting(self, buffer: ReplayBuffer, name: str) -> ReplayBuffer:
        fitting = super()._fitting(buffer, name)
        if fitting is not buffer:
            # The newest rows are no longer at the newest positions: the few that the statistics have not seen are lost to them
            self._fed_position = self._stored_position
        return fitting
