"""
What a pickle that is not trusted gets in place of numpy's names, which believe a state, also one that points anywhere, and of
``getattr``, which could reach all that can be called.
"""

import enum
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

# An element of these is a number, or an object that was pickled itself; numpy ignores states for its own types
DTYPE_KINDS = "biufcO"
# Positions that numpy reads its memory at, and the largest of each
POSITIONS = {"pos": 624, "buffer_pos": 4}


def check_random_state(state: Any) -> None:
    """
    :param state: Of a random number generator of numpy, in its own form or that of ``numpy.random.get_state``
    :raises ValueError: If it points outside of the generator's memory
    """
    legacy = {"pos": state[2]} if isinstance(state, tuple | list) and len(state) > 2 else {}
    own = state if isinstance(state, Mapping) else legacy
    inner = own.get("state")
    for part in (own, inner if isinstance(inner, Mapping) else {}):
        for name, most in POSITIONS.items():
            value = part.get(name, 0)
            if not isinstance(value, int | np.integer) or not 0 <= value <= most:
                raise ValueError(f"{name} of random numbers must be from 0 to {most}, got {str(value)[:40]}")


class _Array:
    """Stands for ``numpy.ndarray``, which would take bytes for the addresses of objects if it were called."""

    def __call__(self, *_: Any) -> Any:
        raise ValueError("it makes an array of memory")


ARRAY = _Array()


def plain_dtype(name: Any, *_: Any) -> np.dtype:
    """
    :param name: Of a type, as ``numpy.dtype`` takes it
    :return: The type, if it is one of numpy's own, in the byte order of this machine
    :raises ValueError: If it is another, whose state could be replaced
    """
    dtype = np.dtype(name) if isinstance(name, str) else None
    if dtype is None or dtype.kind not in DTYPE_KINDS or dtype.isbuiltin != 1:
        raise ValueError(f"it holds an array of {str(name)[:40]!r}, and numbers alone are known to be harmless")
    return dtype


def _reconstruct(subtype: Any, *_: Any) -> np.ndarray:
    if subtype is not ARRAY:
        raise ValueError("it holds an array of an unknown class")
    # What it is, its state says
    return np.ndarray((0,), np.int8)


class _CheckedState:
    """A random number generator that looks at a state before it is used."""

    numpy_class: type

    @property
    def state(self) -> Any:
        return self.numpy_class.state.__get__(self)  # type: ignore[attr-defined]

    @state.setter
    def state(self, value: Any) -> None:
        check_random_state(value)
        self.numpy_class.state.__set__(self, value)  # type: ignore[attr-defined]

    def __setstate__(self, state: Any) -> None:
        for part in state if isinstance(state, tuple) else (state,):
            if isinstance(part, Mapping):
                check_random_state(part)
        self.numpy_class.__setstate__(self, state)  # type: ignore[attr-defined]

    def __reduce__(self) -> Any:
        # As numpy's own, so that it is pickled as such
        make, arguments, *state = self.numpy_class.__reduce__(self)  # type: ignore[call-arg, misc, str-unpack]
        return make, (self.numpy_class, *arguments[1:]), *state


class MT19937(_CheckedState, np.random.MT19937):
    numpy_class = np.random.MT19937


class Philox(_CheckedState, np.random.Philox):
    numpy_class = np.random.Philox


class RandomState(np.random.RandomState):
    def set_state(self, state: Any) -> None:
        check_random_state(state)
        super().set_state(state)

    def __setstate__(self, state: Any) -> None:
        self.set_state(state)


BIT_GENERATORS: dict[str, type] = {
    "MT19937": MT19937,
    "PCG64": np.random.PCG64,
    "PCG64DXSM": np.random.PCG64DXSM,
    "Philox": Philox,
    "SFC64": np.random.SFC64,
}


def _bit_generator(kind: Any = "MT19937") -> Any:
    kind = BIT_GENERATORS.get(kind) if isinstance(kind, str) else kind
    if kind not in BIT_GENERATORS.values():
        raise ValueError("it holds random numbers of an unknown kind")
    return kind()


def _checked(generator: Any) -> Any:
    return generator if type(generator) in BIT_GENERATORS.values() else _bit_generator(generator)


def _generator(generator: Any = "MT19937", *_: Any) -> np.random.Generator:
    return np.random.Generator(_checked(generator))


def _random_state(generator: Any = "MT19937", *_: Any) -> np.random.RandomState:
    return RandomState(_checked(generator))


def _member(of: Any, name: Any, *_: Any) -> enum.Enum:
    """What Python 3.11.0 to 3.11.3 write ``getattr`` for."""
    if not (isinstance(of, type) and issubclass(of, enum.Enum) and isinstance(name, str) and name in of.__members__):
        raise ValueError(f"it asks for {str(name)[:40]!r} of something that is no enumeration, which could run code")
    return of[name]


NAMES: dict[str, dict[str, Any]] = {
    "builtins": {"getattr": _member},
    "numpy": {"dtype": plain_dtype, "ndarray": ARRAY},
    "numpy._core.multiarray": {"_reconstruct": _reconstruct},
    "numpy.core.multiarray": {"_reconstruct": _reconstruct},
    "numpy.random._mt19937": {"MT19937": MT19937},
    "numpy.random._philox": {"Philox": Philox},
    "numpy.random._pickle": {
        "__bit_generator_ctor": _bit_generator,
        "__generator_ctor": _generator,
        "__randomstate_ctor": _random_state,
    },
}
"""By module and name: what is given in its place."""


def in_place_of(module: str, name: str, find: Callable[[str, str], Any]) -> Any:
    """
    :param module: Of a name in a pickle
    :param name: The name
    :param find: Finds others
    :return: What the pickle gets
    """
    of_module = NAMES.get(module, {})
    return of_module[name] if name in of_module else find(module, name)
