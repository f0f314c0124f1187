import json
import shutil

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from setups import SETUPS, STEPS, Setup, write_dataset
from small_models import SMALL
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env

from sb3_causalgdp import CausalGDP, TrainingCheckpointCallback, TrainingDivergedError
from sb3_causalgdp.checkpoints import resume
from sb3_causalgdp.checkpoints.checkpoint import save_checkpoint


def checkpoints(folder):
    return sorted(path for path in folder.iterdir() if path.name.startswith("checkpoint_"))


def copy_up_to(folder, checkpoint, target):
    """The folder as a process left it that was killed before the next checkpoint."""
    shutil.copytree(folder, target)
    for path in checkpoints(target):
        if path.name > checkpoint.name:
            shutil.rmtree(path)


def go_on(setup, folder, seed=3, total=STEPS):
    env = setup.make_env(seed)
    model = resume(setup.algorithm, folder, env) if setup.algorithm is not CausalGDP else CausalGDP.resume(folder, env)
    callbacks = setup.callbacks(folder)
    model.learn(total - model.num_timesteps, callbacks, reset_num_timesteps=False)
    return model, callbacks[0]


def assert_same_training(model, other):
    assert model.num_timesteps == other.num_timesteps
    for key, value in model.policy.state_dict().items():
        assert th.equal(value, other.policy.state_dict()[key]), key
    np.testing.assert_array_equal(model.replay_buffer.actions, other.replay_buffer.actions)


@pytest.mark.parametrize("name", SETUPS)
def test_a_resumed_training_ends_bit_for_bit_where_the_uninterrupted_one_does(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_dataset(tmp_path)
    setup = SETUPS[name]
    model, callbacks = setup.make_model(), setup.callbacks(tmp_path / "all", keep=None)
    model.learn(STEPS, callbacks)
    for checkpoint in checkpoints(tmp_path / "all")[:-1]:
        folder = tmp_path / checkpoint.name
        copy_up_to(tmp_path / "all", checkpoint, folder)
        resumed, evaluation = go_on(setup, folder, total=model._total_timesteps)
        assert_same_training(resumed, model)
        assert evaluation.evaluations_timesteps == callbacks[0].evaluations_timesteps
        np.testing.assert_array_equal(evaluation.evaluations_results, callbacks[0].evaluations_results)
        if resumed.get_vec_normalize_env() is not None:
            np.testing.assert_array_equal(resumed.env.obs_rms.mean, model.env.obs_rms.mean)
        # Those of the resumed training, which needed the transitions of the earlier ones
        assert len(checkpoints(folder)) == 2
        assert_same_training(resume(setup.algorithm, folder, setup.make_env(4)), model)


def test_one_file_holds_everything(tmp_path):
    setup = Setup()
    model = setup.make_model().learn(120)
    assert model.save_checkpoint(tmp_path / "there.zip") == tmp_path / "there.zip"
    assert [path.name for path in tmp_path.iterdir()] == ["there.zip"]
    model.learn(80, reset_num_timesteps=False)
    other = CausalGDP.resume(tmp_path / "there.zip", setup.make_env(1))
    assert_same_training(other.learn(80, reset_num_timesteps=False), model)


def test_remaining_steps_are_those_that_learn_was_asked_for(tmp_path):
    setup = Setup()
    model = setup.make_model()
    model.learn(200, TrainingCheckpointCallback(tmp_path, every=80, keep=None))
    shutil.rmtree(checkpoints(tmp_path)[-1])
    other = CausalGDP.resume(tmp_path, setup.make_env(1))
    assert (other.num_timesteps, other.remaining_timesteps) == (160, 40)
    assert_same_training(other.learn(other.remaining_timesteps, reset_num_timesteps=False), model)
    assert other.remaining_timesteps == 0


def test_pretraining_without_an_environment_goes_on(tmp_path):
    buffer = Setup().make_model().learn(300).replay_buffer
    arguments = {**SMALL, "learning_rate": lambda progress: 1e-3 * progress}
    model = CausalGDP.from_dataset(buffer, **arguments).preload(buffer)
    model.pretrain(130, TrainingCheckpointCallback(tmp_path / "folder", every=50, keep=None))
    shutil.rmtree(checkpoints(tmp_path / "folder")[-1])
    other = CausalGDP.resume(tmp_path / "folder", trusted=True)
    assert other.n_pretrain_steps == 100
    other.pretrain(130 - other.n_pretrain_steps)
    for key, value in model.policy.state_dict().items():
        assert th.equal(value, other.policy.state_dict()[key]), key


def test_only_new_transitions_are_written_and_old_files_go(tmp_path):
    setup = Setup(arguments={"buffer_size": 400})
    model = setup.make_model()
    written = []
    for _ in range(30):
        before = {path.name for path in (tmp_path / "transitions").glob("*")}
        model.learn(40, reset_num_timesteps=False)
        save_checkpoint(model, tmp_path, keep=1)
        rows = [path.stem.split("-")[-2:] for path in (tmp_path / "transitions").glob("*") if path.name not in before]
        written += [int(end) - int(first) for first, end in rows]
        assert len(list((tmp_path / "transitions").glob("*"))) <= 8
    assert min(written) == 40 and sum(written) < 30 * 400 / 2
    other = CausalGDP.resume(tmp_path, setup.make_env(1))
    for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
        np.testing.assert_array_equal(getattr(other.replay_buffer, name), getattr(model.replay_buffer, name))
    assert (other.replay_buffer.pos, other.replay_buffer.full) == (model.replay_buffer.pos, True)


def test_rows_that_somebody_else_added_are_saved_too(tmp_path):
    setup = Setup()
    model = setup.make_model().learn(80)
    save_checkpoint(model, tmp_path)
    buffer = model.replay_buffer
    buffer.add(*(np.ones((1, 3), np.float32),) * 2, np.ones((1, 1), np.float32), np.array([5.0]), np.array([False]), [{}])
    save_checkpoint(model, tmp_path)
    other = CausalGDP.resume(tmp_path, setup.make_env(1))
    np.testing.assert_array_equal(other.replay_buffer.rewards[:90], buffer.rewards[:90])


class Opaque(gym.Wrapper):
    """Holds what cannot be pickled."""

    def __init__(self, env):
        super().__init__(env)
        self.generator = (number for number in range(10))


def test_where_the_state_of_the_environment_cannot_be_had_new_episodes_begin_and_it_is_said(tmp_path):
    def make_env(seed):
        return make_vec_env(lambda: Opaque(gym.make("Pendulum-v1")), seed=seed)

    model = CausalGDP("MlpPolicy", make_env(0), **{**SMALL, "n_steps": 3})
    with pytest.warns(UserWarning, match=r"Opaque.generator \(generator\).*begins new episodes") as said:
        model.learn(250, TrainingCheckpointCallback(tmp_path, every=50))
    assert sum("cannot be pickled" in str(one.message) for one in said) == 1
    starts = [model.replay_buffer.observations[0, 0]]
    with pytest.warns(UserWarning, match="begin new episodes"):
        for n_steps in (256, 512):
            other = CausalGDP.resume(tmp_path, make_env(0))
            assert other.num_timesteps == n_steps
            buffer = other.replay_buffer
            last = buffer.pos - 1
            # The returns of several steps must not go from one episode to the next
            assert buffer.timeouts[last, 0] == buffer.dones[last, 0] == 1
            other.learn(250, TrainingCheckpointCallback(tmp_path, every=50), reset_num_timesteps=False)
            starts.append(buffer.observations[last + 1, 0])
    assert len({tuple(start) for start in starts}) == 3


def test_a_loaded_model_does_not_live_through_its_first_steps_again(tmp_path):
    model = Setup().make_model()
    model.learn(250).save(tmp_path / "model")
    starts = [model.replay_buffer.observations[0, 0]]
    for _ in range(2):
        model = CausalGDP.load(tmp_path / "model", env=Setup().make_env(0))
        model.learn(250, reset_num_timesteps=False)
        model.save(tmp_path / "model")
        starts.append(model.replay_buffer.observations[0, 0])
    assert len({tuple(start) for start in starts}) == 3


def test_returns_of_several_steps_do_not_reach_over_a_gap(tmp_path):
    """With a buffer that was loaded, and with learn() that resets the environment in the middle of an episode."""
    setup = Setup(arguments={"n_steps": 3})
    model = setup.make_model().learn(104)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    loaded = CausalGDP.load(tmp_path / "model", env=setup.make_env(0))
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    for one, reset in ((loaded, False), (model, True)):
        one.learn(24, reset_num_timesteps=reset)
        buffer = one.replay_buffer
        assert buffer.dones[103, 0] == buffer.timeouts[103, 0] == 1
        batch = buffer._get_samples(np.array([101]))
        np.testing.assert_allclose(batch.next_observations[0], buffer.next_observations[103, 0])
        assert batch.dones[0] == 0


@pytest.mark.parametrize("suffix", ["npz", "pkl"])
def test_a_loaded_buffer_gives_the_returns_of_the_model_and_not_those_of_another(tmp_path, suffix):
    for n_steps in (1, 2, 3):
        model = Setup(arguments={"n_steps": n_steps}).make_model().learn(64)
        model.save_replay_buffer(tmp_path / f"{n_steps}.{suffix}")
    for wanted in (1, 3):
        for saved in (1, 2, 3):
            model = Setup(arguments={"n_steps": wanted, "gamma": 0.9}).make_model()
            model.num_timesteps = 64
            kind = type(model.replay_buffer)
            model.load_replay_buffer(tmp_path / f"{saved}.{suffix}")
            buffer = model.replay_buffer
            assert type(buffer) is kind and buffer.size() == 64
            if wanted > 1:
                assert (buffer.n_steps, buffer.gamma) == (wanted, 0.9)
            batch = buffer._get_samples(np.array([10]))
            np.testing.assert_allclose(
                batch.rewards[0, 0], sum(0.9**i * buffer.rewards[10 + i, 0] for i in range(wanted)), rtol=1e-5
            )


def test_a_model_and_a_buffer_of_other_steps_are_not_of_one_moment(tmp_path):
    model = Setup().make_model().learn(64)
    model.save(tmp_path / "model")
    model.learn(40, reset_num_timesteps=False).save_replay_buffer(tmp_path / "buffer.pkl")
    loaded = CausalGDP.load(tmp_path / "model")
    with pytest.warns(UserWarning, match="saved after 104 steps, the model after 64"):
        loaded.load_replay_buffer(tmp_path / "buffer.pkl")


class Diverge(BaseCallback):
    """Makes the critics infinite at these steps, each time that they come."""

    def __init__(self, *steps, once=True):
        super().__init__()
        self.steps, self.once = set(steps), once

    def _on_step(self):
        if self.num_timesteps in self.steps:
            self.steps -= {self.num_timesteps} if self.once else set()
            next(self.model.critic.parameters()).data.fill_(float("inf"))
        return True


def test_a_training_that_diverged_goes_on_from_its_checkpoint_where_that_is_wished(tmp_path):
    model = Setup().make_model()
    saving = TrainingCheckpointCallback(tmp_path / "restored", every=50, on_divergence="restore")
    with pytest.warns(
        UserWarning, match=r"diverged: .* It goes on from .*restored after 1\d\d steps, with other random numbers"
    ):
        model.learn(300, [Diverge(180), saving])
    assert model.num_timesteps == 304 and CausalGDP.resume(tmp_path / "restored").num_timesteps == 304
    assert all(th.isfinite(value).all() for value in model.policy.state_dict().values())
    model.save(tmp_path / "model")
    # Once more each time: it gives up
    with pytest.raises(TrainingDivergedError), pytest.warns(UserWarning, match="It goes on from"):
        Setup().make_model().learn(
            300,
            [Diverge(180, once=False), TrainingCheckpointCallback(tmp_path / "hopeless", every=50, on_divergence="restore")],
        )
    # By default, and where there is no checkpoint yet, the error is raised at once
    for callback in (
        TrainingCheckpointCallback(tmp_path / "raised", every=50),
        TrainingCheckpointCallback(tmp_path / "too_early", on_divergence="restore"),
    ):
        with pytest.raises(TrainingDivergedError):
            Setup().make_model().learn(300, [Diverge(180), callback])


# What is wrong ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path):
    Setup().make_model().learn(200, TrainingCheckpointCallback(tmp_path / "folder", every=90))
    return tmp_path / "folder"


@pytest.mark.parametrize("damaged", ["model.zip", "state.bin", "manifest.json"])
def test_the_newest_whole_checkpoint_is_taken(folder, damaged):
    older, newest = checkpoints(folder)
    content = bytearray((newest / damaged).read_bytes())
    content[len(content) // 2] ^= 4
    (newest / damaged).write_bytes(content)
    steps = json.loads((older / "manifest.json").read_text())["num_timesteps"]
    assert CausalGDP.resume(folder, Setup().make_env(0)).num_timesteps == steps
    (older / damaged).unlink()
    with pytest.raises(ValueError, match=r"no checkpoint is whole: .*checkpoint_\d+"):
        CausalGDP.resume(folder, Setup().make_env(0))


def test_a_damaged_older_checkpoint_does_not_end_a_training(folder):
    older, _ = checkpoints(folder)
    (older / "manifest.json").write_text("{")
    model = CausalGDP.resume(folder, Setup().make_env(0))
    model.learn(8, TrainingCheckpointCallback(folder, every=8, keep=3), reset_num_timesteps=False)
    assert CausalGDP.resume(folder, Setup().make_env(0)).num_timesteps == model.num_timesteps


def test_what_cannot_be_resumed_is_said_in_one_line(folder, tmp_path):
    with pytest.raises(FileNotFoundError, match="there is no checkpoint"):
        CausalGDP.resume(tmp_path, Setup().make_env(0))
    with pytest.raises(ValueError, match="of 1 environments, got 2"):
        CausalGDP.resume(folder, Setup(n_envs=2).make_env(0))
    with pytest.raises(ValueError, match="VecNormalize"):
        CausalGDP.resume(folder, Setup(normalized=True).make_env(0))
    with pytest.raises(ValueError, match="is of CausalGDP, not of"):
        resume(type("Other", (CausalGDP,), {}), folder, Setup().make_env(0))
    (tmp_path / "text.zip").write_text("text")
    with pytest.raises(ValueError, match=r"text\.zip is no checkpoint"):
        CausalGDP.resume(tmp_path / "text.zip")


def test_a_folder_is_for_one_training(folder):
    model = Setup().make_model()
    with pytest.raises(ValueError, match="another training"):
        model.learn(20, TrainingCheckpointCallback(folder))
    with pytest.raises(ValueError, match="another training"):
        model.save_checkpoint(folder)


@pytest.mark.parametrize("arguments", [{"every": 0}, {"keep": 0}, {"on_divergence": "ignore"}])
def test_the_callback_refuses_what_is_out_of_range(tmp_path, arguments):
    with pytest.raises(ValueError, match=next(iter(arguments))):
        TrainingCheckpointCallback(tmp_path, **arguments)
