"""Actions have bounds, and beyond them a way back."""

from typing import Any

import torch as th


class _Bounded(th.autograd.Function):
    """A clamp whose gradient is lost only where a step along it would lead further out."""

    @staticmethod
    def forward(ctx: Any, action: th.Tensor, bound: float) -> th.Tensor:
        ctx.save_for_backward(action)
        ctx.bound = bound
        return action.clamp(-bound, bound)

    @staticmethod
    def backward(ctx: Any, *gradients: th.Tensor) -> tuple[th.Tensor, None]:
        (action,), (gradient,) = ctx.saved_tensors, gradients
        # A minimiser moves against the gradient
        outward = ((action > ctx.bound) & (gradient < 0.0)) | ((action < -ctx.bound) & (gradient > 0.0))
        return gradient.masked_fill(outward, 0.0), None


def bounded(action: th.Tensor, bound: float | None = 1.0) -> th.Tensor:
    """
    Clip actions to their bounds. Where a component lies outside, the gradient of what is minimised passes if it points back
    inside, and is 0 if it points further out ("inverting gradients", Hausknecht & Stone, 2016, https://arxiv.org/abs/1511.04143,
    section 3.3): a plain clamp would lose both, and what is outside would stay there.

    :param action: Any shape
    :param bound: Of each component, in absolute value, None for no bound
    :return: The same shape, in [-bound, bound]
    """
    if bound is None:
        return action
    if not action.requires_grad:
        return action.clamp(-bound, bound)
    return _Bounded.apply(action, bound)


def outside(action: th.Tensor, bound: float = 1.0) -> th.Tensor:
    """
    :param action: Actions that are not clipped, any shape
    :param bound: Of each component, in absolute value
    :return: Mean squared distance from the bounds, 0 where all are inside, scalar
    """
    return th.relu(action.abs() - bound).square().mean()
