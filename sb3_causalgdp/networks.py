"""Diffusion actor and critics: what a policy is made of, beside the world model."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy, ContinuousCritic
from stable_baselines3.common.preprocessing import get_action_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, create_mlp
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_causalgdp.acceleration.activations import fast
from sb3_causalgdp.acceleration.products import make_layers_fast
from sb3_causalgdp.diffusion import Guidance, GuidanceRule, NoiseSchedule, make_denoiser, sample
from sb3_causalgdp.diffusion.plans import sampling_points
from sb3_causalgdp.diffusion.samplers import bind, check_sampler
from sb3_causalgdp.saving.policies import PickledAlone

SelfCritic = TypeVar("SelfCritic", bound="Critic")

ACTIVATIONS: dict[str, type[nn.Module]] = {
    "mish": nn.Mish,
    "silu": nn.SiLU,
    "relu": nn.ReLU,
    "tanh": nn.Tanh,
    "elu": nn.ELU,
    "gelu": nn.GELU,
}


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


def network_outputs(
    critic: "Critic", features: th.Tensor, actions: th.Tensor, networks: slice = slice(None)
) -> list[th.Tensor]:
    """
    What each critic network gives for features that are known already.

    :param critic: The critics
    :param features: Shape ``(batch, features_dim)``
    :param actions: In [-1, 1], shape ``(batch, d)``
    :param networks: Which of the networks, all by default
    :return: For each network, Q, shape ``(batch, 1)``, or the quantiles of the return, shape ``(batch, n_quantiles)``
    """
    inputs = th.cat([features, _modelled(critic, actions)], dim=1)
    return [network(inputs) for network in critic.q_networks[networks]]


def q_values(critic: "Critic", features: th.Tensor, actions: th.Tensor, networks: slice = slice(None)) -> list[th.Tensor]:
    """
    What each critic network says of features that are known already; the critic itself extracts them anew.

    :param critic: The critics
    :param features: Shape ``(batch, features_dim)``
    :param actions: In [-1, 1], shape ``(batch, d)``
    :param networks: Which of the networks, all by default
    :return: One tensor of shape ``(batch, 1)`` for each network
    """
    return [critic.value_of(outputs) for outputs in network_outputs(critic, features, actions, networks)]


@contextmanager
def weights_fixed(network: nn.Module) -> Iterator[None]:
    """
    What is computed within is differentiated by its inputs alone. Where no gradient by the weights is asked for, PyTorch's own
    layers leave it out, but a function that is written in Python, as our linear layers are, cannot know.

    :param network: The network
    """
    # A compiled graph has nothing in it that is not asked for
    trained = [] if th.compiler.is_compiling() else [one for one in network.parameters() if one.requires_grad]
    try:
        for parameter in trained:
            parameter.requires_grad_(False)
        yield
    finally:
        for parameter in trained:
            parameter.requires_grad_(True)


def smallest_q(critic: "Critic", features: th.Tensor, actions: th.Tensor) -> th.Tensor:
    """
    :param critic: The critics
    :param features: Shape ``(batch, features_dim)``
    :param actions: In [-1, 1], shape ``(batch, d)``
    :return: The smallest of :func:`q_values`, shape ``(batch, 1)``
    """
    return th.cat(q_values(critic, features, actions), dim=1).amin(dim=1, keepdim=True)


def hoped_q(critic: "Critic", features: th.Tensor, actions: th.Tensor, optimism: float) -> th.Tensor:
    """
    :param critic: The critics
    :param features: Shape ``(batch, features_dim)``
    :param actions: In [-1, 1], shape ``(batch, d)``
    :param optimism: -1 for the smallest of :func:`q_values`, 0 for their mean, 1 for the largest
    :return: Shape ``(batch, 1)``
    """
    values = th.cat(q_values(critic, features, actions), dim=1)
    extreme = values.amax(dim=1, keepdim=True) if optimism > 0.0 else values.amin(dim=1, keepdim=True)
    return th.lerp(values.mean(dim=1, keepdim=True), extreme, abs(optimism))


def _modelled(network: nn.Module, actions: th.Tensor) -> th.Tensor:
    """
    :param network: An actor or critics
    :param actions: Shape ``(..., d)``
    :return: The same with 0 for components that the network does not model, if it is one that hides any
    """
    gate = getattr(network, "action_gate", None)
    return actions if gate is None else actions * gate


class Critic(PickledAlone, ContinuousCritic):
    """
    SB3's critics, with layer or batch normalisation if asked for.

    :param normalization: ``layer`` normalises hidden layers before their activation, ``batch`` the inputs of each layer over
        the batch, as in CrossQ; None for none
    :param value_network: Whether there is a network V(s) beside them
    :param gates_actions: Whether components of actions can be hidden from it, by the buffer ``action_gate``
    :param n_quantiles: Number of quantiles of the return that each network gives, None for its mean alone
    :param top_quantiles_to_drop_per_net: How many of the largest do not count in what it says of an action
    :param kwargs: Keyword arguments of SB3's critics
    """

    BATCH_NORM_MOMENTUM = 0.01
    BATCH_NORM_EPSILON = 1e-3

    action_gate: th.Tensor | None

    def __init__(
        self,
        normalization: str | None = None,
        value_network: bool = False,
        gates_actions: bool = False,
        n_quantiles: int | None = None,
        top_quantiles_to_drop_per_net: int = 2,
        **kwargs: Any,
    ) -> None:
        super().__init__(**kwargs)
        self.n_quantiles = n_quantiles
        self.n_kept = 1 if n_quantiles is None else n_quantiles - top_quantiles_to_drop_per_net
        gate = th.ones(get_action_dim(kwargs["action_space"])) if gates_actions else None
        self.register_buffer("action_gate", gate, persistent=False)
        n_inputs = kwargs["features_dim"] + get_action_dim(kwargs["action_space"])
        norms: dict[str, Any] = {}
        if normalization == "layer":
            norms = {"post_linear_modules": [nn.LayerNorm]}
        elif normalization == "batch":
            norms = {
                "pre_linear_modules": [partial(nn.BatchNorm1d, eps=self.BATCH_NORM_EPSILON, momentum=self.BATCH_NORM_MOMENTUM)]
            }
        for index, network in enumerate(self.q_networks):
            if norms or n_quantiles is not None:
                layers = create_mlp(n_inputs, n_quantiles or 1, kwargs["net_arch"], kwargs["activation_fn"], **norms)
                self.q_networks[index] = network = nn.Sequential(*layers)
                setattr(self, f"qf{index}", network)
            make_layers_fast(network)
        self.value_network = None
        if value_network:
            layers = create_mlp(kwargs["features_dim"], 1, kwargs["net_arch"], kwargs["activation_fn"], **norms)
            self.value_network = nn.Sequential(*layers)
            make_layers_fast(self.value_network)
        modules = (module for network in self.q_networks for module in network.modules())
        self._batch_norms = tuple(module for module in modules if isinstance(module, nn.BatchNorm1d))

    def forward(self, obs: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        return tuple(map(self.value_of, self.outputs(obs, actions)))

    def outputs(self, observations: PyTorchObs, actions: th.Tensor) -> tuple[th.Tensor, ...]:
        """
        :param observations: Of the batch
        :param actions: Shape ``(batch, d)``
        :return: What is learned, as :func:`network_outputs` gives it
        """
        return super().forward(observations, _modelled(self, actions))  # type: ignore[arg-type]  # dictionaries, too

    def value_of(self, outputs: th.Tensor) -> th.Tensor:
        """
        :param outputs: Of a network
        :return: Q: with quantiles, the mean of those that count (TQC, Kuznetsov et al., 2020), shape ``(batch, 1)``
        """
        if self.n_quantiles is None:
            return outputs
        if self.n_kept < self.n_quantiles:
            outputs = outputs.sort(dim=1).values[:, : self.n_kept]
        return outputs.mean(dim=1, keepdim=True)

    @property
    def normalizes_batches(self) -> bool:
        """Whether what it says of an action depends on the batch while it is trained, and on running averages otherwise."""
        return len(self._batch_norms) > 0

    def train(self: SelfCritic, mode: bool = True) -> SelfCritic:
        super().train(mode)
        for module in self._batch_norms:
            module.training = False
        return self

    @contextmanager
    def batch_statistics(self) -> Iterator[None]:
        """Within it, batches are normalised by their own statistics, which enter the running ones."""
        try:
            for module in self._batch_norms:
                module.training = True
            yield
        finally:
            for module in self._batch_norms:
                module.training = False

    def value(self, observations: PyTorchObs) -> th.Tensor:
        """
        :param observations: Of the batch
        :return: V(s) of the value network, shape ``(batch, 1)``
        """
        assert self.value_network is not None
        return self.value_network(self.extract_features(observations, self.features_extractor))

    def smallest(self, observations: PyTorchObs, actions: th.Tensor) -> th.Tensor:
        """
        :param observations: Of the batch
        :param actions: Shape ``(batch, d)``
        :return: The smallest Q, shape ``(batch, 1)``
        """
        features = self.extract_features(observations, self.features_extractor)
        return smallest_q(self, features, actions)

    def forward_both(
        self, observations: PyTorchObs, actions: th.Tensor, next_observations: PyTorchObs, next_actions: th.Tensor
    ) -> tuple[list[th.Tensor], list[th.Tensor]]:
        """
        Judge actions and those that follow in one batch, whose statistics are then those of both (CrossQ, Bhatt et al., 2024,
        section 3).

        :param observations: Of the batch
        :param actions: Shape ``(batch, d)``
        :param next_observations: That followed
        :param next_actions: In these, shape ``(batch, d)``
        :return: What :func:`network_outputs` gives for the first and for the second
        """
        features = self.extract_features(observations, self.features_extractor)
        with th.no_grad():
            next_features = self.extract_features(next_observations, self.features_extractor)
        both = network_outputs(self, th.cat([features, next_features]), th.cat([actions, next_actions]))
        n_rows = len(actions)
        return [values[:n_rows] for values in both], [values[n_rows:].detach() for values in both]


class DiffusionActor(PickledAlone, BasePolicy):
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
    :param prediction_type: What a named denoiser predicts: ``noise``, or ``velocity``, see
        :class:`~sb3_causalgdp.diffusion.denoisers.Velocity`
    :param sampling_steps: Number of the sampler's steps, None for K
    :param denoiser: Name or class of the denoiser, see :func:`~sb3_causalgdp.diffusion.make_denoiser`
    :param denoiser_kwargs: Further arguments of the denoiser
    :param one_pass: Whether the actions are those of a perceptron, which asks the denoiser nothing: it is trained beside it
    :param gates_actions: Whether there can be components of actions that it does not model, which are then 0, by the buffer
        ``action_gate``
    """

    action_gate: th.Tensor | None

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
        prediction_type: str = "velocity",
        sampling_steps: int | None = None,
        denoiser: str | type[nn.Module] = "mlp",
        denoiser_kwargs: dict[str, Any] | None = None,
        one_pass: bool = False,
        gates_actions: bool = False,
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
        self.register_buffer("action_gate", th.ones(self.action_dim) if gates_actions else None, persistent=False)
        self.net_arch = net_arch
        self.features_dim = features_dim
        self.activation_fn = activation_fn
        self.sampler = sampler
        self.ddim_eta = ddim_eta
        self.sampling_steps = sampling_steps
        self.denoiser_kwargs = denoiser_kwargs
        self.schedule = NoiseSchedule(noise_schedule, diffusion_steps)
        self.n_noises = len(sampling_points(self.schedule, sampling_steps))
        # A denoiser that is asked between its steps learns what is between them
        self.is_continuous = self.n_noises != diffusion_steps
        noisy_enough = (i for i, signal in enumerate(self.schedule.alpha_bar_list) if 1.0 - signal >= self.ADAPTING_NOISE)
        self.adapting_step = next(noisy_enough, self.schedule.n_steps - 1)
        self.prediction_type = prediction_type
        alpha_bar = self.schedule.alpha_bar if prediction_type == "velocity" else None
        self.denoiser_class = denoiser
        self.denoiser = make_denoiser(
            denoiser, self.action_dim, features_dim, diffusion_steps, net_arch, activation_fn, denoiser_kwargs, alpha_bar
        )
        self.one_pass = None
        if one_pass:
            activation: Any = fast(activation_fn)
            layers = create_mlp(features_dim, self.action_dim, net_arch, activation, squash_output=True)
            self.one_pass = nn.Sequential(*layers)
            make_layers_fast(self.one_pass)

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
            prediction_type=self.prediction_type,
            sampling_steps=self.sampling_steps,
            denoiser=self.denoiser_class,
            denoiser_kwargs=self.denoiser_kwargs,
            one_pass=self.one_pass is not None,
            gates_actions=self.action_gate is not None,
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
    ) -> th.Tensor:
        """
        Actions: those of :meth:`denoise`, or, with a one-pass network, what this says alone.

        :param features: Shape ``(batch, features_dim)``
        :param noise: As for :meth:`denoise`
        :param guidance: As for :meth:`denoise`
        :param rule: As for :meth:`denoise`
        :return: Actions in [-1, 1], shape ``(batch, d)``
        """
        if self.one_pass is not None:
            return _modelled(self, self.one_pass(features))
        return self.denoise(features, noise, guidance, rule)

    def denoise(
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
        if self.action_gate is not None:
            if noise is None:
                shape = (self.n_noises, len(features), self.action_dim)
                noise = th.randn(shape, dtype=features.dtype, device=features.device)
            noise = _modelled(self, noise)
        action = sample(
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
        # Guidance may have moved what is not modelled
        return _modelled(self, action)

    def adapt(self, features: th.Tensor, action: th.Tensor) -> th.Tensor:
        """
        Turn an action for one state into one for a state near by: the clean estimate at the diffusion step where little noise
        is left, from the action as it is there without noise.

        :param features: Of the state near by, shape ``(batch, features_dim)``
        :param action: Shape ``(batch, d)``
        :return: Actions in [-1, 1], shape ``(batch, d)``
        """
        step = th.full(action.shape[:1], self.adapting_step, device=action.device)
        noisy = self.schedule.add_noise(_modelled(self, action), th.zeros_like(action), step)
        clean = self.schedule.clean_estimate(noisy, bind(self.denoiser, features)(noisy, step), step).clamp(-1.0, 1.0)
        return _modelled(self, clean)

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        features = self.features(observation)
        shape = (self.n_noises, len(features), self.action_dim)
        return self.sample(features, th.zeros(shape, device=features.device) if deterministic else None)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        return self(observation, deterministic)
