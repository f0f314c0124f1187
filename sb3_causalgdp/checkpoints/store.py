"""Where checkpoints lie: folders that are whole or not there, or one zip file."""

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from sb3_causalgdp.checkpoints.transitions import FOLDER
from sb3_causalgdp.files import remove_folder, remove_stale, renamed_when_done
from sb3_causalgdp.saving.archives import checked_entries

FORMAT = 1
MANIFEST = "manifest.json"
PREFIX = "checkpoint_"


@dataclass(frozen=True)
class Checkpoint:
    """
    A checkpoint that is whole: its files are there, and are what was written.

    :param path: Its folder, or the zip file
    :param manifest: What it says of itself
    :param read: Opens one of its files, or one of the transitions, by its name
    """

    path: Path
    manifest: dict[str, Any]
    read: Callable[[str], BinaryIO]


def write_checkpoint(folder: Path, files: Mapping[str, bytes], content: dict[str, Any], keep: int | None) -> Path:
    """
    :param folder: Of the checkpoints; transitions are in it already
    :param files: Contents by name
    :param content: Of the manifest, with the log of each buffer
    :param keep: How many of the newest checkpoints to keep, None for all
    :return: The checkpoint's folder
    """
    names = [segment["name"] for log in content["buffers"].values() if log for segment in log["segments"]]
    sums = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    known = _known_sums(folder)
    sums |= {f"{FOLDER}/{name}": known.get(f"{FOLDER}/{name}") or _sum_of(folder / FOLDER / name) for name in names}
    manifest = {"format": FORMAT, **content, "files": sums}
    manifest["checksum"] = _checksum(manifest)
    path = folder / f"{PREFIX}{_next_number(folder):06d}"
    with renamed_when_done(path) as staging:
        for name, data in files.items():
            (staging / name).write_bytes(data)
        (staging / MANIFEST).write_text(json.dumps(manifest, indent=1), encoding="utf-8")
    if keep is not None:
        remove_old(folder, keep)
    return path


def remove_old(folder: Path, keep: int) -> None:
    """
    :param folder: Of checkpoints
    :param keep: How many of the newest to keep
    """
    checkpoints = list(checkpoint_folders(folder))
    for path in checkpoints[:-keep]:
        remove_folder(path)
    named: set[str] = set()
    for path in checkpoints[-keep:]:
        named.update(_manifest_of(path).get("files", {}))
    for file in (folder / FOLDER).glob("*.npz"):
        if f"{FOLDER}/{file.name}" not in named:
            file.unlink()


def checkpoint_folders(folder: Path) -> Iterator[Path]:
    """
    :param folder: Of checkpoints
    :return: Their folders, oldest first
    """
    names = sorted(path.name for path in folder.glob(f"{PREFIX}*") if path.name.removeprefix(PREFIX).isdigit())
    yield from (folder / name for name in names)


def run_of(folder: Path) -> str | None:
    """
    :param folder: Of checkpoints
    :return: The training that they are of, None if there is none
    """
    runs = (_manifest_of(path).get("run") for path in reversed(list(checkpoint_folders(folder))))
    return next((run for run in runs if run is not None), None)


def _manifest_of(path: Path) -> dict[str, Any]:
    """What a checkpoint says of itself, nothing if it is damaged."""
    try:
        return dict(json.loads((path / MANIFEST).read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return {}


@contextmanager
def open_checkpoint(path: Path) -> Iterator[Checkpoint]:
    """
    :param path: A folder of checkpoints, of which the newest that is whole is taken, the folder of one, or a zip file
    :return: The checkpoint
    :raises FileNotFoundError: If there is none
    :raises ValueError: If none is whole; what is wrong with the newest
    """
    with ExitStack() as stack:
        yield _opened_zip(path, stack) if path.is_file() else _newest_whole(path)


def is_checkpoint(path: Path) -> bool:
    """
    :param path: A file
    :return: Whether it is a zip file with a checkpoint in it
    """
    if not zipfile.is_zipfile(path):
        return False
    with zipfile.ZipFile(path) as archive:
        return MANIFEST in archive.namelist()


class CheckpointError(ValueError):
    """What is wrong with a checkpoint."""


def _newest_whole(path: Path) -> Checkpoint:
    candidates = [path] if (path / MANIFEST).is_file() else list(checkpoint_folders(path))[::-1]
    if not candidates:
        raise FileNotFoundError(f"{path}: there is no checkpoint")
    problems = []
    for candidate in candidates:
        try:
            return _checked(candidate, _reader(candidate))
        except CheckpointError as error:
            problems.append(str(error))
    raise ValueError(f"no checkpoint is whole: {'; '.join(problems)}")


def _reader(folder: Path) -> Callable[[str], BinaryIO]:
    def read(name: str) -> BinaryIO:
        path = (folder.parent if name.startswith(f"{FOLDER}/") else folder) / name
        if path.exists() and not path.is_file():
            raise ValueError(f"{name} is no file")
        return path.open("rb")

    return read


def _opened_zip(path: Path, stack: ExitStack) -> Checkpoint:
    try:
        archive = stack.enter_context(zipfile.ZipFile(path))
        checked_entries(archive, path.stat().st_size)
        if MANIFEST not in archive.namelist():
            raise ValueError(f"it has no {MANIFEST}; a saved model is loaded by load()")
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
        raise ValueError(f"{path} is no checkpoint: {error}") from error
    return _checked(path, lambda name: io.BytesIO(archive.read(name)))


def _checked(path: Path, read: Callable[[str], BinaryIO]) -> Checkpoint:
    try:
        with read(MANIFEST) as file:
            manifest = json.loads(file.read())
        if manifest["checksum"] != _checksum(manifest):
            raise CheckpointError(f"{path}: {MANIFEST} is not what was written")
        if manifest["format"] > FORMAT:
            raise CheckpointError(f"{path} is of format {manifest['format']}, this version reads up to {FORMAT}")
        for name, expected in manifest["files"].items():
            if Path(name).name != name.removeprefix(f"{FOLDER}/"):
                raise CheckpointError(f"{path}: {name!r} is no file of a checkpoint")
            with read(name) as file:
                if _digest(file) != expected:
                    raise CheckpointError(f"{path}: {name} is not what was written")
    except (OSError, ValueError, KeyError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        if isinstance(error, CheckpointError):
            raise
        raise CheckpointError(f"{path}: {type(error).__name__} {error}") from error
    return Checkpoint(path, manifest, read)


def _checksum(manifest: dict[str, Any]) -> str:
    content = {name: value for name, value in manifest.items() if name != "checksum"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _sum_of(path: Path) -> str:
    with path.open("rb") as file:
        return _digest(file)


def _digest(file: BinaryIO) -> str:
    digest = hashlib.sha256()
    while block := file.read(1 << 20):
        digest.update(block)
    return digest.hexdigest()


def _known_sums(folder: Path) -> dict[str, str]:
    """Of the files that the newest checkpoint names: they are not read again."""
    newest = list(checkpoint_folders(folder))[-1:]
    return _manifest_of(newest[0]).get("files", {}) if newest else {}


def _next_number(folder: Path) -> int:
    folder.mkdir(parents=True, exist_ok=True)
    remove_stale(folder)
    numbers = [int(path.name.removeprefix(PREFIX)) for path in checkpoint_folders(folder)]
    return max(numbers, default=0) + 1
