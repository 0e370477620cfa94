"""Tests that Ipopt stops when the budget is exhausted."""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
import pytest

from vkc_pin.planning.nlp.ipopt import Monitor
from vkc_pin.utils.budget import Budget


@pytest.mark.parametrize(
    ("budget", "iterations"),
    [({"seconds": 0.0}, 0), ({"max_evaluations": 30}, 3), ({}, None)],
    ids=str,
)
def test_ipopt_stops_when_the_budget_is_exhausted(
    budget: dict[str, Any], iterations: int | None
) -> None:
    """The start and each iteration cost ten evaluations."""
    x, p = ca.MX.sym("x", 2), ca.MX.sym("p")
    program = {
        "x": x,
        "p": p,
        "f": (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2,
        "g": x[0] + x[1],
    }
    monitor = Monitor(2, 1, 1, 10)
    options = {
        "iteration_callback": monitor,
        "ipopt.print_level": 0,
        "ipopt.sb": "yes",
        "print_time": False,
    }
    solver = ca.nlpsol("rosenbrock", "ipopt", program, options)
    with Budget(**budget).activate() as running:
        result = solver(x0=[-1.2, 1.0], lbg=-10.0, ubg=10.0, p=0.0)
    stats = solver.stats()
    assert stats["success"] is (iterations is None)
    assert running.evaluations == 10 * (stats["iter_count"] + 1)
    if iterations is None:
        np.testing.assert_allclose(result["x"].full(), 1.0, atol=1e-6)
    else:
        assert stats["return_status"] == "User_Requested_Stop"
        assert stats["iter_count"] == iterations
