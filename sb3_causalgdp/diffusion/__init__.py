"""Diffusion models over actions: noise schedules, denoisers and guided samplers. Knows nothing of SB3 nor of causality."""

from sb3_causalgdp.diffusion.denoiser_types import DENOISERS, DenoiserNetwork, check_denoiser, make_denoiser, register_denoiser
from sb3_causalgdp.diffusion.denoisers import MLPDenoiser, ResidualMLPDenoiser
from sb3_causalgdp.diffusion.guidance import GUIDANCE_COVARIANCES, GUIDANCE_MODES, Guidance, GuidanceRule
from sb3_causalgdp.diffusion.guided_scheduler import ActionUnits, GuidedScheduler
from sb3_causalgdp.diffusion.plans import SAMPLERS, SPACINGS, register_sampler
from sb3_causalgdp.diffusion.samplers import sample
from sb3_causalgdp.diffusion.schedules import NOISE_SCHEDULES, NoiseSchedule, register_noise_schedule
from sb3_causalgdp.diffusion.transformer import TransformerDenoiser, causal_attention

__all__ = [
    "DENOISERS",
    "GUIDANCE_COVARIANCES",
    "GUIDANCE_MODES",
    "NOISE_SCHEDULES",
    "SAMPLERS",
    "SPACINGS",
    "ActionUnits",
    "DenoiserNetwork",
    "Guidance",
    "GuidanceRule",
    "GuidedScheduler",
    "MLPDenoiser",
    "NoiseSchedule",
    "ResidualMLPDenoiser",
    "TransformerDenoiser",
    "causal_attention",
    "check_denoiser",
    "make_denoiser",
    "register_denoiser",
    "register_noise_schedule",
    "register_sampler",
    "sample",
]
