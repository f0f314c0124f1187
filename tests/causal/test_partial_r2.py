import sys
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from sb3_causalgdp.causal import StreamingMoments, TransitionVariables, make_discovery
from sb3_causalgdp.causal.discovery import DISCOVERY_METHODS, PartialR2, discover, make_statistics, partial_r2
from sb3_causalgdp.causal.discovery import regression as regressions
from sb3_causalgdp.causal.discovery.evidence import edge_probability
from sb3_causalgdp.causal.statistics.basis import BasisMoments, bytes_needed
from sb3_causalgdp.causal.statistics.jackknife import jackknife_error
from sb3_causalgdp.stress import NoiseDistractors

# The benchmarks are not part of the installed package
sys.path.append(str(Path(__file__).parents[2]))

from benchmarks.discovery.metrics import auroc, ece, f1
from benchmarks.discovery.systems import KINDS, make_system

VARIABLES = TransitionVariables(("x", "y", "z"), ("push", "pull"))
NO_SPREAD = 1e-9  # masks are 0 or 1, but for the error of the sample


def rows_of(n_rows, seed=0, noise=0.3, variables=VARIABLES):
    """x' = .8 x + .5 push, y' = sin(2 x), z' = .9 z; r = x' - push^2; with noise."""
    rng = np.random.default_rng(seed)
    states, actions = rng.standard_normal((n_rows, 3)), rng.uniform(-1.0, 1.0, (n_rows, 2))
    x, _, z = states.T
    next_states = np.stack([0.8 * x + 0.5 * actions[:, 0], np.sin(2.0 * x), 0.9 * z], axis=1)
    next_states += noise * rng.standard_normal((n_rows, 3))
    rewards = next_states[:, 0] - actions[:, 0] ** 2 + noise * rng.standard_normal(n_rows)
    return variables.stack(states, actions, next_states, rewards)


def statistics_of(rows, method, variables=VARIABLES, **kwargs):
    statistics = make_statistics(method, variables, **kwargs)
    statistics.update(rows)
    return statistics


def graph_of(rows, variables=VARIABLES, method=None, **kwargs):
    method = PartialR2(**kwargs) if method is None else method
    return method(statistics_of(rows, method, variables), variables)


# What it computes --------------------------------------------------------------------------------------------------------


def residual_by_refit(features, target):
    design = np.column_stack([np.ones(len(features)), features])
    return ((target - design @ np.linalg.lstsq(design, target, rcond=None)[0]) ** 2).sum()


@pytest.mark.parametrize("basis", ["linear", "additive", "products"])
@pytest.mark.parametrize("equation", ["dynamics", "reward"])
def test_leaving_out_a_cause_equals_an_actual_refit(monkeypatch, equation, basis):
    """The partial R^2 of every edge, and R^2, from least squares on the rows with and without the cause's features."""
    rows, method = rows_of(400), PartialR2(basis=basis)
    statistics, kept = statistics_of(rows, method), []
    monkeypatch.setattr(partial_r2, "edge_probability", lambda partial, *_: kept.append(partial) or np.zeros_like(partial))
    graph = method(statistics, VARIABLES)
    which = ("dynamics", "reward").index(equation)
    expansion = statistics.expansions[which]
    inputs = (statistics.inputs_of_dynamics, statistics.inputs_of_reward)[which]
    targets, r_squared = ((rows[:, 5:8], graph.r_squared[:3]), (rows[:, [8]], graph.r_squared[3:]))[which]
    features = expansion.features(expansion.standardise(rows[:, inputs]))
    n_rows, n_features = features.shape
    for j, target in enumerate(targets.T):
        residual = residual_by_refit(features, target)
        variance = ((target - target.mean()) ** 2).sum()
        freedom = n_rows - n_features - 1
        assert r_squared[j] == pytest.approx(max(0.0, 1 - (residual / freedom) / (variance / (n_rows - 1))), abs=1e-6)
        for i, out in enumerate(expansion.features_of(np.arange(5))):
            without = residual_by_refit(np.delete(features, out, axis=1), target)
            adjusted = 1 - (residual / freedom) / (without / (freedom + len(out)))
            assert kept[which][i, j] == pytest.approx(max(0.0, adjusted), abs=5e-5)


def test_effects_of_a_linear_system_are_its_standardised_coefficients():
    rng = np.random.default_rng(0)
    states, actions = rng.standard_normal((3000, 3)) * [1.0, 5.0, 0.1], rng.uniform(-1.0, 1.0, (3000, 2))
    slopes = np.array([[0.5, 0.1, 0.0, -0.6, 0.0], [0.0, 0.9, 0.0, 0.0, 1.0], [0.02, 0.0, -0.7, 0.0, 0.0]])
    next_states = np.hstack([states, actions]) @ slopes.T
    next_states += 0.1 * next_states.std(axis=0) * rng.standard_normal((3000, 3))
    rewards = next_states @ [1.0, -0.2, 0.0] + 0.3 * actions[:, 1] + 0.1 * rng.standard_normal(3000)
    graph = graph_of(VARIABLES.stack(states, actions, next_states, rewards))
    expected = slopes * np.hstack([states, actions]).std(axis=0) / next_states.std(axis=0)[:, None]
    np.testing.assert_allclose(graph.effects[:3], expected, atol=0.03)
    of_reward = np.array([1.0, -0.2, 0.0, 0.0, 0.3]) * np.hstack([next_states, actions]).std(axis=0) / rewards.std()
    np.testing.assert_allclose(graph.effects[3], of_reward, atol=0.03)
    opened = np.vstack([slopes, of_reward]) != 0.0
    assert (graph.masks[opened] > 0.5).all() and (graph.masks[~opened] < 0.1).all()


def test_an_even_function_has_an_edge_and_an_effect_where_notears_sees_nothing():
    rows = rows_of(3000)
    graph, linear = graph_of(rows), discover("notears", rows, VARIABLES)
    assert graph.action_to_reward[0] > 0.99 and graph.action_to_reward[1] < 0.01
    assert abs(graph.effect_action_to_reward[0]) > 0.05 > abs(graph.effect_action_to_reward[1])
    assert linear.action_to_reward[0] == 0.0


def test_effects_without_products_need_few_of_the_newest_rows(monkeypatch):
    rows = rows_of(1000)
    graph = graph_of(rows, basis="additive")
    monkeypatch.setattr(regressions, "THINNING", 2)
    np.testing.assert_allclose(graph.effects, graph_of(rows, basis="additive").effects, atol=0.02)


def test_the_linear_basis_is_least_squares():
    rows = rows_of(2000)
    graph = graph_of(rows, basis="linear")
    z = (rows - rows.mean(axis=0)) / rows.std(axis=0)
    for inputs, targets, where in (([0, 1, 2, 3, 4], [5, 6, 7], slice(0, 3)), ([5, 6, 7, 3, 4], [8], slice(3, 4))):
        weights, _, _, _ = np.linalg.lstsq(z[:, inputs], z[:, targets], rcond=None)
        np.testing.assert_allclose(graph.effects[where], weights.T, atol=1e-5)
    # What is linear is found, what is even is not
    assert graph.masks[0, 0] > 0.99 and graph.masks[2, 2] > 0.99 and graph.action_to_reward[0] < 0.01


def test_an_effect_is_the_mean_change_of_the_fitted_function():
    """Against a refit on the rows, evaluated half a standard deviation above and below at the newest rows."""
    rows, method = rows_of(1000), PartialR2(basis="products")
    statistics = statistics_of(rows, method)
    graph, expansion = method(statistics, VARIABLES), statistics.expansions[0]
    z = expansion.standardise(rows[:, :5])
    design = np.column_stack([np.ones(len(z)), expansion.features(z)])
    coefficients = np.linalg.lstsq(design, rows[:, 5:8], rcond=None)[0][1:]
    for i in range(5):
        above, below = z[-256:].copy(), z[-256:].copy()
        above[:, i] += 0.5
        below[:, i] -= 0.5
        change = (expansion.features(above) - expansion.features(below)) @ coefficients / rows[:, 5:8].std(axis=0)
        expected = np.sign(change.mean(axis=0)) * np.abs(change).mean(axis=0)
        np.testing.assert_allclose(graph.effects[:3, i], expected, atol=5e-4)


def test_the_cosine_of_an_angle_causes_the_next_cosine_although_its_square_is_known_from_the_sine():
    """cos^2 + sin^2 = 1 in all rows: a function of the cosine could as well be one of squares of both."""
    env, rows = gym.make("Pendulum-v1"), []
    variables = TransitionVariables(("cos", "sin", "velocity"), ("torque",))
    env.action_space.seed(0)
    for seed in range(4):
        state, _ = env.reset(seed=seed)
        for _ in range(200):
            action = env.action_space.sample()
            next_state, reward, *_ = env.step(action)
            rows.append([*state, *action, *next_state, reward])
            state = next_state
    graph = graph_of(np.array(rows), variables)
    assert (graph.effects[[0, 1], [0, 1]] > 0.7).all() and (graph.masks[[0, 1], [0, 1]] > 0.99).all()


def test_a_cause_in_a_product_alone_is_found():
    rng = np.random.default_rng(0)
    rows = rows_of(2000)
    rows[:, 7] = rows[:, 1] * rows[:, 4] + 0.3 * rng.standard_normal(2000)
    assert graph_of(rows).masks[2].round(2).tolist() == [0.0, 1.0, 0.0, 0.0, 1.0]
    assert graph_of(rows, basis="additive").masks[2].max() < 0.5


@pytest.mark.parametrize("noise", [0.1, 0.3, 1.0])
def test_r_squared_is_the_share_that_the_causes_explain(noise):
    graph = graph_of(rows_of(4000, noise=noise))
    signal = np.array([0.8**2 + 0.5**2 / 3.0, 0.5 * (1.0 - np.exp(-8.0)), 0.9**2])
    np.testing.assert_allclose(graph.r_squared[:3], signal / (signal + noise**2), atol=0.03)


def test_r_squared_of_noise_is_not_that_of_the_number_of_features():
    rows = np.random.default_rng(0).standard_normal((100, 9))
    assert graph_of(rows).r_squared.max() < 0.25  # 20 to 30 features would explain as many percent


# How well it finds graphs -----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found():
    """For each kind of system, the masks and the truth where data can decide."""
    result = {}
    for kind in KINDS:
        rng = np.random.default_rng(0)
        system = make_system(kind, rng, n_states=6, n_actions=2)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            graph = graph_of(system.sample(2000, rng), system.variables)
        result[kind] = system.fold_copies(graph.masks)[system.scored], system.adjacency[system.scored]
    return result


@pytest.mark.parametrize("kind", KINDS)
def test_graphs_of_known_systems_are_found(found, kind):
    assert auroc(*found[kind]) >= 0.99
    assert f1(*found[kind]) >= 0.9


def test_masks_are_calibrated_near_zero_and_one(found):
    masks, truth = (np.concatenate(parts) for parts in zip(*found.values(), strict=True))
    assert truth[masks > 0.9].mean() > 0.95
    assert truth[masks < 0.1].mean() < 0.05
    assert ece(masks, truth) < 0.06


def test_noise_has_no_edges():
    rows = np.random.default_rng(0).standard_normal((1000, 9))
    assert graph_of(rows).masks.max() < 0.2


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("step", [0.05, 0.002])
def test_exact_dynamics_have_no_false_edges_from_rounding(dtype, step):
    """As a replay buffer holds them: v' = .95 v + dt a, x' = x + dt v, w stays beside; the reward is x' - a^2."""
    rng = np.random.default_rng(0)
    variables = TransitionVariables(("x", "v", "w"), ("push",))
    states, actions = rng.standard_normal((3000, 3)) * [1.0, 1.0, 3.0], rng.uniform(-1.0, 1.0, (3000, 1))
    states, actions = states.astype(dtype), actions.astype(dtype)
    x, v, w = states.T
    next_states = np.stack([x + step * v, 0.95 * v + step * actions[:, 0], 0.5 * w + 2.0], axis=1).astype(dtype)
    rewards = (next_states[:, 0] - actions[:, 0] ** 2).astype(dtype)
    masks = graph_of(variables.stack(states, actions, next_states, rewards), variables).masks
    expected = np.array([[1, 1, 0, 0], [0, 1, 0, 1], [0, 0, 1, 0], [1, 0, 0, 1]])
    np.testing.assert_allclose(masks, expected, atol=1e-3)


# Standard errors and what a mask is made of ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def samples():
    """Effects and their errors, ln partial R^2 and its errors: each of shape (30 samples, 3, 5)."""
    values = []

    def keep(partial, log_error, *args):
        values[-1] += [np.log(np.maximum(partial[:, :3], 1e-12)).T, log_error[:, :3].T]
        return edge_probability(partial, log_error, *args)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(partial_r2, "edge_probability", keep)
        for seed in range(30):
            values.append([])
            graph = graph_of(rows_of(600, seed, noise=0.3), basis="additive")
            values[-1] = [graph.effects[:3], graph.standard_errors[:3], *values[-1][:2]]
    return [np.stack(parts) for parts in zip(*values, strict=True)]


@pytest.mark.parametrize("what", ["effects", "logarithms"])
def test_standard_errors_are_the_spread_over_samples(samples, what):
    estimates, errors = samples[:2] if what == "effects" else samples[2:]
    for edge in ((0, 0), (0, 3), (1, 0), (2, 2)):
        spread = estimates[(slice(None), *edge)].std(ddof=1)
        assert 0.5 < errors[(slice(None), *edge)].mean() / spread < 2.0, edge


def textbook_jackknife(whole, parts, shares):
    ratios = 1.0 / np.array(shares)
    pseudo = [h * whole - (h - 1.0) * part for h, part in zip(ratios, parts, strict=True)]
    estimate = len(parts) * whole - sum((1.0 - 1.0 / h) * part for h, part in zip(ratios, parts, strict=True))
    squares = [(value - estimate) ** 2 / (h - 1.0) for value, h in zip(pseudo, ratios, strict=True)]
    return np.sqrt(np.mean(squares, axis=0))


def blocks_of(n_rows):
    """Rows of each block: of 8 at first, and twice as many whenever there are more than 8 of them."""
    size = 8
    while n_rows > 8 * size:
        size *= 2
    return [np.arange(first, min(first + size, n_rows)) for first in range(0, n_rows, size)]


def test_jackknife_follows_the_textbook():
    rng = np.random.default_rng(0)
    shares = np.array([0.1, 0.2, 0.3, 0.4])
    whole, parts = rng.standard_normal((3, 2)), rng.standard_normal((4, 3, 2))
    np.testing.assert_allclose(jackknife_error(whole, list(parts), shares), textbook_jackknife(whole, parts, shares))
    np.testing.assert_array_equal(jackknife_error(whole, [], []), np.zeros((3, 2)))


@pytest.mark.parametrize("n_rows", [300, 2000])
def test_standard_errors_are_those_of_one_newton_step(n_rows):
    """The formula, row by row, for the linear basis, where an effect is a coefficient."""
    rows = rows_of(n_rows) * np.linspace(1.0, 2.0, n_rows)[:, None]
    graph, x, y = graph_of(rows, basis="linear"), rows[:, :5], rows[:, 5:8]
    x, y = x - x.mean(axis=0), y - y.mean(axis=0)
    scale = x.std(axis=0), y.std(axis=0)
    x, y = x / scale[0], y / scale[1]
    inverse = np.linalg.inv(x.T @ x / n_rows)
    weights = inverse @ x.T @ y / n_rows
    parts, shares = [], []
    for block in blocks_of(n_rows):
        rest = np.delete(np.arange(n_rows), block)
        deviation = x[rest].std(axis=0)[:, None]
        score = x[block].T @ (y - x @ weights)[block]
        step = np.sqrt(n_rows / (n_rows - 6)) * inverse @ score / len(rest)
        parts.append((weights - step) * deviation / y[rest].std(axis=0))
        shares.append(len(block) / n_rows)
    np.testing.assert_allclose(graph.standard_errors[:3].T, textbook_jackknife(weights, parts, shares), rtol=1e-4)


@pytest.mark.parametrize("basis", ["linear", "additive", "products"])
@pytest.mark.parametrize("kwargs", [{}, {"half_life": 300.0}, {"window": 800}])
def test_the_scores_of_all_blocks_add_up_to_nothing(monkeypatch, basis, kwargs):
    """So that those of the last block need not be computed."""
    found, parts = [], regressions.Regression.parts
    monkeypatch.setattr(regressions.Regression, "parts", lambda self: found.append(self) or parts(self))
    rows = rows_of(2000)
    rows[:, 2] = rows[:, 0] + 1e-3 * np.random.default_rng(1).standard_normal(2000)
    method = PartialR2(basis=basis)
    statistics = make_statistics(method, VARIABLES, **kwargs)
    for start in range(0, 2000, 100):
        statistics.update(rows[start : start + 100])
    method(statistics, VARIABLES)
    for regression in found:
        scores = np.stack([regression._scores(block) for block in regression.blocks])
        np.testing.assert_allclose(scores.sum(axis=0), 0.0, atol=1e-9 * np.abs(scores).sum(axis=0).max())
    assert len(found) == (6 if "window" in kwargs else 2)


@pytest.mark.parametrize("basis", ["additive", "products"])
def test_features_that_depend_on_each_other_have_errors_of_the_size_of_those_of_others(basis):
    """cos^2 + sin^2 = 1: the features of an angle are linearly dependent, its cosine and sine are not."""
    rng = np.random.default_rng(0)
    # The angle swings ever wider, so that no block is like the others
    angle = np.linspace(0.5, np.pi, 4000) * rng.uniform(-1.0, 1.0, 4000)
    velocity, torque = rng.standard_normal(4000), rng.uniform(-1.0, 1.0, 4000)
    after = velocity + 0.75 * np.sin(angle) + 0.3 * torque + 0.1 * rng.standard_normal(4000)
    moved = angle + 0.05 * after
    now, then = [np.column_stack([np.cos(a), np.sin(a), v]) for a, v in ((angle, velocity), (moved, after))]
    rows = np.column_stack([now, torque, then, -(after**2)]).astype(np.float32).astype(np.float64)
    graph = discover("partial_r2", rows, TransitionVariables(("cos", "sin", "velocity"), ("torque",)), basis=basis)
    assert graph.standard_errors.max() < 0.3
    assert graph.masks[2, 0] < 0.1
    assert graph.masks[2, 1:4].min() > 0.9


@pytest.mark.parametrize("basis", ["linear", "additive", "products"])
def test_standard_errors_are_about_those_of_actual_refits_without_each_block(basis):
    n_rows, method = 4000, PartialR2(basis=basis)
    rows = rows_of(n_rows)
    statistics = statistics_of(rows, method)
    graph, (expansion, _) = method(statistics, VARIABLES), statistics.expansions
    z = expansion.standardise(rows[:, :5])
    design, after = np.column_stack([np.ones(n_rows), expansion.features(z)]), rows[:, 5:8]
    differences = expansion.differences(z[-256:], np.arange(5), np.full(5, 0.5))
    features_of = 1 + expansion.features_of(np.arange(5))

    def effects(kept):
        coefficients = np.linalg.lstsq(design[kept], after[kept], rcond=None)[0]
        change = differences @ coefficients[features_of]
        values = np.copysign(np.abs(change).mean(axis=1), change.mean(axis=1))
        return (values * z[kept].std(axis=0)[:, None] / z.std(axis=0)[:, None] / after[kept].std(axis=0)).T

    everything, blocks = np.arange(n_rows), blocks_of(n_rows)
    parts = [effects(np.delete(everything, block)) for block in blocks]
    expected = textbook_jackknife(effects(everything), parts, [len(block) / n_rows for block in blocks])
    strong = np.abs(graph.effects[:3]) > 0.1
    np.testing.assert_allclose(graph.standard_errors[:3][strong], expected[strong], rtol=0.15)


def test_features_that_are_almost_dependent_have_moderate_effects():
    """z is x but for 1e-3 of it: only the sum of their effects is known."""
    rows = rows_of(2000)
    rows[:, 2] = rows[:, 0] + 1e-3 * np.random.default_rng(1).standard_normal(2000)
    linear, alone = graph_of(rows, basis="linear"), graph_of(rows_of(2000), basis="linear")
    assert linear.duplicated_variables == ()
    assert linear.effects[0, 0] + linear.effects[0, 2] == pytest.approx(alone.effects[0, 0], abs=0.01)
    # By least squares, some 15 and -15
    for basis in ("linear", "additive", "products"):
        assert np.abs(graph_of(rows, basis=basis).effects[:2, :3]).max() < 10.0


def test_a_mask_is_the_probability_that_the_share_is_over_the_threshold():
    share = np.array([0.0, 1e-9, 0.01, 0.03, 0.09, 1.0])
    masks = edge_probability(share, np.zeros(6), threshold=0.03, spread=0.5)
    np.testing.assert_allclose(masks, [0.0, 0.0, 0.0140, 0.5, 0.9860, 1.0], atol=1e-4)
    assert masks[0] == masks[1] == 0.0
    unsure = edge_probability(share, np.full(6, 2.0), threshold=0.03, spread=0.5)
    assert masks[2] < unsure[2] < 0.5 == unsure[3] < unsure[4] < masks[4]


def test_an_unsure_edge_has_a_mask_further_from_zero_and_one(monkeypatch):
    rows = rows_of(150, noise=1.0)
    with_errors = graph_of(rows, spread=0.1)
    monkeypatch.setattr(partial_r2, "jackknife_error", lambda whole, *_: np.zeros_like(whole))
    without = graph_of(rows, spread=0.1)
    sure = (without.masks > 0.99) | ((without.masks > 0.0) & (without.masks < 0.01))
    unsure = (with_errors.masks > 0.02) & (with_errors.masks < 0.98)
    assert (sure & unsure).any()


def test_few_rows_open_no_edges_by_their_number_of_features():
    """Unadjusted, a null edge of 8 of 35 features would have a share of some 8 / 70."""
    rows = np.random.default_rng(0).standard_normal((80, 9))
    assert graph_of(rows, spread=NO_SPREAD).masks.mean() < 0.4
    shares = []
    for seed in range(10):
        rows = np.random.default_rng(seed).standard_normal((80, 9))
        shares.append(graph_of(rows, threshold=0.1, spread=NO_SPREAD).masks.mean())
    assert np.mean(shares) < 0.25


@pytest.mark.parametrize("n_rows", [14, 30, 60, 90])
def test_few_rows_use_fewer_features(n_rows):
    graph = graph_of(rows_of(n_rows, noise=0.02))
    assert graph.masks[0, 0] > 0.5 and graph.masks[2, 2] > 0.5
    assert graph.n_samples == n_rows


# What cannot be told apart ----------------------------------------------------------------------------------------------


def with_copy(n_rows=2000, factor=-2.0):
    """z is a copy of x; and so is z' of x'."""
    rows = rows_of(n_rows)
    rows[:, 2], rows[:, 7] = factor * rows[:, 0], factor * rows[:, 5]
    return rows


def test_copies_share_a_mask_and_are_listed():
    graph, alone = graph_of(with_copy()), graph_of(rows_of(2000))
    assert graph.duplicated_variables == (("x", "z"),)
    np.testing.assert_array_equal(graph.masks[:, 0], graph.masks[:, 2])
    # Tested together they lose nothing, where one by one neither would explain anything
    np.testing.assert_allclose(graph.masks[:2, :2], alone.masks[:2, :2], atol=0.02)
    assert graph.masks[0, 0] > 0.99 and graph.state_to_reward[0] > 0.99
    np.testing.assert_allclose(graph.effects[:, 2], -graph.effects[:, 0])
    np.testing.assert_allclose(graph.effects[:2, 0], alone.effects[:2, 0], atol=0.02)


def test_a_sum_is_tested_together_with_its_terms():
    rows = rows_of(2000)
    rows[:, 2] = rows[:, 0] + rows[:, 1]
    rows[:, [6, 7]] = rows[:, [2, 1]] + 0.3 * np.random.default_rng(1).standard_normal((2000, 2))
    graph = graph_of(rows)
    assert graph.duplicated_variables == (("x", "y", "z"),)
    # Each causes one of x', y', z': which two of the three are kept for the regression must not matter
    assert (graph.masks[:3, :3] > 0.99).all()
    assert graph.masks[0, 3] > 0.99 > 0.1 > graph.masks[0, 4]


def test_an_action_that_the_next_state_repeats_is_listed_with_it():
    rows = rows_of(2000)
    rows[:, 7] = rows[:, 3]
    graph = graph_of(rows)
    assert graph.duplicated_variables == (("z'", "push"),)
    assert graph.state_to_reward[2] == graph.action_to_reward[0] > 0.99
    assert graph.action_to_state[2, 0] > 0.99


def test_constants_have_no_edges():
    rows = rows_of(2000)
    rows[:, [2, 7]] = 0.1
    rows[:, 4] = -1.0
    graph = graph_of(rows)
    assert graph.constant_variables == ("z", "pull", "z'")
    for values in (graph.masks, graph.effects, graph.standard_errors):
        assert not values[:, [2, 4]].any() and not values[2].any()
    assert graph.r_squared[2] == 0.0 and graph.masks[0, 0] > 0.99


def test_a_constant_reward_has_no_causes():
    rows = rows_of(500)
    rows[:, 8] = 0.0
    graph = graph_of(rows, on_degenerate="raise")
    assert not graph.masks[3].any() and graph.r_squared[3] == 0.0 and graph.masks[0, 0] > 0.99


@pytest.mark.parametrize("where", [slice(0, 60), slice(700, 760)])
def test_a_variable_that_moves_in_one_block_alone_does_no_harm(where):
    rows = rows_of(2000)
    moves = np.zeros(2000, dtype=bool)
    moves[where] = True
    for column in (1, 6, 8):
        rows[~moves, column] = 0.3
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        graph = graph_of(rows)
    assert graph.masks[0, 0] > 0.99 and np.isfinite(graph.standard_errors).all()


def test_one_wild_row_does_no_harm():
    rows = rows_of(2000)
    rows[1234, [0, 6]] = 1e9
    graph = graph_of(rows)
    assert graph.masks[2, 2] > 0.99 and np.isfinite(graph.effects).all()


def test_a_binary_cause_is_found():
    rows = rows_of(2000)
    rows[:, 3] = np.sign(rows[:, 3])
    rows[:, 5] = 0.8 * rows[:, 0] + 0.5 * rows[:, 3] * (rows[:, 1] > 0) + 0.2 * np.random.default_rng(1).standard_normal(2000)
    graph = graph_of(rows)
    assert graph.masks[0, 3] > 0.99 and graph.masks[2, 3] < 0.01


# Confounding -------------------------------------------------------------------------------------------------------------


def confounded_rows():
    rows = rows_of(1000)
    rows[:, 3] = rows[:, 0] - 0.5 * rows[:, 1] + 0.05 * rows[:, 3]
    return rows


def test_actions_that_the_states_determine_are_warned_of_once():
    method = PartialR2()
    statistics = statistics_of(confounded_rows(), method)
    with pytest.warns(UserWarning, match=r"almost determine these actions .*: push \(1.5e\+03|: push \(\d") as caught:
        first = method(statistics, VARIABLES)
    assert len(caught) == 1 and caught[0].filename == __file__ and "pull" not in str(caught[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert method(statistics, VARIABLES).action_vif[0] == first.action_vif[0] > 40.0
    with pytest.warns(UserWarning, match="almost determine"):
        PartialR2()(statistics, VARIABLES)


def test_actions_of_their_own_are_not_warned_of():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_allclose(graph_of(rows_of(2000)).action_vif, 1.0, atol=0.02)


# Statistics --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "row_counts"),
    [({}, (20_000, 180_000)), ({"window": 1000}, (2000, 18_000)), ({"half_life": 500.0}, (2000, 18_000))],
)
def test_a_refresh_reads_as_much_after_many_rows_as_after_few(monkeypatch, kwargs, row_counts):
    method, read = PartialR2(basis="additive"), []
    statistics = make_statistics(method, VARIABLES, **kwargs)
    scores = regressions.Regression._scores
    monkeypatch.setattr(
        regressions.Regression,
        "_scores",
        lambda self, block: read[-1].append(block.comoment.size) or scores(self, block),
    )
    for n_rows in row_counts:
        rows = rows_of(n_rows)
        for start in range(0, n_rows, 500):
            statistics.update(rows[start : start + 500])
        read.append([])
        method(statistics, VARIABLES)
        assert len(statistics.recent) == 256
    for sizes in read:
        # Of the 5 to 8 blocks, the scores of the last one follow from the others; a window is seen in two parts, too
        assert 2 * 4 <= len(sizes) <= 2 * (13 if "window" in kwargs else 7) and set(sizes) == {20**2}


@pytest.mark.parametrize("kwargs", [{"window": 800}, {"half_life": 300.0}])
def test_what_is_forgotten_closes_its_edges(kwargs):
    method = PartialR2()
    statistics = make_statistics(method, VARIABLES, **kwargs)
    early, late = rows_of(2000), rows_of(2400, seed=1)
    late[:, 5] -= 0.8 * late[:, 0]
    for rows in (early, late):
        for start in range(0, len(rows), 100):
            statistics.update(rows[start : start + 100])
        if rows is early:
            assert method(statistics, VARIABLES).masks[0, 0] > 0.99
    graph = method(statistics, VARIABLES)
    assert graph.masks[0, 0] < 0.1 and graph.masks[0, 3] > 0.99


def test_too_few_rows_say_how_many_are_needed():
    with pytest.raises(ValueError, match=r"needs at least 14 rows .* got 13"):
        graph_of(rows_of(13))
    with pytest.raises(ValueError, match=r"needs at least 14 rows .* got 0"):
        graph_of(rows_of(0))
    graph_of(rows_of(14))


def test_wrong_statistics_are_an_error():
    method = PartialR2()
    with pytest.raises(ValueError, match="make_statistics makes for"):
        method(StreamingMoments(VARIABLES.n_variables), VARIABLES)
    with pytest.raises(ValueError, match="make_statistics makes for"):
        method(BasisMoments(TransitionVariables(("x",), ("push",))), VARIABLES)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"threshold": 0.0},
        {"threshold": 1.0},
        {"threshold": float("nan")},
        {"spread": 0.0},
        {"spread": float("inf")},
        {"on_degenerate": "drop"},
        {"basis": "cubic"},
    ],
)
def test_bad_arguments_are_errors(kwargs):
    with pytest.raises(ValueError, match=next(iter(kwargs))):
        PartialR2(**kwargs)


def test_it_is_made_by_name_and_describes_itself():
    assert DISCOVERY_METHODS["partial_r2"] is PartialR2
    method = make_discovery("partial_r2", threshold=0.1, basis="additive")
    graph = graph_of(rows_of(300), method=method)
    assert graph.method == "partial_r2" and graph.n_samples == 300 and graph.found_at.endswith("+00:00")
    assert method.make_statistics(VARIABLES).basis == "additive"


def test_the_same_rows_give_the_same_graph_twice():
    method = PartialR2()
    statistics = statistics_of(rows_of(500), method)
    first, second = method(statistics, VARIABLES), method(statistics, VARIABLES)
    for name in ("masks", "effects", "standard_errors", "r_squared"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))


def pendulum_with_noise(n_rows, n_noises, seed=0):
    """Random actions on a pendulum, which is smooth and has no noise of its own, beside observations that change as slowly."""
    env = NoiseDistractors(gym.make("Pendulum-v1"), n=n_noises)
    env.action_space.seed(seed)
    rows, observation = [], env.reset(seed=seed)[0]
    for _ in range(n_rows):
        action = env.action_space.sample()
        following, reward, _, cut, _ = env.step(action)
        rows.append((observation, action, following, reward))
        observation = env.reset()[0] if cut else following
    variables = TransitionVariables(tuple(f"s{i}" for i in range(3 + n_noises)), ("torque",))
    return variables.stack(*map(np.array, zip(*rows, strict=True))), variables


@pytest.mark.parametrize(("n_rows", "n_noises"), [(1_000, 10), (3_000, 20), (5_000, 20)])
def test_slow_noise_is_no_cause_of_a_model_s_slow_errors(n_rows, n_noises):
    rows, variables = pendulum_with_noise(n_rows, n_noises)
    evidence = discover("partial_r2", rows, variables).evidence
    assert (evidence[:3, 3:-1] > 0.5).sum() == 0 and (evidence[-1, 3:-1] > 0.5).sum() == 0
    of_pendulum = np.column_stack([evidence[:3, :3], evidence[:3, -1]])
    assert (of_pendulum > 0.5).sum() >= 10


def test_where_rich_features_only_follow_the_rows_simpler_ones_are_taken():
    """A random walk's past predicts it by straight lines alone."""
    rng = np.random.default_rng(0)
    variables = TransitionVariables(tuple(f"s{i}" for i in range(8)), ("a",))
    states, actions = np.cumsum(rng.normal(size=(201, 8)), axis=0), np.cumsum(rng.normal(size=(200, 1)), axis=0)
    rows = variables.stack(states[:-1], actions, states[1:], rng.normal(size=200))
    masks = discover("partial_r2", rows, variables).masks[:8]
    assert (np.diag(masks) > 0.9).all()
    others = masks[:, :8][~np.eye(8, dtype=bool)]
    assert (others > 0.5).mean() < 0.1
    # Columns that never move say nothing about the others
    still = np.column_stack([rows[:, :8], np.ones((200, 9)), rows[:, 8:17], np.ones((200, 9)), rows[:, 17:]])
    more = TransitionVariables(tuple(f"s{i}" for i in range(17)), ("a",))
    with_still = discover("partial_r2", still, more).masks[:8, :8][~np.eye(8, dtype=bool)]
    assert (with_still > 0.5).mean() < 0.1


def test_blocks_of_unequal_size_are_no_overfitting():
    """A long block and a short one, as in a memory for few of them."""
    rng = np.random.default_rng(0)
    states, actions = rng.normal(size=(1_032, 3)), rng.normal(size=(1_032, 2))
    following = 0.5 * states + 0.1 * rng.normal(size=states.shape)
    method = make_discovery("partial_r2", max_memory=4 * bytes_needed(3, 5, "products"))
    statistics = make_statistics(method, VARIABLES)
    for batch in (slice(0, 1_024), slice(1_024, 1_032)):
        part = (values[batch] for values in (states, actions, following, following[:, 0]))
        statistics.update(VARIABLES.stack(*part))
    graph = method(statistics, VARIABLES)
    assert (np.diag(graph.evidence[:3, :3]) > 0.99).all() and graph.detectable_r2.max() < 0.05
