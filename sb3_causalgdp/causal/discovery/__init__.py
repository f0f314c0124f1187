import inspect
from collections.abc import Callable
from typing import Any, Protocol

from sb3_causalgdp.causal.discovery.notears import Notears
from sb3_causalgdp.causal.graph import CausalGraph
from sb3_causalgdp.causal.moments import StreamingMoments
from sb3_causalgdp.causal.variables import TransitionVariables

__all__ = ["DISCOVERY_METHODS", "DiscoveryMethod", "Notears", "make_discovery"]


class DiscoveryMethod(Protocol):
    """Turns the moments of transitions into a causal graph; any callable of this signature will do."""

    def __call__(
        self, moments: StreamingMoments, variables: TransitionVariables, previous: CausalGraph | None = None
    ) -> CausalGraph: ...


DISCOVERY_METHODS: dict[str, type] = {"notears": Notears}


def make_discovery(method: str | Callable[..., CausalGraph], **kwargs: Any) -> DiscoveryMethod:
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
    accepted = list(inspect.signature(DISCOVERY_METHODS[method]).parameters)
    unknown = sorted(set(kwargs) - set(accepted))
    if unknown:
        raise ValueError(f"unknown arguments {unknown} for discovery method {method!r}, accepted are {accepted}")
    return DISCOVERY_METHODS[method](**kwargs)
