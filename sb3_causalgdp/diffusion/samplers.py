"""From noise to actions."""

import math
from collections.abc import Callable
from functools import partial

import torch as th

from sb3_causalgdp.diffusion.bounds import bounded
from sb3_causalgdp.diffusion.guidance import Guidance, GuidanceRule, NoisePredictor, guidance_shift
from sb3_causalgdp.diffusion.plans import SAMPLERS, SPACINGS, Stage, ancestral_std, sampling_plan, sampling_points
from sb3_causalgdp.diffusion.schedules import NoiseSchedule

Denoiser = Callable[[th.Tensor, int | float | th.Tensor, th.Tensor], th.Tensor]
"""
Predicts the noise, shape ``(batch, d)``, from the noisy action, the diffusion step and the condition. The step is an index;
where a sampler takes other steps than the schedule's, a floating point number between two.
"""


def check_sampler(sampler: str, eta: float, n_steps: int | None = None, spacing: str = "time") -> None:
    """
    :param sampler: One of :data:`~sb3_causalgdp.diffusion.SAMPLERS`
    :param eta: Noise of DDIM, in [0, 1]
    :param n_steps: Number of the sampler's steps, None for the schedule's
    :param spacing: ``time`` or ``log_snr``
    :raises ValueError: If a name is unknown or a number is out of range
    """
    if spacing not in SPACINGS:
        raise ValueError(f"Unknown spacing {spacing!r}: it must be one of {list(SPACINGS)}")
    if n_steps is not None and (isinstance(n_steps, bool) or not isinstance(n_steps, int) or n_steps < 1):
        raise ValueError(f"sampling_steps must be an integer of at least 1 or None, got {n_steps!r}")
    if sampler not in SAMPLERS:
        raise ValueError(f"Unknown sampler {sampler!r}: it must be one of {list(SAMPLERS)}")
    if not 0.0 <= eta <= 1.0:
        raise ValueError(f"ddim_eta must be in [0, 1], got {eta!r}")


def bind(denoiser: Denoiser, condition: th.Tensor) -> NoisePredictor:
    """
    :param denoiser: Predicts the noise from ``(noisy_action, step, condition)``; its method ``bind`` is used where it has one
    :param condition: What it is conditioned on, shape ``(batch, condition_dim)``
    :return: Predicts the noise from ``(noisy_action, step)``
    """
    if hasattr(denoiser, "bind"):
        return denoiser.bind(condition)
    return partial(_call, denoiser, condition)


def _call(denoiser: Denoiser, condition: th.Tensor, noisy_action: th.Tensor, step: int | float | th.Tensor) -> th.Tensor:
    return denoiser(noisy_action, step, condition)


def transition_std(schedule: NoiseSchedule, step: int) -> float:
    """
    Standard deviation sigma_k of a DDPM step; the last step, which draws no noise, takes that of the step before it.

    :param schedule: Noise schedule
    :param step: Index of the diffusion step, ``0..K-1``
    :return: sigma_k
    """
    return ancestral_std(sampling_points(schedule), step)


def denoising_step(
    schedule: NoiseSchedule,
    step: int,
    noisy_action: th.Tensor,
    clean_action: th.Tensor,
    noise: th.Tensor,
    eta: float = 1.0,
) -> th.Tensor:
    """
    One reverse step from a^k to a^(k-1), given the estimate of the clean action (Song et al., 2021, DDIM, equation 12).

    :param schedule: Noise schedule
    :param step: Index of the diffusion step, ``0..K-1``
    :param noisy_action: a^k, shape ``(batch, d)``
    :param clean_action: Estimate of a^0, shape ``(batch, d)``
    :param noise: Standard normal noise, shape ``(batch, d)``; not used by the last step
    :param eta: 1 is DDPM's ancestral step, 0 is deterministic
    :return: a^(k-1), shape ``(batch, d)``
    """
    stage = sampling_plan(schedule, "ddim", eta)[-1 - step]
    return moved(stage, noisy_action, clean_action, noise, None, None)


def moved(
    stage: Stage,
    noisy_action: th.Tensor,
    clean_action: th.Tensor,
    noise: th.Tensor,
    previous_noisy: th.Tensor | None,
    previous_clean: th.Tensor | None,
) -> th.Tensor:
    """
    The move of a stage of :func:`~sb3_causalgdp.diffusion.plans.sampling_plan`.

    :param stage: The stage
    :param noisy_action: The noisy action that the denoiser saw, shape ``(batch, d)``
    :param clean_action: Estimate of a^0, shape ``(batch, d)``
    :param noise: Standard normal noise, shape ``(batch, d)``; read by stages with noise alone
    :param previous_noisy: The noisy action of the stage before, None at the first
    :param previous_clean: The clean estimate of the stage before, None at the first
    :return: The noisy action of the next stage, or, at the last, the action, shape ``(batch, d)``
    """
    if stage.is_last:
        return clean_action
    action = stage.by_clean * clean_action + stage.by_noisy * noisy_action
    if stage.by_previous_clean != 0.0:
        assert previous_clean is not None
        action = action + stage.by_previous_clean * previous_clean
    if stage.by_previous_noisy != 0.0:
        assert previous_noisy is not None
        action = action + stage.by_previous_noisy * previous_noisy
    return action + stage.std * noise if stage.std > 0.0 else action


def sample(
    denoiser: Denoiser,
    schedule: NoiseSchedule,
    observation: th.Tensor,
    guidance: Guidance | None = None,
    rule: GuidanceRule | None = None,
    *,
    noise: th.Tensor | None = None,
    action_dim: int | None = None,
    sampler: str = "ddpm",
    eta: float = 0.0,
    n_steps: int | None = None,
    spacing: str = "time",
    clip: float | None = 1.0,
    divergences: list[th.Tensor] | None = None,
) -> th.Tensor:
    """
    Denoise actions, each step steered by the guidance where there is one.

    Gradients flow through the denoiser of every step; the guidance is a constant shift of the noise.

    :param denoiser: Predicts the noise from ``(noisy_action, step, condition)``, see :class:`MLPDenoiser`
    :param schedule: Noise schedule with K steps
    :param observation: What the denoiser is conditioned on, shape ``(batch, condition_dim)``
    :param guidance: The log density that steers, None for the diffusion policy as it is
    :param rule: How the guidance enters a step, ``GuidanceRule()`` if None
    :param noise: Standard normal noise, shape ``(n_steps, batch, d)``: the start a^K, then that of all steps but the last
        (those that draw none read the start only). Drawn if None; zeros give the noise-free chain
    :param action_dim: Number of action components, where neither ``noise`` nor the denoiser tells
    :param sampler: ``ddpm`` and ``ddim``; ``euler_maruyama``, the reverse SDE; ``heun`` and ``dpm_solver``, methods of second
        order for the probability-flow ODE, the first with two evaluations of the denoiser in each step, the other with one
    :param eta: Noise of DDIM: 0 is deterministic, 1 is DDPM
    :param n_steps: Number of the sampler's steps, None for the schedule's K; others are spread over the same times, and the
        denoiser is asked at fractions of its steps
    :param spacing: ``time`` for evenly spaced diffusion steps, ``log_snr`` for evenly spaced logs of signal over noise
    :param clip: Bound of the clean estimate, None for no bound; gradients that point back inside pass it, see
        :func:`~sb3_causalgdp.diffusion.bounds.bounded`
    :param divergences: If a list, each guided step appends its ``||mu_cg - mu||^2 / (2 sigma_k^2)``, shape ``(batch,)``:
        their sum is KL(pi_cg || pi) of the chain (the paper's Theorem 1), with DDPM's sigma_k
    :return: Actions, shape ``(batch, d)``
    """
    check_sampler(sampler, eta, n_steps, spacing)
    rule = GuidanceRule() if rule is None else rule
    n_noises = schedule.n_steps if n_steps is None else n_steps
    if noise is None:
        width = getattr(denoiser, "action_dim", None) if action_dim is None else action_dim
        if width is None:
            raise ValueError("action_dim must be given, or noise, for a denoiser without an attribute action_dim")
        noise = th.randn(n_noises, len(observation), width, dtype=observation.dtype, device=observation.device)
    if noise.ndim != 3 or noise.shape[:2] != (n_noises, observation.shape[0]):
        raise ValueError(f"noise must have the shape ({n_noises}, {len(observation)}, d), got {tuple(noise.shape)}")
    if guidance is not None and len(rule.scales) not in (1, schedule.n_steps):
        raise ValueError(f"guidance_scale must hold 1 or {schedule.n_steps} values, got {len(rule.scales)}")
    predict_noise = bind(denoiser, observation)
    action = noise[0]
    previous_action = previous_clean = None
    points = sampling_points(schedule, n_steps, spacing) if divergences is not None else []
    for position, stage in enumerate(sampling_plan(schedule, sampler, eta, n_steps, spacing)):
        signal, spread = math.sqrt(stage.alpha_bar), math.sqrt(1.0 - stage.alpha_bar)
        predicted = predict_noise(action, stage.step)
        if predicted.shape != action.shape:
            raise ValueError(f"denoiser must predict noise of the shape {tuple(action.shape)}, got {tuple(predicted.shape)}")
        clean = (action - spread * predicted) / signal
        if guidance is not None:
            shift = guidance_shift(guidance, rule, predict_noise, schedule, action, predicted, stage.step, clip)
            guided = clean + (spread / signal) * shift
            if divergences is not None and not stage.corrects:
                std = ancestral_std(points, stage.point)
                divergences.append(_step_divergence(stage, std, bounded(clean, clip), bounded(guided, clip)))
            clean = guided
        clean = bounded(clean, clip)
        fresh = noise[min(position + 1, n_noises - 1)]
        following = moved(stage, action, clean, fresh, previous_action, previous_clean)
        previous_action, previous_clean, action = action, clean, following
    return action


def _step_divergence(stage: Stage, std: float, clean: th.Tensor, guided: th.Tensor) -> th.Tensor:
    """KL divergence of the guided DDPM step from the plain one: both are Gaussians with the covariance sigma_k^2 I."""
    weight = math.sqrt(stage.previous) * stage.beta / (1.0 - stage.alpha_bar)
    return (weight * (guided - clean)).detach().square().sum(dim=1) / (2.0 * std**2)
