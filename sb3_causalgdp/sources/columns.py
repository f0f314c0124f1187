"""Tables as columns by name: CSV, Parquet and numpy files, data frames of pandas, polars and Arrow, dictionaries of arrays."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

SUFFIXES = (".csv", ".tsv", ".parquet", ".npy", ".npz")
"""Of files that :func:`read_columns` reads."""
SEPARATORS = {".csv": ",", ".tsv": "\t"}


def is_frame(source: Any) -> bool:
    """
    :param source: Anything
    :return: Whether it is a data frame of pandas or polars, an Arrow table or a structured array
    """
    if isinstance(source, np.ndarray):
        return source.dtype.names is not None
    has_names = hasattr(source, "columns") or hasattr(source, "column_names")
    return has_names and hasattr(source, "__getitem__") and not isinstance(source, Mapping)


def columns_of(source: Any) -> dict[str, np.ndarray]:
    """
    :param source: A data frame, an Arrow table, a structured array, a mapping of arrays, an array of shape (N, m), or the path
        of a file
    :return: one array of shape (N,) for each column; the columns of an array of shape (N, m) are ``name[0]`` to
        ``name[m - 1]``, those of an array without a name ``0`` to ``m - 1``
    :raises TypeError: when it is none of these
    :raises ValueError: when it cannot be read, or columns differ in length
    """
    if isinstance(source, str | os.PathLike):
        return read_columns(source)
    if isinstance(source, np.ndarray) and source.dtype.names is None:
        return _split({"": source})
    if isinstance(source, np.ndarray):
        return _split({name: source[name] for name in source.dtype.names or ()})
    if isinstance(source, Mapping):
        return _split({str(name): np.asarray(values) for name, values in source.items()})
    if not is_frame(source):
        raise TypeError(
            "a table is a data frame of pandas or polars, an Arrow table, a mapping of arrays, an array or the path of a "
            f"file, got {type(source).__name__}"
        )
    names = source.column_names if hasattr(source, "column_names") else source.columns
    return _split({str(name): _values(source[name], str(name)) for name in names})


def _values(column: Any, name: str) -> np.ndarray:
    values = column.to_numpy() if hasattr(column, "to_numpy") else np.asarray(column)
    if values.ndim != 1:
        raise ValueError(f"column {name!r} occurs more than once")
    return values


def _split(arrays: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    columns: dict[str, np.ndarray] = {}
    for name, values in arrays.items():
        if values.ndim == 0 or values.ndim > 2:
            raise ValueError(f"column {name!r} must have the shape (N,) or (N, m), got {values.shape}")
        if values.ndim == 1:
            columns[name] = values
        else:
            columns |= {f"{name}[{i}]" if name else str(i): values[:, i] for i in range(values.shape[1])}
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"columns must have a value in each row, got lengths {lengths}")
    return columns


def read_columns(path: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """
    :param path: A file of one of :data:`SUFFIXES`
    :return: its columns, see :func:`columns_of`
    :raises FileNotFoundError: when there is none
    :raises ImportError: when what reads it is missing
    :raises ValueError: when it cannot be read
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path} is no table: a file of {', '.join(SUFFIXES)} is needed")
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {str(path)!r}")
    try:
        if suffix in (".npy", ".npz"):
            content = np.load(path, allow_pickle=False)
            return _split(dict(content)) if suffix == ".npz" else columns_of(content)
        return columns_of(_read_frame(path, suffix))
    except ImportError:
        raise
    except Exception as error:  # of the library that reads it
        raise ValueError(f"{path} cannot be read as a table: {' '.join(str(error).split())[:200]}") from error


def _read_frame(path: Path, suffix: str) -> Any:
    try:
        import pandas as pd
    except ImportError as error:
        raise ImportError(f"pandas is needed to read {path.name}: pip install pandas") from error
    if suffix in SEPARATORS:
        _check_separator(path, SEPARATORS[suffix])
        return pd.read_csv(path, sep=SEPARATORS[suffix])
    try:
        return pd.read_parquet(path)
    except ImportError as error:
        raise ImportError(f"pyarrow is needed to read {path.name}: pip install pyarrow") from error


def _check_separator(path: Path, separator: str) -> None:
    with path.open(encoding="utf-8", errors="replace") as file:
        names, first = file.readline(), file.readline()
    other = next((sign for sign in (";", "\t", ",", "|") if sign in names and sign in first), None)
    if separator not in names and other is not None:
        raise ValueError(
            f"its values are separated by {other!r}, not by {separator!r}: write it anew with {separator!r}, or in "
            f"Python give pandas.read_csv(path, sep={other!r}), with decimal=',' where numbers have commas"
        )
