"""Handles Ctrl-C, which reaches the main thread only: elsewhere nothing changes."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any


@contextlib.contextmanager
def handle_interrupt(
    handler: Callable[[int, FrameType | None], object] | signal.Handlers,
) -> Iterator[Any]:
    """Call `handler` at Ctrl-C, and yield the previous handler.

    Where Ctrl-C is ignored, as in background processes of scripts, it stays ignored.
    """
    before = signal.getsignal(signal.SIGINT)
    # None: a program that embeds Python handles the signal, and its handler could not be restored.
    must_stay = before in (None, signal.SIG_IGN)
    is_main_thread = threading.current_thread() is threading.main_thread()
    if must_stay or not is_main_thread:
        yield before
        return
    signal.signal(signal.SIGINT, handler)
    try:
        yield before
    finally:
        signal.signal(signal.SIGINT, before)


@contextlib.contextmanager
def defer_interrupt() -> Iterator[None]:
    """Defer Ctrl-C to the end of a short operation that must be complete."""
    is_pressed = False

    def note(number: int, frame: FrameType | None) -> None:
        nonlocal is_pressed
        is_pressed = True

    try:
        with handle_interrupt(note):
            yield
    finally:
        if is_pressed:
            signal.raise_signal(signal.SIGINT)


@contextlib.contextmanager
def start_without_interrupt() -> Iterator[None]:
    """Defer Ctrl-C while processes and threads are started, none of which gets it then or later.

    They inherit the mask of blocked signals. Ignoring the signal would lose Ctrl-C here as well,
    and a handler is not inherited.
    """
    from multiprocessing import resource_tracker

    with defer_interrupt():
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            # The first process that multiprocessing spawns starts its tracker of resources, which
            # unblocks SIGINT in the thread that starts it: later processes would get Ctrl-C.
            resource_tracker.ensure_running()
            signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def raise_on_interrupt() -> Iterator[None]:
    """Raise KeyboardInterrupt at Ctrl-C, as Python does by default."""
    with handle_interrupt(signal.default_int_handler):
        yield
