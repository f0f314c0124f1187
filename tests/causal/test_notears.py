import itertools
import pickle
import warnings

import numpy as np
import pytest
from sklearn.linear_model import Lasso
from sklearn.metrics import roc_auc_score

from sb3_causalgdp.causal import (
    DISCOVERY_METHODS,
    CausalGraph,
    StreamingMoments,
    TransitionVariables,
    discover,
    make_discovery,
    make_statistics,
)
from sb3_causalgdp.causal.discovery.acyclic import acyclicity, is_acyclic, without_cycles
from sb3_causalgdp.causal.discovery.lasso import solve_lasso_gram
from sb3_causalgdp.causal.discovery.notears import Notears


def make_variables(n_states, n_actions):
    return TransitionVariables(tuple(f"s{i}" for i in range(n_states)), tuple(f"a{i}" for i in range(n_actions)))


def linear_system(seed, n_rows, n_states=10, n_actions=4):
    """Transitions of a sparse, stable linear system, and its true edges."""
    rng = np.random.default_rng(seed)
    variables = make_variables(n_states, n_actions)

    def sparse(*shape):
        return rng.choice([-1, 1], size=shape) * rng.uniform(0.5, 1.0, shape) * (rng.random(shape) < 0.25)

    dynamics, control, of_state, of_action = (
        sparse(n_states, n_states),
        sparse(n_states, n_actions),
        sparse(n_states),
        sparse(n_actions),
    )
    of_state[0] = of_action[0] = 1.0
    dynamics *= 0.8 / max(1.0, np.abs(np.linalg.eigvals(dynamics)).max())
    states = np.zeros((n_rows + 1, n_states))
    actions = rng.uniform(-1, 1, (n_rows, n_actions))
    for t in range(n_rows):
        states[t + 1] = dynamics @ states[t] + control @ actions[t] + 0.3 * rng.normal(size=n_states)
    rewards = states[1:] @ of_state + actions @ of_action + 0.3 * rng.normal(size=n_rows)
    rows = variables.stack(states[:-1], actions, states[1:], rewards)
    return variables, rows, [block != 0 for block in (dynamics, control, of_state, of_action)]


def moments_of(rows):
    moments = StreamingMoments(rows.shape[1])
    moments.update(rows)
    return moments


def weights_of(graph):
    return [
        graph.effect_state_to_state,
        graph.effect_action_to_state,
        graph.effect_state_to_reward,
        graph.effect_action_to_reward,
    ]


def random_problem(rng, n_inputs, n_targets):
    factor = rng.normal(size=(3 * n_inputs, n_inputs)) @ rng.normal(size=(n_inputs, n_inputs))
    gram = factor.T @ factor / len(factor)
    return gram, gram @ (rng.normal(size=(n_inputs, n_targets)) * (rng.random((n_inputs, n_targets)) < 0.5))


def exact_minimum(gram, cross, sparsity):
    """The Lasso by trying all sign patterns; the one that satisfies the optimality conditions is the minimum."""
    for signs in itertools.product([-1, 0, 1], repeat=len(gram)):
        signs = np.array(signs)
        support = signs != 0
        weights = np.zeros(len(gram))
        weights[support] = np.linalg.solve(gram[np.ix_(support, support)], cross[support] - sparsity * signs[support])
        gradient = gram @ weights - cross
        if (np.sign(weights) == signs).all() and (np.abs(gradient[~support]) <= sparsity + 1e-12).all():
            return weights
    raise AssertionError("no sign pattern is optimal")


@pytest.mark.parametrize("n_inputs", [1, 2, 3, 4])
@pytest.mark.parametrize("sparsity", [0.0, 0.1, 1.0])
def test_solver_finds_the_exact_minimum(n_inputs, sparsity):
    gram, cross = random_problem(np.random.default_rng(n_inputs), n_inputs, 5)
    solution = solve_lasso_gram(gram, cross, sparsity, tolerance=1e-10, max_iterations=200_000)
    exact = np.stack([exact_minimum(gram, column, sparsity) for column in cross.T], axis=1)
    assert solution.converged
    np.testing.assert_allclose(solution.weights, exact, atol=1e-5)


def test_equals_scikit_learns_lasso_on_standardised_data():
    variables, rows, _ = linear_system(seed=0, n_rows=500)
    graph = Notears(sparsity=0.03, tolerance=1e-8)(moments_of(rows), variables)
    standardised = (rows - rows.mean(axis=0)) / rows.std(axis=0)
    state, action, after = standardised[:, :10], standardised[:, 10:14], standardised[:, 14:24]
    lasso = Lasso(alpha=0.03, fit_intercept=False, tol=1e-10, max_iter=100_000)
    to_state = lasso.fit(np.hstack([state, action]), after).coef_
    to_reward = lasso.fit(np.hstack([after, action]), standardised[:, 24]).coef_
    np.testing.assert_allclose(np.hstack([graph.effect_state_to_state, graph.effect_action_to_state]), to_state, atol=1e-6)
    np.testing.assert_allclose(
        np.concatenate([graph.effect_state_to_reward, graph.effect_action_to_reward]), to_reward, atol=1e-6
    )


def test_without_standardize_it_is_the_lasso_on_the_variables_own_units():
    variables, rows, _ = linear_system(seed=0, n_rows=500)
    graph = Notears(sparsity=0.03, tolerance=1e-8, standardize=False)(moments_of(rows), variables)
    centred = rows - rows.mean(axis=0)
    raw = Lasso(alpha=0.03, fit_intercept=False, tol=1e-10, max_iter=100_000).fit(centred[:, :14], centred[:, 14:24]).coef_
    scale = rows.std(axis=0)
    expected = raw * scale[:14] / scale[14:24, None]
    np.testing.assert_allclose(np.hstack([graph.effect_state_to_state, graph.effect_action_to_state]), expected, atol=1e-6)


@pytest.mark.parametrize("n_rows", [2_000, 20_000])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_finds_the_edges_of_linear_systems(seed, n_rows):
    variables, rows, truth = linear_system(seed, n_rows)
    graph = Notears()(moments_of(rows), variables)
    for known, weights in (
        (truth, weights_of(graph)),
        (truth[2:], weights_of(graph)[2:]),
    ):
        labels = np.concatenate([block.ravel() for block in known])
        scores = np.abs(np.concatenate([block.ravel() for block in weights]))
        assert roc_auc_score(labels, scores) >= 0.95


def test_masks_of_strong_edges_are_near_one_and_of_missing_edges_near_zero():
    variables, rows, truth = linear_system(seed=0, n_rows=20_000)
    graph = Notears()(moments_of(rows), variables)
    assert graph.action_to_state[truth[1]].min() > 0.9
    assert graph.action_to_state[~truth[1]].max() < 0.2


def test_warm_start_gives_the_same_solution_in_fewer_iterations():
    gram, cross = random_problem(np.random.default_rng(0), 30, 20)
    cold = solve_lasso_gram(gram, cross, 0.1, tolerance=1e-9, max_iterations=100_000)
    near = solve_lasso_gram(gram, 1.001 * cross, 0.1, tolerance=1e-9, max_iterations=100_000)
    warm = solve_lasso_gram(gram, cross, 0.1, initial=near.weights, tolerance=1e-9, max_iterations=100_000)
    assert cold.converged and warm.converged
    assert warm.iterations < cold.iterations
    np.testing.assert_allclose(warm.weights, cold.weights, atol=1e-4)


def test_starting_from_the_solution_changes_nothing():
    variables, rows, _ = linear_system(seed=0, n_rows=500)
    moments = moments_of(rows)
    for standardize in (True, False):
        method = Notears(standardize=standardize)
        first = method(moments, variables)
        again = method(moments, variables, previous=first)
        np.testing.assert_allclose(
            np.concatenate([w.ravel() for w in weights_of(again)]),
            np.concatenate([w.ravel() for w in weights_of(first)]),
            atol=1e-12,
        )


def test_constant_columns_have_no_edge_and_give_no_warning():
    variables, rows, _ = linear_system(seed=0, n_rows=500, n_states=4, n_actions=2)
    rows[:, 1] = rows[:, 7] = 3.3
    rows[:, variables.reward] = 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        graph = Notears()(moments_of(rows), variables, previous=_all_weights_one(variables))
    assert graph.constant_variables == ("s1", "s1'", "reward")
    assert not graph.effect_state_to_state[1].any() and not graph.effect_state_to_state[:, 1].any()
    assert not graph.effect_action_to_state[1].any()
    assert not graph.effect_state_to_reward.any() and not graph.effect_action_to_reward.any()
    assert not graph.state_to_state[1].any() and not graph.state_to_reward.any()


def _all_weights_one(variables):
    graph = CausalGraph.fully_connected(variables)
    for weights in weights_of(graph):
        weights[...] = 1.0
    return graph


def test_duplicate_columns_do_no_harm():
    variables, rows, _ = linear_system(seed=0, n_rows=500, n_states=4, n_actions=2)
    rows[:, 1] = rows[:, 0]
    rows[:, 5] = -2.0 * rows[:, 4]
    with pytest.warns(UserWarning, match=r"almost determine these actions .*: a0 \(.*\), a1 \(") as caught:
        graph = Notears()(moments_of(rows), variables)
    assert len(caught) == 1
    assert all(np.isfinite(weights).all() for weights in weights_of(graph))


def test_warns_when_the_iterations_run_out():
    variables, rows, _ = linear_system(seed=0, n_rows=100)
    with pytest.warns(UserWarning, match="max_iterations=1 "):
        Notears(max_iterations=1)(moments_of(rows), variables)


def test_graph_says_how_it_was_found():
    variables, rows, _ = linear_system(seed=0, n_rows=100)
    graph = Notears()(moments_of(rows), variables)
    assert (graph.method, graph.n_samples, graph.num_timesteps, graph.constant_variables) == ("notears", 100, None, ())
    assert graph.found_at is not None


def test_too_few_rows_is_an_error_that_says_how_many():
    variables = make_variables(3, 2)
    with pytest.raises(ValueError, match=r"at least 7 rows .* got 6"):
        Notears()(moments_of(np.random.default_rng(0).normal(size=(6, 9))), variables)
    Notears()(moments_of(np.random.default_rng(0).normal(size=(7, 9))), variables)


def test_without_sparsity_it_is_least_squares():
    variables, rows, _ = linear_system(seed=0, n_rows=500)
    graph = Notears(sparsity=0.0)(moments_of(rows), variables)
    standardised = (rows - rows.mean(axis=0)) / rows.std(axis=0)
    expected = np.linalg.lstsq(standardised[:, :14], standardised[:, 14:24], rcond=None)[0].T
    np.testing.assert_allclose(graph.effects[:10], expected, atol=1e-8)
    residual = standardised[:, 14:24] - standardised[:, :14] @ expected.T
    np.testing.assert_allclose(graph.r_squared[:10], 1.0 - residual.var(axis=0), atol=1e-8)


def test_linearly_dependent_causes_share_a_mask():
    variables, rows, _ = linear_system(seed=0, n_rows=2_000, n_states=4, n_actions=2)
    rows[:, 1] = -3.0 * rows[:, 0]
    rows[:, 7] = -3.0 * rows[:, 6]
    graph = Notears()(moments_of(rows), variables)
    assert graph.duplicated_variables == (("s0", "s1"),)
    np.testing.assert_array_equal(graph.masks[:, 0], graph.masks[:, 1])
    np.testing.assert_array_equal(graph.effects[:, 0], -graph.effects[:, 1])
    assert graph.action_vif == pytest.approx([1.0, 1.0], abs=0.05)


@pytest.mark.parametrize("standardize", [True, False])
def test_standard_errors_are_the_spread_over_repetitions(standardize):
    effects, errors = [], []
    _, rows, _ = linear_system(seed=0, n_rows=8_000, n_states=4, n_actions=2)
    for seed in range(40):
        chosen = np.random.default_rng(seed).integers(0, len(rows), 2_000)
        moments = StreamingMoments(rows.shape[1], n_blocks=20)
        moments.update(rows[chosen])
        graph = Notears(sparsity=0.005, standardize=standardize)(moments, make_variables(4, 2))
        effects.append(graph.effects)
        errors.append(graph.standard_errors)
    steady = (np.stack(effects) != 0).all(axis=0)
    ratio = np.mean(errors, axis=0)[steady] / np.std(effects, axis=0)[steady]
    assert steady.sum() >= 8 and 0.8 < ratio.mean() < 1.2
    assert np.mean(errors, axis=0).min() > 0


def test_standard_errors_are_there_when_asked_for_or_with_a_window():
    variables, rows, _ = linear_system(seed=0, n_rows=500)
    assert discover("notears", rows, variables).standard_errors is None
    asked = discover("notears", rows, variables, standard_errors=True)
    method = Notears()
    statistics = make_statistics(method, variables, window=400)
    statistics.update(rows)
    for graph in (asked, method(statistics, variables)):
        assert graph.standard_errors.min() > 0.0
    np.testing.assert_allclose(asked.effects, discover("notears", rows, variables).effects, atol=1e-9)


@pytest.mark.parametrize("sparsity", [0.0, 0.05])
def test_standard_errors_are_about_those_of_actual_refits_without_each_block(sparsity):
    variables, rows, _ = linear_system(seed=0, n_rows=4096, n_states=4, n_actions=2)
    graph = discover("notears", rows, variables, sparsity=sparsity, standard_errors=True)
    parts = [
        discover("notears", np.delete(rows, np.arange(i, i + 512), axis=0), variables, sparsity=sparsity)
        for i in range(0, 4096, 512)
    ]
    effects = np.stack([part.effects for part in parts])
    expected = np.sqrt(((effects - effects.mean(axis=0)) ** 2).sum(axis=0) * 7 / 8)
    # One step keeps the signs: rows in which the L1 norm lets other edges in without some block are not compared
    steady = (np.sign(effects) == np.sign(graph.effects)).all(axis=(0, 2))
    compared = steady[:, None] & (graph.effects != 0.0)
    assert compared.sum() >= 4
    np.testing.assert_allclose(graph.standard_errors[compared], expected[compared], rtol=0.05)


def test_one_block_gives_no_standard_errors():
    variables, rows, _ = linear_system(seed=0, n_rows=100)
    assert Notears()(moments_of(rows), variables).standard_errors is None


def simultaneous_system(n_rows=5_000, seed=0):
    """s1' <- s0' at once, s2' <- s1' at once, each from itself one step before; a0 moves s0' alone."""
    rng = np.random.default_rng(seed)
    states, actions = rng.normal(size=(n_rows, 3)), rng.uniform(-1, 1, (n_rows, 1))
    noise = rng.normal(size=(n_rows, 3))
    first = 0.5 * states[:, 0] + actions[:, 0] + noise[:, 0]
    second = 0.5 * states[:, 1] + 0.9 * first + noise[:, 1]
    third = 0.5 * states[:, 2] - 0.9 * second + noise[:, 2]
    variables = make_variables(3, 1)
    return variables, variables.stack(states, actions, np.stack([first, second, third], axis=1), third)


def test_finds_edges_among_simultaneous_variables():
    variables, rows = simultaneous_system()
    method = Notears(standardize=False, instantaneous=True)
    graph = method(moments_of(rows), variables)
    scale = rows.std(axis=0)
    expected = np.array([[0, 0, 0], [0.9, 0, 0], [0, -0.9, 0]]) * scale[4:7] / scale[4:7, None]
    np.testing.assert_allclose(method.instantaneous_weights, expected, atol=0.05)
    # Over all paths: a0 reaches s2' through s0' and s1'
    assert graph.effects[2, 3] == pytest.approx(-0.81 * scale[3] / scale[6], abs=0.05)
    assert graph.effects[0, 1] == 0.0


@pytest.mark.parametrize("seed", range(3))
def test_edges_among_simultaneous_variables_have_no_cycle(seed):
    variables, rows, _ = linear_system(seed, n_rows=60, n_states=6, n_actions=2)
    rows[:, variables.next_state] += np.random.default_rng(seed).normal(size=(60, 1))
    method = Notears(instantaneous=True)
    method(moments_of(rows), variables)
    assert method.instantaneous_weights.any()
    assert is_acyclic(method.instantaneous_weights != 0)


def test_variables_of_very_different_units_do_no_harm():
    variables, rows = simultaneous_system(500)
    rows *= np.array([1.0, 1e-3, 1e3, 1.0, 1.0, 1e-3, 1e3, 1.0])
    method = Notears(sparsity=1e-4, standardize=False, instantaneous=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        graph = method(moments_of(rows), variables)
    assert np.isfinite(graph.effects).all() and is_acyclic(method.instantaneous_weights != 0)


def test_acyclicity_is_zero_without_cycles_alone_and_has_the_right_gradient():
    rng = np.random.default_rng(0)
    acyclic = np.tril(rng.normal(size=(5, 5)), -1)
    weights = rng.normal(size=(4, 4)) / 2
    assert acyclicity(acyclic)[0] == pytest.approx(0.0, abs=1e-12) and acyclicity(weights)[0] > 0.1
    assert is_acyclic(acyclic != 0) and not is_acyclic(weights != 0)
    step = 1e-6 * np.eye(16).reshape(16, 4, 4)
    numeric = [(acyclicity(weights + e)[0] - acyclicity(weights - e)[0]) / 2e-6 for e in step]
    np.testing.assert_allclose(acyclicity(weights)[1].ravel(), numeric, rtol=1e-5)


def test_weakest_edges_go_until_no_cycle_is_left():
    weights = np.array([[0.0, 0.5, 0.0], [0.3, 0.0, 0.0], [0.0, 0.01, 0.0]])
    np.testing.assert_array_equal(without_cycles(weights, 0.1), [[0, 0.5, 0], [0, 0, 0], [0, 0, 0]])


def test_pickled_method_finds_the_same_graph():
    variables, rows = simultaneous_system(500)
    moments = moments_of(rows)
    method = Notears(instantaneous=True)
    graph = method(moments, variables)
    copied = pickle.loads(pickle.dumps(method))
    np.testing.assert_array_equal(copied.instantaneous_weights, method.instantaneous_weights)
    np.testing.assert_array_equal(copied(moments, variables).effects, graph.effects)


def test_other_variables_are_an_error():
    variables = make_variables(3, 2)
    with pytest.raises(ValueError, match="moments must hold 9 variables, got 4"):
        Notears()(StreamingMoments(4), variables)
    moments = moments_of(np.random.default_rng(0).normal(size=(20, 9)))
    with pytest.raises(ValueError, match="previous"):
        Notears()(moments, variables, previous=CausalGraph.fully_connected(make_variables(2, 2)))


@pytest.mark.parametrize(
    "kwargs",
    [
        {"sparsity": -1.0},
        {"sparsity": "1e-3"},
        {"edge_threshold": np.nan},
        {"mask_scale": 0.0},
        {"max_iterations": 0},
        {"max_iterations": 1.5},
        {"tolerance": np.inf},
    ],
)
def test_bad_arguments_are_errors(kwargs):
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        Notears(**kwargs)


def test_make_discovery_takes_a_name_or_a_callable():
    method = make_discovery("notears", sparsity=0.5)
    assert isinstance(method, Notears) and method.sparsity == 0.5
    assert make_discovery(method) is method
    assert DISCOVERY_METHODS["notears"] is Notears


def test_make_discovery_names_what_it_does_not_know():
    with pytest.raises(ValueError, match=r"unknown discovery method 'nope', known are \[.*'notears'"):
        make_discovery("nope")
    with pytest.raises(ValueError, match=r"unknown arguments \['colour'\].*'sparsity'"):
        make_discovery("notears", colour=1)
    with pytest.raises(ValueError, match=r"callable .* \['sparsity'\]"):
        make_discovery(Notears(), sparsity=1)
