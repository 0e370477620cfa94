"""Tests collision pairs of each phase, their margins, and reduced margins at contacts."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import (
    STICK,
    TOP,
    compute_grasp_pose,
    describe_box,
    describe_table,
    lift,
    make_room,
    solve_above,
    solve_reach,
)
from helpers.pair_margins import list_pair_margins
from helpers.small_problems import (
    SHORT,
    get_margins,
    load_door_scene,
    make_full_scene,
    make_program,
    replace_attachment,
    replace_objects,
)
from helpers.supports import describe_cup, make_plate_scene, make_scene

from vkc_pin.errors import InputError
from vkc_pin.planning.chain.collision_pairs import REDUCED_MARGIN_RATIO
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.world.models.shapes import get_link_name
from vkc_pin.world.scene.clearance_exemptions import find_clearance_exemptions
from vkc_pin.world.scene.contact_rules import CONTACT_WINDOW
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Step, Touch

GAP = 4e-3  # [m] between the stick and its support
HALF = REDUCED_MARGIN_RATIO * GAP
NEAR = SHORT.steps(CONTACT_WINDOW)
N = 2 * NEAR + 3
LONG = dataclasses.replace(SHORT, reach_waypoints=N, move_waypoints=N)
ASIDE = lift(STICK, [0.0, 0.5, 0.0])
FAR_ASIDE = lift(STICK, [0.0, 1.0, 0.0])
RELIFT = [Place("stick", ASIDE), Grasp("stick"), GoTo(0.0, 1.0)]
POINT = np.array([0.8, 0.7, 0.75])
MarginEnds = tuple[float | None, float | None]
"""Margins at begin and end of a phase; None: not reduced."""


def make_room_with_table(gap: float, *others: dict[str, Any]) -> Scene:
    return make_room(describe_table(gap=gap), *others)


def make_room_with_turned_tables() -> Scene:
    """Return a room with a table below the stick, one beside it, and a wall 1 cm beside its tip."""
    table = describe_box("table", [1.3, 0.5, 0.02], [0.8, -0.3, TOP - GAP - 0.01])
    other = describe_box("other", [0.5, 0.6, 0.02], [0.8, 1.0, TOP - GAP - 0.01])
    wall = describe_box("wall", [0.3, 0.02, 0.3], [0.8, 0.27, TOP + 0.1])
    return make_room({**table, "rpy": [0.0, 0.0, np.pi / 2]}, other, wall)


def make_held_scene(gap: float, *, height: float = 0.0) -> Scene:
    """Return a room in which the stick is held at the start, `height` above its place."""
    scene = make_room_with_table(gap)
    row = solve_reach(compute_grasp_pose(lift(STICK, [0.0, 0.0, height])), solve_above(STICK))
    return scene.with_start(base=row[:3], arm=row[3:]).with_held({"stick": "grip"})


def make_room_with_wall(gap: float) -> Scene:
    """Return a room with a held stick and a wall `gap` [m] behind `POINT`."""
    wall = describe_box("wall", [0.3, 0.1, 0.3], [POINT[0], POINT[1] + gap + 0.05, POINT[2]])
    return make_room(wall).with_held({"stick": "grip"})


def make_tray_before_wall() -> Scene:
    """Return a cup on a tray, 1 cm in front of a wall."""
    objects = [
        {"name": "tray", "type": "tray.yaml", "position": [0.8, 0.0, 0.7]},
        describe_cup(at=(0.82, 0.05, 0.72)),
    ]
    return make_scene(objects, [describe_box("wall", [0.02, 0.02, 0.05], [0.875, 0.05, 0.78])])


def make_touches(*margins: MarginEnds) -> list[dict[tuple[str, str], MarginEnds]]:
    return [{(f"stick.tip_{k}", "wall"): ends for k in (0, 1)} for ends in margins]


def put_on(table: str, begin: float | None, end: float | None) -> dict[tuple[str, str], MarginEnds]:
    """Return the expected margins of the stick's two discs."""
    return {(f"stick.stick_{k}", table): (begin, end) for k in (1, 2)}


def compute_margins(p: TrajectoryProblem, phase: int) -> dict[tuple[str, str], np.ndarray]:
    """Return (shape, link) → reduced margin at each waypoint of a phase, without the hand."""
    part, first = p.contacts.phases[phase], int(p.contacts.first_waypoint[phase])
    waypoints = np.arange(first, first + p.task.phases[phase].segments + 1)
    found: dict[tuple[str, str], np.ndarray] = {}
    assert set(part.reduced_margins) <= set(range(len(part.pairs)))
    for k, (one, other) in enumerate(part.pairs.tolist()):
        row = get_margins(part, np.full(len(waypoints), k), waypoints)
        assert k in part.reduced_margins or (row == part.margins[k]).all()
        if k in part.reduced_margins and part.labels[one] not in p.scene.robot.touch_links:
            found[part.shapes[one].name.replace("^", ""), part.labels[other]] = row
    return found


@pytest.mark.parametrize(
    ("make", "steps", "expected"),
    [
        pytest.param(
            lambda: make_room_with_table(0.03),
            [Place("stick", ASIDE)],
            [{}, {}],
            id="table farther than the margin",
        ),
        *(
            pytest.param(
                lambda gap=gap: make_room_with_table(gap),
                RELIFT,
                [{}, put_on("table", begin, end), {}, put_on("table", end, None)],
                id=f"placed and lifted again, gap {gap}",
            )
            # an initial penetration may be left but not entered
            for gap, begin, end in ((GAP, HALF, HALF), (0.0, 0.0, 0.0), (-1e-3, -1e-3, 0.0))
        ),
        pytest.param(
            make_room_with_turned_tables,
            [Place("stick", FAR_ASIDE)],
            [
                {},
                put_on("table", HALF, None)
                | put_on("other", None, HALF)
                | {("stick.tip_1", "wall"): (REDUCED_MARGIN_RATIO * 0.01, None)},
            ],
            id="only close shapes",
        ),
        pytest.param(
            make_room,
            [Place("stick", pin.SE3(np.eye(3), np.array([0.8, 0.0, 0.051])))],
            [{}, put_on(FLOOR, None, REDUCED_MARGIN_RATIO * 1e-3)],
            id="floor",
        ),
        *(
            pytest.param(
                lambda gap=gap: make_held_scene(gap),
                [GoTo(0.0, 1.0), GoTo(0.0, 0.0)],
                [put_on("table", margin, None), {}],
                id=f"held at the start, gap {gap}",
            )
            for gap, margin in ((GAP, HALF), (0.0, 0.0), (-1e-3, -1e-3))
        ),
        pytest.param(
            lambda: make_held_scene(GAP, height=0.1),
            [GoTo(0.0, 1.0)],
            [{}],
            id="held above the table",
        ),
        *(
            pytest.param(
                lambda gap=gap: make_room_with_wall(gap),
                [Touch("stick.tip", POINT), GoTo(0.0, 0.0), GoTo(0.0, 1.0)],
                [*make_touches((None, margin), (margin, None)), {}]
                if margin is not None
                else [{}, {}, {}],
                id=f"touch, gap {gap}",
            )
            for gap, margin in ((0.0, 0.0), (0.006, 0.003), (-0.01, 0.0), (0.03, None))
        ),
        pytest.param(
            lambda: make_room_with_table(GAP),
            [Touch("forearm_link", (0.8, 0.0, TOP))],
            [{(f"forearm_link_{k}", "table"): (None, HALF) for k in range(2)}],
            id="touch with a link of the robot",
        ),
        pytest.param(
            make_room, [Touch("base_link", (0.8, 0.0, 0.0))], [{}], id="touch without such a pair"
        ),
        pytest.param(
            lambda: make_room_with_table(GAP),
            [Reach(pin.SE3(np.eye(3), np.array([0.8, 0.0, TOP])))],
            [{}],
            id="pose",
        ),
        pytest.param(
            lambda: make_plate_scene(cups=1, wall=0.01),
            [Actuate("plate", {"slide": 0.3})],
            [{}, {("cup.cup_0", "wall"): (REDUCED_MARGIN_RATIO * 0.01, None)}],
            id="cup on a plate that moves",
        ),
        pytest.param(
            make_tray_before_wall,
            [Place("tray", (-0.5, -1.5, 0.7))],
            [{}, {("cup.cup_0", "wall"): (REDUCED_MARGIN_RATIO * 0.01, None)}],
            id="cup on a tray that is lifted",
        ),
    ],
)
def test_margins_are_reduced_near_contacts(
    make: Callable[[], Scene],
    steps: list[Step],
    expected: list[dict[tuple[str, str], MarginEnds]],
) -> None:
    """A margin is half the distance at the begin or end of a phase, and else `dist_safe`."""
    p = make_program(make(), steps, options=LONG)
    assert len(p.task.phases) == len(expected)
    for phase, margins in enumerate(expected):
        found = compute_margins(p, phase)
        assert set(found) == set(margins)
        for pair, (begin, end) in margins.items():
            row = np.full(N + 1, LONG.dist_safe)
            row[: NEAR + 1] = LONG.dist_safe if begin is None else begin
            row[-NEAR - 1 :] = LONG.dist_safe if end is None else end
            # a touched point has a size of 0.1 mm
            np.testing.assert_allclose(found[pair], row, rtol=0.0, atol=6e-5)


def test_duration_of_reduced_margins_does_not_depend_on_the_time_step() -> None:
    fine = dataclasses.replace(LONG, dt=LONG.dt / 2, reach_waypoints=2 * N)
    for options in (LONG, fine):
        p = make_program(make_room_with_table(GAP), [Place("stick", ASIDE)], options=options)
        first, reduced = p.contacts.first_waypoint[1], p.contacts.phases[1].reduced_margins
        spans = {(begin - first, end - first) for row in reduced.values() for begin, end, _ in row}
        assert {(begin * options.dt, end * options.dt) for begin, end in spans} == {
            (0.0, CONTACT_WINDOW),
            (N * LONG.dt - CONTACT_WINDOW, N * LONG.dt),
        }


def test_short_phases_begin_and_end_with_reduced_margins() -> None:
    options = dataclasses.replace(SHORT, reach_waypoints=NEAR)
    lower = Place("stick", lift(STICK, [0.0, 0.5, -GAP]))
    p = make_program(make_room_with_table(GAP), [lower], options=options)
    assert set(compute_margins(p, 1)) == set(put_on("table", 0.0, 0.0))
    for row in compute_margins(p, 1).values():
        np.testing.assert_allclose(row, np.zeros(NEAR + 1), atol=1e-6)


CABINET_FRAME = ("cabinet.case", "cabinet.lid")
MARGIN, CLOSE, SELF = SHORT.dist_safe, SHORT.grasp_clearance, 0.015


@cache
def make_door_problem() -> TrajectoryProblem:
    """Return the problem of opening the door and driving away: reach, turn, move, go to."""
    steps = [Actuate("door", {"hinge": 1.2}), GoTo(0.0, 0.0)]
    options = dataclasses.replace(SHORT, self_distance=SELF)
    return make_program(load_door_scene(), steps, options=options)


def count_link_pairs(problem: TrajectoryProblem, phase: int) -> dict[tuple[str, str], int]:
    """Return (link, link or obstacle) → number of pairs, without the robot's own pairs."""
    robot = set(problem.scene.robot.links)
    return {
        key: len(found)
        for key, found in list_pair_margins(problem, phase).items()
        if key[1] not in robot
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
    for (first, second), margins in list_pair_margins(problem, phase).items():
        close = held and first in hand and second.startswith("door.")
        assert set(margins) == {SELF if second in robot else CLOSE if close else MARGIN}


@pytest.mark.parametrize(
    ("own", "expected"), [(None, CLOSE), (0.002, 0.002), (0.0, 0.0), (0.1, MARGIN)]
)
def test_hand_has_the_clearance_of_its_attachment_from_before_grasp_to_after_release(
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
    hand = set(scene.robot.touch_links)
    _, grasp, turned, release, _ = problem.contacts.first_waypoint.tolist()
    for phase, waypoint, is_near in (
        (0, grasp - NEAR - 1, False),
        (0, grasp - NEAR, True),
        (0, grasp, True),
        (1, turned, True),
        (3, release, True),
        (3, release + NEAR, True),
        (3, release + NEAR + 1, False),
    ):
        for (first, second), margins in list_pair_margins(
            problem, phase, waypoint=waypoint
        ).items():
            is_reduced = is_near and first in hand and second.startswith("door.")
            assert set(margins) == {expected if is_reduced else MARGIN}


def test_objects_keep_the_state_of_earlier_phases() -> None:
    problem = make_door_problem()
    knob = problem.task.phases[3].initial_values["door.knob"]
    for phase, state in ((0, {}), (3, {"hinge": 1.2, "knob": knob})):
        shapes = {shape.name: shape.placement for shape in problem.contacts.phases[phase].shapes}
        for shape in make_world_shapes(problem.scene.objects["door"].with_state(state)):
            assert shapes[f"door.{shape.name}"].isApprox(shape.placement, 1e-9)


def test_grasped_object_is_paired_with_other_objects() -> None:
    """Its branches that do not move are obstacles to the robot, and to links that can hit them."""
    placed = make_full_scene().objects["cabinet"]
    colliding = frozenset({frozenset({"arm", "flap"}), frozenset({"tray", "lid"})})
    item = dataclasses.replace(placed.object, own_pairs=colliding)
    placed = dataclasses.replace(placed, object=item)
    scene = replace_objects(make_full_scene(), {"cabinet": placed})
    problem = make_program(scene, [Actuate("cabinet", {"swing": 0.5})], options=SHORT)
    robot, held = set(scene.robot.links), {f"cabinet.{k}" for k in ("arm", "tray", "flap")}
    others = {"door.frame", "door.panel", "door.lever", "drawer.cabinet", "drawer.tray"}
    others |= set(scene.obstacle_names)
    counts, found = count_shapes(problem), count_link_pairs(problem, 1)
    expected = {(link, other) for link in held for other in others}
    expected |= {(link, k) for link in robot for k in (*held, *others, *CABINET_FRAME)}
    own = {("cabinet.arm", "cabinet.flap"), ("cabinet.tray", "cabinet.lid")}
    assert {key: count for key, count in found.items() if key[1] != FLOOR} == {
        key: counts[key[0]] * counts[key[1]] for key in expected | own
    }
    assert {first for first, second in found if second == FLOOR} <= robot
    margins = list_pair_margins(problem, 1)
    assert all(set(margins[pair]) == {MARGIN} for pair in own)


def test_scene_without_collision_geometry_is_rejected() -> None:
    scene = load_door_scene()
    robot = dataclasses.replace(scene.robot, collision=pin.GeometryModel())
    empty = dataclasses.replace(scene, robot=robot, objects={}, obstacles=(), obstacle_labels=())
    with pytest.raises(InputError, match="no pair"):
        make_program(empty, [GoTo(0.0, 0.0)], options=SHORT)


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
    found = list_pair_margins(problem, number)
    own = {m for key in [*found] if set(key) == {"near.tray", "next.tray"} for m in found.pop(key)}
    assert own == (set() if margin is None else {margin})
    assert min(min(margins) for margins in found.values()) >= min(MARGIN, CLOSE)
