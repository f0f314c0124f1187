"""What the pictures of causal graphs have in common: sizes, checks of arguments, files."""

import os
from collections.abc import Sequence
from typing import Any

from sb3_causalgdp.causal.graph import PLOTS_HINT
from sb3_causalgdp.causal.variables import TransitionVariables
from sb3_causalgdp.files import replaced_when_done

try:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
except ImportError as error:
    raise ImportError(PLOTS_HINT) from error

FONT_SIZE = 9
INCHES_PER_CHARACTER = 0.095  # at FONT_SIZE, on the generous side
ROW_INCHES = 0.34
DPI = 120
AS_TEXT: dict[str, Any] = {"parse_math": False}
"""Of the texts with names of variables, in which a dollar sign is one."""


def label_inches(variables: TransitionVariables) -> float:
    return INCHES_PER_CHARACTER * max(map(len, variables.names))


def check_choice(argument: str, given: str, known: Sequence[str]) -> None:
    if given not in known:
        raise ValueError(f"{argument} must be one of {known}, got {given!r}")


def check_suffix(path: str | os.PathLike[str] | None) -> None:
    if path is None:
        return
    known = sorted(FigureCanvasAgg.get_supported_filetypes())
    if os.path.splitext(path)[1].lower().lstrip(".") not in known:
        raise ValueError(f"path must end in one of .{', .'.join(known)}, got {os.fspath(path)!r}")


def save_figure(figure: Figure, path: str | os.PathLike[str] | None) -> None:
    """Write the picture; a reader sees the old file or the new one, never a half."""
    if path is not None:
        with replaced_when_done(path) as temporary:
            figure.savefig(temporary, dpi=DPI)
