"""The one place from which graphs and answers reach the pictures, which know them: imported when one is drawn."""

from collections.abc import Callable
from typing import Any

PLOTS_HINT = 'matplotlib and networkx are needed for this: pip install "sb3_causalgdp[plots]"'


def picture(name: str) -> Callable[..., Any]:
    """
    :param name: A public name of :mod:`sb3_causalgdp.causal.plots`
    :return: What draws
    :raises ImportError: when matplotlib or networkx is missing
    """
    from sb3_causalgdp.causal import plots

    return getattr(plots, name)
