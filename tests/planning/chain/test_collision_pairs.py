"""Tests collision pairs of each phase and their margins."""

from __future__ import annotations

import collections
import dataclasses
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.small_problems import (
    SHORT,
    get_margins,
    load_door_scene,
    make_full_scene,
    make_program,
    replace_attachment,
    replace_objects,
)

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.world.models.shapes import get_link_name
from vkc_pin.world.scene.clearance_exemptions import find_clearance_exemptions
from vkc_pin.world.scene.contact_rules import CONTACT_WINDOW
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp

CABINET_FRAME = ("cabinet.case", "cabinet.lid")
MARGIN, CLOSE = SHORT.dist_safe, SHORT.grasp_clearance


@cache
def make_door_problem() -> TrajectoryProblem:
    """Return the problem of opening the door and driving away: reach, turn, move, go to."""
    return make_program(
        load_door_scene(), [Actuate("door", {"hinge": 1.2}), GoTo(0.0, 0.0)], options=SHORT
    )


def list_pairs(
    problem: TrajectoryProblem, phase: int, *, waypoint: int | None = None
) -> dict[tuple[str, str], list[float]]:
    """Return (link, link or obstacle) → margins of their pairs at a waypoint, or unreduced."""
    part = problem.contacts.phases[phase]
    all_pairs = np.arange(len(part.pairs))
    margins = (
        part.margins
        if waypoint is None
        else get_margins(part, all_pairs, np.full(len(all_pairs), waypoint))
    )
    found = collections.defaultdict(list)
    for (first, second), margin in zip(part.pairs, margins, strict=True):
        found[part.labels[first], part.labels[second]].append(float(margin))
    return dict(found)


def count_link_pairs(problem: TrajectoryProblem, phase: int) -> dict[tuple[str, str], int]:
    """Return (link, link or obstacle) → number of pairs, without the robot's own pairs."""
    robot = set(problem.scene.robot.links)
    return {
        key: len(found) for key, found in list_pairs(problem, phase).items() if key[1] not in robot
    }


def count_shapes(problem: TrajectoryProblem) -> collections.Counter[str]:
    """Return the number of shapes of each obstacle and each link of the robot and objects."""
    scene = problem.scene
    robot = scene.robot.collision.geometryObjects
    counts = collections.Counter(get_link_name(shape.name) for shape in robot)
    for name, placed in scene.objects.items():
        shapes = placed.object.collision.geometryObjects
        counts += collections.Counter(f"{name}.{get_link_name(shape.name)}" for shape in shapes)
    return counts + collections.Counter(scene.obstacle_labels)


@pytest.mark.parametrize("phase", [0, 1, 2, 3])
def test_pairs_of_every_phase(phase: int) -> None:
    """The robot is paired with everything, a grasped object with robot and obstacles."""
    problem = make_door_problem()
    scene, part = problem.scene, problem.contacts.phases[phase]
    shapes = scene.robot.collision.geometryObjects
    robot, hand = set(scene.robot.links), set(scene.robot.touch_links)
    on_floor = {get_link_name(shape.name) for shape in shapes if shape.parentJoint == 1}
    moving, held = set(robot), {"door.panel", "door.lever"} if phase in (1, 2) else set()
    expected = {(link, f"door.{part}") for link in robot for part in ("frame", "panel", "lever")}
    if held:
        expected -= {(link, "door.lever") for link in hand}
    expected |= {(link, name) for link in moving | held for name in scene.obstacle_names}
    expected |= {(link, FLOOR) for link in robot - on_floor}
    counts, found = count_shapes(problem), count_link_pairs(problem, phase)
    assert found == {key: counts[key[0]] * counts[key[1]] for key in expected}
    own = {tuple(pair) for pair in part.pairs.tolist() if max(pair) < len(shapes)}
    assert own == {(pair.first, pair.second) for pair in scene.robot.collision.collisionPairs}
    assert len({frozenset(pair) for pair in part.pairs.tolist()}) == len(part.pairs)
    for (first, second), margins in list_pairs(problem, phase).items():
        close = held and first in hand and second.startswith("door.")
        assert set(margins) == {CLOSE if close else MARGIN}


def test_hand_margins_are_reduced_before_grasps_and_after_releases() -> None:
    problem = make_door_problem()
    hand = set(problem.scene.robot.touch_links)
    assert CLOSE < MARGIN
    near, begins = problem.options.steps(CONTACT_WINDOW), problem.contacts.first_waypoint
    for phase, at, away in ((0, begins[1], -1), (3, begins[3], 1)):
        for steps, close in ((0, CLOSE), (near, CLOSE), (near + 1, MARGIN)):
            for (first, second), margins in list_pairs(
                problem, phase, waypoint=int(at + away * steps)
            ).items():
                assert set(margins) == {
                    close if first in hand and second.startswith("door.") else MARGIN
                }


@pytest.mark.parametrize(
    ("own", "expected"), [(None, CLOSE), (0.002, 0.002), (0.0, 0.0), (0.1, MARGIN)]
)
def test_attachment_sets_the_clearance_of_hand_and_object(
    own: float | None, expected: float
) -> None:
    """It never exceeds the usual margin, and applies to no other pairs."""
    scene = load_door_scene()
    placed = scene.objects["door"]
    handle = dataclasses.replace(placed.object.attachments["handle"], name="near", clearance=own)
    steps = [Actuate("door", {"hinge": 1.2}, "near"), GoTo(0.0, 0.0)]
    problem = make_program(
        replace_objects(scene, {"door": replace_attachment(placed, handle)}), steps, options=SHORT
    )
    hand, begins = set(scene.robot.touch_links), problem.contacts.first_waypoint
    for phase, at in ((0, begins[1]), (1, begins[2]), (3, begins[3])):
        for (first, second), margins in list_pairs(problem, phase, waypoint=int(at)).items():
            assert set(margins) == {
                expected if first in hand and second.startswith("door.") else MARGIN
            }


def test_objects_keep_the_state_of_earlier_phases() -> None:
    problem = make_door_problem()
    knob = problem.task.phases[3].initial_values["door.knob"]
    for phase, state in ((0, {}), (3, {"hinge": 1.2, "knob": knob})):
        part = problem.contacts.phases[phase]
        shapes = {s.name: s.placement for s in part.shapes if s.parentJoint == 0}
        for shape in make_world_shapes(problem.scene.objects["door"].with_state(state)):
            assert shapes[f"door.{shape.name}"].isApprox(shape.placement, 1e-9)


def test_grasped_object_is_paired_with_other_objects() -> None:
    """Its branches that do not move, case and lid, are obstacles to the robot only."""
    problem = make_program(make_full_scene(), [Actuate("cabinet", {"swing": 0.5})], options=SHORT)
    robot, held = set(problem.scene.robot.links), {f"cabinet.{k}" for k in ("arm", "tray", "flap")}
    others = {"door.frame", "door.panel", "door.lever", "drawer.cabinet", "drawer.tray"}
    others |= set(problem.scene.obstacle_names)
    counts, found = count_shapes(problem), count_link_pairs(problem, 1)
    expected = {(link, other) for link in held for other in others}
    expected |= {(link, k) for link in robot for k in (*held, *others, *CABINET_FRAME)}
    assert {key: count for key, count in found.items() if key[1] != FLOOR} == {
        key: counts[key[0]] * counts[key[1]] for key in expected
    }
    assert {first for first, second in found if second == FLOOR} <= robot


def test_links_of_a_grasped_object_that_can_collide_are_paired() -> None:
    colliding = frozenset({frozenset({"arm", "flap"}), frozenset({"tray", "lid"})})
    placed = make_full_scene().objects["cabinet"]
    placed = dataclasses.replace(
        placed, object=dataclasses.replace(placed.object, own_pairs=colliding)
    )
    scene = replace_objects(make_full_scene(), {"cabinet": placed})
    found = list_pairs(make_program(scene, [Actuate("cabinet", {"swing": 0.5})], options=SHORT), 1)
    own = {key: found[key] for key in found if all(k.startswith("cabinet.") for k in key)}
    assert {frozenset(link.removeprefix("cabinet.") for link in key) for key in own} == colliding
    assert all(set(margins) == {MARGIN} for margins in own.values())


def test_objects_grasped_in_sequence_have_pairs_only_while_held() -> None:
    steps = [Grasp("door"), Actuate("drawer", {"slide": 0.2})]
    problem = make_program(make_full_scene(), steps, options=SHORT)
    phases = problem.task.phases
    assert [phase.held for phase in phases] == [(), (), (Hold("drawer", "handle"),)]
    for phase, part in zip(phases, problem.contacts.phases, strict=True):
        paired = set(part.pairs.ravel().tolist())
        for hold, indices in problem.chain.held_geometries.items():
            assert paired & set(indices) == (set(indices) if hold in phase.held else set())
    hand = problem.scene.robot.touch_links
    first, last = (
        list_pairs(problem, 1, waypoint=int(at)) for at in problem.contacts.first_waypoint[1:3]
    )
    assert set(last[hand[0], "drawer.tray"]) == {CLOSE}
    assert set(first[hand[0], "door.lever"]) == {CLOSE}


def test_scene_without_collision_geometry_is_rejected() -> None:
    scene = load_door_scene()
    robot = dataclasses.replace(scene.robot, collision=pin.GeometryModel())
    empty = dataclasses.replace(scene, robot=robot, objects={}, obstacles=(), obstacle_labels=())
    with pytest.raises(InputError, match="no pair"):
        make_program(empty, [GoTo(0.0, 0.0)], options=SHORT)


def test_margins_follow_the_options() -> None:
    options = Options(dist_safe=0.05, self_distance=0.03, grasp_clearance=0.01, reach_waypoints=2)
    for steps in ([GoTo(0.0, 0.0)], [Grasp("door", "handle_free")]):
        problem = make_program(load_door_scene(), steps, options=options)
        margins = {
            margin for found in list_pairs(problem, 0, waypoint=2).values() for margin in found
        }
        assert margins == {0.05, 0.03, *([0.01] if isinstance(steps[0], Grasp) else [])}


def make_drawers(*, opening: float = 0.0) -> Scene:
    """Return two drawers 15 mm apart, the second one open by a distance [m]."""
    scene = load_scene("drawer")
    pair = [
        {"type": "drawer", "name": name, "position": [1.93, y, 0.0], "state": {"slide": slide}}
        for name, y, slide in (("near", 0.0, 0.0), ("next", 0.605, opening))
    ]
    return Scene.from_document({**scene.document, "objects": pair, "obstacles": []}, scene.folder)


def make_moving_problem(scene: Scene, slide: float = 0.3) -> tuple[TrajectoryProblem, int]:
    """Return the problem of moving the near drawer, and the phase in which it moves."""
    problem = make_program(scene, [Actuate("near", {"slide": slide})], options=SHORT)
    (number,) = (k for k, part in enumerate(problem.task.phases) if part.name.startswith("move"))
    return problem, number


def test_neighbours_are_exempt_at_their_initial_positions() -> None:
    """They keep half their initial distance, unless one starts outside the exempt range."""
    problem, number = make_moving_problem(make_drawers())
    (exemption,) = find_clearance_exemptions(make_drawers(), SHORT.dist_safe)
    part = problem.contacts.phases[number]
    (region,) = part.margin_regions
    labels = {frozenset((part.labels[i], part.labels[j])) for i, j in part.pairs[region.pairs]}
    assert labels == {frozenset(("near.tray", "next.tray"))}
    assert region.margin == pytest.approx(0.5 * exemption.distance)
    assert region.columns.tolist() == [problem.chain.index("near.slide")]
    assert (region.lower[0], region.upper[0]) == pytest.approx(exemption.ranges["near.slide"])
    opened = make_drawers().with_state("near", {"slide": 0.3})
    problem, number = make_moving_problem(opened, 0.0)  # it returns to the neighbour
    assert problem.contacts.phases[number].margin_regions
    end = exemption.ranges["next.slide"][1]
    for opening, is_exempt in ((end - 1e-4, True), (end + 1e-4, False)):
        problem, number = make_moving_problem(make_drawers(opening=opening))
        assert bool(problem.contacts.phases[number].margin_regions) == is_exempt


@pytest.mark.parametrize(
    ("fields", "margin"), [({"margin": 0.007}, 0.007), ({"margin": 0.1}, MARGIN), ({}, None)]
)
def test_exemptions_remove_pairs_or_reduce_margins(
    fields: dict[str, float], margin: float | None
) -> None:
    exemption = {"pair": ["near.tray", "next.tray"], **fields}
    document = {**make_drawers().document, "allow": [exemption]}
    problem, number = make_moving_problem(Scene.from_document(document, make_drawers().folder))
    found = list_pairs(problem, number)
    own = {m for key in [*found] if set(key) == {"near.tray", "next.tray"} for m in found.pop(key)}
    assert own == (set() if margin is None else {margin})
    assert min(min(margins) for margins in found.values()) >= min(MARGIN, CLOSE)
