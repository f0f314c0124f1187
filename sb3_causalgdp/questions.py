"""What a user asks a model: interventions, effects of actions, counterfactuals, in the environment's own units."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_causalgdp.causal import (
    ActionEffects,
    CausalGraph,
    Counterfactual,
    InterventionalDistribution,
    StructuralModel,
    TransitionVariables,
)
from sb3_causalgdp.causal.interventions import ActionRule
from sb3_causalgdp.causal.rows import as_numbers
from sb3_causalgdp.causal.world_model import MaskedWorldModel
from sb3_causalgdp.offline.algorithm import OfflineToOnlineAlgorithm
from sb3_causalgdp.policies import CausalGDPPolicy
from sb3_causalgdp.sources.columns import columns_of, is_frame

Observations = np.ndarray | dict[str, np.ndarray]


class AskedAlgorithm(OfflineToOnlineAlgorithm):
    """An algorithm whose policy has a world model and a causal graph that can be asked."""

    policy: CausalGDPPolicy
    world_model: MaskedWorldModel
    transition_variables: TransitionVariables
    _indices: TransitionVariables
    _causal_graph: CausalGraph | None

    def causal_graph(self) -> CausalGraph:
        """
        :return: What causes what, as last discovered; every edge is open before the first discovery
        """
        return self._causal_graph or CausalGraph.fully_connected(self.transition_variables)

    def structural_model(self) -> StructuralModel:
        """
        The world model as a structural causal model in the environment's own units, on which interventions, effects and
        counterfactuals are computed.

        With ``VecNormalize``, set its environment first (``set_env``): the model's statistics are read from it.

        :return: The structural model; later training changes its answers
        :raises RuntimeError: If the world model has not been trained
        """
        return make_structural_model(self.policy, self.transition_variables, self._vec_normalize_env)

    def intervene(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        action: npt.ArrayLike,
        interventions: Mapping[str, npt.ArrayLike],
        n_samples: int | None = None,
    ) -> InterventionalDistribution:
        """
        The distribution of the next state and of the reward under do(...), like
        ``model.intervene(obs, action, {"torque": 0.5, "vel angle'": 1.0})``; ``action[0]`` is understood, too.

        :param observation: One observation or a batch, as the environment gives it: not normalised by ``VecNormalize``
        :param action: The action of each, within the bounds of the action space
        :param interventions: Values by name (see ``model.transition_variables.names``), in the environment's units
        :param n_samples: Samples of the next state for the reward's uncertainty, None for the delta method
        :return: See :meth:`~sb3_causalgdp.causal.StructuralModel.intervene`
        """
        model = self.structural_model()
        states, actions = self._states_of(observation), self._actions_of(action)
        return model.intervene(states, actions, self._by_name(interventions), n_samples)

    def effect_of_actions(
        self,
        observations: np.ndarray | dict[str, np.ndarray],
        actions: npt.ArrayLike,
        delta: npt.ArrayLike | None = None,
    ) -> ActionEffects:
        """
        How strongly each action component moves the reward, direct and through the next state, and each next state variable.

        :param observations: A batch of observations, as the environment gives them: not normalised by ``VecNormalize``
        :param actions: The action of each, within the bounds of the action space
        :param delta: Change of the action, in the environment's units; None for the derivative
        :return: Averages over the observations, see :meth:`~sb3_causalgdp.causal.StructuralModel.effect_of_actions`
        """
        model = self.structural_model()
        return model.effect_of_actions(self._states_of(observations), self._actions_of(actions), delta)

    def counterfactual(
        self,
        trajectory: tuple[Any, npt.ArrayLike, npt.ArrayLike],
        changes: Mapping[str, npt.ArrayLike | ActionRule],
        follow_policy: bool = False,
    ) -> Counterfactual:
        """
        What would have happened in a recorded episode had other actions been taken, under the same noise, like
        ``model.counterfactual((observations, actions, rewards), {"torque": 0.0})``.

        :param trajectory: T + 1 observations, T actions and T rewards of one episode, as the environment gives them: not
            normalised by ``VecNormalize``
        :param changes: For each changed action component a number, T values or a function, see
            :meth:`~sb3_causalgdp.causal.StructuralModel.counterfactual`
        :param follow_policy: Whether this model's policy reacts to the counterfactual states with the components that are not
            changed, its deviation from the recorded actions being replayed; by default they stay as recorded
        :return: States, actions, rewards and noise, in the environment's units
        """
        model = self.structural_model()
        if not isinstance(trajectory, tuple | list) or len(trajectory) != 3:
            raise ValueError(
                "trajectory must be (observations, actions, rewards) of one episode, T + 1 and twice T of them, got "
                f"{type(trajectory).__name__}"
            )
        observations, actions, rewards = trajectory
        recorded = (self._states_of(observations), self._actions_of(actions), rewards)
        policy = StatePolicy(self.policy, self._vec_normalize_env) if follow_policy else None
        return model.counterfactual(recorded, self._by_name(changes), policy)

    def _by_name(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """What has the index of a variable gets its name."""
        if not hasattr(values, "items"):
            like = f"{{{self.transition_variables.action_names[0]!r}: 1.0}}"
            raise ValueError(f"values must be given by name, like {like}, got {values!r}")
        names = dict(zip(self._indices.names, self.transition_variables.names, strict=True))
        return {
            name if name in self.transition_variables.names else names.get(name, name): value for name, value in values.items()
        }

    def _states_of(self, observation: Any) -> np.ndarray:
        if is_frame(observation) and not (
            isinstance(self.observation_space, spaces.Box) and len(self.observation_space.shape) == 1
        ):
            raise ValueError(f"a table of observations needs a Box of one dimension, got {self.observation_space}")
        rows = _by_column("observation", observation, self.transition_variables.state_names)
        return states_of(self.policy, rows, self._vec_normalize_env)

    def _actions_of(self, action: Any) -> np.ndarray:
        return actions_of(self.policy, _by_column("action", action, self.transition_variables.action_names))


# Between SB3's observations and the structural model's rows: normalisation, dictionaries, one observation or many --------


def make_structural_model(
    policy: CausalGDPPolicy, variables: TransitionVariables, normalizer: VecNormalize | None = None
) -> StructuralModel:
    """
    The policy's world model with the maps to the environment's units.

    :param policy: The policy
    :param variables: Names of its states and actions
    :param normalizer: What normalised the observations and rewards that the world model has seen; its statistics are read now
    :return: The structural model; for images its states are features, which have no other unit
    :raises RuntimeError: If the world model has seen no data
    """
    if policy.world_model.n_batches == 0:
        raise RuntimeError("The world model has not been trained: call learn() until after learning_starts, or train(), first")
    assert isinstance(policy.action_space, spaces.Box)
    low, high = policy.action_space.low.flatten(), policy.action_space.high.flatten()
    if normalizer is None:
        return StructuralModel(policy.world_model, variables, low, high)
    offset, scale, clip = (0.0, 1.0, np.inf) if policy.has_image_state else _state_maps(policy, normalizer)
    reward_scale = float(np.sqrt(normalizer.ret_rms.var + normalizer.epsilon)) if normalizer.norm_reward else 1.0
    return StructuralModel(policy.world_model, variables, low, high, offset, scale, clip, reward_scale)


def _state_maps(policy: CausalGDPPolicy, normalizer: VecNormalize) -> tuple[npt.ArrayLike, npt.ArrayLike, npt.ArrayLike]:
    """Offset, scale and clip of each state variable."""
    if not normalizer.norm_obs:
        return 0.0, 1.0, np.inf
    space = policy.observation_space
    parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    columns = []
    for key, part in parts.items():
        size = spaces.flatdim(part)
        statistics = normalizer.obs_rms.get(key) if isinstance(normalizer.obs_rms, dict) else normalizer.obs_rms
        if statistics is None:
            columns.append((np.zeros(size), np.ones(size), np.full(size, np.inf)))
        else:
            scale = np.sqrt(statistics.var + normalizer.epsilon)
            columns.append((statistics.mean.flatten(), scale.flatten(), np.full(size, normalizer.clip_obs)))
    offset, scale, clip = (np.concatenate(values) for values in zip(*columns, strict=True))
    return offset, scale, clip


def _by_column(what: str, values: Any, names: Sequence[str]) -> Any:
    """Rows of a data frame in the order of the variables; anything else as it is."""
    if not is_frame(values):
        return values
    columns = columns_of(values)
    missing = [name for name in names if name not in columns]
    if missing:
        raise ValueError(f"{what} must have the columns {list(names)}, got {list(columns)}")
    return np.column_stack([columns[name] for name in names])


def states_of(policy: CausalGDPPolicy, observation: Any, normalizer: VecNormalize | None = None) -> np.ndarray:
    """
    :param policy: The policy
    :param observation: As the environment gives it, not normalised: one, a batch, or a list of them
    :param normalizer: Normalises the observation where the state is its features
    :return: The causal model's state in the environment's units, shape ``(n,)`` for one observation, else ``(batch, n)``
    """
    if isinstance(observation, (list, tuple)) and len(observation) > 0 and isinstance(observation[0], dict):
        observation = {key: np.stack([one[key] for one in observation]) for key in observation[0]}
    if not isinstance(observation, dict):
        observation = np.asarray(observation)
    if policy.has_image_state and normalizer is not None:
        observation = normalizer.normalize_obs(observation)
    policy.set_training_mode(False)
    tensor, is_batch = policy.obs_to_tensor(observation)
    states = policy.exact_causal_state(tensor).cpu().numpy()
    return states if is_batch else states[0]


def actions_of(policy: CausalGDPPolicy, action: npt.ArrayLike) -> np.ndarray:
    """
    :param policy: The policy
    :param action: One action of the environment, or a batch
    :return: Flattened, shape ``(d,)`` for one action, else ``(batch, d)``
    :raises ValueError: If the shape is not that of the action space
    """
    actions, shape = as_numbers("actions", action), policy.action_space.shape
    assert shape is not None
    if actions.shape == shape:
        return actions.flatten()
    if actions.shape[1:] != shape:
        raise ValueError(f"Actions must have the shape {shape} or (batch, {', '.join(map(str, shape))}), got {actions.shape}")
    return actions.reshape(len(actions), -1)


class StatePolicy:
    """
    The policy's deterministic action at a state of the causal model.

    :param policy: The policy; its observations must be boxes that are no images, whose states are the observations themselves
    :param normalizer: Normalises the observations for it
    :raises ValueError: If a state has no observation
    """

    def __init__(self, policy: CausalGDPPolicy, normalizer: VecNormalize | None = None) -> None:
        space = policy.observation_space
        parts = list(space.spaces.values()) if isinstance(space, spaces.Dict) else [space]
        if policy.has_image_state or not all(isinstance(part, spaces.Box) for part in parts):
            raise ValueError(f"The policy cannot act in predicted states: they do not make an observation of {space}")
        self.policy = policy
        self.normalizer = normalizer

    def __call__(self, state: np.ndarray) -> np.ndarray:
        """
        :param state: In the environment's units, shape ``(n,)``
        :return: Action of the environment, shape ``(d,)``
        """
        space = self.policy.observation_space
        observation: Observations
        if isinstance(space, spaces.Dict):
            ends = np.cumsum([spaces.flatdim(part) for part in space.spaces.values()])
            pieces = np.split(state, ends[:-1])
            observation = {
                key: piece.reshape(part.shape) for (key, part), piece in zip(space.spaces.items(), pieces, strict=True)
            }
        else:
            observation = state.reshape(space.shape)
        if self.normalizer is not None:
            observation = self.normalizer.normalize_obs(observation)
        return self.policy.predict(observation, deterministic=True)[0].flatten()  # type: ignore[arg-type]
