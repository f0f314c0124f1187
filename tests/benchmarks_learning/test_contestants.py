"""Contestants with a graph that is given."""

import numpy as np
import pytest
from small_models import small
from stable_baselines3.common.env_util import make_vec_env

pytest.importorskip("rl_zoo3")
from contestants import DistractedTruth, make_model

from sb3_causalgdp.causal import DISCOVERY_METHODS


def test_the_true_graph_of_distraction_hides_just_the_distractors(monkeypatch):
    # So that it is gone afterwards
    monkeypatch.setitem(DISCOVERY_METHODS, "distracted_truth", DistractedTruth)
    env = make_vec_env("sb3_causalgdp.stress:Distracted/Pendulum-v1", env_kwargs={"noises": 4, "idle_actions": 2})
    arguments = small(learning_starts=250, train_freq=50, causal_refresh_freq=300)
    model = make_model("causalgdp_true", env, **arguments)
    model.learn(1_250)
    graph, gate = model.causal_graph(), model.relevance_gate
    assert graph.method == "distracted_truth"
    np.testing.assert_array_equal(graph.masks[3:7, :7], np.eye(7)[3:])
    np.testing.assert_array_equal(graph.masks[[0, 1, 2, 7]], np.tile([1, 1, 1, 0, 0, 0, 0, 1, 0, 0], (4, 1)))
    np.testing.assert_array_equal(gate.states, [True] * 3 + [False] * 4)
    np.testing.assert_array_equal(gate.actions, [True, False, False])
