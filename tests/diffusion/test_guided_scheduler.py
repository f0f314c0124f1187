"""Schedulers of diffusers, guided: the posterior in closed form, prediction types, chunks and units."""

import copy
import math

import pytest
import torch as th

from sb3_causalgdp.diffusion import ActionUnits, GuidanceRule, GuidedScheduler
from sb3_causalgdp.diffusion.guided_scheduler import SUPPORTED
from tests.diffusion.test_guidance import DIM, LinearGaussian

diffusers = pytest.importorskip("diffusers")

DISCRETE = {"beta_schedule": "squaredcos_cap_v2", "timestep_spacing": "trailing"}
SCHEDULERS = {
    "DDPMScheduler": {**DISCRETE, "clip_sample": False},
    "DDIMScheduler": {**DISCRETE, "clip_sample": False},
    "DPMSolverMultistepScheduler": {**DISCRETE, "final_sigmas_type": "zero"},
    "EulerDiscreteScheduler": DISCRETE,
    "FlowMatchEulerDiscreteScheduler": {},
}
TYPES = ("epsilon", "sample", "v_prediction")
CASES = [(name, kind) for name in SCHEDULERS if not name.startswith("Flow") for kind in TYPES]
CASES.append(("FlowMatchEulerDiscreteScheduler", "flow_prediction"))


def scheduler_of(name, kind="epsilon", n_steps=20):
    kwargs = {} if kind == "flow_prediction" or name.startswith("Flow") else {"prediction_type": kind}
    scheduler = getattr(diffusers, name)(1_000, **SCHEDULERS[name], **kwargs)
    scheduler.set_timesteps(n_steps)
    return scheduler


def exact_model(guided, mean, covariance):
    """What a perfectly trained network says, for a prior N(mean, covariance), of the sample as the scheduler scales it."""

    def model(scaled, timestep):
        level = guided.noise_level(timestep)
        is_scaled = level.signal == 1.0 and not guided.is_flow
        sample = scaled * level.norm if is_scaled else scaled
        identity = th.eye(len(mean), dtype=scaled.dtype)
        marginal = level.signal**2 * covariance + level.spread**2 * identity
        centred = sample - level.signal * mean
        noise = level.spread * centred @ th.linalg.inv(marginal)
        # Not by division by the signal, which flow matching begins without
        clean = mean + level.signal * centred @ th.linalg.inv(marginal) @ covariance
        return guided._prediction(clean, sample, level) if guided.prediction_type != "epsilon" else noise

    return model


def chain(guided, model, start, generator=None):
    """The loop of everybody's policy."""
    sample = start * getattr(guided, "init_noise_sigma", 1.0)
    for timestep in guided.timesteps:
        scaled = guided.scale_model_input(sample, timestep) if hasattr(guided.scheduler, "scale_model_input") else sample
        sample = guided.step(model(scaled, timestep), timestep, sample, generator=generator).prev_sample
    return sample


@pytest.mark.parametrize(
    ("name", "kind", "seed"),
    [(*case, seed) for case in CASES for seed in range(10) if case[1] in ("epsilon", "flow_prediction") or seed == 0],
)
def test_guided_chain_ends_in_the_posterior_after_twenty_steps(name, kind, seed):
    system = LinearGaussian(seed)
    guided = GuidedScheduler(scheduler_of(name, kind), system.guidance, GuidanceRule("posterior", "tweedie"), clip=None)
    model = exact_model(guided, system.mean, system.covariance)
    guided.model = model
    generator = th.Generator().manual_seed(seed)
    start = th.randn(400, DIM, generator=generator, dtype=th.float64)
    # Of opposite starts and, in DDPM, of many draws: the mean without its error
    ends = chain(guided, model, th.cat([start, -start]), generator)
    assert system.error(ends.mean(dim=0)) <= 0.05
    assert system.error(system.mean) > 0.1


@pytest.mark.parametrize("name", SUPPORTED)
def test_every_scheduler_that_is_not_refused_leads_a_normal_policy_to_the_posterior(name):
    scheduler = getattr(diffusers, name)(1_000, **({"clip_sample": False} if name.startswith("DD") else {}))
    scheduler.set_timesteps(20)
    precision = 100.0 * th.eye(2)
    guidance = lambda action: ((0.8 - action) @ precision, precision.expand(len(action), 2, 2))  # noqa: E731
    guided = GuidedScheduler(scheduler, guidance, clip=None)
    model = exact_model(guided, th.zeros(2), th.eye(2))
    th.manual_seed(0)
    sample = th.randn(2_000, 2) * getattr(guided, "init_noise_sigma", 1.0)
    for timestep in guided.timesteps:
        scaled = guided.scale_model_input(sample, timestep) if hasattr(scheduler, "scale_model_input") else sample
        sample = guided.step(model(scaled, timestep), timestep, sample).prev_sample
    th.testing.assert_close(sample.mean(dim=0), th.full((2,), 0.8 * 100.0 / 101.0), atol=0.02, rtol=0.0)


@pytest.mark.parametrize("name", SCHEDULERS)
def test_guided_samples_have_the_covariance_of_the_posterior(name):
    system = LinearGaussian(2, 0.5, 1.0)
    guided = GuidedScheduler(scheduler_of(name, n_steps=50), system.guidance, GuidanceRule("posterior", "tweedie"), clip=None)
    guided.model = exact_model(guided, system.mean, system.covariance)
    generator = th.Generator().manual_seed(0)
    ends = chain(guided, guided.model, th.randn(5_000, DIM, generator=generator, dtype=th.float64), generator)
    target = system.posterior_covariance
    assert (th.cov(ends.T) - target).norm() < 0.2 * target.norm()
    assert (system.covariance - target).norm() > 0.2 * target.norm()


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_guided_prediction_is_that_of_the_posterior(name, kind):
    """Lemma 1, at every timestep: among others the velocity field of the posterior."""
    system = LinearGaussian(3)
    guided = GuidedScheduler(scheduler_of(name, kind), system.guidance, GuidanceRule("posterior", "tweedie"), clip=None)
    guided.model = exact_model(guided, system.mean, system.covariance)
    of_posterior = exact_model(guided, system.posterior_mean, system.posterior_covariance)
    sample = 2.0 * th.randn(8, DIM, generator=th.Generator().manual_seed(0), dtype=th.float64)
    n_checked = 0
    for index, timestep in enumerate(guided.timesteps):
        if getattr(guided.scheduler, "sigmas", None) is not None:
            guided.scheduler._step_index = index
        level = guided.noise_level(timestep)
        if level.alpha_bar < 1e-4:
            continue
        scaled = guided.scale_model_input(sample, timestep) if hasattr(guided.scheduler, "scale_model_input") else sample
        output = guided.model(scaled, timestep)
        clean = guided.clean_estimate(output, sample, level) + guided.shift(output, timestep, sample, level)
        ours = guided._prediction(clean, sample, level)
        th.testing.assert_close(ours, of_posterior(scaled, timestep), rtol=1e-5, atol=1e-6)
        n_checked += 1
    assert n_checked >= 18


def test_the_velocity_is_moved_by_spread_over_signal_times_the_gradient():
    system, guided = LinearGaussian(1), GuidedScheduler(scheduler_of("FlowMatchEulerDiscreteScheduler"), clip=None)
    guided.guidance = system.guidance
    timestep = guided.timesteps[10]
    level = guided.noise_level(timestep)
    sample = th.randn(4, DIM, generator=th.Generator().manual_seed(0), dtype=th.float64)
    shift = guided.shift(th.zeros_like(sample), timestep, sample, level)
    velocity = guided._prediction(sample + shift, sample, level)
    # log p(y | x) for the prior N(0, I): y of N(M a0_hat, Sigma + M C M^T), a0_hat = x signal / (signal^2 + spread^2)
    signal, spread = level
    of_clean = spread**2 / level.norm**2
    x = sample.clone().requires_grad_()
    residual = system.observed - (x - 0.0 * x) @ system.matrix.T  # at the network's clean estimate, which is x where v = 0
    total = th.diag(system.std**2) + of_clean * system.matrix @ system.matrix.T
    gradient = signal / level.norm**2 * th.linalg.solve(total, residual.T).T @ system.matrix
    th.testing.assert_close(velocity, (-spread / signal * gradient).detach(), rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_without_guidance_or_at_scale_zero_steps_are_the_schedulers_own(name, kind):
    th.manual_seed(0)
    output, sample = th.randn(4, 6, 2), th.randn(4, 6, 2)
    ends = []
    for guided in (
        scheduler_of(name, kind),
        GuidedScheduler(scheduler_of(name, kind)),
        GuidedScheduler(scheduler_of(name, kind), pull_to(0.5), GuidanceRule(scale=0.0)),
        GuidedScheduler(scheduler_of(name, kind), pull_to(0.5)),
    ):
        timestep = guided.timesteps[5]
        generator = th.Generator().manual_seed(0)
        ends.append(guided.step(output, timestep, sample, generator=generator).prev_sample)
    assert th.equal(ends[0], ends[1])
    th.testing.assert_close(ends[0], ends[2], rtol=1e-4, atol=1e-4)
    assert not th.allclose(ends[0], ends[3], atol=1e-3)


def pull_to(value, precision=100.0, seen=None):
    """log N(a; value, 1 / precision)."""

    def guidance(action):
        if seen is not None:
            seen.append(action)
        return precision * (value - action), precision * th.eye(action.shape[1]).expand(len(action), -1, -1)

    return guidance


def standard_normal(sample, timestep):
    return sample


@pytest.mark.parametrize("position", [None, 2])
def test_a_chunk_is_guided_as_a_whole_or_at_one_action(position):
    seen = []
    scheduler = scheduler_of("DDIMScheduler", "sample")
    guided = GuidedScheduler(scheduler, pull_to(0.7, 1e4, seen), position=position)
    model = exact_model(guided, th.zeros(3), 0.04 * th.eye(3))
    ends = chain(guided, model, th.randn(64, 4, 3, generator=th.Generator().manual_seed(0)))
    assert ends.shape == (64, 4, 3)
    assert seen[0].shape == ((64, 12) if position is None else (64, 3))
    free = [index for index in range(4) if position is not None and index != position]
    held = [index for index in range(4) if index not in free]
    th.testing.assert_close(ends[:, held], th.full_like(ends[:, held], 0.7), rtol=0.0, atol=0.15)
    assert not free or float(ends[:, free].abs().mean()) < 0.3


def test_actions_of_a_chunk_move_with_the_one_that_is_guided():
    """Through the network's Jacobian: a chunk's actions follow each other."""
    covariance = 0.2 * th.tensor([[1.0, 0.9], [0.9, 1.0]])
    guided = GuidedScheduler(
        scheduler_of("DDIMScheduler"), pull_to(0.5, 1e4), GuidanceRule("posterior", "tweedie"), position=0, clip=None
    )
    flat = exact_model(guided, th.zeros(2), covariance)
    guided.model = lambda sample, timestep: flat(sample.flatten(1), timestep).reshape(sample.shape)
    start = th.randn(500, 2, 1, generator=th.Generator().manual_seed(0))
    mean = chain(guided, guided.model, th.cat([start, -start])).mean(dim=0)[:, 0]
    th.testing.assert_close(mean, th.tensor([0.5, 0.45]), rtol=0.0, atol=0.03)


UNITS = {
    "min and max": (ActionUnits.from_min_max(th.tensor([0.0, -10.0]), th.tensor([4.0, 10.0])), [2.0, 0.0], [2.0, 10.0]),
    "mean and std": (ActionUnits.from_mean_std(th.tensor([1.0, 5.0]), th.tensor([2.0, 3.0])), [1.0, 5.0], [2.0, 3.0]),
    "linear": (ActionUnits.from_linear_normalizer(th.tensor([0.5, 0.1]), th.tensor([-1.0, 0.2])), [2.0, -2.0], [2.0, 10.0]),
}


@pytest.mark.parametrize("name", UNITS)
def test_the_guidance_sees_the_units_of_the_environment(name):
    units, offset, scale = UNITS[name]
    seen = []
    wished = th.tensor(offset) + 0.5 * th.tensor(scale)
    guided = GuidedScheduler(scheduler_of("DDIMScheduler", "sample"), pull_to(wished, 1e3, seen), units=units)
    # A network whose actions are 0 in its own units
    ends = chain(guided, lambda sample, timestep: th.zeros_like(sample), th.zeros(4, 2))
    th.testing.assert_close(seen[0], th.tensor([offset] * 4))
    assert float((ends * th.tensor(scale) + th.tensor(offset) - wished).abs().max()) < 0.1


@pytest.mark.parametrize("name", UNITS)
def test_units_are_read_off_any_unnormaliser(name):
    units = UNITS[name][0]
    read = ActionUnits.from_unnormalizer(lambda action: units.scale * action + units.offset, n_actions=2)
    th.testing.assert_close((read.scale, read.offset), (units.scale, units.offset))
    for wrong in (th.tanh, lambda action: 0.0 * action):
        with pytest.raises(ValueError, match=r"must be scale \* action \+ offset, .* got .* for actions of -1, 0, 0.5 and 1"):
            ActionUnits.from_unnormalizer(wrong, n_actions=2)


@pytest.mark.parametrize("mode", ["posterior", "score", "normalized"])
def test_a_guidance_about_one_action_leaves_the_others_where_they_are(mode):
    """What a guidance of the whole chunk that knows of one action alone gives: the small system is the large one's."""
    generator = th.Generator().manual_seed(0)
    output, sample = th.randn(2, 5, 4, 3, generator=generator)
    root = th.randn(3, 3, generator=generator)

    def about_one(action):
        return (0.3 - action) @ (root @ root.T), (root @ root.T).expand(len(action), 3, 3)

    def about_all(actions):
        gradient, curvature = about_one(actions[:, 6:9])
        whole_gradient, whole_curvature = th.zeros(5, 12), th.zeros(5, 12, 12)
        whole_gradient[:, 6:9], whole_curvature[:, 6:9, 6:9] = gradient, curvature
        return whole_gradient, whole_curvature

    shifts = []
    for guidance, position in ((about_one, 2), (about_all, None)):
        guided = GuidedScheduler(scheduler_of("DDIMScheduler", "sample"), guidance, GuidanceRule(mode), position=position)
        timestep = guided.timesteps[10]
        shifts.append(guided.shift(output, timestep, sample, guided.noise_level(timestep)))
    assert float(shifts[0][:, 2].abs().min()) > 0.0
    th.testing.assert_close(*shifts)


def test_all_else_is_the_schedulers():
    scheduler = scheduler_of("DDPMScheduler")
    guided = GuidedScheduler(scheduler)
    guided.set_timesteps(7)
    assert len(guided.timesteps) == 7 and len(guided) == 1_000 and guided.config is scheduler.config
    action, noise = th.ones(2, 3), th.zeros(2, 3)
    step = th.tensor([10, 500])
    assert th.equal(guided.add_noise(action, noise, step), scheduler.add_noise(action, noise, step))
    assert len(copy.deepcopy(guided).timesteps) == 7
    with pytest.raises(AttributeError, match="no_such_thing"):
        _ = guided.no_such_thing


def test_a_jacobian_needs_the_network_and_scales_are_one_number():
    scheduler = scheduler_of("DDPMScheduler")
    with pytest.raises(ValueError, match=r"'tweedie' needs the network's Jacobian: give model"):
        guided = GuidedScheduler(scheduler, pull_to(0.5), GuidanceRule("posterior", "tweedie"))
        guided.step(th.zeros(1, 2), guided.timesteps[5], th.zeros(1, 2))
    with pytest.raises(ValueError, match="guidance_scale must be one number here, got 2 values"):
        GuidedScheduler(scheduler, rule=GuidanceRule(scale=[1.0, 2.0]))


def test_cost_of_guidance_is_less_than_a_small_network():
    """Without a Jacobian, a step solves one system of the size of the action."""
    calls = []
    guided = GuidedScheduler(scheduler_of("DDIMScheduler", "sample"), pull_to(0.3, seen=calls))
    chain(guided, standard_normal, th.zeros(2, 3))
    assert len(calls) == 20 and math.isfinite(float(calls[-1].sum()))


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"scheduler": "ddim"}, "scheduler must be an object of diffusers"),
        ({"guidance": 0.5}, "guidance must be a function or None, got 0.5"),
        ({"scheduler": diffusers.DDIMScheduler}, "scheduler must be an object of diffusers, like"),
        ({"scheduler": diffusers.EDMEulerScheduler()}, "scheduler must be one of .*DDIMScheduler.*, got EDMEulerScheduler"),
        ({"scheduler": diffusers.DDIMInverseScheduler()}, "known to be guided right, got DDIMInverseScheduler"),
        ({"scheduler": GuidedScheduler(diffusers.DDIMScheduler())}, "guided already: set its guidance"),
        ({"model": "x"}, "model must be a function or None, got 'x'"),
        ({"rule": "posterior"}, "rule must be of the class GuidanceRule or None, got 'posterior'"),
        ({"units": 2.0}, "units must be of the class ActionUnits or None, got 2.0"),
        ({"position": "first"}, "position must be an integer or None, got 'first'"),
    ],
)
def test_arguments_of_another_kind_are_refused_at_construction(kwargs, message):
    with pytest.raises(TypeError, match=message):
        GuidedScheduler(**{"scheduler": diffusers.DDIMScheduler(), **kwargs})


@pytest.mark.parametrize("answer", [lambda a: a, lambda a: (a, a), lambda a: (a[:, :1], a[:, :, None] * a[:, None])])
def test_a_guidance_that_answers_otherwise_is_told_what_is_wanted(answer):
    scheduler = GuidedScheduler(diffusers.DDIMScheduler(), answer)
    scheduler.set_timesteps(4)
    sample = th.randn(5, 2)
    with pytest.raises(ValueError, match=r"a gradient and a curvature of the shapes \(5, 2\) and \(5, 2, 2\)"):
        scheduler.step(th.zeros(5, 2), scheduler.timesteps[0], sample)


@pytest.mark.parametrize("clip", [-1, 0.0, "1"])
def test_a_bound_is_a_positive_number(clip):
    with pytest.raises(ValueError, match="clip must be a positive number or None"):
        GuidedScheduler(diffusers.DDIMScheduler(), clip=clip)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"position": 16}, "position must be an index of a chunk of 16 actions, got 16"),
        (
            {"units": ActionUnits(th.ones(3), th.zeros(3))},
            "units must be those of 2 action components, as samples have, got 3",
        ),
        ({"guidance": lambda a: (a.numpy(), 1.0)}, r"\(5, 32\) and \(5, 32, 32\), got ndarray, float"),
        ({"guidance": lambda a: (a * math.nan, a[:, :, None] * a[:, None])}, "guidance must give finite numbers, got NaN"),
    ],
)
def test_what_does_not_fit_a_chunk_is_named_at_the_first_step(kwargs, message):
    guidance = kwargs.pop("guidance", lambda a: (a, a[:, :, None] * a[:, None]))
    scheduler = GuidedScheduler(diffusers.DDIMScheduler(), guidance, **kwargs)
    scheduler.set_timesteps(4)
    with pytest.raises(ValueError, match=message):
        scheduler.step(th.zeros(5, 16, 2), scheduler.timesteps[0], th.randn(5, 16, 2))


def test_a_network_that_predicts_nan_is_named():
    scheduler = GuidedScheduler(diffusers.DDIMScheduler(), lambda a: (a, a[:, :, None] * a[:, None]))
    scheduler.set_timesteps(4)
    with pytest.raises(ValueError, match="The network must predict finite numbers"):
        scheduler.step(th.full((5, 2), math.nan), scheduler.timesteps[0], th.randn(5, 2))
