"""Tests that calls in the child process return results or errors and leave no process behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.expected_errors import expect_error

from vkc_pin import InputError
from vkc_pin.utils.isolation import (
    MEMORY_VARIABLE,
    TIME_VARIABLE,
    run_isolated,
    submit_isolated,
)


def call_isolated(function: Callable[..., Any], *arguments: Any) -> Any:
    return run_isolated(function, *arguments, program="the parser", file="a.xml")


def is_running(process: int) -> bool:
    """Return whether a process exists and is no zombie."""
    try:
        status = Path(f"/proc/{process}/stat").read_text(encoding="ascii")
    except OSError:
        return False
    return status.rpartition(")")[2].split()[0] != "Z"


def wait_until_ended(process: int) -> bool:
    end = time.monotonic() + 10.0
    while is_running(process) and time.monotonic() < end:
        time.sleep(0.05)
    return not is_running(process)


def test_results_and_errors_are_passed_on() -> None:
    child = call_isolated(os.getpid)
    assert child != os.getpid()
    np.testing.assert_array_equal(
        call_isolated(np.cross, np.eye(3)[0], np.eye(3)[1]), [0.0, 0.0, 1.0]
    )
    with pytest.raises(ValueError, match="invalid literal for int"):
        call_isolated(int, "five")
    with expect_error("PRIVATE_LIMIT: out of range"):
        call_isolated(_fail)
    assert call_isolated(os.getpid) == child


def _fail() -> None:
    raise InputError("out of range", field="PRIVATE_LIMIT")


@pytest.mark.parametrize(
    ("function", "arguments", "reason"),
    [
        (
            time.sleep,
            (60.0,),
            rf"does not finish in time \(expected at most 0.5 s .{TIME_VARIABLE}",
        ),
        (pow, (3, 10**9), "does not finish in time"),
        (open, ("/dev/full", "w"), "cannot pickle"),
        (np.ones, (10**10,), rf"needs too much memory \(expected at most 4 GB .{MEMORY_VARIABLE}"),
        (signal.raise_signal, (signal.SIGKILL,), "needs too much memory"),
        (signal.raise_signal, (signal.SIGSEGV,), "crashes .*got Segmentation fault"),
        (os.abort, (), "crashes .*got Aborted"),
        (os._exit, (0,), "crashes .*got exit code 0"),
        (os._exit, (7,), "crashes .*got exit code 7"),
    ],
)
def test_failure_names_program_and_reason(
    function: Callable[..., Any], arguments: tuple[Any, ...], reason: str, monkeypatch: Any
) -> None:
    if "in time" in reason:
        monkeypatch.setenv(TIME_VARIABLE, "0.5")
    with pytest.raises((InputError, RuntimeError, TypeError), match=reason) as caught:
        call_isolated(function, *arguments)
    if isinstance(caught.value, InputError):
        assert str(caught.value).startswith("a.xml: the parser ")
    assert call_isolated(abs, -2) == 2


def test_child_process_cannot_fill_the_disk_or_the_current_folder(tmp_path: Path) -> None:
    file = tmp_path / "large"
    with pytest.raises(OSError, match="File too large"):
        call_isolated(Path.write_bytes, file, bytes(2**25))
    assert file.stat().st_size <= 2**24
    assert call_isolated(os.getcwd) == "/"


def test_limits_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(MEMORY_VARIABLE, "0.5")
    with expect_error(r"at most 0\.5 GB"):
        call_isolated(np.ones, 10**8)
    monkeypatch.setenv(MEMORY_VARIABLE, "2")
    assert call_isolated(np.ones, 10**7).sum() == 10**7
    for wrong in ("much", "0", "-1", "nan", "inf", "1e9"):
        monkeypatch.setenv(TIME_VARIABLE, wrong)
        with expect_error(f"{TIME_VARIABLE}: wrong environment variable"):
            call_isolated(abs, 1)


def test_unfetched_result_is_dropped() -> None:
    submit_isolated(abs, -1, program="the parser")
    assert call_isolated(abs, -2) == 2


def test_child_process_that_ended_between_calls_is_replaced() -> None:
    child = call_isolated(os.getpid)
    os.kill(child, signal.SIGINT)  # as Ctrl-C does to all processes of a terminal
    os.waitid(os.P_PID, child, os.WEXITED | os.WNOWAIT)
    assert call_isolated(os.getpid) != child


def test_threads_and_forks_have_their_own_child_processes() -> None:
    child, found = call_isolated(os.getpid), list[int]()
    thread = threading.Thread(target=lambda: found.append(call_isolated(os.getpid)))
    thread.start()
    thread.join()
    with get_context("fork").Pool(1) as pool:
        found.append(pool.apply(call_isolated, (os.getpid,)))
    assert len({child, *found}) == 3
    assert call_isolated(os.getpid) == child
    assert all(map(wait_until_ended, found))


SCRIPT = """
import os, time
from vkc_pin.utils.isolation import run_isolated
print(run_isolated(os.getpid, program="it"), flush=True)
run_isolated(time.sleep, 50.0, program="it")
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_child_process_ends_with_its_parent(number: signal.Signals) -> None:
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", SCRIPT]
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as parent:
        assert parent.stdout is not None
        child = int(parent.stdout.readline())
        time.sleep(0.2)
        parent.send_signal(number)
        _, error = parent.communicate(timeout=20)
    assert ("KeyboardInterrupt" in error) == (number == signal.SIGINT)
    assert wait_until_ended(child)
