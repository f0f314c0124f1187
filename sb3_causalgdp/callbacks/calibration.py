"""How pessimistic TD targets are: as much as makes what the critics promise and what is obtained agree."""

from typing import NamedTuple

import numpy as np

RATE = 0.25
LARGEST_STEP = 0.25
OPTIMISM = 0.1  # what was obtained is that of an older policy with exploration noise
FEWEST_HORIZONS = 20  # of updates, before critics are held to what they say


class QErrors(NamedTuple):
    """
    What critics said of the newest transitions, and what was obtained from there on.

    :param of_mean: Mean of the critics less the discounted return
    :param of_smallest: The smallest critic less the discounted return
    :param gap: The mean of the critics less the smallest, at least 0
    :param obtained: The discounted return
    """

    of_mean: float
    of_smallest: float
    gap: float
    obtained: float

    @classmethod
    def of(cls, q_values: np.ndarray, returns: np.ndarray) -> "QErrors":
        """
        :param q_values: Of each critic, shape ``(n, n_critics)``
        :param returns: Discounted returns from there on, shape ``(n,)``
        :return: Means over the n transitions
        """
        mean, smallest = q_values.mean(axis=1), q_values.min(axis=1)
        errors = (mean - returns).mean(), (smallest - returns).mean(), (mean - smallest).mean()
        return cls(*map(float, (*errors, returns.mean())))


def calibrated(pessimism: float, errors: QErrors, discount: float) -> float:
    """
    A damped Newton step towards critics that promise a tenth more than was obtained. The gap between the critics' mean and the
    smallest enters each TD target, so that a change of the pessimism moves Q by the gap times the discounted horizon.
    Calibrating by recent returns is ACC's idea (Dorka et al., 2021, https://arxiv.org/abs/2111.12673).

    :param pessimism: That of the TD targets until now, in [0, 1]
    :param errors: Of the newest transitions
    :param discount: Of one backup: gamma, or gamma^n for n-step returns
    :return: That of the TD targets from now on, in [0, 1]
    """
    if errors.gap == 0.0:
        return pessimism
    excess = errors.of_mean - OPTIMISM * abs(errors.obtained)
    step = RATE * excess * (1.0 - discount) / errors.gap
    return float(np.clip(pessimism + np.clip(step, -LARGEST_STEP, LARGEST_STEP), 0.0, 1.0))
