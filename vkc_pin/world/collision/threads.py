"""Chooses the number of threads for distance queries."""

from __future__ import annotations

import os

from vkc_pin.utils.system import count_cores

__all__ = ["count_threads"]

_MAX_THREADS = 8


def count_threads() -> int:
    """Return the number of threads to use.

    That is the number of cores available to this process, limited to 8 and to `OMP_NUM_THREADS`.
    """
    requested = os.environ.get("OMP_NUM_THREADS", "")
    cores = count_cores()
    return max(1, min(int(requested) if requested.isdigit() else cores, cores, _MAX_THREADS))
