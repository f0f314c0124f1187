"""The callbacks that a training has without being asked, and the order of all of them."""

from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat

from sb3_causalgdp.callbacks.world_model import CausalWorldModelCallback
from sb3_causalgdp.checkpoints import TrainingCheckpointCallback
from sb3_causalgdp.checkpoints.callback_states import all_callbacks

PICTURE_BUDGET = 0.01
"""Share of the training's time that pictures in TensorBoard may take."""


def with_own(model: BaseAlgorithm, callbacks: list[BaseCallback], picture_freq: int) -> list[BaseCallback]:
    """
    :param model: The model that is trained
    :param callbacks: Those of the user
    :param picture_freq: Steps between pictures for TensorBoard
    :return: That of the world model unless it is among them, they, pictures for TensorBoard unless they draw, and last those
        that write checkpoints, which then hold what the others have counted
    :raises ValueError: If there are several of the world model
    """
    every_one = [one for top in callbacks for one in all_callbacks(top)]
    n_own = sum(isinstance(one, CausalWorldModelCallback) for one in every_one)
    if n_own > 1:
        raise ValueError(f"At most one CausalWorldModelCallback can be passed, got {n_own}")
    if n_own == 0:
        # In front of the others, so that evaluations and checkpoints see the new masks
        callbacks = [CausalWorldModelCallback(), *callbacks]
    if any(isinstance(one, TensorBoardOutputFormat) for one in model.logger.output_formats):
        callbacks = [*callbacks, *_pictures(every_one, picture_freq)]
    return sorted(callbacks, key=lambda one: isinstance(one, TrainingCheckpointCallback))


def _pictures(every_one: list[BaseCallback], freq: int) -> list[BaseCallback]:
    try:
        from sb3_causalgdp.callbacks.pictures import CausalPicturesCallback
    except ImportError:  # without matplotlib
        return []
    if any(isinstance(one, CausalPicturesCallback) for one in every_one):
        return []
    return [CausalPicturesCallback(freq, budget=PICTURE_BUDGET)]
