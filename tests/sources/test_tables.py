import sys

import numpy as np
import pandas as pd
import pytest

from sb3_causalgdp.causal import discover
from sb3_causalgdp.sources.columns import columns_of, is_frame
from sb3_causalgdp.sources.tables import Table

ROLES = {"states": ["level", "temperature"], "actions": ["valve"], "reward": "cost", "episode": "run", "time": "minute"}


def make_frame(n_episodes=6, n_steps=50, seed=0):
    """A tank: the valve fills it, its level cools it, and the cost is that of the level reached."""
    rng = np.random.default_rng(seed)
    rows = []
    for run in range(n_episodes):
        level, temperature = rng.normal(size=2)
        for minute in range(n_steps):
            valve = rng.uniform(-1, 1)
            after = 0.8 * level + 0.5 * valve + 0.1 * rng.normal()
            rows.append((run, minute, level, temperature, valve, after))
            level, temperature = after, 0.9 * temperature - 0.3 * level + 0.1 * rng.normal()
    return pd.DataFrame(rows, columns=["run", "minute", "level", "temperature", "valve", "cost"])


class Arrow:
    """What an Arrow table is to us: column_names and columns with to_numpy."""

    def __init__(self, frame):
        self.column_names = list(frame.columns)
        self.frame = frame

    def __getitem__(self, name):
        return self.frame[name]


def sources(frame, folder):
    frame.to_csv(folder / "tank.csv", index=False)
    frame.to_csv(folder / "tank.tsv", sep="\t", index=False)
    np.savez(folder / "tank.npz", **{name: frame[name].to_numpy() for name in frame})
    np.save(folder / "tank.npy", frame.to_records(index=False))
    yield from (folder / f"tank.{suffix}" for suffix in ("csv", "tsv", "npz", "npy"))
    yield from (frame, Arrow(frame), frame.to_records(index=False), {name: frame[name].to_numpy() for name in frame})


def test_every_kind_of_table_gives_the_same_transitions(tmp_path):
    frame = make_frame()
    expected = Table(frame, **ROLES)
    assert len(expected) == 6 * 49 and expected.state_names == ("level", "temperature")
    for source in sources(frame, tmp_path):
        table = Table(source, **ROLES)
        for name in ("observations", "actions", "next_observations", "rewards", "is_last"):
            np.testing.assert_allclose(getattr(table, name), getattr(expected, name), err_msg=f"{type(source)} {name}")


def test_the_next_state_is_the_state_some_rows_later_in_the_same_episode():
    frame = make_frame(2, 5)
    table = Table(frame, **ROLES, lag=2)
    states = frame[["level", "temperature"]].to_numpy()
    np.testing.assert_array_equal(table.observations, states[[0, 1, 2, 5, 6, 7]])
    np.testing.assert_array_equal(table.next_observations, states[[2, 3, 4, 7, 8, 9]])
    np.testing.assert_array_equal(table.rewards, frame["cost"].to_numpy()[[0, 1, 2, 5, 6, 7]])
    np.testing.assert_array_equal(table.is_last, [False, False, True] * 2)


def test_a_table_can_hold_its_next_states():
    frame = make_frame(2, 5)
    frame["level after"], frame["temperature after"] = frame["cost"], frame["temperature"] + 1
    table = Table(frame, **ROLES, next_states=["level after", "temperature after"])
    assert len(table) == 10
    np.testing.assert_array_equal(table.next_observations, frame[["level after", "temperature after"]])


def test_no_transition_is_made_over_a_gap_in_time():
    frame = make_frame(1, 20).drop(index=[8, 9, 10])
    table = Table(frame, **ROLES)
    assert len(table) == 7 + 8
    assert table.remarks == ("no transitions over 1 gaps in 'minute'",)
    assert np.flatnonzero(table.is_last).tolist() == [6, 14]


def test_dates_can_be_the_time():
    frame = make_frame(1, 20)
    frame["minute"] = pd.date_range("2024-01-01", periods=20, freq="min")
    assert len(Table(frame, **ROLES)) == 19
    with pytest.raises(ValueError, match="'minute' does not grow from row 0"):
        Table(frame.iloc[::-1], **ROLES)


def test_missing_values_are_counted_by_column():
    frame = make_frame(1, 20)
    frame.loc[[3, 4], "level"] = np.nan
    frame.loc[9, "cost"] = np.inf
    with pytest.raises(ValueError, match=r"by column: 'level' 2, 'cost' 1; missing=\"drop\" .*leaves out 4 of 19 transitions"):
        Table(frame, **ROLES)
    table = Table(frame, **ROLES, missing="drop")
    assert len(table) == 15 and np.isfinite(table.next_observations).all()
    assert table.remarks == ("4 of 19 transitions left out for missing values, by column: 'level' 2, 'cost' 1",)
    assert np.flatnonzero(table.is_last).tolist() == [1, 5, 14]


def test_categories_are_columns_of_0_and_1():
    frame = make_frame(1, 6)
    frame["mode"] = ["auto", "hand", "auto", "off", "auto", "hand"]
    frame["lamp"] = [True, False] * 3
    table = Table(frame, states=["level"], actions=["mode", "lamp"], reward="cost")
    assert table.action_names == ("mode=hand", "mode=off", "lamp")
    np.testing.assert_array_equal(table.actions, [[0, 0, 1], [1, 0, 0], [0, 0, 1], [0, 1, 0], [0, 0, 1]])
    assert table.remarks == ("'mode' is categorical: a column of 0 and 1 for 'hand', 'off', against 'auto'",)


@pytest.mark.parametrize("kind", ["category", "Int64", "string"])
def test_columns_of_pandas_own_kinds_can_be_missing(kind):
    frame = make_frame(1, 6)
    values = [1, 2, None, 1, 2, 1] if kind == "Int64" else ["a", "b", None, "a", "b", "a"]
    frame["level"] = pd.array(values, dtype=kind) if kind != "category" else pd.Categorical(values)
    with pytest.raises(ValueError, match=r"by column: 'level(=b)?' 1"):
        Table(frame, states=["level"], actions=["valve"], reward="cost")


def test_discovery_on_a_frame_names_its_columns_and_finds_what_made_them():
    frame = make_frame(20, 100)
    graph = discover(frame, **ROLES)
    found = {(edge.cause, edge.effect) for edge in graph.edges()}
    assert found == {
        ("level", "level'"),
        ("valve", "level'"),
        ("level", "temperature'"),
        ("temperature", "temperature'"),
        ("level'", "reward"),
    }
    frame["mode"] = np.where(frame.index % 2 == 0, "a", "b")
    graph = discover(frame, **{**ROLES, "actions": ["valve", "mode"]}, method="notears", sparsity=0.05)
    assert graph.method == "notears" and any("'mode' is categorical" in remark for remark in graph.remarks)


def test_a_matrix_has_numbers_for_names():
    assert list(columns_of(np.zeros((3, 2)))) == ["0", "1"]
    assert list(columns_of({"x": np.zeros((3, 2)), "y": np.zeros(3)})) == ["x[0]", "x[1]", "y"]
    assert is_frame(make_frame(1, 2)) and not is_frame({"x": np.zeros(3)}) and not is_frame(np.zeros(3))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"states": ["levl"]}, "states: the table has no column 'levl', did you mean 'level'"),
        ({"reward": "xyz"}, "reward: the table has no column 'xyz', it has 'run', 'minute'"),
        ({"states": []}, "states is empty"),
        ({"actions": ["level"]}, r"a column must have one role, \['level'\] have several"),
        ({"lag": 0}, "lag must be an integer of at least 1, got 0"),
        ({"lag": 50}, "holds no transition: episodes need more than 50 rows"),
        ({"missing": "fill"}, "missing must be one of .*, got 'fill'"),
        ({"next_states": ["cost"]}, "next_states must name a column for each of the 2 states, got 1"),
        ({"episode": None}, "'minute' does not grow from row 49 .* to row 50 .*, nor in 4 other places"),
        ({"episode": "minute", "time": None}, "episode 0 goes on in row 50 after another one"),
    ],
)
def test_what_does_not_fit_is_one_clear_error(changes, message):
    with pytest.raises(ValueError, match=message):
        Table(make_frame(), **{**ROLES, **changes})


def test_files_that_cannot_be_read_say_so(tmp_path, monkeypatch):
    (tmp_path / "broken.npz").write_bytes(b"PK nothing")
    with pytest.raises(ValueError, match=r"broken\.npz cannot be read as a table"):
        Table(str(tmp_path / "broken.npz"), **ROLES)
    with pytest.raises(FileNotFoundError, match="there is no file"):
        Table(str(tmp_path / "none.csv"), **ROLES)
    with pytest.raises(ValueError, match=r"is no table: a file of .csv"):
        Table(str(tmp_path / "none.xlsx"), **ROLES)
    (tmp_path / "tank.parquet").write_bytes(b"PAR1")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    monkeypatch.setitem(sys.modules, "fastparquet", None)
    with pytest.raises(ImportError, match=r"pyarrow is needed to read tank.parquet: pip install pyarrow"):
        Table(str(tmp_path / "tank.parquet"), **ROLES)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"pandas is needed to read tank.parquet: pip install pandas"):
        Table(str(tmp_path / "tank.parquet"), **ROLES)
    with pytest.raises(TypeError, match=r"a table is a data frame .*, got int"):
        columns_of(3)


def test_discover_says_which_columns_it_needs():
    with pytest.raises(ValueError, match=r"of a table the columns are needed.*missing are \['actions', 'reward'\]"):
        discover(make_frame(), states=["level"])


def test_a_word_among_numbers_is_named_with_its_row():
    frame = make_frame().astype({"level": object})
    frame.loc[7, "level"], frame.loc[9, "level"] = "err", "12,5"
    with pytest.raises(ValueError, match=r"column 'level' of the table has 'err' in row 7, '12,5' in row 9 among numbers"):
        Table(frame, **ROLES)


def test_levels_of_which_some_are_numbers_are_categories():
    frame = make_frame()
    frame["grade"] = np.tile(["1", "2", "A"], len(frame))[: len(frame)]
    table = Table(frame, **{**ROLES, "states": ["level", "grade"]})
    assert table.state_names == ("level", "grade=2", "grade=A")


@pytest.mark.parametrize(("suffix", "separator"), [(".csv", ";"), (".csv", "\t"), (".tsv", ",")])
def test_another_separator_is_named(tmp_path, suffix, separator):
    path = tmp_path / f"tank{suffix}"
    make_frame().to_csv(path, index=False, sep=separator)
    with pytest.raises(ValueError, match=f"its values are separated by {separator!r}".replace("\\", "\\\\")):
        Table(path, **ROLES)


def test_a_rare_mode_among_digits_is_a_mode():
    frame = make_frame()
    frame["mode"] = np.where(np.arange(len(frame)) % 25 == 0, "X", (np.arange(len(frame)) % 3).astype(str))
    assert "mode=X" in Table(frame, **{**ROLES, "states": ["level", "mode"]}).state_names


def test_values_that_are_neither_text_nor_numbers_are_categories():
    frame = make_frame()
    frame["band"] = pd.cut(frame["level"], 3)
    assert len(Table(frame, **{**ROLES, "states": ["level", "band"]}).state_names) == 3


def test_a_name_with_another_separator_is_a_name(tmp_path):
    frame = make_frame().rename(columns={"level": "level, m"})
    frame.to_csv(tmp_path / "tank.csv", index=False)
    assert Table(tmp_path / "tank.csv", **{**ROLES, "states": ["level, m"]}).state_names == ("level, m",)
