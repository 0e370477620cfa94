"""Tests that validation accepts valid transport of free objects and reports each violation."""

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
    MotionBuilder,
    compute_grasp_pose,
    describe_box,
    describe_stand,
    describe_table,
    lift,
    make_carrying_motion,
    make_room,
    move_base,
    place_object,
    replace_grasp,
    solve_above,
    solve_reach,
)
from helpers.judging import get_only_violation, get_violation_names

import vkc_pin as vkc
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.validation.report import Report
from vkc_pin.validation.validate import validate
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Step
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

ASIDE = lift(STICK, [0.0, 0.5, 0.0])
PLACED = vkc.Place("stick", ASIDE)
DIRECTIONS = np.diag([1.0, -1.0, 1.0])


@cache
def make_hall() -> Scene:
    return make_room(describe_table())


def judge(scene: Scene, steps: Sequence[Step], motion: Trajectory) -> Report:
    """Validate a motion without time for the gripper, and with short time steps."""
    return validate(scene, steps, motion, vkc.Options(dt=0.05, grasp_time=1e-6))


def compute_tip_position(scene: Scene, row: np.ndarray) -> np.ndarray:
    """Return the position of the stick's tip, with the stick grasped in the middle of its grip."""
    held = scene.with_held({"stick": "grip"}).with_start(base=row[:3], arm=row[3:])
    return np.array(held.objects["stick"].link_placement("tip").translation)


@pytest.mark.parametrize("values", [(0.0, 0.0), (0.06, 0.0), (-0.05, 0.3), (0.09, -0.3)])
def test_pick_and_place_is_valid(values: tuple[float, float]) -> None:
    motion = make_carrying_motion(make_hall(), values=values).motion()
    for steps in (
        [PLACED],
        [vkc.Place("stick", ASIDE.translation)],
        [vkc.Grasp("stick"), PLACED],
        [vkc.Grasp("stick", "grip"), PLACED, vkc.GoTo(0.0, 0.5)],
        [vkc.Grasp("stick"), vkc.Release()],
        [vkc.Grasp("stick"), vkc.Release("stick"), vkc.GoTo(0.0, 0.5, 0.0)],
    ):
        report = judge(make_hall(), steps, motion)
        assert report.ok, "\n".join(report.lines())
        assert report.closure_error < 1e-9
        assert report.clearance == pytest.approx(1e-3, abs=1e-6)  # of the discs above the table


def test_object_grasped_at_the_start_may_leave_its_support_within_a_second() -> None:
    up, down = solve_above(STICK), solve_reach(compute_grasp_pose(STICK), solve_above(STICK))
    for gap in (1e-3, 0.0, -2e-3):
        held = (
            make_room(describe_table(gap=gap))
            .with_start(base=down[:3], arm=down[3:])
            .with_held({"stick": "grip"})
        )
        report = judge(
            held, [vkc.GoTo(0.0, 0.5)], MotionBuilder(held).go(up).go(move_base(up, y=0.5)).motion()
        )
        assert report.ok, "\n".join(report.lines())
        late = (
            MotionBuilder(held)
            .go(move_base(down, y=0.1), steps=60)
            .go(up)
            .go(move_base(up, y=0.5))
            .motion()
        )
        constraint = "penetration" if gap < 0.0 else "clearance"
        assert get_violation_names(judge(held, [vkc.GoTo(0.0, 0.5)], late)) == {
            (constraint, "stick.stick – table")
        }


def test_fetching_with_a_tool_is_valid() -> None:
    for steps in (
        [vkc.Place("ball", lift(BALL, [0.0, 0.3, 0.0]))],
        [vkc.Grasp("ball", "pull", "stick.tip"), vkc.Place("ball", lift(BALL, [0.0, 0.3, 0.0]))],
        [vkc.Grasp("ball", by="stick.tip"), vkc.Release("ball")],
    ):
        report = judge(fetch_ball().scene, steps, fetch_ball().motion())
        assert report.ok, "\n".join(report.lines())


@pytest.mark.parametrize("direction", DIRECTIONS, ids=str)
def test_position_error_of_a_grasp_is_reported(direction: np.ndarray) -> None:
    motion = make_carrying_motion(make_hall(), off=pin.SE3(np.eye(3), 2e-3 * direction)).motion()
    report = judge(make_hall(), [PLACED], motion)
    found = get_only_violation(report)
    assert (found.constraint, found.subject, found.unit) == ("closure", "stick.grip", "m")
    assert found.amount == pytest.approx(1e-3, abs=1e-9)
    assert found.waypoint >= motion.phases[2].first
    assert report.closure_error == pytest.approx(2e-3, abs=1e-9)
    grasped = judge(make_hall(), [vkc.Grasp("stick"), PLACED], motion)
    assert get_violation_names(grasped) == {("closure", "stick.grip"), ("goal", "stick.grip")}
    within = make_carrying_motion(make_hall(), off=pin.SE3(np.eye(3), 9e-4 * direction)).motion()
    assert judge(make_hall(), [vkc.Grasp("stick"), PLACED], within).ok


@pytest.mark.parametrize("direction", DIRECTIONS, ids=str)
def test_orientation_error_of_a_grasp_is_reported(direction: np.ndarray) -> None:
    motion = make_carrying_motion(
        make_hall(), off=pin.SE3(pin.exp3(4e-3 * direction), np.zeros(3))
    ).motion()
    found = get_only_violation(judge(make_hall(), [PLACED], motion))
    assert (found.constraint, found.subject, found.unit) == ("closure", "stick.grip", "rad")
    assert found.amount == pytest.approx(3e-3, abs=1e-6)


def test_grasp_coordinates_must_match_the_tool() -> None:
    script = make_carrying_motion(make_hall(), values=(0.05, 0.0))
    for column, value, unit in (
        ("stick__grip_slide", 0.053, "m"),
        ("stick__grip_turn", 0.01, "rad"),
    ):
        report = judge(
            make_hall(), [PLACED], script.motion(**{column: np.full(len(script.rows), value)})
        )
        assert get_violation_names(report) == {("closure", "stick.grip")}
        assert unit in {found.unit for found in report.violations}


@pytest.mark.parametrize(
    ("values", "subject"), [((0.1, 0.0), "stick.grip_slide"), ((0.0, -1.25), "stick.grip_turn")]
)
def test_grasp_coordinates_must_be_within_limits(values: tuple[float, float], subject: str) -> None:
    down = solve_reach(compute_grasp_pose(lift(STICK, 0.3 * UP), values=values), GUESS)
    scene = make_hall().with_held({"stick": "grip"}).with_start(arm=down[3:])
    script = MotionBuilder(scene).go(move_base(scene.start, y=0.5))
    script.values |= dict(zip(("stick.grip_slide", "stick.grip_turn"), values, strict=True))
    assert ("limit", subject) in get_violation_names(
        judge(scene, [vkc.GoTo(0.0, 0.5)], script.motion())
    )


def make_slide(script: MotionBuilder, *, begin: int, end: int, by: float) -> np.ndarray:
    """Return a column that changes by `by` between two waypoints and is constant otherwise."""
    return by * np.interp(np.arange(len(script.rows)), [begin, end], [0.0, 1.0])


@pytest.mark.parametrize(
    ("column", "by", "unit"),
    [("grip_slide", 0.02, "m"), ("grip_turn", 0.1, "rad"), ("grip_slide", 1e-4, "m")],
)
def test_firm_grasps_must_not_slide(column: str, by: float, unit: str) -> None:
    script = make_carrying_motion(make_hall())
    phase = script.phases[3]  # half-way, in the air
    motion = script.motion(
        **{f"stick__{column}": make_slide(script, begin=phase.first + 3, end=phase.last - 3, by=by)}
    )
    report = judge(make_hall(), [vkc.Release()], motion)
    found = next(v for v in report.violations if v.constraint == "slide")
    assert get_violation_names(report) <= {
        ("slide", f"stick.{column}"),
        ("penetration", "stick.stick – table"),
    }
    assert (found.subject, found.unit) == (f"stick.{column}", unit)
    assert found.amount == pytest.approx(by)
    assert phase.first < found.waypoint <= phase.last
    assert (
        report.closure_error < 1e-9
    )  # the hand follows the coordinates, so that closure does not show the slide
    loose = replace_grasp(make_hall(), "stick", "grip", firm=False)
    assert "slide" not in {v.constraint for v in judge(loose, [vkc.Release()], motion).violations}


def test_grasp_coordinates_are_free_before_the_grasp() -> None:
    script = make_carrying_motion(make_hall(), values=(0.0, 0.0))
    before = make_slide(script, begin=0, end=script.phases[1].last - 1, by=0.05) - 0.05
    motion = script.motion(stick__grip_slide=before)
    report = judge(make_hall(), [PLACED], motion)
    assert report.ok, "\n".join(report.lines())


def test_slide_in_the_last_segment_of_a_grasp_is_reported() -> None:
    script = make_carrying_motion(make_hall())
    last = script.phases[4].last
    for begin, end, slides in ((last - 1, last, True), (last, last + 1, False)):
        motion = script.motion(stick__grip_slide=make_slide(script, begin=begin, end=end, by=0.01))
        constraints = {v.constraint for v in judge(make_hall(), [vkc.Release()], motion).violations}
        assert ("slide" in constraints) == slides


@pytest.mark.parametrize(
    ("error", "unit", "amount"),
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
def test_pose_error_of_a_placed_object_is_reported(
    error: pin.SE3, unit: str, amount: float
) -> None:
    goal = pin.SE3(ASIDE.rotation @ error.rotation.T, ASIDE.translation - error.translation)
    motion = make_carrying_motion(make_hall()).motion()
    found = get_only_violation(judge(make_hall(), [vkc.Place("stick", goal)], motion))
    assert (found.constraint, found.subject, found.unit) == ("goal", "stick.stick", unit)
    assert found.amount == pytest.approx(amount, abs=1e-8)
    assert found.waypoint == motion.phases[-1].last
    assert judge(make_hall(), [vkc.Place("stick", ASIDE)], motion).ok


@pytest.mark.parametrize(
    ("axis", "wrong"), [(0, True), (1, True), (2, False)], ids=["tilted", "rolled", "turned"]
)
def test_placing_at_a_point_leaves_only_the_heading_free(axis: int, wrong: bool) -> None:
    turn = pin.exp3(0.02 * np.eye(3)[axis])
    scene = make_room(
        describe_box("table", [0.5, 2.4, 0.02], [0.8, 0.3, 0.46])
    )  # lower: an end may hang down
    put = pin.SE3(turn @ STICK.rotation, ASIDE.translation)
    up, down = solve_above(STICK), solve_reach(compute_grasp_pose(STICK), solve_above(STICK))
    there = solve_reach(compute_grasp_pose(put), move_base(down, y=0.5))
    script = (
        MotionBuilder(scene)
        .go(up)
        .go(down)
        .take("stick")
        .go(up)
        .go(there)
        .let_go()
        .go(move_base(up, y=0.5))
    )
    motion = script.motion()
    report = judge(scene, [vkc.Place("stick", ASIDE.translation)], motion)
    if not wrong:
        assert report.ok, "\n".join(report.lines())
        return
    found = get_only_violation(report)
    assert (found.constraint, found.subject, found.unit) == ("goal", "stick.stick", "rad")
    assert found.amount == pytest.approx(0.02 - 1e-3, abs=1e-7)
    assert judge(scene, [vkc.Place("stick", put)], motion).ok


def test_object_grasped_at_the_start_is_placed_upright() -> None:
    slanted = pin.SE3(pin.exp3(np.array([0.5, 0.2, 0.0])), np.array([0.8, 0.0, 0.75]))
    held = (
        make_room()
        .with_held({"stick": "grip"})
        .with_start(arm=solve_reach(compute_grasp_pose(slanted), GUESS)[3:])
    )
    level = (
        MotionBuilder(held)
        .go(solve_reach(compute_grasp_pose(lift(STICK)), np.array(held.start)))
        .let_go()
        .wait()
    )
    report = judge(held, [vkc.Place("stick", lift(STICK).translation)], level.motion())
    assert report.ok, "\n".join(report.lines())
    script = MotionBuilder(held).go(move_base(held.start, x=-0.5, yaw=1.2)).let_go().wait()
    there = held.with_start(base=script.rows[-1][:3]).objects["stick"].placement
    tilted = get_only_violation(
        judge(held, [vkc.Place("stick", there.translation)], script.motion())
    )
    assert (tilted.constraint, tilted.subject, tilted.unit) == ("goal", "stick.stick", "rad")
    assert tilted.amount == pytest.approx(np.arccos(slanted.rotation[2, 2]) - 1e-3, abs=1e-6)


def test_object_placed_at_a_point_may_stay_upside_down() -> None:
    scene = place_object(
        make_hall(), "stick", pin.SE3(pin.utils.rotate("y", np.pi), ASIDE.translation)
    )
    stands = MotionBuilder(scene).go(move_base(scene.start, x=-0.5)).motion()
    assert judge(scene, [vkc.Place("stick", ASIDE.translation)], stands).ok
    assert get_only_violation(judge(scene, [PLACED], stands)).amount == pytest.approx(
        np.pi - 1e-3, abs=1e-6
    )
    lying = make_carrying_motion(make_hall()).motion()
    turned = place_object(
        make_hall(),
        "stick",
        pin.SE3(pin.utils.rotate("y", np.pi) @ STICK.rotation, STICK.translation),
    )
    report = judge(turned, [vkc.Place("stick", (0.8, 0.5, 0.55))], lying)
    assert ("goal", "stick.stick") not in get_violation_names(
        report
    )  # its orientation has not changed
    assert ("closure", "stick.grip") in get_violation_names(
        report
    )  # but the hand cannot grasp it there


def test_object_must_be_released() -> None:
    script = make_carrying_motion(make_hall())
    script.phases[5] = PhaseSpan(
        "stay", script.phases[4].last, script.phases[4].last + 2, script.phases[4].holds
    )
    del script.rows[script.phases[5].last + 1 :]
    script.rows[-2:] = [script.rows[-3]] * 2
    motion = script.motion()
    for steps in ([PLACED], [vkc.Grasp("stick"), vkc.Release()], [vkc.Release("stick")]):
        close, held = judge(make_hall(), steps, motion).violations
        assert (close.constraint, close.subject) == ("clearance", "stick.stick – table")
        assert (held.constraint, held.subject) == ("goal", "stick")
        assert "still grasped" in held.detail


def test_placed_object_must_not_be_moved_again() -> None:
    script = make_carrying_motion(make_hall())
    down = script.rows[script.phases[4].last]
    script.go(down).take("stick").go(move_base(down, y=-0.3)).let_go()
    motion = script.go(move_base(solve_above(STICK), y=0.2)).motion()
    further = vkc.Place("stick", lift(STICK, [0.0, 0.2, 0.0]))
    assert judge(make_hall(), [PLACED, further], motion).ok
    assert ("goal", "stick.stick") in get_violation_names(judge(make_hall(), [PLACED], motion))
    assert ("goal", "stick.stick") in get_violation_names(
        judge(make_hall(), [further, PLACED], motion)
    )
    end = vkc.GoTo(*map(float, motion.positions[-1, :2]))
    undone = get_only_violation(judge(make_hall(), [PLACED, end], motion))
    assert (undone.constraint, undone.subject) == ("order", "step 1")


def test_object_must_not_be_moved_before_its_step() -> None:
    script = make_carrying_motion(make_hall())
    motion = script.go(move_base(make_hall().start, y=1.0)).motion()
    assert judge(make_hall(), [PLACED, vkc.GoTo(0.0, 1.0)], motion).ok
    back = make_carrying_motion(make_hall()).motion()
    (x, y) = back.positions[-1, :2]
    assert get_violation_names(
        judge(make_hall(), [vkc.GoTo(float(x), float(y)), PLACED], back)
    ) == {("order", "stick")}


def test_grasped_object_must_stay_grasped() -> None:
    motion = make_carrying_motion(make_hall()).motion()
    goto = vkc.GoTo(*map(float, motion.positions[-1, :2]))
    assert judge(make_hall(), [vkc.Grasp("stick"), vkc.Release(), goto], motion).ok
    found = get_only_violation(judge(make_hall(), [vkc.Grasp("stick"), goto], motion))
    assert (found.constraint, found.subject) == ("goal", "stick")
    assert "not grasped" in found.detail


def test_grasp_steps_may_end_the_motion() -> None:
    up = solve_above(STICK)
    motion = (
        MotionBuilder(make_hall()).go(up).go(solve_reach(compute_grasp_pose(STICK), up)).motion()
    )
    grasp, here = vkc.Grasp("stick"), vkc.GoTo(*map(float, motion.positions[-1, :2]))
    for steps in ([grasp], [grasp, grasp], [here, grasp, grasp]):
        assert judge(make_hall(), steps, motion).ok, steps
    found = get_only_violation(judge(make_hall(), [grasp, grasp, here], motion))
    assert (found.constraint, found.subject) == ("goal", "stick")


@cache
def touch_wall(gap: float = 0.0) -> tuple[Scene, MotionBuilder, np.ndarray]:
    """Return scene, motion and position of a touch, `gap` [m] in front of a wall."""
    held = make_room().with_held({"stick": "grip"})
    there = move_base(held.start, y=0.4)
    tip = compute_tip_position(held, there)
    wall = describe_box("wall", [0.3, 0.1, 0.3], tip + np.array([0.0, gap + 0.05, 0.0]))
    scene = make_room(wall).with_held({"stick": "grip"})
    return scene, MotionBuilder(scene).go(there).go(np.array(scene.start)), tip


def judge_touch(gap: float, steps: Sequence[vkc.Touch | vkc.GoTo]) -> Report:
    scene, script, _ = touch_wall(gap)
    return judge(scene, [*steps, vkc.GoTo(0.0, 0.0)], script.motion())


@pytest.mark.parametrize("gap", [0.0, -5e-5, 1e-3])
def test_touch_permits_contact(gap: float) -> None:
    _, _, tip = touch_wall(gap)
    report = judge_touch(gap, [vkc.Touch("stick.tip", tip)])
    assert report.ok, "\n".join(report.lines())
    without_touch = judge_touch(gap, [vkc.GoTo(0.0, 0.4)])
    assert get_violation_names(without_touch) <= {
        ("clearance", "stick.tip – wall"),
        ("penetration", "stick.tip – wall"),
    }
    assert get_violation_names(without_touch)


def test_touch_permits_no_penetration() -> None:
    _, _, tip = touch_wall(-1e-3)
    found = get_only_violation(judge_touch(-1e-3, [vkc.Touch("stick.tip", tip)]))
    assert (found.constraint, found.subject) == ("penetration", "stick.tip – wall")
    assert found.amount == pytest.approx(1e-3, abs=1e-6)
    assert found.time == pytest.approx(touch_wall(-1e-3)[1].motion().times[20])


def test_touch_permits_contact_of_its_link_only() -> None:
    _, _, tip = touch_wall(0.0)
    report = judge_touch(-0.03, [vkc.Touch("stick.stick", tip - np.array([0.0, 0.25, 0.0]))])
    assert ("penetration", "stick.tip – wall") in get_violation_names(report)


@pytest.mark.parametrize("direction", DIRECTIONS, ids=str)
def test_position_error_of_a_touch_is_reported(direction: np.ndarray) -> None:
    _, _, tip = touch_wall(1e-3)
    found = get_only_violation(
        judge_touch(1e-3, [vkc.Touch("stick.tip", tip + 1.5e-3 * direction)])
    )
    assert (found.constraint, found.subject, found.unit) == ("goal", "stick.tip", "m")
    assert found.amount == pytest.approx(0.5e-3, abs=1e-8)
    assert judge_touch(1e-3, [vkc.Touch("stick.tip", tip + 0.9e-3 * direction)]).ok


def test_orientation_error_of_a_touch_is_reported() -> None:
    _, _, tip = touch_wall(1e-3)
    looking = pin.SE3(pin.utils.rotate("x", -np.pi / 2), tip)  # z along y, like the stick
    assert judge_touch(1e-3, [vkc.Touch("stick.tip", looking)]).ok
    turned = looking * pin.SE3(pin.exp3(np.array([0.0, 0.0, 0.01])), np.zeros(3))
    found = get_only_violation(judge_touch(1e-3, [vkc.Touch("stick.tip", turned)]))
    assert (found.constraint, found.subject, found.unit) == ("goal", "stick.tip", "rad")
    assert found.amount == pytest.approx(9e-3, abs=1e-6)
    far, there, _ = touch_wall(0.1)
    tool = far.with_start(base=there.rows[20][:3]).tool_placement()
    assert judge(far, [vkc.Touch("tool", tool), vkc.GoTo(0.0, 0.0)], there.motion()).ok
    assert get_violation_names(
        judge(far, [vkc.Touch("tool", tool * looking), vkc.GoTo(0.0, 0.0)], there.motion())
    ) == {("goal", "tool")}


def test_touch_must_hold_at_a_phase_end() -> None:
    scene, script, _ = touch_wall(1e-3)
    passed = compute_tip_position(scene, script.rows[10])
    report = judge_touch(1e-3, [vkc.Touch("stick.tip", passed)])
    assert {v.subject for v in report.violations if v.constraint == "goal"} == {"stick.tip"}


def test_free_objects_may_be_touched() -> None:
    beside = pin.SE3(STICK.rotation, BALL.translation - np.array([0.0, 0.285, 0.0]))
    there = solve_reach(compute_grasp_pose(beside), solve_above(STICK))
    start = move_base(there, y=-0.1)
    scene = (
        make_room(describe_stand(), objects=("stick", "ball"))
        .with_held({"stick": "grip"})
        .with_start(base=start[:3], arm=start[3:])
    )
    motion = MotionBuilder(scene).go(there).motion()
    contact = BALL.translation - np.array([0.0, 0.035, 0.0])
    report = judge(scene, [vkc.Touch("stick.tip", contact)], motion)
    assert report.ok, "\n".join(report.lines())
    assert get_violation_names(judge(scene, [vkc.GoTo(0.0, 0.0)], motion)) & {
        ("clearance", "stick.tip – ball.ball"),
        ("penetration", "stick.tip – ball.ball"),
    }


@pytest.mark.parametrize(
    ("gap", "ok"),
    [(0.01, True), (1e-3, True), (0.0, True), (-5e-5, True), (-2e-4, False), (-1e-3, False)],
)
def test_object_may_rest_on_a_table_but_not_penetrate_it(gap: float, ok: bool) -> None:
    scene = make_room(describe_table(gap=gap))
    report = judge(scene, [PLACED], make_carrying_motion(scene).motion())
    assert report.ok == ok, "\n".join(report.lines())
    if not ok:
        found = get_only_violation(report)
        assert (found.constraint, found.subject) == ("penetration", "stick.stick – table")
        assert found.amount == pytest.approx(-gap, abs=1e-6)


def test_only_supports_may_be_close() -> None:
    down = solve_reach(compute_grasp_pose(STICK), solve_above(STICK))
    passing = (
        MotionBuilder(make_hall())
        .go(down)
        .take("stick")
        .go(np.array(make_hall().start))
        .go(move_base(make_hall().start, y=1.0))
    )
    passing.go(move_base(down, y=1.0)).let_go().go(move_base(make_hall().start, y=1.0))
    motion, steps = passing.motion(), [vkc.Place("stick", lift(STICK, [0.0, 1.0, 0.0]))]
    assert judge(make_hall(), steps, motion).ok
    shelf = describe_box(
        "shelf", [0.1, 0.2, 0.1], [0.8, 0.6, 0.7 - 0.05 - 0.01]
    )  # the discs' lowest points pass at 0.7
    report = judge(make_room(describe_table(), shelf), steps, motion)
    assert get_violation_names(report) == {("clearance", "stick.stick – shelf")}
    assert get_only_violation(report).amount == pytest.approx(0.01 - 1e-3, abs=1e-4)


def test_neighbour_at_the_grasp_may_be_close_but_not_penetrated() -> None:
    fence = describe_box("fence", [0.6, 0.001, 0.1], [0.8, 0.262, 0.56])
    scene = make_room(describe_table(), fence)
    down = solve_reach(compute_grasp_pose(STICK), solve_above(STICK))
    through = MotionBuilder(scene).go(down).take("stick").go(move_base(down, y=0.6)).motion()
    report = judge(scene, [vkc.GoTo(0.0, 0.6)], through)
    assert {
        ("penetration", "stick.tip – fence"),
        ("penetration", "stick.stick – fence"),
    } <= get_violation_names(report)
    over = (
        MotionBuilder(scene)
        .go(down)
        .take("stick")
        .go(np.array(scene.start))
        .go(move_base(scene.start, y=0.6))
        .motion()
    )
    assert judge(scene, [vkc.GoTo(0.0, 0.6)], over).ok


def test_grasped_object_must_not_hit_the_floor() -> None:
    hanging = pin.utils.rotate("x", -np.pi / 2)  # the stick's y points down
    heights = (0.3, 0.24)  # of the stick's middle, 0.25 m above its tip
    rows = [
        solve_reach(
            compute_grasp_pose(pin.SE3(hanging, np.array([0.9, 0.0, z])), values=(0.0, 0.0))
        )
        for z in heights
    ]
    rows[1] = solve_reach(
        compute_grasp_pose(pin.SE3(hanging, np.array([0.9, 0.0, heights[1]]))), rows[0]
    )
    scene = make_room().with_held({"stick": "grip"}).with_start(arm=rows[0][3:])
    motion = MotionBuilder(scene).go(rows[1]).motion()
    report = judge(scene, [vkc.GoTo(0.0, 0.0)], motion)
    found = next(v for v in report.violations if v.subject.endswith(" – floor"))
    assert (found.constraint, found.subject) == ("penetration", "stick.tip – floor")
    assert found.amount == pytest.approx(0.01, abs=1e-5)
    assert found.waypoint == len(motion.times) - 1
    higher = (
        MotionBuilder(scene)
        .go(solve_reach(compute_grasp_pose(pin.SE3(hanging, np.array([0.9, 0.0, 0.275]))), rows[0]))
        .motion()
    )
    assert not {
        v.subject
        for v in judge(scene, [vkc.GoTo(0.0, 0.0)], higher).violations
        if "floor" in v.subject
    }


def test_grasped_object_must_not_hit_the_robot() -> None:
    scene = make_room().with_held({"stick": "grip"})
    bent = np.array(scene.start)
    bent[6] -= 2.36  # bends the wrist until the stick hits the forearm
    report = judge(scene, [vkc.GoTo(0.0, 0.0)], MotionBuilder(scene).go(bent).motion())
    assert get_violation_names(report) == {("penetration", "forearm_link – stick.stick")}
    assert judge(
        make_room(), [vkc.GoTo(0.0, 0.0)], MotionBuilder(make_room()).go(bent).motion()
    ).ok  # the robot alone


def test_grasped_object_must_not_hit_free_objects() -> None:
    scene = make_room(describe_stand(), objects=("stick", "ball")).with_held({"stick": "grip"})
    start = solve_reach(
        compute_grasp_pose(pin.SE3(STICK.rotation, BALL.translation - np.array([0.0, 0.4, 0.0]))),
        solve_above(STICK),
    )
    scene = scene.with_start(arm=start[3:])
    for forward, constraint in ((0.08, None), (0.1, "clearance"), (0.125, "penetration")):
        motion = MotionBuilder(scene).go(move_base(start, y=forward)).motion()
        report = judge(scene, [vkc.GoTo(0.0, forward)], motion)
        assert get_violation_names(report) == (
            {(constraint, "stick.tip – ball.ball")} if constraint else set()
        ), "\n".join(report.lines())


def test_fingers_must_not_penetrate_the_grasped_object() -> None:
    """The grasp is 3 cm deeper in the hand, so that the palm overlaps the stick."""
    deep = replace_grasp(make_hall(), "stick", "grip", standoff=-0.03)
    up = solve_reach(
        compute_grasp_pose(lift(STICK)) * pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.04])),
        solve_above(STICK),
    )
    scene = deep.with_held({"stick": "grip"}).with_start(arm=up[3:])
    report = judge(
        scene, [vkc.GoTo(0.0, 0.3)], MotionBuilder(scene).go(move_base(up, y=0.3)).motion()
    )
    assert {v.constraint for v in report.violations} == {"penetration"}
    assert {v.subject.split(" – ")[0] for v in report.violations} <= set(
        make_hall().robot.touch_links
    )
    assert {v.subject.split(" – ")[1] for v in report.violations} == {"stick.stick"}


@cache
def fetch_ball(off: float = 0.0) -> MotionBuilder:
    """Move the tip to `off` [m] in front of the ball, and carry the ball to the second stand."""
    scene = make_room(
        describe_stand(), describe_stand("stand_2", aside=0.3), objects=("stick", "ball")
    )
    beside = pin.SE3(STICK.rotation, BALL.translation - np.array([0.0, 0.285 + off, 0.0]))
    touch = solve_reach(compute_grasp_pose(beside), solve_above(STICK))
    up = solve_reach(compute_grasp_pose(lift(beside, UP / 4)), touch)
    start = move_base(touch, y=-0.1)
    scene = scene.with_held({"stick": "grip"}).with_start(base=start[:3], arm=start[3:])
    script = (
        MotionBuilder(scene)
        .go(touch)
        .take("ball", "pull", (np.pi / 2, 0.0, 0.0), by="stick.tip")
        .go(up)
    )
    script.go(move_base(up, y=0.3)).go(move_base(touch, y=0.3)).let_go("ball")
    return script.go(move_base(touch, y=0.26))


FETCHED = vkc.Place("ball", lift(BALL, [0.0, 0.3, 0.0]))


def test_position_error_of_a_grasp_by_a_tool_is_reported() -> None:
    report = judge(fetch_ball(2e-3).scene, [FETCHED], fetch_ball(2e-3).motion())
    found = get_only_violation(report)
    assert (found.constraint, found.subject, found.unit) == ("closure", "ball.pull", "m")
    assert found.amount == pytest.approx(1e-3, abs=1e-8)
    grasped = judge(
        fetch_ball(2e-3).scene,
        [vkc.Grasp("ball", "pull", "stick.tip"), FETCHED],
        fetch_ball(2e-3).motion(),
    )
    assert ("goal", "ball.pull") in get_violation_names(grasped)
    by_hand = judge(fetch_ball().scene, [vkc.Grasp("ball", "pull"), FETCHED], fetch_ball().motion())
    assert ("goal", "ball.pull") in get_violation_names(
        by_hand
    )  # the hand itself never reaches the ball


def test_tool_must_not_penetrate_the_grasped_object() -> None:
    assert judge(fetch_ball(-5e-5).scene, [FETCHED], fetch_ball(-5e-5).motion()).ok
    report = judge(fetch_ball(-5e-4).scene, [FETCHED], fetch_ball(-5e-4).motion())
    assert get_violation_names(report) == {("penetration", "stick.tip – ball.ball")}


def test_object_grasped_by_a_tool_requires_the_tool() -> None:
    ball = Hold("ball", "pull", Hold("stick", "grip"), "tip")
    with pytest.raises(InputError, match="held through an object that is not held"):
        PhaseSpan("no stick", 0, 1, (ball,))
    data = fetch_ball().motion().to_dict()
    data["phases"][2] |= {"held": {"ball": "pull"}, "by": {"ball": "stick.tip"}}
    with pytest.raises(UnknownNameError) as caught:
        Trajectory.from_dict(data)
    assert caught.value.field == "by"


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
def test_steps_with_unknown_names_are_refused(step: object, field: str, nearest: str) -> None:
    with pytest.raises(UnknownNameError) as caught:
        judge(make_hall(), [step], make_carrying_motion(make_hall()).motion())
    assert (caught.value.field, caught.value.nearest) == (field, nearest)


def test_trajectories_with_missing_columns_or_frames_are_refused() -> None:
    full = make_carrying_motion(make_hall()).motion()
    names = tuple(name for name in full.names if name != "stick.grip_slide")
    columns = [full.names.index(name) for name in names]
    incomplete = Trajectory(
        names, full.times, full.positions[:, columns], full.phases, full.robot_size
    )
    with pytest.raises(InputError, match="missing") as caught:
        judge(make_hall(), [PLACED], incomplete)
    assert caught.value.expected == "stick.grip_slide"
    script = fetch_ball()
    data = script.motion().to_dict()
    for phase in data["phases"]:
        phase["by"] = dict.fromkeys(phase["by"], "stick.tap")
    with pytest.raises(UnknownNameError) as unknown:
        judge(script.scene, [FETCHED], Trajectory.from_dict(data))
    assert (unknown.value.field, unknown.value.nearest) == ("trajectory.phases[1].by", "tip")
