"""Python objects as bytes, that run nothing when they are read."""

import enum
import functools
import importlib
import io
import pickle
import types
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from gymnasium.utils import EzPickle

from sb3_causalgdp.moved import current_module
from sb3_causalgdp.saving.archives import PLAIN
from sb3_causalgdp.saving.numpy_pickles import in_place_of

CODE = (types.FunctionType, types.BuiltinFunctionType, types.MethodType, types.ModuleType, type, functools.partial)
_MOST_OBJECTS = 100_000


def to_bytes(value: Any, references: Mapping[int, Any] | None = None) -> bytes:
    """
    :param value: What to write
    :param references: By the ``id`` of objects that are not written: what is written in their place
    :return: The bytes
    :raises Exception: Whatever pickle raises on what it cannot write
    """
    stream = io.BytesIO()
    _Pickler(stream, references or {}).dump(value)
    return stream.getvalue()


def from_bytes(
    data: bytes, resolve: Callable[[Any], Any] | None = None, allowed: Iterable[type] = (), trusted: bool = False
) -> Any:
    """
    :param data: What :func:`to_bytes` made, or somebody who wants to harm
    :param resolve: Turns what stands in the place of an object into the object
    :param allowed: Classes whose objects may be filled, beside the plain ones; their constructors are not called
    :param trusted: Whether all may be made that pickle can make
    :return: The value
    :raises ValueError: If it holds something else
    """
    return _Unpickler(io.BytesIO(data), resolve, {(one.__module__, one.__qualname__): one for one in allowed}, trusted).load()


def classes_in(*values: Any) -> set[type]:
    """
    :param values: Objects of this process
    :return: The classes of all that they hold
    """
    found: set[type] = set()
    seen: set[int] = set()
    waiting = list(values)
    while waiting and len(seen) < _MOST_OBJECTS:
        value = waiting.pop()
        if id(value) in seen or isinstance(value, CODE):
            continue
        seen.add(id(value))
        found.add(type(value))
        if isinstance(value, Mapping):
            waiting += [*value.keys(), *value.values()]
        elif isinstance(value, list | tuple | set | frozenset):
            waiting += value
        waiting += vars(value).values() if hasattr(value, "__dict__") else []
    return found


def _blank(module: str, name: str) -> Any:
    """Stands in files; what it makes, the reader decides."""
    raise NotImplementedError


def _fill(instance: Any, state: dict[str, Any]) -> None:
    instance.__dict__.update(state)


def _is_filled(value: Any) -> bool:
    """Whether the attributes are all that an object is: so a file need not name a class that could be called."""
    cls = type(value)
    if isinstance(value, EzPickle):
        # It would keep the constructor's arguments, and lose the state
        return True
    defaults = (
        "__reduce__",
        "__reduce_ex__",
        "__getstate__",
        "__setstate__",
        "__getnewargs__",
        "__getnewargs_ex__",
        "__new__",
    )
    plain = all(getattr(cls, name, None) is getattr(object, name, None) for name in defaults)
    return plain and hasattr(value, "__dict__") and not any(vars(base).get("__slots__") for base in cls.__mro__)


class _Pickler(pickle.Pickler):
    def __init__(self, stream: io.BytesIO, references: Mapping[int, Any]) -> None:
        super().__init__(stream, protocol=4)
        self.references = references

    def persistent_id(self, value: Any) -> Any:
        return self.references.get(id(value))

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, (*CODE, enum.Enum)) or not _is_filled(value):
            return NotImplemented
        return _blank, (type(value).__module__, type(value).__qualname__), vars(value), None, None, _fill


class _Unpickler(pickle.Unpickler):
    def __init__(
        self,
        stream: io.BytesIO,
        resolve: Callable[[Any], Any] | None,
        allowed: Mapping[tuple[str, str], type],
        trusted: bool,
    ) -> None:
        super().__init__(stream)
        self.resolve, self.allowed, self.trusted = resolve, allowed, trusted

    def persistent_load(self, reference: Any) -> Any:
        if self.resolve is None:
            raise ValueError(f"it refers to {reference!r}, which is not there")
        return self.resolve(reference)

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == (__name__, "_blank"):
            return self._blank
        module = current_module(module, name)
        known = self.allowed.get((module, name))
        if known is not None and (issubclass(known, enum.Enum) or hasattr(known, "_fields")):
            return known
        if self.trusted or (module, name) == (__name__, "_fill"):
            return super().find_class(module, name)
        if name in PLAIN.get(module, ()):
            return in_place_of(module, name, super().find_class)
        raise _refused(module, name)

    def _blank(self, module: str, name: str) -> Any:
        module = current_module(module, name)
        known = self.allowed.get((module, name))
        if known is None and self.trusted:
            known = functools.reduce(getattr, name.split("."), importlib.import_module(module))  # type: ignore[assignment]
        if known is None:
            raise _refused(module, name)
        return known.__new__(known)  # type: ignore[call-overload]


def _refused(module: str, name: str) -> ValueError:
    return ValueError(
        f"it holds {module}.{name}, which could run code: if you trust where the file is from, pass trusted=True"
    )
