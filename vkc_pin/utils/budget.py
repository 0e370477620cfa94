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

__all__ = ["ENDINGS", "Budget", "SpentError", "spend", "unlimited"]

ENDINGS = ("interrupted", "effort spent", "time limit")
"""Why a budget may be at its end; what becomes the status of plans."""


class SpentError(Exception):
    """The budget is at its end: whoever has something to show for it catches this; it never reaches the user."""


class Budget:
    """What one call may take. It runs from when it is made.

    A unit of effort is a configuration that is looked at: where its frames are, or how far it is
    from collisions. Every iteration of Ipopt looks at all waypoints.

    Args:
        seconds: Time by the clock; None: any.
        effort: Units; None: any.

    Attributes:
        pressed: Whether Ctrl-C was.
        used: Units of effort so far.
        checking: Time to keep for checking the best motion in the end [s].
        decided: The same for all that was decided before [s].
    """

    def __init__(self, seconds: float | None = None, effort: int | None = None) -> None:
        self._deadline = math.inf if seconds is None else time.perf_counter() + seconds
        self._effort = math.inf if effort is None else effort
        self.pressed, self.used = False, 0
        self.checking = self.decided = 0.0

    @property
    def ended(self) -> str:
        """One of `ENDINGS`, or "" while it lasts."""
        if self.pressed:
            return "interrupted"
        if self.used > self._effort:
            return "effort spent"
        late = time.perf_counter() + self.checking + self.decided > self._deadline
        return "time limit" if late else ""

    @contextlib.contextmanager
    def running(self) -> Iterator[Budget]:
        """Let all that this thread does count, and note the first Ctrl-C instead of raising; the second one raises.

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


@contextlib.contextmanager
def unlimited() -> Iterator[None]:
    """Let nothing count for a while: what must be done in any case."""
    token = _RUNNING.set(None)
    try:
        yield
    finally:
        _RUNNING.reset(token)
