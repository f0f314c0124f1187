"""
The guide's command lines on Pendulum and HalfCheetah, one after the other in one folder, as a reader types them. Numbers are
made smaller, and nothing else; the scripts left out here have tests with stand-ins in ``test_scripts.py``.
"""

import re
import shlex
from pathlib import Path

import numpy as np
import optuna
import pytest

from sb3_causalgdp import CausalGDP

pytest.importorskip("rl_zoo3")
for module in ("mujoco", "moviepy", "pygame", "seaborn"):
    pytest.importorskip(module)

GUIDE = Path(__file__).parents[2] / "docs" / "guide" / "zoo.md"
BLOCK = re.compile(r"^```bash\n(.*?)^```$", re.MULTILINE | re.DOTALL)
ELSEWHERE = ("push_to_hub", "load_from_hub", "record_training", "watch")
LARGEST = {
    "train": {"-n": 100, "--eval-freq": 50, "--save-freq": 50, "--max-total-trials": 1, "--n-startup-trials": 1},
    "enjoy": {"-n": 20},
    "record_video": {"-n": 3},
}
# all_plots cannot tell one run of several episodes from several runs of one
SHORT = ("--env-kwargs", "max_episode_steps:20", "--eval-episodes", "2", "--device", "cpu")
# The last ten of a hundred steps are followed by updates; a search samples the networks
TINY = ("learning_starts:90", "buffer_size:1000", "policy_kwargs:dict(net_arch=[8],world_model_net_arch=[8])")


def documented_commands():
    """Commands of our entry point as lists of words, in the order of the guide."""
    for block in BLOCK.findall(GUIDE.read_text(encoding="utf-8")):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            if words[:1] == ["causalgdp-zoo"] and words[1] not in ELSEWHERE:
                yield words[1:]


def is_tried(words):
    return "sac" not in words and not any(word.startswith("offline/") for word in words)


def smaller(words):
    script, *arguments = words
    largest = LARGEST.get(script, {})
    for place, name in enumerate(arguments[:-1]):
        if name in largest:
            arguments[place + 1] = str(min(int(arguments[place + 1]), largest[name]))
    if script != "train":
        return [script, *arguments]
    steps = [] if "-n" in arguments else ["-n", "100"]
    given = arguments.index("-params") if "-params" in arguments else len(arguments)
    # Of two values for a key, RL Zoo takes the last one
    return [script, *arguments[:given], *steps, *SHORT, "-params", *arguments[given + 1 :], *TINY]


def test_the_guide_can_be_followed(zoo, folder, capsys):
    commands = [words for words in documented_commands() if is_tried(words)]
    tried = {words[0] for words in commands}
    assert tried == {"train", "enjoy", "record_video", "plot_train", "all_plots", "plot_from_file", "report"}
    for words in commands:
        zoo(*smaller(words))
    runs = folder / "logs" / "causalgdp"
    first = runs / "Pendulum-v1_1"
    names = set(re.findall(r"`([\w./-]+\.(?:zip|pkl|npz|csv|yml|txt))`", table_of_files()))
    renamed = {"rl_model_1000_steps.zip": "rl_model_50_steps.zip", "rl_model_2000_steps.zip": "rl_model_100_steps.zip"}
    for name in names - {"Pendulum-v1/vecnormalize.pkl"}:
        path = first / renamed.get(name, name)
        assert path.is_file() or (first / "Pendulum-v1" / name).is_file(), f"the guide promises {name}"
    assert CausalGDP.load(runs / "HalfCheetah-v5_1" / "HalfCheetah-v5.zip", device="cpu").num_timesteps == 100
    assert np.load(runs / "Pendulum-v1_2" / "evaluations.npz")["timesteps"].tolist() == [50, 100]
    assert list(runs.glob("Pendulum-v1_*/videos/final-model-*.mp4"))
    assert (folder / "curves.png").stat().st_size > 0 and (first / "report.html").stat().st_size > 0
    backend = optuna.storages.journal.JournalFileBackend(str(folder / "logs" / "pendulum.log"))
    study = optuna.load_study(storage=optuna.storages.JournalStorage(backend), study_name="pendulum")
    assert len(study.trials) == 2
    assert "With the hyperparameters of trial 1 of pendulum" in capsys.readouterr().out


def table_of_files():
    text = GUIDE.read_text(encoding="utf-8")
    (table,) = re.findall(r"^\| file in `logs/causalgdp/Pendulum-v1_1`.*?\n\n", text, re.MULTILINE | re.DOTALL)
    return table
