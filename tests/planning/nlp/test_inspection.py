from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from helpers.carrying import room, stand
from helpers.small_problems import SHORT, program_of

import vkc_pin as vkc
from vkc_pin.planning.nlp.inspection import patterns, planes, sizes
from vkc_pin.planning.nlp.problem import TrajectoryProblem


@pytest.fixture(scope="module")
def problem() -> TrajectoryProblem:
    return program_of(vkc.load_scene("door"), [vkc.Actuate("door", {"hinge": 1.2})])


@pytest.fixture(scope="module")
def z(problem: TrajectoryProblem) -> np.ndarray:
    """Waypoints at which the arm stands before the door, with nothing solved."""
    start = problem.start.copy()
    start[:3] = 1.4, -0.36, 0.2
    return np.tile(start, (problem.segments, 1))


def test_sizes_add_up(problem: TrajectoryProblem) -> None:
    found, t = sizes(problem), problem.transcription
    assert sum(size for kind, size in found.items() if kind.startswith("variables")) == t.size
    assert sum(size for kind, size in found.items() if kind.startswith("rows")) == t.rows
    assert (
        sum(size for kind, size in found.items() if kind.startswith("only"))
        == t.rate_matrix.size1()
    )
    assert found["rows: witness planes"] == problem.segments * problem.options.contact_slots
    assert found["variables: slacks"] == found["rows: witness planes"]
    shares = [size for kind, size in found.items() if kind.startswith("variables: shares")]
    assert shares == [problem.segments]
    assert found["rows: closure door"] % 7 == 0
    assert (
        found["rows: rolling"]
        == found["rows: clamped freedoms"]
        == found["rows: own constraints"]
        == found["rows: pushes"]
        == 0
    )


def test_rows_of_own_constraints_are_told_from_clamped_freedoms() -> None:
    """And rows of goals of one name are added up."""
    low = vkc.Constraint("low", lambda s: s.coordinate("base_x"), upper=5.0, during=["go to"])
    pose = program_of(room(stand()), [vkc.Grasp("stick")], options=SHORT).targets[0]
    steps = [vkc.Grasp("stick"), vkc.GoTo(0.0, 0.0), vkc.Reach(pose), vkc.Reach(pose)]
    problem = program_of(room(stand()), steps, options=SHORT, terms=[low])
    found, t = sizes(problem), problem.transcription
    assert found["rows: own constraints"] == SHORT.reach_waypoints
    (goal,) = (name for name in found if name.startswith("rows: goal"))
    assert found[goal] == 2 * 7
    firm = [size for kind, size in found.items() if kind == "rows: clamped freedoms"]
    assert firm == [sum(last - first for _, first, last in t.structure.clamped)]
    assert sum(size for kind, size in found.items() if kind.startswith("rows")) == t.rows


def test_planes_of_a_program_with_a_speed_are_those_without(z: np.ndarray) -> None:
    """The time of the steps is one of its parameters."""
    steps = [vkc.Actuate("door", {"hinge": 1.2})]
    slow = vkc.Constraint("slow", lambda s: ca.norm_2(s.velocity("tool")) ** 2, upper=4.0)
    plain, timed = (
        program_of(vkc.load_scene("door"), steps, terms=terms) for terms in ([], [slow])
    )
    for one, other in zip(planes(plain, z, 60), planes(timed, z, 60), strict=True):
        assert one.names == other.names
        np.testing.assert_allclose(one.gradient, other.gradient, atol=1e-9)


def test_patterns_have_the_entries_that_numbers_show(
    problem: TrajectoryProblem, z: np.ndarray
) -> None:
    t = problem.transcription
    jacobian, hessian = patterns(problem)
    assert jacobian.shape == (t.rows, t.size)
    assert hessian.shape == (t.size, t.size)
    assert abs(hessian - hessian.T).nnz == 0
    (plane,) = planes(problem, z, 60)[:1]
    row = jacobian[int(t.slot_rows[59, 0])].toarray().ravel()
    assert not row[: 59 * t.width].any()  # a waypoint's rows are its own
    assert not row[60 * t.width :].any()
    assert (row[59 * t.width + np.flatnonzero(plane.gradient)] != 0).all()
    # Of slacks and share its own slack alone.
    np.testing.assert_array_equal(np.flatnonzero(row[59 * t.width + t.n : 60 * t.width]), [0])


def test_planes_are_distances_to_first_order(problem: TrajectoryProblem, z: np.ndarray) -> None:
    found = planes(problem, z, 60)
    assert 0 < len(found) <= problem.options.contact_slots
    for plane in found:
        here, step = z[59], 1e-4
        assert plane.values(here[None])[0] == pytest.approx(plane.distance, abs=1e-9)
        assert plane.distances(here[None])[0] == pytest.approx(plane.distance, abs=1e-12)
        moved = np.array(
            [here + sign * step * axis for axis in np.eye(len(here)) for sign in (1, -1)]
        )
        ahead, back = plane.values(moved).reshape(-1, 2).T
        assert (ahead - back) / (2 * step) == pytest.approx(plane.gradient, abs=1e-6)
        assert plane.distances(moved) == pytest.approx(plane.values(moved), abs=1e-6)


def test_planes_know_no_distance_far_away(problem: TrajectoryProblem, z: np.ndarray) -> None:
    close = z.copy()
    close[:, 0] = 1.9
    far = np.vstack([close[:1], z[:1] - 2.4 * np.eye(z.shape[1])[0]])
    found = planes(problem, close, 5)
    standing = [plane for plane in found if any(name.startswith("door") for name in plane.names)]
    assert standing, [plane.names for plane in found]  # before it is held the door stands
    for plane in standing:
        near, away = plane.distances(far)
        assert near == pytest.approx(plane.distance, abs=1e-12)
        assert np.isnan(away)
