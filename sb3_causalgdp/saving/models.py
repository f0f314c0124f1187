"""Saved models: what needs no pickle beside SB3's own entries, and limits for what strangers ask for."""

import io
import json
import zipfile
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, BinaryIO

import torch as th
from gymnasium import spaces
from stable_baselines3.common import torch_layers
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.save_util import is_json_serializable, load_from_zip_file, open_path
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule
from stable_baselines3.her.goal_selection_strategy import GoalSelectionStrategy

from sb3_causalgdp.acceleration.activations import FastMish
from sb3_causalgdp.causal.discovery import DISCOVERY_METHODS
from sb3_causalgdp.causal.discovery.perturbed import NoisyMoments, NoisyStatistics
from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.statistics.basis import BasisExpansion, BasisMoments
from sb3_causalgdp.causal.statistics.grouped import GroupedStatistics
from sb3_causalgdp.causal.statistics.moments import Moments, Spread, StreamingMoments
from sb3_causalgdp.causal.statistics.recent_rows import RecentRows
from sb3_causalgdp.causal.variables import TransitionVariables
from sb3_causalgdp.offline.saved_buffers import BUFFERS
from sb3_causalgdp.saving.archives import TRUST, check_sums, checked_entries, errors_of, size_of
from sb3_causalgdp.saving.plain import FORMAT, SPACES, Known, NotPlainError, Writer, decoded, read_json
from sb3_causalgdp.sources.rewards import RewardTransform

CONTENT, BLOCK = "plain.json", "plain.bin"
# What SB3's own load can do without: it is in the plain part alone
LARGE = ("causal_statistics", "_causal_graph", "causal_graph_history")
KNOWN = Known(
    filled=[
        *SPACES,
        *(FloatSchedule, LinearSchedule, ConstantSchedule),
        *(NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise),
        *(TrainFreq, TrainFrequencyUnit, GoalSelectionStrategy, RewardTransform),
        *(
            BasisMoments,
            BasisExpansion,
            StreamingMoments,
            Moments,
            Spread,
            RecentRows,
            NoisyMoments,
            NoisyStatistics,
            GroupedStatistics,
        ),
        *(TransitionVariables, CausalGraph, *DISCOVERY_METHODS.values()),
    ],
    named=[
        *BUFFERS,
        *(FastMish, th.nn.Identity, *(getattr(th.nn.modules.activation, name) for name in th.nn.modules.activation.__all__)),
        *(cls for cls in vars(th.optim).values() if isinstance(cls, type) and issubclass(cls, th.optim.Optimizer)),
        *(torch_layers.FlattenExtractor, torch_layers.NatureCNN, torch_layers.CombinedExtractor),
    ],
)
LIMITS = {
    "batch_size": 1_000_000,
    "buffer_size": 20_000_000,
    "causal_window": 100_000_000,
    "diffusion_steps": 1_000,
    "gradient_steps": 100_000,
    "n_action_candidates": 10_000,
    "n_critics": 1_000,
    "n_quantiles": 1_000,
    "n_envs": 10_000,
    "n_steps": 10_000,
    "pretrain_steps": 100_000_000,
    "torch_threads": 1_024,
    "train_freq": 1_000_000,
    "_stats_window_size": 1_000_000,
}
"""The most that the file of a stranger may ask for; what a caller passes, or trusts, has no limit."""
MOST_UNITS = 65_536


@dataclass(frozen=True)
class SavedValues:
    """
    What a saved model holds beside tensors.

    :param plain: Attributes that need no pickle, by name
    :param named: Names of all attributes in SB3's own entry
    """

    plain: dict[str, Any]
    named: frozenset[str]


# Writing ----------------------------------------------------------------------------------------------------------------


def plain_entries(values: Mapping[str, Any], known: Known) -> tuple[set[str], dict[str, bytes]]:
    """
    :param values: Attributes by name
    :param known: Classes that may be named
    :return: Which attributes are in the entries: those that JSON cannot hold, and that need no pickle; and the entries
    """
    writer, content = Writer(known), {}
    for name, value in values.items():
        if name in LARGE or not is_json_serializable(value):
            try:
                content[name] = writer.encode(value)
            except NotPlainError:
                continue
    text = json.dumps({"format": FORMAT, "attributes": content})
    return set(content), {CONTENT: text.encode(), BLOCK: b"".join(writer.blocks)}


def append_entries(archive: BinaryIO, entries: Mapping[str, bytes]) -> None:
    """
    :param archive: A zip archive that can be read and written
    :param entries: Contents by name
    """
    with zipfile.ZipFile(archive, "a") as opened:
        for name, content in entries.items():
            opened.writestr(name, content)


# Reading ----------------------------------------------------------------------------------------------------------------


def read_values(file: BinaryIO, known: Known, given: Collection[str], trusted: bool, methods: type) -> SavedValues:
    """
    Look at all of a saved model, before SB3 does.

    :param file: The zip archive, whose position stays
    :param known: Classes that it may name
    :param given: Attributes that are not read from it
    :param trusted: Whether it may hold pickles, and ask for whatever it wants
    :param methods: The model's class, whose methods no attribute may hide
    :return: Its attributes
    :raises ValueError: If it is not whole, holds pickles, or asks for too much
    """
    position, size = file.tell(), size_of(file)
    with zipfile.ZipFile(file) as archive:
        entries = checked_entries(archive, size)
        check_sums(archive, entries)
        if not trusted:
            _check_tensors(archive, entries)
        saved = read_json(archive.read("data")) if "data" in archive.namelist() else None
        if "manifest.json" in archive.namelist():
            raise ValueError("it is a checkpoint of a training, with which resume() goes on")
        if not isinstance(saved, dict):
            raise ValueError("it holds no attributes of a model: a policy that was saved alone is loaded by MlpPolicy.load")
        _check_algorithm(saved)
        plain = read_plain(archive, known, given)
    file.seek(position)
    if not trusted:
        for name in given:
            plain.pop(name, None)
        read = {name: value for name, value in {**saved, **plain}.items() if name not in given}
        _check_attributes(read, saved, plain, methods)
        check_limits(read, size)
    return SavedValues({name: value for name, value in plain.items() if name not in given}, frozenset(saved))


def read_parameters(path: Any, device: Any) -> dict[str, Any]:
    """
    The tensors of a saved model, without its attributes. None of it is run, and none is unpacked that is out of proportion.

    :param path: Its path, or a file-like object
    :param device: Device on which they should be
    :return: What ``set_parameters`` takes
    :raises ValueError: If the file is not whole, or not a saved model
    """
    file = open_path(path, "r", suffix="zip")
    try:
        with errors_of(path, "cannot be loaded"):
            position, size = file.tell(), size_of(file)
            with zipfile.ZipFile(file) as archive:
                entries = checked_entries(archive, size)
                check_sums(archive, entries)
                _check_tensors(archive, entries)
            file.seek(position)
            return load_from_zip_file(file, device=device, load_data=False)[1]
    finally:
        if file is not path:
            file.close()


def read_plain(archive: zipfile.ZipFile, known: Known, given: Collection[str] = ()) -> dict[str, Any]:
    """
    :param archive: A saved model
    :param known: Classes that it may name
    :param given: Attributes that are not read
    :return: Its attributes that need no pickle
    :raises ValueError: If an attribute cannot be read, which is named
    """
    if CONTENT not in archive.namelist():
        return {}
    return decoded(read_json(archive.read(CONTENT)), archive.read(BLOCK), known, given)


def _check_algorithm(saved: Mapping[str, Any]) -> None:
    """A file of another algorithm is not asked to be trusted."""
    policy = saved.get("policy_class")
    module = policy.get("__module__") if isinstance(policy, dict) else None
    if isinstance(module, str) and module.split(".")[0] in ("stable_baselines3", "sb3_contrib"):
        raise ValueError(f"it is a model of another algorithm, whose policy is of {module}")


def _check_attributes(read: Mapping[str, Any], saved: Mapping[str, Any], plain: Mapping[str, Any], cls: type) -> None:
    pickled = [name for name in saved if name in read and name not in plain and is_pickled(saved[name])]
    if pickled:
        several = f"{', '.join(pickled)} {'is' if len(pickled) == 1 else 'are'}"
        raise ValueError(f"{several} pickled, which could run code: {TRUST}, or give them as custom_objects")
    for name in read:
        if name == "env" or name.startswith("__") or callable(getattr(cls, name, None)):
            raise ValueError(f"{name} is no attribute that a model saves")


def is_pickled(value: Any) -> bool:
    """
    :param value: What SB3 wrote as JSON
    :return: Whether it holds a pickle
    """
    return isinstance(value, dict) and ":serialized:" in value


def _check_tensors(archive: zipfile.ZipFile, entries: Iterable[zipfile.ZipInfo]) -> None:
    """PyTorch's files are archives themselves, of entries that are not compressed."""
    for entry in entries:
        if entry.filename.endswith(".pth"):
            check_tensor_file(io.BytesIO(archive.read(entry)), entry.filename)


def check_tensor_file(file: BinaryIO, name: str) -> None:
    """
    :param file: What ``torch.save`` wrote; its position stays
    :param name: What to call it
    :raises ValueError: If it is something else, or out of proportion
    """
    position = file.tell()
    try:
        with zipfile.ZipFile(file) as archive:
            entries = checked_entries(archive, size_of(file), small=0)
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in entries):
                raise ValueError("it is compressed, as PyTorch's files are not")
            check_sums(archive, entries)
    except (zipfile.BadZipFile, ValueError, EOFError) as error:
        raise ValueError(f"{name} is no file of tensors: {error}") from error
    file.seek(position)


# Limits -----------------------------------------------------------------------------------------------------------------


def check_limits(values: Mapping[str, Any], size: int) -> None:
    """
    :param values: Attributes of a model, or arguments of a policy
    :param size: Of the file that they are from, in bytes
    :raises ValueError: If one of them is over its limit
    """
    for name, value in values.items():
        if name in LIMITS:
            _check_number(name, value, LIMITS[name])
        elif name == "policy_kwargs" or name.endswith("net_arch"):
            _check_units(name, value, size)
    for name in ("observation_space", "action_space"):
        if n_categories(values.get(name)) > size:
            raise ValueError(f"{name} has {n_categories(values[name]):,} categories, more than the file has bytes")


def _check_number(name: str, value: Any, limit: int) -> None:
    value = getattr(value, "frequency", value)
    if isinstance(value, int | float) and not isinstance(value, bool) and not value <= limit:
        raise ValueError(
            f"{name} is {value:g}, the limit is {limit:,}: if you trust where the file is from, pass trusted=True"
        )


def _check_units(name: str, value: Any, size: int) -> None:
    if isinstance(value, Mapping):
        for key, part in value.items():
            _check_units(f"{name}[{key!r}]", part, size)
            if key in LIMITS:
                _check_number(str(key), part, LIMITS[key])
    elif isinstance(value, list | tuple):
        for part in value:
            _check_units(name, part, size)
        units = [part for part in value if isinstance(part, int)]
        n_weights = sum(one * other for one, other in pairwise(units))
        if 4 * n_weights > size:
            raise ValueError(f"{name} asks for {n_weights:,} weights, more than the file has")
    else:
        _check_number(name, value, MOST_UNITS)


def n_categories(space: Any) -> int:
    """
    :param space: A space
    :return: How many categories its discrete parts have, each of which becomes an input
    """
    if isinstance(space, spaces.Dict):
        return sum(n_categories(part) for part in space.spaces.values())
    if isinstance(space, spaces.Tuple):
        return sum(n_categories(part) for part in space.spaces)
    if isinstance(space, spaces.Discrete):
        return int(space.n)
    return int(space.nvec.sum()) if isinstance(space, spaces.MultiDiscrete) else 0
