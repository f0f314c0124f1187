"""The other end of a worker: starts the process, asks, and interleaves several of them."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from benchmarks.speed.workers.protocol import Config

ROOT = Path(__file__).parents[2]
ONE_THREAD = {
    **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS"), "1"),
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1",
    "JAX_PLATFORMS": "cpu",
    "CUDA_VISIBLE_DEVICES": "",
}


class WorkerError(Exception):
    """A worker could not do what it was asked: ``status`` is ``failed`` or ``not available``."""

    def __init__(self, status: str, message: str) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True)
class Contestant:
    """
    :param name: As the tables call it
    :param module: Name of the module under ``benchmarks.speed.workers``
    :param config: What its model is, see :mod:`benchmarks.speed.workers.protocol`
    :param python: Interpreter that has what it needs
    """

    name: str
    module: str
    config: Config = field(default_factory=dict)
    python: str = sys.executable


class Worker:
    """
    A process with one contestant.

    :param contestant: Who
    :param log: File for what it prints
    """

    def __init__(self, contestant: Contestant, log: Path) -> None:
        self.contestant = contestant
        self.about: dict[str, Any] = {}
        environment = {**os.environ, **ONE_THREAD, "PYTHONPATH": str(ROOT)}
        command = [contestant.python, "-m", f"benchmarks.speed.workers.{contestant.module}"]
        self.log = log
        with log.open("a") as errors:
            self.process = subprocess.Popen(
                command, cwd=ROOT, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True
            )

    def setup(self, **more: Any) -> None:
        """
        Make the model, in place of an earlier one.

        :param more: Joined to the contestant's configuration
        """
        self.about = self.ask("setup", config={**self.contestant.config, **more})["value"]

    def ask(self, call: str, **arguments: Any) -> dict[str, Any]:
        """
        :param call: Name of the contestant's method
        :param arguments: Its arguments
        :return: ``cpu`` and ``wall`` seconds, and the ``value`` that it returned
        :raises WorkerError: If it could not
        """
        assert self.process.stdin is not None and self.process.stdout is not None
        try:
            self.process.stdin.write(json.dumps({"call": call, "arguments": arguments}) + "\n")
            self.process.stdin.flush()
            line = self.process.stdout.readline()
        except BrokenPipeError:
            line = ""
        if not line:
            raise WorkerError("failed", f"the process ended with {self.process.wait()}, see {self.log}")
        answer = json.loads(line)
        if answer["status"] != "ok":
            raise WorkerError(answer["status"], answer["error"])
        return answer

    def close(self) -> None:
        """End the process."""
        assert self.process.stdin is not None and self.process.stdout is not None
        with suppress(BrokenPipeError):  # what could not be sent is tried again here
            self.process.stdin.close()
        self.process.wait()
        self.process.stdout.close()


class Field:
    """
    Several contestants, each in a process of its own. One that cannot be set up is left out, and why is kept in ``absent``.

    :param contestants: Who is asked for
    :param log: File for what the processes print
    :param more: Joined to each configuration
    """

    def __init__(self, contestants: Iterable[Contestant], log: Path, **more: Any) -> None:
        self.workers: dict[str, Worker] = {}
        self.absent: dict[str, dict[str, str]] = {}
        for contestant in contestants:
            self.workers[contestant.name] = Worker(contestant, log)
        self.each(lambda worker: worker.setup(**more))

    def each(self, action: Callable[[Worker], Any]) -> None:
        """
        Do something with all workers; whoever fails leaves.

        :param action: What is done
        """
        for name, worker in list(self.workers.items()):
            try:
                action(worker)
            except WorkerError as error:
                print(f"{name}: {error.status}: {error}", flush=True)
                self.absent[name] = {"status": error.status, "error": str(error)}
                self.workers.pop(name).close()

    def interleaved(
        self, rounds: int, turn: Callable[[Worker], Any], warm_up: Callable[[Worker], Any] | None = None
    ) -> dict[str, list[Any]]:
        """
        A B C A B C ...: so that a busy minute of the machine hits all alike.

        :param rounds: Number of turns of each
        :param turn: What a worker does in its turn
        :param warm_up: What it does before the first round, a turn that does not count if None
        :return: What the turns returned, by name
        """
        self.each(warm_up or turn)
        results: dict[str, list[Any]] = {}
        for _ in range(rounds):
            self.each(lambda worker: results.setdefault(worker.contestant.name, []).append(turn(worker)))
        return {name: values for name, values in results.items() if name in self.workers}

    def __enter__(self) -> "Field":
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, traceback: TracebackType | None) -> None:
        for worker in self.workers.values():
            worker.close()


def median_ratio(numerators: list[float], denominators: list[float]) -> float:
    """
    The median of the ratios within a round: drift of the machine is in both.

    :param numerators: One number for each round
    :param denominators: One number for each round
    """
    return float(np.median(np.asarray(numerators) / np.asarray(denominators)))
