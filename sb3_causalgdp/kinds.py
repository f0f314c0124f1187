"""Kinds of values that arguments accept: what is stored of them, and how errors call them."""

import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th

LONGEST = 100
"""Of a list, where nothing else is said."""


class NotAcceptedError(ValueError):
    """A value is not of a kind."""


@dataclass(frozen=True)
class Kind:
    """
    What an argument accepts.

    :param words: What that is, to stand behind "must be"; a function where it can change, as names can be registered
    :param read: Gives what is to be stored, or raises :class:`NotAcceptedError`
    """

    words: str | Callable[[], str]
    read: Callable[[Any], Any]

    @property
    def accepted(self) -> str:
        """What is accepted by now, in words."""
        return self.words if isinstance(self.words, str) else self.words()

    def __or__(self, other: "Kind") -> "Kind":
        def read(value: Any) -> Any:
            try:
                return self.read(value)
            except NotAcceptedError:
                return other.read(value)

        return Kind(lambda: f"{self.accepted} or {other.accepted}", read)


def accepts(
    words: str | Callable[[], str], condition: Callable[[Any], bool], convert: Callable[[Any], Any] = lambda value: value
) -> Kind:
    """
    :param words: What is accepted, to stand behind "must be"
    :param condition: Whether a value is accepted
    :param convert: Gives what is to be stored
    :return: What satisfies the condition
    """

    def read(value: Any) -> Any:
        if not condition(value):
            raise NotAcceptedError
        return convert(value)

    return Kind(words, read)


def as_text(number: float) -> str:
    """
    :param number: A number
    :return: As errors write it
    """
    return f"{number:,}" if isinstance(number, int) else f"{number:g}"


def integer(low: int, high: int) -> Kind:
    """
    :param low: The smallest
    :param high: The largest
    :return: Integers, also numpy's, which become Python's
    """

    def condition(value: Any) -> bool:
        return isinstance(value, (int, np.integer)) and not isinstance(value, bool) and bool(low <= value <= high)

    return accepts(f"an integer from {as_text(low)} to {as_text(high)}", condition, int)


def number(low: float, high: float, above: bool = False) -> Kind:
    """
    :param low: The smallest
    :param high: The largest
    :param above: Whether it has to be larger than ``low``
    :return: Numbers, also numpy's, which become Python's
    """

    def condition(value: Any) -> bool:
        if not isinstance(value, (int, float, np.integer, np.floating)) or isinstance(value, bool):
            return False
        return bool((low < value if above else low <= value) and value <= high)

    bounds = f"above {as_text(low)} and at most {as_text(high)}" if above else f"from {as_text(low)} to {as_text(high)}"
    return accepts(f"a number {bounds}", condition, lambda value: value if type(value) is int else float(value))


NONE = accepts("None", lambda value: value is None)
FLAG = accepts("True or False", lambda value: isinstance(value, (bool, np.bool_)), bool)
TEXT = accepts("a string", lambda value: isinstance(value, str))
PATH = accepts("a path", lambda value: isinstance(value, (str, os.PathLike)) and str(value) != "")
KEYWORDS = accepts(
    "a dictionary with strings as keys",
    lambda value: isinstance(value, Mapping) and all(isinstance(key, str) for key in value),
    dict,
)
FUNCTION = accepts("a function", callable)


def choice(names: Collection[str]) -> Kind:
    """
    :param names: Known names, to which others can be added later
    :return: One of these
    """

    def words() -> str:
        known = sorted(names)
        return repr(known[0]) if len(known) == 1 else f"one of {known}"

    return accepts(words, lambda value: isinstance(value, str) and value in names)


def subclass(of: type, words: str) -> Kind:
    """
    :param of: A class
    :param words: What its subclasses are called
    :return: The class or a subclass
    """
    return accepts(words, lambda value: isinstance(value, type) and issubclass(value, of))


def instance(of: type | tuple[type, ...], words: str) -> Kind:
    """
    :param of: A class, or several
    :param words: What its instances are called
    :return: Instances of it
    """
    return accepts(words, lambda value: isinstance(value, of))


def schedule(kind: Kind) -> Kind:
    """
    :param kind: What the values have to be
    :return: A number, or a function of the progress that remains, of which the first value is looked at
    """

    def read(value: Any) -> Any:
        if not callable(value):
            return kind.read(value)
        try:
            first = value(1.0)
            kind.read(first.item() if isinstance(first, (np.ndarray, th.Tensor)) else first)
        except (TypeError, ValueError, AttributeError) as error:
            raise NotAcceptedError from error
        return value

    return Kind(f"{kind.accepted}, or a function that gives such numbers for the progress remaining (from 1 to 0)", read)


def sequence(
    kind: Kind, words: str, shortest: int = 0, longest: int = LONGEST, equal: bool = False, different: bool = False
) -> Kind:
    """
    :param kind: What each element has to be
    :param words: What the sequence is called
    :param shortest: The smallest length
    :param longest: The largest length
    :param equal: Whether all elements have to be the same
    :param different: Whether none may be the same as another
    :return: Lists, also tuples and arrays, which become lists
    """

    def read(value: Any) -> Any:
        if not isinstance(value, (list, tuple, np.ndarray)) or not shortest <= len(value) <= longest:
            raise NotAcceptedError
        elements = [kind.read(element) for element in value]
        n_different = len(set(map(str, elements)))
        if (equal and n_different > 1) or (different and n_different < len(elements)):
            raise NotAcceptedError
        return elements

    return Kind(words, read)
