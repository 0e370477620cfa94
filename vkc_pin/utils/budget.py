"""What ends planning early: Ctrl-C, a clock, or effort, which counts work and is the same on every machine."""

from __future__ import annotations

import contextlib
import math
import signal
import time
from collections.abc import Iterator
from contextvars import ContextVar
from types import FrameType

from vkc_pin.utils.interrupt import handled

__all__ = [
    "ENDINGS",
    "Budget",
    "SpentError",
    "count_evaluations",
    "current_ending",
    "reserve_time",
    "spend",
    "unlimited",
]

ENDINGS = ("interrupted", "effort spent", "time limit")
"""Why a budget may be at its end; what becomes the status of plans."""


class SpentError(Exception):
    """The budget is at its end: whoever has something to show for it catches this; it never reaches the user."""


class Budget:
    """Limits of one planning call, which start with its construction.

    One evaluation is a configuration whose frames or distances are computed. Every iteration of
    Ipopt evaluates all waypoints.

    Args:
        seconds: Wall-clock time; None: unlimited.
        effort: Evaluations; None: unlimited.

    Attributes:
        pressed: Whether Ctrl-C was pressed.
        used: Evaluations so far.
        reserved: Purpose → time that is kept for validating the best trajectory at the end [s].
    """

    def __init__(self, seconds: float | None = None, effort: int | None = None) -> None:
        self._deadline = math.inf if seconds is None else time.perf_counter() + seconds
        self._effort = math.inf if effort is None else effort
        self.pressed, self.used = False, 0
        self.reserved: dict[str, float] = {}

    @property
    def ended(self) -> str:
        """One of `ENDINGS`, or "" while it lasts."""
        if self.pressed:
            return "interrupted"
        if self.used > self._effort:
            return "effort spent"
        late = time.perf_counter() + sum(self.reserved.values()) > self._deadline
        return "time limit" if late else ""

    @contextlib.contextmanager
    def running(self) -> Iterator[Budget]:
        """Make this the budget of the thread, and note the first Ctrl-C instead of raising; the second one raises.

        CasADi swallows KeyboardInterrupt inside a solve and reports some failure instead. Signals
        reach the main thread only: elsewhere nothing changes.
        """
        token = _RUNNING.set(self)

        def note(number: int, frame: FrameType | None) -> None:
            self.pressed = True
            signal.signal(signal.SIGINT, before)

        try:
            with handled(note) as before:
                yield self
        finally:
            _RUNNING.reset(token)


_RUNNING: ContextVar[Budget | None] = ContextVar("running", default=None)  # each thread has its own


def spend(units: int = 0) -> None:
    """Count work in the budget that runs in this thread, if there is one.

    Whatever may take long calls this often: a hundredth of a second is a good measure.

    Args:
        units: Of effort; 0: what the same call may do today and not tomorrow, like building what a
            cache has lost.

    Raises:
        SpentError: It is at its end.
    """
    budget = _RUNNING.get()
    if budget is not None:
        budget.used += units
        if budget.ended:
            raise SpentError(budget.ended)


def count_evaluations() -> int:
    """Return the evaluations so far in the budget of this thread; 0 without one."""
    budget = _RUNNING.get()
    return 0 if budget is None else budget.used


def current_ending() -> str:
    """Return which of `ENDINGS` has ended the budget of this thread, or "" while it lasts."""
    budget = _RUNNING.get()
    return "" if budget is None else budget.ended


def reserve_time(purpose: str, seconds: float, *, default: bool = False) -> None:
    """Keep time at the end of this thread's budget, as for validating the best trajectory.

    Args:
        purpose: What it is kept for; a later call with the same purpose replaces the time.
        seconds: How much [s].
        default: Keep an earlier time of the same purpose.
    """
    budget = _RUNNING.get()
    if budget is not None and not (default and budget.reserved.get(purpose)):
        budget.reserved[purpose] = seconds


@contextlib.contextmanager
def unlimited() -> Iterator[None]:
    """Let nothing count for a while: what must be done in any case."""
    token = _RUNNING.set(None)
    try:
        yield
    finally:
        _RUNNING.reset(token)
