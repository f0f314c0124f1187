import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from sb3_causalgdp.causal import CausalGraph, TransitionVariables
from sb3_causalgdp.causal.plots import plot_causal_graph, plot_graph, plot_heat_map


def make_graph(n_states=3, n_actions=1):
    variables = TransitionVariables(
        tuple(f"obs[{i}]" for i in range(n_states)), tuple(f"action[{i}]" for i in range(n_actions))
    )
    return CausalGraph.fully_connected(variables)


def texts(axes):
    return [text.get_text() for text in (*axes.texts, *axes.get_xticklabels(), *axes.get_yticklabels())]


@pytest.mark.parametrize("kind", ["heat_map", "graph", "both"])
@pytest.mark.parametrize("size", [(3, 1), (17, 6)])
def test_plot_writes_an_image_without_a_warning(tmp_path, kind, size):
    path = tmp_path / "graph.png"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = make_graph(*size).plot(path, kind=kind)
    assert isinstance(figure, Figure)
    assert path.stat().st_size > 5_000


@pytest.mark.parametrize("draw", [plot_heat_map, plot_graph])
def test_every_name_is_on_the_plot(draw):
    graph = make_graph()
    assert set(graph.variables.names) <= set(texts(draw(graph)))


def test_axes_say_cause_and_effect():
    axes = plot_heat_map(make_graph())
    assert axes.get_xlabel().startswith("cause")
    assert axes.get_ylabel() == "effect"


def test_heat_map_has_the_masks_with_the_signs_of_the_weights():
    graph = make_graph(2, 1)
    graph.state_to_state[0, 1] = 0.25
    graph.weight_state_to_state[0, 1] = -3.0
    graph.state_to_reward[1] = 0.5
    expected = np.ones((3, 3))
    expected[0, 1], expected[2, 1] = -0.25, 0.5
    np.testing.assert_array_equal(plot_heat_map(graph).images[0].get_array(), expected)


def test_a_graph_without_edges_can_be_drawn(tmp_path):
    graph = make_graph(1, 1)
    empty = replace(
        graph,
        state_to_state=np.zeros((1, 1)),
        action_to_state=np.zeros((1, 1)),
        state_to_reward=np.zeros(1),
        action_to_reward=np.zeros(1),
    )
    empty.plot(tmp_path / "graph.png")
    assert "0 edges" in plot_graph(empty).get_title()


def test_large_graphs_show_the_most_connected_variables_and_say_so():
    graph = make_graph(348, 17)
    for block in (graph.state_to_state, graph.action_to_state, graph.state_to_reward, graph.action_to_reward):
        block *= 0.01
    graph.state_to_state[300, 200] = graph.action_to_reward[16] = 1.0
    axes = plot_heat_map(graph, max_variables=10)
    assert {"obs[300]'", "obs[200]", "action[16]"} <= set(texts(axes))
    assert len(axes.get_xticks()) == 10
    assert "10 states and actions with the largest total mask, of 365" in axes.get_title()


def test_plots_draw_on_the_given_axes():
    axes = Figure().add_subplot()
    assert plot_graph(make_graph(), axes) is axes


def test_bad_arguments_are_errors():
    with pytest.raises(ValueError, match=r"kind must be one of .* got 'pie'"):
        plot_causal_graph(make_graph(), kind="pie")
    with pytest.raises(ValueError, match="max_variables must be at least 2"):
        make_graph().plot(max_variables=1)


@pytest.mark.parametrize("missing", ["matplotlib.figure", "networkx"])
def test_missing_library_says_what_to_install(monkeypatch, missing):
    monkeypatch.delitem(sys.modules, "sb3_causalgdp.causal.plots")
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=r'pip install "sb3_causalgdp\[plots\]"'):
        make_graph().plot()
