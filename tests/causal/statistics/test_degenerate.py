import numpy as np
import pytest

from sb3_causalgdp.causal import StreamingMoments, TransitionVariables
from sb3_causalgdp.causal.statistics.degenerate import DEPENDENT_SHARE, find_degeneracy, find_limits, variance_inflation

N_ROWS = 2000


def correlation_of(*columns):
    moments = StreamingMoments(len(columns))
    moments.update(np.stack(columns, axis=1))
    return moments.correlation()


def groups_of(*columns):
    return [sorted(group) for group in find_degeneracy(correlation_of(*columns)).groups]


@pytest.fixture
def draws():
    rng = np.random.default_rng(0)
    return [rng.standard_normal(N_ROWS) for _ in range(5)]


@pytest.mark.parametrize("factor", [1.0, -1.0, 1e-4, -2e6])
def test_copies_are_found_whatever_their_scale(draws, factor):
    x, y, *_ = draws
    degeneracy = find_degeneracy(correlation_of(x, y, factor * x + 3.0))
    assert [sorted(group) for group in degeneracy.groups] == [[0, 2]]
    ((copy, (original, sign)),) = degeneracy.stand_in.items()
    assert {copy, original} == {0, 2} and original in degeneracy.kept and copy not in degeneracy.kept
    assert sign == np.sign(factor)


def test_a_sum_and_its_terms_are_one_group(draws):
    x, y, z, *_ = draws
    degeneracy = find_degeneracy(correlation_of(x, y, z, x + y))
    assert [sorted(group) for group in degeneracy.groups] == [[0, 1, 3]]
    assert len(degeneracy.kept) == 3 and 2 in degeneracy.kept
    # The kept ones come first
    assert set(degeneracy.groups[0][:2]) <= set(degeneracy.kept.tolist())


def test_groups_with_a_common_member_become_one(draws):
    x, y, z, u, v = draws
    assert groups_of(x, y, z, x + y, y + z, u, v, -u) == [[0, 1, 2, 3, 4], [5, 7]]


def test_constants_are_in_no_group_and_not_kept(draws):
    x, y, *_ = draws
    degeneracy = find_degeneracy(correlation_of(x, np.full(N_ROWS, 0.1), y, np.full(N_ROWS, 0.1)))
    assert degeneracy.kept.tolist() == [0, 2]
    assert degeneracy.groups == () and degeneracy.stand_in == {}


def test_nothing_moves():
    degeneracy = find_degeneracy(correlation_of(np.ones(10), np.zeros(10)))
    assert len(degeneracy.kept) == 0 and degeneracy.groups == ()


@pytest.mark.parametrize("left", [0.0447, 1e-3])
def test_close_correlation_is_no_dependence(draws, left):
    x, y, z, *_ = draws
    columns = (x, x + left * y, z)
    assert correlation_of(*columns)[0, 1] > 0.998
    assert groups_of(*columns) == []


@pytest.mark.parametrize("mean", [0.0, 10.0, 1e6])
def test_copies_in_a_float32_buffer_are_found(draws, mean):
    x, y, *_ = draws
    sensor = (mean + x).astype(np.float32)
    assert groups_of(sensor, y.astype(np.float32), sensor) == [[0, 2]]


def test_scaled_copies_and_sums_rounded_to_float32_are_found(draws):
    x, y, z, *_ = (draw.astype(np.float32) for draw in draws)
    assert groups_of(x, y, (0.3 * x + 0.2).astype(np.float32), z, (y - 0.7 * z).astype(np.float32)) == [[0, 2], [1, 3, 4]]


def test_a_sensor_with_a_large_mean_and_a_small_motion_is_no_constant(draws):
    x, y, *_ = draws
    assert groups_of(1e6 + 1e-3 * x, y, 2e6 + 2e-3 * x) == [[0, 2]]
    assert groups_of(1e6 + 1e-3 * x, 1e6 + 1e-3 * (x + 0.05 * y)) == []


def test_a_group_shares_its_largest_mask(draws):
    x, y, z, *_ = draws
    degeneracy = find_degeneracy(correlation_of(x, y, x, z))
    assert degeneracy.stand_in == {2: (0, 1.0)}
    masks = np.array([[0.1, 0.2, 0.9, 0.0], [0.5, 0.0, 0.3, 1.0]])
    kept = masks.copy()
    np.testing.assert_array_equal(degeneracy.share(masks), [[0.9, 0.2, 0.9, 0.0], [0.5, 0.0, 0.5, 1.0]])
    np.testing.assert_array_equal(masks, kept)


def test_variance_inflation_is_that_of_the_regression_on_the_others(draws):
    x, y, z, u, _ = draws
    columns = np.stack([x, y + 0.9 * x, z, u - 2.0 * z + 0.3 * y, np.ones(N_ROWS)], axis=1)
    correlation = correlation_of(*columns.T)
    inflation = variance_inflation(correlation, 5)
    for i in range(4):
        others = np.delete(columns, i, axis=1)
        residual = columns[:, i] - others @ np.linalg.lstsq(others, columns[:, i], rcond=None)[0]
        assert inflation[i] == pytest.approx(columns[:, i].var() / residual.var(), rel=1e-5)
    assert inflation[4] == 1.0
    np.testing.assert_allclose(variance_inflation(correlation, 2), inflation[3:])


def test_variance_inflation_of_a_copy_is_huge_but_finite(draws):
    x, y, *_ = draws
    inflation = variance_inflation(correlation_of(x, y, x), 3)
    assert (1e6 < inflation[[0, 2]]).all() and (inflation <= 1e8).all()
    assert inflation[1] == pytest.approx(1.0, abs=0.01)


def plain_pivots(correlation):
    """How many are independent: the textbook's factorisation with pivoting, of the whole matrix."""
    remaining, n_pivots = correlation.copy(), 0
    while (left := np.diagonal(remaining)).max() > DEPENDENT_SHARE:
        pivot = int(left.argmax())
        column = remaining[pivot] / np.sqrt(left[pivot])
        remaining -= np.outer(column, column)
        n_pivots += 1
    return n_pivots


@pytest.mark.parametrize("seed", range(5))
def test_kept_variables_span_all_and_are_as_many_as_pivoting_of_the_whole_matrix_keeps(seed):
    """Copies, sums, tiny differences of nearly equal variables: what makes a factorisation in the given order go wrong."""
    rng = np.random.default_rng(seed)
    columns = list(rng.standard_normal((12, N_ROWS)))
    for _ in range(8):
        i, j = rng.choice(len(columns), 2, replace=False)
        columns.append(columns[i] + 10.0 ** -rng.integers(0, 6) * columns[j])
        columns.append((columns[-1] - columns[i]) * 1e5)
    order = rng.permutation(len(columns))
    correlation = correlation_of(*(columns[i] for i in order))
    degeneracy = find_degeneracy(correlation)
    assert len(degeneracy.kept) == plain_pivots(correlation)
    kept = np.stack([columns[i] for i in order], axis=1)[:, degeneracy.kept]
    everything = np.stack([columns[i] for i in order], axis=1)
    everything = (everything - everything.mean(axis=0)) / everything.std(axis=0)
    kept = (kept - kept.mean(axis=0)) / kept.std(axis=0)
    left = everything - kept @ np.linalg.lstsq(kept, everything, rcond=None)[0]
    assert (left.var(axis=0) < 10.0 * DEPENDENT_SHARE).all()
    assert set(degeneracy.stand_in) == set(range(len(columns))) - set(degeneracy.kept.tolist())


def test_limits_name_what_the_data_cannot_say(draws):
    x, y, z, u, v = draws
    variables = TransitionVariables(("x", "y", "copy"), ("push", "still"))
    action = x + 0.1 * z
    rows = variables.stack(
        np.stack([x, y, 3.0 * x], axis=1), np.stack([action, np.ones(N_ROWS)], axis=1), np.stack([u, v, action], axis=1), y
    )
    moments = StreamingMoments(variables.n_variables)
    moments.update(rows)
    limits = find_limits(moments.correlation(), variables)
    assert limits.constant_variables == ("still",)
    assert limits.duplicated_variables == (("x", "copy"), ("copy'", "push"))
    assert limits.of_dynamics.kept.tolist() == [0, 1, 3] and limits.of_reward.kept.tolist() == [0, 1, 2]
    assert limits.action_vif == pytest.approx([101.0, 1.0], rel=0.1)
    remarks = limits.remarks()
    assert remarks["found_at"].endswith("+00:00") and remarks["action_vif"] is limits.action_vif


def test_a_group_of_states_and_next_states_is_listed_once(draws):
    x, y, z, u, _ = draws
    variables = TransitionVariables(("x", "copy"), ("push",))
    moments = StreamingMoments(variables.n_variables)
    moments.update(variables.stack(np.stack([x, -x], axis=1), y[:, None], np.stack([z, -z], axis=1), u))
    assert find_limits(moments.correlation(), variables).duplicated_variables == (("x", "copy"),)
