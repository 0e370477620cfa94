from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator

import pytest

from vkc_pin.utils.budget import Budget, SpentError, current_ending, reserve_time, spend, unlimited


@pytest.fixture(autouse=True)
def handler_is_put_back() -> Iterator[None]:
    """Start from Python's own handler: a shell that starts the tests in the background makes them ignore Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def press() -> None:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)  # the handler runs between two steps of the interpreter


def test_the_first_ctrl_c_is_noted() -> None:
    with Budget().running() as budget:
        spend()
        assert not budget.ended
        press()
        assert budget.ended == "interrupted"
        with pytest.raises(SpentError, match="interrupted"):
            spend()


def test_the_second_raises() -> None:
    with pytest.raises(KeyboardInterrupt), Budget().running():  # noqa: PT012
        press()
        press()


def test_an_error_puts_the_handler_back() -> None:
    with pytest.raises(ValueError, match="mine"), Budget().running():
        raise ValueError("mine")


def test_a_handler_that_python_did_not_install_is_left_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    with Budget().running() as budget:
        assert not budget.ended
    monkeypatch.undo()


def test_other_threads_get_no_signals() -> None:
    seen: list[bool] = []

    def work() -> None:
        spend(10**9)  # of no budget: that of the main thread is not this thread's
        with Budget().running() as budget:
            seen.append(budget.pressed)

    with Budget(effort=1).running() as mine:
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert seen == [False]
    assert mine.used == 0


def test_effort_counts_down() -> None:
    """All of it may be used."""
    with Budget(effort=10).running() as budget:
        spend(4)
        spend(6)
        spend()
        with pytest.raises(SpentError, match="effort spent"):
            spend(1)
        assert (budget.used, budget.ended) == (11, "effort spent")


def test_nothing_counts_where_no_budget_runs() -> None:
    spend(10**9)
    with Budget(effort=1).running() as budget, unlimited():
        spend(10**9)
    assert (budget.used, budget.ended) == (0, "")


def test_a_budget_within_another() -> None:
    with Budget(effort=5).running() as outer:
        with Budget(effort=1).running(), pytest.raises(SpentError):
            spend(2)
        spend(5)
        assert outer.used == 5


def test_the_clock_keeps_time_for_checking(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    budget = Budget(seconds=10.0)
    now[0] = 108.0
    assert budget.ended == ""
    with budget.running():
        reserve_time("validation", 1.5)
        reserve_time("planned steps", 1.0)
        assert current_ending() == "time limit"
        reserve_time("validation", 9.0, default=True)
        reserve_time("planned steps", 0.0)
    assert budget.ended == ""
    budget.pressed = True
    assert budget.ended == "interrupted"
