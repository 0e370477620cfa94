from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator

import pytest

from vkc_pin.interrupt import Interrupt, interruptible


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
    with interruptible() as interrupt:
        assert not interrupt.pressed
        press()
        assert interrupt.pressed


def test_it_is_noted_where_asked_for() -> None:
    mine = Interrupt()
    with interruptible(mine) as interrupt:
        press()
    assert interrupt is mine
    assert mine.pressed


def test_the_second_raises() -> None:
    with pytest.raises(KeyboardInterrupt), interruptible():  # noqa: PT012
        press()
        press()


def test_an_error_puts_the_handler_back() -> None:
    with pytest.raises(ValueError, match="mine"), interruptible():
        raise ValueError("mine")


def test_a_handler_that_python_did_not_install_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signal, "getsignal", lambda number: None)
    with interruptible() as interrupt:
        assert not interrupt.pressed
    monkeypatch.undo()


def test_other_threads_get_no_signals() -> None:
    seen: list[bool] = []

    def work() -> None:
        with interruptible() as interrupt:
            seen.append(interrupt.pressed)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]
