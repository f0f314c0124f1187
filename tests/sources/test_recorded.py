"""One reader: what discovery and training see of a file is the same."""

import subprocess
import sys

import numpy as np
import pytest
from gymnasium import spaces
from recordings import BOX, GOALS, NestedEnv, fill, make_rows, record, rows_of
from small_models import SMALL
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.save_util import save_to_pkl

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.causal.sources import RecordedRows, ReplayBufferSource, SourceError
from sb3_causalgdp.causal.sources import open_source as open_rows
from sb3_causalgdp.offline.saved_buffers import read_buffer, write_buffer
from sb3_causalgdp.offline.sources import open_source as open_for_training
from sb3_causalgdp.sources.chunks import Chunk, Source
from sb3_causalgdp.sources.recorded import ArraySource, BufferSource, MinariSource, TableSource, open_source
from sb3_causalgdp.sources.spaces import flatten_batch
from sb3_causalgdp.sources.tables import Table

# On datasets without an author and so on
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")

ACTION = spaces.Box(-1, 1, (1,))


def make_buffer(n_steps=33, n_envs=2, space=BOX, **kwargs):
    kind = DictReplayBuffer if isinstance(space, spaces.Dict) else ReplayBuffer
    buffer = kind(20 * n_envs, space, ACTION, device="cpu", n_envs=n_envs, **kwargs)
    return buffer, fill(buffer, n_steps)


def saving_memory(**kwargs):
    return make_buffer(optimize_memory_usage=True, handle_timeout_termination=False, **kwargs)[0]


def rows_of_chunks(chunks):
    """States, actions, next states and rewards, side by side."""
    parts = []
    for chunk in chunks:
        columns = (chunk.observations, chunk.actions, chunk.next_observations, chunk.rewards[:, None])
        flat = (list(one.values()) if isinstance(one, dict) else [one] for one in columns)
        parts.append(np.concatenate([part.reshape(len(chunk), -1) for one in flat for part in one], axis=1))
    return np.concatenate(parts)


def in_any_order(rows):
    return rows[np.lexsort(rows.T)]


@pytest.mark.parametrize("kind", ["npz", "pkl", "object"])
@pytest.mark.parametrize("space", [BOX, GOALS], ids=["vectors", "dictionaries"])
def test_discovery_and_training_read_the_same_transitions_of_a_buffer(kind, space, tmp_path):
    buffer, (rows, _) = make_buffer(space=space)
    source = tmp_path / f"buffer.{kind}"
    if kind == "npz":
        write_buffer(buffer, source)
    elif kind == "pkl":
        save_to_pkl(source, buffer)
    else:
        source = buffer
    by_trajectory = rows_of_chunks(open_for_training(source).chunks())
    by_step = rows_of(ReplayBufferSource(buffer) if kind == "object" else open_rows(source))
    steps = np.stack(rows[-20:])
    np.testing.assert_allclose(by_step, steps.reshape(40, -1), rtol=1e-6)
    np.testing.assert_array_equal(in_any_order(by_trajectory), in_any_order(by_step))
    np.testing.assert_allclose(by_trajectory, steps.swapaxes(0, 1).reshape(40, -1), rtol=1e-6)


def test_discovery_and_training_read_the_same_transitions_of_arrays_and_tables(tmp_path):
    arrays = {**make_rows(50), "terminations": np.zeros(50), "truncations": np.arange(50) % 10 == 9}
    np.savez(tmp_path / "arrays.npz", **arrays)
    expected = np.column_stack([arrays[key] for key in ("observations", "actions", "next_observations", "rewards")])
    for source in (tmp_path / "arrays.npz", arrays):
        np.testing.assert_array_equal(rows_of_chunks(open_for_training(source).chunks()), expected)
    np.testing.assert_array_equal(rows_of(open_rows(tmp_path / "arrays.npz")), expected)
    frame = {"level": np.arange(9.0), "valve": np.arange(9.0) / 7, "cost": np.arange(9.0) / 3}
    table = Table(frame, states=["level"], actions=["valve"], reward="cost")
    rows = RecordedRows(TableSource(table, np.float64))
    assert rows.variables.names == ("level", "valve", "level'", "reward")
    np.testing.assert_array_equal(rows_of(rows), rows_of_chunks(TableSource(table, np.float64).chunks()))
    np.testing.assert_allclose(rows_of_chunks(open_for_training(table).chunks()), rows_of(rows), rtol=1e-6)


def test_discovery_and_training_read_the_same_transitions_of_minari(minari):
    dataset, expected = record(minari, "tests/nested-v0", NestedEnv(), 4)
    chunks = list(open_for_training(dataset).chunks())
    assert [len(chunk) for chunk in chunks] == [9, 6, 9, 6]
    assert [bool(chunk.truncations[-1]) for chunk in chunks] == [True, False, True, False]
    for one, name in ((dataset, "tests/nested-v0"), ("tests/nested-v0", "tests/nested-v0")):
        source = open_source(one, download=False)
        assert (type(source), source.name, source.n_transitions) == (MinariSource, name, 30)
        states = np.concatenate([flatten_batch(source.observation_space, chunk.observations) for chunk in source.chunks()])
        np.testing.assert_array_equal(states, expected[:, :3])


def test_a_source_can_be_read_twice():
    source = BufferSource(make_buffer()[0])
    for read in (source.chunks, source.as_recorded):
        np.testing.assert_array_equal(rows_of_chunks(read()), rows_of_chunks(read()))


def test_a_source_of_one_s_own_is_read_by_both():
    class Steps(Source):
        def chunks(self):
            for step in range(3):
                observation = np.full((1, 2), step, float)
                no = np.zeros(1, bool)
                yield Chunk(observation, observation + 1, np.zeros((1, 1)), np.array([float(step)]), no, no)

    source = Steps("steps", 3)
    assert open_for_training(source) is source
    rows = RecordedRows(source)
    assert rows.variables.names[:3] == ("obs[0]", "obs[1]", "action[0]")
    np.testing.assert_array_equal(rows_of(rows)[:, -1], [0.0, 1.0, 2.0])


# What discovery can do without --------------------------------------------------------------------------------------------


def test_a_buffer_that_saves_memory_is_for_discovery_alone(tmp_path):
    source = BufferSource(saving_memory())
    n_kept = source.n_transitions
    assert 0 < n_kept < 40
    assert all(chunk.terminations is None for chunk in source.chunks())
    assert len(rows_of_chunks(source.chunks())) == len(rows_of_chunks(source.as_recorded())) == n_kept
    write_buffer(saving_memory(), tmp_path / "buffer.npz")
    assert open_rows(tmp_path / "buffer.npz").n_rows == n_kept
    for one in (saving_memory(), source, tmp_path / "buffer.npz"):
        with pytest.raises(ValueError, match="does not hold the last observations of its episodes: continue it with"):
            open_for_training(one)


def test_arrays_without_ends_of_episodes_are_for_discovery_alone(tmp_path):
    arrays = make_rows(20)
    np.savez(tmp_path / "arrays.npz", **arrays, truncations=np.zeros(20, bool))
    assert open_rows(tmp_path / "arrays.npz").n_rows == 20
    for one, missing in (
        (arrays, r"\['terminations', 'truncations'\]"),
        (tmp_path / "arrays.npz", r"\['terminations'\]"),
        (ArraySource(arrays), r"\['terminations', 'truncations'\]"),
    ):
        with pytest.raises(ValueError, match=rf"lack {missing}: .* are needed"):
            open_for_training(one)


def test_a_buffer_without_timeouts_is_for_discovery_alone():
    buffer, _ = make_buffer()
    del buffer.timeouts
    assert len(rows_of(ReplayBufferSource(buffer))) == 40
    with pytest.raises(ValueError, match=r"The replay buffer lacks \['timeouts'\]"):
        open_for_training(buffer)


def test_nothing_is_not_trained_on():
    empty = ReplayBuffer(4, BOX, ACTION)
    assert ReplayBufferSource(empty).n_rows == 0
    with pytest.raises(ValueError, match="The replay buffer is empty: it holds no transitions"):
        open_for_training(empty)
    with pytest.raises(SourceError, match="arrays holds no transitions"):
        RecordedRows(ArraySource({key: values[:0] for key, values in make_rows(3).items()}, "arrays"))


def test_discovery_sees_the_environment_s_rewards(tmp_path):
    buffer, (rows, _) = make_buffer(n_envs=1, n_steps=15)
    buffer.rewards[:] = 4.0 * buffer.rewards - 2.0
    for suffix in ("npz", "pkl"):
        buffer.reward_transform = ["antmaze", 4.0, -2.0]
        path = tmp_path / f"buffer.{suffix}"
        write_buffer(buffer, path) if suffix == "npz" else save_to_pkl(path, buffer)
        np.testing.assert_allclose(rows_of(open_rows(path)), np.concatenate(rows), rtol=1e-5, atol=1e-6)


def test_a_model_s_discovery_and_that_of_its_file_see_one_kind_of_reward(tmp_path):
    arrays = {**make_rows(30), "terminations": np.zeros(30, bool), "truncations": np.arange(30) == 29}
    arrays["observations"] = arrays["next_observations"] = np.zeros((30, 3))
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **SMALL, reward_transform="antmaze").preload(arrays)
    model.save_replay_buffer(tmp_path / "buffer")
    assert not np.allclose(model.replay_buffer.rewards[:30, 0], arrays["rewards"])
    np.testing.assert_allclose(rows_of(open_rows(tmp_path / "buffer"))[:, -1], arrays["rewards"], rtol=1e-5, atol=1e-6)


# Files that are something else --------------------------------------------------------------------------------------------


def test_a_saved_buffer_is_read_without_sb3(tmp_path):
    write_buffer(make_buffer()[0], tmp_path / "buffer.npz")
    program = (
        "import sys; from sb3_causalgdp.causal.sources import open_source\n"
        "assert sum(map(len, open_source(sys.argv[1]).batches())) == 40\n"
        "assert 'stable_baselines3' not in sys.modules and 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", program, tmp_path / "buffer.npz"], check=True)


@pytest.mark.parametrize(
    "name, value, message",
    [
        ("n_envs", 0, r"n_envs must be an integer from 1 to 100,000,000, got '0'"),
        ("buffer_size", 10**12, "buffer_size must be an integer from 1 to"),
        ("pos", 20, "pos must be an integer from 0 to 19, got '20'"),
        ("pos", True, "pos must be an integer"),
        ("full", "yes", "full must be of bool, got str"),
        ("observation_space", None, "its observation_space is no space, but of NoneType"),
        ("observation_space", spaces.Box(-1, 1, (3,)), r"observations has shape \(20, 2, 2\), of 20 rows and 2 environments"),
        ("rewards", np.zeros((20, 1)), r"rewards has shape \(20, 1\), of 20 rows and 2 environments"),
        ("rewards", np.zeros((20, 2, 2)), r"rewards has shape \(20, 2, 2\)"),
        ("rewards", np.full((20, 2), 1j), "rewards must be numbers, got an array of complex128"),
        ("dones", np.zeros((19, 2)), r"dones has shape \(19, 2\)"),
        ("next_observations", np.zeros((3, 2, 2)), r"next_observations has shape \(3, 2, 2\)"),
        ("actions", [0.0], "its arrays are of list"),
    ],
)
def test_attributes_of_a_buffer_that_do_not_fit_each_other(name, value, message, tmp_path):
    buffer, _ = make_buffer()
    setattr(buffer, name, value)
    with pytest.raises(ValueError, match=f"The replay buffer is incomplete or damaged: {message}"):
        BufferSource(buffer)
    save_to_pkl(tmp_path / "buffer.pkl", buffer)
    for read in (open_rows, open_for_training):
        with pytest.raises(ValueError, match=rf"buffer\.pkl is incomplete or damaged: {message}"):
            read(tmp_path / "buffer.pkl")


def test_files_of_something_else_are_named(tmp_path):
    save_to_pkl(tmp_path / "list.pkl", [1, 2, 3])
    (tmp_path / "notes.txt").write_text("something else")
    reads = (open_source, open_rows, open_for_training)
    for read in (*reads, read_buffer):
        with pytest.raises(ValueError, match=r"list\.pkl holds no replay buffer but a list: save one with model\."):
            read(tmp_path / "list.pkl")
        with pytest.raises(ValueError, match=r"notes\.txt cannot be read as a replay buffer: "):
            read(tmp_path / "notes.txt")
    for read in reads:
        with pytest.raises(TypeError, match=r"A source is the id of a Minari dataset, .* got int"):
            read(3)
