"""The grammar of the pictures of graphs: what is drawn, in which groups, how much of it, in which size."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from sb3_causalgdp.causal.plots.figures import check_choice
from sb3_causalgdp.causal.plots.summary import AGGREGATES, Groups, Summary, summarize

VALUES = ("effects", "masks")


@dataclass(frozen=True)
class View:
    """
    What a picture of a causal graph shows. Every picture takes one, or its fields by name: ``graph.plot(values="masks")``.

    :param values: What the colours of a heat map are: ``"effects"``, or ``"masks"`` with the signs of the effects
    :param causes: Number of arrows into each next state of a layered graph, at least 1: the strongest. The reward gets twice
        as many
    :param groups: How to summarise, see :func:`~sb3_causalgdp.causal.plots.summary.summarize`
    :param max_variables: More states and actions than this are summarised, at least 2
    :param aggregate: ``"max"`` or ``"mean"`` of the masks, and of the effects' sizes, between two groups
    :param size: Width and height in inches; None for as much as the names need
    :raises ValueError: when a field is out of range
    """

    values: str = "effects"
    causes: int = 3
    groups: Groups = "auto"
    max_variables: int = 40
    aggregate: str = "max"
    size: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        check_choice("values", self.values, VALUES)
        check_choice("aggregate", self.aggregate, tuple(AGGREGATES))
        for name, smallest in (("causes", 1), ("max_variables", 2)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < smallest:
                raise ValueError(f"{name} must be an integer of at least {smallest}, got {value!r}")
        if self.size is not None and not (len(self.size) == 2 and min(self.size) > 0):
            raise ValueError(f"size must be a width and a height in inches, got {self.size!r}")

    def summary_of(self, graph: Any) -> Summary:
        """
        :param graph: The graph
        :return: which variables of it are drawn
        """
        return summarize(graph, self.max_variables, self.groups, self.aggregate)

    def size_or(self, width: float, height: float) -> tuple[float, float]:
        """
        :param width: In inches, where the view has no size
        :param height: In inches
        """
        return (width, height) if self.size is None else self.size


def view_of(view: View | None, options: Mapping[str, Any]) -> View:
    """
    :param view: A view; None for the default
    :param options: Fields to change, by name
    :return: the view with these fields
    :raises ValueError: on an unknown name, or a field out of range
    """
    known = [field.name for field in fields(View)]
    unknown = [name for name in options if name not in known]
    if unknown:
        raise ValueError(f"unknown options {unknown} of a picture, known are {known}")
    return replace(View() if view is None else view, **options)
