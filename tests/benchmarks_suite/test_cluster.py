import csv
import uuid

import pytest

from benchmarks.suite.jobs import grid, run_jobs

ray = pytest.importorskip("ray")

from benchmarks.suite.cluster import RayExecutor  # noqa: E402

FUNCTIONS = """
def square(task, method, seed, scratch):
    if seed == 2 and not (scratch / "failed").exists():
        (scratch / "failed").touch()
        raise RuntimeError("no luck")
    return [{"value": seed**2}]
"""


def start_cluster(folder):
    try:
        return RayExecutor(folder, "local", num_cpus=2, include_dashboard=False)
    except Exception as error:
        # Ray gives its own processes 30 seconds
        if "timed out during startup" in str(error):
            ray.shutdown()
            pytest.skip("Ray does not start on a machine as busy as this one")
        raise


def test_jobs_run_on_a_cluster_and_failures_are_retried(tmp_path, monkeypatch):
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "tiny_jobs.py").write_text(FUNCTIONS)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "code"))
    # Without one, Ray would write a token into the home folder
    monkeypatch.setenv("RAY_AUTH_TOKEN", uuid.uuid4().hex)
    jobs, lines = grid(["a"], ["b"], [1, 2, 3], "tiny_jobs:square", {}), []
    with start_cluster(tmp_path) as executor:
        assert run_jobs(jobs, tmp_path, executor, report=lines.append) == []
    with (tmp_path / "results.csv").open() as file:
        assert [row["value"] for row in csv.DictReader(file)] == ["1", "4", "9"]
    assert sum("no luck" in line for line in lines) == 1
