"""Tests that validation accepts valid motions and reports each violation."""

from __future__ import annotations

from dataclasses import replace

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import describe_box
from helpers.drawers import add_boxes, replace_scene_fields
from helpers.drives import (
    DT,
    drive_through,
    make_hall,
    make_trajectory,
    move_start,
    replace_positions,
)
from helpers.judging import (
    check,
    check_only_violation,
    get_violation_names,
    replace_attachments,
    replace_object,
)
from helpers.motions import make_object_motion
from helpers.supports import make_plate_scene, slide_plate

import vkc_pin as vkc
from vkc_pin import (
    InputError,
    Options,
    PhaseSpan,
    PlacedObject,
    Report,
    Scene,
    Trajectory,
    UnknownNameError,
    Violation,
    validate,
)
from vkc_pin.visualization.plots.plots import compute_clearance_curves
from vkc_pin.world.scene.hold import make_holds
from vkc_pin.world.trajectory.curve import Curve

WRIST = "wrist_3_joint"


def test_planned_motion_is_valid(door_plan: vkc.Plan) -> None:
    report = check(door_plan)
    assert report.ok, report.lines()
    assert report.clearance > 0.0
    assert report.closure_error <= 1e-3
    assert report.closure_angle <= 1e-3
    assert report.states > len(door_plan.trajectory.times)


@pytest.mark.parametrize("error", [0.01, 1e-8, -1e-8])
def test_motion_must_begin_at_the_start(hall: Scene, drive: Trajectory, error: float) -> None:
    positions = drive.positions + error * (np.arange(drive.positions.shape[1]) == 1)
    report = validate(hall, [vkc.GoTo(2.0, error, np.pi / 2)], replace_positions(drive, positions))
    amount = pytest.approx(abs(error), abs=1e-12)
    check_only_violation(report, "start", "base_y", "m", waypoint=0, amount=amount)


def test_objects_must_begin_at_their_state(door_plan: vkc.Plan) -> None:
    report = check(door_plan, scene=door_plan.scene.with_state("door", {"knob": 0.1}))
    amount = pytest.approx(0.1)
    check_only_violation(report, "start", "door.knob", "rad", waypoint=0, amount=amount)


@pytest.mark.parametrize(
    ("subject", "value", "excess", "unit"),
    [
        ("base_x", 6.2, 0.2, "m"),
        ("base_y", -6.2, 0.2, "m"),
        ("base_x", 6.00008, 8e-5, "m"),
        (WRIST, 2 * np.pi + 0.05, 0.05, "rad"),
        (WRIST, -2 * np.pi - 0.01, 0.01, "rad"),
    ],
)
def test_limit_violation_names_coordinate_waypoint_and_excess(
    hall: Scene, subject: str, value: float, excess: float, unit: str
) -> None:
    there = np.array(hall.start)
    there[hall.robot.coordinates.index(subject)] = value
    motion = drive_through(hall, hall.start, there, hall.start, steps=60)
    report = validate(hall, [vkc.GoTo(0.0, 0.0)], motion)
    amount = pytest.approx(excess)
    found = check_only_violation(report, "limit", subject, unit, waypoint=60, amount=amount)
    assert f"by {excess:.4f} {unit}" in found.detail


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_limit_violation_between_waypoints_is_found(hall: Scene, side: float) -> None:
    """The curve overshoots the limit by 0.1 m after the second waypoint."""
    rows = np.array([move_start(hall.start, x=side * x) for x in (0.0, 5.9, 5.9)])
    rates = np.zeros_like(rows)
    rates[1:, 0] = [0.8 * side, -0.8 * side]
    times = np.array([0.0, 20.0, 21.0])
    motion = replace(make_trajectory(hall, rows), times=times, curve=Curve(times, rows, rates))
    report = validate(hall, [vkc.GoTo(side * 5.9, 0.0)], motion)
    (found,) = [one for one in report.violations if one.constraint == "limit"]
    assert (found.subject, found.waypoint) == ("base_x", 1)
    assert found.amount == pytest.approx(0.1)


def test_start_may_exceed_limits_slightly(hall: Scene) -> None:
    for outside, constraints in ((1e-8, []), (9e-3, []), (0.011, ["limit"])):
        start = np.array(hall.start)
        start[-1] = hall.robot.upper[-1] + outside
        end = move_start(start, x=1.0)
        end[-1] = hall.robot.upper[-1]
        motion = make_trajectory(hall, np.vstack([start, end]), dt=10.0)
        report = validate(replace(hall, start=start), [vkc.GoTo(1.0, 0.0)], motion)
        assert [violation.constraint for violation in report.violations] == constraints, "\n".join(
            report.lines()
        )


def test_fixed_base_must_not_move() -> None:
    scene = make_hall(base="fixed").with_start(base=[1.0, -2.0, 0.5])
    turned = np.array(scene.start)
    turned[-1] += 1.0
    assert validate(scene, [vkc.GoTo(1.0, -2.0)], drive_through(scene, scene.start, turned)).ok
    driven = drive_through(scene, scene.start, move_start(scene.start, x=1.1))
    found = validate(scene, [vkc.GoTo(1.1, -2.0)], driven)
    assert ("limit", "base_x") in get_violation_names(found)
    moved = drive_through(scene, scene.start, move_start(scene.start, yaw=0.51))
    found = validate(scene, [vkc.GoTo(1.0, -2.0)], moved)
    check_only_violation(found, "limit", "base_yaw", "rad", amount=pytest.approx(0.01))


@pytest.mark.parametrize(
    ("speed", "constraint", "waypoint", "amount"),
    [
        ([0.3, 0.6, 0.9, 1.2, 0.9, 0.6, 0.3], "velocity", 3, 1.2 - 1.0),
        ([0.0, 0.9, 0.9, 0.9, 0.9, 0.9, 0.0], "acceleration", 1, 0.9 / DT - 3.0),
        ([0.9, 0.6, 0.3, 0.2, 0.1], "acceleration", 0, 0.9 / DT - 3.0),
        ([0.1, 0.2, 0.3, 0.6, 0.9], "acceleration", 5, 0.9 / DT - 3.0),
    ],
)
def test_rate_violation_is_reported(
    hall: Scene, speed: list[float], constraint: str, waypoint: int, amount: float
) -> None:
    assert (hall.robot.velocity[0], hall.robot.acceleration[0]) == (1.0, 3.0)
    rows = np.tile(hall.start, (len(speed) + 1, 1))
    rows[1:, 0] += np.cumsum(speed) * DT
    report = validate(hall, [vkc.GoTo(rows[-1, 0], 0.0)], make_trajectory(hall, rows))
    found = check_only_violation(report, constraint, "base_x", waypoint=waypoint)
    assert found.unit == {"velocity": "m/s", "acceleration": "m/s²"}[constraint]
    assert found.amount == pytest.approx(amount)


def test_object_joints_have_position_and_velocity_limits(door_plan: vkc.Plan) -> None:
    scene, motion = door_plan.scene, door_plan.trajectory
    report = check(door_plan, scene=replace_object(scene, upper=np.array([1.1, 0.8])))
    amount = pytest.approx(0.1, abs=1e-4)
    check_only_violation(report, "limit", "door.hinge", "rad", amount=amount)
    assert motion.curve is not None
    rates = motion.curve.compute_max_rates()[0]
    limits = scene.objects["door"].object.velocity.copy()
    limits[0] = 0.5 * rates[:, motion.names.index("door.hinge")].max()
    report = check(door_plan, scene=replace_object(scene, velocity=limits))
    amount = pytest.approx(limits[0])
    check_only_violation(report, "velocity", "door.hinge", "rad/s", amount=amount)


@pytest.mark.parametrize(
    ("shift", "turn", "units"),
    [(0.002, 0.0, {"m"}), (0.0, 0.003, {"rad"}), (0.003, 0.003, {"m", "rad"})],
)
def test_closure_violation_is_reported(
    door_plan: vkc.Plan, shift: float, turn: float, units: set[str]
) -> None:
    """The grasp is displaced on the lever after planning."""
    grasp = door_plan.scene.objects["door"].object.attachments["handle"]
    displaced = grasp.placement * pin.SE3(
        pin.exp3(np.array([0.0, 0.0, turn])), np.array([0.0, 0.0, shift])
    )
    scene = replace_attachments(door_plan.scene, {"handle": replace(grasp, placement=displaced)})
    report, planned = check(door_plan, scene=scene), check(door_plan)
    assert get_violation_names(report) == {("closure", "door.handle")}
    assert {found.unit for found in report.violations} == units
    for found in report.violations:
        size, drift, largest = (
            (shift, planned.closure_error, report.closure_error)
            if found.unit == "m"
            else (turn, planned.closure_angle, report.closure_angle)
        )
        assert found.amount == pytest.approx(size - 1e-3, abs=drift + 1e-6)
        assert largest == pytest.approx(found.amount + 1e-3)
        assert found.waypoint >= door_plan.trajectory.phases[1].first


def replace_latch(scene: Scene, **fields: float) -> Scene:
    (latch,) = scene.objects["door"].object.latches
    return replace_object(scene, latches=(replace(latch, **fields),))


def test_latch_violation_of_a_planned_motion_is_reported(door_plan: vkc.Plan) -> None:
    (latch,) = door_plan.scene.objects["door"].object.latches
    knob, hinge = map(door_plan.trajectory.column, ("door.knob", "door.hinge"))
    leaving = np.flatnonzero((hinge[1:] > 1e-4) & (hinge[:-1] <= latch.engaged_within))
    turned = min(knob[leaving].min(), knob[leaving + 1].min())
    report = check(door_plan, scene=replace_latch(door_plan.scene, threshold=turned + 0.05))
    found = check_only_violation(report, "latch", "door.hinge", "rad")
    assert found.waypoint in leaving
    assert 0.0 < found.amount <= 0.05 + 1e-9
    assert check(door_plan, scene=replace_latch(door_plan.scene, threshold=turned - 1e-6)).ok


@pytest.mark.parametrize(
    ("hinge", "knob", "shortfall"),
    [
        ([0.0, 0.0, 0.3], [0.0, 0.5, 0.5], 0.0),  # turned, then pushed
        # Both at once: the hinge leaves with the knob at 0.
        ([0.0, 0.3, 0.3], [0.0, 0.6, 0.6], 0.5),
        # 0.6 − 0.6 · 0.05 / 0.3 = 0.5 at the end of the latch's reach
        ([0.0, 0.0, 0.3], [0.0, 0.6, 0.0], 0.0),
        ([0.0, 0.0, 0.3], [0.0, 0.58, 0.0], 0.5 - 0.58 * 5 / 6),
        ([0.0, 0.0, -0.3], [0.0, 0.3, 0.3], 0.2),  # pulled
        ([0.3, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0),  # shutting needs no turned knob
        ([0.3, 0.0, 0.3], [0.0, 0.0, 0.0], 0.5),  # shut and opened again
        ([0.3, -0.3, -0.3], [0.0, 0.0, 0.0], 0.5),  # through the frame to the other side
        ([0.1, 0.3, 0.3], [0.0, 0.0, 0.0], 0.0),  # ajar: the bolt is out of the lock
        ([0.04, 0.3, 0.3], [0.2, 0.2, 0.2], 0.3),  # ajar, but within the latch's reach
        ([0.04, 0.04, 0.3], [0.0, 0.6, 0.6], 0.0),  # the door may rest ajar until the knob turns
        # Released within reach, although the knob turns back
        ([0.0, 0.04, 0.3], [0.7, 0.5, 0.7], 0.0),
    ],
)
def test_latch_releases_the_hinge_only_with_the_knob_turned(
    door_plan: vkc.Plan, hinge: list[float], knob: list[float], shortfall: float
) -> None:
    assert compute_latch_shortfall(door_plan.scene, hinge, knob) == pytest.approx(
        shortfall, abs=5e-3 if hinge[1] * knob[1] > 0 else 1e-6
    )


@pytest.mark.parametrize(
    ("hinge", "knob", "shortfall"),
    [
        ([0.0, 0.0, 0.3], [0.0, 0.4, 0.4], 0.1),
        ([0.0, 0.0, 0.3], [0.0, 0.4995, 0.4995], 5e-4),
        ([0.0, 0.0, 5e-4], [0.0, 0.0, 0.0], 0.5),
        ([0.0, 0.0, 1.3e-4], [0.0, 0.0, 0.0], 0.5),
        ([0.0, 0.0, 0.7e-4], [0.0, 0.0, 0.0], 0.0),  # within the tolerance of a latch
        ([0.3, -0.305, -0.305], [0.0, 0.0, 0.0], 0.5),
        ([0.0, 0.0, 0.3], [0.0, 0.5, 0.5], 0.0),
        ([0.0, 0.0, 0.3], [0.0, 0.51, 0.0], 0.0),
    ],
)
def test_latch_violation_between_two_samples_is_found(
    door_plan: vkc.Plan, hinge: list[float], knob: list[float], shortfall: float
) -> None:
    found = compute_latch_shortfall(door_plan.scene, hinge, knob, reach=0.002)
    assert found == pytest.approx(shortfall)


def compute_latch_shortfall(
    scene: Scene, hinge: list[float], knob: list[float], *, reach: float = 0.05
) -> float:
    """Return the amount of the latch violation of a door that moves alone, 0 without one."""
    scene = replace_latch(scene, engaged_within=reach)
    scene = scene.with_state("door", {"hinge": hinge[0], "knob": knob[0]})
    motion = make_object_motion(scene, "door", dt=2.0, hinge=hinge, knob=knob)
    report = validate(scene, [vkc.Actuate("door", {"hinge": hinge[-1]})], motion)
    found = [violation for violation in report.violations if violation.constraint == "latch"]
    assert {violation.subject for violation in found} <= {"door.hinge"}
    return sum(violation.amount for violation in found)


def test_rest_too_short_for_the_gripper_is_reported(door_plan: vkc.Plan) -> None:
    rest, motion = door_plan.options.grasp_time, door_plan.trajectory
    assert check(door_plan, grasp_time=rest - 1e-9).ok
    grasp = motion.phases[1].first
    fields = {"waypoint": grasp, "time": pytest.approx(motion.times[grasp])}
    report = check(door_plan, grasp_time=rest + 0.25)
    found = check_only_violation(report, "dwell", "door.handle", "s", **fields)
    assert 0.0 < found.amount <= 0.25 + 1e-9
    assert not check(door_plan, grasp_time=rest + 0.25 - found.amount + 1e-4).ok


def test_joints_must_not_move_without_a_grasp(door_plan: vkc.Plan) -> None:
    released = tuple(replace(phase, holds=()) for phase in door_plan.trajectory.phases)
    report = check(door_plan, trajectory=replace(door_plan.trajectory, phases=released))
    unheld = {found.subject: found for found in report.violations if found.constraint == "unheld"}
    assert set(unheld) == {"door.hinge", "door.knob"}
    # The hand touches the grasped link.
    assert {found.constraint for found in report.violations} <= {"unheld", "clearance"}
    hinge = door_plan.trajectory.column("door.hinge")
    assert unheld["door.hinge"].amount == pytest.approx(np.abs(hinge).max())
    assert hinge[unheld["door.hinge"].waypoint] == pytest.approx(hinge[np.argmax(np.abs(hinge))])
    assert "door is not grasped" in unheld["door.hinge"].detail


@pytest.mark.parametrize(
    ("tip", "held", "amount"),
    [
        (0.099, ["plate"], 0.0),
        (0.12, ["plate"], 0.02),
        (0.18, ["plate", "plate"], 0.08),  # half of it in each phase
        (0.18, ["plate", None, "plate"], 0.08),
        (0.18, ["plate", "cup", "plate"], 0.0),  # the hand grasps the cup in between
    ],
)
def test_tilt_of_a_supported_object_counts_from_where_it_was_put_down(
    tip: float, held: list[str | None], amount: float
) -> None:
    scene = make_plate_scene("flap")
    motion = slide_plate(scene, tip)
    holds = {"plate": motion.phases[0].holds, "cup": (vkc.Hold("cup", "side"),), None: ()}
    ends = np.linspace(0, motion.phases[0].last, len(held) + 1).astype(int).tolist()
    phases = tuple(
        PhaseSpan(f"part {k}", ends[k], ends[k + 1], holds[name]) for k, name in enumerate(held)
    )
    grasp = np.zeros((len(motion.times), 2))
    motion = replace(
        motion,
        names=(*motion.names, "cup.side_slide", "cup.side_turn"),
        positions=np.hstack([motion.positions, grasp]),
        phases=phases,
    )
    report = validate(scene, [vkc.Actuate("plate", {"tip": tip})], motion)
    found = [one for one in report.violations if one.constraint == "tips"]
    expected = [("cup", "rad", 30, pytest.approx(amount, abs=1e-9))] * (amount > 0.0)
    assert [(one.subject, one.unit, one.waypoint, one.amount) for one in found] == expected


@pytest.mark.parametrize("change", [2e-5, -2e-5])
def test_slightest_motion_without_a_grasp_is_reported(door_plan: vkc.Plan, change: float) -> None:
    scene = door_plan.scene.with_state("door", {"hinge": 0.5})
    motion = make_object_motion(scene, "door", hinge=[0.5, 0.5, 0.5 + change], knob=[0.0] * 3)
    report = validate(scene, [vkc.GoTo(*scene.start[:3])], motion)
    check_only_violation(report, "unheld", "door.hinge", "rad", amount=pytest.approx(2e-5))


def make_drive_to_a_crate(gap: float) -> tuple[Scene, Trajectory]:
    """Return a hall with a crate, and a drive that ends `gap` in front of it."""

    def place_crate(x: float) -> tuple[Scene, float]:
        scene = make_hall(obstacles=[describe_box("crate", [0.4, 2.0, 0.3], [x, 0.0, 0.15])])
        return scene, scene.with_start(base=[1.0, 0.0, 0.0]).start_clearance()

    scene, clearance = place_crate(2.5 - place_crate(2.5)[1] + gap)
    assert clearance == pytest.approx(gap, abs=1e-6)
    return scene, drive_through(scene, scene.start, move_start(scene.start, x=1.0))


@pytest.mark.parametrize(
    ("gap", "constraint", "amount"),
    [
        (0.0195, "", 0.0),
        (0.0191, "", 0.0),
        (0.0185, "clearance", 0.0005),
        (0.015, "clearance", 0.004),
        (-5e-5, "penetration", 5e-5),
        (-0.03, "penetration", 0.03),
    ],
)
def test_clearance_violation_at_a_waypoint_is_reported(
    gap: float, constraint: str, amount: float
) -> None:
    scene, motion = make_drive_to_a_crate(gap)
    report = validate(scene, [vkc.GoTo(1.0, 0.0)], motion, Options(dist_safe=0.02))
    assert report.clearance == pytest.approx(gap, abs=1e-5)
    if constraint:
        fields = {"waypoint": 40, "amount": pytest.approx(amount, abs=1e-5)}
        check_only_violation(report, constraint, "base_link – crate", "m", **fields)
    else:
        assert report.ok, report.lines()


@pytest.mark.parametrize(
    ("gap", "margin", "constraint", "amount"),
    [
        (0.0042, 0.005, "", 0.0),
        (0.003, 0.005, "clearance", 0.001),
        (-0.002, -0.003, "", 0.0),
        (-0.002, -0.0025, "", 0.0),
        (-0.002, -0.001, "penetration", 0.002),
        (-0.002, 0.005, "penetration", 0.002),
    ],
)
def test_exempt_pair_must_keep_its_own_margin(
    gap: float, margin: float, constraint: str, amount: float
) -> None:
    scene, motion = make_drive_to_a_crate(gap)
    allow = [{"pair": ["base_link", "crate"], "margin": margin}]
    report = validate(replace_scene_fields(scene, allow=allow), [vkc.GoTo(1.0, 0.0)], motion)
    found = [(one.constraint, one.amount) for one in report.violations]
    assert found == ([(constraint, pytest.approx(amount, abs=1e-5))] if constraint else [])


@pytest.mark.parametrize("self_distance", [0.02, 0.001])
def test_every_pair_must_keep_the_clearance_not_only_the_nearest(self_distance: float) -> None:
    scene, _ = make_drive_to_a_crate(5e-4)
    scene = add_boxes(scene, board=((0.3, 0.02, 0.3), (1.0, -0.36, 0.15)))
    rows = np.array([scene.start, move_start(scene.start, x=1.0)])
    motion = make_trajectory(scene, rows, dt=10.0)
    options = Options(dist_safe=0.02, self_distance=self_distance)
    report = validate(scene, [vkc.GoTo(1.0, 0.0)], motion, options)
    found = {one.subject.split(" – ")[1]: one for one in report.violations}
    assert set(found) == {"crate", "board"}
    assert {one.constraint for one in report.violations} == {"clearance"}
    assert found["crate"].amount == pytest.approx(0.02 - 1e-3 - 5e-4, abs=1e-5)
    assert 0.0 < found["board"].amount < found["crate"].amount - 5e-3


def test_clearance_is_checked_from_the_first_waypoint_on() -> None:
    """The start may be closer to the crate than `dist_safe`."""
    for begin, end, amounts in ((0.99, 1.0, [0.004]), (1.0, 0.99, [])):
        scene, _ = make_drive_to_a_crate(0.015)
        scene = scene.with_start(base=[begin, 0.0, 0.0])
        rows = np.array([scene.start, move_start(scene.start, x=end)])
        report = validate(scene, [vkc.GoTo(end, 0.0)], make_trajectory(scene, rows, dt=1.0))
        found = [(one.constraint, one.waypoint, one.amount) for one in report.violations]
        assert found == [("clearance", 1, pytest.approx(a, abs=1e-5)) for a in amounts]


def test_each_phase_has_its_own_clearance() -> None:
    """A drive towards a crate in two phases: each is nearest at its end."""
    scene, _ = make_drive_to_a_crate(0.03)
    stops = [move_start(scene.start, x=x) for x in (0.97, 1.0)]
    drive = drive_through(scene, scene.start, *stops, steps=8)
    report = validate(scene, [vkc.GoTo(1.0, 0.0)], drive)
    assert report.ok
    assert report.clearances == pytest.approx((0.06, 0.03), abs=1e-5)


def test_links_of_the_robot_keep_self_distance(hall: Scene, drive: Trajectory) -> None:
    """In an empty hall the links of the robot are the closest pair."""
    steps = [vkc.GoTo(2.0, 0.0, np.pi / 2)]
    nearest = validate(hall, steps, drive).clearance
    for dist_safe, self_distance, short in (
        (0.001, nearest + 0.005, 0.004),
        (nearest + 0.005, 0.001, 0.0),
    ):
        options = Options(dist_safe=dist_safe, self_distance=self_distance)
        report = validate(hall, steps, drive, options)
        assert {one.constraint for one in report.violations} == ({"clearance"} if short else set())
        worst = max((one.amount for one in report.violations), default=0.0)
        assert worst == pytest.approx(short, abs=1e-5)


def test_clearance_is_required_at_waypoints_only() -> None:
    board = describe_box("board", [0.3, 0.02, 0.3], [2.0, -0.36, 0.15])
    scene = make_hall(obstacles=[board])
    rows = np.array([scene.start, move_start(scene.start, x=4.0)])
    report = validate(scene, [vkc.GoTo(4.0, 0.0)], make_trajectory(scene, rows, dt=20.0))
    assert report.ok, report.lines()
    assert 0.0 < report.clearance < Options().dist_safe


def test_penetration_between_waypoints_is_found() -> None:
    scene = make_hall(obstacles=[describe_box("board", [0.005, 1.0, 0.2], [2.0, 0.0, 0.1])])
    rows = np.array([scene.start, move_start(scene.start, x=4.0)])
    motion = make_trajectory(scene, rows, dt=20.0)
    for row in rows:
        assert scene.with_start(base=row[:3]).start_clearance() > 1.0
    report = validate(scene, [vkc.GoTo(4.0, 0.0)], motion)
    assert report.violations
    assert {found.constraint for found in report.violations} == {"penetration"}
    for found in report.violations:
        assert found.subject.endswith(" – board")
        assert found.waypoint == 0
        assert 0.0 < found.time < 20.0
        there = scene.with_start(base=motion.at(found.time)[:3])
        assert there.start_clearance() <= -found.amount + 1e-6
    assert report.clearance == pytest.approx(-max(found.amount for found in report.violations))
    assert validate(make_hall(), [vkc.GoTo(4.0, 0.0)], motion).ok


@pytest.mark.parametrize("name", ["base_x", "shoulder_pan_joint", "door.hinge"])
@pytest.mark.parametrize("jump", [1e3, 1e9])
def test_motion_too_long_to_be_sampled_is_reported(
    door_plan: vkc.Plan, name: str, jump: float
) -> None:
    positions = door_plan.trajectory.positions.copy()
    positions[40:, door_plan.trajectory.names.index(name)] += jump
    report = check(
        door_plan,
        trajectory=replace(door_plan.trajectory, positions=positions, curve=None),
    )
    found = {v.constraint: v for v in report.violations}
    assert {"sampling", "velocity", "limit"} <= set(found)
    assert (found["sampling"].subject, found["sampling"].waypoint) == ("motion", 39)
    assert "collisions not checked" in found["sampling"].detail
    assert report.states == len(positions)


def thicken_lever(scene: Scene, by: float) -> Scene:
    """Return the scene with the radius of the lever increased by `by` [m]."""
    placed: PlacedObject = scene.objects["door"]
    collision = placed.object.collision.copy()
    for shape in collision.geometryObjects:
        if shape.name.startswith("lever"):
            cylinder = shape.geometry
            shape.geometry = coal.Cylinder(cylinder.radius + by, 2 * cylinder.halfLength)
    return replace_object(scene, collision=collision)


def test_fingers_may_be_close_to_the_grasped_link(door_plan: vkc.Plan) -> None:
    """A thicker lever reduces the clearance to 8 mm, then makes it overlap the fingers by 8 mm."""

    def find_hand_violations(report: Report) -> list[Violation]:
        hand = door_plan.scene.robot.touch_links
        return [v for v in report.violations if v.subject.split(" – ")[0] in hand]

    times = door_plan.trajectory.times
    curves = compute_clearance_curves(door_plan.scene, door_plan.trajectory, times)
    (gap,) = (one.distances.min() for one in curves if one.name == "gripper – grasped object")
    close = thicken_lever(door_plan.scene, gap - 0.008)
    near = check(door_plan, scene=close)
    assert find_hand_violations(near) == []
    assert near.clearance < 0.0085
    found = find_hand_violations(
        check(door_plan, scene=thicken_lever(door_plan.scene, gap + 0.008))
    )
    assert {v.constraint for v in found} == {"penetration"}
    assert {v.subject.split(" – ")[1] for v in found} == {"door.lever"}
    assert max(v.amount for v in found) == pytest.approx(0.008, abs=1e-3)


def test_trajectories_of_another_scene_are_refused(door_plan: vkc.Plan, hall: Scene) -> None:
    motion = door_plan.trajectory
    with pytest.raises(UnknownNameError, match="coordinate") as caught:
        check(door_plan, trajectory=replace(motion, names=(*motion.names[:-1], "door.hing")))
    assert caught.value.nearest == "door.hinge"
    swapped = (motion.names[1], motion.names[0], *motion.names[2:])
    with pytest.raises(InputError) as other:
        check(door_plan, trajectory=replace(motion, names=swapped))
    assert other.value.field == "trajectory.names"

    def check_held(held: dict[str, str]) -> None:
        last = replace(motion.phases[-1], holds=make_holds(held))
        check(door_plan, trajectory=replace(motion, phases=(*motion.phases[:-1], last)))

    for held, kind in (({"dor": "handle"}, "object"), ({"door": "handl"}, "attachment")):
        with pytest.raises(UnknownNameError, match=kind) as caught:
            check_held(held)
        assert caught.value.field == "trajectory.phases[2].held"
        assert caught.value.nearest in ("door", "handle")
    with pytest.raises(InputError, match="missing") as other:
        check_held({"door": "handle_free"})
    assert other.value.expected == "door.handle_free"
    with pytest.raises(UnknownNameError):
        validate(hall, door_plan.steps, motion)
