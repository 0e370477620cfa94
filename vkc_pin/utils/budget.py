"""Ends planning early: at Ctrl-C, at a time, or after a reproducible number of evaluations."""

from __future__ import annotations

import contextlib
import math
import signal
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar
from types import FrameType
from typing import Literal, get_args

from vkc_pin.utils.interrupt import handle_interrupt

StopStatus = Literal["interrupted", "evaluation limit", "time limit"]
STOP_STATUSES: tuple[StopStatus, ...] = get_args(StopStatus)
"""Reasons to stop, which become the status of plans."""


class BudgetExhaustedError(Exception):
    """The limit `status` of the budget is reached. Planning returns its best result."""

    def __init__(self, status: StopStatus) -> None:
        super().__init__(status)
        self.status = status


class Budget:
    """Limits of one planning call, from its construction on.

    An evaluation is a configuration whose frames or distances are computed. Each iteration of Ipopt
    evaluates all waypoints.

    Args:
        seconds: Wall-clock time [s]. Default: unlimited.
        max_evaluations: Number of evaluations. Default: unlimited.

    Attributes:
        limits: Deadline as a value of `time.perf_counter()` [s], and number of evaluations.
        share: Computes the limits of the present attempt; see `share_budget`.
        is_interrupted: Whether Ctrl-C was pressed.
        evaluations: Evaluations so far.
        reserved: Purpose → time reserved at the end [s].
    """

    def __init__(self, seconds: float | None = None, max_evaluations: int | None = None) -> None:
        self._seconds = seconds
        self._max_evaluations = max_evaluations
        deadline = math.inf if seconds is None else time.perf_counter() + seconds
        self.limits = (deadline, math.inf if max_evaluations is None else max_evaluations)
        self.share: Callable[[], tuple[float, float]] | None = None
        self.is_interrupted = False
        self.evaluations = 0
        self.reserved: dict[str, float] = {}

    @property
    def stop_status(self) -> StopStatus | Literal[""]:
        """One of `STOP_STATUSES`, or "" before the end."""
        if self.is_interrupted:
            return "interrupted"
        deadline, max_evaluations = self.limits
        if self.evaluations > max_evaluations:
            return "evaluation limit"
        return "time limit" if self.end_time > deadline else ""

    def describe_limit(self, status: str) -> str:
        """Return the limit that a status of `STOP_STATUSES` is about, as "60 s".

        The status may be that of an attempt that has used up its share.
        """
        if status == "evaluation limit":
            return f"{self._max_evaluations} evaluations"
        return f"{self._seconds:g} s"

    @property
    def is_limited(self) -> bool:
        """Whether there is a limit of time or evaluations."""
        return min(self.limits) < math.inf

    @property
    def end_time(self) -> float:
        """Time at which planning would end if it stopped now [s]."""
        return time.perf_counter() + sum(self.reserved.values())

    @contextlib.contextmanager
    def activate(self) -> Iterator[Budget]:
        """Make this the budget of the thread, which notes the first Ctrl-C; the second one raises.

        CasADi swallows KeyboardInterrupt inside a solve and reports some other failure.
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


_ACTIVE: ContextVar[Budget | None] = ContextVar("active", default=None)  # one per thread


def record_evaluations(count: int = 0) -> None:
    """Add evaluations to the budget of this thread, if there is one.

    Long computations call this about every 10 ms.

    Args:
        count: Number of evaluations; 0 for work that depends on the state of a cache.

    Raises:
        BudgetExhaustedError: The budget is exhausted.
    """
    budget = _ACTIVE.get()
    if budget is not None:
        budget.evaluations += count
        if budget.stop_status:
            raise BudgetExhaustedError(budget.stop_status)


def count_evaluations() -> int:
    """Return the evaluations so far in the budget of this thread; 0 without one."""
    budget = _ACTIVE.get()
    return 0 if budget is None else budget.evaluations


def current_ending() -> StopStatus | Literal[""]:
    """Return the `stop_status` of this thread's budget; "" without one."""
    budget = _ACTIVE.get()
    return "" if budget is None else budget.stop_status


def reserve_time(purpose: str, seconds: float, *, default: bool = False) -> None:
    """Reserve time at the end of this thread's budget, as for validation.

    Args:
        purpose: Purpose of the time; a later call with the same purpose replaces it.
        seconds: Time [s].
        default: Keep an earlier reservation for the same purpose.
    """
    budget = _ACTIVE.get()
    if budget is not None and not (default and budget.reserved.get(purpose)):
        budget.reserved[purpose] = seconds


@contextlib.contextmanager
def share_budget(count: int | Callable[[], int]) -> Iterator[None]:
    """Give this attempt an equal share of what this thread's budget has left.

    The share ends nothing until the attempt calls `enforce_share`.

    Args:
        count: Number of attempts that share the budget, this one included. A function is called
            only when the share of a limited budget is enforced.
    """
    budget = _ACTIVE.get()
    if budget is None:
        yield
        return
    limits_before = budget.limits
    share_before = budget.share
    start_time = budget.end_time
    start_evaluations = budget.evaluations

    def compute_share() -> tuple[float, float]:
        number = count if isinstance(count, int) else count()
        deadline, max_evaluations = limits_before
        seconds_left = max(0.0, deadline - start_time)
        evaluations_left = max(0.0, max_evaluations - start_evaluations)
        return start_time + seconds_left / number, start_evaluations + evaluations_left / number

    budget.share = compute_share
    try:
        yield
    finally:
        budget.limits = limits_before
        budget.share = share_before


def enforce_share() -> None:
    """Limit the present attempt to its share of the budget; see `share_budget`."""
    budget = _ACTIVE.get()
    if budget is not None and budget.share is not None and min(budget.limits) < math.inf:
        budget.limits = budget.share()


@contextlib.contextmanager
def suspend_budget() -> Iterator[None]:
    """Suspend the budget of this thread for work that must be done in any case."""
    token = _ACTIVE.set(None)
    try:
        yield
    finally:
        _ACTIVE.reset(token)
