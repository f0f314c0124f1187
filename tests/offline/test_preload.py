import builtins
import json
import shutil
import warnings
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from goal_env import GOALS, GoalEnv
from gymnasium import spaces
from small_models import small
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.save_util import save_to_pkl
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")
from minari.data_collector import EpisodeBuffer  # noqa: E402
from minari.storage import remotes  # noqa: E402
from minari.storage.remotes.cloud_storage import CloudStorage  # noqa: E402

KWARGS = small(learning_starts=5, train_freq=1, causal_refresh_freq=1_000)
PENDULUM = gym.make("Pendulum-v1")
OBSERVATIONS, ACTIONS = PENDULUM.observation_space, PENDULUM.action_space
LENGTHS = (5, 3, 7)


def episode(length, seed, terminates, observation_space=OBSERVATIONS, action_space=ACTIONS):
    observation_space.seed(seed)
    action_space.seed(seed)
    observations = [observation_space.sample() for _ in range(length + 1)]
    if isinstance(observation_space, spaces.Dict):
        observations = {key: np.stack([one[key] for one in observations]) for key in observation_space}
    ends = np.arange(length) == length - 1
    return {
        "observations": observations if isinstance(observations, dict) else np.stack(observations),
        "actions": np.stack([action_space.sample() for _ in range(length)]),
        "rewards": np.random.default_rng(seed).normal(size=length),
        "terminations": ends & terminates,
        "truncations": ends & (not terminates),
    }


@pytest.fixture
def make_dataset(tmp_path, monkeypatch):
    """Writes episodes as a Minari dataset and gives its id."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))

    def make(episodes, observation_space=OBSERVATIONS, action_space=ACTIONS, name="test/pendulum-v0", env="Pendulum-v1"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            minari.create_dataset_from_buffers(
                name,
                [EpisodeBuffer(id=number, **one) for number, one in enumerate(episodes)],
                env=env,
                observation_space=observation_space,
                action_space=action_space,
            )
        return name

    return make


@pytest.fixture
def episodes():
    return [episode(length, seed, terminates=seed == 1) for seed, length in enumerate(LENGTHS)]


@pytest.fixture
def dataset(make_dataset, episodes):
    return make_dataset(episodes)


def make(env="Pendulum-v1", policy="MlpPolicy", **kwargs):
    return CausalGDP(policy, env, **{**KWARGS, **kwargs})


def arrays_of(episodes):
    return {
        "observations": np.concatenate([one["observations"][:-1] for one in episodes]),
        "next_observations": np.concatenate([one["observations"][1:] for one in episodes]),
        **{
            key: np.concatenate([one[key] for one in episodes])
            for key in ("actions", "rewards", "terminations", "truncations")
        },
    }


def assert_holds(buffer, expected, scale=2.0):
    """The buffer's columns, one after the other, are the transitions."""
    n_rows = len(expected["rewards"])
    for name in ("observations", "next_observations", "rewards"):
        values = getattr(buffer, name)[: buffer.size()].swapaxes(0, 1)
        flat = values.reshape(-1, *values.shape[2:])
        np.testing.assert_allclose(flat[:n_rows], expected[name], rtol=1e-6)
    actions = buffer.actions[: buffer.size()].swapaxes(0, 1).reshape(-1, buffer.action_dim)
    np.testing.assert_allclose(actions[:n_rows], expected["actions"] / scale, rtol=1e-5)


def test_everything_arrives_in_the_replay_buffer(dataset, episodes):
    model = make()
    assert model.preload(dataset) is model
    buffer, expected = model.replay_buffer, arrays_of(episodes)
    assert buffer.size() == sum(LENGTHS) and buffer is model.offline_buffer
    assert_holds(buffer, expected)
    np.testing.assert_array_equal(buffer.dones[:15, 0], expected["terminations"] | expected["truncations"])
    np.testing.assert_array_equal(buffer.timeouts[:15, 0], expected["truncations"])


def test_it_equals_what_sb3_would_have_added(dataset, episodes):
    plain = ReplayBuffer(100, OBSERVATIONS, ACTIONS, device="cpu")
    for one in episodes:
        for step in range(len(one["rewards"])):
            now, after = one["observations"][step : step + 2]
            done, cut = one["terminations"][step] or one["truncations"][step], one["truncations"][step]
            action = one["actions"][step] / 2.0
            plain.add(now, after, action, one["rewards"][step], np.array([done]), [{"TimeLimit.truncated": bool(cut)}])
    buffer = make().preload(dataset).replay_buffer
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        np.testing.assert_allclose(getattr(buffer, name)[:15], getattr(plain, name)[:15], rtol=1e-6)
    assert (buffer.pos, buffer.full) == (plain.pos, plain.full)


def sources(dataset, episodes, tmp_path):
    arrays = arrays_of(episodes)
    np.savez(tmp_path / "arrays.npz", **arrays)
    first = make().preload(dataset)
    for name in ("buffer", "buffer.pkl"):
        first.save_replay_buffer(tmp_path / name)
    saved = [str(tmp_path / name) for name in ("buffer", "buffer.npz", "buffer.pkl")]
    return [minari.load_dataset(dataset), arrays, tmp_path / "arrays.npz", first.replay_buffer, *saved]


@pytest.mark.parametrize("kind", range(7), ids=["MinariDataset", "dict", "npz", "ReplayBuffer", "plain", "suffix", "pkl"])
def test_all_sources_give_the_same(kind, dataset, episodes, tmp_path):
    buffer = make().preload(sources(dataset, episodes, tmp_path)[kind]).replay_buffer
    assert_holds(buffer, arrays_of(episodes))
    np.testing.assert_array_equal(buffer.timeouts[:15, 0], arrays_of(episodes)["truncations"])


def test_a_buffer_that_sac_saved_is_accepted(tmp_path):
    sac = SAC("MlpPolicy", make_vec_env("Pendulum-v1", n_envs=2), learning_starts=1000, buffer_size=40, device="cpu")
    sac.learn(60)
    sac.save_replay_buffer(tmp_path / "sac.pkl")
    buffer = make().preload(tmp_path / "sac.pkl").replay_buffer
    order = (sac.replay_buffer.pos + np.arange(20)) % 20
    expected = np.concatenate([sac.replay_buffer.observations[order, column] for column in range(2)])
    np.testing.assert_array_equal(buffer.observations[:40, 0], expected)
    # What followed is the other environment's
    assert buffer.timeouts[[19, 39], 0].all()


@pytest.mark.parametrize("n_envs", [2, 4])
def test_trajectories_stay_in_one_column(n_envs, dataset, episodes):
    model = make(make_vec_env("Pendulum-v1", n_envs=n_envs)).preload(dataset)
    buffer, expected = model.replay_buffer, arrays_of(episodes)
    n_positions = -(-15 // n_envs)
    assert buffer.size() == n_positions
    assert_holds(buffer, expected)
    # A trajectory that goes on in the next column was cut, and is bootstrapped
    assert buffer.dones[n_positions - 1].all()
    for row, ends in enumerate(expected["terminations"]):
        column, position = divmod(row, n_positions)
        assert buffer.dones[position, column] * (1 - buffer.timeouts[position, column]) == ends


def test_float64_dictionaries_keep_their_type_and_keys(make_dataset):
    given = [episode(6, 0, False, GOALS, GoalEnv.action_space)]
    name = make_dataset(given, GOALS, GoalEnv.action_space, env=None)
    buffer = make(GoalEnv(), "MultiInputPolicy").preload(name).replay_buffer
    for key in GOALS:
        assert buffer.observations[key].dtype == np.float64
        np.testing.assert_array_equal(buffer.observations[key][:6, 0], given[0]["observations"][key][:-1])
        np.testing.assert_array_equal(buffer.next_observations[key][:6, 0], given[0]["observations"][key][1:])


def test_flattening_follows_the_environments_wrappers(make_dataset):
    class Filtered(gym.ObservationWrapper):
        def __init__(self, env):
            super().__init__(env)
            self.observation_space = spaces.Dict([(key, GOALS[key]) for key in ("observation", "desired_goal")])

        def observation(self, observation):
            return {key: observation[key] for key in self.observation_space}

    given = [episode(6, 0, False, GOALS, GoalEnv.action_space)]
    name = make_dataset(given, GOALS, GoalEnv.action_space, env=None)
    env = gym.wrappers.FlattenObservation(Filtered(GoalEnv()))
    buffer = make(env).preload(name).replay_buffer
    values = given[0]["observations"]
    expected = np.concatenate([values["observation"], values["desired_goal"]], axis=1)
    np.testing.assert_array_equal(buffer.observations[:6, 0], expected[:-1])


def test_vec_normalize_gets_the_statistics(dataset, episodes):
    env = VecNormalize(make_vec_env("Pendulum-v1"))
    make(env).preload(dataset)
    expected = arrays_of(episodes)
    np.testing.assert_allclose(env.obs_rms.mean, expected["observations"].mean(axis=0), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(env.obs_rms.var, expected["observations"].var(axis=0), rtol=1e-3)
    sums = []
    for one in episodes:
        running = 0.0
        for reward in one["rewards"]:
            running = env.gamma * running + reward
            sums.append(running)
    np.testing.assert_allclose(env.ret_rms.var, np.var(sums), rtol=1e-3)


def test_a_small_buffer_is_enlarged_and_says_so_once(dataset):
    model = make(buffer_size=10)
    with pytest.warns(UserWarning, match="15 transitions, which do not fit in buffer_size=10") as said:
        model.preload(dataset)
    assert sum("buffer_size" in str(one.message) for one in said) == 1
    assert model.replay_buffer.size() == 15


def test_a_second_dataset_is_appended(dataset, episodes):
    model = make(buffer_size=20).preload(dataset).preload(arrays_of(episodes[:2]))
    both = arrays_of(episodes + episodes[:2])
    assert model.replay_buffer is model.offline_buffer and model.replay_buffer.size() == 23
    assert_holds(model.replay_buffer, both)


def test_the_memory_efficient_buffer_knows_all_but_the_last_observations(dataset, episodes):
    model = make(
        buffer_size=15, optimize_memory_usage=True, replay_buffer_kwargs={"handle_timeout_termination": False}
    ).preload(dataset)
    buffer, expected = model.replay_buffer, arrays_of(episodes)
    assert (buffer.size(), buffer.full) == (15, False)
    going_on = np.flatnonzero(~(expected["terminations"] | expected["truncations"]))
    np.testing.assert_array_equal(buffer.observations[going_on + 1, 0], expected["next_observations"][going_on])
    np.testing.assert_array_equal(buffer.observations[:15, 0], expected["observations"])


def test_hindsight_replay_finds_the_episodes(make_dataset):
    given = [episode(length, length, False, GOALS, GoalEnv.action_space) for length in (4, 6)]
    name = make_dataset(given, GOALS, GoalEnv.action_space, env=None)
    model = make(GoalEnv(), "MultiInputPolicy", replay_buffer_class=HerReplayBuffer).preload(name)
    buffer = model.replay_buffer
    np.testing.assert_array_equal(buffer.ep_length[:10, 0], [4] * 4 + [6] * 6)
    np.testing.assert_array_equal(buffer.ep_start[:10, 0], [0] * 4 + [4] * 6)
    achieved = {tuple(row) for row in buffer.next_observations["achieved_goal"][:10, 0].astype(np.float32)}
    desired = {tuple(row) for row in buffer.observations["desired_goal"][:10, 0].astype(np.float32)}
    goals = buffer.sample(64).observations["desired_goal"].numpy()
    assert {tuple(row) for row in goals.astype(np.float32)} <= achieved | desired
    model.pretrain(2)


REWARDS = {"none": (1.0, 0.0), "antmaze": (4.0, -2.0), "antmaze_iql": (1.0, -1.0)}


@pytest.mark.parametrize("name", [*REWARDS, "normalize"])
def test_reward_transforms(name, dataset, episodes):
    rewards, returns = arrays_of(episodes)["rewards"], [one["rewards"].sum() for one in episodes]
    scale, shift = REWARDS.get(name, (1000.0 / (max(returns) - min(returns)), 0.0))
    model = make(reward_transform=name).preload(dataset)
    np.testing.assert_allclose(model.replay_buffer.rewards[:15, 0], scale * rewards + shift, rtol=1e-5)
    # The environment's rewards are on the same scale
    model.learn(8)
    env = model.get_env()
    model._last_obs = env.reset()
    model._store_transition(model.replay_buffer, np.zeros((1, 1)), model._last_obs, np.array([2.0]), [False], [{}])
    assert model.replay_buffer.rewards[model.replay_buffer.pos - 1, 0] == pytest.approx(2.0 * scale + shift, rel=1e-5)


@pytest.mark.parametrize("name", ["none", "antmaze"])
def test_what_was_collected_before_gets_the_transform_too(name, tmp_path):
    model, plain = (make(reward_transform=one, learning_starts=50, tau=0.5) for one in (name, "none"))
    scale, shift = REWARDS[name]
    for one in (model, plain):
        one.learn(30, callback=CausalWorldModelCallback(min_transitions=20))
    model.save_checkpoint(tmp_path)
    statistics, rewards = model.causal_statistics, model.replay_buffer.rewards[:30].copy()
    model.preload(ARRAYS)
    np.testing.assert_allclose(model.replay_buffer.rewards[:30], scale * rewards + shift, rtol=1e-6)
    assert not model.replay_buffer.rewards[30:].any()
    # They are counted anew, in one unit
    assert (model.causal_statistics is statistics) == (name == "none")
    # Rows that a checkpoint wrote before are written again
    model.save_checkpoint(tmp_path)
    resumed = CausalGDP.resume(tmp_path, "Pendulum-v1")
    np.testing.assert_array_equal(resumed.replay_buffer.rewards, model.replay_buffer.rewards)


def raw_and_saved(folder, name, suffix):
    """Rewards of the environment, offline and online, and a buffer that was saved with what ``name`` makes of them."""
    # Random actions, which do not follow from rewards
    raw = [make(learning_starts=50, reward_transform=one).preload(ARRAYS) for one in ("none", name)]
    for model in raw:
        model.learn(20)
    path = folder / f"buffer{suffix}"
    raw[1].save_replay_buffer(path)
    offline, online = (getattr(raw[0], one).rewards for one in ("offline_buffer", "replay_buffer"))
    assert not np.allclose(raw[1].offline_buffer.rewards[:15], offline[:15])
    return np.concatenate([offline[:15, 0], online[:20, 0]]), path, raw[1]


ARRAYS = {
    "observations": np.zeros((15, 3)),
    "actions": np.zeros((15, 1)),
    "rewards": np.arange(15.0),
    "next_observations": np.zeros((15, 3)),
    "terminations": np.arange(15) % 5 == 4,
    "truncations": np.zeros(15, bool),
}


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
@pytest.mark.parametrize("name", ["antmaze", "normalize"])
def test_transformed_rewards_that_were_saved_are_not_transformed_twice(name, suffix, tmp_path):
    raw, path, model = raw_and_saved(tmp_path, name, suffix)
    np.testing.assert_allclose(make().preload(path).offline_buffer.rewards[:35, 0], raw, rtol=1e-5, atol=1e-5)
    again = make(reward_transform="antmaze").preload(path).offline_buffer.rewards[:35, 0]
    np.testing.assert_allclose(again, 4.0 * raw - 2.0, rtol=1e-5, atol=1e-4)
    # Whose it is, has it as it was
    own = make(reward_transform=name)
    own.load_replay_buffer(path)
    for one in ("offline_buffer", "replay_buffer"):
        np.testing.assert_array_equal(getattr(own, one).rewards, getattr(model, one).rewards)
    assert own._reward_transform == model._reward_transform
    # A model of the environment's rewards goes on with those
    plain = make()
    plain.load_replay_buffer(path)
    both = np.concatenate([plain.offline_buffer.rewards[:15, 0], plain.replay_buffer.rewards[:20, 0]])
    np.testing.assert_allclose(both, raw, rtol=1e-5, atol=1e-5)
    with pytest.raises(ValueError, match=f"transformed by '{name}', and the model's reward_transform is 'antmaze_iql'"):
        make(reward_transform="antmaze_iql").load_replay_buffer(path)


def test_a_buffer_of_raw_rewards_gets_the_models_transform(tmp_path):
    model = make().learn(20)
    model.save_replay_buffer(tmp_path / "buffer")
    other = make(reward_transform="antmaze").preload(ARRAYS)
    other.load_replay_buffer(tmp_path / "buffer")
    np.testing.assert_allclose(other.replay_buffer.rewards[:20], 4.0 * model.replay_buffer.rewards[:20] - 2.0, rtol=1e-6)
    assert not other.replay_buffer.rewards[20:].any()


def test_a_buffer_that_does_not_say_what_was_done_to_its_rewards_is_taken_as_it_is(tmp_path):
    model = make(reward_transform="antmaze").preload(ARRAYS).learn(20)
    save_to_pkl(tmp_path / "older.pkl", model.replay_buffer)
    other = make().preload(tmp_path / "older.pkl")
    np.testing.assert_array_equal(other.offline_buffer.rewards[:20], model.replay_buffer.rewards[:20])
    other.load_replay_buffer(tmp_path / "older.pkl")
    np.testing.assert_array_equal(other.replay_buffer.rewards, model.replay_buffer.rewards)


@pytest.mark.parametrize("value", ["antmaze", ["antmaze", 0.0, 1.0], ["antmaze", 1.0, float("nan")], ["antmaze", 1.0]])
def test_what_was_done_to_rewards_can_be_undone(value, tmp_path):
    buffer = make().learn(20).replay_buffer
    buffer.reward_transform = value
    save_to_pkl(tmp_path / "buffer.pkl", buffer)
    for read in (make().preload, make().load_replay_buffer):
        with pytest.raises(ValueError, match="reward_transform must be a name, a scale other than 0 and a shift, got"):
            read(tmp_path / "buffer.pkl")


def test_a_progress_bar(dataset, capsys):
    make().preload(dataset, progress_bar=True)
    assert "15" in capsys.readouterr().err


# Bad input: one clear error each, and nothing is loaded -------------------------------------------------------------------


def refuses(model, source, match, error=ValueError):
    with pytest.raises(error, match=match):
        model.preload(source)
    assert model.replay_buffer.size() == 0 and model.offline_buffer is None


def test_another_environments_observations(make_dataset, episodes):
    space = spaces.Box(-9.0, 9.0, (5,), np.float32)
    name = make_dataset([episode(4, 0, True, space)], space)
    refuses(make(), name, r"pendulum-v0 does not fit the model's observation space: it is Box.*\(5,\).*\(3,\).*is needed")


def test_another_environments_actions(make_dataset):
    space = spaces.Box(-1.0, 1.0, (1,), np.float32)
    name = make_dataset([episode(4, 0, True, OBSERVATIONS, space)], OBSERVATIONS, space)
    refuses(make(), name, r"action space: it is Box\(-1.0, 1.0.*Box\(-2.0, 2.0.*is needed")


def test_other_keys(make_dataset):
    space = spaces.Dict({"observation": GOALS["observation"]})
    name = make_dataset([episode(4, 0, True, space, GoalEnv.action_space)], space, GoalEnv.action_space, env=None)
    refuses(
        make(GoalEnv(), "MultiInputPolicy"), name, r"keys \['observation'\].*'achieved_goal', 'desired_goal', 'observation'"
    )


def test_arrays_of_another_width(episodes):
    refuses(make(), {**arrays_of(episodes), "actions": np.zeros((15, 2))}, "its actions have 2 components")


def test_an_environment_of_another_name_is_a_warning(make_dataset, episodes):
    name = make_dataset(episodes, env="MountainCarContinuous-v0")
    with pytest.warns(UserWarning, match="collected in MountainCarContinuous, and the model's environment is Pendulum"):
        make().preload(name)


@pytest.mark.parametrize("field", ["observations", "actions", "rewards"])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_one_nan_is_named(field, n_envs, make_dataset, episodes):
    episodes[2][field][4] = np.nan
    refuses(make(make_vec_env("Pendulum-v1", n_envs=n_envs)), make_dataset(episodes), rf"in {field}.* of episode 2, step 4")


def test_a_nan_in_the_second_dataset_leaves_the_first(dataset, episodes):
    model = make().preload(dataset)
    bad = arrays_of(episodes)
    bad["next_observations"][0, 1] = np.inf
    with pytest.raises(ValueError, match=r"next_observations\[1\] of episode 0, step 0"):
        model.preload(bad)
    assert model.offline_buffer.size() == 15
    assert_holds(model.replay_buffer, arrays_of(episodes))


def test_no_episodes(dataset, episodes):
    nothing = minari.load_dataset(dataset).filter_episodes(lambda one: False)
    refuses(make(), nothing, "is empty")
    refuses(make(), {key: values[:0] for key, values in arrays_of(episodes).items()}, "are empty|is empty")


def test_discrete_actions(make_dataset):
    space = spaces.Discrete(3)
    name = make_dataset([episode(4, 0, True, OBSERVATIONS, space)], OBSERVATIONS, space)
    refuses(make(), name, r"Discrete\(3\), but continuous actions")
    refuses(make(), {**arrays_of([episode(4, 0, True)]), "actions": np.zeros(4, dtype=np.int64)}, "continuous actions")


def test_a_file_that_is_cut_off(dataset, tmp_path):
    file = next(tmp_path.rglob("main_data.hdf5"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    refuses(make(), dataset, "incomplete or damaged.*Delete .* and download it again")


def test_a_broken_pickle(tmp_path):
    (tmp_path / "buffer.pkl").write_bytes(b"nothing")
    refuses(make(), tmp_path / "buffer.pkl", "cannot be read as a replay buffer")


class FolderStorage(CloudStorage):
    """A remote store of Minari's that is a folder on this machine."""

    def __init__(self, name, token=None):
        self.folder = Path(name)

    def list_datasets(self, prefix=None):
        files = self.folder.rglob("data/metadata.json")
        names = [file.parents[1].relative_to(self.folder).as_posix() for file in files]
        return [name for name in names if name.startswith(prefix or "")]

    def get_dataset_metadata(self, dataset_id):
        return json.loads((self.folder / dataset_id / "data" / "metadata.json").read_text())

    def download_dataset(self, dataset_id, path):
        shutil.copytree(self.folder / dataset_id, Path(path) / dataset_id)

    def list_namespaces(self):
        return [file.parent.relative_to(self.folder).as_posix() for file in self.folder.rglob("namespace_metadata.json")]

    def download_namespace_metadata(self, namespace, path):
        (Path(path) / namespace).mkdir(parents=True, exist_ok=True)
        shutil.copy(self.folder / namespace / "namespace_metadata.json", Path(path) / namespace)

    def upload_dataset(self, dataset_id):
        raise NotImplementedError

    def upload_namespace(self, namespace):
        raise NotImplementedError


def test_a_dataset_that_is_missing_is_downloaded_once(dataset, tmp_path, monkeypatch):
    expected = make().preload(dataset).offline_buffer
    monkeypatch.setitem(remotes._registry, "folder", lambda: FolderStorage)
    monkeypatch.setenv("MINARI_REMOTE", f"folder://{tmp_path}")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "here"))
    with pytest.raises(FileNotFoundError, match="is not on this machine"):
        make().preload(dataset, download=False)
    found = make().preload(dataset).offline_buffer
    monkeypatch.setattr(FolderStorage, "download_dataset", lambda *args: pytest.fail("downloaded again"))
    again = make().preload(dataset).offline_buffer
    for buffer in (found, again):
        assert buffer.size() == expected.size() > 0
        np.testing.assert_array_equal(buffer.observations, expected.observations)
        np.testing.assert_array_equal(buffer.rewards, expected.rewards)


def test_a_dataset_that_is_nowhere(tmp_path, monkeypatch):
    def fail(dataset_id):
        raise ConnectionError("no network")

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    monkeypatch.setattr("minari.storage.hosting.download_dataset", fail)
    refuses(make(), "D4RL/pointmaze/umaze-v2", "'D4RL/pointmaze/umaze-v2' is not on this machine.*no network")
    with pytest.raises(ValueError, match="datasets make maze2d-umaze` makes sb3_causalgdp") as error:
        CausalGDP.from_dataset("D4RL/pointmaze/umaze-v2")
    # Not the long chain of the hub's libraries
    assert error.value.__suppress_context__ and "\n" not in str(error.value)
    with pytest.raises(FileNotFoundError, match="is not on this machine"):
        make().preload("D4RL/pointmaze/umaze-v2", download=False)
    refuses(make(), "no_such_file.npz", "no file 'no_such_file.npz'", FileNotFoundError)


def test_minari_is_not_installed(monkeypatch):
    import_module = builtins.__import__

    def without_minari(name, *args, **kwargs):
        if name == "minari":
            raise ImportError("No module named 'minari'")
        return import_module(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without_minari)
    refuses(make(), "D4RL/pointmaze/umaze-v2", r'pip install "minari\[hdf5\]" gymnasium-robotics', ImportError)


def test_missing_arrays_and_lengths_are_named(episodes):
    arrays = arrays_of(episodes)
    refuses(make(), {key: arrays[key] for key in ("observations", "actions")}, "lack .*'rewards'.*'truncations'")
    refuses(make(), {**arrays, "rewards": np.zeros(3)}, "one row for each transition")


@pytest.mark.parametrize("key", ["terminations", "truncations"])
@pytest.mark.parametrize("value", [np.nan, -1, 2, 0.5, "False", None])
def test_ends_of_episodes_are_bool_or_0_and_1(key, value, episodes):
    arrays = arrays_of(episodes)
    values = np.array([value if row == 3 else 0 for row in range(sum(LENGTHS))])
    got = "'0'" if isinstance(value, str) else repr(value)
    row = 0 if isinstance(value, str) else 3
    refuses(make(), {**arrays, key: values}, f"{key} must be bool, or 0 and 1, got {got} at transition {row}")


@pytest.mark.parametrize("dtype", [bool, int, np.uint8, np.float32, object])
def test_ends_of_episodes_may_have_any_type_and_a_column(dtype, episodes):
    arrays = arrays_of(episodes)
    given = {key: arrays[key].astype(dtype)[:, None] for key in ("terminations", "truncations")}
    buffer, expected = (make().preload({**arrays, **part}).replay_buffer for part in (given, {}))
    np.testing.assert_array_equal(buffer.dones, expected.dones)
    np.testing.assert_array_equal(buffer.timeouts, expected.timeouts)


def test_ends_of_episodes_in_a_replay_buffer_are_0_and_1(episodes):
    recorded = make().preload(arrays_of(episodes)).replay_buffer
    recorded.dones[3, 0] = np.nan
    refuses(make(), recorded, "The replay buffer: dones of environment 0 must be bool, or 0 and 1, got nan at transition 3")


def test_rewards_are_one_number_each(episodes):
    arrays = arrays_of(episodes)
    refuses(make(), {**arrays, "rewards": np.zeros((sum(LENGTHS), 2))}, r"rewards must have the shape \(N,\) or \(N, 1\)")
    refuses(make(), {**arrays, "rewards": arrays["rewards"].astype(str)}, "rewards must be numbers, got an array of <U")
    refuses(make(), {**arrays, "observations": arrays["observations"] * 1j}, "observations must be numbers, got .* complex64")


def test_shuffled_transitions_are_refused_where_order_matters(episodes):
    shuffled = {key: values[::-1] for key, values in arrays_of(episodes).items()}
    refuses(make(n_steps=3), shuffled, "not in the order of their episodes .* NStepReplayBuffer")
    make().preload(shuffled)


def test_an_unknown_reward_transform():
    with pytest.raises(ValueError, match=r"reward_transform must be one of .*, got 'best'"):
        make(reward_transform="best")


def test_what_cannot_go_together_is_refused_at_construction():
    her = {"replay_buffer_class": HerReplayBuffer, "policy": "MultiInputPolicy", "offline_dataset": "some/data-v0"}
    with pytest.raises(ValueError, match="copy_info_dict"):
        make(GoalEnv(), replay_buffer_kwargs={"copy_info_dict": True}, **her)
    with pytest.raises(ValueError, match="HerReplayBuffer computes rewards anew"):
        make(GoalEnv(), reward_transform="antmaze", **her)
    with pytest.raises(ValueError, match="VecNormalize scales the rewards already"):
        make(VecNormalize(DummyVecEnv([lambda: PENDULUM])), reward_transform="antmaze", offline_dataset="some/data-v0")


def test_an_episode_without_an_end_was_cut(make_dataset, episodes):
    episodes[0]["truncations"][:] = False
    buffer = make().preload(make_dataset(episodes)).replay_buffer
    assert buffer.dones[4, 0] == buffer.timeouts[4, 0] == 1.0
