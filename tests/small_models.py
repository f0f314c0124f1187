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
