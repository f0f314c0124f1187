import itertools
import json
import re

import numpy as np
import pytest

from sb3_causalgdp.causal import CausalGraph, RelevanceGate, TransitionVariables, discover
from sb3_causalgdp.causal.__main__ import relevance_summary

VARIABLES = TransitionVariables(("position", "velocity", "noise", "echo"), ("force", "lamp"))


def make_graph(edges, variables=VARIABLES, **changes):
    """From (cause, effect): probability, effects without a prime."""
    columns = {name: i for i, name in enumerate((*variables.state_names, *variables.action_names))}
    rows = {name: j for j, name in enumerate((*variables.state_names, "reward"))}
    masks = np.zeros((len(rows), len(columns)))
    for (cause, effect), value in edges.items():
        masks[rows[effect], columns[cause]] = value
    content = {"method": "by hand", "n_samples": 1_000, "r_squared": np.full(len(rows), 0.9)}
    return CausalGraph(variables, masks, np.zeros_like(masks), **(content | changes))


CHAIN = {
    ("force", "velocity"): 0.9,
    ("velocity", "position"): 0.8,
    ("position", "reward"): 0.7,
    ("position", "position"): 1.0,
    ("noise", "noise"): 1.0,
    ("velocity", "echo"): 1.0,
    ("lamp", "echo"): 1.0,
}


def test_relevance_is_the_product_along_the_surest_path():
    relevance = make_graph(CHAIN).relevance()
    np.testing.assert_allclose(relevance.states, [0.7, 0.56, 0.0, 0.0])
    np.testing.assert_allclose(relevance.actions, [0.504, 0.0])
    assert relevance.state_paths == (("position", "reward"), ("velocity", "position", "reward"), (), ())
    assert relevance.action_paths[0] == ("force", "velocity", "position", "reward") and relevance.action_paths[1] == ()
    assert relevance.state_lengths.tolist() == [1, 2, 0, 0] and relevance.action_lengths.tolist() == [3, 0]


def test_a_surer_path_may_be_longer_than_the_shortest():
    edges = CHAIN | {("velocity", "reward"): 0.51, ("force", "reward"): 0.1}
    relevance = make_graph(edges).relevance()
    assert relevance.states[1] == pytest.approx(0.56) and relevance.state_lengths[1] == 1
    assert relevance.state_paths[1] == ("velocity", "position", "reward")
    assert relevance.actions[0] == pytest.approx(0.504) and relevance.action_lengths[0] == 2


def brute_force(graph, start):
    """Over all simple paths from a state to the reward."""
    n_states = graph.variables.n_states
    best = graph.state_to_reward[start]
    others = [i for i in range(n_states) if i != start]
    for length in range(1, n_states):
        for nodes in itertools.permutations(others, length):
            way = (start, *nodes)
            edges = [graph.state_to_state[after, before] for before, after in itertools.pairwise(way)]
            best = max(best, np.prod(edges) * graph.state_to_reward[way[-1]])
    return best


@pytest.mark.parametrize("seed", range(5))
def test_relevance_is_that_of_all_paths_and_bounds_the_chance_of_any(seed):
    rng = np.random.default_rng(seed)
    masks = rng.random((5, 6)) ** 3 * (rng.random((5, 6)) < 0.6)
    masks[0, 0] = masks[1, 2] = 1.0
    graph = CausalGraph(VARIABLES, masks, np.zeros_like(masks), "by hand", 10)
    relevance = graph.relevance()
    np.testing.assert_allclose(relevance.states, [brute_force(graph, i) for i in range(4)])
    draws = rng.random((4_000, 5, 6)) < masks
    reached = draws[:, 4].copy()
    for _ in range(5):
        reached |= np.einsum("kji,kj->ki", draws[:, :4], reached[:, :4])
    # The chance that there is any path lies between the two
    chances = reached.mean(axis=0)
    lower, upper = (
        np.concatenate(parts)
        for parts in ((relevance.states, relevance.actions), (relevance.states_upper, relevance.actions_upper))
    )
    assert (lower <= chances + 0.03).all() and (chances <= upper + 0.03).all()
    # and the bound is one, not just 1
    assert (upper < 0.999).any()


def test_evidence_counts_where_a_method_has_it():
    evidence = np.zeros((5, 6))
    evidence[4, 2] = 1.0
    relevance = make_graph(CHAIN, evidence=evidence).relevance()
    assert relevance.states.tolist() == [0.0, 0.0, 1.0, 0.0]


def test_the_data_frame_has_the_variables_in_their_order():
    frame = make_graph(CHAIN).relevance().to_dataframe()
    assert frame["variable"].tolist() == [*VARIABLES.state_names, *VARIABLES.action_names]
    assert frame["kind"].tolist() == ["state"] * 4 + ["action"] * 2
    assert frame["path"][4] == "force -> velocity -> position -> reward"
    assert frame["relevance"][1] == pytest.approx(0.56) and frame["length"][1] == 2


def test_the_command_line_shows_relevance_with_its_assumption():
    text = relevance_summary(make_graph(CHAIN))
    assert "0.70  position  position -> reward" in text and "0.00     noise  -" in text and "whole state" in text


# Evidence ------------------------------------------------------------------------------------------------------------------


def distracted_rows(n_rows, rng, n_noises=8, coefficient=0.9, weak=0.08):
    """A state that the reward reads, a weak cause of it, autoregressive noises, an action that matters and an idle one."""
    n_states = 2 + n_noises
    states = np.zeros((n_rows + 1, n_states))
    actions = rng.uniform(-1, 1, (n_rows, 2))
    for t in range(n_rows):
        noise = rng.normal(size=n_states)
        states[t + 1] = coefficient * states[t] + np.sqrt(1 - coefficient**2) * noise
        states[t + 1, 0] = 0.5 * states[t, 0] + weak * states[t, 1] + 0.5 * actions[t, 0] + 0.5 * noise[0]
    rewards = states[1:, 0] + 0.1 * rng.normal(size=n_rows)
    variables = TransitionVariables(("x", "weak", *(f"noise[{i}]" for i in range(n_noises))), ("force", "idle"))
    return variables.stack(states[:-1], actions, states[1:], rewards), variables


def test_evidence_finds_weak_causes_that_masks_do_not_call_edges():
    rows, variables = distracted_rows(20_000, np.random.default_rng(0))
    graph = discover("partial_r2", rows, variables)
    assert graph.masks[0, 1] < 0.5 < 0.99 < graph.evidence[0, 1]
    assert graph.evidence[[0, -1], 2:10].max() < 0.05
    assert graph.relevance().states[1] > 0.99


def test_evidence_of_autocorrelated_noise_is_rarely_above_one_half():
    above = 0
    for seed in range(10):
        rows, variables = distracted_rows(2_000, np.random.default_rng(seed), coefficient=0.98)
        evidence = discover("partial_r2", rows, variables).evidence
        null = np.ones_like(evidence, dtype=bool)
        null[range(10), range(10)] = False
        null[0, [0, 1, 10]] = null[-1, 0] = False
        above += int((evidence[null] > 0.5).sum())
    assert above <= 2


def test_what_could_have_been_seen_shrinks_with_the_rows():
    rows, variables = distracted_rows(8_000, np.random.default_rng(0))
    few, many = (discover("partial_r2", rows[:n], variables).detectable_r2 for n in (1_000, 8_000))
    assert (many < 0.25 * few).all() and few[0] < 0.1


def test_an_effect_of_the_detectable_size_is_found_in_about_four_of_five_samples():
    rows, variables = distracted_rows(1_500, np.random.default_rng(0), n_noises=2)
    detectable = discover("partial_r2", rows, variables).detectable_r2[0]
    weak = 0.5 * np.sqrt(detectable / (1.0 - detectable))
    found = 0
    for seed in range(40):
        rows, _ = distracted_rows(1_500, np.random.default_rng(seed), n_noises=2, weak=weak)
        found += discover("partial_r2", rows, variables).evidence[0, 1] > 0.5
    assert detectable < 0.03 and 24 <= found <= 39


# The gate ------------------------------------------------------------------------------------------------------------------


def graphs_until(n_rows, every=1_000, **kwargs):
    rows, variables = distracted_rows(n_rows, np.random.default_rng(3), **kwargs)
    return [discover("partial_r2", rows[:n], variables) for n in range(every, n_rows + 1, every)], variables


def test_noise_and_idle_actions_are_closed_and_nothing_else():
    graphs, variables = graphs_until(4_000, weak=0.3)
    gate = RelevanceGate(variables)
    verdicts = [gate.update(graph) for graph in graphs]
    assert gate.states.tolist() == [True, True] + [False] * 8 and gate.actions.tolist() == [True, False]
    assert len(verdicts[1].closed) == 9 and verdicts[0].closed == () and verdicts[-1].withheld == ""


SURE = {("force", "position"): 1.0, ("position", "reward"): 1.0, ("velocity", "position"): 1.0}


def test_closing_needs_several_graphs_in_a_row_and_opening_one():
    gate = RelevanceGate(VARIABLES, patience=3)
    low, middle = make_graph(SURE), make_graph(SURE | {("noise", "position"): 0.3})
    high = make_graph(SURE | {("noise", "position"): 0.9})
    for graph in (low, low, middle, low, low):
        gate.update(graph)
    assert gate.states[2]
    assert "noise" in gate.update(low).closed and not gate.states[2]
    gate.update(middle)
    assert not gate.states[2]
    assert gate.update(high).opened == ("noise",) and gate.states[2]


@pytest.mark.parametrize(
    "changes, reason",
    [
        ({"constant_variables": ("reward",)}, "has not varied"),
        ({"r_squared": np.array([0.9, 0.9, 0.9, 0.9, 0.02])}, "only 0.02 of the reward's variance"),
        ({"n_samples": 50}, "50 transitions are fewer than 60"),
        ({"detectable_r2": np.array([0.2, 0.2, 0.01, 0.01, 0.01])}, "partial R\\^2 of 0.2"),
        ({"detectable_r2": np.array([0.01, 0.01, 0.01, 0.01, 0.2])}, "partial R\\^2 of 0.2"),
    ],
)
def test_nothing_is_closed_by_a_graph_that_says_too_little(changes, reason):
    gate = RelevanceGate(VARIABLES, patience=1)
    verdict = gate.update(make_graph(SURE, **changes))
    assert gate.states.all() and gate.actions.all()
    assert re.search(reason, verdict.withheld)
    # The same without the change closes
    assert gate.update(make_graph(SURE)).closed


def test_a_sparse_reward_that_never_came_closes_nothing():
    rows, variables = distracted_rows(4_000, np.random.default_rng(0))
    rows[:, -1] = 0.0
    gate = RelevanceGate(variables, patience=1)
    verdict = gate.update(discover("partial_r2", rows, variables))
    assert verdict.withheld == "the reward has not varied" and gate.states.all() and gate.actions.all()


def test_no_action_that_matters_is_a_graph_that_is_not_finished():
    edges = {("position", "reward"): 1.0, ("force", "position"): 0.2}
    gate = RelevanceGate(VARIABLES, patience=1)
    assert gate.update(make_graph(edges)).withheld == "no action is known to matter for the reward"
    assert gate.states.all()


@pytest.mark.parametrize(
    "changes",
    [
        {"state_vif": np.array([1.0, 1.0, 100.0, 1.0])},
        {"duplicated_variables": (("noise", "echo"),)},
        {"duplicated_variables": (("noise'", "echo'"),)},
        {"constant_variables": ("noise",)},
    ],
)
def test_variables_that_cannot_be_told_apart_are_not_closed(changes):
    gate = RelevanceGate(VARIABLES, patience=1)
    gate.update(make_graph(SURE, **changes))
    assert gate.states[2]
    gate.update(make_graph(SURE))
    assert not gate.states[2]


def test_a_confounded_action_is_not_closed():
    gate = RelevanceGate(VARIABLES, patience=1)
    gate.update(make_graph(SURE, action_vif=np.array([1.0, 100.0])))
    assert gate.actions[1]
    gate.update(make_graph(SURE, action_vif=np.array([1.0, 2.0])))
    assert not gate.actions[1]


def test_goals_that_were_not_reached_are_kept_open():
    gate = RelevanceGate(VARIABLES, patience=1)
    gate.update(make_graph(SURE), keep_open=("noise", "lamp"))
    assert gate.states[2] and gate.actions[1] and not gate.states[3]
    gate.update(make_graph(SURE))
    assert not gate.states[2] and not gate.actions[1]
    assert gate.update(make_graph(SURE), keep_open=("noise",)).opened == ("noise",)


def test_a_gate_goes_on_from_its_json():
    graphs = [make_graph(SURE)] * 3
    gate = RelevanceGate(VARIABLES, patience=3, low=0.1)
    gate.update(graphs[0])
    gate.update(graphs[1])
    again = RelevanceGate.from_json(gate.to_json())
    assert again.state_dict() == gate.state_dict() and again.low == 0.1
    assert again.update(graphs[2]).closed == gate.update(graphs[2]).closed == ("noise", "echo", "lamp")


@pytest.mark.parametrize(
    "change",
    [{"open": [True]}, {"n_low": [0, 0, 0, 0, 0, -1]}, {"low": 2.0}, {"patience": "x"}, {"unknown": 1}, {"open": None}],
)
def test_what_is_no_state_of_a_gate_is_refused(change):
    state = json.loads(RelevanceGate(VARIABLES).to_json()) | change
    with pytest.raises(ValueError, match="state is not that of a relevance gate"):
        RelevanceGate.from_json(json.dumps(state))
    with pytest.raises(ValueError, match="holds a list"):
        RelevanceGate.from_json("[1]")


@pytest.mark.parametrize("arguments", [{"low": 0.6}, {"patience": 0}, {"detectable": 0.0}, {"known": -1.0}, {"high": 1.5}])
def test_bounds_out_of_range_are_refused(arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        RelevanceGate(VARIABLES, **arguments)


def test_other_variables_and_unknown_names_are_refused():
    gate = RelevanceGate(VARIABLES)
    with pytest.raises(ValueError, match="keep_open must be names"):
        gate.update(make_graph(SURE), keep_open=("goal",))
    with pytest.raises(ValueError, match="graph must be over the variables"):
        gate.update(CausalGraph.fully_connected(TransitionVariables(("x",), ("u",))))


def test_evidence_is_kept_in_files_and_missing_in_older_ones():
    graph = make_graph(CHAIN, evidence=np.full((5, 6), 0.25), detectable_r2=np.full(5, 0.1), state_vif=np.ones(4))
    assert CausalGraph.from_json(graph.to_json()) == graph
    content = json.loads(graph.to_json())
    for name in ("evidence", "detectable_r2", "state_vif"):
        del content[name]
    assert CausalGraph.from_json(json.dumps(content)).evidence is None
    with pytest.raises(ValueError, match="evidence must lie in"):
        make_graph(CHAIN, evidence=np.full((5, 6), 1.5))
