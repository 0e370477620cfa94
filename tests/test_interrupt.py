from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator

import casadi as ca
import numpy as np
import pytest

from vkc_pin.interrupt import Interrupt, interruptible
from vkc_pin.program.deadline import Monitor


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


@pytest.mark.parametrize(("wait", "success"), [(-1.0, False), (np.inf, True)])
def test_ipopt_stops_when_time_is_up(wait: float, success: bool) -> None:
    x, p = ca.MX.sym("x", 2), ca.MX.sym("p")
    program = {"x": x, "p": p, "f": (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2, "g": x[0] + x[1]}
    monitor = Monitor(2, 1, 1)
    options = {"iteration_callback": monitor, "ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False}
    solver = ca.nlpsol("rosenbrock", "ipopt", program, options)
    monitor.deadline = time.perf_counter() + wait
    result = solver(x0=[-1.2, 1.0], lbg=-10.0, ubg=10.0, p=0.0)
    stats = solver.stats()
    assert stats["success"] is success
    if success:
        np.testing.assert_allclose(np.ravel(result["x"]), 1.0, atol=1e-6)
    else:
        assert stats["return_status"] == "User_Requested_Stop"
        assert stats["iter_count"] <= 1
