"""Critics that normalise batches, standardised observations, denoisers that predict the velocity."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import SMALL
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from torch import nn

from sb3_causalgdp import CausalGDP, MlpPolicy
from sb3_causalgdp.diffusion import MLPDenoiser, NoiseSchedule
from sb3_causalgdp.extractors import StandardizedExtractor
from sb3_causalgdp.losses import critic_loss, td_target


def make_model(**kwargs):
    return CausalGDP("MlpPolicy", "Pendulum-v1", **{**SMALL, **kwargs})


def samples(n_rows=64):
    generator = th.Generator().manual_seed(0)
    return ReplayBufferSamples(
        observations=th.randn(n_rows, 3, generator=generator),
        actions=th.rand(n_rows, 1, generator=generator) * 2 - 1,
        next_observations=3.0 + th.randn(n_rows, 3, generator=generator),
        dones=(th.arange(n_rows) % 4 == 0).float().unsqueeze(1),
        rewards=th.randn(n_rows, 1, generator=generator),
    )


def batch_norms(module):
    return [one for one in module.modules() if isinstance(one, nn.BatchNorm1d)]


# Critics that normalise batches -----------------------------------------------------------------------------------------


def test_both_actions_are_judged_in_one_batch_and_the_second_is_the_target_of_the_first():
    model, data = make_model(), samples()
    next_actions = th.linspace(-1.0, 1.0, 64).unsqueeze(1)
    both = th.cat([data.observations, data.next_observations]), th.cat([data.actions, next_actions])
    with th.no_grad(), model.critic.batch_statistics():
        # Neither is what it would be without the other
        values = [of_one.split(64) for of_one in model.critic(*both)]
        alone = model.critic(data.observations, data.actions)
    target = td_target(
        [second for _, second in values], data.rewards, data.dones, model.gamma, pessimism=model._updates.pessimism
    )
    expected = critic_loss([first for first, _ in values], target)
    with model.critic.batch_statistics():
        _, loss, gradients = model._updates.critic_gradients(data, next_actions)
    th.testing.assert_close(loss, expected)
    assert not any(th.allclose(first, one, atol=1e-3) for (first, _), one in zip(values, alone, strict=True))
    # The target is no function of the parameters: its gradient would be another one
    assert all(gradient is not None for gradient in gradients)
    with model.critic.batch_statistics():
        q, next_q = model.critic.forward_both(data.observations, data.actions, data.next_observations, next_actions)
    assert all(value.requires_grad for value in q) and not any(value.requires_grad for value in next_q)


def test_running_averages_move_when_critics_are_trained_and_at_no_other_time():
    model = make_model().learn(60)
    norms = batch_norms(model.critic)
    assert len(norms) == 2 * 2  # two critics of one hidden layer
    model.policy.set_training_mode(True)
    assert not any(norm.training for norm in norms)

    def moved_by(update):
        before = [norm.running_mean.clone() for norm in norms]
        update()
        return any(not th.equal(old, norm.running_mean) for old, norm in zip(before, norms, strict=True))

    data = samples()
    plan = model._updates._next_plan(False)
    assert moved_by(lambda: model._updates.update_critics(data, data.actions, 0.5))
    assert not moved_by(lambda: model._updates.update_actor(data, data.actions, plan))
    assert not moved_by(lambda: model.predict(np.zeros((4, 3), dtype=np.float32)))


def test_an_error_within_an_update_leaves_no_critic_on_batch_statistics():
    model = make_model()
    with pytest.raises(KeyboardInterrupt), model.critic.batch_statistics():
        raise KeyboardInterrupt
    assert not any(norm.training for norm in batch_norms(model.critic))


def test_critics_that_normalise_batches_are_their_own_targets():
    model = make_model(target_policy_noise=0.0).learn(60)
    assert model.critic_target is model.critic
    data = samples()
    th.manual_seed(3)
    next_actions, judged = model._updates.bootstrap(data)
    th.manual_seed(3)
    assert th.equal(next_actions, model.actor.sample(model.actor.features(data.next_observations)))
    assert th.equal(judged, next_actions)
    before = [parameter.clone() for parameter in model.critic.parameters()]
    statistics = [norm.running_mean.clone() for norm in batch_norms(model.critic)]
    model._updates.update_averages()
    assert all(th.equal(old, new) for old, new in zip(before, model.critic.parameters(), strict=True))
    assert all(th.equal(old, new.running_mean) for old, new in zip(statistics, batch_norms(model.critic), strict=True))


@pytest.mark.parametrize("normalization", ["layer", None])
def test_other_critics_have_targets(normalization):
    model = make_model(policy_kwargs={**SMALL["policy_kwargs"], "critic_normalization": normalization})
    assert model.critic_target is not model.critic
    assert batch_norms(model.critic) == []


def test_a_backup_over_many_actions_needs_target_critics():
    with pytest.raises(ValueError, match="max_q_backup must be False without target critics"):
        make_model(max_q_backup=True)


# Targets' noise ---------------------------------------------------------------------------------------------------------


def test_targets_have_clipped_noise():
    model = make_model(target_policy_noise=10.0, target_noise_clip=0.1)
    actions = th.linspace(-1.0, 1.0, 200).unsqueeze(1)
    moved = model._updates.smoothed(actions) - actions
    assert moved.abs().max() <= 0.1 + 1e-6 and moved.abs().mean() > 0.05
    assert (model._updates.smoothed(actions).abs() <= 1.0).all()


# Standardised observations ----------------------------------------------------------------------------------------------


def test_actor_and_critics_see_standardised_observations():
    model = make_model().learn(100)
    world_model = model.world_model
    state = th.tensor([[0.3, -0.2, 5.0]])
    expected = (state - world_model.state_mean) / world_model.state_std
    assert not th.allclose(expected, state, atol=0.1)
    for network in (model.actor, model.actor_target, model.critic):
        assert isinstance(network.features_extractor, StandardizedExtractor)
        th.testing.assert_close(network.extract_features(state, network.features_extractor), expected)


def test_far_observations_are_cut():
    extractor = make_model().actor.features_extractor
    assert extractor(th.tensor([[1e9, -1e9, 1.0]])).tolist() == [[10.0, -10.0, 1.0]]


def test_observations_stay_as_they_are_when_asked_and_with_an_extractor_of_ones_own():
    kwargs = {**SMALL["policy_kwargs"], "normalize_observations": False}
    assert not make_model(policy_kwargs=kwargs).actor.features_extractor.standardizes
    plain = make_model(policy_kwargs=kwargs, causal_abstraction=False)
    assert not isinstance(plain.actor.features_extractor, StandardizedExtractor)


def test_statistics_survive_save_and_load(tmp_path):
    model = make_model().learn(100)
    model.save(tmp_path / "model.zip")
    loaded = CausalGDP.load(tmp_path / "model.zip")
    assert th.equal(loaded.actor.features_extractor.mean, model.actor.features_extractor.mean)
    model.policy.save(tmp_path / "policy.pt")
    observations = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    expected = model.predict(observations, deterministic=True)[0]
    for other in (loaded, MlpPolicy.load(tmp_path / "policy.pt")):
        np.testing.assert_array_equal(other.predict(observations, deterministic=True)[0], expected)


def test_statistics_that_are_not_finite_are_found():
    model = make_model().learn(60)
    model.actor.features_extractor.inverse_std.fill_(float("inf"))
    assert model.policy.first_not_finite()[0] == "policy.actor.features_extractor.inverse_std"


def test_dictionaries_of_vectors_are_standardised_too():
    space = spaces.Dict({"b": spaces.Box(-1.0, 1.0, (2,)), "a": spaces.Box(-1.0, 1.0, (1,))})
    policy = CausalGDP.policy_aliases["MultiInputPolicy"](space, spaces.Box(-1.0, 1.0, (1,)), lambda _: 1e-3)
    policy.world_model.state_mean.copy_(th.arange(3.0))
    policy.update_observation_statistics()
    observation = {key: th.zeros(1, *space[key].shape) for key in space.spaces}
    assert policy.actor.features(observation).tolist() == [[0.0, -1.0, -2.0]]


# Velocity ---------------------------------------------------------------------------------------------------------------


def test_a_velocity_gives_the_noise_and_the_clean_action():
    schedule = NoiseSchedule("vp", 5)
    denoiser = MLPDenoiser(2, 3, 5, [8], alpha_bar=schedule.alpha_bar)
    noise, clean, condition = th.randn(50, 2), th.rand(50, 2) * 2 - 1, th.randn(50, 3)
    step = th.arange(50) % 5
    signal, spread = schedule.alpha_bar[step].sqrt()[:, None], (1.0 - schedule.alpha_bar[step]).sqrt()[:, None]
    velocity = signal * noise - spread * clean
    denoiser.network = nn.Sequential(Constant(velocity))
    noisy = schedule.add_noise(clean, noise, step)
    predicted = denoiser(noisy, step, condition)
    th.testing.assert_close(predicted, noise, rtol=1e-4, atol=1e-5)
    th.testing.assert_close(schedule.clean_estimate(noisy, predicted, step), clean, rtol=1e-4, atol=1e-4)


def test_what_a_velocity_says_of_clean_actions_is_of_one_size_at_all_steps():
    schedule = NoiseSchedule("vp", 5)
    sizes = {}
    for name, alpha_bar in (("velocity", schedule.alpha_bar), ("noise", None)):
        denoiser, sizes[name] = MLPDenoiser(1, 1, 5, [8], alpha_bar=alpha_bar), []
        for step in range(5):
            output = th.zeros(1, 1, requires_grad=True)
            denoiser.network = nn.Sequential(Constant(output))
            noisy = th.zeros(1, 1)
            index = th.tensor([step])
            clean = schedule.clean_estimate(noisy, denoiser(noisy, index, th.zeros(1, 1)), index)
            sizes[name].append(abs(float(th.autograd.grad(clean.sum(), output)[0])))
    assert max(sizes["velocity"]) <= 1.0 and max(sizes["noise"]) > 10.0


class Constant(nn.Module):
    def __init__(self, value):
        super().__init__()
        self.value = value

    def forward(self, _):
        return self.value
