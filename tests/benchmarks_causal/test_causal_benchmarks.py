import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("rl_zoo3")
FOLDER = Path(__file__).parents[2] / "benchmarks"


def call(script, *arguments):
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(FOLDER / script), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout


def test_a_run_under_distraction_goes_on_where_it_was(tmp_path):
    arguments = ["--env", "Pendulum-v1", "--noises", 3, "--idle-actions", 2, "--seeds", 4, "--eval-freq", 100, "--episodes", 1]
    places = ["--folder", tmp_path / "results", "--checkpoints", tmp_path / "checkpoints"]
    algorithms = ["--algorithms", "sac", "causalgdp_open"]
    call("causal/distraction.py", *arguments, *algorithms, "--steps", 100, *places)
    names = sorted(path.name for path in (tmp_path / "results").iterdir())
    assert names == ["Pendulum-v1_causalgdp_open_m3_k2_4.csv", "Pendulum-v1_sac_m3_k2_4.csv"]
    text = call("causal/distraction.py", *arguments, *algorithms, "--steps", 200, *places)
    assert text.count("goes on after 100 steps") == 2
    assert len((tmp_path / "results" / names[0]).read_text().splitlines()) == 3


def test_a_queue_holds_all_pairs_for_the_other_runner(tmp_path):
    arguments = ["--env", "Pendulum-v1", "--noises", 0, 20, "--idle-actions", 0, 6, "--seeds", 0, 1, "--print-queue"]
    lines = call("causal/distraction.py", *arguments, "--folder", tmp_path / "results").splitlines()
    assert len(lines) == 8 and '"noises": 20, "idle_actions": 6' in lines[3]
    sys.path.append(str(FOLDER / "learning"))
    from run import make_parser, runs_of

    (tmp_path / "queue.txt").write_text("\n".join(lines))
    import shlex

    parsed = [run for line in lines for run in runs_of(make_parser().parse_args(shlex.split(line)))]
    assert len({run.title for run in parsed}) == 8 and parsed[3].env_kwargs == {"noises": 20, "idle_actions": 6}


def test_the_gate_is_judged_without_training(tmp_path):
    pytest.importorskip("mujoco")
    output = tmp_path / "relevance.csv"
    arguments = [
        "--noises",
        5,
        "--idle-actions",
        1,
        "--seeds",
        0,
        "--steps",
        3000,
        "--behaviours",
        "random",
        "--output",
        output,
    ]
    call("causal/relevance.py", *arguments)
    (row,) = csv.DictReader(output.open())
    assert row["behaviour"] == "random" and row["own_closed"] == "0" and row["others_open"] == "6 0 0"


def test_the_graph_of_a_window_follows_a_world_that_changes(tmp_path):
    pytest.importorskip("mujoco")
    output = tmp_path / "switch.csv"
    times = ["--at-step", 4000, "--after", 4000, "--windows", 2000, 0, "--seeds", 0, "--changes", "distractor"]
    call("causal/switch.py", "--env", "InvertedPendulum-v5", *times, "--output", output)
    window, everything = csv.DictReader(output.open())
    assert int(window["edges_gone"]) > 0 and int(window["edges_come"]) > 0
    assert int(window["steps_gone"]) <= 3000 and int(window["steps_come"]) <= 3000
    assert everything["steps_gone"] == "never"


def test_the_real_table_has_the_edges_that_the_documentation_names():
    pytest.importorskip("statsmodels")
    lines = dict(line.split(": ", 1) for line in call("causal/real_table.py").splitlines() if ": " in line)
    assert lines["unemp'"] == "unemp 1.00" and lines["reward (infl)"] == "cpi 1.00"
    assert lines["realinv'"] == "realcons 0.99" and lines["realgdp'"] == "-"


def test_pucks_move_only_where_they_are_touched_and_the_benchmark_trains():
    sys.path.append(str(FOLDER / "causal"))
    import numpy as np
    from objects import Pucks

    env = Pucks()
    for seed in range(20):
        env.reset(seed=seed)
        before, gap = env.puck.copy(), np.linalg.norm(env.puck - env.point)
        env.step(np.zeros(2))
        assert np.array_equal(before, env.puck) == (gap >= env.RADIUS)
    arguments = ["--steps", 60, "--eval-freq", 60, "--episodes", 1, "--seeds", 0]
    assert call("causal/objects.py", *arguments).count("success") == 2
