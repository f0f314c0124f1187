"""Optional packages of the offline stage."""

import importlib
from typing import Any

from sb3_causalgdp.hints import how_to_install

OFFLINE_HINT = how_to_install("offline")


def need(module: str) -> Any:
    """
    Import an optional package.

    :param module: Its name
    :return: the module
    :raises ImportError: with the command that installs it
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{module} cannot be imported ({error}): {OFFLINE_HINT}") from error
