"""
Prediction for few observations, in numpy.

For a handful of rows, nearly all of the time that PyTorch needs goes into dispatching hundreds of small operations. Here the
same numbers are computed on the same memory: the arrays are views of the networks' weights, so nothing is copied and nothing
gets out of date while they are trained. From a GPU, the weights are copied in one piece for each prediction. What is not
covered is left to the plain path, see :meth:`NumpyActing.covers`.
"""

import copy
from collections.abc import Callable
from functools import wraps
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor
from threadpoolctl import ThreadpoolController
from torch import nn

from sb3_causalgdp.acceleration import switch
from sb3_causalgdp.acceleration.numpy_layers import (
    ACTIVATIONS,
    ONE,
    has_plain_layers,
    view,
    without_batch_norms,
    without_norms,
)
from sb3_causalgdp.acceleration.numpy_networks import EVERY, Critics, Denoiser, Features, Rule, WorldModel
from sb3_causalgdp.diffusion import MLPDenoiser
from sb3_causalgdp.diffusion.plans import sampling_points
from sb3_causalgdp.extractors import StandardizedExtractor

Policy = Any  # a CausalGDPPolicy, whose file imports this one


def _networks_of(policy: Policy) -> tuple[nn.Module, ...]:
    return policy.actor.denoiser, policy.actor_target.denoiser, policy.critic_target, policy.world_model


class HostCopy:
    """
    A policy's networks in the processor's own memory.

    :param policy: The policy, on any device
    """

    def __init__(self, policy: Policy) -> None:
        networks = policy.actor, policy.critic, policy.world_model
        self.policy = copy.deepcopy(policy, {id(network.optimizer): None for network in networks}).to("cpu")
        self._there = self.tensors_of(policy)
        here = self.tensors_of(self.policy)
        sizes = [tensor.numel() for tensor in here]
        # Pinned memory is written by the GPU itself
        self._memory = th.empty(sum(sizes), pin_memory=policy.device.type == "cuda")
        for tensor, part in zip(here, self._memory.split(sizes), strict=True):
            tensor.data = part.view_as(tensor)
        self.refresh()

    @staticmethod
    def tensors_of(policy: Policy) -> list[th.Tensor]:
        """
        :param policy: A policy
        :return: All that acting reads of it
        """
        tensors = [tensor for module in _networks_of(policy) for tensor in (*module.parameters(), *module.buffers())]
        gates = [] if policy.actor.action_gate is None else [policy.actor.action_gate]
        # Which states are modelled is known here
        floating = [tensor for tensor in tensors if tensor.is_floating_point()]
        return [*floating, policy.return_std, policy.reward_target, *gates]

    @th.no_grad()
    def refresh(self) -> None:
        """Copy what the networks are now."""
        self._memory.copy_(th.cat([tensor.reshape(-1) for tensor in self._there]))


class _Views:
    """Views of a policy's memory, or of a copy: of one process, one policy, and the networks that it has now."""

    def _remember(self, modules: tuple[nn.Module, ...], tensors: list[th.Tensor]) -> None:
        self._modules, self._tensors = modules, tensors
        self._addresses = list(map(th.Tensor.data_ptr, tensors))

    def _has_the_same(self, modules: tuple[nn.Module, ...]) -> bool:
        same = all(ours is theirs for ours, theirs in zip(self._modules, modules, strict=True))
        return same and list(map(th.Tensor.data_ptr, self._tensors)) == self._addresses

    def __reduce__(self) -> tuple[type, tuple]:
        # Copies and pickles of the policy make their own
        return type(None), ()


def _on_one_thread(act: Callable[..., np.ndarray]) -> Callable[..., np.ndarray]:
    """On products this small, several threads of numpy's library mostly wait for each other: ten times the time."""

    @wraps(act)
    def limited(self: "NumpyActing", *args: Any) -> np.ndarray:
        if all(library.num_threads == 1 for library in self._blas.lib_controllers):
            return act(self, *args)
        with self._blas.limit(limits=1):
            return act(self, *args)

    return limited


class NumpyActing(_Views):
    """
    What :func:`sb3_causalgdp.prediction.act` computes, for few rows.

    :param policy: A policy that :meth:`covers` accepts
    :param copies: Whether to compute on a copy of its weights; by default where they are not in the processor's memory
    """

    # Rows of candidates up to which this is faster than PyTorch, see benchmarks/speed
    MOST_ROWS = 640

    def __init__(self, policy: Policy, copies: bool | None = None) -> None:
        self._copy = HostCopy(policy) if copies or (copies is None and policy.device.type != "cpu") else None
        near = policy if self._copy is None else self._copy.policy
        self.denoisers = {False: Denoiser(near.actor), True: Denoiser(near.actor_target)}
        self.features = Features(near)
        self.critics = Critics(near)
        self.world_model = WorldModel(near.world_model)
        self.return_std, self.reward_target = view(near.return_std), view(near.reward_target)
        gate = near.actor.action_gate
        self.action_gate = None if gate is None else view(gate)
        rule = policy.guidance_rule
        points = sampling_points(policy.actor.schedule, policy.actor.sampling_steps)
        self.rule = None if rule is None else Rule(rule, points, policy.actor.action_dim)
        self._blas = ThreadpoolController().select(user_api="blas")
        self._remember(_networks_of(policy), HostCopy.tensors_of(policy))

    def is_current(self, policy: Policy) -> bool:
        """
        :param policy: The policy
        :return: Whether the views are still those of its networks, which may have been moved or replaced
        """
        return self._has_the_same(_networks_of(policy))

    @staticmethod
    def covers(policy: Policy) -> bool:
        """
        :param policy: A policy
        :return: Whether this class can act for it: vectors of observations as they are, plain layers in float32 on a CPU or a
            GPU of CUDA, and a guidance without the denoiser's Jacobian
        """
        if type(policy.actor.denoiser) is not MLPDenoiser:
            return False
        rule, activation = policy.guidance_rule, policy.activation_fn
        critics = (without_norms(without_batch_norms(network)[0])[0] for network in policy.critic_target.q_networks)
        networks: list[Any] = [policy.actor.denoiser.network, *critics]
        return (
            switch.is_on()
            and policy.device.type in ("cpu", "cuda")
            and type(policy.observation_space) is spaces.Box
            and not policy.has_image_state
            and policy.guidance_target in ("return", "reward")
            and _shows_vectors(policy.actor.features_extractor)
            and _shows_vectors(policy.critic_target.features_extractor)
            and activation in ACTIVATIONS
            and all(has_plain_layers(network, activation) for network in networks)
            and all(parameter.dtype == th.float32 for parameter in policy.parameters())
            and (rule is None or not rule.needs_jacobian)
        )

    @_on_one_thread
    def __call__(
        self,
        policy: Policy,
        state: np.ndarray,
        noise: np.ndarray,
        of_choice: np.ndarray | None,
        deterministic: bool,
        guided: bool,
    ) -> np.ndarray:
        """
        :param policy: The policy, for its settings
        :param state: The observations, float32, shape ``(batch, n)``
        :param noise: Noise of the candidates, shape ``(K, batch * n_action_candidates, d)``
        :param of_choice: Noise of the choice among them, shape ``(batch, n_action_candidates)``, None for none
        :param deterministic: Whether it plays, and does not explore
        :param guided: Whether the guidance is on
        :return: Actions in [-1, 1], shape ``(batch, d)``
        """
        if self._copy is not None:
            self._copy.refresh()
        denoiser, optimism = self.denoisers[bool(deterministic and policy.use_ema)], policy.acting_optimism(deterministic)
        n_candidates = policy.n_action_candidates
        features = self.features(state.T)
        time_part = denoiser.time_part()
        bound = denoiser.bind(features, denoiser.at_points(time_part))
        noise = (noise if self.action_gate is None else noise * self.action_gate).transpose(0, 2, 1)
        repeated = bound if n_candidates == 1 else np.repeat(bound, n_candidates, axis=2)
        start, scaled_noise = noise[0], denoiser.scaled(noise)
        first_prediction = denoiser.predict(start, repeated[-1])
        action = denoiser.sample(repeated, start, scaled_noise, first_prediction).T
        if n_candidates > 1:
            values = self.critics.values(features, action.T, n_candidates, optimism).reshape(-1, n_candidates)
            if of_choice is not None:
                spread = values.std(axis=1, keepdims=True)
                values = values + np.float32(policy.exploration_temperature) * spread * of_choice
            best = np.arange(0, len(action), n_candidates) + values.argmax(axis=1)
            action, start, first_prediction = action[best], start[:, best], first_prediction[:, best]
            scaled_noise = scaled_noise[:, :, best]
        if guided:
            assert self.rule is not None
            shift = self.rule.shift(action, *self._local_model(policy, state, action, denoiser, time_part))
            action = denoiser.sample(bound, start, scaled_noise, first_prediction, shift).T
        return np.ascontiguousarray(action if self.action_gate is None else action * self.action_gate)

    def _local_model(
        self, policy: Policy, state: np.ndarray, action: np.ndarray, denoiser: Denoiser, time_part: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and curvature of the guidance at the best candidate, whose predicted state is the one to reach."""
        modelled = policy.world_model.modelled_indices
        of = EVERY if modelled is None else modelled
        response = self.world_model.response(state, action, of)
        by_next_state, by_action = response["reward_by_next_state"], response["reward_by_action"]
        if policy.guidance_target == "return":
            error, std = ONE, self.return_std
            by_value = self._value_gradient(response, action, denoiser, time_part)[:, of]
            by_next_state = by_next_state + np.float32(policy.discount) * by_value
        else:
            reward, std = self.world_model.reward_distribution(response["standardised_reward"])
            error = ((self.reward_target - reward) / std)[:, None]
        to_state = response["standardised_jacobian"]
        jacobian = (by_action + ((by_next_state * response["next_state_std"])[:, None] @ to_state)[:, 0]) / std
        scale = np.float32(policy.outcome_guidance_scale)
        gradient = scale * error * jacobian
        curvature = scale * jacobian[:, :, None] * jacobian[:, None, :]
        if policy.state_guidance_scale > 0.0:
            curvature = curvature + np.float32(policy.state_guidance_scale) * (to_state.transpose(0, 2, 1) @ to_state)
        return gradient, curvature

    def _value_gradient(
        self, response: dict[str, np.ndarray], action: np.ndarray, denoiser: Denoiser, time_part: np.ndarray
    ) -> np.ndarray:
        features = self.features(response["next_state"].T)
        gradient = self.critics.gradient(features, denoiser.adapt(features, action.T, time_part))
        return self.features.backward(gradient, features).T


class OnePassActing(_Views):
    """
    What a policy with a one-pass network does, for few rows.

    :param policy: A policy that :meth:`covers` accepts
    """

    def __init__(self, policy: Policy) -> None:
        self.features = Features(policy)
        networks = policy.actor.one_pass, policy.actor_target.one_pass
        self.layers = [[(view(layer.weight), view(layer.bias)[:, None]) for layer in _linear(network)] for network in networks]
        self.activation = ACTIVATIONS[policy.activation_fn].value
        parameters = [parameter for network in networks for parameter in network.parameters()]
        self._remember(networks, [*parameters, *policy.critic_target.features_extractor.buffers()])

    def is_current(self, policy: Policy) -> bool:
        """
        :param policy: The policy
        :return: Whether the views are still those of its networks, which may have been moved or replaced
        """
        return self._has_the_same((policy.actor.one_pass, policy.actor_target.one_pass))

    @staticmethod
    def covers(policy: Policy) -> bool:
        """
        :param policy: A policy with a one-pass network
        :return: Whether this class can act for it: vectors of observations, plain layers in float32 on a CPU
        """
        *hidden, squash = policy.actor.one_pass
        return (
            switch.is_on()
            and policy.device.type == "cpu"
            and policy.actor.action_gate is None
            and type(policy.observation_space) is spaces.Box
            and not policy.has_image_state
            and _shows_vectors(policy.actor.features_extractor)
            and policy.activation_fn in ACTIVATIONS
            and type(squash) is nn.Tanh
            and has_plain_layers(hidden, policy.activation_fn)
            and all(parameter.dtype == th.float32 for parameter in policy.actor.one_pass.parameters())
        )

    def __call__(self, policy: Policy, state: np.ndarray, deterministic: bool) -> np.ndarray:
        """
        :param policy: The policy, for its settings
        :param state: The observations, float32, shape ``(batch, n)``
        :param deterministic: Whether it plays, and does not explore
        :return: Actions in [-1, 1], shape ``(batch, d)``
        """
        (weight, bias), *layers = self.layers[bool(deterministic and policy.use_ema)]
        hidden = weight @ self.features(state.T)
        hidden += bias
        for weight, bias in layers:
            hidden = weight.dot(self.activation(hidden))
            hidden += bias
        return np.ascontiguousarray(np.tanh(hidden).T)


def _linear(network: nn.Sequential) -> list[nn.Linear]:
    return [module for module in network if isinstance(module, nn.Linear)]


def _shows_vectors(extractor: nn.Module) -> bool:
    """Whether it gives vectors of observations, as they are or standardised."""
    return type(extractor.extractor if type(extractor) is StandardizedExtractor else extractor) is FlattenExtractor
