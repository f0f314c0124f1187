"""Checks of arguments and arrays that several classes make."""

import math
from collections.abc import MutableMapping
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
    return values.dtype.kind != "f" or bool(np.isfinite(values).all())


def many_are_finite(values: np.ndarray) -> bool:
    """
    As :func:`is_finite`, at half the cost for thousands of numbers: only where all are finite, their sum is, or it overflows.

    :param values: Of any type and shape
    :return: Whether all are finite
    """
    if values.dtype.kind != "f":
        return True
    with np.errstate(over="ignore", invalid="ignore"):
        return bool(np.isfinite(values.sum())) or is_finite(values)


def fits_float32(values: np.ndarray) -> bool:
    """
    :param values: Of any type and shape
    :return: Whether all are finite, and stay so in float32
    """
    if values.dtype.itemsize <= 4 or values.dtype.kind != "f":
        return is_finite(values)
    return bool((np.abs(values) <= LARGEST_FLOAT32).all())


def first_not_finite_index(values: np.ndarray) -> tuple[int, ...]:
    """
    :param values: Numbers that are not all finite in float32
    :return: Index of the first that is not, one number for each axis, at least one
    """
    return tuple(np.argwhere(~(np.abs(np.atleast_1d(values)) <= LARGEST_FLOAT32))[0].tolist())


def check_from_environment(values: Any, name: str, step: int) -> None:
    """
    :param values: What an environment gave: an array, or a dictionary of them
    :param name: What it is
    :param step: Number of environment steps before it
    :raises ValueError: If one is NaN, or infinite in float32, with its index
    """
    if isinstance(values, dict):
        for key, part in values.items():
            check_from_environment(part, f"{name}[{key!r}]", step)
    elif not fits_float32(np.asarray(values)):
        values = np.atleast_1d(values)
        where = first_not_finite_index(values)
        what = f"{name} that is infinite in float32" if np.isfinite(values[where]) else f"NaN or infinite {name}"
        raise ValueError(
            f"The environment returned a {what} at step {step}, index {list(where)}: "
            f"{values[where]}. Nothing of this step was stored; see VecCheckNan to find its origin."
        )


def register(registry: MutableMapping[str, Any], name: str, entry: Any, what: str) -> None:
    """
    Add to a table of names.

    :param registry: The table
    :param name: The new name, an identifier of Python
    :param entry: What it stands for
    :param what: What the table's entries are called
    :raises ValueError: If the name stands for something else already, or is no identifier
    :raises TypeError: If the entry cannot be called
    """
    if not callable(entry):
        raise TypeError(f"{what} must be a class or a function, got {entry!r}")
    if not (isinstance(name, str) and name.isidentifier()):
        raise ValueError(f"name must be an identifier such as 'my_{what.replace(' ', '_')}', got {name!r}")
    if registry.get(name, entry) is not entry:
        raise ValueError(f"name must be new: there is a {what} {name!r} already, {registry[name]!r}")
    registry[name] = entry
