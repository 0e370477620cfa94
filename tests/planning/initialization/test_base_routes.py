"""Tests base paths around a wall and through gates, and folded arms."""

from __future__ import annotations

import dataclasses
import functools
import itertools

import numpy as np
import pinocchio as pin
import pytest
from helpers.gates import GOAL, NARROW, TOO_NARROW, make_gate_problem, make_wall_problem
from helpers.small_problems import make_program

import vkc_pin as vkc
from vkc_pin.planning.initialization.base_routes import BaseRoutes, find_folded_arms
from vkc_pin.planning.initialization.keyframes import SIMILARITY_TOLERANCE, compute_shortfall

BEYOND = np.array([4.0, 1.5, 0.0])  # [m], [rad] a pose beyond the wall


def test_path_leads_through_the_gap() -> None:
    problem = make_wall_problem(1.6)
    routes, start = BaseRoutes(problem), problem.start[:3]
    path = routes.find_path(0, start, BEYOND, 40)
    assert path is not None
    np.testing.assert_allclose(routes.find_guide_path(0, start, BEYOND, 40), path, atol=1e-9)
    assert path.shape == (40, 3)
    np.testing.assert_allclose(path[-1, :2], BEYOND[:2], atol=1e-9)
    assert abs((path[-1, 2] + np.pi) % (2 * np.pi) - np.pi) < 1e-9
    crossing = path[np.argmin(np.abs(path[:, 0] - 2.0))]
    assert crossing[1] < -1.4  # the wall reaches from y = -1.4 up
    distance = routes.compute_distances(0, start[None], BEYOND[None])[0]
    assert distance > np.hypot(*(BEYOND - start)[:2]) + 1.0


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
    shared, beside = BaseRoutes(problem), starts + np.array([0.04, -0.04, 0.0])
    together = shared.compute_distances(0, starts, goals)
    alone = [
        BaseRoutes(problem).compute_distances(0, start[None], BEYOND[None])[0] for start in starts
    ]
    np.testing.assert_array_equal(together, alone)
    assert np.abs(np.diff(np.sort(together))).min() > 1e-3
    np.testing.assert_array_equal(shared.compute_distances(0, beside, goals), together)
    own = BaseRoutes(problem).compute_distances(0, beside, goals)
    assert 0.0 < np.abs(own - together).max() < np.hypot(*[SIMILARITY_TOLERANCE] * 2)


# --- folded arms

TASKS = {  # scene, and steps; the load is carried in their last phase
    "nothing": ("household", [vkc.GoTo(1.0, 0.5)]),
    "cup": ("household", [vkc.Grasp("cup"), vkc.GoTo(1.0, 0.5)]),
    "stick": ("init_1", [vkc.Grasp("stick"), vkc.GoTo(0.0, 0.0)]),
}


@dataclasses.dataclass
class Load:
    """A problem whose last phase carries an object or nothing."""

    problem: vkc.TrajectoryProblem

    def make_configuration(self, arm: np.ndarray | None = None) -> np.ndarray:
        """Return a configuration at the origin with an arm posture. Default: at home."""
        chain = self.problem.chain
        z = np.clip(np.zeros(chain.size), chain.lower, chain.upper)
        z[3:9] = chain.robot.home if arm is None else arm
        return z

    @functools.cached_property
    def arms(self) -> np.ndarray:
        return self.find_arms()

    def find_arms(self) -> np.ndarray:
        phase = len(self.problem.task.phases) - 1
        return find_folded_arms(self.problem, phase, self.make_configuration())

    def compute_extent(self, arm: np.ndarray | None = None, *, base: bool = False) -> np.ndarray:
        """Return the bounding box of arm and load or of the base by coal, shape (2, 3)."""
        chain = self.problem.chain
        q = chain.coordinates.q(self.make_configuration(arm))
        data, placed, corners = chain.model.createData(), pin.GeometryData(chain.collision), []
        pin.updateGeometryPlacements(chain.model, data, chain.collision, placed, q)
        for shape, where in zip(chain.collision.geometryObjects, placed.oMg, strict=True):
            if (shape.parentJoint == 1) == base and shape.parentJoint > 0:
                solid = shape.geometry
                if not hasattr(solid, "points"):
                    solid.computeLocalAABB()
                    box = solid.aabb_local
                    points = np.array([*itertools.product(*zip(box.min_, box.max_, strict=True))])
                else:
                    points = np.asarray(solid.points())
                corners.append(points @ where.rotation.T + where.translation)
        rows = np.vstack(corners)
        return np.array([rows.min(axis=0), rows.max(axis=0)])


@functools.cache
def make_load(name: str) -> Load:
    scene, steps = TASKS[name]
    return Load(make_program(vkc.load_scene(scene), steps))


@pytest.mark.parametrize("name", TASKS)
def test_folded_arms_are_compact_and_free(name: str) -> None:
    """No arm extends further than the first one or the base, up to the package's larger boxes."""
    load = make_load(name)
    p, arms = load.problem, load.arms
    assert len(arms) > 10
    first, home = load.compute_extent(arms[0]), load.compute_extent()
    assert np.abs(first[:, 1]).max() < 0.7 * np.abs(home[:, 1]).max()
    assert first[0, 2] > 0.1, "the arm must be above the floor"
    assert np.abs(first[:, 0]).max() < 0.7
    own = load.compute_extent(base=True)
    allowed = np.abs(np.vstack([first, own])).max(axis=0)[:2] + 0.03
    sizes, robot = [], p.chain.robot
    data, shapes = robot.model.createData(), robot.collision.createData()
    for arm in arms:
        z = load.make_configuration(arm)
        extent = np.abs(load.compute_extent(arm)).max(axis=0)
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
    np.testing.assert_array_equal(load.find_arms(), arms)


def test_shortfall_can_ignore_static_obstacles() -> None:
    """The base is in the wall between the rooms."""
    load = make_load("nothing")
    z = load.make_configuration()
    z[:2] = 0.0, 1.25
    assert compute_shortfall(load.problem, z[None], 1)[0] > 0.1
    assert compute_shortfall(load.problem, z[None], 1, static=False)[0] == 0.0


def test_nearest_folded_arm_minimizes_the_motion() -> None:
    """Angles that differ by full turns are the same posture."""
    p, arms = make_load("cup").problem, make_load("cup").arms
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
