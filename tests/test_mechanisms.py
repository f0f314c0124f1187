"""What fails when a mechanism is taken out."""

import numpy as np
import pytest
import torch as th
from small_models import small
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback
from sb3_causalgdp.step_plans import StepPlan

KWARGS = small(learning_starts=50, batch_size=16, train_freq=4, causal_refresh_freq=100)

WITH_TARGET_CRITICS = {**KWARGS, "policy_kwargs": {**KWARGS["policy_kwargs"], "critic_normalization": None}}


class RecordingCallback(CausalWorldModelCallback):
    """Keeps when it refreshed, from how many transitions, and how many were stored by then."""

    def __init__(self):
        super().__init__(min_transitions=50, diagnostics_batch_size=16)
        self.refreshes = []

    def refresh(self):
        super().refresh()
        model = self.model
        n_samples = (model.causal_statistics.n_samples, model.causal_graph().n_samples)
        self.refreshes.append((model.num_timesteps, *n_samples, model.replay_buffer.size()))


def learn(total_timesteps, callback=None, **kwargs):
    model = CausalGDP("MlpPolicy", **{"env": "Pendulum-v1", **KWARGS, **kwargs})
    return model.learn(total_timesteps, callback=callback or RecordingCallback())


@pytest.fixture(scope="module")
def trained():
    callback = RecordingCallback()
    # In Pendulum nearly everything causes everything: the linear method leaves some edges out
    return learn(310, callback, causal_discovery="notears"), callback


@pytest.fixture(scope="module")
def observations():
    angle = np.linspace(-3.0, 3.0, 16)
    return np.stack([np.cos(angle), np.sin(angle), np.linspace(-4.0, 4.0, 16)], axis=1).astype(np.float32)


def predict(model, observations):
    return model.predict(observations, deterministic=True)[0]


# Guidance ---------------------------------------------------------------------------------------------------------------


def test_guidance_changes_what_is_played_once_the_graph_is_known(trained, observations, monkeypatch):
    model, _ = trained
    guided = predict(model, observations)
    np.testing.assert_array_equal(predict(model, observations), guided)
    monkeypatch.setattr(model.policy, "guidance_rule", None)
    assert np.abs(predict(model, observations) - guided).max() > 1e-3


def test_guidance_waits_for_the_graph(observations, monkeypatch):
    model = learn(96)
    assert not model.policy.is_guided
    before = predict(model, observations)
    monkeypatch.setattr(model.policy, "guidance_rule", None)
    np.testing.assert_array_equal(predict(model, observations), before)


def test_too_few_transitions_leave_the_policy_unguided():
    callback = CausalWorldModelCallback(min_transitions=10_000)
    with pytest.warns(UserWarning, match=r"Causal discovery waits: it has \d+ transitions and needs 10000"):
        model = learn(104, callback)
    assert not model.policy.is_guided


def test_guidance_of_scale_zero_trains_as_none_does():
    states = {
        name: learn(140, **kwargs).policy.state_dict()
        for name, kwargs in (
            ("none", {"guidance": None}),
            ("zero", {"guidance_scale": 0.0}),
            ("on", {}),
        )
    }
    trained_parts = ("actor.", "actor_target.", "critic.", "critic_target.", "world_model.")
    for key, value in states["none"].items():
        if key.startswith(trained_parts):
            assert th.equal(states["zero"][key], value), key
    # The comparison sees a guidance that is on
    assert not all(th.equal(states["on"][key], value) for key, value in states["none"].items() if key.startswith("actor."))


def test_guidance_enters_the_actors_loss(trained, monkeypatch):
    model, _ = trained
    data = model.replay_buffer.sample(64)

    def denoising():
        th.manual_seed(0)
        with th.random.fork_rng(), monkeypatch.context() as patch:
            patch.setattr(model._updates, "step", lambda module, gradients: None)
            plan = StepPlan(True, True, model.policy.is_guided, climbed=0, running_weight=0.01)
            return float(model._updates.update_actor(data, data.actions, plan)["denoising_loss"])

    guided = denoising()
    assert denoising() == guided
    monkeypatch.setattr(model.policy, "guidance_rule", None)
    assert denoising() != guided


def test_acting_looks_at_the_value_of_an_action_that_is_adapted_to_the_next_state(observations, monkeypatch):
    policy = CausalGDP("MlpPolicy", "Pendulum-v1", **KWARGS).policy
    state, action, asked = th.as_tensor(observations), th.linspace(-0.5, 0.5, 16).unsqueeze(1), []
    original = policy.value_gradient
    monkeypatch.setattr(policy, "value_gradient", lambda *args: asked.append(args) or original(*args))
    with th.no_grad():
        policy.acting_guidance(state, action)
        ((next_state, next_action, _),) = asked
        th.testing.assert_close(next_state, policy.world_model.action_response(state, action).next_state)
        assert th.equal(next_action, policy.actor.adapt(next_state, action))
        # The denoiser's clean estimate, and so another one in another state
        schedule, step = policy.actor.schedule, policy.actor.adapting_step
        spread, signal = schedule.sqrt_one_minus_alpha_bar[step], schedule.sqrt_alpha_bar[step]
        predicted = policy.actor.denoiser(signal * action, th.full((len(action),), step), next_state)
        th.testing.assert_close(next_action, (action - spread / signal * predicted).clamp(-1.0, 1.0))
        assert not th.allclose(policy.actor.adapt(state.flip(0), action), next_action)


@pytest.mark.parametrize(
    ("noise_schedule", "diffusion_steps"), [("vp", 1), ("vp", 5), ("vp", 100), ("linear", 20), ("cosine", 5)]
)
def test_actions_are_adapted_where_little_noise_is_left(noise_schedule, diffusion_steps):
    model = CausalGDP(
        "MlpPolicy", "Pendulum-v1", noise_schedule=noise_schedule, diffusion_steps=diffusion_steps, buffer_size=1
    )
    actor = model.actor
    noise = [1.0 - alpha_bar for alpha_bar in actor.schedule.alpha_bar_list]
    assert noise[actor.adapting_step] >= 0.1 and all(share < 0.1 for share in noise[: actor.adapting_step])


# Masks ------------------------------------------------------------------------------------------------------------------


def test_masks_change_the_world_models_predictions(trained, observations):
    model, _ = trained
    world = model.world_model
    names = ("state_to_state", "action_to_state", "state_to_reward", "action_to_reward")
    saved = [getattr(world, name).clone() for name in names]
    state, action = th.as_tensor(observations), th.linspace(-1.0, 1.0, 16).unsqueeze(1)
    with th.no_grad():
        world.set_masks(*(th.ones_like(mask) for mask in saved))
        opened = (*world.predict_next_state(state, action), *world.predict_reward(state, action))
        response = world.action_response(state, action)
        assert response.next_state_jacobian.any() and response.reward_jacobian.any()
        world.set_masks(*(th.zeros_like(mask) for mask in saved))
        closed = (*world.predict_next_state(state, action), *world.predict_reward(state, action))
        response = world.action_response(state, action)
        assert not response.next_state_jacobian.any() and not response.reward_jacobian.any()
        world.set_masks(*saved)
    assert not th.allclose(opened[0], closed[0]) and not th.allclose(opened[2], closed[2])


def test_masks_are_those_of_the_graph_and_steer_the_policy(trained, observations):
    model, _ = trained
    graph, world = model.causal_graph(), model.world_model
    names = ("state_to_state", "action_to_state", "state_to_reward", "action_to_reward")
    for name in names:
        np.testing.assert_allclose(getattr(world, name).numpy(), getattr(graph, name), rtol=1e-6)
    # Something was found, and something was left out
    masks = np.concatenate([getattr(graph, name).ravel() for name in names])
    assert 0 < np.count_nonzero(masks) < masks.size
    played = predict(model, observations)
    saved = [getattr(world, name).clone() for name in names]
    world.set_masks(*(th.zeros_like(mask) for mask in saved))
    unsteered = predict(model, observations)
    world.set_masks(*saved)
    assert np.abs(played - unsteered).max() > 1e-3


@pytest.mark.parametrize("sample_masks", [True, False])
def test_the_world_model_trains_on_masks_that_are_drawn_unless_they_shall_scale(sample_masks, monkeypatch):
    model = learn(60, **({} if sample_masks else {"sample_masks": False}))
    world = model.world_model
    names = ("state_to_state", "action_to_state", "state_to_reward", "action_to_reward")
    world.set_masks(*(th.full_like(getattr(world, name), 0.5) for name in names))
    data = model.replay_buffer.sample(16)
    batch = (data.observations, data.actions, data.next_observations, data.rewards.flatten(), None)
    monkeypatch.setattr(world, "update_statistics", lambda *args: None)  # which would change the loss, too
    losses = {model._updates.world_model_gradients(*batch)[0].item() for _ in range(5)}
    assert len(losses) == (5 if sample_masks else 1)


# Refresh ----------------------------------------------------------------------------------------------------------------


def test_refreshes_come_on_time_and_use_every_transition(trained):
    _, callback = trained
    assert [refresh[0] for refresh in callback.refreshes] == [100, 200, 300]
    for timesteps, seen, used, stored in callback.refreshes:
        assert seen == used == stored
        # SB3 stores the transition of a step after it has called the callbacks
        assert timesteps - 1 <= stored <= timesteps


def test_moments_are_those_of_the_replay_buffer(trained):
    model, _ = trained
    buffer, variables = model.replay_buffer, model.transition_variables
    seen = slice(0, model.causal_statistics.n_samples)
    arrays = (buffer.observations, buffer.actions, buffer.next_observations, buffer.rewards)
    rows = variables.stack(*(values[seen, 0] for values in arrays))
    np.testing.assert_allclose(model.causal_statistics.mean, rows.mean(axis=0), rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(model.causal_statistics.covariance(), np.cov(rows.T, ddof=0), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("buffer_size", [60, 99, 100, 101, 150])
def test_a_buffer_that_goes_round_between_refreshes_gives_what_it_has_of_the_new_transitions(buffer_size):
    callback = RecordingCallback()
    learn(320, callback, buffer_size=buffer_size, learning_starts=1000)
    seen = [refresh[1] for refresh in callback.refreshes]
    assert seen[0] == callback.refreshes[0][3]
    assert np.diff(seen).tolist() == [min(100, buffer_size)] * 2


def test_refreshes_count_the_steps_of_all_environments():
    callback = RecordingCallback()
    environments = make_vec_env("Pendulum-v1", n_envs=4, seed=0)
    learn(170, callback, env=environments, causal_refresh_freq=70, learning_starts=1000)
    # The first multiple of four that is at least 70 steps after the last refresh
    assert [refresh[0] for refresh in callback.refreshes] == [72, 144]
    assert [refresh[1] for refresh in callback.refreshes] == [4 * refresh[3] for refresh in callback.refreshes]


# TD target --------------------------------------------------------------------------------------------------------------


@pytest.fixture
def disagreeing():
    """A model whose actor and moving average, and whose critics, have nothing in common."""
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **WITH_TARGET_CRITICS)
    model.target_policy_noise = 0.0
    model._updates.pessimism.fill_(1.0)
    th.manual_seed(0)
    with th.no_grad():
        for module in (model.actor, model.actor_target, model.critic, *model.critic_target.q_networks):
            for parameter in module.parameters():
                parameter.add_(0.5 * th.randn_like(parameter))
    n_rows = 64
    data = ReplayBufferSamples(
        observations=th.randn(n_rows, 3),
        actions=th.rand(n_rows, 1) * 2 - 1,
        next_observations=th.randn(n_rows, 3),
        dones=(th.arange(n_rows) % 4 == 0).float().unsqueeze(1),
        rewards=th.randn(n_rows, 1),
    )
    return model, data


def next_actions_of(actor, data):
    th.manual_seed(7)
    return actor.sample(actor.features(data.next_observations))


@th.no_grad()
def test_td_target_is_the_smallest_target_critic_at_the_moving_averages_action(disagreeing):
    model, data = disagreeing
    th.manual_seed(7)
    next_actions, target = model._updates.bootstrap(data)
    assert th.equal(next_actions, next_actions_of(model.actor_target, data))
    assert not th.allclose(next_actions, next_actions_of(model.actor, data))

    def with_values(values):
        return data.rewards + (1.0 - data.dones) * model.gamma * values

    first, second = model.critic_target(data.next_observations, next_actions)
    th.testing.assert_close(target, with_values(th.minimum(first, second)))
    online = th.minimum(*model.critic(data.next_observations, next_actions))
    for wrong in (first, second, (first + second) / 2, th.maximum(first, second), online):
        assert not th.allclose(target, with_values(wrong))
    ended = data.dones.bool()
    assert th.equal(target[ended], data.rewards[ended])


@th.no_grad()
def test_without_pessimism_the_td_target_is_the_mean_of_the_critics(disagreeing):
    model, data = disagreeing
    model._updates.pessimism.zero_()
    next_actions, target = model._updates.bootstrap(data)
    mean = sum(model.critic_target(data.next_observations, next_actions)) / 2
    th.testing.assert_close(target, data.rewards + (1.0 - data.dones) * model.gamma * mean)


@th.no_grad()
def test_backup_over_several_actions_takes_the_best_of_them(disagreeing):
    model, data = disagreeing
    model.max_q_backup = True
    n_actions = model._updates.N_BACKUP_ACTIONS
    th.manual_seed(7)
    _, target = model._updates.bootstrap(data)
    repeated = data.next_observations.repeat_interleave(n_actions, dim=0)
    th.manual_seed(7)
    actions = model.actor_target.sample(model.actor_target.features(repeated))
    best = [values.view(-1, n_actions).amax(dim=1) for values in model.critic_target(repeated, actions)]
    expected = data.rewards + (1.0 - data.dones) * model.gamma * th.minimum(*best).unsqueeze(1)
    th.testing.assert_close(target, expected)


def test_targets_follow_slowly():
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **WITH_TARGET_CRITICS).learn(60)
    for online, target in ((model.actor, model.actor_target), (model.critic, model.critic_target)):
        before = [parameter.clone() for parameter in target.parameters()]
        model._updates.update_averages()
        for old, new, goal in zip(before, target.parameters(), online.parameters(), strict=True):
            th.testing.assert_close(new, (1.0 - model.tau) * old + model.tau * goal)
        assert any(not th.equal(old, goal) for old, goal in zip(before, online.parameters(), strict=True))


def test_a_gradient_step_trains_actor_critics_and_world_model_and_the_actors_loss_no_critic(trained, monkeypatch):
    model, _ = trained
    data = model.replay_buffer.sample(64)
    modules = {"actor": model.actor, "critic": model.critic, "world_model": model.world_model}

    def changed_by(update):
        before = {name: [p.clone() for p in module.parameters()] for name, module in modules.items()}
        update()
        return {
            name
            for name, module in modules.items()
            if any(not th.equal(old, new) for old, new in zip(before[name], module.parameters(), strict=True))
        }

    plan = StepPlan(True, True, model.policy.is_guided, climbed=0, running_weight=0.01)
    assert changed_by(lambda: model._updates.update_actor(data, data.actions, plan)) == {"actor"}
    assert changed_by(lambda: model._updates.update_critics(data, data.rewards, 0.01)) == {"critic"}
    assert changed_by(lambda: model._updates.update_world_model(data, 0.01)) == {"world_model"}
