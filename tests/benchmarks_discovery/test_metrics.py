import math

import numpy as np
import pytest
from sklearn.metrics import roc_auc_score

from benchmarks.discovery import metrics

MASKS = [0.95, 0.5, 0.4, 0.05]
TRUTH = [True, False, True, False]


def test_metrics_equal_hand_computed_values():
    assert metrics.auroc(MASKS, TRUTH) == 0.75  # three of four pairs in order
    assert metrics.f1(MASKS, TRUTH) == 0.5  # one hit, one superfluous, one missing
    assert metrics.shd(MASKS, TRUTH) == 2
    assert metrics.brier(MASKS, TRUTH) == pytest.approx((0.05**2 + 0.5**2 + 0.6**2 + 0.05**2) / 4)
    assert metrics.ece(MASKS, TRUTH) == pytest.approx((0.05 + 0.5 + 0.6 + 0.05) / 4)
    assert metrics.spearman([1, 2, 3, 4], [10, 20, 40, 30]) == pytest.approx(0.8)


def test_calibration_error_compares_means_of_a_bin():
    assert metrics.ece([0.75, 0.75, 0.75, 0.75], [True, True, True, False]) == 0.0
    assert metrics.ece([1.0, 0.0], [True, False]) == 0.0


def test_auroc_counts_ties_as_half_and_equals_scikit_learn():
    assert metrics.auroc([0.0, 0.0, 0.0], [True, False, False]) == 0.5
    rng = np.random.default_rng(0)
    scores, truth = rng.integers(0, 5, 100), rng.random(100) < 0.3
    assert metrics.auroc(scores, truth) == pytest.approx(roc_auc_score(truth, scores))


def test_what_is_not_defined_is_nan():
    assert math.isnan(metrics.auroc([0.1, 0.2], [True, True]))
    assert math.isnan(metrics.spearman([0.0, 0.0], [1.0, 2.0]))
    assert metrics.f1([0.0, 0.1], [False, False]) == 1.0
