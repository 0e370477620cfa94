"""Tests collision pairs, their distances, and witness planes."""

from __future__ import annotations

import collections
import dataclasses
from functools import cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import (
    SHORT,
    all_pairs,
    cabinet,
    door_scene,
    full_scene,
    program_of,
    random_configurations,
    with_attachment,
    with_objects,
)

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.chain.collision_pairs import build_phase_geometries
from vkc_pin.planning.chain.contacts import Contacts
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.utils.budget import Budget, BudgetExhaustedError
from vkc_pin.world.models.shapes import get_link_name
from vkc_pin.world.scene.clearance_exemptions import find_clearance_exemptions
from vkc_pin.world.scene.contact_rules import CONTACT_WINDOW
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Reach, Step

CURVED = {"Cylinder", "Cone", "Capsule", "Sphere", "Ellipsoid"}
COAL = 5e-6  # [m] by which two answers of coal can differ: it starts from where it ended before
MARGIN, CLOSE = SHORT.dist_safe, SHORT.grasp_clearance


@cache
def door_problem() -> TrajectoryProblem:
    """Return the problem of opening the door and driving away: reach, turn, move, go to."""
    return program_of(
        door_scene(), [Actuate("door", {"hinge": 1.2}), GoTo(0.0, 0.0)], options=SHORT
    )


def waypoint_in(problem: TrajectoryProblem, phase: str) -> int:
    """Return the last waypoint of the phase whose name begins with `phase`."""
    (number,) = (k for k, part in enumerate(problem.task.phases) if part.name.startswith(phase))
    return int(problem.ends[number])


def pairs(
    problem: TrajectoryProblem, phase: int, *, waypoint: int | None = None
) -> dict[tuple[str, str], list[float]]:
    """Return (link, link or obstacle) → margins of their pairs at a waypoint, or unreduced."""
    part = problem.contacts.phases[phase]
    every = np.arange(len(part.pairs))
    margins = (
        part.margins if waypoint is None else part.margins_at(every, np.full(len(every), waypoint))
    )
    found = collections.defaultdict(list)
    for (first, second), margin in zip(part.pairs, margins, strict=True):
        found[part.labels[first], part.labels[second]].append(float(margin))
    return dict(found)


class Counted(NamedTuple):
    """How many shapes of each sort a scene has."""

    robot: int
    planned: int  # of the robot, beyond its base
    find_touch_links: int
    own: int  # pairs of the robot with itself
    obstacles: int  # without the floor

    @staticmethod
    def of(scene: Scene) -> Counted:
        robot = scene.robot
        shapes = robot.collision.geometryObjects
        return Counted(
            len(shapes),
            sum(shape.parentJoint > 1 for shape in shapes),
            sum(robot.link_of(i) in robot.touch_links for i in range(len(shapes))),
            len(robot.collision.collisionPairs),
            len(scene.obstacles) - 1,
        )


def test_pairs_of_every_phase_are_counted() -> None:
    n, problem = Counted.of(door_scene()), door_problem()
    frame, panel, lever = 3, 1, 2
    standing = n.own + n.robot * (frame + panel + lever + n.obstacles) + n.planned
    held = (
        n.own
        + n.robot * (panel + lever)
        - n.find_touch_links * lever
        + n.robot * frame
        + (n.robot + panel + lever) * n.obstacles
        + n.planned
    )
    assert min(n) > 3
    assert [len(part.pairs) for part in problem.contacts.phases] == [standing, held, held, standing]
    for part in problem.contacts.phases:
        assert len(part.pairs) == len(part.margins)
        assert len({frozenset(pair) for pair in part.pairs.tolist()}) == len(part.pairs)
        assert len(part.labels) == len(part.shapes) == len(part.joint)


def test_labels_name_links_and_obstacles() -> None:
    scene = door_scene()
    part = door_problem().contacts.phases[0]
    assert set(part.labels) == {
        *scene.robot.links,
        "door.frame",
        "door.panel",
        "door.lever",
        *scene.obstacle_names,
        FLOOR,
    }


def test_static_geometries_are_not_paired() -> None:
    for part in door_problem().contacts.phases:
        assert not np.any((part.joint[part.pairs] == 0).all(axis=1))


@pytest.mark.parametrize("phase", [0, 1, 2, 3])
def test_self_collision_pairs_are_those_of_the_srdf(phase: int) -> None:
    problem = door_problem()
    collision, part = problem.scene.robot.collision, problem.contacts.phases[phase]
    count = len(collision.geometryObjects)
    own = {tuple(pair) for pair in part.pairs.tolist() if max(pair) < count}
    assert own == {(pair.first, pair.second) for pair in collision.collisionPairs}


@pytest.mark.parametrize("phase", [0, 1, 2, 3])
def test_only_links_off_the_floor_can_hit_it(phase: int) -> None:
    problem = door_problem()
    robot = problem.scene.robot
    meets_floor = {first for first, second in pairs(problem, phase) if second == FLOOR}
    driving = {
        get_link_name(shape.name)
        for shape in robot.collision.geometryObjects
        if shape.parentJoint == 1
    }
    assert meets_floor == set(robot.links) - driving
    assert driving


def test_the_hand_may_hold_what_it_grasps_and_nothing_else_may_touch_it() -> None:
    problem = door_problem()
    hand = set(problem.scene.robot.touch_links)
    for phase in (1, 2):
        found = pairs(problem, phase)
        assert {first for first, second in found if second == "door.lever"} == set(
            problem.scene.robot.links
        ) - hand
        assert {first for first, second in found if second == "door.panel"} == set(
            problem.scene.robot.links
        )
        for (first, second), margins in found.items():
            assert set(margins) == {
                CLOSE if first in hand and second.startswith("door.") else MARGIN
            }


def test_the_hand_comes_closer_to_what_it_will_grasp_or_has_let_go_of() -> None:
    problem = door_problem()
    hand = set(problem.scene.robot.touch_links)
    assert CLOSE < MARGIN
    near, begins = problem.options.steps(CONTACT_WINDOW), problem.contacts.first_waypoint
    for phase, at, away in ((0, begins[1], -1), (3, begins[3], 1)):
        for steps, close in ((0, CLOSE), (near, CLOSE), (near + 1, MARGIN)):
            for (first, second), margins in pairs(
                problem, phase, waypoint=int(at + away * steps)
            ).items():
                assert set(margins) == {
                    close if first in hand and second.startswith("door.") else MARGIN
                }


@pytest.mark.parametrize(
    ("own", "expected"), [(None, CLOSE), (0.002, 0.002), (0.0, 0.0), (0.1, MARGIN)]
)
def test_an_attachment_says_how_close_the_hand_may_come_to_its_object(
    own: float | None, expected: float
) -> None:
    """Never further than everything else keeps, and not closer to what is no part of the object."""
    scene = door_scene()
    placed = scene.objects["door"]
    handle = dataclasses.replace(placed.object.attachments["handle"], name="near", clearance=own)
    steps = [Actuate("door", {"hinge": 1.2}, "near"), GoTo(0.0, 0.0)]
    problem = program_of(
        with_objects(scene, {"door": with_attachment(placed, handle)}), steps, options=SHORT
    )
    hand, begins = set(scene.robot.touch_links), problem.contacts.first_waypoint
    for phase, at in ((0, begins[1]), (1, begins[2]), (3, begins[3])):
        for (first, second), margins in pairs(problem, phase, waypoint=int(at)).items():
            assert set(margins) == {
                expected if first in hand and second.startswith("door.") else MARGIN
            }


def test_a_held_object_is_not_paired_with_itself_but_with_the_room() -> None:
    problem = door_problem()
    for phase in (1, 2):
        found = pairs(problem, phase)
        of_door = {second for first, second in found if first.startswith("door.")}
        assert of_door == set(problem.scene.obstacle_names)


def test_objects_stand_where_the_phases_before_left_them() -> None:
    problem = door_problem()
    placed = problem.scene.objects["door"]
    for phase, state in (
        (0, {"hinge": 0.0, "knob": 0.0}),
        (3, {"hinge": 1.2, "knob": problem.task.phases[3].initial_values["door.knob"]}),
    ):
        part, moved = problem.contacts.phases[phase], placed.with_state(state)
        for index, label in enumerate(part.labels):
            if label.startswith("door.") and part.joint[index] == 0:
                shape = part.shapes[index]
                original = next(
                    s
                    for s in placed.object.collision.geometryObjects
                    if f"door.{s.name}" == shape.name
                )
                frame = placed.object.model.frames[original.parentFrame]
                expected = (
                    moved.link_placement(frame.name)
                    * frame.placement.inverse()
                    * original.placement
                )
                np.testing.assert_allclose(
                    shape.placement.homogeneous, expected.homogeneous, rtol=0.0, atol=1e-12
                )


def test_a_held_object_can_hit_other_objects_and_its_own_other_branches_stand() -> None:
    scene = full_scene()
    problem = program_of(scene, [Actuate("cabinet", {"swing": 0.5})], options=SHORT)
    n, found = Counted.of(scene), pairs(problem, 1)
    assert problem.task.phases[1].held == (Hold("cabinet", "grip"),)
    held = {"cabinet.arm": 1, "cabinet.tray": 2, "cabinet.flap": 1}
    others = {
        "door.frame": 3,
        "door.panel": 1,
        "door.lever": 2,
        "drawer.cabinet": 5,
        "drawer.tray": 8,
    }
    for link, count in held.items():
        for other, times in others.items():
            assert len(found[link, other]) == count * times
        assert not any(
            (link, other) in found for other in (*held, "cabinet.case", "cabinet.lid", FLOOR)
        )
    # Case and lid stand in the world: the robot can hit them, and they hit nothing.
    part, robot = problem.contacts.phases[1], set(scene.robot.links)
    for link in ("cabinet.case", "cabinet.lid"):
        assert {first for first, second in found if second == link} == robot
        assert not any(first == link for first, _ in found)
        assert [part.joint[i] for i, label in enumerate(part.labels) if label == link] == [0]
    held_count, other_count = sum(held.values()), sum(others.values())
    # The hand holds the knob, which has no shape: nothing is left out.
    assert len(part.pairs) == (
        n.own
        + n.robot * held_count
        + (n.robot + held_count) * (other_count + n.obstacles)
        + n.robot * 2
        + n.planned
    )
    assert cabinet().attachments["grip"].link == "knob"


def test_links_of_a_held_object_keep_apart_where_its_description_says_that_they_can_meet() -> None:
    """Those that the hand moves from each other, and from what of the object stands."""
    scene, meeting = (
        full_scene(),
        frozenset({frozenset({"arm", "flap"}), frozenset({"tray", "lid"})}),
    )
    placed = scene.objects["cabinet"]
    placed = dataclasses.replace(
        placed, object=dataclasses.replace(placed.object, own_pairs=meeting)
    )
    steps = [Actuate("cabinet", {"swing": 0.5})]
    found = pairs(program_of(with_objects(scene, {"cabinet": placed}), steps, options=SHORT), 1)
    own = {
        key: margins
        for key, margins in found.items()
        if all(label.startswith("cabinet.") for label in key)
    }
    assert {frozenset(link.removeprefix("cabinet.") for link in key) for key in own} == meeting
    assert all(set(margins) == {MARGIN} for margins in own.values())


def test_two_objects_one_after_the_other() -> None:
    problem = program_of(
        full_scene(), [Grasp("door"), Actuate("drawer", {"slide": 0.2})], options=SHORT
    )
    phases = problem.task.phases
    assert [phase.held for phase in phases] == [(), (), (Hold("drawer", "handle"),)]
    for number, standing in enumerate(
        [{"door", "drawer", "cabinet"}, {"door", "drawer", "cabinet"}, {"door", "cabinet"}]
    ):
        part = problem.contacts.phases[number]
        paired = set(part.pairs.ravel().tolist())
        for hold, indices in problem.chain.held_geometries.items():
            # In the chain's geometry are both; only what is held takes part.
            assert (set(indices) <= paired) == (hold.object not in standing)
            assert set(indices).isdisjoint(paired) == (hold.object in standing)
    hand = problem.scene.robot.touch_links
    first, last = (
        pairs(problem, 1, waypoint=int(at)) for at in problem.contacts.first_waypoint[1:3]
    )
    assert set(last[hand[0], "drawer.tray"]) == {CLOSE}
    assert set(first[hand[0], "door.lever"]) == {CLOSE}  # where it comes from


def test_a_scene_in_which_nothing_can_collide_is_refused() -> None:
    scene = door_scene()
    robot = dataclasses.replace(scene.robot, collision=pin.GeometryModel())
    empty = dataclasses.replace(scene, robot=robot, objects={}, obstacles=(), obstacle_labels=())
    with pytest.raises(InputError, match="no pair"):
        program_of(empty, [GoTo(0.0, 0.0)], options=SHORT)


# --- distances
# ------------------------------------------------------------------------------------------------


def all_distances(problem: TrajectoryProblem, phase: int, z: np.ndarray) -> np.ndarray:
    """Return the signed distance of every pair at every configuration from coal, shape (W, P)."""
    part = problem.contacts.phases[phase]
    geometry, model = all_pairs(part), problem.chain.model
    data, placed = model.createData(), pin.GeometryData(geometry)
    for k in range(len(geometry.collisionPairs)):
        placed.distanceRequests[k].gjk_tolerance = 1e-8
    distances = np.empty((len(z), len(part.pairs)))
    for row, q in enumerate(problem.chain.coordinates.q(z)):
        pin.updateGeometryPlacements(model, data, geometry, placed, q)
        pin.computeDistances(geometry, placed)
        distances[row] = [result.min_distance for result in placed.distanceResults]
    return distances


@cache
def sampled(phase: int) -> tuple[np.ndarray, np.ndarray]:
    """Return random configurations of the door problem and the distances of all pairs there."""
    problem = door_problem()
    z = random_configurations(
        problem.chain.lower, problem.chain.upper, 120, np.random.default_rng(phase)
    )
    return z, all_distances(problem, phase, z)


@pytest.mark.parametrize("phase", [0, 2])
@pytest.mark.parametrize("reach", [0.02, 0.25, 1.0])
def test_culling_never_drops_a_pair_within_reach(phase: int, reach: float) -> None:
    problem = door_problem()
    z, distances = sampled(phase)
    at, which, bounds = problem.contacts.phases[phase].boxes.find_close_pairs(
        reach, *problem.chain.joint_placements(z)
    )
    kept = np.zeros(distances.shape, bool)
    kept[at, which] = True
    near = distances < reach
    assert near.sum() > 100
    assert not np.any(near & ~kept)
    assert kept.mean() < 0.75  # it does cull
    assert np.all(np.diff(at) >= 0)
    assert np.all(bounds < reach)
    assert np.all(bounds <= distances[at, which] + 1e-5)  # also of what overlaps


@pytest.mark.parametrize("phase", [0, 2])
def test_all_pairs_within_reach_are_found_with_their_distances(phase: int) -> None:
    problem, reach = door_problem(), 0.25
    z, distances = sampled(phase)
    waypoints = np.full(len(z), problem.ends[phase])
    contacts = problem.contacts.evaluate(z, waypoints, reach=reach)
    part = problem.contacts.phases[phase]
    number = {tuple(pair): k for k, pair in enumerate(part.pairs.tolist())}
    which = np.array([number[tuple(pair)] for pair in contacts.pair.tolist()])
    # Nothing twice, nothing missing (but for the rounding of a distance just at the reach).
    assert len(set(zip(contacts.waypoint.tolist(), which.tolist(), strict=True))) == len(which)
    found = np.zeros(distances.shape, bool)
    found[contacts.waypoint, which] = True
    sure = np.abs(distances - reach) > 1e-5
    np.testing.assert_array_equal(found[sure], (distances < reach)[sure])
    assert np.all(contacts.distance < reach)
    np.testing.assert_allclose(
        contacts.distance, distances[contacts.waypoint, which], rtol=0.0, atol=COAL
    )
    np.testing.assert_array_equal(
        contacts.margin, part.margins_at(which, waypoints[contacts.waypoint])
    )
    # d = n·(b − a), and n is a unit vector.
    np.testing.assert_allclose(np.linalg.norm(contacts.normal, axis=1), 1.0, atol=1e-9)
    along = np.einsum("ci,ci->c", contacts.normal, contacts.second - contacts.first)
    np.testing.assert_allclose(along, contacts.distance, rtol=0.0, atol=1e-9)
    assert (contacts.distance < 0).sum() > 50


def test_many_configurations_at_once_are_as_one_by_one() -> None:
    """coal hands out views of memory that it writes again."""
    problem = door_problem()
    z, _ = sampled(0)
    phases = np.arange(12) % 4
    waypoints = problem.ends[phases]
    together = problem.contacts.evaluate(z[:12], waypoints, reach=0.3)
    assert set(together.waypoint.tolist()) == set(range(12))
    for row in range(12):
        alone = problem.contacts.evaluate(z[row : row + 1], waypoints[row : row + 1], reach=0.3)
        here = together.waypoint == row
        np.testing.assert_array_equal(together.pair[here], alone.pair)
        np.testing.assert_array_equal(together.margin[here], alone.margin)
        np.testing.assert_allclose(together.distance[here], alone.distance, rtol=0.0, atol=COAL)
        np.testing.assert_allclose(
            together.normal[here], alone.normal, rtol=0.0, atol=np.sqrt(COAL)
        )
        assert not alone.waypoint.any()


def test_contacts_do_not_depend_on_how_many_configurations_are_looked_at_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = door_problem()
    z, _ = sampled(2)
    waypoints = problem.ends[np.arange(len(z)) % 4]
    at_once = problem.contacts.evaluate(z, waypoints, reach=0.3, nearest=4)
    assert np.all(np.diff(at_once.waypoint) >= 0)
    monkeypatch.setattr("vkc_pin.planning.chain.contacts._KINEMATICS_BATCH", 50)
    in_portions = problem.contacts.evaluate(z, waypoints, reach=0.3, nearest=4)
    for one, other in zip(at_once.arrays(), in_portions.arrays(), strict=True):
        np.testing.assert_array_equal(one, other)


def test_contacts_are_sorted_by_shortfall() -> None:
    problem = door_problem()
    z, _ = sampled(0)
    waypoints = np.full(len(z), problem.ends[0])
    every = problem.contacts.evaluate(z, waypoints, reach=0.3)
    assert np.all(np.diff(every.waypoint) >= 0)
    lack = every.distance - every.margin
    same = np.diff(every.waypoint) == 0
    assert np.all(np.diff(lack)[same] >= 0)
    nearest = problem.contacts.evaluate(z, waypoints, reach=0.3, nearest=3)
    for row in range(len(z)):
        some, worst = nearest.waypoint == row, np.flatnonzero(every.waypoint == row)[:3]
        np.testing.assert_allclose(
            lack[worst], (nearest.distance - nearest.margin)[some], rtol=0.0, atol=COAL
        )


def test_no_contacts_within_reach() -> None:
    problem = door_problem()
    contacts = problem.contacts.evaluate(problem.start[None], np.array([1]), reach=1e-6)
    assert contacts.pair.shape == (0, 2)
    assert contacts.normal.shape == contacts.first.shape == contacts.second.shape == (0, 3)
    assert contacts.compute_clearance() == np.inf
    assert contacts.compute_violation() == 0.0
    np.testing.assert_array_equal(contacts.compute_shortfall(3), np.zeros(3))
    planes, offsets = problem.contacts.compute_planes(problem.start[None], contacts, slots=4)
    assert planes.shape == (1, 4, 12 * (problem.chain.model.njoints - 1))
    assert not planes.any()
    assert np.all(offsets == -1.0)


def test_shortfall_violation_and_clearance() -> None:
    contacts = Contacts(
        waypoint=np.array([0, 0, 2]),
        pair=np.zeros((3, 2), int),
        distance=np.array([0.004, 0.015, -0.03]),
        margin=np.array([0.005, 0.02, 0.02]),
        normal=np.zeros((3, 3)),
        first=np.zeros((3, 3)),
        second=np.zeros((3, 3)),
    )
    np.testing.assert_allclose(contacts.compute_shortfall(4), [0.005, 0.0, 0.05, 0.0])
    assert contacts.compute_violation() == pytest.approx(0.05)
    assert contacts.compute_clearance() == -0.03
    apart = dataclasses.replace(contacts, distance=np.array([0.005, 0.02, 0.03]))
    assert apart.compute_violation() == 0.0
    np.testing.assert_array_equal(apart.compute_shortfall(3), np.zeros(3))


def test_a_boundary_between_phases_belongs_to_the_earlier() -> None:
    problem = door_problem()
    ends = [0, *problem.ends.tolist()]
    for waypoint in range(ends[-1] + 1):
        phase = problem.contacts.find_phase(waypoint)
        assert ends[phase] < waypoint <= ends[phase + 1] or (waypoint == 0 and phase == 0)


# --- witness planes
# ------------------------------------------------------------------------------------------------


def stacked_placements(model: pin.Model, data: pin.Data, q: np.ndarray) -> np.ndarray:
    """vec(M) of numeric Pinocchio: per joint the columns of its rotation, then its translation."""
    pin.forwardKinematics(model, data, q)
    return np.concatenate(
        [
            np.r_[data.oMi[j].rotation.T.ravel(), data.oMi[j].translation]
            for j in range(1, model.njoints)
        ]
    )


@pytest.mark.parametrize("phase", [0, 2])
def test_planes_have_value_and_gradient_of_the_signed_distance(phase: int) -> None:
    """Compares each plane with coal's distances around a random configuration.

    A distance has one derivative only where its witness points are unique; elsewhere, and where it
    bends within the step, the two one-sided differences differ, and the plane's slope must lie
    between them. Nothing is skipped. Separated, the tolerance is what remains of coal's own (1e-8
    in distance over a step of 1e-4); in penetration coal stops at 1e-6.
    """
    problem, step, slots = door_problem(), 1e-4, 40
    chain, part = problem.chain, problem.contacts.phases[phase]
    z, _ = sampled(phase)
    z = z[:40]
    contacts = problem.contacts.evaluate(
        z, np.full(len(z), problem.ends[phase]), reach=0.25, nearest=slots
    )
    planes, offsets = problem.contacts.compute_planes(z, contacts, slots=slots)
    number = {tuple(pair): k for k, pair in enumerate(part.pairs.tolist())}
    geometry = all_pairs(part)
    data, placed = chain.model.createData(), pin.GeometryData(geometry)
    for k in range(len(part.pairs)):
        placed.distanceRequests[k].gjk_tolerance = 1e-8

    def distances(row: np.ndarray, which: list[int]) -> np.ndarray:
        pin.updateGeometryPlacements(chain.model, data, geometry, placed, chain.coordinates.q(row))
        return np.array([pin.computeDistance(geometry, placed, k).min_distance for k in which])

    kinds = [type(shape.geometry).__name__ for shape in part.shapes]
    errors: dict[tuple[str, str], list[float]] = {
        (a, b): [] for a in ("flat", "round") for b in ("apart", "deep")
    }
    sorts = collections.Counter()
    robots = len(problem.scene.robot.collision.geometryObjects)
    for row, configuration in enumerate(z):
        here = np.flatnonzero(contacts.waypoint == row)
        which = [number[tuple(pair)] for pair in contacts.pair[here].tolist()]
        rows, count = planes[row, : len(here)], len(here)
        placements = stacked_placements(chain.model, data, chain.coordinates.q(configuration))
        value = rows @ placements - offsets[row, :count]
        np.testing.assert_allclose(
            value, contacts.distance[here] - contacts.margin[here], rtol=0.0, atol=1e-9
        )
        assert not planes[row, count:].any()
        assert np.all(offsets[row, count:] == -1.0)
        centre = distances(configuration, which)
        worst = np.zeros(count)
        for i in range(chain.size):
            change = np.zeros(chain.size)
            change[i] = step
            ahead, behind = (
                stacked_placements(
                    chain.model, data, chain.coordinates.q(configuration + s * change)
                )
                for s in (1, -1)
            )
            slope = rows @ (ahead - behind) / (2 * step)
            right = (distances(configuration + change, which) - centre) / step
            left = (centre - distances(configuration - change, which)) / step
            outside = np.maximum(np.minimum(left, right) - slope, slope - np.maximum(left, right))
            worst = np.maximum(worst, outside)
        for error, (first, second), distance in zip(
            worst, contacts.pair[here], contacts.distance[here], strict=True
        ):
            shape = "round" if CURVED & {kinds[first], kinds[second]} else "flat"
            errors[shape, "apart" if distance > 0 else "deep"].append(error)
            sorts["own" if second < robots else "hand" if first < robots else "object"] += 1
    limits = {
        ("flat", "apart"): 1e-4,
        ("flat", "deep"): 1e-3,
        ("round", "apart"): 1e-3,
        ("round", "deep"): 1e-2,
    }
    for kind, found in errors.items():
        assert len(found) > 10, kind
        assert max(found) < limits[kind], kind
        assert np.median(found) < {"flat": 1e-8, "round": 1e-3}[kind[0]], kind
    assert sorts["own"] > 50
    assert sorts["hand"] > 50
    assert (sorts["object"] > 50) == (phase == 2)


def test_planes_of_the_worst_contacts_are_kept() -> None:
    problem = door_problem()
    z, _ = sampled(0)
    z = z[:10]
    contacts = problem.contacts.evaluate(z, np.full(10, problem.ends[0]), reach=0.5)
    few, few_offsets = problem.contacts.compute_planes(z, contacts, slots=2)
    many, many_offsets = problem.contacts.compute_planes(z, contacts, slots=30)
    assert np.bincount(contacts.waypoint).min() > 2
    np.testing.assert_array_equal(few, many[:, :2])
    np.testing.assert_array_equal(few_offsets, many_offsets[:, :2])


@pytest.mark.parametrize(
    "steps",
    [[Reach(pin.SE3.Identity())], [GoTo(0.0, 0.0)], [Grasp("door", "handle_free")]],
    ids=["reach", "go", "grasp"],
)
def test_margins_follow_the_options(steps: list[Step]) -> None:
    options = Options(dist_safe=0.05, self_distance=0.03, grasp_clearance=0.01, reach_waypoints=2)
    problem = program_of(door_scene(), steps, options=options)
    margins = {margin for found in pairs(problem, 0, waypoint=2).values() for margin in found}
    assert margins == ({0.05, 0.03, 0.01} if isinstance(steps[0], Grasp) else {0.05, 0.03})


def test_every_evaluated_configuration_is_charged() -> None:
    problem = door_problem()
    z = np.tile(problem.start, (7, 1))
    for look in (
        lambda: problem.contacts.evaluate(z, np.ones(7, int), reach=0.1),
        lambda: problem.contacts.first_blocked(z, 1, reach=0.0, allowed=1.0),
    ):
        budget = Budget()
        with budget.activate():
            look()
        assert budget.evaluations == 7


def test_configurations_after_a_blocked_one_are_not_charged() -> None:
    problem = door_problem()
    z = np.tile(problem.start, (5, 1))
    z[2:, :2] = door_scene().objects["door"].placement.translation[:2]  # amid the door
    with Budget().activate() as budget:
        assert problem.contacts.first_blocked(z, 1, reach=0.1, allowed=0.01) == 2
    assert budget.evaluations == 3


def test_pairing_stops_when_the_budget_is_exhausted() -> None:
    problem = door_problem()
    with Budget(seconds=0.0).activate(), pytest.raises(BudgetExhaustedError):
        build_phase_geometries(door_scene(), problem.chain, problem.task, SHORT)


def side_by_side(*, out: float = 0.0) -> Scene:
    """Return a room with two drawers 15 mm apart, the second one opened by a distance [m]."""
    scene = load_scene("drawer")
    pair = [
        {"type": "drawer", "name": name, "position": [1.93, y, 0.0], "state": {"slide": slide}}
        for name, y, slide in (("near", 0.0, 0.0), ("next", 0.605, out))
    ]
    return Scene.from_document({**scene.document, "objects": pair, "obstacles": []}, scene.folder)


def test_neighbours_are_exempt_at_their_initial_positions() -> None:
    """Half as close as they stand; not where one that stands still has left the other's side."""
    shut = program_of(side_by_side(), [Actuate("near", {"slide": 0.3})], options=SHORT)
    (allowance,) = find_clearance_exemptions(side_by_side(), SHORT.dist_safe)
    part = shut.contacts.phases[shut.contacts.find_phase(waypoint_in(shut, "move"))]
    (near,) = part.margin_regions
    labels = {frozenset((part.labels[i], part.labels[j])) for i, j in part.pairs[near.pairs]}
    assert labels == {frozenset(("near.tray", "next.tray"))}
    assert near.margin == pytest.approx(0.5 * allowance.distance)
    assert near.columns.tolist() == [shut.chain.index("near.slide")]
    assert (near.lower[0], near.upper[0]) == pytest.approx(allowance.ranges["near.slide"])
    opened = side_by_side().with_state("near", {"slide": 0.3})
    shutting = program_of(
        opened, [Actuate("near", {"slide": 0.0})], options=SHORT
    )  # it comes back to where it is one
    assert shutting.contacts.phases[
        shutting.contacts.find_phase(waypoint_in(shutting, "move"))
    ].margin_regions
    end = allowance.ranges["next.slide"][1]
    for out, beside in ((end - 1e-4, True), (end + 1e-4, False)):
        problem = program_of(
            side_by_side(out=out), [Actuate("near", {"slide": 0.3})], options=SHORT
        )
        part = problem.contacts.phases[problem.contacts.find_phase(waypoint_in(problem, "move"))]
        assert bool(part.margin_regions) == beside


def test_exemptions_remove_pairs_or_reduce_margins() -> None:
    document = side_by_side().document
    for said, margin in (({"margin": 0.007}, 0.007), ({}, None)):
        allowed = Scene.from_document(
            {**document, "allow": [{"pair": ["near.tray", "next.tray"], **said}]},
            side_by_side().folder,
        )
        problem = program_of(allowed, [Actuate("near", {"slide": 0.3})], options=SHORT)
        number = problem.contacts.find_phase(waypoint_in(problem, "move"))
        own = {
            pair: keep
            for pair, keep in pairs(problem, number).items()
            if set(pair) == {"near.tray", "next.tray"}
        }
        if margin is None:
            assert not own
        else:
            assert {keep for every in own.values() for keep in every} == {margin}
        others = {
            keep
            for pair, every in pairs(problem, number).items()
            if set(pair) != {"near.tray", "next.tray"}
            for keep in every
        }
        assert min(others) >= min(MARGIN, CLOSE)
