"""Defines trials of an experiment that other processes can import."""

from __future__ import annotations

import os
import signal
import time
from typing import Any

import numpy as np

SETTINGS = {"benchmark": "squares", "seed": 3, "scenes": ("a", "b")}


def make_trials(number: int = 6, **more: Any) -> list[dict[str, Any]]:
    """Return trials that are not in the order of their keys."""
    return [{"key": f"{k:03d}", "number": k, **more} for k in reversed(range(number))]


def solve_square(spec: dict[str, Any]) -> dict[str, Any]:
    """Run a deterministic trial with the fields and types of records."""
    k = spec["number"]
    values = {
        "evaluations": np.float64(k) / 3.0,
        "good": np.bool_(k % 2),
        "start": np.array([k, 0.1]),
        "distance": np.inf,
    }
    return {
        "number": k,
        "square": np.int64(k * k),
        **values,
        "violations": ["a, b", 'c "d"'],
        "status": "success",
    }


def divide_by_zero(spec: dict[str, Any]) -> dict[str, Any]:
    if spec["number"] == 2:
        raise ZeroDivisionError("nothing to divide by")
    return solve_square(spec)


def crash(spec: dict[str, Any]) -> dict[str, Any]:
    if spec["number"] == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return solve_square(spec)


def identify_worker(spec: dict[str, Any]) -> dict[str, Any]:
    time.sleep(0.2)
    return {"process": os.getpid(), "threads": os.environ.get("OPENBLAS_NUM_THREADS")}


def solve_slowly(spec: dict[str, Any]) -> dict[str, Any]:
    time.sleep(0.5)
    return solve_square(spec)
