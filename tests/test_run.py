from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import SMALL
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback, MlpPolicy
from sb3_causalgdp.updates import Updates


class CountingEnv(gym.Env):
    """The observation counts the steps of an episode and the episodes; the reward is the count before the step."""

    EPISODE_LENGTH = 7

    def __init__(self):
        self.observation_space = spaces.Box(-1e6, 1e6, (2,))
        self.action_space = spaces.Box(-1.0, 1.0, (2,))
        self.episode = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.count = 0
        self.episode += 1
        return self._observation(), {}

    def step(self, action):
        reward, self.count = float(self.count), self.count + 1
        ended = self.count == self.EPISODE_LENGTH
        # Every other episode is cut off, not over
        terminated = ended and self.episode % 2 == 0
        return self._observation(), reward, terminated, ended and not terminated, {}

    def _observation(self):
        return np.array([self.count, 100.0 * self.episode], dtype=np.float32)


def guided_callback():
    return CausalWorldModelCallback(min_transitions=40, diagnostics_batch_size=8)


def learn(total_timesteps=80, env="Pendulum-v1", callback=None, **kwargs):
    model = CausalGDP("MlpPolicy", env, **{**SMALL, **kwargs})
    model.learn(total_timesteps, callback=callback or guided_callback())
    assert all(bool(th.isfinite(value).all()) for value in model.policy.state_dict().values())
    return model


def parameters(model):
    return th.cat([parameter.flatten() for parameter in model.policy.parameters()])


# Collecting and updating ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_envs", [1, 4])
def test_as_many_updates_as_transitions(n_envs):
    env = make_vec_env("Pendulum-v1", n_envs=n_envs, seed=0)
    model = learn(10 * n_envs, env=env, train_freq=5, gradient_steps=-1, learning_starts=0)
    assert model.num_timesteps == model._n_updates == 10 * n_envs
    assert model.logger.name_to_value["train/n_updates"] == 10 * n_envs


def test_updates_after_each_episode():
    model = learn(30, env=CountingEnv(), train_freq=(1, "episode"), gradient_steps=3, learning_starts=0)
    assert model.num_timesteps == 35
    assert model._n_updates == 15


def test_no_updates_before_learning_starts():
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **{**SMALL, "learning_starts": 50})
    before = parameters(model)
    model.learn(48)
    assert th.equal(parameters(model), before)
    assert model._n_updates == 0
    model.learn(8, reset_num_timesteps=False)
    assert model._n_updates == 1
    assert not th.equal(parameters(model), before)


def test_training_needs_no_batch_size():
    model = learn(24)
    model.train(gradient_steps=2)
    assert model._n_updates == 2 + 1


@pytest.mark.parametrize(
    "action_noise",
    [NormalActionNoise(np.zeros(1), 0.5 * np.ones(1)), OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.5 * np.ones(1))],
)
@pytest.mark.parametrize("n_envs", [1, 2])
def test_action_noise_changes_what_is_tried(action_noise, n_envs):
    env = make_vec_env("Pendulum-v1", n_envs=n_envs, seed=0)
    kwargs = {"env": env, "learning_starts": 0, "exploration_noise": 0.0}
    model = learn(16 * n_envs, action_noise=deepcopy(action_noise), **kwargs)
    assert isinstance(model.action_noise, VectorizedActionNoise) == (n_envs > 1)
    actions = model.replay_buffer.actions[:16]
    assert np.abs(actions).max() <= 1.0
    env.seed(0)
    assert not np.array_equal(actions, learn(16 * n_envs, **kwargs).replay_buffer.actions[:16])


def test_bounds_of_the_actions_are_those_of_the_environment():
    class LopsidedEnv(CountingEnv):
        def __init__(self):
            super().__init__()
            self.action_space = spaces.Box(np.array([-3.0, 1.0], dtype=np.float32), np.array([1.0, 5.0], dtype=np.float32))

        def step(self, action):
            assert self.action_space.contains(action)
            return super().step(action)

    model = learn(80, env=LopsidedEnv())
    played, _ = model.predict(np.zeros((50, 2), dtype=np.float32))
    assert (played >= model.action_space.low).all() and (played <= model.action_space.high).all()
    assert np.abs(model.replay_buffer.actions[:80]).max() <= 1.0


# Variants ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "kwargs",
    [
        {"max_q_backup": True, "policy_kwargs": {**SMALL["policy_kwargs"], "critic_normalization": None}},
        {"max_grad_norm": 1.0},
        {"guidance": None},
        {"guidance": "score", "guidance_scale": 1e-3},
        {"guidance": "normalized", "guidance_scale": [0.1, 0.1, 0.2, 0.2, 0.3]},
        {"guidance_covariance": "tweedie", "sampler": "ddim"},
        {"guidance_covariance": "isotropic", "sampler": "ddim", "ddim_eta": 1.0, "noise_schedule": "cosine"},
        {"guidance_target": "reward", "noise_schedule": "linear", "diffusion_steps": 3},
        {"sampler": "heun", "actor_update": "chain", "policy_kwargs": {**SMALL["policy_kwargs"], "sampling_steps": 3}},
        {"sampler": "dpm_solver", "guidance_covariance": "tweedie", "noise_schedule": "cosine"},
        {"sampler": "euler_maruyama", "actor_update": "chain"},
        {"policy_kwargs": {**SMALL["policy_kwargs"], "denoiser": "residual_mlp"}},
        {
            "guidance_covariance": "tweedie",
            "policy_kwargs": {**SMALL["policy_kwargs"], "denoiser": "transformer", "denoiser_kwargs": {"causal": True}},
        },
        {"diffusion_steps": 1, "n_action_candidates": 1, "state_guidance_scale": 0.0},
        {"causal_half_life": 50.0, "causal_discovery_kwargs": {"threshold": 0.1}},
        {"denoising_weight": 0.0},
        {"eta": 0.0},
        {"max_q_backup": True, "n_steps": 2, "policy_kwargs": {**SMALL["policy_kwargs"], "critic_normalization": "layer"}},
    ],
    ids=str,
)
def test_every_variant_trains(kwargs):
    model = learn(**kwargs)
    assert model._n_updates == 8
    assert model.policy.is_guided == ("guidance" not in kwargs or kwargs["guidance"] is not None)
    losses = [value for name, value in model.logger.name_to_value.items() if name.endswith("_loss")]
    assert len(losses) == 7 and np.isfinite(losses).all()


@pytest.mark.parametrize("n_critics", [1, 3])
def test_number_of_critics(n_critics):
    model = learn(policy_kwargs={**SMALL["policy_kwargs"], "n_critics": n_critics})
    assert len(model.critic.q_networks) == len(model.critic_target.q_networks) == n_critics


def test_layer_norm_of_the_critics_bounds_their_values():
    plain, normalised = (
        learn(policy_kwargs={**SMALL["policy_kwargs"], "critic_normalization": kind, "normalize_observations": False})
        for kind in (None, "layer")
    )
    n_layers = len(SMALL["policy_kwargs"]["net_arch"])
    for critic in (normalised.critic, normalised.critic_target):
        assert [sum(isinstance(one, th.nn.LayerNorm) for one in network) for network in critic.q_networks] == [n_layers] * 2
        names = {name.split(".")[0] for name, _ in critic.named_parameters()}
        assert names == {"qf0", "qf1"} and all(getattr(critic, f"qf{i}") is critic.q_networks[i] for i in (0, 1))
    far = 1e6 * th.ones(1, 3), th.ones(1, 1)
    with th.no_grad():
        assert abs(float(plain.critic(*far)[0])) > 1e3
        assert abs(float(normalised.critic(*far)[0])) < 1e3


@pytest.mark.parametrize("n_parameters", [0, 1])
def test_gradients_are_bounded(n_parameters, monkeypatch):
    model = learn(24, max_grad_norm=1e-3, policy_delay=1)
    module = (model.actor, model.critic)[n_parameters]
    norms = []
    optimizer = module.optimizer

    def step(*args, **kwargs):
        norms.append(float(th.cat([p.grad.flatten() for p in module.parameters()]).norm()))

    monkeypatch.setattr(optimizer, "step", step)
    model.train(gradient_steps=3, batch_size=8)
    assert len(norms) == 3
    assert max(norms) == pytest.approx(1e-3, rel=1e-2)


# Policy arguments -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("policy", ["MlpPolicy", MlpPolicy, type("OwnPolicy", (MlpPolicy,), {})])
def test_the_policy_is_a_name_or_a_class(policy):
    model = CausalGDP(policy, "Pendulum-v1", **SMALL)
    assert isinstance(model.policy, MlpPolicy if isinstance(policy, str) else policy)


def test_the_callers_dictionaries_are_left_as_they_were():
    policy_kwargs = {"net_arch": {"pi": [8], "qf": [4, 4]}, "optimizer_kwargs": {"weight_decay": 0.1}}
    discovery_kwargs = {"threshold": 0.05}
    before = deepcopy((policy_kwargs, discovery_kwargs))
    model = learn(policy_kwargs=policy_kwargs, causal_discovery_kwargs=discovery_kwargs)
    assert (policy_kwargs, discovery_kwargs) == before
    assert model.policy_kwargs == policy_kwargs


@pytest.mark.parametrize(
    ("net_arch", "actor_arch", "critic_arch"),
    [
        ([], [], []),
        ([4], [4], [4]),
        ([8, 4], [8, 4], [8, 4]),
        ({"pi": [8, 4], "qf": [6]}, [8, 4], [6]),
    ],
)
def test_hidden_layers_of_actor_and_critics(net_arch, actor_arch, critic_arch):
    model = learn(24, policy_kwargs={"net_arch": net_arch, "world_model_net_arch": [8]})
    denoiser = model.actor.denoiser
    linears = [denoiser.input_layer, *(layer for layer in denoiser.network if isinstance(layer, th.nn.Linear))]
    assert [layer.out_features for layer in linears] == [*actor_arch, 1]
    linears = [layer for layer in model.critic.q_networks[0] if isinstance(layer, th.nn.Linear)]
    assert [layer.out_features for layer in linears] == [*critic_arch, 1]


@pytest.mark.parametrize("activation_fn", ["tanh", "Tanh", th.nn.Tanh])
def test_the_activation_is_a_name_or_a_class(activation_fn):
    model = learn(24, policy_kwargs={**SMALL["policy_kwargs"], "activation_fn": activation_fn})
    for network in (model.actor.denoiser.network, *model.critic.q_networks):
        assert any(isinstance(layer, th.nn.Tanh) for layer in network)
        assert not any(isinstance(layer, (th.nn.ReLU, th.nn.Mish)) for layer in network)


@pytest.mark.parametrize(
    ("optimizer_class", "optimizer_kwargs"),
    [(th.optim.AdamW, {"weight_decay": 0.0}), (th.optim.Adam, {"foreach": True}), (th.optim.SGD, {"momentum": 0.9})],
)
def test_the_optimizer_is_the_one_asked_for(optimizer_class, optimizer_kwargs):
    policy_kwargs = {"optimizer_class": optimizer_class, "optimizer_kwargs": optimizer_kwargs}
    model = learn(24, learning_rate=1e-4, policy_kwargs={**SMALL["policy_kwargs"], **policy_kwargs})
    for module in (model.actor, model.critic, model.world_model):
        assert type(module.optimizer) is optimizer_class
        for name, value in optimizer_kwargs.items():
            assert module.optimizer.param_groups[0][name] == value


# Several steps, and a buffer that saves memory --------------------------------------------------------------------------


class SpyingUpdates(Updates):
    """Keeps the transitions that each part learned from, and the actions after the actor's."""

    def __init__(self, model):
        self.seen = {"critics": [], "world model": [], "actor": []}
        super().__init__(model)

    def update_critics(self, replay_data, *args):
        self.seen["critics"].append(replay_data)
        return super().update_critics(replay_data, *args)

    def update_world_model(self, transitions, *args):
        self.seen["world model"].append(transitions)
        return super().update_world_model(transitions, *args)

    def actor_gradients(self, transitions, next_actions, *args):
        self.seen["actor"].append((transitions, next_actions))
        return super().actor_gradients(transitions, next_actions, *args)


class SpyingGDP(CausalGDP):
    updates_class = SpyingUpdates


N_STEP_BUFFERS = [
    {"n_steps": 3},
    {"replay_buffer_class": NStepReplayBuffer, "replay_buffer_kwargs": {"n_steps": 3, "gamma": 0.99}},
]


@pytest.mark.parametrize("kwargs", N_STEP_BUFFERS, ids=["n_steps", "buffer class"])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_with_n_step_returns_the_world_model_learns_from_single_steps(kwargs, n_envs):
    env = make_vec_env(CountingEnv, n_envs=n_envs)
    model = SpyingGDP("MlpPolicy", env, **{**SMALL, "batch_size": 32, **kwargs})
    model.learn(80, callback=guided_callback())
    assert model.policy.is_guided

    def column(batches, name):
        return th.cat([getattr(batch, name) for batch in batches])

    for part, batches in (
        ("world model", model._updates.seen["world model"]),
        ("actor", [transitions for transitions, _ in model._updates.seen["actor"]]),
    ):
        states, next_states = column(batches, "observations"), column(batches, "next_observations")
        assert th.equal(next_states[:, 0], states[:, 0] + 1.0), part
        assert th.equal(next_states[:, 1], states[:, 1]), part
        assert th.equal(column(batches, "rewards")[:, 0], states[:, 0]), part
        # The seventh step of every other episode ends it, the others are cut off
        ended = (next_states[:, 0] == 7.0) & (next_states[:, 1] % 200 == 0.0)
        assert th.equal(column(batches, "dones")[:, 0], ended.float()), part

    # The critics' next states lie up to three steps ahead, and their rewards are sums
    states, next_states = (
        column(model._updates.seen["critics"], "observations"),
        column(model._updates.seen["critics"], "next_observations"),
    )
    ahead = (next_states[:, 0] - states[:, 0]).int()
    assert set(ahead.tolist()) == {1, 2, 3}
    steps = th.arange(3)
    weights = 0.99**steps * (steps < ahead.unsqueeze(1))
    returns = (weights * (states[:, :1] + steps)).sum(dim=1)
    th.testing.assert_close(column(model._updates.seen["critics"], "rewards")[:, 0], returns)


def test_with_n_step_returns_the_guidance_asks_for_the_next_step(monkeypatch):
    policy_kwargs = {**SMALL["policy_kwargs"], "normalize_observations": False}
    model = SpyingGDP("MlpPolicy", CountingEnv(), **{**SMALL, "n_steps": 3, "policy_delay": 1, "policy_kwargs": policy_kwargs})
    model.learn(80, callback=guided_callback())
    asked = []
    make_guidance = model.policy.make_guidance
    monkeypatch.setattr(model.policy, "make_guidance", lambda *args: asked.append(args) or make_guidance(*args))
    # The action that follows is the target's for that next state
    monkeypatch.setattr(model.actor_target, "sample", lambda features: features / 1000.0)
    model.train(gradient_steps=4, batch_size=8)
    for (state, next_state, next_action, critic), (transitions, next_actions) in zip(
        asked, model._updates.seen["actor"][-4:], strict=True
    ):
        assert critic in (0, 1)
        assert th.equal(state, transitions.observations)
        assert th.equal(next_state, transitions.observations + th.tensor([1.0, 0.0]))
        assert next_action is next_actions
        th.testing.assert_close(next_action, next_state / 1000.0)


def memory_efficient():
    return CausalGDP(
        "MlpPolicy",
        CountingEnv(),
        optimize_memory_usage=True,
        replay_buffer_kwargs={"handle_timeout_termination": False},
        **{**SMALL, "buffer_size": 50},
    )


def test_the_memory_efficient_buffer_gives_the_guidance_a_predicted_end_of_each_episode(monkeypatch):
    model = memory_efficient().learn(160, callback=guided_callback())
    asked = []
    make_guidance = model.policy.make_guidance
    monkeypatch.setattr(model.policy, "make_guidance", lambda *args: asked.append(args) or make_guidance(*args))
    data = model.replay_buffer.sample(200)
    model._updates.actor_gradients(data, data.actions, 0, True)
    ((state, next_state, _, _),) = asked
    ended = data.dones.flatten() > 0.0
    assert 0 < ended.sum() < 200
    assert th.equal(next_state[~ended], (state + th.tensor([1.0, 0.0]))[~ended])
    predicted, _ = model.world_model.predict_next_state(state, data.actions)
    th.testing.assert_close(next_state[ended], predicted[ended].detach())
    assert not next_state.requires_grad


def test_the_memory_efficient_buffer_gives_the_world_model_no_jumps_between_episodes(monkeypatch):
    model = memory_efficient()
    statistics, rows = [], []
    update_statistics, update = model.world_model.update_statistics, model.causal_statistics.update
    monkeypatch.setattr(
        model.world_model, "update_statistics", lambda *args: statistics.append(args) or update_statistics(*args)
    )
    monkeypatch.setattr(model.causal_statistics, "update", lambda values: rows.append(values) or update(values))
    model.learn(160, callback=guided_callback())
    fed = np.concatenate(rows)
    # Rows are s (2), a (2), s' (2), r
    np.testing.assert_array_equal(fed[:, 4] - fed[:, 0], 1.0)
    np.testing.assert_array_equal(fed[:, 5], fed[:, 1])
    np.testing.assert_array_equal(fed[:, 6], fed[:, 0])
    assert fed[:, 0].max() == 5.0
    assert any((known == 0.0).any() for *_, known in statistics)
    for state, next_state, reward, known in statistics:
        kept = known > 0.0
        assert th.equal(next_state[kept], (state + th.tensor([1.0, 0.0]))[kept])
        assert th.equal(reward[kept], state[kept, 0])


# Seeds ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kwargs", [{}, {"n_steps": 3}], ids=str)
def test_the_same_seed_gives_the_same_training_and_another_seed_another(kwargs):
    models = [learn(env=make_vec_env("Pendulum-v1", n_envs=2, seed=1), seed=seed, **kwargs) for seed in (4, 4, 5)]
    first, second, other = (parameters(model) for model in models)
    assert th.equal(first, second)
    assert models[0].causal_graph().masks.tolist() == models[1].causal_graph().masks.tolist()
    assert not th.equal(first, other)
    np.testing.assert_array_equal(models[0].replay_buffer.actions, models[1].replay_buffer.actions)


def test_learning_in_two_parts_is_learning_at_once():
    """SB3 draws the environment's episodes and its random numbers on where it stopped."""
    models = [CausalGDP("MlpPolicy", "Pendulum-v1", **SMALL) for _ in range(2)]
    models[0].set_random_seed(3)
    models[0].learn(128, callback=guided_callback())
    models[1].set_random_seed(3)
    models[1].learn(72, callback=guided_callback())
    models[1].learn(56, callback=guided_callback(), reset_num_timesteps=False)
    assert models[0].num_timesteps == models[1].num_timesteps == 128
    assert models[0].causal_graph().num_timesteps == models[1].causal_graph().num_timesteps == 120
    assert models[0].causal_statistics.n_samples == models[1].causal_statistics.n_samples == 119
    assert th.equal(parameters(models[0]), parameters(models[1]))
