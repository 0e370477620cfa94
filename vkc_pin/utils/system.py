"""Queries the operating system, and describes versions and machine of this process."""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import resource
import socket
import sys
from pathlib import Path
from typing import Any

PACKAGES = ("vkc-pin", "pin", "coal", "casadi", "numpy")
"""The package and the dependencies that affect motions."""


def is_file(path: Path) -> bool:
    """Return whether there is a file; `Path.is_file` raises where the name is too long for one."""
    return os.path.isfile(path)  # noqa: PTH113


def count_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):  # not on macOS
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def find_processor_name() -> str:
    """Return the name of the processor, or of its architecture."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    for line in lines:
        if line.startswith("model name"):
            _, _, name = line.partition(":")
            return name.strip()
    return platform.processor()


def has_screen() -> bool:
    """Return whether a browser can open a window."""
    variables = ("DISPLAY", "WAYLAND_DISPLAY")
    return sys.platform in ("darwin", "win32") or any(map(os.environ.get, variables))


def find_libc_version() -> str | None:
    """Return name and version of the GNU C library, or None where there is another."""
    with contextlib.suppress(OSError, ValueError):
        return os.confstr("CS_GNU_LIBC_VERSION")
    return None


def measure_peak_memory() -> float:
    """Return the largest memory use of this process so far [MB]."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # macOS states bytes, other systems kilobytes.
    per_megabyte = 2**20 if sys.platform == "darwin" else 2**10
    return peak / per_megabyte


def measure_resident_memory() -> float:
    """Return the current memory use of this process [MB], or the largest one outside Linux."""
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    except OSError:
        return measure_peak_memory()
    return int(pages) * resource.getpagesize() / 2**20


def release_freed_memory() -> None:
    """Return memory that was freed to the system, where the C library can be asked to."""
    # glibc keeps freed memory between used blocks; other C libraries have no such call
    with contextlib.suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def limit_resource(name: str, limit: int) -> None:
    """Limit a resource of this process, such as "RLIMIT_DATA", where the system has that limit."""
    # Some limits do not exist on macOS, and none can be above that of the user.
    with contextlib.suppress(AttributeError, ValueError, OSError):
        resource.setrlimit(getattr(resource, name), (limit, limit))


def find_versions() -> dict[str, str]:
    """Return the versions of `PACKAGES`."""
    from importlib.metadata import PackageNotFoundError, version  # takes as long as a scene

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
