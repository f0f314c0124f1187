"""What the callbacks of a training counted and gathered, and the environments that they hold."""

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_causalgdp.checkpoints.environments import environment_state, restore_environment
from sb3_causalgdp.checkpoints.pickles import to_bytes


def all_callbacks(callback: BaseCallback) -> list[BaseCallback]:
    """
    :param callback: A callback
    :return: It and all that it holds, through lists and event callbacks
    """
    found = [callback]
    for one in getattr(callback, "callbacks", []):
        found += all_callbacks(one)
    child = getattr(callback, "callback", None)
    if isinstance(child, BaseCallback):
        found += all_callbacks(child)
    return found


def callback_states(callback: BaseCallback, fresh: Mapping[BaseCallback, dict[str, bytes]]) -> list[dict[str, Any]]:
    """
    :param callback: All callbacks of a training
    :param fresh: Their values when the training began
    :return: For each, its class, what it counted and gathered, and the state of its environments
    """
    return [
        {"class": _name(one), "values": _counted(one, fresh.get(one, {})), "environments": _callback_environments(one)}
        for one in all_callbacks(callback)
    ]


def set_callback_states(callback: BaseCallback, states: list[dict[str, Any]]) -> None:
    """
    :param callback: All callbacks of a training
    :param states: Of those of an earlier one; callbacks of the same class are taken to be the same, in their order
    """
    left = list(states)
    for one in all_callbacks(callback):
        state = next((state for state in left if state["class"] == _name(one)), None)
        if state is None:
            continue
        left.remove(state)
        vars(one).update({name: value for name, value in state["values"].items() if name in vars(one)})
        for name, of_environment in state["environments"].items():
            env = vars(one).get(name)
            if isinstance(env, VecEnv) and not of_environment["problems"]:
                _restore_if_same(env, of_environment, f"{type(one).__name__}.{name}")


def _restore_if_same(env: VecEnv, state: dict[str, Any], name: str) -> None:
    try:
        restore_environment(env, state)
    except ValueError as error:
        # It has no part in the training
        warnings.warn(f"The environments of {name} begin anew: {error}")


def _name(callback: BaseCallback) -> str:
    return f"{type(callback).__module__}.{type(callback).__qualname__}"


def _counted(callback: BaseCallback, fresh: Mapping[str, bytes]) -> dict[str, Any]:
    """Not what the constructor was given, which may be another in the resumed training."""
    return {name: value for name, value in plain_values(callback).items() if fresh.get(name) != to_bytes(value)}


def plain_values(callback: BaseCallback) -> dict[str, Any]:
    """
    :param callback: One callback
    :return: Its attributes that are numbers and arrays, or lists of them, by name
    """
    if getattr(callback, "counts_nothing", False):
        return {}
    return {
        name: value
        for name, value in vars(callback).items()
        if name not in ("locals", "globals", "num_timesteps", "verbose") and _is_plain(value)
    }


def _is_plain(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return type(value) in (bool, int, float) or isinstance(value, np.ndarray | np.generic)


def _callback_environments(callback: BaseCallback) -> dict[str, Any]:
    environments = {
        name: value for name, value in vars(callback).items() if isinstance(value, VecEnv) and name != "training_env"
    }
    return {name: environment_state(env) for name, env in environments.items()}
