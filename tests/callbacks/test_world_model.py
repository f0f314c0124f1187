import os
import warnings
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from small_models import SMALL
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback
from sb3_causalgdp.causal import CausalGraph, StreamingMoments


class RecordingCallback(CausalWorldModelCallback):
    """Keeps when it refreshed."""

    def __init__(self, **kwargs):
        super().__init__(**{"min_transitions": 20, "diagnostics_batch_size": 8, **kwargs})
        self.refreshes = []

    def refresh(self):
        super().refresh()
        self.refreshes.append(self.model.num_timesteps)


def make(env="Pendulum-v1", **kwargs):
    return CausalGDP("MlpPolicy", env, **{**SMALL, **kwargs})


@pytest.fixture
def active(monkeypatch):
    """The callbacks of ours that saw a step."""
    seen = []
    on_step = CausalWorldModelCallback._on_step

    def spy(self):
        if not any(self is one for one in seen):
            seen.append(self)
        return on_step(self)

    monkeypatch.setattr(CausalWorldModelCallback, "_on_step", spy)
    return seen


# Exactly one is active --------------------------------------------------------------------------------------------------


class CountingCallback(BaseCallback):
    def __init__(self):
        super().__init__()
        self.n_starts = 0

    def _init_callback(self):
        self.n_starts += 1

    def _on_step(self):
        return True


@pytest.mark.parametrize(
    "callback",
    [None, [], CallbackList([]), lambda local, world: True, CountingCallback(), [CountingCallback()]],
    ids=["none", "list", "CallbackList", "function", "other", "list of other"],
)
def test_one_is_added_where_the_user_gives_none(callback, active):
    model = make()
    model.learn(16, callback=callback)
    assert len(active) == 1
    assert model._steps_since_refresh == 16


WRAPPINGS = {
    "bare": lambda own: own,
    "list": lambda own: [CountingCallback(), own],
    "CallbackList": lambda own: CallbackList([own, CountingCallback()]),
    "nested": lambda own: [CallbackList([CountingCallback(), CallbackList([own])])],
    "event": lambda own: EveryNTimesteps(n_steps=20, callback=own),
    "event in a list": lambda own: [CallbackList([EveryNTimesteps(n_steps=20, callback=CallbackList([own]))])],
}


@pytest.mark.parametrize("progress_bar", [False, True])
@pytest.mark.parametrize("wrapping", WRAPPINGS)
def test_the_users_own_replaces_it_wherever_it_is(wrapping, progress_bar, active):
    own = RecordingCallback(refresh_freq=40)
    make().learn(88, callback=WRAPPINGS[wrapping](own), progress_bar=progress_bar)
    assert len(active) == 1 and active[0] is own
    assert own.refreshes == [40, 80]


def test_two_of_them_are_refused():
    with pytest.raises(ValueError, match="At most one CausalWorldModelCallback can be passed, got 2"):
        make().learn(8, callback=[RecordingCallback(), CallbackList([RecordingCallback()])])


def test_other_callbacks_are_set_up_once_and_see_the_new_masks():
    class LookingCallback(CountingCallback):
        graphs = ()

        def _on_step(self):
            if self.num_timesteps in (209, 210):
                self.graphs = (*self.graphs, self.model.causal_graph().method)
            return True

    other = LookingCallback()
    # The default waits for 200 transitions
    make(causal_discovery=all_open, causal_refresh_freq=210, learning_starts=1000).learn(216, callback=CallbackList([other]))
    assert other.n_starts == 1
    assert other.graphs == ("none", "all open")


def all_open(moments, variables, previous=None):
    assert isinstance(moments, StreamingMoments)
    shape = (variables.n_states + 1, variables.n_states + variables.n_actions)
    return CausalGraph(variables, np.ones(shape), np.zeros(shape), "all open", moments.n_samples)


# Schedule ---------------------------------------------------------------------------------------------------------------


def test_the_callbacks_own_arguments_win_over_the_models():
    own = RecordingCallback(refresh_freq=30)
    make(causal_refresh_freq=50).learn(96, callback=own)
    assert own.refreshes == [30, 60, 90]
    own = RecordingCallback()
    make(causal_refresh_freq=50).learn(56, callback=own)
    assert own.refreshes == [50]
    for refresh_freq in (0, -3):
        with pytest.raises(ValueError, match="refresh_freq must be at least 1"):
            CausalWorldModelCallback(refresh_freq=refresh_freq)


def test_the_schedule_goes_on_over_several_calls():
    model, callback = make(train_freq=1, gradient_steps=1, learning_starts=1000), RecordingCallback()
    model.learn(50, callback=callback)
    model.learn(50, callback=callback, reset_num_timesteps=False)
    model.learn(50, callback=RecordingCallback(), reset_num_timesteps=False)
    assert callback.refreshes == [60]
    assert model.causal_graph().num_timesteps == 120
    # A counter that starts again does not start the schedule again: 30 steps have passed since the last refresh
    callback = RecordingCallback()
    model.learn(50, callback=callback)
    assert callback.refreshes == [30]
    # Every transition counts once: 150 of before, 29 of now
    assert model.causal_statistics.n_samples == 179


def test_in_an_event_callback_the_steps_between_the_events_count():
    own = RecordingCallback(refresh_freq=60)
    env = make_vec_env("Pendulum-v1", n_envs=2, seed=0)
    model = make(env=env)
    model.learn(192, callback=EveryNTimesteps(n_steps=50, callback=own))
    # Events after 50, 100 and 150 steps; at the first one only 50 have passed
    assert own.refreshes == [100]
    assert model._steps_since_refresh == 50


def test_an_own_discovery_method_sees_moments_and_the_last_graph_and_its_masks_are_used():
    calls = []

    def discover(moments, variables, previous=None):
        calls.append((moments.n_samples, previous))
        masks = np.full((variables.n_states + 1, variables.n_states + variables.n_actions), 0.25 * len(calls))
        return CausalGraph(variables, masks, np.zeros_like(masks), "own", moments.n_samples)

    model = make(causal_discovery=discover)
    model.learn(128, callback=RecordingCallback())
    assert [n_samples for n_samples, _ in calls] == [59, 119]
    assert calls[0][1] is None and calls[1][1].method == "own"
    assert model.causal_graph().num_timesteps == 120
    assert bool((model.world_model.state_to_state == 0.5).all())


def test_a_window_that_is_too_short_for_the_discovery_is_refused_at_construction():
    with pytest.raises(ValueError, match="window=8 and half_life=None keep as few as 8 rows, and discovery needs 12"):
        make(causal_window=8)
    with pytest.raises(ValueError, match=r"half_life=5\.0 keep as few as 8 rows"):
        make(causal_half_life=5.0)
    make(causal_window=16).learn(128, callback=RecordingCallback())


class ManyNumbers(gym.Env):
    """An observation of 700 numbers, more than the default features have memory for."""

    observation_space = gym.spaces.Box(-9.0, 9.0, (700,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return self.np_random.normal(size=700).astype(np.float32), {}

    def step(self, action):
        return self.np_random.normal(size=700).astype(np.float32), 0.0, False, False, {}


def test_hundreds_of_observations_are_discovered_with_simpler_features_and_the_saved_graph_says_so(tmp_path):
    model = make(env=ManyNumbers(), learning_starts=2_000, buffer_size=2_000, policy_kwargs={"world_model_net_arch": [4, 4]})
    model.learn(1_500, callback=CausalWorldModelCallback(refresh_freq=1_420, min_transitions=1_406))
    assert model.causal_graph().remarks[0].endswith("found with basis='linear'")
    model.save(tmp_path / "model")
    assert CausalGDP.load(tmp_path / "model").causal_graph().remarks == model.causal_graph().remarks


def test_statistics_that_started_anew_wait_for_rows_instead_of_raising(tmp_path):
    """A loaded model without its buffer, whose observations have another scale all at once."""
    model = make()
    model.learn(128, callback=RecordingCallback())
    model.save(tmp_path / "model")
    scaled = gym.wrappers.TransformObservation(gym.make("Pendulum-v1"), lambda observation: 500.0 * observation, None)
    scaled.observation_space = gym.spaces.Box(-np.inf, np.inf, (3,))
    model = CausalGDP.load(tmp_path / "model")
    model.observation_space = scaled.observation_space
    model.set_env(scaled)
    with pytest.warns(UserWarning, match="Causal discovery waits: it has 3 transitions and needs 20"):
        model.learn(6, callback=RecordingCallback(refresh_freq=3), reset_num_timesteps=False)
    assert model.causal_graph().num_timesteps == 129


def test_a_half_life_makes_old_transitions_weigh_less():
    model = make(causal_half_life=20.0)
    model.learn(128, callback=RecordingCallback())
    statistics = model.causal_statistics
    assert statistics.n_samples == 119
    assert 20.0 < statistics.raw.count < 80.0


def test_a_refresh_by_hand():
    model, callback = make(), RecordingCallback()
    model.learn(48)
    assert model.causal_graph().method == "none" and not model.policy.is_guided
    callback.init_callback(model)
    callback.refresh()
    assert model.causal_graph().n_samples == 48 and model.policy.is_guided
    callback.refresh()
    assert model.causal_statistics.n_samples == 48


# What is logged ---------------------------------------------------------------------------------------------------------


TAGS = {
    "causal/change",
    "causal/n_edges",
    "causal/refresh_seconds",
    "guidance/kl",
    "guidance/lipschitz",
    "guidance/step_size",
    "guidance/step_size_bound",
    "policy/candidate_spread",
    "policy/guidance_advantage",
    "policy/q_value",
    "train/actor_loss",
    "train/bound_loss",
    "train/critic_loss",
    "train/denoising_loss",
    "train/learning_rate",
    "train/q_loss",
    "train/world_model_reward_loss",
    "train/world_model_transition_loss",
}


def test_tensorboard_files_hold_causes_and_guidance(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    env = gym.wrappers.TimeLimit(gym.make("Pendulum-v1"), 32)
    model = make(env=env, tensorboard_log=str(tmp_path))
    model.learn(128, callback=RecordingCallback(), log_interval=1)
    model.learn(64, callback=RecordingCallback(), log_interval=1, reset_num_timesteps=False)
    assert os.listdir(tmp_path) == ["CausalGDP_1"]
    model.learn(8, tb_log_name="own_name")
    assert sorted(os.listdir(tmp_path)) == ["CausalGDP_1", "own_name_1"]
    events = accumulator.EventAccumulator(str(tmp_path / "CausalGDP_1"))
    events.Reload()
    assert set(events.Tags()["scalars"]) >= TAGS
    # Written with the end of the episode in which the refresh was
    assert [event.step for event in events.Scalars("causal/n_edges")] == [64, 128, 192]
    for tag in TAGS:
        assert np.isfinite([event.value for event in events.Scalars(tag)]).all(), tag
    assert all(event.value > 0.0 for event in events.Scalars("guidance/kl"))
    assert all(0.0 <= event.value <= 1.0 for event in events.Scalars("causal/change"))


def test_diagnostics_can_be_left_out_and_a_refresh_can_be_printed(capsys):
    model = make()
    model.learn(64, callback=RecordingCallback(diagnostics_batch_size=0, verbose=1))
    names = set(model.logger.name_to_value)
    assert "causal/n_edges" in names and not any(name.startswith(("guidance/", "policy/")) for name in names)
    assert "Causal graph at 60 steps: " in capsys.readouterr().out


def test_without_guidance_there_is_a_graph_and_no_diagnostics_of_guidance():
    model = make(guidance=None)
    model.learn(64, callback=RecordingCallback())
    assert model.causal_graph().num_timesteps == 60
    assert not any(name.startswith("guidance/") for name in model.logger.name_to_value)
    assert model.logger.name_to_value["policy/guidance_advantage"] == 0.0
    assert model.logger.name_to_value["policy/candidate_spread"] > 0.0


def test_diagnostics_leave_the_networks_alone():
    models = [make(learning_starts=1000) for _ in range(2)]
    for model, size in zip(models, (0, 32), strict=True):
        model.learn(64, callback=RecordingCallback(diagnostics_batch_size=size))
    states = [model.policy.state_dict() for model in models]
    assert all(th.equal(value, states[1][name]) for name, value in states[0].items())


# Callbacks of SB3 -------------------------------------------------------------------------------------------------------


def test_evaluation_checkpoints_and_early_stops_work_beside_it(tmp_path):
    stop = StopTrainingOnRewardThreshold(reward_threshold=-1e6)
    evaluation = EvalCallback(
        gym.wrappers.TimeLimit(gym.make("Pendulum-v1"), 10),
        callback_on_new_best=stop,
        best_model_save_path=str(tmp_path / "best"),
        log_path=str(tmp_path),
        eval_freq=72,
        n_eval_episodes=1,
        verbose=0,
        warn=False,
    )
    checkpoint = CheckpointCallback(save_freq=64, save_path=str(tmp_path), save_replay_buffer=True)
    model = make()
    model.learn(200, callback=[RecordingCallback(), evaluation, checkpoint])
    assert model.num_timesteps == 72
    assert (tmp_path / "best" / "best_model.zip").exists() and (tmp_path / "evaluations.npz").exists()
    loaded = CausalGDP.load(tmp_path / "rl_model_64_steps.zip", device="cpu")
    loaded.load_replay_buffer(tmp_path / "rl_model_replay_buffer_64_steps.pkl")
    assert loaded.num_timesteps == 64 and loaded.replay_buffer.pos == 63
    assert loaded.causal_graph().num_timesteps == 60 and loaded.policy.is_guided
    mean, _ = evaluate_policy(CausalGDP.load(tmp_path / "best" / "best_model.zip", device="cpu"), model.env, 1, warn=False)
    assert np.isfinite(mean)


@pytest.mark.parametrize("answer", [False, np.bool_(False)])
def test_a_callback_can_end_training_at_the_first_step(answer):
    model = make()
    model.learn(100, callback=lambda local, world: answer)
    assert model.num_timesteps == 1
    model.learn(100, callback=StopTrainingOnMaxEpisodes(1), reset_num_timesteps=False)
    assert model.num_timesteps <= 202


def test_a_progress_bar(capsys, monkeypatch):
    pytest.importorskip("tqdm")
    pytest.importorskip("rich")
    model = make()
    model.learn(64, callback=RecordingCallback(), progress_bar=True)
    assert model.causal_graph().num_timesteps == 60
    assert "no episode yet" in capsys.readouterr().out
    return_only, everything = (progress_of(model, columns, monkeypatch, capsys) for columns in (80, 200))
    edges = f"{model.causal_graph().n_edges} edges"
    assert "64/64" in return_only and "return -155" in return_only and edges not in return_only
    assert "64/64" in everything and f"return -155, success 50%, {edges}, graph 12 steps old" in everything


def progress_of(model, columns, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", str(columns))
    # Rich's one console may have been made by another test, for its width
    monkeypatch.setattr("rich._console", None)
    model.ep_info_buffer.extend([{"r": -150.0}, {"r": -160.0}])
    model.ep_success_buffer.extend([True, False])
    model.learn(64, callback=RecordingCallback(), progress_bar=True, reset_num_timesteps=False)
    return " ".join(capsys.readouterr().out.split())


def test_the_progress_bar_asks_seldom(monkeypatch):
    pytest.importorskip("rich")
    calls = []
    monkeypatch.setattr(CausalGDP, "progress_parts", lambda self: [str(calls.append(self.num_timesteps))])
    make(learning_starts=1_000).learn(256, progress_bar=True)
    assert calls == [0, 100, 200, 256]


@pytest.mark.parametrize(("kwargs", "warned"), [({}, False), ({"guidance": "score", "guidance_scale": 1e4}, True)])
def test_guidance_that_is_too_steep_for_the_sampler_is_said_once(kwargs, warned):
    model = CausalGDP(
        "MlpPolicy",
        "Pendulum-v1",
        learning_starts=50,
        batch_size=16,
        train_freq=8,
        causal_refresh_freq=50,
        policy_kwargs={"net_arch": [16], "world_model_net_arch": [16, 16]},
        seed=0,
        **kwargs,
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model.learn(170, callback=CausalWorldModelCallback(min_transitions=40))
    assert sum("Proposition 1" in str(one.message) for one in caught) == int(warned)


def test_the_history_spans_the_training_in_a_bounded_number_of_graphs():
    model = make()
    graphs = [replace(model.causal_graph(), method=str(i)) for i in range(200)]
    for graph in graphs:
        model.set_causal_graph(graph)
    history = [int(graph.method) for graph in model.causal_graph_history]
    assert len(history) <= model.GRAPHS_IN_HISTORY
    assert history[-1] == 199 and history[0] == 0 and history == sorted(history)
    assert "causal_graph_history" in model._excluded_save_params()


@pytest.mark.parametrize("method", ["notears", "partial_r2", "world_model"])
def test_the_first_graph_waits_for_as_many_transitions_as_the_method_needs(method):
    """Pendulum has four causes: world_model needs 14 transitions, partial_r2 12 and notears 6."""
    needed = {"notears": 6, "partial_r2": 12, "world_model": 14}[method]
    model = make(causal_discovery=method, learning_starts=100, train_freq=1)
    callback = CausalWorldModelCallback(refresh_freq=1, min_transitions=1, diagnostics_batch_size=0)
    with pytest.warns(UserWarning, match=rf"Causal discovery waits: it has 0 transitions and needs {needed}"):
        model.learn(needed, callback=callback)  # the last transition is stored after the last refresh
    assert model._causal_graph is None
    model.learn(1, callback=callback, reset_num_timesteps=False)
    assert model.causal_graph().n_samples == needed
