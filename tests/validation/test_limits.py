"""Tests checks of rates, torques and wheels against their limits, and limiting constraints."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.door_closers import load_door_with_closer, replace_object_fields
from helpers.drives import drive_through, make_hall, make_trajectory, move_start
from helpers.executions import make_grasping_scene, make_stationary_motion, plan_door, plan_drawer
from helpers.judging import check_only_violation, get_violation_names
from oracle.judge import judge

import vkc_pin as vkc
from vkc_pin import PhaseSpan, Report, Scene, Trajectory, Violation, validate
from vkc_pin.planning.retiming.retime import retime_trajectory
from vkc_pin.validation.limits import (
    TORQUE_TOLERANCE,
    MotorLoads,
    check_rates,
    find_limiting_constraints,
)
from vkc_pin.validation.samples import Samples
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.torques import sample_curve


@pytest.mark.parametrize("make_plan", [plan_door, plan_drawer])
def test_motion_is_at_its_limits_in_reported_intervals(make_plan: object) -> None:
    plan: vkc.Plan = make_plan()  # type: ignore[operator]
    motion, samples = plan.trajectory, Samples(plan.scene, plan.trajectory)
    found = plan.report.bounds
    assert 0.9 < sum(bound.share for bound in found) <= 1.0 + 1e-9
    assert [bound.share for bound in found] == sorted(
        (bound.share for bound in found), reverse=True
    )
    assert len({(bound.subject, bound.kind) for bound in found}) == len(found)
    for bound in found:
        assert 0.0 <= bound.begin < bound.end <= motion.times[-1] + 1e-9
        times = np.linspace(bound.begin, bound.end, 400)
        if bound.kind == "rest":
            np.testing.assert_allclose(motion.velocity(times), 0.0, atol=1e-9)
        elif bound.share > 0.1:
            evaluate, column = {
                "velocity": (motion.velocity, 2),
                "acceleration": (motion.acceleration, 3),
            }[bound.kind]
            values = np.abs(evaluate(times)[:, motion.names.index(bound.subject)])
            assert values.max() > 0.9 * samples.get_limits(bound.subject)[column]


def test_longest_interval_is_reported() -> None:
    plan = plan_door()
    samples, curve = Samples(plan.scene, plan.trajectory), plan.trajectory.curve
    assert curve is not None
    moments, pieces = sample_curve(curve), len(curve.times) - 1
    for longest in ((0, 30), (20, 50), (pieces - 30, pieces)):
        parts = [(0, 5), longest, (pieces - 5, pieces)]
        torques = np.zeros((len(moments.times), plan.trajectory.robot_size))
        for begin, end in parts:
            torques[(moments.pieces >= begin) & (moments.pieces < end), 4] = 50.0
        bounds = find_limiting_constraints(samples, moments, torques, 0.0)
        (found,) = [bound for bound in bounds if bound.kind == "torque"]
        assert max(parts, key=lambda part: curve.times[part[1]] - curve.times[part[0]]) == longest
        begin, end = (curve.times[k] for k in longest)
        assert (found.subject, found.begin, found.end) == ("shoulder_lift_joint", begin, end)


def find_violations(motion: Trajectory, **options: float) -> dict[tuple[str, str], Violation]:
    rows = check_rates(
        Samples(plan_drawer().scene, motion),
        plan_drawer().steps,
        vkc.Options(**options),  # type: ignore[arg-type]
    )
    return {(row.constraint, row.unit): row for row in rows if row.subject == "elbow_joint"}


def retime_smoothly() -> Trajectory:
    plan = plan_drawer()
    return retime_trajectory(plan.scene, plan.trajectory, jerk_time=0.2)


def test_jerk_violation_is_reported() -> None:
    motion = retime_smoothly()
    assert not find_violations(motion, jerk_time=0.2)
    assert not find_violations(motion)
    assert not find_violations(plan_drawer().trajectory)
    ((kind, found),) = find_violations(motion, jerk_time=1.0).items()
    assert kind == ("jerk", "rad/s³")
    assert motion.curve is not None
    strongest = motion.curve.compute_jerks()[0][:, motion.names.index("elbow_joint")].max()
    assert found.amount == pytest.approx(strongest - 1.4 / 1.0)


def move_elbow(share: float) -> Trajectory:
    """Move the elbow by one cubic, with `share` of its largest acceleration, 1.4 rad/s²."""
    plan = plan_drawer()
    motion, elbow = plan.trajectory, plan.trajectory.names.index("elbow_joint")
    rows = np.tile(motion.positions[0], (2, 1))
    rows[1, elbow] += share * 1.4 / 6.0 * 2.0**2  # 3s² − 2s³ in 2 s has 6 / 2² at its ends
    times = np.array([0.0, 2.0])
    curve = Curve(times, rows, np.zeros_like(rows))
    return Trajectory(
        motion.names, times, rows, (PhaseSpan("move", 0, 1),), motion.robot_size, curve
    )


@pytest.mark.parametrize(
    ("share", "kinds"), [(1.0005, set()), (1.0015, {"acceleration"}), (0.5, set())]
)
def test_rates_within_the_tolerance_are_accepted(share: float, kinds: set[str]) -> None:
    assert {kind for kind, _ in find_violations(move_elbow(share))} == kinds


@pytest.mark.parametrize(("speed", "rests"), [(0.9e-6, True), (1.5e-6, False)])
@pytest.mark.parametrize("end", [0, -1])
def test_motion_must_begin_and_end_at_rest(speed: float, rests: bool, end: int) -> None:
    motion = move_elbow(0.1)
    assert motion.curve is not None
    rates = motion.curve.rates.copy()
    rates[end, motion.names.index("elbow_joint")] = speed
    curve = Curve(motion.curve.times, motion.curve.positions, rates)
    rows = find_violations(replace(motion, curve=curve))
    assert (not rows) == rests
    if not rests:
        (row,) = rows.values()
        assert (row.constraint, row.waypoint) == ("velocity", 0 if end == 0 else 1)


def test_acceleration_jumps_are_reported() -> None:
    motion = plan_drawer().trajectory
    assert motion.curve is not None
    jumps = motion.curve.compute_jerks()[1][:, motion.names.index("elbow_joint")]
    violation = find_violations(motion, jerk_time=0.005)["jerk", "rad/s² at once"]
    assert violation.amount == pytest.approx(jumps.max() - 1.4e-3)
    at = motion.curve.times[int(np.argmax(jumps))]
    assert (
        motion.times[violation.waypoint]
        <= at
        <= motion.times[min(violation.waypoint + 1, len(motion.times) - 1)]
    )


def test_jerk_bounds_the_duration() -> None:
    plan = plan_drawer()
    report = vkc.validate(plan.scene, plan.steps, retime_smoothly(), vkc.Options(jerk_time=0.2))
    assert report.ok
    assert "jerk" in {bound.kind for bound in report.bounds}
    assert "jerk" not in {bound.kind for bound in plan.report.bounds}


STIFF_SPRING = {"stiffness": 120.0, "springref": -2.0}


def validate_door(scene: vkc.Scene, trajectory: vkc.Trajectory | None = None) -> Report:
    plan = plan_door()
    return validate(scene, plan.steps, trajectory or plan.trajectory, plan.options)


def test_torque_violation_of_a_door_with_a_stiff_spring_is_reported(tmp_path: Path) -> None:
    heavy, plan = load_door_with_closer(**STIFF_SPRING), plan_door()
    report = validate_door(heavy)
    assert {violation.constraint for violation in report.violations} == {"torque"}
    worst = max(report.violations, key=lambda violation: violation.amount)
    assert (worst.subject, worst.unit) == ("shoulder_pan_joint", "N·m")
    assert worst.amount == pytest.approx(150.0 * (report.torque - 1.0))
    assert 6.0 < worst.time <= plan.trajectory.times[-1], "the spring torque is largest there"
    assert "exceeds the motor's 150 N·m" in worst.detail
    assert "even at rest" in worst.detail
    rejected = replace(plan, scene=heavy, report=report, status="rejected")
    verdict = judge(rejected.save(tmp_path / "heavy.npz"))
    assert verdict.agrees
    assert {(found.rule, found.subject) for found in verdict.found} == get_violation_names(report)


def test_damped_door_must_be_opened_slowly() -> None:
    scene, plan = load_door_with_closer(damping=400.0), plan_door()
    fast = validate_door(scene).violations
    assert {found.constraint for found in fast} == {"torque"}
    assert all("N·m at rest" in found.detail for found in fast)
    slower = retime_trajectory(scene, plan.trajectory)
    report = validate_door(scene, slower)
    assert report.ok
    assert 0.9 < report.torque <= 1.0 + TORQUE_TOLERANCE, "the motion is slower than necessary"
    assert 1.0 < slower.times[-1] / plan.trajectory.times[-1] < 1.3
    assert "torque" in {bound.kind for bound in report.bounds}


def load_stationary(scene: vkc.Scene) -> MotorLoads:
    return MotorLoads(Samples(scene, make_stationary_motion(scene)))


def hold_stick(mass: float) -> vkc.Scene:
    scene = replace_object_fields(vkc.load_scene("init_1"), "stick", mass=mass)
    return scene.with_held({"stick": "grip"})


def test_torque_violation_at_rest_is_reported() -> None:
    found = load_stationary(hold_stick(60.0)).find_violations()
    assert {violation.constraint for violation in found} == {"torque"}
    assert "shoulder_lift_joint" in {violation.subject for violation in found}
    assert all("even at rest" in violation.detail for violation in found)
    assert load_stationary(make_grasping_scene()).find_violations() == []


@pytest.mark.parametrize(("ratio", "ok"), [(1.004, True), (1.006, False)])
def test_torques_within_the_tolerance_are_accepted(ratio: float, ok: bool) -> None:
    """At rest, torques are linear in the mass of the stick."""
    masses = np.array([10.0, 20.0])
    known = [load_stationary(hold_stick(mass)).torque_ratios.max(axis=0) for mass in masses]
    joint = int(known[1].argmax())
    mass = 10.0 + 10.0 * (ratio - known[0][joint]) / (known[1][joint] - known[0][joint])
    loads = load_stationary(hold_stick(mass))
    assert loads.torque_ratios.max() == pytest.approx(ratio, abs=1e-6)
    excess = np.abs(loads.torques[:, joint]).max() * (1.0 - 1.0 / ratio)
    found = [one.amount for one in loads.find_violations()]
    assert found == ([] if ok else [pytest.approx(excess, rel=1e-3)])


def test_weight_counts_from_the_first_cubic_of_a_grasp() -> None:
    scene = hold_stick(60.0)
    motion, times = make_stationary_motion(scene), np.arange(3.0)
    rows = np.tile(motion.positions[0], (3, 1))
    phases = (PhaseSpan("before", 0, 1), PhaseSpan("grasped", 1, 2, scene.holds))
    curve = Curve(times, rows, np.zeros_like(rows))
    motion = replace(motion, times=times, positions=rows, phases=phases, curve=curve)
    found = MotorLoads(Samples(scene.with_held({}), motion)).find_violations()
    expected = load_stationary(scene).find_violations()
    assert {one.subject: one.amount for one in found} == pytest.approx(
        {one.subject: one.amount for one in expected}
    )
    assert {one.waypoint for one in found} == {1}


def test_report_remarks_on_missing_masses() -> None:
    scene = load_door_with_closer(**STIFF_SPRING)
    model = pin.Model(scene.robot.model)
    for joint in range(1, model.njoints):
        model.inertias[joint] = pin.Inertia.Zero()
    report = validate_door(replace(scene, robot=replace(scene.robot, model=model)))
    assert report.ok
    assert report.torque == 0.0
    assert report.remarks == ("torques not checked: the URDF states no masses of the arm",)


def test_report_remarks_on_massless_payload() -> None:
    (remark,) = load_stationary(hold_stick(0.0)).summarize()["remarks"]
    assert remark == "carried as massless, since no mass is given: stick"
    assert load_stationary(make_grasping_scene()).summarize()["remarks"] == ()


def make_circle(
    scene: Scene,
    *,
    is_smooth: bool,
    peak: float = 0.4,
    aside: float = 0.0,
    signs: tuple[int, int] = (1, 1),
) -> tuple[list[Any], Trajectory]:
    """Return the goal and the motion of a quarter circle of 1 m, with a lateral velocity.

    Args:
        scene: The scene.
        is_smooth: Whether the motion has a curve.
        peak: Largest angular velocity [rad/s].
        aside: Largest velocity along −x [m/s], which is lateral at the end.
        signs: 1 or −1 for motion ahead or back, and for a turn to the left or right.
    """
    duration = 1.5 * (np.pi / 2) / peak
    times = np.linspace(0.0, duration, 81)
    s = times / duration
    yaw, turning = np.pi / 2 * (3.0 - 2.0 * s) * s**2, np.pi / 2 * 6.0 * (s - s**2) / duration
    rows, rates = np.tile(scene.start, (81, 1)), np.zeros((81, len(scene.start)))
    slide = aside * (1.0 - np.cos(2.0 * np.pi * s)) / 2
    rows[:, 0], rows[:, 1], rows[:, 2] = np.sin(yaw), 1.0 - np.cos(yaw), yaw
    rates[:, 0], rates[:, 1], rates[:, 2] = turning * np.cos(yaw), turning * np.sin(yaw), turning
    rows[1:, 0] -= np.cumsum((slide[1:] + slide[:-1]) / 2 * np.diff(times))
    rates[:, 0] -= slide
    ahead, left = signs
    for values in (rows, rates):
        values[:, :3] *= [ahead, ahead * left, left]
    curve = Curve(times, rows, rates) if is_smooth else None
    motion = replace(make_trajectory(scene, rows), times=times, curve=curve)
    return [vkc.GoTo(*rows[-1, :3])], motion


in_all_directions = pytest.mark.parametrize("signs", [(1, 1), (1, -1), (-1, 1), (-1, -1)], ids=str)
with_and_without_curve = pytest.mark.parametrize("is_smooth", [True, False], ids=["curve", "steps"])


@with_and_without_curve
@in_all_directions
def test_slip_is_reported(signs: tuple[int, int], is_smooth: bool) -> None:
    """At heading θ, the velocity along −x is lateral by a factor of sin θ."""
    scene = make_hall(base="differential")
    rolling = validate(scene, *make_circle(scene, is_smooth=is_smooth, signs=signs))
    assert rolling.ok
    assert bool(rolling.bounds) == is_smooth, "only curves have limiting constraints"
    goal, motion = make_circle(scene, is_smooth=is_smooth, aside=0.01, signs=signs)
    unit, tolerance = ("m/s", 1e-3) if is_smooth else ("m", 1e-4)
    found = check_only_violation(validate(scene, goal, motion), "slip", "base", unit)
    if is_smooth:
        moments = np.linspace(0.0, motion.times[-1], 5000)
        moves, yaw = motion.velocity(moments), motion(moments)[:, 2]
    else:
        moments, moves = motion.times[:-1], np.diff(motion.positions, axis=0)
        yaw = motion.positions[:-1, 2] + moves[:, 2] / 2
    slip = np.abs(np.cos(yaw) * moves[:, 1] - np.sin(yaw) * moves[:, 0])
    assert found.amount == pytest.approx(slip.max(), rel=1e-3)
    assert found.time == pytest.approx(moments[slip.argmax()], abs=0.05)
    assert motion.times[found.waypoint] <= found.time <= motion.times[found.waypoint + 1]
    assert "mm" in found.detail
    assert validate(make_hall(), goal, motion).ok
    for ratio, ok in ((0.95, True), (1.1, False)):
        aside = 0.01 * ratio * tolerance / found.amount
        circle = make_circle(scene, is_smooth=is_smooth, aside=aside, signs=signs)
        assert validate(scene, *circle).ok == ok


def test_slip_within_one_cubic_is_found() -> None:
    """The base turns by 0.2 rad while it moves along a chord: it rolls half-way, and at rest."""
    scene, turn = make_hall(base="differential"), 0.2
    rows = np.array([scene.start, scene.start])
    rows[1, :3] += [np.cos(turn / 2), np.sin(turn / 2), turn]
    times = np.array([0.0, 10.0])
    curve = Curve(times, rows, np.zeros_like(rows))
    motion = replace(make_trajectory(scene, rows), times=times, curve=curve)
    report = validate(scene, [vkc.GoTo(*rows[1, :3])], motion)
    moments = np.linspace(*times, 2001)
    angles = motion(moments)[:, 2] - turn / 2
    slip = np.abs(np.linalg.norm(motion.velocity(moments)[:, :2], axis=1) * np.sin(angles))
    amount = pytest.approx(slip.max(), rel=0.02)
    check_only_violation(report, "slip", "base", "m/s", amount=amount)


@with_and_without_curve
@in_all_directions
@pytest.mark.parametrize(("radius", "ok"), [(0.997, True), (1.01, False)])
def test_turning_radius_is_checked(
    radius: float, ok: bool, signs: tuple[int, int], is_smooth: bool
) -> None:
    scene = make_hall(base="ackermann", turning_radius=radius)
    goal, motion = make_circle(scene, is_smooth=is_smooth, signs=signs)
    report = validate(scene, goal, motion)
    assert report.ok == ok
    if not ok:
        unit, turn = (
            ("m/s", 0.4) if is_smooth else ("m", np.abs(np.diff(motion.positions[:, 2])).max())
        )
        amount = pytest.approx((radius - 1.0) * turn, rel=1e-2)
        check_only_violation(report, "turning", "base", unit, amount=amount)


def test_steered_base_must_not_turn_in_place() -> None:
    scene = make_hall(base="ackermann", turning_radius=0.8)
    motion = drive_through(
        scene, scene.start, move_start(scene.start, x=2.0), move_start(scene.start, x=2.0, yaw=1.0)
    )
    steps, amount = [vkc.GoTo(2.0, 0.0, 1.0)], 0.8 * np.diff(motion.positions[:, 2]).max()
    found = check_only_violation(validate(scene, steps, motion), "turning", "base", "m")
    assert found.amount == pytest.approx(amount)
    assert "radius of 0.8 m" in found.detail
    assert validate(make_hall(base="differential"), steps, motion).ok


@with_and_without_curve
@in_all_directions
@pytest.mark.parametrize("base", ["differential", "ackermann"])
def test_wheel_speed_is_checked(base: str, signs: tuple[int, int], is_smooth: bool) -> None:
    """On a circle of 1 m the outer wheels roll 1 + track / 2 times as fast as the base."""
    scene = make_hall(base=base, **({"turning_radius": 0.8} if base == "ackermann" else {}))
    assert scene.robot.wheels is not None
    rim = scene.robot.wheels.rim_speed
    peak = rim / (1.0 + scene.robot.wheels.track / 2)
    below, above, far = (
        make_circle(scene, is_smooth=is_smooth, peak=share * peak, signs=signs)
        for share in (0.9995, 1.002, 1.02)
    )
    assert validate(scene, *below).ok
    amount = pytest.approx(0.02 * rim, rel=0.02)
    check_only_violation(validate(scene, *far), "wheels", "base", "m/s", amount=amount)
    assert not validate(scene, *above).ok
    assert validate(make_hall(), *far).ok
