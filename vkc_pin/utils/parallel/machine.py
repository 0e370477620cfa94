"""What results depend on beside the question: versions and the machine; and the memory that a process takes."""

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
"""The package and what motions depend on."""


def find_versions() -> dict[str, str]:
    """Return the versions of the package and of what motions depend on."""
    found = {}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "unknown"
    return found


def describe_machine() -> dict[str, Any]:
    """Return what machine this is."""
    return {
        "system": platform.system(),
        "machine": platform.machine(),
        "processor": _find_processor_name(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
    }


def _find_processor_name() -> str:
    """Return the processor's name where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next(
        (line.partition(":")[2].strip() for line in lines if line.startswith("model name")),
        platform.processor(),
    )


def measure_peak_memory() -> float:
    """Return the largest memory this process has used so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def measure_resident_memory() -> float:
    """Return the memory this process uses now [MB], or the most so far where the system does not tell."""
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    except OSError:
        return measure_peak_memory()
    return int(pages) * resource.getpagesize() / 2**20


def identify_process() -> str:
    """Return what tells this process from others, also of other machines."""
    return f"{socket.gethostname()}-{os.getpid()}"
