from dataclasses import replace

import numpy as np
import pytest

from sb3_causalgdp.causal import CausalGraph, TransitionVariables
from sb3_causalgdp.causal.trusted_components import TrustedComponents

VARIABLES = TransitionVariables(("x", "y", "z"), ("push",))


def graph_of(*edges, **changes):
    masks = np.eye(4, 4)
    masks[3] = [1.0, 0.0, 0.0, 0.0]
    for effect, cause in edges:
        masks[effect, cause] = 1.0
    graph = CausalGraph(VARIABLES, masks, np.zeros_like(masks), "by hand", 1_000)
    return replace(graph, **changes)


def groups(trusted):
    labels = trusted.components.labels
    return {frozenset(np.flatnonzero(labels == label).tolist()) for label in labels}


def test_two_graphs_in_a_row_are_needed_and_an_edge_in_either_binds():
    trusted = TrustedComponents(VARIABLES)
    assert trusted.update(graph_of((0, 3))) == "" and trusted.components is None
    trusted.update(graph_of((1, 2)))
    assert groups(trusted) == {frozenset({0, 3}), frozenset({1, 2})}
    assert trusted.components.read[trusted.components.labels].tolist() == [True, False, False, True]
    trusted.update(graph_of((1, 2)))
    assert groups(trusted) == {frozenset({0}), frozenset({3}), frozenset({1, 2})}


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"n_samples": 39}, "39 transitions are fewer than 40"),
        ({"detectable_r2": np.array([0.01, 0.06, 0.01, 0.01])}, "effects of a partial R.2 of 0.060 could be missed"),
        ({"constant_variables": ("reward",)}, "the reward has not varied"),
        ({"r_squared": np.array([0.9, 0.9, 0.9, 0.05])}, "only 0.05 of the reward's variance is explained"),
    ],
)
def test_what_cannot_be_trusted_exchanges_nothing(changes, why):
    trusted = TrustedComponents(VARIABLES)
    for _ in range(3):
        trusted.update(graph_of())
    assert trusted.components is not None
    import re

    assert re.fullmatch(why, trusted.update(graph_of(**changes)))
    assert trusted.components is None
    trusted.update(graph_of())
    assert trusted.components is None


def test_rewards_that_the_task_computes_need_not_have_varied():
    trusted = TrustedComponents(VARIABLES)
    changes = {"constant_variables": ("reward",), "detectable_r2": np.array([0.01, 0.01, 0.01, 1.0])}
    for _ in range(2):
        assert trusted.update(graph_of(**changes), reward_is_known=True) == ""
    assert trusted.components is not None


@pytest.mark.parametrize(
    "changes", [{"duplicated_variables": (("x'", "z'"),)}, {"state_vif": np.array([50.0, 1.0, 60.0])}], ids=["twins", "vif"]
)
def test_what_no_graph_can_tell_apart_is_bound_together(changes):
    trusted = TrustedComponents(VARIABLES)
    for _ in range(2):
        trusted.update(graph_of(**changes))
    assert groups(trusted) == {frozenset({0, 2}), frozenset({1}), frozenset({3})}


def test_copies_of_different_things_stay_apart():
    variables = TransitionVariables(("x", "copy of x", "y", "copy of y"), ("push",))
    masks = np.eye(5, 5)
    graph = CausalGraph(variables, masks, np.zeros_like(masks), "by hand", 1_000, state_vif=np.full(4, 1e7))
    copies = (("x'", "copy of x'"), ("y'", "copy of y'"))
    trusted = TrustedComponents(variables)
    for _ in range(2):
        trusted.update(replace(graph, duplicated_variables=copies))
    assert groups(trusted) == {frozenset({0, 1}), frozenset({2, 3}), frozenset({4})}


def test_states_that_end_episodes_are_bound_together():
    trusted = TrustedComponents(VARIABLES)
    for _ in range(2):
        trusted.update(graph_of(), np.array([True, True, False]))
    assert groups(trusted) == {frozenset({0, 1}), frozenset({2}), frozenset({3})}


def test_its_state_goes_on_and_a_wrong_one_is_refused():
    trusted, other = TrustedComponents(VARIABLES), TrustedComponents(VARIABLES)
    trusted.update(graph_of((0, 3)))
    other.load_state_dict(trusted.state_dict())
    for one in (trusted, other):
        one.update(graph_of())
    assert other.state_dict() == trusted.state_dict() and groups(other) == groups(trusted)
    with pytest.raises(ValueError, match="not that of trusted components"):
        other.load_state_dict({"components": None})
    with pytest.raises(ValueError, match="of 4 states and actions"):
        other.load_state_dict({"components": None, "last": {"labels": [0, 0, 5, 1], "read": [True, False]}})
