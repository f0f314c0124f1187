"""Methods of other papers: each is a set of arguments with which CausalGDP trains, online and offline, guided or not."""

import inspect
import time

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from small_models import small
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_causalgdp import CausalGDP, MlpPolicy, preset
from sb3_causalgdp.acceleration.acting import OnePassActing
from sb3_causalgdp.distillation import visited
from sb3_causalgdp.presets import METHODS, OFFLINE, PRESETS

KWARGS = small(learning_starts=210, causal_refresh_freq=205, batch_size=32, train_freq=1, n_action_candidates=4)


class Aim(gym.Env):
    """The reward is how near the action is to half of the observation."""

    observation_space = gym.spaces.Box(-1.0, 1.0, (2,))
    action_space = gym.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.n_steps = self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32), 0
        return self.state, {}

    def step(self, action):
        reward = -float(abs(action[0] - 0.5 * self.state[0]))
        self.state, self.n_steps = self.np_random.uniform(-1.0, 1.0, 2).astype(np.float32), self.n_steps + 1
        return self.state, reward, False, self.n_steps == 20, {}


def vector(module):
    return th.nn.utils.parameters_to_vector(module.parameters()).detach().clone()


@pytest.mark.parametrize("guided", [False, True])
@pytest.mark.parametrize("name", PRESETS)
def test_each_trains_from_an_environment(name, guided):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **preset(name, guided=guided, **KWARGS))
    before = vector(model.actor), vector(model.critic)
    model.learn(400)
    assert model.policy.is_guided is guided
    after = vector(model.actor), vector(model.critic)
    assert all(bool(new.isfinite().all()) and not th.equal(new, old) for new, old in zip(after, before, strict=True))
    assert all(np.isfinite(value) for key, value in model.logger.name_to_value.items() if key.startswith("train/"))


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "pendulum.npz"
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **{**KWARGS, "learning_starts": 1_000})
    model.learn(400)
    model.save_replay_buffer(path)
    return str(path)


@pytest.mark.parametrize("guided", [False, True])
@pytest.mark.parametrize("name", PRESETS)
def test_each_trains_offline_with_its_papers_settings(name, guided, dataset):
    model = CausalGDP(
        "MlpPolicy", "Pendulum-v1", **preset(name, offline=True, guided=guided, **KWARGS), offline_dataset=dataset
    )
    before = vector(model.actor)
    model.pretrain(gradient_steps=30)
    assert bool(vector(model.actor).isfinite().all()) and not th.equal(vector(model.actor), before)
    action, _ = model.predict(np.zeros(3, np.float32), deterministic=True)
    assert action.shape == (1,) and np.isfinite(action).all()


def test_presets_are_arguments_of_the_constructor_and_of_the_policy():
    arguments, of_policy = (inspect.signature(kind.__init__).parameters for kind in (CausalGDP, MlpPolicy))
    for settings in (*METHODS.values(), *OFFLINE.values()):
        assert set(settings) <= set(arguments) and set(settings.get("policy_kwargs", {})) <= set(of_policy)
    assert set(OFFLINE) == set(METHODS)


def test_what_makes_a_method_wins_over_its_papers_other_settings_and_the_users_own_over_both():
    given = preset("edp_iql", offline=True, eta=3.0, policy_kwargs={"n_critics": 5})
    assert given["actor_update"] == "weighted" and given["learning_rate"] == 3e-4 and given["eta"] == 3.0
    assert given["policy_kwargs"]["critic_normalization"] == "layer"
    assert given["policy_kwargs"]["activation_fn"] == "mish" and given["policy_kwargs"]["n_critics"] == 5
    given["policy_kwargs"]["sampling_steps"] = 1
    assert preset("edp_iql")["policy_kwargs"]["sampling_steps"] == 15


def test_arguments_of_the_denoiser_are_joined_unless_it_is_another_one():
    assert preset("attention", policy_kwargs={"denoiser_kwargs": {"n_heads": 2}})["policy_kwargs"]["denoiser_kwargs"] == {
        "causal": True,
        "n_heads": 2,
    }
    assert "denoiser_kwargs" not in preset("attention", policy_kwargs={"denoiser": "mlp"})["policy_kwargs"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"name": ["edp"]}, "preset must be one of"),
        ({"name": "edp", "guided": "no"}, "guided must be True or False, got 'no'"),
        ({"name": "edp", "policy_kwargs": "x"}, "policy_kwargs must be a dictionary or None, got 'x'"),
    ],
)
def test_arguments_of_another_kind_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        preset(**arguments)


def test_guidance_is_off_unless_it_is_plugged_in():
    assert all(preset(name)["guidance"] is None and "guidance" not in preset(name, guided=True) for name in PRESETS)
    assert preset("edp", guidance="score")["guidance"] == "score"


def test_an_unknown_preset_is_refused_with_the_one_that_may_be_meant():
    with pytest.raises(ValueError, match=r"preset must be one of .*, got 'dqtl', did you mean 'dtql'\?"):
        preset("dqtl")


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"actor_update": "weighted"}, "expectile must be a number with actor_update='weighted', got None"),
        ({"expectile": 0.7}, "expectile must be None without target critics, got 0.7"),
    ],
)
def test_arguments_that_do_not_go_together_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        CausalGDP("MlpPolicy", "Pendulum-v1", **arguments)


@pytest.mark.parametrize("name", [name for name in PRESETS if name != "attention"])
def test_each_learns_what_pays(name):
    # Not the transformer: here the reward reads what the next state does not hold, so the graph does not show it
    policy_kwargs = {"net_arch": [64, 64], "world_model_net_arch": [8, 8]}
    arguments = {**KWARGS, "gamma": 0.5, "batch_size": 64, "policy_kwargs": policy_kwargs}
    model = CausalGDP("MlpPolicy", Aim(), **preset(name, **arguments))
    model.learn(700)
    observations = np.random.default_rng(1).uniform(-1.0, 1.0, (500, 2)).astype(np.float32)
    actions, _ = model.predict(observations, deterministic=True)
    # No action at all is off by 0.25, random ones by 0.53
    assert np.abs(actions[:, 0] - 0.5 * observations[:, 0]).mean() < 0.2


# What makes the methods -------------------------------------------------------------------------------------------------


def test_the_targets_of_implicit_q_learning_ask_no_policy():
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **preset("edp_iql", **KWARGS))
    model.learn(250)
    data = model.replay_buffer.sample(32)
    _, target = model._updates.bootstrap(data)
    with th.no_grad():
        for parameter in model.actor_target.parameters():
            parameter.add_(1.0)
    assert th.equal(model._updates.bootstrap(data)[1], target)
    with th.no_grad():
        value = model.critic.value(data.next_observations)
    discounts = model.gamma if data.discounts is None else data.discounts
    th.testing.assert_close(target, data.rewards + (1.0 - data.dones) * discounts * value)


def test_the_attention_preset_looks_along_the_graph_that_was_found():
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **preset("attention", **KWARGS))
    assert bool((model.actor.denoiser.attention == 1.0).all())
    model.learn(400)
    assert not bool((model.actor.denoiser.attention == 1.0).all())
    assert th.equal(model.actor.denoiser.attention, model.actor_target.denoiser.attention)


def test_the_one_pass_policy_asks_the_denoiser_nothing_and_survives_saving(tmp_path):
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **preset("dtql", guided=True, **KWARGS))
    model.learn(400)
    observations = np.random.default_rng(0).normal(size=(8, 3)).astype(np.float32)
    actions, _ = model.predict(observations, deterministic=True)
    assert isinstance(model.policy._acting, OnePassActing)
    with th.no_grad():
        features = model.actor_target.features(th.as_tensor(observations))
        plain = 2.0 * model.actor_target.one_pass(features).numpy()  # Pendulum's torques reach to 2
    np.testing.assert_allclose(actions, plain, rtol=1e-4, atol=1e-5)
    model.save(tmp_path / "model")
    loaded = CausalGDP.load(tmp_path / "model", env="Pendulum-v1")
    np.testing.assert_array_equal(loaded.predict(observations, deterministic=True)[0], actions)
    assert th.equal(vector(loaded.critic), vector(model.critic))
    with th.no_grad():
        for parameter in (*model.actor.denoiser.parameters(), *model.actor_target.denoiser.parameters()):
            parameter.fill_(th.nan)
    np.testing.assert_array_equal(model.predict(observations, deterministic=True)[0], actions)


# Distillation -----------------------------------------------------------------------------------------------------------


def test_the_trust_region_has_the_papers_weight_on_a_fixed_dataset_and_a_smaller_one_online():
    assert preset("dtql", offline=True)["denoising_weight"] == 5.0
    assert preset("dtql")["denoising_weight"] == 0.01
    assert preset("dtql", denoising_weight=2.0)["denoising_weight"] == 2.0


class Stretched(FlattenExtractor):
    """Features that are learned."""

    def __init__(self, observation_space):
        super().__init__(observation_space)
        self.layer = th.nn.Linear(self.features_dim, self.features_dim)

    def forward(self, observations):
        return self.layer(super().forward(observations))


def test_a_student_sees_what_it_was_taught_on():
    policy_kwargs = {**KWARGS["policy_kwargs"], "features_extractor_class": Stretched}
    kwargs = {**KWARGS, "policy_kwargs": policy_kwargs, "tau": 1e-3, "learning_rate": 1e-2}
    model = CausalGDP("MlpPolicy", "Pendulum-v1", **kwargs).learn(300)
    student = model.distil(n_observations=300, gradient_steps=300, batch_size=32)
    observations = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    with th.no_grad():
        expected = student.actor.one_pass(student.actor.features(th.as_tensor(observations))).numpy()
    np.testing.assert_allclose(student.predict(observations, deterministic=True)[0], 2.0 * expected, atol=1e-5)


@pytest.fixture(scope="module")
def teacher():
    policy_kwargs = {"net_arch": [64, 64], "world_model_net_arch": [16, 16]}
    arguments = {"learning_starts": 200, "causal_refresh_freq": 300, "batch_size": 64, "gamma": 0.5, "seed": 0}
    return CausalGDP("MlpPolicy", Aim(), policy_kwargs=policy_kwargs, **arguments).learn(900)


def test_a_distilled_policy_does_what_the_guided_one_does(teacher, tmp_path):
    assert teacher.policy.is_guided
    student = teacher.distil(n_observations=1_000, gradient_steps=1_500)
    observations, drawn = np.random.default_rng(1).uniform(-1.0, 1.0, (2, 2_000, 2)).astype(np.float32)
    actions, _ = teacher.predict(observations, deterministic=True)
    imitated, _ = student.predict(observations, deterministic=True)
    guided, distilled, random = (np.abs(one[:, 0] - 0.5 * observations[:, 0]).mean() for one in (actions, imitated, drawn))
    assert guided < 0.5 * random
    assert distilled < guided + 0.03 * (random - guided)
    assert np.abs(imitated - actions).mean() < 0.05
    student.save(tmp_path / "policy")
    loaded = MlpPolicy.load(tmp_path / "policy")
    np.testing.assert_array_equal(loaded.predict(observations, deterministic=True)[0], imitated)


class Far(Aim):
    """Where the replay buffer of the next test has never been."""

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        return np.abs(observation), info

    def step(self, action):
        observation, *rest = super().step(action)
        return np.abs(observation), *rest


def test_a_distilled_policy_learns_where_it_gets_to_itself(teacher):
    observations = teacher.replay_buffer.observations.copy()
    teacher.replay_buffer.observations[:] = -np.abs(observations)
    try:
        arguments = {"n_observations": 500, "gradient_steps": 500}
        students = [teacher.distil(**arguments), teacher.distil(**arguments, env=Far(), n_rounds=1)]
    finally:
        teacher.replay_buffer.observations[:] = observations
    seen = np.random.default_rng(1).uniform(0.3, 1.0, (500, 2)).astype(np.float32)
    actions, _ = teacher.predict(seen, deterministic=True)
    errors = [np.abs(student.predict(seen, deterministic=True)[0] - actions).mean() for student in students]
    assert errors[1] < 0.05 and errors[1] < 0.5 * errors[0], errors


def test_an_environment_to_distil_in_is_one_of_its_own_with_the_models_spaces(teacher):
    for own in (teacher.get_env(), teacher.get_env().envs[0], teacher.get_env().envs[0].unwrapped):
        with pytest.raises(ValueError, match="must not be the environment that is learned from"):
            teacher.distil(env=own)
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        teacher.distil(env="Pendulum-v1")
    with pytest.raises(ValueError, match="as they are, got one with VecNormalize"):
        teacher.distil(env=VecNormalize(DummyVecEnv([Aim])))


def test_observations_that_are_visited_are_normalised_as_those_learned_from():
    env = VecNormalize(DummyVecEnv([Aim]))
    model = CausalGDP("MlpPolicy", env, **KWARGS).learn(150)
    before = env.obs_rms.mean.copy(), env.obs_rms.count
    visits = visited(model.policy, DummyVecEnv([Aim]), 50, env)
    assert len(visits) == 50 and np.array_equal(env.obs_rms.mean, before[0]) and env.obs_rms.count == before[1]
    # Uniform numbers in [-1, 1] have a standard deviation of .58
    assert float(th.cat(visits).std()) == pytest.approx(1.0, abs=0.25)
    model.distil(50, 5, env=Aim(), n_rounds=1)
    assert env.obs_rms.count == before[1]


def test_distilling_leaves_the_model_as_it_was(teacher):
    before, buffers = vector(teacher.policy), (np.random.get_state()[1].copy(), th.random.get_rng_state())
    teacher.distil(n_observations=600, gradient_steps=5, env=Aim())
    assert th.equal(vector(teacher.policy), before)
    assert np.array_equal(np.random.get_state()[1], buffers[0]) and th.equal(th.random.get_rng_state(), buffers[1])


def test_a_distilled_policy_is_quicker(teacher):
    student = teacher.distil(n_observations=100, gradient_steps=2)

    def seconds(policy):
        observation = np.zeros(2, np.float32)
        policy.predict(observation, deterministic=True)
        times = []
        for _ in range(200):
            start = time.process_time()
            policy.predict(observation, deterministic=True)
            times.append(time.process_time() - start)
        return np.median(times)

    assert seconds(student) < 0.7 * seconds(teacher.policy)


def test_distilling_before_learning_says_so():
    model = CausalGDP("MlpPolicy", Aim(), **KWARGS)
    model.learn(model.learning_starts - 1)
    with pytest.warns(UserWarning, match="has not been trained: what is distilled is the policy that it started with"):
        model.distil(n_observations=10, gradient_steps=1)


def test_distilling_needs_a_policy_that_denoises_and_transitions(teacher):
    with pytest.raises(ValueError, match="needs transitions, got none"):
        CausalGDP("MlpPolicy", Aim()).distil()
    with pytest.raises(ValueError, match="needs a policy that denoises"):
        CausalGDP("MlpPolicy", Aim(), **preset("dtql", **KWARGS)).distil()
    with pytest.raises(ValueError, match=r"n_rounds must be an integer from 0 .*, got -1"):
        teacher.distil(n_rounds=-1)
    with pytest.raises(ValueError, match=r"gradient_steps must be an integer from 1 .*, got 0"):
        teacher.distil(gradient_steps=0)
