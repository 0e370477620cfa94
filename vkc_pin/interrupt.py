"""Ctrl-C: whoever plans asks now and then whether it was pressed, and ends early with what there is."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from types import FrameType

__all__ = ["NEVER", "Interrupt", "interruptible"]


@dataclass
class Interrupt:
    """Whether Ctrl-C was pressed."""

    pressed: bool = False


NEVER = Interrupt()
"""For searches that nobody ends early."""


@contextlib.contextmanager
def interruptible(interrupt: Interrupt | None = None) -> Iterator[Interrupt]:
    """Note the first Ctrl-C instead of raising, so that the best there is can be returned; the second one raises.

    CasADi swallows KeyboardInterrupt inside a solve and reports some failure instead. Signals reach the main thread only:
    elsewhere nothing changes.

    Args:
        interrupt: Where to note it; None: in a new one.
    """
    interrupt = Interrupt() if interrupt is None else interrupt
    before = signal.getsignal(signal.SIGINT)  # None: whoever embeds Python handles it, and could not be put back
    if before is None or threading.current_thread() is not threading.main_thread():
        yield interrupt
        return

    def note(number: int, frame: FrameType | None) -> None:
        interrupt.pressed = True
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, note)
    try:
        yield interrupt
    finally:
        signal.signal(signal.SIGINT, before)
