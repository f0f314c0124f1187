"""Callbacks that the zoo adds."""

import math

from stable_baselines3.common.callbacks import BaseCallback


class StopOnDivergence(BaseCallback):
    """
    Raise ``ValueError`` when a loss is NaN or infinite, which prunes a trial of RL Zoo's search.

    Environments that clip their actions, as MuJoCo's do, would go on with a broken policy to the end of the trial.
    """

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        for name, value in self.logger.name_to_value.items():
            if name.startswith("train/") and not math.isfinite(value):
                raise ValueError(f"the training diverged: {name} is {value} after {self.num_timesteps} steps")
