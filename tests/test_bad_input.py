import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from small_models import SMALL
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_causalgdp import CausalGDP, CausalWorldModelCallback


class FaultyEnv(gym.Env):
    """Episodes of ten steps; one value can be put in at one step of the environment's life."""

    def __init__(self, fault=None, value=np.nan, fault_at=7, dict_observation=False):
        part = spaces.Box(-10.0, 10.0, (3,))
        self.observation_space = spaces.Dict({"part": part}) if dict_observation else part
        self.action_space = spaces.Box(-1.0, 1.0, (1,))
        self.fault, self.value, self.fault_at = fault, value, fault_at
        self.total = 0

    def _observe(self, broken):
        values = self.np_random.normal(size=3).astype(np.float32)
        if broken:
            values[1] = self.value
        return {"part": values} if isinstance(self.observation_space, spaces.Dict) else values

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.n_steps = 0
        return self._observe(self.fault == "reset" and self.total == self.fault_at), {}

    def step(self, action):
        self.n_steps += 1
        self.total += 1
        now = self.total == self.fault_at
        reward = self.value if now and self.fault == "reward" else 1.0
        return self._observe(now and self.fault == "observation"), reward, self.n_steps == 10, False, {}


def make(env="Pendulum-v1", policy="MlpPolicy", **kwargs):
    return CausalGDP(policy, env, **{**SMALL, **kwargs})


# Spaces -----------------------------------------------------------------------------------------------------------------


def test_discrete_actions_are_refused():
    with pytest.raises(AssertionError, match="only supports"):
        make("CartPole-v1")


def test_unbounded_actions_are_refused():
    class UnboundedEnv(FaultyEnv):
        def __init__(self):
            super().__init__()
            self.action_space = spaces.Box(-np.inf, np.inf, (1,))

    with pytest.raises(AssertionError, match="finite lower and upper bound"):
        make(UnboundedEnv())


def test_the_wrong_policy_is_refused():
    with pytest.raises(ValueError, match="MultiInputPolicy"):
        make(FaultyEnv(dict_observation=True))
    with pytest.raises(ValueError, match="unknown"):
        make(policy="NoSuchPolicy")
    with pytest.raises(AssertionError, match="NatureCNN"):
        make(policy="CnnPolicy")


# Values of the environment ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("fault", "fault_at", "name", "n_stored"),
    [
        ("observation", 7, "observation", 6),
        ("observation", 10, "terminal observation", 9),
        ("reset", 10, "observation", 9),
        ("reward", 7, "reward", 6),
    ],
    ids=["observation", "terminal observation", "observation after a reset", "reward"],
)
def test_what_is_not_finite_is_named_and_not_stored(fault, fault_at, name, n_stored, value):
    model = make(FaultyEnv(fault, value, fault_at))
    with pytest.raises(ValueError, match=f"NaN or infinite {name} at step {fault_at}, index .*: {value}") as error:
        model.learn(40)
    assert "Nothing of this step was stored" in str(error.value)
    assert model.replay_buffer.pos == n_stored
    for values in (model.replay_buffer.observations, model.replay_buffer.next_observations, model.replay_buffer.rewards):
        assert np.isfinite(values).all()
    # The environment has recovered, and training goes on
    model.learn(40, reset_num_timesteps=False)
    assert all(bool(th.isfinite(values).all()) for values in model.policy.state_dict().values())


class DoubleEnv(FaultyEnv):
    """Its observations and rewards are float64."""

    def __init__(self, fault, value, fault_at=7, dtype=np.float64):
        super().__init__(fault, value, fault_at)
        self.observation_space = spaces.Box(-np.inf, np.inf, (3,), dtype)

    def _observe(self, broken):
        values = super()._observe(False).astype(np.float64)
        if broken:
            values[1] = self.value
        return values


@pytest.mark.filterwarnings("ignore:overflow encountered")
@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("fault", ["observation", "reward"])
@pytest.mark.parametrize("value", [1e39, -1e300, np.inf])
def test_what_overflows_float32_is_not_stored(value, fault, dtype, normalised):
    env = make_vec_env(lambda: DoubleEnv(fault, value, dtype=dtype), n_envs=1)
    model = make(VecNormalize(env) if normalised else env)
    with pytest.raises(ValueError, match=f"(infinite {fault}|{fault} that is infinite in float32) at step 7, index "):
        model.learn(40)
    buffer = model.replay_buffer
    assert buffer.pos == 6
    for values in (buffer.observations, buffer.next_observations, buffer.rewards):
        assert np.abs(values).max() < 1e38


def test_large_numbers_that_float32_holds_are_stored():
    model = make(DoubleEnv("observation", 1e30))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(8)
    assert np.abs(model.replay_buffer.next_observations).max() == 1e30


def test_the_first_observation_is_looked_at_too():
    model = make(FaultyEnv("reset", fault_at=0))
    with pytest.raises(ValueError, match=r"NaN or infinite observation at step 0, index \[0, 1\]"):
        model.learn(40)
    assert model.replay_buffer.pos == 0


def test_the_part_of_a_dictionary_and_the_environment_are_named():
    environments = iter([FaultyEnv(dict_observation=True), FaultyEnv("observation", dict_observation=True, fault_at=3)])
    model = make(make_vec_env(lambda: next(environments), n_envs=2), "MultiInputPolicy")
    with pytest.raises(ValueError, match=r"observation\['part'\] at step 6, index \[1, 1\]: nan"):
        model.learn(40)
    assert model.replay_buffer.pos == 2


def test_with_vec_normalize_too():
    env = VecNormalize(make_vec_env(lambda: FaultyEnv("reward"), n_envs=1))
    model = make(env)
    with pytest.raises(ValueError, match="NaN or infinite reward at step 7"):
        model.learn(40)
    assert model.replay_buffer.pos == 6


def test_a_constant_observation_has_no_edges_and_gives_no_warning():
    class ConstantEnv(FaultyEnv):
        def _observe(self, broken):
            return np.array([1e3, *super()._observe(broken)[1:]], dtype=np.float32)

        def __init__(self):
            super().__init__()
            self.observation_space = spaces.Box(-1e4, 1e4, (3,))

    model = make(ConstantEnv())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(128, callback=CausalWorldModelCallback(min_transitions=40))
    graph = model.causal_graph()
    assert graph.constant_variables == ("obs[0]", "obs[0]'", "reward")
    assert not any("obs[0]" in (edge.cause, edge.effect.removesuffix("'")) for edge in graph.edges())
    assert model.policy.is_guided
    observation = np.array([1e3, 0.0, 0.0], dtype=np.float32)
    for deterministic in (True, False):
        assert np.isfinite(model.predict(observation, deterministic=deterministic)[0]).all()
    assert all(bool(th.isfinite(values).all()) for values in model.policy.state_dict().values())


def test_too_few_transitions_are_said_once_and_then_it_works():
    model = make(causal_refresh_freq=20)
    with pytest.warns(UserWarning, match="Causal discovery waits") as caught:
        model.learn(88, callback=CausalWorldModelCallback(min_transitions=70))
    assert sum("Causal discovery waits" in str(warning.message) for warning in caught) == 1
    assert model.causal_graph().num_timesteps == 80
    assert model.policy.is_guided


# Arguments --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("argument", "accepted"),
    [
        ("noise_schedule", ["cosine", "linear", "vp"]),
        ("sampler", ["ddpm", "ddim"]),
        ("guidance", ["posterior", "score", "normalized", "None"]),
        ("guidance_target", ["return", "reward"]),
        ("guidance_covariance", ["tweedie", "isotropic", "unit_gaussian"]),
        ("causal_discovery", ["notears"]),
        ("activation_fn", ["mish", "relu", "tanh"]),
    ],
)
def test_an_unknown_name_is_refused_at_once_with_those_that_are_known(argument, accepted):
    kwargs = {argument: "no_such_thing"}
    if argument == "activation_fn":
        kwargs = {"policy_kwargs": {**SMALL["policy_kwargs"], **kwargs}}
    with pytest.raises(ValueError, match="no_such_thing") as error:
        make(**kwargs)
    for name in accepted:
        assert name in str(error.value)


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("eta", -1.0),
        ("eta", float("nan")),
        ("denoising_weight", -0.1),
        ("denoising_weight", float("inf")),
        ("exploration_noise", -0.1),
        ("state_guidance_scale", -1.0),
        ("outcome_guidance_scale", float("nan")),
        ("guidance_scale", -1.0),
        ("guidance_scale", []),
        ("guidance_scale", [1.0, 2.0]),
        ("guidance_scale", float("inf")),
        ("diffusion_steps", 0),
        ("diffusion_steps", 2.5),
        ("ddim_eta", 1.5),
        ("n_action_candidates", 0),
        ("max_grad_norm", 0.0),
        ("causal_refresh_freq", 0),
        ("causal_half_life", -5.0),
    ],
)
def test_a_value_that_makes_no_sense_is_refused_at_once(argument, value):
    with pytest.raises(ValueError, match=argument.removeprefix("causal_half")):
        make(**{argument: value})


def test_arguments_of_the_discovery_method_are_checked_at_once():
    with pytest.raises(ValueError, match=r"unknown arguments \['treshold'\].*'threshold'"):
        make(causal_discovery_kwargs={"treshold": 0.1})
    with pytest.raises(ValueError, match="threshold must be in"):
        make(causal_discovery_kwargs={"threshold": -0.1})


@pytest.mark.parametrize("net_arch", [[], [16, 8], [0]])
def test_layers_of_the_world_model_have_one_size(net_arch):
    with pytest.raises(ValueError, match="world_model_net_arch"):
        make(policy_kwargs={"world_model_net_arch": net_arch})


def test_unknown_arguments_of_the_policy_are_refused():
    with pytest.raises(TypeError, match="no_such_argument"):
        make(policy_kwargs={"no_such_argument": 1})


@pytest.mark.parametrize("train_freq", ["4", ("1", "episode"), "nonsense", (1, "close")])
def test_a_train_frequency_that_makes_no_sense_is_refused(train_freq):
    with pytest.raises(ValueError, match="train_freq"):
        make(train_freq=train_freq)
