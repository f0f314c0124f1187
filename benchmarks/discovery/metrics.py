"""How close an estimated graph is to the true one. Arguments are flat or any shape; both of the same."""

import numpy as np
import numpy.typing as npt
from scipy.stats import rankdata, spearmanr


def auroc(scores: npt.ArrayLike, truth: npt.ArrayLike) -> float:
    """
    Probability that a true edge scores above a false one; ties count half.

    :param scores: Larger for likelier edges
    :param truth: Boolean
    :return: value in [0, 1]; NaN when all edges are true or none is
    """
    scores, truth = np.ravel(scores), np.ravel(truth).astype(bool)
    n_true, n_false = int(truth.sum()), int((~truth).sum())
    if n_true == 0 or n_false == 0:
        return float("nan")
    return float((rankdata(scores)[truth].sum() - n_true * (n_true + 1) / 2) / (n_true * n_false))


def f1(masks: npt.ArrayLike, truth: npt.ArrayLike, threshold: float = 0.5) -> float:
    """
    Harmonic mean of precision and recall of the edges whose mask is at least the threshold.

    :param masks: Values in [0, 1]
    :param truth: Boolean
    :param threshold: Smallest mask of an edge
    :return: value in [0, 1]; 1 when there are no edges and none was found
    """
    found, truth = np.ravel(masks) >= threshold, np.ravel(truth).astype(bool)
    wrong = int((found != truth).sum())
    hits = int((found & truth).sum())
    return 1.0 if hits + wrong == 0 else 2.0 * hits / (2.0 * hits + wrong)


def shd(masks: npt.ArrayLike, truth: npt.ArrayLike, threshold: float = 0.5) -> int:
    """
    Structural Hamming distance; time fixes every direction, so it is the number of missing and superfluous edges.

    :param masks: Values in [0, 1]
    :param truth: Boolean
    :param threshold: Smallest mask of an edge
    """
    return int(((np.ravel(masks) >= threshold) != np.ravel(truth).astype(bool)).sum())


def brier(masks: npt.ArrayLike, truth: npt.ArrayLike) -> float:
    """
    Mean squared difference of probability and truth.

    :param masks: Probabilities
    :param truth: Boolean
    """
    return float(((np.ravel(masks) - np.ravel(truth).astype(float)) ** 2).mean())


def ece(masks: npt.ArrayLike, truth: npt.ArrayLike, n_bins: int = 10) -> float:
    """
    Expected calibration error: mean gap, over bins of equal width, of the mean probability and the share of true edges.

    :param masks: Probabilities
    :param truth: Boolean
    :param n_bins: Number of bins of [0, 1]
    """
    masks, truth = np.ravel(masks), np.ravel(truth).astype(float)
    bins = np.minimum((masks * n_bins).astype(int), n_bins - 1)
    gaps = [abs((masks[bins == b] - truth[bins == b]).sum()) for b in range(n_bins)]
    return float(sum(gaps) / len(masks))


def spearman(scores: npt.ArrayLike, effects: npt.ArrayLike) -> float:
    """
    Rank correlation.

    :param scores: Estimated strengths
    :param effects: True sizes of the effects
    :return: value in [-1, 1]; NaN when either is constant
    """
    scores, effects = np.ravel(scores), np.ravel(effects)
    if np.ptp(scores) == 0 or np.ptp(effects) == 0:
        return float("nan")
    return float(spearmanr(scores, effects).statistic)
