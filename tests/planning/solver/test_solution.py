"""Tests of a solution before the first round."""

from __future__ import annotations

import numpy as np

from vkc_pin.planning.solver.solution import Solution


def test_solution_is_not_converged_initially() -> None:
    one, other = (Solution(np.zeros((2, 1)), np.ones(2)) for _ in range(2))
    assert (one.converged, one.status, one.shortfall, one.radius) == (
        False,
        "not converged",
        0.0,
        None,
    )
    assert (one.rounds, one.iterations, one.history) == (0, 0, [])
    assert one.timings == {"coal": 0.0, "casadi": 0.0, "ipopt": 0.0}
    one.timings["coal"] = 1.0
    assert other.timings["coal"] == 0.0  # each counts for itself
