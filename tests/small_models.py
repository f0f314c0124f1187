"""Arguments of models that are small enough to be trained in a second."""

from typing import Any

SMALL: dict[str, Any] = {
    "learning_starts": 20,
    "batch_size": 8,
    "train_freq": 8,
    "buffer_size": 1000,
    "causal_refresh_freq": 60,
    "seed": 0,
    "device": "cpu",
    "policy_kwargs": {"net_arch": [16], "world_model_net_arch": [16, 16]},
}

# Else all actions would lie on their bounds, and be the same for that reason
SPREAD: dict[str, Any] = {"learning_rate": 1e-2, "eta": 0.01, "denoising_weight": 1.0, "n_action_candidates": 3}


def small(policy_kwargs: dict[str, Any] | None = None, **changes: Any) -> dict[str, Any]:
    """
    :param policy_kwargs: Of the policy, beside small networks
    :param changes: Further arguments
    :return: All of a small model
    """
    return {**SMALL, **changes, "policy_kwargs": {**SMALL["policy_kwargs"], **(policy_kwargs or {})}}
