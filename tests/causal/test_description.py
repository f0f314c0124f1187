from dataclasses import replace

import numpy as np
import pytest

from sb3_causalgdp.causal import CausalGraph, TransitionVariables, discover


def make_graph(n_states=3, n_actions=2, **changes):
    rng = np.random.default_rng(0)
    variables = TransitionVariables(tuple(f"x{i}" for i in range(n_states)), tuple(f"u{i}" for i in range(n_actions)))
    shape = (n_states + 1, n_states + n_actions)
    content = {"method": "by hand", "n_samples": 1_234, "masks": np.ones(shape), "effects": rng.normal(size=shape), **changes}
    return replace(CausalGraph.fully_connected(variables), **content)


def test_print_names_the_strongest_causes_of_the_reward_and_of_each_next_state():
    graph = make_graph(
        masks=np.zeros((4, 5)), effects=np.zeros((4, 5)), standard_errors=np.full((4, 5), 0.02), num_timesteps=5_000
    )
    graph.masks[3, [0, 3]], graph.effects[3, [0, 3]] = 0.9, [-0.2, 0.75]
    graph.masks[0, 1], graph.effects[0, 1] = 0.4, 0.3
    assert str(graph).splitlines() == [
        "Causal graph by by hand from 1,234 transitions after 5,000 steps",
        "3 states, 2 actions; 2 edges with a probability above 0.5 of 20, 2.2 expected",
        "effect in standard deviations for one of the cause, the strongest first:",
        "  reward <- u0 +0.75±0.02, x0' -0.20±0.02",
        "     x0' <- x1 +0.30±0.02 (probability 0.40)",
        "     x1' <- nothing known",
        "     x2' <- nothing known",
    ]


@pytest.mark.parametrize("n_states", [1, 3, 17, 60, 348])
def test_print_fits_on_a_screen(n_states):
    graph = make_graph(
        n_states,
        17,
        r_squared=np.full(n_states + 1, 0.5),
        constant_variables=tuple(f"x{i}" for i in range(n_states)),
        remarks=("something " * 40,) * 9,
    )
    lines = str(graph).splitlines()
    assert len(lines) <= 25
    assert max(map(len, lines)) <= 127
    assert any(line.startswith("  reward <- ") for line in lines)
    assert len(repr(graph)) < 200 and repr(graph).startswith("<CausalGraph 'by hand'")


def test_of_many_next_states_those_are_shown_that_actions_move_most():
    graph = make_graph(100, 2, effects=np.full((101, 102), 0.01))
    graph.effects[[70, 90], 100] = 0.5
    shown = [line.split()[0] for line in str(graph).splitlines() if "<-" in line]
    assert {"x70'", "x90'", "reward"} <= set(shown)
    assert f"and {101 - len(shown)} more next states" in str(graph)


def test_before_the_first_discovery_print_says_so():
    graph = CausalGraph.fully_connected(TransitionVariables(("x",), ("u",)))
    assert not graph.is_discovered
    assert "No discovery yet" in str(graph) and "<-" not in str(graph) and "<-" not in graph._repr_html_()
    assert "no discovery yet" in repr(graph)


def test_notebooks_get_a_table_of_the_same_in_which_names_are_text():
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(500, 2)), rng.uniform(-1, 1, (500, 1))
    following = 0.5 * states + actions + 0.1 * rng.normal(size=(500, 2))
    variables = TransitionVariables(("<b>level</b>", "b"), ("u",))
    graph = discover("partial_r2", variables.stack(states, actions, following, following[:, 0]), variables)
    html = graph._repr_html_()
    assert "<b>level" not in html and "&lt;b&gt;level&lt;/b&gt;&#x27;" in html
    assert html.count("<tr>") == 4 and f"{graph.n_edges} edges" in html
