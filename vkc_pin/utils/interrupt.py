"""Who has Ctrl-C for a while."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

__all__ = ["defer_interrupt", "handle_interrupt", "raise_on_interrupt"]


@contextlib.contextmanager
def handle_interrupt(
    handler: Callable[[int, FrameType | None], object] | signal.Handlers,
) -> Iterator[Any]:
    """Let `handler` have Ctrl-C, and yield what had it before; where it cannot be had, nothing changes.

    Signals reach the main thread only.
    """
    before = signal.getsignal(
        signal.SIGINT
    )  # None: whoever embeds Python handles it, and could not be put back
    if before is None or threading.current_thread() is not threading.main_thread():
        yield before
        return
    signal.signal(signal.SIGINT, handler)
    try:
        yield before
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def defer_interrupt() -> Iterator[None]:
    """Let Ctrl-C wait for the end of something short that must not be left half done."""
    pressed: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        pressed.append(number)

    try:
        with handle_interrupt(note):
            yield
    finally:
        if pressed:
            signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def raise_on_interrupt() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt, as it does unless somebody chose otherwise."""
    with handle_interrupt(signal.default_int_handler):
        yield
