"""Causal discovery on transitions and the world model that it masks. Knows nothing of SB3 nor of diffusion."""

from sb3_causalgdp.causal.discovery import DISCOVERY_METHODS, make_discovery
from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.guidance import CausalGuidance, LinearisedGuidance, ReturnTarget, RewardTarget
from sb3_causalgdp.causal.moments import StreamingMoments
from sb3_causalgdp.causal.variables import TransitionVariables
from sb3_causalgdp.causal.world_model import MaskedWorldModel

__all__ = [
    "DISCOVERY_METHODS",
    "CausalGraph",
    "CausalGuidance",
    "LinearisedGuidance",
    "MaskedWorldModel",
    "ReturnTarget",
    "RewardTarget",
    "StreamingMoments",
    "TransitionVariables",
    "make_discovery",
]
