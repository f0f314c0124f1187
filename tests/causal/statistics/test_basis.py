import pickle
import tracemalloc

import numpy as np
import pytest

from sb3_causalgdp.causal import TransitionVariables
from sb3_causalgdp.causal.discovery import PartialR2
from sb3_causalgdp.causal.statistics.basis import BasisExpansion, BasisMoments

VARIABLES = TransitionVariables(("x", "y"), ("force",))


def draw(n_rows, seed=0, scale=1.0, variables=VARIABLES):
    rng = np.random.default_rng(seed)
    n, d = variables.n_states, variables.n_actions
    states, actions = scale * rng.standard_normal((n_rows, n)), rng.uniform(-1.0, 1.0, (n_rows, d))
    next_states = states + scale * actions[:, :1] + 0.1 * scale * rng.standard_normal((n_rows, n))
    return variables.stack(states, actions, next_states, next_states[:, 0] - actions[:, 0] ** 2)


def fed(rows, batch=100, **kwargs):
    statistics = BasisMoments(VARIABLES, **kwargs)
    for start in range(0, len(rows), batch):
        statistics.update(rows[start : start + batch])
    return statistics


def expand(z, basis="products"):
    """The formula, column by column."""
    b = np.clip(z, -5.0, 5.0)
    columns = [*z.T]
    if basis != "linear":
        columns += [*(b**2).T, *np.sin(b).T, *np.tanh(b).T]
    p = z.shape[1]
    columns += [b[:, i] * b[:, j] for i in range(p) for j in range(i + 1, p)] if basis == "products" else []
    return np.stack(columns, axis=1)


@pytest.fixture(params=["linear", "additive", "products"])
def expansion(request):
    return BasisExpansion(np.array([1.0, -2.0, 0.5]), np.array([2.0, 0.5, 1.0]), request.param)


def test_features_follow_the_formula(expansion):
    inputs = 8.0 * np.random.default_rng(0).standard_normal((50, 3))
    z = (inputs - [1.0, -2.0, 0.5]) / [2.0, 0.5, 1.0]
    features = expansion.features(expansion.standardise(inputs))
    np.testing.assert_allclose(features, expand(z, expansion.basis))
    assert np.abs(z).max() > 5.0 and features.shape == (50, expansion.n_features)


def test_squares_and_products_are_what_doubled_inputs_make_four_times_as_large(expansion):
    z = np.random.default_rng(0).uniform(0.5, 2.0, (20, 3))
    fourfold = np.isclose(expansion.features(2.0 * z), 4.0 * expansion.features(z)).all(axis=0)
    np.testing.assert_array_equal(expansion.squares_and_products, fourfold)


def test_features_of_a_variable_are_those_that_change_with_it(expansion):
    z = np.random.default_rng(0).standard_normal((20, 3))
    for variable, of_variable in enumerate(expansion.features_of(np.arange(3))):
        moved = z.copy()
        moved[:, variable] += 0.3
        changed = (expansion.features(moved) != expansion.features(z)).any(axis=0)
        np.testing.assert_array_equal(np.flatnonzero(changed), np.sort(of_variable))


@pytest.mark.parametrize("variables", [[0, 1, 2], [2, 0], []])
def test_differences_are_those_of_the_features(expansion, variables):
    z, half_steps = 3.0 * np.random.default_rng(0).standard_normal((20, 3)), np.array([0.4, 0.2, 1.0])
    differences = expansion.differences(z, np.array(variables, dtype=int), half_steps)
    features_of = expansion.features_of(np.array(variables, dtype=int))
    assert differences.shape[:2] == (len(variables), 20) and len(features_of) == len(variables)
    for variable, difference, of_variable in zip(variables, differences, features_of, strict=True):
        above, below = z.copy(), z.copy()
        above[:, variable] += half_steps[variable]
        below[:, variable] -= half_steps[variable]
        expected = (expansion.features(above) - expansion.features(below))[:, of_variable]
        np.testing.assert_allclose(difference, expected, atol=1e-12)


@pytest.mark.parametrize("expansion", ["products"], indirect=True)
def test_subset_has_the_features_of_the_kept_inputs_alone(expansion):
    z = np.random.default_rng(0).standard_normal((20, 3))
    kept = np.array([0, 2])
    features = expansion.features(z)
    np.testing.assert_allclose(features[:, expansion.subset(kept, 4, True)], expand(z[:, kept]))
    np.testing.assert_allclose(features[:, expansion.subset(kept, 4, False)], expand(z[:, kept], "additive"))
    np.testing.assert_allclose(features[:, expansion.subset(kept, 2, False)], np.hstack([z[:, kept], z[:, kept] ** 2]))
    np.testing.assert_allclose(features[:, expansion.subset(kept, 1, False)], z[:, kept])


@pytest.mark.parametrize("batch", [1, 37, 1000])
def test_moments_are_those_of_features_and_targets(batch):
    rows = draw(600)
    statistics = fed(rows, batch)
    # The first batches up to 200 rows decide
    first = rows[: batch * -(-200 // batch)]
    for moments, inputs, target in (
        (statistics.dynamics, [0, 1, 2], [3, 4]),
        (statistics.reward, [3, 4, 2], [5]),
    ):
        z = (rows - first.mean(axis=0))[:, inputs] / first.std(axis=0)[inputs]
        everything, total = np.hstack([expand(z), rows[:, target]]), moments.total()
        covariance, n_features = np.cov(everything.T, ddof=0), 15
        np.testing.assert_allclose(total.mean, everything.mean(axis=0), atol=1e-9)
        np.testing.assert_allclose(total.covariance(), covariance[:n_features, :n_features], atol=1e-9)
        np.testing.assert_allclose(total.cross / 600, covariance[:n_features, n_features:], atol=1e-9)
        np.testing.assert_allclose(total.standard_deviation(), np.sqrt(np.diagonal(covariance)), atol=1e-9)
        assert moments.n_samples == 600
    np.testing.assert_array_equal(statistics.recent, rows[-256:])


def test_the_first_rows_fix_the_scale():
    statistics = fed(draw(200))
    known = statistics.expansions
    statistics.update(draw(5000, seed=1, scale=1.5))
    assert statistics.expansions is known and not statistics.wants_history


def test_a_start_with_few_rows_uses_all_of_them():
    rows = draw(50)
    statistics = fed(rows, batch=10)
    assert statistics.expansions is None and statistics.dynamics.n_samples == 0
    statistics.start()
    np.testing.assert_allclose(statistics.expansions[0].location, rows[:, :3].mean(axis=0))
    statistics.update(draw(30, seed=1))
    assert statistics.dynamics.n_samples == statistics.reward.n_samples == statistics.n_samples == 80


def test_an_input_that_moved_starts_the_features_anew_and_asks_for_history():
    early, late = draw(400), draw(1200, seed=1, scale=8.0)
    statistics = fed(early)
    before = statistics.expansions
    statistics.update(late)
    assert statistics.wants_history and statistics.expansions is not before
    assert statistics.dynamics.n_samples == statistics.reward.n_samples == 1200
    assert statistics.n_samples == 1600


def test_refilling_gives_the_graph_of_feeding_afresh_on_the_new_scale():
    rows = np.concatenate([draw(400), draw(1200, seed=1, scale=8.0)])
    statistics = fed(rows)
    assert statistics.wants_history
    statistics.restart()
    for start in range(0, 1600, 100):
        statistics.refill(rows[start : start + 100])
    assert not statistics.wants_history
    afresh = BasisMoments(VARIABLES)
    afresh.update(rows)  # in one batch: its scale is that of all rows
    method = PartialR2()
    one, other = method(statistics, VARIABLES), method(afresh, VARIABLES)
    for name in ("masks", "effects", "standard_errors", "r_squared"):
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), atol=1e-6)
    assert one.n_samples == other.n_samples == 1600


def test_an_input_that_begins_to_move_gets_a_scale():
    rows = draw(1500)
    rows[:300, [1, 4]] = 0.25
    statistics = fed(rows[:300])
    assert statistics.expansions[0].scale[1] == 1.0
    rows[300:, [1, 4]] *= 1e-3
    statistics.update(rows[300:])
    assert statistics.wants_history
    assert 1e-4 < statistics.expansions[0].scale[1] < 0.5


def test_a_large_batch_fades_as_small_ones_do():
    rows = draw(4096)
    large, small = (fed(rows, batch, half_life=1000.0) for batch in (4096, 512))
    for part in ("raw", "dynamics", "reward"):
        assert getattr(large, part).count == pytest.approx(getattr(small, part).count)
        assert getattr(large, part).count < 2000.0


def test_a_window_forgets_features_and_rows():
    rows = draw(2000)
    statistics = fed(rows, window=400)
    assert statistics.raw.count <= 400 and statistics.dynamics.count <= 400 and statistics.reward.count <= 400


def test_a_bad_row_is_named_and_changes_nothing():
    for n_rows in (100, 300):
        statistics = fed(draw(n_rows))
        before, rows = pickle.dumps(statistics), draw(3000)
        rows[2500, 4] = np.nan
        with pytest.raises(ValueError, match=r"first bad row 2500, bad variables \[\"y'\"\]"):
            statistics.update(rows)
        assert pickle.dumps(statistics) == before
    with pytest.raises(ValueError, match=r"rows must have shape \(N, 6\)"):
        statistics.update(np.zeros((3, 5)))


def test_the_arrays_of_the_caller_are_neither_changed_nor_kept():
    rows = draw(150)
    statistics, kept = BasisMoments(VARIABLES), rows.copy()
    statistics.update(rows)
    np.testing.assert_array_equal(rows, kept)
    rows[:] = 1e6  # as one who fills the same array again
    statistics.update(draw(100, seed=1))
    expected = fed(np.concatenate([kept, draw(100, seed=1)]), batch=150)
    np.testing.assert_array_equal(statistics.dynamics.mean, expected.dynamics.mean)
    assert statistics.recent.max() < 100.0


def test_pickle_keeps_what_was_fed():
    for n_rows in (100, 400):
        statistics = fed(draw(n_rows))
        loaded = pickle.loads(pickle.dumps(statistics))
        for each in (statistics, loaded):
            each.update(draw(300, seed=1))
        assert PartialR2()(loaded, VARIABLES).masks.tolist() == PartialR2()(statistics, VARIABLES).masks.tolist()


@pytest.mark.parametrize(("n_inputs", "basis", "other"), [(60, "products", "additive"), (61, "additive", "products")])
def test_there_are_products_up_to_sixty_inputs(n_inputs, basis, other):
    variables = TransitionVariables(tuple(f"s{i}" for i in range(n_inputs - 2)), ("a", "b"))
    statistics = BasisMoments(variables)
    assert statistics.basis == basis
    n_features = 4 * n_inputs + (n_inputs * (n_inputs - 1) // 2 if basis == "products" else 0)
    assert statistics.dynamics.n_variables == n_features + n_inputs - 2
    assert BasisMoments(variables, basis=other, max_memory=1e9).basis == other


def test_the_memory_limit_takes_blocks_away_and_then_is_an_error():
    # Products of 15 features with each other, twice, and with 2 and 1 targets: 3960 bytes a block
    assert [BasisMoments(VARIABLES, max_memory=size).dynamics.n_blocks for size in (8 * 3960, 7 * 3960, 2 * 3960)] == [8, 6, 2]
    with pytest.raises(ValueError, match=r"15 features of 3 states and actions .* use basis='additive', or"):
        BasisMoments(VARIABLES, basis="products", max_memory=2 * 3960 - 1)
    with pytest.raises(ValueError, match="use basis='linear', or give it more memory"):
        BasisMoments(VARIABLES, basis="additive", max_memory=1000)
    with pytest.raises(ValueError, match="MB: give it more memory"):
        BasisMoments(VARIABLES, basis="linear", max_memory=100)


def test_the_default_features_become_simpler_where_memory_is_short_and_say_so():
    for memory, basis in ((2 * 3960, "products"), (2 * 3960 - 1, "additive"), (2 * 8 * 12 * 27 - 1, "linear")):
        statistics = BasisMoments(VARIABLES, max_memory=memory)
        assert statistics.basis == basis
        assert (f"found with basis={basis!r}" in statistics.remark) == (basis != "products")
    many = TransitionVariables(tuple(f"s{i}" for i in range(771)), ("a",))
    statistics = BasisMoments(many)
    assert statistics.basis == "linear"
    assert statistics.remark.startswith("3088 features of 772 states and actions need 343 MB, and max_memory is 200 MB")


def test_memory_is_that_of_the_blocks():
    statistics = fed(draw(16_000), max_memory=8 * 3960)
    arrays = [
        array for part in (statistics.dynamics, statistics.reward) for b in part.blocks for array in (b.comoment, b.cross)
    ]
    assert statistics.dynamics.n_filled == 8 and sum(array.nbytes for array in arrays) == 8 * 3960


def test_a_long_batch_needs_little_memory_beside_itself():
    variables = TransitionVariables(tuple(f"s{i}" for i in range(20)), ("a", "b"))
    rows = draw(20_000, variables=variables)
    statistics = BasisMoments(variables)
    tracemalloc.start()
    statistics.update(rows)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # The features of all rows would be 50 MB
    assert peak < 0.5 * 20_000 * (4 * 22 + 22 * 21 // 2) * 8
