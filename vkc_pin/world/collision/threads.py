"""How many threads look for distances."""

from __future__ import annotations

import os

__all__ = ["count_threads"]

_MOST = 8


def count_threads() -> int:
    """Return how many to use: one for each core that this process may use, 8 at most, or as `OMP_NUM_THREADS` says."""
    said = os.environ.get("OMP_NUM_THREADS", "")
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    return max(1, min(int(said) if said.isdigit() else cores, cores, _MOST))
