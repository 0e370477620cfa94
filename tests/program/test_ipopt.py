"""Ipopt stops when time is up."""

from __future__ import annotations

import time

import casadi as ca
import numpy as np
import pytest

from vkc_pin.program.ipopt import Monitor


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
