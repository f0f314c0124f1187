"""Causal discovery by name: each method says what it gathers from a stream of transitions and turns that into a graph."""

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Protocol, overload

import numpy.typing as npt

from sb3_causalgdp.causal.discovery.fully_connected import FullyConnected
from sb3_causalgdp.causal.discovery.lingam import DirectLingam
from sb3_causalgdp.causal.discovery.notears import Notears
from sb3_causalgdp.causal.discovery.partial_r2 import PartialR2
from sb3_causalgdp.causal.discovery.perturbed import Perturbed
from sb3_causalgdp.causal.discovery.world_model import WorldModelEffects
from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.statistics.moments import StreamingMoments
from sb3_causalgdp.causal.variables import TransitionVariables
from sb3_causalgdp.checks import register
from sb3_causalgdp.sources.tables import Table

__all__ = [
    "DISCOVERY_METHODS",
    "DirectLingam",
    "DiscoveryMethod",
    "FullyConnected",
    "Notears",
    "PartialR2",
    "Perturbed",
    "Statistics",
    "WorldModelEffects",
    "discover",
    "make_discovery",
    "make_statistics",
    "min_rows",
    "register_discovery_method",
]


class Statistics(Protocol):
    """What a method gathers from a stream of transitions: rows ``[s, a, s', r]`` in the order of the variables."""

    n_samples: int

    def update(self, rows: npt.ArrayLike) -> None: ...


class DiscoveryMethod(Protocol):
    """
    Turns statistics of transitions into a causal graph; any callable of this signature will do.

    A method that needs more than :class:`StreamingMoments` has a method ``make_statistics`` as well, with the arguments of
    :func:`make_statistics` behind the first; and one that cannot do with any number of rows a method ``min_rows(variables)``.
    """

    def __call__(
        self, statistics: Any, variables: TransitionVariables, previous: CausalGraph | None = None
    ) -> CausalGraph: ...


DISCOVERY_METHODS: dict[str, type] = {
    "direct_lingam": DirectLingam,
    "fully_connected": FullyConnected,
    "notears": Notears,
    "partial_r2": PartialR2,
    "perturbed": Perturbed,
    "world_model": WorldModelEffects,
}


def register_discovery_method(name: str, method: type) -> None:
    """
    Let ``causal_discovery=name`` be a method of one's own, whose constructor takes ``causal_discovery_kwargs``.

    A callable does without a name.

    :param name: Its name
    :param method: A class whose instances are a :class:`DiscoveryMethod`
    :raises ValueError: If there is another method of that name
    """
    register(DISCOVERY_METHODS, name, method, "discovery method")


def make_discovery(method: str | Callable[..., CausalGraph], /, **kwargs: Any) -> DiscoveryMethod:
    """
    Build a discovery method by name.

    :param method: A key of ``DISCOVERY_METHODS``, or a callable, which is returned as it is
    :param kwargs: Arguments of the method's constructor; none with a callable
    :return: the discovery method
    :raises ValueError: on an unknown name or unknown arguments
    """
    if callable(method):
        if kwargs:
            raise ValueError(f"a callable discovery method takes no arguments here, got {sorted(kwargs)}")
        return method
    if method not in DISCOVERY_METHODS:
        raise ValueError(f"unknown discovery method {method!r}, known are {sorted(DISCOVERY_METHODS)}")
    parameters = inspect.signature(DISCOVERY_METHODS[method]).parameters
    accepted = [name for name, parameter in parameters.items() if parameter.kind is not parameter.VAR_KEYWORD]
    unknown = sorted(set(kwargs) - set(accepted))
    # A method with arguments of its own kind, as a wrapper has, checks them itself
    if unknown and len(accepted) == len(parameters):
        raise ValueError(f"unknown arguments {unknown} for discovery method {method!r}, accepted are {accepted}")
    return DISCOVERY_METHODS[method](**kwargs)


def make_statistics(
    method: DiscoveryMethod, variables: TransitionVariables, half_life: float | None = None, window: int | None = None
) -> Statistics:
    """
    :param method: The method that will read the statistics
    :param variables: Names and order of the variables
    :param half_life: Number of new rows after which an old row weighs half; None weighs all alike
    :param window: Number of newest rows that are kept; None keeps all
    :return: statistics without any rows
    :raises ValueError: when rows are forgotten before there are as many as the method needs
    """
    statistics: Any
    if hasattr(method, "make_statistics"):
        statistics = method.make_statistics(variables, half_life, window)
    else:
        statistics = StreamingMoments(variables.n_variables, half_life, variables.names, window)
    kept, needed = getattr(statistics, "fewest_rows", math.inf), min_rows(method, variables)
    if kept < needed:
        raise ValueError(
            f"window={window!r} and half_life={half_life!r} keep as few as {kept:.0f} rows, and discovery needs {needed} for "
            f"{variables.n_states} states and {variables.n_actions} actions: keep more"
        )
    return statistics


def min_rows(method: DiscoveryMethod, variables: TransitionVariables) -> int:
    """
    :param method: A discovery method
    :param variables: Names and order of the variables
    :return: number of rows that it needs for a graph, 1 where it does not say
    """
    return method.min_rows(variables) if hasattr(method, "min_rows") else 1


@overload
def discover(
    method: str | Callable[..., CausalGraph], rows: npt.ArrayLike, variables: TransitionVariables, /, **kwargs: Any
) -> CausalGraph: ...


@overload
def discover(
    table: Any,
    /,
    *,
    states: Sequence[str] = ...,
    actions: Sequence[str] = ...,
    reward: str = ...,
    method: str | Callable[..., CausalGraph] = ...,
    **kwargs: Any,
) -> CausalGraph: ...


def discover(
    source: Any, rows: npt.ArrayLike | None = None, variables: TransitionVariables | None = None, /, **kwargs: Any
) -> CausalGraph:
    """
    Find the graph of recorded transitions, in one call: ``discover("partial_r2", rows, variables)`` with rows
    ``[s, a, s', r]`` (see :meth:`TransitionVariables.stack`, shape (N, 2 n + d + 1)), or of a table whose columns are named,
    ``discover(frame, states=["level"], actions=["valve"], reward="cost")``.

    :param source: The name of a method (a key of ``DISCOVERY_METHODS``) or a callable, with rows; or a table: a data frame, an
        Arrow table, a mapping of arrays, the path of a file, or a :class:`~sb3_causalgdp.sources.tables.Table`
    :param rows: Transitions, shape (N, 2 n + d + 1)
    :param variables: Names and order of the variables
    :param kwargs: Arguments of the method's constructor; with a table also those of
        :class:`~sb3_causalgdp.sources.tables.Table`, and ``method`` (``"partial_r2"``)
    :return: the graph
    :raises ValueError: on an unknown argument, or a table that cannot be used
    """
    if rows is not None and variables is not None:
        return _discover(source, rows, variables, kwargs)
    if isinstance(source, str) and source in DISCOVERY_METHODS:
        raise ValueError(f"the table comes first, the method by name: discover(table, method={source!r}, states=[...], ...)")
    own = [name for name in inspect.signature(Table).parameters if name in kwargs]
    method = kwargs.pop("method", "partial_r2")
    if not isinstance(source, Table):
        needed = [name for name in ("states", "actions", "reward") if name not in own]
        if needed:
            raise ValueError(f"of a table the columns are needed, as states=, actions= and reward=; missing are {needed}")
        source = Table(source, **{name: kwargs.pop(name) for name in own})
    variables = TransitionVariables(source.state_names, source.action_names)
    rows = variables.stack(source.observations, source.actions, source.next_observations, source.rewards)
    graph = _discover(method, rows, variables, kwargs)
    return replace(graph, remarks=(*graph.remarks, *source.remarks))


def _discover(
    method: str | Callable[..., CausalGraph], rows: npt.ArrayLike, variables: TransitionVariables, kwargs: dict[str, Any]
) -> CausalGraph:
    chosen = make_discovery(method, **kwargs)
    statistics = make_statistics(chosen, variables)
    statistics.update(rows)
    return chosen(statistics, variables)
