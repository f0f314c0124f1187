"""Every argument has one entry in a table; what it does not accept is refused by name, and what it accepts works."""

import inspect
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from gymnasium.envs.classic_control import PendulumEnv
from small_models import SMALL
from stable_baselines3 import SAC
from stable_baselines3.common.env_util import make_vec_env

from sb3_causalgdp import CausalGDP, MlpPolicy
from sb3_causalgdp.arguments import CONSTRUCTOR_ARGUMENTS, POLICY_ARGUMENTS
from sb3_causalgdp.offline.algorithm import OfflineToOnlineAlgorithm
from sb3_causalgdp.policies import CausalGDPPolicy

WILD = [
    float("nan"),
    float("inf"),
    -1,
    0,
    7,
    0.5,
    1e300,
    10**30,
    True,
    None,
    "no_such_thing",
    [],
    {"no_such": 1},
    np.int64(2),
    np.float32(0.5),
    object(),
]
# What these accept does not say yet whether it is there, or takes half a minute
NOT_TRAINED = ("offline_dataset", "pretrain_steps", "compile")
SET_BY_THE_ALGORITHM = ("observation_space", "action_space", "lr_schedule", "discount")


def make(**kwargs):
    return CausalGDP(**{"policy": "MlpPolicy", "env": "Pendulum-v1", **SMALL, **kwargs})


def in_policy(**kwargs):
    return {"policy_kwargs": {**SMALL["policy_kwargs"], **kwargs}}


def is_refused_by_name_or_right(name, kwargs):
    """Whether it was refused; anything else than these two fails."""
    try:
        model = make(**kwargs)
    except (TypeError, ValueError) as error:
        assert name in str(error), f"{name}={kwargs[name] if name in kwargs else kwargs}: {error}"
        assert "\n" not in str(error)
        return True
    if name not in NOT_TRAINED and model.policy is not None:
        model.learn(48)
    return False


# The table --------------------------------------------------------------------------------------------------------------


def test_every_argument_has_an_entry():
    assert set(CONSTRUCTOR_ARGUMENTS) == set(inspect.signature(CausalGDP.__init__).parameters) - {"self"}
    assert set(POLICY_ARGUMENTS) == set(inspect.signature(CausalGDPPolicy.__init__).parameters) - {"self"}
    own = set(inspect.signature(OfflineToOnlineAlgorithm.__init__).parameters) - {"self", "args", "kwargs"}
    assert own <= set(CONSTRUCTOR_ARGUMENTS)


def test_every_default_is_accepted():
    for function, table in ((CausalGDP, CONSTRUCTOR_ARGUMENTS), (CausalGDPPolicy, POLICY_ARGUMENTS)):
        for name, parameter in inspect.signature(function.__init__).parameters.items():
            if parameter.default is not parameter.empty:
                assert table[name].read(parameter.default) == parameter.default


@pytest.mark.parametrize("name", CONSTRUCTOR_ARGUMENTS)
def test_wild_values_are_refused_by_name_or_right(name):
    wild = [value for value in WILD if not (name == "env" and isinstance(value, str))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        refused = [is_refused_by_name_or_right(name, {name: value}) for value in wild]
    # Each argument refuses something, and no value is refused only because all are
    assert sum(refused) >= len(wild) // 3


@pytest.mark.parametrize("name", sorted(set(POLICY_ARGUMENTS) - set(SET_BY_THE_ALGORITHM)))
def test_wild_values_of_the_policy_are_refused_by_name_or_right(name):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        refused = [is_refused_by_name_or_right(name, in_policy(**{name: value})) for value in WILD]
    assert sum(refused) >= len(WILD) // 3


def a_word(progress):
    return "fast"


def less_than_nothing(progress):
    return -progress


def name_of(value):
    """Without addresses, which each process has others of."""
    return value if isinstance(value, str) else getattr(value, "__name__", repr(value))


@pytest.mark.parametrize(
    "kwargs",
    [
        {"batch_size": 0},
        {"gamma": 1.5},
        {"n_steps": 0},
        {"buffer_size": -5},
        {"sample_masks": "no"},
        {"causal_refresh_freq": float("nan")},
        {"tau": 7},
        {"tau": float("nan")},
        {"max_grad_norm": float("nan")},
        {"exploration_noise": 1e9},
        {"learning_starts": -1},
        {"learning_rate": a_word},
        {"learning_rate": less_than_nothing},
        {"train_freq": 0},
        {"train_freq": (1, "year")},
        {"train_freq": (1, "step", 2)},
        {"gradient_steps": -2},
        {"gradient_steps": 1_000_000_000},
        {"diffusion_steps": 1_000_000},
        {"verbose": "loud"},
        {"seed": -1},
        {"seed": 1.0},
        {"device": "no_device"},
        {"device": "meta"},
        {"policy": SAC},
        {"policy": SAC.policy_aliases["MlpPolicy"]},
        {"action_noise": 0.1},
        {"replay_buffer_class": dict},
        {"causal_discovery_kwargs": {"threshold": "low"}},
        {"buffer_size": 1, "optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}},
        {"n_steps": 3, "buffer_size": 2},
        {"pessimism": "auto", **in_policy(n_critics=1)},
        {"causal_abstraction": True, **in_policy(denoiser="transformer")},
        {"causal_abstraction": True, "actor_update": "trust_region"},
    ],
    ids=lambda kwargs: "=".join(name_of(part) for part in next(iter(kwargs.items())))[:40],
)
def test_what_makes_no_sense_is_refused_by_name(kwargs):
    with pytest.raises(ValueError, match=rf"{next(iter(kwargs))}( must be|: )"):
        make(**kwargs)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"net_arch": [0]},
        {"net_arch": {"pi": [8]}},
        {"activation_fn": th.nn.Linear},
        {"optimizer_class": th.optim.LBFGS},
        {"optimizer_kwargs": {"betas": (2.0, 3.0)}},
        {"optimizer_kwargs": {"lr": 1.0}},
        {"n_critics": 0},
        {"features_extractor_class": th.nn.Flatten},
    ],
    ids=str,
)
def test_what_makes_no_sense_for_the_policy_is_refused_by_name(kwargs):
    with pytest.raises((TypeError, ValueError), match=next(iter(kwargs))):
        make(**in_policy(**kwargs))


def test_numbers_of_numpy_become_pythons():
    model = make(
        batch_size=np.int64(8),
        policy_delay=np.int64(2),
        train_freq=(np.int32(4), "step"),
        seed=np.int64(3),
        stats_window_size=np.int64(5),
        eta=np.float32(0.5),
        tau=np.float64(0.1),
        max_q_backup=np.bool_(True),
        guidance_scale=np.ones(5),
        **in_policy(net_arch=np.array([16]), n_critics=np.int64(3), critic_normalization="layer"),
    )
    stored = (model.batch_size, model.policy_delay, model.train_freq.frequency, model.seed, model.eta, model.max_q_backup)
    assert stored == (8, 2, 4, 3, 0.5, True)
    assert [type(value) for value in stored] == [int, int, int, int, float, bool]
    assert model.guidance_scale == [1.0] * 5 and len(model.critic.q_networks) == 3
    model.learn(48)


def test_what_load_brings_is_checked_too(tmp_path):
    make().save(tmp_path / "model")
    with pytest.raises(ValueError, match=r"^policy_delay must be an integer from 1 to 1,000,000,000, got 0"):
        CausalGDP.load(tmp_path / "model", policy_delay=0)
    assert CausalGDP.load(tmp_path / "model", policy_delay=np.int64(3)).policy_delay == 3


def test_episodes_cannot_be_counted_in_several_environments():
    with pytest.raises(ValueError, match=r"train_freq must be in steps with 2 environments, got \(1, 'episode'\)"):
        make(env=make_vec_env("Pendulum-v1", n_envs=2), train_freq=(1, "episode"))


def test_a_policy_alone_checks_its_arguments():
    space = spaces.Box(-1.0, 1.0, (1,))
    with pytest.raises(ValueError, match="n_critics must be an integer from 1 to 100, got 0"):
        MlpPolicy(space, space, lambda progress: 1e-3, n_critics=0)


# Action spaces ----------------------------------------------------------------------------------------------------------

LARGEST = np.finfo(np.float32).max
SMALLEST = np.float32(1.4e-45)


class WithActions(PendulumEnv):
    def __init__(self, space):
        super().__init__()
        self.action_space = space

    def step(self, action):
        assert np.isfinite(action).all() and self.action_space.contains(action)
        return super().step(np.clip(np.asarray(action, dtype=np.float64), -2.0, 2.0)[:1])


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Box(1.0, 1.0, (1,)), "component 0 from 1 to 1 is fixed"),
        (spaces.Box(np.array([-1, 3], np.float32), np.array([1, 3], np.float32)), "component 1 from 3 to 3 is fixed"),
        (spaces.Box(-LARGEST, LARGEST, (1,)), r"from -3.40282e\+38 to 3.40282e\+38 cannot be told from \[-1, 1\] in float32"),
        (spaces.Box(-SMALLEST, SMALLEST, (1,)), "cannot be told"),
        (spaces.Box(1e8, 1e8 + 16, (1,)), "cannot be told"),
        (spaces.Box(-2, 2, (1,), np.int64), "float32 or float64"),
        (spaces.Box(-2, 2, (1,), np.float16), "float32 or float64"),
    ],
    ids=str,
)
def test_actions_that_cannot_be_told_apart_are_refused_at_construction(space, message):
    with pytest.raises(ValueError, match=f"action_space.*{message}"):
        make(env=WithActions(space))


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1e-30, 1e-30, (1,)),
        spaces.Box(-1e30, 1e30, (1,)),
        spaces.Box(-1e300, 1e300, (1,), np.float64),
        spaces.Box(1e9, 1e9 + 1e-2, (1,), np.float64),
    ],
    ids=str,
)
def test_actions_of_any_unit_are_stored_between_minus_one_and_one(space):
    model = make(env=WithActions(space))
    model.learn(48)
    stored = model.replay_buffer.actions[:48]
    assert np.abs(stored).max() <= 1.0 + 1e-6 and stored.std() > 0.1


def test_the_environment_is_asked_for():
    assert isinstance(gym.make("Pendulum-v1"), gym.Env)
    with pytest.raises(ValueError, match="env must be an id or an environment, got None"):
        make(env=None)
