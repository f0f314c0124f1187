"""Diffusion models over actions: noise schedules, denoisers and guided samplers. Knows nothing of SB3 nor of causality."""

from sb3_causalgdp.diffusion.denoisers import MLPDenoiser
from sb3_causalgdp.diffusion.guidance import GUIDANCE_COVARIANCES, GUIDANCE_MODES, Guidance, GuidanceRule
from sb3_causalgdp.diffusion.samplers import SAMPLERS, sample
from sb3_causalgdp.diffusion.schedules import NOISE_SCHEDULES, NoiseSchedule

__all__ = [
    "GUIDANCE_COVARIANCES",
    "GUIDANCE_MODES",
    "NOISE_SCHEDULES",
    "SAMPLERS",
    "Guidance",
    "GuidanceRule",
    "MLPDenoiser",
    "NoiseSchedule",
    "sample",
]
