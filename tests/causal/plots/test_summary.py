from dataclasses import replace

import numpy as np
import pytest

from sb3_causalgdp.causal import CausalGraph, TransitionVariables
from sb3_causalgdp.causal.plots.grouping import MAX_GROUPS
from sb3_causalgdp.causal.plots.summary import summarize

VARIABLES = TransitionVariables(("arm[0]", "arm[1]", "leg[0]"), ("force",))
MASKS = np.array([[0.8, 0.4, 0.0, 0.1], [0.2, 0.6, 0.0, 0.3], [0.0, 0.0, 1.0, 0.0], [0.0, 0.5, 0.0, 0.9]])
EFFECTS = np.array([[-0.8, 0.4, 0.0, -0.1], [0.2, 0.6, 0.0, 0.3], [0.0, 0.0, 1.0, 0.0], [0.0, 0.5, 0.0, -0.9]])


def make_graph(**changes):
    return replace(CausalGraph(VARIABLES, MASKS, EFFECTS, "by hand", 12, np.full((4, 4), 0.1), num_timesteps=70), **changes)


def make_large(n_states=348, n_actions=17):
    states, actions = tuple(f"obs[{i}]" for i in range(n_states)), tuple(f"action[{i}]" for i in range(n_actions))
    return CausalGraph.fully_connected(TransitionVariables(states, actions))


def test_small_graphs_stay_as_they_are():
    summary = summarize(make_graph())
    assert summary(make_graph()) == make_graph()
    assert summary.remark == "" and not summary.is_grouped


@pytest.mark.parametrize(
    ("aggregate", "masks", "effects"),
    [
        (
            "mean",
            [[0.5, 0.0, 0.2], [0.0, 1.0, 0.0], [0.25, 0.0, 0.9]],
            [[0.2, 0.0, 0.015], [0.0, 0.8, 0.0], [0.075, 0.0, 0.63]],
        ),
        ("max", [[0.8, 0.0, 0.3], [0.0, 1.0, 0.0], [0.5, 0.0, 0.9]], [[0.48, 0.0, 0.03], [0.0, 0.8, 0.0], [0.15, 0.0, 0.63]]),
    ],
)
def test_groups_have_the_mean_or_the_largest_of_their_masks_and_of_what_is_sure_of_their_effects(aggregate, masks, effects):
    summary = summarize(make_graph(), groups={"arm[0]": "arm", "arm[1]": "arm"}, aggregate=aggregate)
    small = summary(make_graph())
    assert small.variables == TransitionVariables(("arm", "leg[0]"), ("force",))
    np.testing.assert_allclose(small.masks, masks)
    np.testing.assert_allclose(small.effects, effects)
    assert small.standard_errors is None and small.num_timesteps == 70
    assert summary.is_grouped and summary.remark == f"{aggregate} over groups of 3 states and 1 actions"


def test_members_of_a_group_need_not_be_neighbours():
    small = summarize(make_graph(), groups={"arm[0]": "ends", "leg[0]": "ends"})(make_graph())
    assert small.variables.state_names == ("ends", "arm[1]")
    assert small.state_to_state[0, 0] == pytest.approx((0.8 + 0.0 + 0.0 + 1.0) / 4)


def test_names_make_groups_on_demand():
    assert summarize(make_graph(), groups="names").variables == VARIABLES  # few enough to stay alone
    names = summarize(make_large(30, 2), groups="names").variables
    assert names.state_names[:2] == ("obs[0..1]", "obs[2..3]") and names.action_names == ("action[0]", "action[1]")


def test_large_graphs_are_grouped_in_ranges_of_a_round_size():
    summary = summarize(make_large())
    states = summary.variables.state_names
    assert len(states) <= MAX_GROUPS
    assert states[0] == "obs[0..19]" and states[-1] == "obs[340..347]"
    assert len(summary.variables.action_names) == 17
    assert sorted(column for group in summary.members for column in group) == list(range(365))
    assert (summary(make_large()).masks == 1.0).all()


def test_ranges_do_not_cross_a_change_of_stem():
    names = (*(f"left_{i}" for i in range(25)), *(f"right_{i}" for i in range(25)))
    graph = CausalGraph.fully_connected(TransitionVariables(names, ("force",)))
    assert summarize(graph).variables.state_names == tuple(
        f"{side}_{i}..{i + 4}" for side in ("left", "right") for i in range(0, 25, 5)
    )


def test_names_without_numbers_are_grouped_by_their_ends():
    names = tuple(f"{a}{b}" for a in "abcdefg" for b in "uvwxyz")
    graph = CausalGraph.fully_connected(TransitionVariables(names, ("force",)))
    assert summarize(graph).variables.state_names[0] == "au..ay"


def test_neighbours_that_begin_with_the_same_words_are_one_group_and_the_largest_are_split_first():
    joints = ("hip", "knee")
    names = [
        *(f"{joint}_{leg}" for leg in range(4) for joint in joints),
        *(f"vel {joint}_{leg}" for leg in range(4) for joint in joints),
    ]
    names += [f"force {body}[{i}]" for body in range(30) for i in range(6)]
    graph = CausalGraph.fully_connected(TransitionVariables(tuple(names), ("torque",)))
    shown = summarize(graph).variables.state_names
    assert shown == (*names[:16], "180 force")


def test_groups_that_begin_alike_have_names_of_their_own():
    names = tuple(
        f"{side} {joint} {axis}" for joint in ("hip", "arm") for side in ("left", "right") for axis in "abcdefghijklmnopqr"
    )
    shown = summarize(CausalGraph.fully_connected(TransitionVariables(names, ("torque",)))).variables.state_names
    assert shown == ("18 left hip", "18 right hip", "18 left arm", "18 right arm")
    crossed = tuple(f"{side} x{i}y" for i in range(30) for side in ("left", "right"))
    assert (
        len(set(summarize(CausalGraph.fully_connected(TransitionVariables(crossed, ("torque",)))).variables.state_names)) <= 20
    )


def test_sections_are_consecutive_states():
    sections = {"skipped_qpos": 1, "position": 2, "velocity": 1, "tendons": 0}
    summary = summarize(make_graph(), groups=sections)
    assert summary.variables == TransitionVariables(("position", "velocity"), ("force",))
    assert summary.members == ((0, 1), (2,), (3,))


def test_most_connected_variables_keep_signs_and_standard_errors():
    graph = make_graph()
    summary = summarize(graph, max_variables=3, groups=None)
    small = summary(graph)
    assert small.variables == TransitionVariables(("arm[0]", "arm[1]"), ("force",))
    kept = np.ix_([0, 1, 3], [0, 1, 3])
    np.testing.assert_array_equal(small.effects, EFFECTS[kept])
    np.testing.assert_array_equal(small.standard_errors, np.full((3, 3), 0.1))
    assert summary.remark == "the 3 states and actions with the largest total mask, of 4"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"max_variables": 1}, "max_variables must be at least 2, got 1"),
        ({"aggregate": "sum"}, "aggregate must be one of .*, got 'sum'"),
        ({"groups": "colour"}, "groups must be .*, got 'colour'"),
        ({"groups": {"wing": "arm"}}, r"groups must map names of states and actions, got \['wing'\]"),
        ({"groups": {"arm[0]": "all", "force": "all"}}, "groups must not mix states and actions, 'all' does"),
        ({"groups": {"position": 2}}, "sections in groups must have 3 states in all"),
        ({"groups": {"position": 4, "velocity": -1}}, "groups must map names to groups, or sections"),
        ({"groups": {"arm[0]": "arm", "velocity": 1}}, "groups must map names to groups, or sections"),
    ],
)
def test_bad_arguments_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        summarize(make_graph(), **arguments)
