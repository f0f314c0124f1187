"""Checks of arguments that several classes take."""

import math
from typing import Any


def check_at_least_zero(**values: Any) -> None:
    """
    :param values: Numbers by the names of the arguments that they were given for
    :raises ValueError: If one is negative, infinite or NaN
    """
    for name, value in values.items():
        if not 0.0 <= value < math.inf:
            raise ValueError(f"{name} must be a finite number of at least 0, got {value!r}")


def is_count(value: Any) -> bool:
    """
    :param value: What was given for an argument
    :return: Whether it is an integer of at least 1
    """
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1
