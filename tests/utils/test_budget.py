from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator

import pytest

from vkc_pin.utils.budget import (
    Budget,
    BudgetExhaustedError,
    current_ending,
    record_evaluations,
    reserve_time,
    suspend_budget,
)


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
    with Budget().activate() as budget:
        record_evaluations()
        assert not budget.stop_status
        press()
        assert budget.stop_status == "interrupted"
        with pytest.raises(BudgetExhaustedError, match="interrupted"):
            record_evaluations()


def test_the_second_raises() -> None:
    with pytest.raises(KeyboardInterrupt), Budget().activate():  # noqa: PT012
        press()
        press()


def test_an_error_puts_the_handler_back() -> None:
    with pytest.raises(ValueError, match="mine"), Budget().activate():
        raise ValueError("mine")


def test_a_handler_that_python_did_not_install_is_left_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    with Budget().activate() as budget:
        assert not budget.stop_status
    monkeypatch.undo()


def test_other_threads_get_no_signals() -> None:
    seen: list[bool] = []

    def work() -> None:
        record_evaluations(10**9)  # of no budget: that of the main thread is not this thread's
        with Budget().activate() as budget:
            seen.append(budget.is_interrupted)

    with Budget(max_evaluations=1).activate() as mine:
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert seen == [False]
    assert mine.evaluations == 0


def test_effort_counts_down() -> None:
    """All of it may be used."""
    with Budget(max_evaluations=10).activate() as budget:
        record_evaluations(4)
        record_evaluations(6)
        record_evaluations()
        with pytest.raises(BudgetExhaustedError, match="evaluation limit"):
            record_evaluations(1)
        assert (budget.evaluations, budget.stop_status) == (11, "evaluation limit")


def test_nothing_counts_where_no_budget_runs() -> None:
    record_evaluations(10**9)
    with Budget(max_evaluations=1).activate() as budget, suspend_budget():
        record_evaluations(10**9)
    assert (budget.evaluations, budget.stop_status) == (0, "")


def test_a_budget_within_another() -> None:
    with Budget(max_evaluations=5).activate() as outer:
        with Budget(max_evaluations=1).activate(), pytest.raises(BudgetExhaustedError):
            record_evaluations(2)
        record_evaluations(5)
        assert outer.evaluations == 5


def test_the_clock_keeps_time_for_checking(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    budget = Budget(seconds=10.0)
    now[0] = 108.0
    assert budget.stop_status == ""
    with budget.activate():
        reserve_time("validation", 1.5)
        reserve_time("planned steps", 1.0)
        assert current_ending() == "time limit"
        reserve_time("validation", 9.0, default=True)
        reserve_time("planned steps", 0.0)
    assert budget.stop_status == ""
    budget.is_interrupted = True
    assert budget.stop_status == "interrupted"
