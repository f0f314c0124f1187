"""Files of RL Zoo's runs, read without running what they bring: YAML with Python's tags, and saved normalizations."""

import ast
import importlib
import math
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecNormalize

from sb3_causalgdp.files import replaced_when_done
from sb3_causalgdp.offline.callbacks import WholeEvalCallback
from sb3_causalgdp.saving.archives import errors_of, read_pickle
from sb3_causalgdp.zoo.replacing import replaced

TAG = "tag:yaml.org,2002:python/"
# Modules that a run's settings may name: importing another may run code that came with the run
HARMLESS = ("gymnasium", "gymnasium_robotics", "minari", "rl_zoo3", "sb3_causalgdp", "sb3_contrib", "stable_baselines3")


# Of a file, with what an alias repeats
MOST_VALUES = 100_000


class PlainLoader(yaml.SafeLoader):
    """YAML, and those of Python's tags that are data: what RL Zoo writes."""

    def get_single_data(self) -> Any:
        """
        :return: What the file says
        :raises ValueError: If aliases make it grow without end
        """
        node = self.get_single_node()
        if node is None:
            return None
        if _n_values(node, {}) > MOST_VALUES:
            raise ValueError(f"it holds more than {MOST_VALUES:,} values, with what its aliases repeat")
        return self.construct_document(node)


def _n_values(node: yaml.Node, known: dict[int, float]) -> float:
    if id(node) not in known:
        # Until it is known, so that what holds itself has no end
        known[id(node)] = math.inf
        children = node.value if isinstance(node, yaml.CollectionNode) else []
        parts = [part for child in children for part in (child if isinstance(child, tuple) else (child,))]
        known[id(node)] = 1 + sum(_n_values(part, known) for part in parts)
    return known[id(node)]


class ZooLoader(PlainLoader):
    """The same in place of the loader of RL Zoo, which evaluates and imports what settings say."""

    def get_single_data(self) -> Any:
        """
        :return: What the file says
        :raises FileError: If it cannot be read, or would run code
        """
        with errors_of(self.name, "cannot be read as YAML"):
            settings = super().get_single_data()
            check_normalize(settings)
            if isinstance(settings, Mapping):
                check_modules(settings, {})
            return settings


def _tuple(loader: PlainLoader, node: Any) -> tuple:
    return tuple(loader.construct_sequence(node, deep=True))


def _ordered(loader: PlainLoader, node: Any) -> OrderedDict:
    arguments = loader.construct_sequence(node, deep=True)
    return OrderedDict(*arguments[:1])


def _refused(loader: PlainLoader, suffix: str, node: Any) -> Any:
    raise ValueError(f"it holds !!python/{suffix}, which could run code: if you trust where the file is from, use --trusted")


for _name, _construct in {
    "str": PlainLoader.construct_yaml_str,
    "unicode": PlainLoader.construct_yaml_str,
    "int": PlainLoader.construct_yaml_int,
    "long": PlainLoader.construct_yaml_int,
    "float": PlainLoader.construct_yaml_float,
    "bool": PlainLoader.construct_yaml_bool,
    "none": PlainLoader.construct_yaml_null,
    "list": PlainLoader.construct_yaml_seq,
    "dict": PlainLoader.construct_yaml_map,
    "tuple": _tuple,
    "object/apply:collections.OrderedDict": _ordered,
}.items():
    PlainLoader.add_constructor(f"{TAG}{_name}", _construct)
PlainLoader.add_multi_constructor(TAG, _refused)


def read_settings(path: Path, trusted: bool = False) -> Any:
    """
    :param path: A YAML file of a run
    :param trusted: Whether it may name Python objects that could run code
    :return: What it says
    :raises ValueError: If it cannot be read, or not trusted and needs to be; in one line
    """
    with errors_of(path, "cannot be read as YAML"):
        text = path.read_text(encoding="utf-8")
        return yaml.load(text, Loader=yaml.UnsafeLoader if trusted else PlainLoader)


def load_normalizer(load_path: str, venv: VecEnv) -> VecNormalize:
    """
    As ``VecNormalize.load``, for files of strangers.

    :param load_path: What ``VecNormalize.save`` wrote
    :param venv: The environment that is normalised
    :return: The normalised environment
    :raises ValueError: If the file holds anything else
    """
    with errors_of(load_path, "cannot be read as VecNormalize"), open(load_path, "rb") as file:
        normalizer = read_pickle(file)
        if not isinstance(normalizer, VecNormalize):
            raise ValueError(f"it holds a {type(normalizer).__name__}")
        normalizer.set_venv(venv)
        return normalizer


def check_normalize(settings: Any) -> None:
    """
    :param settings: Of a run; RL Zoo evaluates ``normalize`` as Python
    :raises ValueError: If that is more than a dictionary of numbers and names
    """
    value = settings.get("normalize") if isinstance(settings, Mapping) else None
    if not isinstance(value, str):
        return
    try:
        call = ast.parse(value.strip(), mode="eval").body
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "dict" and not call.args:
            for keyword in call.keywords:
                ast.literal_eval(keyword.value)
        else:
            ast.literal_eval(call)
    except (ValueError, SyntaxError, TypeError, RecursionError, MemoryError) as error:
        raise ValueError(f"normalize must be a dictionary of numbers, got {value[:80]!r}") from error


def check_modules(settings: Mapping[str, Any], arguments: Mapping[str, Any]) -> None:
    """
    :param settings: Hyperparameters of a run
    :param arguments: Of its command line
    :raises ValueError: If they name modules that may have come with the run
    """
    names = [str(name) for name in arguments.get("gym_packages") or []]
    environment = str(arguments.get("env", ""))
    names += [environment.partition(":")[0]] if ":" in environment else []
    for key in ("env_wrapper", "vec_env_wrapper"):
        wrappers = settings.get(key) or []
        for wrapper in wrappers if isinstance(wrappers, list) else [wrappers]:
            names.append(str(next(iter(wrapper), "") if isinstance(wrapper, Mapping) else wrapper))
            _check_wrapper(names[-1])
    for name in names:
        if name.partition(".")[0] not in HARMLESS:
            raise ValueError(f"the run names the module of {name!r}, which could run code: if you trust it, use --trusted")


def _check_wrapper(name: str) -> None:
    """Of a harmless module, what is called has to be a wrapper."""
    module, _, attribute = name.rpartition(".")
    if module.partition(".")[0] not in HARMLESS:
        return
    try:
        wrapper = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError):
        return  # RL Zoo says so
    if not (isinstance(wrapper, type) and issubclass(wrapper, gym.Wrapper | VecEnvWrapper)):
        raise ValueError(f"the run names {name!r}, which is no wrapper and could run code: if you trust it, use --trusted")


@contextmanager
def whole_files() -> Iterator[None]:
    """RL Zoo's normalizations and evaluations are replaced only once the new ones are complete, as all that we write."""
    from rl_zoo3 import exp_manager

    save = VecNormalize.save

    def save_whole(normalizer: VecNormalize, save_path: str) -> None:
        with replaced_when_done(save_path) as file:
            save(normalizer, str(file))

    with replaced(VecNormalize, "save", save_whole), replaced(exp_manager, "EvalCallback", WholeEvalCallback):
        yield


@contextmanager
def safe_files() -> Iterator[None]:
    """RL Zoo reads YAML and normalizations of runs as its own files, which run what they hold."""
    with ExitStack() as stack:
        stack.enter_context(replaced(yaml, "UnsafeLoader", ZooLoader))
        stack.enter_context(replaced(VecNormalize, "load", staticmethod(load_normalizer)))
        yield
