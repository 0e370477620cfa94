"""Describes versions and machine of this process."""

from __future__ import annotations

import os
import platform
import socket
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from vkc_pin.utils.system import find_processor_name

__all__ = [
    "PACKAGES",
    "describe_machine",
    "find_versions",
    "identify_process",
]

PACKAGES = ("vkc-pin", "pin", "coal", "casadi", "numpy")
"""The package and the dependencies that affect motions."""


def find_versions() -> dict[str, str]:
    """Return the versions of `PACKAGES`."""
    found = {}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "unknown"
    return found


def describe_machine() -> dict[str, Any]:
    """Return system, processor and Python version."""
    return {
        "system": platform.system(),
        "machine": platform.machine(),
        "processor": find_processor_name(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
    }


def identify_process() -> str:
    """Return a name of this process that is unique among machines."""
    return f"{socket.gethostname()}-{os.getpid()}"
