import pickle

import numpy as np
import pytest

from sb3_causalgdp.causal import TransitionVariables
from sb3_causalgdp.causal.statistics.recent_rows import RecentRows

VARIABLES = TransitionVariables(("x",), ("u",))


@pytest.mark.parametrize("sizes", [(3,), (7,), (2, 2, 2, 5), (1,) * 23, (30,), (4, 9, 1)])
def test_keeps_the_newest_rows_in_order(sizes):
    rows = np.random.default_rng(0).normal(size=(sum(sizes), 4))
    recent = RecentRows(VARIABLES, window=7)
    for batch in np.split(rows, np.cumsum(sizes)[:-1]):
        recent.update(batch)
    np.testing.assert_allclose(recent.rows(), rows[-7:], rtol=1e-6)
    assert (len(recent), recent.n_samples) == (min(7, len(rows)), len(rows))


def test_small_motion_far_from_zero_survives_float32():
    rows = 1e6 + 1e-3 * np.random.default_rng(0).normal(size=(100, 4))
    recent = RecentRows(VARIABLES)
    recent.update(rows)
    np.testing.assert_allclose(recent.rows(), rows, atol=1e-8)


def test_pickled_rows_go_on_alike():
    rows = np.random.default_rng(0).normal(size=(12, 4))
    recent = RecentRows(VARIABLES, window=8)
    recent.update(rows[:5])
    copied = pickle.loads(pickle.dumps(recent))
    for ring in (recent, copied):
        ring.update(rows[5:])
    np.testing.assert_array_equal(copied.rows(), recent.rows())
    assert len(pickle.dumps(RecentRows(VARIABLES))) < 10_000


def test_clear_forgets_all():
    recent = RecentRows(VARIABLES)
    recent.update(np.ones((3, 4)))
    recent.clear()
    assert (len(recent), recent.n_samples) == (0, 0)
    with pytest.raises(ValueError, match="no rows have been seen yet"):
        recent.rows()


def test_bad_rows_are_named_and_change_nothing():
    recent = RecentRows(VARIABLES)
    recent.update(np.zeros((0, 4)))
    bad = np.zeros((3, 4))
    bad[1, 2] = np.nan
    with pytest.raises(ValueError, match=r"bad variables \[\"x'\"\]"):
        recent.update(bad)
    with pytest.raises(ValueError, match=r"rows must have shape \(N, 4\)"):
        recent.update(np.zeros((3, 5)))
    assert (len(recent), recent.n_samples) == (0, 0)


@pytest.mark.parametrize("window", [0, 1, 2.5, "9"])
def test_bad_windows_are_errors(window):
    with pytest.raises(ValueError, match="window"):
        RecentRows(VARIABLES, window=window)
