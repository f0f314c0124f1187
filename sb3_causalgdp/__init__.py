"""CausalGDP: diffusion policies steered by a causal world model, for Stable-Baselines3."""

from pathlib import Path

from sb3_causalgdp import moved  # noqa: F401  the old names of modules
from sb3_causalgdp.callbacks import CausalWorldModelCallback
from sb3_causalgdp.causalgdp import CausalGDP
from sb3_causalgdp.checkpoints import TrainingCheckpointCallback
from sb3_causalgdp.divergence import TrainingDivergedError
from sb3_causalgdp.policies import CnnPolicy, MlpPolicy, MultiInputPolicy

__version__ = Path(__file__).with_name("version.txt").read_text(encoding="utf-8").strip()

__all__ = [
    "CausalGDP",
    "CausalWorldModelCallback",
    "CnnPolicy",
    "MlpPolicy",
    "MultiInputPolicy",
    "TrainingCheckpointCallback",
    "TrainingDivergedError",
    "__version__",
]
