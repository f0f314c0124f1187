"""
A worker: a process that holds one model and answers, one line of JSON for each line that it is sent, in CPU seconds.

    {"call": "setup", "arguments": {"config": {...}}}   ->   {"status": "ok", "cpu": 1.9, "wall": 2.0, "value": {...}}
    {"call": "update", "arguments": {"n": 20}}          ->   {"status": "ok", "cpu": 0.2, "wall": 0.2, "value": null}

CPU seconds are those of the whole process: a library that starts threads of its own pays for them.
"""

import json
import os
import sys
import time
import traceback
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from typing import Any, TextIO

Config = dict[str, Any]
"""
``transitions``: path of the arrays; ``batch_size``; ``env``: id of the task, None for its spaces alone; ``n_envs``; and what
the worker's own module says.
"""


class NotAvailable(Exception):
    """What was asked for does not exist in the version that is installed."""


def serve(make: Callable[[Config], Any], source: TextIO | None = None, sink: TextIO | None = None) -> None:
    """
    Answer until the input ends. What models print goes to standard error.

    :param make: Makes the contestant from a configuration; its public methods are what can be called
    :param source: Where requests come from, standard input if None
    :param sink: Where answers go to, standard output if None
    """
    if sink is None:
        sink = os.fdopen(os.dup(1), "w")
        os.dup2(2, 1)
    contestant: Any = None
    for line in source or sys.stdin:
        request = json.loads(line)
        arguments = request.get("arguments", {})
        try:
            if request["call"] == "setup":
                contestant = None
                answer, contestant = _timed(make, **arguments)
                answer["value"] = contestant.about()
            else:
                answer, answer["value"] = _timed(getattr(contestant, request["call"]), **arguments)
        except NotAvailable as error:
            answer = {"status": "not available", "error": str(error)}
        except Exception:
            traceback.print_exc()
            answer = {"status": "failed", "error": traceback.format_exc().strip().splitlines()[-1]}
        sink.write(json.dumps(answer) + "\n")
        sink.flush()


def _timed(call: Callable[..., Any], **arguments: Any) -> tuple[dict[str, Any], Any]:
    wall, cpu = time.perf_counter(), time.process_time()
    value = call(**arguments)
    return {"status": "ok", "cpu": time.process_time() - cpu, "wall": time.perf_counter() - wall}, value


def versions(*packages: str) -> dict[str, str]:
    """
    :param packages: Names of distributions
    :return: The versions of those that are installed
    """
    found = {}
    for package in packages:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found
