import os
import pickle
import subprocess
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from PIL import Image
from recordings import BOX, GOALS, NestedEnv, fill, make_rows, record, rows_of
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer, RolloutBuffer
from stable_baselines3.common.save_util import save_to_pkl

import sb3_causalgdp
from sb3_causalgdp.causal import CausalGraph, TransitionVariables
from sb3_causalgdp.causal.__main__ import feed, main, parse_kwargs
from sb3_causalgdp.causal.discovery import make_discovery, make_statistics
from sb3_causalgdp.causal.sources import (
    ArraySource,
    MinariSource,
)

# On datasets without an author and so on
pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:minari")


@pytest.fixture
def arrays(tmp_path):
    path = tmp_path / "arrays.npz"
    np.savez(path, **make_rows(600))
    return path


def error_of(capsys, *argv):
    with pytest.raises(SystemExit) as stopped:
        main([str(argument) for argument in argv])
    assert stopped.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    usage, error = printed.err.splitlines()
    assert usage.startswith("usage: ")
    return error


# Replay buffers ---------------------------------------------------------------------------------------------------------


def test_the_whole_way_from_a_trained_model(tmp_path, capsys):
    model = SAC("MlpPolicy", "Pendulum-v1", buffer_size=1_000, learning_starts=1_000, seed=0, device="cpu")
    model.learn(600)
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    main([str(tmp_path / "buffer.pkl"), "--plot", f"{tmp_path}/new/graph.png", "--json", f"{tmp_path}/new/graph.json"])
    printed = capsys.readouterr().out
    assert "buffer.pkl: 600 transitions\nstate variables: 3, action variables: 1\n" in printed
    graph = CausalGraph.load(tmp_path / "new" / "graph.json")
    assert (graph.method, graph.n_samples, graph.variables.action_names) == ("partial_r2", 600, ("action[0]",))
    assert graph.action_to_state[2, 0] > 0.9
    assert "action[0] -> obs[2]'" in printed
    assert sorted(os.listdir(tmp_path / "new")) == ["graph.json", "graph.png"]
    assert (tmp_path / "new" / "graph.png").read_bytes().startswith(b"\x89PNG")


# Spaces -----------------------------------------------------------------------------------------------------------------


# Minari -----------------------------------------------------------------------------------------------------------------


def test_the_whole_way_from_a_minari_dataset(minari, capsys):
    dataset, rows = record(minari, "pendulum/random-v0", gym.make("Pendulum-v1", max_episode_steps=50), 4)
    main(["pendulum/random-v0", "--method", "notears", "--max-rows", "150"])
    printed = capsys.readouterr().out
    assert "pendulum/random-v0: 150 of 200 transitions" in printed
    assert "notears: " in printed
    np.testing.assert_array_equal(rows_of(MinariSource(dataset)), rows)
    chosen = np.linspace(0, 199, 80).astype(int)
    np.testing.assert_array_equal(rows_of(MinariSource(dataset, max_rows=80)), rows[chosen])


def test_minari_dataset_that_is_not_there(minari, capsys):
    assert "dataset 'no/such-v0' is not on this machine: ask for its download (" in error_of(capsys, "no/such-v0")
    assert "datasets make --help` lists datasets" in error_of(capsys, "no/such-v0")


def test_minari_is_not_installed(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "minari", None)
    assert 'pip install "minari[hdf5]" gymnasium-robotics' in error_of(capsys, "D4RL/door/human-v2")


# The command ------------------------------------------------------------------------------------------------------------


def test_summary(arrays, capsys):
    main([str(arrays)])
    printed = capsys.readouterr()
    assert printed.err == ""
    for part in (
        f"{arrays}: 600 transitions\n",
        "partial_r2: 4 edges with a probability above 0.5 of 9, 4 expected\n",
        "   obs[0] -> obs[0]'\n",
        "   obs[1] -> obs[1]'\n",
        "action[0] -> obs[0]'\n",
        "  obs[0]' -> reward\n",
        "R^2: obs[0]' 0.99",
        "variance inflation",
        "s discovery)",
    ):
        assert part in printed.out
    assert "constant" not in printed.out


def test_summary_of_variables_that_cannot_be_told_apart(tmp_path, capsys):
    rows = make_rows(600)
    for key in ("observations", "next_observations"):
        states = rows[key]
        rows[key] = np.column_stack([states, 2.0 * states[:, 0], np.ones(600), np.random.default_rng(1).normal(size=(600, 6))])
    rows["actions"] = rows["observations"][:, :1] + 1e-3 * rows["actions"]
    np.savez(tmp_path / "rows.npz", **rows)
    main([str(tmp_path / "rows.npz")])
    printed = capsys.readouterr()
    assert "obs[0] = obs[2]" in printed.out
    assert "constant, without edges: obs[3], obs[3]'" in printed.out
    assert "(the lowest 8 of 11)" in printed.out
    assert printed.err.startswith("warning: The states and the other actions almost determine these actions")
    assert printed.err.count("\n") == 1


def test_quiet_and_without_tqdm(arrays, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "tqdm", None)
    main([str(arrays), "--quiet", "--json", str(tmp_path / "graph.json")])
    assert capsys.readouterr() == ("", "")
    assert CausalGraph.load(tmp_path / "graph.json").n_samples == 600


def test_python_m(arrays):
    env = {**os.environ, "PYTHONPATH": str(Path(sb3_causalgdp.__file__).parents[1])}
    command = [sys.executable, "-m", "sb3_causalgdp.causal", str(arrays), "--method-kwargs", "threshold=0.05"]
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "partial_r2: 4 edges with a probability above 0.5 of 9" in done.stdout


@pytest.mark.parametrize("options", [["--window", "400"], ["--half-life", "50"], []])
def test_window_and_half_life_forget(tmp_path, options):
    old, new = make_rows(600), make_rows(800, seed=1)
    new["next_observations"][:, 0] *= -1.0  # the effects turn round
    np.savez(tmp_path / "rows.npz", **{key: np.concatenate([old[key], new[key]]) for key in old})
    main([str(tmp_path / "rows.npz"), "--quiet", "--method", "notears", "--json", str(tmp_path / "graph.json"), *options])
    effect = CausalGraph.load(tmp_path / "graph.json").effect_state_to_state[0, 0]
    assert effect < -0.5 if options else abs(effect) < 0.3


def test_rows_are_read_again_when_their_scale_has_moved(tmp_path):
    rows = make_rows(900)
    rows["observations"][:300] *= 0.01
    rows["next_observations"][:300] *= 0.01
    source = ArraySource(**rows)
    method = make_discovery("partial_r2")
    statistics = make_statistics(method, source.variables)
    feed(statistics, source, batch_rows=100)
    assert not statistics.wants_history
    assert method(statistics, source.variables).n_samples == 900


def test_kwargs():
    items = ["threshold=0.1", "basis=linear", "max_memory=1e8", "on_degenerate=raise", '{"spread": 1, "basis": "auto"}']
    expected = {"threshold": 0.1, "basis": "auto", "max_memory": 1e8, "on_degenerate": "raise", "spread": 1}
    assert parse_kwargs(items) == expected
    assert parse_kwargs(["standardize=False"]) == {"standardize": False}


# Mistakes ---------------------------------------------------------------------------------------------------------------


def test_mistakes_in_the_arguments(arrays, capsys):
    for options, message in (
        (
            ["--method", "magic"],
            "unknown discovery method 'magic', known are ['direct_lingam', 'fully_connected', 'notears', 'partial_r2'",
        ),
        (["--method-kwargs", "sparsity=1"], "unknown arguments ['sparsity'] for discovery method 'partial_r2'"),
        (["--method-kwargs", "threshold=2"], "threshold must be in (0, 1), got 2"),
        (["--method-kwargs", "threshold=low"], "--method-kwargs: "),
        (["--method-kwargs", "max_memory=much"], "--method-kwargs: "),
        (["--method-kwargs", "threshold"], "--method-kwargs must be key=value or a JSON object, got 'threshold'"),
        (["--method-kwargs", "{threshold}"], "'{threshold}' is no JSON object"),
        (["--method-kwargs", '{"threshold": ' + "[" * 100_000], "is no JSON object"),
        (["--method-kwargs", "threshold=" + "[" * 100_000], "--method-kwargs: "),
        (["--window", "0"], "--window: must be an integer of at least 1, got '0'"),
        (["--window", "3"], "window must be None or at least 8 rows"),
        (["--max-rows", "many"], "--max-rows: must be an integer"),
        (["--max-rows", "5"], "partial_r2 needs at least 10 rows"),
        (["--plot", "graph.txt"], "path must end in one of"),
        (["--json", str(arrays.parent)], "directory"),
    ):
        assert message in error_of(capsys, arrays, *(["--quiet", *options]))


def test_mistakes_in_the_source(tmp_path, capsys):
    (tmp_path / "broken.pkl").write_bytes(b"no pickle")
    (tmp_path / "broken.npz").write_bytes(b"no zip")
    (tmp_path / "table.csv").write_text("1,2,3")
    (tmp_path / "list.pkl").write_bytes(pickle.dumps([1, 2, 3]))
    save_to_pkl(tmp_path / "rollout.pkl", RolloutBuffer(4, BOX, BOX))
    save_to_pkl(tmp_path / "empty.pkl", ReplayBuffer(4, BOX, BOX))
    np.savez(tmp_path / "half.npz", observations=np.zeros((3, 2)), actions=np.zeros((3, 1)))
    for name, message in (
        ("missing.pkl", "no file"),
        ("missing", "no file"),
        ("broken.pkl", "broken.pkl cannot be read as a replay buffer: UnpicklingError"),
        ("broken.npz", "broken.npz cannot be read as arrays"),
        ("table.csv", "table.csv is a table and needs --state, --action, --reward: its columns are 1, 2, 3"),
        ("none.csv", "there is no file"),
        ("list.pkl", "list.pkl holds no replay buffer but a list"),
        ("rollout.pkl", "rollout.pkl holds no replay buffer but a RolloutBuffer"),
        ("empty.pkl", "empty.pkl holds no transitions"),
        ("half.npz", "half.npz lack ['rewards', 'next_observations', 'terminations', 'truncations']: ["),
    ):
        assert message in error_of(capsys, tmp_path / name)


def write_table(path, n_rows=300):
    rng = np.random.default_rng(0)
    level, valve = np.zeros(n_rows), rng.uniform(-1, 1, n_rows)
    for t in range(1, n_rows):
        level[t] = 0.8 * level[t - 1] + valve[t - 1] + 0.1 * rng.normal()
    content = np.column_stack([np.arange(n_rows) // 100, np.arange(n_rows), level, valve, -(level**2)])
    np.savetxt(path, content, "%.6f", ",", header="run,second,level,valve,cost", comments="")


TABLE = ("--state", "level", "--action", "valve", "--reward", "cost")


def test_a_table_is_read_by_the_names_of_its_columns(tmp_path, capsys):
    write_table(tmp_path / "tank.csv")
    main([str(tmp_path / "tank.csv"), *TABLE, "--episode", "run", "--time", "second", "--json", str(tmp_path / "graph.json")])
    printed = capsys.readouterr()
    assert printed.err == "" and "tank.csv: 297 transitions" in printed.out
    assert "  valve -> level'\n" in printed.out
    graph = CausalGraph.load(tmp_path / "graph.json")
    assert graph.variables == TransitionVariables(("level",), ("valve",)) and graph.n_samples == 297
    main([str(tmp_path / "tank.csv"), *TABLE, "--lag", "2", "--max-rows", "100"])
    assert "100 of 298 transitions" in capsys.readouterr().out


def test_what_is_missing_in_a_table_is_said(tmp_path, capsys):
    write_table(tmp_path / "tank.csv")
    text = (tmp_path / "tank.csv").read_text().splitlines()
    (tmp_path / "tank.csv").write_text("\n".join([*text[:5], "0,4,,0.5,1", *text[6:]]))
    error = error_of(capsys, tmp_path / "tank.csv", *TABLE)
    assert "missing or infinite values, by column: 'level' 1" in error and "--drop-missing) leaves out 2 of 299" in error
    main([str(tmp_path / "tank.csv"), *TABLE, "--drop-missing"])
    assert "remark: 2 of 299 transitions left out for missing values, by column: 'level' 1" in capsys.readouterr().out


def test_names_without_commas_are_explained(tmp_path, capsys):
    write_table(tmp_path / "tank.csv")
    error = error_of(capsys, tmp_path / "tank.csv", "--state", "level", "second", "--action", "valve", "--reward", "cost")
    assert "unrecognized arguments: second; several names are separated by commas, like --state level,temperature" in error
    assert "commas" not in error_of(capsys, tmp_path / "tank.csv", *TABLE, "--no-such-option")


def test_the_picture_takes_the_options_of_a_view(arrays, tmp_path, capsys):
    command = [str(arrays), "--quiet", "--plot", str(tmp_path / "graph.png"), "--plot-kwargs"]
    main([*command, "kind=heat_map", "values=masks", "size=[5, 4]"])
    with Image.open(tmp_path / "graph.png") as image:
        assert image.size == (600, 480)
    for option, message in (("colour=red", "unknown options ['colour'] of a picture"), ("kind=pie", "kind must be one of")):
        assert message in error_of(capsys, *command, option)
    assert "--plot-kwargs need --plot FILE" in error_of(capsys, arrays, "--plot-kwargs", "causes=2")


def test_a_buffer_s_variables_get_names(tmp_path, capsys):
    rng = np.random.default_rng(0)
    arrays = {name: rng.normal(size=(400, 2)) for name in ("observations", "next_observations")}
    np.savez(tmp_path / "rows.npz", **arrays, actions=rng.normal(size=(400, 1)), rewards=rng.normal(size=400))
    options = ("--state-names", "level, heat", "--action-names=valve", "--json", str(tmp_path / "g.json"))
    main([str(tmp_path / "rows.npz"), "--quiet", *options])
    assert CausalGraph.load(tmp_path / "g.json").variables.names[:3] == ("level", "heat", "valve")
    said = error_of(capsys, tmp_path / "rows.npz", "--state-names", "level")
    assert said.endswith("--state-names must be 2 names for obs[0], obs[1], got 'level'")
    said = error_of(capsys, tmp_path / "rows.npz", "--state", "a", "--action", "b", "--reward", "c", "--state-names", "level")
    assert "the names of a table are those of its columns" in said


def test_minari_datasets_that_are_damaged(minari, capsys):
    h5py = pytest.importorskip("h5py")
    for number, field in enumerate(("observations/arm/angle", "observations/goal", "rewards", "actions")):
        name = f"tests/nested-v{number}"
        dataset, _ = record(minari, name, NestedEnv(), 2)
        with h5py.File(Path(dataset.storage.data_path) / "main_data.hdf5", "r+") as file:
            del file["episode_1"][field]
        said = error_of(capsys, name, "--quiet")
        assert name in said and ("incomplete or damaged" in said or "episode 1 is incomplete" in said)
        assert error_of(capsys, name, "--quiet", "--max-rows", "5").count("\n") == 0


def test_buffers_that_are_damaged(tmp_path, capsys):
    def half(buffer):
        buffer.rewards = buffer.rewards[:2]

    def without_key(buffer):
        del buffer.observations["desired_goal"]

    def without_space(buffer):
        buffer.observation_space = None

    def with_nonsense_beside(buffer):
        buffer.offline_part = 3

    def without_positions(buffer):
        buffer.pos = "7"

    for damage in (half, without_key, without_space, with_nonsense_beside, without_positions):
        buffer = DictReplayBuffer(20, GOALS, spaces.Box(-1, 1, (1,)))
        fill(buffer, 12)
        damage(buffer)
        save_to_pkl(tmp_path / "buffer.pkl", buffer)
        said = error_of(capsys, tmp_path / "buffer.pkl", "--quiet")
        assert "damaged" in said or "cannot be flattened" in said


def test_arrays_that_are_damaged(tmp_path, capsys):
    np.savez_compressed(tmp_path / "rows.npz", **make_rows(600))
    whole = (tmp_path / "rows.npz").read_bytes()
    for position in range(100, len(whole), len(whole) // 40):
        (tmp_path / "rows.npz").write_bytes(whole[:position] + bytes([whole[position] ^ 0xFF]) + whole[position + 1 :])
        try:
            main([str(tmp_path / "rows.npz"), "--quiet"])
        except SystemExit as stopped:
            assert stopped.code == 2
    capsys.readouterr()


def test_rows_that_are_not_finite(tmp_path, capsys):
    rows = make_rows(6_000)
    rows["next_observations"][5_000, 1] = np.nan
    np.savez(tmp_path / "rows.npz", **rows)
    assert error_of(capsys, tmp_path / "rows.npz").endswith("transition 5000 is NaN or infinite in obs[1]'")
