import math

import pytest
import torch as th

from sb3_causalgdp.causal import MaskedWorldModel
from sb3_causalgdp.diffusion import GuidanceRule, NoiseSchedule, sample
from sb3_causalgdp.diffusion.bounds import bounded, outside
from sb3_causalgdp.losses import (
    advantage_weights,
    critic_loss,
    denoising_loss,
    expectile_loss,
    improved_actions,
    improvement_weights,
    q_loss,
    quantile,
    td_target,
    trust_region_loss,
    world_model_loss,
)

SCHEDULE = NoiseSchedule("vp", 5)


def column(*values):
    return th.tensor(values).unsqueeze(1)


# Critics ----------------------------------------------------------------------------------------------------------------


def test_target_takes_the_smallest_of_the_critics():
    # Each critic is the smallest once, so neither the first, nor the largest, nor the mean is right
    next_q_values = [column(1.0, 5.0, 7.0), column(3.0, 2.0, 9.0), column(8.0, 4.0, 6.0)]
    target = td_target(next_q_values, column(10.0, 20.0, 30.0), th.zeros(3, 1), 0.5)
    th.testing.assert_close(target, column(10.5, 21.0, 33.0))


def test_target_is_between_the_mean_of_the_critics_and_the_smallest():
    next_q_values = [column(1.0, 5.0), column(3.0, 2.0), column(8.0, 2.0)]
    for pessimism, expected in ((0.0, (14.0, 23.0)), (0.5, (12.5, 22.5)), (1.0, (11.0, 22.0))):
        target = td_target(next_q_values, column(10.0, 20.0), th.zeros(2, 1), 1.0, pessimism=pessimism)
        th.testing.assert_close(target, column(*expected))


def test_a_terminated_episode_does_not_bootstrap():
    target = td_target([column(5.0, 5.0)], column(1.0, 2.0), column(1.0, 0.0), 0.9)
    th.testing.assert_close(target, column(1.0, 6.5))


def test_each_transition_may_have_its_own_discount():
    target = td_target([column(10.0, 10.0)], column(1.0, 1.0), th.zeros(2, 1), column(0.9, 0.81))
    th.testing.assert_close(target, column(10.0, 9.1))


def test_each_critic_takes_its_best_action_before_the_smallest_critic_counts():
    # Two states with three actions each, next to each other
    first = column(1.0, 4.0, 2.0, 0.0, 0.0, 9.0)
    second = column(6.0, 0.0, 3.0, 5.0, 1.0, 1.0)
    target = td_target([first, second], th.zeros(2, 1), th.zeros(2, 1), 1.0, n_backup_actions=3)
    # min over critics of max over actions; the max over actions of the min over critics would be 2 and 1
    th.testing.assert_close(target, column(4.0, 5.0))


def test_critic_loss_sums_the_mean_squared_errors():
    q_values = [column(1.0, 2.0), column(0.0, 5.0)]
    loss = critic_loss(q_values, column(2.0, 2.0))
    assert loss.item() == pytest.approx((1.0 + 0.0) / 2 + (4.0 + 9.0) / 2)
    assert critic_loss(q_values[:1], column(2.0, 2.0)).item() == pytest.approx(0.5)


# Actor ------------------------------------------------------------------------------------------------------------------


class PerfectDenoiser:
    """Knows the clean action, which is its condition, and so the noise; keeps what it was asked."""

    def __call__(self, noisy_action, step, condition):
        alpha_bar = SCHEDULE.alpha_bar[step].unsqueeze(1)
        self.noisy, self.step = noisy_action, step
        self.noise = (noisy_action - alpha_bar.sqrt() * condition) / (1.0 - alpha_bar).sqrt()
        return self.noise


def pull(action):
    """Constant gradient, no curvature."""
    return th.tensor([2.0, -3.0]).expand_as(action), th.zeros(len(action), 2, 2)


def test_a_perfect_denoiser_has_no_loss():
    th.manual_seed(0)
    actions = th.rand(64, 2) * 2 - 1
    assert denoising_loss(PerfectDenoiser(), SCHEDULE, actions, actions)[0].item() < 1e-8
    assert denoising_loss(PerfectDenoiser(), SCHEDULE, actions, actions, None, GuidanceRule())[0].item() < 1e-8
    assert denoising_loss(PerfectDenoiser(), SCHEDULE, actions, actions + 0.1)[0].item() > 1e-3


def test_the_noise_is_standard_normal_and_every_step_is_drawn():
    th.manual_seed(0)
    actions, denoiser = th.rand(20_000, 2) * 2 - 1, PerfectDenoiser()
    denoising_loss(denoiser, SCHEDULE, actions, actions)
    assert abs(denoiser.noise.mean().item()) < 0.03
    assert denoiser.noise.std().item() == pytest.approx(1.0, abs=0.03)
    assert th.bincount(denoiser.step, minlength=5).min() > 3_700 and len(th.bincount(denoiser.step)) == 5


@pytest.mark.parametrize("scale", [0.5, [1.0, 2.0, 3.0, 4.0, 5.0]])
def test_guidance_shifts_the_target(scale):
    th.manual_seed(0)
    actions, denoiser = th.rand(64, 2) * 2 - 1, PerfectDenoiser()
    loss = denoising_loss(denoiser, SCHEDULE, actions, actions, pull, GuidanceRule("score", scale=scale))[0]
    scales = th.tensor(scale)[denoiser.step] if isinstance(scale, list) else th.full((64,), scale)
    shift = (scales * (1.0 - SCHEDULE.alpha_bar[denoiser.step]).sqrt()).unsqueeze(1) * th.tensor([2.0, -3.0])
    assert loss.item() == pytest.approx(shift.square().mean().item(), rel=1e-4)


def test_guidance_shifts_the_target_towards_higher_density():
    th.manual_seed(0)
    actions = th.rand(64, 2) * 2 - 1

    def shifted_denoiser(noisy, step, condition):
        # eps - lambda sqrt(1 - alpha_bar) G is what has to be predicted
        return PerfectDenoiser()(noisy, step, condition) - (1.0 - SCHEDULE.alpha_bar[step]).sqrt().unsqueeze(1) * th.tensor(
            [2.0, -3.0]
        )

    assert denoising_loss(shifted_denoiser, SCHEDULE, actions, actions, pull, GuidanceRule("score"))[0].item() < 1e-8


def test_no_gradient_flows_through_the_guidance():
    weight, pulled_to = th.tensor(0.7, requires_grad=True), th.tensor(2.0, requires_grad=True)
    seen = {}

    def denoiser(noisy, step, condition):
        seen.update(noisy=noisy, step=step)
        return weight * noisy

    def guidance(action):
        seen["clean"] = action.detach()
        return pulled_to - action, th.eye(2).expand(len(action), 2, 2)

    th.manual_seed(0)
    actions = th.rand(64, 2) * 2 - 1
    denoising_loss(denoiser, SCHEDULE, actions, actions, guidance, GuidanceRule("score"))[0].backward()
    alpha_bar = SCHEDULE.alpha_bar[seen["step"]].unsqueeze(1)
    noise = (seen["noisy"] - alpha_bar.sqrt() * actions) / (1.0 - alpha_bar).sqrt()
    target = noise - (1.0 - alpha_bar).sqrt() * (2.0 - seen["clean"])
    expected = 2.0 * ((0.7 * seen["noisy"] - target) * seen["noisy"]).mean()
    th.testing.assert_close(weight.grad, expected, rtol=1e-4, atol=1e-5)
    assert pulled_to.grad is None


def test_q_term_climbs_one_critic_on_the_scale_of_another():
    assert q_loss(column(1.0, -3.0), column(10.0, 30.0)).item() == pytest.approx(1.0 / 20.0)
    assert q_loss(column(10.0, 30.0), column(-4.0, 0.0)).item() == pytest.approx(-20.0 / 2.0)


def test_q_term_does_not_climb_by_its_scale():
    values, scale = column(1.0, 3.0).requires_grad_(), column(10.0, 30.0).requires_grad_()
    q_loss(values, scale).backward()
    th.testing.assert_close(values.grad, column(-0.5 / 20.0, -0.5 / 20.0))
    assert scale.grad is None


def test_critics_at_zero_give_a_finite_q_term():
    assert math.isfinite(q_loss(column(1.0, 1.0), column(0.0, 0.0)).item())


def test_the_scale_of_advantages_does_not_see_what_all_actions_have_in_common():
    values, others, of_data = column(3.0, 5.0), column(2.0, 6.0), column(1.0, 8.0)
    loss = q_loss(values, others, of_data)
    assert loss.item() == pytest.approx(-4.0 / 1.5)
    gradients = []
    for level in (0.0, 1e4):
        actor_values = column(3.0, 5.0).requires_grad_()
        q_loss(actor_values + level, others + level, of_data + level).backward()
        gradients.append(actor_values.grad)
    th.testing.assert_close(*gradients)


def test_actions_that_make_no_difference_give_a_finite_gradient():
    values = column(100.0, 100.0).requires_grad_()
    q_loss(values, column(100.0, 100.0), column(100.0, 100.0)).backward()
    assert values.grad.abs().max() < 1e4


# Bounds -----------------------------------------------------------------------------------------------------------------


def test_the_gradient_of_the_q_term_leads_back_inside_and_not_further_out():
    # Far out on either side, for a Q that wants them inside, and for one that wants them further out
    for wanted, moves in ((0.0, True), (9.0, False)):
        said = th.tensor([[3.0, -3.0]]).requires_grad_()
        sign = th.tensor([[1.0, -1.0]])
        (bounded(said) - wanted * sign).square().sum().backward()
        assert (said.grad != 0.0).all().item() is moves
        if moves:
            assert ((said - 0.1 * said.grad).abs() < 3.0).all()


def test_inside_the_bounds_the_gradient_is_that_of_the_action():
    action = th.tensor([0.5, -1.0, 1.0]).requires_grad_()
    (bounded(action) * th.tensor([2.0, -3.0, 4.0])).sum().backward()
    assert action.grad.tolist() == [2.0, -3.0, 4.0]
    assert bounded(th.tensor([2.0, -0.5]), 1.5).tolist() == [1.5, -0.5]
    assert bounded(th.tensor([2.0]), None).tolist() == [2.0]


@pytest.mark.parametrize("part", ["one step", "chain"])
def test_a_policy_that_is_stuck_outside_is_brought_back_by_its_critic(part):
    """With a plain clamp its parameters would not move."""
    bias = th.full((2,), -20.0).requires_grad_()
    optimizer = th.optim.Adam([bias], lr=0.5)

    def denoiser(noisy, step, condition):
        return noisy + bias

    for _ in range(200):
        if part == "one step":
            actions = denoising_loss(denoiser, SCHEDULE, th.zeros(32, 1), th.rand(32, 2) * 2 - 1).clean_actions
        else:
            actions = sample(denoiser, SCHEDULE, th.zeros(32, 1), action_dim=2)
        optimizer.zero_grad()
        (actions + 0.5).square().mean().backward()
        optimizer.step()
    assert (actions.mean(dim=0) + 0.5).abs().max() < 0.3


def test_what_lies_outside_is_penalised_by_its_squared_distance():
    assert outside(th.tensor([[0.5, 1.0], [-3.0, 2.0]])).item() == pytest.approx((4.0 + 1.0) / 4)
    terms = denoising_loss(lambda noisy, step, condition: 100.0 + 0.0 * noisy, SCHEDULE, th.zeros(64, 1), th.zeros(64, 2))
    assert terms.clean_actions.abs().max() <= 1.0 and terms.outside > 1e3


# World model ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def transitions():
    th.manual_seed(0)
    model = MaskedWorldModel(3, 2, [8])
    return model, th.randn(10, 3), th.rand(10, 2), th.randn(10, 3), th.randn(10)


def test_world_model_loss_is_the_mean_likelihood(transitions):
    model, *data = transitions
    likelihood = model.negative_log_likelihood(*data)
    for loss, terms in zip(world_model_loss(model, *data), likelihood, strict=True):
        th.testing.assert_close(loss, terms.mean())


def test_masks_are_drawn_anew_for_each_loss_where_they_are_probabilities(transitions):
    model, *data = transitions
    model.set_masks(*(th.full_like(mask, 0.5) for mask in (th.ones(3, 3), th.ones(3, 2), th.ones(3), th.ones(2))))
    plain, drawn = ({sum(world_model_loss(model, *data, sample_masks=one)).item() for _ in range(5)} for one in (False, True))
    assert len(plain) == 1 and len(drawn) == 5


def test_weights_of_zero_leave_transitions_out(transitions):
    model, state, action, next_state, reward = transitions
    weight = th.tensor([1.0, 0.0] * 5)
    known = weight > 0.0
    expected = world_model_loss(model, state[known], action[known], next_state[known], reward[known])
    next_state[~known] = 1e4
    losses = world_model_loss(model, state, action, next_state, reward, weight)
    for ours, theirs in zip(losses, expected, strict=True):
        th.testing.assert_close(ours, theirs)


def test_weights_of_zero_alone_give_no_loss(transitions):
    model, *data = transitions
    assert [loss.item() for loss in world_model_loss(model, *data, weight=th.zeros(10))] == [0.0, 0.0]


@pytest.mark.parametrize("n_values", [1, 2, 3, 32, 256])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.99, 1.0])
def test_a_quantile_is_that_of_pytorch(n_values, share):
    values = th.randn(n_values, generator=th.Generator().manual_seed(n_values))
    th.testing.assert_close(quantile(values, share), th.quantile(values, share))


# Those of other methods -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("expectile, value", [(0.5, 2.0), (0.9, 3.6), (0.1, 0.4)])
def test_the_expectile_of_two_values_is_found(expectile, value):
    # Of 0 and 4: the share of 4 is the expectile
    targets = th.tensor([[0.0], [4.0]])
    values = th.tensor([[1.0]], requires_grad=True)
    optimizer = th.optim.SGD([values], lr=0.5)
    for _ in range(200):
        optimizer.zero_grad()
        expectile_loss(values, targets, expectile).backward()
        optimizer.step()
    assert values.item() == pytest.approx(value, abs=1e-3)


def test_advantages_weigh_in_units_of_their_own_size():
    advantages = th.tensor([[-1.0], [0.0], [1.0]])
    weights = advantage_weights(advantages, 2.0)
    th.testing.assert_close(weights, advantage_weights(100.0 * advantages, 2.0))
    assert weights.mean().item() == pytest.approx(1.0)
    assert (weights[2] / weights[1]).item() == pytest.approx(math.exp(3.0))
    assert (weights[1] / weights[0]).item() == pytest.approx(math.exp(3.0))
    th.testing.assert_close(advantage_weights(advantages, 0.0), th.ones(3, 1))
    assert (advantage_weights(advantages, 50.0)[2] / advantage_weights(advantages, 50.0)[1]).item() == pytest.approx(100.0)
    th.testing.assert_close(advantage_weights(th.zeros(3, 1), 2.0), th.ones(3, 1))


def test_improved_actions_are_a_step_up_and_within_bounds():
    actions, gradient = th.tensor([[0.0, 0.0], [0.95, 0.0], [0.3, 0.3]]), th.tensor([[3.0, 4.0], [1.0, 0.0], [0.0, 0.0]])
    improved = improved_actions(actions, gradient, 0.1)
    step = 0.1 * math.sqrt(2.0)
    th.testing.assert_close(improved, th.tensor([[0.6 * step, 0.8 * step], [1.0, 0.0], [0.3, 0.3]]))


def test_what_did_not_become_better_is_not_imitated():
    weights = improvement_weights(th.zeros(4, 1), th.tensor([[-1.0], [0.0], [1.0], [3.0]]))
    th.testing.assert_close(weights, th.tensor([[0.0], [0.0], [1.0], [3.0]]))
    assert bool((improvement_weights(th.ones(2, 1), th.zeros(2, 1)) == 0.0).all())


def test_weights_of_a_denoising_loss_choose_what_is_learned():
    schedule, actions = NoiseSchedule("vp", 3), th.tensor([[0.5], [-0.5]])
    parameter = th.zeros(1, requires_grad=True)

    def loss(weights):
        th.manual_seed(0)
        return denoising_loss(
            lambda action, step, features: action * 0.0 + parameter, schedule, actions, actions, weights=weights
        )

    (of_first,) = th.autograd.grad(loss(th.tensor([[2.0], [0.0]])).loss, parameter)
    (of_second,) = th.autograd.grad(loss(th.tensor([[0.0], [2.0]])).loss, parameter)
    (of_both,) = th.autograd.grad(loss(None).loss, parameter)
    assert not th.allclose(of_first, of_second)
    th.testing.assert_close(0.5 * (of_first + of_second), of_both)


def test_the_trust_region_pulls_actions_to_where_the_behaviour_is_and_leaves_its_model_alone():
    # The behaviour is N(0.4, 0.1^2), whose noise is known
    schedule = NoiseSchedule("vp", 5)

    class Behaviour(th.nn.Module):
        def __init__(self):
            super().__init__()
            self.mean = th.nn.Parameter(th.tensor(0.4))

        def forward(self, action, step, features):
            signal, left = schedule.sqrt_alpha_bar[step].unsqueeze(1), schedule.alpha_bar[step].unsqueeze(1)
            return (action - signal * self.mean) * (1.0 - left).sqrt() / (0.01 * left + 1.0 - left)

    behaviour = Behaviour()
    actions = th.tensor([-0.5, 0.4, 0.9]).repeat_interleave(20_000).unsqueeze(1).requires_grad_()
    th.manual_seed(0)
    loss = trust_region_loss(behaviour, schedule, th.zeros(len(actions), 1), actions)
    (gradient,) = th.autograd.grad(loss, actions, retain_graph=True)
    below, at, above = gradient.view(3, -1).mean(dim=1).tolist()
    assert below < 0.0 < above and abs(at) < 0.05 * above
    assert th.autograd.grad(loss, behaviour.mean, allow_unused=True) == (None,)
