import numpy as np

from sb3_causalgdp.causal import TransitionVariables, discover


def test_every_edge_is_open_whatever_the_data_say():
    rows = np.random.default_rng(0).normal(size=(50, 6))
    graph = discover("fully_connected", rows, TransitionVariables(("x", "y"), ("u",)))
    assert (graph.masks == 1.0).all() and graph.n_samples == 50 and graph.method == "fully_connected"
