"""What a trial may take: effort, so that verdicts are the same on every machine; the clock only ends what hangs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["EFFORT", "LIMITS", "TIME_LIMIT", "allowed"]

EFFORT = 1_000_000
"""Units, several times what trials take: what can be done is done with less."""
TIME_LIMIT = 1800.0
"""[s] Of a whole call. Trials that end with it have the status "time limit": such a result is none of the method's."""
LIMITS: Mapping[str, Any] = {"effort": EFFORT, "time_limit": TIME_LIMIT}
"""Both, as arguments of planners, and for the record."""


def allowed(about: Mapping[str, Any]) -> str:
    """Return in words what each trial of a record was allowed; older records had a limit of planning time alone."""
    if "effort" in about:
        return f"at most {about['effort']:,} units of effort".replace(",", " ")
    return f"at most {about['time_limit']:g} s of planning"
