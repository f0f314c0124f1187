import numpy as np
import pandas as pd
import pytest
from gymnasium import spaces

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.sources.tables import Table

ROLES = {"states": ["level", "temperature"], "actions": ["valve"], "reward": "cost", "episode": "run"}


def make_frame(n_episodes=10, n_steps=40):
    rng = np.random.default_rng(0)
    runs = np.repeat(np.arange(n_episodes), n_steps)
    columns = rng.normal(size=(n_episodes * n_steps, 3))
    valve = rng.uniform(0, 5, size=len(runs))
    return pd.DataFrame({"run": runs, "level": columns[:, 0], "temperature": columns[:, 1], "valve": valve, "cost": -valve})


def make(source, **kwargs):
    return CausalGDP.from_dataset(source, buffer_size=2_000, **kwargs)


def test_a_model_is_made_from_a_frame_and_learns_from_it():
    frame = make_frame()
    with pytest.warns(UserWarning, match=r"spaces are inferred, observation_space=Box\(-inf, inf, \(2,\).*action_space=Box\("):
        model = make(frame, **ROLES)
    assert model.observation_space.shape == (2,)
    np.testing.assert_allclose(model.action_space.high, [frame["valve"].max()], rtol=1e-6)
    table = Table(frame, **ROLES)
    model.preload(table)
    buffer = model.replay_buffer
    assert buffer.size() == len(table) == 390
    np.testing.assert_allclose(buffer.observations[:390, 0], table.observations, rtol=1e-6)
    np.testing.assert_allclose(buffer.next_observations[:390, 0], table.next_observations, rtol=1e-6)
    assert (buffer.dones[:390, 0] == table.is_last).all() and buffer.timeouts[:390].sum() == 10
    model.pretrain(2)
    action, _ = model.predict(np.zeros(2, dtype=np.float32))
    assert model.action_space.contains(action)


def test_the_model_of_a_table_has_its_columns_names():
    frame = make_frame()
    with pytest.warns(UserWarning, match="spaces are inferred"):
        model = make(frame, **ROLES)
    assert model.transition_variables.names[:3] == ("level", "temperature", "valve")
    model.preload(Table(frame, **ROLES))
    model.pretrain(4)
    outcome = model.intervene(np.zeros(2), [1.0], {"valve": 2.0})
    assert set(outcome.to_dataframe()["outcome"]) == {"level'", "temperature'", "reward"}
    with pytest.warns(UserWarning, match="spaces are inferred"):
        model = make(frame, **ROLES, state_names=["a", "b"])
    assert model.transition_variables.names[:3] == ("a", "b", "valve")


def test_given_spaces_are_taken_without_a_word(recwarn):
    wanted = spaces.Box(-10.0, 10.0, (2,)), spaces.Box(0.0, 10.0, (1,))
    model = make(make_frame(), **ROLES, observation_space=wanted[0], action_space=wanted[1])
    assert (model.observation_space, model.action_space) == wanted
    assert not [warning for warning in recwarn if "inferred" in str(warning.message)]


def test_arrays_tell_their_shapes():
    rng = np.random.default_rng(0)
    arrays = {
        "observations": rng.normal(size=(50, 3)),
        "next_observations": rng.normal(size=(50, 3)),
        "actions": rng.uniform(-2, 2, size=(50, 2)),
        "rewards": rng.normal(size=50),
        "terminations": np.zeros(50, bool),
        "truncations": np.zeros(50, bool),
    }
    with pytest.warns(UserWarning, match=r"The arrays: spaces are inferred, observation_space=Box\(-inf, inf, \(3,\)"):
        model = make(arrays)
    assert model.observation_space.shape == (3,) and model.action_space.shape == (2,)
    arrays["actions"][:, 0] = 1.0
    with pytest.raises(ValueError, match="no range can be inferred, give action_space="):
        make(arrays)


def test_a_frame_without_roles_says_what_is_needed(tmp_path):
    make_frame().to_csv(tmp_path / "tank.csv")
    for source in (make_frame(), str(tmp_path / "tank.csv")):
        with pytest.raises(ValueError, match=r"its columns must be known: give states="):
            make(source)


def test_a_frame_is_preloaded_by_the_names_of_its_columns():
    frame, columns = make_frame(), {"states": ["level"], "actions": ["valve"], "reward": "cost", "episode": "run"}
    expected, found = (make(Table(frame, **columns)) for _ in range(2))
    expected.preload(Table(frame, **columns))
    found.preload(frame, **columns)
    np.testing.assert_array_equal(found.offline_buffer.observations, expected.offline_buffer.observations)
    with pytest.raises(ValueError, match="a table needs actions=, too: got states, reward"):
        found.preload(frame, states=["level"], reward="cost")
    with pytest.raises(TypeError, match="unexpected keyword argument 'rewards'"):
        found.preload(frame, rewards="cost")


def test_columns_that_are_not_the_model_s_are_refused():
    columns = {"states": ["level", "temperature"], "actions": ["valve"], "reward": "cost", "episode": "run"}
    model = make(make_frame(), **columns)
    with pytest.raises(
        ValueError, match=r"states must be \['level', 'temperature'\], in this order.*\['temperature', 'level'\]"
    ):
        model.preload(make_frame(), **{**columns, "states": ["temperature", "level"]})
    renamed = make_frame().rename(columns={"level": "lvl"})
    with pytest.raises(ValueError, match=r"got \['lvl', 'temperature'\]"):
        model.preload(renamed, **{**columns, "states": ["lvl", "temperature"]})
    assert model.offline_buffer is None


def test_a_text_column_that_is_coded_otherwise_is_refused():
    columns = {"states": ["level"], "actions": ["pump"], "reward": "cost", "episode": "run"}
    mostly_on, mostly_off = (make_frame() for _ in range(2))
    mostly_on["pump"] = np.where(np.arange(400) % 5 < 3, "on", "off")
    mostly_off["pump"] = np.where(np.arange(400) % 5 < 2, "on", "off")
    model = make(mostly_on, **columns).preload(mostly_on, **columns)
    with pytest.raises(ValueError, match=r"actions must be \['pump=off'\].*got \['pump=on'\]"):
        model.preload(mostly_off, **columns)


def test_a_model_without_names_of_its_own_takes_columns_by_position():
    columns = {"states": ["level", "temperature"], "actions": ["valve"], "reward": "cost", "episode": "run"}
    frame = make_frame()
    expected = Table(frame, **columns)
    arrays = {name: getattr(expected, name) for name in ("observations", "actions", "next_observations", "rewards")}
    ends = {"terminations": np.zeros(len(expected), bool), "truncations": expected.is_last}
    model = make({**arrays, **ends}).preload(frame, **columns)
    np.testing.assert_allclose(model.offline_buffer.observations[: len(expected), 0], expected.observations, rtol=1e-6)


def test_questions_about_a_frame_are_by_the_names_of_its_columns():
    columns = {"states": ["level", "temperature"], "actions": ["valve"], "reward": "cost", "episode": "run"}
    frame = make_frame()
    model = make(frame, **columns).preload(frame, **columns).pretrain(4)
    plain = model.effect_of_actions(frame[["level", "temperature"]].to_numpy(), frame[["valve"]].to_numpy())
    swapped = model.effect_of_actions(frame[["temperature", "run", "level"]], frame[["valve"]])
    np.testing.assert_array_equal(swapped.next_state.mean, plain.next_state.mean)
    with pytest.raises(ValueError, match=r"observation must have the columns \['level', 'temperature'\], got \['level'\]"):
        model.intervene(frame[["level"]], frame[["valve"]], {})


@pytest.mark.parametrize("reward", [["cost"], ("cost",)])
def test_a_list_of_one_reward_is_one_reward(reward):
    assert len(Table(make_frame(), states=["level"], actions=["valve"], reward=reward)) == 399
    with pytest.raises(ValueError, match="reward must be the name of one column"):
        Table(make_frame(), states=["level"], actions=["valve"], reward=["cost", "run"])
