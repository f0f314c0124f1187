import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")
SCRIPT = Path(__file__).parents[2] / "benchmarks" / "learning" / "run.py"


def command(folder, *arguments):
    places = ["--folder", folder / "results", "--checkpoints", folder / "checkpoints"]
    return [sys.executable, SCRIPT, *map(str, [*arguments, *places])]


def start(*arguments):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command(*arguments), stdout=subprocess.PIPE, text=True, env=environment, start_new_session=True)


def rows(path):
    return [line.split(",") for line in path.read_text().splitlines()[1:]]


def test_a_run_that_was_killed_goes_on_and_one_that_is_complete_goes_on_with_more_steps(tmp_path):
    arguments = (tmp_path, "--env", "Pendulum-v1", "--eval-freq", 150, "--episodes", 1, "--seeds", 3, "--algorithms", "td3")
    result = tmp_path / "results" / "Pendulum-v1_td3_3.csv"
    complete = start(*arguments, "--steps", 450)
    assert "goes on" not in complete.communicate()[0] and complete.returncode == 0
    first = rows(result)
    assert [row[0] for row in first] == ["150.0", "300.0", "450.0"]
    assert start(*arguments, "--steps", 450).communicate()[0] == ""
    longer = start(*arguments, "--steps", 600)
    assert "goes on after 450 steps" in longer.communicate()[0]
    assert rows(result)[:3] == first and len(rows(result)) == 4
    times = [float(row[4]) for row in rows(result)]
    assert times == sorted(times) and times[0] > 0.0


def test_several_processes_can_work_on_a_queue(tmp_path):
    places = f"--folder {tmp_path}/results --checkpoints {tmp_path}/checkpoints"
    lines = [f"--env Pendulum-v1 --steps 150 --eval-freq 150 --episodes 1 --algorithms sac --seeds 0 1 {places}", "# a remark"]
    (tmp_path / "queue.txt").write_text("\n".join(lines))
    workers = [start(tmp_path, "--queue", tmp_path / "queue.txt") for _ in range(2)]
    end = time.monotonic() + 100
    outputs = [worker.communicate(timeout=end - time.monotonic())[0] for worker in workers]
    assert sorted(path.name for path in (tmp_path / "results").iterdir()) == ["Pendulum-v1_sac_0.csv", "Pendulum-v1_sac_1.csv"]
    # Nobody does what somebody else has done
    assert sum(output.count("Pendulum-v1_sac") for output in outputs) == 2


def test_peers_have_the_settings_of_rl_zoo():
    from contestants import zoo_settings

    assert zoo_settings("tqc", "Hopper-v5") == {
        "policy": "MlpPolicy",
        "learning_starts": 10_000,
        "top_quantiles_to_drop_per_net": 5,
    }
    assert zoo_settings("crossq", "Ant-v5")["policy_kwargs"] == {"net_arch": {"pi": [256, 256], "qf": [2048, 2048]}}
    # RL Zoo has no entry of its own
    assert zoo_settings("sac", "Reacher-v5") == {"policy": "MlpPolicy", "learning_starts": 10_000}
