"""Callbacks: the causal world model's schedule, pictures, and what the paper's theory says of a policy."""

from sb3_causalgdp.callbacks.world_model import CausalWorldModelCallback

__all__ = ["CausalWorldModelCallback"]
