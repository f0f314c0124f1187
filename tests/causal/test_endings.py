import numpy as np
import pytest

from sb3_causalgdp.causal import CausalGraph, TransitionVariables
from sb3_causalgdp.causal.endings import states_that_end, with_endings


@pytest.fixture
def usual():
    return np.random.default_rng(0).normal(size=(2000, 4))


def test_what_is_beyond_a_limit_where_episodes_end_is_found(usual):
    last = np.random.default_rng(1).normal(size=(30, 4))
    last[:, 1] -= 2.0
    last[:, 2] = 2.0 * np.sign(last[:, 2])  # a limit on both sides: the mean is as ever
    assert states_that_end(usual, last).tolist() == [False, True, True, False]
    assert not states_that_end(usual, last[:4]).any()


def test_a_constant_ends_nothing(usual):
    usual[:, 0] = 3.0
    last = usual[:20].copy()
    assert not states_that_end(usual, last)[0]


def test_what_leads_to_an_end_is_relevant():
    variables = TransitionVariables(("fuel", "speed", "noise"), ("throttle",))
    masks = np.array([[1, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0]], dtype=float)
    graph = CausalGraph(variables, masks, np.zeros_like(masks), method="by hand", n_samples=1000)
    assert graph.relevance().states.tolist() == [0.0, 1.0, 0.0] and graph.relevance().actions.tolist() == [0.0]
    judged = with_endings(graph, np.array([True, False, False]))
    assert judged.relevance().states.tolist() == [1.0, 1.0, 0.0] and judged.relevance().actions.tolist() == [1.0]
    np.testing.assert_array_equal(judged.masks, graph.masks)
    assert with_endings(graph, np.zeros(3, dtype=bool)) is graph
