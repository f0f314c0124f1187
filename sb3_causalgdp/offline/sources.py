"""Recorded transitions to train on: what :mod:`sb3_causalgdp.sources.recorded` opens, if it says all that training needs."""

from typing import Any

from sb3_causalgdp.sources import recorded
from sb3_causalgdp.sources.buffers import preloaded_part_of
from sb3_causalgdp.sources.chunks import as_flags
from sb3_causalgdp.sources.recorded import ArraySource, BufferSource, Chunk, MinariSource, Source, TableSource

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
