from __future__ import annotations

import numpy as np
import pytest
from helpers.gates import GOAL, NARROW, TIGHT, gated, walled
from helpers.small_problems import program_of

import vkc_pin as vkc
from vkc_pin.planning.initialization.base_routes import BaseRoutes
from vkc_pin.planning.initialization.keyframes import SIMILARITY_TOLERANCE
from vkc_pin.planning.initialization.methods import initialize


def test_path_leads_through_the_gap() -> None:
    problem = walled(1.6)
    routes, start = BaseRoutes(problem), problem.start[:3]
    goal = np.array([4.0, 1.5, 0.0])
    way = routes.find_path(0, start, goal, 40)
    assert way is not None
    assert way.shape == (40, 3)
    np.testing.assert_allclose(way[-1, :2], goal[:2], atol=1e-9)
    assert abs((way[-1, 2] - goal[2] + np.pi) % (2 * np.pi) - np.pi) < 1e-9
    crossing = way[np.argmin(np.abs(way[:, 0] - 2.0))]
    assert crossing[1] < -1.4  # the wall reaches from y = -1.4 up
    assert (
        routes.compute_distances(0, start[None], goal[None])[0]
        > np.hypot(*(goal[:2] - start[:2])) + 1.0
    )


def test_missing_path_is_noted() -> None:
    problem = walled(0.0)
    assert (
        BaseRoutes(problem).find_path(0, problem.start[:3], np.array([4.0, 1.5, 0.0]), 40) is None
    )
    notes: list[str] = []
    assert list(initialize(problem, "astar", 0, notes=notes)) == []
    assert len(notes) == 1
    assert "found no path for the base" in notes[0]
    plan = vkc.plan(problem.scene, [vkc.GoTo(4.0, 1.5, 0.0)], initialization="astar")
    assert plan.status == "infeasible"
    assert "no path for the base, proven" in plan.report()


def test_guess_follows_the_path_with_its_heading() -> None:
    problem = walled(1.6)
    (seed,) = initialize(problem, "astar", 0)
    assert seed.name == "astar"
    path = problem.waypoints(seed.z)[:, :3]
    steps = np.diff(path[:, :2], axis=0)
    length = np.linalg.norm(steps, axis=1)
    heading = path[:-1, 2] + np.diff(path[:, 2]) / 2
    along = np.abs(steps[:, 0] * np.cos(heading) + steps[:, 1] * np.sin(heading))
    assert np.sum(along) > 0.8 * np.sum(length)  # forwards or backwards, not sideways
    assert problem.evaluate_contacts(seed.z, reach=0.02).compute_violation() < 0.02


# --- narrow places
# ------------------------------------------------------------


@pytest.mark.parametrize("width", [NARROW, TIGHT])
def test_folded_arm_fits_through_a_narrow_gate(width: float) -> None:
    problem = gated(width)
    routes, start, goal = BaseRoutes(problem), problem.start[:3], np.array(GOAL)
    home, folded = (
        routes.compute_distances(0, start[None], goal[None], folded=each)[0]
        for each in (False, True)
    )
    straight = np.hypot(*(goal - start)[:2])
    assert np.isinf(home)
    assert straight <= folded < 1.1 * straight
    assert routes.find_path(0, start, goal, 40) is None
    guide = routes.find_guide_path(0, start, goal, 40)
    assert guide is not None
    assert guide.shape == (40, 3)
    np.testing.assert_allclose(guide[-1], goal, atol=1e-9)
    through = np.array([[np.interp(2.0, guide[:, 0], guide[:, 1])]])
    assert abs(through) < 0.03, "it is as wide as the base and a hand"
    # Nothing but the arm is in the way: with it folded the base hits nothing all along.
    z = np.tile(problem.start, (len(guide), 1))
    z[:, :3], z[:, 3:] = guide, routes.get_folded_arm(0)
    assert problem.contacts.evaluate(z, np.ones(len(z), int), reach=0.1).compute_clearance() > 0.0


def test_gate_too_narrow_for_the_base_has_no_path() -> None:
    problem = gated(0.64)
    routes, start, goal = BaseRoutes(problem), problem.start[:3], np.array(GOAL)
    assert np.isinf(routes.compute_distances(0, start[None], goal[None], folded=True)[0])
    assert routes.find_guide_path(0, start, goal, 40) is None


def test_grids_are_cached_separately() -> None:
    routes = BaseRoutes(gated(NARROW))
    home, folded = routes.get_grid(0), routes.get_grid(0, folded=True)
    assert home is routes.get_grid(0)
    assert folded is routes.get_grid(0, folded=True)
    assert folded is not home
    assert np.all(folded.step < home.step)


def test_guide_is_the_usual_path_if_the_arm_at_home_fits() -> None:
    problem = walled(1.6)
    routes, start, goal = BaseRoutes(problem), problem.start[:3], np.array([4.0, 1.5, 0.0])
    guide, way = routes.find_guide_path(0, start, goal, 40), routes.find_path(0, start, goal, 40)
    assert guide is not None
    assert way is not None
    np.testing.assert_allclose(guide, way, atol=1e-9)


def test_guide_reaches_goals_within_the_margin() -> None:
    """Inverse kinematics often leads there."""
    problem = walled(1.6)
    routes, start = BaseRoutes(problem), problem.start[:3]
    near, inside = (
        np.array([1.39, 1.0, 0.0]),
        np.array([1.5, 1.0, 0.0]),
    )  # the wall begins at 1.9, the base is 0.5 m long before
    assert problem.options.dist_safe > 0.01
    assert routes.find_path(0, start, near, 40) is None
    guide = routes.find_guide_path(0, start, near, 40)
    assert guide is not None
    np.testing.assert_allclose(guide[-1], near, atol=1e-9)
    assert routes.find_guide_path(0, start, inside, 40) is None


def test_guide_to_goals_in_collision_does_not_exist() -> None:
    problem = walled(0.0)
    block = np.array([5.5, 0.0, 0.0])  # behind the wall, and so is all that is beside it
    assert BaseRoutes(problem).find_guide_path(0, problem.start[:3], block, 40) is None


def test_folded_arm_is_cached_per_load(monkeypatch: pytest.MonkeyPatch) -> None:
    """The hand is empty in the first phase, and holds the cup in the second."""
    problem = program_of(vkc.load_scene("household"), [vkc.Grasp("cup"), vkc.GoTo(1.0, 0.5)])
    asked: list[int] = []

    def fold(_: object, phase: int, *__: object) -> np.ndarray:
        asked.append(phase)
        return np.full((1, 6), float(phase))

    monkeypatch.setattr("vkc_pin.planning.initialization.base_routes.find_folded_arms", fold)
    routes = BaseRoutes(problem)
    assert [routes.get_folded_arm(phase)[0] for phase in (0, 1, 0, 1)] == [0.0, 1.0, 0.0, 1.0]
    assert asked == [0, 1]


def test_similar_starts_share_distances() -> None:
    """Starts on both sides of a wall agree, in one query or several."""
    problem = walled(1.6)
    goal = np.array([4.0, 1.5, 0.0])
    starts = np.array([[x, y, 0.0] for x in (0.5, 3.5) for y in (-0.55, -0.35, 0.05, 0.85)])
    together = BaseRoutes(problem).compute_distances(0, starts, np.tile(goal, (len(starts), 1)))
    alone = [
        BaseRoutes(problem).compute_distances(0, start[None], goal[None])[0] for start in starts
    ]
    np.testing.assert_array_equal(together, alone)
    assert np.abs(np.diff(np.sort(together))).min() > 1e-3
    beside = starts + np.array([0.04, -0.04, 0.0])
    routes = BaseRoutes(problem)
    shared = [
        routes.compute_distances(0, each, np.tile(goal, (len(starts), 1)))
        for each in (starts, beside)
    ]
    np.testing.assert_array_equal(shared[0], shared[1])
    own = BaseRoutes(problem).compute_distances(0, beside, np.tile(goal, (len(starts), 1)))
    assert np.abs(own - shared[1]).max() < np.hypot(SIMILARITY_TOLERANCE, SIMILARITY_TOLERANCE)
