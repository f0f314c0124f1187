"""Networks of CausalGDP, what they are fed and how they are guided, as one SB3 policy."""

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, preprocess_obs
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
    get_actor_critic_arch,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_causalgdp.abstraction import forget_inputs, forget_outputs, forget_rows
from sb3_causalgdp.acceleration.acting import NumpyActing, OnePassActing
from sb3_causalgdp.acceleration.activations import fast
from sb3_causalgdp.arguments import POLICY_ARGUMENTS, check_arguments, check_keywords
from sb3_causalgdp.causal import (
    CausalGuidance,
    LinearisedGuidance,
    MaskedWorldModel,
    ReturnTarget,
    RewardTarget,
    TransitionVariables,
)
from sb3_causalgdp.causal.guidance import OutcomeTarget
from sb3_causalgdp.checks import is_finite
from sb3_causalgdp.diffusion import GuidanceRule, MLPDenoiser
from sb3_causalgdp.divergence import TrainingDivergedError
from sb3_causalgdp.export import export_policy
from sb3_causalgdp.extractors import StandardizedExtractor
from sb3_causalgdp.networks import Critic, DiffusionActor, activation_class, q_values
from sb3_causalgdp.prediction import act, check_observation, fixed_noise
from sb3_causalgdp.saving.models import KNOWN
from sb3_causalgdp.saving.plain import Known
from sb3_causalgdp.saving.policies import SavedPolicy


class CausalGDPPolicy(SavedPolicy):
    """
    Policy of CausalGDP: diffusion actor, its moving average, critics, their targets and the masked world model.

    Prediction draws candidate actions, takes the best of them by the smallest target Q, imagines its next state, and runs the
    sampler again from the same noise, steered towards that state and towards the outcome that is wished for.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule
    :param net_arch: Hidden layers of the denoiser and of the critics: a list, or ``dict(pi=[...], qf=[...])``
    :param activation_fn: Activation of both: a class or its name
    :param features_extractor_class: Features extractor to use
    :param features_extractor_kwargs: Keyword arguments of the features extractor
    :param normalize_images: Whether to divide images by 255
    :param optimizer_class: Optimizer of the actor, the critics and the world model
    :param optimizer_kwargs: Its keyword arguments, without the learning rate
    :param n_critics: Number of critics
    :param critic_normalization: ``batch`` normalises the inputs of the critics' layers over the batch, and needs no target
        critics (CrossQ, Bhatt et al., 2024); ``layer`` their hidden layers, which bounds what they say of actions that the
        data does not hold (RLPD, Ball et al., 2023, section 4.2): for offline data; None is neither
    :param normalize_observations: Whether actor and critics see observations in the standard deviations that the world model
        measures while it trains; where there are images or an extractor of your own, they see them as they are
    :param share_features_extractor: Whether actor and critics share one features extractor
    :param world_model_net_arch: Hidden layers of the world model, all of one size, ``[128, 128]`` by default
    :param diffusion_steps: Number of diffusion steps K
    :param noise_schedule: ``vp``, ``linear`` or ``cosine``
    :param sampler: One of :data:`~sb3_causalgdp.diffusion.SAMPLERS`
    :param ddim_eta: Noise of DDIM, in [0, 1]
    :param prediction_type: What a named denoiser predicts, ``noise`` or ``velocity``, see
        :class:`~sb3_causalgdp.diffusion.denoisers.Velocity`
    :param sampling_steps: Number of the sampler's steps, None for K. With another number the denoiser learns, and is asked, at
        all times between the diffusion steps
    :param denoiser: ``mlp``, ``residual_mlp``, ``transformer``, or a class of your own, see
        :func:`~sb3_causalgdp.diffusion.make_denoiser`
    :param denoiser_kwargs: Further arguments of the denoiser
    :param guidance: ``posterior``, ``score``, ``normalized``, or None for no guidance
    :param guidance_covariance: ``tweedie``, ``isotropic`` or ``unit_gaussian``, see
        :class:`~sb3_causalgdp.diffusion.GuidanceRule`
    :param guidance_target: ``return`` or ``reward``
    :param guidance_scale: lambda_k: one number, or one for each diffusion step
    :param state_guidance_scale: gamma, scales the precision of the next state
    :param outcome_guidance_scale: beta, scales the precision of the reward or return
    :param n_action_candidates: Number of candidates N of which prediction plays the best
    :param exploration_noise: Standard deviation of the Gaussian noise of stochastic predictions, actions being in [-1, 1]
    :param discount: Discount factor, for the return target
    :param one_pass: Whether a perceptron acts, trained beside the denoiser: one pass, no candidates and no steering while
        acting
    :param value_network: Whether the critics have a network V(s) beside them
    :param causal_abstraction: Whether components of observations and actions can be hidden from actor and critics, see
        :meth:`show`
    """

    actor: DiffusionActor
    actor_target: DiffusionActor
    critic: Critic
    critic_target: Critic
    """The critics themselves where they normalise batches."""
    reward_target: th.Tensor
    return_std: th.Tensor
    guidance_ready: th.Tensor
    candidate_noise: th.Tensor
    state_gate: th.Tensor
    action_gate: th.Tensor

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        net_arch: list[int] | dict[str, list[int]] | None = None,
        activation_fn: str | type[nn.Module] = nn.ReLU,
        features_extractor_class: type[BaseFeaturesExtractor] = FlattenExtractor,
        features_extractor_kwargs: dict[str, Any] | None = None,
        normalize_images: bool = True,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
        n_critics: int = 2,
        critic_normalization: str | None = "batch",
        normalize_observations: bool = True,
        share_features_extractor: bool = False,
        world_model_net_arch: list[int] | None = None,
        diffusion_steps: int = 5,
        noise_schedule: str = "vp",
        sampler: str = "ddpm",
        ddim_eta: float = 0.0,
        prediction_type: str = "velocity",
        sampling_steps: int | None = None,
        denoiser: str | type[nn.Module] = "mlp",
        denoiser_kwargs: dict[str, Any] | None = None,
        guidance: str | None = "posterior",
        guidance_covariance: str = "unit_gaussian",
        guidance_target: str = "return",
        guidance_scale: float | Sequence[float] = 1.0,
        state_guidance_scale: float = 0.01,
        outcome_guidance_scale: float = 1.0,
        n_action_candidates: int = 10,
        exploration_noise: float = 0.2,
        discount: float = 0.99,
        one_pass: bool = False,
        value_network: bool = False,
        causal_abstraction: bool = False,
    ) -> None:
        check_arguments(POLICY_ARGUMENTS, locals())
        check_keywords("features_extractor_kwargs", features_extractor_kwargs or {}, features_extractor_class)
        check_keywords("optimizer_kwargs", optimizer_kwargs or {}, optimizer_class)
        if causal_abstraction and (denoiser != "mlp" or one_pass):
            raise ValueError(
                f"causal_abstraction must be False where the actor is no denoiser 'mlp', got True with {denoiser!r}"
            )
        super().__init__(
            observation_space,
            action_space,
            features_extractor_class,
            features_extractor_kwargs,
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
            squash_output=True,
            normalize_images=normalize_images,
        )
        self.guidance_rule = None if guidance is None else GuidanceRule(guidance, guidance_covariance, guidance_scale)
        self.guidance_kwargs: dict[str, Any] = {
            "guidance": guidance,
            "guidance_covariance": guidance_covariance,
            "guidance_target": guidance_target,
            "guidance_scale": guidance_scale,
            "state_guidance_scale": state_guidance_scale,
            "outcome_guidance_scale": outcome_guidance_scale,
            "n_action_candidates": n_action_candidates,
            "exploration_noise": exploration_noise,
            "discount": discount,
        }
        self.guidance_target = guidance_target
        self.state_guidance_scale = state_guidance_scale
        self.outcome_guidance_scale = outcome_guidance_scale
        self.n_action_candidates = n_action_candidates
        self.exploration_noise = exploration_noise
        self.discount = discount

        self.net_arch = [256, 256] if net_arch is None else net_arch
        self.activation_fn = activation_class(activation_fn)
        self.n_critics = n_critics
        self.critic_normalization = critic_normalization
        self.normalize_observations = normalize_observations
        self.share_features_extractor = share_features_extractor
        self.causal_abstraction = causal_abstraction
        self.world_model_net_arch = world_model_net_arch
        actor_arch, critic_arch = get_actor_critic_arch(self.net_arch)
        shared_kwargs = {
            "observation_space": observation_space,
            "action_space": action_space,
            "activation_fn": self.activation_fn,
            "normalize_images": normalize_images,
            "gates_actions": causal_abstraction,
        }
        self.diffusion_kwargs = {
            "diffusion_steps": diffusion_steps,
            "noise_schedule": noise_schedule,
            "sampler": sampler,
            "ddim_eta": ddim_eta,
            "prediction_type": prediction_type,
            "sampling_steps": sampling_steps,
            "denoiser": denoiser,
            "denoiser_kwargs": denoiser_kwargs,
            "one_pass": one_pass,
        }
        self.value_network = value_network
        self.actor_kwargs = {**shared_kwargs, "net_arch": actor_arch, **self.diffusion_kwargs}
        self.critic_kwargs = {
            **shared_kwargs,
            "activation_fn": fast(self.activation_fn),
            "net_arch": critic_arch,
            "n_critics": n_critics,
            "normalization": critic_normalization,
            "value_network": value_network,
            "share_features_extractor": share_features_extractor,
        }
        self._build(lr_schedule)

    def _build(self, lr_schedule: Schedule) -> None:
        # Here, because a compiler cannot see through flatdim()
        self.leaf_sizes = [spaces.flatdim(space) for space in _leaf_spaces(self.observation_space)]
        self.has_image_state = any(
            is_image_space(space, normalized_image=not self.normalize_images) for space in _leaf_spaces(self.observation_space)
        )
        self._acting: NumpyActing | OnePassActing | None = None
        self.register_buffer("reward_target", th.zeros(()))
        self.register_buffer("return_std", th.ones(()))
        self.register_buffer("guidance_ready", th.zeros(()))
        if self.causal_abstraction:
            self.register_buffer("state_gate", th.ones(sum(self.leaf_sizes)))
            self.register_buffer("action_gate", th.ones(spaces.flatdim(self.action_space)))
        self.actor = self.make_actor()
        self.actor_target = self.make_actor()
        self.actor_target.load_state_dict(self.actor.state_dict())
        # With a shared features extractor, targets share theirs too, see SB3's TD3Policy
        shared = self.share_features_extractor
        self.critic = self.make_critic(self.actor.features_extractor if shared else None)
        self.critic_target = self.critic
        if not self.critic.normalizes_batches:
            self.critic_target = self.make_critic(self.actor_target.features_extractor if shared else None)
            self.critic_target.load_state_dict(self.critic.state_dict())
        self._check_guidance_steps()
        self._check_attention()

        self.world_model = MaskedWorldModel(self._state_dim(), self.actor.action_dim, self.world_model_net_arch)
        # Of deterministic predictions
        noise = fixed_noise(self.actor.n_noises, self.n_action_candidates, self.actor.action_dim)
        self.register_buffer("candidate_noise", noise, persistent=False)

        optimizer_kwargs = self.optimizer_kwargs
        if issubclass(self.optimizer_class, (th.optim.Adam, th.optim.AdamW)) and self.critic.normalizes_batches:
            # What batch statistics give is outdated soon (CrossQ)
            optimizer_kwargs = {"betas": (0.5, 0.999), **optimizer_kwargs}
        if self.optimizer_class in (th.optim.Adam, th.optim.AdamW) and "foreach" not in optimizer_kwargs:
            # One kernel for all parameters: the update takes half the time
            optimizer_kwargs = {"fused": True, **optimizer_kwargs}
        for module in (self.actor, self.critic, self.world_model):
            try:
                module.optimizer = self.optimizer_class(  # type: ignore[assignment]
                    module.parameters(),
                    lr=lr_schedule(1),  # type: ignore[call-arg]
                    **optimizer_kwargs,
                )
            except (TypeError, ValueError) as error:
                raise ValueError(f"optimizer_kwargs={self.optimizer_kwargs!r} do not fit: {error}") from error
        self.actor_target.set_training_mode(False)
        if self.critic_target is not self.critic:
            self.critic_target.set_training_mode(False)

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

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> DiffusionActor:
        return DiffusionActor(**self._update_features_extractor(self.actor_kwargs, features_extractor)).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Critic:
        return Critic(**self._update_features_extractor(self.critic_kwargs, features_extractor)).to(self.device)

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        extractor = super().make_features_extractor()
        is_covered = not self.has_image_state and StandardizedExtractor.covers(extractor, sum(self.leaf_sizes))
        if self.causal_abstraction and not is_covered:
            raise ValueError(
                "causal_abstraction must be False with images or features of your own, got True: it hides components "
                "of observations"
            )
        if is_covered and (self.normalize_observations or self.causal_abstraction):
            return StandardizedExtractor(extractor, self.normalize_observations).to(self.device)
        return extractor

    @th.no_grad()
    def update_observation_statistics(self) -> None:
        """Let actor, critics and their targets see observations by what the world model knows of them by now."""
        own = self._statistics_of_extractors()
        if own and self.normalize_observations:
            inverse_std = 1.0 / self.world_model.state_std
            if self.causal_abstraction:
                inverse_std *= self.state_gate
            th._foreach_copy_(own, [self.world_model.state_mean, inverse_std] * (len(own) // 2))

    def _statistics_of_extractors(self) -> list[th.Tensor]:
        """Mean and factor of each network."""
        networks = (self.actor, self.actor_target, self.critic, self.critic_target)
        # Networks may share one, and critics that normalise batches are their own targets
        extractors = dict.fromkeys(network.features_extractor for network in networks)
        return [
            tensor for one in extractors if isinstance(one, StandardizedExtractor) for tensor in (one.mean, one.inverse_std)
        ]

    # Causal abstraction -------------------------------------------------------------------------------------------------

    @th.no_grad()
    def show(self, states: th.Tensor, actions: th.Tensor) -> None:
        """
        Say what actor, critics and their targets see. Hidden components of observations are constant for them. Hidden ones of
        actions are 0 in all that the actor gives and the critics are asked, before the exploration noise. What is shown again
        starts with weights of 0, so that no output jumps. The world model leaves out next values that are hidden.

        :param states: Which state variables are shown, boolean, shape ``(n,)``
        :param actions: Which components of the actions are shown, boolean, shape ``(d,)``
        :raises ValueError: If the policy was made without ``causal_abstraction``
        """
        if not self.causal_abstraction:
            raise ValueError("causal_abstraction must be True for a policy that hides components of observations, got False")
        states, actions = states.to(self.device, th.bool), actions.to(self.device, th.bool)
        before, actions_before = self.state_gate > 0.0, self.action_gate > 0.0
        if th.equal(states, before) and th.equal(actions, actions_before):
            return
        self._begin_anew(states & ~before, actions & ~actions_before, before, actions_before)
        self._stop_modelling(~actions & actions_before)
        self.state_gate.copy_(states)
        self.action_gate.copy_(actions)
        self._write_action_gates()
        known, newly = self.world_model.modelled_states, self.world_model.model_only(states)
        optimizer: Any = self.world_model.optimizer
        forget_rows(self.world_model.transition.parameters(), newly, known, optimizer)
        if self.normalize_observations:
            self.update_observation_statistics()
        else:
            for factor in self._statistics_of_extractors()[1::2]:
                factor.copy_(self.state_gate)

    def _write_action_gates(self) -> None:
        for network in (self.actor, self.actor_target, self.critic, self.critic_target):
            assert network.action_gate is not None
            network.action_gate.copy_(self.action_gate)

    def _trained_networks(self) -> list[tuple[DiffusionActor | Critic, th.optim.Optimizer | None]]:
        """Actor and critics, each with its optimizer, and their targets, which have none."""
        networks = {network: network.optimizer for network in (self.actor, self.critic)}
        return list({self.actor_target: None, self.critic_target: None, **networks}.items())  # type: ignore[arg-type]

    def _begin_anew(self, states: th.Tensor, actions: th.Tensor, known: th.Tensor, known_actions: th.Tensor) -> None:
        """Of inputs that are shown again, forget what was learned of them."""
        mean, variance = th.zeros_like(self.world_model.state_mean), th.ones_like(self.world_model.state_mean)
        if not self.normalize_observations:
            mean, variance = self.world_model.state_mean, self.world_model.state_std.square()
        # Actions are in [-1, 1]
        unit = th.cat([mean, 0.0 * actions]), th.cat([variance, th.full_like(actions, 1.0 / 3.0, dtype=variance.dtype)])
        inputs, known_inputs = th.cat([states, actions]), th.cat([known, known_actions])
        for network, optimizer in self._trained_networks():
            if isinstance(network, Critic):
                for q_network in network.q_networks:
                    forget_inputs(q_network.children(), inputs, known_inputs, unit, optimizer)
            else:
                layer, _ = _layers_of(network.denoiser)
                times = th.zeros(layer.in_features - len(inputs), dtype=th.bool, device=self.device)
                # Of noisy actions the weights are 0 since they were hidden
                columns = th.cat([th.zeros_like(actions), times, states])
                forget_inputs([layer], columns, th.cat([known_actions, ~times, known]), unit, optimizer)

    def _stop_modelling(self, actions: th.Tensor) -> None:
        """Let the denoisers neither see nor give components of actions."""
        for network, optimizer in self._trained_networks():
            if isinstance(network, DiffusionActor):
                layer, last = _layers_of(network.denoiser)
                others = th.zeros(layer.in_features - len(actions), dtype=th.bool, device=self.device)
                columns = th.cat([actions, others])
                forget_inputs([layer], columns, ~columns, (columns, columns), optimizer)
                forget_outputs(last, actions, optimizer)

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """
        As PyTorch's. What was hidden in a policy is shown again in one without ``causal_abstraction``, and one that has it
        hides nothing yet after the parameters of one without.

        :param state_dict: Tensors by name
        :param strict: As PyTorch's
        :param assign: As PyTorch's
        :return: As PyTorch's
        """
        state_dict = dict(state_dict)
        if self.causal_abstraction:
            if strict:
                open_gates = {"state_gate": th.ones_like(self.state_gate), "action_gate": th.ones_like(self.action_gate)}
                state_dict = {**open_gates, **state_dict}
            result = super().load_state_dict(state_dict, strict, assign)
            self._write_action_gates()
            self.world_model.model_only(self.state_gate > 0.0)
            return result
        of_states, of_actions = state_dict.pop("state_gate", None), state_dict.pop("action_gate", None)
        result = super().load_state_dict(state_dict, strict, assign)
        if of_states is not None and of_actions is not None:
            shown, modelled = of_states.to(self.device) > 0.0, of_actions.to(self.device) > 0.0
            with th.no_grad():
                self._begin_anew(~shown, ~modelled, shown, modelled)
                self.update_observation_statistics()
        return result

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            net_arch=self.net_arch,
            activation_fn=self.activation_fn,
            features_extractor_class=self.features_extractor_class,
            features_extractor_kwargs=self.features_extractor_kwargs,
            optimizer_class=self.optimizer_class,
            optimizer_kwargs=self.optimizer_kwargs,
            n_critics=self.n_critics,
            critic_normalization=self.critic_normalization,
            normalize_observations=self.normalize_observations,
            share_features_extractor=self.share_features_extractor,
            world_model_net_arch=self.world_model_net_arch,
            value_network=self.value_network,
            causal_abstraction=self.causal_abstraction,
            lr_schedule=self._dummy_schedule,  # not needed for loading the policy alone
            **self.diffusion_kwargs,
            **self.guidance_kwargs,
        )
        return data

    @property
    def device(self) -> th.device:
        """Where the policy is."""
        # SB3 looks for the first parameter of all modules, two or three times a prediction
        return self.return_std.device

    def set_training_mode(self, mode: bool) -> None:
        """
        Put the actor, the critics and the world model in training or evaluation mode; targets stay in evaluation mode.

        :param mode: Whether to train
        """
        modules = (self.actor, self.critic, self.world_model)
        if all(module.training == mode for module in (self, *modules)):
            return  # every prediction asks for it, and visiting all layers would take a sixth of its time
        for module in modules:
            module.train(mode)
        self.training = mode

    # The causal model's state -------------------------------------------------------------------------------------------

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
        with th.enable_grad():
            state = state.detach().requires_grad_()
            features = state if self.has_image_state else self._features_of_state(state, self.critic_target.features_extractor)
            values = q_values(self.critic_target, features, action, networks)
            smallest = values[0] if len(values) == 1 else th.cat(values, dim=1).amin(dim=1)
            (gradient,) = th.autograd.grad(smallest.sum(), state)
        return gradient

    # Guidance -----------------------------------------------------------------------------------------------------------

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
        outcome: OutcomeTarget
        if self.guidance_target == "return":
            outcome = ReturnTarget(
                lambda predicted: self.value_gradient(predicted, next_action, critic), self.discount, self.return_std
            )
        else:
            outcome = RewardTarget(self.reward_target)
        return CausalGuidance(
            self.world_model, state, next_state, outcome, self.state_guidance_scale, self.outcome_guidance_scale
        )

    def acting_guidance(self, state: th.Tensor, action: th.Tensor) -> LinearisedGuidance:
        """
        Guidance where the next state is not known: s* is the model's own prediction for an action, about which the guidance is
        linear, so that the world model is evaluated once and not at every diffusion step.

        :param state: s, shape ``(batch, n)``
        :param action: The best candidate, shape ``(batch, d)``
        :return: The guidance for these states
        """
        response = self.world_model.action_response(state, action, of_all=False)
        next_state = response.next_state
        next_action = action
        if self.guidance_target == "return" and not self.has_image_state:
            features = self._features_of_state(next_state, self.actor.features_extractor)
            # The next state is near: one step of the denoiser stands for a chain
            next_action = self.actor.adapt(features, action)
        return LinearisedGuidance(self.make_guidance(state, next_state, next_action), action, response)

    # Prediction ---------------------------------------------------------------------------------------------------------

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        SB3's ``predict``, which gives no action that is not a number.

        :param observation: One observation or a batch
        :param state: Not used
        :param episode_start: Not used
        :param deterministic: Whether the action has no noise
        :return: The action of each, in the environment's units, and ``state``
        :raises ValueError: If an observation is NaN or infinite in float32, with its row and index
        :raises TrainingDivergedError: If the policy itself gives NaN, with the first of its tensors that holds it
        """
        check_observation(observation, self.observation_space)
        actions, state = super().predict(observation, state, episode_start, deterministic)
        if not is_finite(actions):
            found = self.first_not_finite()
            raise TrainingDivergedError(*(found or ("the policy's action", float(actions[~np.isfinite(actions)][0]))))
        return actions, state

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(observation, deterministic=deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        action = act(self, observation, deterministic)
        if not deterministic and self.exploration_noise > 0.0:
            action = (action + self.exploration_noise * th.randn_like(action)).clamp(-1.0, 1.0)
        return action

    # Files --------------------------------------------------------------------------------------------------------------

    def export(
        self,
        path: str | os.PathLike[str],
        guided: bool | None = None,
        deterministic: bool = True,
        vec_normalize: VecNormalize | None = None,
    ) -> None:
        """
        Write what :meth:`predict` computes to a file that runs without this package. ``model.export`` also knows the names of
        the environment and its ``VecNormalize``.

        :param path: The file; its suffix says of which kind: ``.onnx``, ``.pt`` (TorchScript) or ``.pt2`` (``torch.export``)
        :param guided: Whether actions are steered by the causal guidance, None for what :meth:`predict` does now
        :param deterministic: Whether the noise is fixed; if not, it is an input beside the observation
        :param vec_normalize: Normalises the observations in the file, which then takes them as the environment gives them
        :raises ValueError: If the suffix is unknown, there is no guidance yet, or the policy cannot be traced
        :raises ImportError: If a package for ONNX is missing
        :raises RuntimeError: If the file gives other actions than :meth:`predict`
        """
        names = tuple(f"action[{index}]" for index in range(self.actor.action_dim))
        export_policy(self, path, TransitionVariables(self.state_names(), names), guided, deterministic, vec_normalize)

    @classmethod
    def known_classes(cls) -> Known:
        return KNOWN + Known([], [CausalGDPPolicy, CnnPolicy, MultiInputPolicy])


def _layers_of(denoiser: nn.Module) -> tuple[nn.Linear, nn.Linear]:
    """The first and the last layer of a perceptron."""
    assert isinstance(denoiser, MLPDenoiser)
    last = [denoiser.input_layer, *denoiser.network][-1]
    assert isinstance(last, nn.Linear)
    return denoiser.input_layer, last


def _leaf_spaces(space: spaces.Space) -> list[spaces.Space]:
    return list(space.spaces.values()) if isinstance(space, spaces.Dict) else [space]


def _exactly(values: th.Tensor, space: spaces.Space) -> th.Tensor:
    if not isinstance(space, spaces.Box):
        values = preprocess_obs(values, space)  # type: ignore[assignment]
    return values.double().flatten(1)


def _as_observation(state: th.Tensor, space: spaces.Space) -> th.Tensor:
    """A box has its own shape; what is not a box has been preprocessed to a vector."""
    return state.reshape(-1, *space.shape) if isinstance(space, spaces.Box) else state


class CnnPolicy(CausalGDPPolicy):
    """
    Policy for images; see :class:`CausalGDPPolicy`.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule
    :param features_extractor_class: Features extractor to use
    :param kwargs: Keyword arguments of :class:`CausalGDPPolicy`
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        features_extractor_class: type[BaseFeaturesExtractor] = NatureCNN,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            observation_space, action_space, lr_schedule, features_extractor_class=features_extractor_class, **kwargs
        )


class MultiInputPolicy(CausalGDPPolicy):
    """
    Policy for dictionaries of observations; see :class:`CausalGDPPolicy`.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule
    :param features_extractor_class: Features extractor to use
    :param kwargs: Keyword arguments of :class:`CausalGDPPolicy`
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        lr_schedule: Schedule,
        features_extractor_class: type[BaseFeaturesExtractor] = CombinedExtractor,
        **kwargs: Any,
    ) -> None:
        super().__init__(
            observation_space, action_space, lr_schedule, features_extractor_class=features_extractor_class, **kwargs
        )


MlpPolicy = CausalGDPPolicy
