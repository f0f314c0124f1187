"""Groups of variables from their names: neighbours that begin with the same words, such as one key, body or joint."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

MAX_GROUPS = 20  # of the states, and of the actions
GROUP_SIZES = [size * power for power in (1, 10, 100, 1_000, 10_000) for size in (1, 2, 5)]
SHORT = 5  # smaller groups are named by their first and last member


@dataclass(frozen=True)
class _Group:
    names: tuple[str, ...]
    depth: int  # number of words that they have in common


def groups_of_names(names: Sequence[str]) -> dict[str, str]:
    """
    :param names: Names of variables
    :return: the name of the group of each: as many groups as there may be, the largest ones split first
    """
    groups = _runs(names, 1)
    if len(groups) > MAX_GROUPS:
        groups = [_Group(tuple(names), 0)]
        return _named(_in_ranges(groups))
    is_split = True
    while is_split:
        is_split = False
        for position in sorted(range(len(groups)), key=lambda position: -len(groups[position].names)):
            parts = _parts(groups[position])
            if 1 < len(parts) <= MAX_GROUPS - len(groups) + 1:
                groups[position : position + 1] = parts
                is_split = True
                break
    return _named(_in_ranges(groups))


def _words(name: str) -> list[str]:
    return re.findall(r"[^\s._\[\]/()]+", name) or [name]


def _runs(names: Sequence[str], depth: int) -> list[_Group]:
    return [_Group(tuple(run), depth) for _, run in groupby(names, key=lambda name: _words(name)[:depth])]


def _parts(group: _Group) -> list[_Group]:
    """By the first word in which they differ."""
    for depth in range(group.depth + 1, max(map(len, map(_words, group.names))) + 1):
        parts = _runs(group.names, depth)
        if len(parts) > 1:
            return parts
    return [group]


def _in_ranges(groups: Sequence[_Group]) -> list[_Group]:
    """Numbered names, or those with nothing in common, in ranges of the smallest round size with few enough groups."""
    for size in GROUP_SIZES:
        ranges = []
        for group in groups:
            step = size if group.depth == 0 or len({_stem(name) for name in group.names}) == 1 else len(group.names)
            ranges += [_Group(group.names[i : i + step], group.depth) for i in range(0, len(group.names), step)]
        if len(ranges) <= MAX_GROUPS:
            break
    return ranges


def _named(groups: Sequence[_Group]) -> dict[str, str]:
    labels = [_label(group) for group in groups]
    counts = Counter(labels)
    labels = [label if counts[label] == 1 else _range(group.names) for label, group in zip(labels, groups, strict=True)]
    return {name: label for group, label in zip(groups, labels, strict=True) for name in group.names}


def _label(group: _Group) -> str:
    """``obs[0..19]`` for a range of one stem, ``78 contact forces`` for what begins alike."""
    names = group.names
    if len(names) == 1 or len({_stem(name) for name in names}) == 1:
        return _range(names)
    depth = group.depth
    while depth < len(_words(names[0])) and len({tuple(_words(name)[: depth + 1]) for name in names}) == 1:
        depth += 1
    if depth == 0 or len(names) < SHORT:
        return _range(names)
    # As it is written: the words with what stands between them
    match = re.match(r"[\s._\[\]/()]*" + r"[\s._\[\]/()]+".join(map(re.escape, _words(names[0])[:depth])), names[0])
    return f"{len(names)} {match.group() if match else names[0]}"


def _stem(name: str) -> str:
    """The name without the number at its end: ``obs`` for ``obs[12]``."""
    return re.sub(r"[\[_ ]?\d+\]?$", "", name)


def _range(names: Sequence[str]) -> str:
    """``obs[0..19]`` for ``obs[0]`` to ``obs[19]``."""
    first, last = names[0], names[-1]
    if len(names) == 1:
        return first
    stem = _stem(first)
    if stem == _stem(last):
        opening = first[len(stem) :].rstrip("]")
        return f"{stem}{opening}..{re.sub(r'^[^0-9]*', '', last[len(stem) :])}"
    # Words that both begin with are said once
    common = 0
    while _words(first)[: common + 1] == _words(last)[: common + 1]:
        common += 1
    rest = last
    for word in _words(last)[:common]:
        rest = rest[rest.index(word) + len(word) :].lstrip(" ._[/(")
    return f"{first}..{rest}"
