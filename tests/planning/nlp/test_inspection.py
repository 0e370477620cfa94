"""Tests of the description of a program: witness planes, sizes and sparsity."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from helpers.carrying import STICK, describe_stand, make_room
from helpers.small_problems import SHORT, make_program

import vkc_pin as vkc
from vkc_pin.planning.nlp.inspection import patterns, planes, sizes
from vkc_pin.planning.nlp.problem import TrajectoryProblem

WAYPOINT = SHORT.reach_waypoints - 1


@pytest.fixture(scope="module")
def problem() -> TrajectoryProblem:
    """Return a problem with a speed limit, which makes the step durations parameters."""
    slow = vkc.Constraint("slow", lambda s: ca.sumsqr(s.velocity("tool")), upper=4.0)
    steps = [vkc.Actuate("door", {"hinge": 1.2})]
    return make_program(vkc.load_scene("door"), steps, options=SHORT, terms=[slow])


@pytest.fixture(scope="module")
def z(problem: TrajectoryProblem) -> np.ndarray:
    """Return waypoints with the arm in front of the door."""
    start = problem.start.copy()
    start[:3] = 1.4, -0.36, 0.2
    return np.tile(start, (problem.segments, 1))


def test_sizes_add_up() -> None:
    low = vkc.Constraint("low", lambda s: s.coordinate("base_x"), upper=5.0, during=["go to"])
    steps = [vkc.Grasp("stick"), vkc.GoTo(0.0, 0.0), vkc.Reach(STICK), vkc.Reach(STICK)]
    problem = make_program(make_room(describe_stand()), steps, options=SHORT, terms=[low])
    found, t = sizes(problem), problem.transcription
    for kind, total in (
        ("variables", t.size),
        ("rows", t.rows),
        ("only if needed", t.rate_matrix.size1()),
    ):
        assert sum(size for name, size in found.items() if name.startswith(kind)) == total
    assert found["rows: witness planes"] == problem.segments * problem.options.contact_slots
    assert found["variables: slacks"] == found["rows: witness planes"]
    assert found["variables: relaxation"] == problem.segments
    assert found["rows: user-defined constraints"] == SHORT.reach_waypoints
    assert found["rows: goal tool"] == 2 * 7
    clamped = sum(last - first for _, first, last in t.structure.clamped)
    assert found["rows: clamped freedoms"] == clamped > 0


@pytest.mark.parametrize("at", [0, WAYPOINT - 1, -1])
def test_planes_equal_distances_to_first_order(
    problem: TrajectoryProblem, z: np.ndarray, at: int
) -> None:
    found = planes(problem, z, int(np.arange(1, len(z) + 1)[at]))
    assert 0 < len(found) <= problem.options.contact_slots
    here, step = z[at], 1e-4
    moved = np.array([here + sign * step * axis for axis in np.eye(len(here)) for sign in (1, -1)])
    for plane in found:
        assert plane.values(here[None])[0] == pytest.approx(plane.distance, abs=1e-9)
        assert plane.distances(here[None])[0] == pytest.approx(plane.distance, abs=1e-12)
        ahead, behind = plane.values(moved).reshape(-1, 2).T
        assert (ahead - behind) / (2 * step) == pytest.approx(plane.gradient, abs=1e-6)
        assert plane.distances(moved) == pytest.approx(plane.values(moved), abs=1e-6)


def test_distances_out_of_reach_are_nan(problem: TrajectoryProblem, z: np.ndarray) -> None:
    close = z.copy()
    close[:, 0] = 1.9
    far = close[:1] - np.outer([0.0, 0.28, 2.9], np.eye(z.shape[1])[0])
    found = planes(problem, close, 2)
    fixed = [plane for plane in found if any(name.startswith("door") for name in plane.names)]
    assert fixed, [plane.names for plane in found]
    for plane in fixed:
        near, within, away = plane.distances(far)
        assert near == pytest.approx(plane.distance, abs=1e-12)
        assert 0.3 < within < plane.distance + 0.3
        assert np.isnan(away)


def test_patterns_contain_all_nonzeros(problem: TrajectoryProblem, z: np.ndarray) -> None:
    t = problem.transcription
    jacobian, hessian = patterns(problem)
    assert jacobian.shape == (t.rows, t.size)
    assert hessian.shape == (t.size, t.size)
    assert abs(hessian - hessian.T).nnz == 0
    plane, first = planes(problem, z, WAYPOINT)[0], (WAYPOINT - 1) * t.width
    row = np.flatnonzero(jacobian[int(t.slot_rows[WAYPOINT - 1, 0])].toarray().ravel()) - first
    assert set(np.flatnonzero(plane.gradient)) <= set(row)
    # the row depends on the coordinates of its waypoint and on its own slack
    assert ((row >= 0) & (row <= t.n)).all()
    assert row[-1] == t.n
