"""Diffusion policies of other papers, as arguments of CausalGDP."""

import copy
import difflib
from collections.abc import Mapping
from typing import Any

# What makes the method; everything else is CausalGDP's default, with which the rest is compared under equal conditions
METHODS: dict[str, dict[str, Any]] = {
    # Wang et al., 2023, https://arxiv.org/abs/2208.06193
    "diffusion_ql": {"actor_update": "chain"},
    # Kang et al., 2023, https://arxiv.org/abs/2305.20081: equation 9, and DPM-Solver in 15 steps (section 4.2)
    "edp": {
        "actor_update": "one_step",
        "sampler": "dpm_solver",
        "diffusion_steps": 100,
        "noise_schedule": "linear",
        "policy_kwargs": {"sampling_steps": 15},
    },
    # The same with IQL (section 4.4): expectile 0.7, temperature 3
    "edp_iql": {
        "actor_update": "weighted",
        "denoising_weight": 1.0,
        "expectile": 0.7,
        "advantage_temperature": 3.0,
        "sampler": "dpm_solver",
        "diffusion_steps": 100,
        "noise_schedule": "linear",
        "policy_kwargs": {"sampling_steps": 15, "critic_normalization": "layer"},
    },
    # Chen et al., 2024, https://arxiv.org/abs/2405.19690: a deterministic policy, whose entropy term is 0 (table 4)
    "dtql": {
        "actor_update": "trust_region",
        "expectile": 0.7,
        "policy_kwargs": {"critic_normalization": "layer"},
    },
    # Ours: the attention mask is the causal graph
    "attention": {
        "policy_kwargs": {
            "denoiser": "transformer",
            "denoiser_kwargs": {"causal": True},
            "net_arch": {"pi": [64, 64], "qf": [256, 256]},
        }
    },
    # Ding et al., 2024, https://arxiv.org/abs/2405.16173, with improved actions in place of the best of 64
    "qvpo": {"actor_update": "imitation", "denoising_weight": 1.0, "diffusion_steps": 20, "noise_schedule": "cosine"},
}

# The papers' networks and optimizers, which the first three took from Diffusion-QL
_OF_DIFFUSION_QL: dict[str, Any] = {
    "learning_rate": 3e-4,
    "batch_size": 256,
    "tau": 0.005,
    "gamma": 0.99,
    "n_steps": 1,
    "policy_delay": 1,
    "pessimism": 1.0,
    "target_policy_noise": 0.0,
    "bound_penalty": 0.0,
    "n_action_candidates": 50,
    "exploration_optimism": -1.0,
    "policy_kwargs": {
        "net_arch": [256, 256, 256],
        "activation_fn": "mish",
        "critic_normalization": None,
        "normalize_observations": False,
        "prediction_type": "noise",
        "use_ema": False,
    },
}
OFFLINE: dict[str, dict[str, Any]] = {
    "diffusion_ql": {**_OF_DIFFUSION_QL, "denoising_weight": 1.0, "eta": 1.0, "max_grad_norm": 9.0},
    "edp": {**_OF_DIFFUSION_QL, "denoising_weight": 1.0, "eta": 2.0, "max_grad_norm": 9.0},
    "edp_iql": {**_OF_DIFFUSION_QL, "denoising_weight": 1.0, "max_grad_norm": 9.0},
    "dtql": {**_OF_DIFFUSION_QL, "denoising_weight": 5.0, "eta": 1.0},
    "attention": {**_OF_DIFFUSION_QL, "denoising_weight": 1.0, "eta": 1.0, "n_action_candidates": 10},
    "qvpo": {**_OF_DIFFUSION_QL, "denoising_weight": 1.0},
}

# Where a default of CausalGDP's means something else in the method: here the weight of the trust region
ONLINE: dict[str, dict[str, Any]] = {"dtql": {"denoising_weight": 0.01}}

# Guided and not, they differ in the guidance alone
NOT_ABSTRACTING: dict[str, Any] = {"causal_abstraction": False}
NOT_GUIDED: dict[str, Any] = {"guidance": None}

PRESETS = tuple(METHODS)


def preset(name: str, offline: bool = False, guided: bool = False, **changes: Any) -> dict[str, Any]:
    """
    Arguments with which :class:`~sb3_causalgdp.CausalGDP` is another method:
    ``CausalGDP("MlpPolicy", env, **preset("edp"))``.

    :param name: One of :data:`PRESETS`
    :param offline: Whether all settings are those of the method's paper, for a fixed dataset. By default only those are set
        that make the method, and the others are CausalGDP's own, for learning from an environment
    :param guided: Whether the causal guidance is plugged in
    :param changes: Arguments of your own, which win; ``policy_kwargs``, and ``denoiser_kwargs`` of one denoiser, key by key
    :return: Arguments of the constructor
    :raises ValueError: If the name is unknown, or an argument is of another kind
    """
    if not isinstance(name, str) or name not in METHODS:
        close = difflib.get_close_matches(str(name), PRESETS, n=1)
        hint = f", did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"preset must be one of {list(PRESETS)}, got {name!r}{hint}")
    for what, value in (("offline", offline), ("guided", guided)):
        if not isinstance(value, bool):
            raise ValueError(f"{what} must be True or False, got {value!r}")
    # What makes the method wins over the settings that it shares with others
    settings = OFFLINE[name] if offline else ONLINE.get(name, {})
    return _joined([settings, METHODS[name], NOT_ABSTRACTING, {} if guided else NOT_GUIDED, changes])


def _joined(parts: list[Mapping[str, Any]]) -> dict[str, Any]:
    """Later ones win; policy_kwargs are joined, as are those of one denoiser, and are copies."""
    joined: dict[str, Any] = {}
    policy_kwargs: dict[str, Any] = {}
    for part in parts:
        joined.update(part)
        own = part.get("policy_kwargs") or {}
        if not isinstance(own, Mapping):
            raise ValueError(f"policy_kwargs must be a dictionary or None, got {own!r}")
        of_denoiser = dict(own.get("denoiser_kwargs") or {})
        if own.get("denoiser", policy_kwargs.get("denoiser")) == policy_kwargs.get("denoiser"):
            of_denoiser = {**policy_kwargs.get("denoiser_kwargs", {}), **of_denoiser}
        policy_kwargs = {**policy_kwargs, **own}
        policy_kwargs.pop("denoiser_kwargs", None)
        if of_denoiser:
            policy_kwargs["denoiser_kwargs"] = of_denoiser
    if policy_kwargs:
        joined["policy_kwargs"] = policy_kwargs
    return copy.deepcopy(joined)
