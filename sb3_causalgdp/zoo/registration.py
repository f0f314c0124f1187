"""Make RL Zoo know CausalGDP. It has no hook for that: its tables and its manager are changed in place."""

import importlib
import sys
from typing import Any

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.zoo.algorithm import (
    ALGORITHM,
    ZOO_HINT,
    TrustingCausalGDP,
    TrustingWithoutReplayBuffer,
    WithoutReplayBuffer,
)
from sb3_causalgdp.zoo.offline_tasks import register_offline_tasks


def need_zoo(module: str) -> Any:
    """
    :param module: A module of RL Zoo
    :return: The module
    :raises ImportError: With the command that installs what is missing
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"RL Zoo cannot be imported ({error}): {ZOO_HINT}") from error


def register(for_playing: bool = False, trusted: bool = False) -> None:
    """
    Add CausalGDP to RL Zoo's algorithms, search spaces and hyperparameter files, in this process. Call it before RL Zoo parses
    a command line.

    :param for_playing: Whether models are loaded to be played, not trained
    :param trusted: Whether their files may run code
    :raises ImportError: Without RL Zoo
    """
    zoo, manager = need_zoo("rl_zoo3"), need_zoo("rl_zoo3.exp_manager")
    from sb3_causalgdp.zoo.manager import CausalGDPExperimentManager
    from sb3_causalgdp.zoo.search_space import convert_causalgdp_params, sample_causalgdp_params

    plain, trusting = (WithoutReplayBuffer, TrustingWithoutReplayBuffer) if for_playing else (CausalGDP, TrustingCausalGDP)
    zoo.ALGOS[ALGORITHM] = trusting if trusted else plain
    manager.HYPERPARAMS_SAMPLER[ALGORITHM] = sample_causalgdp_params
    manager.HYPERPARAMS_CONVERTER[ALGORITHM] = convert_causalgdp_params
    for name in ("exp_manager", "train", "enjoy"):
        module = sys.modules.get(f"rl_zoo3.{name}")
        if module is not None:
            module.ExperimentManager = CausalGDPExperimentManager  # type: ignore[attr-defined]
    register_offline_tasks()
