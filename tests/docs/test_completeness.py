"""What the documentation promises to list: public names, arguments, logged keys, errors, figures."""

import ast
import inspect
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import small
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv, FakeImageEnv
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import sb3_causalgdp
from sb3_causalgdp import CausalGDP, CausalWorldModelCallback
from sb3_causalgdp.arguments import GROUPS
from sb3_causalgdp.causal import CausalGraph, TransitionVariables
from sb3_causalgdp.policies import CausalGDPPolicy

PACKAGE = Path(sb3_causalgdp.__file__).parent
DOCS = Path(__file__).parents[2] / "docs"
KWARGS = small(learning_starts=10, train_freq=16, causal_refresh_freq=48)


def read(page):
    return (DOCS / page).read_text(encoding="utf-8")


# Names ------------------------------------------------------------------------------------------------------------------


def module_of(file):
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def public_names(file):
    """``__all__``, or without one what is defined there and has no underscore."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name) and node.targets[0].id == "__all__":
            return ast.literal_eval(node.value)
    defined = (node.name for node in tree.body if isinstance(node, ast.ClassDef | ast.FunctionDef))
    return [name for name in defined if not name.startswith("_")]


MODULES = (
    "callbacks/diagnostics",
    "callbacks/pictures",
    "losses",
    "networks",
    "policies",
    "prediction",
    "questions",
    "updates",
)
PUBLIC_MODULES = [
    *(file for file in sorted(PACKAGE.rglob("__init__.py")) if file.read_text(encoding="utf-8").strip()),
    *(PACKAGE / f"{name}.py" for name in MODULES),
]


def documented_names():
    """Full names of what the API reference documents, and modules that it documents whole."""
    names, modules = set(), set()
    for page in (DOCS / "modules").glob("*.md"):
        text = page.read_text(encoding="utf-8")
        names.update(re.findall(r"^\.\. (?:auto\w+|py:\w+):: (\S+)$", text, re.MULTILINE))
        modules.update(re.findall(r"^\.\. automodule:: (\S+)\n    :members:\n", text + "\n", re.MULTILINE))
        for members in re.findall(r"^\.\. automodule:: \S+\n    :members: (.+)$", text, re.MULTILINE):
            names.update(members.split(", "))
    return names, modules


@pytest.mark.parametrize("file", PUBLIC_MODULES, ids=module_of)
def test_every_public_name_is_in_the_api_reference(file):
    names, modules = documented_names()
    module = module_of(file)
    last_parts = {name.rpartition(".")[2] for name in names}
    missing = [name for name in public_names(file) if module not in modules and name not in last_parts]
    assert not [name for name in missing if name != "__version__"], f"docs/modules lacks these of {module}: {missing}"


def test_every_name_that_a_page_imports_is_in_the_api_reference():
    names, modules = documented_names()
    last_parts = {name.rpartition(".")[2] for name in names}
    pages = [DOCS.parent / "README.md", *DOCS.rglob("*.md")]
    imports = [
        (match[1], name.strip())
        for page in pages
        for match in re.finditer(
            r"^from (sb3_causalgdp[\w.]*) import ([\w, ]+)$", page.read_text(encoding="utf-8"), re.MULTILINE
        )
        for name in match[2].split(",")
    ]
    assert len(imports) > 20
    assert {(module, name) for module, name in imports if module not in modules and name not in last_parts} == set()


# Arguments --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("owner", [CausalGDP, CausalGDPPolicy])
def test_every_argument_is_in_the_overview_and_in_the_docstring(owner):
    parameters = [name for name in inspect.signature(owner.__init__).parameters if name != "self"]
    listed = set(re.findall(r"`(\w+)`", read("guide/arguments.md")))
    assert not set(parameters) - listed, "docs/guide/arguments.md lacks these"
    described = re.findall(r":param (\w+):", inspect.getdoc(owner) or "")
    assert described == parameters


def test_the_overview_has_the_groups_of_the_table():
    page = read("guide/arguments.md")
    sections = re.split(r"^## ", page, flags=re.MULTILINE)[1:]
    rows = {section.partition("\n")[0]: re.findall(r"^\| (`.*?) \|", section, re.MULTILINE) for section in sections}
    for group, arguments in GROUPS.items():
        shown = set(re.findall(r"`(\w+)`", " ".join(rows[group])))
        assert shown == set(arguments) - {"_init_setup_model"}, group


def test_the_overview_lists_no_argument_that_is_gone():
    rows = re.findall(r"^\| (`.*?) \|", read("guide/arguments.md"), re.MULTILINE)
    known = {name for owner in (CausalGDP, CausalGDPPolicy) for name in inspect.signature(owner.__init__).parameters}
    assert not set(re.findall(r"`(\w+)`", " ".join(rows))) - known


# Logged keys ------------------------------------------------------------------------------------------------------------


def test_every_logged_key_has_a_row_and_every_row_a_key(monkeypatch):
    recorded = set()
    record = Logger.record
    monkeypatch.setattr(Logger, "record", lambda self, key, *args, **kw: recorded.add(key) or record(self, key, *args, **kw))
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **KWARGS)
    model.learn(64, callback=CausalWorldModelCallback(min_transitions=30))
    model.pretrain(1, log_interval=1)
    cells = re.findall(r"^\| (`\w+/\w+`.*?) \|", read("guide/callbacks.md"), re.MULTILINE)
    rows = {key for cell in cells for key in re.findall(r"`(\w+/\w+)`", cell)}
    ours = {key for key in recorded if not key.startswith("rollout/") and key not in sb3_keys()}
    assert ours - rows == set(), "docs/guide/callbacks.md lacks these"
    # By a callback of its own, tests/offline/test_scores.py, by a preset, tests/test_presets.py, and by longer trainings,
    # tests/callbacks/test_diagnostics.py, tests/test_abstraction.py and tests/test_counterfactual.py
    of_others = {"policy/q_error", "train/pessimism", "train/actor_gradient_norm"}
    of_others |= {"causal/n_components", "causal/exchanged_share"}
    assert rows - recorded == {"eval/normalized_score", "train/trust_region_loss"} | of_others


def sb3_keys():
    return {f"time/{name}" for name in ("episodes", "fps", "time_elapsed", "total_timesteps")} | {"train/learning_rate"}


# Errors that the page on SB3 quotes -------------------------------------------------------------------------------------


class NanEnv(gym.Env):
    observation_space = spaces.Box(-1.0, 1.0, (2,))
    action_space = spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        return np.zeros(2, dtype=np.float32), {}

    def step(self, action):
        return np.full(2, np.nan, dtype=np.float32), 0.0, False, False, {}


class UnboundedEnv(NanEnv):
    action_space = spaces.Box(-np.inf, np.inf, (1,))


class HugeRewardEnv(NanEnv):
    observation_space = spaces.Box(-1.0, 1.0, (2,))

    def __init__(self, reward=1e39):
        self.reward = reward

    def step(self, action):
        return np.zeros(2, dtype=np.float32), self.reward, False, False, {}


class FixedEnv(NanEnv):
    action_space = spaces.Box(1.0, 1.0, (1,))


class DoubleRewards(DummyVecEnv):
    """Does not round rewards, as processes do not."""

    def __init__(self, env_fns):
        super().__init__(env_fns)
        self.buf_rews = self.buf_rews.astype(np.float64)


def diverge():
    make(HugeRewardEnv(1e30)).learn(32)


def load_nan():
    model = make()
    model.set_parameters({"policy": {**model.policy.state_dict(), "return_std": th.tensor(np.nan)}}, exact_match=False)


def load_a_state_of_another_size():
    other = CausalGDP("MlpPolicy", "Pendulum-v1", **{**KWARGS, "policy_kwargs": {"net_arch": [8]}}).learn(32)
    make().set_parameters({"critic.optimizer": other.critic.optimizer.state_dict()}, exact_match=False)


def make(env="Pendulum-v1", policy="MlpPolicy", **kwargs):
    return CausalGDP(policy, env, **{**KWARGS, **kwargs})


def preload_twice_scaled():
    make(VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")])), offline_dataset="data.npz", reward_transform="antmaze")


def preload_with_hindsight():
    env = BitFlippingEnv(continuous=True)
    kwargs = {"replay_buffer_class": HerReplayBuffer, "offline_dataset": "data.npz", "reward_transform": "antmaze"}
    make(env, "MultiInputPolicy", **kwargs)


def react_to_images():
    env = FakeImageEnv(screen_height=36, screen_width=36, n_channels=1, discrete=False, channel_first=True)
    model = CausalGDP("CnnPolicy", env, **{**KWARGS, "policy_kwargs": {"features_extractor_kwargs": {"features_dim": 4}}})
    model.learn(32)
    observations = np.stack([env.observation_space.sample() for _ in range(2)])
    model.counterfactual((observations, np.zeros((1, *env.action_space.shape)), [0.0]), {"action[0]": 0.0}, follow_policy=True)


def normalise_a_raw_policy():
    model = make()
    model.learn(20)
    model.set_env(VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")])))


def write_a_foreign_graph():
    make().set_causal_graph(CausalGraph.fully_connected(TransitionVariables(("x",), ("u",))))


ERRORS = {
    "The algorithm only supports": lambda: make("CartPole-v1"),
    "Continuous action space must have a finite lower and upper bound": lambda: make(UnboundedEnv()),
    "You must use `MultiInputPolicy` when working with dict observation space": lambda: make(BitFlippingEnv(continuous=True)),
    "unexpected keyword argument 'use_sde'": lambda: make(use_sde=True),
    "The environment returned a NaN or infinite observation at step": lambda: make(NanEnv()).learn(10),
    "The environment returned a reward that is infinite in float32 at step": lambda: make(
        DoubleRewards([HugeRewardEnv])
    ).learn(10),
    "The observation is nan at row 2, index [1]: it must be finite in float32": lambda: make().predict(
        np.where(np.arange(12).reshape(4, 3) == 7, np.nan, 0.0)
    ),
    "The training diverged: critic_loss is inf at update 1.": diverge,
    "Nothing was loaded: policy.return_std holds nan": load_nan,
    "critic.optimizer.state.2.exp_avg has the shape": load_a_state_of_another_size,
    "action_space: component 0 from 1 to 1 is fixed: leave it out, or": lambda: make(FixedEnv()),
    "gamma must be a number from 0 to 1, got 1.5": lambda: make(gamma=1.5),
    "guidance must be one of ['normalized', 'posterior', 'score'] or None, got 'plain'": lambda: make(guidance="plain"),
    "VecNormalize scales the rewards already: pass norm_reward=False to it": preload_twice_scaled,
    "The policy was trained on raw observations, and this VecNormalize would give it": normalise_a_raw_policy,
    "HerReplayBuffer computes rewards anew: reward_transform must be 'none' with it": preload_with_hindsight,
    "There is nothing to train on: call preload(source) or load_replay_buffer(path) first": lambda: make().pretrain(1),
    "The world model has not been trained": lambda: make().intervene(np.zeros(3), np.zeros(1), {}),
    "The policy cannot act in predicted states": react_to_images,
    "At most one CausalWorldModelCallback can be passed, got 2": lambda: make().learn(
        10, callback=[CausalWorldModelCallback(), CausalWorldModelCallback()]
    ),
    "The graph is about": write_a_foreign_graph,
}


@pytest.mark.parametrize("message", ERRORS)
def test_the_errors_that_are_quoted_are_those_that_are_raised(message):
    (row,) = (line for line in read("guide/sb3.md").splitlines() if message in line)
    with pytest.raises(Exception, match=re.escape(message)) as error:
        ERRORS[message]()
    assert f"`{error.type.__name__}`: " in row


def test_every_quoted_error_is_tried():
    rows = re.findall(r"^\| .* \| `\w+Error`: (.*) \|$", read("guide/sb3.md"), re.MULTILINE)
    assert len(rows) == len(ERRORS)


# Figures ----------------------------------------------------------------------------------------------------------------


def test_every_figure_is_there_and_shown_and_has_a_text():
    shown = set()
    for page in DOCS.rglob("*.md"):
        text = page.read_text(encoding="utf-8")
        for path, options in re.findall(r"^```\{figure\} (\S+)\n((?::.*\n)*)", text, re.MULTILINE):
            assert ":alt: " in options, f"{page.name}: {path} needs an :alt:"
            shown.add((page.parent / path).resolve())
    assert shown == set((DOCS / "figures").resolve().glob("*.png"))
