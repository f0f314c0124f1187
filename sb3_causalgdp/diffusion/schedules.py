"""How much of the action is left at each diffusion step."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch as th
from torch import nn

from sb3_causalgdp.checks import register


def vp_betas(n_steps: int, beta_min: float = 0.1, beta_max: float = 10.0) -> th.Tensor:
    """
    Variance-preserving SDE, integrated exactly over each of the steps (Song et al., 2021; Diffusion-QL, Wang et al., 2023).

    :param n_steps: Number of diffusion steps K
    :param beta_min: Noise rate at the clean end, per unit of diffusion time
    :param beta_max: Noise rate at the noise end
    :return: beta_k for k = 1..K, shape ``(K,)``, float64
    """
    step = th.arange(1, n_steps + 1, dtype=th.float64)
    rate = beta_min / n_steps + 0.5 * (beta_max - beta_min) * (2 * step - 1) / n_steps**2
    return 1.0 - th.exp(-rate)


def linear_betas(n_steps: int, beta_start: float = 1e-4, beta_end: float = 2e-2) -> th.Tensor:
    """
    DDPM's 1000 linear steps (Ho et al., 2020), thinned out to K steps.

    DDPM's own betas leave 95 % of the signal after five steps, yet sampling starts from pure noise. The cumulative product
    of the 1000 steps is therefore read at K evenly spaced times: equal to DDPM at K = 1000, usable at every K.

    :param n_steps: Number of diffusion steps K
    :param beta_start: First of the 1000 betas
    :param beta_end: Last of the 1000 betas
    :return: beta_k for k = 1..K, shape ``(K,)``, float64
    """
    reference_steps = 1000
    log_alpha_bar = th.log1p(-th.linspace(beta_start, beta_end, reference_steps, dtype=th.float64)).cumsum(0)
    log_alpha_bar = th.cat([th.zeros(1, dtype=th.float64), log_alpha_bar])
    position = th.arange(n_steps + 1, dtype=th.float64) * reference_steps / n_steps
    lower = position.floor().long().clamp(max=reference_steps - 1)
    values = th.lerp(log_alpha_bar[lower], log_alpha_bar[lower + 1], position - lower)
    return -th.expm1(values.diff())


def cosine_betas(n_steps: int, offset: float = 0.008, max_beta: float = 0.999) -> th.Tensor:
    """
    Cosine schedule (Nichol & Dhariwal, 2021, equation 17).

    :param n_steps: Number of diffusion steps K
    :param offset: Keeps the first beta from vanishing
    :param max_beta: Upper bound of beta_k, reached by the last step
    :return: beta_k for k = 1..K, shape ``(K,)``, float64
    """
    time = th.arange(n_steps + 1, dtype=th.float64) / n_steps
    alpha_bar = th.cos((time + offset) / (1 + offset) * math.pi / 2) ** 2
    return (1.0 - alpha_bar[1:] / alpha_bar[:-1]).clamp(max=max_beta)


NOISE_SCHEDULES: dict[str, Callable[[int], th.Tensor]] = {
    "vp": vp_betas,
    "linear": linear_betas,
    "cosine": cosine_betas,
}


def at_step(table: th.Tensor, step: int | float | th.Tensor) -> th.Tensor:
    """
    Rows of a table that has one for each diffusion step. At a time between two steps, what is between their rows: a network
    that was trained at the steps alone has seen nothing else.

    :param table: Shape ``(K, ...)``
    :param step: Diffusion step in [0, K-1], an index or a number between two: one, or shape ``(batch,)``
    :return: Shape ``(...)``, or ``(batch, ...)``
    """
    if isinstance(step, int):
        return table[step]
    last = len(table) - 1
    if isinstance(step, th.Tensor) and step.is_floating_point():
        lower = step.floor().long().clamp(0, last)
        weight = (step - lower).to(table.dtype).reshape(-1, *[1] * (table.ndim - 1))
        return table[lower].lerp(table[(lower + 1).clamp(max=last)], weight)
    if isinstance(step, float):
        below = min(max(int(step), 0), last)
        return table[below].lerp(table[min(below + 1, last)], step - below)
    return table[step]


def register_noise_schedule(name: str, betas: Callable[[int], th.Tensor]) -> None:
    """
    Let ``noise_schedule=name`` be a noise schedule of one's own.

    :param name: Its name
    :param betas: Gives beta_1 to beta_K for a number of diffusion steps K, shape ``(K,)``, in (0, 1)
    :raises ValueError: If there is another noise schedule of that name
    """
    register(NOISE_SCHEDULES, name, betas, "noise schedule")


def _checked_betas(betas: Any, name: str, n_steps: int) -> th.Tensor:
    """Of a function of one's own, too; double precision."""
    betas = th.as_tensor(betas, dtype=th.float64)
    if betas.shape != (n_steps,) or not bool(((betas > 0.0) & (betas < 1.0)).all()):
        raise ValueError(
            f"noise_schedule {name!r} must give {n_steps} betas between 0 and 1, got {betas.flatten().tolist()[:10]} "
            f"of the shape {tuple(betas.shape)}"
        )
    return betas


class NoiseSchedule(nn.Module):
    """
    The coefficients of the forward process ``a^k = sqrt(alpha_bar_k) a^0 + sqrt(1 - alpha_bar_k) eps``.

    With the steps as points of a time that is continuous, it is the variance-preserving SDE
    ``da = -1/2 beta(t) a dt + sqrt(beta(t)) dw`` (Song et al., 2021), of which a step integrates beta(t) exactly.

    All are float32 buffers of shape ``(K,)`` that are not saved: they follow from the name and the number of steps. Index
    ``k - 1`` belongs to the paper's diffusion step ``k = 1..K``.

    :param name: One of ``vp``, ``linear`` and ``cosine``
    :param n_steps: Number of diffusion steps K, at least 1
    :raises ValueError: If the name is unknown or there is no step
    """

    betas: th.Tensor
    alpha_bar: th.Tensor
    alpha_bar_previous: th.Tensor
    sqrt_alpha_bar: th.Tensor
    sqrt_one_minus_alpha_bar: th.Tensor
    log_snr: th.Tensor

    def __init__(self, name: str = "vp", n_steps: int = 5) -> None:
        super().__init__()
        if name not in NOISE_SCHEDULES:
            raise ValueError(f"Unknown noise_schedule {name!r}: it must be one of {sorted(NOISE_SCHEDULES)}")
        if isinstance(n_steps, bool) or not isinstance(n_steps, (int, np.integer)) or n_steps < 1:
            raise ValueError(f"diffusion_steps must be an integer of at least 1, got {n_steps!r}")
        self.name = name
        self.n_steps = int(n_steps)
        betas = _checked_betas(NOISE_SCHEDULES[name](self.n_steps), name, self.n_steps)
        alpha_bar = th.cumprod(1.0 - betas, dim=0)
        alpha_bar_previous = th.cat([th.ones(1, dtype=th.float64), alpha_bar[:-1]])
        coefficients = {
            "betas": betas,
            "alpha_bar": alpha_bar,
            "alpha_bar_previous": alpha_bar_previous,
            "sqrt_alpha_bar": alpha_bar.sqrt(),
            "sqrt_one_minus_alpha_bar": (1.0 - alpha_bar).sqrt(),
            "log_snr": alpha_bar.log() - th.log1p(-alpha_bar),
        }
        for key, value in coefficients.items():
            self.register_buffer(key, value.float(), persistent=False)
        # Python floats in double precision: the samplers read one coefficient at a time, without a tensor look-up
        self.alpha_bar_list: list[float] = alpha_bar.tolist()
        self.alpha_bar_previous_list: list[float] = alpha_bar_previous.tolist()
        self.beta_list: list[float] = betas.tolist()
        self.log_snr_list: list[float] = coefficients["log_snr"].tolist()
        # What the samplers made of it, by their settings
        self.plans: dict[tuple, list] = {}

    def alpha_bar_at(self, step: float) -> float:
        """
        Share of signal left at any time: between two diffusion steps, the log of the signal-to-noise ratio is linear in time.

        :param step: Diffusion step, a fraction between two indices, in [0, K-1]
        :return: alpha_bar
        """
        below = min(max(int(step), 0), self.n_steps - 1)
        share = step - below
        if share <= 0.0 or below == self.n_steps - 1:
            return self.alpha_bar_list[below]
        log_snr = (1.0 - share) * self.log_snr_list[below] + share * self.log_snr_list[below + 1]
        return 1.0 / (1.0 + math.exp(-log_snr))

    def signal_left(self, step: int | float | th.Tensor) -> th.Tensor:
        """
        :meth:`alpha_bar_at` as a tensor.

        :param step: Diffusion step in [0, K-1]: an index, a fraction between two, or a tensor of either of shape ``(batch,)``
        :return: alpha_bar, shape ``(1, 1)`` or ``(batch, 1)``
        """
        if isinstance(step, float):
            return th.full((1, 1), self.alpha_bar_at(step), dtype=self.alpha_bar.dtype, device=self.alpha_bar.device)
        if not isinstance(step, th.Tensor) or not step.is_floating_point():
            return self.alpha_bar[step].reshape(-1, 1)
        return th.sigmoid(at_step(self.log_snr, step)).reshape(-1, 1)

    def add_noise(self, action: th.Tensor, noise: th.Tensor, step: th.Tensor) -> th.Tensor:
        """
        Draw from the forward process.

        :param action: Clean actions a^0, shape ``(batch, d)``
        :param noise: Standard normal noise, shape ``(batch, d)``
        :param step: Diffusion step in [0, K-1]: indices, or floating point numbers between them, shape ``(batch,)``
        :return: Noisy actions a^k, shape ``(batch, d)``
        """
        if step.is_floating_point():
            alpha_bar = self.signal_left(step)
            return alpha_bar.sqrt() * action + (1.0 - alpha_bar).sqrt() * noise
        return self.sqrt_alpha_bar[step].unsqueeze(1) * action + self.sqrt_one_minus_alpha_bar[step].unsqueeze(1) * noise

    def clean_estimate(self, noisy_action: th.Tensor, noise: th.Tensor, step: th.Tensor) -> th.Tensor:
        """
        Invert :meth:`add_noise` for a predicted noise.

        :param noisy_action: a^k, shape ``(batch, d)``
        :param noise: Predicted noise, shape ``(batch, d)``
        :param step: Diffusion step in [0, K-1]: indices, or floating point numbers between them, shape ``(batch,)``
        :return: Estimate of the clean action, shape ``(batch, d)``
        """
        if step.is_floating_point():
            alpha_bar = self.signal_left(step)
            return (noisy_action - (1.0 - alpha_bar).sqrt() * noise) / alpha_bar.sqrt()
        return (noisy_action - self.sqrt_one_minus_alpha_bar[step].unsqueeze(1) * noise) / self.sqrt_alpha_bar[step].unsqueeze(
            1
        )
