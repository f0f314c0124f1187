import pickle

import numpy as np
import pytest

from sb3_causalgdp.causal import StreamingMoments, TransitionVariables


def moments_of(rows, batch=64, **kwargs):
    moments = StreamingMoments(rows.shape[1], **kwargs)
    for start in range(0, len(rows), batch):
        moments.update(rows[start : start + batch])
    return moments


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


def test_pickle_keeps_the_moments():
    moments = moments_of(np.random.default_rng(0).normal(size=(10, 2)), half_life=20.0)
    loaded = pickle.loads(pickle.dumps(moments))
    loaded.update(np.ones((3, 2)))
    moments.update(np.ones((3, 2)))
    np.testing.assert_array_equal(loaded.covariance(), moments.covariance())


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
