import math

import numpy as np
import pytest
import torch as th

from sb3_causalgdp.diffusion import NOISE_SCHEDULES, NoiseSchedule
from sb3_causalgdp.diffusion.schedules import register_noise_schedule

NAMES = sorted(NOISE_SCHEDULES)


def alpha_bar_of_diffusers(beta_schedule, n_steps, **kwargs):
    diffusers = pytest.importorskip("diffusers")
    return diffusers.DDPMScheduler(n_steps, beta_schedule=beta_schedule, **kwargs).alphas_cumprod


def test_linear_is_ddpm_at_a_thousand_steps():
    expected = alpha_bar_of_diffusers("linear", 1000, beta_start=1e-4, beta_end=2e-2)
    th.testing.assert_close(NoiseSchedule("linear", 1000).alpha_bar, expected, rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("n_steps", [5, 20, 100])
def test_linear_reads_ddpm_at_even_times(n_steps):
    reference = alpha_bar_of_diffusers("linear", 1000, beta_start=1e-4, beta_end=2e-2)
    expected = reference[1000 // n_steps - 1 :: 1000 // n_steps]
    th.testing.assert_close(NoiseSchedule("linear", n_steps).alpha_bar, expected, rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("n_steps", [1, 5, 50, 1000])
def test_cosine_is_the_one_of_improved_ddpm(n_steps):
    expected = alpha_bar_of_diffusers("squaredcos_cap_v2", n_steps)
    th.testing.assert_close(NoiseSchedule("cosine", n_steps).alpha_bar, expected, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("n_steps", [1, 5, 7, 100])
def test_vp_is_the_integral_of_the_variance_preserving_sde(n_steps):
    beta_min, beta_max = 0.1, 10.0
    schedule = NoiseSchedule("vp", n_steps)
    for index, alpha_bar in enumerate(schedule.alpha_bar_list):
        time = (index + 1) / n_steps
        expected = math.exp(-(beta_min * time + (beta_max - beta_min) * time**2 / 2))
        assert alpha_bar == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("n_steps", [1, 2, 5, 13, 100])
def test_signal_falls_from_most_to_almost_nothing(name, n_steps):
    schedule = NoiseSchedule(name, n_steps)
    alpha_bar = th.tensor(schedule.alpha_bar_list, dtype=th.float64)
    assert alpha_bar.shape == (n_steps,)
    assert bool((alpha_bar > 0.0).all()) and bool((alpha_bar < 1.0).all())
    assert bool((alpha_bar.diff() < 0.0).all())
    # Sampling starts from pure noise
    assert alpha_bar[-1] < 0.01
    if n_steps >= 5:
        assert alpha_bar[0] > 0.6


@pytest.mark.parametrize("name", NAMES)
def test_coefficients_agree_with_each_other(name):
    schedule = NoiseSchedule(name, 9)
    th.testing.assert_close(th.tensor(schedule.beta_list), schedule.betas)
    th.testing.assert_close(th.tensor(schedule.alpha_bar_list), schedule.alpha_bar)
    th.testing.assert_close(th.tensor(schedule.alpha_bar_previous_list), schedule.alpha_bar_previous)
    assert schedule.alpha_bar_previous_list == [1.0, *schedule.alpha_bar_list[:-1]]
    th.testing.assert_close(schedule.alpha_bar_previous * (1.0 - schedule.betas), schedule.alpha_bar)
    th.testing.assert_close(schedule.sqrt_alpha_bar.square(), schedule.alpha_bar)
    th.testing.assert_close(schedule.sqrt_one_minus_alpha_bar.square(), 1.0 - schedule.alpha_bar)


@pytest.mark.parametrize("name", NAMES)
def test_forward_process_mixes_action_and_noise(name):
    schedule = NoiseSchedule(name, 5)
    th.manual_seed(0)
    action, noise, step = th.randn(5, 3), th.randn(5, 3), th.arange(5)
    noisy = schedule.add_noise(action, noise, step)
    for index, alpha_bar in enumerate(schedule.alpha_bar_list):
        expected = math.sqrt(alpha_bar) * action[index] + math.sqrt(1.0 - alpha_bar) * noise[index]
        th.testing.assert_close(noisy[index], expected)


@pytest.mark.parametrize("name", NAMES)
def test_clean_estimate_inverts_add_noise(name):
    schedule = NoiseSchedule(name, 5)
    th.manual_seed(0)
    action, noise, step = th.rand(64, 3) * 2 - 1, th.randn(64, 3), th.randint(5, (64,))
    noisy = schedule.add_noise(action, noise, step)
    th.testing.assert_close(schedule.clean_estimate(noisy, noise, step), action, rtol=0.0, atol=2e-4)


@pytest.mark.parametrize("name", NAMES)
def test_coefficients_move_with_the_module_but_are_not_saved(name):
    schedule = NoiseSchedule(name, 5)
    assert schedule.state_dict() == {}
    assert {key for key, _ in schedule.named_buffers()} >= {"betas", "alpha_bar"}
    assert not list(schedule.parameters())


def test_an_unknown_name_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"'sigmoid'.*cosine.*linear.*vp"):
        NoiseSchedule("sigmoid", 5)


@pytest.mark.parametrize("n_steps", [0, -3, 2.5, True, "5"])
def test_a_number_of_steps_that_is_no_positive_integer_is_refused(n_steps):
    with pytest.raises(ValueError, match="integer of at least 1"):
        NoiseSchedule("vp", n_steps)


@pytest.mark.parametrize(
    "betas", [lambda n: th.linspace(0.5, 1.5, n), lambda n: th.full((n,), math.nan), lambda n: th.full((3,), 0.1)]
)
def test_betas_of_ones_own_are_checked(betas, monkeypatch):
    monkeypatch.setitem(NOISE_SCHEDULES, "own", betas)
    with pytest.raises(ValueError, match="noise_schedule 'own' must give 5 betas between 0 and 1, got"):
        NoiseSchedule("own", 5)


def test_betas_of_ones_own_may_be_an_array(monkeypatch):
    monkeypatch.setitem(NOISE_SCHEDULES, "own", lambda n: np.full(n, 0.5, np.float32))
    assert NoiseSchedule("own", 2).alpha_bar_list == [0.5, 0.25]
    with pytest.raises(TypeError, match="noise schedule must be a class or a function, got 3"):
        register_noise_schedule("another", 3)
