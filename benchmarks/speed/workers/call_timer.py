"""
CPU time of the functions of a package, called by whatever name: every function and method of it is wrapped for a while.

A part (``critics``, ``optimizers``, ...) is a pattern of qualified names. A function's own time goes to the outermost firm
part around it, or else to the innermost loose one: what the TD target asks of the actor is the TD target's, but the TD target
is not the critics', in whose update it is called. Optimizers are always their own part.
"""

import functools
import re
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import FunctionType, MethodType, ModuleType
from typing import Any, NamedTuple

WRAPPED_DUNDERS = ("__call__",)
OTHER = "everything else"


class Part(NamedTuple):
    """``pattern`` is searched in ``module.Class.function``; ``kind`` is ``loose``, ``firm`` or ``always``."""

    name: str
    pattern: str
    kind: str


PARTS = (
    Part("optimizers", r"^torch\.optim\..*\.(step|zero_grad)$|clip_grad", "always"),
    Part(
        "sample",
        r"\._?sample(_batch|_transitions)?$(?<!Actor\.sample)(?<!samplers\.sample)|\._draw|concatenate_samples",
        "firm",
    ),
    Part("TD target", r"bootstrap|td_target", "firm"),
    Part("targets", r"polyak|update_averages$|_targets$|soft_update", "firm"),
    Part("denoising and guidance", r"denois\w*_loss|make_guidance|guidance_shift", "firm"),
    Part("Q term", r"Actor\.sample$|samplers\.sample|q_loss|q_term|\.q_values$", "firm"),
    Part("world model", r"update_world_model|world_model_loss|\.world_model\.", "firm"),
    Part("critics", r"update_critic|critic_loss", "loose"),
    Part("actor: backward and the rest", r"update_actor|actor_loss", "loose"),
)


@dataclass
class _Call:
    name: str
    part: str
    is_firm: bool
    start: float
    inside: float = 0.0


@dataclass
class FunctionTime:
    """
    :param calls: How often it was called
    :param inclusive: CPU seconds with what it calls, each recursion counted
    :param exclusive: CPU seconds without the wrapped functions that it calls
    """

    calls: int = 0
    inclusive: float = 0.0
    exclusive: float = 0.0


@dataclass
class CallTimer:
    """
    :param parts: How names are grouped
    :param clock: Seconds
    """

    parts: tuple[Part, ...] = PARTS
    clock: Callable[[], float] = time.process_time
    functions: dict[str, FunctionTime] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    _stack: list[_Call] = field(default_factory=list)
    _part_of: dict[str, Part | None] = field(default_factory=dict)

    def wrap(self, function: Callable[..., Any], name: str) -> Callable[..., Any]:
        """
        :param function: What is timed
        :param name: Its qualified name
        :return: The same, timed
        """
        found = next((part for part in self.parts if re.search(part.pattern, name)), None)

        @functools.wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            call = self._enter(name, found)
            try:
                return function(*args, **kwargs)
            finally:
                self._leave(call)

        return timed

    def _enter(self, name: str, found: Part | None) -> _Call:
        around = self._stack[-1] if self._stack else _Call("", OTHER, False, 0.0)
        part, is_firm = around.part, around.is_firm
        if found is not None and (found.kind == "always" or not around.is_firm):
            part, is_firm = found.name, found.kind != "loose"
        call = _Call(name, part, is_firm, self.clock())
        self._stack.append(call)
        return call

    def _leave(self, call: _Call) -> None:
        spent = self.clock() - call.start
        self._stack.pop()
        if self._stack:
            self._stack[-1].inside += spent
        own = spent - call.inside
        total = self.functions.setdefault(call.name, FunctionTime())
        total.calls += 1
        total.inclusive += spent
        total.exclusive += own
        self.seconds[call.part] = self.seconds.get(call.part, 0.0) + own

    @contextmanager
    def attached(
        self, prefixes: tuple[str, ...], extra: tuple[tuple[Any, str], ...] = (), owner: Any = None
    ) -> Iterator[None]:
        """
        While it lasts, all functions of these packages are timed, also where another module has imported them.

        :param prefixes: Names of packages that are imported already
        :param extra: Further functions: what holds them, and their name there
        :param owner: An object that may keep methods in attributes of its own
        """
        undo: list[tuple[Any, str, Any]] = []
        wrapped: dict[int, Callable[..., Any]] = {}
        modules = [module for name, module in sorted(sys.modules.items()) if _belongs(name, prefixes)]
        for module in modules:
            for name, value in list(vars(module).items()):
                if isinstance(value, FunctionType) and _belongs(value.__module__, prefixes):
                    if id(value) not in wrapped:
                        wrapped[id(value)] = self.wrap(value, f"{value.__module__}.{value.__qualname__}")
                    undo.append((module, name, value))
                elif isinstance(value, type) and value.__module__ == module.__name__:
                    undo += [(value, method, own) for method, own in _methods(value)]
        undo += [(holder, name, vars(holder)[name]) for holder, name in extra]
        undo += [
            (owner, name, value) for name, value in getattr(owner, "__dict__", {}).items() if isinstance(value, MethodType)
        ]
        try:
            for holder, name, value in undo:
                if id(value) not in wrapped:
                    wrapped[id(value)] = self.wrap(value, _qualified(holder, name))
                setattr(holder, name, wrapped[id(value)])
            yield
        finally:
            for holder, name, value in undo:
                setattr(holder, name, value)


def _belongs(name: str, prefixes: tuple[str, ...]) -> bool:
    return any(name == prefix or name.startswith(f"{prefix}.") for prefix in prefixes)


def _methods(owner: type) -> list[tuple[str, FunctionType]]:
    found = [(name, value) for name, value in vars(owner).items() if isinstance(value, FunctionType)]
    return [(name, value) for name, value in found if not name.startswith("__") or name in WRAPPED_DUNDERS]


def _qualified(holder: Any, name: str) -> str:
    if isinstance(holder, ModuleType):
        return f"{holder.__name__}.{name}"
    owner = holder if isinstance(holder, type) else type(holder)
    return f"{owner.__module__}.{owner.__qualname__}.{name}"
