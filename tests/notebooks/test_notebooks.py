"""
The notebooks, executed from the first to the last cell in an empty folder.

The constants of the cell tagged "parameters" are replaced by smaller ones. To renew the committed outputs, in notebooks/:

    jupyter execute --inplace --NotebookClient.record_timing=False *.ipynb
"""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.causal import CausalGraph

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")
pytest.importorskip("matplotlib")
pytest.importorskip("networkx")
pytest.importorskip("pandas")

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"
NAMES = sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb"))
LARGEST_NOTEBOOK = 250_000  # bytes, with its pictures
SECONDS_PER_CELL = 300
SHORT_ENTRY = """
Pendulum-v1:
  n_timesteps: 100
  policy: MlpPolicy
  batch_size: 16
  env_kwargs: {max_episode_steps: 40}
"""


def read(name):
    return nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def parameter_cell(notebook):
    (cell,) = (cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", ()))
    return cell


@pytest.fixture
def execute(tmp_path, monkeypatch):
    """Execute a notebook with other parameters; gives the values of expressions at its end, by name."""
    monkeypatch.chdir(tmp_path)
    # Nothing of the user's own, and nothing that is left there
    for variable in ("IPYTHONDIR", "JUPYTER_CONFIG_DIR", "JUPYTER_RUNTIME_DIR", "MINARI_DATASETS_PATH"):
        monkeypatch.setenv(variable, str(tmp_path / variable.lower()))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")

    def run(name, parameters, results):
        notebook = read(name)
        place = notebook.cells.index(parameter_cell(notebook))
        replaced = "\n".join(f"{key} = {value!r}" for key, value in parameters.items())
        notebook.cells.insert(place + 1, nbformat.v4.new_code_cell(replaced))
        values = ", ".join(f"{key!r}: {expression}" for key, expression in results.items())
        notebook.cells.append(nbformat.v4.new_code_cell(f"import json\nprint(json.dumps({{{values}}}))"))
        resources = {"metadata": {"path": str(tmp_path)}}
        # On a busy machine a kernel can take more than nbclient's minute to start
        nbclient.NotebookClient(
            notebook,
            timeout=SECONDS_PER_CELL,
            startup_timeout=SECONDS_PER_CELL,
            kernel_name="python3",
            resources=resources,
        ).execute()
        # What is printed at once may come in parts
        return json.loads("".join(output.get("text", "") for output in notebook.cells[-1].outputs))

    return run


def test_getting_started(execute, tmp_path):
    results = {
        "mean_return": "mean_return",
        "same": "bool(same_actions)",
        "n_edges": "graph.n_edges",
        "n_samples": "graph.n_samples",
    }
    values = execute("getting_started", {"STEPS": 230, "REFRESH": 220, "EPISODES": 1}, results)
    assert -2_000 < values["mean_return"] < 0 and values["same"]
    assert values["n_edges"] > 0 and values["n_samples"] >= 200
    assert CausalGDP.load(tmp_path / "causalgdp_pendulum.zip").num_timesteps == 230
    assert (tmp_path / "causal_graph.png").stat().st_size > 0


def test_offline_to_online(execute, tmp_path):
    pytest.importorskip("minari")
    pytest.importorskip("mujoco")
    parameters = {"DATASET_STEPS": 900, "PRETRAIN_STEPS": 40, "ONLINE_STEPS": 120, "EPISODES": 1}
    results = {
        "scores": "[float(offline_score), float(online_score)]",
        "returns": "online_returns.tolist()",
        "dataset": "[len(dataset), int(dataset.total_steps)]",
        "n_samples": "graph.n_samples",
        "velocity_moves_position": "graph.state_to_state[0, 2]",
    }
    values = execute("offline_to_online", parameters, results)
    assert values["dataset"] == [3, 900] and values["n_samples"] == 900
    assert np.isfinite(values["scores"]).all()
    # D4RL's references
    assert values["scores"][1] == pytest.approx(100 * (np.mean(values["returns"]) - 23.85) / (161.86 - 23.85))
    assert values["velocity_moves_position"] > 0.5
    model = CausalGDP.load(tmp_path / "maze2d_umaze.zip")
    assert (model.n_pretrain_steps, model.num_timesteps) == (40, 120)


def test_what_causes_what(execute, tmp_path):
    results = {
        "torque": "graph.action_to_state[:, 0].tolist()",
        "broken": "broken.action_to_state[:, 0].tolist()",
        "closed": "[[edge.cause, edge.effect] for edge in broken.diff(graph).closed]",
        "errors": "[float(error) for error in errors]",
        "effects": "effects.next_state.mean[:, 0].tolist()",
        "kept": "float(abs(answer.states[0] - recorded[0]).max())",
        "changed": "float(abs(answer.states - recorded).max())",
    }
    values = execute("what_causes_what", {"TRANSITIONS": 1_500, "MODEL_STEPS": 80}, results)
    assert values["torque"][2] > 0.9 and max(values["broken"]) < 0.1
    assert ["torque", "velocity'"] in values["closed"]
    assert all(math.isfinite(error) and error < 1.0 for error in values["errors"])
    assert values["effects"][2] > max(map(abs, values["effects"][:2]))
    assert values["kept"] < 1e-6 and math.isfinite(values["changed"]) and values["changed"] > 0.0
    # What the command line wrote
    written = CausalGraph.load(tmp_path / "graph.json")
    assert written.n_samples == 1_500 and written.variables.state_names == ("cos", "sin", "velocity")


def test_tuning_with_rl_zoo(execute, tmp_path):
    pytest.importorskip("rl_zoo3")
    parameters = {
        "TRIALS": 2,
        "TRIAL_STEPS": 104,
        "STEPS": 120,
        "EPISODES": 1,
        "ENTRY": SHORT_ENTRY,
    }
    values = execute("tuning_with_rl_zoo", parameters, {"best": "best", "values": "report['value'].tolist()"})
    assert len(values["values"]) == 2 and np.isfinite(values["values"]).all()
    assert values["best"] == int(np.argmax(values["values"]))
    (trained,) = (tmp_path / "logs" / "causalgdp").glob("Pendulum-v1_*/Pendulum-v1.zip")
    assert CausalGDP.load(trained, device="cpu").num_timesteps == 120


@pytest.mark.parametrize("name", NAMES)
def test_the_committed_notebook_is_small_and_without_errors(name):
    notebook = read(name)
    nbformat.validate(notebook)
    cells = code_cells(notebook)
    assert [cell.execution_count for cell in cells] == [*range(1, len(cells) + 1)], "executed as a whole"
    outputs = [output for cell in cells for output in cell.outputs]
    assert outputs and not [output for output in outputs if output.output_type == "error"]
    assert sum("image/png" in output.get("data", {}) for output in outputs) <= 2
    assert (NOTEBOOKS / f"{name}.ipynb").stat().st_size < LARGEST_NOTEBOOK


def test_every_notebook_is_executed():
    tests = {name.removeprefix("test_") for name in globals() if name.startswith("test_")}
    assert NAMES and set(NAMES) <= tests
