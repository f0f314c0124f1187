import math

import pytest
import torch as th
from torch.autograd.functional import jacobian

from sb3_causalgdp.causal.masked_blocks import ManyMaskedBlocks, MaskedBlocks
from sb3_causalgdp.causal.world_model import MaskedWorldModel

N, D = 5, 3


def random_masks(seed, n=N, d=D):
    """Soft masks, about half of whose entries are closed."""
    generator = th.Generator().manual_seed(seed)
    masks = []
    for shape in ((n, n), (n, d), (n,), (d,)):
        is_open = th.rand(shape, generator=generator) < 0.5
        masks.append(is_open * (0.2 + 0.8 * th.rand(shape, generator=generator)))
    return masks


def make(seed=0, masks=None, net_arch=(16, 16)):
    th.manual_seed(seed)
    model = MaskedWorldModel(N, D, list(net_arch))
    # Statistics of variables on different scales
    state = th.randn(256, N) * th.tensor([0.1, 1.0, 3.0, 10.0, 0.5]) + th.tensor([0.0, 5.0, -3.0, 1.0, 0.2])
    model.update_statistics(state, state + 0.1 * state.std(dim=0) * th.randn(256, N), 4.0 * th.randn(256) - 7.0)
    with th.no_grad():
        model.transition_log_std.uniform_(-2.0, 1.0)
        model.reward_log_std.fill_(-0.7)
    if masks is not None:
        model.set_masks(*masks)
    return model, state[:6], th.rand(6, D) * 2 - 1


# Masks ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_next_state_depends_on_exactly_what_its_masks_let_through(seed):
    masks = random_masks(seed)
    model, states, actions = make(seed, masks)
    for state, action in zip(states, actions, strict=True):
        by_state, by_action = jacobian(lambda s, a: model.predict_next_state(s[None], a[None])[0][0], (state, action))
        assert bool((by_state[masks[0] == 0.0] == 0.0).all())
        assert bool((by_action[masks[1] == 0.0] == 0.0).all())
        assert bool((by_state[masks[0] > 0.0] != 0.0).all())
        assert bool((by_action[masks[1] > 0.0] != 0.0).all())


@pytest.mark.parametrize("seed", range(3))
def test_reward_depends_on_exactly_what_its_masks_let_through(seed):
    masks = random_masks(seed)
    model, states, actions = make(seed, masks)
    for state, action in zip(states, actions, strict=True):
        by_state, by_action = jacobian(lambda s, a: model.predict_reward(s[None], a[None])[0][0], (state, action))
        assert bool((by_state[masks[2] == 0.0] == 0.0).all())
        assert bool((by_action[masks[3] == 0.0] == 0.0).all())
        assert bool((by_state[masks[2] > 0.0] != 0.0).all())
        assert bool((by_action[masks[3] > 0.0] != 0.0).all())


@pytest.mark.parametrize("seed", range(3))
def test_response_to_the_action_is_exactly_zero_where_the_mask_is(seed):
    masks = random_masks(seed)
    model, states, actions = make(seed, masks)
    response = model.action_response(states, actions)
    assert bool((response.next_state_jacobian[:, masks[1] == 0.0] == 0.0).all())
    assert bool((response.next_state_jacobian[:, masks[1] > 0.0] != 0.0).all())


def test_closed_edges_do_not_move_predictions_at_all():
    masks = random_masks(0)
    model, states, actions = make(0, masks)
    reference, _ = model.predict_next_state(states, actions)
    for cause in range(N):
        changed = states.clone()
        changed[:, cause] += 1.0
        moved, _ = model.predict_next_state(changed, actions)
        for effect in range(N):
            assert th.equal(moved[:, effect], reference[:, effect]) == (masks[0][effect, cause] == 0.0)


def test_everything_closed_leaves_constants():
    model, states, actions = make(0, [th.zeros(N, N), th.zeros(N, D), th.zeros(N), th.zeros(D)])
    next_state, _ = model.predict_next_state(states, actions)
    reward, _ = model.predict_reward(states, actions)
    assert th.equal(next_state, next_state[:1].expand_as(next_state))
    assert th.equal(reward, reward[:1].expand_as(reward))


@pytest.mark.parametrize("value", [0.25, 1.0])
def test_residual_path_is_gated_by_the_diagonal_of_the_mask(value):
    model, states, actions = make(0, [value * th.eye(N), th.zeros(N, D), th.ones(N), th.ones(D)])
    with th.no_grad():
        model.transition.output_weight.zero_()
        model.transition.output_bias.zero_()
    next_state, _ = model.predict_next_state(states, actions)
    th.testing.assert_close(next_state, model.state_mean + value * (states - model.state_mean))


def test_without_its_own_edge_a_variable_forgets_itself():
    model, states, actions = make(0, [1.0 - th.eye(N), th.ones(N, D), th.ones(N), th.ones(D)])
    by_state = jacobian(lambda state: model.predict_next_state(state, actions)[0].sum(dim=0), states)
    for variable in range(N):
        assert bool((by_state[variable, :, variable] == 0.0).all())


def test_far_outside_of_what_was_seen_only_the_residual_path_moves():
    model, states, actions = make(0)
    # The residual path must not be the clamped one
    far = states + 100.0 * model.state_std
    by_state = jacobian(lambda state: model.predict_next_state(state[None], actions[:1])[0][0], far[0])
    th.testing.assert_close(by_state, th.eye(N))


def test_a_soft_mask_scales_the_input():
    th.manual_seed(0)
    blocks, inputs, mask = MaskedBlocks(4, 3, 8, 2), th.randn(6, 4), th.rand(3, 4)
    masked = blocks(inputs, mask)
    for output in range(3):
        expected = blocks(mask[output] * inputs, th.ones(3, 4))[:, output]
        th.testing.assert_close(masked[:, output], expected)


def test_blocks_share_no_parameter():
    th.manual_seed(0)
    blocks = MaskedBlocks(4, 3, 8, 3)
    blocks(th.randn(6, 4), th.ones(3, 4))[:, 1].sum().backward()
    weight = blocks.input_layer.weight.grad.view(3, 8, 4)
    hidden = [parameter.grad for parameter in blocks.hidden_weights]
    for gradient in (weight, *hidden, blocks.output_weight.grad, blocks.output_bias.grad):
        assert not gradient[0].any() and not gradient[2].any() and gradient[1].any()


@pytest.mark.parametrize("position", range(4))
def test_masks_of_a_wrong_shape_or_range_are_refused_and_nothing_is_written(position):
    name = ("state_to_state", "action_to_state", "state_to_reward", "action_to_reward")[position]
    model, _, _ = make()
    for wrong, message in (
        (lambda mask: mask[:-1], "must have the shape"),
        (lambda mask: mask + 1.0, r"must hold values in \[0, 1\]"),
        (lambda mask: mask - 2.0, r"must hold values in \[0, 1\]"),
        (lambda mask: mask * float("nan"), r"must hold values in \[0, 1\]"),
    ):
        masks = [th.full_like(mask, 0.5) for mask in random_masks(0)]
        masks[position] = wrong(masks[position])
        with pytest.raises(ValueError, match=f"{name} {message}"):
            model.set_masks(*masks)
    assert bool((model.state_to_state == 1.0).all()) and bool((model.action_to_reward == 1.0).all())


# Jacobians --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("blocks_class", [MaskedBlocks, ManyMaskedBlocks])
@pytest.mark.parametrize("depth", [1, 3])
@pytest.mark.parametrize("columns", [slice(None), slice(2, None), slice(0, 2)])
def test_blocks_give_their_outputs_and_their_jacobian(blocks_class, depth, columns):
    th.manual_seed(0)
    blocks, inputs, mask = blocks_class(4, 3, 8, depth), th.randn(6, 4), th.rand(3, 4)
    scale = th.tensor([[1.0], [0.1], [20.0]])
    outputs, ours = blocks.forward_and_jacobian(inputs, mask, columns, scale)
    th.testing.assert_close(outputs, blocks(inputs, mask))
    for row in range(6):
        expected = scale * jacobian(lambda x: blocks(x[None], mask)[0], inputs[row])
        th.testing.assert_close(ours[row], expected[:, columns])
    assert not outputs.requires_grad and not ours.requires_grad
    assert all(parameter.grad is None for parameter in blocks.parameters())


def test_many_blocks_are_the_same_function_with_the_same_gradients():
    th.manual_seed(0)
    few, many = MaskedBlocks(4, 3, 8, 3), ManyMaskedBlocks(4, 3, 8, 3)
    many.load_state_dict(few.state_dict())
    inputs, mask, target = th.randn(6, 4), th.rand(3, 4), th.randn(6, 3)
    outputs = [blocks(inputs, mask) for blocks in (few, many)]
    th.testing.assert_close(*outputs)
    losses = [(output - target).square().mean() for output in outputs]
    gradients = [th.autograd.grad(loss, blocks.parameters()) for loss, blocks in zip(losses, (few, many), strict=True)]
    for theirs, ours in zip(*gradients, strict=True):
        th.testing.assert_close(ours, theirs)


def test_a_world_of_many_states_has_blocks_for_many():
    assert type(MaskedWorldModel(MaskedWorldModel.MANY_STATES, 2).transition) is ManyMaskedBlocks
    assert type(MaskedWorldModel(MaskedWorldModel.MANY_STATES - 1, 2).transition) is MaskedBlocks


# Masks as probabilities -------------------------------------------------------------------------------------------------


def learned_response(mask, sample_masks):
    """The model's derivative of s' = s + a by the action, after training with this mask of the action."""
    th.manual_seed(0)
    model = MaskedWorldModel(1, 1, [16])
    model.set_masks(th.ones(1, 1), th.full((1, 1), mask), th.ones(1), th.ones(1))
    optimizer = th.optim.Adam(model.parameters(), lr=1e-2)
    for _ in range(400):
        state, action = th.randn(64, 1), 2.0 * th.rand(64, 1) - 1.0
        model.update_statistics(state, state + action, action[:, 0])
        transition, reward = model.negative_log_likelihood(state, action, state + action, action[:, 0], sample_masks)
        optimizer.zero_grad()
        (transition + reward).mean().backward()
        optimizer.step()
    return model.action_response(th.zeros(8, 1), th.linspace(-0.5, 0.5, 8)[:, None]).next_state_jacobian.mean().item()


def test_what_is_learned_makes_up_for_a_mask_that_scales_but_not_for_one_that_is_drawn():
    assert learned_response(0.2, sample_masks=False) > 0.9
    assert learned_response(0.2, sample_masks=True) < 0.5
    assert learned_response(1.0, sample_masks=True) > 0.9
    assert learned_response(0.0, sample_masks=True) == 0.0


def test_a_mask_of_0_or_1_is_never_drawn_otherwise():
    masks = [(mask > 0.0).float() for mask in random_masks(1)]
    model, states, actions = make(0, masks)
    arguments = states, actions, states + 0.1, states[:, 0]
    expected = model.negative_log_likelihood(*arguments)
    for _ in range(20):
        for theirs, ours in zip(expected, model.negative_log_likelihood(*arguments, sample_masks=True), strict=True):
            assert th.equal(ours, theirs)


@pytest.mark.parametrize("masked", [False, True])
def test_action_response_is_what_autograd_finds(masked):
    model, states, actions = make(0, random_masks(1) if masked else None)
    response = model.action_response(states, actions)

    def next_state_of(action, state):
        return model.predict_next_state(state[None], action[None])[0]

    def reward_of(action, state):
        # The path a -> s' -> r counts
        return model.predict_reward(next_state_of(action, state), action[None])[0][0]

    next_state, next_std = model.predict_next_state(states, actions)
    th.testing.assert_close(response.next_state, next_state)
    th.testing.assert_close(response.next_state_std, next_std)
    reward, reward_std = model.predict_reward(next_state, actions)
    th.testing.assert_close(response.reward, reward)
    th.testing.assert_close(response.reward_std, reward_std)
    assert not any(part.requires_grad for part in response if isinstance(part, th.Tensor))
    for row, (state, action) in enumerate(zip(states, actions, strict=True)):
        by_action = jacobian(lambda a, s=state: next_state_of(a, s)[0], action)
        th.testing.assert_close(response.next_state_jacobian[row], by_action, rtol=1e-4, atol=1e-5)
        reward_by_action = jacobian(lambda a, s=state: reward_of(a, s), action)
        th.testing.assert_close(response.reward_jacobian[row], reward_by_action, rtol=1e-4, atol=1e-5)


def test_reward_responds_through_the_next_state_alone():
    model, states, actions = make(0, [th.ones(N, N), th.ones(N, D), th.ones(N), th.zeros(D)])
    assert bool((model.action_response(states, actions).reward_jacobian != 0.0).all())
    model.set_masks(th.ones(N, N), th.zeros(N, D), th.ones(N), th.zeros(D))
    assert not model.action_response(states, actions).reward_jacobian.any()


# Statistics and likelihood ----------------------------------------------------------------------------------------------


def test_statistics_are_those_of_all_batches():
    th.manual_seed(0)
    model = MaskedWorldModel(2, 1, [8])
    state = th.randn(640, 2) * th.tensor([0.01, 30.0]) + th.tensor([2.0, -50.0])
    next_state, reward = state + th.randn(640, 2) * th.tensor([0.001, 3.0]), 5.0 * th.randn(640) + 11.0
    for start in range(0, 640, 64):
        rows = slice(start, start + 64)
        model.update_statistics(state[rows], next_state[rows], reward[rows])
    th.testing.assert_close(model.state_mean, state.mean(dim=0), rtol=1e-4, atol=1e-4)
    th.testing.assert_close(model.state_variance, state.var(dim=0, correction=0), rtol=1e-3, atol=0.0)
    th.testing.assert_close(model.reward_mean, reward.mean(), rtol=1e-4, atol=1e-4)
    th.testing.assert_close(model.reward_variance, reward.var(correction=0), rtol=1e-3, atol=0.0)
    th.testing.assert_close(model.change_variance, (next_state - state).square().mean(dim=0), rtol=1e-3, atol=0.0)


def test_statistics_ignore_a_single_row_and_forget_the_start_values():
    model = MaskedWorldModel(2, 1, [8])
    model.update_statistics(th.full((1, 2), 9.0), th.zeros(1, 2), th.zeros(1))
    assert th.equal(model.state_mean, th.zeros(2)) and model.n_batches == 0.0
    model.update_statistics(th.full((4, 2), 9.0), th.full((4, 2), 9.0), th.full((4,), 3.0))
    assert th.equal(model.state_mean, th.full((2,), 9.0)) and model.reward_mean == 3.0


def test_statistics_of_the_transitions_that_are_known_are_those_of_a_batch_without_the_others():
    th.manual_seed(0)
    state, next_state, reward = th.randn(8, 2), th.randn(8, 2), th.randn(8)
    known = th.tensor([1.0, 0.0, 1.0, 1.0, 0.0, 1.0, 1.0, 1.0])
    kept = known > 0.0
    both = MaskedWorldModel(2, 1, [8]), MaskedWorldModel(2, 1, [8])
    for scale in (1.0, 3.0):
        both[0].update_statistics(scale * state, next_state, reward, known)
        both[1].update_statistics(scale * state[kept], next_state[kept], reward[kept])
    # One transition or none tells nothing
    for few in (th.zeros(8), (th.arange(8) == 0).float()):
        both[0].update_statistics(state, next_state, reward, few)
    for name, value in both[0].named_buffers():
        th.testing.assert_close(value, dict(both[1].named_buffers())[name], msg=name)


def test_statistics_follow_a_change_of_the_data():
    model = MaskedWorldModel(1, 1, [8])
    model.STATISTICS_WINDOW = 20
    th.manual_seed(0)
    for mean in (0.0, 10.0):
        for _ in range(100):
            state = mean + th.randn(4, 1)
            model.update_statistics(state, state, state[:, 0])
    assert abs(float(model.state_mean) - 10.0) < 1.0


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1.0, 1e6])
def test_units_change_predictions_by_the_unit_alone(unit):
    """Of the rewards; of the states, too."""
    predictions = []
    for scale in (1.0, unit):
        th.manual_seed(0)
        model = MaskedWorldModel(2, 1, [16])
        state, action = scale * th.randn(64, 2), th.rand(64, 1)
        model.update_statistics(state, state + 0.1 * scale * action, scale * (state / scale).sum(dim=1))
        (mean, std), (reward, reward_std) = model.predict_next_state(state, action), model.predict_reward(state, action)
        response = model.action_response(state, action)
        predictions.append(
            [value / scale for value in (mean, std, reward, reward_std, model.state_std, model.reward_scale)]
            + [response.reward_jacobian / scale, response.next_state_jacobian / scale, response.reward_by_next_state]
        )
    for value, expected in zip(*reversed(predictions), strict=True):
        th.testing.assert_close(value, expected, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("value", [0.0, 1e-9, 0.1, 1e3, 5e6])
def test_what_does_not_move_is_measured_in_ones(value):
    model = MaskedWorldModel(2, 1, [16])
    state = th.stack([th.randn(300), th.full((300,), value)], dim=1)
    for rows in state.split(30):
        model.update_statistics(rows, rows, th.full((30,), value))
    assert model.state_std[1] == model.reward_scale == 1.0 and model.state_std[0] != 1.0


def test_constant_variables_give_finite_predictions():
    model = MaskedWorldModel(2, 1, [8])
    state, reward = th.tensor([[1.0, 5.0]]).repeat(16, 1), th.zeros(16)
    model.update_statistics(state, state, reward)
    losses = model.negative_log_likelihood(state, th.zeros(16, 1), state, reward)
    assert all(bool(loss.isfinite().all()) for loss in losses)
    response = model.action_response(state, th.zeros(16, 1))
    tensors = [part for part in response if isinstance(part, th.Tensor)]
    assert len(tensors) > 3 and all(bool(part.isfinite().all()) for part in tensors)


def test_likelihood_is_the_gaussian_one_up_to_a_constant():
    model, states, actions = make(0, random_masks(0))
    th.manual_seed(1)
    next_states, rewards = states + 0.3 * th.randn(6, N), th.randn(6) * 4.0 - 7.0
    transition, reward = model.negative_log_likelihood(states, actions, next_states, rewards)
    # Standardised units: the constant is the scale of the units
    dist = th.distributions.Normal(*model.predict_next_state(states, actions))
    expected = -dist.log_prob(next_states) - (model.residual_std * model.state_std).log() - 0.5 * math.log(2 * math.pi)
    th.testing.assert_close(transition, expected.mean(dim=1), rtol=1e-4, atol=1e-4)
    dist = th.distributions.Normal(*model.predict_reward(next_states, actions))
    expected = -dist.log_prob(rewards) - model.reward_scale.log() - 0.5 * math.log(2 * math.pi)
    th.testing.assert_close(reward, expected, rtol=1e-4, atol=1e-4)


def test_learns_a_linear_system_and_its_noise():
    th.manual_seed(0)
    model = MaskedWorldModel(3, 2, [32, 32])
    transition = th.tensor([[0.9, 0.1, 0.0], [0.0, 0.8, 0.2], [0.0, 0.0, 0.7]])
    control = th.tensor([[0.0, 0.0], [0.5, 0.0], [0.0, 0.5]])
    noise_std, reward_std = th.tensor([0.05, 0.1, 0.2]), 0.3
    optimizer = th.optim.Adam(model.parameters(), lr=1e-2)

    def draw(n):
        state, action = th.randn(n, 3), th.rand(n, 2) * 2 - 1
        next_state = state @ transition.T + action @ control.T + noise_std * th.randn(n, 3)
        return state, action, next_state, 2.0 * next_state[:, 0] + action[:, 1] + reward_std * th.randn(n) - 5.0

    losses = []
    for _ in range(300):
        state, action, next_state, reward = draw(128)
        model.update_statistics(state, next_state, reward)
        terms = model.negative_log_likelihood(state, action, next_state, reward)
        loss = terms[0].mean() + terms[1].mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert sum(losses[-20:]) / 20 < sum(losses[:20]) / 20 - 1.0
    state, action, *_ = draw(1000)
    mean, std = model.predict_next_state(state, action)
    assert (mean - state @ transition.T - action @ control.T).square().mean().sqrt() < 0.07
    assert bool((std / noise_std < 1.5).all()) and bool((std / noise_std > 0.7).all())
    _, std = model.predict_reward(state, action)
    assert 0.7 < std.item() / reward_std < 1.5
    effect = model.action_response(state, action).next_state_jacobian.mean(dim=0)
    th.testing.assert_close(effect, control, rtol=0.0, atol=0.1)


# Size -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("net_arch", [[], [64, 128], [0], [-8, -8]])
def test_hidden_layers_that_differ_or_are_empty_are_refused(net_arch):
    with pytest.raises(ValueError, match="world_model_net_arch must be a list of equal positive sizes"):
        MaskedWorldModel(4, 2, net_arch)


def test_depth_and_width_follow_net_arch():
    small, wide, deep = (
        sum(parameter.numel() for parameter in MaskedWorldModel(4, 2, net_arch).parameters())
        for net_arch in ([32, 32], [64, 64], [32, 32, 32])
    )
    assert small < wide and small < deep


def test_stays_small_for_a_humanoid():
    model = MaskedWorldModel(348, 17, [256] * 4)
    assert sum(parameter.numel() for parameter in model.parameters()) < 5e6


def test_masks_and_statistics_are_saved():
    model, states, actions = make(0, random_masks(0))
    other = MaskedWorldModel(N, D, [16, 16])
    other.load_state_dict(model.state_dict())
    responses = [one.action_response(states, actions) for one in (model, other)]
    for ours, theirs in zip(*([part for part in one if isinstance(part, th.Tensor)] for one in responses), strict=True):
        assert th.equal(ours, theirs)


def test_the_reward_does_not_move_with_a_next_state_beyond_the_bound_of_the_inputs():
    th.manual_seed(0)
    model = MaskedWorldModel(2, 1, [8])
    with th.no_grad():
        model.transition.output_weight.mul_(20)
    model.set_masks(th.ones(2, 2), th.ones(2, 1), th.ones(2), th.zeros(1))
    state, action = th.tensor([[20.0, 0.0]]), th.zeros(1, 1)
    expected = th.autograd.functional.jacobian(
        lambda one: model.predict_reward(model.predict_next_state(state, one)[0], one)[0], action
    )
    th.testing.assert_close(model.action_response(state, action).reward_jacobian, expected.flatten(1))


# Some states alone --------------------------------------------------------------------------------------------------------


def partial_model(n):
    """Of many states, of which 10 are to be modelled: every third one, and six others to make the number a multiple of 8."""
    th.manual_seed(0)
    model = MaskedWorldModel(n, D, [16, 16])
    states, actions = th.randn(6, n), th.rand(6, D) * 2 - 1
    model.update_statistics(states, states + 0.3 * th.randn(6, n), th.randn(6))
    model.set_masks(*(mask.clamp(min=0.1) for mask in random_masks(1, n)))
    wanted = th.zeros(n, dtype=th.bool)
    wanted[2:32:3] = True
    return model, states, actions, wanted


@pytest.mark.parametrize("n", [40, 80])
def test_what_is_modelled_is_as_in_a_model_of_all_whose_other_edges_are_closed(n):
    model, states, actions, wanted = partial_model(n)
    assert isinstance(model.transition, ManyMaskedBlocks) == (n == 80)
    newly = model.model_only(wanted)
    modelled = model.modelled_states
    assert modelled.sum() == 16 and bool((modelled | ~wanted).all()) and not newly.any()
    response = model.action_response(states, actions, of_all=False)
    of_all = model.action_response(states, actions)
    assert response.standardised_jacobian.shape == (6, 16, D)
    th.testing.assert_close(response.next_state[:, modelled], of_all.next_state[:, modelled])
    assert th.equal(response.next_state[:, ~modelled], states[:, ~modelled])
    th.testing.assert_close(response.standardised_jacobian, of_all.standardised_jacobian[:, modelled])
    th.testing.assert_close(response.reward, of_all.reward)
    th.testing.assert_close(response.reward_by_next_state, of_all.reward_by_next_state[:, modelled])
    assert not of_all.reward_by_next_state[:, ~modelled].any()
    # And so is a model that never heard of it, with those masks
    edges = modelled.float()
    plain, _, _, _ = partial_model(n)
    closed = [model.state_to_state * th.where(modelled.unsqueeze(1), edges, 1.0), model.action_to_state]
    plain.set_masks(*closed, model.state_to_reward * edges, model.action_to_reward)
    for ours, theirs in zip(
        (*model.predict_next_state(states, actions), *model.predict_reward(states, actions)),
        (*plain.predict_next_state(states, actions), *plain.predict_reward(states, actions)),
        strict=True,
    ):
        th.testing.assert_close(ours, theirs)
    likelihoods = [one.negative_log_likelihood(states, actions, states + 0.1, states[:, 0]) for one in (model, plain)]
    th.testing.assert_close(likelihoods[0][1], likelihoods[1][1])
    assert not th.allclose(likelihoods[0][0], likelihoods[1][0])


@pytest.mark.parametrize("n", [40, 80])
def test_what_is_not_modelled_is_not_learned(n):
    model, states, actions, wanted = partial_model(n)
    model.model_only(wanted)
    modelled = model.modelled_states
    sum(part.sum() for part in model.negative_log_likelihood(states, actions, states + 0.1, states[:, 0])).backward()
    assert model.transition_log_std.grad[modelled].all() and not model.transition_log_std.grad[~modelled].any()
    for parameter in model.transition.parameters():
        by_output = parameter.grad.view(n, -1)
        assert by_output[modelled].any(dim=1).all() and not by_output[~modelled].any()
    of_inputs = model.reward.input_layer.weight.grad
    assert of_inputs[:, :n][:, modelled].any() and of_inputs[:, n:].any() and not of_inputs[:, :n][:, ~modelled].any()


def test_all_are_modelled_again():
    model, states, actions, wanted = partial_model(40)
    before = model.predict_next_state(states, actions)[0]
    model.model_only(wanted)
    others = ~model.modelled_states
    assert th.equal(model.model_only(th.ones(40, dtype=th.bool)), others)
    assert th.equal(model.predict_next_state(states, actions)[0], before) and model.modelled_indices is None
