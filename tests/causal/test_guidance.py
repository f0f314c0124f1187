import pytest
import torch as th
from torch.autograd.functional import jacobian

from sb3_causalgdp.causal import CausalGuidance, LinearisedGuidance, MaskedWorldModel, ReturnTarget, RewardTarget
from sb3_causalgdp.causal.masked_blocks import ActionResponse

N, D, BATCH = 4, 3, 6
DISCOUNT, RETURN_STD = 0.9, th.tensor(2.5)
VALUE_MATRIX = th.linspace(-1.0, 1.0, N * N).view(N, N) + th.eye(N)
REWARD = th.tensor(1.5)


def value(state):
    return -0.5 * ((state @ VALUE_MATRIX.T).square().sum(dim=-1)) + state[..., 0]


def value_gradient(state):
    return jacobian(lambda one: value(one).sum(), state)


class LinearWorld(MaskedWorldModel):
    """Next state and reward are linear in the action."""

    def __init__(self):
        super().__init__(N, D, [8])
        generator = th.Generator().manual_seed(0)
        self.by_action = th.randn(N, D, generator=generator)
        self.reward_by_action = th.randn(D, generator=generator)

    def action_response(self, state, action, of_all=True):
        std = th.tensor([0.5, 1.0, 2.0, 0.7])
        return ActionResponse(
            next_state=0.5 * state + action @ self.by_action.T,
            next_state_std=std,
            standardised_jacobian=(self.by_action / std.unsqueeze(1)).expand(len(action), N, D),
            reward=action @ self.reward_by_action,
            reward_std=th.tensor(0.8),
            reward_by_next_state=th.zeros(len(action), N),
            reward_by_action=self.reward_by_action.expand(len(action), D),
        )


@pytest.fixture
def world():
    th.manual_seed(0)
    model = MaskedWorldModel(N, D, [16, 16])
    state = th.randn(256, N) * th.tensor([0.1, 1.0, 3.0, 0.5]) + th.tensor([0.0, 5.0, -3.0, 0.2])
    model.update_statistics(state, state + 0.5 * state.std(dim=0) * th.randn(256, N), 4.0 * th.randn(256))
    with th.no_grad():
        model.transition_log_std.uniform_(-1.5, 0.5)
        model.reward_log_std.fill_(-0.7)
    model.set_masks(*(0.3 + 0.7 * th.rand(shape) for shape in ((N, N), (N, D), (N,), (D,))))
    return model


@pytest.fixture
def states(world):
    th.manual_seed(1)
    return world.state_mean + world.state_std * th.randn(BATCH, N)


@pytest.fixture
def wished(world):
    th.manual_seed(2)
    return world.state_mean + world.state_std * th.randn(BATCH, N)


@pytest.fixture
def actions():
    return th.rand(BATCH, D, generator=th.Generator().manual_seed(3)) * 2 - 1


def make_target(name):
    return RewardTarget(REWARD) if name == "reward" else ReturnTarget(value_gradient, DISCOUNT, RETURN_STD)


def outcome_of(world, name, state, action):
    next_state, _ = world.predict_next_state(state[None], action[None])
    reward = world.predict_reward(next_state, action[None])[0][0]
    return reward if name == "reward" else reward + DISCOUNT * value(next_state)[0]


def outcome_std(world, name):
    return world.action_response(th.zeros(1, N), th.zeros(1, D)).reward_std if name == "reward" else RETURN_STD


@pytest.mark.parametrize("name", ["reward", "return"])
@pytest.mark.parametrize("gamma, beta", [(1.0, 1.0), (0.3, 2.0), (0.0, 1.0), (1.0, 0.0)])
def test_gradient_is_that_of_the_log_densities(name, gamma, beta, world, states, wished, actions):
    gradient, _ = CausalGuidance(world, states, wished, make_target(name), gamma, beta)(actions)
    assert not gradient.requires_grad
    for row in range(BATCH):
        state = states[row]
        # What is wished for stays where it is while the action moves
        target = REWARD if name == "reward" else (outcome_of(world, name, state, actions[row]) + RETURN_STD).detach()

        def log_density(action, row=row, state=state, target=target):
            outcome = outcome_of(world, name, state, action)
            of_outcome = th.distributions.Normal(outcome, outcome_std(world, name)).log_prob(target)
            mean, std = world.predict_next_state(state[None], action[None])
            of_state = th.distributions.Normal(mean[0], std).log_prob(wished[row]).sum()
            return gamma * of_state + beta * of_outcome

        th.testing.assert_close(gradient[row], jacobian(log_density, actions[row]), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("name", ["reward", "return"])
@pytest.mark.parametrize("gamma, beta", [(1.0, 1.0), (0.3, 2.0)])
def test_curvature_is_that_of_gauss_and_newton(name, gamma, beta, world, states, wished, actions):
    _, curvature = CausalGuidance(world, states, wished, make_target(name), gamma, beta)(actions)
    _, std = world.predict_next_state(states, actions)
    precision = th.diag(th.cat([gamma / std.detach() ** 2, (beta / outcome_std(world, name) ** 2).view(1)]))
    for row in range(BATCH):

        def predicted(action, row=row):
            next_state, _ = world.predict_next_state(states[row][None], action[None])
            return th.cat([next_state[0], outcome_of(world, name, states[row], action).view(1)])

        matrix = jacobian(predicted, actions[row])
        th.testing.assert_close(curvature[row], matrix.T @ precision @ matrix, rtol=1e-3, atol=1e-4)
    th.testing.assert_close(curvature, curvature.mT)
    assert bool((th.linalg.eigvalsh(curvature) > -1e-5 * curvature.abs().max()).all())


@pytest.mark.parametrize("name", ["reward", "return"])
@pytest.mark.parametrize("component", range(D))
def test_an_action_that_causes_nothing_is_not_steered(name, component, world, states, wished, actions):
    action_to_state, action_to_reward = world.action_to_state.clone(), world.action_to_reward.clone()
    action_to_state[:, component] = 0.0
    action_to_reward[component] = 0.0
    world.set_masks(world.state_to_state, action_to_state, world.state_to_reward, action_to_reward)
    gradient, curvature = CausalGuidance(world, states, wished, make_target(name))(actions)
    others = [index for index in range(D) if index != component]
    assert bool((gradient[:, component] == 0.0).all())
    assert bool((curvature[:, component] == 0.0).all()) and bool((curvature[:, :, component] == 0.0).all())
    assert bool((gradient[:, others] != 0.0).all())


def test_the_value_counts_only_in_the_return(world, states, wished, actions):
    with_value, _ = CausalGuidance(world, states, wished, make_target("return"), 0.0)(actions)
    without, _ = CausalGuidance(world, states, wished, ReturnTarget(th.zeros_like, DISCOUNT, RETURN_STD), 0.0)(actions)
    response = world.action_response(states, actions)
    th.testing.assert_close(without, response.reward_jacobian / RETURN_STD)
    assert not th.allclose(with_value, without)


@pytest.mark.parametrize("name", ["reward", "return"])
def test_scales_multiply_their_own_density(name, world, states, wished, actions):
    def at(gamma, beta):
        return CausalGuidance(world, states, wished, make_target(name), gamma, beta)(actions)

    for combined, state_part, outcome_part in zip(at(3.0, 0.5), at(1.0, 0.0), at(0.0, 1.0), strict=True):
        assert bool((state_part != 0.0).any()) and bool((outcome_part != 0.0).any())
        th.testing.assert_close(combined, 3.0 * state_part + 0.5 * outcome_part, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", ["state_scale", "outcome_scale"])
@pytest.mark.parametrize("scale", [-1.0, float("nan"), float("inf")])
def test_a_scale_that_is_negative_or_not_finite_is_refused(name, scale, world, states, wished):
    with pytest.raises(ValueError, match=f"{name} must be a finite number of at least 0"):
        CausalGuidance(world, states, wished, make_target("reward"), **{name: scale})


def test_states_of_another_size_and_an_outcome_that_is_none_are_named(world, states, wished):
    with pytest.raises(ValueError, match=r"state must have the shape \(batch, 4\), got \(6, 3\)"):
        CausalGuidance(world, states[:, :3], wished, RewardTarget(REWARD))
    with pytest.raises(ValueError, match=r"next_state must have the shape \(batch, 4\), got \(4,\)"):
        CausalGuidance(world, states, wished[0], RewardTarget(REWARD))
    with pytest.raises(TypeError, match=r"outcome must be an OutcomeTarget, .* got 1.0"):
        CausalGuidance(world, states, wished, 1.0)


@pytest.mark.parametrize("name", ["reward", "return"])
def test_linearised_equals_the_guidance_where_it_was_taken(name, world, states, wished, actions):
    guidance = CausalGuidance(world, states, wished, make_target(name))
    linearised = LinearisedGuidance(guidance, actions)
    for ours, theirs in zip(linearised(actions), guidance(actions), strict=True):
        th.testing.assert_close(ours, theirs, rtol=0.0, atol=0.0)


def test_linearised_equals_the_guidance_of_a_linear_model_everywhere(states, wished, actions):
    guidance = CausalGuidance(LinearWorld(), states, wished, RewardTarget(REWARD), 0.7, 1.3)
    linearised = LinearisedGuidance(guidance, actions)
    elsewhere = th.randn(BATCH, D, generator=th.Generator().manual_seed(5))
    for ours, theirs in zip(linearised(elsewhere), guidance(elsewhere), strict=True):
        th.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)
    assert not th.allclose(linearised(elsewhere)[0], linearised(actions)[0])


def test_linearised_return_keeps_its_target(states, wished, actions):
    linearised = LinearisedGuidance(CausalGuidance(LinearWorld(), states, wished, make_target("return"), 0.0), actions)
    # One Newton step along the gradient reaches the target, where nothing is left to pull
    gradient, curvature = linearised(actions)
    reached = actions + (th.linalg.pinv(curvature) @ gradient.unsqueeze(2)).squeeze(2)
    th.testing.assert_close(linearised(reached)[0], th.zeros(BATCH, D), rtol=0.0, atol=1e-3)


def test_linearised_evaluates_the_model_once(world, states, wished, actions, monkeypatch):
    calls = []
    original = world.action_response
    monkeypatch.setattr(world, "action_response", lambda *args, **kwargs: calls.append(1) or original(*args, **kwargs))
    linearised = LinearisedGuidance(CausalGuidance(world, states, wished, make_target("reward")), actions)
    for _ in range(3):
        linearised(actions)
    assert len(calls) == 1
