"""Tests collision pairs of each phase, their margins, and reduced margins at contacts."""

from __future__ import annotations

import collections
import dataclasses
from functools import cache

import coal
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
    move_base,
    solve_above,
    solve_reach,
)
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
from hypothesis import given, settings
from hypothesis import strategies as st

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.chain.collision_pairs import REDUCED_MARGIN_RATIO, PhaseGeometry
from vkc_pin.planning.nlp.problem import TrajectoryProblem
from vkc_pin.world.models.shapes import compute_bounding_box, compute_shape_distance, get_link_name
from vkc_pin.world.scene.clearance_exemptions import find_clearance_exemptions
from vkc_pin.world.scene.contact_rules import CONTACT_WINDOW
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene, load_scene
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Step, Touch

JOINTS = 3
COAL = 1e-5  # [m]


def sample_placement(rng: np.random.Generator, size: float) -> pin.SE3:
    return pin.SE3(pin.exp3(rng.normal(size=3)), rng.uniform(-size, size, 3))


def make_random_geometry(
    rng: np.random.Generator, moving: int = 7, static: int = 9
) -> PhaseGeometry:
    """Return random shapes on joints and in a 3 m room, with two thirds of all pairs."""
    shapes = []
    for k in range(moving + static):
        size = rng.uniform(0.02, 0.4, 3)
        solid = [coal.Box(*size), coal.Sphere(size[0] / 2), coal.Cylinder(size[0] / 2, size[1])][
            int(rng.integers(3))
        ]
        joint = 1 + int(rng.integers(JOINTS)) if k < moving else 0
        shapes.append(
            pin.GeometryObject(
                f"s{k}", joint, 0, sample_placement(rng, 0.3 if joint else 1.5), solid
            )
        )
    candidates = [
        (a, b)
        for a in range(moving)
        for b in range(a + 1, len(shapes))
        if shapes[a].parentJoint != shapes[b].parentJoint
    ]
    pairs = np.array([pair for pair in candidates if rng.random() < 0.66]).reshape(-1, 2)
    boxes = [compute_bounding_box(shape) for shape in shapes]
    return PhaseGeometry(
        shapes=shapes,
        labels=tuple(shape.name for shape in shapes),
        pairs=pairs,
        margins=rng.uniform(0.01, 0.05, len(pairs)),
        joint=np.array([shape.parentJoint for shape in shapes]),
        center=np.array([center for center, _ in boxes]),
        half=np.array([half for _, half in boxes]),
        rotation=np.array([shape.placement.rotation for shape in shapes]),
        translation=np.array([shape.placement.translation for shape in shapes]),
    )


def sample_joints(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return universe and joint placements, shapes (count, J + 1, 3, 3) and (count, J + 1, 3)."""
    rotations = np.array(
        [[np.eye(3), *(pin.exp3(rng.normal(size=3)) for _ in range(JOINTS))] for _ in range(count)]
    )
    translations = rng.uniform(-1.5, 1.5, (count, JOINTS + 1, 3))
    translations[:, 0] = 0.0
    return rotations, translations


def compute_all_distances(
    part: PhaseGeometry, rotations: np.ndarray, translations: np.ndarray
) -> np.ndarray:
    """Return coal's distance of every pair at every configuration, shape (W, P)."""
    out = np.empty((len(rotations), len(part.pairs)))
    for w in range(len(rotations)):
        at = [
            pin.SE3(rotations[w, s.parentJoint], translations[w, s.parentJoint]) * s.placement
            for s in part.shapes
        ]
        for k, (a, b) in enumerate(part.pairs.tolist()):
            out[w, k] = compute_shape_distance(
                part.shapes[a].geometry, at[a], part.shapes[b].geometry, at[b]
            )
    return out


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_static_geometry_can_be_moved(seed: int) -> None:
    rng = np.random.default_rng(seed)
    part, joints = make_random_geometry(rng), sample_joints(rng, 4)
    part.boxes.find_close_pairs(0.1, *joints)  # fills caches that the copy must not use
    where = {geometry: sample_placement(rng, 1.5) for geometry in (8, 11)}
    moved = part.with_placements(where)
    at, pairs, _ = moved.boxes.find_close_pairs(0.1, *joints)
    for geometry, placement in where.items():
        assert moved.shapes[geometry].placement.isApprox(placement)
        assert not part.shapes[geometry].placement.isApprox(placement)
    close = np.argwhere(compute_all_distances(moved, *joints) < 0.1 - COAL).tolist()
    assert {tuple(pair) for pair in close} <= set(zip(at.tolist(), pairs.tolist(), strict=True))


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_static_geometry_near_a_box(seed: int) -> None:
    rng = np.random.default_rng(seed)
    part = make_random_geometry(rng)
    lower = rng.uniform(-1.5, 1.0, 3)
    size = rng.uniform(0.05, 0.6, 3)
    box, here = coal.Box(*size), pin.SE3(np.eye(3), lower + size / 2)
    near = part.find_static_near(0.1, lower, lower + size).tolist()
    for k in range(7, 16):
        shape = part.shapes[k]
        if compute_shape_distance(box, here, shape.geometry, shape.placement) < 0.1 - COAL:
            assert k in near
    assert min(near, default=7) >= 7
    listed = part.pairs.tolist()
    for first in range(7):
        numbers = part.find_pairs(first, np.arange(7, 16)).tolist()
        assert [listed[k] for k in numbers] == [
            [first, b] for b in range(7, 16) if [first, b] in listed
        ]


GAP = 4e-3  # [m] between the stick and its support
NEAR = SHORT.steps(CONTACT_WINDOW)
LONG = dataclasses.replace(SHORT, reach_waypoints=2 * NEAR + 3)
N = LONG.reach_waypoints
ASIDE = lift(STICK, [0.0, 0.5, 0.0])


def make_problem(scene: Scene, *steps: Step) -> TrajectoryProblem:
    return make_program(scene, steps, options=LONG)


def compute_margins(p: TrajectoryProblem, phase: int) -> dict[tuple[str, str], np.ndarray]:
    """Return links → smallest reduced margin at each waypoint of a phase, without the hand."""
    part, first = p.contacts.phases[phase], int(p.contacts.first_waypoint[phase])
    waypoints = range(first, first + p.task.phases[phase].segments + 1)
    found: dict[tuple[str, str], np.ndarray] = {}
    for k, pair in enumerate(part.pairs.tolist()):
        row = get_margins(part, np.full(len(waypoints), k), np.array(waypoints))
        assert k in part.reduced_margins or (row == part.margins[k]).all()
        if k in part.reduced_margins and part.labels[pair[0]] not in p.scene.robot.touch_links:
            key = (part.labels[pair[0]], part.labels[pair[1]])
            found[key] = np.minimum(found.get(key, np.inf), row)
    return found


def assert_reduced(
    row: np.ndarray,
    margin: float,
    *,
    begin: bool = False,
    end: bool = False,
    tolerance: float = 1e-6,
) -> None:
    """Assert that a margin applies near begin or end, and dist_safe elsewhere."""
    expected = np.full(N + 1, LONG.dist_safe)
    if begin:
        expected[: NEAR + 1] = margin
    if end:
        expected[-NEAR - 1 :] = margin
    np.testing.assert_allclose(row, expected, rtol=0.0, atol=tolerance)


def test_margins_are_not_reduced_without_need() -> None:
    p = make_problem(make_room(describe_table(gap=GAP)), GoTo(0.0, 1.0))
    assert compute_margins(p, 0) == {}
    far = make_problem(make_room(describe_table(gap=0.03)), Place("stick", ASIDE))
    assert [compute_margins(far, phase) for phase in (0, 1)] == [{}, {}]


def test_margins_are_reduced_where_objects_are_lifted_and_placed() -> None:
    """An object that is placed elsewhere and lifted again has reduced margins there, too."""
    steps = [Place("stick", ASIDE), Grasp("stick"), GoTo(0.0, 1.0)]
    p = make_problem(make_room(describe_table(gap=GAP)), *steps)
    names = ["reach stick.grip", "place stick", "reach stick.grip", "go to"]
    assert [phase.name for phase in p.task.phases] == names
    assert [compute_margins(p, phase) for phase in (0, 2)] == [{}, {}]
    for phase, windows in ((1, {"begin": True, "end": True}), (3, {"begin": True})):
        found = compute_margins(p, phase)
        assert set(found) == {("stick.stick", "table")}
        assert_reduced(found["stick.stick", "table"], REDUCED_MARGIN_RATIO * GAP, **windows)


def test_margin_is_half_the_distance_of_each_shape() -> None:
    wall = describe_box("wall", [0.3, 0.02, 0.3], [0.8, 0.25 + 0.01 + 0.01, TOP + 0.1])
    p = make_problem(make_room(describe_table(gap=GAP), wall), Place("stick", ASIDE))
    part, first = p.contacts.phases[1], int(p.contacts.first_waypoint[1])
    reduced = {
        (part.shapes[i].name, part.labels[j]): [*part.reduced_margins[k]]
        for k, (i, j) in enumerate(part.pairs.tolist())
        if k in part.reduced_margins
    }
    assert set(reduced) >= {
        ("stick.stick_1", "table"),
        ("stick.stick_2", "table"),
        ("stick.tip_1", "wall"),
    }
    assert not {name for name, label in reduced if label == "table"} - {
        "stick.stick_1",
        "stick.stick_2",
    }
    ((begin, end, margin),) = reduced["stick.tip_1", "wall"]  # the wall is far from the other end
    assert (begin, end) == (first, first + NEAR)
    assert margin == pytest.approx(REDUCED_MARGIN_RATIO * 0.01, abs=1e-6)


def test_duration_of_reduced_margins_does_not_depend_on_the_time_step() -> None:
    fine = dataclasses.replace(LONG, dt=LONG.dt / 2, reach_waypoints=2 * N)
    for options in (LONG, fine):
        p = make_program(
            make_room(describe_table(gap=GAP)), [Place("stick", ASIDE)], options=options
        )
        first, reduced = p.contacts.first_waypoint[1], p.contacts.phases[1].reduced_margins
        spans = {(begin - first, end - first) for row in reduced.values() for begin, end, _ in row}
        assert {(begin * options.dt, end * options.dt) for begin, end in spans} == {
            (0.0, CONTACT_WINDOW),
            (N * LONG.dt - CONTACT_WINDOW, N * LONG.dt),
        }


@pytest.mark.parametrize("gap", [0.0, -1e-3])
def test_initial_penetration_may_be_left_but_not_entered(gap: float) -> None:
    p = make_problem(
        make_room(describe_table(gap=gap)), Place("stick", ASIDE), Grasp("stick"), GoTo(0.0, 0.0)
    )
    found = compute_margins(p, 1)["stick.stick", "table"]
    np.testing.assert_allclose(found[: NEAR + 1], gap, rtol=0.0, atol=1e-6)
    assert_reduced(np.append(np.zeros(NEAR + 1), found[NEAR + 1 :]), 0.0, begin=True, end=True)
    assert_reduced(compute_margins(p, 3)["stick.stick", "table"], 0.0, begin=True)


def test_margins_are_reduced_to_the_object_below_only() -> None:
    other = describe_box("other", [0.5, 0.6, 0.02], [0.8, 1.0, TOP - GAP - 0.01])
    small = describe_box("table", [0.5, 0.7, 0.02], [0.8, 0.0, TOP - GAP - 0.01])
    p = make_problem(make_room(small, other), Place("stick", lift(STICK, [0.0, 1.0, 0.0])))
    found = compute_margins(p, 1)
    assert set(found) == {("stick.stick", "table"), ("stick.stick", "other")}
    assert_reduced(found["stick.stick", "table"], REDUCED_MARGIN_RATIO * GAP, begin=True)
    assert_reduced(found["stick.stick", "other"], REDUCED_MARGIN_RATIO * GAP, end=True)


@pytest.mark.parametrize(
    ("gap", "margin"), [(GAP, REDUCED_MARGIN_RATIO * GAP), (0.0, 0.0), (-1e-3, -1e-3)]
)
def test_object_grasped_at_the_start_may_leave_its_support(gap: float, margin: float) -> None:
    scene, row = (
        make_room(describe_table(gap=gap)),
        solve_reach(compute_grasp_pose(STICK), solve_above(STICK)),
    )
    held = scene.with_start(base=row[:3], arm=row[3:]).with_held({"stick": "grip"})
    found = compute_margins(make_problem(held, GoTo(0.0, 1.0), GoTo(0.0, 0.0)), 0)
    assert set(found) == {("stick.stick", "table")}
    assert_reduced(found["stick.stick", "table"], margin, begin=True)
    assert compute_margins(make_problem(held, GoTo(0.0, 1.0), GoTo(0.0, 0.0)), 1) == {}
    raised = held.with_start(base=move_base(row, x=-0.1)[:3], arm=solve_above(STICK)[3:])
    assert compute_margins(make_problem(raised, GoTo(0.0, 1.0)), 0) == {}


def test_margins_of_supported_objects_are_reduced_where_transport_begins() -> None:
    options = dataclasses.replace(LONG, move_waypoints=N)
    p = make_program(
        make_plate_scene(cups=1, wall=0.01), [Actuate("plate", {"slide": 0.3})], options=options
    )
    (number,) = (k for k, phase in enumerate(p.task.phases) if phase.supported)
    row = compute_margins(p, number)["cup.cup", "wall"]
    assert row[0] == pytest.approx(REDUCED_MARGIN_RATIO * 0.01, abs=1e-4)
    assert row[-1] == LONG.dist_safe


def test_margins_of_objects_on_a_tray_are_reduced_where_it_is_lifted() -> None:
    """A cup on a tray is 1 cm in front of a wall. The tray is placed away from the wall."""
    objects = [
        {"name": "tray", "type": "tray.yaml", "position": [0.8, 0.0, 0.7]},
        describe_cup(at=(0.82, 0.05, 0.72)),
    ]
    p = make_problem(
        make_scene(objects, [describe_box("wall", [0.02, 0.02, 0.05], [0.875, 0.05, 0.78])]),
        Place("tray", (-0.5, -1.5, 0.7)),
    )
    (number,) = (k for k, phase in enumerate(p.task.phases) if phase.supported)
    assert_reduced(
        compute_margins(p, number)["cup.cup", "wall"],
        REDUCED_MARGIN_RATIO * 0.01,
        begin=True,
        tolerance=1e-4,
    )


def test_short_phases_begin_and_end_with_reduced_margins() -> None:
    options = dataclasses.replace(SHORT, reach_waypoints=NEAR)
    p = make_program(
        make_room(describe_table(gap=GAP)),
        [Place("stick", lift(STICK, [0.0, 0.5, -GAP]))],
        options=options,
    )
    np.testing.assert_allclose(
        compute_margins(p, 1)["stick.stick", "table"], np.zeros(NEAR + 1), atol=1e-6
    )


def test_margins_to_the_floor_are_reduced() -> None:
    low = pin.SE3(np.eye(3), np.array([0.8, 0.0, 0.051]))
    p = make_problem(make_room(), Place("stick", low))
    found = compute_margins(p, 1)
    assert set(found) == {("stick.stick", FLOOR)}
    assert_reduced(found["stick.stick", FLOOR], REDUCED_MARGIN_RATIO * 1e-3, end=True)


@pytest.mark.parametrize(
    ("gap", "margin"), [(0.0, 0.0), (0.006, 0.003), (-0.01, 0.0), (0.03, None)]
)
def test_margins_are_reduced_before_and_after_a_touch(gap: float, margin: float | None) -> None:
    point = np.array([0.8, 0.7, 0.75])
    wall = describe_box("wall", [0.3, 0.1, 0.3], point + np.array([0.0, gap + 0.05, 0.0]))
    scene = make_room(wall).with_held({"stick": "grip"})
    p = make_problem(scene, Touch("stick.tip", point), GoTo(0.0, 0.0), GoTo(0.0, 1.0))
    for phase, windows in ((0, {"end": True}), (1, {"begin": True}), (2, {})):
        found = compute_margins(p, phase)
        assert set(found) == ({("stick.tip", "wall")} if windows and margin is not None else set())
        for row in found.values():  # a point has a size of 0.1 mm here
            assert_reduced(row, margin or 0.0, **windows, tolerance=6e-5)


def test_margins_are_reduced_for_touches_but_not_for_poses() -> None:
    scene = make_room(describe_table(gap=GAP)).with_held({"stick": "grip"})
    touch = Touch("forearm_link", (0.8, 0.0, TOP))
    found = compute_margins(make_problem(scene, touch), 0)
    assert {first for first, _ in found} == {"forearm_link"}
    assert (
        compute_margins(
            make_problem(scene, Reach(pin.SE3(np.eye(3), np.array([0.8, 0.0, TOP])))), 0
        )
        == {}
    )


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
