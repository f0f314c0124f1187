"""Standard errors by leaving out blocks of data."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt


def jackknife_error(whole: np.ndarray, parts: Sequence[np.ndarray], shares: npt.ArrayLike) -> np.ndarray:
    """
    Standard error by the jackknife for blocks of unequal size (Busing, Meijer and van der Leeden, 1999).

    :param whole: Estimate from all data, any shape
    :param parts: For each block, the estimate from all other data, the same shape
    :param shares: For each block, the share of the data that it holds, in (0, 1), summing to 1
    :return: the same shape; 0 without blocks
    """
    if len(parts) == 0:
        return np.zeros_like(whole)
    held = np.asarray(shares)
    left = 1.0 - held
    # With h = 1 / share and d the change without a block, a pseudo-value less their estimate is sum[(1 - 1/h) d] - (h - 1) d
    changes = np.stack(list(parts))
    changes -= whole
    estimate = np.tensordot(left, changes, axes=1)
    changes *= (left / held).reshape(-1, *[1] * whole.ndim)
    changes -= estimate
    np.square(changes, out=changes)
    return np.sqrt(np.tensordot(held / left / len(parts), changes, axes=1))
