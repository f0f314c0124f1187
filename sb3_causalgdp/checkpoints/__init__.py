"""Checkpoints of a training, from which it goes on bit for bit: for any of SB3's off-policy algorithms."""

from sb3_causalgdp.checkpoints.callback import TrainingCheckpointCallback
from sb3_causalgdp.checkpoints.checkpoint import begin_training, resume, save_checkpoint

__all__ = ["TrainingCheckpointCallback", "begin_training", "resume", "save_checkpoint"]
