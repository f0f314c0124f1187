"""Files that are either the old or the new ones, whatever happens while they are written."""

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

try:
    import fcntl
except ImportError:  # Windows: there temporaries of killed processes stay
    fcntl = None  # type: ignore[assignment]

# Of every temporary's name; what follows is unique
MARK = ".writing-"


@contextmanager
def replaced_when_done(path: str | os.PathLike[str]) -> Iterator[Path]:
    """
    Give a temporary file beside ``path``, of the same suffix, to write to; it takes the place of ``path`` if the block ends
    without an error, once it is on the disk. A link stays a link, its target is replaced; the mode of the old file is kept.
    Temporaries that a killed process left for the same file are removed.

    :param path: File to write; its folder is created
    :raises OSError: If it cannot be written; the error names ``path``, and not the temporary file
    """
    target = Path(os.path.realpath(path))
    target.parent.mkdir(parents=True, exist_ok=True)
    remove_stale(target.parent, target.name)
    with errors_about(path), _locked_temporary(target, is_folder=False) as temporary:
        try:
            yield temporary
            if target.exists():
                shutil.copymode(target, temporary)
            sync(temporary)
            os.replace(temporary, target)
        finally:
            temporary.unlink(missing_ok=True)
    sync(target.parent)


@contextmanager
def saved_when_done(path: Any, suffix: str) -> Iterator[Any]:
    """
    What SB3's ``save`` methods take: a file-like object, which is given back as it is, or a path, for which see
    :func:`replaced_when_done`.

    :param path: File-like object or path
    :param suffix: Of a path that has none, with its dot
    """
    if not isinstance(path, str | os.PathLike):
        yield path
        return
    path = Path(path)
    with replaced_when_done(path if path.suffix else path.with_name(path.name + suffix)) as temporary:
        yield temporary


def write_bytes(path: Any, suffix: str, content: bytes | memoryview) -> None:
    """
    :param path: File-like object or path, as for :func:`saved_when_done`
    :param suffix: Of a path that has none, with its dot
    :param content: What to write
    """
    with saved_when_done(path, suffix) as file:
        if isinstance(file, Path):
            file.write_bytes(content)
        else:
            file.write(content)


@contextmanager
def temporary_folder(folder: Path) -> Iterator[Path]:
    """
    Give an empty folder with a hidden name that is removed at the end; those that a killed process left are removed, too.

    :param folder: Where to make it; it is created
    """
    folder.mkdir(parents=True, exist_ok=True)
    remove_stale(folder)
    with errors_about(folder), _locked_temporary(folder / "folder", is_folder=True) as temporary:
        try:
            yield temporary
        finally:
            shutil.rmtree(temporary, ignore_errors=True)


@contextmanager
def renamed_when_done(path: str | os.PathLike[str]) -> Iterator[Path]:
    """
    Give a temporary folder beside ``path`` to fill; it becomes ``path``, which must not be there, if the block ends without an
    error, once all of it is on the disk. Temporary folders that a killed process left beside it are removed.

    :param path: Folder to make
    :raises FileExistsError: If it is there already
    """
    target = Path(path).absolute()
    if target.exists():
        raise FileExistsError(f"{target} is there already")
    with temporary_folder(target.parent) as temporary, errors_about(path):
        filled = temporary / target.name
        filled.mkdir()
        yield filled
        move_folder(filled, target)


@contextmanager
def errors_about(path: str | os.PathLike[str]) -> Iterator[None]:
    """
    Errors of the system, as on a full disk, name what was to be written in place of a temporary file, or of nothing.

    :param path: What is to be written
    """
    try:
        yield
    except OSError as error:
        if error.errno is None or (error.filename is not None and MARK not in str(error.filename)):
            raise
        raise OSError(error.errno, error.strerror, os.fspath(path)) from error


def move_folder(source: Path, target: Path) -> None:
    """
    Rename a folder once all of it is on the disk.

    :param source: The folder
    :param target: Its new name, which must not be there
    """
    for folder, _, names in os.walk(source):
        for name in (*names, ""):
            sync(Path(folder, name))
    source.rename(target)
    sync(target.parent)


def remove_folder(path: Path) -> None:
    """
    Remove a folder in one step, as others see it.

    :param path: The folder
    """
    doomed = _temporary_name(path)
    with suppress(FileNotFoundError):
        path.rename(doomed)
        shutil.rmtree(doomed, ignore_errors=True)


def remove_stale(folder: Path, name: str | None = None) -> None:
    """
    Remove the temporaries that killed processes left: those that nobody holds a lock on.

    :param folder: Where they are
    :param name: Of the file that they were to become, None for all
    """
    if fcntl is None:
        return
    for entry in list(os.scandir(folder)):
        if not entry.name.startswith(MARK) or (name is not None and not entry.name.endswith(f"-{name}")):
            continue
        with suppress(OSError):
            descriptor = os.open(entry.path, os.O_RDONLY)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(entry.path) if entry.is_dir(follow_symlinks=False) else os.unlink(entry.path)
            finally:
                os.close(descriptor)


def sync(path: Path) -> None:
    """
    :param path: File or folder that shall survive a loss of power
    """
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except PermissionError:  # a folder, on Windows
        return
    try:
        os.fsync(descriptor)
    except OSError:
        # Some file systems cannot for folders; a file that cannot be written is an error
        if not path.is_dir():
            raise
    finally:
        os.close(descriptor)


@contextmanager
def _locked_temporary(target: Path, is_folder: bool) -> Iterator[Path]:
    """A new file or folder beside the target, with a lock that ends with the process, however it ends."""
    while True:
        temporary = _temporary_name(target)
        if is_folder:
            temporary.mkdir()
        descriptor = os.open(temporary, os.O_RDONLY if is_folder else os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o666)
        if fcntl is None:
            break
        fcntl.flock(descriptor, fcntl.LOCK_SH)
        if temporary.exists():
            break
        # Somebody who cleaned up was faster than the lock
        os.close(descriptor)
    try:
        yield temporary
    finally:
        os.close(descriptor)


def _temporary_name(target: Path) -> Path:
    return target.with_name(f"{MARK}{uuid.uuid4().hex[:12]}-{target.name}")
