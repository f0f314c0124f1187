"""Files from strangers: nothing that they bring is run, and nothing out of proportion is made."""

import base64
import io
import json
import os
import pickle
import re
import zipfile
from pathlib import Path

import cloudpickle
import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from torch import nn

from sb3_causalgdp import CausalGDP, MlpPolicy
from sb3_causalgdp.causal import DISCOVERY_METHODS, CausalGraph, TransitionVariables, make_discovery, make_statistics
from sb3_causalgdp.causal.sources import open_source
from sb3_causalgdp.causal.statistics.grouped import GroupedStatistics
from sb3_causalgdp.saving.models import KNOWN, plain_entries
from sb3_causalgdp.saving.plain import decoded

TINY = {
    "policy_kwargs": {"net_arch": [8], "world_model_net_arch": [8], "activation_fn": nn.ReLU},
    "batch_size": 8,
    "buffer_size": 500,
    "diffusion_steps": 2,
    "device": "cpu",
    "seed": 0,
}
OLD = Path(__file__).parents[1] / "data" / "pickled_model.zip"


@pytest.fixture(scope="module")
def model():
    return CausalGDP("MlpPolicy", "Pendulum-v1", **TINY, causal_refresh_freq=210, learning_starts=200).learn(230)


@pytest.fixture(scope="module")
def saved(model, tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "model.zip"
    model.save(path, include=["causal_graph_history"])
    return path


def changed(saved, path, **entries):
    """The zip file with other contents, by name, or by what is done to its JSON."""
    with zipfile.ZipFile(saved) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    for name, new in entries.items():
        name = name.replace("__", ".")
        contents[name] = json.dumps(new(json.loads(contents[name]))) if callable(new) else new
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return path


def pickled(value):
    return {":type:": "x", ":serialized:": base64.b64encode(cloudpickle.dumps(value)).decode()}


# Model zips -------------------------------------------------------------------------------------------------------------


def test_what_the_package_writes_comes_back_without_a_pickle(model, saved, monkeypatch):
    monkeypatch.setattr(cloudpickle, "loads", lambda *args: pytest.fail("unpickled"))
    monkeypatch.setattr(pickle, "load", lambda *args: pytest.fail("unpickled"))
    loaded = CausalGDP.load(saved, device="cpu")
    for name in ("observation_space", "action_space", "policy_kwargs", "policy_class", "train_freq", "replay_buffer_class"):
        assert getattr(loaded, name) == getattr(model, name), name
    assert loaded.causal_graph().to_json() == model.causal_graph().to_json()
    assert [graph.num_timesteps for graph in loaded.causal_graph_history] == [210]
    totals = (loaded.causal_statistics.raw.total(), model.causal_statistics.raw.total())
    np.testing.assert_array_equal(*(total.comoment for total in totals))
    assert loaded.action_space.sample() == CausalGDP.load(saved, device="cpu").action_space.sample()


@pytest.mark.parametrize("method", [*DISCOVERY_METHODS, "grouped"])
@pytest.mark.parametrize("window", [None, 40])
def test_no_statistics_need_a_pickle(method, window):
    variables = TransitionVariables(tuple(f"s{i}" for i in range(3)), ("a",))
    discovery = make_discovery("partial_r2" if method == "grouped" else method)
    statistics = make_statistics(discovery, variables, None, window)
    if method == "grouped":
        statistics = GroupedStatistics(TransitionVariables(tuple(f"s{i}" for i in range(60)), ("a",)), None, window, 1e6)
    rows = np.random.default_rng(0).normal(size=(230, statistics.variables.n_variables if method == "grouped" else 8))
    statistics.update(rows)
    names, entries = plain_entries({"causal_statistics": statistics}, KNOWN)
    assert names == {"causal_statistics"}
    back = decoded(json.loads(entries["plain.json"]), entries["plain.bin"], KNOWN)["causal_statistics"]
    for one in (statistics, back):
        one.update(rows[:50])
    assert plain_entries({"causal_statistics": back}, KNOWN)[1] == plain_entries({"causal_statistics": statistics}, KNOWN)[1]


def test_sb3_reads_the_zip_and_loads_the_model(model, saved):
    data, params, _ = load_from_zip_file(saved)
    assert data["eta"] == model.eta and "policy" in params
    loaded = OffPolicyAlgorithm.load.__func__(CausalGDP, saved, device="cpu")
    observation = np.zeros((1, 3), np.float32)
    np.testing.assert_array_equal(
        loaded.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True)[0]
    )


@pytest.mark.parametrize("name", ["lr_schedule", "eta", "something", "causal_statistics", "observation_space", "env"])
def test_a_pickle_in_a_zip_is_not_run(hostile, saved, tmp_path, name):
    def put(data):
        return {**data, name: pickled(hostile)}

    def without(content):
        content["attributes"].pop(name, None)
        return content

    path = changed(saved, tmp_path / "strange.zip", data=put, plain__json=without)
    with pytest.raises(ValueError, match=rf"strange.zip cannot be loaded: {name} is pickled, .*trusted=True, or"):
        CausalGDP.load(path, device="cpu")
    with pytest.raises(ValueError, match=f"{name} is pickled"):
        CausalGDP.load(path, device="cpu", custom_objects={"tau": 0.1})
    if name == "eta":
        assert CausalGDP.load(path, device="cpu", custom_objects={"eta": 3.0}).eta == 3.0
        assert CausalGDP.load(path, device="cpu", eta=4.0).eta == 4.0


def test_a_pickle_beside_the_plain_value_is_not_touched(hostile, saved, tmp_path):
    path = changed(saved, tmp_path / "strange.zip", data=lambda data: {**data, "action_space": pickled(hostile)})
    assert CausalGDP.load(path, device="cpu").action_space.shape == (1,)
    # Not even where it is trusted
    assert CausalGDP.load(path, device="cpu", trusted=True).action_space.shape == (1,)


def test_pickled_tensors_are_not_run(hostile, saved, tmp_path):
    stream = io.BytesIO()
    th.save({"log": hostile}, stream)
    path = changed(saved, tmp_path / "strange.zip", policy__pth=stream.getvalue())
    with pytest.raises(ValueError, match=r"strange.zip"):
        CausalGDP.load(path, device="cpu")
    own = CausalGDP("MlpPolicy", "Pendulum-v1", **TINY)
    with pytest.raises(ValueError, match=r"strange.zip"):
        own.set_parameters(path)
    changed(saved, path, policy__pth=pickle.dumps(hostile))
    for read in (lambda: CausalGDP.load(path, device="cpu"), lambda: own.set_parameters(path)):
        with pytest.raises(ValueError, match=r"policy.pth is no file of tensors"):
            read()


def test_schedules_of_your_own_need_trust(tmp_path):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **TINY, learning_rate=lambda progress: 1e-3 * progress)
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=r"model.zip cannot be loaded: learning_rate, lr_schedule are pickled"):
        CausalGDP.load(tmp_path / "model.zip", device="cpu")
    assert CausalGDP.load(tmp_path / "model.zip", device="cpu", trusted=True).lr_schedule(0.5) == 5e-4
    given = {"learning_rate": 1e-4, "lr_schedule": None}
    assert CausalGDP.load(tmp_path / "model.zip", device="cpu", custom_objects=given).lr_schedule(0.5) == 1e-4


def test_a_zip_of_an_older_version_needs_trust():
    with pytest.raises(ValueError, match=r"policy_class, .* are pickled"):
        CausalGDP.load(OLD, device="cpu")
    model = CausalGDP.load(OLD, device="cpu", trusted=True)
    assert model.num_timesteps == 230 and model.causal_graph().num_timesteps == 210
    assert np.isfinite(model.predict(np.zeros((1, 3), np.float32))[0]).all()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("diffusion_steps", 1_000_000, "diffusion_steps is 1e.06, the limit is 1,000"),
        ("gradient_steps", 10**9, "gradient_steps is 1e.09"),
        ("n_envs", 10**9, "n_envs is 1e.09"),
        ("buffer_size", 10**12, "buffer_size is 1e.12"),
        ("pretrain_steps", 10**9, "pretrain_steps is 1e.09"),
        ("env", "some_module:Env-v0", "env is no attribute"),
        ("predict", 1, "predict is no attribute"),
        ("causal_discovery", "os.system", "causal_discovery must be one of"),
    ],
)
def test_a_zip_that_asks_for_too_much_is_refused(saved, tmp_path, name, value, message):
    path = changed(saved, tmp_path / "strange.zip", data=lambda data: {**data, name: value})
    with pytest.raises(ValueError, match=f"strange.zip cannot be loaded: .*{message}") as error:
        CausalGDP.load(path, device="cpu")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("units", [[10**9], [60_000, 60_000]])
def test_networks_larger_than_the_file_are_refused(saved, tmp_path, units):
    def wide(content):
        content["attributes"]["policy_kwargs"] = {"dict": [["net_arch", units]]}
        return content

    with pytest.raises(ValueError, match=r"policy_kwargs.*net_arch"):
        CausalGDP.load(changed(saved, tmp_path / "strange.zip", plain__json=wide), device="cpu")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"class": "os.system"}, "none of the classes"),
        ({"object": "builtins.eval", "state": {}}, "none of the classes"),
        ({"array": ["|O", [1], "C", 0]}, "an array of"),
        ({"array": ["<f8", [10**15], "C", 0]}, "too few bytes"),
        ({"scalar": {"array": ["<f8", [], "C", -1]}}, "an array of shape"),
        ({"object": "gymnasium.spaces.box.Box", "state": {}}, "action_space cannot be read"),
        ({"unknown": 1}, "unknown kind"),
        (float("nan"), "NaN"),
    ],
)
def test_values_of_other_kinds_are_refused(saved, tmp_path, value, message):
    def put(content):
        content["attributes"]["action_space"] = value
        return content

    with pytest.raises(ValueError, match=message):
        CausalGDP.load(changed(saved, tmp_path / "strange.zip", plain__json=put), device="cpu")


def test_zip_bombs_are_refused_before_they_are_unpacked(saved, tmp_path, monkeypatch):
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("policy.pth", "w") as file:
        for _ in range(300):
            file.write(bytes(1 << 20))
    monkeypatch.setattr(zipfile.ZipExtFile, "read", lambda *args: pytest.fail("unpacked"))
    for read in (
        lambda: CausalGDP.load(path),
        lambda: MlpPolicy.load(path),
        lambda: CausalGDP("MlpPolicy", "Pendulum-v1", **TINY).set_parameters(path),
        lambda: CausalGDP.resume(path),
        lambda: open_source(path.rename(path.with_suffix(".npz"))),
    ):
        with pytest.raises(ValueError, match=r"bomb.* times as many|bomb.*compressed"):
            read()


def test_damage_that_a_checksum_shows_is_refused(saved, tmp_path):
    data = bytearray(saved.read_bytes())
    data[len(data) // 2] ^= 4
    (tmp_path / "damaged.zip").write_bytes(data)
    with pytest.raises(ValueError, match=r"damaged.zip cannot be loaded"):
        CausalGDP.load(tmp_path / "damaged.zip", device="cpu")
    with pytest.raises(ValueError, match=r"damaged.zip cannot be loaded"):
        CausalGDP("MlpPolicy", "Pendulum-v1", **TINY).set_parameters(tmp_path / "damaged.zip")


def test_parameters_that_do_not_fit_are_refused_by_the_name_of_their_file(model, saved, tmp_path):
    wider = CausalGDP("MlpPolicy", "Pendulum-v1", **{**TINY, "policy_kwargs": {"net_arch": [16]}})
    without = tmp_path / "without.zip"
    with zipfile.ZipFile(saved) as archive, zipfile.ZipFile(without, "w") as other:
        for name in archive.namelist():
            if name != "actor.optimizer.pth":
                other.writestr(name, archive.read(name))
    for one, path in ((wider, saved), (model, without)):
        with pytest.raises(ValueError, match=f"{path.name} cannot be loaded: ") as error:
            one.set_parameters(path)
        assert "\n" not in str(error.value)


# Policies, graphs, checkpoints ------------------------------------------------------------------------------------------


def test_a_policy_is_read_without_a_pickle(model, tmp_path, hostile):
    model.policy.save(tmp_path / "policy.pt")
    policy = MlpPolicy.load(tmp_path / "policy.pt", device="cpu")
    observation = np.zeros((1, 3), np.float32)
    np.testing.assert_array_equal(
        policy.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True)[0]
    )
    assert policy.activation_fn is nn.ReLU
    for content in ({"state_dict": {}, "data": {"net_arch": hostile}}, hostile):
        th.save(content, tmp_path / "strange.pt")
        with pytest.raises(ValueError, match=r"strange.pt cannot be loaded: .*trusted=True"):
            MlpPolicy.load(tmp_path / "strange.pt")


def test_a_graph_names_its_file(tmp_path):
    for text in ("{", "[" * 100_000, "[]", '{"masks": 1}'):
        (tmp_path / "graph.json").write_text(text)
        with pytest.raises(ValueError, match=r"graph.json cannot be read as a causal graph") as error:
            CausalGraph.load(tmp_path / "graph.json")
        assert "\n" not in str(error.value)


def strange_checkpoint(model, folder, change=lambda manifest: manifest, **contents):
    """A checkpoint with other contents, whose checksums are right."""
    from sb3_causalgdp.checkpoints.store import _checksum, _digest

    model.save_checkpoint(folder / "there.zip")
    contents = {name.replace("__", "."): content for name, content in contents.items()}

    def honest(manifest):
        manifest["files"] |= {name: _digest(io.BytesIO(content)) for name, content in contents.items()}
        manifest = change(manifest)
        return {**manifest, "checksum": _checksum(manifest)}

    return changed(folder / "there.zip", folder / "strange.zip", manifest__json=honest, **contents)


@pytest.mark.parametrize("part", ["model.zip", "state.bin"])
def test_a_checkpoint_is_not_run(model, saved, tmp_path, hostile, part):
    strange = changed(saved, tmp_path / "m.zip", data=lambda data: {**data, "something": pickled(hostile)}).read_bytes()
    content = {"model.zip": strange, "state.bin": pickle.dumps({"generators": hostile})}[part]
    path = strange_checkpoint(model, tmp_path, **{part: content})
    with pytest.raises(ValueError, match=r"strange.zip.*trusted=True"):
        CausalGDP.resume(path, gym.make("Pendulum-v1"))


def segment(**values):
    def change(manifest):
        manifest["buffers"]["online"]["segments"][0].update(values)
        return manifest

    return change


def named(name):
    return lambda manifest: {**manifest, "files": {**manifest["files"], name: "0" * 64}}


@pytest.mark.parametrize(
    "change, message",
    [
        (named("/dev/zero"), "'/dev/zero' is no file of a checkpoint"),
        (named("../../secret"), "'../../secret' is no file of a checkpoint"),
        (segment(name="../model.zip"), "is not about 230 rows"),
        (segment(end=10**12), "is not about 230 rows"),
        (segment(first=-5), "is not about 230 rows"),
        (segment(first="many"), "TypeError"),
        (lambda manifest: {**manifest, "buffers": {"online": {}}}, "KeyError: 'segments'"),
        (lambda manifest: {name: value for name, value in manifest.items() if name != "run"}, "KeyError: 'run'"),
    ],
)
def test_a_checkpoint_cannot_point_elsewhere(model, tmp_path, change, message):
    path = strange_checkpoint(model, tmp_path, change)
    with pytest.raises(ValueError, match=rf"strange.zip.*{message}") as error:
        CausalGDP.resume(path, gym.make("Pendulum-v1"))
    assert "\n" not in str(error.value)


def test_a_folder_of_checkpoints_with_a_device_in_it_is_refused(model, tmp_path):
    folder = model.save_checkpoint(tmp_path / "there")
    (folder / "state.bin").unlink()
    (folder / "state.bin").symlink_to("/dev/zero")
    with pytest.raises(ValueError, match=r"state\.bin is no file"):
        CausalGDP.resume(folder, gym.make("Pendulum-v1"))


def state_with(model, folder, **changes):
    """Of a checkpoint, with other values, by the path of their keys."""
    from sb3_causalgdp.checkpoints.checkpoint import STATE
    from sb3_causalgdp.checkpoints.pickles import from_bytes, to_bytes
    from sb3_causalgdp.checkpoints.store import open_checkpoint

    model.save_checkpoint(folder / "there.zip")
    with open_checkpoint(folder / "there.zip") as checkpoint, checkpoint.read(STATE) as file:
        state = from_bytes(file.read(), trusted=True)
    for keys, value in changes.items():
        *parents, last = keys.split("__")
        part = state
        for key in parents:
            part = part[key]
        part[last] = value
    return to_bytes(state)


@pytest.mark.parametrize(
    "keys, value, message",
    [
        ("rest__online__buffer_size", 10**12, "buffer_size is 1e.12, the limit is 20,000,000"),
        ("rest__online__pos", 10**6, "its position is 1000000"),
        ("rest__online__full", "yes", "full must be of bool, got str"),
        ("rest", {}, "KeyError: 'online'"),
        ("generators", 3, "TypeError"),
    ],
)
def test_a_checkpoint_whose_state_does_not_fit_is_refused(model, tmp_path, keys, value, message):
    path = strange_checkpoint(model, tmp_path, state__bin=state_with(model, tmp_path, **{keys: value}))
    with pytest.raises(ValueError, match=rf"strange.zip cannot be resumed: .*{message}"):
        CausalGDP.resume(path, gym.make("Pendulum-v1"))


def test_a_checkpoint_sets_no_other_attributes_of_a_model(model, tmp_path):
    path = strange_checkpoint(model, tmp_path, state__bin=state_with(model, tmp_path, attributes__gamma=0.5))
    assert CausalGDP.resume(path, gym.make("Pendulum-v1")).gamma == model.gamma


# Transitions ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".npz", ".pkl", ""])
def test_buffers_come_back(model, tmp_path, suffix):
    path = tmp_path / f"buffer{suffix}"
    model.save_replay_buffer(path)
    assert os.listdir(tmp_path) == [f"buffer{suffix or '.npz'}"]
    loaded = CausalGDP("MlpPolicy", "Pendulum-v1", **TINY)
    loaded.load_replay_buffer(path)
    buffer, other = model.replay_buffer, loaded.replay_buffer
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(getattr(buffer, name), getattr(other, name))
    assert (buffer.pos, buffer.full, buffer.buffer_size) == (other.pos, other.full, other.buffer_size)
    assert open_source(path).n_rows == 230
    with pytest.warns(UserWarning, match="was saved after 230 steps, the model after 0"):
        CausalGDP("MlpPolicy", "Pendulum-v1", **TINY).load_replay_buffer(path)
    assert make_preloaded(path).offline_buffer.size() == 230


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_the_preloaded_part_comes_back(model, tmp_path, suffix):
    model.save_replay_buffer(tmp_path / "first.npz")
    both = make_preloaded(tmp_path / "first.npz").learn(40)
    both.save_replay_buffer(tmp_path / f"both{suffix}")
    assert open_source(tmp_path / f"both{suffix}").n_rows == 230 + 40
    assert make_preloaded(tmp_path / f"both{suffix}").offline_buffer.size() == 230 + 40
    other = CausalGDP("MlpPolicy", "Pendulum-v1", **TINY)
    other.load_replay_buffer(tmp_path / f"both{suffix}")
    assert (other.offline_buffer.size(), other.replay_buffer.size()) == (230, 40)
    assert other._offline_marks == both._offline_marks


def make_preloaded(path):
    return CausalGDP("MlpPolicy", "Pendulum-v1", **TINY).preload(path)


@pytest.mark.parametrize("kwargs", [{"optimize_memory_usage": True}, {"n_steps": 3}, {}], ids=str)
@pytest.mark.parametrize("n_rows", [40, 90])
def test_all_kinds_of_buffers_come_back_as_arrays(tmp_path, kwargs, n_rows):
    if "optimize_memory_usage" in kwargs:
        kwargs["replay_buffer_kwargs"] = {"handle_timeout_termination": False}
    arguments = {**TINY, "buffer_size": 60, "learning_starts": 1_000, **kwargs}
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **arguments).learn(n_rows)
    stream = io.BytesIO()
    model.save_replay_buffer(stream)
    stream.seek(0)
    other = CausalGDP("MlpPolicy", "Pendulum-v1", **arguments)
    other.load_replay_buffer(stream)
    assert type(other.replay_buffer) is type(model.replay_buffer)
    np.random.seed(0)
    sample = model.replay_buffer.sample(30)
    np.random.seed(0)
    assert all(th.equal(one, two) for one, two in zip(sample, other.replay_buffer.sample(30), strict=True) if one is not None)


def test_hindsight_replay_comes_back_as_arrays(tmp_path):
    from goal_env import GoalEnv

    arguments = {**TINY, "replay_buffer_class": HerReplayBuffer, "learning_starts": 1_000}
    model = CausalGDP("MultiInputPolicy", GoalEnv(), **arguments).learn(60)
    model.save_replay_buffer(tmp_path / "buffer.npz")
    other = CausalGDP("MultiInputPolicy", GoalEnv(), **arguments)
    other.load_replay_buffer(tmp_path / "buffer.npz", truncate_last_traj=False)
    for key in ("observation", "achieved_goal", "desired_goal"):
        np.testing.assert_array_equal(other.replay_buffer.observations[key], model.replay_buffer.observations[key])
    np.testing.assert_array_equal(other.replay_buffer.ep_length, model.replay_buffer.ep_length)
    assert other.replay_buffer.goal_selection_strategy == model.replay_buffer.goal_selection_strategy
    other.learn(30, reset_num_timesteps=False)


class OwnBuffer(ReplayBuffer):
    """A user's."""


def test_a_buffer_of_your_own_is_pickled_and_needs_trust(tmp_path):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **TINY, replay_buffer_class=OwnBuffer)
    with pytest.warns(UserWarning, match="OwnBuffer is pickled"):
        model.save_replay_buffer(tmp_path / "buffer")
    with pytest.raises(ValueError, match=r"buffer.pkl cannot be read as a replay buffer: it holds .*OwnBuffer.*trusted=True"):
        model.load_replay_buffer(tmp_path / "buffer")
    model.load_replay_buffer(tmp_path / "buffer", trusted=True)
    assert type(model.replay_buffer) is OwnBuffer
    with pytest.raises(ValueError, match=r"suffix .pkl"):
        model.save_replay_buffer(tmp_path / "buffer.npz")


@pytest.mark.parametrize("name", ["buffer.pkl", "buffer.npz", "buffer.bin"])
def test_a_pickle_in_place_of_transitions_is_not_run(model, tmp_path, hostile, name):
    path = tmp_path / name
    path.write_bytes(pickle.dumps(hostile))
    before = model.replay_buffer
    reads = [lambda: model.load_replay_buffer(path), lambda: make_preloaded(path), lambda: open_source(path)]
    for read in reads:
        with pytest.raises(ValueError, match=re.escape(name)) as error:
            read()
        assert "\n" not in str(error.value)
    assert model.replay_buffer is before
    # The path of a dataset in somebody's zip is read in the same way
    with pytest.raises(ValueError, match=re.escape(name)):
        CausalGDP("MlpPolicy", "Pendulum-v1", **TINY, offline_dataset=str(path)).pretrain(1)


def test_the_command_line_runs_nothing(tmp_path, hostile, capsys):
    from sb3_causalgdp.causal.__main__ import main

    (tmp_path / "buffer.pkl").write_bytes(pickle.dumps(hostile))
    with pytest.raises(SystemExit):
        main([str(tmp_path / "buffer.pkl")])
    assert "which could run code" in capsys.readouterr().err


def test_arrays_of_python_objects_are_not_run(tmp_path, hostile):
    arrays = {name: np.zeros(3) for name in ("observations", "actions", "next_observations", "terminations", "truncations")}
    np.savez(tmp_path / "arrays.npz", **arrays, rewards=np.array([hostile] * 3, dtype=object))
    for read in (make_preloaded, open_source):
        with pytest.raises(ValueError, match=r"arrays.npz cannot be read as arrays: .*Python objects"):
            read(tmp_path / "arrays.npz")


def test_an_array_that_declares_more_than_there_is_gets_no_memory(tmp_path):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"shape": (10**12,), "fortran_order": False, "descr": "<f8"})
    with zipfile.ZipFile(tmp_path / "arrays.npz", "w") as archive:
        archive.writestr("rewards.npy", stream.getvalue())
    with pytest.raises(ValueError, match="'rewards' of shape"):
        open_source(tmp_path / "arrays.npz")


def test_the_environment_of_a_dataset_is_not_made(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    from sb3_causalgdp.offline.storage import Episode, write_dataset

    steps = Episode(np.zeros((4, 3), np.float32), np.zeros((3, 1), np.float32), np.zeros(3))
    write_dataset("strange/data-v0", [steps], "Pendulum-v1", tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    path = tmp_path / "strange" / "data-v0" / "data" / "metadata.json"
    metadata = json.loads(path.read_text())
    mark = tmp_path / "mark"
    spec = {**json.loads(metadata["env_spec"]), "entry_point": "os:system", "kwargs": {"command": f"touch {mark}"}}
    spec |= {"order_enforce": False, "disable_env_checker": True, "max_episode_steps": None}
    metadata["env_spec"] = json.dumps(spec)
    del metadata["action_space"]
    path.write_text(json.dumps(metadata))
    for read in (make_preloaded, open_source):
        with pytest.raises(ValueError, match=r"strange/data-v0.*lack a space"):
            read("strange/data-v0")
    assert not mark.exists()
    # It is not the test that is harmless
    with pytest.raises(Exception, match=""):
        minari.load_dataset("strange/data-v0")
    assert mark.exists()


# Files of another kind --------------------------------------------------------------------------------------------------


def test_a_file_of_another_kind_is_told_apart(model, saved, tmp_path):
    model.policy.save(tmp_path / "policy.zip")
    with pytest.raises(ValueError, match=r"loaded by MlpPolicy.load"):
        CausalGDP.load(tmp_path / "policy.zip")
    with pytest.raises(ValueError, match=r"it is a whole model, which CausalGDP.load loads"):
        MlpPolicy.load(saved)
    with pytest.raises(ValueError, match=r"is a model, which is saved without its buffer: save one with model.save_replay"):
        model.load_replay_buffer(saved)
    with pytest.raises(ValueError, match=r"is no checkpoint: it has no manifest.json; a saved model is loaded by load\(\)"):
        CausalGDP.resume(saved, "Pendulum-v1")
    SAC("MlpPolicy", "Pendulum-v1", buffer_size=10).save(tmp_path / "sac")
    with pytest.raises(ValueError, match=r"it is a model of another algorithm, whose policy is of stable_baselines3.sac"):
        CausalGDP.load(tmp_path / "sac")


def test_a_misspelt_argument_of_load_is_refused(saved):
    with pytest.raises(TypeError, match=r"unexpected keyword argument 'guidance_scal', did you mean 'guidance_scale'\?"):
        CausalGDP.load(saved, guidance_scal=0.5)
    with pytest.raises(TypeError, match="load\\(\\) got 'use_ema', an argument of the policy"):
        CausalGDP.load(saved, use_ema=False)
    assert CausalGDP.load(saved, num_timesteps=3, guidance_scale=0.5, causal_graph_history=[]).num_timesteps == 3


def test_a_policy_without_newer_arguments_acts_as_it_did(model, tmp_path):
    model.policy.save(tmp_path / "policy.zip")
    saved = th.load(tmp_path / "policy.zip", weights_only=True)
    content = json.loads(saved["plain.json"])
    for name in ("use_ema", "exploration_optimism"):
        content["attributes"].pop(name, None)
        saved["data"].pop(name, None)
    th.save({**saved, "plain.json": json.dumps(content)}, tmp_path / "older.zip")
    policy = MlpPolicy.load(tmp_path / "older.zip")
    assert policy.use_ema is False and policy.exploration_optimism == -1.0


def test_a_model_without_newer_arguments_acts_as_it_did(saved, tmp_path):
    older = changed(
        saved, tmp_path / "older.zip", data=lambda data: {k: v for k, v in data.items() if k != "exploration_optimism"}
    )
    policy = CausalGDP.load(older).policy
    assert policy.use_ema is False and policy.exploration_optimism == -1.0
    assert CausalGDP.load(saved).policy.use_ema is True
