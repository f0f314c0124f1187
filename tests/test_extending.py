"""Parts of one's own: those of docs/guide/extending.md, used."""

import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from small_models import SMALL

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback, causal, diffusion
from sb3_causalgdp.checks import register
from sb3_causalgdp.diffusion.plans import SAMPLERS, sampling_plan
from sb3_causalgdp.diffusion.schedules import NoiseSchedule

PAGE = (Path(__file__).parents[1] / "docs" / "guide" / "extending.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


pytestmark = pytest.mark.usefixtures("registries")


@pytest.fixture
def page(monkeypatch):
    """What the page defines, with trainings that end at once."""
    monkeypatch.setattr(CausalGDP, "learn", lambda self, *args, **kwargs: self)
    namespace: dict = {}
    for block in BLOCKS:
        exec(block, namespace)
    monkeypatch.undo()
    return namespace


def learned(model_class=CausalGDP, policy="MlpPolicy", policy_kwargs=None, **kwargs):
    policy_kwargs = {**SMALL["policy_kwargs"], **(policy_kwargs or {})}
    model = model_class(policy, "Pendulum-v1", **{**SMALL, **kwargs, "policy_kwargs": policy_kwargs})
    return model.learn(128, callback=CausalWorldModelCallback(min_transitions=40))


def test_examples_are_short():
    assert len(BLOCKS) == 6
    assert max(block.count("\n") for block in BLOCKS) <= 25


def test_a_discovery_method_finds_the_graph(page):
    model = learned(causal_discovery="correlation", causal_discovery_kwargs={"threshold": 0.9})
    assert model.causal_graph().method == "correlation"
    assert set(np.unique(model.causal_graph().masks)) == {0.0, 1.0}


def test_what_is_wished_for_moves_the_actions(page):
    model = learned(guidance_target="slow", outcome_guidance_scale=1e3, state_guidance_scale=0.0, n_action_candidates=1)
    assert model.policy.is_guided
    observation = np.array([[1.0, 0.0, 6.0], [1.0, 0.0, -6.0]], np.float32)
    guided, _ = model.predict(observation, deterministic=True)
    model.policy.guidance_ready.zero_()
    plain, _ = model.predict(observation, deterministic=True)
    speeds = []
    for actions in (guided, plain):
        scaled = th.as_tensor(actions / 2.0)
        speeds.append(model.policy.world_model.predict_next_state(th.as_tensor(observation), scaled)[0][:, 2].abs())
    assert (speeds[0] < speeds[1]).all()


def test_a_denoiser_by_name(page):
    denoiser = learned(policy_kwargs={"denoiser": "small", "denoiser_kwargs": {"width": 16}}).actor.denoiser
    assert type(denoiser) is page["SmallDenoiser"] and denoiser.network[0].out_features == 16


def test_a_sampler_by_name(page):
    schedule = NoiseSchedule("vp", 5)
    for own, known in zip(sampling_plan(schedule, "noiseless"), sampling_plan(schedule, "ddim"), strict=True):
        np.testing.assert_allclose(own, known, atol=1e-12)
    observation = gym.make("Pendulum-v1").observation_space.sample()
    actions = [learned(sampler=name).predict(observation, deterministic=True)[0] for name in ("noiseless", "ddim")]
    np.testing.assert_allclose(*actions, atol=1e-3)


def test_a_noise_schedule_by_name():
    diffusion.register_noise_schedule("constant", lambda n_steps: th.full((n_steps,), 0.5))
    model = learned(noise_schedule="constant")
    np.testing.assert_allclose(
        model.actor.schedule.alpha_bar.numpy(), 0.5 ** np.arange(1, len(model.actor.schedule.alpha_bar) + 1)
    )


def test_a_loss_by_class(page):
    plain, cautious = learned(), learned(page["CautiousCausalGDP"])
    first, second = next(plain.actor.parameters()), next(cautious.actor.parameters())
    assert not th.equal(first, second)


def test_a_critic_by_class(page):
    model = learned(policy=page["DroppingPolicy"])
    layers = list(model.critic.q_networks[0])
    n_dropouts, n_linear = (sum(isinstance(layer, kind) for layer in layers) for kind in (th.nn.Dropout, th.nn.Linear))
    assert n_dropouts == n_linear - 1 == 1
    observation = np.zeros((1, 3), np.float32)
    np.testing.assert_array_equal(*(model.predict(observation, deterministic=True)[0] for _ in range(2)))


def test_a_model_is_loaded_where_its_names_are_registered(page, tmp_path):
    model = learned(sampler="noiseless")
    model.save(tmp_path / "model")
    observation = np.zeros((1, 3), np.float32)
    loaded = CausalGDP.load(tmp_path / "model")
    np.testing.assert_array_equal(*(one.predict(observation, deterministic=True)[0] for one in (model, loaded)))
    del SAMPLERS["noiseless"]
    with pytest.raises(ValueError, match=r"sampler must be one of .*, got 'noiseless'"):
        CausalGDP.load(tmp_path / "model")


@pytest.mark.parametrize(
    ("register_one", "argument", "what"),
    [
        (causal.register_discovery_method, "causal_discovery", "discovery method"),
        (causal.register_guidance_target, "guidance_target", "guidance target"),
        (diffusion.register_sampler, "sampler", "sampler"),
        (diffusion.register_noise_schedule, "noise_schedule", "noise schedule"),
        (diffusion.register_denoiser, "denoiser", "denoiser"),
    ],
)
def test_names_are_told_and_taken_once(register_one, argument, what):
    def entry():
        raise AssertionError

    register_one("mine", entry)
    # The same again, as a notebook's cell does it, is the same
    register_one("mine", entry)
    with pytest.raises(ValueError, match=f"there is a {what} 'mine' already"):
        register_one("mine", lambda: None)
    with pytest.raises(ValueError, match="name must be an identifier such as"):
        register_one("my own", entry)
    given = {"policy_kwargs": {argument: "other"}} if argument == "denoiser" else {argument: "other"}
    with pytest.raises(ValueError, match=rf"{argument} must be one of \[.*'mine'.*\].*, got 'other'"):
        CausalGDP("MlpPolicy", "Pendulum-v1", **given)


def test_a_built_in_name_cannot_be_taken():
    names = {"ddpm": max}
    with pytest.raises(ValueError, match="name must be new: there is a sampler 'ddpm' already"):
        register(names, "ddpm", min, "sampler")
