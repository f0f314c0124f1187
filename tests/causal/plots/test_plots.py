import re
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from matplotlib.text import Text
from PIL import Image

from sb3_causalgdp import causal
from sb3_causalgdp.causal import CausalGraph, TransitionVariables
from sb3_causalgdp.causal.plots import View, animate_history, plot_causal_graph, plot_graph, plot_heat_map, plot_history


def make_graph(n_states=3, n_actions=1, **changes):
    """All masks 1, all effects 0, as found in data."""
    variables = TransitionVariables(
        tuple(f"obs[{i}]" for i in range(n_states)), tuple(f"action[{i}]" for i in range(n_actions))
    )
    return replace(CausalGraph.fully_connected(variables), **{"method": "by hand", "n_samples": 10, **changes})


def make_history(length, n_states=2, n_actions=1, every=1000):
    """Entry by entry, the masks close, from the first one on."""
    graphs = []
    for number in range(length):
        graph = make_graph(n_states, n_actions, num_timesteps=every * (number + 1))
        graph.masks.flat[:number] = 0.0
        graphs.append(graph)
    return graphs


def texts(axes):
    return [text.get_text() for text in (*axes.texts, *axes.get_xticklabels(), *axes.get_yticklabels())]


def matrix_of(axes):
    return np.asarray(axes.images[0].get_array())


def arrows(axes):
    return [patch for patch in axes.patches if isinstance(patch, FancyArrowPatch)]


def history_axes(figure):
    """The heat maps, and the curves of edges and changes."""
    return [axes for axes in figure.axes if axes.images], [axes for axes in figure.axes if axes.lines and not axes.images]


@pytest.mark.parametrize("kind", ["heat_map", "graph", "both"])
@pytest.mark.parametrize("size", [(3, 1), (17, 6)])
def test_plot_writes_an_image_without_a_warning(tmp_path, kind, size):
    path = tmp_path / "folder" / "graph.png"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = make_graph(*size).plot(path, kind=kind)
    assert isinstance(figure, Figure)
    assert path.stat().st_size > 5_000
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("draw", [plot_heat_map, plot_graph])
def test_every_name_is_on_the_plot(draw):
    graph = make_graph()
    assert set(graph.variables.names) <= set(texts(draw(graph)))


@pytest.mark.parametrize("name", ["cash $$", "price_$ vs cost_$", "$/m^2 and $/m_", "a_$x_$b", "$x$", r"\$"])
@pytest.mark.parametrize("kind", ["heat_map", "graph"])
def test_a_dollar_sign_in_a_name_is_a_dollar_sign(tmp_path, name, kind):
    graph = CausalGraph.fully_connected(TransitionVariables((name, "other"), (f"u {name}",)))
    figure = graph.plot(tmp_path / "graph.png", kind=kind)
    shown = [text for text in figure.findobj(Text) if "$" in text.get_text()]
    assert {name, f"{name}'", f"u {name}"} <= {text.get_text() for text in shown}
    assert not any(text.get_parse_math() for text in shown)
    plot_history([graph, graph], tmp_path / "history.png")


def test_axes_say_cause_and_effect():
    axes = plot_heat_map(make_graph())
    assert axes.get_xlabel().startswith("cause")
    assert axes.get_ylabel() == "effect"


def test_heat_map_has_the_masks_with_the_signs_of_the_effects():
    graph = make_graph(2, 1)
    graph.state_to_state[0, 1] = 0.25
    graph.effect_state_to_state[0, 1] = -3.0
    graph.state_to_reward[1] = 0.5
    expected = np.ones((3, 3))
    expected[0, 1], expected[2, 1] = -0.25, 0.5
    axes = plot_heat_map(graph, values="masks")
    np.testing.assert_array_equal(matrix_of(axes), expected)
    assert axes.images[0].get_clim() == (-1.0, 1.0)


def test_heat_map_shows_effects_and_a_huge_one_does_not_hide_the_others():
    graph = make_graph(2, 1)
    graph.effects[0] = [0.5, -3.0, 0.0]
    axes = plot_heat_map(graph)
    np.testing.assert_array_equal(matrix_of(axes), graph.effects)
    assert axes.images[0].get_clim() == (-1.0, 1.0)
    graph.effects[0, 1] = -0.8
    assert plot_heat_map(graph).images[0].get_clim() == (-0.8, 0.8)


def test_improbable_effects_are_pale():
    graph = make_graph(2, 1)
    graph.masks[0, 1] = 0.1
    np.testing.assert_array_equal(plot_heat_map(graph).images[0].get_alpha(), graph.masks)
    assert plot_heat_map(graph, values="masks").images[0].get_alpha() is None


def test_titles_count_the_edges_as_the_graph_does():
    graph = make_graph(2, 1)
    graph.masks[0] = [0.2, 0.5, 0.6]
    assert plot_heat_map(graph).get_title() == "Causal effects: 7 edges with a probability above 0.5 of 9, 7.3 expected"


def test_standard_errors_are_numbers_in_a_small_heat_map_of_effects():
    graph = make_graph(2, 1, standard_errors=np.full((3, 3), 0.25))
    graph.effects[1, 2] = -0.5
    cells = {tuple(text.get_position()): text.get_text() for text in plot_heat_map(graph, values="effects").texts}
    assert cells[2, 1] == "-0.50\n\u00b10.25"
    assert len(cells) == 9
    assert not plot_heat_map(graph, values="masks").texts


def test_dots_mark_the_effects_that_may_be_zero_in_a_larger_heat_map():
    graph = make_graph(8, 2, standard_errors=np.full((9, 10), 0.25))
    graph.effects[3, 4], graph.effects[5, 6] = 0.4, -0.6
    graph.masks[graph.effects == 0.0] = 0.0
    axes = plot_heat_map(graph, values="effects")
    dots = next(collection for collection in axes.collections if "two standard errors" in str(collection.get_label()))
    np.testing.assert_array_equal(dots.get_offsets(), [[4, 3]])


def test_a_graph_without_edges_can_be_drawn(tmp_path):
    graph = make_graph(1, 1)
    empty = replace(graph, masks=np.zeros_like(graph.masks))
    for values in ("masks", "effects"):
        empty.plot(tmp_path / "graph.png", values=values)
        empty.plot(tmp_path / "graph.png", values=values, groups={"obs[0]": "obs"})
    assert "0 edges" in plot_heat_map(empty).get_title()
    assert arrows(plot_graph(empty)) == []
    plot_history([empty, empty], tmp_path / "history.png")


@pytest.mark.parametrize("kind", ["heat_map", "graph"])
@pytest.mark.parametrize("size", [(3, 1), (348, 17)])
def test_before_the_first_discovery_pictures_say_so_and_draw_nothing_open(kind, size):
    (axes, *bars) = replace(make_graph(*size), method="none", n_samples=0).plot(kind=kind).axes
    assert any("No discovery yet" in text for text in texts(axes))
    assert not bars and arrows(axes) == []
    assert kind == "graph" or not matrix_of(axes).any()


def test_layered_graph_colours_edges_by_the_sign_of_the_effect():
    graph = make_graph(1, 1)
    graph.masks[:] = [[1.0, 0.0], [0.0, 1.0]]
    graph.effects[:] = [[-1.0, 0.0], [0.0, 0.5]]
    weak, strong = arrows(plot_graph(graph))
    assert weak.get_linewidth() < strong.get_linewidth()
    assert weak.get_edgecolor()[0] > weak.get_edgecolor()[2]  # red
    assert strong.get_edgecolor()[2] > strong.get_edgecolor()[0]  # blue


def test_layered_graph_shows_the_strongest_causes_of_every_effect():
    graph = make_graph(12, 2, effects=np.random.default_rng(0).normal(size=(13, 14)) * 0.1)
    graph.effects[:12] *= 5.0  # those on the reward are the weakest of all
    assert len(arrows(plot_graph(graph))) == 12 * 3 + 6
    edges = graph.strongest_edges(3, 6)
    for effect in (*graph.variables.next_state_names, "reward"):
        own = sorted((abs(edge.strength) for edge in graph.edges() if edge.effect == effect), reverse=True)
        drawn = [abs(edge.strength) for edge in edges if edge.effect == effect]
        assert drawn == own[: len(drawn)] and len(drawn) >= 3


def test_an_uncertain_effect_is_faint_and_loses_against_a_certain_one():
    graph = make_graph(2, 1, standard_errors=np.full((3, 3), 0.01))
    graph.effects[0] = [0.9, 0.5, 0.4]
    graph.standard_errors[0, 0] = 0.4
    assert [edge.cause for edge in graph.strongest_edges(2)[:2]] == ["obs[1]", "action[0]"]
    graph.masks[1:] = 0.0
    faint, clear = sorted(arrows(plot_graph(graph)), key=lambda arrow: arrow.get_linewidth())[::-1][:2]
    assert faint.get_alpha() < clear.get_alpha() - 0.3


def test_ties_are_not_broken_by_position():
    graph = make_graph(5, 1)
    graph.effects[0] = [0.5, 0.5, 0.5, 0.5, 0.2, 0.1]
    assert [edge.cause for edge in graph.strongest_edges(2) if edge.effect == "obs[0]'"] == [f"obs[{i}]" for i in range(4)]


def test_an_effect_without_an_edge_has_its_likeliest_cause_dashed():
    graph = make_graph(2, 1, effects=np.full((3, 3), 0.5))
    graph.masks[0] = [0.1, 0.4, 0.2]
    axes = plot_graph(graph)
    dashed = [arrow for arrow in arrows(axes) if arrow.get_linestyle() != "-" and arrow.get_linestyle() != "solid"]
    assert len(dashed) == 1
    assert [edge.cause for edge in graph.strongest_edges() if edge.effect == "obs[0]'"] == ["obs[1]"]
    assert "probability below 0.5" in [text.get_text() for text in axes.get_legend().get_texts()]


def test_what_moves_each_other_stands_side_by_side():
    graph = make_graph(6, 2)
    graph.masks[:] = 0.0
    for row, columns in enumerate(([0, 3, 6], [1, 4, 7], [2, 5], [0, 3, 6], [1, 4, 7], [2, 5])):
        graph.masks[row, columns], graph.effects[row, columns] = 1.0, 0.5
    heights = {text.get_text(): text.get_position()[1] for text in plot_graph(graph).texts}
    for members in (("obs[0]", "obs[3]", "action[0]"), ("obs[1]", "obs[4]", "action[1]"), ("obs[2]", "obs[5]")):
        own = [heights[name] for name in members]
        assert max(own) - min(own) == len(members) - 1


def test_large_graphs_are_drawn_as_groups_with_numbers():
    graph = make_graph(348, 17)
    graph.masks[:] = 0.0
    graph.masks[:20, 20:40] = 0.5
    axes = plot_heat_map(graph, values="masks")
    assert matrix_of(axes).shape == (19, 35)
    assert matrix_of(axes)[0, 1] == 0.5 and matrix_of(axes).sum() == 0.5
    assert [text.get_text() for text in axes.texts] == [".50"]
    assert {"obs[0..19]'", "obs[340..347]", "action[16]", "reward"} <= set(texts(axes))
    assert axes.get_title().endswith("(max over groups of 348 states and 17 actions)")


def test_large_graphs_can_show_the_most_connected_variables():
    graph = make_graph(348, 17)
    graph.masks[:] *= 0.01
    graph.state_to_state[300, 200] = graph.action_to_reward[16] = 1.0
    axes = plot_heat_map(graph, max_variables=10, groups=None)
    assert {"obs[300]'", "obs[200]", "action[16]"} <= set(texts(axes))
    assert len(axes.get_xticks()) == 10
    assert "10 states and actions with the largest total mask, of 365" in axes.get_title()


def test_own_groups_are_on_both_parts_of_the_plot():
    figure = make_graph(4, 1).plot(groups={"position": 2, "velocity": 2})
    heat_map, layered = figure.axes[:2]
    assert {"position", "velocity'", "action[0]"} <= set(texts(heat_map))
    assert {"position", "velocity'", "action[0]"} <= set(texts(layered))


def test_one_view_is_for_all_pictures():
    view = View(values="masks", groups={"obs[0]": "both", "obs[1]": "both"}, size=(5.0, 4.0))
    graph = make_graph(3, 1)
    for picture in (graph.plot(view=view), plot_history([graph], view=view), plot_graph(graph, view=view).figure):
        assert tuple(picture.get_size_inches()) == (5.0, 4.0)
    assert matrix_of(plot_heat_map(graph, view=view)).shape == (3, 3)
    assert matrix_of(plot_heat_map(graph, view=view, groups=None)).shape == (4, 4)


def test_plots_draw_on_the_given_axes():
    axes = Figure().add_subplot()
    assert plot_graph(make_graph(), axes) is axes


def test_history_shows_evenly_chosen_graphs_and_both_ends():
    graphs = make_history(10)
    maps, _ = history_axes(plot_history(graphs, max_panels=4, values="masks"))
    assert [axes.get_title() for axes in maps] == ["1,000 steps", "4,000 steps", "7,000 steps", "10,000 steps"]
    for axes, number in zip(maps, (0, 3, 6, 9), strict=True):
        np.testing.assert_array_equal(matrix_of(axes), graphs[number].masks)


@pytest.mark.parametrize(("length", "n_maps"), [(1, 1), (3, 3), (5, 5), (8, 8), (20, 8)])
def test_history_draws_at_most_eight_maps_without_a_warning(tmp_path, length, n_maps):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure = plot_history(make_history(length), tmp_path / "history.png")
    maps, _ = history_axes(figure)
    assert len(maps) == n_maps
    assert maps[-1].get_title() == f"{length},000 steps"
    assert list(tmp_path.iterdir()) == [tmp_path / "history.png"]


def test_history_without_steps_numbers_the_graphs_among_all():
    graphs = [replace(graph, num_timesteps=None) for graph in make_history(9)]
    maps, _ = history_axes(plot_history(graphs, max_panels=3))
    assert [axes.get_title() for axes in maps] == ["graph 1 of 9", "graph 5 of 9", "graph 9 of 9"]


def test_history_has_curves_of_edges_and_changes_of_all_graphs():
    graphs = make_history(10)
    _, (edges, changes) = history_axes(plot_history(graphs, max_panels=2))
    np.testing.assert_array_equal(edges.lines[0].get_xydata(), [(1000 * (i + 1), 9 - i) for i in range(10)])
    np.testing.assert_allclose(changes.lines[0].get_xydata(), [(1000 * (i + 1), 1 / 9) for i in range(1, 10)])
    np.testing.assert_allclose(edges.lines[1].get_ydata(), [9 - i for i in range(10)])
    assert edges.get_title() == "edges"
    assert changes.get_xlabel() == "environment steps"


def test_history_counts_edges_as_the_graph_does():
    graph = make_graph(2, 1)
    graph.masks[0] = 0.4
    _, (edges, _) = history_axes(plot_history([graph]))
    assert edges.lines[0].get_ydata().tolist() == [graph.n_edges] == [6]
    assert edges.lines[1].get_ydata().tolist() == pytest.approx([7.2])


@pytest.mark.parametrize("steps", [[None, None], [2000, 1000], [None, 1000]])
def test_history_without_increasing_steps_counts_the_graphs(steps):
    graphs = [replace(graph, num_timesteps=at) for graph, at in zip(make_history(2), steps, strict=True)]
    _, (edges, changes) = history_axes(plot_history(graphs))
    assert edges.lines[0].get_xdata().tolist() == [1, 2]
    assert changes.get_xlabel() == "number of the graph"


def test_history_of_a_large_graph_shows_the_same_groups_on_one_scale():
    graphs = make_history(2, 50, 3)
    graphs[0].masks[:] = 0.0
    graphs[0].masks[0, 0] = 0.5
    maps, _ = history_axes(plot_history(graphs, values="masks", aggregate="mean"))
    assert [matrix_of(axes).shape for axes in maps] == [(11, 13), (11, 13)]
    assert [axes.images[0].get_clim() for axes in maps] == [(0.0, 1.0), (0.0, 1.0)]
    assert matrix_of(maps[0])[0, 0] == pytest.approx(0.5 / 25)


def test_animation_has_a_frame_for_each_graph_and_stays_on_the_last(tmp_path):
    path = tmp_path / "folder" / "history.gif"
    animate_history(make_history(4), path, frames_per_second=4)
    with Image.open(path) as movie:
        assert movie.n_frames == 4
        durations = []
        for number in range(4):
            movie.seek(number)
            durations.append(movie.info["duration"])
    assert durations == [250, 250, 250, 2000]
    assert list(path.parent.iterdir()) == [path]


def test_failed_writing_keeps_the_old_picture(tmp_path, monkeypatch):
    path = tmp_path / "graph.png"
    make_graph().plot(path)
    before = path.read_bytes()
    monkeypatch.setattr(Figure, "savefig", lambda _, path, **__: (path.write_bytes(b"half"), 1 / 0))
    with pytest.raises(ZeroDivisionError):
        make_graph(2, 2).plot(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("name", ["graph.xyz", "graph"])
def test_unknown_suffix_is_one_clear_error(tmp_path, name):
    for draw in (make_graph().plot, lambda path: plot_history(make_history(2), path)):
        with pytest.raises(ValueError, match=rf"path must end in one of .*\.pdf.*\.png.*, got '.*{re.escape(name)}'"):
            draw(tmp_path / name)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("suffix", [".PNG", ".svg", ".pdf"])
def test_the_suffix_is_the_format(tmp_path, suffix):
    path = tmp_path / f"graph{suffix}"
    make_graph(1, 1).plot(path, kind="heat_map")
    assert path.read_bytes()[:4] in (b"\x89PNG", b"<?xm", b"%PDF")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: plot_causal_graph(make_graph(), kind="pie"), "kind must be one of .* got 'pie'"),
        (lambda: make_graph().plot(values="signs"), "values must be one of .* got 'signs'"),
        (lambda: make_graph().plot(max_variables=1), "max_variables must be an integer of at least 2, got 1"),
        (
            lambda: make_graph().plot(colour="red"),
            r"unknown options \['colour'\] of a picture, known are \['values'",
        ),
        (lambda: plot_heat_map(make_graph(), size=(3, -1)), r"size must be a width and a height in inches, got \(3, -1\)"),
        (lambda: make_graph().plot(aggregate="sum"), "aggregate must be one of .* got 'sum'"),
        (lambda: plot_graph(make_graph(), causes=0), "causes must be an integer of at least 1, got 0"),
        (lambda: plot_history([]), "graphs is empty"),
        (lambda: plot_history([make_graph(1), make_graph(2)]), "graphs must be over the same variables"),
        (lambda: plot_history([make_graph()], max_panels=9), "max_panels must be from 1 to 8, got 9"),
        (lambda: animate_history([make_graph()], "a.png"), "path must end in .gif, got 'a.png'"),
        (lambda: animate_history([make_graph()], "a.gif", frames_per_second=0), "frames_per_second must be above 0"),
        (lambda: animate_history([], "a.gif"), "graphs is empty"),
    ],
)
def test_bad_arguments_are_errors(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize("missing", ["matplotlib.figure", "matplotlib.patches"])
def test_missing_library_says_what_to_install(monkeypatch, missing):
    for name in [name for name in sys.modules if name.startswith("sb3_causalgdp.causal.plots")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr(causal, "plots")
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=r"pip install matplotlib networkx pandas"):
        make_graph().plot()
