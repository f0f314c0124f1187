import numpy as np
import pytest

pytest.importorskip("mujoco")

from benchmarks.discovery import oracle

ROOT_VELOCITY = 8  # of HalfCheetah's observation: eight positions, then nine velocities


@pytest.fixture(scope="module")
def half_cheetah() -> oracle.Oracle:
    return oracle.measure("HalfCheetah-v5", n_states=5, seed=0, n_rolled=300)


def test_actions_of_half_cheetah_change_the_velocities(half_cheetah):
    joint_velocities = half_cheetah.effects[11:17, 17:]
    assert half_cheetah.effects.shape == (18, 23)
    assert (np.diag(joint_velocities) > 0.1).all()


def test_the_reward_is_about_the_root_velocity_and_the_actions(half_cheetah):
    rewarding = np.flatnonzero(half_cheetah.effects[-1] > 0)
    assert rewarding.tolist() == [ROOT_VELOCITY, *range(17, 23)]


def test_the_root_velocity_changes_no_joint_in_the_air_as_physics_has_it():
    simulator = oracle.Simulator("HalfCheetah-v5")
    flying, action = np.zeros(17), np.zeros(6)
    flying[0] = 5.0
    still, _ = simulator.step(flying, action)
    flying[ROOT_VELOCITY] = 1.0
    moving, reward = simulator.step(flying, action)
    assert moving[ROOT_VELOCITY] > 0.9 and reward > 0.9
    np.testing.assert_allclose(np.delete(moving, ROOT_VELOCITY), np.delete(still, ROOT_VELOCITY), atol=1e-9)


@pytest.mark.parametrize("env_id", oracle.ENVIRONMENTS)
def test_the_simulator_repeats_a_recorded_transition(env_id):
    rows, variables = oracle.collect(env_id, 10, seed=0)
    simulator = oracle.Simulator(env_id)
    # Clipped velocities are not those that the simulator had
    rows = rows[(np.abs(rows[:, variables.state]) < 10).all(axis=1)]
    assert len(rows) > 1
    first = [simulator.step(row[variables.state], row[variables.action]) for row in rows]
    for (following, reward), row in zip(first, rows, strict=True):
        np.testing.assert_allclose(following, row[variables.next_state], atol=1e-4)
        np.testing.assert_allclose(reward, row[variables.reward], atol=1e-4)
        again, _ = simulator.step(row[variables.state], row[variables.action])
        np.testing.assert_array_equal(again, following)


def test_measured_once_read_ever_after(tmp_path, monkeypatch, half_cheetah):
    monkeypatch.setattr(oracle, "measure", lambda *args: half_cheetah)
    written = oracle.cached("HalfCheetah-v5", folder=tmp_path)
    monkeypatch.setattr(oracle, "measure", lambda *args: pytest.fail("measured again"))
    read = oracle.cached("HalfCheetah-v5", folder=tmp_path)
    np.testing.assert_array_equal(read.effects, written.effects)
    assert read.reward_r2 == half_cheetah.reward_r2


def test_a_seed_reproduces_the_transitions_and_smooth_actions_are_autocorrelated():
    rows, variables = oracle.collect("Hopper-v5", 400, seed=1, behaviour="smooth")
    again, _ = oracle.collect("Hopper-v5", 400, seed=1, behaviour="smooth")
    np.testing.assert_array_equal(rows, again)
    actions = rows[:, variables.action][:, 0]
    assert np.corrcoef(actions[1:], actions[:-1])[0, 1] > 0.7


def test_an_unknown_behaviour_is_an_error():
    with pytest.raises(ValueError, match="behaviour"):
        oracle.collect("Hopper-v5", 1, seed=0, behaviour="lazy")
