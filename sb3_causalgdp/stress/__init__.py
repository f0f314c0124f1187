"""
Environments made hard by what does not matter, or by a world that changes: wrappers of Gymnasium, for any library.

``gymnasium.make("sb3_causalgdp.stress:Distracted/HalfCheetah-v5", noises=20, idle_actions=6)`` makes one by name.
"""

from sb3_causalgdp.stress.registration import DISTRACTED_IDS, make_stressed, register_environments
from sb3_causalgdp.stress.wrappers import (
    ConfoundedBehaviour,
    IdleActions,
    LastAction,
    NoiseDistractors,
    Nuisance,
    OtherEnvironment,
    SensorDeath,
    WeakActuator,
)

__all__ = [
    "DISTRACTED_IDS",
    "ConfoundedBehaviour",
    "IdleActions",
    "LastAction",
    "NoiseDistractors",
    "Nuisance",
    "OtherEnvironment",
    "SensorDeath",
    "WeakActuator",
    "make_stressed",
    "register_environments",
]

register_environments()
