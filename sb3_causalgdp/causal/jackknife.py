"""Standard errors by leaving out blocks of data."""

from collections.abc import Sequence

import numpy as np


def jackknife_error(whole: np.ndarray, parts: Sequence[np.ndarray], shares: Sequence[float]) -> np.ndarray:
    """
    Standard error by the jackknife for blocks of unequal size (Busing, Meijer and van der Leeden, 1999).

    :param whole: Estimate from all data, any shape
    :param parts: For each block, the estimate from all other data, the same shape
    :param shares: For each block, the share of the data that it holds, in (0, 1)
    :return: the same shape; 0 without blocks
    """
    if len(parts) == 0:
        return np.zeros_like(whole)
    stacked = np.stack(list(parts))
    ratio = (1.0 / np.asarray(shares)).reshape(-1, *[1] * whole.ndim)
    pseudo = ratio * whole - (ratio - 1.0) * stacked
    estimate = len(parts) * whole - ((1.0 - 1.0 / ratio) * stacked).sum(axis=0)
    return np.sqrt(((pseudo - estimate) ** 2 / (ratio - 1.0)).mean(axis=0))
