"""A run of RL Zoo that was interrupted goes on, in its own folder, when the same command is given again."""

import csv
import fcntl
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

from sb3_causalgdp.checkpoints.store import open_checkpoint
from sb3_causalgdp.files import replaced_when_done

FOLDER = "checkpoints"
COMMAND = "command.json"


class RunLock:
    """
    Says which process works in the folder of a run, until that process ends, however it ends.

    :param folder: Of the run
    :raises BlockingIOError: If another process does
    """

    def __init__(self, folder: Path) -> None:
        checkpoints = folder / FOLDER
        checkpoints.mkdir(exist_ok=True)
        self._file: IO[str] = open(checkpoints / "lock", "w")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise


def write_command(folder: Path) -> None:
    """
    :param folder: Of the run that this process's command has begun
    """
    with replaced_when_done(folder / FOLDER / COMMAND) as file:
        file.write_text(json.dumps(sys.argv[1:]), encoding="utf-8")


def interrupted_run(log_path: Path, environment: str) -> tuple[Path, RunLock, dict[str, Any]] | None:
    """
    :param log_path: Folder of the algorithm's runs
    :param environment: Name of the environment in the names of runs
    :return: The newest run of this process's command that has a checkpoint and no final model, and that nobody works on; and
        what its checkpoint says of itself
    """
    for folder in sorted(_runs(log_path, environment), key=lambda path: path.stat().st_mtime, reverse=True):
        if (folder / f"{environment}.zip").exists() or _command(folder) != sys.argv[1:]:
            continue
        try:
            lock = RunLock(folder)
            with open_checkpoint(folder / FOLDER) as checkpoint:
                return folder, lock, checkpoint.manifest
        except (BlockingIOError, FileNotFoundError):
            continue
        except ValueError as error:
            print(f"{folder} cannot go on: {error}", file=sys.stderr)
    return None


def new_folder(path: str, numbered: Callable[[], str]) -> str:
    """
    Make the folder of a run. Of two processes that want the same number, one gets the next.

    :param path: Its name with the first free number
    :param numbered: Gives the name for the first number that is free now
    :return: The folder that was made
    """
    os.makedirs(os.path.dirname(path), exist_ok=True)
    while True:
        try:
            os.mkdir(path)
            return path
        except FileExistsError:
            path = numbered()


def cut_monitors(folder: Path, steps_per_environment: int) -> None:
    """
    Remove the episodes that ended behind the checkpoint: they will be played again.

    :param folder: Of the run
    :param steps_per_environment: At the checkpoint
    """
    for path in folder.glob("*.monitor.csv"):
        with path.open(newline="", encoding="utf-8", errors="replace") as file:
            header, rows = file.readline(), list(csv.reader(file))
        if not rows or "l" not in rows[0]:
            continue
        names, kept, steps = rows[0], [], 0
        for row in rows[1:]:
            # A row that was cut off is of the last episode
            if len(row) != len(names) or not row[names.index("l")].isdigit():
                break
            steps += int(row[names.index("l")])
            if steps > steps_per_environment:
                break
            kept.append(row)
        with replaced_when_done(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
            file.write(header)
            csv.writer(file, lineterminator="\n").writerows([names, *kept])


def _runs(log_path: Path, environment: str) -> Iterator[Path]:
    return (path for path in log_path.glob(f"{environment}_*") if (path / FOLDER).is_dir())


def _command(folder: Path) -> list[str] | None:
    try:
        return json.loads((folder / FOLDER / COMMAND).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
