"""Which pairs may be close, and when; and what overlap counts as contact."""

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
    Script,
    above,
    box,
    moved_base,
    reaching,
    room,
    stand,
    table,
    tool_at,
    with_object,
)
from helpers.drawers import changed, drawer_scene, with_boxes
from helpers.drives import of_rows, through
from helpers.grippers import between_cheeks, write_gripper
from helpers.riding import plates, slid
from helpers.small_problems import door_scene

from vkc_pin.options import Options
from vkc_pin.validation.contact_windows import check_gripper, find_contact_windows
from vkc_pin.validation.distances import CollisionShapes
from vkc_pin.validation.samples import Samples
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.contact_rules import CONTACT_DEPTH
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, Grasp, Step, Touch
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

HANDS = set(door_scene().robot.touch_links)
STEPS = 4  # of `EASED_TIME`


def near(
    scene: Scene, motion: Trajectory, steps: Sequence[Step] = (), dist_safe: float = 0.02
) -> dict[tuple[str, str], list[tuple[int, int]]]:
    """Return the labels of pairs that may be close, and between which waypoints; by the way check what else is said of them."""
    samples = Samples(scene, motion)
    labels, found = samples.world.collision_labels, dict[tuple[str, str], list[tuple[int, int]]]()
    for window in find_contact_windows(
        samples, CollisionShapes(samples.world), steps, Options(dist_safe=dist_safe)
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
            at = found.setdefault((first, second), [])
            at += [(window.first, window.last)] * ((window.first, window.last) not in at)
    return {pair: sorted(at) for pair, at in found.items()}


def still(scene: Scene) -> Trajectory:
    return of_rows(scene, np.tile(scene.start, (11, 1)))


DOOR, TIP = ("door.frame", "door.panel"), ("stick.tip",)


def hand_on(
    label: str,
    near: tuple[int, int],
    held: tuple[int, int] | None = None,
    others: Sequence[str] = (),
) -> dict[tuple[str, str], list[tuple[int, int]]]:
    """Return what the hand may be close to: the link it holds for a while, and around that time the object's others, too."""
    found = {(link, other): [near] for link in HANDS for other in (label, *others)}
    return found | {(link, label): sorted({near, held or near}) for link in HANDS}


def test_a_hand_and_what_it_holds_around_that_time() -> None:
    door = door_scene()
    assert near(door, still(door)) == {}
    assert (
        near(door, still(door), [Actuate("door", {"hinge": 1.0})]) == {}
    )  # the motion says where it is held
    assert near(door.with_held({"door": "handle"}), still(door)) == hand_on(
        "door.lever", (0, 10), (0, 0), DOOR
    )  # let go of at once
    motion, hold = (
        through(door, door.start, moved_base(door.start, y=0.3)),
        (Hold("door", "handle"),),
    )
    spans = (PhaseSpan("reach", 0, 15), PhaseSpan("hold", 15, 30, hold), PhaseSpan("leave", 30, 40))
    held = dataclasses.replace(motion, phases=spans)
    assert near(door, held) == hand_on("door.lever", (15 - STEPS, 30 + STEPS), (15, 30), DOOR)


def test_a_hand_that_is_where_it_is_asked_to_grasp() -> None:
    """Also where nothing comes of it, because it lets go of what stands fixed and drives on."""
    scene = room(table())
    there = Script(scene).go(reaching(tool_at(STICK), above(STICK))).go(np.array(scene.start))
    assert near(scene, there.motion()) == {}
    assert near(scene, there.motion(), [Grasp("stick")]) == hand_on(
        "stick.stick", (20 - STEPS, 20 + STEPS), others=TIP
    )


@pytest.mark.parametrize(("attachment", "rigid"), [("handle", True), ("handle_free", False)])
def test_only_a_grasp_without_freedom_moves_as_one(attachment: str, rigid: bool) -> None:
    scene = door_scene().with_held({"door": attachment})
    freedoms = scene.objects["door"].object.attachment(attachment).coordinates
    names = (*scene.robot.coordinates.names, *(f"door.{name}" for name in freedoms))
    rows = np.column_stack([np.tile(scene.start, (2, 1)), np.zeros((2, len(names) - 9))])
    samples = Samples(
        scene, Trajectory(names, np.arange(2.0), rows, (PhaseSpan("hold", 0, 1, scene.holds),), 9)
    )
    near, lever = find_contact_windows(samples, CollisionShapes(samples.world), [], Options())
    assert (near.moves_together, near.margin, near.contact) == (False, 0.005, 0.0)
    assert (lever.moves_together, lever.margin, lever.contact) == (
        (True, 0.0, CONTACT_DEPTH) if rigid else (False, 0.005, CONTACT_DEPTH)
    )


def carried(scene: Scene, *, aside: float = 0.5) -> Script:
    """Return a motion that takes the stick, lifts it, carries it aside and puts it down there."""
    down = reaching(tool_at(STICK), above(STICK))
    script = (
        Script(scene)
        .go(down)
        .take("stick")
        .go(np.array(scene.start))
        .go(moved_base(scene.start, y=aside))
    )
    return script.go(moved_base(down, y=aside)).let_go().go(moved_base(scene.start, y=aside))


def test_what_a_carried_thing_rests_on_where_it_is_taken_and_left() -> None:
    """Not what it only passes, and neither what is further away; and only around these times."""
    short = box("board", [0.5, 0.6, 0.02], [0.8, 0.0, TOP - 0.011])
    other = box("other", [0.5, 0.6, 0.02], [0.8, 1.0, TOP - 0.011])
    between = box(
        "between", [0.3, 0.1, 0.05], [0.8, 0.5, TOP + 0.125]
    )  # 5 cm below the discs when they pass
    beside, far = (
        box("near", [0.02, 0.1, 0.1], [0.875, 0.0, TOP + 0.05]),
        box("far", [0.02, 0.1, 0.1], [0.885, 0.0, TOP + 0.05]),
    )
    scene = room(short, other, between, beside, far)
    taken, left = (20, 20 + STEPS), (80 - STEPS, 80)
    assert near(scene, carried(scene, aside=1.0).motion(), dist_safe=0.055) == {
        **hand_on("stick.stick", (20 - STEPS, 80 + STEPS), (20, 80), TIP),
        ("stick.stick", "board"): [taken],
        ("stick.tip", "board"): [taken],
        ("stick.stick", "near"): [taken],
        ("stick.stick", "other"): [left],
        ("stick.tip", "other"): [left],
    }
    wide = near(
        scene, carried(scene, aside=1.0).motion(), dist_safe=0.15
    )  # the wrist is that close when the hand closes
    assert {pair for pair in wide if pair[0] in set(scene.robot.links)} == set(
        hand_on("stick.stick", (0, 0), others=TIP)
    )
    tight = near(scene, carried(scene, aside=1.0).motion(), dist_safe=1e-3 / 2)
    assert (
        tight.keys() == hand_on("stick.stick", (0, 0), others=TIP).keys()
    )  # everything is 1 mm away at least


def test_what_is_in_the_hand_at_the_start_leaves_what_it_lies_on_then_and_rests_nowhere_if_it_stays() -> (
    None
):
    scene = room(table()).with_held({"stick": "grip"})
    low = scene.with_start(arm=reaching(tool_at(STICK), above(STICK))[3:])
    drive = Script(low).go(moved_base(low.start, y=0.3)).motion()
    assert near(low, drive) == {
        **hand_on("stick.stick", (0, 20), others=TIP),
        ("stick.stick", "table"): [(0, STEPS)],
    }
    left = (
        Script(low)
        .go(moved_base(low.start, y=0.3))
        .let_go()
        .go(moved_base(low.start, y=0.3, x=-0.1))
        .motion()
    )
    assert near(low, left) == {
        **hand_on("stick.stick", (0, 20 + STEPS), (0, 20), TIP),
        ("stick.stick", "table"): [(0, STEPS), (20 - STEPS, 20)],
    }


def test_what_lies_on_the_floor() -> None:
    on_floor = pin.SE3(np.eye(3), np.array([0.8, 1.0, 0.036]))
    scene = with_object(room(objects=("stick", "ball")), "ball", on_floor)
    taken = (
        Script(scene)
        .take("ball", "grip", (0.0, 0.0, 0.0))
        .go(moved_base(scene.start, x=-0.2))
        .motion()
    )
    found = near(scene, taken)
    assert found == {**hand_on("ball.ball", (0, 20)), ("ball.ball", FLOOR): [(0, STEPS)]}


@pytest.mark.parametrize(
    ("gap", "allow", "expected"),
    [
        (
            0.005,
            [],
            (2, 6, 0.0, CONTACT_DEPTH, False, True),
        ),  # until the front, 18 mm thick, has left it by √(20² - 5²) mm
        (-0.002, [], (2, 6, -np.inf, np.inf, True, True)),
        (
            -0.002,
            [{"pair": ["drawer.tray", "side"], "margin": -0.003}],
            (0, 8, -0.003, CONTACT_DEPTH + 0.003, False, True),
        ),
    ],
)
def test_neighbours_at_the_waypoints_at_which_their_joints_have_them_so(
    gap: float, allow: list[object], expected: tuple[float, ...]
) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        side = with_boxes(drawer_scene(), side=((0.4, 0.1, 0.9), (2.085, 0.295 + gap + 0.05, 0.45)))
        scene = changed(side, allow=allow).with_state("drawer", {"slide": 0.3})
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
        for window in find_contact_windows(samples, CollisionShapes(samples.world), [], Options())
        if len(window.pairs)
    ]
    for window in found:
        assert {
            frozenset(samples.world.collision_labels[k] for k in pair)
            for pair in window.pairs.tolist()
        } == {frozenset(("drawer.tray", "side"))}
    assert expected in [tuple(window[1:]) for window in found]
    assert len(found) == 1 + (bool(allow))


def test_what_stands_in_something_leaves_it_once_and_within_a_second() -> None:
    """It may not be put back there, nor be lifted out of there again."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = room(table(gap=-0.002))
    down, up = reaching(tool_at(STICK), above(STICK)), np.array(scene.start)
    script = (
        Script(scene)
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
        for window in find_contact_windows(samples, CollisionShapes(samples.world), [], Options())
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


def test_things_that_lie_side_by_side() -> None:
    """They may touch, as both may the table; the robot may touch neither."""
    beside = pin.SE3(np.eye(3), np.array([0.8 + 0.05 + 0.035 + 0.01, 0.1275, TOP + 0.036]))
    scene = with_object(room(table(), objects=("stick", "ball")), "ball", beside)
    assert near(scene, carried(scene).motion()) == {
        **hand_on("stick.stick", (20 - STEPS, 80 + STEPS), (20, 80), TIP),
        ("stick.stick", "table"): [(20, 20 + STEPS), (80 - STEPS, 80)],
        ("stick.stick", "ball.ball"): [(20, 20 + STEPS)],
    }


def test_a_tip_and_what_it_holds() -> None:
    scene = room(stand(), objects=("stick", "ball")).with_held({"stick": "grip"})
    script = (
        Script(scene)
        .take("ball", "pull", (0.0, 0.0, 0.0), by="stick.tip")
        .go(moved_base(scene.start, y=0.5))
    )
    found = near(scene, script.motion())
    assert found == {
        **hand_on("stick.stick", (0, 20), others=TIP),
        ("stick.tip", "ball.ball"): [(0, 20)],
        ("ball.ball", "stand"): [(0, STEPS)],
    }


def test_a_frame_and_what_is_at_its_target_when_it_is_there() -> None:
    wall = box("wall", [0.3, 0.1, 0.3], [0.8, 0.95, 0.75])  # its near side is at y = 0.9
    scene = room(table(), wall).with_held({"stick": "grip"})
    tip = scene.objects["stick"].link_placement("tip").translation
    for gap, touches in ((0.0, True), (0.019, True), (0.021, False), (-0.05, True)):
        aside = 0.9 - gap - tip[1]
        there = Script(
            room(table(), {**wall, "position": [tip[0], 0.95, tip[2]]}).with_held({"stick": "grip"})
        )
        there.go(moved_base(scene.start, y=aside)).go(np.array(scene.start))
        target = tip + np.array([0.0, aside, 0.0])
        for goal in (tuple(target), pin.SE3(np.eye(3), target)):
            found = near(there.scene, there.motion(), [Touch("stick.tip", goal)])
            wanted = {("stick.tip", "wall"): [(20 - STEPS, 20 + STEPS)]} if touches else {}
            assert found == {**hand_on("stick.stick", (0, 40), others=TIP), **wanted}
        assert ("stick.tip", "wall") not in near(
            there.scene, there.motion(), [Touch("stick.tip", tuple(target + 0.05))]
        )


def test_what_rides_and_what_it_stands_on() -> None:
    """Two cups on a plate that slides: they and the plate move as one; what is beside them does not."""
    found = near(plates(cups=2, wall=0.01), slid(plates(cups=2, wall=0.01), 0.3))
    assert {pair: at for pair, at in found.items() if pair[0] not in HANDS} == {
        ("plate.plate", "cup.cup"): [(0, STEPS), (0, 30)],
        ("plate.plate", "cup_1.cup"): [(0, STEPS), (0, 30)],
        ("cup.cup", "cup_1.cup"): [(0, 30)],
        ("cup.cup", "wall"): [(0, STEPS)],
    }


def test_how_close_what_moves_as_one_is_says_nothing_of_a_motion() -> None:
    """A cup that stands a twentieth of a millimetre in its plate, which slides."""
    clearances = []
    for gap in (0.0, -5e-5):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            scene = plates(gap=gap)
        report = validate(scene, [Actuate("plate", {"slide": 0.3})], slid(scene, 0.3))
        assert not [found for found in report.violations if "cup" in found.subject]
        clearances.append(report.clearance)
    assert clearances[1] == pytest.approx(clearances[0])
    assert clearances[0] > 0.02


@pytest.mark.parametrize(
    ("openings", "told"),
    [((0.04, 0.04, 0.04), 0), ((None, 0.04, 0.04), 1), ((0.04, None, 0.04), 1)],
)
def test_fingers_are_open_as_asked_on_the_way_to_what_they_take_and_while_they_hold_it(
    tmp_path: Path, openings: tuple[float | None, ...], told: int
) -> None:
    scene = between_cheeks(write_gripper(tmp_path / "mine"), opening=0.04, start=0.04)
    still, hold = np.tile(scene.start, (61, 1)), (Hold("drawer", "grip"),)
    spans = [("reach", 0, 20, ()), ("move", 20, 40, hold), ("release", 40, 60, ())]
    phases = tuple(PhaseSpan(*span, opening) for span, opening in zip(spans, openings, strict=True))
    found = list(check_gripper(Samples(scene, of_rows(scene, still, phases=phases)), Options()))
    assert [(one.constraint, one.subject) for one in found] == [("opening", "drawer.grip")] * told


def test_what_can_be_carried_itself_may_be_touched_where_it_is_then() -> None:
    """And it does not touch itself."""
    scene = room(table(), objects=("stick", "ball")).with_held({"stick": "grip"})
    tip = scene.objects["stick"].link_placement("tip").translation
    beside = with_object(scene, "ball", pin.SE3(np.eye(3), tip + np.array([0.0, 0.035, 0.0])))
    for there, touched in ((beside, True), (scene, False)):
        script = (
            Script(there)
            .go(moved_base(there.start, x=-0.1), steps=2 * STEPS)
            .go(there.start, steps=2 * STEPS)
        )
        found = near(there, script.motion(), [Touch("stick.tip", tuple(tip))]).get(
            ("stick.tip", "ball.ball"), []
        )
        assert ((3 * STEPS, 4 * STEPS) in found) == touched
    inside = [Touch("ball.ball", tuple(tip + np.array([0.0, 0.035, 0.0])))]
    found = near(beside, Script(beside).wait().motion(), inside)
    assert found == {
        **hand_on("stick.stick", (0, 2), others=TIP),
        ("stick.tip", "ball.ball"): [(0, 2)],
    }
