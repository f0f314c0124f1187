"""The samplers of the SDE and of the ODE, against closed forms, in their order of convergence, and against diffusers."""

import math

import numpy as np
import pytest
import torch as th
from scipy.integrate import solve_ivp

from sb3_causalgdp.diffusion import (
    NOISE_SCHEDULES,
    SAMPLERS,
    SPACINGS,
    GuidanceRule,
    MLPDenoiser,
    NoiseSchedule,
    TransformerDenoiser,
    sample,
)
from sb3_causalgdp.diffusion.plans import sampling_plan, sampling_points
from sb3_causalgdp.diffusion.samplers import moved
from sb3_causalgdp.losses import denoising_loss
from tests.diffusion.test_guidance import DIM, LinearGaussian

ODE_SAMPLERS = ("ddim", "heun", "dpm_solver")
STOCHASTIC = ("ddpm", "euler_maruyama")
GRID = np.linspace(-6.0, 6.0, 801)


def gaussian_denoiser(schedule, mean, covariance):
    """The exact denoiser of N(mean, covariance), at any time."""
    identity = th.eye(len(mean), dtype=th.float64)

    def predict_noise(action, step, condition):
        alpha_bar = schedule.alpha_bar_at(step)
        centred = action - math.sqrt(alpha_bar) * mean
        return math.sqrt(1.0 - alpha_bar) * th.linalg.solve(alpha_bar * covariance + (1.0 - alpha_bar) * identity, centred.T).T

    return predict_noise


class Mixture:
    """Two Gaussians on a line."""

    weights = np.array([0.3, 0.7])
    means = np.array([-0.8, 0.5])
    variances = np.array([0.04, 0.09])

    @property
    def mean(self):
        return float(self.weights @ self.means)

    @property
    def variance(self):
        return float(self.weights @ (self.variances + self.means**2)) - self.mean**2

    def density_and_score(self, x, alpha_bar):
        centres = math.sqrt(alpha_bar) * self.means
        variances = alpha_bar * self.variances + 1.0 - alpha_bar
        parts = self.weights * np.exp(-0.5 * (x[..., None] - centres) ** 2 / variances) / np.sqrt(2.0 * np.pi * variances)
        density = parts.sum(axis=-1)
        return density, (parts * (centres - x[..., None]) / variances).sum(axis=-1) / density

    def noise(self, x, alpha_bar):
        return -math.sqrt(1.0 - alpha_bar) * self.density_and_score(x, alpha_bar)[1]

    def denoiser(self, schedule):
        def predict_noise(action, step, condition=None):
            return th.as_tensor(self.noise(action.numpy(), schedule.alpha_bar_at(step)))

        return predict_noise

    def clean(self, x, alpha_bar):
        return (x - math.sqrt(1.0 - alpha_bar) * self.noise(x, alpha_bar)) / math.sqrt(alpha_bar)

    def exact_end(self, schedule, start):
        """The probability-flow ODE from noise to the last diffusion step, to ten digits, and the clean estimate there."""
        sigma_of = {index: math.sqrt(1.0 / schedule.alpha_bar_list[index] - 1.0) for index in (0, -1)}

        def derivative(sigma, x):
            alpha_bar = 1.0 / (1.0 + sigma**2)
            return self.noise(math.sqrt(alpha_bar) * x, alpha_bar)

        first = start / math.sqrt(schedule.alpha_bar_list[-1])
        solved = solve_ivp(derivative, (sigma_of[-1], sigma_of[0]), first, rtol=1e-10, atol=1e-12, method="DOP853")
        alpha_bar = schedule.alpha_bar_list[0]
        return self.clean(math.sqrt(alpha_bar) * solved.y[:, -1], alpha_bar)


def placed(denoiser, schedule, drawn, sampler, condition=None):
    """Where a sampler begins: an ODE is told what little of the action the schedule leaves at its noise end."""
    first = sampling_plan(schedule, sampler)[0]
    if not first.corrects:
        return drawn
    signal, spread = math.sqrt(first.alpha_bar), math.sqrt(1.0 - first.alpha_bar)
    clean = (drawn - spread * denoiser(drawn, first.step, condition)) / signal
    return signal * clean + spread * drawn


def order_of(errors):
    """Slope of the errors at a number of steps that doubles from one to the next."""
    return float(np.mean(np.log2(np.array(errors[:-1]) / np.array(errors[1:]))))


# Closed forms -----------------------------------------------------------------------------------------------------------


def mean_and_covariance(denoiser, schedule, start_mean, n_steps, dim=DIM, **kwargs):
    """Of the samples, exactly: with a linear denoiser a sample is affine in its noise."""
    n_noises = n_steps * dim
    noise = th.cat([th.zeros(1, n_noises, dtype=th.float64), th.eye(n_noises, dtype=th.float64)])
    noise = noise.view(n_noises + 1, n_steps, dim).transpose(0, 1).clone()
    noise[0] += start_mean
    samples = sample(denoiser, schedule, noise[0], noise=noise, n_steps=n_steps, clip=None, **kwargs)
    columns = samples[1:] - samples[0]
    return samples[0], columns.T @ columns


@pytest.mark.parametrize("sampler", SAMPLERS)
@pytest.mark.parametrize("name", sorted(NOISE_SCHEDULES))
def test_exact_denoiser_of_a_gaussian_gives_that_gaussian(sampler, name):
    system, schedule = LinearGaussian(0), NoiseSchedule(name, 200)
    denoiser = gaussian_denoiser(schedule, system.mean, system.covariance)
    finds_start = sampling_plan(schedule, sampler)[0].corrects
    start = 0.0 if finds_start else math.sqrt(schedule.alpha_bar_list[-1]) * system.mean
    mean, covariance = mean_and_covariance(denoiser, schedule, start, 200, sampler=sampler)
    error = system.error(mean + system.posterior_mean - system.mean)
    assert error < (0.01 if finds_start else 1e-3)
    assert (covariance - system.covariance).norm() < 0.1 * system.covariance.norm()


@pytest.mark.parametrize("sampler", ODE_SAMPLERS)
def test_exact_denoiser_of_a_mixture_gives_its_mean_and_variance(sampler):
    mixture, schedule = Mixture(), NoiseSchedule("cosine", 100)
    share = (np.arange(4_000) + 0.5) / 4_000
    start = th.distributions.Normal(0.0, 1.0).icdf(th.as_tensor(share))[None, :, None].expand(100, -1, -1)
    ends = sample(mixture.denoiser(schedule), schedule, start[0], noise=start, clip=None, sampler=sampler)
    assert float(ends.mean()) == pytest.approx(mixture.mean, abs=0.01)
    assert float(ends.var()) == pytest.approx(mixture.variance, rel=0.03)


@pytest.mark.parametrize("sampler", STOCHASTIC)
def test_the_sde_reaches_the_mean_and_variance_of_a_mixture(sampler):
    mixture, schedule = Mixture(), NoiseSchedule("cosine", 100)
    ends = law_of_ends(mixture, schedule, sampler, 100, th.distributions.Normal(0.0, 1.0))
    assert ends(lambda x: x) == pytest.approx(mixture.mean, abs=0.01)
    assert ends(lambda x: x**2) - ends(lambda x: x) ** 2 == pytest.approx(mixture.variance, rel=0.05)


def law_of_ends(mixture, schedule, sampler, n_steps, start=None):
    """Expectations of the samples of a stochastic sampler, without drawing any: its density, passed on from step to step."""
    grid, width = GRID, GRID[1] - GRID[0]
    plan = sampling_plan(schedule, sampler, 0.0, n_steps)
    density = mixture.density_and_score(grid, plan[0].alpha_bar)[0]
    if start is not None:
        density = start.log_prob(th.as_tensor(grid)).exp().numpy()
    for stage in plan[:-1]:
        clean = th.as_tensor(mixture.clean(grid, stage.alpha_bar))
        centres = moved(stage, th.as_tensor(grid), clean, th.zeros(()), None, None).numpy()
        kernel = np.exp(-0.5 * ((grid[:, None] - centres) / stage.std) ** 2) / (stage.std * math.sqrt(2.0 * np.pi))
        density = kernel @ density * width
    ends = mixture.clean(grid, plan[-1].alpha_bar)
    return lambda function: float((function(ends) * density).sum() * width)


# Order of convergence ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize(("sampler", "order"), [("ddim", 1), ("heun", 2), ("dpm_solver", 2)])
def test_order_of_convergence_on_a_mixture(sampler, order, spacing):
    mixture, schedule = Mixture(), NoiseSchedule("vp", 10)
    start = np.linspace(-2.0, 2.0, 41)
    denoiser = mixture.denoiser(schedule)
    exact = mixture.exact_end(schedule, placed(denoiser, schedule, th.as_tensor(start), sampler).numpy())
    errors = []
    for n_steps in (73, 145, 289):  # so that the diffusion steps stay among the times
        noise = th.as_tensor(start)[None, :, None].expand(n_steps, -1, -1)
        ends = sample(
            mixture.denoiser(schedule),
            schedule,
            noise[0],
            noise=noise,
            clip=None,
            sampler=sampler,
            n_steps=n_steps,
            spacing=spacing,
        )
        errors.append(float(np.abs(ends[:, 0].numpy() - exact).mean()))
    assert order_of(errors) == pytest.approx(order, abs=0.25), errors


def test_weak_order_of_euler_maruyama_on_a_mixture():
    mixture, schedule = Mixture(), NoiseSchedule("vp", 10)
    alpha_bar = schedule.alpha_bar_list[0]
    at_end = mixture.density_and_score(GRID, alpha_bar)[0]
    laws = [law_of_ends(mixture, schedule, "euler_maruyama", n_steps) for n_steps in (37, 73, 145)]
    for function in (lambda x: x, lambda x: x**3, lambda x: np.tanh(2.0 * x)):
        exact = float((function(mixture.clean(GRID, alpha_bar)) * at_end).sum() * (GRID[1] - GRID[0]))
        errors = [abs(expectation(function) - exact) for expectation in laws]
        assert order_of(errors) == pytest.approx(1.0, abs=0.3), errors


def test_weak_order_of_euler_maruyama_on_a_gaussian():
    system, schedule = LinearGaussian(0), NoiseSchedule("vp", 10)
    denoiser = gaussian_denoiser(schedule, system.mean, system.covariance)
    first, last = schedule.alpha_bar_list[0], schedule.alpha_bar_list[-1]
    identity = th.eye(DIM, dtype=th.float64)
    noisy = first * system.covariance + (1.0 - first) * identity
    slope = math.sqrt(first) * system.covariance @ th.linalg.inv(noisy)
    exact = slope @ noisy @ slope.T
    errors = []
    for n_steps in (37, 73, 145):
        mean, covariance = mean_and_covariance(
            denoiser, schedule, math.sqrt(last) * system.mean, n_steps, sampler="euler_maruyama"
        )
        th.testing.assert_close(mean, system.mean, rtol=0.0, atol=1e-9)
        errors.append(float((covariance - exact).norm()))
    assert order_of(errors) == pytest.approx(1.0, abs=0.2), errors


# Lemma 1 ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize(
    ("sampler", "name"),
    [(sampler, name) for sampler in SAMPLERS for name in sorted(NOISE_SCHEDULES)],
)
def test_guided_samples_end_at_the_posterior_mean_after_ten_steps(seed, sampler, name):
    system, schedule = LinearGaussian(seed), NoiseSchedule(name, 10)
    denoiser = gaussian_denoiser_in_torch(schedule, system)
    noise = th.zeros(10, 1, DIM, dtype=th.float64)
    rule = GuidanceRule("posterior", "tweedie")
    end = sample(denoiser, schedule, noise[0], system.guidance, rule, noise=noise, clip=None, sampler=sampler)[0]
    assert system.error(end) <= 0.03
    assert system.error(system.mean) > 0.1


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("sampler", SAMPLERS)
def test_guided_samples_have_the_covariance_of_the_posterior(seed, sampler):
    system, schedule = LinearGaussian(seed, 0.5, 1.0), NoiseSchedule("cosine", 100)
    denoiser = gaussian_denoiser_in_torch(schedule, system)
    _, covariance = mean_and_covariance(
        denoiser, schedule, 0.0, 100, guidance=system.guidance, rule=GuidanceRule("posterior", "tweedie"), sampler=sampler
    )
    target = system.posterior_covariance
    assert (covariance - target).norm() < 0.1 * target.norm()
    assert (system.covariance - target).norm() > 0.1 * target.norm()


@pytest.mark.parametrize("n_steps", [4, 25])
@pytest.mark.parametrize("sampler", ["ddpm", "heun", "dpm_solver", "euler_maruyama"])
def test_guidance_is_exact_at_times_between_the_diffusion_steps(sampler, n_steps):
    system, schedule = LinearGaussian(1), NoiseSchedule("cosine", 10)
    denoiser = gaussian_denoiser_in_torch(schedule, system)
    noise = th.zeros(n_steps, 1, DIM, dtype=th.float64)
    rule = GuidanceRule("posterior", "tweedie")
    kwargs = {"noise": noise, "clip": None, "sampler": sampler, "n_steps": n_steps}
    end = sample(denoiser, schedule, noise[0], system.guidance, rule, **kwargs)[0]
    assert system.error(end) <= 0.05


def gaussian_denoiser_in_torch(schedule, system):
    def predict_noise(action, step, condition=None):
        # Of vmap's tensors, too
        alpha_bar = schedule.alpha_bar_at(step)
        noisy = alpha_bar * system.covariance + (1.0 - alpha_bar) * th.eye(DIM, dtype=th.float64)
        return math.sqrt(1.0 - alpha_bar) * (action - math.sqrt(alpha_bar) * system.mean) @ th.linalg.inv(noisy)

    return predict_noise


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_each_step_but_no_corrector_has_a_divergence(sampler):
    schedule, divergences = NoiseSchedule("vp", 5), []
    noise = th.randn(5, 4, 2, generator=th.Generator().manual_seed(0))

    def pull(action):
        return th.ones_like(action), th.eye(2).expand(len(action), 2, 2)

    sample(
        lambda action, step, condition: action,
        schedule,
        noise[0],
        pull,
        GuidanceRule(),
        noise=noise,
        sampler=sampler,
        clip=None,
        divergences=divergences,
    )
    assert len(divergences) == 5 and all(float(one.min()) > 0.0 for one in divergences)


# diffusers --------------------------------------------------------------------------------------------------------------


def wavy(action, step, condition):
    return th.sin(2.0 * action + 0.3 * step) + 0.5 * condition


def scheduler_of(name, schedule, **kwargs):
    diffusers = pytest.importorskip("diffusers")
    scheduler = getattr(diffusers, name)(
        schedule.n_steps, trained_betas=schedule.beta_list, timestep_spacing="linspace", prediction_type="epsilon", **kwargs
    )
    scheduler.set_timesteps(schedule.n_steps)
    return scheduler


@pytest.mark.parametrize("name", ["vp", "linear"])
def test_dpm_solver_is_that_of_diffusers(name):
    schedule = NoiseSchedule(name, 7)
    scheduler = scheduler_of(
        "DPMSolverMultistepScheduler", schedule, final_sigmas_type="zero", solver_order=2, algorithm_type="dpmsolver++"
    )
    steps = list(reversed(range(7)))
    scheduler.timesteps = th.tensor(steps)
    # Its own are rounded to float32
    sigmas = [math.sqrt(1.0 / schedule.alpha_bar_list[step] - 1.0) for step in steps]
    scheduler.sigmas = th.tensor([*sigmas, 0.0], dtype=th.float64)
    th.manual_seed(0)
    condition, noise = th.randn(8, 2, dtype=th.float64), th.randn(7, 8, 2, dtype=th.float64)
    action = placed(wavy, schedule, noise[0], "dpm_solver", condition)
    for step in steps:
        action = scheduler.step(wavy(action, step, condition), step, action).prev_sample
    ours = sample(wavy, schedule, condition, noise=noise, sampler="dpm_solver", clip=None)
    th.testing.assert_close(ours, action, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", ["vp", "linear"])
def test_heun_is_that_of_diffusers(name):
    schedule = NoiseSchedule(name, 6)
    scheduler = scheduler_of("HeunDiscreteScheduler", schedule)
    sigmas = [math.sqrt(1.0 / alpha_bar - 1.0) for alpha_bar in schedule.alpha_bar_list][::-1]
    # Each sigma but the first twice, as its timesteps are: the end of one step and the start of the next
    scheduler.sigmas = th.tensor([sigmas[0], *np.repeat(sigmas[1:], 2), 0.0], dtype=th.float64)
    scheduler.timesteps = th.arange(11)
    th.manual_seed(0)
    condition, noise = th.randn(8, 2, dtype=th.float64), th.randn(6, 8, 2, dtype=th.float64)
    # Its sample is a / signal
    scaled = placed(wavy, schedule, noise[0], "heun", condition) / math.sqrt(schedule.alpha_bar_list[-1])
    steps = [5, *np.repeat([4, 3, 2, 1, 0], 2).tolist()]
    for index, step in enumerate(steps):
        action = scaled * math.sqrt(schedule.alpha_bar_list[step])
        scaled = scheduler.step(wavy(action, step, condition), index, scaled).prev_sample
    ours = sample(wavy, schedule, condition, noise=noise, sampler="heun", clip=None)
    th.testing.assert_close(ours, scaled, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("clip", [None, 1.0])
def test_euler_maruyama_is_diffusers_ddpm_with_the_forward_noise(clip):
    schedule = NoiseSchedule("vp", 7)
    diffusers = pytest.importorskip("diffusers")
    scheduler = diffusers.DDPMScheduler(
        7, trained_betas=schedule.beta_list, clip_sample=clip is not None, variance_type="fixed_large"
    )
    scheduler.set_timesteps(7)
    th.manual_seed(0)
    condition, noise = th.randn(8, 2), th.randn(7, 8, 2)
    noise[1:] = 0.7
    action = noise[0]
    for position, step in enumerate(reversed(range(7))):
        predicted = wavy(action, step, condition)
        # Its noise is drawn within: the mean is what it gives less the noise
        generator = th.Generator().manual_seed(step)
        theirs = scheduler.step(predicted, step, action, generator=generator).prev_sample
        if step > 0:
            drawn = th.randn(8, 2, generator=th.Generator().manual_seed(step))
            theirs = theirs + math.sqrt(schedule.beta_list[step]) * (noise[position + 1] - drawn)
        action = theirs
    ours = sample(wavy, schedule, condition, noise=noise, sampler="euler_maruyama", clip=clip)
    th.testing.assert_close(ours, action, rtol=1e-4, atol=1e-4)


def test_the_mean_of_euler_maruyama_is_that_of_the_reverse_sde_of_diffusers():
    diffusers = pytest.importorskip("diffusers")
    schedule = NoiseSchedule("vp", 7)
    sigmas = [math.sqrt(1.0 / alpha_bar - 1.0) for alpha_bar in schedule.alpha_bar_list]
    scheduler = diffusers.ScoreSdeVeScheduler(7)
    scheduler.set_timesteps(7)
    scheduler.timesteps = th.arange(7.0).flip(0) / 7.0
    scheduler.discrete_sigmas = th.tensor(sigmas)
    th.manual_seed(0)
    for stage in sampling_plan(schedule, "euler_maruyama")[:-1]:
        action, predicted = th.randn(8, 2), th.randn(8, 2)
        sigma = sigmas[stage.point]
        scaled = action / math.sqrt(stage.alpha_bar)
        theirs = scheduler.step_pred(-predicted / sigma, th.tensor((stage.point + 0.5) / 6.0), scaled).prev_sample_mean
        clean = (action - math.sqrt(1.0 - stage.alpha_bar) * predicted) / math.sqrt(stage.alpha_bar)
        ours = moved(stage, action, clean, th.zeros(()), None, None)
        th.testing.assert_close(ours, theirs * math.sqrt(stage.previous), rtol=1e-3, atol=1e-3)


# Other numbers of steps -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(NOISE_SCHEDULES))
def test_the_signal_falls_between_the_diffusion_steps_and_is_the_schedules_at_them(name):
    schedule = NoiseSchedule(name, 10)
    steps = np.linspace(0.0, 9.0, 91)
    values = np.array([schedule.alpha_bar_at(step) for step in steps])
    assert (np.diff(values) < 0.0).all()
    np.testing.assert_allclose(values[::10], schedule.alpha_bar_list, rtol=1e-12)
    tensors = schedule.signal_left(th.as_tensor(steps, dtype=th.float32))[:, 0]
    np.testing.assert_allclose(tensors.numpy(), values, rtol=1e-4)
    assert float(schedule.signal_left(3.5)) == pytest.approx(schedule.alpha_bar_at(3.5), rel=1e-6)


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("n_steps", [1, 2, 5, 10, 23])
def test_all_times_lie_where_the_denoiser_was_trained(spacing, n_steps):
    schedule = NoiseSchedule("vp", 10)
    points = sampling_points(schedule, n_steps, spacing)
    steps = [point.step for point in points]
    assert len(points) == n_steps and steps == sorted(set(steps)) and steps[-1] == pytest.approx(9.0)
    assert n_steps == 1 or steps[0] == 0.0
    if n_steps > 2:
        log_snr = [math.log(point.alpha_bar / (1.0 - point.alpha_bar)) for point in points]
        evenly = log_snr if spacing == "log_snr" else steps
        np.testing.assert_allclose(np.diff(evenly), np.mean(np.diff(evenly)), rtol=1e-6)


@pytest.mark.parametrize("sampler", SAMPLERS)
def test_as_many_steps_as_the_schedule_has_are_its_own(sampler):
    schedule = NoiseSchedule("vp", 6)
    steps = [stage.step for stage in sampling_plan(schedule, sampler) if not stage.corrects]
    assert steps == [5, 4, 3, 2, 1, 0] and all(isinstance(step, int) for step in steps)
    noise = th.randn(6, 8, 2, generator=th.Generator().manual_seed(0))
    chains = [sample(wavy, schedule, th.zeros(8, 2), noise=noise, sampler=sampler, n_steps=n) for n in (None, 6)]
    assert th.equal(*chains)


@pytest.mark.parametrize("make", [MLPDenoiser, TransformerDenoiser])
def test_a_denoiser_is_continuous_in_the_step(make):
    th.manual_seed(0)
    denoiser = make(2, 3, 5, [16])
    action, condition = th.randn(4, 2), th.randn(4, 3)
    ends, near = [denoiser(action, step, condition) for step in (1, 2)], denoiser(action, 1.0 + 1e-4, condition)
    th.testing.assert_close(denoiser(action, 1.0, condition), ends[0])
    th.testing.assert_close(near, ends[0], rtol=0.0, atol=1e-3)
    assert not th.allclose(denoiser(action, 1.5, condition), ends[0], atol=1e-4)
    mixed = denoiser(action, th.tensor([1.0, 2.0, 1.5, 1.0]), condition)
    th.testing.assert_close(mixed[:2], th.stack([ends[0][0], ends[1][1]]))
    th.testing.assert_close(mixed[2], denoiser(action, 1.5, condition)[2])


def test_continuous_training_draws_all_times_and_their_noise():
    seen = []

    def denoiser(noisy, step, condition):
        seen.append((noisy, step))
        return noisy

    schedule, actions = NoiseSchedule("vp", 5), th.full((20_000, 1), 0.5)
    th.manual_seed(0)
    denoising_loss(denoiser, schedule, actions, actions, continuous=True)
    noisy, step = seen[0]
    assert step.min() < 0.01 and step.max() > 3.99 and float((step % 1.0).std()) > 0.25
    for low in (0.4, 2.4):
        rows = (step > low) & (step < low + 0.2)
        alpha_bar = schedule.alpha_bar_at(low + 0.1)
        assert float(noisy[rows].mean()) == pytest.approx(0.5 * math.sqrt(alpha_bar), abs=0.1)
        assert float(noisy[rows].std()) == pytest.approx(math.sqrt(1.0 - alpha_bar), rel=0.1)


def test_a_denoiser_trained_at_few_steps_is_sampled_with_fewer_and_more():
    th.manual_seed(0)
    schedule, denoiser = NoiseSchedule("vp", 10), MLPDenoiser(1, 1, 10, [64, 64])
    optimizer = th.optim.Adam(denoiser.parameters(), lr=3e-3)
    for _ in range(600):
        actions = (0.3 + 0.2 * th.randn(256, 1)).clamp(-1.0, 1.0)
        loss = denoising_loss(denoiser, schedule, th.zeros(256, 1), actions).loss
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    with th.no_grad():
        for n_steps in (5, 10, 30):
            for sampler in ("heun", "dpm_solver", "euler_maruyama"):
                ends = sample(denoiser, schedule, th.zeros(4_000, 1), sampler=sampler, n_steps=n_steps)
                assert float(ends.mean()) == pytest.approx(0.3, abs=0.06), (sampler, n_steps)
                assert 0.1 < float(ends.std()) < 0.3, (sampler, n_steps)


@pytest.mark.parametrize("n_steps", [0, -1, 2.5, True])
def test_a_number_of_steps_that_is_none_is_refused(n_steps):
    with pytest.raises(ValueError, match="sampling_steps must be an integer of at least 1 or None"):
        sample(wavy, NoiseSchedule("vp", 3), th.zeros(2, 2), action_dim=2, n_steps=n_steps)


def test_an_unknown_spacing_is_refused():
    with pytest.raises(ValueError, match=r"'karras'.*time.*log_snr"):
        sample(wavy, NoiseSchedule("vp", 3), th.zeros(2, 2), action_dim=2, spacing="karras")
