"""Tests that validation accepts valid transport of free objects and reports each violation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

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
    solve_grasp,
    solve_reach,
)
from helpers.judging import check_only_violation, get_violation_names

import vkc_pin as vkc
from vkc_pin import (
    Hold,
    InputError,
    PhaseSpan,
    Report,
    Scene,
    Trajectory,
    UnknownNameError,
    validate,
)
from vkc_pin.world.task.steps import Step

ASIDE = lift(STICK, [0.0, 0.5, 0.0])
PLACED = vkc.Place("stick", ASIDE)
DIRECTIONS = np.diag([1.0, -1.0, 1.0])


@cache
def make_hall() -> Scene:
    return make_room(describe_table())


def judge(
    steps: Sequence[Step], motion: MotionBuilder | Trajectory, scene: Scene | None = None
) -> Report:
    """Validate a motion without time for the gripper, and with short time steps."""
    if isinstance(motion, MotionBuilder):
        scene, motion = scene or motion.scene, motion.motion()
    return validate(scene or make_hall(), steps, motion, vkc.Options(dt=0.05, grasp_time=1e-6))


def carry(**changes: Any) -> MotionBuilder:
    """Carry the stick aside on the table of the hall."""
    return make_carrying_motion(make_hall(), **changes)


def make_error(unit: str, vector: np.ndarray) -> pin.SE3:
    """Return a shift [m] or a turn [rad]."""
    shift, turn = (vector, np.zeros(3)) if unit == "m" else (np.zeros(3), vector)
    return pin.SE3(pin.exp3(turn), shift)


@pytest.mark.parametrize("values", [(0.0, 0.0), (0.06, 0.0), (-0.05, 0.3), (0.09, -0.3)])
def test_pick_and_place_is_valid(values: tuple[float, float]) -> None:
    motion = carry(values=values).motion()
    for steps in (
        [PLACED],
        [vkc.Place("stick", ASIDE.translation)],
        [vkc.Grasp("stick"), PLACED],
        [vkc.Grasp("stick", "grip"), PLACED, vkc.GoTo(0.0, 0.5)],
        [vkc.Grasp("stick"), vkc.Release()],
        [vkc.Grasp("stick"), vkc.Release("stick"), vkc.GoTo(0.0, 0.5, 0.0)],
    ):
        report = judge(steps, motion)
        assert report.ok, report.lines()
        assert report.closure_error < 1e-9
        assert report.clearance == pytest.approx(1e-3, abs=1e-6)  # of the discs above the table


def test_object_grasped_at_the_start_may_leave_its_support_within_a_second() -> None:
    up, down = solve_above(STICK), solve_grasp()
    for gap in (1e-3, 0.0, -2e-3):
        held = (
            make_room(describe_table(gap=gap))
            .with_start(base=down[:3], arm=down[3:])
            .with_held({"stick": "grip"})
        )
        report = judge([vkc.GoTo(0.0, 0.5)], MotionBuilder(held).go(up).go(move_base(up, y=0.5)))
        assert report.ok, report.lines()
        late = MotionBuilder(held).go(move_base(down, y=0.1), steps=60).go(up)
        late.go(move_base(up, y=0.5))
        constraint = "penetration" if gap < 0.0 else "clearance"
        assert get_violation_names(judge([vkc.GoTo(0.0, 0.5)], late)) == {
            (constraint, "stick.stick – table")
        }


def test_fetching_with_a_tool_is_valid() -> None:
    for steps in (
        [vkc.Place("ball", lift(BALL, [0.0, 0.3, 0.0]))],
        [vkc.Grasp("ball", "pull", "stick.tip"), vkc.Place("ball", lift(BALL, [0.0, 0.3, 0.0]))],
        [vkc.Grasp("ball", by="stick.tip"), vkc.Release("ball")],
    ):
        report = judge(steps, fetch_ball())
        assert report.ok, report.lines()


@pytest.mark.parametrize("unit", ["m", "rad"])
@pytest.mark.parametrize("direction", DIRECTIONS, ids=str)
def test_error_of_a_grasp_is_reported(direction: np.ndarray, unit: str) -> None:
    motion = carry(off=make_error(unit, 2e-3 * direction)).motion()
    report = judge([PLACED], motion)
    amount = pytest.approx(1e-3, abs=1e-6)
    found = check_only_violation(report, "closure", "stick.grip", unit, amount=amount)
    assert found.waypoint >= motion.phases[2].first
    largest = report.closure_error if unit == "m" else report.closure_angle
    assert largest == pytest.approx(2e-3, abs=1e-6)
    grasped = judge([vkc.Grasp("stick"), PLACED], motion)
    assert get_violation_names(grasped) == {("closure", "stick.grip"), ("goal", "stick.grip")}
    within = carry(off=make_error(unit, 9e-4 * direction)).motion()
    assert judge([vkc.Grasp("stick"), PLACED], within).ok


def test_grasp_coordinates_must_match_the_tool() -> None:
    script = carry(values=(0.05, 0.0))
    for column, value, unit in (
        ("stick__grip_slide", 0.053, "m"),
        ("stick__grip_turn", 0.01, "rad"),
    ):
        report = judge([PLACED], script.motion(**{column: np.full(len(script.rows), value)}))
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
    assert ("limit", subject) in get_violation_names(judge([vkc.GoTo(0.0, 0.5)], script))


def make_slide(script: MotionBuilder, *, begin: int, end: int, by: float) -> np.ndarray:
    """Return a column that changes by `by` between two waypoints and is constant otherwise."""
    return by * np.interp(np.arange(len(script.rows)), [begin, end], [0.0, 1.0])


@pytest.mark.parametrize(
    ("column", "by", "unit"),
    [("grip_slide", 0.02, "m"), ("grip_turn", -0.1, "rad"), ("grip_slide", 2e-5, "m")],
)
def test_firm_grasps_must_not_slide(column: str, by: float, unit: str) -> None:
    script = carry()
    phase = script.phases[3]  # half-way, in the air
    motion = script.motion(
        **{f"stick__{column}": make_slide(script, begin=phase.first + 3, end=phase.last - 3, by=by)}
    )
    report = judge([vkc.Release()], motion)
    found = next(v for v in report.violations if v.constraint == "slide")
    assert get_violation_names(report) <= {
        ("slide", f"stick.{column}"),
        ("penetration", "stick.stick – table"),
    }
    assert (found.subject, found.unit) == (f"stick.{column}", unit)
    assert found.amount == pytest.approx(abs(by))
    assert phase.first < found.waypoint <= phase.last
    # The hand follows the coordinates, so that closure does not show the slide.
    assert report.closure_error < 1e-9
    loose = replace_grasp(make_hall(), "stick", "grip", firm=False)
    assert "slide" not in {v.constraint for v in judge([vkc.Release()], motion, loose).violations}


def test_grasp_coordinates_are_free_before_and_after_the_grasp() -> None:
    script = carry()
    first, last = script.phases[2].first, script.phases[4].last
    for begin, end, slides in (
        (0, first - 1, False),
        (first, first + 1, True),
        (last - 1, last, True),
        (last, last + 1, False),
    ):
        slide = make_slide(script, begin=begin, end=end, by=0.01)
        motion = script.motion(stick__grip_slide=slide - slide[first])
        report = judge([vkc.Release()], motion)
        assert ("slide" in {v.constraint for v in report.violations}) == slides
        assert report.ok != slides, report.lines()


@pytest.mark.parametrize("unit", ["m", "rad"])
@pytest.mark.parametrize("direction", DIRECTIONS, ids=str)
def test_pose_error_of_a_placed_object_is_reported(direction: np.ndarray, unit: str) -> None:
    goal = vkc.Place("stick", ASIDE * make_error(unit, 2e-3 * direction))
    motion = carry().motion()
    fields = {"amount": pytest.approx(1e-3, abs=1e-8), "waypoint": motion.phases[-1].last}
    check_only_violation(judge([goal], motion), "goal", "stick.stick", unit, **fields)


@pytest.mark.parametrize(
    ("axis", "wrong"), [(0, True), (1, True), (2, False)], ids=["tilted", "rolled", "turned"]
)
def test_placing_at_a_point_leaves_only_the_heading_free(axis: int, wrong: bool) -> None:
    scene = make_room(describe_table(gap=0.03))  # an end may hang down
    put = pin.SE3(pin.exp3(0.02 * np.eye(3)[axis]) @ STICK.rotation, ASIDE.translation)
    up, down = solve_above(STICK), solve_grasp()
    there = solve_reach(compute_grasp_pose(put), move_base(down, y=0.5))
    script = MotionBuilder(scene).go(up).go(down).take("stick").go(up).go(there).let_go()
    motion = script.go(move_base(up, y=0.5)).motion()
    assert judge([vkc.Place("stick", put, unsupported=True)], motion, scene).ok
    report = judge([vkc.Place("stick", ASIDE.translation, unsupported=True)], motion, scene)
    if wrong:
        amount = pytest.approx(0.02 - 1e-3, abs=1e-7)
        check_only_violation(report, "goal", "stick.stick", "rad", amount=amount)
    else:
        assert report.ok, report.lines()


def test_object_grasped_at_the_start_is_placed_upright() -> None:
    slanted = pin.SE3(pin.exp3(np.array([0.5, 0.2, 0.0])), np.array([0.8, 0.0, 0.75]))
    start = solve_reach(compute_grasp_pose(slanted), GUESS)
    held = make_room().with_held({"stick": "grip"}).with_start(arm=start[3:])
    level = MotionBuilder(held).go(solve_reach(compute_grasp_pose(lift(STICK)), start))
    goal = vkc.Place("stick", lift(STICK).translation, unsupported=True)
    report = judge([goal], level.let_go().wait())
    assert report.ok, report.lines()
    script = MotionBuilder(held).go(move_base(held.start, x=-0.5, yaw=1.2)).let_go().wait()
    there = held.with_start(base=script.rows[-1][:3]).objects["stick"].placement
    report = judge([vkc.Place("stick", there.translation, unsupported=True)], script)
    amount = pytest.approx(np.arccos(slanted.rotation[2, 2]) - 1e-3, abs=1e-6)
    check_only_violation(report, "goal", "stick.stick", "rad", amount=amount)


def test_object_placed_at_a_point_may_stay_upside_down() -> None:
    turned = pin.SE3(pin.utils.rotate("y", np.pi), ASIDE.translation)
    scene = place_object(make_hall(), "stick", turned)
    stands = MotionBuilder(scene).go(move_base(scene.start, x=-0.5))
    assert judge([vkc.Place("stick", ASIDE.translation)], stands).ok
    amount = pytest.approx(np.pi - 1e-3, abs=1e-6)
    check_only_violation(judge([PLACED], stands), "goal", "stick.stick", "rad", amount=amount)


def test_object_must_be_released() -> None:
    script = carry()
    script.phases[5] = PhaseSpan(
        "stay", script.phases[4].last, script.phases[4].last + 2, script.phases[4].holds
    )
    del script.rows[script.phases[5].last + 1 :]
    script.rows[-2:] = [script.rows[-3]] * 2
    motion = script.motion()
    for steps in ([PLACED], [vkc.Grasp("stick"), vkc.Release()], [vkc.Release("stick")]):
        close, held = judge(steps, motion).violations
        assert (close.constraint, close.subject) == ("clearance", "stick.stick – table")
        assert (held.constraint, held.subject) == ("goal", "stick")
        assert "still grasped" in held.detail


def test_placed_object_must_not_be_moved_again() -> None:
    script = carry()
    down = script.rows[script.phases[4].last]
    script.go(down).take("stick").go(move_base(down, y=-0.3)).let_go()
    motion = script.go(move_base(solve_above(STICK), y=0.2)).motion()
    further = vkc.Place("stick", lift(STICK, [0.0, 0.2, 0.0]))
    assert judge([PLACED, further], motion).ok
    assert ("goal", "stick.stick") in get_violation_names(judge([PLACED], motion))
    assert ("goal", "stick.stick") in get_violation_names(judge([further, PLACED], motion))
    end = vkc.GoTo(*map(float, motion.positions[-1, :2]))
    check_only_violation(judge([PLACED, end], motion), "order", "step 1")


def test_object_must_not_be_moved_before_its_step() -> None:
    script = carry()
    motion = script.go(move_base(make_hall().start, y=1.0)).motion()
    assert judge([PLACED, vkc.GoTo(0.0, 1.0)], motion).ok
    back = carry().motion()
    (x, y) = back.positions[-1, :2]
    assert get_violation_names(judge([vkc.GoTo(float(x), float(y)), PLACED], back)) == {
        ("order", "stick")
    }


def test_grasped_object_must_stay_grasped() -> None:
    motion = carry().motion()
    goto = vkc.GoTo(*map(float, motion.positions[-1, :2]))
    assert judge([vkc.Grasp("stick"), vkc.Release(), goto], motion).ok
    report = judge([vkc.Grasp("stick"), goto], motion)
    found = check_only_violation(report, "goal", "stick")
    assert "not grasped" in found.detail


def test_grasp_steps_may_end_the_motion() -> None:
    up = solve_above(STICK)
    motion = MotionBuilder(make_hall()).go(up).go(solve_grasp()).motion()
    grasp, here = vkc.Grasp("stick"), vkc.GoTo(*map(float, motion.positions[-1, :2]))
    for steps in ([grasp], [grasp, grasp], [here, grasp, grasp]):
        assert judge(steps, motion).ok, steps
    check_only_violation(judge([grasp, grasp, here], motion), "goal", "stick")


@cache
def touch_wall(gap: float = 0.0) -> tuple[MotionBuilder, np.ndarray]:
    """Return motion and position of a touch, `gap` [m] in front of a wall."""
    held = make_room().with_held({"stick": "grip"})
    there = move_base(held.start, y=0.4)
    tip = np.array(
        held.with_start(base=there[:3]).objects["stick"].link_placement("tip").translation
    )
    wall = describe_box("wall", [0.3, 0.1, 0.3], tip + np.array([0.0, gap + 0.05, 0.0]))
    scene = make_room(wall).with_held({"stick": "grip"})
    return MotionBuilder(scene).go(there).go(np.array(scene.start)), tip


def judge_touch(gap: float, steps: Sequence[vkc.Touch | vkc.GoTo]) -> Report:
    return judge([*steps, vkc.GoTo(0.0, 0.0)], touch_wall(gap)[0])


@pytest.mark.parametrize("gap", [0.0, -5e-5, 1e-3, -1e-3])
def test_touch_permits_contact_but_no_penetration(gap: float) -> None:
    script, tip = touch_wall(gap)
    report = judge_touch(gap, [vkc.Touch("stick.tip", tip)])
    if gap < -1e-4:
        time, amount = script.motion().times[20], pytest.approx(-gap, abs=1e-6)
        check_only_violation(report, "penetration", "stick.tip – wall", time=time, amount=amount)
    else:
        assert report.ok, report.lines()
    without_touch = get_violation_names(judge_touch(gap, [vkc.GoTo(0.0, 0.4)]))
    assert {subject for _, subject in without_touch} == {"stick.tip – wall"}


def test_touch_permits_contact_of_its_link_only() -> None:
    _, tip = touch_wall(0.0)
    report = judge_touch(-0.03, [vkc.Touch("stick.stick", tip - np.array([0.0, 0.25, 0.0]))])
    assert ("penetration", "stick.tip – wall") in get_violation_names(report)


@pytest.mark.parametrize("direction", DIRECTIONS, ids=str)
def test_position_error_of_a_touch_is_reported(direction: np.ndarray) -> None:
    _, tip = touch_wall(1e-3)
    report = judge_touch(1e-3, [vkc.Touch("stick.tip", tip + 1.5e-3 * direction)])
    amount = pytest.approx(0.5e-3, abs=1e-8)
    check_only_violation(report, "goal", "stick.tip", "m", amount=amount)
    assert judge_touch(1e-3, [vkc.Touch("stick.tip", tip + 0.9e-3 * direction)]).ok


def test_orientation_error_of_a_touch_is_reported() -> None:
    _, tip = touch_wall(1e-3)
    looking = pin.SE3(pin.utils.rotate("x", -np.pi / 2), tip)  # z along y, like the stick
    assert judge_touch(1e-3, [vkc.Touch("stick.tip", looking)]).ok
    turned = looking * make_error("rad", np.array([0.0, 0.0, 0.01]))
    check_only_violation(
        judge_touch(1e-3, [vkc.Touch("stick.tip", turned)]),
        "goal",
        "stick.tip",
        "rad",
        amount=pytest.approx(9e-3, abs=1e-6),
    )
    there, _ = touch_wall(0.1)
    tool = there.scene.with_start(base=there.rows[20][:3]).tool_placement()
    assert judge([vkc.Touch("tool", tool), vkc.GoTo(0.0, 0.0)], there).ok
    assert get_violation_names(
        judge([vkc.Touch("tool", tool * looking), vkc.GoTo(0.0, 0.0)], there)
    ) == {("goal", "tool")}


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
    report = judge([vkc.Touch("stick.tip", contact)], motion, scene)
    assert report.ok, report.lines()
    assert get_violation_names(judge([vkc.GoTo(0.0, 0.0)], motion, scene)) & {
        ("clearance", "stick.tip – ball.ball"),
        ("penetration", "stick.tip – ball.ball"),
    }


@pytest.mark.parametrize(
    ("gap", "ok"),
    [(2e-3, True), (1e-3, True), (0.0, True), (-5e-5, True), (-2e-4, False), (-1e-3, False)],
)
def test_object_may_rest_on_a_table_but_not_penetrate_it(gap: float, ok: bool) -> None:
    scene = make_room(describe_table(gap=gap))
    report = judge([PLACED], make_carrying_motion(scene))
    assert report.ok == ok, report.lines()
    if not ok:
        amount = pytest.approx(-gap, abs=1e-6)
        check_only_violation(report, "penetration", "stick.stick – table", amount=amount)


def test_grasped_object_must_not_hit_the_robot() -> None:
    scene = make_room().with_held({"stick": "grip"})
    bent = np.array(scene.start)
    bent[6] -= 2.36  # bends the wrist until the stick hits the forearm
    report = judge([vkc.GoTo(0.0, 0.0)], MotionBuilder(scene).go(bent))
    assert get_violation_names(report) == {("penetration", "forearm_link – stick.stick")}
    assert judge([vkc.GoTo(0.0, 0.0)], MotionBuilder(make_room()).go(bent)).ok  # the robot alone


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
    report = judge([FETCHED], fetch_ball(2e-3))
    check_only_violation(report, "closure", "ball.pull", "m", amount=pytest.approx(1e-3, abs=1e-8))
    assert report.closure_error == pytest.approx(2e-3, abs=1e-8)  # although the last hold is exact
    grasped = judge(
        [vkc.Grasp("ball", "pull", "stick.tip"), FETCHED],
        fetch_ball(2e-3),
    )
    assert ("goal", "ball.pull") in get_violation_names(grasped)
    by_hand = judge([vkc.Grasp("ball", "pull"), FETCHED], fetch_ball())
    # The hand itself never reaches the ball.
    assert ("goal", "ball.pull") in get_violation_names(by_hand)


def test_tool_must_not_penetrate_the_grasped_object() -> None:
    assert judge([FETCHED], fetch_ball(-5e-5)).ok
    report = judge([FETCHED], fetch_ball(-5e-4))
    assert get_violation_names(report) == {("penetration", "stick.tip – ball.ball")}


def test_object_grasped_by_a_tool_requires_the_tool() -> None:
    ball = Hold("ball", "pull", Hold("stick", "grip"), "tip")
    with pytest.raises(InputError, match="held through an object that is not held"):
        PhaseSpan("no stick", 0, 1, (ball,))
    script = fetch_ball()
    data = script.motion().to_dict()
    for phase in data["phases"]:
        phase["by"] = dict.fromkeys(phase["by"], "stick.tap")
    with pytest.raises(UnknownNameError) as unknown:
        judge([FETCHED], Trajectory.from_dict(data), script.scene)
    assert (unknown.value.field, unknown.value.nearest) == ("trajectory.phases[1].by", "tip")
    data["phases"][2] |= {"held": {"ball": "pull"}, "by": {"ball": "stick.tip"}}
    with pytest.raises(UnknownNameError) as caught:
        Trajectory.from_dict(data)
    assert caught.value.field == "by"
