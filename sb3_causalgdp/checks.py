"""Checks of arguments and arrays that several classes make."""

import math
from typing import Any

import numpy as np

LARGEST_FLOAT32 = float(np.finfo(np.float32).max)


def check_at_least_zero(**values: Any) -> None:
    """
    :param values: Numbers by the names of the arguments that they were given for
    :raises ValueError: If one is negative, infinite or NaN
    """
    for name, value in values.items():
        if not 0.0 <= value < math.inf:
            raise ValueError(f"{name} must be a finite number of at least 0, got {value!r}")


def is_finite(values: np.ndarray) -> bool:
    """
    :param values: Of any type and shape
    :return: Whether all are finite
    """
    if values.dtype.kind != "f":
        return True
    flat = values.ravel()
    # In half of the time, and only where the sum of the squares is not finite has each value to be looked at
    return math.isfinite(flat.dot(flat)) or bool(np.isfinite(flat).all())


def fits_float32(values: np.ndarray) -> bool:
    """
    :param values: Of any type and shape
    :return: Whether all are finite, and stay so in float32
    """
    if values.dtype.itemsize <= 4 or values.dtype.kind != "f":
        return is_finite(values)
    flat = values.ravel()
    return bool(flat.dot(flat) < 1e76 or (np.abs(flat) <= LARGEST_FLOAT32).all())


def first_not_finite_index(values: np.ndarray) -> tuple[int, ...]:
    """
    :param values: Numbers that are not all finite in float32
    :return: Index of the first that is not, one number for each axis, at least one
    """
    return tuple(np.argwhere(~(np.abs(np.atleast_1d(values)) <= LARGEST_FLOAT32))[0].tolist())
