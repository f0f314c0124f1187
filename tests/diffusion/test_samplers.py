import math

import pytest
import torch as th

from sb3_causalgdp.diffusion import MLPDenoiser, NoiseSchedule, sample
from sb3_causalgdp.diffusion.plans import SAMPLERS, sampling_plan
from sb3_causalgdp.diffusion.samplers import denoising_step, transition_std

STEPPING = {"timestep_spacing": "leading", "steps_offset": 0, "prediction_type": "epsilon"}


def scheduler_of_diffusers(name, schedule, clip):
    diffusers = pytest.importorskip("diffusers")
    kwargs = {"trained_betas": schedule.beta_list, "clip_sample": clip is not None, **STEPPING}
    if name == "DDPMScheduler":
        kwargs["variance_type"] = "fixed_small"
    else:
        kwargs["set_alpha_to_one"] = True
    scheduler = getattr(diffusers, name)(schedule.n_steps, **kwargs)
    scheduler.set_timesteps(schedule.n_steps)
    assert scheduler.timesteps.tolist() == list(reversed(range(schedule.n_steps)))
    return scheduler


def clean_estimate(schedule, step, action, predicted, clip):
    alpha_bar = schedule.alpha_bar_list[step]
    clean = (action - math.sqrt(1.0 - alpha_bar) * predicted) / math.sqrt(alpha_bar)
    return clean if clip is None else clean.clamp(-clip, clip)


def wavy(action, step, condition):
    """A denoiser that depends on everything, large enough for clipping to bite."""
    return th.sin(2.0 * action + 0.3 * step) + 0.5 * condition


def gaussian_denoiser(schedule, mean, covariance):
    """The exact denoiser of the prior N(mean, covariance)."""
    identity = th.eye(len(mean), dtype=th.float64)

    def predict_noise(action, step, condition):
        alpha_bar = schedule.alpha_bar_list[step]
        noisy_covariance = alpha_bar * covariance + (1.0 - alpha_bar) * identity
        centred = action - math.sqrt(alpha_bar) * mean
        return math.sqrt(1.0 - alpha_bar) * th.linalg.solve(noisy_covariance, centred.T).T

    return predict_noise


def mean_and_covariance(denoiser, schedule, mean, **kwargs):
    """
    Of the samples, exactly: with a linear denoiser a sample is ``b + A z`` in its noise z, read off one unit vector at a time.

    The chain starts where the forward process ends on average, about what is left of the prior's mean, if it does not find its
    start by itself.
    """
    dim = len(mean)
    n_noises = schedule.n_steps * dim
    noise = th.cat([th.zeros(1, n_noises, dtype=th.float64), th.eye(n_noises, dtype=th.float64)])
    noise = noise.view(n_noises + 1, schedule.n_steps, dim).transpose(0, 1).clone()
    if not sampling_plan(schedule, **kwargs)[0].corrects:
        noise[0] += math.sqrt(schedule.alpha_bar_list[-1]) * mean
    condition = th.zeros(n_noises + 1, 1, dtype=th.float64)
    samples = sample(denoiser, schedule, condition, noise=noise, clip=None, **kwargs)
    columns = samples[1:] - samples[0]
    return samples[0], columns.T @ columns


@pytest.fixture
def prior():
    generator = th.Generator().manual_seed(0)
    root = th.randn(3, 3, generator=generator, dtype=th.float64)
    covariance = root @ root.T / 3 + 0.1 * th.eye(3, dtype=th.float64)
    return th.randn(3, generator=generator, dtype=th.float64), covariance


@pytest.mark.parametrize("name", ["vp", "cosine"])
@pytest.mark.parametrize("clip", [None, 1.0])
def test_each_ddpm_step_is_that_of_diffusers(name, clip):
    schedule = NoiseSchedule(name, 7)
    scheduler = scheduler_of_diffusers("DDPMScheduler", schedule, clip)
    th.manual_seed(0)
    for step in range(7):
        action, predicted = th.randn(8, 3), th.randn(8, 3)
        theirs = scheduler.step(predicted, step, action, generator=th.Generator().manual_seed(step)).prev_sample
        noise = th.randn(8, 3, generator=th.Generator().manual_seed(step))
        clean = clean_estimate(schedule, step, action, predicted, clip)
        ours = denoising_step(schedule, step, action, clean, noise)
        th.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)
        # Mean and standard deviation apart
        std = scheduler._get_variance(step).sqrt() if step > 0 else th.tensor(0.0)
        mean = denoising_step(schedule, step, action, clean, th.zeros(8, 3))
        th.testing.assert_close(mean, theirs - std * noise, rtol=1e-4, atol=1e-4)
        if step > 0:
            assert transition_std(schedule, step) == pytest.approx(float(std), rel=1e-4)


@pytest.mark.parametrize("name", ["vp", "linear"])
@pytest.mark.parametrize("clip", [None, 1.0])
@pytest.mark.parametrize("eta", [0.0, 0.5, 1.0])
def test_each_ddim_step_is_that_of_diffusers(name, clip, eta):
    schedule = NoiseSchedule(name, 7)
    scheduler = scheduler_of_diffusers("DDIMScheduler", schedule, clip)
    th.manual_seed(0)
    for step in range(7):
        action, predicted, noise = th.randn(8, 3), th.randn(8, 3), th.randn(8, 3)
        theirs = scheduler.step(
            predicted, step, action, eta=eta, use_clipped_model_output=clip is not None, variance_noise=noise
        ).prev_sample
        clean = clean_estimate(schedule, step, action, predicted, clip)
        ours = denoising_step(schedule, step, action, clean, noise, eta)
        th.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("clip", [None, 1.0])
@pytest.mark.parametrize("sampler, eta", [("ddpm", 0.0), ("ddim", 0.0), ("ddim", 0.5), ("ddim", 1.0)])
def test_whole_chain_is_that_of_diffusers(sampler, eta, clip):
    schedule = NoiseSchedule("vp", 6)
    scheduler = scheduler_of_diffusers("DDIMScheduler", schedule, clip)
    th.manual_seed(0)
    condition, noise = th.randn(16, 2), th.randn(6, 16, 2)
    action = noise[0]
    start = sampling_plan(schedule, sampler, eta)[0]
    assert start.corrects == (sampler == "ddim" and eta == 0.0)
    if start.corrects:
        # What they start from is a^K, which holds 8 % of the action
        clean = clean_estimate(schedule, 5, action, wavy(action, 5, condition), clip)
        action = schedule.add_noise(clean, action, th.full((16,), 5))
    for position, step in enumerate(scheduler.timesteps.tolist()):
        # The chain's last step draws no noise
        fresh = noise[position + 1] if step > 0 else th.zeros(16, 2)
        kwargs = {"use_clipped_model_output": clip is not None, "variance_noise": fresh}
        theirs_eta = 1.0 if sampler == "ddpm" else eta
        action = scheduler.step(wavy(action, step, condition), step, action, eta=theirs_eta, **kwargs).prev_sample
    ours = sample(wavy, schedule, condition, noise=noise, sampler=sampler, eta=eta, clip=clip)
    th.testing.assert_close(ours, action, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("name", ["vp", "cosine", "linear"])
@pytest.mark.parametrize("sampler, eta", [("ddpm", 0.0), ("ddim", 0.0), ("ddim", 0.5)])
def test_exact_denoiser_of_a_gaussian_gives_that_gaussian(name, sampler, eta, prior):
    mean, covariance = prior
    schedule = NoiseSchedule(name, 200)
    ours = mean_and_covariance(gaussian_denoiser(schedule, mean, covariance), schedule, mean, sampler=sampler, eta=eta)
    finds_start = sampling_plan(schedule, sampler, eta)[0].corrects
    th.testing.assert_close(ours[0], mean, rtol=0.0, atol=3e-3 if finds_start else 1e-9)
    assert (ours[1] - covariance).norm() < 0.1 * covariance.norm()


@pytest.mark.parametrize("sampler", ["ddpm", "ddim"])
def test_mean_of_a_gaussian_is_right_at_few_steps_and_more_steps_mend_the_covariance(sampler, prior):
    mean, covariance = prior
    errors = []
    for n_steps in (5, 20, 80):
        schedule = NoiseSchedule("vp", n_steps)
        ours = mean_and_covariance(gaussian_denoiser(schedule, mean, covariance), schedule, mean, sampler=sampler)
        th.testing.assert_close(ours[0], mean, rtol=0.0, atol=3e-3 if sampler == "ddim" else 1e-9)
        errors.append(float((ours[1] - covariance).norm() / covariance.norm()))
    assert errors[0] > errors[1] > errors[2]


def test_ddim_with_full_noise_is_ddpm():
    schedule = NoiseSchedule("vp", 5)
    noise, condition = th.randn(5, 8, 2, generator=th.Generator().manual_seed(0)), th.zeros(8, 2)
    ddpm = sample(wavy, schedule, condition, noise=noise, sampler="ddpm")
    th.testing.assert_close(sample(wavy, schedule, condition, noise=noise, sampler="ddim", eta=1.0), ddpm)
    assert not th.allclose(sample(wavy, schedule, condition, noise=noise, sampler="ddim", eta=0.0), ddpm)


@pytest.mark.parametrize("sampler, reads_fresh_noise", [("ddpm", True), ("ddim", False)])
def test_which_noises_a_sampler_reads(sampler, reads_fresh_noise):
    schedule, condition = NoiseSchedule("vp", 4), th.zeros(8, 2)
    noise = th.randn(4, 8, 2, generator=th.Generator().manual_seed(0))
    reference = sample(wavy, schedule, condition, noise=noise, sampler=sampler)
    for position in range(4):
        changed = noise.clone()
        changed[position] += 1.0
        moved = not th.equal(sample(wavy, schedule, condition, noise=changed, sampler=sampler), reference)
        assert moved == (position == 0 or reads_fresh_noise)


def test_gradient_flows_through_every_step():
    predictions = []

    def denoiser(action, step, condition):
        predicted = wavy(action, step, condition)
        predicted.retain_grad()
        predictions.append(predicted)
        return predicted

    schedule, condition = NoiseSchedule("vp", 5), th.zeros(8, 2, requires_grad=True)
    noise = th.randn(5, 8, 2, generator=th.Generator().manual_seed(0))
    sample(denoiser, schedule, condition, noise=noise, clip=None).sum().backward()
    assert len(predictions) == 5
    for predicted in predictions:
        assert bool((predicted.grad != 0.0).all())
    # The gradient through the chain is the derivative of the chain
    with th.no_grad():
        plus, minus = (
            sample(wavy, schedule, th.full((8, 2), shift, dtype=th.float64), noise=noise.double(), clip=None)
            for shift in (1e-4, -1e-4)
        )
    th.testing.assert_close(condition.grad.double(), (plus - minus) / 2e-4, rtol=1e-3, atol=1e-3)


def test_parameters_learn_through_the_clipped_chain():
    th.manual_seed(0)
    denoiser = MLPDenoiser(2, 3, 5, [16])
    sample(denoiser, NoiseSchedule("vp", 5), th.randn(64, 3)).sum().backward()
    for name, parameter in denoiser.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().sum() > 0.0, name


@pytest.mark.parametrize("sampler", ["ddpm", "ddim"])
def test_given_noise_makes_samples_reproducible(sampler):
    th.manual_seed(0)
    denoiser, schedule, condition = MLPDenoiser(2, 3, 5, [16]), NoiseSchedule("vp", 5), th.randn(8, 3)
    for noise in (th.zeros(5, 8, 2), th.randn(5, 8, 2)):
        first = sample(denoiser, schedule, condition, noise=noise, sampler=sampler)
        assert th.equal(sample(denoiser, schedule, condition, noise=noise, sampler=sampler), first)
    assert not th.equal(sample(denoiser, schedule, condition, noise=th.zeros(5, 8, 2), sampler=sampler), first)


def test_drawn_noise_follows_the_seed():
    th.manual_seed(0)
    denoiser, schedule, condition = MLPDenoiser(2, 3, 5, [16]), NoiseSchedule("vp", 5), th.randn(8, 3)
    th.manual_seed(1)
    first, second = sample(denoiser, schedule, condition), sample(denoiser, schedule, condition)
    assert not th.equal(first, second)
    assert first.shape == (8, 2)
    th.manual_seed(1)
    assert th.equal(sample(denoiser, schedule, condition), first)


def test_action_dim_stands_in_for_noise_and_denoiser():
    actions = sample(lambda action, step, condition: action, NoiseSchedule("vp", 3), th.zeros(4, 7), action_dim=2)
    assert actions.shape == (4, 2)


def test_clip_bounds_the_actions_and_none_does_not():
    schedule, noise = NoiseSchedule("vp", 5), 3.0 * th.randn(5, 64, 2, generator=th.Generator().manual_seed(0))
    clipped = sample(wavy, schedule, th.ones(64, 2), noise=noise, clip=0.3)
    assert clipped.abs().max() == pytest.approx(0.3)
    assert sample(wavy, schedule, th.ones(64, 2), noise=noise, clip=None).abs().max() > 1.0


@pytest.mark.parametrize("sampler", ["ddpm", "ddim"])
def test_one_step_returns_the_clean_estimate(sampler):
    schedule, noise = NoiseSchedule("linear", 1), th.randn(1, 8, 2, generator=th.Generator().manual_seed(0))
    condition = th.zeros(8, 2)
    expected = clean_estimate(schedule, 0, noise[0], wavy(noise[0], 0, condition), 1.0)
    th.testing.assert_close(sample(wavy, schedule, condition, noise=noise, sampler=sampler), expected)


def test_an_unknown_sampler_is_refused():
    with pytest.raises(ValueError, match=r"'euler'.*ddpm.*ddim.*heun"):
        sample(wavy, NoiseSchedule("vp", 3), th.zeros(2, 2), action_dim=2, sampler="euler")


@pytest.mark.parametrize("eta", [-0.1, 1.1, float("nan")])
def test_a_noise_of_ddim_out_of_range_is_refused(eta):
    with pytest.raises(ValueError, match=r"ddim_eta must be in \[0, 1\]"):
        sample(wavy, NoiseSchedule("vp", 3), th.zeros(2, 2), action_dim=2, sampler="ddim", eta=eta)


@pytest.mark.parametrize("sampler", list(SAMPLERS))
def test_a_schedule_of_one_step_has_no_more(sampler):
    with pytest.raises(ValueError, match="sampling_steps must be 1 or None for a schedule of one diffusion step, got 4"):
        sampling_plan(NoiseSchedule("vp", 1), sampler, n_steps=4)


@pytest.mark.parametrize(
    "answer",
    [lambda a: a, lambda a: (a, a[0, :, None] * a[0]), lambda a: (a, a), lambda a: (a[:1], a[:1, :, None] * a[:1, None])],
)
def test_a_guidance_of_other_shapes_is_refused(answer):
    denoiser = lambda noisy, step, condition: noisy  # noqa: E731
    with pytest.raises(ValueError, match=r"a gradient and a curvature of the shapes \(2, 2\) and \(2, 2, 2\), got"):
        sample(denoiser, NoiseSchedule("vp", 4), th.zeros(2, 1), answer, action_dim=2)


def test_a_denoiser_of_another_width_and_one_of_unknown_width_are_refused():
    schedule, condition = NoiseSchedule("vp", 4), th.zeros(2, 1)
    with pytest.raises(ValueError, match=r"denoiser must predict noise of the shape \(2, 2\), got \(2, 1\)"):
        sample(lambda noisy, step, condition: noisy[:, :1], schedule, condition, action_dim=2)
    with pytest.raises(ValueError, match="action_dim must be given, or noise"):
        sample(lambda noisy, step, condition: noisy, schedule, condition)
