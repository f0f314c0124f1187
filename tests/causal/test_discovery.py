import warnings

import numpy as np
import pytest

from sb3_causalgdp.causal import (
    CausalGraph,
    StreamingMoments,
    TransitionVariables,
    discover,
    make_discovery,
    make_statistics,
    min_rows,
)

VARIABLES = TransitionVariables(("x", "y", "z"), ("push", "pull"))
METHODS = {
    "partial_r2": ({}, 14),
    "notears": ({}, 7),
    "world_model": ({"first_gradient_steps": 2}, 15),
    "direct_lingam": ({}, 18),
    "perturbed": ({"method": "partial_r2", "noise": 0.0}, 14),
}


@pytest.mark.parametrize("name", METHODS)
def test_a_method_says_how_many_rows_it_needs(name):
    kwargs, n_rows = METHODS[name]
    if name == "direct_lingam":
        pytest.importorskip("lingam")
    assert min_rows(make_discovery(name, **kwargs), VARIABLES) == n_rows
    rows = np.random.default_rng(0).standard_normal((n_rows, VARIABLES.n_variables))
    assert discover(name, rows, VARIABLES, **kwargs).n_samples == n_rows
    with pytest.raises(ValueError, match=rf"at least {n_rows} rows .*got {n_rows - 1}|at least {n_rows} rows, got"):
        discover(name, rows[:-1], VARIABLES, **kwargs)


def test_a_callable_that_does_not_say_needs_one_row():
    assert min_rows(lambda statistics, variables, previous=None: CausalGraph.fully_connected(variables), VARIABLES) == 1


def rows_that_cannot_be_told_apart():
    """Two states are multiples of each other, an action is constant."""
    rows = np.random.default_rng(0).standard_normal((200, VARIABLES.n_variables))
    rows[:, 1] = -2.0 * rows[:, 0]
    rows[:, 4] = 1.0
    return rows


@pytest.mark.parametrize("name", METHODS)
def test_a_graph_says_when_it_was_found_and_what_the_data_cannot_say(name):
    kwargs, _ = METHODS[name]
    if name == "direct_lingam":
        pytest.importorskip("lingam")
    graph = discover(name, rows_that_cannot_be_told_apart(), VARIABLES, **kwargs)
    assert graph.found_at.endswith("+00:00") and graph.constant_variables == ("pull",)
    assert graph.duplicated_variables == (("x", "y"),)
    np.testing.assert_array_equal(graph.masks[:, 0][:3], graph.masks[:, 1][:3])
    assert graph.action_vif.shape == (2,) and graph.action_vif[1] == 1.0


@pytest.mark.parametrize("name", METHODS)
def test_causes_that_cannot_be_told_apart_are_an_error_if_asked_for(name):
    kwargs, _ = METHODS[name]
    if name == "direct_lingam":
        pytest.importorskip("lingam")
    rows = np.random.default_rng(0).standard_normal((200, VARIABLES.n_variables))
    discover(name, rows, VARIABLES, **kwargs, on_degenerate="raise")
    rows = rows_that_cannot_be_told_apart()
    with pytest.raises(ValueError, match=r"constant \['pull'\], linearly dependent \[\['x', 'y'\]\]"):
        discover(name, rows, VARIABLES, **kwargs, on_degenerate="raise")
    with pytest.raises(ValueError, match="on_degenerate must be 'share' or 'raise', got 'ignore'"):
        make_discovery(name, **kwargs, on_degenerate="ignore")


@pytest.mark.parametrize("name", METHODS)
def test_an_action_that_the_states_determine_is_warned_of_once(name):
    kwargs, _ = METHODS[name]
    if name == "direct_lingam":
        pytest.importorskip("lingam")
    rows = np.random.default_rng(0).standard_normal((200, VARIABLES.n_variables))
    rows[:, 3] = rows[:, 0] - 0.5 * rows[:, 1] + 0.05 * rows[:, 3]
    method = make_discovery(name, **kwargs)
    statistics = make_statistics(method, VARIABLES)
    statistics.update(rows)
    with pytest.warns(UserWarning, match=r"almost determine these actions \(variance inflation over 40\): push \(\d"):
        method(statistics, VARIABLES)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert method(statistics, VARIABLES).action_vif[0] > 40.0


@pytest.mark.parametrize("name", ["notears", "partial_r2"])
def test_rows_that_are_forgotten_do_not_count(name):
    method = make_discovery(name)
    with pytest.raises(ValueError, match=r"half_life=3\.0 keep as few as \d rows"):
        make_statistics(method, VARIABLES, half_life=3.0)
    # Statistics that somebody else made are looked at when they are read
    made_by = getattr(method, "make_statistics", None)
    if made_by is None:
        statistics = StreamingMoments(VARIABLES.n_variables, 3.0, VARIABLES.names)
    else:
        statistics = made_by(VARIABLES, 3.0, None)
    for row in np.random.default_rng(0).standard_normal((100, 1, VARIABLES.n_variables)):
        statistics.update(row)
    with pytest.raises(ValueError, match=r"at least \d+ rows .* that are not forgotten, got 5"):
        method(statistics, VARIABLES)
