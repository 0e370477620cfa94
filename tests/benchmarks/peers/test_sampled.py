"""Tests the paths and the limits of sampling-based planners."""

from __future__ import annotations

import numpy as np

from tests.benchmarks.peers.sampled import compute_finite_limits, subdivide
from tests.benchmarks.peers.tasks import build_program, make_problem


def test_lines_are_subdivided() -> None:
    rows = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.0, 0.5]])
    path = subdivide(rows, np.array([1.0, 2.0]), step=0.25)
    assert np.abs(np.diff(path, axis=0) * [1.0, 2.0]).max() == 0.25
    assert len(path) == 9
    assert np.array_equal(path[[0, 4, 8]], rows[[0, 1, 3]])


def test_limits_are_finite_and_contain_the_start() -> None:
    problem = build_program(make_problem("drawer", 18, 0))
    lower, upper = compute_finite_limits(problem)
    assert np.isfinite([lower, upper]).all()
    assert np.all((lower <= problem.start) & (problem.start <= upper))
    assert upper[-1] >= 0.3 > lower[-1]
