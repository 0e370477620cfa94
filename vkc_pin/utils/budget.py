"""What ends planning early: Ctrl-C, a clock, or effort, which counts work and is the same on every machine."""

from __future__ import annotations

import contextlib
import math
import signal
import time
from collections.abc import Iterator
from contextvars import ContextVar
from types import FrameType

from vkc_pin.utils.interrupt import handle_interrupt

__all__ = [
    "STOP_STATUSES",
    "Budget",
    "BudgetExhaustedError",
    "count_evaluations",
    "current_ending",
    "record_evaluations",
    "reserve_time",
    "suspend_budget",
]

STOP_STATUSES = ("interrupted", "effort spent", "time limit")
"""Why a budget may be at its end; what becomes the status of plans."""


class BudgetExhaustedError(Exception):
    """The budget is at its end: whoever has something to show for it catches this; it never reaches the user."""


class Budget:
    """Limits of one planning call, which start with its construction.

    One evaluation is a configuration whose frames or distances are computed. Every iteration of
    Ipopt evaluates all waypoints.

    Args:
        seconds: Wall-clock time; None: unlimited.
        effort: Evaluations; None: unlimited.

    Attributes:
        is_interrupted: Whether Ctrl-C was pressed.
        evaluations: Evaluations so far.
        reserved: Purpose → time that is kept for validating the best trajectory at the end [s].
    """

    def __init__(self, seconds: float | None = None, effort: int | None = None) -> None:
        self._deadline = math.inf if seconds is None else time.perf_counter() + seconds
        self._effort = math.inf if effort is None else effort
        self.is_interrupted, self.evaluations = False, 0
        self.reserved: dict[str, float] = {}

    @property
    def stop_status(self) -> str:
        """One of `ENDINGS`, or "" while it lasts."""
        if self.is_interrupted:
            return "interrupted"
        if self.evaluations > self._effort:
            return "effort spent"
        late = time.perf_counter() + sum(self.reserved.values()) > self._deadline
        return "time limit" if late else ""

    @contextlib.contextmanager
    def activate(self) -> Iterator[Budget]:
        """Make this the budget of the thread, and note the first Ctrl-C instead of raising; the second one raises.

        CasADi swallows KeyboardInterrupt inside a solve and reports some failure instead. Signals
        reach the main thread only: elsewhere nothing changes.
        """
        token = _ACTIVE.set(self)

        def note(number: int, frame: FrameType | None) -> None:
            self.is_interrupted = True
            signal.signal(signal.SIGINT, before)

        try:
            with handle_interrupt(note) as before:
                yield self
        finally:
            _ACTIVE.reset(token)


_ACTIVE: ContextVar[Budget | None] = ContextVar("running", default=None)  # each thread has its own


def record_evaluations(units: int = 0) -> None:
    """Count work in the budget that runs in this thread, if there is one.

    Whatever may take long calls this often: a hundredth of a second is a good measure.

    Args:
        units: Of effort; 0: what the same call may do today and not tomorrow, like building what a
            cache has lost.

    Raises:
        SpentError: It is at its end.
    """
    budget = _ACTIVE.get()
    if budget is not None:
        budget.evaluations += units
        if budget.stop_status:
            raise BudgetExhaustedError(budget.stop_status)


def count_evaluations() -> int:
    """Return the evaluations so far in the budget of this thread; 0 without one."""
    budget = _ACTIVE.get()
    return 0 if budget is None else budget.evaluations


def current_ending() -> str:
    """Return which of `ENDINGS` has ended the budget of this thread, or "" while it lasts."""
    budget = _ACTIVE.get()
    return "" if budget is None else budget.stop_status


def reserve_time(purpose: str, seconds: float, *, default: bool = False) -> None:
    """Keep time at the end of this thread's budget, as for validating the best trajectory.

    Args:
        purpose: What it is kept for; a later call with the same purpose replaces the time.
        seconds: How much [s].
        default: Keep an earlier time of the same purpose.
    """
    budget = _ACTIVE.get()
    if budget is not None and not (default and budget.reserved.get(purpose)):
        budget.reserved[purpose] = seconds


@contextlib.contextmanager
def suspend_budget() -> Iterator[None]:
    """Let nothing count for a while: what must be done in any case."""
    token = _ACTIVE.set(None)
    try:
        yield
    finally:
        _ACTIVE.reset(token)
