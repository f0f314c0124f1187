"""Our YAML file, and what its values may be."""

import argparse
import inspect
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import yaml
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.utils import LinearSchedule

from sb3_causalgdp import CausalGDP, preset
from sb3_causalgdp.causal.world_model import MaskedWorldModel
from sb3_causalgdp.offline.make import TASKS
from sb3_causalgdp.policies import CausalGDPPolicy
from sb3_causalgdp.zoo import hyperparameters
from sb3_causalgdp.zoo.hyperparameters import (
    ZOO_KEYS,
    constructor_arguments,
    hyperparameter_file,
    make_schedule,
    merged,
    read_entry,
    read_numbers,
)
from sb3_causalgdp.zoo.offline_tasks import OFFLINE_TASKS, register_offline_tasks

DOCS = Path(__file__).parents[2] / "docs"
ENTRIES = yaml.safe_load(hyperparameter_file().read_text(encoding="utf-8"))
# Not on this machine, or not with its MuJoCo
NOT_HERE = ("LunarLander", "BipedalWalker", "CarRacing", "Fetch", "FrankaKitchen", "kitchen", "Pusher-v4")
BUILT_HERE = [name for name in ENTRIES if name != "default" and not any(part in name for part in NOT_HERE)]
# One environment of each entry that several share
RUN_HERE = list({id(ENTRIES[name]): name for name in BUILT_HERE if not name.startswith("offline/")}.values())

# Learning rate, eta, hidden units and layers: the table in the paper's appendix
PAPER = {
    "sb3_causalgdp/maze2d-umaze": (3e-4, 3.0, 128, 3),
    "sb3_causalgdp/maze2d-medium": (3e-4, 5.0, 128, 3),
    "sb3_causalgdp/maze2d-large": (3e-4, 5.0, 128, 3),
    "sb3_causalgdp/maze2d-umaze-dense": (3e-4, 3.0, 128, 3),
    "sb3_causalgdp/maze2d-medium-dense": (3e-4, 5.0, 128, 3),
    "sb3_causalgdp/maze2d-large-dense": (3e-4, 5.0, 128, 3),
    "D4RL/pointmaze/umaze": (3e-4, 3.0, 128, 3),
    "D4RL/pointmaze/medium": (3e-4, 5.0, 128, 3),
    "D4RL/pointmaze/large": (3e-4, 5.0, 128, 3),
    "D4RL/pointmaze/umaze-dense": (3e-4, 3.0, 128, 3),
    "D4RL/pointmaze/medium-dense": (3e-4, 5.0, 128, 3),
    "D4RL/pointmaze/large-dense": (3e-4, 5.0, 128, 3),
    "sb3_causalgdp/halfcheetah-medium": (3e-4, 5.0, 256, 4),
    "sb3_causalgdp/halfcheetah-medium-replay": (3e-4, 5.0, 256, 4),
    "sb3_causalgdp/hopper-medium": (1e-4, 2.0, 128, 4),
    "sb3_causalgdp/hopper-medium-replay": (1e-4, 2.0, 128, 4),
    "sb3_causalgdp/walker2d-medium": (1e-4, 2.0, 256, 4),
    "sb3_causalgdp/walker2d-medium-replay": (1e-4, 2.0, 256, 4),
    "mujoco/halfcheetah/medium": (3e-4, 5.0, 256, 4),
    "mujoco/hopper/medium": (1e-4, 2.0, 128, 4),
    "mujoco/walker2d/medium": (1e-4, 2.0, 256, 4),
    "mujoco/humanoid/medium": (3e-4, 5.0, 256, 4),
    "D4RL/antmaze/umaze": (3e-4, 0.5, 128, 3),
    "D4RL/antmaze/umaze-diverse": (3e-4, 2.0, 128, 3),
    "D4RL/antmaze/medium-play": (1e-3, 2.0, 128, 3),
    "D4RL/antmaze/medium-diverse": (3e-4, 3.0, 128, 3),
    "D4RL/antmaze/large-play": (3e-4, 4.5, 128, 3),
    "D4RL/antmaze/large-diverse": (3e-4, 3.5, 128, 3),
    "D4RL/pen/human": (3e-5, 0.15, 256, 3),
    "D4RL/pen/cloned": (3e-5, 0.1, 256, 3),
    "D4RL/kitchen/complete": (3e-4, 0.005, 128, 4),
    "D4RL/kitchen/partial": (3e-4, 0.005, 128, 4),
    "D4RL/kitchen/mixed": (3e-4, 0.005, 128, 4),
}


@pytest.fixture(scope="module")
def environments():
    pytest.importorskip("mujoco")
    gym.register_envs(pytest.importorskip("gymnasium_robotics"))
    register_offline_tasks()


# The file ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", PAPER)
def test_an_offline_task_has_the_numbers_of_the_paper(task):
    (entry,) = (one for one in ENTRIES.values() if one.get("offline_dataset", "").rsplit("-v", 1)[0] == task)
    world_model = entry["policy_kwargs"]["world_model_net_arch"]
    assert (entry["learning_rate"], entry["eta"], world_model[0], len(world_model)) == PAPER[task]
    assert entry["denoising_weight"] == 1.0 and entry["pretrain_steps"] >= 250_000
    assert entry.get("reward_transform", "none") == (
        "antmaze" if "antmaze" in task else "normalize" if "pen" in task else "none"
    )


def test_offline_entries_and_tasks_are_the_same():
    offline = {name: entry["offline_dataset"] for name, entry in ENTRIES.items() if name.startswith("offline/")}
    assert offline == {name: task.dataset for name, task in OFFLINE_TASKS.items()}
    # Those of the paper, and what the command line can make beside them
    assert {dataset.rsplit("-v", 1)[0] for dataset in offline.values()} == {
        *PAPER,
        "sb3_causalgdp/pen-medium",
        "sb3_causalgdp/pen-medium-replay",
    }
    assert {f"sb3_causalgdp/{task}-v0" for task in TASKS} <= set(offline.values())


@pytest.mark.parametrize("name", ENTRIES)
def test_an_entry_has_known_keys_and_plain_numbers(name):
    entry = ENTRIES[name]
    # Numbers can be read without our help
    assert read_entry(entry) == entry and read_numbers(entry) == entry
    assert isinstance(entry["n_timesteps"], int)
    arguments = {key: value for key, value in entry.items() if key not in ZOO_KEYS}
    inspect.signature(CausalGDP).bind(env=None, **arguments)
    policy_kwargs = entry.get("policy_kwargs", {})
    assert set(policy_kwargs) <= set(inspect.signature(CausalGDPPolicy).parameters)
    if "world_model_net_arch" in policy_kwargs:
        MaskedWorldModel(3, 1, policy_kwargs["world_model_net_arch"])


def test_every_task_that_the_package_knows_has_an_entry(environments):
    # AntMaze-v3 needs mujoco_py
    families = ("PointMaze_", "AntMaze_", "AdroitHand", "sb3_causalgdp/")
    wanted = {name for name in gym.registry if name.startswith(families) and not re.match("AntMaze.*-v3", name)}
    mujoco = "(Ant|HalfCheetah|Hopper|Humanoid|HumanoidStandup|Inverted.*|Pusher|Reacher|Swimmer|Walker2d)-v[45]"
    wanted |= {name for name in gym.registry if re.fullmatch(mujoco, name)}
    assert {name for name in wanted if name not in ENTRIES} == set()
    assert {name for name in ENTRIES if name not in gym.registry} == {"default"}


def build(name, monkeypatch, tmp_path, config=None, **hyperparams):
    """The model that ``train`` makes of an entry."""
    pytest.importorskip("rl_zoo3")
    from sb3_causalgdp.zoo import register
    from sb3_causalgdp.zoo.manager import CausalGDPExperimentManager

    monkeypatch.chdir(tmp_path)
    register()
    manager = CausalGDPExperimentManager(
        argparse.Namespace(),
        "causalgdp",
        name,
        "logs",
        eval_freq=-1,
        log_interval=-1,
        verbose=0,
        device="cpu",
        hyperparams=hyperparams,
        config=config,
    )
    model, _ = manager.setup_experiment()
    return manager, model


@pytest.mark.parametrize("name", BUILT_HERE)
@pytest.mark.filterwarnings("ignore")
def test_an_entry_makes_a_model(name, environments, monkeypatch, tmp_path):
    # Large hindsight buffers take seconds to allocate
    _, model = build(name, monkeypatch, tmp_path, buffer_size=2_000)
    entry = ENTRIES[name]
    for key, value in entry.items():
        if key in constructor_arguments() and isinstance(value, int | float):
            assert getattr(model, key) == value
    assert model.world_model.action_dim == model.action_space.shape[0]
    model.env.reset()
    model.env.step(np.array([model.action_space.sample()]))
    model.env.close()


@pytest.mark.parametrize("name", RUN_HERE)
@pytest.mark.filterwarnings("ignore")
def test_an_entry_trains(name, environments, monkeypatch, tmp_path):
    tiny = {"policy_kwargs": {"net_arch": [8], "world_model_net_arch": [8]}, "batch_size": 4, "buffer_size": 1_000}
    # Hindsight needs a whole episode
    short = {"n_timesteps": 30, "learning_starts": 25, "env_kwargs": {"max_episode_steps": 20}}
    manager, model = build(name, monkeypatch, tmp_path, diffusion_steps=2, n_action_candidates=1, **tiny, **short)
    manager.learn(model)
    assert model._n_updates > 0


EVERYTHING = """
PointMaze_UMaze-v3:
  n_timesteps: 6e1
  policy: MultiInputPolicy
  learning_starts: 25
  batch_size: 4
  learning_rate: lin_1e-3
  critic_learning_rate: lin_2e-3
  world_model_learning_rate: lin_3e-3
  replay_buffer_class: HerReplayBuffer
  replay_buffer_kwargs: {n_sampled_goal: 2}
  normalize: {norm_obs: true, norm_reward: false}
  policy_kwargs: {net_arch: [8], world_model_net_arch: [8]}
  env_kwargs: {max_episode_steps: 20}
  env_wrapper:
    - gymnasium.wrappers.RescaleAction: {min_action: -0.5, max_action: 0.5}
  callback:
    - stable_baselines3.common.callbacks.StopTrainingOnMaxEpisodes: {max_episodes: 2}
"""


@pytest.mark.filterwarnings("ignore")
def test_what_an_entry_says_reaches_the_training(environments, monkeypatch, tmp_path):
    (tmp_path / "entry.yml").write_text(EVERYTHING)
    manager, model = build("PointMaze_UMaze-v3", monkeypatch, tmp_path, config="entry.yml", buffer_size=1_000)
    manager.learn(model)
    assert isinstance(model.replay_buffer, HerReplayBuffer) and model.replay_buffer.n_sampled_goal == 2
    assert model.action_space.high.tolist() == [0.5, 0.5]
    # Two episodes of 20 steps out of 60: a third of each rate is left
    assert model.num_timesteps == 40
    modules = (model.actor, model.critic, model.world_model)
    rates = [module.optimizer.param_groups[0]["lr"] for module in modules]
    assert rates == pytest.approx([1e-3 / 3, 2e-3 / 3, 3e-3 / 3], rel=0.1)
    normalizer = model.get_vec_normalize_env()
    assert normalizer.obs_rms["observation"].count > 40 and not normalizer.norm_reward


EXAMPLES = [
    example
    for page in sorted(DOCS.rglob("*.md"))
    for example in re.findall(r"^```yaml\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S)
]


def test_the_documentation_has_examples():
    assert len(EXAMPLES) >= 5


@pytest.mark.parametrize("example", EXAMPLES)
@pytest.mark.filterwarnings("ignore")
def test_an_example_of_the_documentation_makes_a_model(example, environments, monkeypatch, tmp_path):
    (tmp_path / "example.yml").write_text(example)
    (name,) = yaml.safe_load(example)
    _, model = build(name, monkeypatch, tmp_path, config="example.yml", buffer_size=1_000)
    model.env.close()


def test_the_file_of_an_installed_package_is_found(tmp_path, monkeypatch):
    site = tmp_path / "site-packages"
    metadata = site / "sb3_causalgdp-0.0.dist-info"
    metadata.mkdir(parents=True)
    installed = tmp_path / "share" / "sb3_causalgdp" / "hyperparams" / "causalgdp.yml"
    installed.parent.mkdir(parents=True)
    installed.write_text("default: {}\n")
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: sb3_causalgdp\nVersion: 0.0\n")
    (metadata / "RECORD").write_text("../share/sb3_causalgdp/hyperparams/causalgdp.yml,,\n")
    monkeypatch.setattr(hyperparameters, "__file__", str(site / "sb3_causalgdp" / "zoo" / "hyperparameters.py"))
    monkeypatch.syspath_prepend(str(site))
    assert hyperparameter_file() == installed.resolve()
    installed.unlink()
    monkeypatch.setattr(hyperparameters.sys, "prefix", str(tmp_path))
    with pytest.raises(FileNotFoundError, match=r"share/sb3_causalgdp/hyperparams.*--conf-file"):
        hyperparameter_file()


def test_the_file_goes_into_a_wheel():
    setup = Path(hyperparameters.__file__).parents[2] / "setup.cfg"
    if not setup.is_file():
        pytest.skip("not in a checkout")
    assert "share/sb3_causalgdp/hyperparams = hyperparams/causalgdp.yml" in setup.read_text(encoding="utf-8")


# Values -----------------------------------------------------------------------------------------------------------------


def test_numbers_in_scientific_notation_are_read_wherever_they_are():
    entry = yaml.safe_load(
        """
        policy: MlpPolicy
        n_timesteps: 1e6
        buffer_size: 1e5
        learning_rate: 3e-4
        eta: 1.5E-1
        causal_window: 2e4
        guidance_scale: [1e-1, .5e0, 1.]
        offline_fraction: lin_0.5
        policy_kwargs: {optimizer_kwargs: {eps: 1e-5}, net_arch: [64, 64], activation_fn: relu}
        env_kwargs: {name: 1e5x}
        """
    )
    read = read_entry(entry)
    assert read["n_timesteps"] == 1_000_000 and isinstance(read["n_timesteps"], int)
    assert read["buffer_size"] == 100_000 and isinstance(read["buffer_size"], int)
    assert read["causal_window"] == 20_000 and isinstance(read["causal_window"], int)
    assert (read["learning_rate"], read["eta"], read["guidance_scale"]) == (3e-4, 0.15, [0.1, 0.5, 1.0])
    assert read["policy_kwargs"] == {"optimizer_kwargs": {"eps": 1e-5}, "net_arch": [64, 64], "activation_fn": "relu"}
    assert (read["offline_fraction"], read["env_kwargs"]) == ("lin_0.5", {"name": "1e5x"})
    assert entry["n_timesteps"] == "1e6"


@pytest.mark.parametrize(
    "change, message",
    [
        ({"lerning_rate": 1e-3}, "unknown hyperparameter 'lerning_rate': did you mean 'learning_rate'"),
        ({"zzz": 1}, "unknown hyperparameter 'zzz': see the arguments of CausalGDP"),
        ({"seed": 1}, "'seed' cannot be in the YAML file: it is the command line's --seed"),
        ({"batch_size": 2.5}, "batch_size must be an integer, got 2.5"),
        ({"n_timesteps": "1.5e0"}, "n_timesteps must be an integer, got 1.5"),
    ],
)
def test_a_bad_entry_says_what_is_wrong(change, message):
    with pytest.raises(ValueError, match=message):
        read_entry({"n_timesteps": 1_000, "policy": "MlpPolicy", **change})


def test_an_incomplete_entry_says_what_is_missing():
    with pytest.raises(ValueError, match="lacks n_timesteps and policy"):
        read_entry({"eta": 1.0})
    with pytest.raises(ValueError, match="must be a mapping of hyperparameters, got 'MlpPolicy'"):
        read_entry("MlpPolicy")


def test_a_schedule_goes_down_to_zero():
    schedule = make_schedule("learning_rate", "lin_2e-3")
    assert isinstance(schedule, LinearSchedule)
    assert [schedule(progress) for progress in (1.0, 0.5, 0.0)] == pytest.approx([2e-3, 1e-3, 0.0])
    assert make_schedule("learning_rate", 1) == 1.0
    assert make_schedule("critic_learning_rate", None) is None
    for wrong in ("cos_1", "lin_", "fast", [1]):
        with pytest.raises(ValueError, match="offline_fraction must be a number, or 'lin_'"):
            make_schedule("offline_fraction", wrong)


def test_sampled_keyword_arguments_stand_beside_those_of_the_entry():
    entry = {"eta": 1.0, "policy_kwargs": {"net_arch": [8], "activation_fn": "relu"}, "gamma": 0.9}
    sampled = {"eta": 2.0, "policy_kwargs": {"net_arch": [16]}, "replay_buffer_kwargs": {"n_sampled_goal": 2}}
    assert merged(entry, sampled) == {
        "eta": 2.0,
        "gamma": 0.9,
        "policy_kwargs": {"net_arch": [16], "activation_fn": "relu"},
        "replay_buffer_kwargs": {"n_sampled_goal": 2},
    }
    assert entry["policy_kwargs"]["net_arch"] == [8]


# Presets ----------------------------------------------------------------------------------------------------------------


def test_a_preset_in_an_entry_is_its_arguments_of_which_those_of_the_entry_win():
    entry = {"n_timesteps": 1_000, "policy": "MlpPolicy", "eta": 3.0, "policy_kwargs": {"n_critics": 5}}
    read = read_entry({**entry, "preset": "edp"})
    assert read == {**entry, **preset("edp", eta=3.0, policy_kwargs={"n_critics": 5})}
    assert read["policy_kwargs"] == {"n_critics": 5, "sampling_steps": 15} and read["guidance"] is None
    offline = read_entry({**entry, "preset": {"name": "edp", "offline": True, "guided": True}})
    assert offline["learning_rate"] == 3e-4 and "guidance" not in offline


@pytest.mark.parametrize(
    "change, message",
    [
        ({"preset": "edb"}, "did you mean 'edp'"),
        ({"preset": {"offline": True}}, "preset must be a name, or a mapping of name, offline and guided"),
        ({"preset": {"name": "edp", "online": True}}, "preset must be a name, or a mapping of name, offline and guided"),
        ({"preset": "edp", "policy_kwargs": "dict(n_critics=5)"}, "policy_kwargs must be a mapping beside a preset"),
    ],
)
def test_a_preset_that_cannot_be_read_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        read_entry({"n_timesteps": 1_000, "policy": "MlpPolicy", **change})
