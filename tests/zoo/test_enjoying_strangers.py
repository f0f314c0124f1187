"""RL Zoo's scripts on the folder of a stranger: none of what it brings is run."""

import pickle

import pytest
import torch as th
from hostile import Hostile

pytest.importorskip("rl_zoo3")
from sb3_causalgdp import CausalGDP
from sb3_causalgdp.zoo.run_folder import RunFolder
from sb3_causalgdp.zoo.settings import check_modules, read_settings

SMALL = {"policy_kwargs": {"net_arch": [8], "world_model_net_arch": [8]}, "device": "cpu", "buffer_size": 100}
MODULE = """
open("mark", "w").close()
import gymnasium
class Wrapper(gymnasium.Wrapper):
    pass
"""


@pytest.fixture
def run(folder, monkeypatch):
    """The run of a stranger, whose folder we are in."""
    monkeypatch.syspath_prepend(str(folder))
    settings = folder / "logs" / "causalgdp" / "Pendulum-v1_1" / "Pendulum-v1"
    settings.mkdir(parents=True)
    (folder / "came_with_the_run.py").write_text(MODULE)
    (settings / "args.yml").write_text("{env: Pendulum-v1, algo: causalgdp, env_kwargs: null}")
    CausalGDP("MlpPolicy", "Pendulum-v1", **SMALL).save(settings.with_suffix(".zip"))
    yield settings
    assert not (folder / "mark").exists()


def enjoy(zoo, *more):
    zoo(
        *("enjoy", "--algo", "causalgdp", "--env", "Pendulum-v1", "-f", "logs", "-n", 2, "--no-render", "--device", "cpu"),
        *more,
    )


HOSTILE = {
    "env_wrapper: came_with_the_run.Wrapper": "names the module of 'came_with_the_run.Wrapper'",
    "env_wrapper: [{came_with_the_run.Wrapper: {}}]": "names the module of 'came_with_the_run.Wrapper'",
    "vec_env_wrapper: came_with_the_run.Wrapper": "names the module of 'came_with_the_run.Wrapper'",
    "env_wrapper: rl_zoo3.utils.get_class_by_name": "'rl_zoo3.utils.get_class_by_name', which is no wrapper",
    "normalize: \"__import__('os').system('touch mark')\"": "normalize must be a dictionary of numbers",
    "x: !!python/object/apply:os.system ['touch mark']": "holds !!python/object/apply:os.system",
}


@pytest.mark.parametrize("text", HOSTILE)
def test_enjoy_runs_nothing_that_settings_name(zoo, run, capsys, text):
    (run / "config.yml").write_text(text)
    with pytest.raises(SystemExit) as stopped:
        enjoy(zoo)
    assert stopped.value.code == 2
    (line,) = (line for line in capsys.readouterr().err.splitlines() if "error:" in line)
    assert "config.yml" in line and HOSTILE[text] in line


def test_enjoy_runs_no_pickle(zoo, run, capsys):
    (run / "config.yml").write_text("normalize: true")
    (run / "vecnormalize.pkl").write_bytes(pickle.dumps(Hostile()))
    with pytest.raises(SystemExit):
        enjoy(zoo)
    assert "vecnormalize.pkl cannot be read as VecNormalize" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["args.yml", "config.yml", "vecnormalize.pkl"])
def test_enjoy_names_a_file_that_is_cut_off(zoo, run, capsys, name):
    (run / "config.yml").write_text("normalize: true")
    (run / name).write_bytes({"vecnormalize.pkl": b"\x80\x04cut"}.get(name, b"{env: Pendulum-v1, algo: [causalgdp"))
    with pytest.raises(SystemExit):
        enjoy(zoo)
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert name in line and "cannot be read as" in line


def test_enjoy_plays_a_run_that_brings_nothing(zoo, run):
    (run / "config.yml").write_text('{normalize: "dict(norm_obs=False, norm_reward=False)", env_wrapper: null}')
    (run / "config.yml").write_text("env_wrapper: [{gymnasium.wrappers.TimeLimit: {max_episode_steps: 2}}]")
    enjoy(zoo)


def test_what_is_trusted_may_bring_code(zoo, run, folder, capsys):
    schedule = {"learning_rate": lambda progress: 1e-3 * progress}
    CausalGDP("MlpPolicy", "Pendulum-v1", **SMALL, **schedule, exploration_noise=0.1).save(run.with_suffix(".zip"))
    model = CausalGDP.load(run.with_suffix(".zip"), trusted=True)
    model.something = lambda: None
    model.save(run.with_suffix(".zip"))
    (run / "config.yml").write_text("env_wrapper: came_with_the_run.Wrapper")
    enjoy(zoo, "--trusted")
    (folder / "mark").unlink()
    (run / "config.yml").write_text("{}")
    with pytest.raises(SystemExit):
        enjoy(zoo)
    error = capsys.readouterr().err
    assert "something" in error and "add --trusted" in error


def test_results_of_plots_are_read_without_running_them(zoo, folder, capsys):
    (folder / "results.pkl").write_bytes(pickle.dumps(Hostile()))
    with pytest.raises(SystemExit):
        zoo("plot_from_file", "-i", "results.pkl")
    assert "results.pkl cannot be read as results: it holds posix.system" in capsys.readouterr().err
    assert not (folder / "mark").exists()


def test_aliases_cannot_make_settings_grow(run):
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 10)]
    (run / "config.yml").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=r"config\.yml cannot be read as YAML: it holds more than 100,000 values"):
        read_settings(run / "config.yml")
    assert "it holds more than 100,000 values" in RunFolder(run.parent).problems["config.yml"]
    (run / "config.yml").write_text("a: &a [*a]")
    with pytest.raises(ValueError, match="it holds more than 100,000 values"):
        read_settings(run / "config.yml")
    (run / "config.yml").write_text("{a: &a [1, 2], b: *a}")
    assert read_settings(run / "config.yml") == {"a": [1, 2], "b": [1, 2]}


def test_a_wrapper_has_to_be_one():
    check_modules({"env_wrapper": "gymnasium.wrappers.TimeLimit", "vec_env_wrapper": "gymnasium.wrappers.NotThere"}, {})
    with pytest.raises(ValueError, match=r"'gymnasium\.make', which is no wrapper"):
        check_modules({"env_wrapper": {"gymnasium.make": {}}}, {})


@pytest.mark.parametrize("name", ["actor", "critic"])
def test_networks_alone_need_trust(folder, name):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **SMALL)
    th.save({"state_dict": {}, "data": Hostile()}, folder / "network.pt")
    with pytest.raises(ValueError, match=r"network\.pt is a pickle, which could run code"):
        type(getattr(model, name)).load(folder / "network.pt")
    assert not (folder / "mark").exists()
