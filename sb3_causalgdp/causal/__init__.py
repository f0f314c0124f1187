"""Causal discovery on transitions and the world model that it masks. Knows nothing of SB3 nor of diffusion."""

from typing import TYPE_CHECKING

from sb3_causalgdp.lazy import lazy_names

if TYPE_CHECKING:
    from sb3_causalgdp.causal.discovery import (
        DISCOVERY_METHODS,
        DiscoveryMethod,
        Statistics,
        discover,
        make_discovery,
        make_statistics,
        min_rows,
        register_discovery_method,
    )
    from sb3_causalgdp.causal.graph import CausalGraph
    from sb3_causalgdp.causal.guidance import (
        GUIDANCE_TARGETS,
        CausalGuidance,
        LinearisedGuidance,
        OutcomeTarget,
        OutcomeTerm,
        ReturnTarget,
        RewardTarget,
        register_guidance_target,
    )
    from sb3_causalgdp.causal.interventions import (
        ActionEffects,
        Counterfactual,
        EffectStatistics,
        InterventionalDistribution,
        StructuralModel,
        Trajectory,
    )
    from sb3_causalgdp.causal.relevance import Relevance
    from sb3_causalgdp.causal.relevance_gate import RelevanceGate, Verdict
    from sb3_causalgdp.causal.statistics.moments import StreamingMoments
    from sb3_causalgdp.causal.variables import TransitionVariables
    from sb3_causalgdp.causal.world_model import MaskedWorldModel

# The command line's help and the variables need no PyTorch
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        **{
            name: "sb3_causalgdp.causal.discovery"
            for name in (
                *("DISCOVERY_METHODS", "DiscoveryMethod", "Statistics"),
                *("discover", "make_discovery", "make_statistics", "min_rows", "register_discovery_method"),
            )
        },
        "CausalGraph": "sb3_causalgdp.causal.graph",
        **{
            name: "sb3_causalgdp.causal.guidance"
            for name in (
                *("GUIDANCE_TARGETS", "CausalGuidance", "LinearisedGuidance", "OutcomeTarget", "OutcomeTerm"),
                *("ReturnTarget", "RewardTarget", "register_guidance_target"),
            )
        },
        **{
            name: "sb3_causalgdp.causal.interventions"
            for name in (
                *("ActionEffects", "Counterfactual", "EffectStatistics"),
                *("InterventionalDistribution", "StructuralModel", "Trajectory"),
            )
        },
        "Relevance": "sb3_causalgdp.causal.relevance",
        "RelevanceGate": "sb3_causalgdp.causal.relevance_gate",
        "Verdict": "sb3_causalgdp.causal.relevance_gate",
        "StreamingMoments": "sb3_causalgdp.causal.statistics.moments",
        "TransitionVariables": "sb3_causalgdp.causal.variables",
        "MaskedWorldModel": "sb3_causalgdp.causal.world_model",
    },
)

__all__ = [
    "DISCOVERY_METHODS",
    "GUIDANCE_TARGETS",
    "ActionEffects",
    "CausalGraph",
    "CausalGuidance",
    "Counterfactual",
    "DiscoveryMethod",
    "EffectStatistics",
    "InterventionalDistribution",
    "LinearisedGuidance",
    "MaskedWorldModel",
    "OutcomeTarget",
    "OutcomeTerm",
    "Relevance",
    "RelevanceGate",
    "ReturnTarget",
    "RewardTarget",
    "Statistics",
    "StreamingMoments",
    "StructuralModel",
    "Trajectory",
    "TransitionVariables",
    "Verdict",
    "discover",
    "make_discovery",
    "make_statistics",
    "min_rows",
    "register_discovery_method",
    "register_guidance_target",
]
