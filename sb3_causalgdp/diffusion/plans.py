"""What a sampler does with its evaluations of the denoiser, as numbers: the same for all actions, so found once."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

from sb3_causalgdp.checks import register
from sb3_causalgdp.diffusion.schedules import NoiseSchedule


class Stage(NamedTuple):
    """
    One evaluation of the denoiser and the move that follows: a sum of what is there, and noise.

    ``a' = by_clean a0_hat + by_noisy a + by_previous_clean a0_hat_- + by_previous_noisy a_- + std z``, where ``_-`` is what
    the stage before had. The last stage returns the clean estimate.

    :param point: Position of the time in the sampler's grid, from 0 at the clean end
    :param step: Diffusion step of the denoiser, an index, or a fraction between two
    :param alpha_bar: Share of signal left at that time
    :param previous: The same at the time of the grid that follows, 1 at the end
    :param beta: Share of the variance that is noise of this step, ``1 - alpha_bar / previous``
    :param by_clean: Weight of the clean estimate
    :param by_noisy: Weight of the noisy action
    :param by_previous_clean: Weight of the clean estimate of the stage before
    :param by_previous_noisy: Weight of the noisy action of the stage before
    :param std: Standard deviation of the noise
    :param is_last: Whether this is the last stage
    :param corrects: Whether the stage is no step along the grid: it mends the one before it, as in Heun's method, or the start
    """

    point: int
    step: int | float
    alpha_bar: float
    previous: float
    beta: float
    by_clean: float = 1.0
    by_noisy: float = 0.0
    by_previous_clean: float = 0.0
    by_previous_noisy: float = 0.0
    std: float = 0.0
    is_last: bool = False
    corrects: bool = False


class Point(NamedTuple):
    """
    A time of a sampler's grid.

    :param position: From 0 at the clean end
    :param step: Diffusion step of the denoiser
    :param alpha_bar: Share of signal left
    :param previous: The same at the time of the grid that follows, 1 at the end
    :param beta: ``1 - alpha_bar / previous``
    """

    position: int
    step: int | float
    alpha_bar: float
    previous: float
    beta: float

    @property
    def signal(self) -> float:
        """Factor of the clean action."""
        return math.sqrt(self.alpha_bar)

    @property
    def spread(self) -> float:
        """Standard deviation of the noise in the noisy action."""
        return math.sqrt(1.0 - self.alpha_bar)

    @property
    def half_log_snr(self) -> float:
        """Log of signal over spread, DPM-Solver's time."""
        return math.log(self.signal / self.spread)


def sampling_points(schedule: NoiseSchedule, n_steps: int | None = None, spacing: str = "time") -> list[Point]:
    """
    The times at which a sampler asks the denoiser, all of them between the first and the last of the schedule, between which
    it was trained.

    :param schedule: Noise schedule with K steps
    :param n_steps: Number of times, None for the schedule's own
    :param spacing: ``time`` for evenly spaced diffusion steps, ``log_snr`` for evenly spaced logs of signal over noise
    :return: From the clean end to the noise end
    :raises ValueError: If there are to be several, and the schedule has but one
    """
    if schedule.n_steps == 1 and n_steps not in (None, 1):
        raise ValueError(f"sampling_steps must be 1 or None for a schedule of one diffusion step, got {n_steps}")
    count, last = schedule.n_steps if n_steps is None else n_steps, schedule.n_steps - 1
    if spacing == "log_snr" and count > 1 and last > 0:
        low, high = schedule.log_snr_list[0], schedule.log_snr_list[-1]
        steps: list[int | float] = [
            step_of_log_snr(schedule, low + (high - low) * index / (count - 1)) for index in range(count)
        ]
    elif count == schedule.n_steps:
        steps = list(range(count))
    else:
        steps = [last * index / (count - 1) for index in range(count)] if count > 1 else [last]
    # An index where it is one: the denoiser then looks up what it was trained with
    steps = [int(step) if step == int(step) else step for step in steps]
    points, previous = [], 1.0
    for position, step in enumerate(steps):
        alpha_bar = schedule.alpha_bar_at(step)
        # The schedule's own to the last bit
        beta = schedule.beta_list[position] if count == schedule.n_steps and spacing == "time" else 1.0 - alpha_bar / previous
        points.append(Point(position, step, alpha_bar, previous, beta))
        previous = alpha_bar
    return points


def step_of_log_snr(schedule: NoiseSchedule, log_snr: float) -> float:
    """
    :param schedule: Noise schedule
    :param log_snr: Log of ``alpha_bar / (1 - alpha_bar)``; what is beyond the schedule's is taken to its ends
    :return: The diffusion step that has it, in [0, K-1]
    """
    values = schedule.log_snr_list
    if log_snr >= values[0]:
        return 0.0
    for below, (high, low) in enumerate(pairwise(values)):
        if log_snr >= low:
            return below + (high - log_snr) / (high - low)
    return float(len(values) - 1)


def ancestral_std(points: Sequence[Point], position: int) -> float:
    """
    :param points: The sampler's grid
    :param position: A position in it
    :return: Standard deviation sigma_k of DDPM's step from there; the last step, which draws no noise, takes that of the step
        before it
    """
    if len(points) == 1:
        return math.sqrt(points[0].beta)
    point = points[max(position, 1)]
    return math.sqrt((1.0 - point.previous) / (1.0 - point.alpha_bar) * point.beta)


def ancestral_weights(point: Point, std: float) -> tuple[float, float]:
    """
    :param point: The time of the step
    :param std: Standard deviation of its noise
    :return: Weights of the clean estimate and of the noisy action (Song et al., 2021, DDIM, equation 12)
    """
    by_noisy = math.sqrt(1.0 - point.previous - std**2) / math.sqrt(1.0 - point.alpha_bar)
    return math.sqrt(point.previous) - by_noisy * math.sqrt(point.alpha_bar), by_noisy


def _ancestral(points: Sequence[Point], eta: float) -> list[Stage]:
    stages = []
    for point in reversed(points[1:]):
        std = eta * ancestral_std(points, point.position)
        stages.append(Stage(*point, *ancestral_weights(point, std), std=std))
    return stages


def _euler_maruyama(points: Sequence[Point], eta: float) -> list[Stage]:
    """
    The reverse SDE ``da = -beta (a / 2 + score) dt + sqrt(beta) dw``, backwards in time. For ``x = a / signal`` there is no
    drift but the score's, and with the clock ``sigma^2 = (spread / signal)^2`` it is ``dx = -score dsigma^2 + dw``: the only
    error of a step is that of a score that stands still, and the mean of a Gaussian has none. The noise is that which the
    forward process adds in the step, at most 1, where the scheme's own would grow with sigma over the few large steps that are
    usual here.
    """
    stages = []
    for point, following in zip(points[:0:-1], points[-2::-1], strict=True):
        variance, next_variance = (point.spread / point.signal) ** 2, (following.spread / following.signal) ** 2
        kept = next_variance / variance
        by_clean, by_noisy = following.signal * (1.0 - kept), kept * following.signal / point.signal
        stages.append(Stage(*point, by_clean, by_noisy, std=math.sqrt(point.beta)))
    return stages


def _start(points: Sequence[Point]) -> list[Stage]:
    """
    Where an ODE begins. What was drawn is noise alone, but some of the action may be left at the last diffusion step, and an
    ODE, unlike an SDE, does not forget what is missing. This is DDIM's step from no signal to what the schedule leaves, with
    the clean estimate of the last diffusion step, which is that of no signal but for a share of alpha_bar.
    """
    noisiest = points[-1]
    if noisiest.signal <= LEAST_SIGNAL:
        return []
    return [Stage(*noisiest, by_clean=noisiest.signal, by_noisy=noisiest.spread, corrects=True)]


def _heun(points: Sequence[Point], eta: float) -> list[Stage]:
    """
    The probability-flow ODE. For ``x = a / signal`` and ``sigma = spread / signal`` it is ``dx / dsigma = eps`` (Karras et
    al., 2022, algorithm 1): a step of Euler's, which is DDIM's, and the mean of the noises at both of its ends.
    """
    stages = []
    for point, following in zip(points[:0:-1], points[-2::-1], strict=True):
        stages.append(Stage(*point, *ancestral_weights(point, 0.0)))
        sigma, next_sigma = point.spread / point.signal, following.spread / following.signal
        half, next_half = 0.5 * (next_sigma / sigma - 1.0), 0.5 * (1.0 - sigma / next_sigma)
        stages.append(
            Stage(
                *following,
                by_clean=-following.signal * next_half,
                by_noisy=next_half,
                by_previous_clean=-following.signal * half,
                by_previous_noisy=following.signal / point.signal * (1.0 + half),
                corrects=True,
            )
        )
    return stages


def _dpm_solver(points: Sequence[Point], eta: float) -> list[Stage]:
    """
    DPM-Solver++(2M) (Lu et al., 2022, https://arxiv.org/abs/2211.01095, algorithm 2): the ODE in the half log of the
    signal-to-noise ratio, with the clean estimate continued as a straight line from the last two of them.
    """
    stages: list[Stage] = []
    before: Point | None = None
    for point, following in zip(points[:0:-1], points[-2::-1], strict=True):
        width = following.half_log_snr - point.half_log_snr
        by_clean, by_previous = -following.signal * math.expm1(-width), 0.0
        if before is not None:
            share = 0.5 * width / (point.half_log_snr - before.half_log_snr)
            by_clean, by_previous = (1.0 + share) * by_clean, -share * by_clean
        stages.append(Stage(*point, by_clean, following.spread / point.spread, by_previous))
        before = point
    return stages


SAMPLERS: dict[str, Callable[[Sequence[Point], float], list[Stage]]] = {
    "ddpm": lambda points, eta: _ancestral(points, 1.0),
    "ddim": _ancestral,
    "euler_maruyama": _euler_maruyama,
    "heun": _heun,
    "dpm_solver": _dpm_solver,
}
# Share of the action's size at the noise end up to which it does not matter that a start of pure noise has none of it
LEAST_SIGNAL = 0.01
SPACINGS = ("time", "log_snr")


def register_sampler(name: str, method: Callable[[Sequence[Point], float], list[Stage]]) -> None:
    """
    Let ``sampler=name`` be a sampler of one's own: linear in the noisy action, the clean estimate and the one before it.

    :param name: Its name
    :param method: Takes the points in time, the last first, and ``eta``, and gives a :class:`Stage` for each evaluation of the
        denoiser, all but the one at the point of the clean action
    :raises ValueError: If there is another sampler of that name
    """
    register(SAMPLERS, name, method, "sampler")


def sampling_plan(
    schedule: NoiseSchedule, sampler: str = "ddpm", eta: float = 0.0, n_steps: int | None = None, spacing: str = "time"
) -> list[Stage]:
    """
    :param schedule: Noise schedule with K steps
    :param sampler: One of :data:`SAMPLERS`
    :param eta: Noise of DDIM: 0 is deterministic, 1 is DDPM
    :param n_steps: Number of the sampler's steps, None for K; ``heun`` evaluates the denoiser twice in all of them but the
        last, and those without noise once more for their start where the schedule leaves more than 1 % of the action
    :param spacing: ``time`` or ``log_snr``, see :func:`sampling_points`
    :return: The evaluations of the denoiser, from noise to the action
    """
    key = sampler, eta, n_steps, spacing
    if key not in schedule.plans:
        points = sampling_points(schedule, n_steps, spacing)
        stages = SAMPLERS[sampler](points, eta)
        draws_noise = any(stage.std > 0.0 for stage in stages)
        start = [] if draws_noise else _start(points)
        schedule.plans[key] = [*start, *stages, Stage(*points[0], is_last=True)]
    return schedule.plans[key]
