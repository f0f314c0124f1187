import numpy as np
import pytest

from benchmarks.discovery.systems import KINDS, LARGEST_STATE, MIN_SHARE, ControlSystem, generate, make_system


@pytest.fixture(scope="module", params=KINDS)
def system(request) -> ControlSystem:
    return make_system(request.param, np.random.default_rng(0))


def outcome(system: ControlSystem, inputs: np.ndarray, row: int) -> np.ndarray:
    """Noise-free effect of a row of the adjacency: inputs are [s, a] for next states, [s', a] for the reward."""
    n_states = system.variables.n_states
    states, actions = inputs[:, :n_states], inputs[:, n_states:]
    if row == n_states:
        return system.expected_reward(states, actions)
    return system.expected_next_states(states, actions)[:, row]


def test_a_cause_changes_its_effect_and_nothing_else_does(system):
    rng = np.random.default_rng(1)
    inputs = rng.uniform(-2.0, 2.0, (50, system.variables.n_states + system.variables.n_actions))
    for row in range(system.adjacency.shape[0]):
        base = outcome(system, inputs, row)
        for column, is_edge in enumerate(system.adjacency[row]):
            moved = inputs.copy()
            moved[:, column] += 0.3
            change = np.abs(outcome(system, moved, row) - base)
            if is_edge:
                # Slow systems move by 5 % of the effect
                assert change.max() > 1e-3, f"{row} <- {column}"
            else:
                assert change.max() == 0.0, f"{row} <- {column}"


def test_every_edge_has_its_share_of_the_variance(system):
    rng = np.random.default_rng(2)
    shares = system.shares(system.sample(20_000, rng), rng)
    for row, effect in enumerate(system.effects):
        if effect.terms:
            assert shares[row, effect.parents].min() > 0.9 * MIN_SHARE  # an estimate, from another sample


def test_there_are_edges_and_non_edges_and_every_moving_action_matters(system):
    edges = system.adjacency
    assert 0.1 < edges.mean() < 0.4
    actions = edges[:-1, system.variables.n_states :].any(axis=0)
    assert np.flatnonzero(~actions).tolist() == list(system.constant_actions)


def test_rows_are_finite_and_of_the_asked_number(system):
    for n_rows in (1, 250, 1033):
        rows = system.sample(n_rows, np.random.default_rng(3))
        assert rows.shape == (n_rows, system.variables.n_variables)
        assert np.isfinite(rows).all()


def test_an_episode_goes_on_from_its_next_state_until_it_is_over(system):
    rows = system.sample(90, np.random.default_rng(4))  # one episode at a time
    states, next_states = rows[1:, system.variables.state], rows[:-1, system.variables.next_state]
    follows = (states == next_states).all(axis=1)
    over = (np.abs(next_states) > LARGEST_STATE).any(axis=1)
    assert not follows[over].any()
    assert (~follows & ~over).sum() <= 1


def test_a_seed_reproduces_system_and_rows():
    rows, variables, edges = generate("nonlinear", 200, seed=5)
    again, _, same_edges = generate("nonlinear", 200, seed=5)
    np.testing.assert_array_equal(rows, again)
    np.testing.assert_array_equal(edges, same_edges)
    other, _, _ = generate("nonlinear", 200, seed=6)
    assert edges.shape == (variables.n_states + 1, variables.n_states + variables.n_actions)
    assert not np.array_equal(rows, other)


def test_next_states_of_a_slow_system_are_nearly_the_states():
    rows, variables, edges = generate("slow", 2000, seed=0)
    states, next_states = rows[:, variables.state], rows[:, variables.next_state]
    correlations = [np.corrcoef(states[:, i], next_states[:, i])[0, 1] for i in range(variables.n_states)]
    assert min(correlations) > 0.95
    assert np.diag(edges).all()


def test_less_noise_ties_the_confounded_actions_closer_to_the_states():
    explained = []
    for action_noise in (0.5, 0.05):
        rows, variables, _ = generate("confounded", 3000, seed=0, action_noise=action_noise)
        states, action = rows[:, variables.state], rows[:, variables.action][:, 0]
        centred = np.column_stack([states, np.ones(len(rows))])
        rest = action - centred @ np.linalg.lstsq(centred, action, rcond=None)[0]
        explained.append(1.0 - rest.var() / action.var())
    assert explained[1] > explained[0] + 0.2


def test_distractors_cause_only_themselves_and_persist():
    rows, variables, edges = generate("irrelevant", 5000, seed=0)
    for distractor in range(6, 10):
        assert np.flatnonzero(edges[distractor]).tolist() == [distractor]
        assert np.flatnonzero(edges[:, distractor]).tolist() == [distractor]
        pair = np.corrcoef(rows[:, variables.state][:, distractor], rows[:, variables.next_state][:, distractor])
        assert pair[0, 1] > 0.9


def test_copies_are_exact_and_constants_do_not_move():
    system = make_system("duplicated", np.random.default_rng(0))
    rows = system.sample(500, np.random.default_rng(0))
    for block in (rows[:, system.variables.state], rows[:, system.variables.next_state]):
        for copy, original in system.copies:
            np.testing.assert_array_equal(block[:, copy], block[:, original])
        assert np.ptp(block[:, system.constant_states], axis=0).max() == 0.0
    assert np.ptp(rows[:, system.variables.action][:, system.constant_actions], axis=0).max() == 0.0


def test_an_edge_found_at_the_copy_counts_for_the_original():
    system = make_system("duplicated", np.random.default_rng(0))
    copy, original = system.copies[0]
    found = system.adjacency.astype(float)
    found[:, copy], found[:, original] = found[:, original].copy(), 0.0
    np.testing.assert_array_equal(system.fold_copies(found)[system.scored], system.adjacency[system.scored])


@pytest.mark.parametrize(
    "arguments", [{"kind": "cubic"}, {"kind": "linear", "n_states": 3}, {"kind": "linear", "n_actions": 1}]
)
def test_what_cannot_be_drawn_is_an_error(arguments):
    with pytest.raises(ValueError):
        make_system(rng=np.random.default_rng(0), **arguments)
