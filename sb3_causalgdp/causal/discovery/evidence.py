"""How sure an edge is, from the size of an effect and its error."""

import numpy as np
import torch as th
from scipy.special import expit, ndtri

FAMILY_ERROR = 0.01  # expected number of edges, of all possible ones, that evidence of one half gives where there are none
POWER = 0.8  # with which an effect of ``detectable_r2`` has evidence of at least one half


def edge_probability(partial_r2: np.ndarray, log_error: np.ndarray, threshold: float, spread: float) -> np.ndarray:
    """
    Probability that an edge is there: ``Phi[ln(partial R^2 / threshold) / sqrt(se^2 + spread^2)]``.

    :param partial_r2: Adjusted partial R^2, at least 0, any shape
    :param log_error: Standard error of its logarithm, the same shape
    :param threshold: Partial R^2 at which the probability is one half
    :param spread: Uncertainty in the logarithm beside that of the sample: how far off the threshold may be
    :return: the same shape; exactly 0 where the partial R^2 is 0 or the probability is below 1e-3
    """
    present = partial_r2 > 0.0
    log_ratio = np.log(np.where(present, partial_r2, 1.0) / threshold)
    score = th.as_tensor(log_ratio / np.sqrt(log_error**2 + spread**2))
    probability = th.special.ndtr(score).numpy()
    return np.where(present & (probability >= 1e-3), probability, 0.0)


def edge_evidence(f_statistic: np.ndarray, n_features: np.ndarray | float, freedom: float, n_tests: int) -> np.ndarray:
    """
    Probability that there is an edge at all, however weak: ``1 / (1 + exp[(z0^2 - z^2) / 2])``, with z the F-test's statistic
    as a standard normal variable (Wilson and Hilferty's cube roots), and z0 what 1 in 100 whole graphs without any edge exceed
    somewhere (Bonferroni).

    :param f_statistic: At least 0, any shape
    :param n_features: Degrees of freedom of its numerator, at least 1, of a shape that goes with it
    :param freedom: Degrees of freedom of its denominator
    :param n_tests: Number of edges that are tested
    :return: the shape of ``f_statistic``; exactly 0 below 1e-3
    """
    z = np.maximum(_as_normal(f_statistic, n_features, freedom), 0.0)
    evidence = expit(0.5 * (z**2 - _z_of_one_half(n_tests) ** 2))
    return np.where(evidence >= 1e-3, evidence, 0.0)


def _z_of_one_half(n_tests: int) -> float:
    return float(-ndtri(FAMILY_ERROR / n_tests))


def _as_normal(f_statistic: np.ndarray, n_features: np.ndarray | float, freedom: float) -> np.ndarray:
    of_cause, of_rest = 2.0 / (9.0 * n_features), 2.0 / (9.0 * freedom)
    root = np.cbrt(f_statistic)
    return (root * (1.0 - of_rest) - (1.0 - of_cause)) / np.sqrt(of_cause + of_rest * root**2)


def detectable_effect(n_features: float, freedom: float, design_effect: np.ndarray, n_tests: int) -> np.ndarray:
    """
    :param n_features: Degrees of freedom of the F-test's numerator
    :param freedom: Degrees of freedom of its denominator
    :param design_effect: How much more the statistic spreads than that of independent rows, at least 1, any shape
    :param n_tests: Number of edges that are tested
    :return: partial R^2 whose evidence is at least one half in four of five samples, the same shape
    """
    of_cause = 2.0 / (9.0 * n_features)
    critical = n_features * (1.0 - of_cause + _z_of_one_half(n_tests) * np.sqrt(of_cause)) ** 3
    # The root of a noncentral chi^2 is about normal, with variance 1
    ratio = design_effect * ((np.sqrt(critical) + ndtri(POWER)) ** 2 - (n_features - 1.0)) / freedom
    return ratio / (1.0 + ratio)
