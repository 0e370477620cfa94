"""Tests which pairs may be close, when, and which overlap counts as contact."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import (
    STICK,
    TOP,
    MotionBuilder,
    compute_grasp_pose,
    describe_box,
    describe_stand,
    describe_table,
    make_room,
    move_base,
    place_object,
    solve_above,
    solve_reach,
)
from helpers.drawers import add_boxes, load_drawer_scene, replace_scene_fields
from helpers.drives import drive_through, make_trajectory
from helpers.grippers import write_cheeks_scene, write_gripper
from helpers.small_problems import load_door_scene
from helpers.supports import make_plate_scene, slide_plate

from vkc_pin.options import Options
from vkc_pin.validation.contact_windows import check_gripper, check_pushes, find_contact_windows
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.validation.samples import Samples
from vkc_pin.validation.tolerances import Tolerances
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.contact_rules import CONTACT_DEPTH
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, Grasp, Step, Touch
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

STEPS = 4  # moving time steps in a window
HANDS = set(load_door_scene().robot.touch_links)


def find_windows(
    scene: Scene, motion: Trajectory, steps: Sequence[Step] = (), dist_safe: float = 0.02
) -> dict[tuple[str, str], list[tuple[int, int]]]:
    """Return the pairs that may be close, by labels, with their intervals."""
    samples = Samples(scene, motion)
    labels, found = samples.world.collision_labels, dict[tuple[str, str], list[tuple[int, int]]]()
    for window in find_contact_windows(
        samples, CollisionShapes(samples.world), steps, Options(dist_safe=dist_safe), Tolerances()
    ):
        named = {(labels[i], labels[j]) for i, j in window.pairs.tolist()}
        assert (np.diff(window.pairs, axis=1) > 0).all()
        for first, second in named:
            by_hand = first in HANDS
            held = window.moves_together and window.margin == 0.0
            assert held or window.margin == (
                -np.inf if window.moves_together else min(0.005, dist_safe) if by_hand else 0.0
            )
            assert window.contact == (
                0.0 if by_hand and not window.moves_together else CONTACT_DEPTH
            )
            intervals = found.setdefault((first, second), [])
            interval = (window.first, window.last)
            intervals += [interval] * (interval not in intervals)
    return {pair: sorted(intervals) for pair, intervals in found.items()}


def make_stationary_motion(scene: Scene) -> Trajectory:
    return make_trajectory(scene, np.tile(scene.start, (11, 1)))


DOOR, TIP = ("door.frame", "door.panel"), ("stick.tip",)


def make_hand_windows(
    label: str,
    near: tuple[int, int],
    held: tuple[int, int] | None = None,
    others: Sequence[str] = (),
) -> dict[tuple[str, str], list[tuple[int, int]]]:
    """Return the expected windows of the hand with a grasped link and the object's other links."""
    found = {(link, other): [near] for link in HANDS for other in (label, *others)}
    return found | {(link, label): sorted({near, held or near}) for link in HANDS}


def test_hand_may_be_close_to_a_grasped_object() -> None:
    door = load_door_scene()
    assert find_windows(door, make_stationary_motion(door)) == {}
    assert (
        find_windows(door, make_stationary_motion(door), [Actuate("door", {"hinge": 1.0})]) == {}
    )  # the holds of the motion decide
    assert find_windows(
        door.with_held({"door": "handle"}), make_stationary_motion(door)
    ) == make_hand_windows("door.lever", (0, 10), (0, 0), DOOR)  # released at once
    motion, hold = (
        drive_through(door, door.start, move_base(door.start, y=0.3)),
        (Hold("door", "handle"),),
    )
    spans = (PhaseSpan("reach", 0, 15), PhaseSpan("hold", 15, 30, hold), PhaseSpan("leave", 30, 40))
    held = dataclasses.replace(motion, phases=spans)
    assert find_windows(door, held) == make_hand_windows(
        "door.lever", (15 - STEPS, 30 + STEPS), (15, 30), DOOR
    )


@pytest.mark.parametrize(("back", "is_wrong"), [(0.9 * CONTACT_DEPTH, False), (0.05, True)])
def test_pushed_links_must_not_move_back(back: float, is_wrong: bool) -> None:
    scene = load_drawer_scene()
    slide = 0.3 - np.cumsum([0.0, 0.1, 0.0, -back, 0.1])
    push = Hold("drawer", "push")
    freedoms = scene.objects["drawer"].object.attachments["push"].coordinates
    names = (*scene.robot.coordinates.names, *(f"drawer.{name}" for name in ("slide", *freedoms)))
    rows = np.tile(np.append(scene.start, np.zeros(len(freedoms) + 1)), (len(slide), 1))
    rows[:, len(scene.start)] = slide
    spans = (PhaseSpan("push", 0, len(slide) - 1, (push,)),)
    motion = Trajectory(names, np.arange(5.0), rows, spans, len(scene.start))
    found = list(check_pushes(Samples(scene, motion)))
    assert [(one.constraint, one.waypoint) for one in found] == [("push", 3)] * is_wrong
    for one in found:
        assert one.amount == pytest.approx(back - CONTACT_DEPTH, abs=1e-9)


def test_hand_may_be_close_to_the_object_of_a_grasp_step_without_hold() -> None:
    scene = make_room(describe_table())
    there = (
        MotionBuilder(scene)
        .go(solve_reach(compute_grasp_pose(STICK), solve_above(STICK)))
        .go(np.array(scene.start))
    )
    assert find_windows(scene, there.motion()) == {}
    assert find_windows(scene, there.motion(), [Grasp("stick")]) == make_hand_windows(
        "stick.stick", (20 - STEPS, 20 + STEPS), others=TIP
    )


@pytest.mark.parametrize(("attachment", "rigid"), [("handle", True), ("handle_free", False)])
def test_only_rigid_grasps_move_together(attachment: str, rigid: bool) -> None:
    scene = load_door_scene().with_held({"door": attachment})
    freedoms = scene.objects["door"].object.attachment(attachment).coordinates
    names = (*scene.robot.coordinates.names, *(f"door.{name}" for name in freedoms))
    rows = np.column_stack([np.tile(scene.start, (2, 1)), np.zeros((2, len(names) - 9))])
    samples = Samples(
        scene, Trajectory(names, np.arange(2.0), rows, (PhaseSpan("hold", 0, 1, scene.holds),), 9)
    )
    near, lever = find_contact_windows(
        samples, CollisionShapes(samples.world), [], Options(), Tolerances()
    )
    assert (near.moves_together, near.margin, near.contact) == (
        False,
        0.005,
        0.0,
    )
    assert (lever.moves_together, lever.margin, lever.contact) == (
        (True, 0.0, CONTACT_DEPTH) if rigid else (False, 0.005, CONTACT_DEPTH)
    )


def carry_stick(scene: Scene, *, aside: float = 0.5) -> MotionBuilder:
    down = solve_reach(compute_grasp_pose(STICK), solve_above(STICK))
    script = (
        MotionBuilder(scene)
        .go(down)
        .take("stick")
        .go(np.array(scene.start))
        .go(move_base(scene.start, y=aside))
    )
    return script.go(move_base(down, y=aside)).let_go().go(move_base(scene.start, y=aside))


def test_carried_object_may_be_close_to_its_supports() -> None:
    short = describe_box("board", [0.5, 0.6, 0.02], [0.8, 0.0, TOP - 0.011])
    other = describe_box("other", [0.5, 0.6, 0.02], [0.8, 1.0, TOP - 0.011])
    between = describe_box(
        "between", [0.3, 0.1, 0.05], [0.8, 0.5, TOP + 0.125]
    )  # 5 cm below the discs when they pass
    beside, far = (
        describe_box("near", [0.02, 0.1, 0.1], [0.875, 0.0, TOP + 0.05]),
        describe_box("far", [0.02, 0.1, 0.1], [0.885, 0.0, TOP + 0.05]),
    )
    scene = make_room(short, other, between, beside, far)
    taken, left = (20, 20 + STEPS), (80 - STEPS, 80)
    assert find_windows(scene, carry_stick(scene, aside=1.0).motion(), dist_safe=0.055) == {
        **make_hand_windows("stick.stick", (20 - STEPS, 80 + STEPS), (20, 80), TIP),
        ("stick.stick", "board"): [taken],
        ("stick.tip", "board"): [taken],
        ("stick.stick", "near"): [taken],
        ("stick.stick", "other"): [left],
        ("stick.tip", "other"): [left],
    }
    wide = find_windows(
        scene, carry_stick(scene, aside=1.0).motion(), dist_safe=0.15
    )  # the wrist is within 0.15 m at the grasp
    assert {pair for pair in wide if pair[0] in set(scene.robot.links)} == set(
        make_hand_windows("stick.stick", (0, 0), others=TIP)
    )
    tight = find_windows(scene, carry_stick(scene, aside=1.0).motion(), dist_safe=1e-3 / 2)
    assert (
        tight.keys() == make_hand_windows("stick.stick", (0, 0), others=TIP).keys()
    )  # all supports are at least 1 mm away


def test_object_grasped_at_the_start_may_be_close_to_its_support() -> None:
    scene = make_room(describe_table()).with_held({"stick": "grip"})
    low = scene.with_start(arm=solve_reach(compute_grasp_pose(STICK), solve_above(STICK))[3:])
    drive = MotionBuilder(low).go(move_base(low.start, y=0.3)).motion()
    assert find_windows(low, drive) == {
        **make_hand_windows("stick.stick", (0, 20), others=TIP),
        ("stick.stick", "table"): [(0, STEPS)],
    }
    left = (
        MotionBuilder(low)
        .go(move_base(low.start, y=0.3))
        .let_go()
        .go(move_base(low.start, y=0.3, x=-0.1))
        .motion()
    )
    assert find_windows(low, left) == {
        **make_hand_windows("stick.stick", (0, 20 + STEPS), (0, 20), TIP),
        ("stick.stick", "table"): [(0, STEPS), (20 - STEPS, 20)],
    }


@pytest.mark.parametrize(
    ("gap", "allow", "expected"),
    [
        (
            0.005,
            [],
            (2, 6, 0.0, CONTACT_DEPTH, False, True),
        ),  # until the front, 18 mm thick, is √(20² - 5²) mm past it
        (-0.002, [], (2, 6, -np.inf, np.inf, True, True)),
        (
            -0.002,
            [{"pair": ["drawer.tray", "side"], "margin": -0.003}],
            (0, 8, -0.003, CONTACT_DEPTH + 0.003, False, True),
        ),
    ],
)
def test_exempt_pairs_may_be_close(
    gap: float, allow: list[object], expected: tuple[float, ...]
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        side = add_boxes(
            load_drawer_scene(), side=((0.4, 0.1, 0.9), (2.085, 0.295 + gap + 0.05, 0.45))
        )
        scene = replace_scene_fields(side, allow=allow).with_state("drawer", {"slide": 0.3})
    slide = np.array([0.3, 0.1, 0.03, 0.0, 0.0, 0.0, 0.03, 0.1, 0.3])
    rows = np.column_stack([np.tile(scene.start, (9, 1)), slide])
    motion = Trajectory(
        (*scene.robot.coordinates.names, "drawer.slide"),
        np.arange(9.0),
        rows,
        (PhaseSpan("slide", 0, 8),),
        9,
    )
    samples = Samples(scene, motion)
    found = [
        window
        for window in find_contact_windows(
            samples, CollisionShapes(samples.world), [], Options(), Tolerances()
        )
        if len(window.pairs)
    ]
    for window in found:
        assert {
            frozenset(samples.world.collision_labels[k] for k in pair)
            for pair in window.pairs.tolist()
        } == {frozenset(("drawer.tray", "side"))}
    assert expected in [tuple(window[1:]) for window in found]
    assert len(found) == 1 + (bool(allow))


def test_initial_penetration_is_exempt_once() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = make_room(describe_table(gap=-0.002))
    down, up = solve_reach(compute_grasp_pose(STICK), solve_above(STICK)), np.array(scene.start)
    script = (
        MotionBuilder(scene)
        .go(down)
        .take("stick")
        .go(up)
        .go(down)
        .let_go()
        .go(up)
        .go(down)
        .take("stick")
        .go(up)
    )
    samples = Samples(scene, script.motion())
    inside = [
        window
        for window in find_contact_windows(
            samples, CollisionShapes(samples.world), [], Options(), Tolerances()
        )
        if window.margin < 0.0
    ]
    assert inside
    for window in inside:
        assert (window.first, window.last) == (20, 20 + STEPS)
        assert (window.margin, window.contact) == (
            pytest.approx(-0.002, abs=1e-6),
            pytest.approx(0.002 + CONTACT_DEPTH, abs=1e-6),
        )
        assert {
            samples.world.collision_labels[k] for pair in window.pairs.tolist() for k in pair
        } == {"stick.stick", "table"}


@pytest.mark.parametrize(("gap", "listed"), [(0.0, []), (-0.002, ["stick.stick – table"])])
def test_exemptions_list_overlaps_but_not_contacts(gap: float, listed: list[str]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = make_room(describe_table(gap=gap))
    down = solve_reach(compute_grasp_pose(STICK), solve_above(STICK))
    motion = MotionBuilder(scene).go(down).take("stick").go(np.array(scene.start)).motion()
    report = validate(scene, [Grasp("stick")], motion, Options())
    assert [one.subject for one in report.exemptions] == listed


def test_tool_may_be_close_to_its_grasped_object() -> None:
    scene = make_room(describe_stand(), objects=("stick", "ball")).with_held({"stick": "grip"})
    script = (
        MotionBuilder(scene)
        .take("ball", "pull", (0.0, 0.0, 0.0), by="stick.tip")
        .go(move_base(scene.start, y=0.5))
    )
    found = find_windows(scene, script.motion())
    assert found == {
        **make_hand_windows("stick.stick", (0, 20), others=TIP),
        ("stick.tip", "ball.ball"): [(0, 20)],
        ("ball.ball", "stand"): [(0, STEPS)],
    }


def test_touching_link_may_be_close_to_shapes_at_the_target() -> None:
    wall = describe_box("wall", [0.3, 0.1, 0.3], [0.8, 0.95, 0.75])  # its near side is at y = 0.9
    scene = make_room(describe_table(), wall).with_held({"stick": "grip"})
    tip = scene.objects["stick"].link_placement("tip").translation
    for gap, touches in ((0.0, True), (0.019, True), (0.021, False), (-0.05, True)):
        aside = 0.9 - gap - tip[1]
        there = MotionBuilder(
            make_room(describe_table(), {**wall, "position": [tip[0], 0.95, tip[2]]}).with_held(
                {"stick": "grip"}
            )
        )
        there.go(move_base(scene.start, y=aside)).go(np.array(scene.start))
        target = tip + np.array([0.0, aside, 0.0])
        for goal in (tuple(target), pin.SE3(np.eye(3), target)):
            found = find_windows(there.scene, there.motion(), [Touch("stick.tip", goal)])
            touch = {("stick.tip", "wall"): [(20 - STEPS, 20 + STEPS)]} if touches else {}
            assert found == {**make_hand_windows("stick.stick", (0, 40), others=TIP), **touch}
        assert ("stick.tip", "wall") not in find_windows(
            there.scene, there.motion(), [Touch("stick.tip", tuple(target + 0.05))]
        )


def test_supported_objects_move_with_their_support() -> None:
    found = find_windows(
        make_plate_scene(cups=2, wall=0.01), slide_plate(make_plate_scene(cups=2, wall=0.01), 0.3)
    )
    assert {pair: at for pair, at in found.items() if pair[0] not in HANDS} == {
        ("plate.plate", "cup.cup"): [(0, STEPS), (0, 30)],
        ("plate.plate", "cup_1.cup"): [(0, STEPS), (0, 30)],
        ("cup.cup", "cup_1.cup"): [(0, 30)],
        ("cup.cup", "wall"): [(0, STEPS)],
    }


@pytest.mark.parametrize(
    ("openings", "count"),
    [((0.04, 0.04, 0.04), 0), ((None, 0.04, 0.04), 1), ((0.04, None, 0.04), 1)],
)
def test_gripper_must_be_open_as_required(
    tmp_path: Path, openings: tuple[float | None, ...], count: int
) -> None:
    scene = write_cheeks_scene(write_gripper(tmp_path / "mine"), opening=0.04, start=0.04)
    rows, hold = np.tile(scene.start, (61, 1)), (Hold("drawer", "grip"),)
    spans = [("reach", 0, 20, ()), ("move", 20, 40, hold), ("release", 40, 60, ())]
    phases = tuple(PhaseSpan(*span, opening) for span, opening in zip(spans, openings, strict=True))
    found = list(
        check_gripper(Samples(scene, make_trajectory(scene, rows, phases=phases)), Options())
    )
    assert [(one.constraint, one.subject) for one in found] == [("opening", "drawer.grip")] * count


def test_touching_link_may_be_close_to_a_free_object() -> None:
    scene = make_room(describe_table(), objects=("stick", "ball")).with_held({"stick": "grip"})
    tip = scene.objects["stick"].link_placement("tip").translation
    beside = place_object(scene, "ball", pin.SE3(np.eye(3), tip + np.array([0.0, 0.035, 0.0])))
    for there, touched in ((beside, True), (scene, False)):
        script = (
            MotionBuilder(there)
            .go(move_base(there.start, x=-0.1), steps=2 * STEPS)
            .go(there.start, steps=2 * STEPS)
        )
        found = find_windows(there, script.motion(), [Touch("stick.tip", tuple(tip))]).get(
            ("stick.tip", "ball.ball"), []
        )
        assert ((3 * STEPS, 4 * STEPS) in found) == touched
    inside = [Touch("ball.ball", tuple(tip + np.array([0.0, 0.035, 0.0])))]
    found = find_windows(beside, MotionBuilder(beside).wait().motion(), inside)
    assert found == {
        **make_hand_windows("stick.stick", (0, 2), others=TIP),
        ("stick.tip", "ball.ball"): [(0, 2)],
    }


@pytest.mark.parametrize(("dt", "last"), [(0.25, 4), (1.0, 4), (0.125, 8)])
def test_window_lasts_one_second_but_at_least_four_moving_steps(dt: float, last: int) -> None:
    scene = make_room(describe_table()).with_held({"stick": "grip"})
    low = scene.with_start(arm=solve_reach(compute_grasp_pose(STICK), solve_above(STICK))[3:])
    there, pair = move_base(low.start, y=0.3), ("stick.stick", "table")
    assert find_windows(low, MotionBuilder(low).go(there).motion(dt=dt))[pair] == [(0, last)]
    if dt == 1.0:  # two steps at rest do not count
        assert find_windows(low, MotionBuilder(low).wait().go(there).motion(dt=dt))[pair] == [
            (0, 6)
        ]


@pytest.mark.parametrize(
    ("positions", "rest"),
    [
        ([0, 1, 2, 2, 2, 3, 4], 2.0),
        ([0, 1, 2, 2, 3, 4, 5], 1.0),
        ([0, 1, 2, 3, 4, 5, 6], 0.0),
        ([3, 3, 3, 3, 4, 5, 6], 3.0),
        ([0, 1, 2, 3, 3, 3, 3], 3.0),
        ([2, 2, 3, 3, 4, 4, 4], 1.0),
    ],
)
def test_robot_must_rest_at_a_grasp(positions: list[float], rest: float) -> None:
    """The door may move meanwhile."""
    scene, hold = load_door_scene(), (Hold("door", "handle"),)
    rows = np.column_stack([np.tile(scene.start, (7, 1)), 0.01 * np.arange(7), np.zeros(7)])
    rows[:, 0] += 0.01 * np.array(positions)
    names = (*scene.robot.coordinates.names, "door.hinge", "door.knob")
    phases = (PhaseSpan("reach", 0, 3), PhaseSpan("move", 3, 6, hold))
    motion = Trajectory(names, np.arange(7.0), rows, phases, 9)
    found = list(check_gripper(Samples(scene, motion), Options(grasp_time=2.0)))
    assert [(one.constraint, one.subject, one.waypoint, one.time) for one in found] == [
        ("dwell", "door.handle", 3, 3.0)
    ] * (rest < 2.0)
    assert [one.amount for one in found] == [pytest.approx(2.0 - rest)] * (rest < 2.0)


@pytest.mark.parametrize(
    ("positions", "rest"), [([0, 1, 2, 3, 3, 3, 4], 2.0), ([0, 3, 3, 3, 4, 5, 6], 0.0)]
)
def test_robot_must_rest_while_fingers_move(
    tmp_path: Path, positions: list[float], rest: float
) -> None:
    """Fingers begin to move at the beginning of the phase."""
    scene = write_cheeks_scene(write_gripper(tmp_path / "mine"), start=0.05)
    rows = np.tile(scene.start, (7, 1))
    rows[:, 0] += 0.01 * np.array(positions)
    phases = (PhaseSpan("one", 0, 3, (), 0.05), PhaseSpan("two", 3, 6, (), 0.02))
    motion = make_trajectory(scene, rows, dt=1.0, phases=phases)
    found = list(check_gripper(Samples(scene, motion), Options(grasp_time=2.0)))
    assert [(one.subject, one.amount) for one in found] == (
        [("gripper", pytest.approx(2.0))] if rest < 2.0 else []
    )
