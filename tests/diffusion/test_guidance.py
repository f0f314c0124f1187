import math

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_causalgdp.diffusion import GUIDANCE_COVARIANCES, GUIDANCE_MODES, GuidanceRule, MLPDenoiser, NoiseSchedule, sample
from sb3_causalgdp.diffusion.guidance import clean_estimate_jacobian, guidance_shift

SEEDS = range(12)
DIM = 3


class LinearGaussian:
    """
    A prior N(mean, covariance) over actions, and an observation ``y = M a + noise`` of independent components.

    :param seed: Seed
    :param lowest: Smallest standard deviation of the observation's noise
    :param highest: The largest one
    """

    def __init__(self, seed, lowest=0.1, highest=0.5):
        generator = th.Generator().manual_seed(seed)

        def normal(*shape):
            return th.randn(*shape, generator=generator, dtype=th.float64)

        root = normal(DIM, DIM)
        self.covariance = root @ root.T / DIM + 0.1 * th.eye(DIM, dtype=th.float64)
        self.mean = normal(DIM)
        self.matrix = normal(4, DIM)
        self.std = lowest + (highest - lowest) * th.rand(4, generator=generator, dtype=th.float64)
        self.observed = self.matrix @ (self.mean + th.linalg.cholesky(self.covariance) @ normal(DIM))
        precision = th.linalg.inv(self.covariance)
        self.curvature = self.matrix.T @ th.diag(self.std**-2) @ self.matrix
        self.posterior_covariance = th.linalg.inv(precision + self.curvature)
        evidence = self.matrix.T @ (self.observed / self.std**2)
        self.posterior_mean = self.posterior_covariance @ (precision @ self.mean + evidence)

    def guidance(self, action):
        gradient = ((self.observed - action @ self.matrix.T) / self.std**2) @ self.matrix
        return gradient, self.curvature.expand(len(action), DIM, DIM)

    def error(self, action):
        """Distance from the posterior's mean in standard deviations of the prior."""
        return float(th.linalg.solve(th.linalg.cholesky(self.covariance), action - self.posterior_mean).norm())


def exact_denoiser(schedule, mean, covariance):
    def predict_noise(action, step, condition=None):
        alpha_bar = schedule.alpha_bar[step].double()
        noisy_covariance = alpha_bar * covariance + (1.0 - alpha_bar) * th.eye(DIM, dtype=th.float64)
        return (1.0 - alpha_bar).sqrt() * th.linalg.solve(noisy_covariance, (action - alpha_bar.sqrt() * mean).mT).mT

    return predict_noise


def end_of_noise_free_chain(system, n_steps, mode, covariance="unit_gaussian", sampler="ddpm", name="vp"):
    schedule = NoiseSchedule(name, n_steps)
    denoiser = exact_denoiser(schedule, system.mean, system.covariance)
    noise = th.zeros(n_steps, 1, DIM, dtype=th.float64)
    rule = GuidanceRule(mode, covariance)
    return sample(denoiser, schedule, noise[0], system.guidance, rule, noise=noise, clip=None, sampler=sampler)[0]


def sampled_covariance(denoiser, schedule, guidance, rule, sampler):
    """Of the samples, exactly: a sample is affine in its noise, whose unit vectors give the matrix."""
    n_noises = schedule.n_steps * DIM
    noise = th.cat([th.zeros(1, n_noises, dtype=th.float64), th.eye(n_noises, dtype=th.float64)])
    noise = noise.view(n_noises + 1, schedule.n_steps, DIM).transpose(0, 1)
    samples = sample(denoiser, schedule, noise[0], guidance, rule, noise=noise, clip=None, sampler=sampler)
    columns = samples[1:] - samples[0]
    return columns.T @ columns


def bowl(action):
    """Pulls to a point outside the actions' range, unlike a Gaussian of any linear model."""
    curvature = th.diag_embed(1.0 + action.square())
    return 2.0 - action - action**3, curvature


@pytest.fixture
def chain():
    th.manual_seed(0)
    denoiser, schedule = MLPDenoiser(DIM, 2, 5, [16], nn.Tanh), NoiseSchedule("vp", 5)
    return denoiser, schedule, th.randn(16, 2), th.randn(5, 16, DIM)


# Lemma 1: the guided sampler ends in the posterior ----------------------------------------------------------------------


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["vp", "cosine"])
def test_guided_noise_is_the_noise_of_the_posterior(seed, name):
    system, schedule, rule = LinearGaussian(seed), NoiseSchedule(name, 20), GuidanceRule("posterior", "tweedie")
    prior = exact_denoiser(schedule, system.mean, system.covariance)
    posterior = exact_denoiser(schedule, system.posterior_mean, system.posterior_covariance)
    action = 2.0 * th.randn(16, DIM, generator=th.Generator().manual_seed(seed), dtype=th.float64)
    for step in range(schedule.n_steps):
        noise = prior(action, step)
        guided = noise - guidance_shift(system.guidance, rule, prior, schedule, action, noise, step, clip=None)
        th.testing.assert_close(guided, posterior(action, step), rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("n_steps", [5, 20])
@pytest.mark.parametrize("sampler, name", [("ddpm", "vp"), ("ddpm", "cosine"), ("ddim", "cosine")])
def test_noise_free_chain_ends_at_the_posterior_mean(seed, n_steps, sampler, name):
    system = LinearGaussian(seed)
    end = end_of_noise_free_chain(system, n_steps, "posterior", "tweedie", sampler, name)
    assert system.error(end) < 0.03
    # Not because the prior's mean is there already
    assert system.error(system.mean) > 0.1


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("name", ["vp", "cosine"])
def test_samples_have_the_covariance_of_the_posterior(seed, name):
    system, schedule = LinearGaussian(seed, 0.5, 1.0), NoiseSchedule(name, 100)
    denoiser = exact_denoiser(schedule, system.mean, system.covariance)
    covariance = sampled_covariance(denoiser, schedule, system.guidance, GuidanceRule("posterior", "tweedie"), "ddim")
    target = system.posterior_covariance
    assert (covariance - target).norm() < 0.1 * target.norm()
    assert (system.covariance - target).norm() > 0.1 * target.norm()


@pytest.mark.parametrize("n_steps", [5, 20])
def test_the_plain_score_diverges_on_most_systems(n_steps):
    systems = [LinearGaussian(seed) for seed in SEEDS]
    diverged = [not system.error(end_of_noise_free_chain(system, n_steps, "score")) < 10.0 for system in systems]
    assert sum(diverged) > len(systems) / 2


@pytest.mark.parametrize("n_steps", [5, 20])
@pytest.mark.parametrize("covariance", ["isotropic", "unit_gaussian"])
def test_approximate_covariances_stay_close_to_the_posterior_mean(n_steps, covariance):
    systems = [LinearGaussian(seed) for seed in SEEDS]
    errors = sorted(system.error(end_of_noise_free_chain(system, n_steps, "posterior", covariance)) for system in systems)
    assert errors[len(errors) // 2] < 0.3
    assert errors[-1] < 1.5


# The rule ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("approximation", ["isotropic", "unit_gaussian"])
@pytest.mark.parametrize("seed", range(3))
def test_approximate_covariances_are_exact_for_a_standard_normal_prior(approximation, seed):
    system, schedule = LinearGaussian(seed), NoiseSchedule("vp", 10)
    denoiser = exact_denoiser(schedule, th.zeros(DIM, dtype=th.float64), th.eye(DIM, dtype=th.float64))
    action = th.randn(8, DIM, generator=th.Generator().manual_seed(0), dtype=th.float64)
    for step in range(schedule.n_steps):
        shifts = [
            guidance_shift(
                system.guidance,
                GuidanceRule("posterior", covariance),
                denoiser,
                schedule,
                action,
                denoiser(action, step),
                step,
                clip=None,
            )
            for covariance in (approximation, "tweedie")
        ]
        th.testing.assert_close(shifts[0], shifts[1], rtol=1e-7, atol=1e-9)


@pytest.mark.parametrize("covariance", ["tweedie", "isotropic"])
def test_posterior_rule_is_the_gradient_of_the_marginal_likelihood(covariance):
    generator = th.Generator().manual_seed(0)
    matrix, jacobian, residual, std = (
        th.randn(*shape, generator=generator, dtype=th.float64) for shape in ((4, DIM), (DIM, DIM), (4,), (4,))
    )
    # The networks' Jacobians are not symmetric, as the exact denoiser's is
    jacobian = jacobian + 3.0 * th.eye(DIM, dtype=th.float64)
    precision, alpha_bar = th.diag(std**-2), th.tensor([[0.3]], dtype=th.float64)
    of_clean = 0.7 / 0.3**0.5 * jacobian if covariance == "tweedie" else 0.7 * th.eye(DIM, dtype=th.float64)
    # J^T M^T (Sigma + M C M^T)^-1 (y - yhat), not pushed through
    expected = jacobian.T @ matrix.T @ th.linalg.solve(th.diag(std**2) + matrix @ of_clean @ matrix.T, residual)
    gradient, curvature = matrix.T @ precision @ residual, matrix.T @ precision @ matrix
    ours = GuidanceRule("posterior", covariance)(gradient[None], curvature[None], alpha_bar, jacobian[None])
    th.testing.assert_close(ours[0], expected)


def test_jacobian_of_the_clean_estimate_is_that_of_autograd(chain):
    denoiser, schedule, condition, noise = chain
    steps = th.randint(5, (16,), generator=th.Generator().manual_seed(0))
    for step in (0, 3, steps):
        alpha_bar = schedule.alpha_bar[step].reshape(-1, 1)
        jacobian = clean_estimate_jacobian(denoiser.bind(condition), noise[0], step, alpha_bar)

        def clean(action, step=step, alpha_bar=alpha_bar):
            return (action - (1.0 - alpha_bar).sqrt() * denoiser(action, step, condition)) / alpha_bar.sqrt()

        full = th.autograd.functional.jacobian(clean, noise[0])
        for row in range(16):
            th.testing.assert_close(jacobian[row], full[row, :, row], rtol=1e-4, atol=1e-5)


def test_score_is_the_gradient_and_normalized_is_its_direction():
    gradient = th.randn(8, DIM, generator=th.Generator().manual_seed(0)) * 100.0
    curvature, alpha_bar = th.eye(DIM).expand(8, DIM, DIM), th.full((1, 1), 0.5)
    assert th.equal(GuidanceRule("score")(gradient, curvature, alpha_bar), gradient)
    direction = GuidanceRule("normalized")(gradient, curvature, alpha_bar)
    th.testing.assert_close(direction.norm(dim=1), th.ones(8))
    th.testing.assert_close(direction * gradient.norm(dim=1, keepdim=True), gradient)


def test_normalized_takes_no_step_without_a_gradient():
    nothing = GuidanceRule("normalized")(th.zeros(2, DIM), th.zeros(2, DIM, DIM), th.full((1, 1), 0.5))
    assert th.equal(nothing, th.zeros(2, DIM))


def test_only_the_covariances_that_need_the_denoisers_jacobian_ask_for_it():
    needed = {covariance: GuidanceRule("posterior", covariance).needs_jacobian for covariance in GUIDANCE_COVARIANCES}
    assert needed == {"tweedie": True, "isotropic": True, "unit_gaussian": False}
    assert not GuidanceRule("score", "tweedie").needs_jacobian
    with pytest.raises(ValueError, match="needs the Jacobian"):
        GuidanceRule("posterior", "tweedie")(th.ones(1, 2), th.eye(2)[None], th.full((1, 1), 0.5))


@pytest.mark.parametrize("mode", GUIDANCE_MODES)
@pytest.mark.parametrize("covariance", GUIDANCE_COVARIANCES)
def test_shift_of_mixed_steps_equals_that_of_each_step(mode, covariance, chain):
    denoiser, schedule, condition, noise = chain
    rule = GuidanceRule(mode, covariance, [1.0, 2.0, 3.0, 4.0, 5.0])
    predict_noise, action = denoiser.bind(condition), noise[0]
    steps = th.arange(16) % 5
    mixed = guidance_shift(bowl, rule, predict_noise, schedule, action, predict_noise(action, steps), steps)
    assert not mixed.requires_grad
    for step in range(5):
        alone = guidance_shift(bowl, rule, predict_noise, schedule, action, predict_noise(action, step), step)
        rows = steps == step
        th.testing.assert_close(mixed[rows], alone[rows], rtol=1e-4, atol=1e-5)


def test_guidance_is_evaluated_at_the_clipped_clean_estimate(chain):
    denoiser, schedule, condition, noise = chain
    seen = []

    def recording(action):
        seen.append(action)
        return bowl(action)

    predict_noise, action = denoiser.bind(condition), 3.0 * noise[0]
    predicted = predict_noise(action, 2)
    for clip in (None, 1.0):
        guidance_shift(recording, GuidanceRule(), predict_noise, schedule, action, predicted, 2, clip)
    clean = schedule.clean_estimate(action, predicted, th.full((16,), 2))
    th.testing.assert_close(seen[0], clean)
    assert clean.abs().max() > 1.0
    th.testing.assert_close(seen[1], clean.clamp(-1.0, 1.0))


# Scales -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", GUIDANCE_MODES)
def test_without_guidance_or_with_a_scale_of_zero_samples_are_the_plain_ones(mode, chain):
    denoiser, schedule, condition, noise = chain
    plain = sample(denoiser, schedule, condition, noise=noise)
    assert th.equal(sample(denoiser, schedule, condition, None, GuidanceRule(mode), noise=noise), plain)
    assert th.equal(sample(denoiser, schedule, condition, bowl, GuidanceRule(mode, scale=0.0), noise=noise), plain)
    assert not th.allclose(sample(denoiser, schedule, condition, bowl, GuidanceRule(mode), noise=noise), plain)


def test_guidance_pulls_towards_what_is_wished_for(chain):
    denoiser, schedule, condition, noise = chain
    means = [
        sample(denoiser, schedule, condition, bowl, GuidanceRule(scale=scale), noise=noise).mean()
        for scale in (0.0, 0.3, 1.0, 3.0)
    ]
    assert means == sorted(means) and means[0] < means[-1]


def test_each_step_takes_its_own_scale(chain):
    denoiser, schedule, condition, noise = chain
    uniform = sample(denoiser, schedule, condition, bowl, GuidanceRule(scale=2.0), noise=noise)
    assert th.equal(sample(denoiser, schedule, condition, bowl, GuidanceRule(scale=[2.0] * 5), noise=noise), uniform)
    # The first scale is that of k = 1, the last step of the chain
    predict_noise, action = denoiser.bind(condition), noise[0]
    for step in range(5):
        scales = [0.0] * 5
        scales[step] = 3.0
        for other in range(5):
            predicted = predict_noise(action, other)
            shift, reference = (
                guidance_shift(bowl, GuidanceRule(scale=scale), predict_noise, schedule, action, predicted, other)
                for scale in (scales, 1.0)
            )
            th.testing.assert_close(shift, 3.0 * reference if other == step else th.zeros_like(reference))


def test_unknown_names_are_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"'classifier'.*posterior.*score.*normalized"):
        GuidanceRule("classifier")
    with pytest.raises(ValueError, match=r"'full'.*tweedie.*isotropic.*unit_gaussian"):
        GuidanceRule("posterior", "full")


@pytest.mark.parametrize("scale", [-1.0, float("nan"), float("inf"), [], [1.0, -1.0], [1.0, float("nan")], "1.0", True, None])
def test_a_scale_that_is_negative_or_not_finite_is_refused(scale):
    with pytest.raises(ValueError, match="guidance_scale must be a finite number of at least 0"):
        GuidanceRule(scale=scale)


@pytest.mark.parametrize("covariance", GUIDANCE_COVARIANCES)
@pytest.mark.parametrize("size", [1e6, 1e12, 1e30])
def test_a_huge_singular_curvature_gives_finite_actions(covariance, size, chain):
    denoiser, schedule, condition, noise = chain
    direction = th.tensor([1.0, 2.0, -1.0])

    def steep(action):
        gradient = size * (1.0 - action @ direction).unsqueeze(1) * direction
        return gradient, (size * th.outer(direction, direction)).expand(len(action), DIM, DIM)

    actions = sample(denoiser, schedule, condition, steep, GuidanceRule("posterior", covariance), noise=noise)
    assert bool(actions.isfinite().all())
    assert actions.abs().max() <= 1.0


# Divergence -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("clip", [None, 1.0])
def test_divergences_are_those_of_the_guided_steps_from_the_plain_ones(clip, chain):
    denoiser, schedule, condition, noise = chain
    divergences = []
    end = sample(denoiser, schedule, condition, bowl, GuidanceRule(), noise=noise, clip=clip, divergences=divergences)
    assert len(divergences) == 5
    predict_noise, action = denoiser.bind(condition), noise[0]
    for position, step in enumerate(reversed(range(5))):
        alpha_bar = schedule.alpha_bar_list[step]
        previous = schedule.alpha_bar_list[step - 1] if step > 0 else 1.0
        beta = 1.0 - alpha_bar / previous
        predicted = predict_noise(action, step)
        shift = guidance_shift(bowl, GuidanceRule(), predict_noise, schedule, action, predicted, step, clip)
        means = []
        for eps in (predicted, predicted - shift):
            clean = (action - math.sqrt(1.0 - alpha_bar) * eps) / math.sqrt(alpha_bar)
            clean = clean if clip is None else clean.clamp(-clip, clip)
            # The posterior q(a^(k-1) | a^k, a^0) of Ho et al. (2020), equation 7
            from_clean = math.sqrt(previous) * beta / (1.0 - alpha_bar)
            from_noisy = math.sqrt(1.0 - beta) * (1.0 - previous) / (1.0 - alpha_bar)
            means.append(from_clean * clean + from_noisy * action)
        # The last step draws no noise: it takes the variance of the step before it
        this = max(step, 1)
        before, here = schedule.alpha_bar_list[this - 1], schedule.alpha_bar_list[this]
        variance = (1.0 - before) / (1.0 - here) * (1.0 - here / before)
        expected = (means[1] - means[0]).square().sum(dim=1) / (2.0 * variance)
        th.testing.assert_close(divergences[position], expected, rtol=1e-3, atol=1e-5)
        assert expected.max() > 0.0
        action = means[1] + (math.sqrt(variance) * noise[position + 1] if step > 0 else 0.0)
    th.testing.assert_close(end, action, rtol=1e-3, atol=1e-4)


def test_divergences_are_zero_at_scale_zero_and_absent_without_guidance(chain):
    denoiser, schedule, condition, noise = chain
    divergences = []
    sample(denoiser, schedule, condition, noise=noise, divergences=divergences)
    assert divergences == []
    sample(denoiser, schedule, condition, bowl, GuidanceRule(scale=0.0), noise=noise, divergences=divergences)
    assert [float(one.abs().max()) for one in divergences] == [0.0] * 5


@pytest.mark.parametrize("scale", [2, 2.0, np.float32(2), np.int64(2), th.tensor(2.0), [2.0], np.array([2.0])])
def test_a_scale_is_any_kind_of_number(scale):
    assert GuidanceRule(scale=scale).scales == [2.0]


@pytest.mark.parametrize("n_scales", [3, 7])
def test_a_scale_for_each_step_needs_as_many_scales_as_steps(n_scales):
    def guidance(action):
        return th.zeros_like(action), th.zeros(len(action), 2, 2)

    with pytest.raises(ValueError, match=rf"guidance_scale must hold 1 or 5 values, got {n_scales}"):
        sample(
            lambda action, step, condition: action,
            NoiseSchedule("vp", 5),
            th.zeros(4, 1),
            guidance,
            GuidanceRule(scale=[1.0] * n_scales),
            action_dim=2,
        )


@pytest.mark.parametrize("shape", [(3, 4, 2), (7, 4, 2), (5, 3, 2), (5, 2)])
def test_given_noise_must_have_a_row_for_each_step_and_observation(shape):
    with pytest.raises(ValueError, match=r"noise must have the shape \(5, 4, d\)"):
        sample(lambda action, step, condition: action, NoiseSchedule("vp", 5), th.zeros(4, 1), noise=th.zeros(shape))
