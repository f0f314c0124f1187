"""
Prediction for few observations, in numpy.

For a handful of rows, nearly all of the time that PyTorch needs goes into dispatching hundreds of small operations. Here the
same numbers are computed on the same memory: the arrays are views of the networks' weights, so nothing is copied and nothing
gets out of date while they are trained. What is not covered is left to the plain path, see :meth:`NumpyActing.covers`.
"""

from collections.abc import Callable, Sequence
from functools import reduce
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import FlattenExtractor
from threadpoolctl import ThreadpoolController
from torch import nn

from sb3_causalgdp.causal.world_model import MaskedBlocks, MaskedWorldModel
from sb3_causalgdp.diffusion import GuidanceRule, MLPDenoiser, NoiseSchedule
from sb3_causalgdp.diffusion.activations import fast
from sb3_causalgdp.diffusion.samplers import transition_weights

Policy = Any  # a CausalGDPPolicy, whose file imports this one


class Activation(NamedTuple):
    """An activation and its derivative, the latter from the input and the output."""

    value: Callable[[np.ndarray], np.ndarray]
    derivative: Callable[[np.ndarray, np.ndarray], np.ndarray]


def _sigmoid(x: np.ndarray) -> np.ndarray:
    # By tanh, which does not overflow
    return 0.5 * (1.0 + np.tanh(0.5 * x))


def _tanh_of_softplus(x: np.ndarray) -> np.ndarray:
    # tanh(log(1 + e)) = ((1 + e)^2 - 1) / ((1 + e)^2 + 1): one exponential; beyond 20 it is 1 in float32
    exponential = np.exp(np.minimum(x, 20.0))
    numerator = exponential * (exponential + 2.0)
    return numerator / (numerator + 2.0)


def _mish_derivative(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    squashed = _tanh_of_softplus(x)
    return squashed + x * _sigmoid(x) * (1.0 - squashed * squashed)


def _silu_derivative(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    gate = _sigmoid(x)
    return gate + y * (1.0 - gate)


ACTIVATIONS: dict[type[nn.Module], Activation] = {
    nn.ReLU: Activation(lambda x: np.maximum(x, 0.0), lambda x, y: (y > 0.0).astype(y.dtype)),
    nn.Tanh: Activation(np.tanh, lambda x, y: 1.0 - y * y),
    nn.Mish: Activation(lambda x: x * _tanh_of_softplus(x), _mish_derivative),
    nn.SiLU: Activation(lambda x: x * _sigmoid(x), _silu_derivative),
}


def _clip(values: np.ndarray, bound: float = 1.0) -> np.ndarray:
    # A third of the time of np.clip on a few numbers
    return np.minimum(np.maximum(values, -bound), bound)


Layer = tuple[np.ndarray, np.ndarray]
"""A weight, shape ``(outputs, inputs)``, and a bias, shape ``(outputs, 1)``."""


def _view(tensor: th.Tensor) -> np.ndarray:
    return tensor.detach().numpy()


def _layer(linear: nn.Linear) -> Layer:
    return _view(linear.weight), _view(linear.bias)[:, None]


def _linear_layers(modules: Any, activation: type[nn.Module]) -> list[Layer] | None:
    """The layers, with that activation between them; None if there is anything else."""
    layers = []
    for module in modules:
        if isinstance(module, nn.Linear) and module.bias is not None:
            layers.append(_layer(module))
        elif type(module) not in (activation, fast(activation)):
            return None
    return layers


class _LayerNorm:
    """``nn.LayerNorm`` of columns."""

    def __init__(self, module: nn.LayerNorm) -> None:
        self.weight, self.bias = _view(module.weight)[:, None], _view(module.bias)[:, None]
        self.epsilon = np.float32(module.eps)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        standardised, _ = self._standardise(values)
        return self.weight * standardised + self.bias

    def backward(self, gradient: np.ndarray, values: np.ndarray) -> np.ndarray:
        """From the gradient by what came out, the one by the values that went in."""
        standardised, inverse_std = self._standardise(values)
        gradient = self.weight * gradient
        along = (gradient * standardised).mean(axis=0)
        return inverse_std * (gradient - gradient.mean(axis=0) - along * standardised)

    def _standardise(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        centred = values - values.mean(axis=0)
        inverse_std = 1.0 / np.sqrt((centred * centred).mean(axis=0) + self.epsilon)
        return centred * inverse_std, inverse_std


def _without_norms(network: nn.Sequential) -> tuple[list[nn.Module], list[nn.LayerNorm]]:
    """The normalisations where each layer but the last has one right behind it, else none; and all other modules."""
    modules = list(network)
    norms = [after for layer, after in pairwise(modules[:-1]) if isinstance(layer, nn.Linear) and _normalises(after, layer)]
    if len(norms) != sum(isinstance(module, nn.Linear) for module in modules) - 1:
        return modules, []
    return [module for module in modules if not any(module is norm for norm in norms)], norms  # type: ignore[return-value]


def _normalises(module: nn.Module, layer: nn.Linear) -> bool:
    if type(module) is not nn.LayerNorm or module.normalized_shape != (layer.out_features,):
        return False
    return module.weight is not None and module.bias is not None


def _through(gradient: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
    """Gradient by the next state, shape ``(batch, n)``, times its Jacobian, ``(n, batch, d)``: shape ``(batch, d)``."""
    return (gradient[:, None] @ jacobian.transpose(1, 0, 2))[:, 0]


class _Denoiser:
    """
    The denoiser and the noise schedule's coefficients of each reverse step.

    Rows of a batch are columns here, as in the critics: weights times a few columns take half the time of a few rows times
    transposed weights.
    """

    def __init__(self, policy: Policy) -> None:
        actor, denoiser = policy.actor, policy.actor.denoiser
        weight, self.bias = _layer(denoiser.input_layer)
        first_time = denoiser.action_dim
        first_condition = first_time + denoiser.time_table.shape[1]
        self.action_weight, self.condition_weight = weight[:, :first_time], weight[:, first_condition:]
        self.time_weight = weight[:, first_time:first_condition]
        self.time_table = _view(denoiser.time_table).T
        time_layers = _linear_layers(denoiser.time_mlp, nn.Mish)
        layers = _linear_layers(denoiser.network, actor.activation_fn)
        assert time_layers is not None and layers is not None
        self.time_layers, self.layers = time_layers, layers
        self.activation = ACTIVATIONS[actor.activation_fn].value
        self.schedule = actor.schedule
        eta = 1.0 if actor.sampler == "ddpm" else actor.ddim_eta
        self.weights = [transition_weights(actor.schedule, step, eta) for step in range(actor.schedule.n_steps)]

    def time_part(self) -> np.ndarray:
        """The diffusion steps' part of the first layer, bias included, shape ``(K, width, 1)``."""
        (weight, bias), (last_weight, last_bias) = self.time_layers
        embedding = last_weight @ ACTIVATIONS[nn.Mish].value(weight @ self.time_table + bias) + last_bias
        return (self.time_weight @ embedding + self.bias).T[:, :, None]

    def bind(self, features: np.ndarray, time_part: np.ndarray) -> np.ndarray:
        """The first layer without the noisy action's part, for each diffusion step, shape ``(K, width, batch)``."""
        return time_part + self.condition_weight @ features

    def predict_noise(self, noisy_action: np.ndarray, from_rest: np.ndarray) -> np.ndarray:
        hidden = self.action_weight @ noisy_action
        hidden += from_rest
        for weight, bias in self.layers:
            hidden = weight @ self.activation(hidden)
            hidden += bias
        return hidden

    def sample(
        self,
        bound: np.ndarray,
        noise: np.ndarray,
        first_prediction: np.ndarray | None = None,
        shift: Callable[[np.ndarray, int], np.ndarray] | None = None,
    ) -> np.ndarray:
        """
        The chain of :func:`sb3_causalgdp.diffusion.sample`; noise of shape ``(K, d, batch)``, actions ``(d, batch)``. What the
        denoiser says of the start does not depend on the guidance, so a second chain need not ask again.
        """
        action, n_steps = noise[0], len(noise)
        for position, step in enumerate(reversed(range(n_steps))):
            alpha_bar = self.schedule.alpha_bar_list[step]
            spread, signal = (1.0 - alpha_bar) ** 0.5, alpha_bar**0.5
            is_known = position == 0 and first_prediction is not None
            predicted = first_prediction if is_known else self.predict_noise(action, bound[step])
            clean = (action - spread * predicted) / signal
            if shift is not None:
                clean = clean + (spread / signal) * shift(_clip(clean), step)
            clean = _clip(clean)
            by_clean, by_noisy, std = self.weights[step]
            action = by_clean * clean + by_noisy * action if step > 0 else clean
            if step > 0 and std > 0.0:
                action += std * noise[min(position + 1, n_steps - 1)]
        return action


class _Hidden(NamedTuple):
    """A hidden layer of a critic: what the product gave, the same normalised if the critic is, and the activation of that."""

    product: np.ndarray
    normalised: np.ndarray
    output: np.ndarray

    def columns(self, chosen: np.ndarray) -> "_Hidden":
        return _Hidden(*(part[:, chosen] for part in self))


class _Critic:
    """One target critic."""

    def __init__(self, network: nn.Sequential, activation_fn: type[nn.Module]) -> None:
        modules, norms = _without_norms(network)
        layers = _linear_layers(modules, activation_fn)
        assert layers is not None
        self.layers = layers
        self.norms: Sequence[_LayerNorm | None] = [_LayerNorm(norm) for norm in norms] or [None] * (len(layers) - 1)
        self.activation = ACTIVATIONS[activation_fn]

    def values(self, features: np.ndarray, actions: np.ndarray, n_candidates: int) -> np.ndarray:
        """Q of several actions for each features; the features' part of the first layer is computed once."""
        (weight, bias), *layers = self.layers
        hidden = np.repeat(weight[:, : len(features)] @ features + bias, n_candidates, axis=1)
        hidden += weight[:, len(features) :] @ actions
        for norm, (next_weight, next_bias) in zip(self.norms, layers, strict=True):
            hidden = next_weight @ self._hidden(norm, hidden).output
            hidden += next_bias
        return hidden

    def forward(self, inputs: np.ndarray) -> tuple[np.ndarray, list[_Hidden]]:
        """The values, and the hidden layers."""
        hidden = []
        for norm, (weight, bias) in zip(self.norms, self.layers[:-1], strict=True):
            product = weight @ inputs
            product += bias
            hidden.append(self._hidden(norm, product))
            inputs = hidden[-1].output
        weight, bias = self.layers[-1]
        return weight @ inputs + bias, hidden

    def _hidden(self, norm: _LayerNorm | None, product: np.ndarray) -> _Hidden:
        normalised = product if norm is None else norm(product)
        return _Hidden(product, normalised, self.activation.value(normalised))

    def backward(self, hidden: list[_Hidden], n_states: int) -> np.ndarray:
        """Gradient of the values by the states, the first of the inputs."""
        weights = [weight for weight, _ in self.layers]
        weights[0] = weights[0][:, :n_states]
        gradient = weights[-1].T
        for weight, layer, norm in zip(weights[-2::-1], reversed(hidden), reversed(self.norms), strict=True):
            gradient = gradient * self.activation.derivative(layer.normalised, layer.output)
            gradient = weight.T @ (gradient if norm is None else norm.backward(gradient, layer.product))
        return gradient


class _Critics:
    """The target critics: the smallest Q, and its gradient by the state."""

    def __init__(self, policy: Policy) -> None:
        self.networks = [_Critic(network, policy.activation_fn) for network in policy.critic_target.q_networks]

    def values(self, features: np.ndarray, actions: np.ndarray, n_candidates: int) -> np.ndarray:
        """Smallest Q of several actions for each features."""
        return reduce(np.minimum, (network.values(features, actions, n_candidates) for network in self.networks))[0]

    def gradient(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        """Of the smallest Q, by the state, shape ``(n, batch)``."""
        inputs = np.concatenate([state, action])
        passes = [network.forward(inputs) for network in self.networks]
        smallest = np.argmin(np.concatenate([values for values, _ in passes]), axis=0)
        if len(set(smallest.tolist())) == 1:
            return self.networks[smallest[0]].backward(passes[smallest[0]][1], len(state))
        gradient = np.empty_like(state)
        for index, (network, (_, hidden)) in enumerate(zip(self.networks, passes, strict=True)):
            columns = smallest == index
            if columns.any():
                gradient[:, columns] = network.backward([layer.columns(columns) for layer in hidden], len(state))
        return gradient


class _Blocks:
    """``MaskedBlocks``, whose inputs are masked here, and not its weights, of which there are more."""

    def __init__(self, blocks: MaskedBlocks) -> None:
        shape = (blocks.n_outputs, blocks.width)
        self.weight = _view(blocks.input_layer.weight).reshape(*shape, -1)
        self.bias = _view(blocks.input_layer.bias).reshape(blocks.n_outputs, 1, blocks.width)
        self.hidden = [
            (_view(weight), _view(bias)) for weight, bias in zip(blocks.hidden_weights, blocks.hidden_biases, strict=True)
        ]
        self.output_weight, self.output_bias = _view(blocks.output_weight), _view(blocks.output_bias)

    def forward_and_jacobian(self, inputs: np.ndarray, mask: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray]:
        """Outputs, shape ``(batch, m)``, and their Jacobian by the inputs from the first on, shape ``(m, batch, q)``."""
        layers = [np.tanh((inputs * mask[:, None]) @ self.weight.transpose(0, 2, 1) + self.bias)]
        for weight, bias in self.hidden:
            layers.append(np.tanh(layers[-1] @ weight + bias))
        outputs = (layers[-1] @ self.output_weight[:, :, None])[:, :, 0].T + self.output_bias
        gradient = self.output_weight[:, None] * (1.0 - layers[-1] * layers[-1])
        for (weight, _), hidden in zip(reversed(self.hidden), reversed(layers[:-1]), strict=True):
            gradient = (gradient @ weight.transpose(0, 2, 1)) * (1.0 - hidden * hidden)
        return outputs, (gradient @ self.weight[:, :, first:]) * mask[:, None, first:]


class _WorldModel:
    """:meth:`~sb3_causalgdp.causal.MaskedWorldModel.action_response`, with Jacobians of shape ``(n, batch, d)``."""

    def __init__(self, model: MaskedWorldModel) -> None:
        self.model = model
        self.transition, self.reward = _Blocks(model.transition), _Blocks(model.reward)
        self.arrays = {
            name: _view(value) for name, value in (*model.named_buffers(recurse=False), *model.named_parameters(recurse=False))
        }

    def response(self, state: np.ndarray, action: np.ndarray) -> dict[str, np.ndarray]:
        arrays, bound = self.arrays, self.model.INPUT_BOUND
        n_states = state.shape[1]
        state_std = np.maximum(np.sqrt(arrays["state_variance"]), 1e-4)
        reward_scale = np.maximum(np.sqrt(arrays["reward_variance"]), 1e-4)
        gate = arrays["state_to_state"].diagonal()
        change = np.minimum(arrays["change_variance"] / (state_std * state_std), 4.0)
        residual_std = np.maximum(np.sqrt((1.0 - gate) ** 2 + gate * change), 1e-4)
        standardised = (state - arrays["state_mean"]) / state_std
        inputs = np.concatenate([_clip(standardised, bound), action], axis=1)
        mask = np.concatenate([arrays["state_to_state"], arrays["action_to_state"]], axis=1)
        change, jacobian = self.transition.forward_and_jacobian(inputs, mask, n_states)
        next_standardised = gate * standardised + residual_std * change
        next_jacobian = residual_std[:, None, None] * jacobian
        reward_inputs = np.concatenate([_clip(next_standardised, bound), action], axis=1)
        reward_mask = np.concatenate([arrays["state_to_reward"], arrays["action_to_reward"]])[None]
        reward, reward_gradient = self.reward.forward_and_jacobian(reward_inputs, reward_mask, 0)
        by_next_state = reward_gradient[0, :, :n_states] * (np.abs(next_standardised) <= bound)
        total = reward_gradient[0, :, n_states:] + _through(by_next_state, next_jacobian)
        lowest, highest = self.model.LOG_STD_BOUNDS
        return {
            "next_state": arrays["state_mean"] + state_std * next_standardised,
            "next_state_std": np.exp(np.clip(arrays["transition_log_std"], lowest, highest)) * residual_std * state_std,
            "next_state_jacobian": state_std[:, None, None] * next_jacobian,
            "reward": arrays["reward_mean"] + reward_scale * reward[:, 0],
            "reward_std": np.exp(np.clip(arrays["reward_log_std"], lowest, highest)) * reward_scale,
            "reward_jacobian": reward_scale * total,
        }


class _Rule:
    """``GuidanceRule`` for a guidance that is linear in the clean action."""

    def __init__(self, rule: GuidanceRule, schedule: NoiseSchedule, action_dim: int) -> None:
        self.mode = rule.mode
        self.identity = np.eye(action_dim, dtype=np.float32)
        alpha_bar = np.array(schedule.alpha_bar_list, dtype=np.float32)[:, None, None, None]
        self.noise = 1.0 - alpha_bar
        scales = np.asarray(rule.scales, dtype=np.float32).reshape(-1, 1, 1, 1)
        self.factor = scales * np.sqrt(self.noise * alpha_bar if rule.mode == "posterior" else self.noise)

    def shift(self, best: np.ndarray, gradient: np.ndarray, curvature: np.ndarray) -> Callable[[np.ndarray, int], np.ndarray]:
        """
        What the guidance takes off the predicted noise, as ``guidance_shift`` finds it.

        :param best: The action at which the guidance was taken, shape ``(batch, d)``
        :param gradient: Shape ``(batch, d)``
        :param curvature: Shape ``(batch, d, d)``
        :return: Gives the shift of a clean action and a diffusion step, both of shape ``(d, batch)``
        """
        # The guidance at the clean action 0; the diffusion steps' factors are found for all of them at once
        at_zero = gradient[:, :, None] + curvature @ best[:, :, None]
        if self.mode == "normalized":
            return lambda clean, step: self.factor[step, 0, 0] * _unit((at_zero - curvature @ clean.T[:, :, None])[:, :, 0]).T
        if self.mode == "posterior":
            systems = self.identity + self.noise * curvature
            size = np.abs(systems).max(axis=(2, 3), keepdims=True)
            systems += (8.0 * np.finfo(np.float32).eps) * size * self.identity
            both = self.factor * np.linalg.solve(systems, np.concatenate([curvature, at_zero], axis=2))
            slopes, offsets = both[..., :-1], both[..., -1:]
        else:
            slopes, offsets = self.factor * curvature, self.factor * at_zero
        return lambda clean, step: (offsets[step] - slopes[step] @ clean.T[:, :, None])[:, :, 0].T


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-8)


class NumpyActing:
    """
    What :meth:`CausalGDPPolicy._act` computes, for few rows on a CPU.

    :param policy: A policy that :meth:`covers` accepts
    """

    # Rows of candidates up to which this is faster than PyTorch, see benchmarks/speed
    MOST_ROWS = 640

    def __init__(self, policy: Policy) -> None:
        self.denoiser = _Denoiser(policy)
        self.critics = _Critics(policy)
        self.world_model = _WorldModel(policy.world_model)
        rule = policy.guidance_rule
        self.rule = None if rule is None else _Rule(rule, policy.actor.schedule, policy.actor.action_dim)
        self._blas = ThreadpoolController().select(user_api="blas")
        self._modules = self._modules_of(policy)
        tensors = (tensor for module in self._modules for tensor in (*module.parameters(), *module.buffers()))
        self._find_addresses = [tensor.data_ptr for tensor in tensors]
        self._addresses = [find() for find in self._find_addresses]

    @staticmethod
    def _modules_of(policy: Policy) -> tuple[nn.Module, ...]:
        return policy.actor.denoiser, policy.critic_target, policy.world_model

    def __reduce__(self) -> tuple[type, tuple]:
        # Views are of one process and one policy: copies and pickles of the policy make their own
        return type(None), ()

    def is_current(self, policy: Policy) -> bool:
        """
        :param policy: The policy
        :return: Whether the views are still those of its networks, which may have been moved or replaced
        """
        same = all(ours is theirs for ours, theirs in zip(self._modules, self._modules_of(policy), strict=True))
        return same and [find() for find in self._find_addresses] == self._addresses

    @staticmethod
    def covers(policy: Policy) -> bool:
        """
        :param policy: A policy
        :return: Whether this class can act for it: vectors of observations as they are, plain layers in float32 on a CPU, and
            a guidance without the denoiser's Jacobian
        """
        rule, activation = policy.guidance_rule, policy.activation_fn
        critics = (_without_norms(network)[0] for network in policy.critic_target.q_networks)
        networks: list[Any] = [policy.actor.denoiser.network, *critics]
        return (
            policy.device.type == "cpu"
            and type(policy.observation_space) is spaces.Box
            and not policy.has_image_state
            and type(policy.actor.features_extractor) is FlattenExtractor
            and type(policy.critic_target.features_extractor) is FlattenExtractor
            and type(policy.actor.denoiser) is MLPDenoiser
            and activation in ACTIVATIONS
            and all(_linear_layers(network, activation) is not None for network in networks)
            and all(parameter.dtype == th.float32 for parameter in policy.parameters())
            and (rule is None or not rule.needs_jacobian)
        )

    def __call__(self, policy: Policy, features: np.ndarray, noise: np.ndarray, guided: bool) -> np.ndarray:
        """
        :param policy: The policy, for its settings
        :param features: The observations, float32, shape ``(batch, n)``
        :param noise: Noise of the candidates, shape ``(K, batch * n_action_candidates, d)``
        :param guided: Whether the guidance is on
        :return: Actions in [-1, 1], shape ``(batch, d)``
        """
        # On products this small, several threads of numpy's library mostly wait for each other: ten times the time
        if all(library.num_threads == 1 for library in self._blas.lib_controllers):
            return self._act(policy, features, noise, guided)
        with self._blas.limit(limits=1):
            return self._act(policy, features, noise, guided)

    def _act(self, policy: Policy, features: np.ndarray, noise: np.ndarray, guided: bool) -> np.ndarray:
        n_candidates = policy.n_action_candidates
        time_part = self.denoiser.time_part()
        bound = self.denoiser.bind(features.T, time_part)
        noise = noise.transpose(0, 2, 1)
        repeated = bound if n_candidates == 1 else np.repeat(bound, n_candidates, axis=2)
        first_prediction = self.denoiser.predict_noise(noise[0], repeated[-1])
        candidates = self.denoiser.sample(repeated, noise, first_prediction)
        best = np.arange(0, noise.shape[2], n_candidates)
        if n_candidates > 1:
            values = self.critics.values(features.T, candidates, n_candidates)
            best = best + values.reshape(-1, n_candidates).argmax(axis=1)
        action = candidates.T[best]
        if not guided:
            return action
        assert self.rule is not None
        shift = self.rule.shift(action, *self._local_model(policy, features, action, time_part))
        return np.ascontiguousarray(self.denoiser.sample(bound, noise[:, :, best], first_prediction[:, best], shift).T)

    def _local_model(
        self, policy: Policy, state: np.ndarray, action: np.ndarray, time_part: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and curvature of the guidance at the best candidate, whose predicted state is the one to reach."""
        response = self.world_model.response(state, action)
        if policy.guidance_target == "return":
            error = np.ones(len(state), dtype=state.dtype)
            through_value = self._value_jacobian(policy, response, action, time_part)
            jacobian = response["reward_jacobian"] + policy.discount * through_value
            jacobian = jacobian / _view(policy.return_std)
        else:
            error = (_view(policy.reward_target) - response["reward"]) / response["reward_std"]
            jacobian = response["reward_jacobian"] / response["reward_std"]
        scale = np.float32(policy.outcome_guidance_scale)
        gradient = scale * error[:, None] * jacobian
        curvature = scale * jacobian[:, :, None] * jacobian[:, None, :]
        if policy.state_guidance_scale > 0.0:
            by_state = (response["next_state_jacobian"] / response["next_state_std"][:, None, None]).transpose(1, 0, 2)
            curvature = curvature + np.float32(policy.state_guidance_scale) * (by_state.transpose(0, 2, 1) @ by_state)
        return gradient, curvature

    def _value_jacobian(
        self, policy: Policy, response: dict[str, np.ndarray], action: np.ndarray, time_part: np.ndarray
    ) -> np.ndarray:
        next_state = response["next_state"].T
        noise = np.zeros((policy.actor.schedule.n_steps, *action.T.shape), dtype=action.dtype)
        next_action = self.denoiser.sample(self.denoiser.bind(next_state, time_part), noise)
        by_state = self.critics.gradient(next_state, next_action)
        return _through(by_state.T, response["next_state_jacobian"])
