"""The networks of a policy, its chain of denoising and its guidance, in numpy, on the memory of PyTorch's tensors."""

import copy
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from torch import nn

from sb3_causalgdp.acceleration.numpy_layers import (
    ACTIVATIONS,
    ONE,
    ROUNDING,
    BatchNorm,
    LayerNorm,
    SlopeAndOffset,
    clip,
    constant,
    layer_of,
    linear_layers,
    view,
    without_batch_norms,
    without_norms,
)
from sb3_causalgdp.causal.masked_blocks import MaskedBlocks
from sb3_causalgdp.causal.world_model import MaskedWorldModel
from sb3_causalgdp.diffusion import GuidanceRule
from sb3_causalgdp.diffusion.plans import Point, Stage, sampling_plan, sampling_points
from sb3_causalgdp.extractors import StandardizedExtractor

Policy = Any  # a CausalGDPPolicy, whose file imports this one
Indices = np.ndarray | slice

EVERY = slice(None)
_SMALLEST_RESIDUAL_STD, _MOST_CHANGE = constant(1e-4), constant(4.0)  # those of MaskedWorldModel


class _Move:
    """The coefficients of a stage of a sampler."""

    def __init__(self, stage: Stage, predicts_velocity: bool) -> None:
        alpha_bar = stage.alpha_bar
        # a0_hat = clean_by_noisy a^k - clean_by_output (what the network gives: the noise or the velocity)
        self.clean_by_noisy = constant(alpha_bar ** (0.5 if predicts_velocity else -0.5))
        self.clean_by_output = constant((1.0 - alpha_bar if predicts_velocity else 1.0 / alpha_bar - 1.0) ** 0.5)
        self.std = stage.std
        self.by = constant(stage.by_clean), constant(stage.by_noisy)
        self.by_previous = constant(stage.by_previous_clean), constant(stage.by_previous_noisy)
        self.reads_previous = stage.by_previous_clean != 0.0 or stage.by_previous_noisy != 0.0
        self.is_last = stage.is_last

    def clean(self, noisy_action: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """The estimate of the clean action, not clipped."""
        return self.clean_by_noisy * noisy_action - self.clean_by_output * predicted

    def next(
        self, clean: np.ndarray, noisy_action: np.ndarray, scaled_noise: np.ndarray, previous: tuple[np.ndarray, np.ndarray]
    ) -> np.ndarray:
        """From a^k to a^(k-1); the noise has the step's standard deviation."""
        if self.is_last:
            return clean
        by_clean, by_noisy = self.by
        action = by_clean * clean
        action += by_noisy * noisy_action
        if self.reads_previous:
            by_clean, by_noisy = self.by_previous
            action += by_clean * previous[0]
            action += by_noisy * previous[1]
        if self.std > 0.0:
            action += scaled_noise
        return action


class Denoiser:
    """
    The denoiser and the noise schedule's coefficients of each reverse step.

    Rows of a batch are columns here, as in the critics: weights times a few columns take half the time of a few rows times
    transposed weights. ``dot`` starts a microsecond earlier than ``@``.
    """

    def __init__(self, actor: Any) -> None:
        denoiser = actor.denoiser
        weight, self.bias = layer_of(denoiser.input_layer)
        first_time = denoiser.action_dim
        first_condition = first_time + denoiser.time_table.shape[1]
        self.action_weight, self.condition_weight = weight[:, :first_time], weight[:, first_condition:]
        self.time_weight = weight[:, first_time:first_condition]
        self.time_table = view(denoiser.time_table).T
        self.time_layers, self.layers = linear_layers(denoiser.time_mlp), linear_layers(denoiser.network)
        self.activation = ACTIVATIONS[actor.activation_fn].value
        schedule, predicts_velocity = actor.schedule, denoiser.velocity is not None
        stages = sampling_plan(schedule, actor.sampler, actor.ddim_eta, actor.sampling_steps)
        # The stage at position p scales the noise of row p + 1, and the very last one none
        self.chain = [(stage.point, _Move(stage, predicts_velocity)) for stage in stages]
        self.stds = np.array([stage.std for stage in stages], dtype=np.float32)[:, None, None]
        self.noise_rows = np.minimum(np.arange(1, len(stages) + 1), actor.n_noises - 1)
        steps = np.array([point.step for point in sampling_points(schedule, actor.sampling_steps)])
        self.is_trained_grid = np.array_equal(steps, np.arange(schedule.n_steps))
        self.lower = steps.astype(int)
        self.upper = np.minimum(self.lower + 1, schedule.n_steps - 1)
        self.share = (steps - self.lower).astype(np.float32)[:, None, None]
        self.adapting_step = actor.adapting_step
        self.adapting = _Move(sampling_plan(schedule, "ddim")[-1 - actor.adapting_step], predicts_velocity)
        self.adapting_signal = constant(schedule.alpha_bar_list[actor.adapting_step] ** 0.5)

    def time_part(self) -> np.ndarray:
        """The diffusion steps' part of the first layer, bias included, shape ``(K, width, 1)``."""
        (weight, bias), (last_weight, last_bias) = self.time_layers
        embedding = last_weight @ ACTIVATIONS[nn.Mish].value(weight @ self.time_table + bias) + last_bias
        return (self.time_weight @ embedding + self.bias).T[:, :, None]

    def at_points(self, time_part: np.ndarray) -> np.ndarray:
        """The same at the times of the sampler's grid, which may be between the diffusion steps."""
        if self.is_trained_grid:
            return time_part
        return time_part[self.lower] + self.share * (time_part[self.upper] - time_part[self.lower])

    def bind(self, features: np.ndarray, time_part: np.ndarray) -> np.ndarray:
        """The first layer without the noisy action's part, for each diffusion step, shape ``(K, width, batch)``."""
        return time_part + self.condition_weight @ features

    def predict(self, noisy_action: np.ndarray, from_rest: np.ndarray) -> np.ndarray:
        """The noise or the velocity."""
        hidden, activation = self.action_weight @ noisy_action, self.activation
        hidden += from_rest
        for weight, bias in self.layers:
            hidden = weight.dot(activation(hidden))
            hidden += bias
        return hidden

    def scaled(self, noise: np.ndarray) -> np.ndarray:
        """What each stage adds of the noise, in the order of the chain, shape ``(stages, d, batch)``."""
        return self.stds * noise[self.noise_rows]

    def sample(
        self,
        bound: np.ndarray,
        action: np.ndarray,
        scaled_noise: np.ndarray,
        first_prediction: np.ndarray | None = None,
        shift: Callable[[np.ndarray, int], np.ndarray] | None = None,
    ) -> np.ndarray:
        """
        The chain of :func:`sb3_causalgdp.diffusion.sample`, from a noisy action of shape ``(d, batch)``. What the denoiser
        says of the start does not depend on the guidance, so a second chain need not ask again. ``shift`` says by how much the
        guidance moves a clean estimate.
        """
        predicted, previous = first_prediction, (action, action)
        for position, (point, move) in enumerate(self.chain):
            if predicted is None:
                predicted = self.predict(action, bound[point])
            clean = move.clean(action, predicted)
            if shift is not None:
                clean += shift(clip(clean), point)
            clean = clip(clean)
            following = move.next(clean, action, scaled_noise[position], previous)
            previous, action, predicted = (clean, action), following, None
        return action

    def adapt(self, features: np.ndarray, action: np.ndarray, time_part: np.ndarray) -> np.ndarray:
        """:meth:`DiffusionActor.adapt`, features of shape ``(n, batch)``, actions ``(d, batch)``."""
        noisy = self.adapting_signal * action
        return clip(self.adapting.clean(noisy, self.predict(noisy, self.bind(features, time_part[self.adapting_step]))))


class Features:
    """What actor and critics see of states of shape ``(n, batch)``; their statistics are the same."""

    def __init__(self, policy: Policy) -> None:
        extractor = policy.critic_target.features_extractor
        self.is_plain = not isinstance(extractor, StandardizedExtractor)
        if not self.is_plain:
            self.mean, self.inverse_std = view(extractor.mean)[:, None], view(extractor.inverse_std)[:, None]
            self.bounds = constant(-extractor.bound), constant(extractor.bound)

    def __call__(self, state: np.ndarray) -> np.ndarray:
        if self.is_plain:
            return state
        standardized = state - self.mean
        standardized *= self.inverse_std
        return clip(standardized, *self.bounds)

    def backward(self, gradient: np.ndarray, features: np.ndarray) -> np.ndarray:
        """From the gradient by the features, the one by the states."""
        if self.is_plain:
            return gradient
        return gradient * self.inverse_std * (np.abs(features) <= self.bounds[1])


class _Hidden(NamedTuple):
    """A hidden layer of a critic: what the product gave, the same normalised if the critic is, and the activation of that."""

    product: np.ndarray
    normalised: np.ndarray
    output: np.ndarray

    def columns(self, chosen: np.ndarray) -> "_Hidden":
        return _Hidden(*(part[:, chosen] for part in self))


class _Critic:
    """One target critic."""

    def __init__(self, network: nn.Sequential, activation_fn: type[nn.Module], n_kept: int) -> None:
        self.n_kept = n_kept
        modules, batch_norms = without_batch_norms(network)
        modules, norms = without_norms(modules)
        self.layers = layers = linear_layers(modules)
        self.batch_norms = [BatchNorm(norm) for norm in batch_norms]
        self.norms: Sequence[LayerNorm | None] = [LayerNorm(norm) for norm in norms] or [None] * (len(layers) - 1)
        self.activation = ACTIVATIONS[activation_fn]

    def values(self, features: np.ndarray, actions: np.ndarray, n_candidates: int) -> np.ndarray:
        """Q of several actions for each features; the features' part of the first layer is computed once."""
        (weight, bias), *layers = self.layers
        first_norm, *batch_norms = self._batch_norms_now()
        n_features = len(features)
        if first_norm is not None:
            features, actions = first_norm.of(slice(n_features))(features), first_norm.of(slice(n_features, None))(actions)
        hidden = np.repeat(weight[:, :n_features] @ features + bias, n_candidates, axis=1)
        hidden += weight[:, n_features:] @ actions
        for norm, batch_norm, (next_weight, next_bias) in zip(self.norms, batch_norms, layers, strict=True):
            hidden = next_weight.dot(_normalised(batch_norm, self._hidden(norm, hidden).output))
            hidden += next_bias
        return self.value_of(hidden)

    def value_of(self, outputs: np.ndarray) -> np.ndarray:
        """Q, shape ``(batch,)``, of the outputs, one or the quantiles, shape ``(n_outputs, batch)``."""
        if len(outputs) == 1:
            return outputs[0]
        if self.n_kept < len(outputs):
            outputs = np.partition(outputs, self.n_kept - 1, axis=0)[: self.n_kept]
        return outputs.mean(axis=0)

    def forward(self, inputs: np.ndarray) -> tuple[np.ndarray, list[_Hidden]]:
        """The outputs, and the hidden layers."""
        hidden: list[_Hidden] = []
        (weight, bias), *layers = self.layers
        first_norm, *batch_norms = self._batch_norms_now()
        product = weight.dot(_normalised(first_norm, inputs)) + bias
        for norm, batch_norm, (weight, bias) in zip(self.norms, batch_norms, layers, strict=True):
            hidden.append(self._hidden(norm, product))
            product = weight.dot(_normalised(batch_norm, hidden[-1].output))
            product += bias
        return product, hidden

    def _batch_norms_now(self) -> Sequence[SlopeAndOffset | None]:
        """Of the input of each layer."""
        return [norm.now() for norm in self.batch_norms] or [None] * len(self.layers)

    def _hidden(self, norm: LayerNorm | None, product: np.ndarray) -> _Hidden:
        normalised = _normalised(norm, product)
        return _Hidden(product, normalised, self.activation.value(normalised))

    def backward(self, outputs: np.ndarray, hidden: list[_Hidden], n_states: int) -> np.ndarray:
        """Gradient of Q by the states, the first of the inputs."""
        weights = [weight for weight, _ in self.layers]
        first_norm, *batch_norms = self._batch_norms_now()
        weights[0] = weights[0][:, :n_states]
        gradient = weights[-1].T
        if self.n_kept < len(outputs):
            smallest = np.argpartition(outputs, self.n_kept - 1, axis=0)[: self.n_kept]
            gradient = weights[-1][smallest].mean(axis=0).T
        elif self.n_kept > 1:
            gradient = gradient.mean(axis=1, keepdims=True)
        of_layers = (weights[-2::-1], reversed(hidden), reversed(self.norms), reversed(batch_norms))
        for weight, layer, norm, batch_norm in zip(*of_layers, strict=True):
            if batch_norm is not None:
                gradient = gradient * batch_norm.slope
            gradient = gradient * self.activation.derivative(layer.normalised, layer.output)
            gradient = weight.T.dot(gradient if norm is None else norm.backward(gradient, layer.product))
        return gradient if first_norm is None else gradient * first_norm.slope[:n_states]


def _normalised(norm: LayerNorm | SlopeAndOffset | None, values: np.ndarray) -> np.ndarray:
    return values if norm is None else norm(values)


class Critics:
    """The target critics: Q of candidates, and the gradient of the smallest by the state."""

    def __init__(self, policy: Policy) -> None:
        critic = policy.critic_target
        self.networks = [_Critic(network, policy.activation_fn, critic.n_kept) for network in critic.q_networks]

    def values(self, features: np.ndarray, actions: np.ndarray, n_candidates: int, optimism: float) -> np.ndarray:
        """Q of several actions for each features, between the smallest, for -1, and the largest, for 1."""
        values = [network.values(features, actions, n_candidates) for network in self.networks]
        extreme = reduce(np.maximum if optimism > 0.0 else np.minimum, values)
        if abs(optimism) == 1.0:
            return extreme
        mean = sum(values) / np.float32(len(values))
        return mean + np.float32(abs(optimism)) * (extreme - mean)

    def gradient(self, state: np.ndarray, action: np.ndarray) -> np.ndarray:
        """Of the smallest Q, by the state, shape ``(n, batch)``."""
        inputs = np.concatenate([state, action])
        passes = [network.forward(inputs) for network in self.networks]
        values = [network.value_of(outputs) for network, (outputs, _) in zip(self.networks, passes, strict=True)]
        smallest = np.argmin(np.stack(values), axis=0)
        if len(set(smallest.tolist())) == 1:
            return self.networks[smallest[0]].backward(*passes[smallest[0]], len(state))
        gradient = np.empty_like(state)
        for index, (network, (outputs, hidden)) in enumerate(zip(self.networks, passes, strict=True)):
            columns = smallest == index
            if columns.any():
                of_columns = [layer.columns(columns) for layer in hidden]
                gradient[:, columns] = network.backward(outputs[:, columns], of_columns, len(state))
        return gradient


class _Blocks:
    """``MaskedBlocks``, whose inputs are masked here, and not its weights, of which there are more."""

    def __init__(self, blocks: MaskedBlocks) -> None:
        shape = (blocks.n_outputs, blocks.width)
        self.weight = view(blocks.input_layer.weight).reshape(*shape, -1)
        self.bias = view(blocks.input_layer.bias).reshape(blocks.n_outputs, 1, blocks.width)
        self.hidden = [
            (view(weight), view(bias)) for weight, bias in zip(blocks.hidden_weights, blocks.hidden_biases, strict=True)
        ]
        self.output_weight, self.output_bias = view(blocks.output_weight), view(blocks.output_bias)

    def of(self, outputs: Indices, inputs: Indices) -> "_Blocks":
        """The chosen blocks, which see the chosen inputs alone."""
        if outputs is EVERY and inputs is EVERY:
            return self
        chosen = copy.copy(self)
        chosen.weight = self.weight[outputs][:, :, inputs]
        chosen.bias, chosen.output_weight, chosen.output_bias = (
            values[outputs] for values in (self.bias, self.output_weight, self.output_bias)
        )
        chosen.hidden = [(weight[outputs], bias[outputs]) for weight, bias in self.hidden]
        return chosen

    def forward_and_jacobian(self, inputs: np.ndarray, mask: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray]:
        """Outputs, shape ``(batch, m)``, and their Jacobian by the inputs from the first on, shape ``(m, batch, q)``."""
        layers = [np.tanh((inputs * mask[:, None]) @ self.weight.transpose(0, 2, 1) + self.bias)]
        for weight, bias in self.hidden:
            layers.append(np.tanh(layers[-1] @ weight + bias))
        outputs = (layers[-1] @ self.output_weight[:, :, None])[:, :, 0].T + self.output_bias
        gradient = self.output_weight[:, None] * (ONE - layers[-1] * layers[-1])
        for (weight, _), hidden in zip(reversed(self.hidden), reversed(layers[:-1]), strict=True):
            gradient = (gradient @ weight.transpose(0, 2, 1)) * (ONE - hidden * hidden)
        return outputs, (gradient @ self.weight[:, :, first:]) * mask[:, None, first:]


class WorldModel:
    """:meth:`~sb3_causalgdp.causal.MaskedWorldModel.action_response`, about the states that are modelled."""

    def __init__(self, model: MaskedWorldModel) -> None:
        self.transition, self.reward = _Blocks(model.transition), _Blocks(model.reward)
        self.input_bounds = constant(-model.INPUT_BOUND), constant(model.INPUT_BOUND)
        lowest, highest = model.LOG_STD_BOUNDS
        self.log_std_bounds = constant(lowest), constant(highest)
        named = (*model.named_buffers(recurse=False), *model.named_parameters(recurse=False))
        self.arrays = {name: view(value) for name, value in named if value.is_floating_point()}
        # What has a row for each state
        self.of_states = [
            name for name in self.arrays if name.startswith(("state_", "change_", "transition_")) or name.endswith("_to_state")
        ]

    def response(self, state: np.ndarray, action: np.ndarray, of: Indices = EVERY) -> dict[str, np.ndarray]:
        """The states that it is about, m of them, are given by their indices."""
        inputs_of, arrays = of, self.arrays
        if not isinstance(of, slice):
            inputs_of = np.concatenate([of, np.arange(state.shape[1], state.shape[1] + action.shape[1])])
            arrays = {**arrays, **{name: arrays[name][of] for name in self.of_states}}
            arrays["state_to_state"] = arrays["state_to_state"][:, of]
        now = state[:, of]
        state_std, reward_scale = np.sqrt(arrays["state_unit_square"]), np.sqrt(arrays["reward_unit_square"])
        gate = arrays["state_to_state"].diagonal()
        closed = ONE - gate
        change = np.minimum(arrays["change_variance"] / (state_std * state_std), _MOST_CHANGE)
        residual_std = np.maximum(np.sqrt(closed * closed + gate * change), _SMALLEST_RESIDUAL_STD)
        standardised = (now - arrays["state_mean"]) / state_std
        inputs = np.concatenate([clip(standardised, *self.input_bounds), action], axis=1)
        mask = np.concatenate([arrays["state_to_state"], arrays["action_to_state"]], axis=1)
        change, jacobian = self.transition.of(of, inputs_of).forward_and_jacobian(inputs, mask, now.shape[1])
        next_standardised = gate * standardised + residual_std * change
        noise_std = np.exp(clip(arrays["transition_log_std"], *self.log_std_bounds))
        reward_inputs = np.concatenate([clip(next_standardised, *self.input_bounds), action], axis=1)
        reward_mask = np.concatenate([arrays["state_to_reward"], arrays["action_to_reward"]])[None]
        reward, reward_gradient = self.reward.of(EVERY, inputs_of).forward_and_jacobian(reward_inputs, reward_mask, 0)
        reward_gradient = reward_scale * reward_gradient[0]
        within = np.abs(next_standardised) <= self.input_bounds[1]
        next_state = arrays["state_mean"] + state_std * next_standardised
        if not isinstance(of, slice):
            modelled, next_state = next_state, state.copy()
            next_state[:, of] = modelled
        return {
            "next_state": next_state,
            "next_state_std": noise_std * residual_std * state_std,
            "standardised_jacobian": (jacobian / noise_std[:, None, None]).transpose(1, 0, 2),
            "standardised_reward": reward[:, 0],
            "reward_by_next_state": reward_gradient[:, : now.shape[1]] * within / state_std,
            "reward_by_action": reward_gradient[:, now.shape[1] :],
        }

    def reward_distribution(self, standardised: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means and standard deviation in the environment's units, from the standardised means."""
        arrays = self.arrays
        scale = np.sqrt(arrays["reward_unit_square"])
        std = np.exp(arrays["reward_log_std"].clip(*self.log_std_bounds)) * scale
        return arrays["reward_mean"] + scale * standardised, std


class Rule:
    """``GuidanceRule`` for a guidance that is linear in the clean action."""

    def __init__(self, rule: GuidanceRule, points: Sequence[Point], action_dim: int) -> None:
        self.mode = rule.mode
        self.identity = np.eye(action_dim, dtype=np.float32)
        alpha_bar = np.array([point.alpha_bar for point in points], dtype=np.float32)[:, None, None, None]
        self.noise = 1.0 - alpha_bar
        steps = [point.step for point in points]
        each = np.interp(steps, range(len(rule.scales)), rule.scales) if len(rule.scales) > 1 else rule.scales
        scales = np.asarray(each, dtype=np.float32).reshape(-1, 1, 1, 1)
        # Taking sqrt(1 - alpha_bar) G off the noise adds (1 - alpha_bar) / sqrt(alpha_bar) G to the clean estimate
        self.factor = scales * (self.noise if rule.mode == "posterior" else self.noise / np.sqrt(alpha_bar))

    def shift(self, best: np.ndarray, gradient: np.ndarray, curvature: np.ndarray) -> Callable[[np.ndarray, int], np.ndarray]:
        """
        How far the guidance moves the estimate of the clean action, from what ``guidance_shift`` takes off the noise.

        :param best: The action at which the guidance was taken, shape ``(batch, d)``
        :param gradient: Shape ``(batch, d)``
        :param curvature: Shape ``(batch, d, d)``
        :return: Gives the shift of a clean action at a point of the sampler's grid; both actions have the shape
            ``(d, batch)``
        """
        # The guidance at the clean action 0; the diffusion steps' factors are found for all of them at once
        at_zero = gradient[:, :, None] + curvature @ best[:, :, None]
        if self.mode == "normalized":
            return lambda clean, step: self.factor[step, 0, 0] * _unit((at_zero - curvature @ clean.T[:, :, None])[:, :, 0]).T
        if self.mode == "posterior":
            systems = self.identity + self.noise * curvature
            size = np.abs(systems).max(axis=(2, 3), keepdims=True)
            systems += ROUNDING * size * self.identity
            both = self.factor * np.linalg.solve(systems, np.concatenate([curvature, at_zero], axis=2))
            slopes, offsets = both[..., :-1], both[..., -1:]
        else:
            slopes, offsets = self.factor * curvature, self.factor * at_zero
        if len(best) == 1:
            # The views of several rows take longer than the products
            slope_of, offset_of = list(slopes[:, 0]), list(offsets[:, 0])
            return lambda clean, step: offset_of[step] - slope_of[step].dot(clean)
        return lambda clean, step: (offsets[step] - slopes[step] @ clean.T[:, :, None])[:, :, 0].T


def _unit(rows: np.ndarray) -> np.ndarray:
    return rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-8)
