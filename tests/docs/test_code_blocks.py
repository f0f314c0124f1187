"""
The code of README and documentation: what a page says is run here, one test for each page.

Its ``python`` blocks run one after the other, in one namespace and in an empty folder. What takes hours is made to take
seconds, and the pages need not know:

- ``learn``, ``pretrain``, ``train``, ``distil`` and ``evaluate_policy`` stop after a few steps (``LIMITS``), and so does
  ``range(n)``;
- ``CausalGDP`` and others have smaller defaults (``SMALL``);
- Minari's datasets that pages name are on disk, a few steps of their environments.

A block below ``<!-- not executed: the reason -->`` is compiled, no more, and so is one below ``<!-- needs: package -->`` where
that is missing. Of ``bash`` blocks, our own commands are parsed up to the point where they would begin to work, and make's
targets must exist.
"""

import argparse
import ast
import functools
import importlib.util
import inspect
import re
import runpy
import shlex
import sys
import warnings
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common import evaluation
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback
from sb3_causalgdp.diffusion import NOISE_SCHEDULES
from sb3_causalgdp.offline import make
from sb3_causalgdp.offline.algorithm import OfflineToOnlineAlgorithm

minari = pytest.importorskip("minari")
EpisodeBuffer = pytest.importorskip("minari.data_collector.episode_buffer").EpisodeBuffer

ROOT = Path(__file__).parents[2]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").rglob("*.md")),
    # Pages of the documentation include these
    *(ROOT / "benchmarks" / name / "README.md" for name in ("discovery", "learning")),
]
FENCE = re.compile(r"^```(python|bash)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
ANY_FENCE = re.compile(r"^ *(?:```|~~~)(.*)\n(?:.*\n)*?^ *(?:```|~~~)$", re.MULTILINE)
# Outputs, citations, pages of Sphinx, and YAML, which tests/zoo/test_hyperparameters.py makes models of
OTHER_BLOCKS = re.compile(r"|text|bibtex|yaml|\{[\w-]+\}.*")
NOT_EXECUTED = re.compile(r"<!-- not executed: (.+?) -->\s*\Z")
NEEDS = re.compile(r"<!-- needs: (\w+) -->\s*\Z")
MOST_NOT_EXECUTED = 0

LIMITS = (
    (OffPolicyAlgorithm, "learn", "total_timesteps", 48),
    (OfflineToOnlineAlgorithm, "pretrain", "gradient_steps", 3),
    (CausalGDP, "train", "gradient_steps", 2),
    (CausalGDP, "distil", "gradient_steps", 20),
    (CausalGDP, "distil", "n_observations", 100),
    (evaluation, "evaluate_policy", "n_eval_episodes", 1),
)
LONGEST_LOOP = 60
SMALL = {
    CausalGDP: {
        "learning_starts": 10,
        "batch_size": 16,
        "train_freq": 16,
        "causal_refresh_freq": 40,
        "n_action_candidates": 2,
        "policy_kwargs": {"net_arch": [32], "world_model_net_arch": [16]},
    },
    CausalWorldModelCallback: {"min_transitions": 30},
    SAC: {"batch_size": 16, "policy_kwargs": {"net_arch": [16]}},
}
# Names that a page takes for granted
GIVEN = {
    "docs/causal_discovery.md": """
import numpy as np
rng = np.random.default_rng(0)
states, actions = rng.normal(size=(500, 2)), rng.normal(size=(500, 1))
next_states, rewards = states + 0.1 * rng.normal(size=(500, 2)), rng.normal(size=500)
"""
}


@dataclass(frozen=True)
class Block:
    language: str
    code: str
    line: int  # of the page, on which the code begins
    reason: str | None  # why it is not executed
    needs: str | None  # package without which it is not executed

    @property
    def is_executed(self):
        return self.reason is None and (self.needs is None or importlib.util.find_spec(self.needs) is not None)


def blocks_of(page):
    text = page.read_text(encoding="utf-8")
    for match in FENCE.finditer(text):
        marker, needed = (pattern.search(text[: match.start()]) for pattern in (NOT_EXECUTED, NEEDS))
        line = text.count("\n", 0, match.start(2)) + 1
        yield Block(match[1], match[2], line, marker and marker[1], needed and needed[1])


def name_of(page):
    return page.relative_to(ROOT).as_posix()


def pages_with(language):
    return [page for page in PAGES if any(block.language == language for block in blocks_of(page))]


# python -----------------------------------------------------------------------------------------------------------------


class ShorterLoops(ast.NodeTransformer):
    """``range(20_000)`` becomes ``range(60)``."""

    def visit_Call(self, node):
        self.generic_visit(node)
        match node:
            case ast.Call(func=ast.Name(id="range"), args=[ast.Constant(value=int(count))]) if count > LONGEST_LOOP:
                node.args[0] = ast.copy_location(ast.Constant(LONGEST_LOOP), node.args[0])
        return node


def compiled(block, page):
    tree = ShorterLoops().visit(ast.parse(block.code, filename=str(page)))
    # A traceback then names the page's own line
    return compile(ast.increment_lineno(tree, block.line - 1), str(page), "exec")


def limited(function, argument, largest):
    signature = inspect.signature(function)

    @functools.wraps(function)
    def shorter(*args, **kwargs):
        bound = signature.bind(*args, **kwargs)
        bound.apply_defaults()
        bound.arguments[argument] = min(bound.arguments[argument], largest)
        return function(*bound.args, **bound.kwargs)

    return shorter


def with_defaults(constructor, defaults):
    @functools.wraps(constructor)
    def smaller(self, *args, **kwargs):
        constructor(self, *args, **{**defaults, **kwargs})

    return smaller


@pytest.fixture
def small_budgets(monkeypatch):
    for owner, name, argument, largest in LIMITS:
        monkeypatch.setattr(owner, name, limited(getattr(owner, name), argument, largest))
    for owner, defaults in SMALL.items():
        monkeypatch.setattr(owner, "__init__", with_defaults(owner.__init__, defaults))
    with mock.patch.dict(NOISE_SCHEDULES):  # a page adds one
        yield


def point_maze_episode(env, seed, n_steps=60):
    """As Minari's buffers hold it."""
    observation, _ = env.reset(seed=seed)
    observations, actions, rewards = [observation], [], []
    for _ in range(n_steps):
        actions.append(env.action_space.sample())
        observation, reward, *_ = env.step(actions[-1])
        observations.append(observation)
        rewards.append(reward)
    ends = np.arange(n_steps) == n_steps - 1
    return {
        "observations": {key: np.stack([one[key] for one in observations]) for key in observation},
        "actions": np.stack(actions),
        "rewards": np.array(rewards),
        "terminations": np.zeros(n_steps, dtype=bool),
        "truncations": ends,
    }


@pytest.fixture(scope="module")
def datasets(tmp_path_factory):
    """A folder of Minari datasets: the names of those on the network, the contents a few steps."""
    gym.register_envs(pytest.importorskip("gymnasium_robotics"))
    root = tmp_path_factory.mktemp("minari")
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        patch.setenv("MINARI_DATASETS_PATH", str(root))
        warnings.simplefilter("ignore")  # on datasets without an author and so on
        env = gym.make("PointMaze_UMaze-v3")
        buffers = [EpisodeBuffer(id=seed, **point_maze_episode(env, seed)) for seed in range(2)]
        minari.create_dataset_from_buffers("D4RL/pointmaze/umaze-v2", buffers, env=env)
        make.main(["make", "maze2d-umaze", "--steps", "600", "--quiet"])
    return root


@pytest.mark.parametrize("page", pages_with("python"), ids=name_of)
def test_python_blocks_run(page, small_budgets, datasets, registries, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(datasets))
    namespace: dict[str, object] = {"__name__": "page"}
    exec(GIVEN.get(name_of(page), ""), namespace)
    for block in blocks_of(page):
        if block.language == "python":
            code = compiled(block, page)
            if block.is_executed:
                exec(code, namespace)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_no_block_is_passed_over(page):
    text = page.read_text(encoding="utf-8")
    others = [match[1] for match in ANY_FENCE.finditer(text) if not FENCE.match(match[0])]
    assert [language for language in others if not OTHER_BLOCKS.fullmatch(language)] == []


def test_everything_is_run():
    reasons = [f"{name_of(page)}: {block.reason}" for page in PAGES for block in blocks_of(page) if block.reason is not None]
    assert len(reasons) <= MOST_NOT_EXECUTED, reasons


# bash -------------------------------------------------------------------------------------------------------------------


class Parsed(BaseException):
    """The command line has been accepted; no ``except Exception`` may stop this."""


def commands_of(code):
    """Simple commands as lists of words, without comments and without what is set in front of them."""
    lines = code.replace("\\\n", " ").replace("&&", "\n").replace('"$SRC/', f'"{ROOT}/').splitlines()
    for line in lines:
        words = shlex.split(line, comments=True)
        while words and re.fullmatch(r"\w+=.*", words[0]):
            words.pop(0)
        if words:
            yield words


def parse_python(words, monkeypatch):
    """Everything of ``python ...`` up to the end of ``parse_args``."""
    original = argparse.ArgumentParser.parse_args

    def parse_args(self, *args, **kwargs):
        original(self, *args, **kwargs)
        raise Parsed

    is_module = words[0] == "-m"
    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_args)
    monkeypatch.setattr(sys, "argv", words[1:] if is_module else words)
    with pytest.raises(Parsed):
        if is_module:
            runpy.run_module(words[1], run_name="__main__", alter_sys=True)
        else:
            runpy.run_path(str(ROOT / words[0]), run_name="__main__")


def our_command(words):
    """What follows ``python`` in a command of ours, None for others and where an extra is missing."""
    program, *words = words
    if program == "causalgdp-zoo":
        program, words = "python", ["-m", "sb3_causalgdp.zoo", *words]
    if Path(program).name not in ("python", "python3"):
        return None
    if words[:2] == ["-m", "sb3_causalgdp.zoo"] and importlib.util.find_spec("rl_zoo3") is None:
        return None
    return words if words[0] != "-m" or words[1].split(".")[0] in ("sb3_causalgdp", "benchmarks") else None


@pytest.mark.parametrize("page", pages_with("bash"), ids=name_of)
def test_commands_are_accepted(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(ROOT)
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    for block in blocks_of(page):
        if block.language != "bash" or block.reason is not None:
            continue
        for words in commands_of(block.code):
            if (ours := our_command(words)) is not None:
                with monkeypatch.context() as patch:
                    parse_python(ours, patch)
            elif words[0] == "make":
                assert set(words[1:]) <= set(targets), f"{words}: the Makefile has {targets}"


def test_a_wrong_command_is_found(monkeypatch, capsys):
    with pytest.raises(SystemExit):
        parse_python(["-m", "sb3_causalgdp.causal", "buffer.pkl", "--no-such-option"], monkeypatch)


def test_a_wrong_block_is_found_on_its_line(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# Page\n\n```python\nvalue = 1\nvalue.missing\n```\n", encoding="utf-8")
    (block,) = blocks_of(page)
    with pytest.raises(AttributeError) as error:
        exec(compiled(block, page), {})
    assert error.traceback[-1].lineno == 4  # counted from 0


def test_stand_ins_are_small(datasets, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(datasets))
    sizes = {
        name: minari.load_dataset(name).total_steps for name in ("D4RL/pointmaze/umaze-v2", "sb3_causalgdp/maze2d-umaze-v0")
    }
    assert np.all(np.array([*sizes.values()]) < 1_000), sizes


def test_a_block_that_needs_a_package_is_run_where_that_is_installed(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("".join(f"<!-- needs: {name} -->\n```python\n1\n```\n\n" for name in ("numpy", "no_such_package")))
    assert [block.is_executed for block in blocks_of(page)] == [True, False]
