import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector.utils import concatenate, create_empty_array
from recordings import BOX, GOALS, NestedEnv, fill, make_rows, record, rows_of
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.save_util import save_to_pkl
from stable_baselines3.her import HerReplayBuffer

from sb3_causalgdp.causal.sources import ArraySource, FlatSpace, MinariSource, ReplayBufferSource, SourceError, open_source

# On datasets without an author and so on
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("n_steps", [13, 20, 33])
@pytest.mark.parametrize(
    "kind, space, kwargs",
    [
        (ReplayBuffer, BOX, {}),
        (ReplayBuffer, BOX, {"optimize_memory_usage": True, "handle_timeout_termination": False}),
        (NStepReplayBuffer, BOX, {"n_steps": 3}),
        (DictReplayBuffer, GOALS, {}),
        (HerReplayBuffer, GOALS, {"env": None}),
    ],
)
def test_rows_of_a_saved_buffer(tmp_path, kind, space, kwargs, n_steps, n_envs):
    buffer = kind(20 * n_envs, space, spaces.Box(-1, 1, (1,)), device="cpu", n_envs=n_envs, **kwargs)
    rows, ends = fill(buffer, n_steps)
    rows, ends = rows[-20:], ends[-20:]
    if buffer.optimize_memory_usage:
        overwritten = int(n_steps >= 20)
        rows = [row for row, end in list(zip(rows, ends, strict=True))[overwritten:] if not end]
    save_to_pkl(tmp_path / "buffer.pkl", buffer)
    source = open_source(tmp_path / "buffer")
    expected = np.concatenate(rows)
    assert source.n_rows == len(expected)
    np.testing.assert_allclose(rows_of(source), expected, rtol=1e-6)


def test_names_are_those_of_the_model():
    buffer = DictReplayBuffer(20, spaces.Dict({"action": BOX, "pose": BOX}), spaces.Box(-1, 1, (1,)))
    assert ReplayBufferSource(buffer).variables.state_names == ("obs[action][0]", "obs[action][1]", "pose[0]", "pose[1]")


@pytest.mark.parametrize(
    "space, names",
    [
        (spaces.Box(-1, 1, (2, 2)), ["obs[0]", "obs[1]", "obs[2]", "obs[3]"]),
        (spaces.Discrete(3, start=1), ["obs[0]", "obs[1]", "obs[2]"]),
        (spaces.MultiDiscrete([2, 3]), [f"obs[{i}]" for i in range(5)]),
        (
            spaces.Dict({"b": spaces.Dict({"d": BOX, "c": spaces.Discrete(2)}), "a": spaces.MultiBinary(1)}),
            ["a", "b.c[0]", "b.c[1]", "b.d[0]", "b.d[1]"],
        ),
        (spaces.Tuple([spaces.Dict({"a": BOX}), spaces.Box(0, 1, ())]), ["obs[0.a][0]", "obs[0.a][1]", "obs[1][0]"]),
    ],
)
def test_observations_are_flattened_as_gymnasium_does(space, names):
    space.seed(0)
    samples = [space.sample() for _ in range(6)]
    flat = FlatSpace(space)
    assert flat.names == tuple(names)
    batch = concatenate(space, samples, create_empty_array(space, len(samples)))
    np.testing.assert_array_equal(flat(batch), [spaces.flatten(space, sample) for sample in samples])


def test_rows_of_a_minari_dataset(minari):
    _, expected = record(minari, "tests/nested-v0", NestedEnv(), 4)
    source = open_source("tests/nested-v0")
    assert source.variables.state_names == ("arm.angle[0]", "arm.angle[1]", "goal")
    assert source.n_rows == len(expected) == 30
    np.testing.assert_array_equal(rows_of(source), expected)


def test_a_minari_dataset_with_fewer_rows_than_it_announces(minari):
    dataset, _ = record(minari, "tests/nested-v0", NestedEnv(), 2)
    dataset = dataset.filter_episodes(lambda episode: episode.id == 0)
    source = MinariSource(dataset)
    source.n_stored = source.n_rows = 20
    with pytest.raises(SourceError, match="it announces 20 transitions and holds 9"):
        rows_of(source)


@pytest.mark.parametrize(
    "observation_space, action_space, message",
    [
        (BOX, spaces.Discrete(3), r"action space Discrete\(3\), but continuous actions \(a Box\) are needed"),
        (spaces.Box(0, 255, (32, 32, 3), np.uint8), BOX, r"'obs' are images of shape \(32, 32, 3\)"),
        (spaces.Dict({"v": BOX, "camera": spaces.Box(0, 255, (32, 32, 1), np.uint8)}), BOX, r"'camera' are images"),
    ],
)
def test_spaces_that_discovery_cannot_use(observation_space, action_space, message):
    kind = DictReplayBuffer if isinstance(observation_space, spaces.Dict) else ReplayBuffer
    with pytest.raises(SourceError, match=message):
        ReplayBufferSource(kind(4, observation_space, action_space))


@pytest.mark.parametrize(
    "change, message",
    [
        ({"actions": np.zeros((600, 1), dtype=int)}, "actions of int64, but continuous actions are needed"),
        ({"observations": np.zeros((600, 8, 8), dtype=np.uint8)}, r"'obs' are images of shape \(8, 8\)"),
        ({"rewards": np.zeros(599)}, "must have one row for each transition"),
    ],
)
def test_arrays_that_discovery_cannot_use(change, message):
    with pytest.raises(SourceError, match=message):
        ArraySource(**{**make_rows(600), **change})
