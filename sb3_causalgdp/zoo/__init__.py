"""RL Zoo with CausalGDP in it: ``python -m sb3_causalgdp.zoo train --algo causalgdp --env HalfCheetah-v5 -f logs/``."""

from sb3_causalgdp.zoo.algorithm import ALGORITHM
from sb3_causalgdp.zoo.command_line import main
from sb3_causalgdp.zoo.registration import register

__all__ = ["ALGORITHM", "main", "register"]
