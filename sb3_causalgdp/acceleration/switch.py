"""All that only the clock notices, on or off at once."""

import os

VARIABLE = "SB3_CAUSALGDP_ACCELERATION"
VALUES = {"on": True, "off": False}


def _read() -> bool:
    value = os.environ.get(VARIABLE, "on")
    if value not in VALUES:
        raise ValueError(f"The environment variable {VARIABLE} must be one of {list(VALUES)}, got {value!r}")
    return VALUES[value]


_on = _read()


def is_on() -> bool:
    """
    :return: Whether anything in this folder is used; as the environment variable ``SB3_CAUSALGDP_ACCELERATION`` was when the
        package was imported
    """
    return _on
