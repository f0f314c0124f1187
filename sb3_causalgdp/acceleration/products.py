"""
Linear layers by the faster of the two libraries that PyTorch has for a CPU.

PyTorch multiplies 32-bit matrices with MKL. oneDNN is in PyTorch too and computes the same up to rounding: on AMD's processors
with 512-bit vectors in half of the time, on Intel's in about the same. Which one is faster here is measured once, when the
first large product is asked for; wherever oneDNN cannot be used, PyTorch's own way is taken.
"""

import time
from collections.abc import Callable
from functools import cache
from typing import Any

import torch as th
import torch.nn.functional as F
from torch import nn
from torch.utils._python_dispatch import _get_current_dispatch_mode

from sb3_causalgdp.acceleration import switch

LIBRARIES = ("auto", "default", "onednn")
# Below it, a product with a thin matrix, the other library is as fast or faster
SMALLEST_SIZE = 16
# How much faster oneDNN has to be: a choice that falls one way today and the other tomorrow would change results in rounding
LEAST_SPEEDUP = 1.25
_MEASURED_SIZE = 256
_REPETITIONS = 12

_chosen = "auto"


def use_library(name: str) -> None:
    """
    Say which library multiplies, for this process; ``auto`` at the start.

    :param name: ``auto`` measures which one is faster, ``default`` is what PyTorch takes for itself, ``onednn`` is oneDNN
        wherever it can be used
    :raises ValueError: If the name is unknown, or oneDNN is asked for and this PyTorch does not have it
    """
    global _chosen
    if name not in LIBRARIES:
        raise ValueError(f"Unknown library {name!r}: it must be one of {list(LIBRARIES)}")
    if name == "onednn" and _onednn_product() is None:
        raise ValueError(
            f"PyTorch {th.__version__} has no linear layers of oneDNN here, got {name!r}: take 'auto' or 'default'"
        )
    _chosen = name


def uses_onednn() -> bool:
    """
    :return: Whether linear layers of 32-bit matrices on a CPU are multiplied by oneDNN
    """
    return switch.is_on() and (_onednn_is_faster() if _chosen == "auto" else _chosen == "onednn")


@cache
def _onednn_product() -> Callable[[th.Tensor, th.Tensor, th.Tensor | None], th.Tensor] | None:
    """``x w^T + b``, None where this PyTorch cannot."""
    try:
        operator = th.ops.mkldnn._linear_pointwise.default
        product = lambda x, weight, bias: operator(x, weight, bias, "none", [], "")  # noqa: E731
        product(th.ones(2, 3), th.ones(4, 3), th.ones(4))
    except (AttributeError, RuntimeError):
        return None
    return product


@cache
def _onednn_is_faster() -> bool:
    product = _onednn_product()
    if product is None:
        return False
    x, weight = th.ones(2, _MEASURED_SIZE, _MEASURED_SIZE).unbind()
    with th.no_grad():
        return _seconds(lambda: F.linear(x, weight)) > LEAST_SPEEDUP * _seconds(lambda: product(x, weight, None))


def _seconds(function: Callable[[], Any]) -> float:
    """The shortest of some calls, which is the one that nothing else disturbed."""
    taken = []
    for _ in range(_REPETITIONS):
        start = time.perf_counter()
        function()
        taken.append(time.perf_counter() - start)
    return min(taken)


def linear(x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None) -> th.Tensor:
    """
    ``x W^T + b``, as :func:`torch.nn.functional.linear`, to rounding.

    :param x: Shape ``(batch, inputs)``
    :param weight: Shape ``(outputs, inputs)``
    :param bias: Shape ``(outputs,)``
    :return: Shape ``(batch, outputs)``
    """
    if not _is_covered(x, weight):
        return F.linear(x, weight, bias)
    if th.is_grad_enabled() and (x.requires_grad or weight.requires_grad):
        return _Linear.apply(x, weight, bias)  # type: ignore[no-any-return]
    return _product(x, weight, bias)


class Linear(nn.Linear):
    """``nn.Linear`` on the faster library; a state dictionary of one fits the other."""

    def forward(self, input: th.Tensor) -> th.Tensor:
        """
        :param input: Shape ``(batch, inputs)``
        :return: Shape ``(batch, outputs)``
        """
        return linear(input, self.weight, self.bias)


def make_layers_fast(network: nn.Module) -> None:
    """
    Replace each ``nn.Linear`` of a network by a :class:`Linear` that has its parameters.

    :param network: Layers, changed in place
    """
    for name, layer in network.named_children():
        if type(layer) is nn.Linear:
            # Without values of its own, which would move the generator of random numbers
            fast = Linear(layer.in_features, layer.out_features, bias=layer.bias is not None, device="meta")
            fast.weight, fast.bias = layer.weight, layer.bias
            setattr(network, name, fast)


def _is_covered(x: th.Tensor, weight: th.Tensor) -> bool:
    if _is_transformed() or x.ndim != 2 or x.dtype is not th.float32 or weight.dtype is not th.float32 or not x.is_cpu:
        return False
    return min(*x.shape, len(weight)) >= SMALLEST_SIZE and not th.is_autocast_enabled("cpu") and uses_onednn()


def _is_transformed() -> bool:
    """Whether what is computed is traced, counted, mapped or differentiated forwards, which knows PyTorch's own product."""
    return (
        th.compiler.is_compiling()
        or th.jit.is_tracing()
        or _get_current_dispatch_mode() is not None
        or th._C._functorch.maybe_current_level() is not None
        or th.autograd.forward_ad._current_level >= 0
    )


def _product(x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None = None) -> th.Tensor:
    """``x w^T + b`` by oneDNN."""
    # oneDNN needs milliseconds for a part of a larger matrix
    return _onednn_product()(_whole(x), _whole(weight), bias)  # type: ignore[misc]


def _whole(matrix: th.Tensor) -> th.Tensor:
    return matrix if matrix.is_contiguous() or matrix.mT.is_contiguous() else matrix.contiguous()


# The same as an operator of its own, which a compiled graph can hold: oneDNN's would have its operands copied there
_OPERATORS = th.library.Library("sb3_causalgdp", "DEF")
_OPERATORS.define("linear(Tensor x, Tensor weight, Tensor? bias) -> Tensor")
_OPERATORS.impl("linear", _product, "CPU")
_OPERATORS.impl("linear", lambda x, weight, bias: x.new_empty(len(x), len(weight)), "Meta")


class _Linear(th.autograd.Function):
    # Not with a setup_context, which costs as much time as a small product
    @staticmethod
    def forward(ctx: Any, x: th.Tensor, weight: th.Tensor, bias: th.Tensor | None) -> th.Tensor:  # type: ignore[override]
        ctx.save_for_backward(x, weight)
        return _product(x, weight, bias)

    @staticmethod
    def backward(ctx: Any, gradient: th.Tensor) -> tuple[th.Tensor | None, ...]:  # type: ignore[override]
        x, weight = ctx.saved_tensors
        by_x, by_weight, by_bias = ctx.needs_input_grad
        # The same three sizes, so as large as forward. With a graph, for derivatives of derivatives, these are layers again
        product = linear if th.is_grad_enabled() else _product
        return (
            product(gradient, weight.t()) if by_x else None,
            product(gradient.t(), x.t()) if by_weight else None,
            gradient.sum(dim=0) if by_bias else None,
        )
