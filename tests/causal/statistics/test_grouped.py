import json
import pickle

import numpy as np
import pytest

from sb3_causalgdp.causal import CausalGraph, TransitionVariables, discover, make_discovery, make_statistics
from sb3_causalgdp.causal.plots.summary import summarize
from sb3_causalgdp.causal.statistics.basis import bytes_needed
from sb3_causalgdp.causal.statistics.grouped import GroupedStatistics, groups_that_fit

VARIABLES = TransitionVariables(tuple(f"s[{i}]" for i in range(40)), tuple(f"a[{i}]" for i in range(4)))
GROUPS_OF_FOUR = bytes_needed(10, 11, "linear")


def draw(n_rows, seed=0, units=1.0, n_groups=10):
    """Four neighbours move alike; each group but the first follows the one before it, the first the actions."""
    rng = np.random.default_rng(seed)
    causes, actions = rng.standard_normal((n_rows, n_groups)), rng.uniform(-1.0, 1.0, (n_rows, 4))
    after = np.column_stack([actions.sum(axis=1), causes[:, :-1]]) + 0.1 * rng.standard_normal((n_rows, n_groups))

    def members(groups):
        return np.repeat(groups, 4, axis=1) + 0.1 * rng.standard_normal((n_rows, 40))

    states, next_states = units * members(causes), units * members(after)
    states[:, 7] = next_states[:, 7] = 3.0
    return VARIABLES.stack(states, actions, next_states, after[:, 5] + 0.1 * rng.standard_normal(n_rows))


def test_groups_are_the_smallest_that_fit():
    for memory, size in ((GROUPS_OF_FOUR, 4), (GROUPS_OF_FOUR - 1, 5), (1e9, 1)):
        states, actions = groups_that_fit(VARIABLES, memory)
        assert states.tolist() == list(range(0, 40, size)) and actions.tolist() == list(range(0, 4, size))
    assert groups_that_fit(VARIABLES, bytes_needed(1, 2, "linear") - 1) is None
    with pytest.raises(ValueError, match="max_memory is too little for any discovery"):
        GroupedStatistics(VARIABLES, max_memory=10)


def test_edges_of_groups_are_those_of_their_members_and_the_graph_says_so():
    units = np.logspace(-3.0, 3.0, 40)
    graph = discover("partial_r2", draw(3_000, units=units), VARIABLES, max_memory=GROUPS_OF_FOUR)
    expected = np.zeros((41, 44))
    expected[:4, 40:] = 1.0
    for group in range(1, 10):
        expected[4 * group : 4 * group + 4, 4 * group - 4 : 4 * group] = 1.0
    expected[40, 20:24] = 1.0
    expected[7, :] = expected[:, 7] = 0.0
    np.testing.assert_array_equal(graph.masks > 0.5, expected > 0.5)
    assert (graph.effects[1, 40:] > 0.5).all() and graph.constant_variables == ("s[7]", "s[7]'")
    assert graph.r_squared.shape == (41,) and graph.action_vif.shape == (4,) and graph.n_samples == 3_000
    assert len(graph.remarks) == 1 and "each edge is that between two of 10 and 1 groups of neighbours" in graph.remarks[0]


def test_a_stream_in_batches_finds_the_same_and_survives_a_pickle():
    method = make_discovery("partial_r2", max_memory=GROUPS_OF_FOUR)
    rows, statistics = draw(3_000), make_statistics(method, VARIABLES)
    for part in np.split(rows, 30):
        statistics = pickle.loads(pickle.dumps(statistics))
        statistics.update(part)
    graph, whole = method(statistics, VARIABLES), discover("partial_r2", rows, VARIABLES, max_memory=GROUPS_OF_FOUR)
    np.testing.assert_array_equal(graph.masks > 0.5, whole.masks > 0.5)
    assert not statistics.wants_history and statistics.count == 3_000


def test_a_member_whose_unit_changes_is_weighed_anew_on_the_old_rows():
    units = np.where(np.arange(40) == 20, 1e-3, 1.0)
    method = make_discovery("partial_r2", max_memory=GROUPS_OF_FOUR)
    statistics = make_statistics(method, VARIABLES)
    first, then = draw(300, units=units), draw(3_000, seed=1)
    for rows in (first, then):
        statistics.update(rows)
    assert statistics.wants_history and statistics.n_samples == 3_300
    statistics.restart()
    for rows in (first, then):
        statistics.refill(rows)
    assert not statistics.wants_history and statistics.count == 3_300
    assert method(statistics, VARIABLES).masks[20, 16:20].min() > 0.5


def test_a_remark_is_saved_with_the_graph_and_older_files_have_none():
    graph = discover("partial_r2", draw(300), VARIABLES, max_memory=bytes_needed(40, 44, "additive") - 1)
    assert len(graph.remarks) == 1 and graph.remarks[0].endswith("found with basis='linear'")
    assert CausalGraph.from_json(graph.to_json()) == graph
    older = json.loads(graph.to_json())
    del older["remarks"]
    assert CausalGraph.from_json(json.dumps(older)).remarks == ()
    assert summarize(graph, max_variables=4)(graph).remarks == graph.remarks
    with pytest.raises(ValueError, match="remarks must be strings, got 'one'"):
        CausalGraph.from_json(json.dumps({**older, "remarks": "one"}))


@pytest.mark.parametrize(
    ("method", "kwargs", "forgetting", "kept"),
    [
        ("partial_r2", {}, {"window": 90}, 85),
        ("partial_r2", {}, {"half_life": 60.0}, 87),
        ("partial_r2", {"max_memory": bytes_needed(40, 44, "linear")}, {"window": 180}, 91),
        ("partial_r2", {}, {"window": 104, "half_life": 500.0}, 86),
        ("notears", {}, {"window": 45}, 43),
        ("world_model", {"window": 50}, {}, 50),
        ("direct_lingam", {}, {"window": 93}, 93),
        ("perturbed", {"method": "partial_r2"}, {"window": 90}, 85),
    ],
)
def test_rows_must_not_be_forgotten_before_there_are_enough(method, kwargs, forgetting, kept):
    with pytest.raises(ValueError, match=rf"window=.* and half_life=.* keep as few as {kept} rows, and discovery needs \d+ "):
        make_statistics(make_discovery(method, **kwargs), VARIABLES, **forgetting)


@pytest.mark.parametrize("forgetting", [{"window": 104}, {"half_life": 65.0}])
def test_what_is_not_forgotten_is_enough_at_every_moment(forgetting):
    method = make_discovery("partial_r2")
    statistics = make_statistics(method, VARIABLES, **forgetting)
    counts = []
    for row in draw(1_200)[:, None]:
        statistics.update(row)
        counts.append(statistics.count)
    assert min(counts[900:]) == pytest.approx(statistics.fewest_rows, rel=1e-3)
    assert statistics.fewest_rows >= method.min_rows(VARIABLES)


def test_rows_that_are_not_finite_name_the_variable():
    rows = draw(300)
    rows[2, 5] = np.nan
    statistics = GroupedStatistics(VARIABLES)
    with pytest.raises(ValueError, match=r"first bad row 2, bad variables \['s\[5\]'\]"):
        statistics.update(rows)
    assert statistics.n_samples == 0
