"""Folded arms: narrower than at home, free, and the same every time."""

from __future__ import annotations

from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import program_of

import vkc_pin as vkc
from vkc_pin.planning.initialization import base_routes as folding
from vkc_pin.planning.initialization.base_routes import BaseRoutes, find_folded_arms
from vkc_pin.planning.initialization.keyframes import compute_shortfall

TASKS = {  # scene and steps, in the last phase of which something is carried
    "nothing": ("household", [vkc.GoTo(1.0, 0.5)]),
    "cup": ("household", [vkc.Grasp("cup"), vkc.GoTo(1.0, 0.5)]),
    "stick": ("init_1", [vkc.Grasp("stick"), vkc.GoTo(0.0, 0.0)]),
}


@cache
def problem(load: str) -> vkc.TrajectoryProblem:
    name, steps = TASKS[load]
    return program_of(vkc.load_scene(name), steps)


def resting(load: str) -> np.ndarray:
    chain = problem(load).chain
    z = np.clip(np.zeros(chain.size), chain.lower, chain.upper)
    z[3 : chain.robot.coordinates.size] = chain.robot.home
    return z


def with_arm(load: str, arm: np.ndarray) -> np.ndarray:
    z = resting(load)
    z[3 : 3 + len(arm)] = arm
    return z


def reach(load: str, z: np.ndarray, *, base: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return the bounding box of the load or the base, by coal and Pinocchio."""
    chain = problem(load).chain
    data, placed = chain.model.createData(), pin.GeometryData(chain.collision)
    pin.updateGeometryPlacements(chain.model, data, chain.collision, placed, chain.coordinates.q(z))
    lows, highs = [], []
    for shape, where in zip(chain.collision.geometryObjects, placed.oMg, strict=True):
        if shape.parentJoint == 1 if base else shape.parentJoint > 1:
            points = (
                np.asarray(shape.geometry.points()) if hasattr(shape.geometry, "points") else None
            )
            if points is None:
                shape.geometry.computeLocalAABB()
                box = shape.geometry.aabb_local
                points = (
                    np.array(np.meshgrid(*zip(box.min_, box.max_, strict=True))).reshape(3, -1).T
                )
            points = points @ where.rotation.T + where.translation
            lows.append(points.min(axis=0))
            highs.append(points.max(axis=0))
    return np.min(lows, axis=0), np.max(highs, axis=0)


@pytest.mark.parametrize("load", TASKS)
def test_folded_arm_is_much_narrower_than_at_home(load: str) -> None:
    p = problem(load)
    arm = find_folded_arms(p, len(p.task.phases) - 1, resting(load))[0]
    low, high = reach(load, with_arm(load, arm))
    low_home, high_home = reach(load, resting(load))
    assert max(high[1], -low[1]) < 0.7 * max(high_home[1], -low_home[1])
    assert low[2] > 0.1, "it is above the floor"
    assert low[0] > -0.7, "and does not hang far over the base's ends"
    assert high[0] < 0.7


@pytest.mark.parametrize("number", [0, 1, -1])
@pytest.mark.parametrize("load", TASKS)
def test_folded_arms_respect_limits_and_self_collisions(load: str, number: int) -> None:
    p = problem(load)
    chain, robot = p.chain, p.chain.robot
    z = with_arm(load, find_folded_arms(p, len(p.task.phases) - 1, resting(load))[number])
    assert np.all((z >= chain.lower) & (z <= chain.upper))
    data, shapes = robot.model.createData(), robot.collision.createData()
    q = robot.coordinates.q(z[: robot.coordinates.size])
    pin.computeDistances(robot.model, data, robot.collision, shapes, q)
    assert (
        min(result.min_distance for result in shapes.distanceResults) > p.options.dist_safe - 1e-4
    )
    # What is carried, too: of the pairs that move in the last phase none comes too close where
    # nothing stands.
    z[:2] = 50.0
    last = np.array([p.segments])
    assert p.contacts.evaluate(z[None], last, reach=p.options.dist_safe).compute_violation() == 0.0


def test_obstacles_do_not_count() -> None:
    """The base is in the wall between the rooms."""
    p = problem("nothing")
    z = resting("nothing")
    z[:2] = 0.0, 1.25
    assert compute_shortfall(p, z[None], 1)[0] > 0.1
    assert compute_shortfall(p, z[None], 1, standing=False)[0] == 0.0


def test_folded_arm_is_deterministic() -> None:
    p = problem("stick")
    np.testing.assert_array_equal(
        find_folded_arms(p, 1, resting("stick")), find_folded_arms(p, 1, resting("stick"))
    )


def test_arm_stays_at_home_if_no_posture_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folding, "compute_shortfall", lambda _, z, *__, **___: np.ones(len(z)))
    np.testing.assert_array_equal(
        find_folded_arms(problem("nothing"), 0, resting("nothing")),
        [problem("nothing").chain.robot.home],
    )


@pytest.mark.parametrize("load", TASKS)
def test_other_folded_arms_extend_no_further_than_the_first(load: str) -> None:
    """The extents are coal's boxes; the package's are slightly larger."""
    p = problem(load)
    arms = find_folded_arms(p, len(p.task.phases) - 1, resting(load))
    assert len(arms) > 10
    own, first = (
        np.max(np.abs(reach(load, with_arm(load, arms[0]), base=base)), axis=0)
        for base in (True, False)
    )
    room = np.maximum(own, first)[:2] + 0.03
    for arm in arms[1:]:
        assert np.all(np.max(np.abs(reach(load, with_arm(load, arm))), axis=0)[:2] <= room)
    sizes = [np.max(np.abs(reach(load, with_arm(load, arm))), axis=0).sum() for arm in arms]
    assert min(sizes) > sizes[0] - 0.03


def test_nearest_folded_arm_minimizes_the_motion() -> None:
    """Equivalent angles are the same posture at another joint position."""
    p = problem("cup")
    routes, arms = (
        BaseRoutes(p),
        find_folded_arms(p, 1, BaseRoutes(p)._make_resting_configuration()),
    )
    np.testing.assert_array_equal(routes.get_folded_arm(1), arms[0])
    metric, rng = p.chain.metric[3:9], np.random.default_rng(0)
    for _ in range(20):
        first, last = rng.uniform(p.chain.lower[3:9], p.chain.upper[3:9], (2, 6))
        near = routes.find_nearest_folded_arm(1, first, last)
        assert np.all((near >= p.chain.lower[3:9]) & (near <= p.chain.upper[3:9]))
        turns = (near - arms) / (2.0 * np.pi)
        assert np.abs(turns - np.round(turns)).max(axis=1).min() < 1e-9, "it is none of them"
        for wound in (arms, arms + 2.0 * np.pi, arms - 2.0 * np.pi):
            inside = np.all((wound >= p.chain.lower[3:9]) & (wound <= p.chain.upper[3:9]), axis=1)
            ways = (np.abs(wound - first) + np.abs(wound - last)) @ metric
            assert (np.abs(near - first) + np.abs(near - last)) @ metric <= ways[inside].min(
                initial=np.inf
            ) + 1e-9
