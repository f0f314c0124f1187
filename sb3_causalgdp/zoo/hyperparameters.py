"""Hyperparameters in RL Zoo's format: where ours lie, and what the values of an entry mean."""

import difflib
import importlib.metadata
import inspect
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

from stable_baselines3.common.type_aliases import Schedule
from stable_baselines3.common.utils import LinearSchedule

from sb3_causalgdp import CausalGDP
from sb3_causalgdp.presets import preset

DISTRIBUTION = "sb3_causalgdp"
FILE_NAME = "causalgdp.yml"
# What RL Zoo takes out of an entry before the rest goes to the constructor
ZOO_KEYS = (
    "callback",
    "env_kwargs",
    "env_wrapper",
    "frame_stack",
    "monitor_kwargs",
    "n_envs",
    "n_timesteps",
    "noise_std",
    "noise_type",
    "normalize",
    "vec_env_wrapper",
)
REQUIRED_KEYS = ("n_timesteps", "policy")
COMMAND_LINE_KEYS = {
    "device": "--device",
    "env": "--env",
    "seed": "--seed",
    "tensorboard_log": "--tensorboard-log",
    "verbose": "--verbose",
}
# Arguments that may be "lin_" and a number: from there to 0 over the training
SCHEDULES = ("learning_rate", "critic_learning_rate", "world_model_learning_rate", "offline_fraction", "exploration_noise")
# YAML 1.1 asks for a dot and a sign, and reads 3e-4 as text
SCIENTIFIC = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+")


def constructor_arguments() -> dict[str, inspect.Parameter]:
    """
    :return: What an entry can set of the constructor's arguments, by name
    """
    parameters = inspect.signature(CausalGDP.__init__, eval_str=True).parameters
    return {
        name: one for name, one in parameters.items() if not name.startswith("_") and name not in ("self", *COMMAND_LINE_KEYS)
    }


def hyperparameter_file() -> Path:
    """
    :return: Our YAML file: of the checkout, if the package is imported from one, else the installed one
    :raises FileNotFoundError: If there is none
    """
    checkout = Path(__file__).parents[2]
    candidates = [checkout / "hyperparams" / FILE_NAME] if (checkout / "setup.cfg").is_file() else []
    try:
        installed = importlib.metadata.files(DISTRIBUTION) or []
        candidates += [Path(str(file.locate())) for file in installed if file.name == FILE_NAME]
    except importlib.metadata.PackageNotFoundError:
        pass
    candidates.append(Path(sys.prefix, "share", DISTRIBUTION, "hyperparams", FILE_NAME))
    for path in candidates:
        if path.is_file():
            return path.resolve()
    raise FileNotFoundError(
        f"{FILE_NAME} is neither in {' nor in '.join(str(path.parent) for path in candidates)}: name one with --conf-file"
    )


def read_entry(entry: Any) -> dict[str, Any]:
    """
    Check an entry and read its numbers.

    :param entry: What the YAML file says of one environment
    :return: A copy in which what looks like a number is one, and what has to be an integer is an int
    :raises ValueError: If a key is unknown or missing
    """
    if not isinstance(entry, Mapping):
        raise ValueError(f"the entry must be a mapping of hyperparameters, got {entry!r}")
    _check_keys(entry)
    entry = _without_preset(entry)
    arguments = constructor_arguments()
    return {key: _as_declared(key, read_numbers(value), arguments) for key, value in entry.items()}


def _without_preset(entry: Mapping[str, Any]) -> Mapping[str, Any]:
    """The same with a preset's arguments, of which those of the entry win."""
    if "preset" not in entry:
        return entry
    changes = {key: value for key, value in entry.items() if key != "preset"}
    named = entry["preset"] if isinstance(entry["preset"], Mapping) else {"name": entry["preset"]}
    if "name" not in named or not set(named) <= {"name", "offline", "guided"}:
        raise ValueError(f"preset must be a name, or a mapping of name, offline and guided, got {entry['preset']!r}")
    if not isinstance(changes.get("policy_kwargs") or {}, Mapping):
        raise ValueError(f"policy_kwargs must be a mapping beside a preset, got {changes['policy_kwargs']!r}")
    return preset(**named, **changes)


def _check_keys(entry: Mapping[str, Any]) -> None:
    known = {*constructor_arguments(), *ZOO_KEYS, "preset"}
    for key in entry:
        if key in COMMAND_LINE_KEYS:
            raise ValueError(f"{key!r} cannot be in the YAML file: it is the command line's {COMMAND_LINE_KEYS[key]}")
        if key not in known:
            close = difflib.get_close_matches(str(key), known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else "see the arguments of CausalGDP"
            raise ValueError(f"unknown hyperparameter {key!r}: {hint}")
    missing = [key for key in REQUIRED_KEYS if key not in entry]
    if missing:
        raise ValueError(f"the entry lacks {' and '.join(missing)}")


def read_numbers(value: Any) -> Any:
    """
    :param value: A value of a YAML file, which may be a list or a mapping
    :return: The same with numbers in scientific notation read
    """
    if isinstance(value, str) and SCIENTIFIC.fullmatch(value.strip()):
        return float(value)
    if isinstance(value, list):
        return [read_numbers(one) for one in value]
    if isinstance(value, dict):
        return {key: read_numbers(one) for key, one in value.items()}
    return value


def _as_declared(key: str, value: Any, arguments: Mapping[str, inspect.Parameter]) -> Any:
    if not isinstance(value, float):
        return value
    annotation = arguments[key].annotation if key in arguments else int if key in ("n_timesteps", "n_envs") else None
    accepted = get_args(annotation) or (annotation,)
    if int not in accepted or float in accepted:
        return value
    if value != int(value):
        raise ValueError(f"{key} must be an integer, got {value!r}")
    return int(value)


def make_schedule(key: str, value: Any) -> float | Schedule:
    """
    :param key: The hyperparameter, for the error
    :param value: A number, ``"lin_"`` and a number, or a function of the progress that remains
    :return: The number, or a schedule that needs no RL Zoo to be loaded
    :raises ValueError: If it is something else
    """
    if value is None or callable(value):
        return value
    try:
        if isinstance(value, str):
            name, _, start = value.partition("_")
            if name != "lin":
                raise ValueError
            return LinearSchedule(float(start), 0.0, 1.0)
        return float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{key} must be a number, or 'lin_' and a number like 'lin_3e-4', got {value!r}") from None


def merged(entry: Mapping[str, Any], sampled: Mapping[str, Any]) -> dict[str, Any]:
    """
    :param entry: Hyperparameters of the YAML file, whose ``..._kwargs`` are mappings
    :param sampled: What replaces them
    :return: Both, with the sampled values of a mapping beside those that only the YAML file gives
    """
    result = {**entry, **sampled}
    for key in ("policy_kwargs", "replay_buffer_kwargs"):
        if key in sampled:
            result[key] = {**(entry.get(key) or {}), **sampled[key]}
    return result
