"""Describes versions, machine and memory use of this process."""

from __future__ import annotations

import os
import platform
import resource
import socket
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

__all__ = [
    "PACKAGES",
    "describe_machine",
    "find_versions",
    "identify_process",
    "measure_peak_memory",
    "measure_resident_memory",
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
        "processor": _find_processor_name(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
    }


def _find_processor_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")),
        platform.processor(),
    )


def measure_peak_memory() -> float:
    """Return the largest memory use of this process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def measure_resident_memory() -> float:
    """Return the current memory use of this process [MB], or the largest one outside Linux."""
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    except OSError:
        return measure_peak_memory()
    return int(pages) * resource.getpagesize() / 2**20


def identify_process() -> str:
    """Return a name of this process that is unique among machines."""
    return f"{socket.gethostname()}-{os.getpid()}"
