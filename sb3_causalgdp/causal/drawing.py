"""The one place from which graphs and answers reach the pictures, which know them, and pandas: imported when they are used."""

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from sb3_causalgdp.hints import how_to_install

if TYPE_CHECKING:
    import pandas as pd

PLOTS_HINT = f"matplotlib and networkx are needed for this: {how_to_install('plots')}"


def picture(name: str) -> Callable[..., Any]:
    """
    :param name: A public name of :mod:`sb3_causalgdp.causal.plots`
    :return: What draws
    :raises ImportError: when matplotlib or networkx is missing
    """
    from sb3_causalgdp.causal import plots

    return getattr(plots, name)


def frame_of(rows: Iterable[Sequence[Any]], columns: Sequence[str]) -> "pd.DataFrame":
    """
    :param rows: Values of each row
    :param columns: Names of the columns
    :return: a data frame
    :raises ImportError: when pandas is missing
    """
    try:
        import pandas as pd
    except ImportError as error:
        raise ImportError("pandas is needed for this: pip install pandas") from error
    return pd.DataFrame(list(rows), columns=list(columns))
