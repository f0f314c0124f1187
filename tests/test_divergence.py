"""What is no longer a number is said by name: never acted with, stored, saved or loaded."""

import io
import math
import pickle
from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import SMALL
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise

from sb3_causalgdp import CausalGDP, MlpPolicy, TrainingDivergedError
from sb3_causalgdp.divergence import check_losses
from sb3_causalgdp.offline.replay import SpacesEnv


class RecordingEnv(gym.Env):
    """Keeps the actions that it was given; its rewards have any unit."""

    def __init__(self, unit=1.0):
        self.observation_space = spaces.Box(-1.0, 1.0, (3,))
        self.action_space = spaces.Box(-1.0, 1.0, (2,))
        self.unit = unit
        self.actions = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        self.actions.append(action)
        return self.observation_space.sample(), self.unit * float(action[0]), False, False, {}


class At(BaseCallback):
    """Does something to the model at one step."""

    def __init__(self, step, do):
        super().__init__()
        self.step, self.do = step, do

    def _on_step(self):
        if self.num_timesteps == self.step:
            with th.no_grad():
                self.do(self.model)
        return True


def make(env="Pendulum-v1", **kwargs):
    return CausalGDP("MlpPolicy", env, **{**SMALL, **kwargs})


def break_(tensors, value=math.nan):
    with th.no_grad():
        next(iter(tensors)).view(-1)[0] = value


@pytest.fixture(scope="module")
def trained():
    return make().learn(64)


# Training ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "kwargs"),
    [(1e30, {}), (1.0, {"learning_rate": 1e6}), (1.0, {"learning_rate": lambda p: math.nan if p < 0.9 else 1e-3})],
)
def test_training_that_diverges_says_so_and_no_nan_is_sent_or_stored(unit, kwargs):
    env = RecordingEnv(unit)
    model = make(env, train_freq=1, **kwargs)
    with pytest.raises(TrainingDivergedError, match=r"The training diverged: \S+ is (nan|inf) at update \d+") as error:
        model.learn(1000)
    assert not math.isfinite(error.value.value) and error.value.update == model._n_updates
    assert np.isfinite(env.actions).all()
    for values in (model.replay_buffer.actions, model.replay_buffer.observations, model.replay_buffer.rewards):
        assert np.isfinite(values).all()


@pytest.mark.parametrize(
    ("module", "quantity", "update"),
    [("critic", "critic_loss", 11), ("world_model", "world_model_transition_loss", 12), ("critic_target", "critic_loss", 11)],
)
def test_the_first_loss_and_its_update_are_named(module, quantity, update):
    model = make(train_freq=10, gradient_steps=5, learning_starts=10, world_model_delay=3)
    # After the ten updates of steps 20 and 30
    callback = At(35, lambda model: break_(getattr(model, module).parameters()))
    with pytest.raises(TrainingDivergedError) as error:
        model.learn(100, callback)
    assert (error.value.quantity, error.value.update) == (quantity, update)


def test_losses_that_are_finite_raise_nothing_however_large():
    steps = {"last_step": 2, "delays": {"critic_loss": 1}, "delay": 2}
    check_losses([("critic_loss", 1e38), ("critic_loss", 3e38)], **steps)
    with pytest.raises(TrainingDivergedError, match="actor_loss is inf at update 2"):
        check_losses([("critic_loss", 1.0), ("critic_loss", 1.0), ("actor_loss", math.inf)], **steps)


def test_a_policy_that_diverged_acts_no_more_and_the_environment_is_not_blamed():
    env = RecordingEnv()
    model = make(env, train_freq=100)
    callback = At(40, lambda model: break_(model.actor.denoiser.input_layer.parameters()))
    with pytest.raises(TrainingDivergedError, match=r"policy\.actor\.denoiser\.input_layer\.weight is nan at update 0"):
        model.learn(100, callback)
    assert len(env.actions) == 40 and np.isfinite(env.actions).all()
    assert model.replay_buffer.pos == 40


def test_noise_that_is_nan_is_named():
    env = RecordingEnv()
    model = make(env, action_noise=NormalActionNoise(np.zeros(2), np.array([0.1, math.nan])))
    with pytest.raises(ValueError, match="action_noise gave an action of NaN at step 0"):
        model.learn(10)
    assert env.actions == []


def test_pretraining_that_diverges_says_so(trained):
    model = make()
    n = 100
    rows = np.random.default_rng(0).normal(size=(n, 3))
    ends = np.zeros(n, bool)
    data = {"observations": rows, "next_observations": rows, "actions": np.zeros((n, 1)), "rewards": np.full(n, 1e30)}
    model.preload({**data, "terminations": ends, "truncations": ends})
    with pytest.raises(TrainingDivergedError, match="critic_loss is inf at update 1"):
        model.pretrain(10)


def test_the_error_survives_a_process():
    error = pickle.loads(pickle.dumps(TrainingDivergedError("critic_loss", math.inf, 7)))
    assert (error.quantity, error.value, error.update) == ("critic_loss", math.inf, 7)
    assert str(error).startswith("The training diverged: critic_loss is inf at update 7. ")


# Prediction -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e39])
def test_an_observation_that_is_no_number_is_named(value):
    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float64)
    model = make(SpacesEnv(observation_space, spaces.Box(-1.0, 1.0, (1,))))
    batch = np.zeros((4, 3))
    batch[2, 1] = value
    for observations in (batch, batch.tolist()):
        with pytest.raises(ValueError, match=r"The observation is \S+ at row 2, index \[1\]: it must be finite in float32"):
            model.predict(observations)
    with pytest.raises(ValueError, match=r"The observation is \S+ at index \[1\]"):
        model.policy.predict(batch[2])
    assert np.isfinite(model.predict(np.zeros((4, 3)))[0]).all()


def test_the_part_of_a_dictionary_is_named():
    space = spaces.Dict({"a": spaces.Box(-1.0, 1.0, (2,)), "b": spaces.Box(-1.0, 1.0, (2, 2))})
    model = CausalGDP("MultiInputPolicy", SpacesEnv(space, spaces.Box(-1.0, 1.0, (1,))), **SMALL)
    batch = {"a": np.zeros((3, 2), np.float32), "b": np.zeros((3, 2, 2), np.float32)}
    assert np.isfinite(model.predict(batch)[0]).all()
    batch["b"][1, 1, 0] = math.nan
    with pytest.raises(ValueError, match=r"observation\['b'\] is nan at row 1, index \[1, 0\]"):
        model.predict(batch)


# Files ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("what", ["parameter", "buffer", "optimizer"])
def test_nan_is_neither_saved_nor_loaded(what, tmp_path, trained):
    model = make().learn(64)
    model.save(tmp_path / "model")
    before = (tmp_path / "model.zip").read_bytes()
    if what == "optimizer":
        model.critic.optimizer.state[next(model.critic.parameters())]["exp_avg_sq"][0] = math.inf
        name = "critic.optimizer.state.0.exp_avg_sq"
    else:
        name = {"parameter": "policy.world_model.transition_log_std", "buffer": "policy.return_std"}[what]
        break_([dict((*model.policy.named_parameters(), *model.policy.named_buffers()))[name.removeprefix("policy.")]])
    with pytest.raises(TrainingDivergedError, match=f"{name} is (nan|inf) at update {model._n_updates}"):
        model.save(tmp_path / "model")
    assert (tmp_path / "model.zip").read_bytes() == before
    # As another program would have written it
    stream = io.BytesIO()
    model._refuse_to_save_nan = lambda: None
    model.save(stream, exclude=["_refuse_to_save_nan"])
    with pytest.raises(ValueError, match=f"{name} holds (nan|inf)"):
        CausalGDP.load(stream, device="cpu")
    with pytest.raises(ValueError, match=f"{name} holds (nan|inf)"):
        trained.set_parameters(stream)


def test_a_policy_with_nan_is_not_loaded(tmp_path, trained):
    policy = deepcopy(trained.policy)
    policy.save(tmp_path / "policy.pt")
    assert MlpPolicy.load(tmp_path / "policy.pt").first_not_finite() is None
    break_(policy.actor.parameters())
    policy.save(tmp_path / "policy.pt")
    with pytest.raises(ValueError, match=r"policy\.actor\.denoiser\.\S+ is nan"):
        MlpPolicy.load(tmp_path / "policy.pt")


def leaves(tree):
    parts = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, (list, tuple)) else ()
    return [tree] if isinstance(tree, th.Tensor) else [leaf for part in parts for leaf in leaves(part)]


def with_wider_critics():
    return make(policy_kwargs={"net_arch": [32], "world_model_net_arch": [16, 16]}).learn(64).get_parameters()


def one_name_too_many(parameters):
    return {**parameters, "no_such_thing": {}}


def one_name_too_few(parameters):
    return {name: state for name, state in parameters.items() if name != "critic.optimizer"}


def another_policy_behind_good_optimizers(parameters):
    wider = with_wider_critics()
    return {**{name: state for name, state in parameters.items() if name != "policy"}, "policy": wider["policy"]}


def a_state_of_another_size(parameters):
    return {**parameters, "critic.optimizer": with_wider_critics()["critic.optimizer"]}


def a_state_of_other_parameters(parameters):
    return {**parameters, "critic.optimizer": parameters["actor.optimizer"]}


def no_state_at_all(parameters):
    return {**parameters, "critic.optimizer": {"weights": 3}}


@pytest.mark.parametrize("exact_match", [True, False])
@pytest.mark.parametrize(
    "change",
    [
        one_name_too_many,
        one_name_too_few,
        another_policy_behind_good_optimizers,
        a_state_of_another_size,
        a_state_of_other_parameters,
        no_state_at_all,
    ],
)
def test_parameters_are_set_all_or_not_at_all(change, exact_match):
    model, other = make().learn(64), make(seed=1).learn(64)
    before = deepcopy(model.get_parameters())
    changed = change(other.get_parameters())
    if change is one_name_too_few and not exact_match:
        model.set_parameters(changed, exact_match)
        assert th.equal(leaves(model.get_parameters()["policy"])[-1], leaves(other.get_parameters()["policy"])[-1])
        return
    with pytest.raises((ValueError, RuntimeError)):
        model.set_parameters(changed, exact_match)
    for mine, expected in zip(leaves(model.get_parameters()), leaves(before), strict=True):
        assert th.equal(mine, expected)
    # And goes on
    model.learn(32, reset_num_timesteps=False)


def test_a_state_of_another_size_is_named():
    state = make(policy_kwargs={"net_arch": [32], "world_model_net_arch": [16, 16]}).learn(64).critic.optimizer.state_dict()
    with pytest.raises(
        ValueError, match=r"critic\.optimizer\.state\.2\.exp_avg has the shape \(32, 4\), its parameter \(16, 4\)"
    ):
        make().set_parameters({"critic.optimizer": state}, exact_match=False)
