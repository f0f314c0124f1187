"""Networks of CausalGDP, what they are fed and how they are guided, as one SB3 policy."""

import os
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
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

from sb3_causalgdp.abstraction import AbstractingPolicy
from sb3_causalgdp.acceleration.acting import NumpyActing, OnePassActing
from sb3_causalgdp.acceleration.activations import fast
from sb3_causalgdp.arguments import POLICY_ARGUMENTS, check_arguments, check_keywords, check_quantiles
from sb3_causalgdp.causal import (
    MaskedWorldModel,
    TransitionVariables,
)
from sb3_causalgdp.checks import is_finite
from sb3_causalgdp.diffusion import GuidanceRule
from sb3_causalgdp.divergence import TrainingDivergedError
from sb3_causalgdp.export import export_policy
from sb3_causalgdp.extractors import StandardizedExtractor
from sb3_causalgdp.networks import Critic, DiffusionActor, activation_class
from sb3_causalgdp.noise import noise_scale
from sb3_causalgdp.prediction import act, check_observation, fixed_noise
from sb3_causalgdp.saving.models import KNOWN
from sb3_causalgdp.saving.plain import Known
from sb3_causalgdp.steering import leaf_spaces


class CausalGDPPolicy(AbstractingPolicy):
    """
    Policy of CausalGDP: diffusion actor, its moving average, critics, their targets and the masked world model.

    Prediction draws candidate actions, keeps the best of them by the smallest of the critics' Q, predicts its next state, and
    runs the sampler again from the same noise, steered towards that state and towards the target outcome.

    :param observation_space: Observation space
    :param action_space: Action space
    :param lr_schedule: Learning rate schedule
    :param net_arch: Hidden layers of the denoiser and of the critics: a list, or ``dict(pi=[...], qf=[...])``
    :param activation_fn: Activation function of both: a class or its name
    :param features_extractor_class: Features extractor to use
    :param features_extractor_kwargs: Keyword arguments of the features extractor
    :param normalize_images: Whether to divide images by 255
    :param optimizer_class: Optimizer of the actor, the critics and the world model
    :param optimizer_kwargs: Its keyword arguments, without the learning rate
    :param n_critics: Number of critics
    :param n_quantiles: Number of quantiles of the return that each critic learns, in place of its mean (TQC, Kuznetsov et al.,
        2020, https://arxiv.org/abs/2005.04269): TD targets are then the smallest quantiles of all critics together, whatever
        the ``pessimism``, and actor, guidance and candidates are judged by the mean of the smallest; needs sb3-contrib
    :param top_quantiles_to_drop_per_net: How many of a critic's quantiles, the largest, do not count
    :param critic_normalization: ``batch`` normalises the inputs of the critics' layers over the batch, and needs no target
        critics (CrossQ, Bhatt et al., 2024); ``layer`` normalises their hidden layers, which limits extrapolation to actions
        that are not in the data (RLPD, Ball et al., 2023, section 4.2): for offline data; None does neither
    :param normalize_observations: Whether actor and critics see observations in units of the standard deviations that the
        world model measures during training; images and inputs of a custom extractor are left as they are
    :param share_features_extractor: Whether actor and critics share one features extractor
    :param world_model_net_arch: Hidden layers of the world model, all the same size, ``[128, 128]`` by default
    :param diffusion_steps: Number of diffusion steps K
    :param noise_schedule: ``vp``, ``linear`` or ``cosine``
    :param sampler: One of :data:`~sb3_causalgdp.diffusion.SAMPLERS`
    :param ddim_eta: Noise of DDIM, in [0, 1]
    :param prediction_type: What a named denoiser predicts, ``noise`` or ``velocity``, see
        :class:`~sb3_causalgdp.diffusion.denoisers.Velocity`
    :param sampling_steps: Number of sampler steps, None for K. With a different number, the denoiser is trained and evaluated
        at all times between the diffusion steps
    :param denoiser: ``mlp``, ``residual_mlp``, ``transformer``, or a class of your own, see
        :func:`~sb3_causalgdp.diffusion.make_denoiser`
    :param denoiser_kwargs: Further arguments of the denoiser
    :param guidance: ``posterior``, ``score``, ``normalized``, or None for no guidance
    :param guidance_covariance: ``tweedie``, ``isotropic`` or ``unit_gaussian``, see
        :class:`~sb3_causalgdp.diffusion.GuidanceRule`
    :param guidance_target: ``return`` or ``reward``
    :param guidance_scale: lambda_k: one number, or one per diffusion step
    :param state_guidance_scale: gamma, scales the precision of the next state
    :param outcome_guidance_scale: beta, scales the precision of the reward or return
    :param n_action_candidates: Number of candidates N from which prediction plays the best
    :param exploration_noise: Standard deviation of the Gaussian noise of stochastic predictions, for actions in [-1, 1];
        ``auto`` is 0.3 divided by the square root of the number of action components that are not hidden
    :param exploration_optimism: What stochastic predictions hope of a candidate: -1 for the smallest Q of the critics, 0 for
        their mean, 1 for the largest
    :param exploration_temperature: How random the choice among candidates is in stochastic predictions, 0 for the best
    :param discount: Discount factor, for the return target
    :param one_pass: Whether an MLP trained alongside the denoiser does the acting: one pass, without candidates or guidance
        while acting
    :param value_network: Whether the critics include a network V(s)
    :param causal_abstraction: Whether components of observations and actions can be hidden from actor and critics, see
        :meth:`~sb3_causalgdp.abstraction.AbstractingPolicy.show`; ``auto``: where that works
    :param use_ema: Whether deterministic predictions are those of the actor's exponential moving average, which is steadier
        from one update to the next, and from which diffusion models are sampled (Ho et al., 2020,
        https://arxiv.org/abs/2006.11239); exploring ones are always the actor's own
    """

    candidate_noise: th.Tensor

    # What networks are made of: a subclass may have its own
    actor_class: ClassVar[type[DiffusionActor]] = DiffusionActor
    critic_class: ClassVar[type[Critic]] = Critic

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
        n_quantiles: int | None = None,
        top_quantiles_to_drop_per_net: int = 2,
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
        exploration_noise: float | str = "auto",
        exploration_optimism: float = 1.0,
        exploration_temperature: float = 0.0,
        discount: float = 0.99,
        one_pass: bool = False,
        value_network: bool = False,
        causal_abstraction: bool | str = False,
        use_ema: bool = True,
    ) -> None:
        check_arguments(POLICY_ARGUMENTS, locals())
        check_keywords("features_extractor_kwargs", features_extractor_kwargs or {}, features_extractor_class)
        check_keywords("optimizer_kwargs", optimizer_kwargs or {}, optimizer_class)
        if n_quantiles is not None:
            check_quantiles(n_quantiles, top_quantiles_to_drop_per_net)
        gates_actions = denoiser == "mlp" and not one_pass
        gates_states = StandardizedExtractor.may_cover(features_extractor_class)
        is_plain = gates_actions and gates_states and not self._has_images(observation_space, normalize_images)
        if causal_abstraction == "auto":
            causal_abstraction = is_plain
        elif causal_abstraction and not gates_actions:
            what = "a policy that acts in one pass" if one_pass else f"denoiser={denoiser!r}"
            raise ValueError(
                f"causal_abstraction must be 'auto' or False with {what}, got True: it hides inputs of the denoiser 'mlp'"
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
        self.is_plain = is_plain
        """Whether observations are vectors, and no part is the user's own."""
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
            "exploration_optimism": exploration_optimism,
            "exploration_temperature": exploration_temperature,
            "discount": discount,
        }
        self.guidance_target = guidance_target
        self.state_guidance_scale = state_guidance_scale
        self.outcome_guidance_scale = outcome_guidance_scale
        self.n_action_candidates = n_action_candidates
        self._exploration_noise = exploration_noise
        self.exploration_optimism = exploration_optimism
        self.exploration_temperature = exploration_temperature
        self.discount = discount

        self.net_arch = [256, 256] if net_arch is None else net_arch
        self.activation_fn = activation_class(activation_fn)
        self.n_critics = n_critics
        self.n_quantiles = n_quantiles
        self.top_quantiles_to_drop_per_net = top_quantiles_to_drop_per_net
        self.critic_normalization = critic_normalization
        self.normalize_observations = normalize_observations
        self.share_features_extractor = share_features_extractor
        self.causal_abstraction = bool(causal_abstraction)
        self.use_ema = use_ema
        self.world_model_net_arch = world_model_net_arch
        actor_arch, critic_arch = get_actor_critic_arch(self.net_arch)
        shared_kwargs = {
            "observation_space": observation_space,
            "action_space": action_space,
            "activation_fn": self.activation_fn,
            "normalize_images": normalize_images,
            "gates_actions": self.causal_abstraction,
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
            "n_quantiles": n_quantiles,
            "top_quantiles_to_drop_per_net": top_quantiles_to_drop_per_net,
            "normalization": critic_normalization,
            "value_network": value_network,
            "share_features_extractor": share_features_extractor,
        }
        self._build(lr_schedule)

    def _build(self, lr_schedule: Schedule) -> None:
        # Here, because a compiler cannot see through flatdim()
        self.leaf_sizes = [spaces.flatdim(space) for space in leaf_spaces(self.observation_space)]
        self.has_image_state = self._has_images(self.observation_space, self.normalize_images)
        self._acting: NumpyActing | OnePassActing | None = None
        self.register_buffer("reward_target", th.zeros(()))
        self.register_buffer("return_std", th.ones(()))
        self.register_buffer("guidance_ready", th.zeros(()))
        if self.causal_abstraction:
            self.register_buffer("state_gate", th.ones(sum(self.leaf_sizes)))
            self.register_buffer("action_gate", th.ones(spaces.flatdim(self.action_space)))
        self.actor = self.make_actor()
        self.n_shown_actions = self.actor.action_dim
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

        self._make_optimizers(lr_schedule)
        self.actor_target.set_training_mode(False)
        if self.critic_target is not self.critic:
            self.critic_target.set_training_mode(False)

    @staticmethod
    def _has_images(observation_space: spaces.Space, normalize_images: bool) -> bool:
        return any(is_image_space(space, normalized_image=not normalize_images) for space in leaf_spaces(observation_space))

    def _make_optimizers(self, lr_schedule: Schedule) -> None:
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

    def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> DiffusionActor:
        return self.actor_class(**self._update_features_extractor(self.actor_kwargs, features_extractor)).to(self.device)

    def make_critic(self, features_extractor: BaseFeaturesExtractor | None = None) -> Critic:
        return self.critic_class(**self._update_features_extractor(self.critic_kwargs, features_extractor)).to(self.device)

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
            n_quantiles=self.n_quantiles,
            top_quantiles_to_drop_per_net=self.top_quantiles_to_drop_per_net,
            critic_normalization=self.critic_normalization,
            normalize_observations=self.normalize_observations,
            share_features_extractor=self.share_features_extractor,
            world_model_net_arch=self.world_model_net_arch,
            value_network=self.value_network,
            causal_abstraction=self.causal_abstraction,
            use_ema=self.use_ema,
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

    def acting_actor(self, deterministic: bool) -> DiffusionActor:
        """
        :param deterministic: Whether it plays, and does not explore
        :return: The network that acts: the exponential moving average of the actor where it plays, which is steadier from one
            update to the next; the actor itself where it explores, and without ``use_ema``
        """
        return self.actor_target if deterministic and self.use_ema else self.actor

    @property
    def exploration_noise(self) -> float:
        """Standard deviation of the noise of non-deterministic predictions, for actions in [-1, 1]."""
        return noise_scale(self._exploration_noise, self.n_shown_actions)

    @exploration_noise.setter
    def exploration_noise(self, noise: float | str) -> None:
        self._exploration_noise = noise

    def acting_optimism(self, deterministic: bool) -> float:
        """
        :param deterministic: Whether it plays, and does not explore
        :return: How the critics judge candidates, see :func:`~sb3_causalgdp.networks.hoped_q`
        """
        return -1.0 if deterministic else self.exploration_optimism

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
