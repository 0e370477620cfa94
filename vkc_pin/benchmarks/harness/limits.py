"""Limits trials by evaluations, so that results do not depend on the speed of the machine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["LIMITS", "MAX_EVALUATIONS", "TIME_LIMIT", "describe_limit"]

MAX_EVALUATIONS = 1_000_000
"""Several times the evaluations of a usual trial."""
TIME_LIMIT = 1800.0
"""Wall time of a call [s]; trials that it ends are no results of the method."""
LIMITS: Mapping[str, Any] = {"max_evaluations": MAX_EVALUATIONS, "time_limit": TIME_LIMIT}
"""Both, as arguments of planners, and for the record."""


def describe_limit(about: Mapping[str, Any]) -> str:
    """Return the limit of a record's trials in words; old records limit planning time."""
    if "max_evaluations" in about:
        return f"at most {about['max_evaluations']:,} evaluations".replace(",", " ")
    return f"at most {about['time_limit']:g} s of planning"
