import time

import numpy as np
import pytest

from benchmarks.discovery import metrics
from benchmarks.discovery.methods import (
    PEERS,
    Outcome,
    agreement,
    allowed_edges,
    cut,
    load,
    load_all,
    objective,
    run_limited,
    standardise,
)
from benchmarks.discovery.systems import generate
from sb3_causalgdp.causal import TransitionVariables

VARIABLES = TransitionVariables(("x", "y"), ("u",))


def test_the_cut_reads_causes_of_next_states_and_of_the_reward():
    weights = np.arange(36.0).reshape(6, 6)  # columns x, y, u, x', y', reward
    np.testing.assert_array_equal(cut(weights, VARIABLES), [[3, 9, 15], [4, 10, 16], [23, 29, 17]])
    assert allowed_edges(VARIABLES).sum() == 9
    assert cut(allowed_edges(VARIABLES), VARIABLES).all()


def test_standardised_constants_are_zero():
    standardised = standardise(np.array([[1.0, 5.0], [3.0, 5.0]]))
    np.testing.assert_array_equal(standardised, [[-1.0, 0.0], [1.0, 0.0]])


@pytest.mark.parametrize("name", ["notears", "correlation", "lasso", "lasso_cv"])
def test_linear_edges_are_found(name):
    rows, variables, edges = generate("linear", 1000, seed=0)
    estimate = load(name)(rows, variables)
    assert estimate.ranking.shape == estimate.masks.shape == estimate.effects.shape == edges.shape
    assert metrics.auroc(estimate.ranking, edges) > 0.85


def test_lasso_of_the_same_sparsity_is_our_notears():
    rows, variables, _ = generate("linear", 1000, seed=0)
    np.testing.assert_allclose(load("lasso")(rows, variables).effects, load("notears")(rows, variables).effects, atol=2e-3)


def test_agreement_and_objective_say_who_solves_the_same_problem():
    rows, variables, _ = generate("linear", 1000, seed=0)
    ours, same, other = (load(name)(rows, variables) for name in ("notears", "lasso", "correlation"))
    gaps = agreement(same, ours)
    assert gaps["weight_gap"] < 2e-3 and gaps["support_gap"] == 0
    assert agreement(ours, ours) == {"weight_gap": 0.0, "support_gap": 0}
    assert agreement(other, ours)["support_gap"] > 0
    least, near, far = (objective(estimate.weights, rows, variables) for estimate in (ours, same, other))
    assert least <= near + 1e-6 < far
    # Half the variance of each of the n + 1 effects is left by no edges
    assert objective(np.zeros_like(ours.weights), rows, variables) == pytest.approx(0.5 * (variables.n_states + 1))


def test_a_missing_peer_is_skipped_with_a_line(monkeypatch, capsys):
    def missing():
        raise ImportError("No module named 'lingam'")

    monkeypatch.setitem(PEERS, "lingam", missing)
    assert list(load_all(["correlation", "lingam"], {})) == ["correlation"]
    assert "lingam: skipped" in capsys.readouterr().err


def test_an_unknown_method_is_an_error():
    with pytest.raises(ValueError, match="unknown method"):
        load("astrology")


def test_a_child_returns_its_value_its_seconds_or_its_error():
    outcome = run_limited(lambda: 3, limit_s=20)
    assert (outcome.status, outcome.value) == ("ok", 3)
    failed = run_limited(lambda: 1 // 0, limit_s=20)
    assert failed.status == "failed" and "ZeroDivisionError" in failed.error


def test_seconds_of_a_child_are_finer_than_the_ticks_of_its_limit():
    assert 0.0 < run_limited(lambda: sum(range(10_000)), limit_s=20).cpu_seconds < 2e-3


def test_a_child_over_its_limit_is_ended():
    def endless() -> Outcome:
        while True:
            time.process_time()

    assert run_limited(endless, limit_s=1).status == "> limit"
