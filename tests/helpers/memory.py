"""Measures the memory that this process has allocated and not freed, unlike its resident size."""

from __future__ import annotations

import ctypes
import gc
import sys
from collections.abc import Callable

import numpy as np
import pytest


class _Mallinfo(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_size_t)
        for name in (
            "arena",
            "ordblks",
            "smblks",
            "hblks",
            "hblkhd",
            "usmblks",
            "fsmblks",
            "uordblks",
            "fordblks",
            "keepcost",
        )
    ]


def measure_growth(
    run: Callable[[], object], *, warm: int = 3, times: int = 6
) -> tuple[float, float]:
    """Return the growth per call: bytes of compiled code, and blocks of Python's objects.

    It is the minimum over several calls, since caches fill occasionally and leaks grow every time.

    Args:
        run: Function to call.
        warm: Number of calls before the measurement.
        times: Number of measured calls.
    """
    info = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if info is None:
        pytest.skip("this C library does not report allocations")
    info.restype = _Mallinfo
    allocated = []
    for _ in range(warm + times + 1):
        run()
        gc.collect()
        usage = info()
        allocated.append((usage.uordblks + usage.hblkhd, sys.getallocatedblocks()))
    grown = np.diff(np.array(allocated[warm:], float), axis=0)
    return float(grown[:, 0].min()), float(grown[:, 1].min())
