"""What a guidance is, and how it enters a denoising step."""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
import torch as th

from sb3_causalgdp.diffusion.schedules import NoiseSchedule, at_step

NoisePredictor = Callable[[th.Tensor, int | float | th.Tensor], th.Tensor]
"""
Predicts the noise, shape ``(batch, d)``, from the noisy action and the diffusion step: an index, or, where a sampler takes
other steps than the schedule's, a floating point number between two.
"""

GUIDANCE_MODES = ("posterior", "score", "normalized")
GUIDANCE_COVARIANCES = ("tweedie", "isotropic", "unit_gaussian")


class Guidance(Protocol):
    """
    A log density over clean actions, known by its local quadratic model.

    Anything that can be called like this can steer a sampler: a causal world model, a classifier, a constraint.
    """

    def __call__(self, action: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """
        :param action: Estimate of the clean action, shape ``(batch, d)``
        :return: The gradient ``v = M^T Sigma^-1 (y - yhat)``, shape ``(batch, d)``, and the Gauss-Newton curvature
            ``P = M^T Sigma^-1 M``, shape ``(batch, d, d)``, of log N(y; yhat(a), Sigma) at the action, without a graph
        """
        ...  # pragma: no cover


class GuidanceRule:
    """
    Turns the local model of a guidance into the gradient G(a^k) that is added to the score.

    ``posterior`` is the gradient of log p(y | a^k) with the uncertainty of a^0 given a^k in it. With
    ``p(y | a^k) = N(y; yhat, Sigma + M C_k M^T)`` and the push-through identity it is ``J_k^T (I + P C_k)^-1 v``, where
    ``J_k = d a0_hat / d a^k`` and ``C_k = Cov(a^0 | a^k)``: no step is longer than the posterior allows, so nothing has to be
    clipped. ``score`` is the plain gradient ``v`` (the paper's equation for the guided noise), ``normalized`` is ``v`` at unit
    length.

    :param mode: One of ``posterior``, ``score`` and ``normalized``
    :param covariance: What ``posterior`` takes for C_k and J_k. ``tweedie``: ``C_k = (1 - alpha_bar_k) / sqrt(alpha_bar_k)
        J_k`` with the Jacobian of the denoiser, exact for every prior (second-order Tweedie), d Jacobian-vector products of
        the denoiser per step. ``isotropic``: ``C_k = (1 - alpha_bar_k) I``, with the denoiser's J_k. ``unit_gaussian``: both
        as if the prior were N(0, I), ``J_k = sqrt(alpha_bar_k) I``: no Jacobian of the denoiser, the cheapest
    :param scale: lambda_k of the paper: one factor for all diffusion steps, or one for each, from k = 1 to K
    :raises ValueError: If a name is unknown, or the scale is negative or not finite
    """

    # Forward, the Jacobian of the denoiser is fastest; backward, PyTorch can trace it for every batch size
    differentiates_forwards = True

    def __init__(
        self, mode: str = "posterior", covariance: str = "unit_gaussian", scale: float | Sequence[float] = 1.0
    ) -> None:
        if mode not in GUIDANCE_MODES:
            raise ValueError(f"Unknown guidance mode {mode!r}: it must be one of {list(GUIDANCE_MODES)} or None")
        if covariance not in GUIDANCE_COVARIANCES:
            raise ValueError(f"Unknown guidance_covariance {covariance!r}: it must be one of {list(GUIDANCE_COVARIANCES)}")
        try:
            scales = [float(value) for value in np.ravel(np.asarray(scale))]
        except (TypeError, ValueError):
            scales = []
        if not scales or isinstance(scale, (str, bool)) or any(not 0.0 <= value < float("inf") for value in scales):
            raise ValueError(f"guidance_scale must be a finite number of at least 0, or one for each step, got {scale!r}")
        self.mode = mode
        self.covariance = covariance
        self.scales = scales

    @property
    def needs_jacobian(self) -> bool:
        """Whether the Jacobian of the denoiser is needed."""
        return self.mode == "posterior" and self.covariance != "unit_gaussian"

    @property
    def samples_a_posterior(self) -> bool:
        """Whether the guided chain is that of a posterior, which asks for no smaller steps than the chain of the prior."""
        return self.mode == "posterior" and max(self.scales) <= 1.0

    def scale_at(self, step: int | float | th.Tensor, reference: th.Tensor) -> th.Tensor:
        """
        :param step: Diffusion step in [0, K-1], an index or a number between two: one, or shape ``(batch,)``
        :param reference: Tensor whose device and type the result takes
        :return: lambda_k, shape ``(1, 1)`` or ``(batch, 1)``
        """
        # Made on the device: to copy them there would be to wait for it
        scales = [th.full((1,), scale, dtype=reference.dtype, device=reference.device) for scale in self.scales]
        return (scales[0] if len(scales) == 1 else at_step(th.cat(scales), step)).reshape(-1, 1)

    def __call__(
        self,
        gradient: th.Tensor,
        curvature: th.Tensor,
        alpha_bar: th.Tensor,
        jacobian: th.Tensor | None = None,
    ) -> th.Tensor:
        """
        :param gradient: v, shape ``(batch, d)``
        :param curvature: P, shape ``(batch, d, d)``
        :param alpha_bar: Share of signal left, shape ``(batch, 1)`` or ``(1, 1)``
        :param jacobian: J_k of the denoiser, shape ``(batch, d, d)``; needed where :attr:`needs_jacobian`
        :return: G(a^k), shape ``(batch, d)``, without the scale lambda_k
        """
        if self.mode == "score":
            return gradient
        if self.mode == "normalized":
            return gradient / gradient.norm(dim=1, keepdim=True).clamp(min=1e-8)
        identity = th.eye(gradient.shape[1], dtype=gradient.dtype, device=gradient.device)
        if self.covariance == "unit_gaussian":
            system = identity + (1.0 - alpha_bar).unsqueeze(2) * curvature
            return alpha_bar.sqrt() * _solve(system, gradient)
        if jacobian is None:
            raise ValueError(f"guidance_covariance {self.covariance!r} needs the Jacobian of the denoiser")
        if self.covariance == "tweedie":
            covariance = ((1.0 - alpha_bar) / alpha_bar.sqrt()).unsqueeze(2) * jacobian
        else:
            covariance = (1.0 - alpha_bar).unsqueeze(2) * identity
        solution = _solve(identity + curvature @ covariance, gradient)
        return (jacobian.mT @ solution.unsqueeze(2)).squeeze(2)


def _solve(system: th.Tensor, right_side: th.Tensor) -> th.Tensor:
    """Solve ``(I + P C) x = v``, also where P is so large that rounding swallows the identity, which leaves it singular."""
    identity = th.eye(system.shape[-1], dtype=system.dtype, device=system.device)
    size = system.abs().amax(dim=(1, 2), keepdim=True)
    system = system + 8.0 * th.finfo(system.dtype).eps * size * identity
    return th.linalg.solve_ex(system, right_side.unsqueeze(2))[0].squeeze(2)


@th.no_grad()
def guidance_shift(
    guidance: Guidance,
    rule: GuidanceRule,
    predict_noise: NoisePredictor,
    schedule: NoiseSchedule,
    noisy_action: th.Tensor,
    noise: th.Tensor,
    step: int | float | th.Tensor,
    clip: float | None = 1.0,
) -> th.Tensor:
    """
    What the guidance takes off the predicted noise: ``lambda_k sqrt(1 - alpha_bar_k) G(a^k)``.

    The guidance is evaluated at the clean estimate a0_hat(a^k), where its model was trained, not at the noisy action.

    :param guidance: The log density that steers
    :param rule: How it enters the step
    :param predict_noise: The denoiser, bound to its condition
    :param schedule: Noise schedule
    :param noisy_action: a^k, shape ``(batch, d)``
    :param noise: The noise that the denoiser predicts for it, shape ``(batch, d)``
    :param step: Diffusion step in [0, K-1], an index or a number between two: one for all, or shape ``(batch,)``
    :param clip: Bound of the actions at which the guidance is evaluated, None for no bound
    :return: The shift, shape ``(batch, d)``, without a graph
    """
    alpha_bar = schedule.signal_left(step).to(noisy_action.dtype)
    clean = (noisy_action - (1.0 - alpha_bar).sqrt() * noise) / alpha_bar.sqrt()
    at = clean if clip is None else clean.clamp(-clip, clip)
    gradient, curvature = checked_answer(guidance(at), at)
    jacobian = None
    if rule.needs_jacobian:
        jacobian = clean_estimate_jacobian(predict_noise, noisy_action, step, alpha_bar, rule.differentiates_forwards)
    direction = rule(gradient, curvature, alpha_bar, jacobian)
    return rule.scale_at(step, alpha_bar) * (1.0 - alpha_bar).sqrt() * direction


def checked_answer(answer: Any, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
    """
    :param answer: What a guidance says
    :param actions: Of these, shape ``(batch, d)``
    :return: Its gradient and curvature
    :raises ValueError: If these are none, or of other shapes, which PyTorch would repeat
    """
    batch, width = actions.shape
    parts = tuple(answer) if isinstance(answer, tuple | list) else (answer,)
    shapes = [tuple(part.shape) if isinstance(part, th.Tensor) else type(part).__name__ for part in parts]
    wanted = [(batch, width), (batch, width, width)]
    if shapes != wanted:
        raise ValueError(
            f"guidance must give tensors, a gradient and a curvature of the shapes {wanted[0]} and {wanted[1]}, "
            f"got {', '.join(map(str, shapes))}"
        )
    return parts[0], parts[1]


def clean_estimate_jacobian(
    predict_noise: NoisePredictor,
    noisy_action: th.Tensor,
    step: int | float | th.Tensor,
    alpha_bar: th.Tensor,
    forwards: bool = True,
) -> th.Tensor:
    """
    J_k = d a0_hat / d a^k of the denoiser, by d forward-mode products in one batch.

    :param predict_noise: The denoiser, bound to its condition
    :param noisy_action: a^k, shape ``(batch, d)``
    :param step: Diffusion step in [0, K-1], an index or a number between two: one for all, or shape ``(batch,)``
    :param alpha_bar: Share of signal left, shape ``(batch, 1)`` or ``(1, 1)``
    :param forwards: Whether by forward-mode products; if not, by d backward passes
    :return: Shape ``(batch, d, d)``; entry ``[b, i, j]`` is the derivative of a0_hat_i by a^k_j
    """

    def column(tangent: th.Tensor) -> th.Tensor:
        tangents = tangent.expand_as(noisy_action)
        return th.func.jvp(lambda action: predict_noise(action, step), (noisy_action,), (tangents,))[1]

    identity = th.eye(noisy_action.shape[1], dtype=noisy_action.dtype, device=noisy_action.device)
    if forwards:
        noise_jacobian = th.func.vmap(column)(identity).permute(1, 2, 0)
    else:
        noise_jacobian = _jacobian_backwards(lambda action: predict_noise(action, step), noisy_action)
    return (identity - (1.0 - alpha_bar).sqrt().unsqueeze(2) * noise_jacobian) / alpha_bar.sqrt().unsqueeze(2)


def _jacobian_backwards(function: Callable[[th.Tensor], th.Tensor], action: th.Tensor) -> th.Tensor:
    with th.enable_grad():
        action = action.detach().requires_grad_()
        outputs = function(action).unbind(dim=1)
        rows = [th.autograd.grad(output.sum(), action, retain_graph=True)[0] for output in outputs]
    return th.stack(rows, dim=1)
