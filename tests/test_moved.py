import importlib
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from small_models import SMALL

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.moved import MOVED
from sb3_causalgdp.sources.rewards import RewardTransform

DATA = Path(__file__).parent / "data"
# Of the version in which both files were written, for this observation
OBSERVATION, ACTION = np.array([[0.5, 0.5, 1.0]], dtype=np.float32), 1.1722972

ARRAYS = {
    "observations": np.zeros((15, 3)),
    "actions": np.zeros((15, 1)),
    "rewards": np.arange(15.0),
    "next_observations": np.zeros((15, 3)),
    "terminations": np.arange(15) % 5 == 4,
    "truncations": np.zeros(15, bool),
}


@pytest.mark.parametrize("old", MOVED)
def test_old_names_of_modules_are_the_new_modules_and_say_so(old, monkeypatch):
    # Where another test may have put it
    monkeypatch.delitem(sys.modules, old, raising=False)
    with pytest.warns(DeprecationWarning, match=f"{old} is {MOVED[old]} now"):
        module = importlib.util.find_spec(old).loader.create_module(importlib.util.find_spec(old))
    assert module is importlib.import_module(MOVED[old])
    assert module.__spec__.name == MOVED[old]


def test_classes_that_went_elsewhere_are_found_under_their_old_names(tmp_path):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **SMALL, reward_transform="antmaze").preload(ARRAYS)
    model.save(tmp_path / "new.zip")
    with zipfile.ZipFile(tmp_path / "new.zip") as new, zipfile.ZipFile(tmp_path / "old.zip", "w") as old:
        for name in new.namelist():
            old.writestr(name, new.read(name).replace(b"sb3_causalgdp.sources.rewards.", b"sb3_causalgdp.offline.rewards."))
        assert b"sb3_causalgdp.sources.rewards.RewardTransform" in new.read("plain.json")
    with zipfile.ZipFile(tmp_path / "old.zip") as old:
        assert b"sb3_causalgdp.offline.rewards.RewardTransform" in old.read("plain.json")
    assert CausalGDP.load(tmp_path / "old.zip", device="cpu")._reward_transform == RewardTransform(4.0, -2.0)


@pytest.mark.parametrize("name", ["Source", "Chunk", "MinariSource", "BufferSource", "ArraySource", "TableSource"])
def test_sources_can_be_imported_from_where_they_were(name):
    assert getattr(importlib.import_module("sb3_causalgdp.offline.sources"), name).__module__.startswith(
        "sb3_causalgdp.sources."
    )


def test_a_model_that_was_saved_under_old_names_loads():
    model = CausalGDP.load(DATA / "model_of_0_1.zip")
    assert model.predict(OBSERVATION, deterministic=True)[0] == pytest.approx(ACTION, abs=1e-4)
    assert model.causal_graph().num_timesteps == model.causal_graph_history[-1].num_timesteps == 500
    found = model.discovery(model.causal_statistics, model.transition_variables)
    np.testing.assert_allclose(found.state_to_state, model.causal_graph().state_to_state, atol=1e-5)


def test_a_training_whose_checkpoint_has_old_names_goes_on():
    program = (
        "import sys; from sb3_causalgdp import CausalGDP\n"
        "model = CausalGDP.resume(sys.argv[1], 'Pendulum-v1')\n"
        "n_updates = model._n_updates\n"
        "model.learn(20, reset_num_timesteps=False)\n"
        "assert model.num_timesteps == 540 and model._n_updates == n_updates + 20\n"
    )
    # In a process of its own: RL Zoo, which other tests import, has other wrappers
    subprocess.run([sys.executable, "-c", program, DATA / "checkpoint_of_0_1.zip"], check=True)
