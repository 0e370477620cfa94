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
    TOP,
    MotionBuilder,
    describe_box,
    describe_stand,
    describe_table,
    make_room,
    move_base,
    solve_grasp,
)
from helpers.drawers import add_boxes, load_drawer_scene, replace_scene_fields
from helpers.drives import drive_through, make_trajectory, replace_positions
from helpers.grippers import write_cheeks_scene, write_gripper
from helpers.motions import make_object_motion
from helpers.robots import compute_placement
from helpers.small_problems import load_door_scene
from helpers.supports import make_plate_scene, slide_plate

from vkc_pin import (
    Actuate,
    Grasp,
    Hold,
    Options,
    PhaseSpan,
    Scene,
    Tolerances,
    Touch,
    Trajectory,
    validate,
)
from vkc_pin.validation.contact_windows import (
    Window,
    check_gripper,
    check_pushes,
    find_contact_windows,
)
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.validation.samples import Samples
from vkc_pin.world.scene.contact_rules import CONTACT_DEPTH
from vkc_pin.world.task.steps import Step

STEPS = 4  # moving time steps in a window
HANDS = set(load_door_scene().robot.touch_links)


def list_windows(
    samples: Samples, steps: Sequence[Step] = (), dist_safe: float = 0.02
) -> list[Window]:
    solids = CollisionShapes(samples.world)
    return find_contact_windows(samples, solids, steps, Options(dist_safe=dist_safe), Tolerances())


def get_labels(samples: Samples, window: Window) -> set[tuple[str, str]]:
    """Return the labels of the pairs of a window."""
    labels = samples.world.collision_labels
    return {(labels[i], labels[j]) for i, j in window.pairs.tolist()}


def find_windows(
    scene: Scene, motion: Trajectory, steps: Sequence[Step] = (), dist_safe: float = 0.02
) -> dict[tuple[str, str], list[tuple[int, int]]]:
    """Return the pairs that may be close, by labels, with their intervals."""
    samples, found = Samples(scene, motion), dict[tuple[str, str], list[tuple[int, int]]]()
    for window in list_windows(samples, steps, dist_safe):
        assert (np.diff(window.pairs, axis=1) > 0).all()
        for first, second in get_labels(samples, window):
            by_hand = first in HANDS
            held = window.moves_together and window.margin == 0.0
            assert held or window.margin == (
                -np.inf if window.moves_together else min(0.005, dist_safe) if by_hand else 0.0
            )
            assert window.contact == (
                0.0 if by_hand and not window.moves_together else CONTACT_DEPTH
            )
            found.setdefault((first, second), []).append((window.first, window.last))
    return {pair: sorted(set(intervals)) for pair, intervals in found.items()}


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
    door, held = load_door_scene(), load_door_scene().with_held({"door": "handle"})
    rest = make_stationary_motion(door)
    assert find_windows(door, rest) == {}
    steps = [Actuate("door", {"hinge": 1.0})]
    assert find_windows(door, rest, steps) == {}, "the holds of the motion decide"
    released_at_once = make_hand_windows("door.lever", (0, 10), (0, 0), DOOR)
    assert find_windows(held, rest) == released_at_once
    freedom = np.linspace(0.0, 0.1, len(rest.times))  # of a later grasp
    columns = {
        "names": (*rest.names, "door.handle_free"),
        "positions": np.column_stack([rest.positions, freedom]),
    }
    assert find_windows(held, dataclasses.replace(rest, **columns)) == released_at_once
    motion = drive_through(door, door.start, move_base(door.start, y=0.3))
    hold = (Hold("door", "handle"),)
    spans = (PhaseSpan("reach", 0, 15), PhaseSpan("hold", 15, 30, hold), PhaseSpan("leave", 30, 40))
    around = (15 - STEPS, 30 + STEPS)
    assert find_windows(door, dataclasses.replace(motion, phases=spans)) == make_hand_windows(
        "door.lever", around, (15, 30), DOOR
    )


@pytest.mark.parametrize(
    ("back", "is_wrong"), [(0.9 * CONTACT_DEPTH, False), (2.0 * CONTACT_DEPTH, True), (0.05, True)]
)
def test_pushed_links_must_not_move_back(back: float, is_wrong: bool) -> None:
    scene = load_drawer_scene()
    slide = 0.3 - np.cumsum([0.0, 0.1, 0.0, -back, 0.1])
    push = Hold("drawer", "push")
    freedoms = scene.objects["drawer"].object.attachments["push"].coordinates
    phase, still = PhaseSpan("push", 0, 4, (push,)), dict.fromkeys(freedoms, np.zeros(5))
    motion = make_object_motion(scene, "drawer", phase, slide=slide, **still)
    found = list(check_pushes(Samples(scene, motion)))
    assert [(one.constraint, one.waypoint) for one in found] == [("push", 3)] * is_wrong
    for one in found:
        assert one.amount == pytest.approx(back - CONTACT_DEPTH, abs=1e-9)


def test_hand_may_be_close_to_the_object_of_a_grasp_step_without_hold() -> None:
    scene = make_room(describe_table())
    motion = MotionBuilder(scene).go(solve_grasp()).go(np.array(scene.start)).motion()
    assert find_windows(scene, motion) == {}
    assert find_windows(scene, motion, [Grasp("stick")]) == make_hand_windows(
        "stick.stick", (20 - STEPS, 20 + STEPS), others=TIP
    )


@pytest.mark.parametrize(("attachment", "rigid"), [("handle", True), ("handle_free", False)])
def test_only_rigid_grasps_move_together(attachment: str, rigid: bool) -> None:
    scene = load_door_scene().with_held({"door": attachment})
    freedoms = scene.objects["door"].object.attachment(attachment).coordinates
    values = dict.fromkeys(("hinge", *freedoms), np.zeros(2))
    motion = make_object_motion(scene, "door", PhaseSpan("hold", 0, 1, scene.holds), **values)
    near, lever = list_windows(Samples(scene, motion))
    assert (near.moves_together, near.margin, near.contact) == (False, 0.005, 0.0)
    expected = (True, 0.0, CONTACT_DEPTH) if rigid else (False, 0.005, CONTACT_DEPTH)
    assert (lever.moves_together, lever.margin, lever.contact) == expected


def carry_stick(scene: Scene) -> Trajectory:
    """Carry the stick by one metre along y."""
    down, up = solve_grasp(), np.array(scene.start)
    script = MotionBuilder(scene).go(down).take("stick").go(up).go(move_base(up, y=1.0))
    return script.go(move_base(down, y=1.0)).let_go().go(move_base(up, y=1.0)).motion()


def test_carried_object_may_be_close_to_its_supports() -> None:
    scene = make_room(
        describe_box("board", [0.5, 0.6, 0.02], [0.8, 0.0, TOP - 0.011]),
        describe_box("other", [0.5, 0.6, 0.02], [0.8, 1.0, TOP - 0.011]),
        describe_box("between", [0.3, 0.1, 0.05], [0.8, 0.5, TOP + 0.125]),  # passed 5 cm above it
        describe_box("near", [0.02, 0.1, 0.1], [0.875, 0.0, TOP + 0.05]),
        describe_box("far", [0.02, 0.1, 0.1], [0.885, 0.0, TOP + 0.05]),
    )
    motion, taken, left = carry_stick(scene), (20, 20 + STEPS), (80 - STEPS, 80)
    hands = make_hand_windows("stick.stick", (20 - STEPS, 80 + STEPS), (20, 80), TIP)
    assert find_windows(scene, motion, dist_safe=0.055) == {
        **hands,
        ("stick.stick", "board"): [taken],
        ("stick.tip", "board"): [taken],
        ("stick.stick", "near"): [taken],
        ("stick.stick", "other"): [left],
        ("stick.tip", "other"): [left],
    }
    wide = find_windows(scene, motion, dist_safe=0.15)  # the wrist is within 0.15 m at the grasp
    assert {pair for pair in wide if pair[0] in set(scene.robot.links)} == set(hands)
    tight = find_windows(scene, motion, dist_safe=1e-3 / 2)
    assert tight.keys() == hands.keys(), "all supports are at least 1 mm away"


@pytest.mark.parametrize(
    ("gap", "allow", "expected"),
    [
        # Until the front, 18 mm thick, is √(20² - 5²) mm past it
        (0.005, [], (2, 6, 0.0, CONTACT_DEPTH, False, True)),
        (-0.002, [], (2, 6, -0.005, CONTACT_DEPTH + 0.005, False, True)),
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
    box = ((0.4, 0.1, 0.9), (2.085, 0.295 + gap + 0.05, 0.45))
    with warnings.catch_warnings(action="ignore"):
        scene = replace_scene_fields(add_boxes(load_drawer_scene(), side=box), allow=allow)
        scene = scene.with_state("drawer", {"slide": 0.3})
    slide = np.array([0.3, 0.1, 0.03, 0.0, 0.0, 0.0, 0.03, 0.1, 0.3])
    samples = Samples(scene, make_object_motion(scene, "drawer", slide=slide))
    found = [window for window in list_windows(samples) if len(window.pairs)]
    for window in found:
        assert get_labels(samples, window) == {("drawer.tray", "side")}
    assert expected in [tuple(window[1:]) for window in found]
    assert len(found) == 1 + (bool(allow))


def test_initial_penetration_is_exempt_once() -> None:
    with warnings.catch_warnings(action="ignore"):
        scene = make_room(describe_table(gap=-0.002))
    down, up = solve_grasp(), np.array(scene.start)
    script = MotionBuilder(scene).go(down).take("stick").go(up).go(down).let_go()
    samples = Samples(scene, script.go(up).go(down).take("stick").go(up).motion())
    inside = [window for window in list_windows(samples) if window.margin < 0.0]
    assert inside
    for window in inside:
        assert (window.first, window.last) == (20, 20 + STEPS)
        assert window.margin == pytest.approx(-0.002, abs=1e-6)
        assert window.contact == pytest.approx(0.002 + CONTACT_DEPTH, abs=1e-6)
        assert get_labels(samples, window) == {("stick.stick", "table")}


@pytest.mark.parametrize(("gap", "listed"), [(0.0, []), (-0.002, ["stick.stick – table"])])
def test_exemptions_list_overlaps_but_not_contacts(gap: float, listed: list[str]) -> None:
    with warnings.catch_warnings(action="ignore"):
        scene = make_room(describe_table(gap=gap))
    script = MotionBuilder(scene).go(solve_grasp()).take("stick").go(np.array(scene.start))
    report = validate(scene, [Grasp("stick")], script.motion(), Options())
    assert [one.subject for one in report.exemptions] == listed


def test_tool_may_be_close_to_its_grasped_object() -> None:
    scene = make_room(describe_stand(), objects=("stick", "ball")).with_held({"stick": "grip"})
    script = MotionBuilder(scene).take("ball", "pull", (0.0, 0.0, 0.0), by="stick.tip")
    assert find_windows(scene, script.go(move_base(scene.start, y=0.5)).motion()) == {
        **make_hand_windows("stick.stick", (0, 20), others=TIP),
        ("stick.tip", "ball.ball"): [(0, 20)],
        ("ball.ball", "stand"): [(0, STEPS)],
    }


@pytest.mark.parametrize(
    ("gap", "touches"), [(0.0, True), (0.019, True), (0.021, False), (-0.05, True)]
)
def test_touching_link_may_be_close_to_shapes_at_the_target(gap: float, touches: bool) -> None:
    start = make_room().with_held({"stick": "grip"})
    tip = start.objects["stick"].link_placement("tip").translation
    wall = describe_box("wall", [0.3, 0.1, 0.3], [tip[0], 0.95, tip[2]])  # its near side: y = 0.9
    scene = make_room(describe_table(), wall).with_held({"stick": "grip"})
    target = np.array([tip[0], 0.9 - gap, tip[2]])
    there = move_base(scene.start, y=target[1] - tip[1])
    motion = MotionBuilder(scene).go(there).go(np.array(scene.start)).motion()
    hands = make_hand_windows("stick.stick", (0, 40), others=TIP)
    touch = {("stick.tip", "wall"): [(20 - STEPS, 20 + STEPS)]} if touches else {}
    for goal in (tuple(target), pin.SE3(np.eye(3), target)):
        assert find_windows(scene, motion, [Touch("stick.tip", goal)]) == {**hands, **touch}
    assert find_windows(scene, motion, [Touch("stick.tip", tuple(target + 0.02))]) == hands


def test_only_the_link_of_the_touching_frame_may_be_close() -> None:
    scene = load_door_scene()
    target = compute_placement(scene.robot, "forearm_link", scene.start).translation
    scene = add_boxes(scene, ball=((0.02, 0.02, 0.02), tuple(target.tolist())))
    found = find_windows(scene, make_stationary_motion(scene), [Touch("forearm_link", target)])
    assert found == {("forearm_link", "ball"): [(0, 10)]}


def test_supported_objects_move_with_their_support() -> None:
    scene = make_plate_scene(cups=2, wall=0.01)
    found = find_windows(scene, slide_plate(scene, 0.3))
    assert {pair: at for pair, at in found.items() if pair[0] not in HANDS} == {
        ("plate.plate", "cup.cup"): [(0, STEPS), (0, 30)],
        ("plate.plate", "cup_1.cup"): [(0, STEPS), (0, 30)],
        ("cup.cup", "cup_1.cup"): [(0, 30)],
        ("cup.cup", "wall"): [(0, STEPS)],
    }


@pytest.mark.parametrize(
    ("openings", "count"),
    [
        ((0.04, 0.04, 0.04), 0),
        ((None, 0.04, 0.04), 1),
        ((0.04, None, 0.04), 1),
        ((0.0398, 0.04, 0.04), 1),
    ],
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


@pytest.mark.parametrize(("dt", "last"), [(0.25, 4), (1.0, 4), (0.125, 8)])
def test_window_lasts_one_second_but_at_least_four_moving_steps(dt: float, last: int) -> None:
    low = make_room(describe_table()).with_held({"stick": "grip"}).with_start(arm=solve_grasp()[3:])
    there, pair = move_base(low.start, y=0.3), ("stick.stick", "table")
    motion = MotionBuilder(low).go(there).motion(dt=dt)
    assert find_windows(low, motion)[pair] == [(0, last)]
    rested = MotionBuilder(low).wait().go(there).motion(dt=1.0)
    assert find_windows(low, rested)[pair] == [(0, 6)], "two steps at rest do not count"


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
@pytest.mark.parametrize("grasps", [True, False], ids=["grasp", "release"])
def test_robot_must_rest_at_a_grasp(grasps: bool, positions: list[float], rest: float) -> None:
    """The door may move meanwhile."""
    hold = (Hold("door", "handle"),)
    before, after = ((), hold) if grasps else (hold, ())
    scene = load_door_scene().with_held({hold.object: hold.attachment for hold in before})
    phases = (PhaseSpan("before", 0, 3, before), PhaseSpan("after", 3, 6, after))
    motion = make_object_motion(scene, "door", *phases, hinge=0.01 * np.arange(7), knob=np.zeros(7))
    moves = np.outer(0.01 * np.array(positions), np.arange(len(motion.names)) == 0)
    motion = replace_positions(motion, motion.positions + moves)
    found = check_gripper(Samples(scene, motion), Options(grasp_time=2.0))
    assert [(one.constraint, one.subject, one.waypoint, one.time, one.amount) for one in found] == [
        ("dwell", "door.handle", 3, 3.0, pytest.approx(2.0 - rest))
    ] * (rest < 2.0)


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
