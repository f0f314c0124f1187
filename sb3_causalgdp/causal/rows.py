"""Checked rows of states and actions in the environment's units, and averages over them."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import numpy.typing as npt
import torch as th

from sb3_causalgdp.causal.answers import EffectStatistics


class EffectAverage:
    """Running sums of effects of shape ``(batch, ...)``."""

    def __init__(self) -> None:
        self.n_rows = 0
        self.total: np.ndarray | float = 0.0
        self.total_square: np.ndarray | float = 0.0
        self.total_absolute: np.ndarray | float = 0.0

    def update(self, effects: np.ndarray) -> None:
        self.n_rows += len(effects)
        self.total = self.total + effects.sum(axis=0)
        self.total_square = self.total_square + (effects**2).sum(axis=0)
        self.total_absolute = self.total_absolute + np.abs(effects).sum(axis=0)

    def statistics(self) -> EffectStatistics:
        mean = np.asarray(self.total / self.n_rows)
        if self.n_rows > 1:
            variance = np.maximum(self.total_square - self.n_rows * mean**2, 0.0) / (self.n_rows - 1)
            standard_error = np.sqrt(variance / self.n_rows)
        else:
            standard_error = np.full_like(mean, np.nan)
        return EffectStatistics(mean, standard_error, np.asarray(self.total_absolute / self.n_rows))


def as_array(tensor: th.Tensor) -> np.ndarray:
    """On the processor, in double precision."""
    return tensor.detach().cpu().numpy().astype(np.float64)


def as_numbers(name: str, values: npt.ArrayLike) -> np.ndarray:
    """A copy in double precision, of what is no text that looks like numbers."""
    array = np.asarray(values)
    if array.dtype == object and not any(isinstance(value, str | bytes) for value in array.flat):
        array = array.astype(np.float64)
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name} must be numbers, got {' '.join(repr(values).split())[:100]}")
    return array.astype(np.float64)


def as_vector(name: str, values: npt.ArrayLike, size: int) -> np.ndarray:
    """A number for all, or one for each."""
    array = as_numbers(name, values)
    if array.shape not in ((), (size,)):
        raise ValueError(f"{name} must be a number or have shape ({size},), got {array.shape}")
    return np.broadcast_to(array, (size,)).copy()


def checked_positive(name: str, values: np.ndarray) -> np.ndarray:
    """The values, all above 0."""
    if not (values > 0.0).all():
        raise ValueError(f"{name} must be positive, got {values.min():g}")
    return values


def checked_rows(values: npt.ArrayLike, width: int, name: str) -> np.ndarray:
    """A finite copy of shape (width,) or (batch, width)."""
    rows = as_numbers(name, values)
    if rows.ndim not in (1, 2) or rows.shape[-1] != width or len(rows) == 0:
        raise ValueError(f"{name} must have shape ({width},) or (batch, {width}), got {rows.shape}")
    if not np.isfinite(rows).all():
        raise ValueError(f"{name} must be finite, got {rows[~np.isfinite(rows)][0]}")
    return rows


def same_batch(states: np.ndarray, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Copies with an axis of the batch; a single row meets every row of the other."""
    states, actions = np.atleast_2d(states), np.atleast_2d(actions)
    n_rows = max(len(states), len(actions))
    if {len(states), len(actions)} - {1, n_rows}:
        raise ValueError(f"There are {len(states)} observations but {len(actions)} actions")
    return (
        np.broadcast_to(states, (n_rows, states.shape[1])).copy(),
        np.broadcast_to(actions, (n_rows, actions.shape[1])).copy(),
    )


def as_column(name: str, value: npt.ArrayLike, n_rows: int) -> np.ndarray:
    """A finite value for each row."""
    values = as_vector(name, value, n_rows)
    if not np.isfinite(values).all():
        raise ValueError(f"{name} must be set to finite values, got {values[~np.isfinite(values)][0]}")
    return values


def replace_columns(rows: np.ndarray, names: Sequence[str], values: Mapping[str, np.ndarray]) -> None:
    """Set the columns that have values, by name."""
    for column, name in enumerate(names):
        if name in values:
            rows[:, column] = values[name]


def chunks(n_rows: int, size: int) -> Iterator[slice]:
    """Consecutive slices."""
    return (slice(first, first + size) for first in range(0, n_rows, size))
