"""The independent check of motions with something in the hand: what is right passes, and every way to get it wrong is named."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import (
    BALL,
    GUESS,
    STICK,
    UP,
    Script,
    above,
    box,
    carried_over,
    lifted,
    moved_base,
    reaching,
    room,
    stand,
    table,
    tool_at,
    with_grasp,
    with_object,
)

import vkc_pin as vkc
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.validation.report import Report, Violation
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

ASIDE = lifted(STICK, [0.0, 0.5, 0.0])
PLACED = vkc.Place("stick", ASIDE)
SIDES = np.vstack([np.eye(3), -np.eye(3)])


@cache
def hall() -> Scene:
    return room(table())


def judged(scene: Scene, steps: Sequence[Step], motion: Trajectory) -> Report:
    """Validate a motion that takes its time to come near things, and none to close the hand."""
    return validate(scene, steps, motion, vkc.Options(dt=0.05, grasp_time=1e-6))


def only(report: Report) -> Violation:
    """Return the one violation there is."""
    assert len(report.violations) == 1, "\n".join(report.lines())
    return report.violations[0]


def names(report: Report) -> set[tuple[str, str]]:
    return {(violation.constraint, violation.subject) for violation in report.violations}


def tips_target(scene: Scene, row: np.ndarray) -> np.ndarray:
    """Return where the tip of the stick is that is held in the middle of its grip."""
    held = scene.with_held({"stick": "grip"}).with_start(base=row[:3], arm=row[3:])
    return np.array(held.objects["stick"].link_placement("tip").translation)


# --- what is right
# ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("values", [(0.0, 0.0), (0.06, 0.0), (-0.05, 0.3), (0.09, -0.3)])
def test_a_stick_that_is_carried_over_is_accepted(values: tuple[float, float]) -> None:
    motion = carried_over(hall(), values=values).motion()
    for steps in (
        [PLACED],
        [vkc.Place("stick", ASIDE.translation)],
        [vkc.Grasp("stick"), PLACED],
        [vkc.Grasp("stick", "grip"), PLACED, vkc.GoTo(0.0, 0.5)],
        [vkc.Grasp("stick"), vkc.Release()],
        [vkc.Grasp("stick"), vkc.Release("stick"), vkc.GoTo(0.0, 0.5, 0.0)],
    ):
        report = judged(hall(), steps, motion)
        assert report.ok, "\n".join(report.lines())
        assert report.closure_error < 1e-9
        assert report.clearance == pytest.approx(1e-3, abs=1e-6)  # of the discs above the table


def test_a_stick_that_is_in_the_hand_on_the_table_at_the_start_is_accepted() -> None:
    """And it leaves what it lies on in time: a second later it keeps its distance."""
    up, down = above(STICK), reaching(tool_at(STICK), above(STICK))
    for gap in (1e-3, 0.0, -2e-3):
        held = (
            room(table(gap=gap))
            .with_start(base=down[:3], arm=down[3:])
            .with_held({"stick": "grip"})
        )
        report = judged(
            held, [vkc.GoTo(0.0, 0.5)], Script(held).go(up).go(moved_base(up, y=0.5)).motion()
        )
        assert report.ok, "\n".join(report.lines())
        late = (
            Script(held)
            .go(moved_base(down, y=0.1), steps=60)
            .go(up)
            .go(moved_base(up, y=0.5))
            .motion()
        )
        what = "penetration" if gap < 0.0 else "clearance"
        assert names(judged(held, [vkc.GoTo(0.0, 0.5)], late)) == {(what, "stick.stick – table")}


def test_a_ball_that_is_fetched_with_the_stick_is_accepted() -> None:
    for steps in (
        [vkc.Place("ball", lifted(BALL, [0.0, 0.3, 0.0]))],
        [vkc.Grasp("ball", "pull", "stick.tip"), vkc.Place("ball", lifted(BALL, [0.0, 0.3, 0.0]))],
        [vkc.Grasp("ball", by="stick.tip"), vkc.Release("ball")],
    ):
        report = judged(fetching().scene, steps, fetching().motion())
        assert report.ok, "\n".join(report.lines())


# --- how it is held
# ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", SIDES, ids=str)
def test_a_hand_that_closes_beside_the_attachment(side: np.ndarray) -> None:
    motion = carried_over(hall(), off=pin.SE3(np.eye(3), 2e-3 * side)).motion()
    report = judged(hall(), [PLACED], motion)
    found = only(report)
    assert (found.constraint, found.subject, found.unit) == ("closure", "stick.grip", "m")
    assert found.amount == pytest.approx(1e-3, abs=1e-9)
    assert found.waypoint >= motion.phases[2].first
    assert report.closure_error == pytest.approx(2e-3, abs=1e-9)
    grasped = judged(hall(), [vkc.Grasp("stick"), PLACED], motion)
    assert names(grasped) == {("closure", "stick.grip"), ("goal", "stick.grip")}
    within = carried_over(hall(), off=pin.SE3(np.eye(3), 9e-4 * side)).motion()
    assert judged(hall(), [vkc.Grasp("stick"), PLACED], within).ok


@pytest.mark.parametrize("side", SIDES, ids=str)
def test_a_hand_that_closes_askew(side: np.ndarray) -> None:
    motion = carried_over(hall(), off=pin.SE3(pin.exp3(4e-3 * side), np.zeros(3))).motion()
    found = only(judged(hall(), [PLACED], motion))
    assert (found.constraint, found.subject, found.unit) == ("closure", "stick.grip", "rad")
    assert found.amount == pytest.approx(3e-3, abs=1e-6)


def test_a_hand_that_holds_from_afar() -> None:
    """It claims to carry the stick, and does, but is nowhere near it."""
    script = Script(hall()).take("stick").go(moved_base(hall().start, y=0.5))
    found = {
        v.constraint: v for v in judged(hall(), [vkc.GoTo(0.0, 0.5)], script.motion()).violations
    }
    assert found["closure"].subject == "stick.grip"
    assert found["closure"].amount == pytest.approx(0.2 - 1e-3, abs=1e-6)


def test_a_hand_that_says_it_holds_elsewhere_than_it_does() -> None:
    """The coordinates of the grasp are part of the motion: they must say where the hand is."""
    script = carried_over(hall(), values=(0.05, 0.0))
    for column, value, unit in (
        ("stick__grip_slide", 0.053, "m"),
        ("stick__grip_turn", 0.01, "rad"),
    ):
        report = judged(
            hall(), [PLACED], script.motion(**{column: np.full(len(script.rows), value)})
        )
        assert names(report) == {("closure", "stick.grip")}
        assert unit in {found.unit for found in report.violations}


@pytest.mark.parametrize(
    ("values", "subject"), [((0.1, 0.0), "stick.grip_slide"), ((0.0, -1.25), "stick.grip_turn")]
)
def test_a_grasp_beyond_its_limits(values: tuple[float, float], subject: str) -> None:
    down = reaching(tool_at(lifted(STICK, 0.3 * UP), values=values), GUESS)
    scene = hall().with_held({"stick": "grip"}).with_start(arm=down[3:])
    script = Script(scene).go(moved_base(scene.start, y=0.5))
    script.values |= dict(zip(("stick.grip_slide", "stick.grip_turn"), values, strict=True))
    assert ("limit", subject) in names(judged(scene, [vkc.GoTo(0.0, 0.5)], script.motion()))


def sliding(script: Script, *, begin: int, end: int, by: float) -> np.ndarray:
    """Return a column that changes by `by` between two waypoints, and stays otherwise."""
    return by * np.interp(np.arange(len(script.rows)), [begin, end], [0.0, 1.0])


@pytest.mark.parametrize(
    ("column", "by", "unit"),
    [("grip_slide", 0.02, "m"), ("grip_turn", 0.1, "rad"), ("grip_slide", 1e-4, "m")],
)
def test_a_hand_that_clamps_does_not_slide(column: str, by: float, unit: str) -> None:
    script = carried_over(hall())
    phase = script.phases[3]  # half-way, in the air
    motion = script.motion(
        **{f"stick__{column}": sliding(script, begin=phase.first + 3, end=phase.last - 3, by=by)}
    )
    report = judged(hall(), [vkc.Release()], motion)
    found = next(v for v in report.violations if v.constraint == "slide")
    assert names(report) <= {("slide", f"stick.{column}"), ("penetration", "stick.stick – table")}
    assert (found.subject, found.unit) == (f"stick.{column}", unit)
    assert found.amount == pytest.approx(by)
    assert phase.first < found.waypoint <= phase.last
    assert (
        report.closure_error < 1e-9
    )  # the hand is where the coordinates say, so nothing else would notice
    loose = with_grasp(hall(), "stick", "grip", firm=False)
    assert "slide" not in {v.constraint for v in judged(loose, [vkc.Release()], motion).violations}


def test_where_the_hand_will_take_it_is_open_until_then() -> None:
    script = carried_over(hall(), values=(0.0, 0.0))
    before = sliding(script, begin=0, end=script.phases[1].last - 1, by=0.05)[::1] - 0.05
    motion = script.motion(stick__grip_slide=before)
    report = judged(hall(), [PLACED], motion)
    assert report.ok, "\n".join(report.lines())


def test_a_slide_at_the_very_end_of_a_phase() -> None:
    """From the last waypoint but one, in which it is carried, to the last, at which it is let go of."""
    script = carried_over(hall())
    last = script.phases[4].last
    for begin, end, slides in ((last - 1, last, True), (last, last + 1, False)):
        motion = script.motion(stick__grip_slide=sliding(script, begin=begin, end=end, by=0.01))
        constraints = {v.constraint for v in judged(hall(), [vkc.Release()], motion).violations}
        assert ("slide" in constraints) == slides


def test_the_other_attachment_leaves_no_freedom() -> None:
    grasp = {"attachment": "end"}
    down = reaching(tool_at(STICK, **grasp), above(STICK, **grasp))
    script = (
        Script(hall())
        .go(down)
        .take("stick", "end", ())
        .go(np.array(hall().start))
        .go(down)
        .let_go()
        .wait()
    )
    motion = script.motion()
    assert judged(hall(), [vkc.Grasp("stick", "end"), vkc.Release()], motion).ok
    beside = (
        Script(hall())
        .go(reaching(tool_at(STICK, values=(0.01, 0.0)), down))
        .take("stick", "end", ())
        .wait()
    )
    found = only(judged(hall(), [vkc.Release()], beside.let_go().wait().motion()))
    assert (found.constraint, found.subject) == ("closure", "stick.end")
    assert found.amount == pytest.approx(0.01 - 1e-3, abs=1e-9)


# --- where it goes
# ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("off", "subject_unit", "amount"),
    [
        (pin.SE3(np.eye(3), np.array([2e-3, 0.0, 0.0])), "m", 1e-3),
        (pin.SE3(np.eye(3), np.array([0.0, -2e-3, 0.0])), "m", 1e-3),
        (pin.SE3(np.eye(3), np.array([0.0, 0.0, 2e-3])), "m", 1e-3),
        (pin.SE3(pin.exp3(np.array([0.0, 0.0, 0.01])), np.zeros(3)), "rad", 9e-3),
        (pin.SE3(pin.exp3(np.array([0.01, 0.0, 0.0])), np.zeros(3)), "rad", 9e-3),
        (pin.SE3(pin.exp3(np.array([0.0, 0.01, 0.0])), np.zeros(3)), "rad", 9e-3),
    ],
    ids=["x", "y", "z", "heading", "tilt", "roll"],
)
def test_what_is_placed_beside_its_place_or_askew(
    off: pin.SE3, subject_unit: str, amount: float
) -> None:
    goal = pin.SE3(ASIDE.rotation @ off.rotation.T, ASIDE.translation - off.translation)
    motion = carried_over(hall()).motion()
    found = only(judged(hall(), [vkc.Place("stick", goal)], motion))
    assert (found.constraint, found.subject, found.unit) == ("goal", "stick.stick", subject_unit)
    assert found.amount == pytest.approx(amount, abs=1e-8)
    assert found.waypoint == motion.phases[-1].last
    assert judged(hall(), [vkc.Place("stick", ASIDE)], motion).ok


@pytest.mark.parametrize(
    ("axis", "wrong"), [(0, True), (1, True), (2, False)], ids=["tilted", "rolled", "turned"]
)
def test_a_point_to_place_it_at_leaves_the_heading_open_and_nothing_else(
    axis: int, wrong: bool
) -> None:
    """It is put down on the table turned by 0.02 rad: it lay otherwise before, as the scene says."""
    turn = pin.exp3(0.02 * np.eye(3)[axis])
    scene = room(box("table", [0.5, 2.4, 0.02], [0.8, 0.3, 0.46]))  # lower: an end may hang down
    put = pin.SE3(turn @ STICK.rotation, ASIDE.translation)
    up, down = above(STICK), reaching(tool_at(STICK), above(STICK))
    there = reaching(tool_at(put), moved_base(down, y=0.5))
    script = (
        Script(scene)
        .go(up)
        .go(down)
        .take("stick")
        .go(up)
        .go(there)
        .let_go()
        .go(moved_base(up, y=0.5))
    )
    motion = script.motion()
    report = judged(scene, [vkc.Place("stick", ASIDE.translation)], motion)
    if not wrong:
        assert report.ok, "\n".join(report.lines())
        return
    found = only(report)
    assert (found.constraint, found.subject, found.unit) == ("goal", "stick.stick", "rad")
    assert found.amount == pytest.approx(0.02 - 1e-3, abs=1e-7)
    assert judged(scene, [vkc.Place("stick", put)], motion).ok


def test_what_is_in_the_hand_at_the_start_stands_with_its_z_axis_up() -> None:
    """How it happens to be held says nothing of how it should stand."""
    aslant = pin.SE3(pin.exp3(np.array([0.5, 0.2, 0.0])), np.array([0.8, 0.0, 0.75]))
    held = room().with_held({"stick": "grip"}).with_start(arm=reaching(tool_at(aslant), GUESS)[3:])
    level = Script(held).go(reaching(tool_at(lifted(STICK)), np.array(held.start))).let_go().wait()
    report = judged(held, [vkc.Place("stick", lifted(STICK).translation)], level.motion())
    assert report.ok, "\n".join(report.lines())
    script = Script(held).go(moved_base(held.start, x=-0.5, yaw=1.2)).let_go().wait()
    there = held.with_start(base=script.rows[-1][:3]).objects["stick"].placement
    tilted = only(judged(held, [vkc.Place("stick", there.translation)], script.motion()))
    assert (tilted.constraint, tilted.subject, tilted.unit) == ("goal", "stick.stick", "rad")
    assert tilted.amount == pytest.approx(np.arccos(aslant.rotation[2, 2]) - 1e-3, abs=1e-6)


def test_upside_down_is_not_upright() -> None:
    scene = with_object(hall(), "stick", pin.SE3(pin.utils.rotate("y", np.pi), ASIDE.translation))
    stands = Script(scene).go(moved_base(scene.start, x=-0.5)).motion()
    assert judged(scene, [vkc.Place("stick", ASIDE.translation)], stands).ok
    assert only(judged(scene, [PLACED], stands)).amount == pytest.approx(np.pi - 1e-3, abs=1e-6)
    lying = carried_over(hall()).motion()
    turned = with_object(
        hall(), "stick", pin.SE3(pin.utils.rotate("y", np.pi) @ STICK.rotation, STICK.translation)
    )
    report = judged(turned, [vkc.Place("stick", (0.8, 0.5, 0.55))], lying)
    assert ("goal", "stick.stick") not in names(
        report
    )  # it stands as it stood, wherever its top is
    assert ("closure", "stick.grip") in names(report)  # but nobody can take it from there


def test_let_go_of_too_early() -> None:
    """Half-way, in the air: it stays there."""
    script = carried_over(hall())
    middle = script.phases[3]
    half = (middle.first + middle.last) // 2
    phases = (
        *script.phases[:3],
        PhaseSpan("carry", middle.first, half, middle.holds),
        PhaseSpan("drop", half, middle.last),
        *(PhaseSpan(phase.name, phase.first, phase.last) for phase in script.phases[4:]),
    )
    full = script.motion()
    motion = Trajectory(full.names, full.times, full.positions, phases, full.robot_size)
    report = judged(hall(), [PLACED], motion)
    goal = {v.unit: v for v in report.violations if v.constraint == "goal"}
    assert goal["m"].subject == "stick.stick"
    height, way = UP[2], 0.5 - script.rows[half][1]
    assert goal["m"].amount == pytest.approx(np.hypot(height, way) - 1e-3, abs=1e-6)


def test_never_let_go_of() -> None:
    script = carried_over(hall())
    script.phases[5] = PhaseSpan(
        "stay", script.phases[4].last, script.phases[4].last + 2, script.phases[4].holds
    )
    del script.rows[script.phases[5].last + 1 :]
    script.rows[-2:] = [script.rows[-3]] * 2
    motion = script.motion()
    for steps in ([PLACED], [vkc.Grasp("stick"), vkc.Release()], [vkc.Release("stick")]):
        low, held = judged(
            hall(), steps, motion
        ).violations  # that it comes so near is for putting down alone
        assert (low.constraint, low.subject) == ("clearance", "stick.stick – table")
        assert (held.constraint, held.subject) == ("goal", "stick")
        assert "still grasped" in held.detail
    assert (
        only(judged(hall(), [vkc.Grasp("stick"), vkc.GoTo(0.0, 0.5)], motion)).constraint
        == "clearance"
    )


def test_never_taken() -> None:
    drive = Script(hall()).go(moved_base(hall().start, y=0.5)).motion()
    assert ("goal", "stick.stick") in names(judged(hall(), [PLACED], drive))
    assert ("goal", "stick.grip") in names(
        judged(hall(), [vkc.Grasp("stick"), vkc.GoTo(0.0, 0.5)], drive)
    )


def test_placed_and_taken_away_again() -> None:
    """The goal must hold when the hand has let go of it, and the last one at the end."""
    script = carried_over(hall())
    down = script.rows[script.phases[4].last]
    back = (
        script.go(down)
        .take("stick")
        .go(moved_base(down, y=-0.3))
        .let_go()
        .go(moved_base(above(STICK), y=0.2))
    )
    motion = back.motion()
    assert judged(hall(), [PLACED, vkc.Place("stick", lifted(STICK, [0.0, 0.2, 0.0]))], motion).ok
    assert ("goal", "stick.stick") in names(judged(hall(), [PLACED], motion))
    wrong = [vkc.Place("stick", lifted(STICK, [0.0, 0.2, 0.0])), PLACED]
    assert ("goal", "stick.stick") in names(judged(hall(), wrong, motion))


def test_placed_before_its_turn() -> None:
    """First the drive, then the stick was asked for; it is done the other way round."""
    script = carried_over(hall())
    motion = script.go(moved_base(hall().start, y=1.0)).motion()
    assert judged(hall(), [PLACED, vkc.GoTo(0.0, 1.0)], motion).ok
    back = carried_over(hall()).motion()
    (x, y) = back.positions[-1, :2]
    assert names(judged(hall(), [vkc.GoTo(float(x), float(y)), PLACED], back)) == {
        ("order", "stick")
    }


def test_left_behind() -> None:
    """What was taken must still be in the hand at the next step's end, unless it was to be let go of."""
    motion = carried_over(hall()).motion()
    goto = vkc.GoTo(*map(float, motion.positions[-1, :2]))
    assert judged(hall(), [vkc.Grasp("stick"), vkc.Release(), goto], motion).ok
    found = only(judged(hall(), [vkc.Grasp("stick"), goto], motion))
    assert (found.constraint, found.subject) == ("goal", "stick")
    assert "not grasped" in found.detail


def test_taken_hold_of_as_the_motion_ends() -> None:
    """To ask for it twice asks for nothing more; to go on with it does."""
    up = above(STICK)
    motion = Script(hall()).go(up).go(reaching(tool_at(STICK), up)).motion()
    grasp, here = vkc.Grasp("stick"), vkc.GoTo(*map(float, motion.positions[-1, :2]))
    for steps in ([grasp], [grasp, grasp], [here, grasp, grasp]):
        assert judged(hall(), steps, motion).ok, steps
    found = only(judged(hall(), [grasp, grasp, here], motion))
    assert (found.constraint, found.subject) == ("goal", "stick")


# --- touching
# ---------------------------------------------------------------------------------------------------------


@cache
def touching(gap: float = 0.0) -> tuple[Scene, Script, np.ndarray]:
    """Return a motion that drives the tip of a stick in the hand to `gap` before a wall, and back; and where it touches."""
    held = room().with_held({"stick": "grip"})
    there = moved_base(held.start, y=0.4)
    tip = tips_target(held, there)
    wall = box("wall", [0.3, 0.1, 0.3], tip + np.array([0.0, gap + 0.05, 0.0]))
    scene = room(wall).with_held({"stick": "grip"})
    return scene, Script(scene).go(there).go(np.array(scene.start)), tip


def at_the_wall(gap: float, steps: Sequence[vkc.Touch | vkc.GoTo]) -> Report:
    scene, script, _ = touching(gap)
    return judged(scene, [*steps, vkc.GoTo(0.0, 0.0)], script.motion())


@pytest.mark.parametrize("gap", [0.0, -5e-5, 1e-3])
def test_a_tip_may_touch_what_it_is_told_to_touch(gap: float) -> None:
    _, _, tip = touching(gap)
    report = at_the_wall(gap, [vkc.Touch("stick.tip", tip)])
    assert report.ok, "\n".join(report.lines())
    unasked = at_the_wall(gap, [vkc.GoTo(0.0, 0.4)])
    assert names(unasked) <= {
        ("clearance", "stick.tip – wall"),
        ("penetration", "stick.tip – wall"),
    }
    assert names(unasked)


def test_but_it_may_not_go_into_it() -> None:
    _, _, tip = touching(-1e-3)
    found = only(at_the_wall(-1e-3, [vkc.Touch("stick.tip", tip)]))
    assert (found.constraint, found.subject) == ("penetration", "stick.tip – wall")
    assert found.amount == pytest.approx(1e-3, abs=1e-6)
    assert found.time == pytest.approx(touching(-1e-3)[1].motion().times[20])


def test_nor_may_the_rest_of_the_stick_touch_it() -> None:
    """Only the link that is brought there."""
    _, _, tip = touching(0.0)
    report = at_the_wall(-0.03, [vkc.Touch("stick.stick", tip - np.array([0.0, 0.25, 0.0]))])
    assert ("penetration", "stick.tip – wall") in names(report)


@pytest.mark.parametrize("side", SIDES, ids=str)
def test_a_touch_beside_the_target(side: np.ndarray) -> None:
    _, _, tip = touching(1e-3)
    found = only(at_the_wall(1e-3, [vkc.Touch("stick.tip", tip + 1.5e-3 * side)]))
    assert (found.constraint, found.subject, found.unit) == ("goal", "stick.tip", "m")
    assert found.amount == pytest.approx(0.5e-3, abs=1e-8)
    assert at_the_wall(1e-3, [vkc.Touch("stick.tip", tip + 0.9e-3 * side)]).ok


def test_touching_a_pose_asks_for_the_orientation_too() -> None:
    _, _, tip = touching(1e-3)
    looking = pin.SE3(pin.utils.rotate("x", -np.pi / 2), tip)  # z along y, as the stick lies
    assert at_the_wall(1e-3, [vkc.Touch("stick.tip", looking)]).ok
    turned = looking * pin.SE3(pin.exp3(np.array([0.0, 0.0, 0.01])), np.zeros(3))
    found = only(at_the_wall(1e-3, [vkc.Touch("stick.tip", turned)]))
    assert (found.constraint, found.subject, found.unit) == ("goal", "stick.tip", "rad")
    assert found.amount == pytest.approx(9e-3, abs=1e-6)
    far, there, _ = touching(0.1)
    tool = far.with_start(base=there.rows[20][:3]).tool_placement()
    assert judged(far, [vkc.Touch("tool", tool), vkc.GoTo(0.0, 0.0)], there.motion()).ok
    assert names(
        judged(far, [vkc.Touch("tool", tool * looking), vkc.GoTo(0.0, 0.0)], there.motion())
    ) == {("goal", "tool")}


def test_a_touch_on_the_way_is_no_touch() -> None:
    """It must be where a phase ends."""
    scene, script, _ = touching(1e-3)
    passed = tips_target(scene, script.rows[10])
    report = at_the_wall(1e-3, [vkc.Touch("stick.tip", passed)])
    assert {v.subject for v in report.violations if v.constraint == "goal"} == {"stick.tip"}


def test_a_tip_may_touch_a_ball() -> None:
    """Which could be carried away, but stands there."""
    beside = pin.SE3(STICK.rotation, BALL.translation - np.array([0.0, 0.285, 0.0]))
    there = reaching(tool_at(beside), above(STICK))
    start = moved_base(there, y=-0.1)
    scene = (
        room(stand(), objects=("stick", "ball"))
        .with_held({"stick": "grip"})
        .with_start(base=start[:3], arm=start[3:])
    )
    motion = Script(scene).go(there).motion()
    side = BALL.translation - np.array([0.0, 0.035, 0.0])
    report = judged(scene, [vkc.Touch("stick.tip", side)], motion)
    assert report.ok, "\n".join(report.lines())
    assert names(judged(scene, [vkc.GoTo(0.0, 0.0)], motion)) & {
        ("clearance", "stick.tip – ball.ball"),
        ("penetration", "stick.tip – ball.ball"),
    }


def test_touches_in_the_wrong_order() -> None:
    scene = room().with_held({"stick": "grip"})
    one, two = moved_base(scene.start, y=0.3), moved_base(scene.start, y=0.3, x=-0.2)
    motion = Script(scene).go(one).go(two).motion()
    first, second = (vkc.Touch("stick.tip", tips_target(scene, row)) for row in (one, two))
    assert judged(scene, [first, second], motion).ok
    assert names(judged(scene, [second, first], motion)) == {("goal", "stick.tip")}


# --- what it runs into
# ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("gap", "ok"),
    [(0.01, True), (1e-3, True), (0.0, True), (-5e-5, True), (-2e-4, False), (-1e-3, False)],
)
def test_it_may_lie_on_a_table_but_not_in_it(gap: float, ok: bool) -> None:
    scene = room(table(gap=gap))
    report = judged(scene, [PLACED], carried_over(scene).motion())
    assert report.ok == ok, "\n".join(report.lines())
    if not ok:
        found = only(report)
        assert (found.constraint, found.subject) == ("penetration", "stick.stick – table")
        assert found.amount == pytest.approx(-gap, abs=1e-6)


def test_only_what_it_lies_on_may_be_that_close() -> None:
    """A shelf that the stick passes at 1 cm, where it neither starts nor ends."""
    down = reaching(tool_at(STICK), above(STICK))
    passing = (
        Script(hall())
        .go(down)
        .take("stick")
        .go(np.array(hall().start))
        .go(moved_base(hall().start, y=1.0))
    )
    passing.go(moved_base(down, y=1.0)).let_go().go(moved_base(hall().start, y=1.0))
    motion, steps = passing.motion(), [vkc.Place("stick", lifted(STICK, [0.0, 1.0, 0.0]))]
    assert judged(hall(), steps, motion).ok
    shelf = box(
        "shelf", [0.1, 0.2, 0.1], [0.8, 0.6, 0.7 - 0.05 - 0.01]
    )  # the discs' lowest points pass at 0.7
    report = judged(room(table(), shelf), steps, motion)
    assert names(report) == {("clearance", "stick.stick – shelf")}
    assert only(report).amount == pytest.approx(0.01 - 1e-3, abs=1e-4)


@pytest.mark.parametrize("where", [0.5, 0.85])
def test_a_post_between_two_waypoints(where: float) -> None:
    """Both waypoints are clear of it, and the robot all the way; what it carries is not."""
    scene = room(table())
    script = (
        Script(scene)
        .go(reaching(tool_at(STICK), above(STICK)))
        .take("stick")
        .go(np.array(scene.start))
    )
    far = moved_base(scene.start, y=2.0)
    script.go(far, steps=1)
    motion = script.motion(dt=20.0)
    steps = [vkc.GoTo(0.0, 2.0)]
    assert judged(scene, steps, motion).ok
    post = {
        "name": "post",
        "type": "cylinder",
        "radius": 0.01,
        "length": 0.04,
        "position": [0.8, 2.0 * where, 0.75],
    }
    report = judged(room(table(), post), steps, motion)
    hits = {v.subject: v for v in report.violations if v.constraint == "penetration"}
    assert {"stick.stick – post", "stick.tip – post"} & set(hits)
    assert not any(v.constraint == "clearance" for v in report.violations)
    for found in hits.values():
        assert motion.times[-2] < found.time < motion.times[-1]


def test_a_fence_beside_which_it_lies() -> None:
    """What is close where it is taken need not be cleared, but neither may it be passed through, between two samples or not."""
    fence = box("fence", [0.6, 0.001, 0.1], [0.8, 0.262, 0.56])
    scene = room(table(), fence)
    down = reaching(tool_at(STICK), above(STICK))
    through = Script(scene).go(down).take("stick").go(moved_base(down, y=0.6)).motion()
    report = judged(scene, [vkc.GoTo(0.0, 0.6)], through)
    assert {("penetration", "stick.tip – fence"), ("penetration", "stick.stick – fence")} <= names(
        report
    )
    over = (
        Script(scene)
        .go(down)
        .take("stick")
        .go(np.array(scene.start))
        .go(moved_base(scene.start, y=0.6))
        .motion()
    )
    assert judged(scene, [vkc.GoTo(0.0, 0.6)], over).ok


def test_it_hits_the_floor() -> None:
    """Hung from the hand, tip down, and lowered."""
    hanging = pin.utils.rotate("x", -np.pi / 2)  # the stick's y points down
    heights = (0.3, 0.24)  # of its middle: the tip is 0.25 below
    rows = [
        reaching(tool_at(pin.SE3(hanging, np.array([0.9, 0.0, z])), values=(0.0, 0.0)))
        for z in heights
    ]
    rows[1] = reaching(tool_at(pin.SE3(hanging, np.array([0.9, 0.0, heights[1]]))), rows[0])
    scene = room().with_held({"stick": "grip"}).with_start(arm=rows[0][3:])
    motion = Script(scene).go(rows[1]).motion()
    report = judged(scene, [vkc.GoTo(0.0, 0.0)], motion)
    found = next(v for v in report.violations if v.subject.endswith(" – floor"))
    assert (found.constraint, found.subject) == ("penetration", "stick.tip – floor")
    assert found.amount == pytest.approx(0.01, abs=1e-5)
    assert found.waypoint == len(motion.times) - 1
    higher = (
        Script(scene)
        .go(reaching(tool_at(pin.SE3(hanging, np.array([0.9, 0.0, 0.275]))), rows[0]))
        .motion()
    )
    assert not {
        v.subject
        for v in judged(scene, [vkc.GoTo(0.0, 0.0)], higher).violations
        if "floor" in v.subject
    }


def test_it_hits_the_robot_that_carries_it() -> None:
    """The hand alone may be at what it holds."""
    scene = room().with_held({"stick": "grip"})
    bent = np.array(scene.start)
    bent[6] -= 2.36  # the wrist, so that the dowel comes back to the forearm
    report = judged(scene, [vkc.GoTo(0.0, 0.0)], Script(scene).go(bent).motion())
    assert names(report) == {("penetration", "forearm_link – stick.stick")}
    assert judged(
        room(), [vkc.GoTo(0.0, 0.0)], Script(room()).go(bent).motion()
    ).ok  # the robot alone


def test_it_hits_another_thing_that_could_be_carried() -> None:
    scene = room(stand(), objects=("stick", "ball")).with_held({"stick": "grip"})
    start = reaching(
        tool_at(pin.SE3(STICK.rotation, BALL.translation - np.array([0.0, 0.4, 0.0]))), above(STICK)
    )
    scene = scene.with_start(arm=start[3:])
    for forward, constraint in ((0.08, None), (0.1, "clearance"), (0.125, "penetration")):
        motion = Script(scene).go(moved_base(start, y=forward)).motion()
        report = judged(scene, [vkc.GoTo(0.0, forward)], motion)
        assert names(report) == (
            {(constraint, "stick.tip – ball.ball")} if constraint else set()
        ), "\n".join(report.lines())


def test_the_fingers_may_not_go_into_what_they_hold() -> None:
    """Its hold lies 3 cm deeper in the hand than it is meant to: the palm is in the dowel."""
    deep = with_grasp(hall(), "stick", "grip", standoff=-0.03)
    up = reaching(
        tool_at(lifted(STICK)) * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.04])), above(STICK)
    )
    scene = deep.with_held({"stick": "grip"}).with_start(arm=up[3:])
    report = judged(scene, [vkc.GoTo(0.0, 0.3)], Script(scene).go(moved_base(up, y=0.3)).motion())
    assert {v.constraint for v in report.violations} == {"penetration"}
    assert {v.subject.split(" – ")[0] for v in report.violations} <= set(hall().robot.touch_links)
    assert {v.subject.split(" – ")[1] for v in report.violations} == {"stick.stick"}


# --- through a stick
# --------------------------------------------------------------------------------------------------


@cache
def fetching(off: float = 0.0, *, post: bool = False) -> Script:
    """Return stick in hand, its tip brought to `off` [m] before the ball, which it then carries to another stand to the left."""
    obstacles = [stand(), stand("stand_2", aside=0.3)]
    if post:
        obstacles.append(box("post", [0.02, 0.005, 0.03], [0.8, 0.5, 0.75]))
    scene = room(*obstacles, objects=("stick", "ball"))
    beside = pin.SE3(STICK.rotation, BALL.translation - np.array([0.0, 0.285 + off, 0.0]))
    touch = reaching(tool_at(beside), above(STICK))
    up = reaching(tool_at(lifted(beside, UP / 4)), touch)
    start = moved_base(touch, y=-0.1)
    scene = scene.with_held({"stick": "grip"}).with_start(base=start[:3], arm=start[3:])
    script = (
        Script(scene).go(touch).take("ball", "pull", (np.pi / 2, 0.0, 0.0), by="stick.tip").go(up)
    )
    script.go(moved_base(up, y=0.3)).go(moved_base(touch, y=0.3)).let_go("ball")
    return script.go(moved_base(touch, y=0.26))


FETCHED = vkc.Place("ball", lifted(BALL, [0.0, 0.3, 0.0]))


def test_a_tip_that_does_not_reach_the_ball_does_not_hold_it() -> None:
    report = judged(fetching(2e-3).scene, [FETCHED], fetching(2e-3).motion())
    found = only(report)
    assert (found.constraint, found.subject, found.unit) == ("closure", "ball.pull", "m")
    assert found.amount == pytest.approx(1e-3, abs=1e-8)
    grasped = judged(
        fetching(2e-3).scene,
        [vkc.Grasp("ball", "pull", "stick.tip"), FETCHED],
        fetching(2e-3).motion(),
    )
    assert ("goal", "ball.pull") in names(grasped)
    by_hand = judged(fetching().scene, [vkc.Grasp("ball", "pull"), FETCHED], fetching().motion())
    assert ("goal", "ball.pull") in names(by_hand)  # the hand itself never was there


def test_a_tip_in_the_ball() -> None:
    """By more than rounding."""
    assert judged(fetching(-5e-5).scene, [FETCHED], fetching(-5e-5).motion()).ok
    report = judged(fetching(-5e-4).scene, [FETCHED], fetching(-5e-4).motion())
    assert names(report) == {("penetration", "stick.tip – ball.ball")}


def test_a_ball_that_is_carried_through_a_post() -> None:
    report = judged(fetching(post=True).scene, [FETCHED], fetching(post=True).motion())
    assert ("penetration", "ball.ball – post") in names(report)


def test_a_ball_that_rolls_on_the_tip() -> None:
    script = fetching()
    roll = np.pi / 2 + sliding(script, begin=45, end=55, by=0.2)
    report = judged(script.scene, [vkc.Release("ball")], script.motion(ball__pull_x=roll))
    assert ("slide", "ball.pull_x") in names(report)


def test_a_ball_that_is_dropped_with_the_stick() -> None:
    """Nothing is held through what nobody holds."""
    ball = Hold("ball", "pull", Hold("stick", "grip"), "tip")
    with pytest.raises(InputError, match="held through an object that is not held"):
        PhaseSpan("no stick", 0, 1, (ball,))
    data = fetching().motion().to_dict()
    data["phases"][2] |= {"held": {"ball": "pull"}, "by": {"ball": "stick.tip"}}
    with pytest.raises(UnknownNameError) as caught:
        Trajectory.from_dict(data)
    assert caught.value.field == "by"


# --- what is no motion of this scene
# ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("step", "field", "nearest"),
    [
        (vkc.Touch("stick.top", (0.0, 0.0, 1.0)), "steps[0].frame", "tip"),
        (vkc.Touch("tol", (0.0, 0.0, 1.0)), "steps[0].frame", "tool"),
        (vkc.Place("stik", (0.0, 0.0, 1.0)), "steps[0].object", "stick"),
        (vkc.Place("stick", (0.0, 0.0, 1.0), "gripp"), "steps[0].attachment", "grip"),
        (vkc.Release("stik"), "steps[0].object", "stick"),
        (vkc.Grasp("stick", by="stik.tip"), "steps[0].by", "stick"),
        (vkc.Grasp("stick", by="stick.tap"), "steps[0].by", "tip"),
    ],
)
def test_steps_that_name_what_is_not_there(step: object, field: str, nearest: str) -> None:
    with pytest.raises(UnknownNameError) as caught:
        judged(hall(), [step], carried_over(hall()).motion())
    assert (caught.value.field, caught.value.nearest) == (field, nearest)


def test_trajectories_that_do_not_fit() -> None:
    full = carried_over(hall()).motion()
    names_without = tuple(name for name in full.names if name != "stick.grip_slide")
    kept = [full.names.index(name) for name in names_without]
    lacking = Trajectory(
        names_without, full.times, full.positions[:, kept], full.phases, full.robot_size
    )
    with pytest.raises(InputError, match="missing") as caught:
        judged(hall(), [PLACED], lacking)
    assert caught.value.expected == "stick.grip_slide"
    script = fetching()
    data = script.motion().to_dict()
    for phase in data["phases"]:
        phase["by"] = dict.fromkeys(phase["by"], "stick.tap")
    with pytest.raises(UnknownNameError) as unknown:
        judged(script.scene, [FETCHED], Trajectory.from_dict(data))
    assert (unknown.value.field, unknown.value.nearest) == ("trajectory.phases[1].by", "tip")
