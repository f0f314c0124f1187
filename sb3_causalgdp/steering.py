"""The causal model's view of observations, and how it steers a policy's samples."""

from collections.abc import Sequence

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import preprocess_obs
from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_causalgdp.causal import CausalGuidance, LinearisedGuidance, MaskedWorldModel
from sb3_causalgdp.causal.guidance import GUIDANCE_TARGETS
from sb3_causalgdp.diffusion import GuidanceRule
from sb3_causalgdp.extractors import StandardizedExtractor
from sb3_causalgdp.networks import Critic, DiffusionActor, q_values, weights_fixed
from sb3_causalgdp.saving.policies import SavedPolicy


class SteeredPolicy(SavedPolicy):
    """A policy with a world model."""

    actor: DiffusionActor
    actor_target: DiffusionActor
    critic: Critic
    critic_target: Critic
    """The critics themselves where they normalise batches."""
    world_model: MaskedWorldModel
    guidance_rule: GuidanceRule | None
    guidance_target: str
    state_guidance_scale: float
    outcome_guidance_scale: float
    discount: float
    reward_target: th.Tensor
    return_std: th.Tensor
    guidance_ready: th.Tensor
    leaf_sizes: list[int]
    has_image_state: bool
    """Whether the states are features of images."""

    def _state_dim(self) -> int:
        if self.has_image_state:
            return self.critic_target.features_extractor.features_dim
        return sum(self.leaf_sizes)

    def state_names(self) -> tuple[str, ...]:
        """
        :return: Names of the causal model's state variables, by the observation space's keys and indices
        """
        if self.has_image_state:
            return tuple(f"feature[{index}]" for index in range(self._state_dim()))
        names = list(self.observation_space.spaces) if isinstance(self.observation_space, spaces.Dict) else ["obs"]
        # The key "action" would give the names of the actions
        prefixes = [f"obs[{name}]" if name == "action" else name for name in names]
        sized = zip(prefixes, self.leaf_sizes, strict=True)
        return tuple(f"{prefix}[{index}]" for prefix, size in sized for index in range(size))

    @th.no_grad()
    def causal_state(self, observation: PyTorchObs) -> th.Tensor:
        """
        The variables of the causal model: the observation flattened (discrete parts one-hot), or, where there are images, the
        features of the target critic, through which no gradient flows.

        :param observation: Observations as SB3 gives them to policies
        :return: Shape ``(batch, n)``
        """
        if self.has_image_state:
            return self.critic_target.extract_features(observation, self.critic_target.features_extractor)
        preprocessed = preprocess_obs(observation, self.observation_space, normalize_images=self.normalize_images)
        if isinstance(self.observation_space, spaces.Dict):
            assert isinstance(preprocessed, dict)
            return th.cat([preprocessed[key].flatten(1) for key in self.observation_space.spaces], dim=1)
        assert isinstance(preprocessed, th.Tensor)
        return preprocessed.flatten(1)

    @th.no_grad()
    def exact_causal_state(self, observation: PyTorchObs) -> th.Tensor:
        """
        :meth:`causal_state` in double precision, for statistics and answers in the environment's units: far from 0, float32
        loses a small motion.

        :param observation: Observations as the environment gives them
        :return: float64, shape ``(batch, n)``
        """
        if self.has_image_state:
            return self.causal_state(observation).double()
        if isinstance(observation, dict):
            named = self.observation_space.spaces.items()  # type: ignore[attr-defined]
            return th.cat([_exactly(observation[key], space) for key, space in named], dim=1)
        return _exactly(observation, self.observation_space)

    def _features_of_state(self, state: th.Tensor, extractor: nn.Module) -> th.Tensor:
        """Features of predicted states, which have no observation: the inverse of :meth:`causal_state`."""
        if not isinstance(self.observation_space, spaces.Dict):
            return extractor(_as_observation(state, self.observation_space))
        named = self.observation_space.spaces.items()
        parts = state.split(self.leaf_sizes, dim=1)
        return extractor({key: _as_observation(part, space) for (key, space), part in zip(named, parts, strict=True)})

    def value_gradient(self, state: th.Tensor, action: th.Tensor, critic: int | None = None) -> th.Tensor:
        """
        Gradient of the target Q at a predicted state by the state.

        :param state: Shape ``(batch, n)``
        :param action: The action that follows, held fixed, shape ``(batch, d)``
        :param critic: The critic whose Q it is; None takes the smallest Q of all
        :return: Shape ``(batch, n)``, without a graph
        """
        networks = slice(None) if critic is None else slice(critic, critic + 1)
        with th.enable_grad(), weights_fixed(self.critic_target):
            state = state.detach().requires_grad_()
            features = state if self.has_image_state else self._features_of_state(state, self.critic_target.features_extractor)
            values = q_values(self.critic_target, features, action, networks)
            smallest = values[0] if len(values) == 1 else th.cat(values, dim=1).amin(dim=1)
            (gradient,) = th.autograd.grad(smallest.sum(), state)
        return gradient

    # Guidance -----------------------------------------------------------------------------------------------------------

    def _check_guidance_steps(self) -> None:
        n_steps = self.actor.schedule.n_steps
        if self.guidance_rule is not None and len(self.guidance_rule.scales) not in (1, n_steps):
            raise ValueError(
                f"guidance_scale must be one number or one for each of the {n_steps} diffusion steps, "
                f"got {len(self.guidance_rule.scales)} values"
            )

    def _check_attention(self) -> None:
        if not getattr(self.actor.denoiser, "causal", False):
            return
        extractor = self.actor.features_extractor
        plain = type(extractor) in (FlattenExtractor, CombinedExtractor, StandardizedExtractor)
        if self.has_image_state or not plain:
            raise ValueError(
                "denoiser_kwargs={'causal': True} needs observations that are vectors and no features extractor, got "
                f"{type(extractor).__name__} for {self.observation_space}"
            )

    def set_attention(self, masks: Sequence[th.Tensor]) -> None:
        """
        Let a denoiser look along a causal graph, where it was made to.

        :param masks: As :meth:`~sb3_causalgdp.causal.MaskedWorldModel.set_masks` takes them
        """
        for actor in (self.actor, self.actor_target):
            if getattr(actor.denoiser, "causal", False):
                actor.denoiser.set_graph(*masks)  # type: ignore[operator]

    @property
    def is_guided(self) -> bool:
        """Whether samples are steered: the guidance is on and the causal graph has been found."""
        return self.guidance_rule is not None and max(self.guidance_rule.scales) > 0.0 and bool(self.guidance_ready)

    def make_guidance(
        self, state: th.Tensor, next_state: th.Tensor, next_action: th.Tensor, critic: int | None = None
    ) -> CausalGuidance:
        """
        :param state: s, shape ``(batch, n)``
        :param next_state: s* that is wished for, shape ``(batch, n)``
        :param next_action: The action that would follow in s*, for the return target, shape ``(batch, d)``
        :param critic: The critic that the return target climbs; None takes the smallest Q of all
        :return: The guidance for these states
        """
        outcome = GUIDANCE_TARGETS[self.guidance_target](self, next_action, critic)
        return CausalGuidance(
            self.world_model, state, next_state, outcome, self.state_guidance_scale, self.outcome_guidance_scale
        )

    def acting_guidance(self, state: th.Tensor, action: th.Tensor, actor: DiffusionActor | None = None) -> LinearisedGuidance:
        """
        Guidance where the next state is not known: s* is the model's own prediction for an action, about which the guidance is
        linear, so that the world model is evaluated once and not at every diffusion step.

        :param state: s, shape ``(batch, n)``
        :param action: The best candidate, shape ``(batch, d)``
        :param actor: That of the actors that acts, None for the one that learns
        :return: The guidance for these states
        """
        actor = self.actor if actor is None else actor
        response = self.world_model.action_response(state, action, of_all=False)
        next_state = response.next_state
        next_action = action
        if self.guidance_target != "reward" and not self.has_image_state:
            features = self._features_of_state(next_state, actor.features_extractor)
            # The next state is near: one step of the denoiser stands for a chain
            next_action = actor.adapt(features, action)
        return LinearisedGuidance(self.make_guidance(state, next_state, next_action), action, response)


def leaf_spaces(space: spaces.Space) -> list[spaces.Space]:
    """
    :param space: Of observations
    :return: The spaces of a dictionary, or the space alone
    """
    return list(space.spaces.values()) if isinstance(space, spaces.Dict) else [space]


def _exactly(values: th.Tensor, space: spaces.Space) -> th.Tensor:
    if not isinstance(space, spaces.Box):
        values = preprocess_obs(values, space)  # type: ignore[assignment]
    return values.double().flatten(1)


def _as_observation(state: th.Tensor, space: spaces.Space) -> th.Tensor:
    """A box has its own shape; what is not a box has been preprocessed to a vector."""
    return state.reshape(-1, *space.shape) if isinstance(space, spaces.Box) else state
