"""What is installed: recorded where a training starts, and shown on its page."""

import importlib.metadata

from stable_baselines3.common.utils import get_system_info

from sb3_causalgdp import __version__

PACKAGES = ("rl_zoo3", "mujoco", "gymnasium-robotics", "minari")


def installed_versions() -> dict[str, str]:
    """
    :return: What SB3 says of the system, and the versions of this package and of those that its environments and data are from
    """
    # PyTorch's version is a string of its own kind, which YAML cannot write
    versions = {name: str(value) for name, value in get_system_info(print_info=False)[0].items()}
    versions["sb3_causalgdp"] = __version__
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return versions
