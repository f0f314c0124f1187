"""What the arguments of the algorithm and of its policy accept: one table each."""

import difflib
import importlib.util
import inspect
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv
from torch import nn

from sb3_causalgdp.causal.discovery import DISCOVERY_METHODS
from sb3_causalgdp.causal.guidance import GUIDANCE_TARGETS
from sb3_causalgdp.diffusion.denoiser_types import DENOISERS
from sb3_causalgdp.diffusion.guidance import GUIDANCE_COVARIANCES, GUIDANCE_MODES
from sb3_causalgdp.diffusion.plans import SAMPLERS
from sb3_causalgdp.diffusion.schedules import NOISE_SCHEDULES
from sb3_causalgdp.kinds import (
    FLAG,
    FUNCTION,
    KEYWORDS,
    LONGEST,
    NONE,
    PATH,
    TEXT,
    Kind,
    NotAcceptedError,
    accepts,
    as_text,
    choice,
    instance,
    integer,
    number,
    schedule,
    sequence,
    subclass,
)
from sb3_causalgdp.offline.rewards import REWARD_TRANSFORMS

ACTOR_UPDATES = ("one_step", "chain", "weighted", "imitation", "trust_region")
CRITIC_NORMALIZATIONS = ("batch", "layer")
PREDICTION_TYPES = ("noise", "velocity")
Q_SCALES = ("value", "advantage")

# Rates and weights: their squares, and those of what they scale, stay inside float32
LARGEST_WEIGHT = 1e6
LARGEST_NUMBER = 1e30
# What is a slip, or an attack by a file, rather than a wish
MOST_STEPS = 1_000_000_000
MOST_GRADIENT_STEPS = 1_000_000
MOST_PRETRAIN_STEPS = 100_000_000
MOST_DIFFUSION_STEPS = 1_000
MOST_CANDIDATES = 10_000
MOST_THREADS = 1_024
WIDEST_LAYER = 65_536
MOST_LAYERS = LONGEST
MOST_CRITICS = 100
MOST_QUANTILES = 1_000
MOST_NAMES = 1_000_000
LARGEST_NOISE = 10.0
ACTION_PRECISION = 1e-3  # of an action's half range


def _read_train_freq(value: Any) -> Any:
    if isinstance(value, TrainFreq):
        frequency, unit = value.frequency, value.unit
    elif isinstance(value, (tuple, list)) and len(value) == 2:
        frequency, unit = value
    else:
        return STEPS.read(value)
    try:
        name = TrainFrequencyUnit(unit).value
    except ValueError as error:
        raise NotAcceptedError from error
    steps = STEPS.read(frequency)
    return value if isinstance(value, TrainFreq) else (steps, name)


def counts_episodes(train_freq: Any) -> bool:
    """
    :param train_freq: A frequency that is accepted
    :return: Whether its unit is the episode
    """
    unit = train_freq[1] if isinstance(train_freq, tuple) else "step"
    return TrainFrequencyUnit(unit) is TrainFrequencyUnit.EPISODE


def _read_device(value: Any) -> Any:
    if not isinstance(value, (str, th.device)):
        raise NotAcceptedError
    if value == "auto":
        return value
    try:
        device = th.device(value)
        if device.type == "meta":
            raise NotAcceptedError
        if device.type != "cuda" or th.cuda.is_available():
            # SB3 takes the CPU where there is no GPU at all
            th.empty(1, device=device)
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise NotAcceptedError from error
    return value


def _read_activation(value: Any) -> Any:
    if not (isinstance(value, str) or (isinstance(value, type) and issubclass(value, nn.Module))):
        raise NotAcceptedError
    if not isinstance(value, str):
        try:
            value()
        except TypeError as error:
            raise NotAcceptedError from error
    return value


def _needs_no_closure(value: type) -> bool:
    closure = inspect.signature(value.step).parameters.get("closure")  # type: ignore[attr-defined]
    return closure is None or closure.default is not closure.empty


STEPS = integer(1, MOST_STEPS)
SHARE = number(0.0, 1.0)
OPTIMISM = number(-1.0, 1.0)
TEMPERATURE = number(0.0, 100.0)
NAMES = sequence(TEXT, "a list of names, each another one", 1, MOST_NAMES, different=True)
WEIGHT = number(0.0, LARGEST_WEIGHT)
RATE = schedule(WEIGHT)
LAYERS_ACCEPTED = f"a list of at most {MOST_LAYERS} layer sizes from 1 to {as_text(WIDEST_LAYER)}"
LAYERS = sequence(integer(1, WIDEST_LAYER), LAYERS_ACCEPTED)


def _read_networks(value: Any) -> Any:
    if not isinstance(value, Mapping) or set(value) != {"pi", "qf"}:
        raise NotAcceptedError
    return {key: LAYERS.read(layers) for key, layers in value.items()}


CANDIDATES = integer(1, MOST_CANDIDATES)
NOISE = number(0.0, LARGEST_NOISE)

# The policy has these, too
DIFFUSION_ARGUMENTS: dict[str, Kind] = {
    "diffusion_steps": integer(1, MOST_DIFFUSION_STEPS),
    "noise_schedule": choice(NOISE_SCHEDULES),
    "sampler": choice(SAMPLERS),
    "ddim_eta": SHARE,
}
GUIDANCE_ARGUMENTS: dict[str, Kind] = {
    "guidance": choice(GUIDANCE_MODES) | NONE,
    "guidance_target": choice(GUIDANCE_TARGETS),
    "guidance_covariance": choice(GUIDANCE_COVARIANCES),
    "guidance_scale": WEIGHT | sequence(WEIGHT, "one of them for each diffusion step", 1, MOST_DIFFUSION_STEPS),
    "state_guidance_scale": WEIGHT,
    "outcome_guidance_scale": WEIGHT,
}

GROUPS: dict[str, dict[str, Kind]] = {
    "Environment and policy": {
        "policy": TEXT | subclass(BasePolicy, "a policy class"),
        "env": TEXT | instance((gym.Env, VecEnv), "an environment") | NONE,
        "policy_kwargs": KEYWORDS | NONE,
        "seed": integer(0, 2**32 - 1) | NONE,
        "verbose": integer(0, MOST_STEPS) | FLAG,
        "device": Kind("'auto' or a device that PyTorch has here, such as 'cpu' or 'cuda:0'", _read_device),
        "compile": FLAG | accepts("'auto' or a mode of torch.compile", lambda value: isinstance(value, str) and value != ""),
        "cuda_graph": FLAG | choice(["auto"]),
        "torch_threads": integer(1, MOST_THREADS) | choice(["auto"]) | NONE,
        "tensorboard_log": PATH | NONE,
        "stats_window_size": integer(1, MOST_STEPS),
        "_init_setup_model": FLAG,
    },
    "Collecting and updating": {
        "learning_rate": RATE,
        "critic_learning_rate": RATE | NONE,
        "world_model_learning_rate": RATE,
        "buffer_size": integer(1, 10 * MOST_STEPS),
        "batch_size": integer(1, MOST_GRADIENT_STEPS),
        "learning_starts": integer(0, MOST_STEPS),
        "train_freq": Kind(f"{STEPS.accepted}, or a tuple of one and 'step' or 'episode'", _read_train_freq),
        "gradient_steps": integer(-1, MOST_GRADIENT_STEPS),
        "tau": SHARE,
        "gamma": SHARE,
        "n_steps": integer(1, MOST_CANDIDATES),
        "action_noise": instance(ActionNoise, "an ActionNoise") | NONE,
        "exploration_noise": schedule(NOISE) | choice(["auto"]),
        "exploration_optimism": OPTIMISM,
        "exploration_temperature": TEMPERATURE,
        "replay_buffer_class": subclass(ReplayBuffer, "a subclass of ReplayBuffer") | NONE,
        "replay_buffer_kwargs": KEYWORDS | NONE,
        "optimize_memory_usage": FLAG,
    },
    "Actor and critics": {
        "denoising_weight": WEIGHT,
        "eta": WEIGHT,
        "actor_update": choice(ACTOR_UPDATES),
        "q_scale": choice(Q_SCALES),
        "expectile": number(0.0, 1.0, above=True) | NONE,
        "advantage_temperature": WEIGHT,
        "improvement_step": number(0.0, 2.0, above=True),
        "bound_penalty": WEIGHT,
        "policy_delay": STEPS,
        "world_model_delay": STEPS,
        "pessimism": SHARE | choice(["auto"]),
        "target_policy_noise": NOISE | choice(["auto"]),
        "target_noise_clip": NOISE,
        "max_q_backup": FLAG,
        "max_grad_norm": number(0.0, LARGEST_NUMBER, above=True) | NONE,
        "n_action_candidates": CANDIDATES,
    },
    "Diffusion": DIFFUSION_ARGUMENTS,
    "Guidance": GUIDANCE_ARGUMENTS,
    "Causal discovery": {
        "causal_discovery": choice(DISCOVERY_METHODS) | FUNCTION,
        "causal_discovery_kwargs": KEYWORDS | NONE,
        "causal_refresh_freq": STEPS,
        "sample_masks": FLAG,
        "causal_abstraction": FLAG | KEYWORDS | choice(["auto"]),
        "counterfactual_replay": SHARE,
        "causal_half_life": number(1.0, LARGEST_NUMBER) | NONE,
        "causal_window": integer(8, MOST_STEPS) | NONE,
        "state_names": NAMES | NONE,
        "action_names": NAMES | NONE,
    },
    "Offline data": {
        "offline_dataset": PATH | NONE,
        "pretrain_steps": integer(0, MOST_PRETRAIN_STEPS),
        "offline_fraction": schedule(SHARE),
        "reward_transform": choice(REWARD_TRANSFORMS),
    },
}
"""Every argument of :class:`~sb3_causalgdp.CausalGDP`, by what it is about, as ``docs/guide/arguments.md`` has them."""

CONSTRUCTOR_ARGUMENTS: dict[str, Kind] = {name: kind for group in GROUPS.values() for name, kind in group.items()}

DISTILLATION_ARGUMENTS: dict[str, Kind] = {
    "n_observations": STEPS,
    "gradient_steps": STEPS,
    "batch_size": integer(1, MOST_GRADIENT_STEPS),
    "learning_rate": number(0.0, LARGEST_WEIGHT, above=True),
    "n_rounds": integer(0, MOST_GRADIENT_STEPS),
}
"""Every argument of :meth:`~sb3_causalgdp.CausalGDP.distil` but the environment."""

POLICY_ARGUMENTS: dict[str, Kind] = {
    "observation_space": instance(spaces.Space, "a space of Gymnasium"),
    "action_space": instance(spaces.Box, "a Box of Gymnasium"),
    "lr_schedule": FUNCTION,
    "net_arch": LAYERS | Kind("a dictionary of two such lists, 'pi' and 'qf',", _read_networks) | NONE,
    "activation_fn": Kind("a class of torch.nn that needs no arguments, or its name", _read_activation),
    "features_extractor_class": subclass(BaseFeaturesExtractor, "a subclass of BaseFeaturesExtractor"),
    "features_extractor_kwargs": KEYWORDS | NONE,
    "normalize_images": FLAG,
    "optimizer_class": accepts(
        "a subclass of torch.optim.Optimizer whose step() needs no closure",
        lambda value: isinstance(value, type) and issubclass(value, th.optim.Optimizer) and _needs_no_closure(value),
    ),
    "optimizer_kwargs": KEYWORDS | NONE,
    "n_critics": integer(1, MOST_CRITICS),
    "n_quantiles": integer(1, MOST_QUANTILES) | NONE,
    "top_quantiles_to_drop_per_net": integer(0, MOST_QUANTILES - 1),
    "critic_normalization": choice(CRITIC_NORMALIZATIONS) | NONE,
    "normalize_observations": FLAG,
    "prediction_type": choice(PREDICTION_TYPES),
    "share_features_extractor": FLAG,
    "world_model_net_arch": sequence(
        integer(1, WIDEST_LAYER), f"a list of 1 to {MOST_LAYERS} equal layer sizes, like [128, 128],", shortest=1, equal=True
    )
    | NONE,
    "n_action_candidates": CANDIDATES,
    "exploration_noise": NOISE | choice(["auto"]),
    "exploration_optimism": OPTIMISM,
    "exploration_temperature": TEMPERATURE,
    **DIFFUSION_ARGUMENTS,
    **GUIDANCE_ARGUMENTS,
    "sampling_steps": integer(1, MOST_DIFFUSION_STEPS) | NONE,
    "denoiser": choice(DENOISERS) | subclass(nn.Module, "a class of torch.nn"),
    "denoiser_kwargs": KEYWORDS | NONE,
    "discount": SHARE,
    "one_pass": FLAG,
    "value_network": FLAG,
    "causal_abstraction": FLAG | choice(["auto"]),
    "use_ema": FLAG,
}
"""Every argument of :class:`~sb3_causalgdp.policies.CausalGDPPolicy`, what goes into ``policy_kwargs`` among them."""


def check_arguments(table: Mapping[str, Kind], values: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param table: What each argument accepts
    :param values: What was given, by name; what is not in the table is left out
    :return: What is to be stored, by name: numpy's numbers and arrays have become Python's
    :raises ValueError: If a value is not accepted, with the argument's name, what was given and what is accepted
    """
    read = {}
    for name, kind in table.items():
        if name not in values:
            continue
        try:
            read[name] = kind.read(values[name])
        except NotAcceptedError:
            raise ValueError(f"{name} must be {kind.accepted.rstrip(',')}, got {_shown(values[name])}") from None
    return read


def _shown(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 100 else f"{text[:97]}..."


def check_quantiles(n_quantiles: int, n_dropped: int) -> None:
    """
    :param n_quantiles: Number of quantiles of a critic
    :param n_dropped: How many of them do not count
    :raises ValueError: If none counts
    :raises ImportError: Without sb3-contrib, whose loss they learn by
    """
    if n_dropped >= n_quantiles:
        raise ValueError(f"top_quantiles_to_drop_per_net must be below n_quantiles={n_quantiles}, got {n_dropped}")
    if importlib.util.find_spec("sb3_contrib") is None:
        raise ImportError(f"n_quantiles={n_quantiles} needs the loss of sb3-contrib: pip install sb3-contrib")


def check_keywords(name: str, keywords: Iterable[str], function: Callable[..., Any]) -> None:
    """
    :param name: The argument that holds them
    :param keywords: Names of arguments
    :param function: A function or class that will be called with them
    :raises TypeError: If it does not know one, with the one that may be meant, or those that it knows
    """
    parameters = inspect.signature(function).parameters.values()
    if any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        return
    known = [parameter.name for parameter in parameters]
    unknown = [keyword for keyword in keywords if keyword not in known]
    if unknown:
        close = difflib.get_close_matches(unknown[0], known, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"it has {known}"
        raise TypeError(f"{name}: {getattr(function, '__name__', function)} has no argument {unknown[0]!r}, {hint}")


def check_action_space(space: spaces.Space) -> None:
    """
    :param space: The environment's actions
    :raises ValueError: If there are components that cannot be told from [-1, 1], or are fixed, or no floating point numbers
    """
    if not isinstance(space, spaces.Box):
        raise ValueError(f"action_space must be a Box, got {space}")
    if space.dtype not in (np.float32, np.float64):
        raise ValueError(
            f"action_space must be a Box of float32 or float64, got {space}: take real numbers, and round in the environment"
        )
    low, high = space.low.reshape(-1), space.high.reshape(-1)
    scaled = np.linspace(-1.0, 1.0, 9, dtype=np.float32)[:, None]
    with np.errstate(all="ignore"):
        # To the environment's units and back, as SB3 does it
        actions = low + 0.5 * (scaled + 1.0) * (high - low)
        error = np.abs(2.0 * ((actions - low) / (high - low)) - 1.0 - scaled).max(axis=0)
    bad = np.flatnonzero(~(error <= ACTION_PRECISION))
    if len(bad) > 0:
        index = int(bad[0])
        why = "is fixed" if low[index] == high[index] else f"cannot be told from [-1, 1] in {space.dtype}"
        raise ValueError(
            f"action_space: component {index} from {low[index]:g} to {high[index]:g} {why}: leave it out, or let the "
            "environment take it in other units, such as [-1, 1]"
        )
