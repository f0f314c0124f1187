import numpy as np
import pandas as pd
import pytest

from benchmarks.offline.data import ensure_dataset
from benchmarks.offline.guidance import LoadedModel, sweep
from benchmarks.offline.methods import make_learner
from benchmarks.offline.online import draw, fine_tune, hand_over
from sb3_causalgdp import CausalGDP

pytest.importorskip("mujoco")
pytest.importorskip("minari")

TASK, STEPS = "maze2d-umaze", 1_500
QUICK = {
    "policy_kwargs": {"net_arch": [8], "world_model_net_arch": [8]},
    "batch_size": 16,
    "n_action_candidates": 1,
    "diffusion_steps": 2,
}


def test_one_run_is_evaluated_in_both_stages_and_trained_in_both(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    ensure_dataset(TASK, STEPS)
    rows = fine_tune(TASK, "no_guidance", 0, tmp_path, 4, 8, 2, 1, STEPS, QUICK)
    assert [(row["stage"], row["count"]) for row in rows] == [("offline", 2), ("offline", 4), ("online", 4), ("online", 8)]
    model = CausalGDP.load(tmp_path / "model", trusted=True)
    assert model.num_timesteps == 8 and model._n_updates == 4 + 8


def test_the_hand_over_is_read_off_the_last_offline_and_the_first_online_evaluation(tmp_path):
    columns = ["task", "method", "seed", "stage", "count", "score", "std"]
    values = [("offline", 5, 1.0, 0.1), ("offline", 10, 30.0, 4.0), ("online", 5, 28.0, 5.0), ("online", 10, 60.0, 2.0)]
    table = pd.DataFrame([("maze2d-umaze", "causalgdp", 0, *one) for one in values], columns=columns)
    assert hand_over(table).splitlines()[2] == "| maze2d-umaze | causalgdp | 0 | 30.0 +- 4.0 | 28.0 +- 5.0 | 60.0 +- 2.0 |"
    draw(table, tmp_path / "curve.png")
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_a_checkpoint_is_played_with_another_guidance_than_it_was_trained_with(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    learner = make_learner("causalgdp", TASK, 0, ensure_dataset(TASK, STEPS), QUICK)
    learner.train(3)
    learner.save(tmp_path / "checkpoint-3")
    observations = np.random.default_rng(0).normal(size=(20, 4)).astype(np.float32)
    weak, strong = (LoadedModel(tmp_path / "checkpoint-3", outcome_guidance_scale=scale) for scale in (0.0, 1e6))
    assert strong.model.policy.outcome_guidance_scale == 1e6
    assert not np.allclose(weak.predict(observations), strong.predict(observations))
    lines = sweep([tmp_path / "checkpoint-3"], TASK, [0.0, 30.0], [1, 2], episodes=1)
    assert lines[0] == "| model | candidates | 0 | 30 |" and len(lines) == 4
