"""CausalGDP: diffusion policies steered by a causal world model, for Stable-Baselines3."""

from pathlib import Path
from typing import TYPE_CHECKING

from sb3_causalgdp import moved  # noqa: F401  the old names of modules
from sb3_causalgdp.lazy import lazy_names

if TYPE_CHECKING:
    from sb3_causalgdp.callbacks import CausalWorldModelCallback
    from sb3_causalgdp.causalgdp import CausalGDP
    from sb3_causalgdp.checkpoints import TrainingCheckpointCallback
    from sb3_causalgdp.divergence import TrainingDivergedError
    from sb3_causalgdp.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
    from sb3_causalgdp.presets import preset

__version__ = Path(__file__).with_name("version.txt").read_text(encoding="utf-8").strip()

# Neither SB3 nor PyTorch is imported before one of them is used: sb3_causalgdp.causal stands alone
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "CausalGDP": "sb3_causalgdp.causalgdp",
        "CausalWorldModelCallback": "sb3_causalgdp.callbacks",
        "CnnPolicy": "sb3_causalgdp.policies",
        "MlpPolicy": "sb3_causalgdp.policies",
        "MultiInputPolicy": "sb3_causalgdp.policies",
        "TrainingCheckpointCallback": "sb3_causalgdp.checkpoints",
        "TrainingDivergedError": "sb3_causalgdp.divergence",
        "preset": "sb3_causalgdp.presets",
    },
)

__all__ = [
    "CausalGDP",
    "CausalWorldModelCallback",
    "CnnPolicy",
    "MlpPolicy",
    "MultiInputPolicy",
    "TrainingCheckpointCallback",
    "TrainingDivergedError",
    "__version__",
    "preset",
]
