"""Which pairs may touch, and what overlap counts as contact."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from helpers.carrying import (
    BALL,
    STICK,
    TOP,
    Script,
    above,
    box,
    lifted,
    moved_base,
    reaching,
    room,
    stand,
    table,
    tool_at,
    with_object,
)
from helpers.drives import of_rows
from helpers.small_problems import door_scene, full_scene

from vkc_pin.motion.trajectory import PhaseSpan, Trajectory
from vkc_pin.motion.world import World
from vkc_pin.scene.hold import Hold
from vkc_pin.scene.obstacles import FLOOR
from vkc_pin.scene.scene import Scene
from vkc_pin.task.steps import Actuate, Grasp, Place, Step, Touch
from vkc_pin.validation.distances import Solids
from vkc_pin.validation.touching import CONTACT, may_touch

HANDS = set(door_scene().robot.touch_links)


def pairs(scene: Scene, motion: Trajectory, steps: Sequence[Step] = (), dist_safe: float = 0.02) -> dict[tuple[str, str], float]:
    """Return the labels of the pairs that may touch, and their overlaps."""
    world = World(scene)
    found = may_touch(scene, Solids(world), motion, steps, dist_safe)
    assert all(i < j for i, j in found)
    labels = world.collision_labels
    named: dict[tuple[str, str], float] = {}
    for (i, j), overlap in found.items():
        assert named.setdefault((labels[i], labels[j]), overlap) == overlap
    return named


def still(scene: Scene) -> Trajectory:
    return of_rows(scene, np.vstack([scene.start, scene.start]))


def hand_on(label: str) -> dict[tuple[str, str], float]:
    return {(link, label): 0.0 for link in HANDS}


def test_a_hand_and_what_it_holds_held_or_is_asked_to_grasp() -> None:
    door = door_scene()
    assert pairs(door, still(door)) == {}
    assert pairs(door, still(door), [Actuate("door", {"hinge": 1.0})]) == {}  # the motion says where it is held
    assert pairs(door, still(door), [Grasp("door", "handle_free")]) == hand_on("door.lever")
    assert pairs(door.with_held({"door": "handle"}), still(door)) == hand_on("door.lever")
    motion = still(door)
    held = Trajectory(motion.names, motion.times, motion.positions, (PhaseSpan("hold", 0, 1, (Hold("door", "handle"),)),), 9)
    assert pairs(door, held) == hand_on("door.lever")
    scene = full_scene()
    two = [Grasp("drawer"), Grasp("door")]
    assert pairs(scene, still(scene), two) == {**hand_on("door.lever"), **hand_on("drawer.tray")}


def carried(scene: Scene, *, aside: float = 0.5) -> Script:
    """Return a motion that takes the stick, lifts it, carries it aside and puts it down there."""
    down = reaching(tool_at(STICK), above(STICK))
    script = Script(scene).go(down).take("stick").go(np.array(scene.start)).go(moved_base(scene.start, y=aside))
    return script.go(moved_base(down, y=aside)).let_go().go(moved_base(scene.start, y=aside))


def test_what_a_carried_thing_rests_on_where_it_is_taken_and_left() -> None:
    """Not what it only passes, and neither what is further away."""
    short = box("board", [0.5, 0.6, 0.02], [0.8, 0.0, TOP - 0.011])
    other = box("other", [0.5, 0.6, 0.02], [0.8, 1.0, TOP - 0.011])
    between = box("between", [0.3, 0.1, 0.05], [0.8, 0.5, TOP + 0.125])  # 5 cm below the discs when they pass
    near, far = box("near", [0.02, 0.1, 0.1], [0.875, 0.0, TOP + 0.05]), box("far", [0.02, 0.1, 0.1], [0.885, 0.0, TOP + 0.05])
    scene = room(short, other, between, near, far)
    found = pairs(scene, carried(scene, aside=1.0).motion(), dist_safe=0.055)
    resting = {pair for pair in found if pair[0] not in HANDS}
    assert {second for _, second in resting} == {"board", "other", "near"}
    assert {("stick.stick", "board"), ("stick.stick", "other"), ("stick.stick", "near")} <= resting
    assert all(found[pair] == CONTACT for pair in resting)
    assert {pair: found[pair] for pair in found if pair[0] in HANDS} == hand_on("stick.stick")
    wide = pairs(scene, carried(scene, aside=1.0).motion(), dist_safe=0.15)  # the wrist is that close when the hand closes
    robots = set(scene.robot.links)
    assert {pair for pair in wide if pair[0] in robots} == set(hand_on("stick.stick"))
    tight = pairs(scene, carried(scene, aside=1.0).motion(), dist_safe=1e-3 / 2)
    assert tight == hand_on("stick.stick")  # everything is 1 mm away at least


def test_what_is_in_the_hand_at_the_start_and_stays_there_rests_nowhere() -> None:
    scene = room(table()).with_held({"stick": "grip"})
    low = scene.with_start(arm=reaching(tool_at(STICK), above(STICK))[3:])
    drive = Script(low).go(moved_base(low.start, y=0.3)).motion()
    assert pairs(low, drive) == hand_on("stick.stick")
    left = Script(low).go(moved_base(low.start, y=0.3)).let_go().go(moved_base(low.start, y=0.3, x=-0.1)).motion()
    assert pairs(low, left) == {**hand_on("stick.stick"), ("stick.stick", "table"): CONTACT}


def test_what_lies_on_the_floor() -> None:
    on_floor = pin.SE3(np.eye(3), np.array([0.8, 1.0, 0.036]))
    scene = with_object(room(objects=("stick", "ball")), "ball", on_floor)
    taken = Script(scene).take("ball", "grip", (0.0, 0.0, 0.0)).go(moved_base(scene.start, x=-0.2)).motion()
    found = pairs(scene, taken)
    assert found == {**hand_on("ball.ball"), ("ball.ball", FLOOR): CONTACT}


def test_things_that_lie_side_by_side() -> None:
    """They may touch, as both may the table; the robot may touch neither."""
    beside = pin.SE3(np.eye(3), np.array([0.8 + 0.05 + 0.035 + 0.01, 0.1275, TOP + 0.036]))
    scene = with_object(room(table(), objects=("stick", "ball")), "ball", beside)
    found = pairs(scene, carried(scene).motion())
    assert found == {
        **hand_on("stick.stick"),
        ("stick.stick", "table"): CONTACT,
        ("stick.stick", "ball.ball"): CONTACT,
    }


def test_a_tip_and_what_it_holds() -> None:
    scene = room(stand(), objects=("stick", "ball")).with_held({"stick": "grip"})
    script = Script(scene).take("ball", "pull", (0.0, 0.0, 0.0), by="stick.tip").go(moved_base(scene.start, y=0.5))
    found = pairs(scene, script.motion())
    assert found == {**hand_on("stick.stick"), ("stick.tip", "ball.ball"): CONTACT, ("ball.ball", "stand"): CONTACT}
    asked = pairs(scene, still(scene), [Grasp("ball", by="stick.tip")])
    assert asked == {**hand_on("stick.stick"), ("stick.tip", "ball.ball"): CONTACT}
    assert pairs(scene, still(scene), [Place("ball", BALL)]) == hand_on("stick.stick")


def test_a_frame_and_what_is_at_its_target() -> None:
    wall = box("wall", [0.3, 0.1, 0.3], [0.8, 0.95, 0.75])  # its near side is at y = 0.9
    scene = room(table(), wall)
    for gap, near in ((0.0, True), (0.019, True), (0.021, False), (-0.05, True)):
        point = (0.8, 0.9 - gap, 0.75)
        for target in (point, lifted(STICK, np.array(point) - STICK.translation)):
            found = pairs(scene, still(scene), [Touch("stick.tip", target)])
            assert found == ({("stick.tip", "wall"): CONTACT} if near else {})
    assert pairs(scene, still(scene), [Touch("forearm_link", (0.8, 0.9, 0.75))]) == {("forearm_link", "wall"): CONTACT}
    door = door_scene()
    lever = door.objects["door"].link_placement("lever").act(np.array([-0.1, 0.06, 0.0]))
    assert ("forearm_link", "door.lever") in pairs(door, still(door), [Touch("forearm_link", lever)])
    corner = pairs(scene, still(scene), [Touch("stick.tip", (0.8, 1.0, TOP + 0.01))], dist_safe=0.7)
    assert corner == {("stick.tip", "wall"): CONTACT, ("stick.tip", "table"): CONTACT, ("stick.tip", FLOOR): CONTACT}


def test_what_can_be_carried_itself_may_be_touched_where_it_is_then() -> None:
    """A ball that is put somewhere, and touched there; and it does not touch itself."""
    scene = room(table(), objects=("stick", "ball"))
    side = BALL.translation - np.array([0.0, 0.035, 0.0])
    touch = [Touch("stick.tip", side)]
    assert pairs(scene, still(scene), touch) == {("stick.tip", "ball.ball"): CONTACT}
    assert pairs(scene, still(scene), [Touch("ball.ball", side)]) == {}
    moved = with_object(scene, "ball", lifted(BALL, [0.0, 0.5, 0.0]))
    assert pairs(moved, still(moved), touch) == {}
    tool = scene.tool_placement()
    held = with_object(scene, "ball", tool)
    script = Script(held).take("ball", "grip", (0.0, 0.0, 0.0)).go(moved_base(held.start, y=0.5))
    assert ("stick.tip", "ball.ball") not in pairs(held, script.motion(), [Touch("stick.tip", tool.translation)])
    there = [Touch("stick.tip", tool.translation + np.array([0.0, 0.5, 0.0]))]
    assert ("stick.tip", "ball.ball") in pairs(held, script.motion(), there)
