"""Files of RL Zoo's own are the old or the new ones, too."""

import numpy as np
import pytest
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.offline.callbacks import WholeEvalCallback
from sb3_causalgdp.zoo.settings import whole_files

pytest.importorskip("rl_zoo3")


class Stopped(Exception):
    pass


def half_written(path, *args, **kwargs):
    with open(path, "wb") as file:
        file.write(b"half")
    raise Stopped


def test_normalizations_are_the_old_or_the_new_ones(tmp_path, monkeypatch):
    env, path = VecNormalize(make_vec_env("Pendulum-v1")), tmp_path / "vecnormalize.pkl"
    with whole_files():
        env.save(str(path))
    before = path.read_bytes()
    assert VecNormalize.load(str(path), env.venv).obs_rms.mean.shape == (3,)
    monkeypatch.setattr(VecNormalize, "save", lambda normalizer, path: half_written(path))
    with whole_files(), pytest.raises(Stopped):
        env.save(str(path))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_evaluations_are_the_old_or_the_new_ones(tmp_path, monkeypatch):
    def evaluations():
        return WholeEvalCallback(
            make_vec_env("Pendulum-v1"), n_eval_episodes=1, eval_freq=10, log_path=str(tmp_path), verbose=0
        )

    model = CausalGDP("MlpPolicy", "Pendulum-v1", policy_kwargs={"net_arch": [8]}, learning_starts=100)
    model.learn(25, evaluations())
    path = tmp_path / "evaluations.npz"
    before = path.read_bytes()
    with np.load(path) as stored:
        assert stored["timesteps"].tolist() == [10, 20]
    monkeypatch.setattr(np, "savez", half_written)
    with pytest.raises(Stopped):
        model.learn(25, evaluations())
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_settings_of_a_run_are_written_in_one_piece(tmp_path, monkeypatch):
    from rl_zoo3 import exp_manager

    from sb3_causalgdp.zoo.manager import CausalGDPExperimentManager

    manager = CausalGDPExperimentManager.__new__(CausalGDPExperimentManager)
    manager.params_path = manager.save_path = str(tmp_path)
    manager._manifest = None
    manager.args = type("Args", (), {})()
    manager._save_config({"learning_rate": 1e-3})
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["args.yml", "command.txt", "config.yml", "versions.yml"]
    before = (tmp_path / "config.yml").read_text()

    def half(content, file):
        file.write("learn")
        raise Stopped

    monkeypatch.setattr(exp_manager.yaml, "dump", half)
    with pytest.raises(Stopped):
        manager._save_config({"learning_rate": 1e-4})
    assert (tmp_path / "config.yml").read_text() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == names
