import pickle
import sys

import numpy as np
import pytest

from sb3_causalgdp.causal import DISCOVERY_METHODS, TransitionVariables, discover, make_discovery, make_statistics
from sb3_causalgdp.causal.discovery.lingam import DirectLingam

VARIABLES = TransitionVariables(("x", "y", "z"), ("u",))


def test_missing_package_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "lingam", None)
    with pytest.raises(ImportError, match=r"pip install lingam"):
        make_discovery("direct_lingam")


@pytest.fixture(autouse=True)
def _package(request):
    if "missing_package" not in request.node.name:
        pytest.importorskip("lingam")


def instantaneous_system(n_rows=3_000, seed=0):
    """x' <- x, u;  y' <- y and, at once, x';  z' <- z and, at once, y'; with uniform noise. The reward is z' + u."""
    rng = np.random.default_rng(seed)
    state, action = rng.normal(size=(n_rows, 3)), rng.uniform(-1, 1, (n_rows, 1))
    noise = rng.uniform(-1, 1, (n_rows, 3))
    x = 0.5 * state[:, 0] + action[:, 0] + noise[:, 0]
    y = 0.5 * state[:, 1] + 0.8 * x + noise[:, 1]
    z = 0.5 * state[:, 2] - 0.8 * y + noise[:, 2]
    return VARIABLES.stack(state, action, np.stack([x, y, z], axis=1), z + action[:, 0])


def test_finds_the_order_of_simultaneous_variables():
    method = DirectLingam()
    discover(method, instantaneous_system(), VARIABLES)
    found = np.abs(method.instantaneous_weights) > 0.1
    np.testing.assert_array_equal(found, np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=bool))


def test_effects_go_over_all_paths():
    rows = instantaneous_system()
    graph = discover("direct_lingam", rows, VARIABLES)
    scale = rows.std(axis=0)
    truth = np.array([[0.5, 0, 0, 1.0], [0.4, 0.5, 0, 0.8], [-0.32, -0.4, 0.5, -0.64]]) * scale[:4] / scale[4:7, None]
    np.testing.assert_allclose(graph.effects[:3], truth, atol=0.05)
    assert graph.masks[:3][truth == 0].max() < 0.3 and graph.masks[:3][np.abs(truth) > 0.2].min() > 0.8
    np.testing.assert_allclose(graph.effect_state_to_reward, [0, 0, scale[6] / scale[7]], atol=0.05)
    assert graph.effect_action_to_reward[0] == pytest.approx(scale[3] / scale[7], abs=0.05)
    assert (graph.method, graph.n_samples) == ("direct_lingam", 3_000)
    assert graph.r_squared[-1] > 0.99 and graph.action_vif[0] == pytest.approx(1.0, abs=0.01)


def test_constant_and_duplicate_columns_do_no_harm():
    rows = instantaneous_system(500)
    rows[:, 1] = rows[:, 0]
    rows[:, 2] = 7.0
    rows[:, 5] = rows[:, 4]
    graph = discover("direct_lingam", rows, VARIABLES)
    assert graph.constant_variables == ("z",) and graph.duplicated_variables == (("x", "y"),)
    np.testing.assert_array_equal(graph.masks[:3, 0], graph.masks[:3, 1])
    assert not graph.masks[:3, 2].any()


def test_pickled_method_and_statistics_give_the_same_graph():
    method = DirectLingam()
    statistics = make_statistics(method, VARIABLES)
    statistics.update(instantaneous_system(200))
    copied_method, copied = pickle.loads(pickle.dumps((method, statistics)))
    np.testing.assert_array_equal(copied_method(copied, VARIABLES).effects, method(statistics, VARIABLES).effects)


def test_too_few_rows_too_many_states_and_other_statistics_are_errors():
    with pytest.raises(ValueError, match="direct_lingam needs at least 17 rows, got 16"):
        discover("direct_lingam", instantaneous_system(16), VARIABLES)
    discover("direct_lingam", instantaneous_system(17), VARIABLES)
    with pytest.raises(ValueError, match=r"max_states=2 states, .* got 3"):
        discover("direct_lingam", instantaneous_system(20), VARIABLES, max_states=2)
    with pytest.raises(ValueError, match="make_statistics"):
        DirectLingam()("rows", VARIABLES)


@pytest.mark.parametrize("kwargs", [{"edge_threshold": -1.0}, {"mask_scale": 0.0}, {"window": 5}, {"max_states": 0}])
def test_bad_arguments_are_errors(kwargs):
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        DISCOVERY_METHODS["direct_lingam"](**kwargs)
