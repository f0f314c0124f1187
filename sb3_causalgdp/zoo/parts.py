"""What a page about a run is made of."""

import base64
import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from sb3_causalgdp.causal import CausalGraph

DPI = 144


@dataclass(frozen=True)
class Picture:
    """A picture in base64, ``width`` CSS pixels wide."""

    caption: str
    data: str
    width: int
    format: str = "png"


@dataclass(frozen=True)
class Table:
    """Rows of text; a folded one opens with a click on its title."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    folded: bool = False


@dataclass(frozen=True)
class Text:
    """Preformatted lines; those with a title are folded, and open with a click on it."""

    lines: str
    title: str = ""


@dataclass(frozen=True)
class Section:
    """A part of the page: remarks, then pictures, preformatted texts and tables."""

    title: str
    remarks: Sequence[str] = ()
    pictures: Sequence[Picture] = ()
    texts: Sequence[Text] = ()
    tables: Sequence[Table] = ()

    @property
    def id(self) -> str:
        """Where links to the section lead."""
        return self.title.lower().replace(" ", "-")


def guarded(title: str, make: Callable[..., Section], *args: Any) -> Section:
    """
    :param title: Of the section
    :param make: What makes it
    :param args: Of that
    :return: The section, or why there is none: one that fails must not take the others with it
    """
    try:
        return make(*args)
    except Exception as error:
        return Section(title, [f"Cannot be shown: {type(error).__name__}: {error}"])


def make_picture(figure: Figure, caption: str) -> Picture:
    """
    :param figure: A figure
    :param caption: What it shows
    :return: The figure as a picture of a page
    """
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=DPI)
    return Picture(caption, base64.b64encode(data.getvalue()).decode(), round(figure.get_figwidth() * 96))


def mean_and_spread(returns: np.ndarray) -> str:
    return f"{returns.mean():.1f}" if len(returns) == 1 else f"{returns.mean():.1f} ± {returns.std():.1f}"


def count_of_episodes(n_episodes: int) -> str:
    return "1 episode" if n_episodes == 1 else f"{n_episodes:,} episodes"


def strength(value: float, error: float) -> str:
    return f"{value:+.3g}" if np.isnan(error) else f"{value:+.3g} ± {error:.2g}"


def as_text(value: Any) -> str:
    """A value without what differs from one run to the next, such as addresses."""
    if callable(value):
        return getattr(value, "__qualname__", None) or repr(value)
    return repr(value) if isinstance(value, str) else str(value)


def moment_of(graph: CausalGraph) -> str:
    return "an unknown step" if graph.num_timesteps is None else f"step {graph.num_timesteps:,}"
