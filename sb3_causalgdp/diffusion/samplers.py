"""From noise to actions."""

import math
from collections.abc import Callable
from functools import partial

import torch as th

from sb3_causalgdp.diffusion.bounds import bounded
from sb3_causalgdp.diffusion.guidance import Guidance, GuidanceRule, NoisePredictor, guidance_shift
from sb3_causalgdp.diffusion.schedules import NoiseSchedule

Denoiser = Callable[[th.Tensor, int | th.Tensor, th.Tensor], th.Tensor]
"""Predicts the noise, shape ``(batch, d)``, from the noisy action, the index of the diffusion step and the condition."""

SAMPLERS = ("ddpm", "ddim")


def check_sampler(sampler: str, eta: float) -> None:
    """
    :param sampler: ``ddpm`` or ``ddim``
    :param eta: Noise of DDIM, in [0, 1]
    :raises ValueError: If the name is unknown or the noise is out of range
    """
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


def _call(denoiser: Denoiser, condition: th.Tensor, noisy_action: th.Tensor, step: int | th.Tensor) -> th.Tensor:
    return denoiser(noisy_action, step, condition)


def transition_std(schedule: NoiseSchedule, step: int) -> float:
    """
    Standard deviation sigma_k of a DDPM step; the last step, which draws no noise, takes that of the step before it.

    :param schedule: Noise schedule
    :param step: Index of the diffusion step, ``0..K-1``
    :return: sigma_k
    """
    if schedule.n_steps == 1:
        return math.sqrt(schedule.beta_list[0])
    step = max(step, 1)
    previous, current = schedule.alpha_bar_previous_list[step], schedule.alpha_bar_list[step]
    return math.sqrt((1.0 - previous) / (1.0 - current) * schedule.beta_list[step])


def transition_weights(schedule: NoiseSchedule, step: int, eta: float = 1.0) -> tuple[float, float, float]:
    """
    A reverse step is ``a^(k-1) = by_clean a0_hat + by_noisy a^k + std z`` (Song et al., 2021, DDIM, equation 12).

    :param schedule: Noise schedule
    :param step: Index of the diffusion step, ``0..K-1``; step 0 returns the clean action, ``(1, 0, 0)``
    :param eta: 1 is DDPM's ancestral step, 0 is deterministic
    :return: ``by_clean``, ``by_noisy`` and ``std``
    """
    if step == 0:
        return 1.0, 0.0, 0.0
    alpha_bar, previous = schedule.alpha_bar_list[step], schedule.alpha_bar_previous_list[step]
    std = eta * transition_std(schedule, step)
    by_noisy = math.sqrt(1.0 - previous - std**2) / math.sqrt(1.0 - alpha_bar)
    return math.sqrt(previous) - by_noisy * math.sqrt(alpha_bar), by_noisy, std


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
    if step == 0:
        return clean_action
    by_clean, by_noisy, std = transition_weights(schedule, step, eta)
    mean = by_clean * clean_action + by_noisy * noisy_action
    return mean + std * noise if std > 0.0 else mean


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
    :param noise: Standard normal noise, shape ``(K, batch, d)``: the start a^K, then that of the steps K..2 (DDIM without
        noise reads the start only). Drawn if None; zeros give the noise-free chain
    :param action_dim: Number of action components, where neither ``noise`` nor the denoiser tells
    :param sampler: ``ddpm`` or ``ddim``
    :param eta: Noise of DDIM: 0 is deterministic, 1 is DDPM
    :param clip: Bound of the clean estimate, None for no bound; gradients that point back inside pass it, see
        :func:`~sb3_causalgdp.diffusion.bounds.bounded`
    :param divergences: If a list, each guided step appends its ``||mu_cg - mu||^2 / (2 sigma_k^2)``, shape ``(batch,)``:
        their sum is KL(pi_cg || pi) of the chain (the paper's Theorem 1), with DDPM's sigma_k
    :return: Actions, shape ``(batch, d)``
    """
    check_sampler(sampler, eta)
    rule = GuidanceRule() if rule is None else rule
    eta = 1.0 if sampler == "ddpm" else eta
    if noise is None:
        width = denoiser.action_dim if action_dim is None else action_dim  # type: ignore[attr-defined]
        noise = th.randn(schedule.n_steps, len(observation), width, dtype=observation.dtype, device=observation.device)
    if noise.ndim != 3 or noise.shape[:2] != (schedule.n_steps, observation.shape[0]):
        raise ValueError(f"noise must have the shape ({schedule.n_steps}, {len(observation)}, d), got {tuple(noise.shape)}")
    if guidance is not None and len(rule.scales) not in (1, schedule.n_steps):
        raise ValueError(f"guidance_scale must hold 1 or {schedule.n_steps} values, got {len(rule.scales)}")
    predict_noise = bind(denoiser, observation)
    action = noise[0]
    for position, step in enumerate(reversed(range(schedule.n_steps))):
        signal = math.sqrt(schedule.alpha_bar_list[step])
        spread = math.sqrt(1.0 - schedule.alpha_bar_list[step])
        predicted = predict_noise(action, step)
        clean = (action - spread * predicted) / signal
        if guidance is not None:
            shift = guidance_shift(guidance, rule, predict_noise, schedule, action, predicted, step, clip)
            guided = clean + (spread / signal) * shift
            if divergences is not None:
                divergences.append(_step_divergence(schedule, step, bounded(clean, clip), bounded(guided, clip)))
            clean = guided
        fresh = noise[min(position + 1, schedule.n_steps - 1)]
        action = denoising_step(schedule, step, action, bounded(clean, clip), fresh, eta)
    return action


def _step_divergence(schedule: NoiseSchedule, step: int, clean: th.Tensor, guided: th.Tensor) -> th.Tensor:
    """KL divergence of the guided DDPM step from the plain one: both are Gaussians with the covariance sigma_k^2 I."""
    alpha_bar, previous = schedule.alpha_bar_list[step], schedule.alpha_bar_previous_list[step]
    weight = math.sqrt(previous) * schedule.beta_list[step] / (1.0 - alpha_bar)
    return (weight * (guided - clean)).detach().square().sum(dim=1) / (2.0 * transition_std(schedule, step) ** 2)
