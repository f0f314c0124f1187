import csv
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from benchmarks.suite.jobs import (
    ROOT,
    Job,
    JobError,
    LocalExecutor,
    grid,
    load_result,
    result_path,
    run_in_process,
    run_jobs,
    scratch_path,
)

FUNCTIONS = """
import os, signal, time
from pathlib import Path


def count(scratch, name="calls"):
    with (scratch / name).open("a") as file:
        file.write("x")
    return (scratch / name).stat().st_size


def square(task, method, seed, scratch, factor=1):
    return [{"value": factor * seed**2, "calls": count(scratch)}]


def fails_once(task, method, seed, scratch):
    if count(scratch) == 1:
        raise RuntimeError("no luck")
    return [{"value": seed}]


def fails_always(task, method, seed, scratch):
    raise RuntimeError("never any luck")


def killed_after_a_checkpoint(task, method, seed, scratch):
    checkpoint = scratch / "checkpoint"
    first = int(checkpoint.read_text()) if checkpoint.exists() else 0
    for step in range(first, 4):
        checkpoint.write_text(str(step + 1))
        if step == 1:
            os.kill(os.getpid(), signal.SIGKILL)
    return [{"value": 4, "first": first}]


def slow(task, method, seed, scratch):
    (scratch / "pid").write_text(str(os.getpid()))
    time.sleep(60)


def half_a_second(task, method, seed, scratch):
    calls = count(scratch)
    time.sleep(0.5)
    return [{"calls": calls}]
"""


@pytest.fixture(autouse=True)
def functions(tmp_path, monkeypatch):
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "tiny_jobs.py").write_text(FUNCTIONS)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "code"))


def run(jobs, folder, **kwargs):
    lines = []
    with LocalExecutor(folder, workers=2) as executor:
        return run_jobs(jobs, folder, executor, report=lines.append, **kwargs), lines


def table(folder):
    with (folder / "results.csv").open() as file:
        return list(csv.DictReader(file))


def test_every_combination_has_its_row_in_the_table(tmp_path):
    jobs = grid(["easy", "hard"], ["ours", "theirs"], [2, 3], "tiny_jobs:square", {"factor": 10})
    failed, _ = run(jobs, tmp_path)
    found = {(row["task"], row["method"], row["seed"], row["value"]) for row in table(tmp_path)}
    expected = {(task, method, seed, value) for task in ("easy", "hard") for method in ("ours", "theirs")
                for seed, value in (("2", "40"), ("3", "90"))}  # fmt: skip
    assert failed == [] and found == expected and len(table(tmp_path)) == 8


def test_a_finished_job_is_not_run_again(tmp_path):
    run(grid(["a"], ["b"], [1], "tiny_jobs:square", {}), tmp_path)
    before = result_path(Job("a", "b", 1, "tiny_jobs:square"), tmp_path).stat().st_mtime_ns
    failed, lines = run(grid(["a"], ["b"], [1, 2], "tiny_jobs:square", {}), tmp_path)
    assert failed == [] and lines[0] == "2 jobs, 1 of them finished before"
    assert [row["calls"] for row in table(tmp_path)] == ["1", "1"]
    assert result_path(Job("a", "b", 1, "tiny_jobs:square"), tmp_path).stat().st_mtime_ns == before


def test_a_job_that_fails_once_succeeds_on_its_retry(tmp_path):
    failed, lines = run([Job("a", "b", 7, "tiny_jobs:fails_once")], tmp_path, retries=1)
    assert failed == [] and [row["value"] for row in table(tmp_path)] == ["7"]
    assert "no luck" in lines[1]


def test_what_failed_runs_again_with_the_next_command_and_the_others_do_not_suffer(tmp_path):
    jobs = [Job("a", "b", 7, "tiny_jobs:fails_once"), Job("a", "c", 0, "tiny_jobs:fails_always")]
    failed, lines = run(jobs, tmp_path, retries=0)
    assert {job.method for job in failed} == {"b", "c"} and any("never any luck" in line for line in lines)
    assert table(tmp_path) == []
    failed, _ = run(jobs, tmp_path, retries=0)
    assert [job.method for job in failed] == ["c"] and [row["method"] for row in table(tmp_path)] == ["b"]


def test_a_killed_job_finds_its_checkpoint(tmp_path):
    failed, lines = run([Job("a", "b", 0, "tiny_jobs:killed_after_a_checkpoint")], tmp_path)
    assert failed == [] and "exit status -9" in lines[1]
    assert table(tmp_path)[0]["first"] == "2"


def test_a_checkpoint_of_other_options_is_not_found(tmp_path):
    job = Job("a", "b", 0, "tiny_jobs:killed_after_a_checkpoint")
    with pytest.raises(JobError):
        run_in_process(job, tmp_path)
    assert (scratch_path(job, tmp_path) / "checkpoint").read_text() == "2"
    assert run_in_process(Job("a", "b", 0, "tiny_jobs:square"), tmp_path)["rows"] == [{"value": 0, "calls": 1}]
    assert not (scratch_path(job, tmp_path) / "checkpoint").exists()


def test_a_result_of_other_options_is_not_taken(tmp_path):
    run([Job("a", "b", 2, "tiny_jobs:square", {"factor": 1})], tmp_path)
    with pytest.raises(ValueError, match="made with another factor: choose another folder"):
        run([Job("a", "b", 2, "tiny_jobs:square", {"factor": 2})], tmp_path)


def test_two_processes_with_one_job_run_it_once(tmp_path):
    job = Job("a", "b", 0, "tiny_jobs:half_a_second")
    with ThreadPoolExecutor(2) as pool:
        results = [future.result() for future in [pool.submit(run_in_process, job, tmp_path) for _ in range(2)]]
    assert [result["rows"] for result in results] == [[{"calls": 1}]] * 2


def test_a_job_ends_with_the_process_that_started_it(tmp_path):
    command = [sys.executable, "-m", "benchmarks.suite.run", "--function", "tiny_jobs:slow", "--tasks", "a", "--methods", "b"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ["PYTHONPATH"]])}
    parent = subprocess.Popen([*command, "--folder", str(tmp_path)], env=environment, stdout=subprocess.DEVNULL)
    pid = tmp_path / "scratch" / "a_b_0" / "pid"
    wait_until(pid.exists)
    wait_until(lambda: pid.read_text() != "")
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    wait_until(lambda: not is_alive(int(pid.read_text())))
    assert load_result(Job("a", "b", 0, "tiny_jobs:slow"), tmp_path) is None


def wait_until(condition, seconds=20):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.05)


def is_alive(pid):
    state = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True).stdout.strip()
    # Where nobody waits for it, a dead process stays in the table as a zombie
    return state != "" and not state.startswith("Z")


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("a/b", "c", 0, "m:f"), "names of tasks and methods"),
        (("a", "b", 0, "m.f"), "package.module:function"),
        (("a", "b", 0, "m:f", {"x": (1, 2)}), "JSON"),
        (("a", "b", 0, "m:f", {"x": object()}), "JSON"),
    ],
)
def test_bad_jobs_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Job(*arguments)
