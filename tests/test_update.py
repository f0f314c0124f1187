"""The fast parts of an update do what the plain ones do."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from compiling import compile_for_tests
from small_models import small
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.batches import Batches
from sb3_causalgdp.diffusion.bounds import bounded
from sb3_causalgdp.losses import denoising_loss
from sb3_causalgdp.networks import q_values
from sb3_causalgdp.offline.replay import deal_rows, rows_of

KWARGS = small({"net_arch": [16, 16]}, learning_starts=210, causal_refresh_freq=205, batch_size=32, train_freq=1)


AS_THEY_ARE = {"critic_normalization": None, "normalize_observations": False}


def trained_model(policy="MlpPolicy", env="Pendulum-v1", **kwargs):
    """A model whose guidance is on, just before its next gradient step."""
    model = CausalGDP(policy, env, **{**KWARGS, **kwargs})
    model.learn(215)
    assert model.policy.is_guided is (kwargs.get("guidance", "posterior") is not None)
    model.policy.set_training_mode(True)
    return model


def dictionary_pendulum():
    """Pendulum, whose observations are a dictionary of vectors."""
    space = gym.spaces.Dict({"pole": gym.spaces.Box(-1.0, 1.0, (2,)), "speed": gym.spaces.Box(-8.0, 8.0, (1,))})
    return gym.wrappers.TransformObservation(gym.make("Pendulum-v1"), lambda x: {"pole": x[:2], "speed": x[2:]}, space)


# The value that the guidance climbs ------------------------------------------------------------------------------------


def test_the_guidance_in_the_loss_climbs_one_critic_and_in_acting_the_smallest():
    policy = trained_model(policy_kwargs={**KWARGS["policy_kwargs"], **AS_THEY_ARE}).policy
    states, actions = th.randn(64, 3), th.rand(64, 1) * 2.0 - 1.0

    def gradients(value):
        leaf = states.clone().requires_grad_()
        return th.autograd.grad(value(q_values(policy.critic_target, leaf, actions)).sum(), leaf)[0]

    first, second = (gradients(lambda values, i=i: values[i]) for i in (0, 1))
    smallest = gradients(lambda values: th.minimum(*values))
    assert not th.allclose(first, smallest) and not th.allclose(second, smallest)
    th.testing.assert_close(policy.value_gradient(states, actions, critic=0), first)
    th.testing.assert_close(policy.value_gradient(states, actions, critic=1), second)
    th.testing.assert_close(policy.value_gradient(states, actions), smallest)


# Delayed updates --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy_delay, world_model_delay", [(1, 1), (2, 3), (3, 2)])
def test_actor_and_world_model_are_updated_once_every_so_many_gradient_steps(policy_delay, world_model_delay):
    model = trained_model(policy_delay=policy_delay, world_model_delay=world_model_delay)
    modules = {"actor": model.actor, "critic": model.critic, "world_model": model.world_model}
    delays = {"actor": policy_delay, "critic": 1, "world_model": world_model_delay}
    for _ in range(6):
        before = {name: th.nn.utils.parameters_to_vector(module.parameters()).clone() for name, module in modules.items()}
        model.train(gradient_steps=1, batch_size=32)
        changed = {
            name: not th.equal(before[name], th.nn.utils.parameters_to_vector(modules[name].parameters())) for name in modules
        }
        assert changed == {name: model._n_updates % delay == 0 for name, delay in delays.items()}


@pytest.mark.parametrize("steps_per_call", [1, 2, 5])
def test_target_networks_follow_at_every_gradient_step(steps_per_call, monkeypatch):
    model = trained_model(policy_delay=3)
    monkeypatch.setattr(model._updates, "step", lambda module, gradients: None)
    online, before = (
        th.nn.utils.parameters_to_vector([*actor.parameters(), *critic.parameters()]).clone()
        for actor, critic in ((model.actor, model.critic), (model.actor_target, model.critic_target))
    )
    for _ in range(3):
        model.train(gradient_steps=steps_per_call, batch_size=32)
    found = th.nn.utils.parameters_to_vector([*model.actor_target.parameters(), *model.critic_target.parameters()])
    left = (1.0 - model.tau) ** (3 * steps_per_call)
    th.testing.assert_close(found, left * before + (1.0 - left) * online, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("n_updates, sizes", [(8, [2, 2, 1]), (9, [1, 2, 2])])
def test_td_targets_up_to_an_update_of_the_actor_are_computed_at_once(n_updates, sizes, monkeypatch):
    model = trained_model(policy_delay=2)
    model._n_updates = n_updates
    asked, given, td_target, update_critics = [], [], model._updates.bootstrap, model._updates.update_critics

    def ask(data):
        asked.append((data, td_target(data)[1]))
        return data.actions, asked[-1][1]

    def give(data, target, *args):
        given.append((data, target.clone()))
        return update_critics(data, target, *args)

    monkeypatch.setattr(model._updates, "bootstrap", ask)
    monkeypatch.setattr(model._updates, "update_critics", give)
    model.train(gradient_steps=5, batch_size=32)
    assert [len(target) for _, target in asked] == [32 * size for size in sizes]
    assert th.equal(th.cat([data.rewards for data, _ in asked]), th.cat([data.rewards for data, _ in given]))
    assert th.equal(th.cat([target for _, target in asked]), th.cat([target for _, target in given]))
    assert all(len(target) == 32 for _, target in given)


@pytest.mark.parametrize("name", ["policy_delay", "world_model_delay"])
@pytest.mark.parametrize("delay", [0, -1, 1.5, True, "2", None])
def test_a_delay_that_is_no_number_of_gradient_steps_is_refused(name, delay):
    with pytest.raises(ValueError, match=rf"{name} must be an integer from 1 to [0-9,]+, got"):
        CausalGDP("MlpPolicy", "Pendulum-v1", **{name: delay})


# The action that the Q term judges --------------------------------------------------------------------------------------


def q_term_and_its_gradients(model, data, climbed):
    """By the parameters of the actor, of whose losses the others weigh nothing."""
    model.denoising_weight = model.bound_penalty = 0.0
    losses, gradients = model._updates.actor_gradients(data, data.actions, climbed, False)
    th.testing.assert_close(losses["actor_loss"], losses["q_loss"])
    return losses["q_loss"], gradients


def q_term_and_its_noise(model, data):
    """The Q term with its gradients, and the action that the denoising term's own noise prediction gives."""
    actor, actions = model.actor, data.actions
    th.manual_seed(5)
    q_term, gradients = q_term_and_its_gradients(model, data, climbed=0)
    th.manual_seed(5)
    step = th.randint(actor.schedule.n_steps, (len(actions),))
    noise = th.randn_like(actions)
    alpha_bar = actor.schedule.alpha_bar[step].unsqueeze(1)
    noisy = alpha_bar.sqrt() * actions + (1.0 - alpha_bar).sqrt() * noise
    predicted = actor.denoiser(noisy, step, actor.features(data.observations))
    clean = (noisy - (1.0 - alpha_bar).sqrt() * predicted) / alpha_bar.sqrt()
    return q_term, gradients, bounded(clean)


@pytest.mark.parametrize("n_critics, climbed, scale", [(1, 0, 0), (3, 0, 1), (3, 1, 2), (3, 2, 0)])
@pytest.mark.parametrize("q_scale", ["advantage", "value"])
def test_the_next_critic_sets_the_scale_and_a_single_one_its_own(n_critics, climbed, scale, q_scale):
    arguments = {"policy_kwargs": {"net_arch": [8], "n_critics": n_critics}, "q_scale": q_scale}
    model = CausalGDP("MlpPolicy", "Pendulum-v1", learning_starts=64, seed=0, device="cpu", **arguments)
    model.learn(64)
    data = model.replay_buffer.sample(64)
    found = []
    for plain in (False, True):
        th.manual_seed(5)
        if plain:
            actions = denoising_loss(
                model.actor.denoiser, model.actor.schedule, model.actor.features(data.observations), data.actions
            ).clean_actions
            values = q_values(model.critic, data.observations.float(), actions)
            size = values[scale].detach()
            if q_scale == "advantage":
                size = size - q_values(model.critic, data.observations.float(), data.actions)[scale].detach()
            loss = -values[climbed].mean() / size.abs().mean()
            found.append((loss.detach(), th.autograd.grad(loss, list(model.actor.parameters()))))
        else:
            found.append(q_term_and_its_gradients(model, data, climbed))
    (ours, our_gradients), (theirs, their_gradients) = found
    th.testing.assert_close(ours, theirs)
    th.testing.assert_close(our_gradients, their_gradients, rtol=1e-4, atol=1e-6)


def test_one_step_judges_the_clean_estimate_of_the_denoising_term():
    model = trained_model(actor_update="one_step")
    data = model.replay_buffer.sample(64)
    q_term, ours, clean = q_term_and_its_noise(model, data)
    first, second = q_values(
        model.critic, model.critic.extract_features(data.observations, model.critic.features_extractor), clean
    )
    expected = -first.mean() / second.detach().abs().mean()
    th.testing.assert_close(q_term, expected.detach(), rtol=1e-5, atol=1e-6)
    for gradient, plain in zip(ours, th.autograd.grad(expected, list(model.actor.parameters())), strict=True):
        th.testing.assert_close(gradient, plain, rtol=1e-4, atol=1e-6)


def test_the_chain_judges_where_the_chain_ends():
    model = trained_model(actor_update="chain")
    data = model.replay_buffer.sample(64)
    q_term, _, clean = q_term_and_its_noise(model, data)
    one_step = -q_values(model.critic, data.observations.float(), clean)[0].mean()
    assert not th.isclose(q_term, one_step, rtol=1e-3)
    th.manual_seed(5)
    th.randint(model.actor.schedule.n_steps, (64,)), th.randn_like(data.actions)
    first, second = model.critic(data.observations, model.actor.sample(model.actor.features(data.observations)))
    th.testing.assert_close(q_term, -first.mean() / second.detach().abs().mean(), rtol=1e-5, atol=1e-6)


def test_an_unknown_actor_update_is_refused():
    with pytest.raises(ValueError, match=r"actor_update must be one of \['chain', .*'weighted'\], got 'two_step'"):
        CausalGDP("MlpPolicy", "Pendulum-v1", actor_update="two_step")


# Sampling ---------------------------------------------------------------------------------------------------------------


def test_rows_are_dealt_to_batches_with_a_share_of_every_kind_of_row():
    rows = th.arange(12.0).unsqueeze(1)
    sample = ReplayBufferSamples({"a": rows}, rows + 100, {"a": rows}, rows, rows, None)
    dealt = deal_rows(sample, 3)
    batches = [rows_of(dealt, slice(first, first + 4)) for first in (0, 4, 8)]
    assert [batch.observations["a"].flatten().tolist() for batch in batches] == [[0, 3, 6, 9], [1, 4, 7, 10], [2, 5, 8, 11]]
    assert th.equal(batches[2].actions, batches[2].observations["a"] + 100)
    assert batches[0].discounts is None
    assert batches[1].rewards.is_contiguous() and batches[1].rewards.data_ptr() == dealt.rewards[4:].data_ptr()
    assert deal_rows(sample, 1) is sample


def test_many_gradient_steps_sample_the_buffer_once(monkeypatch):
    model = trained_model()
    sizes = []
    original = model.replay_buffer.sample
    monkeypatch.setattr(model.replay_buffer, "sample", lambda size, env=None: sizes.append(size) or original(size, env))
    model.train(gradient_steps=5, batch_size=32)
    assert sizes == [160]
    monkeypatch.setattr(Batches, "MOST_ROWS_PER_DRAW", 64)
    model.train(gradient_steps=5, batch_size=32)
    assert sizes[1:] == [64, 64, 32]


def test_every_gradient_step_of_a_draw_has_its_own_rows(monkeypatch):
    model = trained_model()
    seen = []
    original = model._updates.update_critics
    monkeypatch.setattr(
        model._updates, "update_critics", lambda data, *args: seen.append(data.actions.clone()) or original(data, *args)
    )
    model.train(gradient_steps=4, batch_size=32)
    assert [len(actions) for actions in seen] == [32] * 4
    assert len(np.unique(th.cat(seen).numpy(), axis=0)) > 64


def test_logs_are_means_over_the_gradient_steps(monkeypatch):
    model = trained_model(policy_delay=1)
    values = iter([1.0, 2.0, 6.0])
    original = model._updates.update_actor
    monkeypatch.setattr(model._updates, "update_actor", lambda *args: {**original(*args), "q_loss": th.tensor(next(values))})
    model.set_logger(Logger(None, []))
    model.train(gradient_steps=3, batch_size=16)
    assert model.logger.name_to_value["train/q_loss"] == pytest.approx(3.0)


# Compilation ------------------------------------------------------------------------------------------------------------


def weights_after(model, seed=3):
    th.manual_seed(seed), np.random.seed(seed)
    # So many that every kind of step comes more than once
    model.train(gradient_steps=12, batch_size=32)
    return model.policy.state_dict()


def assert_same_weights(found, expected, **tolerances):
    for name, value in expected.items():
        th.testing.assert_close(found[name], value, msg=name, **tolerances)


def assert_trains_alike(model, path, compile_=True):
    model.save(path / "model")
    model.save_replay_buffer(path / "buffer")
    states = []
    for mode in (False, compile_):
        loaded = CausalGDP.load(path / "model", env=model.get_env(), custom_objects={"compile": mode})
        loaded.load_replay_buffer(path / "buffer")
        loaded.set_logger(Logger(None, []))
        assert loaded.policy.is_guided == model.policy.is_guided
        states.append(weights_after(loaded))
    assert_same_weights(states[1], states[0], rtol=1e-5, atol=1e-6)
    return loaded


COMPILABLE = {
    "defaults": {},
    "chain": {"actor_update": "chain"},
    "mish": {"policy_kwargs": {"net_arch": [8], "activation_fn": "mish"}},
    "no guidance": {"guidance": None},
    "score": {"guidance": "score"},
    "normalized, reward": {"guidance": "normalized", "guidance_target": "reward"},
    "tweedie": {"guidance_covariance": "tweedie"},
    "isotropic": {"guidance_covariance": "isotropic"},
    "ddim": {"sampler": "ddim"},
    "euler_maruyama": {"sampler": "euler_maruyama", "actor_update": "chain"},
    "heun": {"sampler": "heun", "actor_update": "chain"},
    "dpm_solver, 3 steps": {
        "sampler": "dpm_solver",
        "actor_update": "chain",
        "policy_kwargs": {"net_arch": [8], "sampling_steps": 3},
    },
    "residual_mlp": {"policy_kwargs": {"net_arch": [8], "denoiser": "residual_mlp"}},
    "transformer": {"policy_kwargs": {"net_arch": [8], "denoiser": "transformer", "denoiser_kwargs": {"causal": True}}},
    "one critic": {"policy_kwargs": {"net_arch": [8], "n_critics": 1}},
    "quantiles": {"policy_kwargs": {"net_arch": [8], "n_quantiles": 5}},
    "quantiles, layer norm": {"policy_kwargs": {"net_arch": [8], "n_quantiles": 3, "critic_normalization": "layer"}},
    "layer norm": {"policy_kwargs": {"net_arch": [8], "critic_normalization": "layer"}},
    "clipped": {"max_grad_norm": 0.1},
    "max_q_backup": {"max_q_backup": True, "policy_kwargs": {"net_arch": [8], **AS_THEY_ARE}},
    "memory": {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}},
    "n steps": {"n_steps": 3},
}


def test_an_update_on_a_dictionary_of_vectors_is_one_graph_for_each_network(tmp_path, monkeypatch):
    compile_for_tests(monkeypatch, backend="eager")
    assert_trains_alike(trained_model("MultiInputPolicy", dictionary_pendulum()), tmp_path)


@pytest.mark.parametrize("name", COMPILABLE)
def test_an_update_is_one_graph_for_each_network_and_trains_as_without(tmp_path, monkeypatch, name):
    compile_for_tests(monkeypatch, backend="aot_eager" if name == "defaults" else "eager")
    model = trained_model(**COMPILABLE[name])
    assert_trains_alike(model, tmp_path)


def test_what_changes_between_two_calls_is_seen(tmp_path, monkeypatch):
    compile_for_tests(monkeypatch, backend="eager")
    model = assert_trains_alike(trained_model(), tmp_path)
    plain = CausalGDP.load(tmp_path / "model", env=model.get_env(), custom_objects={"compile": False})
    plain.load_replay_buffer(tmp_path / "buffer")
    plain.set_logger(Logger(None, []))
    assert_same_weights(model.policy.state_dict(), weights_after(plain), rtol=1e-5, atol=1e-6)
    for one in (model, plain):
        one.gamma, one.eta = 0.5, 2.0
        one.policy.outcome_guidance_scale *= 3.0
        weights_after(one)
    assert_same_weights(model.policy.state_dict(), plain.policy.state_dict(), rtol=1e-4, atol=1e-5)


def test_what_a_compiler_made_trains_as_the_plain_code_and_is_saved_as_a_wish(tmp_path):
    policy_kwargs = {"net_arch": [8], "n_critics": 1, "world_model_net_arch": [8]}
    model = trained_model(policy_delay=1, policy_kwargs=policy_kwargs)
    loaded = assert_trains_alike(model, tmp_path)
    loaded.save(tmp_path / "again")
    assert CausalGDP.load(tmp_path / "again").compile is True


# Threads ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("torch_threads", "expected"), [("auto", 1), (2, 2), (None, 3)])
def test_updates_run_with_the_threads_asked_for_and_give_them_back(torch_threads, expected, monkeypatch):
    model = trained_model(torch_threads=torch_threads)
    seen = []
    original = model._updates.update_averages
    monkeypatch.setattr(model._updates, "update_averages", lambda: seen.append(th.get_num_threads()) or original())
    before = th.get_num_threads()
    try:
        th.set_num_threads(3)
        model.train(gradient_steps=1, batch_size=8)
        assert seen == [expected]
        assert th.get_num_threads() == 3
    finally:
        th.set_num_threads(before)


@pytest.mark.parametrize("torch_threads", [0, -1, True, "all", 1.5])
def test_a_number_of_threads_that_is_none_is_refused(torch_threads):
    with pytest.raises(ValueError, match="torch_threads"):
        CausalGDP("MlpPolicy", "Pendulum-v1", torch_threads=torch_threads)
