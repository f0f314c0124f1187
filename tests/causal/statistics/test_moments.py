import pickle

import numpy as np
import pytest

from sb3_causalgdp.causal import StreamingMoments, TransitionVariables
from sb3_causalgdp.causal.statistics.moments import leave_one_out, merge, merge_spread


def moments_of(rows, batch=64, **kwargs):
    moments = StreamingMoments(rows.shape[1], **kwargs)
    for start in range(0, len(rows), batch):
        moments.update(rows[start : start + batch])
    return moments


def without_each_block(moments):
    """Moments of all blocks but one, and the share of the weight that this one has."""
    blocks = moments.blocks
    return [(merge([*blocks[:i], *blocks[i + 1 :]]), block.count / moments.count) for i, block in enumerate(blocks)]


@pytest.mark.parametrize("batch", [1, 7, 1000])
def test_equals_numpy_whatever_the_batches(batch):
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(1000, 4)) @ rng.normal(size=(4, 4)) + 3.0
    moments = moments_of(rows, batch)
    np.testing.assert_allclose(moments.mean, rows.mean(axis=0))
    np.testing.assert_allclose(moments.covariance(), np.cov(rows.T, ddof=0))
    np.testing.assert_allclose(moments.correlation(), np.corrcoef(rows.T))
    np.testing.assert_allclose(moments.standard_deviation(), rows.std(axis=0))
    assert moments.count == moments.n_samples == 1000


@pytest.mark.parametrize("batch", [1, 256, 10_000])
def test_stays_accurate_with_a_large_mean_and_a_small_deviation(batch):
    rows = 1e6 + 1e-3 * np.random.default_rng(0).normal(size=(10_000, 2))
    moments = moments_of(rows, batch)
    exact = np.cov((rows - 1e6).T, ddof=0)
    np.testing.assert_allclose(moments.covariance(), exact, rtol=1e-6, atol=1e-6 * exact[0, 0])
    assert not moments.constant.any()


def test_half_life_weighs_old_rows_less():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(300, 3))
    moments = moments_of(rows, batch=100, half_life=50)
    weights = np.repeat([1 / 16, 1 / 4, 1.0], 100)
    np.testing.assert_allclose(moments.count, weights.sum())
    np.testing.assert_allclose(moments.mean, np.average(rows, axis=0, weights=weights))
    np.testing.assert_allclose(moments.covariance(), np.cov(rows.T, aweights=weights, ddof=0))
    assert moments.n_samples == 300


def assert_of_rows(moments, rows, weights=None):
    np.testing.assert_allclose(moments.count, len(rows) if weights is None else weights.sum())
    np.testing.assert_allclose(moments.mean, np.average(rows, axis=0, weights=weights))
    np.testing.assert_allclose(moments.covariance(), np.cov(rows.T, aweights=weights, ddof=0), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("batch", [1, 7, 1000])
@pytest.mark.parametrize("n_blocks", [2, 4, 8])
def test_merging_blocks_forgets_nothing(n_blocks, batch):
    rows = np.random.default_rng(0).normal(size=(1000, 3)) + 3.0
    moments = moments_of(rows, batch, n_blocks=n_blocks)
    assert_of_rows(moments, rows)
    assert n_blocks // 2 < moments.n_filled <= n_blocks


@pytest.mark.parametrize("batch", [1, 7, 1000])
def test_a_window_forgets_the_oldest_block(batch):
    rows = np.random.default_rng(0).normal(size=(1000, 3))
    moments = StreamingMoments(3, window=100, n_blocks=4)
    moments.update(rows[:100])
    assert_of_rows(moments, rows[:100])
    moments.update(rows[100:101])
    assert_of_rows(moments, rows[25:101])
    moments = moments_of(rows[:990], batch, window=100, n_blocks=4)
    assert_of_rows(moments, rows[900:990])
    assert moments.n_samples == 990


@pytest.mark.parametrize("window", [None, 200])
def test_half_life_with_blocks_weighs_rows_by_their_age(window):
    rows = np.random.default_rng(0).normal(size=(400, 2))
    moments = moments_of(rows, batch=20, half_life=60.0, window=window, n_blocks=8)
    weights = np.repeat(0.5 ** (20.0 * np.arange(20)[::-1] / 60.0), 20)
    kept = slice(None) if window is None else slice(-200, None)
    assert_of_rows(moments, rows[kept], weights[kept])


@pytest.mark.parametrize("n_blocks", [4, 8])
def test_half_life_leaves_weight_in_several_blocks(n_blocks):
    moments = moments_of(np.random.default_rng(0).normal(size=(20_000, 2)), batch=100, half_life=500, n_blocks=n_blocks)
    shares = [share for _, share in without_each_block(moments)]
    assert len(shares) == n_blocks
    np.testing.assert_allclose(sum(shares), 1.0)
    assert max(shares) < 0.8


def test_rows_of_no_weight_are_gone():
    moments = StreamingMoments(2, half_life=1.0, n_blocks=4)
    moments.update(np.random.default_rng(0).normal(size=(50, 2)))
    rows = np.random.default_rng(1).normal(size=(5000, 2))
    moments.update(rows)
    assert_of_rows(moments, rows)
    assert all(0.0 < share < 1.0 for _, share in without_each_block(moments))


def test_leaving_a_block_out_equals_numpy_on_the_other_rows():
    rows = np.random.default_rng(0).normal(size=(150, 3)) + np.linspace(0.0, 5.0, 150)[:, None]
    moments = moments_of(rows, batch=11, n_blocks=4)
    parts = without_each_block(moments)
    first_rows = [0, 64, 128, 150]  # two blocks of 8 rows, doubled three times, and one that is not full
    assert len(parts) == 3
    for i, (rest, share) in enumerate(parts):
        block = np.arange(first_rows[i], first_rows[i + 1])
        assert_of_rows(rest, np.delete(rows, block, axis=0))
        assert share == pytest.approx(len(block) / 150)
        others = leave_one_out(moments.blocks)[i]
        left = np.delete(rows, block, axis=0)
        assert others.count == len(left)
        np.testing.assert_allclose(others.mean, left.mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(others.standard_deviation(), left.std(axis=0), rtol=1e-12)


def test_there_is_a_block_for_the_first_rows_and_none_without():
    assert StreamingMoments(2, n_blocks=4).blocks == ()
    assert len(moments_of(np.ones((5, 2)), n_blocks=4).blocks) == 1
    assert len(moments_of(np.ones((500, 2))).blocks) == 1


def test_a_block_with_all_of_a_variance_leaves_none_behind():
    rows = np.random.default_rng(0).normal(size=(512, 2))
    rows[:, 1] = 0.1
    rows[70:80, 1] = 1e6
    moments = moments_of(rows, n_blocks=8)
    left = [rest.covariance()[1, 1] for rest, _ in without_each_block(moments)]
    assert left[1] == 0.0 and min(left[:1] + left[2:]) > 0.0
    spreads = leave_one_out(moments.blocks)
    assert [rest.standard_deviation()[1] ** 2 for rest in spreads] == pytest.approx(left)
    assert [bool(rest.constant[1]) for rest in spreads] == [i == 1 for i in range(8)]


@pytest.mark.parametrize("kwargs", [{}, {"half_life": 200.0}, {"window": 400, "n_blocks": 4}, {"n_blocks": 8}])
@pytest.mark.parametrize("batch", [1, 70])
def test_targets_have_no_products_with_each_other(batch, kwargs):
    rows = np.random.default_rng(0).normal(size=(1000, 5)) @ np.random.default_rng(1).normal(size=(5, 5)) + 2.0
    full, slim = moments_of(rows, batch, **kwargs), moments_of(rows, batch, n_targets=2, **kwargs)
    covariance, total = full.covariance(), slim.total()
    np.testing.assert_allclose(slim.covariance(), covariance[:3, :3], rtol=1e-9)
    np.testing.assert_allclose(slim.correlation(), full.correlation()[:3, :3], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(total.cross / total.count, covariance[:3, 3:], rtol=1e-9)
    np.testing.assert_allclose(total.squares / total.count, np.diagonal(covariance), rtol=1e-9)
    np.testing.assert_allclose(slim.mean, full.mean)
    assert slim.constant.tolist() == [False] * 5 and total.cross.shape == (3, 2)


@pytest.mark.parametrize("half_life", [None, 150.0])
def test_the_spread_is_that_of_the_moments(half_life):
    moments = moments_of(np.random.default_rng(0).normal(size=(700, 3)) + 5.0, n_blocks=4, half_life=half_life)
    spread, total = moments.spread(), moments.total()
    assert spread.count == pytest.approx(total.count)
    np.testing.assert_allclose(spread.mean, total.mean)
    np.testing.assert_allclose(spread.squares, np.diagonal(total.comoment), rtol=1e-12)
    rest = merge_spread(moments.blocks[1:])
    np.testing.assert_allclose(rest.squares, np.diagonal(merge(moments.blocks[1:]).comoment), rtol=1e-12)


def test_merging_into_the_first_gives_the_same_and_leaves_the_others_alone():
    blocks = moments_of(np.random.default_rng(0).normal(size=(700, 3)), n_blocks=4).blocks
    kept = [block.comoment.copy() for block in blocks]
    merged = merge(blocks)
    for block, comoment in zip(blocks, kept, strict=True):
        np.testing.assert_array_equal(block.comoment, comoment)
    into = merge(blocks, into_first=True)
    np.testing.assert_array_equal(into.comoment, merged.comoment)
    assert into.comoment is blocks[0].comoment
    np.testing.assert_array_equal(blocks[1].comoment, kept[1])


@pytest.mark.parametrize("batch", [1, 100])
def test_blocks_stay_accurate_with_a_large_mean_and_a_small_deviation(batch):
    rows = 1e6 + 1e-3 * np.random.default_rng(0).normal(size=(3000, 2))
    moments = moments_of(rows, batch, n_blocks=8)
    everything = [(moments, rows)]
    for i, (rest, _) in enumerate(without_each_block(moments)):
        everything.append((rest, np.delete(rows, np.arange(512 * i, min(512 * (i + 1), 3000)), axis=0)))
    assert len(everything) == 7
    for estimate, kept in everything:
        exact = np.cov((kept - 1e6).T, ddof=0)
        np.testing.assert_allclose(estimate.covariance(), exact, rtol=1e-6, atol=1e-6 * exact[0, 0])


@pytest.mark.parametrize("kwargs", [{}, {"window": 1000}, {"half_life": 300.0}])
def test_memory_does_not_grow_with_the_rows(kwargs):
    moments, sizes = StreamingMoments(3, n_blocks=8, **kwargs), []
    for n_rows in (2000, 60_000):
        moments.update(np.random.default_rng(0).normal(size=(n_rows, 3)))
        sizes.append(len(pickle.dumps(moments)))
        assert moments.n_filled <= 8
    assert sizes[1] < 2 * sizes[0]


def test_what_was_read_does_not_change_with_later_rows():
    moments = moments_of(np.random.default_rng(0).normal(size=(100, 2)))
    total = moments.total()
    before = pickle.dumps(total)
    moments.update(np.ones((5, 2)))
    assert pickle.dumps(total) == before


def test_clear_forgets_all_rows():
    rows = np.random.default_rng(0).normal(size=(300, 2))
    moments = moments_of(np.ones((1000, 2)), n_blocks=4)
    moments.clear()
    moments.update(rows)
    assert_of_rows(moments, rows)
    assert moments.n_samples == 300


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
def test_a_small_unit_is_no_constant(unit):
    rows = np.random.default_rng(0).normal(size=(100, 2))
    moments = StreamingMoments(2)
    moments.update(rows * [unit, 1.0])
    assert moments.constant.tolist() == [False, False]
    np.testing.assert_allclose(moments.correlation(), np.corrcoef(rows.T), atol=1e-6)


def test_constant_columns_have_zero_correlation():
    rows = np.random.default_rng(0).normal(size=(100, 4))
    rows[:, 1] = 0.1
    rows[:, 3] = 1e6 / 3
    moments = moments_of(rows, batch=9)
    assert moments.constant.tolist() == [False, True, False, True]
    correlation = moments.correlation()
    assert not correlation[[1, 3]].any() and not correlation[:, [1, 3]].any()
    np.testing.assert_allclose(correlation[[0, 2], [0, 2]], 1.0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e200])
def test_bad_values_are_named_and_change_nothing(value):
    moments = StreamingMoments(3, names=["x", "y", "z"])
    moments.update(np.eye(3))
    before = pickle.dumps(moments)
    rows = np.ones((5, 3))
    rows[2, 1] = rows[4, 2] = value
    with pytest.raises(ValueError, match=r"first bad row 2, bad variables \['y', 'z'\]"):
        moments.update(rows)
    assert pickle.dumps(moments) == before


def test_update_leaves_the_rows_alone_and_takes_an_empty_batch():
    rows = np.random.default_rng(0).normal(size=(10, 2))
    kept = rows.copy()
    moments = moments_of(rows)
    moments.update(np.empty((0, 2)))
    np.testing.assert_array_equal(rows, kept)
    assert moments.n_samples == 10


@pytest.mark.parametrize("kwargs", [{}, {"half_life": 20.0}, {"n_blocks": 4}, {"window": 12, "n_blocks": 4}])
def test_pickle_keeps_the_moments(kwargs):
    moments = moments_of(np.random.default_rng(0).normal(size=(30, 2)), batch=7, **kwargs)
    loaded = pickle.loads(pickle.dumps(moments))
    loaded.update(np.ones((3, 2)))
    moments.update(np.ones((3, 2)))
    np.testing.assert_array_equal(loaded.covariance(), moments.covariance())
    assert len(loaded.blocks) == len(moments.blocks)


@pytest.mark.parametrize("shape", [(3,), (2, 4), (1, 2, 3)])
def test_wrong_shape_is_an_error(shape):
    with pytest.raises(ValueError, match="rows must have shape"):
        StreamingMoments(3).update(np.zeros(shape))


def test_no_rows_is_an_error():
    with pytest.raises(ValueError, match="no rows"):
        StreamingMoments(3).covariance()


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"n_variables": 0}, ValueError, "n_variables"),
        ({"n_variables": 2.0}, TypeError, "n_variables"),
        ({"n_variables": 2, "half_life": 0}, ValueError, "half_life"),
        ({"n_variables": 2, "half_life": "1e5"}, ValueError, "half_life"),
        ({"n_variables": 2, "names": ["x"]}, ValueError, "names"),
        ({"n_variables": 2, "n_blocks": 3}, ValueError, "n_blocks"),
        ({"n_variables": 2, "n_blocks": 0}, ValueError, "n_blocks"),
        ({"n_variables": 2, "window": 7}, ValueError, "window"),
        ({"n_variables": 2, "window": 7, "n_blocks": 1}, ValueError, "window"),
        ({"n_variables": 2, "window": "1e5"}, ValueError, "window"),
        ({"n_variables": 2, "n_targets": 2}, ValueError, "n_targets"),
        ({"n_variables": 2, "n_targets": -1}, ValueError, "n_targets"),
    ],
)
def test_bad_arguments_are_errors(kwargs, error, message):
    with pytest.raises(error, match=message):
        StreamingMoments(**kwargs)


def test_variables_say_where_each_column_is():
    variables = TransitionVariables(("x", "y"), ("force",))
    assert variables.names == ("x", "y", "force", "x'", "y'", "reward")
    rows = variables.stack([[1, 2]], [[3]], [[4, 5]], [6])
    np.testing.assert_array_equal(rows, [[1, 2, 3, 4, 5, 6]])
    assert rows.dtype == np.float64
    np.testing.assert_array_equal(rows[:, variables.state], [[1, 2]])
    np.testing.assert_array_equal(rows[:, variables.action], [[3]])
    np.testing.assert_array_equal(rows[:, variables.next_state], [[4, 5]])
    assert rows[0, variables.reward] == 6
    assert variables.n_variables == 6


@pytest.mark.parametrize(
    ("argument", "shape"), [("states", (4, 3)), ("actions", (3, 1)), ("next_states", (4, 1)), ("rewards", (4, 2))]
)
def test_stack_names_the_argument_of_a_wrong_shape(argument, shape):
    columns = {"states": (4, 2), "actions": (4, 1), "next_states": (4, 2), "rewards": (4,)} | {argument: shape}
    with pytest.raises(ValueError, match=f"^{argument} must have shape"):
        TransitionVariables(("x", "y"), ("force",)).stack(**{name: np.zeros(size) for name, size in columns.items()})


def test_variables_need_distinct_names():
    with pytest.raises(ValueError, match="repeated: \\['x'\\]"):
        TransitionVariables(("x",), ("x",))
    with pytest.raises(ValueError, match="state_names is empty"):
        TransitionVariables((), ("x",))
    with pytest.raises(TypeError, match="action_names"):
        TransitionVariables(("x",), "force")


@pytest.mark.parametrize(
    ("half_life", "window", "expected"), [(1.0, None, 2.0), (1e18, None, 1e18 / np.log(2.0)), (1e18, 8, 8.0)]
)
def test_the_fewest_rows_that_are_kept_follow_from_half_life_and_window(half_life, window, expected):
    assert StreamingMoments(2, half_life, window=window).fewest_rows == pytest.approx(expected, rel=0.2)
