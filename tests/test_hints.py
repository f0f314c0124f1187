import configparser
import re
from pathlib import Path

import pytest

import sb3_causalgdp
from sb3_causalgdp.hints import EXTRAS, how_to_install, how_to_make
from sb3_causalgdp.offline.make import TASKS

PACKAGE = Path(sb3_causalgdp.__file__).parent
ROOT = Path(__file__).parents[1]


def test_hints_install_what_the_extras_do():
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    for extra, packages in EXTRAS.items():
        assert [line for line in setup["options.extras_require"][extra].split() if line] == list(packages)
    assert how_to_install("zoo").startswith('pip install "rl-zoo3>=2.7" sb3-contrib ')


def test_no_message_takes_an_index_that_has_not_this_package():
    files = [*PACKAGE.rglob("*.py"), *(ROOT / "benchmarks").rglob("*.py"), *ROOT.rglob("*.md"), *ROOT.rglob("*.ipynb")]
    assert len(files) > 100
    wrong = [file.name for file in files if re.search(r'pip install \\?"?sb3_causalgdp', file.read_text(encoding="utf-8"))]
    assert wrong == []


@pytest.mark.parametrize(
    "dataset_id, task",
    [
        ("D4RL/pointmaze/umaze-v2", "maze2d-umaze"),
        ("D4RL/pointmaze/large-dense-v2", "maze2d-large-dense"),
        ("sb3_causalgdp/maze2d-medium-v0", "maze2d-medium"),
        ("mujoco/hopper/medium-v0", "hopper-medium"),
        ("mujoco/walker2d/expert-v0", "walker2d-medium"),
        ("sb3_causalgdp/halfcheetah-medium-replay-v0", "halfcheetah-medium-replay"),
        ("D4RL/pen/human-v2", "pen-medium"),
    ],
)
def test_a_dataset_that_is_not_to_be_had_can_be_made(dataset_id, task):
    assert task in TASKS
    assert f"`python -m sb3_causalgdp.datasets make {task}`" in how_to_make(dataset_id)


def test_for_other_datasets_there_is_a_list():
    assert "make --help` lists" in how_to_make("D4RL/kitchen/complete-v2")
