"""Ctrl-C: who has it, and when."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from vkc_pin.utils.budget import Budget
from vkc_pin.utils.interrupt import defer_interrupt, raise_on_interrupt


@pytest.fixture(autouse=True)
def handler_is_put_back() -> Iterator[None]:
    before = signal.getsignal(signal.SIGINT)
    yield
    assert signal.getsignal(signal.SIGINT) is before


def press() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def test_it_waits_for_the_end_of_what_is_short() -> None:
    done = []
    with pytest.raises(KeyboardInterrupt), raise_on_interrupt(), defer_interrupt():  # noqa: PT012
        press()
        press()
        done.append("all")
    assert done == ["all"]


def test_nothing_waits_if_nothing_was_pressed() -> None:
    with defer_interrupt():
        pass


def test_planning_hears_of_what_waited() -> None:
    with Budget().activate() as budget, defer_interrupt():
        press()
        assert not budget.is_interrupted
    assert budget.is_interrupted


def test_it_raises_where_it_is_asked_to() -> None:
    seen: list[int] = []
    mine = signal.signal(signal.SIGINT, lambda number, frame: seen.append(number))
    try:
        with pytest.raises(KeyboardInterrupt), raise_on_interrupt():
            press()
        press()
    finally:
        signal.signal(signal.SIGINT, mine)
    assert seen == [signal.SIGINT]
