"""Recorded transitions to train on: what :mod:`sb3_causalgdp.sources.recorded` opens, if it says all that training needs."""

from collections.abc import MutableMapping
from inspect import signature
from typing import Any

from sb3_causalgdp.sources import recorded
from sb3_causalgdp.sources.buffers import preloaded_part_of
from sb3_causalgdp.sources.chunks import as_flags
from sb3_causalgdp.sources.recorded import ArraySource, BufferSource, Chunk, MinariSource, Source, TableSource
from sb3_causalgdp.sources.tables import Table

__all__ = [
    "ArraySource",
    "BufferSource",
    "Chunk",
    "MinariSource",
    "Source",
    "TableSource",
    "as_flags",
    "open_source",
    "preloaded_part_of",
    "with_columns",
]


def open_source(source: Any, download: bool = True, trusted: bool = False) -> Source:
    """
    :param source: What :func:`sb3_causalgdp.sources.recorded.open_source` takes
    :param download: Whether to download a Minari dataset that is not on this machine
    :param trusted: Whether a pickled buffer may hold more than what SB3's own are made of, which could run code
    :return: The source, of which no row has been read
    :raises ValueError: If it cannot be used, is empty, or does not tell where episodes end and what was observed there
    """
    found = recorded.open_source(source, download, trusted)
    if found.lack is not None:
        raise ValueError(found.lack)
    if found.n_transitions == 0:
        raise ValueError(f"{found.name} is empty: it holds no transitions")
    return found


def with_columns(source: Any, keywords: MutableMapping[str, Any]) -> Any:
    """
    :param source: What a user gave
    :param keywords: What they said beside it; arguments of :class:`~sb3_causalgdp.sources.tables.Table` are taken out
    :return: The source as a table, where it was said what its columns are
    """
    names = [name for name in signature(Table).parameters if name in keywords]
    if isinstance(source, Table) or not {"states", "actions", "reward"} & set(names):
        return source
    missing = [name for name in ("states", "actions", "reward") if name not in names]
    if missing:
        raise ValueError(f"a table needs {', '.join(f'{name}=' for name in missing)}, too: got {', '.join(names)}")
    return Table(source, **{name: keywords.pop(name) for name in names})
