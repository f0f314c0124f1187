"""Counterfactual data in the batches of gradient steps: transitions that exchange what does not influence each other."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_causalgdp.causal.counterfactual_batches import (
    Components,
    Exchange,
    RewardModel,
    Transitions,
    exchange_components,
    exchange_locally,
    local_edges,
)
from sb3_causalgdp.causal.graph import CausalGraph

THRESHOLD = 0.05  # of derivatives, see exchange_locally
Model = Any  # a CausalGDP, whose file imports this one


class CounterfactualReplay:
    """
    Exchanges components of the causal graph between transitions of a batch, as much of it as ``counterfactual_replay`` says,
    once two graphs in a row are trusted. Half of these rows may exchange what is independent at their states alone, by the
    world model's derivatives, where the largest component holds several states.

    :param model: The model, a ``CausalGDP``
    """

    # Local components of more variables take longer than the update
    MOST_LOCAL_VARIABLES = 64
    # Of the reward model, in standard deviations of the rewards: what it does not know better is left as it is
    LARGEST_REWARD_ERROR = 0.2

    # Of the world model, before its derivatives are believed
    LEAST_BATCHES = 1_000
    ASKED_ROWS = 256

    def __init__(self, model: Model) -> None:
        self.model = model
        self._asked_of: CausalGraph | None = None
        self._knows_edges = False

    @th.no_grad()
    def exchanged(self, sample: Any) -> Any:
        """
        :param sample: Sample of a replay buffer, of single steps
        :return: The same size; rows at random places hold parts of others
        """
        share = self.model.counterfactual_replay
        components = self._components() if share > 0.0 else None
        n_rows = 2 * round(share * len(sample.rewards) / 2)
        if components is None or n_rows == 0:
            return sample
        rows = th.randperm(len(sample.rewards), device=sample.rewards.device)[:n_rows]
        n_local = n_rows // 4 * 2 if self._looks_locally(components, sample, rows) else 0
        parts = []
        for part, is_local in ((rows[n_local:], False), (rows[:n_local], True)):
            if len(part) > 0:
                parts.append((part, self._exchange(sample, part, components, is_local)))
        n_exchanged = sum(exchange.exchanged.sum() for _, exchange in parts)
        self.model.logger.record_mean("causal/exchanged_share", float(n_exchanged) / len(sample.rewards))
        return self._written(sample, parts)

    def _components(self) -> Components | None:
        components = self.model.trusted_components.components
        if components is None or self._goals() is None:
            return components
        # By its definition, not by the graph
        read = np.zeros_like(components.read)
        read[components.labels[self._goals()]] = True
        return Components(components.labels, read)

    def _goals(self) -> np.ndarray | None:
        """Indices of the goals among the states, where rewards are those of hindsight goals."""
        if not isinstance(self.model.replay_buffer, HerReplayBuffer):
            return None
        names = self.model.policy.state_names()
        return np.array([i for i, name in enumerate(names) if name.startswith(("achieved_goal", "desired_goal"))])

    def _looks_locally(self, components: Components, sample: Any, rows: th.Tensor) -> bool:
        world_model, graph = self.model.world_model, self.model.causal_graph()
        n_states, n_causes = world_model.state_dim, len(components.labels)
        largest = np.bincount(components.labels[:n_states]).max()
        if largest < 2 or n_causes > self.MOST_LOCAL_VARIABLES:
            return False
        if self._asked_of is not graph:
            # Once for each graph: derivatives that miss an edge everywhere are not those of the world
            rows = rows[: self.ASKED_ROWS]
            states, actions = self._states(sample.observations, rows).float(), sample.actions[rows].float()
            found = local_edges(world_model, states, actions, THRESHOLD).any(dim=0).cpu().numpy()
            is_trained = bool(world_model.n_batches >= self.LEAST_BATCHES)
            self._knows_edges = is_trained and bool(found[graph.masks[:-1] > 0.5].all())
            self._asked_of = graph
        return self._knows_edges

    def _exchange(self, sample: Any, rows: th.Tensor, components: Components, is_local: bool) -> Exchange:
        model = self.model
        states, next_states = (self._states(part, rows) for part in (sample.observations, sample.next_observations))
        transitions = Transitions(states, sample.actions[rows], next_states, sample.rewards[rows].flatten())
        # Nobody knows what an end depends on
        keep = sample.dones[rows].flatten() > 0.0
        reward_model = self._reward_model()
        if not is_local:
            return exchange_components(transitions, components, reward_model, keep)
        read = None if self._goals() is None else th.as_tensor(components.read[components.labels], device=states.device)
        transitions = Transitions(*(values.float() for values in transitions))
        proposed = exchange_locally(
            transitions, model.world_model, model.causal_graph(), THRESHOLD, keep=keep, reward_model=reward_model, read=read
        )
        if reward_model is not None or not bool(proposed.modelled.any()):
            return proposed
        return _without(proposed, transitions, proposed.modelled)

    def _reward_model(self) -> RewardModel | None:
        buffer, world_model = self.model.replay_buffer, self.model.world_model
        if not isinstance(buffer, HerReplayBuffer):
            knows_rewards = float(world_model.reward_log_std.exp()) <= self.LARGEST_REWARD_ERROR
            return self._predicted_reward if knows_rewards else None
        # What the infos of exchanged transitions would be is not known
        return None if buffer.copy_info_dict or buffer.env is None else self._reward_of_goals

    def _predicted_reward(self, next_states: th.Tensor, actions: th.Tensor) -> th.Tensor:
        return self.model.world_model.predict_reward(next_states.float(), actions.float())[0]

    def _reward_of_goals(self, next_states: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """As SB3's HerReplayBuffer computes it for goals that it sets."""
        model, normalizer = self.model, self.model._vec_normalize_env
        observations = {key: values.cpu().numpy() for key, values in self._observations(next_states).items()}
        if normalizer is not None:
            observations = normalizer.unnormalize_obs(observations)
        goals = (observations["achieved_goal"], observations["desired_goal"])
        infos: list[dict[str, Any]] = [{} for _ in range(len(next_states))]
        rewards = model.replay_buffer.env.env_method("compute_reward", *goals, infos, indices=[0])[0]
        rewards = model.replay_buffer._normalize_reward(np.asarray(rewards, dtype=np.float32).reshape(-1, 1), normalizer)
        return th.as_tensor(rewards, device=next_states.device).flatten()

    def _states(self, observations: Any, rows: th.Tensor) -> th.Tensor:
        """As ``policy.causal_state``, of boxes, in their own precision."""
        if not isinstance(observations, dict):
            return observations[rows].flatten(1)
        return th.cat([observations[key][rows].flatten(1) for key in self.model.observation_space.spaces], dim=1)

    def _observations(self, states: th.Tensor) -> Any:
        """The inverse of :meth:`_states`."""
        space = self.model.observation_space
        if not isinstance(space, spaces.Dict):
            return states.reshape(-1, *space.shape)
        parts = states.split(self.model.policy.leaf_sizes, dim=1)
        return {
            key: part.reshape(-1, *(box.shape or ())) for (key, box), part in zip(space.spaces.items(), parts, strict=True)
        }

    def _written(self, sample: Any, parts: list[tuple[th.Tensor, Exchange]]) -> Any:
        rows = th.cat([part[exchange.exchanged] for part, exchange in parts])
        kept = [[values[one.exchanged] for values in one.transitions] for _, one in parts]
        states, actions, next_states, rewards = (th.cat(column) for column in zip(*kept, strict=True))
        return sample._replace(
            observations=_with_rows(sample.observations, rows, self._observations(states)),
            actions=_with_rows(sample.actions, rows, actions),
            next_observations=_with_rows(sample.next_observations, rows, self._observations(next_states)),
            rewards=_with_rows(sample.rewards, rows, rewards.unsqueeze(1)),
        )


def check_exchangeable(policy: Any) -> None:
    """
    :param policy: The policy of a model with ``counterfactual_replay``
    :raises ValueError: If observations are no vectors of numbers, whose entries could be exchanged
    """
    space = policy.observation_space
    leaves = space.spaces.values() if isinstance(space, spaces.Dict) else (space,)
    if policy.has_image_state or not all(isinstance(leaf, spaces.Box) for leaf in leaves):
        raise ValueError(f"counterfactual_replay must be 0 where observations are not boxes of numbers, got {space}")


def _without(exchange: Exchange, before: Transitions, rows: th.Tensor) -> Exchange:
    """Some rows as they were; their partners stay as they are."""
    merged = (
        th.where(rows.view(-1, *[1] * (new.ndim - 1)), old, new) for new, old in zip(exchange.transitions, before, strict=True)
    )
    return Exchange(Transitions(*merged), exchange.exchanged & ~rows, exchange.modelled & ~rows)


def _with_rows(part: Any, rows: th.Tensor, new: Any) -> Any:
    if isinstance(part, dict):
        return {key: _with_rows(values, rows, new[key]) for key, values in part.items()}
    return part.index_copy(0, rows, new.to(part.dtype))
