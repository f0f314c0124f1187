import math
import pickle

import gymnasium as gym
import numpy as np
import pytest

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.callbacks import CausalWorldModelCallback
from sb3_causalgdp.causal import TransitionVariables, make_statistics
from sb3_causalgdp.causal.discovery import PartialR2, Perturbed
from sb3_causalgdp.causal.statistics.basis import bytes_needed
from sb3_causalgdp.causal.statistics.grouped import GroupedStatistics
from sb3_causalgdp.stress import WeakActuator
from tests.small_models import small

VARIABLES = TransitionVariables(("x", "y", "z"), ("push", "pull"))
WINDOW, BATCH = 1600, 100
PUSH = 3  # column of the masks


def rows_of(n_rows, seed=0, push=1.0, spread=1.0):
    """x', y', z' and r depend on push, unless it is 0."""
    rng = np.random.default_rng(seed)
    states, actions = spread * rng.standard_normal((n_rows, 3)), rng.uniform(-1.0, 1.0, (n_rows, 2))
    pushed = push * actions[:, [0]]
    next_states = np.sin(states) + [[1.0, 0.8, 0.6]] * pushed + 0.3 * rng.standard_normal((n_rows, 3))
    rewards = next_states[:, 0] + pushed[:, 0] + 0.3 * rng.standard_normal(n_rows)
    return VARIABLES.stack(states, actions, next_states, rewards)


def graphs_of(method, rows, window=WINDOW, half_life=None):
    """A graph after each batch of rows, and the statistics at the end."""
    statistics, graphs = make_statistics(method, VARIABLES, half_life, window), []
    for first in range(0, len(rows), BATCH):
        statistics.update(rows[first : first + BATCH])
        graphs.append(method(statistics, VARIABLES))
    return graphs, statistics


@pytest.mark.parametrize(("before", "after"), [(1.0, 0.0), (0.0, 1.0)])
def test_a_graph_follows_a_change_in_less_than_half_of_its_window(before, after):
    graphs, statistics = graphs_of(PartialR2(), np.concatenate([rows_of(1600, 0, before), rows_of(600, 1, after)]))
    assert (graphs[15].masks[:, PUSH] > 0.5).all() == (before == 1.0)
    assert ((graphs[-1].masks[:, PUSH] > 0.5) == (after == 1.0)).all()
    assert statistics.rows_since_change < WINDOW / 2
    said = [remark for graph in graphs for remark in graph.remarks]
    assert len(said) == 1 and "4 edges are others in the newest " in said[0] and "older ones are forgotten" in said[0]


def test_where_nothing_changes_nothing_is_forgotten():
    graphs, statistics = graphs_of(PartialR2(), rows_of(4000))
    assert statistics.count > WINDOW * 7 / 8
    assert statistics.rows_since_change == math.inf
    assert not any(graph.remarks for graph in graphs)


def test_other_states_are_no_other_world():
    """A policy that gets to where the same dynamics look linear changes effects, and no edge."""
    _, statistics = graphs_of(PartialR2(), np.concatenate([rows_of(1600, 0), rows_of(1600, 1, spread=0.4)]))
    assert statistics.rows_since_change == math.inf


@pytest.mark.parametrize(
    "kwargs", [{"window": None}, {"window": None, "half_life": 400.0}, {"window": 1600, "half_life": 1e6}, {"window": 16}]
)
def test_only_a_window_that_is_long_enough_forgets_at_once(kwargs):
    _, statistics = graphs_of(PartialR2(), np.concatenate([rows_of(1600, 0), rows_of(600, 1, push=0.0)]), **kwargs)
    assert (statistics.rows_since_change < math.inf) == (kwargs["window"] == 1600)


def test_rows_from_before_a_change_are_forgotten_up_to_whole_blocks():
    statistics = make_statistics(PartialR2(), VARIABLES, None, WINDOW)
    statistics.update(rows_of(1600))
    newest = statistics.with_blocks(slice(-2, None))
    assert newest.count == newest.raw.count == 400.0 and statistics.count == 1600.0
    statistics.forget_old(300)
    assert statistics.count == statistics.raw.count == statistics.rows_since_change == 400.0
    np.testing.assert_array_equal(statistics.dynamics.total().comoment, newest.dynamics.total().comoment)
    statistics.update(rows_of(50, seed=1))
    assert pickle.loads(pickle.dumps(statistics)).rows_since_change == 450.0


def test_groups_and_perturbed_statistics_know_the_rows_of_the_world_as_it_is():
    variables = TransitionVariables(tuple(f"s{i}" for i in range(40)), ("a",))
    grouped = GroupedStatistics(variables, None, 800, bytes_needed(20, 21, "linear"))
    perturbed = make_statistics(Perturbed("partial_r2", noise=0.1), VARIABLES, None, WINDOW)
    for statistics in (grouped, perturbed):
        assert statistics.rows_since_change == math.inf
        statistics.update(np.random.default_rng(0).standard_normal((300, statistics.variables.n_variables)))
        statistics.statistics.rows_since_change = 300.0
        statistics.restart()
        assert statistics.rows_since_change == 300.0


def test_a_model_forgets_what_its_actuator_could_do_and_does_not_read_it_again(capsys):
    env = WeakActuator(gym.make("Pendulum-v1"), at_step=1600, factor=0.0)
    arguments = small(learning_starts=10_000, buffer_size=5000, causal_refresh_freq=200, causal_window=1600)
    model = CausalGDP("MlpPolicy", env, **arguments)
    callback = CausalWorldModelCallback(verbose=1)
    model.learn(2400, callback=callback)
    history = model.causal_graph_history
    assert (history[6].action_to_state[2] > 0.5).all() and (history[-1].action_to_state <= 0.5).all()
    assert "older ones are forgotten" in capsys.readouterr().out
    statistics = model.causal_statistics
    assert statistics.rows_since_change <= 800
    statistics.wants_history = True
    callback.refresh()
    assert statistics.dynamics.count == statistics.rows_since_change <= 800
    assert (model.causal_graph().action_to_state <= 0.5).all()
