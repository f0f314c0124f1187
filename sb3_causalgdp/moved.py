"""Modules that have another name now: for one release the old ones can be imported, and files that name them be read."""

import importlib
import sys
import warnings
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

_ROOMS = {
    "acceleration": "acting activations cuda_graphs device_replay gradients product_pass products",
    "callbacks": "diagnostics pictures",
    "saving": "archives numpy_pickles plain",
}
_STATISTICS = "basis degenerate grouped jackknife matrices moments recent_rows"
_PLOTS = {
    "effect_plots": "effects",
    "figures": "figures",
    "heat_maps": "heat_maps",
    "history_plots": "history",
    "layered_graphs": "layered_graphs",
    "summary": "summary",
}
_NEW_NAMES = {
    **{module: f"{room}.{module}" for room, modules in _ROOMS.items() for module in modules.split()},
    **{f"causal.{module}": f"causal.statistics.{module}" for module in _STATISTICS.split()},
    **{f"causal.{old}": f"causal.plots.{new}" for old, new in _PLOTS.items()},
    "saved": "saving.models",
    "structural": "questions",
}
MOVED = {f"{__package__}.{old}": f"{__package__}.{new}" for old, new in _NEW_NAMES.items()}
"""New full names of modules by their old ones."""
# Modules that are still there, from which a class went elsewhere
_MOVED_CLASSES = {
    (f"{__package__}.callbacks", "CausalWorldModelCallback"): f"{__package__}.callbacks.world_model",
    (f"{__package__}.offline.rewards", "RewardTransform"): f"{__package__}.sources.rewards",
}


def current_module(module: str, name: str) -> str:
    """
    :param module: Full name of a module, as a file of this or the last release has it
    :param name: What is in it
    :return: Full name of the module where that is now
    """
    return _MOVED_CLASSES.get((module, name)) or MOVED.get(module, module)


class _OldNames(MetaPathFinder):
    def find_spec(
        self, fullname: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname not in MOVED:
            return None
        warnings.warn(
            f"{fullname} is {MOVED[fullname]} now; the old name goes with the next release", DeprecationWarning, stacklevel=2
        )
        return ModuleSpec(fullname, _Alias())


class _Alias(Loader):
    def create_module(self, spec: ModuleSpec) -> ModuleType:
        module = importlib.import_module(MOVED[spec.name])
        self.own_spec = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        # Python has put the alias' own there
        module.__spec__ = self.own_spec


if not any(isinstance(finder, _OldNames) for finder in sys.meta_path):
    sys.meta_path.append(_OldNames())
