"""
Jobs of a benchmark, task x method x seed: each is a process of its own, and its result is either complete or not there.

A job's function is called as ``function(task, method, seed, scratch, **options)`` and returns rows of the results table:
mappings of numbers or texts by column. ``scratch`` is a folder of its own for checkpoints, which a later attempt finds as this
one left it.
"""

import csv
import fcntl
import importlib
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from itertools import product
from pathlib import Path
from typing import Any, Protocol

ROOT = Path(__file__).resolve().parents[2]
TABLE = "results.csv"
LINES_OF_LOG = 15


class JobError(RuntimeError):
    """A job ended without a result."""


@dataclass(frozen=True)
class Job:
    """
    :param task: Name of the task
    :param method: Name of the method
    :param seed: Seed
    :param function: What to call, as ``"package.module:function"``
    :param options: Arguments of the function; a finished job is the same one only with the same options
    :param python: Interpreter, None for the one that runs this
    :raises ValueError: If a name cannot be part of a file's name, or if the options are not JSON
    """

    task: str
    method: str
    seed: int
    function: str
    options: dict[str, Any] = field(default_factory=dict)
    python: str | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        for name in (self.task, self.method):
            if not re.fullmatch(r"[\w.-]+", name):
                raise ValueError(f"names of tasks and methods are made of letters, digits, '.', '-' and '_', got {name!r}")
        if not re.fullmatch(r"[\w.]+:\w+", self.function):
            raise ValueError(f"function must be 'package.module:function', got {self.function!r}")
        try:
            same = json.loads(json.dumps(self.options)) == self.options
        except TypeError:
            same = False
        if not same:
            raise ValueError(f"options must be what JSON can hold (lists, no tuples), got {self.options!r}")

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.task}_{self.method}_{self.seed}"

    def identity(self) -> dict[str, Any]:
        """
        :return: All that its result depends on, as JSON
        """
        return {name: value for name, value in asdict(self).items() if name != "python"}


def grid(
    tasks: Sequence[str], methods: Sequence[str], seeds: Sequence[int], function: str, options: dict[str, Any]
) -> list[Job]:
    """
    :param tasks: Names of tasks
    :param methods: Names of methods
    :param seeds: Seeds
    :param function: As for :class:`Job`
    :param options: As for :class:`Job`
    :return: One job for each combination; seeds go first, so that an interrupted benchmark has some seeds of all
    """
    return [Job(task, method, seed, function, options) for seed, task, method in product(seeds, tasks, methods)]


# Files ------------------------------------------------------------------------------------------------------------------


def result_path(job: Job, folder: Path) -> Path:
    """
    :param job: The job
    :param folder: Folder of the benchmark
    :return: File of its result
    """
    return folder / "runs" / f"{job.name}.json"


def scratch_path(job: Job, folder: Path) -> Path:
    """
    :param job: The job
    :param folder: Folder of the benchmark
    :return: Folder of its checkpoints and of its ``log.txt``
    """
    return folder / "scratch" / job.name


def write_atomically(path: Path, text: str) -> None:
    """
    :param path: The file, which is replaced once the new one is complete
    :param text: Its content
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}.{threading.get_ident()}.{path.name}")
    temporary.write_text(text)
    os.replace(temporary, path)


def load_result(job: Job, folder: Path) -> dict[str, Any] | None:
    """
    :param job: The job
    :param folder: Folder of the benchmark
    :return: Its result, None if it is not finished
    :raises ValueError: If the result is that of a job with other options
    """
    path = result_path(job, folder)
    if not path.exists():
        return None
    result = json.loads(path.read_text())
    if result["job"] != job.identity():
        made, wanted = result["job"], job.identity()
        made, wanted = ({**record, **record["options"]} for record in (made, wanted))
        changed = sorted(name for name in {*made, *wanted} - {"options"} if made.get(name) != wanted.get(name))
        raise ValueError(
            f"{path} was made with another {', '.join(changed)}: choose another folder, or delete the file to run it again"
        )
    return result


def store_result(job: Job, folder: Path, result: Mapping[str, Any]) -> None:
    """
    :param job: The job
    :param folder: Folder of the benchmark
    :param result: Its result
    """
    if load_result(job, folder) is None:
        write_atomically(result_path(job, folder), json.dumps(result, indent=1) + "\n")


def write_table(folder: Path) -> Path:
    """
    Write the results of all finished jobs to one table.

    :param folder: Folder of the benchmark
    :return: The table, a CSV file with the columns task, method, seed and those of the rows
    """
    results = [json.loads(path.read_text()) for path in sorted((folder / "runs").glob("*.json"))]
    rows = [
        {"task": result["job"]["task"], "method": result["job"]["method"], "seed": result["job"]["seed"], **row}
        for result in results
        for row in result["rows"]
    ]
    columns = list(dict.fromkeys(column for row in rows for column in row))
    path = folder / TABLE
    temporary = path.with_name(f".{os.getpid()}.{TABLE}")
    folder.mkdir(parents=True, exist_ok=True)
    with temporary.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    os.replace(temporary, path)
    return path


# One job ----------------------------------------------------------------------------------------------------------------


def run_in_process(job: Job, folder: Path, running: "set[subprocess.Popen[bytes]] | None" = None) -> dict[str, Any]:
    """
    Run a job in a new process and wait for it.

    :param job: The job
    :param folder: Folder of the benchmark
    :param running: Where the process is to be found while it runs
    :return: Its result
    :raises JobError: If it ended without one
    """
    scratch = scratch_path(job, folder)
    scratch.mkdir(parents=True, exist_ok=True)
    # Scratch folders are not for version control
    write_atomically(scratch.parent / ".gitignore", "*\n")
    paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
    environment = {
        **os.environ,
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1"),
        "PYTHONPATH": os.pathsep.join(path for path in paths if path),
    }
    command = [job.python or sys.executable, "-m", "benchmarks.suite.jobs"]
    with (scratch / "log.txt").open("ab") as log:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=environment)
    assert process.stdin is not None
    running = set() if running is None else running
    running.add(process)
    try:
        process.stdin.write(json.dumps([job.identity(), str(folder)]).encode() + b"\n")
        process.stdin.flush()
        status = process.wait()
    except BrokenPipeError:
        status = process.wait()
    finally:
        running.discard(process)
        process.stdin.close()  # if it still runs, it ends
    result = load_result(job, folder) if status == 0 else None
    if result is None:
        lines = (scratch / "log.txt").read_text(errors="replace").splitlines()[-LINES_OF_LOG:]
        raise JobError(f"exit status {status}, see {scratch / 'log.txt'}:\n" + "\n".join(f"    {line}" for line in lines))
    return result


def main() -> None:
    """Run the job that stands in the first line of the standard input, while that stays open."""
    request = b""
    while not request.endswith(b"\n"):
        part = os.read(0, 65_536)
        if not part:
            raise SystemExit("no job was given: this module is started by run_in_process")
        request += part
    threading.Thread(target=_end_with_parent, daemon=True).start()
    identity, folder = json.loads(request)
    job, folder = Job(**identity), Path(folder)
    # A machine that was given up may still be at it; whoever comes second takes the other's result
    with locked(scratch_path(job, folder).with_suffix(".lock")):
        if load_result(job, folder) is None:
            execute(job, folder)


def execute(job: Job, folder: Path) -> None:
    """
    Call the job's function and write its result.

    :param job: The job
    :param folder: Folder of the benchmark
    """
    scratch = scratch_path(job, folder)
    _forget_other_options(job, scratch)
    module, name = job.function.split(":")
    function: Callable[..., Iterable[Mapping[str, Any]]] = getattr(importlib.import_module(module), name)
    wall, cpu = time.perf_counter(), time.process_time()
    rows = [dict(row) for row in function(job.task, job.method, job.seed, scratch, **job.options)]
    # Of the last attempt alone
    spent = {"wall_seconds": round(time.perf_counter() - wall, 1), "cpu_seconds": round(time.process_time() - cpu, 1)}
    store_result(job, folder, {"job": job.identity(), **spent, "rows": rows})


def _forget_other_options(job: Job, scratch: Path) -> None:
    """A checkpoint with other options is of no use."""
    record = scratch / "job.json"
    if record.exists() and json.loads(record.read_text()) != job.identity():
        for path in scratch.iterdir():
            if path.name != "log.txt":
                shutil.rmtree(path) if path.is_dir() else path.unlink()
    write_atomically(record, json.dumps(job.identity()))


def _end_with_parent() -> None:
    """The other end of the standard input is closed by whoever started this, or by its death."""
    while os.read(0, 1):
        pass
    os._exit(70)


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """
    Wait until no other process on this file system holds a lock, and hold it.

    :param path: File of the lock
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)  # freed when the process ends, however it ends
        yield


# Many jobs --------------------------------------------------------------------------------------------------------------


class Executor(Protocol):
    """Where jobs run."""

    def submit(self, job: Job) -> "Future[dict[str, Any]]": ...


class LocalExecutor:
    """
    Processes on this machine; leaving the context ends those that still run.

    :param folder: Folder of the benchmark
    :param workers: Number of jobs that run at a time
    """

    def __init__(self, folder: Path, workers: int = 1) -> None:
        self.folder = folder
        self._running: set[subprocess.Popen[bytes]] = set()
        self._pool = ThreadPoolExecutor(workers)

    def submit(self, job: Job) -> "Future[dict[str, Any]]":
        """
        :param job: The job
        :return: Its result, once there is one
        """
        return self._pool.submit(run_in_process, job, self.folder, self._running)

    def __enter__(self) -> "LocalExecutor":
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in list(self._running):
            process.kill()
        self._pool.shutdown()


def run_jobs(
    jobs: Sequence[Job], folder: Path, executor: Executor, retries: int = 1, report: Callable[[str], object] = print
) -> list[Job]:
    """
    Run all jobs that have no result yet, and write the table whenever one has finished.

    :param jobs: The jobs
    :param folder: Folder of the benchmark
    :param executor: Where they run
    :param retries: How often a failed job is run again
    :param report: What is called with each line of progress
    :return: The jobs that failed
    :raises ValueError: If a result is there that was made with other options
    """
    waiting = [job for job in jobs if load_result(job, folder) is None]
    n_done = len(jobs) - len(waiting)
    report(f"{len(jobs)} jobs, {n_done} of them finished before")
    start, failures, failed = time.monotonic(), Counter[str](), []
    futures = {executor.submit(job): job for job in waiting}
    while futures:
        for future in wait(futures, return_when=FIRST_COMPLETED).done:
            job = futures.pop(future)
            try:
                result = future.result()
            except Exception as error:  # whatever the job or the machine raised
                failures[job.name] += 1
                if failures[job.name] <= retries:
                    report(f"{job.name} failed and is run again: {error}")
                    futures[executor.submit(job)] = job
                else:
                    report(f"{job.name} failed for good: {error}")
                    failed.append(job)
                continue
            store_result(job, folder, result)
            write_table(folder)
            n_done += 1
            n_now = n_done - len(jobs) + len(waiting)
            minutes = (time.monotonic() - start) / n_now * len(futures) / 60
            left = f", {len(futures)} left, about {minutes:.0f} min" if futures else ""
            report(f"[{n_done}/{len(jobs)}] {job.name}: {result['wall_seconds']:.0f} s{left}")
    write_table(folder)
    return failed


if __name__ == "__main__":
    main()
