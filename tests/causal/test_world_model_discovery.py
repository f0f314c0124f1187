import pickle

import numpy as np
import pytest
import torch as th

from sb3_causalgdp.causal import DISCOVERY_METHODS, MaskedWorldModel, TransitionVariables, discover, make_statistics
from sb3_causalgdp.causal.discovery.world_model import WorldModelEffects

VARIABLES = TransitionVariables(("x", "y"), ("u",))
SMALL = {"net_arch": [16, 16], "first_gradient_steps": 400, "gradient_steps": 50, "batch_size": 64, "learning_rate": 1e-2}


def nonlinear_system(n_rows=2_000, seed=0):
    """x' = x + sin(2 u);  y' = 0.8 y + x^2 - 1;  r = -2 x'. No linear method sees x -> y'."""
    rng = np.random.default_rng(seed)
    state, action = rng.normal(size=(n_rows, 2)), rng.uniform(-1, 1, (n_rows, 1))
    x, y = state.T
    after = np.stack([x + np.sin(2 * action[:, 0]), 0.8 * y + x**2 - 1], axis=1) + 0.05 * rng.normal(size=(n_rows, 2))
    return VARIABLES.stack(state, action, after, -2.0 * after[:, 0])


@pytest.fixture(scope="module")
def graph():
    return discover("world_model", nonlinear_system(), VARIABLES, **SMALL)


def test_finds_nonlinear_edges_and_closes_the_others(graph):
    edges = np.array([[1, 0, 1], [1, 1, 0], [1, 0, 0]], dtype=bool)
    assert graph.masks[edges].min() > 0.9 and graph.masks[~edges].max() < 0.3
    assert (graph.method, graph.n_samples) == ("world_model", 2_000)
    assert graph.r_squared.min() > 0.9


def test_effects_are_in_standard_deviations_of_the_effect_per_one_of_the_cause(graph):
    rows = nonlinear_system()
    scale = rows.std(axis=0)
    assert graph.effects[0, 0] == pytest.approx(scale[0] / scale[3], rel=0.1)
    assert graph.effects[1, 1] == pytest.approx(0.8 * scale[1] / scale[4], rel=0.1)
    # mean |(x + sd / 2)^2 - (x - sd / 2)^2| = 2 sd mean |x|
    assert abs(graph.effects[1, 0]) == pytest.approx(2 * scale[0] * np.abs(rows[:, 0]).mean() / scale[4], rel=0.15)
    assert graph.effects[2, 0] == pytest.approx(-1.0, rel=0.1)


@pytest.mark.parametrize("offset", [1e3, 5e6])
def test_far_from_zero_it_finds_the_same(offset, graph):
    rows = nonlinear_system()
    rows[:, VARIABLES.state] += offset
    rows[:, VARIABLES.next_state] += offset
    rows[:, VARIABLES.reward] += offset
    moved = discover("world_model", rows, VARIABLES, **SMALL)
    np.testing.assert_allclose(moved.masks, graph.masks, atol=0.02)
    np.testing.assert_allclose(moved.effects, graph.effects, atol=0.02)


def test_is_seeded_and_leaves_torchs_generator_alone():
    rows = nonlinear_system(200)
    state = th.get_rng_state()
    first, again, other = (
        discover("world_model", rows, VARIABLES, **(SMALL | {"first_gradient_steps": 5, "seed": seed})) for seed in (0, 0, 1)
    )
    assert th.equal(th.get_rng_state(), state)
    np.testing.assert_array_equal(first.effects, again.effects)
    assert not np.array_equal(first.effects, other.effects)


def test_goes_on_with_its_model_at_the_next_refresh():
    method = WorldModelEffects(**(SMALL | {"first_gradient_steps": 40, "gradient_steps": 40}))
    statistics = make_statistics(method, VARIABLES)
    statistics.update(nonlinear_system(1_000))
    first = method(statistics, VARIABLES)
    model = method.world_model
    statistics.update(nonlinear_system(200, seed=1))
    second = method(statistics, VARIABLES)
    assert method.world_model is model
    assert second.r_squared.min() > first.r_squared.min() and second.n_samples == 1_200


def test_pickled_method_and_statistics_go_on_alike():
    method = WorldModelEffects(**(SMALL | {"first_gradient_steps": 5, "gradient_steps": 5}))
    statistics = make_statistics(method, VARIABLES)
    statistics.update(nonlinear_system(200))
    method(statistics, VARIABLES)
    copied_method, copied = pickle.loads(pickle.dumps((method, statistics)))
    np.testing.assert_array_equal(copied_method(copied, VARIABLES).effects, method(statistics, VARIABLES).effects)


def test_reads_a_trained_model_without_changing_it():
    model = MaskedWorldModel(2, 1, [8, 8])
    masks = [th.ones(2, 2), th.tensor([[1.0], [0.0]]), th.tensor([1.0, 0.0]), th.ones(1)]
    masks[0][0, 1] = 0.0
    model.set_masks(*masks)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    graph = WorldModelEffects().from_world_model(model, nonlinear_system(100), VARIABLES)
    closed = np.array([[0, 1, 0], [0, 0, 1], [0, 1, 0]], dtype=bool)
    assert not graph.effects[closed].any() and not graph.masks[closed].any() and graph.effects[~closed].all()
    assert all(th.equal(value, before[name]) for name, value in model.state_dict().items())


def test_model_of_other_variables_is_an_error():
    with pytest.raises(ValueError, match="world_model must have 2 states and 1 actions, got 3 and 1"):
        WorldModelEffects().from_world_model(MaskedWorldModel(3, 1), nonlinear_system(100), VARIABLES)


def test_constant_columns_have_no_edges_and_duplicates_share_theirs():
    variables = TransitionVariables(("x", "copy", "still"), ("u",))
    plain = nonlinear_system(300)
    columns = {"x": plain[:, 0], "still": np.full(300, 2.0), "u": plain[:, 2], "after": plain[:, 3]}
    state = np.stack([columns["x"], -columns["x"], columns["still"]], axis=1)
    after = np.stack([columns["after"], -columns["after"], columns["still"]], axis=1)
    rows = variables.stack(state, plain[:, 2:3], after, plain[:, -1])
    graph = discover("world_model", rows, variables, **(SMALL | {"first_gradient_steps": 20}))
    assert graph.constant_variables == ("still", "still'") and graph.duplicated_variables == (("x", "copy"),)
    np.testing.assert_array_equal(graph.masks[:, 0], graph.masks[:, 1])
    assert not graph.masks[:, 2].any() and not graph.masks[2].any()


def test_too_few_rows_and_other_statistics_are_errors():
    with pytest.raises(ValueError, match="world_model needs at least 13 rows, got 12"):
        discover("world_model", nonlinear_system(12), VARIABLES)
    discover("world_model", nonlinear_system(13), VARIABLES, **(SMALL | {"first_gradient_steps": 1}))
    with pytest.raises(ValueError, match="make_statistics"):
        WorldModelEffects()("rows", VARIABLES)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"gradient_steps": 0},
        {"first_gradient_steps": 1.5},
        {"batch_size": 1},
        {"learning_rate": 0.0},
        {"threshold": 1.0},
        {"spread": -1.0},
        {"smallest_residual": 0.0},
        {"window": 3},
    ],
)
def test_bad_arguments_are_errors(kwargs):
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        DISCOVERY_METHODS["world_model"](**kwargs)
