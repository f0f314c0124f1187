"""Zip archives, arrays and pickles of strangers: nothing is unpacked that is out of proportion, and nothing is run."""

import io
import json
import math
import os
import pickle
import struct
import zipfile
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from sb3_causalgdp.saving.numpy_pickles import in_place_of

# What bookkeeping is made of; none of it runs what a file says
PLAIN: dict[str, set[str]] = {
    "builtins": {"bytearray", "complex", "frozenset", "getattr", "object", "range", "set", "slice"},
    "collections": {"OrderedDict", "defaultdict", "deque"},
    "copyreg": {"_reconstructor"},
    "_codecs": {"encode"},
    "numpy": {"dtype", "ndarray", *(kind.__name__ for kind in np.sctypeDict.values() if np.dtype(kind).kind in "biufc")},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "numpy.core.multiarray": {"_reconstruct", "scalar"},
    "numpy._core.numeric": {"_frombuffer"},
    "numpy.core.numeric": {"_frombuffer"},
    "numpy.random._pickle": {"__bit_generator_ctor", "__generator_ctor", "__randomstate_ctor"},
    "numpy.random._pcg64": {"PCG64", "PCG64DXSM"},
    "numpy.random._mt19937": {"MT19937"},
    "numpy.random._philox": {"Philox"},
    "numpy.random._sfc64": {"SFC64"},
    "numpy.random.bit_generator": {"SeedSequence", "__pyx_unpickle_SeedSequence"},
    "gymnasium.spaces.box": {"Box"},
    "gymnasium.spaces.dict": {"Dict"},
    "gymnasium.spaces.discrete": {"Discrete"},
    "gymnasium.spaces.multi_binary": {"MultiBinary"},
    "gymnasium.spaces.multi_discrete": {"MultiDiscrete"},
    "gymnasium.spaces.tuple": {"Tuple"},
}
# What the replay buffers and normalizations that SB3 pickles are made of, beside that
OF_SB3: dict[str, set[str]] = {
    "stable_baselines3.common.buffers": {"ReplayBuffer", "DictReplayBuffer", "NStepReplayBuffer", "RolloutBuffer"},
    "stable_baselines3.her.her_replay_buffer": {"HerReplayBuffer"},
    "stable_baselines3.her.goal_selection_strategy": {"GoalSelectionStrategy"},
    "stable_baselines3.common.running_mean_std": {"RunningMeanStd"},
    "stable_baselines3.common.vec_env.vec_normalize": {"VecNormalize"},
    "torch": {"device"},
}
# Up to so many bytes no file is suspicious
SMALL = 1 << 28
MOST_TIMES = 100
LONGEST_TEXT = 1_000
COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA)
TRUST = "if you trust where the file is from, pass trusted=True"


def named(name: Any) -> str:
    """
    :param name: A path or a file-like object
    :return: What to call it in errors
    """
    return os.fspath(name) if isinstance(name, str | os.PathLike) else "the file"


def one_line(error: BaseException) -> str:
    """
    :param error: An error
    :return: What it says in one line, with its class where that is no plain ValueError
    """
    text = " ".join(str(error).split())
    text = text if len(text) <= LONGEST_TEXT else f"{text[:LONGEST_TEXT]}..."
    return text if type(error) in (ValueError, FileError) and text else f"{type(error).__name__}: {text}".removesuffix(": ")


class FileError(ValueError):
    """What is wrong with a file, in one line that names it."""


class DownloadError(ValueError):
    """A dataset is not on this machine, and could not be brought there."""


@contextmanager
def errors_of(path: Any, what: str = "cannot be read") -> Iterator[None]:
    """
    Whatever is raised while a file is read becomes one :class:`FileError`. Missing files, missing rights and missing packages
    stay what they are.

    :param path: The file
    :param what: What is said of it
    """
    try:
        yield
    except (FileNotFoundError, IsADirectoryError, PermissionError, ImportError, KeyboardInterrupt):
        raise
    except Exception as error:
        name, text = named(path), one_line(error)
        raise FileError(text if text.startswith(name) else f"{name} {what}: {text}") from error


def checked_entries(archive: zipfile.ZipFile, size: int, small: int = SMALL) -> list[zipfile.ZipInfo]:
    """
    Look at a zip archive before anything of it is unpacked: Python never unpacks more of an entry than it declares.

    :param archive: The archive
    :param size: Of its file, in bytes
    :param small: Bytes that may come out of any file
    :return: Its entries
    :raises ValueError: If they are out of proportion, or of a kind that cannot be read
    """
    entries = archive.infolist()
    names = [entry.filename for entry in entries]
    if len(set(names)) < len(names):
        raise ValueError("two entries have one name")
    for entry in entries:
        if entry.flag_bits & 0x1 or entry.compress_type not in COMPRESSIONS:
            raise ValueError(f"the entry {entry.filename!r} is encrypted or compressed in an unknown way")
        if entry.compress_type == zipfile.ZIP_STORED and entry.file_size != entry.compress_size:
            raise ValueError(f"the entry {entry.filename!r} has two sizes")
    unpacked = sum(entry.file_size for entry in entries)
    if unpacked > max(small, MOST_TIMES * size):
        raise ValueError(f"{size:,} bytes would become {unpacked:,}, more than {MOST_TIMES} times as many")
    return entries


def check_sums(archive: zipfile.ZipFile, entries: Iterable[zipfile.ZipInfo]) -> None:
    """
    :param archive: An archive
    :param entries: Its checked entries
    :raises ValueError: If one of them is not what was written
    """
    for entry in entries:
        with archive.open(entry) as file:
            while file.read(1 << 20):
                pass


@contextmanager
def opened(path: Any) -> Iterator[Any]:
    """
    :param path: A path, or a file-like object, which stays open
    """
    if isinstance(path, str | os.PathLike):
        with open(path, "rb") as file:
            yield file
    else:
        yield path


def size_of(file: BinaryIO) -> int:
    """
    :param file: An open file
    :return: Its size in bytes; its position stays
    """
    position = file.tell()
    size = file.seek(0, io.SEEK_END)
    file.seek(position)
    return size


def read_arrays(file: Any, names: Iterable[str] | None = None) -> dict[str, np.ndarray]:
    """
    What ``numpy.savez`` wrote, without pickles; an array that declares more than there is gets no memory.

    :param file: Path or open file
    :param names: Which arrays to read, where they are there; None for all
    :return: The arrays
    :raises ValueError: If something is wrong with them
    """
    arrays = {}
    with opened(file) as stream, zipfile.ZipFile(stream) as archive:
        for entry in checked_entries(archive, size_of(stream)):
            name = entry.filename.removesuffix(".npy")
            if names is None or name in names:
                with archive.open(entry) as content:
                    arrays[name] = _read_array(content, entry, name, stream)
    return arrays


def write_arrays(file: Any, arrays: Mapping[str, np.ndarray]) -> None:
    """
    What ``numpy.savez`` writes, without its copies.

    :param file: Path or file-like object
    :param arrays: By name, none of Python objects
    """
    with zipfile.ZipFile(file, "w") as archive:
        for name, values in arrays.items():
            values = np.asarray(values, order="C")
            with archive.open(f"{name}.npy", "w", force_zip64=True) as content:
                np.lib.format.write_array_header_1_0(content, np.lib.format.header_data_from_array_1_0(values))
                content.write(memoryview(values.reshape(-1).view(np.uint8).data))


def _read_array(content: Any, entry: zipfile.ZipInfo, name: str, stream: BinaryIO) -> np.ndarray:
    version = np.lib.format.read_magic(content)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise ValueError(f"the array {name!r} is of the unknown version {version}")
    shape, in_fortran_order, dtype = readers[version](content)
    if dtype.hasobject:
        raise ValueError(f"the array {name!r} holds Python objects, which could run code")
    left = entry.file_size - content.tell()
    count = math.prod(shape)
    if count < 0 or count * dtype.itemsize != left:
        raise ValueError(f"the array {name!r} of shape {shape} and {dtype} has {left} bytes")
    values = np.empty(count, dtype)
    view = values.view(np.uint8).data if left > 0 else memoryview(bytearray())
    if entry.compress_type == zipfile.ZIP_STORED:
        _read_stored(stream, entry, view)
    else:
        view[:] = content.read()
    return values.reshape(shape[::-1]).T if in_fortran_order else values.reshape(shape)


def _read_stored(stream: BinaryIO, entry: zipfile.ZipInfo, view: memoryview) -> None:
    """The last bytes of an entry, with its checksum, and without the copies that ``zipfile`` makes."""
    stream.seek(entry.header_offset + 26)
    start = entry.header_offset + 30 + sum(struct.unpack("<HH", stream.read(4)))
    stream.seek(start)
    checksum = zlib.crc32(stream.read(entry.file_size - len(view)))
    n_read = stream.readinto(view) if len(view) > 0 else 0  # type: ignore[attr-defined]
    if n_read != len(view) or zlib.crc32(view, checksum) != entry.CRC:
        raise ValueError(f"{entry.filename!r} is not what was written")


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: BinaryIO, known: Mapping[str, set[str]]) -> None:
        super().__init__(file)
        self.known = known

    def find_class(self, module: str, name: str) -> Any:
        if name in PLAIN.get(module, ()) or name in self.known.get(module, ()):
            return in_place_of(module, name, super().find_class)
        raise ValueError(f"it holds {module}.{name}, which could run code: {TRUST}")

    def persistent_load(self, reference: Any) -> Any:
        raise ValueError("it refers to something outside of it")


def read_pickle(file: BinaryIO, trusted: bool = False, known: Mapping[str, set[str]] = OF_SB3) -> Any:
    """
    :param file: An open file
    :param trusted: Whether all may be made that pickle can make
    :param known: Names by module that may be used, beside the plain ones of Python, numpy and gymnasium
    :return: What was pickled
    :raises ValueError: If it names something else
    """
    return pickle.load(file) if trusted else _Unpickler(file, known).load()


def is_zip(file: BinaryIO) -> bool:
    """
    :param file: An open file
    :return: Whether it begins as a zip archive does; its position stays
    """
    position = file.tell()
    start = file.read(4)
    file.seek(position)
    return start == b"PK\x03\x04"


def is_model(file: BinaryIO) -> bool:
    """
    :param file: An open file
    :return: Whether it is a zip archive in which SB3 saved a model; its position stays
    """
    position, found = file.tell(), False
    if is_zip(file):
        with zipfile.ZipFile(file) as archive:
            found = "pytorch_variables.pth" in archive.namelist()
        file.seek(position)
    return found


def existing(path: str | os.PathLike[str], suffixes: Iterable[str]) -> Path:
    """
    :param path: A path, perhaps without its suffix
    :param suffixes: Those that may be missing, the first that is there is taken
    :return: The file's path, or the given one if there is none
    """
    path = Path(path)
    if not path.is_file():
        for suffix in suffixes:
            if path.with_name(path.name + suffix).is_file():
                return path.with_name(path.name + suffix)
    return path


def load_minari(dataset_id: str, download: bool, trusted: bool = False) -> Any:
    """
    :param dataset_id: Of a Minari dataset
    :param download: Whether to download it if it is not on this machine
    :param trusted: Whether Minari may make the environment that its metadata describe, which runs what they name
    :return: The ``minari.MinariDataset``
    :raises ImportError: Without minari
    :raises DownloadError: If it cannot be downloaded
    :raises ValueError: If its metadata are out of proportion, or name an environment in place of spaces
    """
    import minari
    from minari.storage import get_dataset_path, hosting

    path = get_dataset_path(dataset_id) / "data" / "metadata.json"
    if download and not path.parent.exists():
        try:
            hosting.download_dataset(dataset_id)
        except ImportError:
            raise
        except Exception as error:  # of the network, or of a server's library
            raise DownloadError(one_line(error)) from error
    if path.is_file():
        with errors_of(dataset_id):
            metadata = json.loads(path.read_text(encoding="utf-8"))
            size = sum(file.stat().st_size for file in path.parent.rglob("*") if file.is_file())
            for name, most in {"total_episodes": size, "total_steps": MOST_TIMES * size}.items():
                count = metadata.get(name, 0)
                if isinstance(count, bool) or not isinstance(count, int) or not 0 <= count <= most:
                    raise ValueError(f"{name} must be an integer from 0 to {most:,} for {size:,} bytes, got {str(count)[:80]}")
            spaces = [isinstance(metadata.get(name), str) for name in ("observation_space", "action_space")]
            if not trusted and not all(spaces):
                raise ValueError(f"its metadata lack a space, and making its environment could run code: {TRUST}")
    return minari.load_dataset(dataset_id, download=False)
