import importlib
import pickle
from collections import OrderedDict

import numpy as np
import pytest
import yaml
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

pytest.importorskip("rl_zoo3")
from sb3_causalgdp.zoo.algorithm import SetupError
from sb3_causalgdp.zoo.report import report
from sb3_causalgdp.zoo.run_folder import RunFolder
from sb3_causalgdp.zoo.settings import check_modules, check_normalize, load_normalizer, read_settings, safe_files


def test_what_rl_zoo_writes_is_read(tmp_path):
    arguments = OrderedDict([("algo", "causalgdp"), ("env_kwargs", {"a": (1, 2)}), ("seed", 1), ("gym_packages", [])])
    (tmp_path / "args.yml").write_text(yaml.dump(arguments))
    assert "!!python/object/apply:collections.OrderedDict" in (tmp_path / "args.yml").read_text()
    assert read_settings(tmp_path / "args.yml") == arguments


@pytest.mark.parametrize(
    "text",
    [
        '!!python/object/apply:os.system ["touch MARK"]',
        'env: !!python/object/new:subprocess.Popen [["touch", "MARK"]]',
        "env: !!python/name:os.system",
        "!!python/module:antigravity",
        "a: [",
        "\x00",
    ],
)
def test_other_objects_are_refused_in_one_line(tmp_path, hostile, text, capsys):
    settings = tmp_path / "run" / "Pendulum-v1"
    settings.mkdir(parents=True)
    (settings / "args.yml").write_text(text.replace("MARK", str(hostile.mark)))
    with pytest.raises(ValueError, match=r"args\.yml cannot be read as YAML") as error:
        read_settings(settings / "args.yml")
    assert "\n" not in str(error.value)
    run = RunFolder(tmp_path / "run")
    assert run.arguments == {} and "args.yml cannot be read as YAML" in run.problems["args.yml"]
    with pytest.raises(SetupError, match="there is no model yet"):
        report([str(tmp_path / "run")])


def test_rl_zoo_reads_a_run_with_the_same_care(tmp_path, hostile):
    with safe_files():
        zoo = importlib.import_module("rl_zoo3.utils")
        (tmp_path / "config.yml").write_text(f'!!python/object/apply:os.system ["touch {hostile.mark}"]')
        with pytest.raises(ValueError, match=r"config\.yml"):
            zoo.get_saved_hyperparams(str(tmp_path))
        (tmp_path / "config.yml").write_text(f"normalize: \"__import__('os').system('touch {hostile.mark}')\"")
        with pytest.raises(ValueError, match="normalize must be a dictionary of numbers"):
            zoo.get_saved_hyperparams(str(tmp_path))
        (tmp_path / "config.yml").write_text('normalize: "dict(norm_obs=True, norm_reward=False)"')
        assert zoo.get_saved_hyperparams(str(tmp_path))[0]["normalize_kwargs"]["norm_obs"] is True


@pytest.mark.parametrize("value", ["eval('1')", "dict(a=print)", "dict([('a', 1)])", "x", "(" * 500])
def test_normalize_is_a_dictionary_of_numbers(value):
    with pytest.raises(ValueError, match="normalize must be"):
        check_normalize({"normalize": value})


def test_modules_of_a_run_need_trust():
    check_modules({"env_wrapper": ["gymnasium.wrappers.RescaleAction", {"stable_baselines3.x.Y": {}}]}, {"env": "A-v0"})
    for settings, arguments in (
        ({"env_wrapper": "evil.Wrapper"}, {}),
        ({"vec_env_wrapper": [{"evil.Wrapper": {}}]}, {}),
        ({}, {"gym_packages": ["evil"]}),
        ({}, {"env": "evil:Env-v0"}),
    ):
        with pytest.raises(ValueError, match=r"names the module of 'evil.*use --trusted"):
            check_modules(settings, arguments)


def test_normalizations_are_read_without_running_others(tmp_path, hostile):
    env = VecNormalize(make_vec_env("Pendulum-v1", seed=0))
    env.reset()
    env.step(np.zeros((1, 1)))
    env.save(str(tmp_path / "vecnormalize.pkl"))
    loaded = load_normalizer(str(tmp_path / "vecnormalize.pkl"), make_vec_env("Pendulum-v1"))
    np.testing.assert_array_equal(loaded.obs_rms.mean, env.obs_rms.mean)
    for strange in (hostile, [1, 2]):
        (tmp_path / "strange.pkl").write_bytes(pickle.dumps(strange))
        with pytest.raises(ValueError, match=r"strange\.pkl cannot be read as VecNormalize"):
            load_normalizer(str(tmp_path / "strange.pkl"), make_vec_env("Pendulum-v1"))


@pytest.mark.parametrize("name", ["replay_buffer.pkl", "evaluations.npz", "best_model.zip"])
def test_other_files_of_a_run_are_not_run(tmp_path, hostile, name):
    (tmp_path / name).write_bytes(pickle.dumps(hostile))
    run = RunFolder(tmp_path)
    reads = {
        "replay_buffer.pkl": lambda: importlib.import_module("sb3_causalgdp.offline.saved_buffers").read_buffer(
            tmp_path / name
        ),
        "evaluations.npz": run.evaluations,
        "best_model.zip": lambda: report([str(tmp_path)]),
    }
    if name == "evaluations.npz":
        assert reads[name]() is None and run.problems[name].startswith("evaluations.npz is left out")
        return
    with pytest.raises((ValueError, SetupError), match=name.replace(".", r"\.")):
        reads[name]()


def test_a_monitor_file_is_text(tmp_path, hostile):
    (tmp_path / "0.monitor.csv").write_bytes(pickle.dumps(hostile))
    run = RunFolder(tmp_path)
    assert run.training_episodes() is None and any("monitor.csv" in problem for problem in run.problems.values())
