import numpy as np
import pytest
import torch as th
from scipy import stats

from sb3_causalgdp.causal import CausalGraph, MaskedWorldModel, TransitionVariables, discover
from sb3_causalgdp.causal.counterfactual_batches import (
    Transitions,
    components_of,
    exchange_components,
    exchange_locally,
    exchange_part,
    irrelevant_part,
)

VARIABLES = TransitionVariables(("x", "v", "y", "w", "noise"), ("push", "pull", "idle"))
NOISE = 0.1


def means(states, actions, coupling=0.0):
    """Two masses, and a noise: x, v moved by push, y, w by pull. With a coupling, the first moves the second."""
    x, v, y, w, noise = states.T
    push, pull, _ = actions.T
    return np.stack(
        [
            x + 0.3 * v,
            0.8 * v + np.sin(x) + 0.5 * push,
            y + 0.3 * w,
            0.8 * w - 0.5 * y * np.abs(y) + 0.5 * pull + coupling * x,
            0.9 * noise,
        ],
        axis=1,
    )


def rewards_of(next_states, actions):
    return next_states[:, 0] - 0.5 * next_states[:, 2] ** 2 + 0.1 * actions[:, 0]


def sample(n_rows, rng, coupling=0.0):
    states, actions = rng.normal(size=(n_rows, 5)), rng.uniform(-1, 1, (n_rows, 3))
    next_states = means(states, actions, coupling) + NOISE * rng.normal(size=states.shape)
    return states, actions, next_states, rewards_of(next_states, actions)


def tensors(arrays):
    return Transitions(*(th.as_tensor(array) for array in arrays))


def true_graph(**changes):
    masks = np.zeros((6, 8))
    for row, columns in enumerate(([0, 1], [0, 1, 5], [2, 3], [2, 3, 6], [4], [0, 2, 5])):
        masks[row, columns] = 1.0
    return CausalGraph(VARIABLES, masks, np.zeros_like(masks), "by hand", 10, **changes)


def reward_model(next_states, actions):
    return th.as_tensor(rewards_of(next_states.numpy(), actions.numpy()))


def p_of_true_system(transitions, coupling=0.0):
    """
    The smallest p-value, times their number, of tests that what the true system leaves of the next states is its noise: of the
    right size, and unrelated to any state and action.
    """
    states, actions, next_states, _ = (values.numpy() for values in transitions)
    left = (next_states - means(states, actions, coupling)) / NOISE
    p_values = [stats.kstest(column, "norm").pvalue for column in left.T]
    for column in left.T:
        p_values += [stats.pearsonr(column, cause).pvalue for cause in (*states.T, *actions.T)]
    return min(p_values) * len(p_values)


def test_components_are_what_hangs_together():
    components = components_of(true_graph())
    groups = {frozenset(np.flatnonzero(components.labels == label)) for label in range(components.labels.max() + 1)}
    assert groups == {frozenset({0, 1, 5}), frozenset({2, 3, 6}), frozenset({4}), frozenset({7})}
    assert components.read[components.labels].tolist() == [True, True, True, True, False, True, True, False]


def test_components_of_the_graph_that_is_found_are_the_true_ones():
    rows = VARIABLES.stack(*sample(3_000, np.random.default_rng(0)))
    found = components_of(discover("partial_r2", rows, VARIABLES))
    np.testing.assert_array_equal(found.labels, components_of(true_graph()).labels)


def test_exchanged_transitions_have_the_true_systems_distribution():
    transitions = tensors(sample(4_000, np.random.default_rng(0)))
    exchange = exchange_components(
        transitions, components_of(true_graph()), reward_model, generator=th.Generator().manual_seed(0)
    )
    assert exchange.exchanged.float().mean() > 0.8 and exchange.modelled.any()
    assert p_of_true_system(exchange.transitions) > 0.01
    after = exchange.transitions
    np.testing.assert_allclose(after.rewards, rewards_of(after.next_states.numpy(), after.actions.numpy()))
    # They are others than before, and each variable's values are those of the batch
    assert not th.equal(after.states, transitions.states)
    assert th.equal(after.states.sort(dim=0).values, transitions.states.sort(dim=0).values)


def test_a_wrong_graph_is_detected():
    coupling = 0.3
    transitions = tensors(sample(4_000, np.random.default_rng(0), coupling))
    assert p_of_true_system(transitions, coupling) > 0.01
    wrong = exchange_components(transitions, components_of(true_graph()), reward_model)
    assert p_of_true_system(wrong.transitions, coupling) < 1e-6
    right_graph = true_graph()
    right_graph.masks[3, 0] = 1.0
    right = exchange_components(transitions, components_of(right_graph), reward_model)
    assert p_of_true_system(right.transitions, coupling) > 0.01


def test_rewards_are_computed_only_where_they_depend_on_both_parts():
    transitions = tensors(sample(500, np.random.default_rng(0)))
    asked = []

    def counting_model(next_states, actions):
        asked.append(len(next_states))
        return th.full((len(next_states),), 7.0, dtype=th.float64)

    donors = th.arange(500).roll(1)
    read = th.tensor([True, False, True, False, False, True, False, False])
    unread, first, both = (th.zeros(8, dtype=th.bool) for _ in range(3))
    unread[[4, 7]], first[[0, 1, 5]], both[[0, 1, 2, 3, 5, 6]] = True, True, True
    kept = exchange_part(transitions, unread, donors, read, counting_model)
    assert th.equal(kept.transitions.rewards, transitions.rewards) and kept.exchanged.all() and not asked
    moved = exchange_part(transitions, both, donors, read, counting_model)
    assert th.equal(moved.transitions.rewards, transitions.rewards[donors]) and not moved.modelled.any() and not asked
    computed = exchange_part(transitions, first, donors, read, counting_model)
    assert (computed.transitions.rewards == 7.0).all() and computed.modelled.all() and asked == [500]
    # Without a model there is no exchange whose reward nobody knows
    assert not exchange_part(transitions, first, donors, read).exchanged.any()


def test_rows_that_are_kept_give_and_take_nothing():
    transitions = tensors(sample(300, np.random.default_rng(0)))
    keep = th.zeros(300, dtype=th.bool)
    keep[::7] = True
    after = exchange_components(transitions, components_of(true_graph()), reward_model, keep).transitions
    assert th.equal(after.states[keep], transitions.states[keep])
    others = after.states[~keep]
    assert not th.isin(others, transitions.states[keep]).any()


def test_all_in_one_component_changes_nothing():
    transitions = tensors(sample(100, np.random.default_rng(0)))
    exchange = exchange_components(transitions, components_of(CausalGraph.fully_connected(VARIABLES)), reward_model)
    assert not exchange.exchanged.any()
    for before, after in zip(transitions, exchange.transitions, strict=True):
        assert th.equal(before, after)


def test_what_relevant_variables_move_is_not_exchanged_alone():
    graph = true_graph()
    irrelevant = np.array([False, False, False, False, True, False, False, True])
    assert irrelevant_part(graph, irrelevant).tolist() == irrelevant.tolist()
    graph.masks[4, 0] = 1.0
    assert irrelevant_part(graph, irrelevant).tolist() == [False] * 7 + [True]


def test_the_irrelevant_can_be_exchanged_without_a_reward_model():
    rng = np.random.default_rng(0)
    transitions = tensors(sample(3_000, rng))
    relevance = true_graph().relevance()
    irrelevant = np.concatenate([relevance.states, relevance.actions]) == 0.0
    part = th.as_tensor(irrelevant_part(true_graph(), irrelevant))
    assert part.tolist() == [False] * 4 + [True, False, False, True]
    read = th.as_tensor(true_graph().masks[-1] > 0)
    exchange = exchange_part(transitions, part, th.as_tensor(rng.permutation(3_000)), read)
    after = exchange.transitions
    assert th.equal(after.states[:, :4], transitions.states[:, :4]) and th.equal(after.rewards, transitions.rewards)
    assert exchange.exchanged.float().mean() > 0.99 and not th.equal(after.states[:, 4], transitions.states[:, 4])
    assert p_of_true_system(after) > 0.01


# Objects that touch sometimes ------------------------------------------------------------------------------------------------

TOUCHING = TransitionVariables(("hand", "object"), ("move", "blow"))


def touching_means(states, actions):
    """A hand that moves an object only where they are close, and a wind that moves the object."""
    hand, thing = states.T
    close = np.abs(hand - thing) < 0.5
    return np.stack(
        [0.9 * hand + 0.3 * actions[:, 0], 0.9 * thing + np.where(close, 0.6 * hand, 0.0) + 0.3 * actions[:, 1]], axis=1
    )


@pytest.fixture(scope="module")
def touching():
    rng = np.random.default_rng(0)
    n_rows = 4_000
    states, actions = rng.uniform(-2, 2, (n_rows, 2)), rng.uniform(-1, 1, (n_rows, 2))
    next_states = touching_means(states, actions) + 0.02 * rng.normal(size=states.shape)
    transitions = tensors([values.astype(np.float32) for values in (states, actions, next_states, next_states[:, 1])])
    masks = np.array([[1, 0, 1, 0], [1, 1, 0, 1], [0, 1, 0, 0]], dtype=float)
    graph = CausalGraph(TOUCHING, masks, np.zeros_like(masks), "by hand", n_rows)
    th.manual_seed(0)
    model = MaskedWorldModel(2, 2, [64, 64])
    blocks = (graph.state_to_state, graph.action_to_state, graph.state_to_reward, graph.action_to_reward)
    model.set_masks(*(th.as_tensor(block, dtype=th.float32) for block in blocks))
    optimizer = th.optim.Adam(model.parameters(), lr=3e-3)
    for step in range(1_500):
        rows = th.randint(n_rows, (256,))
        batch = Transitions(*(values[rows] for values in transitions))
        if step < 100:
            model.update_statistics(batch.states, batch.next_states, batch.rewards)
        transition, reward = model.negative_log_likelihood(batch.states, batch.actions, batch.next_states, batch.rewards)
        optimizer.zero_grad()
        (transition.mean() + reward.mean()).backward()
        optimizer.step()
    return transitions, model, graph


def test_objects_that_do_not_touch_are_exchanged_and_touching_ones_are_not(touching):
    transitions, model, graph = touching
    assert len(components_of(graph).read) == 1
    exchange = exchange_locally(transitions, model, graph, 0.3, generator=th.Generator().manual_seed(0))
    before = ((transitions.states[:, 0] - transitions.states[:, 1]).abs() < 0.5).numpy()
    taken = exchange.exchanged.numpy()
    assert taken.mean() > 0.1
    assert taken[before].mean() < 0.1 * taken[~before].mean()
    after = exchange.transitions
    states, actions, next_states = (values.numpy()[taken] for values in after[:3])
    error = np.abs(next_states - touching_means(states, actions)).max(axis=1)
    assert (error < 0.1).mean() > 0.95
    # Exchanged without looking, many would be impossible
    part = th.tensor([True, False, True, False])
    blind = exchange_part(transitions, part, th.arange(4_000).roll(1), th.tensor([False, True, False, False])).transitions
    wrong = np.abs(blind.next_states.numpy() - touching_means(blind.states.numpy(), blind.actions.numpy())).max(axis=1)
    assert (wrong > 0.1).mean() > 0.2


def test_rows_without_a_local_exchange_are_as_they_were(touching):
    transitions, model, graph = touching
    exchange = exchange_locally(transitions, model, graph, 0.3)
    for before, after in zip(transitions, exchange.transitions, strict=True):
        assert th.equal(before[~exchange.exchanged], after[~exchange.exchanged])
    assert not exchange_locally(transitions, model, graph, 1e-9).exchanged.all()


def test_arguments_out_of_range_are_refused(touching):
    transitions, model, graph = touching
    with pytest.raises(ValueError, match="binding must be"):
        components_of(graph, 0.0)
    with pytest.raises(ValueError, match="threshold must be positive"):
        exchange_locally(transitions, model, graph, 0.0)
    with pytest.raises(ValueError, match="part must have shape"):
        exchange_part(transitions, th.ones(3, dtype=th.bool), th.arange(4_000), th.ones(4, dtype=th.bool))
    with pytest.raises(ValueError, match="donors must have shape"):
        exchange_part(transitions, th.ones(4, dtype=th.bool), th.arange(3), th.ones(4, dtype=th.bool))
    with pytest.raises(ValueError, match="irrelevant must have shape"):
        irrelevant_part(graph, np.ones(3))
