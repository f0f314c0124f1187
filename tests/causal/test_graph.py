import json
import sys
from dataclasses import replace

import numpy as np
import pytest

from sb3_causalgdp.causal import CausalGraph, TransitionVariables
from sb3_causalgdp.causal.graph import GraphDiff

VARIABLES = TransitionVariables(("x", "y"), ("force",))
MASKS = [[0.9, 0.0, 0.0], [0.5, 1.0, 0.1], [0.0, 0.7, 0.3]]
EFFECTS = [[1 / 3, 0.001, 0.0], [-0.2, 2.0, 0.05], [0.0, -0.4, 0.1]]
ERRORS = [[0.01, 0.02, 0.03], [0.04, 0.05, 0.06], [0.07, 0.08, 0.09]]
NO_EDGE = np.zeros((3, 3))


def make_graph(**changes):
    content = {"masks": MASKS, "effects": EFFECTS, "method": "by hand", "n_samples": 12, "constant_variables": ("x",)}
    return CausalGraph(VARIABLES, **(content | changes))


def make_full_graph():
    return make_graph(
        standard_errors=ERRORS,
        r_squared=[0.5, 1.0, -0.1],
        action_vif=[1.25],
        duplicated_variables=(("x", "y"), ("x", "y", "force")),
        num_timesteps=5000,
        found_at="2024-01-01T00:00:00+00:00",
    )


def names_of(edges):
    return [(edge.cause, edge.effect) for edge in edges]


def test_blocks_are_parts_of_the_matrices():
    graph = make_full_graph()
    for prefix, matrix in (("", MASKS), ("effect_", EFFECTS), ("se_", ERRORS)):
        whole = np.block(
            [
                [getattr(graph, f"{prefix}state_to_state"), getattr(graph, f"{prefix}action_to_state")],
                [getattr(graph, f"{prefix}state_to_reward"), getattr(graph, f"{prefix}action_to_reward")],
            ]
        )
        np.testing.assert_array_equal(whole, matrix)
    assert graph.action_to_state.shape == (2, 1) and graph.action_to_reward.shape == (1,)


@pytest.mark.parametrize("block", ["state_to_state", "action_to_state", "state_to_reward", "action_to_reward"])
def test_unknown_standard_errors_are_an_error(block):
    with pytest.raises(ValueError, match="the method 'by hand' knows no standard errors"):
        getattr(make_graph(), f"se_{block}")


def test_edges_have_names_masks_strengths_and_standard_errors():
    graph = make_full_graph()
    assert graph.n_edges == len(graph.edges()) == 3
    assert graph.expected_edges == pytest.approx(3.5)
    assert graph.edges(0.0) == [
        ("x", "x'", 0.9, 1 / 3, 0.01),
        ("x", "y'", 0.5, -0.2, 0.04),
        ("y", "y'", 1.0, 2.0, 0.05),
        ("force", "y'", 0.1, 0.05, 0.06),
        ("y'", "reward", 0.7, -0.4, 0.08),
        ("force", "reward", 0.3, 0.1, 0.09),
    ]
    assert graph.edges() == [edge for edge in graph.edges(0.0) if edge.mask > 0.5]
    assert all(np.isnan(edge.standard_error) for edge in make_graph().edges())


def test_networkx_graph_has_layers_and_open_edges_only():
    network = make_graph().to_networkx(threshold=0.0)
    assert dict(network.nodes(data="layer")) == {"x": 0, "y": 0, "force": 0, "x'": 1, "y'": 1, "reward": 2}
    assert network.number_of_edges() == 6
    assert network.edges["x", "y'"] == {"mask": 0.5, "strength": -0.2}
    assert make_graph().to_networkx().number_of_edges() == make_graph().n_edges == 3
    assert not network.has_edge("y", "x'")


def test_dataframe_has_a_row_for_each_candidate():
    pd = pytest.importorskip("pandas")
    graph = make_full_graph()
    frame = graph.to_dataframe()
    assert list(frame.columns) == ["cause", "effect", "mask", "strength", "standard_error"]
    for column, matrix in (("mask", MASKS), ("strength", EFFECTS), ("standard_error", ERRORS)):
        np.testing.assert_array_equal(frame[column].to_numpy().reshape(3, 3), matrix)
    assert frame.loc[1, ["cause", "effect"]].tolist() == ["y", "x'"]
    assert frame.loc[7, ["cause", "effect"]].tolist() == ["y'", "reward"]
    assert make_graph().to_dataframe()["standard_error"].isna().all()
    assert isinstance(frame, pd.DataFrame)


def test_json_round_trip_is_equal():
    graph = make_full_graph()
    again = CausalGraph.from_json(graph.to_json())
    assert again == graph
    np.testing.assert_array_equal(again.r_squared, [0.5, 1.0, -0.1])
    np.testing.assert_array_equal(again.action_vif, [1.25])
    np.testing.assert_array_equal(again.standard_errors, ERRORS)
    assert again.duplicated_variables == (("x", "y"), ("x", "y", "force"))
    assert CausalGraph.from_json(make_graph().to_json()) == make_graph()


def test_numpy_counts_can_be_written():
    graph = make_graph(n_samples=np.int64(3), num_timesteps=np.int32(7))
    assert CausalGraph.from_json(graph.to_json()) == graph


def test_save_and_load_are_equal_and_leave_no_other_file(tmp_path):
    graph = make_graph()
    path = tmp_path / "folder" / "graph.json"
    CausalGraph.fully_connected(VARIABLES).save(path)
    graph.save(path)
    assert CausalGraph.load(path) == graph
    assert list(path.parent.iterdir()) == [path]


def test_failed_save_keeps_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "graph.json"
    make_graph().save(path)
    monkeypatch.setattr("os.replace", lambda *_: (_ for _ in ()).throw(OSError("disk")))
    with pytest.raises(OSError, match="disk"):
        CausalGraph.fully_connected(VARIABLES).save(path)
    assert CausalGraph.load(path) == make_graph()
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "changes",
    [
        {"variables": TransitionVariables(("x", "y"), ("torque",)), "duplicated_variables": ()},
        {"masks": np.ones((3, 3))},
        {"effects": np.ones((3, 3))},
        {"method": "other"},
        {"n_samples": 13},
        {"standard_errors": None},
        {"standard_errors": np.ones((3, 3))},
        {"r_squared": None},
        {"r_squared": [0.0, 0.0, 0.0]},
        {"action_vif": None},
        {"constant_variables": ()},
        {"duplicated_variables": (("x", "y"),)},
        {"num_timesteps": None},
        {"found_at": None},
    ],
)
def test_equality_sees_every_field(changes):
    graph = make_full_graph()
    assert graph == make_full_graph()
    assert graph != replace(graph, **changes)
    assert replace(graph, **changes) != graph
    assert graph != "graph"


def test_change_since_goes_from_none_to_all():
    full = CausalGraph.fully_connected(VARIABLES)
    empty = replace(full, masks=NO_EDGE)
    assert full.change_since(full) == 0.0
    assert full.change_since(empty) == 1.0
    assert make_graph().change_since(empty) == pytest.approx((0.9 + 0.5 + 1.0 + 0.1 + 0.7 + 0.3) / 9)
    assert empty.n_edges == 0 and empty.edges() == []


def test_diff_sorts_the_edges_by_what_happened_to_them():
    before = make_graph(masks=np.full((3, 3), 0.9), effects=np.full((3, 3), 0.5))
    before.masks[0] = 0.2
    now = make_graph(masks=np.full((3, 3), 0.8), effects=np.full((3, 3), 0.5))
    now.masks[2] = 0.4
    now.effects[:2] = [[0.9, 0.9, 0.9], [0.7, -0.7, 0.3]]
    diff = now.diff(before)
    assert names_of(diff.opened) == [("x", "x'"), ("y", "x'"), ("force", "x'")]
    assert names_of(diff.closed) == [("x'", "reward"), ("y'", "reward"), ("force", "reward")]
    assert names_of(diff.strengthened) == [("x", "y'")]
    assert names_of(diff.flipped) == [("y", "y'")]
    assert names_of(diff.weakened) == [("force", "y'")]
    assert diff.opened[0].mask == 0.8 and diff.closed[0].mask == 0.9
    assert names_of(before.diff(now).opened) == names_of(diff.closed)


def test_diff_has_a_threshold_on_masks_and_one_on_effects():
    before, now = make_graph(), make_graph(effects=np.array(EFFECTS) * 1.2)
    assert now.diff(now) == GraphDiff([], [], [], [], [])
    assert names_of(now.diff(before).strengthened) == [("y", "y'")]
    assert len(now.diff(before, min_change=0.0).strengthened) == 3
    assert len(now.diff(before, threshold=0.0, min_change=0.0).strengthened) == 6
    empty = make_graph(masks=NO_EDGE)
    assert names_of(now.diff(empty).opened) == [("x", "x'"), ("y", "y'"), ("y'", "reward")]
    assert len(now.diff(empty, threshold=0.0).opened) == 6


def test_diff_reads_as_text():
    text = str(make_full_graph().diff(make_graph(masks=NO_EDGE)))
    assert text.splitlines()[:2] == ["opened (3):", "  x -> x': mask 0.90, strength +0.33 +- 0.01"]
    assert "closed" not in text
    closed = str(make_graph(masks=NO_EDGE).diff(make_graph()))
    assert closed.splitlines()[:2] == ["closed (3):", "  x -> x': mask 0.90, strength +0.33"]
    assert str(make_graph().diff(make_graph())) == "no edge changed"


@pytest.mark.parametrize(("argument", "value"), [("threshold", 1.0), ("threshold", -0.1), ("min_change", -1.0)])
def test_diff_names_a_number_out_of_range(argument, value):
    with pytest.raises(ValueError, match=f"{argument} must be .*, got {value}"):
        make_graph().diff(make_graph(), **{argument: value})


def test_fully_connected_is_all_open():
    graph = CausalGraph.fully_connected(VARIABLES)
    assert graph.n_edges == 9
    assert graph.method == "none"
    assert not graph.effects.any()


def test_arrays_are_copies():
    masks = np.ones((3, 3))
    graph = make_graph(masks=masks)
    masks[2, 2] = 0.0
    assert graph.action_to_reward[0] == 1.0


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("masks", np.ones((2, 3)), r"shape \(3, 3\), got \(2, 3\)"),
        ("masks", [[1.0], [1.0, 0.0]], r"numbers of shape \(3, 3\)"),
        ("masks", None, r"shape \(3, 3\), got \(\)"),
        ("masks", np.full((3, 3), np.nan), "finite"),
        ("masks", np.full((3, 3), 1.5), r"\[0, 1\], got values from 1.5 to 1.5"),
        ("masks", np.full((3, 3), -0.5), r"\[0, 1\], got values from -0.5 to -0.5"),
        ("effects", np.ones(9), r"shape \(3, 3\), got \(9,\)"),
        ("effects", np.full((3, 3), np.inf), "finite"),
        ("effects", [["a"] * 3] * 3, r"numbers of shape \(3, 3\)"),
        ("standard_errors", np.ones((3, 2)), r"shape \(3, 3\), got \(3, 2\)"),
        ("standard_errors", np.full((3, 3), -1.0), "at least 0, got -1"),
        ("r_squared", [0.5], r"shape \(3,\), got \(1,\)"),
        ("action_vif", [1.0, 2.0], r"shape \(1,\), got \(2,\)"),
        ("action_vif", [np.inf], "finite"),
        ("method", None, "a string, got None"),
        ("found_at", 5, "a string, got 5"),
        ("n_samples", -1, "at least 0, got -1"),
        ("n_samples", 1.5, "an integer .*, got 1.5"),
        ("num_timesteps", "10", "an integer .*, got '10'"),
        ("constant_variables", "x", "names of variables, got 'x'"),
        ("constant_variables", ["z"], r"names of variables, got \['z'\]"),
        ("duplicated_variables", 5, "groups of names, got 5"),
        ("duplicated_variables", [5], "names of variables, got 5"),
    ],
)
def test_bad_fields_are_named(name, value, message):
    with pytest.raises(ValueError, match=f"^{name} .*{message}"):
        make_graph(**{name: value})


@pytest.mark.parametrize("compare", [CausalGraph.change_since, CausalGraph.diff])
def test_other_variables_cannot_be_compared(compare):
    with pytest.raises(ValueError, match="other must be over the same variables"):
        compare(make_graph(), CausalGraph.fully_connected(TransitionVariables(("x", "z"), ("force",))))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ("[" * 100_000, "not JSON"),
        ('{"n_samples": ' + "9" * 10_000 + "}", "not JSON"),
        ("[]", "holds a list, not an object"),
        (json.dumps({"a": 1}), r"unknown fields \['a'\]"),
    ],
)
def test_bad_json_is_an_error(text, message):
    with pytest.raises(ValueError, match=message):
        CausalGraph.from_json(text)


@pytest.mark.parametrize("missing", ["standard_errors", "r_squared", "masks", "found_at"])
def test_json_without_a_field_says_which(missing):
    content = json.loads(make_full_graph().to_json())
    del content[missing]
    with pytest.raises(ValueError, match=rf"missing fields \['{missing}'\], unknown fields \[\]"):
        CausalGraph.from_json(json.dumps(content))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("variables", None),
        ("variables", ["x"]),
        ("variables", {"state_names": ["x"]}),
        ("variables", {"state_names": ["x", 1], "action_names": ["force"]}),
        ("variables", {"state_names": 1, "action_names": ["force"]}),
        ("masks", None),
        ("masks", {"x": 1}),
        ("masks", [[1.0, 2.0]]),
        ("effects", "none"),
        ("standard_errors", [[None] * 3] * 3),
        ("r_squared", 1.0),
        ("n_samples", "many"),
        ("num_timesteps", [1]),
        ("constant_variables", 1),
        ("duplicated_variables", [[["x"]]]),
        ("masks", [[10**400] * 3] * 3),
        ("r_squared", [10**400] * 3),
    ],
)
def test_malformed_json_fields_are_value_errors(field, value):
    content = json.loads(make_full_graph().to_json()) | {field: value}
    with pytest.raises(ValueError, match="text is not a causal graph: "):
        CausalGraph.from_json(json.dumps(content))


@pytest.mark.parametrize(
    ("library", "method", "message"),
    [("networkx", "to_networkx", r"pip install matplotlib networkx pandas"), ("pandas", "to_dataframe", "pip install pandas")],
)
def test_missing_library_says_what_to_install(monkeypatch, library, method, message):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ImportError, match=message):
        getattr(make_graph(), method)()
