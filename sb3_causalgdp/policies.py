"""Diffusion actor, double critics, their targets and the causal world model, as one SB3 policy."""

import io
import pathlib
import pickle
from collections.abc import Mapping, Sequence
from typing import Any, BinaryIO, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BaseModel, BasePolicy, ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim, is_image_space, preprocess_obs
from stable_baselines3.common.torch_layers import (
    BaseFeaturesExtractor,
    CombinedExtractor,
    FlattenExtractor,
    NatureCNN,
    create_mlp,
    get_actor_critic_arch,
)
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.common.utils import get_device
from torch import nn

from sb3_causalgdp.acceleration.acting import NumpyActing
from sb3_causalgdp.acceleration.activations import fast
from sb3_causalgdp.acceleration.products import make_layers_fast
from sb3_causalgdp.arguments import POLICY_ARGUMENTS, check_arguments, check_keywords
from sb3_causalgdp.causal import CausalGuidance, LinearisedGuidance, MaskedWorldModel, ReturnTarget, RewardTarget
from sb3_causalgdp.causal.guidance import OutcomeTarget
from sb3_causalgdp.checks import first_not_finite_index, fits_float32, is_finite
from sb3_causalgdp.diffusion import Guidance, GuidanceRule, NoiseSchedule, make_denoiser, sample
from sb3_causalgdp.diffusion.samplers import bind, check_sampler
from sb3_causalgdp.divergence import TrainingDivergedError, first_not_finite
from sb3_causalgdp.files import saved_when_done
from sb3_causalgdp.saving.archives import TRUST, FileError, errors_of, named, opened, size_of
from sb3_causalgdp.saving.models import BLOCK, CONTENT, KNOWN, check_limits, check_tensor_file, plain_entries
from sb3_causalgdp.saving.plain import Known, decoded, read_json

ACTIVATIONS: dict[str, type[nn.Module]] = {
    "mish": nn.Mish,
    "silu": nn.SiLU,
    "relu": nn.ReLU,
    "tanh": nn.Tanh,
    "elu": nn.ELU,
    "gelu": nn.GELU,
}

SelfPolicy = TypeVar("SelfPolicy", bound="CausalGDPPolicy")
SelfNetwork = TypeVar("SelfNetwork", bound="_PickledAlone")


def activation_class(activation_fn: str | type[nn.Module]) -> type[nn.Module]:
    """
    :param activation_fn: Class of the activation, or its name in lower case
    :return: The class
    :raises ValueError: If the name is unknown
    """
    if not isinstance(activation_fn, str):
        return activation_fn
    if activation_fn.lower() not in ACTIVATIONS:
        raise ValueError(
            f"Unknown activation_fn {activation_fn!r}: it must be a torch.nn class or one of {sorted(ACTIVATIONS)}"
        )
    return ACTIVATIONS[activation_fn.lower()]


def q_values(
    critic: ContinuousCritic, features: th.Tensor, actions: th.Tensor, networks: slice = slice(None)
) -> list[th.Tensor]:
    """
    What each critic network says of features that are known already; the critic itself extracts them anew.

    :param critic: The critics
    :param features: Shape ``(batch, features_dim)``
    :param actions: In [-1, 1], shape ``(batch, d)``
    :param networks: Which of the networks, all by default
    :return: One tensor of shape ``(batch, 1)`` for each network
    """
    inputs = th.cat([features, actions], dim=1)
    return [network(inputs) for network in critic.q_networks[networks]]


class _PickledAlone(BaseModel):
    """A network that SB3 saves as a pickle, because it holds another one; a whole policy needs none."""

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfNetwork], path: Any, device: th.device | str = "auto", *, trusted: bool = False
    ) -> SelfNetwork:
        """
        Load a network that was saved alone.

        :param path: File, or file-like object
        :param device: Device on which the network should be
        :param trusted: Whether the file may bring Python objects that could run code
        :return: The network
        :raises ValueError: If the file is not trusted
        """
        if not trusted:
            raise FileError(
                f"{named(path)} is a pickle, which could run code: {TRUST}, or save the whole policy, which is none"
            )
        return super().load(path, device)


class Critic(_PickledAlone, ContinuousCritic):
    """
    SB3's critics, with layer normalisation between each hidden layer and its activation if asked for.

    :param layer_norm: Whether to normalise the hidden layers
    :param kwargs: Keyword arguments of SB3's critics
    """

    def __init__(self, layer_norm: bool = False, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        n_inputs = kwargs["features_dim"] + get_action_dim(kwargs["action_space"])
        for index, network in enumerate(self.q_networks):
            if layer_norm:
                norms: list[type[nn.Module]] = [nn.LayerNorm]
                layers = create_mlp(n_inputs, 1, kwargs["net_arch"], kwargs["activation_fn"], post_linear_modules=norms)
                self.q_networks[index] = network = nn.Sequential(*layers)
                setattr(self, f"qf{index}", network)
            make_layers_fast(network)


class DiffusionActor(_PickledAlone, BasePolicy):
    """
    Diffusion policy: denoises actions, conditioned on the features of the observation.

    :param observation_space: Observation space
    :param action_space: Action space
    :param net_arch: Hidden layers of the denoiser
    :param features_extractor: Network that turns observations into features
    :param features_dim: Number of features
    :param activation_fn: Activation class
    :param normalize_images: Whether to divide images by 255
    :param diffusion_steps: Number of diffusion steps K
    :param noise_schedule: ``vp``, ``linear`` or ``cosine``
    :param sampler: One of :data:`~sb3_causalgdp.diffusion.SAMPLERS`
    :param ddim_eta: Noise of DDIM, in [0, 1]
    :param sampling_steps: Number of the sampler's steps, None for K
    :param denoiser: Name or class of the denoiser, see :func:`~sb3_causalgdp.diffusion.make_denoiser`
    :param denoiser_kwargs: Further arguments of the denoiser
    """

    # Noise's share of the variance from which an action is adapted to a state near by
    ADAPTING_NOISE = 0.1

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Box,
        net_arch: list[int],
        features_extractor: BaseFeaturesExtractor,
        features_dim: int,
        activation_fn: type[nn.Module] = nn.Mish,
        normalize_images: bool = True,
        diffusion_steps: int = 5,
        noise_schedule: str = "vp",
        sampler: str = "ddpm",
        ddim_eta: float = 0.0,
        sampling_steps: int | None = None,
        denoiser: str | type[nn.Module] = "mlp",
        denoiser_kwargs: dict[str, Any] | None = None,
    ) -> None:
        super().__init__(
            observation_space,
            action_space,
            features_extractor=features_extractor,
            normalize_images=normalize_images,
            squash_output=True,
        )
        check_sampler(sampler, ddim_eta, sampling_steps)
        self.action_dim = get_action_dim(action_space)
        self.net_arch = net_arch
        self.features_dim = features_dim
        self.activation_fn = activation_fn
        self.sampler = sampler
        self.ddim_eta = ddim_eta
        self.sampling_steps = sampling_steps
        self.denoiser_kwargs = denoiser_kwargs
        self.schedule = NoiseSchedule(noise_schedule, diffusion_steps)
        self.n_noises = diffusion_steps if sampling_steps is None else sampling_steps
        # A denoiser that is asked between its steps learns what is between them
        self.is_continuous = self.n_noises != diffusion_steps
        noisy_enough = (i for i, signal in enumerate(self.schedule.alpha_bar_list) if 1.0 - signal >= self.ADAPTING_NOISE)
        self.adapting_step = next(noisy_enough, self.schedule.n_steps - 1)
        self.denoiser_class = denoiser
        self.denoiser = make_denoiser(
            denoiser, self.action_dim, features_dim, diffusion_steps, net_arch, activation_fn, denoiser_kwargs
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        data = super()._get_constructor_parameters()
        data.update(
            net_arch=self.net_arch,
            features_dim=self.features_dim,
            activation_fn=self.activation_fn,
            features_extractor=self.features_extractor,
            diffusion_steps=self.schedule.n_steps,
            noise_schedule=self.schedule.name,
            sampler=self.sampler,
            ddim_eta=self.ddim_eta,
            sampling_steps=self.sampling_steps,
            denoiser=self.denoiser_class,
            denoiser_kwargs=self.denoiser_kwargs,
        )
        return data

    def features(self, observation: PyTorchObs) -> th.Tensor:
        """
        :param observation: Observations as SB3 gives them to policies
        :return: What the denoiser is conditioned on, shape ``(batch, features_dim)``
        """
        return self.extract_features(observation, self.features_extractor)

    def sample(
        self,
        features: th.Tensor,
        noise: th.Tensor | None = None,
        guidance: Guidance | None = None,
        rule: GuidanceRule | None = None,
        divergences: list[th.Tensor] | None = None,
    ) -> th.Tensor:
        """
        Denoise actions, see :func:`sb3_causalgdp.diffusion.sample`.

        :param features: Shape ``(batch, features_dim)``
        :param noise: Shape ``(sampling_steps, batch, d)``, drawn if None
        :param guidance: Causal guidance, None for none
        :param rule: How the guidance enters a step
        :param divergences: If a list, each guided step appends its KL divergence
        :return: Actions in [-1, 1], shape ``(batch, d)``
        """
        return sample(
            self.denoiser,
            self.schedule,
            features,
            guidance,
            rule,
            noise=noise,
            action_dim=self.action_dim,
            sampler=self.sampler,
            eta=self.ddim_eta,
            n_steps=self.sampling_steps,
            divergences=divergences,
        )

    def adapt(self, features: th.Tensor, action: th.Tensor) -> th.Tensor:
        """
        Turn an action for one state into one for a state near by: the clean estimate at the diffusion step where little noise
        is left, from the action as it is there without noise.

        :param features: Of the state near by, shape ``(batch, features_dim)``
        :param action: Shape ``(batch, d)``
        :return: Actions in [-1, 1], shape ``(batch, d)``
        """
        step = th.full((len(action),), self.adapting_step, device=action.device)
        noisy = self.schedule.add_noise(action, th.zeros_like(action), step)
        return self.schedule.clean_estimate(noisy, bind(self.denoiser, features)(noisy, step), step).clamp(-1.0, 1.0)

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        features = self.features(observation)
        shape = (self.n_noises, len(features), self.action_dim)
        return self.sample(features, th.zeros(shape, device=features.device) if deterministic else None)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self(observation, deterministic)


class CausalGDPPolicy(BasePolicy):
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
    :param critic_layer_norm: Whether the critics' hidden layers have layer normalisation, which bounds what they say of
        actions that the data does not hold (RLPD, Ball et al., 2023, section 4.2): for offline data with ``learn()`` after it
    :param share_features_extractor: Whether actor and critics share one features extractor
    :param world_model_net_arch: Hidden layers of the world model, all of one size, ``[128, 128]`` by default
    :param diffusion_steps: Number of diffusion steps K
    :param noise_schedule: ``vp``, ``linear`` or ``cosine``
    :param sampler: One of :data:`~sb3_causalgdp.diffusion.SAMPLERS`
    :param ddim_eta: Noise of DDIM, in [0, 1]
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
    """

    actor: DiffusionActor
    actor_target: DiffusionActor
    critic: ContinuousCritic
    critic_target: ContinuousCritic
    reward_target: th.Tensor
    return_std: th.Tensor
    guidance_ready: th.Tensor
    candidate_noise: th.Tensor

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
        critic_layer_norm: bool = False,
        share_features_extractor: bool = False,
        world_model_net_arch: list[int] | None = None,
        diffusion_steps: int = 5,
        noise_schedule: str = "vp",
        sampler: str = "ddpm",
        ddim_eta: float = 0.0,
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
    ) -> None:
        check_arguments(POLICY_ARGUMENTS, locals())
        check_keywords("features_extractor_kwargs", features_extractor_kwargs or {}, features_extractor_class)
        check_keywords("optimizer_kwargs", optimizer_kwargs or {}, optimizer_class)
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
        self.critic_layer_norm = critic_layer_norm
        self.share_features_extractor = share_features_extractor
        self.world_model_net_arch = world_model_net_arch
        actor_arch, critic_arch = get_actor_critic_arch(self.net_arch)
        shared_kwargs = {
            "observation_space": observation_space,
            "action_space": action_space,
            "activation_fn": self.activation_fn,
            "normalize_images": normalize_images,
        }
        self.diffusion_kwargs = {
            "diffusion_steps": diffusion_steps,
            "noise_schedule": noise_schedule,
            "sampler": sampler,
            "ddim_eta": ddim_eta,
            "sampling_steps": sampling_steps,
            "denoiser": denoiser,
            "denoiser_kwargs": denoiser_kwargs,
        }
        self.actor_kwargs = {**shared_kwargs, "net_arch": actor_arch, **self.diffusion_kwargs}
        self.critic_kwargs = {
            **shared_kwargs,
            "activation_fn": fast(self.activation_fn),
            "net_arch": critic_arch,
            "n_critics": n_critics,
            "layer_norm": critic_layer_norm,
            "share_features_extractor": share_features_extractor,
        }
        self._build(lr_schedule)

    def _build(self, lr_schedule: Schedule) -> None:
        self._acting: NumpyActing | None = None
        self.register_buffer("reward_target", th.zeros(()))
        self.register_buffer("return_std", th.ones(()))
        self.register_buffer("guidance_ready", th.zeros(()))
        self.actor = self.make_actor()
        self.actor_target = self.make_actor()
        self.actor_target.load_state_dict(self.actor.state_dict())
        # With a shared features extractor, targets share theirs too, see SB3's TD3Policy
        shared = self.share_features_extractor
        self.critic = self.make_critic(self.actor.features_extractor if shared else None)
        self.critic_target = self.make_critic(self.actor_target.features_extractor if shared else None)
        self.critic_target.load_state_dict(self.critic.state_dict())
        self._check_guidance_steps()

        # Here, because a compiler cannot see through flatdim()
        self.leaf_sizes = [spaces.flatdim(space) for space in _leaf_spaces(self.observation_space)]
        self.has_image_state = any(
            is_image_space(space, normalized_image=not self.normalize_images) for space in _leaf_spaces(self.observation_space)
        )
        self._check_attention()
        self.world_model = MaskedWorldModel(self._state_dim(), self.actor.action_dim, self.world_model_net_arch)
        self.register_buffer("candidate_noise", self._fixed_candidate_noise(), persistent=False)

        optimizer_kwargs = self.optimizer_kwargs
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
        self.critic_target.set_training_mode(False)

    def _check_guidance_steps(self) -> None:
        n_steps = self.actor.schedule.n_steps
        if self.guidance_rule is not None and len(self.guidance_rule.scales) not in (1, n_steps):
            raise ValueError(
                f"guidance_scale must be one number or one for each of the {n_steps} diffusion steps, "
                f"got {len(self.guidance_rule.scales)} values"
            )

    def _fixed_candidate_noise(self) -> th.Tensor:
        """Noise of deterministic predictions: none for the first candidate, the same at every call for the others."""
        generator = th.Generator().manual_seed(0)
        shape = (self.actor.n_noises, self.n_action_candidates, self.actor.action_dim)
        noise = th.randn(shape, generator=generator)
        noise[:, 0] = 0.0
        return noise

    def _check_attention(self) -> None:
        plain = type(self.actor.features_extractor) in (FlattenExtractor, CombinedExtractor) and not self.has_image_state
        if getattr(self.actor.denoiser, "causal", False) and not plain:
            raise ValueError(
                "denoiser_kwargs={'causal': True} needs observations that are vectors and no features extractor, got "
                f"{type(self.actor.features_extractor).__name__} for {self.observation_space}"
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

    def first_not_finite(self, state_dict: Mapping[str, th.Tensor] | None = None) -> tuple[str, float] | None:
        """
        :param state_dict: Tensors by their names in this policy, None for its own
        :return: Name and value of the first number that is NaN or infinite, None if there is none. Buffers of features
            extractors may hold infinity, as masks of attention do
        """
        state_dict = self.state_dict() if state_dict is None else state_dict
        buffers = [f"policy.{name}" for name, _ in self.named_buffers() if "features_extractor" in name]
        return first_not_finite(state_dict, "policy", buffers)

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
            critic_layer_norm=self.critic_layer_norm,
            share_features_extractor=self.share_features_extractor,
            world_model_net_arch=self.world_model_net_arch,
            lr_schedule=self._dummy_schedule,  # not needed for loading the policy alone
            **self.diffusion_kwargs,
            **self.guidance_kwargs,
        )
        return data

    def save(self, path: str) -> None:
        """
        Save the policy alone; a file is replaced only once the new one is complete.

        :param path: File, or file-like object
        """
        arguments = {**self._get_constructor_parameters(), "lr_schedule": None}
        written, entries = plain_entries(arguments, _known_to_policies())
        left = {name: value for name, value in arguments.items() if name not in written}
        saved = {
            "state_dict": self.state_dict(),
            "data": left,
            CONTENT: entries[CONTENT].decode(),
            BLOCK: th.frombuffer(bytearray(entries[BLOCK] or b"0"), dtype=th.uint8),
        }
        # First in memory: on a full disk, PyTorch's error would be about a position
        stream = io.BytesIO()
        th.save(saved, stream)
        with saved_when_done(path, "") as file:
            if isinstance(file, pathlib.Path):
                file.write_bytes(stream.getbuffer())
            else:
                file.write(stream.getbuffer())

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfPolicy], path: Any, device: th.device | str = "auto", *, trusted: bool = False
    ) -> SelfPolicy:
        """
        Load a policy. Nothing that the file brings is run, unless it is trusted.

        :param path: File, or file-like object
        :param device: Device on which the policy should be
        :param trusted: Whether the file may bring Python objects that could run code: it has to, where you gave the policy
            classes of your own, or it was saved by a version that pickled all
        :return: The policy
        :raises ValueError: If the file is not whole, or not trusted and needs to be, or a tensor holds NaN or infinity
        """
        with errors_of(path, "cannot be loaded"), opened(path) as file:
            state, arguments = _read_policy(file, get_device(device), trusted)
            policy = cls(**arguments)
            policy.load_state_dict(state)
            found = policy.first_not_finite()
            if found is not None:
                raise ValueError(f"it is not a policy that can act: {found[0]} is {found[1]}")
            return policy.to(get_device(device))

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
        response = self.world_model.action_response(state, action)
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
        if isinstance(observation, np.ndarray):
            if not fits_float32(observation):
                self._refuse_observation(observation)
        else:
            self._check_parts(observation)
        actions, state = super().predict(observation, state, episode_start, deterministic)
        if not is_finite(actions):
            self._say_what_diverged(actions)
        return actions, state

    def _check_parts(self, observation: Any) -> None:
        for key, values in observation.items() if isinstance(observation, dict) else ((None, observation),):
            if isinstance(values, (list, np.ndarray)) and not fits_float32(np.asarray(values)):
                self._refuse_observation(np.asarray(values), key)

    def _refuse_observation(self, values: np.ndarray, key: str | None = None) -> None:
        space = self.observation_space if key is None else self.observation_space[key]  # type: ignore[index]
        index = first_not_finite_index(values)
        value = np.atleast_1d(values)[index]
        n_axes = len(space.shape or ())
        row = f"row {index[0]}, " if values.ndim > n_axes else ""
        name = "The observation" if key is None else f"observation[{key!r}]"
        raise ValueError(f"{name} is {value} at {row}index {list(index[len(index) - n_axes :])}: it must be finite in float32")

    def _say_what_diverged(self, actions: np.ndarray) -> None:
        found = self.first_not_finite()
        raise TrainingDivergedError(*(found or ("the policy's action", float(actions[~np.isfinite(actions)][0]))))

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self._predict(observation, deterministic=deterministic)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        action = self._act(observation, deterministic)
        if not deterministic and self.exploration_noise > 0.0:
            action = (action + self.exploration_noise * th.randn_like(action)).clamp(-1.0, 1.0)
        return action

    def _act(self, observation: PyTorchObs, deterministic: bool) -> th.Tensor:
        acting = self._numpy_acting(observation)
        if acting is not None:
            assert isinstance(observation, th.Tensor)
            noise = self._candidate_noise(len(observation), deterministic).cpu().numpy()
            actions = acting(self, observation.float().flatten(1).cpu().numpy(), noise, self.is_guided)
            return th.as_tensor(actions, device=observation.device)
        with th.no_grad():
            features = self.actor.features(observation)
            return self._act_in_torch(observation, features, self._candidate_noise(len(features), deterministic))

    def _numpy_acting(self, observation: PyTorchObs) -> NumpyActing | None:
        """The fast path for few rows, where it covers this policy; made anew when the networks were moved or replaced."""
        if self.training or not isinstance(observation, th.Tensor):
            return None
        if len(observation) * self.n_action_candidates > NumpyActing.MOST_ROWS:
            return None
        if self._acting is not None and not self._acting.is_current(self):
            self._acting = None
        if self._acting is None and NumpyActing.covers(self):
            self._acting = NumpyActing(self)
        return self._acting

    def _act_in_torch(self, observation: PyTorchObs, features: th.Tensor, noise: th.Tensor) -> th.Tensor:
        critic_features = self.critic_target.extract_features(observation, self.critic_target.features_extractor)
        candidates = self.actor.sample(features.repeat_interleave(self.n_action_candidates, dim=0), noise)
        best = self._best_candidate(critic_features, candidates)
        action = candidates[best]
        if not self.is_guided:
            return action
        # From the same noise, the guided chain ends at the best candidate, moved by the guidance
        guidance = self.acting_guidance(self.causal_state(observation), action)
        return self.actor.sample(features, noise[:, best], guidance, self.guidance_rule)

    def _candidate_noise(self, n_observations: int, deterministic: bool) -> th.Tensor:
        if deterministic:
            return self.candidate_noise if n_observations == 1 else self.candidate_noise.repeat(1, n_observations, 1)
        n_steps, n_candidates, action_dim = self.candidate_noise.shape
        return th.randn(n_steps, n_observations * n_candidates, action_dim, device=self.candidate_noise.device)

    def _best_candidate(self, critic_features: th.Tensor, actions: th.Tensor) -> th.Tensor:
        """Row of the candidate with the largest of the smallest target Q, for each observation."""
        first = th.arange(0, len(actions), self.n_action_candidates, device=actions.device)
        if self.n_action_candidates == 1:
            return first
        n_candidates = self.n_action_candidates
        repeated = critic_features.repeat_interleave(n_candidates, dim=0)
        values = th.cat(q_values(self.critic_target, repeated, actions), dim=1).amin(dim=1)
        return first + values.view(-1, n_candidates).argmax(dim=1)


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


def _known_to_policies() -> Known:
    """
    :return: What a saved policy may name
    """
    return KNOWN + Known([], [CausalGDPPolicy, CnnPolicy, MultiInputPolicy])


def _read_policy(file: BinaryIO, device: th.device, trusted: bool) -> tuple[dict[str, th.Tensor], dict[str, Any]]:
    """Parameters, and the arguments of the constructor."""
    if trusted:
        saved = th.load(file, map_location=device, weights_only=False)
    else:
        check_tensor_file(file, "it")
        try:
            saved = th.load(file, map_location=device, weights_only=True)
        except pickle.UnpicklingError as error:
            raise ValueError(f"it holds pickled objects, which could run code: {TRUST}") from error
    content = saved.get(CONTENT)
    arguments = (
        {} if content is None else decoded(read_json(content), saved[BLOCK].cpu().numpy().tobytes(), _known_to_policies())
    )
    arguments = {**saved["data"], **arguments}
    if not trusted:
        check_limits(arguments, size_of(file))
    # Schedules are not needed for predictions
    return saved["state_dict"], {**arguments, "lr_schedule": BasePolicy._dummy_schedule}
