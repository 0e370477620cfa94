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
from vkc_pin.utils.interrupt import defer_interrupt, raise_on_interrupt


@pytest.fixture(autouse=True)
def handler_is_restored() -> Iterator[None]:
    """Use Python's handler: shells may start background jobs that ignore Ctrl-C."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    signal.signal(signal.SIGINT, before)


def press_ctrl_c() -> None:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.01)  # the handler runs between two steps of the interpreter


def test_other_threads_have_their_own_budget() -> None:
    interrupted: list[bool] = []

    def work() -> None:
        record_evaluations(10**9)
        with Budget().activate() as thread_budget:
            interrupted.append(thread_budget.is_interrupted)

    with Budget(max_evaluations=1).activate() as budget:
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert interrupted == [False]
    assert budget.evaluations == 0


def test_evaluations_are_limited() -> None:
    record_evaluations(10**9)
    with Budget(max_evaluations=10).activate() as budget:
        record_evaluations(4)
        record_evaluations(6)
        record_evaluations()
        with suspend_budget():
            record_evaluations(10**9)
        with Budget(max_evaluations=1).activate(), pytest.raises(BudgetExhaustedError):
            record_evaluations(2)
        assert (budget.evaluations, budget.stop_status) == (10, "")
        with pytest.raises(BudgetExhaustedError, match="evaluation limit"):
            record_evaluations(1)
        assert (budget.evaluations, budget.stop_status) == (11, "evaluation limit")


def test_second_ctrl_c_raises() -> None:
    with pytest.raises(KeyboardInterrupt), Budget().activate() as budget:  # noqa: PT012
        record_evaluations()
        assert not budget.stop_status
        press_ctrl_c()
        assert budget.stop_status == "interrupted"
        with pytest.raises(BudgetExhaustedError, match="interrupted"):
            record_evaluations()
        press_ctrl_c()


def test_foreign_handlers_are_kept(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    with Budget().activate() as budget:
        assert not budget.stop_status
    monkeypatch.undo()


def test_time_is_reserved_for_validation(monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_interrupts_are_deferred() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), raise_on_interrupt(), defer_interrupt():  # noqa: PT012
        press_ctrl_c()
        press_ctrl_c()
        done.append("all")
    assert done == ["all"]


def test_deferred_interrupts_reach_the_budget() -> None:
    with Budget().activate() as budget, defer_interrupt():
        press_ctrl_c()
        assert not budget.is_interrupted
    assert budget.is_interrupted


def test_ignored_interrupts_stay_ignored() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Budget().activate() as budget, raise_on_interrupt(), defer_interrupt():
            press_ctrl_c()
        assert not budget.is_interrupted
    finally:
        signal.signal(signal.SIGINT, before)


def test_interrupts_raise_on_request() -> None:
    received: list[int] = []
    previous = signal.signal(signal.SIGINT, lambda number, frame: received.append(number))
    try:
        with pytest.raises(KeyboardInterrupt), raise_on_interrupt():
            press_ctrl_c()
        press_ctrl_c()
    finally:
        signal.signal(signal.SIGINT, previous)
    assert received == [signal.SIGINT]
