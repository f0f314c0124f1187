"""One line that says what to do, and no traceback."""

import subprocess
import sys

import pytest

from sb3_causalgdp.zoo import command_line

PENDULUM = ("train", "--algo", "causalgdp", "--env", "Pendulum-v1", "-f", "logs")


@pytest.fixture
def fails(zoo, folder, capsys):
    def run(*arguments):
        with pytest.raises(SystemExit) as raised:
            zoo(*arguments)
        assert raised.value.code == 2
        lines = capsys.readouterr().err.strip().splitlines()
        assert lines[-1].startswith("causalgdp-zoo")
        assert "Traceback" not in "".join(lines)
        return lines[-1]

    return run


def test_usage_lists_the_scripts(capsys):
    for arguments in ([], ["--help"], ["-h"]):
        command_line.main(arguments)
        output = capsys.readouterr().out
        assert all(f"  {script} " in output for script in command_line.SCRIPTS)


@pytest.mark.parametrize("script", ["train", "enjoy", "record_video", "record_training"])
def test_an_environment_has_to_be_named(script, fails, folder):
    assert f"--env is needed, the id of an environment: causalgdp-zoo {script} --env Pendulum-v1" in fails(
        script, "-f", "logs"
    )
    assert not list(folder.iterdir())


def test_the_algorithm_is_ours_unless_another_is_named(zoo, fails, folder, capsys):
    broken = ("train", "--env", "Pendulum-v1", "--env-kwargs", "gravty:3")
    assert "causalgdp on Pendulum-v1: " in fails(*broken)
    assert "sac on Pendulum-v1: " in fails(*broken, "--alg", "sac")
    with pytest.raises(SystemExit) as raised:
        zoo("train", "--help")
    assert raised.value.code == 0 and "--n-timesteps" in capsys.readouterr().out


def test_an_unknown_script(fails):
    assert "unknown script 'trian', it must be one of train, enjoy, " in fails("trian")


@pytest.mark.parametrize(
    "change, message",
    [
        (("--env", "Pendulim-v1"), "Pendulim-v1 not found in gym registry, you maybe meant Pendulum-v1?"),
        (("--env", "CartPole-v1"), "as action spaces but Discrete"),
        (("--gym-packages", "no_such_package"), "No module named 'no_such_package'"),
        (("--conf-file", "missing.yml"), "No such file or directory: 'missing.yml'"),
        (("-i", "missing.zip"), "must be a valid path to a .zip file"),
        (("-params", "eta=3"), "values are Python, as in -params eta:0.5"),
        (("-params", "guidance:score"), "name 'score' is not defined: values are Python"),
        (("-params", "etta:3"), "unknown hyperparameter 'etta': did you mean 'eta'?"),
        (("-params", "eta:-1"), "eta must be a number from 0 to 1e+06, got -1"),
        (("-params", "learning_rate:'exp_3'"), "learning_rate must be a number, or 'lin_' and a number like 'lin_3e-4'"),
        (("-params", "policy_kwargs:dict(net_arc=[8])"), "no argument 'net_arc', did you mean 'net_arch'?"),
        (("--storage", "x.log", "--study-name", "s", "--trial-id", "4"), "x.log"),
        (("--optimize", "--storage", "study.sqlite"), "--storage must end in .log or be a database's URL"),
    ],
)
def test_a_training_that_cannot_start(change, message, fails):
    assert message in fails(*PENDULUM, *change)


@pytest.mark.parametrize(
    "text, message",
    [
        ("Pendulum-v1: {policy: MlpPolicy, n_timesteps: 1e3, lerning_rate: 3e-4}", "did you mean 'learning_rate'?"),
        ("Pendulum-v1: {policy: MlpPolicy}", "the entry lacks n_timesteps"),
        ("Hopper-v5: {policy: MlpPolicy, n_timesteps: 1e3}", "Hyperparameters not found for causalgdp-Pendulum-v1 in bad.yml"),
        ("a: b: c", 'mapping values are not allowed here in "bad.yml", line 1, column 5'),
    ],
)
def test_a_bad_file(text, message, fails, folder):
    (folder / "bad.yml").write_text(text)
    assert message in fails(*PENDULUM, "--conf-file", "bad.yml")
    assert not list(folder.glob("logs/causalgdp/*"))


def test_an_environment_that_cannot_be_made_leaves_no_empty_run(fails, folder):
    # The latest run is what the other scripts look for
    assert "unexpected keyword argument 'gravty'" in fails(*PENDULUM, "--env-kwargs", "gravty:3")
    assert not list(folder.glob("logs/causalgdp/*"))


def test_a_model_that_is_not_there(fails):
    assert "The logs/causalgdp folder was not found" in fails("enjoy", *PENDULUM[1:], "--no-render")


def test_a_plot_without_its_package(fails, monkeypatch):
    monkeypatch.setitem(sys.modules, "seaborn", None)
    for name in [name for name in sys.modules if name.startswith("rl_zoo3.plots")]:
        monkeypatch.delitem(sys.modules, name)
    assert 'pip install "rl-zoo3>=2.7" sb3-contrib' in fails(
        "plot_train", "-a", "causalgdp", "-e", "Pendulum-v1", "-f", "logs"
    )


def test_the_traceback_is_shown_on_request(zoo, folder):
    with pytest.raises(ValueError, match="not found in gym registry"):
        zoo("--traceback", *PENDULUM, "--env", "Pendulim-v1")


def test_errors_in_the_training_keep_their_traceback(zoo, folder, tiny, monkeypatch):
    from sb3_causalgdp import CausalGDP

    def broken(self, *args, **kwargs):
        raise ValueError("broken in the middle")

    monkeypatch.setattr(CausalGDP, "train", broken)
    with pytest.raises(ValueError, match="broken in the middle"):
        zoo(*PENDULUM, "-n", 20, "--eval-freq", -1, *tiny, "learning_starts:5")


def test_without_rl_zoo_the_command_says_how_to_install_it(folder):
    # A process in which the package is not there
    code = "import sys; sys.modules['rl_zoo3'] = None; from sb3_causalgdp.zoo import main; main(['train', '--env', 'A-v1'])"
    done = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}; {code}"], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert done.stderr.strip().splitlines()[-1].startswith("causalgdp-zoo train: error: RL Zoo cannot be imported")
    assert 'pip install "rl-zoo3>=2.7" sb3-contrib' in done.stderr and "Traceback" not in done.stderr
