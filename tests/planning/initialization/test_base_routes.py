"""Tests base paths around a wall and through gates, and folded arms."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.gates import GOAL, NARROW, TOO_NARROW, make_gate_problem, make_wall_problem
from helpers.small_problems import make_program

import vkc_pin as vkc
from vkc_pin.planning.initialization.base_routes import BaseRoutes, find_folded_arms
from vkc_pin.planning.initialization.keyframes import SIMILARITY_TOLERANCE, compute_shortfall
from vkc_pin.planning.initialization.methods import initialize

BEYOND = np.array([4.0, 1.5, 0.0])  # [m], [rad] a pose beyond the wall


def test_path_leads_through_the_gap() -> None:
    problem = make_wall_problem(1.6)
    routes, start = BaseRoutes(problem), problem.start[:3]
    path, guide = (
        find(0, start, BEYOND, 40) for find in (routes.find_path, routes.find_guide_path)
    )
    assert path is not None
    assert guide is not None
    np.testing.assert_allclose(guide, path, atol=1e-9)
    assert path.shape == (40, 3)
    np.testing.assert_allclose(path[-1, :2], BEYOND[:2], atol=1e-9)
    assert abs((path[-1, 2] + np.pi) % (2 * np.pi) - np.pi) < 1e-9
    crossing = path[np.argmin(np.abs(path[:, 0] - 2.0))]
    assert crossing[1] < -1.4  # the wall reaches from y = -1.4 up
    distance = routes.compute_distances(0, start[None], BEYOND[None])[0]
    assert distance > np.hypot(*(BEYOND - start)[:2]) + 1.0


def test_missing_path_is_noted() -> None:
    problem, notes = make_wall_problem(0.0), list[str]()
    routes = BaseRoutes(problem)
    assert routes.find_path(0, problem.start[:3], BEYOND, 40) is None
    assert routes.find_guide_path(0, problem.start[:3], np.array([5.5, 0.0, 0.0]), 40) is None
    assert list(initialize(problem, "astar", 0, notes=notes)) == []
    (note,) = notes
    assert "found no path for the base" in note


def test_guess_follows_the_path_with_its_heading() -> None:
    problem = make_wall_problem(1.6)
    (guess,) = initialize(problem, "astar", 0)
    path = problem.waypoints(guess.z)[:, :3]
    steps = np.diff(path[:, :2], axis=0)
    heading = path[:-1, 2] + np.diff(path[:, 2]) / 2
    along = np.abs(steps[:, 0] * np.cos(heading) + steps[:, 1] * np.sin(heading))
    assert np.sum(along) > 0.8 * np.sum(np.linalg.norm(steps, axis=1))
    assert problem.evaluate_contacts(guess.z, reach=0.02).compute_violation() < 0.02


@pytest.mark.parametrize("width", [NARROW, TOO_NARROW, 0.64])  # the base is 0.67 m wide
def test_folded_arm_fits_through_a_narrow_gate(width: float) -> None:
    problem = make_gate_problem(width)
    routes, start, goal = BaseRoutes(problem), problem.start[:3], np.array(GOAL)
    home, folded = (
        routes.compute_distances(0, start[None], goal[None], folded=each)[0]
        for each in (False, True)
    )
    assert np.isinf(home)
    assert routes.find_path(0, start, goal, 40) is None
    guide = routes.find_guide_path(0, start, goal, 40)
    if width == 0.64:
        assert np.isinf(folded)
        assert guide is None
        return
    straight = np.hypot(*(goal - start)[:2])
    assert straight <= folded < 1.1 * straight
    assert guide is not None
    np.testing.assert_allclose(guide[-1], goal, atol=1e-9)
    z = np.tile(problem.start, (40, 1))
    z[:, :3], z[:, 3:] = guide, routes.get_folded_arm(0)
    assert problem.contacts.evaluate(z, np.ones(40, int), reach=0.1).compute_clearance() > 0.0


def test_guide_reaches_goals_within_the_margin() -> None:
    """Inverse kinematics often yields such goals.

    The wall begins at x = 1.9 m, and the base extends 0.5 m to the front.
    """
    problem = make_wall_problem(1.6)
    routes, start = BaseRoutes(problem), problem.start[:3]
    near, colliding = np.array([1.39, 1.0, 0.0]), np.array([1.5, 1.0, 0.0])
    assert routes.find_path(0, start, near, 40) is None
    guide = routes.find_guide_path(0, start, near, 40)
    assert guide is not None
    np.testing.assert_allclose(guide[-1], near, atol=1e-9)
    assert routes.find_guide_path(0, start, colliding, 40) is None


def test_similar_starts_share_distances() -> None:
    """Starts on both sides of a wall agree, in one query or several."""
    problem = make_wall_problem(1.6)
    starts = np.array([[x, y, 0.0] for x in (0.5, 3.5) for y in (-0.55, -0.35, 0.05, 0.85)])
    goals = np.tile(BEYOND, (len(starts), 1))
    shared = BaseRoutes(problem)
    together = shared.compute_distances(0, starts, goals)
    for start, distance in zip(starts, together, strict=True):
        assert BaseRoutes(problem).compute_distances(0, start[None], BEYOND[None])[0] == distance
    assert np.abs(np.diff(np.sort(together))).min() > 1e-3
    beside = starts + np.array([0.04, -0.04, 0.0])
    np.testing.assert_array_equal(shared.compute_distances(0, beside, goals), together)
    own = BaseRoutes(problem).compute_distances(0, beside, goals)
    assert 0.0 < np.abs(own - together).max() < np.hypot(*[SIMILARITY_TOLERANCE] * 2)


# --- folded arms

TASKS = {  # scene, and steps; the load is carried in their last phase
    "nothing": ("household", [vkc.GoTo(1.0, 0.5)]),
    "cup": ("household", [vkc.Grasp("cup"), vkc.GoTo(1.0, 0.5)]),
    "stick": ("init_1", [vkc.Grasp("stick"), vkc.GoTo(0.0, 0.0)]),
}


@cache
def make_carrying_problem(load: str) -> vkc.TrajectoryProblem:
    name, steps = TASKS[load]
    return make_program(vkc.load_scene(name), steps)


def make_configuration(load: str, arm: np.ndarray | None = None) -> np.ndarray:
    """Return a configuration at the origin with an arm posture. Default: at home."""
    chain = make_carrying_problem(load).chain
    z = np.clip(np.zeros(chain.size), chain.lower, chain.upper)
    z[3:9] = chain.robot.home if arm is None else arm
    return z


@cache
def find_arms(load: str) -> np.ndarray:
    p = make_carrying_problem(load)
    return find_folded_arms(p, len(p.task.phases) - 1, make_configuration(load))


def compute_extent(load: str, z: np.ndarray, *, base: bool = False) -> np.ndarray:
    """Return the bounding box of arm and load or of the base by coal and Pinocchio, (2, 3)."""
    chain = make_carrying_problem(load).chain
    data, placed = chain.model.createData(), pin.GeometryData(chain.collision)
    pin.updateGeometryPlacements(chain.model, data, chain.collision, placed, chain.coordinates.q(z))
    corners = []
    for shape, where in zip(chain.collision.geometryObjects, placed.oMg, strict=True):
        if (shape.parentJoint == 1) if base else (shape.parentJoint > 1):
            if hasattr(shape.geometry, "points"):
                points = np.asarray(shape.geometry.points())
            else:
                shape.geometry.computeLocalAABB()
                box = shape.geometry.aabb_local
                points = np.array(np.meshgrid(*zip(box.min_, box.max_, strict=True)))
                points = points.reshape(3, -1).T
            corners.append(points @ where.rotation.T + where.translation)
    rows = np.vstack(corners)
    return np.array([rows.min(axis=0), rows.max(axis=0)])


@pytest.mark.parametrize("load", TASKS)
def test_folded_arms_are_compact_and_free(load: str) -> None:
    """No arm extends further than the first one or the base, up to the package's larger boxes."""
    p, arms = make_carrying_problem(load), find_arms(load)
    assert len(arms) > 10
    first, home = (
        compute_extent(load, make_configuration(load, arms[0])),
        compute_extent(load, make_configuration(load)),
    )
    assert np.abs(first[:, 1]).max() < 0.7 * np.abs(home[:, 1]).max()
    assert first[0, 2] > 0.1, "the arm must be above the floor"
    assert np.abs(first[:, 0]).max() < 0.7
    own = compute_extent(load, make_configuration(load), base=True)
    allowed = np.abs(np.vstack([first, own])).max(axis=0)[:2] + 0.03
    sizes, robot = [], p.chain.robot
    data, shapes = robot.model.createData(), robot.collision.createData()
    for arm in arms:
        z = make_configuration(load, arm)
        extent = np.abs(compute_extent(load, z)).max(axis=0)
        assert np.all(extent[:2] <= allowed)
        sizes.append(extent.sum())
        assert np.all((z >= p.chain.lower) & (z <= p.chain.upper))
        pin.computeDistances(robot.model, data, robot.collision, shapes, robot.coordinates.q(z[:9]))
        distances = [result.min_distance for result in shapes.distanceResults]
        assert min(distances) > p.options.dist_safe - 1e-4
        z[:2] = 50.0  # far from all obstacles only the load can collide
        contacts = p.contacts.evaluate(z[None], np.array([p.segments]), reach=p.options.dist_safe)
        assert contacts.compute_violation() == 0.0
    assert min(sizes) > sizes[0] - 0.03
    np.testing.assert_array_equal(
        find_folded_arms(p, len(p.task.phases) - 1, make_configuration(load)), arms
    )


def test_shortfall_can_ignore_static_obstacles() -> None:
    """The base is in the wall between the rooms."""
    p, z = make_carrying_problem("nothing"), make_configuration("nothing")
    z[:2] = 0.0, 1.25
    assert compute_shortfall(p, z[None], 1)[0] > 0.1
    assert compute_shortfall(p, z[None], 1, static=False)[0] == 0.0


def test_nearest_folded_arm_minimizes_the_motion() -> None:
    """Angles that differ by full turns are the same posture."""
    p, arms = make_carrying_problem("cup"), find_arms("cup")
    routes, lower, upper = BaseRoutes(p), p.chain.lower[3:9], p.chain.upper[3:9]
    np.testing.assert_array_equal(routes.get_folded_arm(1), arms[0])
    metric, rng = p.chain.metric[3:9], np.random.default_rng(0)

    def measure(arm: np.ndarray) -> np.ndarray:
        return np.asarray((np.abs(arm - first) + np.abs(arm - last)) @ metric)

    for _ in range(20):
        first, last = rng.uniform(lower, upper, (2, 6))
        near = routes.find_nearest_folded_arm(1, first, last)
        assert np.all((near >= lower) & (near <= upper))
        turns = (near - arms) / (2.0 * np.pi)
        assert np.abs(turns - np.round(turns)).max(axis=1).min() < 1e-9
        for wound in (arms, arms + 2.0 * np.pi, arms - 2.0 * np.pi):
            is_inside = np.all((wound >= lower) & (wound <= upper), axis=1)
            assert measure(near) <= measure(wound[is_inside]).min(initial=np.inf) + 1e-9
