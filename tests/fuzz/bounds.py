"""Checks how a case ends: in a result or an error of the package, within time and memory."""

from __future__ import annotations

import contextlib
import faulthandler
import signal
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from vkc_pin.errors import VkcError

MAX_SECONDS = 2.0  # [s] of processor time
PLANNING_SECONDS = 8.0  # [s] of processor time, for cases that build or solve a problem
MAX_GROWTH = 500.0  # [MB] of resident memory
TIMEOUT = 40.0  # [s] of wall-clock time after which a case is interrupted; twice ends the process
MAX_MESSAGE = 4000  # characters


def take_share(share: float) -> settings:
    """Return settings with a share of the examples of the profile."""
    return settings(
        max_examples=max(1, round(share * settings().max_examples)),
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )


@contextlib.contextmanager
def expect_result_or_error(max_seconds: float = MAX_SECONDS) -> Iterator[None]:
    """Fail unless the block ends, or raises an error of the package, within the limits."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # resets the peak
    memory = _read_memory("VmRSS")
    start_time = time.process_time()
    previous = signal.signal(signal.SIGALRM, _interrupt)
    # The time limit of the whole test, which pytest-timeout has set, stops while a case runs.
    remaining, _ = signal.setitimer(signal.ITIMER_REAL, TIMEOUT)
    # Compiled code is not interrupted by signals.
    faulthandler.dump_traceback_later(2.0 * TIMEOUT, exit=True, file=sys.__stderr__)
    try:
        yield
    except VkcError as error:
        message = str(error)
        assert message.strip(), "an error without a message"
        assert len(message) <= MAX_MESSAGE, f"a message of {len(message)} characters"
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, previous)
        signal.setitimer(signal.ITIMER_REAL, remaining)
    seconds = time.process_time() - start_time
    growth = _read_memory("VmHWM") - memory
    assert seconds <= max_seconds, f"took {seconds:.1f} s"
    assert growth <= MAX_GROWTH, f"took {growth:.0f} MB"


def _interrupt(*_: Any) -> None:
    pytest.fail(f"no end within {TIMEOUT:g} s")


def _read_memory(name: str) -> float:
    """Return an entry of the process's status [MB]."""
    for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
        if line.startswith(name):
            return float(line.split()[1]) / 1024.0
    raise LookupError(name)
