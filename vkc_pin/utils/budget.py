"""Budget of a planning call: Ctrl-C, wall-clock time and number of evaluations."""

from __future__ import annotations

import contextlib
import math
import signal
import time
from collections.abc import Iterator
from contextvars import ContextVar
from types import FrameType
from typing import Literal, get_args

from vkc_pin.utils.interrupt import handle_interrupt

__all__ = [
    "STOP_STATUSES",
    "Budget",
    "BudgetExhaustedError",
    "StopStatus",
    "count_evaluations",
    "current_ending",
    "record_evaluations",
    "reserve_time",
    "suspend_budget",
]

StopStatus = Literal["interrupted", "evaluation limit", "time limit"]
STOP_STATUSES: tuple[StopStatus, ...] = get_args(StopStatus)
"""Why a budget may be at its end; what becomes the status of plans."""


class BudgetExhaustedError(Exception):
    """A limit of the budget is reached. Planning catches it and returns its best result.

    Attributes:
        status: Limit that was reached.
    """

    def __init__(self, status: StopStatus) -> None:
        super().__init__(status)
        self.status = status


class Budget:
    """Limits of one planning call, which start with its construction.

    One evaluation is a configuration whose frames or distances are computed. Every iteration of
    Ipopt evaluates all waypoints.

    Args:
        seconds: Wall-clock time; None: unlimited.
        max_evaluations: Evaluations; None: unlimited.

    Attributes:
        is_interrupted: Whether Ctrl-C was pressed.
        evaluations: Evaluations so far.
        reserved: Purpose → time that is kept for validating the best trajectory at the end [s].
    """

    def __init__(self, seconds: float | None = None, max_evaluations: int | None = None) -> None:
        self._deadline = math.inf if seconds is None else time.perf_counter() + seconds
        self._max_evaluations = math.inf if max_evaluations is None else max_evaluations
        self.is_interrupted, self.evaluations = False, 0
        self.reserved: dict[str, float] = {}

    @property
    def stop_status(self) -> StopStatus | Literal[""]:
        """One of `STOP_STATUSES`, or "" while it lasts."""
        if self.is_interrupted:
            return "interrupted"
        if self.evaluations > self._max_evaluations:
            return "evaluation limit"
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
        units: Number of evaluations; 0 for work that depends on the state of caches.

    Raises:
        BudgetExhaustedError: A limit is reached.
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


def current_ending() -> StopStatus | Literal[""]:
    """Return which of `STOP_STATUSES` has ended the budget of this thread, or "" while it lasts."""
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
