"""Values as JSON and bytes, with no pickle: what reads them fills objects of known classes and calls nothing of the file's."""

import base64
import enum
import json
import math
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces

from sb3_causalgdp.moved import current_module
from sb3_causalgdp.saving.numpy_pickles import check_random_state

SPACES: tuple[type, ...] = (
    spaces.Box,
    spaces.Dict,
    spaces.Discrete,
    spaces.MultiBinary,
    spaces.MultiDiscrete,
    spaces.Tuple,
)
BIT_GENERATORS = {
    kind.__name__: kind
    for kind in (np.random.PCG64, np.random.PCG64DXSM, np.random.MT19937, np.random.Philox, np.random.SFC64)
}
SEQUENCES: dict[str, Callable[[list], Any]] = {"tuple": tuple, "set": set, "frozenset": frozenset}
ARRAY_KINDS = "biufcSUMm"  # no objects
FORMAT = 1
DEEPEST = 60
LATE = ("_np_random", "_np_random_seed", "low_repr", "high_repr")  # of spaces, made when they are asked for
LONGEST_NUMBER = 5_000


class NotPlainError(TypeError):
    """A value that cannot be written without a pickle."""


def name_of(cls: type) -> str:
    """
    :param cls: A class
    :return: What it is called in files
    """
    return f"{cls.__module__}.{cls.__qualname__}"


class Known:
    """
    Classes that files may name.

    :param filled: Those whose objects may be in a file: their attributes are filled, no constructor is called
    :param named: Those that may be values themselves, beside the first
    """

    def __init__(self, filled: Iterable[type], named: Iterable[type] = ()) -> None:
        self.filled = {name_of(cls): cls for cls in filled}
        self.named = {**self.filled, **{name_of(cls): cls for cls in named}}

    def __add__(self, other: "Known") -> "Known":
        return Known(
            [*self.filled.values(), *other.filled.values()],
            [*self.named.values(), *other.named.values()],
        )


class Writer:
    """
    Turns values into JSON and one block of bytes, which holds the arrays.

    :param known: Classes that may be named
    """

    def __init__(self, known: Known) -> None:
        self.known = known
        self.blocks: list[bytes] = []
        self.n_bytes = 0

    def encode(self, value: Any) -> Any:
        """
        :param value: Any value
        :return: What ``json.dumps`` takes; arrays are appended to ``blocks``
        :raises NotPlainError: If something in it is of no known class; nothing is appended then
        """
        n_blocks, n_bytes = len(self.blocks), self.n_bytes
        try:
            return self._encode(value, 0)
        except NotPlainError:
            del self.blocks[n_blocks:]
            self.n_bytes = n_bytes
            raise

    def _encode(self, value: Any, depth: int) -> Any:
        if depth > DEEPEST:
            raise NotPlainError("it is nested too deeply, or holds itself")
        kind = type(value)
        if value is None or kind in (bool, int, float, str):
            return value
        if kind is np.ndarray:
            return self._array(value)
        if isinstance(value, np.generic):
            return {"scalar": self._array(np.asarray(value))}
        if kind is list:
            return [self._encode(one, depth + 1) for one in value]
        return self._container(value, depth + 1) or self._object(value, depth + 1)

    def _array(self, value: np.ndarray) -> dict[str, Any]:
        if value.dtype.kind not in ARRAY_KINDS:
            raise NotPlainError(f"arrays of {value.dtype}")
        # As it lies in memory, so that sums are rounded alike
        order = "F" if value.flags.f_contiguous and not value.flags.c_contiguous else "C"
        block = value.tobytes(order=order)  # type: ignore[arg-type]
        content = [value.dtype.str, list(value.shape), order, self.n_bytes]
        self.blocks.append(block)
        self.n_bytes += len(block)
        return {"array": content}

    def _container(self, value: Any, depth: int) -> Any:
        kind = type(value)
        if kind.__name__ in SEQUENCES and kind is SEQUENCES[kind.__name__]:
            return {kind.__name__: [self._encode(one, depth) for one in value]}
        if kind is deque:
            return {"deque": [self._encode(one, depth) for one in value], "most": value.maxlen}
        if kind in (dict, OrderedDict):
            return {
                "dict" if kind is dict else "ordered": [
                    [self._encode(key, depth), self._encode(one, depth)] for key, one in value.items()
                ]
            }
        if kind is bytes:
            return {"bytes": base64.b64encode(value).decode()}
        return None

    def _object(self, value: Any, depth: int) -> Any:
        kind = type(value)
        if isinstance(value, np.dtype):
            if value.kind not in ARRAY_KINDS:
                raise NotPlainError(f"the dtype {value}")
            return {"dtype": value.str}
        if kind is slice:
            return {"slice": [self._encode(one, depth) for one in (value.start, value.stop, value.step)]}
        if isinstance(value, np.random.Generator) and type(value.bit_generator).__name__ in BIT_GENERATORS:
            return {"generator": self._encode(value.bit_generator.state, depth)}
        if kind is np.random.RandomState:
            return {"random_state": self._encode(value.get_state(legacy=False), depth)}
        return self._class(value) if isinstance(value, type) else self._instance(value, depth)

    def _class(self, value: type) -> Any:
        if issubclass(value, np.generic) and np.dtype(value).kind in ARRAY_KINDS and np.dtype(value).type is value:
            return {"numpy_type": np.dtype(value).str}
        if self.known.named.get(name_of(value)) is value:
            return {"class": name_of(value)}
        raise NotPlainError(f"the class {name_of(value)}")

    def _instance(self, value: Any, depth: int) -> Any:
        kind = type(value)
        name = name_of(kind)
        if self.known.filled.get(name) is not kind:
            raise NotPlainError(f"an object of {name}")
        if isinstance(value, enum.Enum):
            return {"enum": name, "value": self._encode(value.value, depth)}
        if isinstance(value, tuple):
            return {"object": name, "parts": [self._encode(one, depth) for one in value]}
        state = value.__getstate__() if _has_own_state(kind) else vars(value)
        return {"object": name, "state": {key: self._encode(one, depth) for key, one in state.items()}}


class Reader:
    """
    The opposite of :class:`Writer`.

    :param known: Classes that may be named
    :param block: The bytes that the arrays are in
    """

    def __init__(self, known: Known, block: bytes) -> None:
        self.known = known
        self.block = block

    def decode(self, value: Any) -> Any:
        """
        :param value: What ``json.loads`` gave
        :return: The value
        :raises ValueError: If it is not what :class:`Writer` makes, names other classes, or holds NaN
        """
        try:
            return self._decode(value)
        except ValueError:
            raise
        except Exception as error:  # whatever a strange file brings about
            raise ValueError(f"{type(error).__name__}: {error}") from error

    def _decode(self, value: Any) -> Any:
        if isinstance(value, list):
            return [self._decode(one) for one in value]
        if isinstance(value, float) and math.isnan(value):
            raise ValueError("it holds NaN")
        if not isinstance(value, dict):
            return value
        kind = next(iter(value), "")
        if kind in SEQUENCES:
            return SEQUENCES[kind]([self._decode(one) for one in value[kind]])
        reader = getattr(self, f"_{kind}", None) if kind in _KINDS else None
        if reader is None:
            raise ValueError(f"it holds an unknown kind of value, {str(kind)[:80]!r}")
        return reader(value)

    def _array(self, value: dict) -> np.ndarray:
        name, shape, order, first = value["array"]
        dtype = np.dtype(str(name))
        if dtype.kind not in ARRAY_KINDS or order not in ("C", "F"):
            raise ValueError(f"an array of {name!r} in order {order!r}")
        if not all(type(size) is int and size >= 0 for size in (*shape, first)):
            raise ValueError(f"an array of shape {shape} at {first}")
        count = math.prod(shape)
        if first + count * dtype.itemsize > len(self.block):
            raise ValueError(f"an array of shape {shape}, for which there are too few bytes")
        values = np.frombuffer(self.block, dtype, count, first) if count > 0 else np.empty(0, dtype)
        if dtype.kind in "fc" and np.isnan(values).any():
            raise ValueError("it holds NaN")
        return values.reshape(shape, order=order).copy(order="K")

    def _scalar(self, value: dict) -> Any:
        return self._array(value["scalar"])[()]

    def _dtype(self, value: dict) -> np.dtype:
        dtype = np.dtype(str(value["dtype"]))
        if dtype.kind not in ARRAY_KINDS:
            raise ValueError(f"it holds the dtype {dtype}")
        return dtype

    def _numpy_type(self, value: dict) -> type:
        return self._dtype({"dtype": value["numpy_type"]}).type

    def _slice(self, value: dict) -> slice:
        return slice(*(self._decode(one) for one in value["slice"]))

    def _bytes(self, value: dict) -> bytes:
        return base64.b64decode(value["bytes"], validate=True)

    def _deque(self, value: dict) -> deque:
        return deque((self._decode(one) for one in value["deque"]), value["most"])

    def _dict(self, value: dict) -> dict:
        return {self._decode(key): self._decode(one) for key, one in value["dict"]}

    def _ordered(self, value: dict) -> OrderedDict:
        return OrderedDict((self._decode(key), self._decode(one)) for key, one in value["ordered"])

    def _generator(self, value: dict) -> np.random.Generator:
        state = self._decode(value["generator"])
        check_random_state(state)
        generator = np.random.Generator(BIT_GENERATORS[state["bit_generator"]]())
        generator.bit_generator.state = state
        return generator

    def _random_state(self, value: dict) -> np.random.RandomState:
        generator, state = np.random.RandomState(), self._decode(value["random_state"])
        check_random_state(state)
        generator.set_state(state)
        return generator

    def _class(self, value: dict) -> type:
        return self._known(self.known.named, value["class"])

    def _enum(self, value: dict) -> Any:
        cls = self._known(self.known.filled, value["enum"])
        if not issubclass(cls, enum.Enum):
            raise ValueError(f"{value['enum']} has no members")
        return cls(self._decode(value["value"]))

    def _object(self, value: dict) -> Any:
        cls = self._known(self.known.filled, value["object"])
        if "parts" in value:
            if not hasattr(cls, "_make"):
                raise ValueError(f"{value['object']} has no parts")
            return cls._make([self._decode(one) for one in value["parts"]])
        if issubclass(cls, enum.Enum | tuple):
            raise ValueError(f"{value['object']} has no attributes")
        instance = cls.__new__(cls)
        state = {str(key): self._decode(one) for key, one in value["state"].items()}
        if _has_own_state(cls):
            instance.__setstate__(state)
        else:
            vars(instance).update(state)
        if isinstance(instance, spaces.Space):
            _check_space(instance)
        check = getattr(cls, "__post_init__", None)
        if check is not None:
            # What a dataclass checks of what it is made of, it checks of a file, too
            check(instance)
        return instance

    @staticmethod
    def _known(classes: Mapping[str, type], name: Any) -> Any:
        if isinstance(name, str):
            module, _, last = name.rpartition(".")
            name = f"{current_module(module, last)}.{last}"
        if not isinstance(name, str) or name not in classes:
            raise ValueError(f"it names {str(name)[:200]!r}, which is none of the classes that are known to be harmless")
        return classes[name]


def _has_own_state(cls: type) -> bool:
    """Whether a class says itself what of its objects is written."""
    own = getattr(cls, "__getstate__", None)
    return own is not None and own is not getattr(object, "__getstate__", None) and hasattr(cls, "__setstate__")


def _check_space(space: Any) -> None:
    """Whether its attributes are those of a space that the constructor makes."""
    cls = type(space)
    arguments: dict[type, Callable[[], tuple[Any, ...]]] = {
        spaces.Box: lambda: (space.low, space.high, space.low.shape, space.dtype.type),
        spaces.Dict: lambda: (OrderedDict(space.spaces),),
        spaces.Discrete: lambda: (space.n, None, space.start),
        spaces.MultiBinary: lambda: (space.n,),
        spaces.MultiDiscrete: lambda: (space.nvec, space.dtype.type, None, space.start),
        spaces.Tuple: lambda: (tuple(space.spaces),),
    }
    fresh = cls(*arguments[cls]())
    if vars(fresh).keys() != vars(space).keys() or fresh != space:
        raise ValueError(f"the attributes of {cls.__name__} do not fit each other")
    for name, value in vars(fresh).items():
        given = vars(space)[name]
        is_same = name in LATE and isinstance(given, str | int | list | tuple | dict | np.random.Generator | None)
        is_same = is_same or isinstance(given, type(value))
        if not is_same or (isinstance(value, np.ndarray) and (value.shape, value.dtype) != (given.shape, given.dtype)):
            raise ValueError(f"{name} of {cls.__name__} does not fit its other attributes")
    if not isinstance(space._np_random, np.random.Generator | None):
        raise ValueError(f"the generator of {cls.__name__} is a {type(space._np_random).__name__}")


_KINDS = frozenset(
    {
        *("array", "scalar", "dtype", "bytes", "deque", "dict", "ordered", "generator", "random_state"),
        *("class", "enum", "object", "numpy_type", "slice"),
    }
)


def decoded(
    content: Any, block: bytes, known: Known, given: Collection[str] = (), only: Collection[str] | None = None
) -> dict[str, Any]:
    """
    :param content: What a writer encoded, ``{"format": 1, "attributes": {...}}``
    :param block: Its bytes
    :param known: Classes that it may name
    :param given: Attributes that are not read
    :param only: Attributes that are read, None for all
    :return: The attributes by name
    :raises ValueError: If one cannot be read, which is named
    """
    if not isinstance(content, dict) or not isinstance(content.get("attributes"), dict):
        raise ValueError("its attributes are no JSON object")
    if content.get("format") != FORMAT:
        raise ValueError(f"it is of format {content.get('format')!r}, this version reads {FORMAT}")
    reader, values = Reader(known, block), {}
    for name, value in content["attributes"].items():
        if name in given or (only is not None and name not in only):
            continue
        try:
            values[name] = reader.decode(value)
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{name} cannot be read: {error}") from error
    return values


def read_json(data: bytes | str) -> Any:
    """
    :param data: Text of a file
    :return: What it says
    :raises ValueError: If it is not JSON, or would overflow what reads it
    """
    try:
        return json.loads(data, parse_int=_integer)
    except (RecursionError, UnicodeDecodeError) as error:
        raise ValueError(f"it is not JSON that can be read: {error}") from error


def _integer(text: str) -> int:
    if len(text) > LONGEST_NUMBER:
        raise ValueError(f"it holds a number of {len(text)} digits")
    return int(text)
