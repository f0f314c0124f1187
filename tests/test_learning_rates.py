import io

import numpy as np
import pytest
import torch as th
from small_models import SMALL
from stable_baselines3.common.utils import LinearSchedule

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback

MODULES = ("actor", "critic", "world_model")


def make(**kwargs):
    return CausalGDP("MlpPolicy", "Pendulum-v1", **{**SMALL, **kwargs})


def learn(total_timesteps=80, **kwargs):
    return make(**kwargs).learn(total_timesteps, callback=CausalWorldModelCallback(min_transitions=40))


def rates(model):
    return [getattr(model, name).optimizer.param_groups[0]["lr"] for name in MODULES]


def weights(model):
    return {name: th.cat([p.detach().flatten().clone() for p in getattr(model, name).parameters()]) for name in MODULES}


def halving(start):
    return lambda progress: start * (0.5 + 0.5 * progress)


def test_every_part_has_its_own_rate():
    model = learn(learning_rate=1e-3, critic_learning_rate=2e-3, world_model_learning_rate=3e-3)
    assert rates(model) == [1e-3, 2e-3, 3e-3]


def test_critics_take_the_actors_rate_unless_they_have_one():
    assert rates(learn(learning_rate=7e-4, world_model_learning_rate=3e-3)) == [7e-4, 7e-4, 3e-3]
    model = learn(learning_rate=halving(1e-2), world_model_learning_rate=3e-3)
    assert rates(model)[0] == rates(model)[1] == pytest.approx(5e-3)


@pytest.mark.parametrize("name", ["learning_rate", "critic_learning_rate", "world_model_learning_rate"])
def test_every_rate_can_be_a_schedule(name):
    constant = {"learning_rate": 1e-3, "critic_learning_rate": 2e-3, "world_model_learning_rate": 3e-3}
    model = learn(**{**constant, name: halving(1e-2)})
    expected = dict(zip(constant, rates(model), strict=True))
    assert expected.pop(name) == pytest.approx(5e-3)
    assert expected == {other: rate for other, rate in constant.items() if other != name}
    # Python's own floats: a learning rate of numpy's could not be loaded again
    assert all(type(rate) is float for rate in rates(model))


def test_rates_follow_the_progress_of_training():
    seen = []

    class SpyingGDP(CausalGDP):
        def train(self, gradient_steps, batch_size=8):
            super().train(gradient_steps, batch_size)
            seen.append((self.num_timesteps, *rates(self)))

    schedules = {
        "learning_rate": lambda progress: 1e-3 * progress,
        "critic_learning_rate": lambda progress: np.float64(2e-3) * progress,
        "world_model_learning_rate": lambda progress: 3e-3 * progress,
    }
    model = SpyingGDP("MlpPolicy", "Pendulum-v1", **{**SMALL, **schedules})
    model.learn(80, callback=CausalWorldModelCallback(min_transitions=40))
    assert [steps for steps, *_ in seen] == [24, 32, 40, 48, 56, 64, 72, 80]
    for steps, *now in seen:
        np.testing.assert_allclose(now, [(1 - steps / 80) * start for start in (1e-3, 2e-3, 3e-3)], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "parts"),
    [("learning_rate", {"actor"}), ("critic_learning_rate", {"critic"}), ("world_model_learning_rate", {"world_model"})],
)
def test_a_rate_of_zero_stops_its_part_alone(name, parts):
    constant = {"learning_rate": 1e-3, "critic_learning_rate": 1e-3, "world_model_learning_rate": 1e-3}
    kwargs = {**constant, name: 0.0}
    before = weights(make(**kwargs))
    after = weights(learn(**kwargs))
    assert {part for part in MODULES if th.equal(before[part], after[part])} == parts


def test_the_actors_rate_is_logged():
    assert learn(learning_rate=7e-4).logger.name_to_value["train/learning_rate"] == 7e-4


def test_rates_and_schedules_survive_saving_and_new_ones_take_effect():
    model = learn(learning_rate=halving(1e-3), critic_learning_rate=halving(2e-3), world_model_learning_rate=3e-3)
    stream = io.BytesIO()
    model.save(stream)
    # The functions are pickled
    loaded = CausalGDP.load(stream, env=model.env, device="cpu", trusted=True)
    assert rates(loaded) == rates(model)
    loaded.learn(16)
    np.testing.assert_allclose(rates(loaded), [5e-4, 1e-3, 3e-3])
    stream.seek(0)
    changed = CausalGDP.load(
        stream,
        env=model.env,
        device="cpu",
        trusted=True,
        learning_rate=1e-5,
        custom_objects={"critic_learning_rate": None, "world_model_learning_rate": 2e-5},
    )
    changed.learn(32)
    assert rates(changed) == [1e-5, 1e-5, 2e-5]


@pytest.mark.parametrize("name", ["learning_rate", "critic_learning_rate", "world_model_learning_rate"])
@pytest.mark.parametrize(
    "rate", [-1e-3, float("inf"), float("nan"), lambda progress: -progress], ids=["negative", "infinite", "nan", "schedule"]
)
def test_rates_that_make_no_sense_are_refused_at_once(name, rate):
    with pytest.raises(ValueError, match=f"^{name} must be a number from 0 to "):
        make(**{name: rate})


def test_exploration_noise_follows_its_schedule(tmp_path):
    model = make(exploration_noise=LinearSchedule(0.4, 0.1, 1.0))
    assert model.policy.exploration_noise == pytest.approx(0.4)
    model.learn(80)
    assert model.policy.exploration_noise == pytest.approx(0.1, abs=0.04)
    model.save(tmp_path / "model.zip")
    assert CausalGDP.load(tmp_path / "model.zip").exploration_noise(1.0) == pytest.approx(0.4)


def test_a_number_for_the_exploration_noise_leaves_the_policy_s_own_alone():
    model = make(exploration_noise=0.3)
    model.policy.exploration_noise = 0.05
    assert model.learn(80).policy.exploration_noise == 0.05
