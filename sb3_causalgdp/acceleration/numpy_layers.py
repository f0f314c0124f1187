"""Activations, linear layers and normalisations in numpy, on the memory of PyTorch's tensors."""

from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch as th
from torch import nn

from sb3_causalgdp.acceleration.activations import fast


def constant(value: float) -> np.ndarray:
    # A product of a few numbers with an array of no dimension takes half the time of one with a Python number
    return np.array(value, dtype=np.float32)


ZERO, ONE, MINUS_ONE, TWO = constant(0.0), constant(1.0), constant(-1.0), constant(2.0)
_LARGEST_EXPONENT = constant(20.0)
ROUNDING = constant(8.0 * float(np.finfo(np.float32).eps))


class Activation(NamedTuple):
    """An activation and its derivative, the latter from the input and the output."""

    value: Callable[[np.ndarray], np.ndarray]
    derivative: Callable[[np.ndarray, np.ndarray], np.ndarray]


def _sigmoid(x: np.ndarray) -> np.ndarray:
    # By tanh, which does not overflow
    return 0.5 * (1.0 + np.tanh(0.5 * x))


def _tanh_of_softplus(x: np.ndarray) -> np.ndarray:
    # tanh(log(1 + e)) = ((1 + e)^2 - 1) / ((1 + e)^2 + 1): one exponential; beyond 20 it is 1 in float32
    exponential = np.minimum(x, _LARGEST_EXPONENT)
    np.exp(exponential, out=exponential)
    result = exponential + TWO
    result *= exponential
    result /= result + TWO
    return result


def _elu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, ZERO) + np.expm1(np.minimum(x, ZERO))


def _mish_derivative(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    squashed = _tanh_of_softplus(x)
    return squashed + x * _sigmoid(x) * (1.0 - squashed * squashed)


def _silu_derivative(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    gate = _sigmoid(x)
    return gate + y * (1.0 - gate)


ACTIVATIONS: dict[type[nn.Module], Activation] = {
    nn.ReLU: Activation(lambda x: np.maximum(x, ZERO), lambda x, y: y > ZERO),
    nn.Tanh: Activation(np.tanh, lambda x, y: ONE - y * y),
    nn.Mish: Activation(lambda x: x * _tanh_of_softplus(x), _mish_derivative),
    nn.ELU: Activation(_elu, lambda x, y: np.minimum(y, ZERO) + ONE),
    nn.SiLU: Activation(lambda x: x * _sigmoid(x), _silu_derivative),
}


def clip(values: np.ndarray, lowest: np.ndarray = MINUS_ONE, highest: np.ndarray = ONE) -> np.ndarray:
    # Half of the time of ndarray.clip
    raised = np.maximum(values, lowest)
    return np.minimum(raised, highest, out=raised)


Layer = tuple[np.ndarray, np.ndarray]
"""A weight, shape ``(outputs, inputs)``, and a bias, shape ``(outputs, 1)``."""


def view(tensor: th.Tensor) -> np.ndarray:
    return tensor.detach().numpy()


def layer_of(linear: nn.Linear) -> Layer:
    return view(linear.weight), view(linear.bias)[:, None]


def linear_layers(modules: Iterable[nn.Module]) -> list[Layer]:
    return [layer_of(module) for module in modules if isinstance(module, nn.Linear)]


def has_plain_layers(modules: Iterable[nn.Module], activation: type[nn.Module]) -> bool:
    """Whether there is nothing but layers with a bias and that activation."""
    return all(
        (isinstance(module, nn.Linear) and module.bias is not None) or type(module) in (activation, fast(activation))
        for module in modules
    )


class LayerNorm:
    """``nn.LayerNorm`` of columns."""

    def __init__(self, module: nn.LayerNorm) -> None:
        self.weight, self.bias = view(module.weight)[:, None], view(module.bias)[:, None]
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


class SlopeAndOffset(NamedTuple):
    """What a batch normalisation does to each row of its input, shape ``(rows, 1)`` each."""

    slope: np.ndarray
    offset: np.ndarray

    def __call__(self, values: np.ndarray) -> np.ndarray:
        mapped = values * self.slope
        mapped += self.offset
        return mapped

    def of(self, rows: slice) -> "SlopeAndOffset":
        return SlopeAndOffset(self.slope[rows], self.offset[rows])


class BatchNorm:
    """``nn.BatchNorm1d`` of columns, by its running averages."""

    def __init__(self, module: nn.BatchNorm1d) -> None:
        assert module.running_mean is not None and module.running_var is not None
        arrays = (module.weight, module.bias, module.running_mean, module.running_var)
        self.weight, self.bias, self.mean, self.variance = (view(array)[:, None] for array in arrays)
        self.epsilon = np.float32(module.eps)

    def now(self) -> "SlopeAndOffset":
        slope = self.weight / np.sqrt(self.variance + self.epsilon)
        return SlopeAndOffset(slope, self.bias - self.mean * slope)


def without_batch_norms(network: nn.Sequential) -> tuple[list[nn.Module], list[nn.BatchNorm1d]]:
    """The batch normalisations where each layer has one right in front of it, else none; and all other modules."""
    modules = list(network)
    norms = [norm for norm, layer in pairwise(modules) if isinstance(layer, nn.Linear) and _normalises_batches(norm, layer)]
    if len(norms) != sum(isinstance(module, nn.Linear) for module in modules):
        return modules, []
    return [module for module in modules if not any(module is norm for norm in norms)], norms  # type: ignore[return-value]


def _normalises_batches(module: nn.Module, layer: nn.Linear) -> bool:
    return (
        type(module) is nn.BatchNorm1d
        and module.num_features == layer.in_features
        and module.affine
        and module.track_running_stats
    )


def without_norms(network: nn.Sequential | list[nn.Module]) -> tuple[list[nn.Module], list[nn.LayerNorm]]:
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
