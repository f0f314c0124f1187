"""What an update has to multiply, and how long these products take alone."""

import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import torch as th
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import FlopCounterMode

PRODUCTS = ("mm", "addmm", "bmm", "baddbmm")
Layout = tuple[tuple[int, ...], tuple[int, ...]]
Product = tuple[str, tuple[Layout, ...]]
"""Name of the operator, and shape and strides of each of its operands: a transposed operand has another speed."""


class ProductRecorder(TorchDispatchMode):
    """Counts the matrix products of the code that runs inside, by operator and layout."""

    def __init__(self) -> None:
        super().__init__()
        self.counts: Counter[Product] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        name = func._overloadpacket.__name__
        if name in PRODUCTS:
            operands = [argument for argument in args if isinstance(argument, th.Tensor)]
            self.counts[name, tuple((tuple(one.shape), tuple(one.stride())) for one in operands)] += 1
        return func(*args, **(kwargs or {}))


CYCLE = 6  # updates after which the delays of actors and world models begin anew


def count_flops(update: Callable[[], Any]) -> dict[str, int]:
    """
    :param update: Makes one update
    :return: Floating point operations by operator (PyTorch's counter: matrix products and nothing else), and their ``total``
    """
    with FlopCounterMode(display=False) as counter:
        update()
    by_operator = {str(operator): int(count) for operator, count in counter.get_flop_counts().get("Global", {}).items()}
    return {**by_operator, "total": int(counter.get_total_flops())}


def products_alone(update: Callable[[], Any], seconds: float = 0.002) -> dict[str, float]:
    """
    The matrix products of one update, each layout timed alone by the faster library, nothing else around it.

    :param update: Makes one update
    :param seconds: CPU seconds for which each layout is repeated
    :return: ``n_products``, their ``seconds`` and the sum of their floating point operations
    """
    with ProductRecorder() as recorder:
        update()
    total = {"n_products": 0.0, "seconds": 0.0, "flops": 0.0}
    for (name, layouts), count in recorder.counts.items():
        operands = [_random(*layout) for layout in layouts]
        total["n_products"] += count
        total["seconds"] += count * _fastest_seconds(name, operands, seconds)
        left, right = layouts[-2][0], layouts[-1][0]
        total["flops"] += count * 2 * float(th.tensor(left).prod()) * right[-1]
    return total


def _random(shape: tuple[int, ...], stride: tuple[int, ...]) -> th.Tensor:
    # By hand: an expanded operand (stride 0) shares memory with itself and cannot be written to
    n_elements = 1 + sum((size - 1) * step for size, step in zip(shape, stride, strict=True))
    return th.randn(n_elements).as_strided(shape, stride)


def layer_rate(batch: int, inputs: int, outputs: int, seconds: float = 0.1) -> dict[str, float]:
    """
    The rate of one dense layer's three products, each by the faster of PyTorch's two libraries for a CPU.

    :param batch: Rows
    :param inputs: Input units
    :param outputs: Output units
    :param seconds: CPU seconds for each product
    :return: GFLOP/s ``forward`` (x W^T), ``by_input`` (g W), ``by_weight`` (g^T x), of the three together, ``layer``, and of
        these as PyTorch multiplies by itself, ``default``
    """
    x, weight, gradient = th.randn(batch, inputs), th.randn(outputs, inputs), th.randn(batch, outputs)
    operands = {"forward": (x, weight.t()), "by_input": (gradient, weight), "by_weight": (gradient.t(), x)}
    flops = 2.0 * batch * inputs * outputs
    taken = {name: _fastest_seconds("mm", pair, seconds) for name, pair in operands.items()}
    default = sum(_mean_seconds(th.mm, pair, seconds) for pair in operands.values())
    rates = {name: flops / one / 1e9 for name, one in taken.items()}
    return {**rates, "layer": 3.0 * flops / sum(taken.values()) / 1e9, "default": 3.0 * flops / default / 1e9}


def _fastest_seconds(name: str, operands: Sequence[th.Tensor], seconds: float) -> float:
    """By PyTorch's own choice, or by oneDNN, where a layer can be asked of it."""
    taken = _mean_seconds(getattr(th, name), operands, seconds)
    *bias, left, right = operands
    if name not in ("mm", "addmm") or any(one.ndim != 1 for one in bias) or not hasattr(th.ops.mkldnn, "_linear_pointwise"):
        return taken
    layer = th.ops.mkldnn._linear_pointwise.default
    arguments: tuple[Any, ...] = (left, right.t(), bias[0] if bias else None, "none", [], "")
    return min(taken, _mean_seconds(layer, arguments, seconds))


def _mean_seconds(product: Callable[..., th.Tensor], operands: Sequence[Any], seconds: float) -> float:
    product(*operands)
    calls, start = 0, time.process_time()
    while time.process_time() < start + seconds:
        for _ in range(5):
            product(*operands)
        calls += 5
    return (time.process_time() - start) / calls
