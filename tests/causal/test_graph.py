import json
from dataclasses import replace

import numpy as np
import pytest

from sb3_causalgdp.causal import CausalGraph, TransitionVariables

VARIABLES = TransitionVariables(("x", "y"), ("force",))


def make_graph(**changes):
    content = {
        "state_to_state": [[0.9, 0.0], [0.5, 1.0]],
        "action_to_state": [[0.0], [0.1]],
        "state_to_reward": [0.0, 0.7],
        "action_to_reward": [0.3],
        "weight_state_to_state": [[1 / 3, 0.001], [-0.2, 2.0]],
        "weight_action_to_state": [[0.0], [0.05]],
        "weight_state_to_reward": [0.0, -0.4],
        "weight_action_to_reward": [0.1],
    }
    return CausalGraph(VARIABLES, **(content | changes), method="by hand", n_samples=12, constant_variables=("x",))


def test_edges_have_names_masks_and_weights():
    graph = make_graph()
    assert graph.n_edges == 6
    assert graph.edges() == [
        ("x", "x'", 0.9, 1 / 3),
        ("x", "y'", 0.5, -0.2),
        ("y", "y'", 1.0, 2.0),
        ("force", "y'", 0.1, 0.05),
        ("y'", "reward", 0.7, -0.4),
        ("force", "reward", 0.3, 0.1),
    ]


def test_networkx_graph_has_layers_and_open_edges_only():
    network = make_graph().to_networkx()
    assert dict(network.nodes(data="layer")) == {"x": 0, "y": 0, "force": 0, "x'": 1, "y'": 1, "reward": 2}
    assert network.number_of_edges() == 6
    assert network.edges["x", "y'"] == {"mask": 0.5, "weight": -0.2}
    assert not network.has_edge("y", "x'")


def test_json_round_trip_is_equal():
    graph = replace(make_graph(), num_timesteps=5000, found_at="2024-01-01T00:00:00+00:00")
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


def test_equality_sees_every_field():
    graph = make_graph()
    assert graph == make_graph()
    assert graph != make_graph(action_to_reward=[0.31])
    assert graph != replace(graph, n_samples=13)
    assert graph != "graph"


def test_change_since_goes_from_none_to_all():
    full = CausalGraph.fully_connected(VARIABLES)
    shapes = {"state_to_state": (2, 2), "action_to_state": (2, 1), "state_to_reward": 2, "action_to_reward": 1}
    empty = replace(full, **{name: np.zeros(shape) for name, shape in shapes.items()})
    assert full.change_since(full) == 0.0
    assert full.change_since(empty) == 1.0
    assert make_graph().change_since(empty) == pytest.approx((0.9 + 0.5 + 1.0 + 0.1 + 0.7 + 0.3) / 9)
    assert empty.n_edges == 0 and empty.edges() == []


def test_fully_connected_is_all_open():
    graph = CausalGraph.fully_connected(VARIABLES)
    assert graph.n_edges == 9
    assert graph.method == "none"
    assert not graph.weight_state_to_state.any()


def test_matrices_hold_all_blocks_and_give_the_graph_back():
    graph = make_graph()
    np.testing.assert_array_equal(graph.masks, [[0.9, 0.0, 0.0], [0.5, 1.0, 0.1], [0.0, 0.7, 0.3]])
    rebuilt = CausalGraph.from_matrices(
        VARIABLES, graph.masks, graph.weights, method="by hand", n_samples=12, constant_variables=("x",)
    )
    assert rebuilt == graph
    with pytest.raises(ValueError, match=r"weights must have shape \(3, 3\), got \(2, 3\)"):
        CausalGraph.from_matrices(VARIABLES, graph.masks, graph.weights[1:], method="by hand", n_samples=12)


def test_arrays_are_copies():
    mask = np.ones(1)
    graph = make_graph(action_to_reward=mask)
    mask[0] = 0.0
    assert graph.action_to_reward[0] == 1.0


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("state_to_state", np.ones((2, 3)), r"shape \(2, 2\), got \(2, 3\)"),
        ("weight_action_to_state", np.ones(2), r"shape \(2, 1\), got \(2,\)"),
        ("state_to_reward", [0.0, np.nan], "finite"),
        ("weight_state_to_reward", [0.0, np.inf], "finite"),
        ("action_to_reward", [1.5], r"\[0, 1\], got \[1.5, 1.5\]"),
        ("action_to_state", [[-0.5], [0.0]], r"\[0, 1\], got \[-0.5, 0\]"),
    ],
)
def test_bad_arrays_are_named(name, value, message):
    with pytest.raises(ValueError, match=f"^{name} .*{message}"):
        make_graph(**{name: value})


def test_other_variables_cannot_be_compared():
    with pytest.raises(ValueError, match="other must be over the same variables"):
        make_graph().change_since(CausalGraph.fully_connected(TransitionVariables(("x", "z"), ("force",))))


@pytest.mark.parametrize(("text", "message"), [("{", "not JSON"), ("[]", "got list"), (json.dumps({"a": 1}), "got \\['a'\\]")])
def test_bad_json_is_an_error(text, message):
    with pytest.raises(ValueError, match=message):
        CausalGraph.from_json(text)


def test_missing_networkx_says_what_to_install(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "networkx", None)
    with pytest.raises(ImportError, match=r'pip install "sb3_causalgdp\[plots\]"'):
        make_graph().to_networkx()
