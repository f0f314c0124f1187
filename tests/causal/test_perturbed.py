import pickle

import numpy as np
import pytest
from sklearn.metrics import roc_auc_score

from sb3_causalgdp.causal import (
    DISCOVERY_METHODS,
    StreamingMoments,
    TransitionVariables,
    discover,
    make_discovery,
    make_statistics,
)
from sb3_causalgdp.causal.discovery.perturbed import NoisyMoments, NoisyStatistics, Perturbed

VARIABLES = TransitionVariables(("x", "y", "z"), ("u", "v"))


def chain(n_rows=4_000, seed=0):
    """x' <- x, u;  y' <- x, y;  z' <- y, v, with strongly correlated states; and which edges there are."""
    rng = np.random.default_rng(seed)
    state = rng.normal(size=(n_rows, 3)) @ (0.3 * np.eye(3) + 0.5)
    action = rng.uniform(-1, 1, (n_rows, 2))
    x, y, _ = state.T
    after = np.stack([x + 2 * action[:, 0], y - x, 0.5 * y + action[:, 1]], axis=1) + 0.1 * rng.normal(size=(n_rows, 3))
    edges = np.array([[1, 0, 0, 1, 0], [1, 1, 0, 0, 0], [0, 1, 0, 0, 1]], dtype=bool)
    return VARIABLES.stack(state, action, after, after[:, 0]), edges


def auroc(rows, edges, **kwargs):
    return roc_auc_score(edges.ravel(), np.abs(discover("perturbed", rows, VARIABLES, **kwargs).effects[:-1]).ravel())


def test_more_noise_finds_worse_edges():
    rows, edges = chain()
    scores = [auroc(rows, edges, noise=noise) for noise in (0.0, 2.0, 5.0)]
    assert scores[0] > scores[1] > scores[2]


@pytest.mark.parametrize("method", ["notears", "partial_r2"])
def test_without_noise_it_is_the_wrapped_method(method):
    rows, _ = chain(1_000)
    plain, wrapped = discover(method, rows, VARIABLES), discover("perturbed", rows, VARIABLES, method=method, noise=0.0)
    np.testing.assert_array_equal(wrapped.masks, plain.masks)
    np.testing.assert_array_equal(wrapped.effects, plain.effects)
    assert wrapped.method == f"perturbed_{method}"


def test_moments_with_noise_are_those_of_many_draws():
    rows, _ = chain(200_000)
    moments = StreamingMoments(VARIABLES.n_variables, n_blocks=2)
    moments.update(rows)
    noisy = np.arange(rows.shape[1]) < 8
    drawn = StreamingMoments(VARIABLES.n_variables)
    drawn.update(rows + 0.5 * noisy * rows.std(axis=0) * np.random.default_rng(1).normal(size=rows.shape))
    view = NoisyMoments(moments, 0.5, noisy)
    np.testing.assert_allclose(view.correlation(), drawn.correlation(), atol=0.01)
    np.testing.assert_allclose(view.standard_deviation(), drawn.standard_deviation(), rtol=0.01)
    assert len(view.blocks) == 2
    for block in view.blocks:
        np.testing.assert_allclose(block.covariance(), drawn.covariance(), rtol=0.05, atol=0.05)
        np.testing.assert_allclose(block.squares, np.diagonal(block.comoment))


def test_the_same_moments_serve_the_method_without_noise():
    rows, _ = chain(500)
    moments = StreamingMoments(VARIABLES.n_variables)
    moments.update(rows)
    before = moments.covariance().copy()
    Perturbed(noise=1.0)(moments, VARIABLES)
    np.testing.assert_array_equal(moments.covariance(), before)


def test_drawn_noise_is_seeded_and_grows_the_variance_of_causes_alone():
    rows, _ = chain(5_000)
    rows[:, 1] = 4.0
    method = Perturbed("partial_r2", noise=2.0, seed=3)
    first, second = (make_statistics(method, VARIABLES) for _ in range(2))
    for statistics in (first, second):
        assert isinstance(statistics, NoisyStatistics)
        statistics.update(rows)
    seen = first.statistics.raw.standard_deviation()
    np.testing.assert_array_equal(seen, second.statistics.raw.standard_deviation())
    np.testing.assert_allclose((seen / np.where(rows.std(axis=0) > 0, rows.std(axis=0), 1.0))[[0, 3, 6]], 5**0.5, rtol=0.05)
    assert seen[1] == 0.0 and seen[-1] == pytest.approx(rows[:, -1].std())
    assert first.n_samples == 5_000


def test_a_method_and_its_arguments_can_be_named():
    method = make_discovery("perturbed", method="notears", noise=0.5, sparsity=0.2)
    assert method.noise == 0.5 and method.method.sparsity == 0.2
    assert DISCOVERY_METHODS["perturbed"] is Perturbed
    assert make_discovery("perturbed", method=method.method).method is method.method


def test_bad_arguments_are_errors():
    for noise in (-0.1, np.nan, "0.1", True):
        with pytest.raises(ValueError, match="noise must be a finite number 0 or above"):
            Perturbed(noise=noise)
    with pytest.raises(ValueError, match=r"unknown arguments \['colour'\] for discovery method 'notears'"):
        make_discovery("perturbed", colour=1)
    with pytest.raises(ValueError, match="unknown discovery method 'nope'"):
        make_discovery("perturbed", method="nope")
    with pytest.raises(ValueError, match="make_statistics"):
        Perturbed()("rows", VARIABLES)


def test_rows_that_are_not_finite_are_named():
    statistics = make_statistics(Perturbed("partial_r2"), VARIABLES)
    rows, _ = chain(50)
    rows[3, 4] = np.nan
    with pytest.raises(ValueError, match=r"bad variables \['v'\]"):
        statistics.update(rows)
    assert statistics.n_samples == 0


def test_too_few_rows_is_the_wrapped_methods_error():
    rows, _ = chain(4)
    with pytest.raises(ValueError, match="at least 7 rows"):
        discover("perturbed", rows, VARIABLES)


@pytest.mark.parametrize("inner", ["notears", "partial_r2"])
def test_pickled_method_and_statistics_go_on_alike(inner):
    rows, _ = chain(1_000)
    method = Perturbed(inner, noise=0.3)
    statistics = make_statistics(method, VARIABLES)
    statistics.update(rows[:500])
    copied_method, copied = pickle.loads(pickle.dumps((method, statistics)))
    statistics.update(rows[500:])
    copied.update(rows[500:])
    np.testing.assert_array_equal(copied_method(copied, VARIABLES).effects, method(statistics, VARIABLES).effects)
