"""Tests the handling of Ctrl-C."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from vkc_pin.utils.budget import Budget
from vkc_pin.utils.interrupt import defer_interrupt, raise_on_interrupt


@pytest.fixture(autouse=True)
def handler_is_restored() -> Iterator[None]:
    before = signal.getsignal(signal.SIGINT)
    yield
    assert signal.getsignal(signal.SIGINT) is before


def press_ctrl_c() -> None:
    os.kill(os.getpid(), signal.SIGINT)


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
