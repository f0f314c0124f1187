import os
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from goal_env import GoalEnv
from gymnasium import spaces
from small_models import small
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CheckpointCallback,
    EvalCallback,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback
from sb3_causalgdp.causal.sources import open_source as open_causal_source
from sb3_causalgdp.offline.sources import Source

KWARGS = small(learning_starts=5, train_freq=1, causal_refresh_freq=10)
N_ROWS = 400
GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")


def make(env="Pendulum-v1", **kwargs):
    return CausalGDP("MlpPolicy", env, **{**KWARGS, **kwargs})


def make_hindsight(env, **kwargs):
    return CausalGDP("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, **{**KWARGS, **kwargs})


@pytest.fixture(scope="module")
def arrays():
    env = gym.make("Pendulum-v1")
    env.action_space.seed(0)
    rows, observation = [], env.reset(seed=0)[0]
    for step in range(N_ROWS):
        action = env.action_space.sample()
        after, reward, terminated, _, _ = env.step(action)
        truncated = step % 100 == 99
        rows.append((observation, action, reward, after, terminated, truncated))
        observation = env.reset()[0] if truncated else after
    names = ("observations", "actions", "rewards", "next_observations", "terminations", "truncations")
    return {name: np.stack(values) for name, values in zip(names, zip(*rows, strict=True), strict=True)}


@pytest.fixture
def npz(arrays, tmp_path):
    np.savez(tmp_path / "data.npz", **arrays)
    return str(tmp_path / "data.npz")


@pytest.fixture
def model(arrays):
    return make().preload(arrays)


class Counting(BaseCallback):
    """Keeps the steps that it saw, and stops at one of them."""

    def __init__(self, stop_at=None):
        super().__init__()
        self.steps, self.stop_at = [], stop_at

    def _on_step(self):
        self.steps.append(self.model.num_timesteps)
        return self.num_timesteps != self.stop_at


def states(model):
    optimizers = (model.actor.optimizer, model.critic.optimizer, model.world_model.optimizer)
    return [*model.policy.state_dict().values(), *(value for one in optimizers for value in _tensors(one.state_dict()))]


def _tensors(tree):
    if isinstance(tree, th.Tensor):
        yield tree
    elif isinstance(tree, dict | list):
        for part in tree.values() if isinstance(tree, dict) else tree:
            yield from _tensors(part)


def assert_same(states, others):
    assert all(th.equal(one, other) for one, other in zip(states, others, strict=True))


# What it trains, and when ---------------------------------------------------------------------------------------------------


def test_everything_is_trained(model):
    parts = ("actor", "actor_target", "critic", "critic_target", "world_model")
    before = {part: [value.clone() for value in getattr(model, part).parameters()] for part in parts}
    assert model.pretrain(5) is model
    for part in parts:
        assert any(not th.equal(one, two) for one, two in zip(before[part], getattr(model, part).parameters(), strict=True))
    assert model._n_updates == 5


def test_masks_come_before_the_first_step_and_on_schedule(model, monkeypatch):
    refreshes, seen = [], []

    class Recording(CausalWorldModelCallback):
        def refresh(self):
            super().refresh()
            refreshes.append(self.model.num_timesteps)

    train = model.train
    monkeypatch.setattr(model, "train", lambda **kwargs: (seen.append(model.causal_graph().n_samples), train(**kwargs)))
    model.pretrain(25, callback=Recording())
    assert refreshes == [0, 10, 20]
    assert seen == [N_ROWS] * 25
    assert model.causal_graph().num_timesteps == 0


@pytest.mark.parametrize("n_envs", [1, 2])
def test_a_buffer_that_is_exactly_full_is_fed_whole(n_envs, arrays):
    model = make(make_vec_env("Pendulum-v1", n_envs=n_envs), buffer_size=N_ROWS).preload(arrays)
    assert model.replay_buffer.full and model.replay_buffer.pos == 0
    model.pretrain(12)
    assert model.causal_statistics.n_samples == N_ROWS


def test_a_full_replay_buffer_that_was_loaded_is_fed_whole(arrays, tmp_path):
    make(buffer_size=N_ROWS).preload(arrays).save_replay_buffer(tmp_path / "buffer")
    model = make(buffer_size=N_ROWS)
    model.load_replay_buffer(tmp_path / "buffer")
    model.offline_buffer = None  # as if another algorithm had saved it
    model.pretrain(1)
    assert model.causal_statistics.n_samples == N_ROWS


def test_preloaded_and_collected_transitions_are_fed_once(model, arrays):
    model.pretrain(15)
    model.learn(35)
    model.preload({key: values[:100] for key, values in arrays.items()})
    model.pretrain(12)
    # learn() feeds before it stores the step
    assert model.causal_statistics.n_samples == N_ROWS + 35 + 100


def test_schedules_go_from_1_to_0_and_learn_starts_anew(arrays):
    rates = []
    model = make(learning_rate=lambda remaining: 1e-3 * (0.5 + remaining)).preload(arrays)
    model.pretrain(4, callback=lambda *_: rates.append(model.actor.optimizer.param_groups[0]["lr"]) or True)
    np.testing.assert_allclose(rates, [1.5e-3, 1.25e-3, 1.0e-3, 0.75e-3])
    assert model._current_progress_remaining == 1.0


# Callbacks ----------------------------------------------------------------------------------------------------------------


def test_callbacks_see_each_gradient_step_and_the_counter_of_steps_comes_back(model):
    model.learn(7)
    callback = Counting()
    model.pretrain(5, callback=callback)
    assert callback.steps == [1, 2, 3, 4, 5] and callback.n_calls == 5
    assert model.num_timesteps == 7 and not model.is_pretraining
    model.learn(3, reset_num_timesteps=False)
    assert model.num_timesteps == 10


def test_it_stops_and_goes_on(model):
    first, second = Counting(stop_at=3), Counting()
    model.pretrain(8, callback=first)
    model.pretrain(5, callback=second)
    assert first.steps == [1, 2, 3] and second.steps == [4, 5, 6, 7, 8]


class AsksForSteps(BaseCallback):
    """Reads what callbacks of the zoo and of SB3 read of each step."""

    def _on_training_start(self):
        assert not self.locals["dones"].any() and len(self.locals["infos"]) == self.training_env.num_envs

    def _on_step(self):
        assert self.locals["self"] is self.model and not self.locals["dones"].any()
        return not any("episode" in info for info in self.locals["infos"])


@pytest.mark.parametrize("n_envs", [1, 3])
def test_callbacks_that_ask_for_the_environments_steps_find_that_no_episode_ended(n_envs, arrays):
    model = make(make_vec_env("Pendulum-v1", n_envs=n_envs)).preload(arrays)
    model.pretrain(4, callback=[StopTrainingOnMaxEpisodes(1, verbose=1), AsksForSteps()])
    assert model.n_pretrain_steps == 4


def test_a_model_without_improvement_stops_the_offline_stage(arrays):
    env = make_vec_env(lambda: gym.wrappers.TimeLimit(gym.make("Pendulum-v1"), 5))
    stop = StopTrainingOnNoModelImprovement(max_no_improvement_evals=1, min_evals=0)
    good_enough = StopTrainingOnRewardThreshold(reward_threshold=-1e9)
    for callbacks in ({"callback_after_eval": stop}, {"callback_on_new_best": good_enough}):
        model = make(learning_rate=0.0).preload(arrays)
        model.pretrain(40, callback=EvalCallback(env, eval_freq=2, n_eval_episodes=1, verbose=0, **callbacks))
        assert model.n_pretrain_steps < 40


def test_an_exception_leaves_the_counters_as_they_were(model):
    def fail(*_):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        model.pretrain(8, callback=fail)
    assert model.num_timesteps == 0 and not model.is_pretraining
    model.pretrain(1)


def test_evaluations_and_checkpoints_are_numbered_by_gradient_steps(model, tmp_path):
    env = make_vec_env(lambda: gym.wrappers.TimeLimit(gym.make("Pendulum-v1"), 5))
    evaluation = EvalCallback(env, eval_freq=4, n_eval_episodes=1, log_path=str(tmp_path), verbose=0)
    model.pretrain(8, callback=[evaluation, CheckpointCallback(4, str(tmp_path), "offline")])
    assert np.load(tmp_path / "evaluations.npz")["timesteps"].tolist() == [4, 8]
    assert sorted(file for file in os.listdir(tmp_path) if file.endswith("zip")) == [
        "offline_4_steps.zip",
        "offline_8_steps.zip",
    ]
    # A checkpoint of the offline stage has made no step in the environment
    loaded = CausalGDP.load(tmp_path / "offline_4_steps.zip", device="cpu")
    assert loaded.num_timesteps == 0 and loaded._n_pretrain_steps == 4 and not loaded.is_pretraining


@pytest.mark.parametrize("n_envs", [1, 3])
def test_a_progress_bar_counts_gradient_steps(n_envs, arrays, capsys):
    model = make(make_vec_env("Pendulum-v1", n_envs=n_envs)).preload(arrays)
    model.pretrain(4, progress_bar=True)
    assert "4/4" in capsys.readouterr().out


def test_tensorboard_gets_a_run_of_its_own(arrays, tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    model = make(tensorboard_log=str(tmp_path)).preload(arrays)
    model.pretrain(4, log_interval=2)
    model.pretrain(4, log_interval=2)
    assert os.listdir(tmp_path) == ["offline_1"]
    events = accumulator.EventAccumulator(str(tmp_path / "offline_1"))
    events.Reload()
    # Files are read by name, and the tenth comes before the ninth
    losses = sorted(events.Scalars("train/critic_loss"), key=lambda event: event.wall_time)
    assert [event.step for event in losses] == [2, 4, 6, 8]
    model.learn(8)
    assert sorted(os.listdir(tmp_path)) == ["CausalGDP_1", "offline_1"]


# Without an environment -----------------------------------------------------------------------------------------------------


class Described(Source):
    """Arrays with spaces."""

    def __init__(self, arrays, observation_space):
        action_space = spaces.Box(-2.0, 2.0, (1,), np.float32)
        super().__init__("described", N_ROWS, observation_space, action_space)
        self.arrays = arrays

    def chunks(self):
        from sb3_causalgdp.offline.sources import ArraySource

        yield from ArraySource(self.arrays).chunks()


def test_a_model_from_a_dataset_needs_no_environment(arrays, tmp_path):
    source = Described(arrays, gym.make("Pendulum-v1").observation_space)
    model = CausalGDP.from_dataset(source, **KWARGS)
    assert model.env is None
    env = gym.wrappers.TimeLimit(gym.make("Pendulum-v1"), 5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        evaluation = EvalCallback(env, eval_freq=2, n_eval_episodes=1, verbose=0)
        model.preload(source).pretrain(2, callback=evaluation, progress_bar=True)
    assert model.env is None and np.isfinite(evaluation.last_mean_reward)
    model.save(tmp_path / "model")
    CausalGDP.load(tmp_path / "model", device="cpu").preload(source).pretrain(1)
    with pytest.raises(ValueError, match="set_env"):
        model.learn(5)
    model.set_env(gym.make("Pendulum-v1"))
    model.learn(10)


def test_dictionaries_are_flattened_for_an_mlp(arrays):
    space = spaces.Dict(angle=spaces.Box(-1.0, 1.0, (2,)), speed=spaces.Box(-8.0, 8.0, (1,)))
    split = dict(arrays)
    for key in ("observations", "next_observations"):
        split[key] = {"angle": arrays[key][:, :2], "speed": arrays[key][:, 2:]}
    source = Described(split, space)
    assert CausalGDP.from_dataset(source, **KWARGS).preload(source).observation_space.shape == (3,)
    assert CausalGDP.from_dataset(source, "MultiInputPolicy", **KWARGS).preload(source).observation_space == space


def test_a_source_that_is_no_array_has_to_tell_its_spaces(arrays):
    class Silent(Source):
        pass

    with pytest.raises(ValueError, match="it does not tell its spaces: give observation_space= and action_space="):
        CausalGDP.from_dataset(Silent("it", 5))


def test_nothing_to_train_on():
    with pytest.raises(ValueError, match="nothing to train on: call preload"):
        make().pretrain(5)


# Online -------------------------------------------------------------------------------------------------------------------


def test_nothing_is_reset_between_the_stages(model):
    model.pretrain(12)
    before, graph, n_updates = [value.clone() for value in states(model)], model.causal_graph(), model._n_updates
    model.learn(4)  # no update yet
    assert_same(before, states(model))
    assert model.causal_graph() == graph and model._n_updates == n_updates
    assert model.offline_buffer.size() == N_ROWS and model.replay_buffer.size() == 4


@pytest.mark.parametrize("pretrain_steps", [0, 2])
def test_only_a_policy_that_was_not_pretrained_starts_with_random_actions(pretrain_steps, arrays, monkeypatch):
    model = make(learning_starts=50).preload(arrays).pretrain(pretrain_steps)
    drawn = []
    sample = model.action_space.sample
    monkeypatch.setattr(model.action_space, "sample", lambda: drawn.append(1) or sample())
    n_updates = model._n_updates
    model.learn(10)
    assert len(drawn) == (0 if pretrain_steps else 10)
    assert model._n_updates == n_updates


def n_offline(model, batch_size=1000):
    """How many rows of a batch were preloaded, by their marked rewards."""
    model.offline_buffer.rewards[:] = 99.0
    return int((model._updates.batches.sample(batch_size).rewards == 99.0).sum())


@pytest.mark.parametrize(("fraction", "expected"), [(0.5, 500), (0.0, 0), (0.25, 250), (1.0, 1000)])
def test_batches_are_made_from_both(fraction, expected, arrays):
    model = make(offline_fraction=fraction).preload(arrays)
    assert n_offline(model) == 1000
    model.learn(8)
    assert n_offline(model) == expected


def test_the_fraction_can_be_annealed(arrays):
    model = make(offline_fraction=lambda remaining: remaining).preload(arrays)
    model.learn(8)
    for remaining in (1.0, 0.4, 0.0):
        model._current_progress_remaining = remaining
        assert n_offline(model) == round(1000 * remaining)


@pytest.mark.parametrize("fraction", [-0.1, 1.5, lambda remaining: 2.0])
def test_a_fraction_outside_of_0_and_1_is_refused(fraction):
    with pytest.raises(ValueError, match=r"offline_fraction must be (between|a number from) 0 (and|to) 1"):
        make(offline_fraction=fraction)


def test_online_transitions_never_overwrite_preloaded_ones(arrays):
    model = make(buffer_size=20).preload(arrays)
    before = model.offline_buffer.observations.copy()
    model.learn(50)
    np.testing.assert_array_equal(model.offline_buffer.observations, before)
    assert model.replay_buffer.full and model.replay_buffer.buffer_size == 20


VARIANTS = {
    "n-step": {"n_steps": 3},
    "memory efficient": {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}},
    "several environments": {"env": lambda: make_vec_env("Pendulum-v1", n_envs=3)},
    "VecNormalize": {"env": lambda: VecNormalize(make_vec_env("Pendulum-v1", n_envs=2))},
}


@pytest.mark.filterwarnings("ignore:The last trajectory in the replay buffer will be truncated")
@pytest.mark.parametrize("variant", VARIANTS)
def test_both_stages_work_with_every_kind_of_buffer(variant, arrays, tmp_path):
    kwargs = dict(VARIANTS[variant])
    env = kwargs.pop("env", lambda: gym.make("Pendulum-v1"))
    model = make(env(), **kwargs).preload(arrays).pretrain(3).learn(30)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CausalGDP.load(tmp_path / "model", env=env(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.offline_buffer.size() == model.offline_buffer.size()
    assert loaded.replay_buffer.size() == model.replay_buffer.size()
    fed = loaded.causal_statistics.n_samples
    loaded.learn(24, reset_num_timesteps=False)
    assert loaded.causal_statistics.n_samples <= fed + 54


@pytest.mark.filterwarnings("ignore:.*trajectory in the replay buffer will be truncated")
def test_hindsight_replay_takes_preloaded_batches_until_an_episode_has_ended(tmp_path):
    first = CausalGDP(
        "MultiInputPolicy", GoalEnv(20), replay_buffer_class=HerReplayBuffer, **{**KWARGS, "learning_starts": 100}
    )
    first.learn(60)
    model = CausalGDP("MultiInputPolicy", GoalEnv(20), replay_buffer_class=HerReplayBuffer, **KWARGS)
    model.preload(first.replay_buffer).pretrain(2).learn(12)
    assert model._n_updates == 2 + 7
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CausalGDP.load(tmp_path / "model", env=GoalEnv(20), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    loaded.learn(30, reset_num_timesteps=False)
    assert loaded.offline_buffer.size() == 60


@pytest.mark.parametrize("learns_from_the_start", [False, True])
def test_hindsight_replay_waits_for_the_end_of_an_episode(learns_from_the_start, tmp_path):
    model = make_hindsight(GoalEnv(20))
    if not learns_from_the_start:
        model.learn(60)
        model.save(tmp_path / "model")
        model = CausalGDP.load(tmp_path / "model", env=GoalEnv(20), device="cpu")
    before = model._n_updates
    with pytest.warns(UserWarning, match="Updates wait: HerReplayBuffer holds no whole episode yet"):
        model.learn(30, reset_num_timesteps=False)
    assert model._n_updates - before == 30 - 20 + 1


def test_hindsight_replay_of_another_number_of_environments_is_put_into_as_many_columns(tmp_path):
    model = make_hindsight(make_vec_env(GoalEnv, 3, env_kwargs={"episode_length": 7}))
    recorded = make_hindsight(GoalEnv(7), learning_starts=100).learn(49)
    model.preload(recorded.replay_buffer).learn(60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = CausalGDP.load(tmp_path / "model", env=GoalEnv(7), device="cpu")
    loaded.load_replay_buffer(tmp_path / "buffer")
    online, offline = loaded.replay_buffer, loaded.offline_buffer
    assert (online.n_envs, online.size(), offline.n_envs, offline.size()) == (1, 60, 1, 51)
    assert (online.ep_length[:60] > 0).all() and online.ep_length.max() == 7
    loaded.learn(20, reset_num_timesteps=False)


# Normalised observations ---------------------------------------------------------------------------------------------------


def normalising(**kwargs):
    return VecNormalize(make_vec_env("Pendulum-v1"), **kwargs)


def test_a_resumed_training_counts_the_dataset_once_in_vec_normalize(npz, tmp_path):
    model = make(env=normalising(), offline_dataset=npz)
    for _ in range(3):
        model.learn(20, reset_num_timesteps=False)
        model.save(tmp_path / "model")
        model.env.save(tmp_path / "normalize.pkl")
        env = VecNormalize.load(tmp_path / "normalize.pkl", make_vec_env("Pendulum-v1"))
        n_counted, returns = env.obs_rms.count, env.ret_rms.count
        model = CausalGDP.load(tmp_path / "model", env=env, device="cpu")
    model.preload(npz)
    assert (env.obs_rms.count, env.ret_rms.count) == (n_counted, returns)
    assert N_ROWS + 60 <= n_counted <= N_ROWS + 70
    # A fresh one has not counted it, and other transitions are others
    fresh = normalising()
    model = CausalGDP.load(tmp_path / "model", env=fresh, device="cpu").preload(npz)
    assert round(fresh.obs_rms.count) == N_ROWS
    model.preload({key: values[:100] for key, values in np.load(npz).items()})
    assert round(fresh.obs_rms.count) == N_ROWS + 100


def test_vec_normalize_that_comes_after_the_dataset_gets_its_statistics(arrays):
    model = CausalGDP.from_dataset(Described(arrays, gym.make("Pendulum-v1").observation_space), **KWARGS)
    model.preload(Described(arrays, gym.make("Pendulum-v1").observation_space))
    before, after = normalising(), normalising()
    make(env=before).preload(arrays)
    model.set_env(after)
    np.testing.assert_array_equal(before.obs_rms.mean, after.obs_rms.mean)
    np.testing.assert_array_equal(before.ret_rms.var, after.ret_rms.var)
    model.set_env(after)
    assert before.obs_rms.count == after.obs_rms.count
    model = make(reward_transform="antmaze").preload(arrays)
    with pytest.raises(ValueError, match="VecNormalize scales the rewards already"):
        model.set_env(normalising())
    model.set_env(normalising(norm_reward=False))


def test_a_policy_that_was_trained_on_raw_observations_is_not_given_normalised_ones(model, tmp_path):
    model.pretrain(3)
    model.save(tmp_path / "model")
    raw = model.env
    message = r"trained on raw observations, and this VecNormalize would give it .* normalised: pass norm_obs=False to it"
    with pytest.raises(ValueError, match=message):
        model.set_env(normalising())
    assert model.env is raw and model._vec_normalize_env is None
    with pytest.raises(ValueError, match=message):
        CausalGDP.load(tmp_path / "model", env=normalising(), device="cpu")
    model.set_env(normalising(norm_obs=False))
    model.learn(20)


@pytest.mark.filterwarnings("error:The policy was trained on")
def test_a_policy_that_was_trained_on_normalised_observations_says_so_where_they_are_raw(arrays, tmp_path):
    model = make(env=normalising()).preload(arrays).pretrain(3)
    model.save(tmp_path / "model")
    for env in (normalising(), None):
        CausalGDP.load(tmp_path / "model", env=env, device="cpu")
    message = r"trained on observations with \['observation'\] normalised, and this environment gives it raw observations"
    for env in (make_vec_env("Pendulum-v1"), normalising(norm_obs=False)):
        with pytest.warns(UserWarning, match=message):
            model.set_env(env)
    with pytest.warns(UserWarning, match=message):
        CausalGDP.load(tmp_path / "model", env=gym.make("Pendulum-v1"), device="cpu")


# From the constructor, as a YAML file says it ----------------------------------------------------------------------


def test_training_starts_with_the_dataset_and_the_offline_stage(npz):
    model = make(offline_dataset=npz, pretrain_steps=6)
    assert model.offline_buffer is None and model._n_updates == 0
    model.learn(4)
    assert model.offline_buffer.size() == N_ROWS
    assert model.n_pretrain_steps == model._n_updates == 6 and model.num_timesteps == 4
    model.learn(4)
    assert model.n_pretrain_steps == 6 and model.offline_buffer.size() == N_ROWS


def test_an_interrupted_offline_stage_does_the_rest(npz):
    model = make(offline_dataset=npz, pretrain_steps=6)
    model.pretrain(6, callback=Counting(stop_at=2))
    model.learn(4)
    assert model.n_pretrain_steps == 6


def test_a_loaded_model_loads_the_dataset_again_only_where_its_buffer_is_empty(npz, tmp_path):
    model = make(offline_dataset=npz, pretrain_steps=6).learn(14)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    for has_buffer in (False, True):
        loaded = CausalGDP.load(tmp_path / "model", env=gym.make("Pendulum-v1"), device="cpu")
        assert loaded.offline_buffer is None and loaded.replay_buffer.size() == 0
        if has_buffer:
            loaded.load_replay_buffer(tmp_path / "buffer")
        fed = loaded.causal_statistics.n_samples
        loaded.learn(10, reset_num_timesteps=False)
        assert loaded.offline_buffer.size() == N_ROWS and loaded._n_pretrain_steps == 6
        assert fed < loaded.causal_statistics.n_samples <= fed + 15


# The two ends ---------------------------------------------------------------------------------------------------------------


def test_behaviour_cloning_does_not_listen_to_the_critics(arrays):
    actors = []
    for scale in (1.0, -100.0):
        model = make(eta=0.0, guidance=None, denoising_weight=1.0).preload(arrays)
        for value in model.critic.parameters():
            value.data *= scale
        model.set_random_seed(1)
        model.pretrain(3)
        actors.append(list(model.actor.parameters()))
    assert_same(*actors)


@pytest.mark.parametrize("eta", [0.0, 1.0])
def test_without_guidance_the_actor_minimises_the_loss_of_diffusion_ql(eta, arrays):
    model = make(eta=eta, guidance=None, denoising_weight=1.0).preload(arrays).pretrain(3)
    assert model.causal_graph().method != "none" and not model.policy.is_guided
    values = model.logger.name_to_value
    expected = values["train/denoising_loss"] + eta * values["train/q_loss"] + 0.1 * values["train/bound_loss"]
    assert values["train/actor_loss"] == pytest.approx(expected, rel=1e-5)


def test_without_guidance_the_world_model_does_not_move_the_actor(arrays):
    actors = []
    for scale in (1.0, -100.0):
        model = make(guidance=None, denoising_weight=1.0).preload(arrays)
        for value in model.world_model.parameters():
            value.data *= scale
        model.set_random_seed(1)
        model.pretrain(3)
        actors.append(list(model.actor.parameters()))
    assert_same(*actors)


@pytest.mark.parametrize("has_learned", [False, True])
def test_a_saved_buffer_brings_its_preloaded_part_wherever_it_is_read(has_learned, arrays, tmp_path):
    model = make(env=make_vec_env("Pendulum-v1", n_envs=2)).preload(arrays)
    if has_learned:
        model.learn(80)
    n_online = 80 if has_learned else 0
    model.save_replay_buffer(tmp_path / "buffer")
    n_preloaded = model.offline_buffer.size() * 2
    other = make().preload(tmp_path / "buffer.npz")
    assert other.offline_buffer.size() == n_preloaded + n_online
    half = n_preloaded // 2
    np.testing.assert_array_equal(other.offline_buffer.actions[:half, 0], model.offline_buffer.actions[:half, 0])
    source = open_causal_source(tmp_path / "buffer.npz")
    rows = np.concatenate(list(source.batches(7)))
    assert source.n_rows == len(rows) == n_preloaded + n_online
    np.testing.assert_array_equal(np.sort(rows[:, -1]), np.sort(other.offline_buffer.rewards[: len(rows), 0]))
