import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import SAC
from stable_baselines3.common.logger import CSVOutputFormat, configure
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

pytest.importorskip("matplotlib")
from matplotlib.image import imread
from small_models import SMALL

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback
from sb3_causalgdp.callbacks.diagnostics import guidance_divergence, step_divergences
from sb3_causalgdp.callbacks.pictures import CausalPicturesCallback, draw_transitions, plot_guidance_strength, policy_input

KWARGS = {**SMALL, "diffusion_steps": 3}
NAMES = ("effects", "graph", "guidance")


def make(env="Pendulum-v1", **kwargs):
    return CausalGDP("MlpPolicy", env, **{**KWARGS, **kwargs})


def early():
    """The graph is found from as few transitions as there are."""
    return CausalWorldModelCallback(min_transitions=20, diagnostics_batch_size=0)


def files(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


@pytest.fixture
def drawn(monkeypatch):
    """At which steps pictures were drawn, without drawing them."""
    steps = []
    monkeypatch.setattr(CausalPicturesCallback, "draw", lambda self: steps.append(self.num_timesteps))
    return steps


@pytest.mark.parametrize(("save_freq", "expected"), [(30, [60, 90, 120]), (50, [60, 110]), (100, [100])])
def test_pictures_start_with_the_first_graph_and_come_every_so_many_steps(save_freq, expected, drawn, tmp_path):
    make(learning_starts=1000).learn(128, callback=[early(), CausalPicturesCallback(save_freq, tmp_path)])
    assert drawn == expected


def test_the_schedule_goes_on_in_a_second_call(drawn, tmp_path):
    model, callback = make(learning_starts=1000), CausalPicturesCallback(60, tmp_path)
    model.learn(72, callback=[early(), callback])
    model.learn(72, callback=[early(), callback], reset_num_timesteps=False)
    assert drawn == [60, 132]


def test_files_and_tensorboard_hold_every_picture(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    env = gym.wrappers.TimeLimit(gym.make("Pendulum-v1"), 32)
    model = make(env, tensorboard_log=str(tmp_path / "logs"))
    model.learn(64, callback=[early(), CausalPicturesCallback(60, tmp_path / "pictures")], log_interval=1)
    assert files(tmp_path / "pictures") == [f"{name}_60_steps.png" for name in NAMES]
    for path in (tmp_path / "pictures").iterdir():
        assert imread(path)[..., :3].std() > 0.01, path
    events = accumulator.EventAccumulator(str(tmp_path / "logs" / "CausalGDP_1"))
    events.Reload()
    assert sorted(events.Tags()["images"]) == [f"pictures/{name}" for name in NAMES]
    assert [event.step for event in events.Images("pictures/guidance")] == [64]


def test_tensorboard_has_pictures_without_asking_for_them(tmp_path, monkeypatch):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    monkeypatch.setattr(CausalPicturesCallback, "EXPECTED_SECONDS", 0.0)
    env = gym.wrappers.TimeLimit(gym.make("Pendulum-v1"), 32)
    model = make(env, tensorboard_log=str(tmp_path))
    model.learn(64, callback=early(), log_interval=1)
    events = accumulator.EventAccumulator(str(tmp_path / "CausalGDP_1"))
    events.Reload()
    assert sorted(events.Tags()["images"]) == [f"pictures/{name}" for name in NAMES]
    plain = make(env)
    plain.learn(64, callback=early(), log_interval=1)
    states = [one.policy.state_dict() for one in (model, plain)]
    assert all(th.equal(value, states[1][name]) for name, value in states[0].items())


def test_nothing_is_drawn_where_there_is_no_tensorboard_and_beside_own_pictures(drawn, tmp_path):
    pytest.importorskip("tensorboard")
    make(learning_starts=1000).learn(64, callback=early())
    make(learning_starts=1000, tensorboard_log=str(tmp_path)).learn(64, callback=[early(), CausalPicturesCallback(10_000)])
    assert drawn == []


def test_a_budget_is_kept(monkeypatch, tmp_path):
    now, times = [0.0], []

    def draw(self):
        times.append(now[0])
        self._expected = 0.5
        self._seconds += 0.5

    monkeypatch.setattr("sb3_causalgdp.callbacks.pictures.time.perf_counter", lambda: now[0])
    monkeypatch.setattr(CausalPicturesCallback, "draw", draw)
    callback = CausalPicturesCallback(1, tmp_path, budget=0.01)
    callback.model = make()
    callback.model._causal_graph = callback.model.causal_graph()
    callback._on_training_start()
    for second in range(400):
        now[0], callback.num_timesteps = float(second), second
        callback._on_step()
    # A second is expected of the first, half a second of the others
    assert times == [100.0, 101.0, 150.0, 200.0, 250.0, 300.0, 350.0]
    assert 0.5 * len(times) <= 0.01 * 400


@pytest.mark.parametrize("budget", [0.0, -0.1, 1.5])
def test_a_budget_is_a_share(budget):
    with pytest.raises(ValueError, match="budget must be a share above 0 and up to 1"):
        CausalPicturesCallback(budget=budget)


def test_text_logs_work_beside_the_pictures(tmp_path):
    model = make(gym.wrappers.TimeLimit(gym.make("Pendulum-v1"), 32))
    model.set_logger(configure(str(tmp_path / "logs"), ["stdout", "log", "json", "csv"]))
    model.learn(64, callback=[early(), CausalPicturesCallback(60, tmp_path / "pictures")], log_interval=1)
    assert len(files(tmp_path / "pictures")) == 3
    assert all("pictures" not in path.read_text() for path in (tmp_path / "logs").iterdir())


def test_without_a_place_for_them_nothing_is_drawn_and_that_is_said(drawn):
    model = make(learning_starts=1000)
    with pytest.warns(UserWarning, match="draws nothing: give it a folder, or the model a tensorboard_log"):
        model.learn(64, callback=[early(), CausalPicturesCallback(10)])
    assert drawn == []
    assert not any(not isinstance(one, CSVOutputFormat) for one in model.logger.output_formats)


def test_the_training_is_the_same_with_and_without_pictures(tmp_path):
    models = []
    for callbacks in ([early()], [early(), CausalPicturesCallback(60, tmp_path, batch_size=8)]):
        models.append(make().learn(112, callback=callbacks))
    assert files(tmp_path) == [f"{name}_60_steps.png" for name in NAMES]
    expected, given = (model.policy.state_dict() for model in models)
    assert all(th.equal(value, given[name]) for name, value in expected.items())
    assert np.array_equal(models[0].replay_buffer.actions, models[1].replay_buffer.actions)


def test_the_offline_stage_is_the_same_too_and_has_a_folder_of_its_own(tmp_path):
    online = make()
    online.learn(64, callback=early())
    online.save_replay_buffer(tmp_path / "buffer.pkl")
    states = []
    for callbacks in ([early()], [early(), CausalPicturesCallback(4, tmp_path / "pictures", batch_size=8)]):
        model = make(causal_refresh_freq=3)
        model.preload(str(tmp_path / "buffer.pkl"))
        model.pretrain(6, callback=callbacks)
        assert model.policy.training
        states.append(model.policy.state_dict())
    assert files(tmp_path / "pictures") == [f"offline/{name}_4_steps.png" for name in NAMES]
    assert all(th.equal(value, states[1][name]) for name, value in states[0].items())


def test_what_is_not_there_is_not_drawn(tmp_path):
    make(learning_starts=1000).learn(64, callback=[early(), CausalPicturesCallback(60, tmp_path / "untrained")])
    assert files(tmp_path / "untrained") == ["graph_60_steps.png", "guidance_60_steps.png"]
    make(guidance=None).learn(64, callback=[early(), CausalPicturesCallback(60, tmp_path / "unguided")])
    assert files(tmp_path / "unguided") == ["effects_60_steps.png", "graph_60_steps.png"]


def test_dictionaries_and_normalisation(tmp_path):
    env = VecNormalize(DummyVecEnv([lambda: DictPendulum(gym.make("Pendulum-v1"))] * 2))
    model = CausalGDP("MultiInputPolicy", env, **KWARGS)
    model.learn(64, callback=[early(), CausalPicturesCallback(60, tmp_path)])
    assert files(tmp_path) == [f"{name}_60_steps.png" for name in NAMES]
    observations, actions = draw_transitions(model.replay_buffer, model.policy, 16)
    stored = model.replay_buffer.observations["b"].reshape(-1, 2)
    assert all((stored == row).all(axis=1).any() for row in observations["b"])
    assert actions.shape == (16, 1) and 1.0 < np.abs(actions).max() <= 2.0
    # At most what the buffer holds, each of it once
    everything = draw_transitions(model.replay_buffer, model.policy, 1000)[0]["b"]
    assert np.array_equal(np.sort(everything, axis=0), np.sort(stored[:64], axis=0))
    given = policy_input(model, observations)
    assert np.allclose(given["b"].numpy(), env.normalize_obs(observations)["b"])


class DictPendulum(gym.ObservationWrapper):
    def __init__(self, env):
        super().__init__(env)
        low, high = env.observation_space.low, env.observation_space.high
        parts = {"a": gym.spaces.Box(low[:1], high[:1]), "b": gym.spaces.Box(low[1:], high[1:])}
        self.observation_space = gym.spaces.Dict(parts)

    def observation(self, observation):
        return {"a": observation[:1], "b": observation[1:]}


def test_step_divergences_add_up_to_the_divergence_of_the_chain():
    model = make()
    model.learn(64, callback=early())
    observations = th.as_tensor(model.replay_buffer.observations[:16, 0])
    th.manual_seed(0)
    steps = step_divergences(model.policy, observations)
    th.manual_seed(0)
    whole = guidance_divergence(model.policy, observations)
    assert steps.shape == (3, 16) and bool((steps >= 0.0).all())
    assert float(steps.mean(dim=1).sum()) == pytest.approx(whole, rel=1e-5) and whole > 0.0


def test_the_bars_stand_over_their_diffusion_steps():
    figure = plot_guidance_strength(np.array([[0.0, 0.0], [1.0, 3.0], [4.0, 4.0]]))
    heights = {round(bar.get_x() + bar.get_width() / 2): bar.get_height() for bar in figure.axes[0].patches}
    assert heights == {3: 0.0, 2: 2.0, 1: 4.0}
    assert "6 in all" in figure.axes[0].get_title()


@pytest.mark.parametrize("arguments", [{"save_freq": 0}, {"batch_size": -1}])
def test_numbers_below_one_are_refused(arguments):
    with pytest.raises(ValueError, match=rf"{next(iter(arguments))} must be at least 1, got"):
        CausalPicturesCallback(**arguments)


def test_another_algorithm_is_refused(tmp_path):
    model = SAC("MlpPolicy", "Pendulum-v1", device="cpu", buffer_size=10, policy_kwargs={"net_arch": [4]})
    with pytest.raises(TypeError, match="CausalPicturesCallback draws a CausalGDP, got SAC"):
        model.learn(1, callback=CausalPicturesCallback(folder=tmp_path))


def test_the_picture_of_the_graph_takes_a_view(tmp_path):
    model = make()
    callback = CausalPicturesCallback(60, tmp_path, kind="graph", view={"causes": 1, "size": (4.0, 3.0)})
    model.learn(64, callback=[early(), callback])
    assert imread(tmp_path / "graph_60_steps.png").shape[:2] == (360, 480)
    with pytest.raises(ValueError, match="causes must be an integer of at least 1, got 0"):
        CausalPicturesCallback(view={"causes": 0})
    with pytest.raises(ValueError, match="kind must be one of"):
        CausalPicturesCallback(kind="pie")
