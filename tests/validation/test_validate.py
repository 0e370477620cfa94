"""The independent check: it accepts what is right, and names each kind of fault, its subject, place and amount."""

from __future__ import annotations

import dataclasses

import coal
import numpy as np
import pinocchio as pin
import pytest
from helpers.drives import DT, hall, moved, of_rows, through, with_positions
from helpers.judging import check, names, only, until_the_grasp, with_attachments, with_object

import vkc_pin as vkc
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.options import Options
from vkc_pin.validation.validate import validate
from vkc_pin.visualization.plots.clearance import compute_clearance_curves
from vkc_pin.world.scene.hold import make_holds
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory

WRIST = "wrist_3_joint"


@pytest.fixture(scope="module")
def empty() -> Scene:
    return hall()


@pytest.fixture(scope="module")
def drive(empty: Scene) -> Trajectory:
    """Two metres ahead and a quarter turn."""
    return through(empty, empty.start, moved(empty.start, x=2.0, yaw=np.pi / 2))


ARRIVED = vkc.GoTo(2.0, 0.0, np.pi / 2)


# --- what is right
# ------------------------------------------------------------------------------------------------


def test_the_planned_motion_is_accepted(door_plan: vkc.Plan) -> None:
    report = check(door_plan)
    assert report.ok, "\n".join(report.lines())
    assert report.clearance > 0.0
    times, safe = door_plan.trajectory.times[1:], door_plan.options.dist_safe
    curves = compute_clearance_curves(door_plan.scene, door_plan.trajectory, times)
    at_waypoints = {curve.name: curve.distances.min() for curve in curves}
    assert at_waypoints.pop("gripper – what it grasps") > 0.0
    assert min(at_waypoints.values()) >= safe - 1e-3
    assert report.clearance <= min(at_waypoints.values()) + 1e-9
    assert report.closure_error <= 1e-3
    assert report.closure_angle <= 1e-3
    assert report.states > len(door_plan.trajectory.times)


def test_a_plain_drive_is_accepted(empty: Scene, drive: Trajectory) -> None:
    assert validate(empty, [ARRIVED], drive).ok
    assert validate(empty, [vkc.GoTo(2.0, 0.0)], drive, Options()).ok


def test_what_was_asked_for_is_asked_about(empty: Scene, drive: Trajectory) -> None:
    found = only(validate(empty, [vkc.GoTo(3.0, 0.0)], drive))
    assert (found.constraint, found.subject) == ("goal", "base")


def test_the_same_heading_a_turn_further_is_as_good(empty: Scene, drive: Trajectory) -> None:
    assert validate(empty, [vkc.GoTo(2.0, 0.0, np.pi / 2 - 4 * np.pi)], drive).ok


# --- start, limits, rates
# -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [0.01, 1e-8, -1e-8])
def test_another_start(empty: Scene, drive: Trajectory, error: float) -> None:
    positions = drive.positions + error * (np.arange(drive.positions.shape[1]) == 1)
    found = only(
        validate(empty, [vkc.GoTo(2.0, error, np.pi / 2)], with_positions(drive, positions))
    )
    assert (found.constraint, found.subject, found.waypoint, found.unit) == (
        "start",
        "base_y",
        0,
        "m",
    )
    assert found.amount == pytest.approx(abs(error), abs=1e-12)


def test_an_object_that_starts_otherwise(door_plan: vkc.Plan) -> None:
    found = only(check(door_plan, scene=door_plan.scene.with_state("door", {"knob": 0.1})))
    assert (found.constraint, found.subject, found.waypoint, found.unit) == (
        "start",
        "door.knob",
        0,
        "rad",
    )
    assert found.amount == pytest.approx(0.1)


def test_a_joint_beyond_its_limit(empty: Scene) -> None:
    index = empty.robot.coordinates.index(WRIST)
    end = np.array(empty.start)
    end[index] = empty.robot.upper[index] + 0.05
    found = only(validate(empty, [vkc.GoTo(0.0, 0.0)], through(empty, empty.start, end)))
    assert (found.constraint, found.subject, found.waypoint, found.unit) == (
        "limit",
        WRIST,
        40,
        "rad",
    )
    assert found.amount == pytest.approx(0.05)


def test_a_joint_beyond_its_lower_limit_on_the_way(empty: Scene) -> None:
    index = empty.robot.coordinates.index(WRIST)
    there = np.array(empty.start)
    there[index] = empty.robot.lower[index] - 0.01
    found = only(
        validate(empty, [vkc.GoTo(0.0, 0.0)], through(empty, empty.start, there, empty.start))
    )
    assert (found.constraint, found.subject, found.waypoint) == ("limit", WRIST, 40)
    assert found.amount == pytest.approx(0.01)


@pytest.mark.parametrize(("place", "subject"), [({"x": 6.2}, "base_x"), ({"y": -6.2}, "base_y")])
def test_out_of_the_arena(empty: Scene, place: dict[str, float], subject: str) -> None:
    goal = moved(empty.start, **place)
    report = validate(
        empty, [vkc.GoTo(goal[0], goal[1])], through(empty, empty.start, goal, steps=60)
    )
    found = only(report)
    assert (found.constraint, found.subject, found.waypoint, found.unit) == (
        "limit",
        subject,
        60,
        "m",
    )
    assert found.amount == pytest.approx(0.2)


def test_a_start_slightly_outside_its_limits_is_where_the_robot_is(empty: Scene) -> None:
    for outside, constraints in ((1e-8, []), (5e-3, []), (0.02, ["limit"])):
        start = np.array(empty.start)
        start[-1] = empty.robot.upper[-1] + outside
        end = moved(start, x=1.0)
        end[-1] = empty.robot.upper[-1]
        motion = of_rows(empty, np.vstack([start, end]), dt=10.0)
        report = validate(dataclasses.replace(empty, start=start), [vkc.GoTo(1.0, 0.0)], motion)
        assert [violation.constraint for violation in report.violations] == constraints, "\n".join(
            report.lines()
        )


def test_a_fixed_base_stays_where_it_stands() -> None:
    scene = hall(base="fixed").with_start(base=[1.0, -2.0, 0.5])
    turned = np.array(scene.start)
    turned[-1] += 1.0
    assert validate(scene, [vkc.GoTo(1.0, -2.0)], through(scene, scene.start, turned)).ok
    found = validate(
        scene, [vkc.GoTo(1.1, -2.0)], through(scene, scene.start, moved(scene.start, x=1.1))
    )
    assert ("limit", "base_x") in names(found)


def test_too_fast(empty: Scene) -> None:
    """The base speeds up gently, but to more than it can."""
    speed = np.concatenate([np.linspace(0.3, 1.2, 4), np.linspace(0.9, 0.3, 3)])
    rows = np.tile(empty.start, (len(speed) + 1, 1))
    rows[1:, 0] += np.cumsum(speed) * DT
    found = only(validate(empty, [vkc.GoTo(rows[-1, 0], 0.0)], of_rows(empty, rows)))
    assert (found.constraint, found.subject, found.waypoint, found.unit) == (
        "velocity",
        "base_x",
        3,
        "m/s",
    )
    assert found.amount == pytest.approx(1.2 - empty.robot.velocity[0])


def test_a_jump_of_velocity(empty: Scene) -> None:
    """The base is at its cruising speed within one step, and stops as suddenly."""
    rows = np.tile(empty.start, (9, 1))
    rows[2:7, 0] += 0.9 * DT * np.arange(1, 6)
    rows[7:, 0] = rows[6, 0]
    found = only(validate(empty, [vkc.GoTo(rows[-1, 0], 0.0)], of_rows(empty, rows)))
    assert (found.constraint, found.subject, found.waypoint, found.unit) == (
        "acceleration",
        "base_x",
        1,
        "m/s²",
    )
    assert found.amount == pytest.approx(0.9 / DT - empty.robot.acceleration[0])


@pytest.mark.parametrize("waypoint", [0, 5])
def test_the_motion_starts_and_ends_at_rest(empty: Scene, waypoint: int) -> None:
    speed = (
        np.array([0.9, 0.6, 0.3, 0.2, 0.1])
        if waypoint == 0
        else np.array([0.1, 0.2, 0.3, 0.6, 0.9])
    )
    rows = np.tile(empty.start, (6, 1))
    rows[1:, 0] += np.cumsum(speed) * DT
    found = only(validate(empty, [vkc.GoTo(rows[-1, 0], 0.0)], of_rows(empty, rows)))
    assert (found.constraint, found.subject, found.waypoint) == ("acceleration", "base_x", waypoint)


def test_an_object_has_limits_and_rates_too(door_plan: vkc.Plan) -> None:
    door = door_plan.scene.objects["door"].object
    scene = with_object(door_plan.scene, upper=np.array([1.1, 0.8]))
    found = only(check(door_plan, scene=scene))
    assert (found.constraint, found.subject, found.unit) == ("limit", "door.hinge", "rad")
    assert found.amount == pytest.approx(0.1, abs=1e-4)
    assert door_plan.trajectory.curve is not None
    fastest = door_plan.trajectory.curve.compute_max_rates()[0][
        :, door_plan.trajectory.names.index("door.hinge")
    ].max()
    scene = with_object(door_plan.scene, velocity=np.array([0.5 * fastest, door.velocity[1]]))
    found = only(check(door_plan, scene=scene))
    assert (found.constraint, found.subject, found.unit) == ("velocity", "door.hinge", "rad/s")
    assert found.amount == pytest.approx(0.5 * fastest)


# --- closure, latch, what nobody holds
# ----------------------------------------------------------------------------


def tool_drift(plan: vkc.Plan, scene: Scene) -> np.ndarray:
    """Return how far the tool is from the handle at the waypoints from the grasp on, shape (K, 2), by plain kinematics."""
    robot, placed = scene.robot, scene.objects["door"]
    grasp = placed.object.attachments["handle"]
    tool, data, drift = robot.model.getFrameId(robot.tool_frame), robot.model.createData(), []
    order = [
        plan.trajectory.names.index(f"door.{joint}") for joint in placed.object.coordinates.names
    ]
    for row in plan.trajectory.positions[plan.trajectory.phases[1].first :]:
        pin.framesForwardKinematics(
            robot.model, data, robot.coordinates.q(row[: robot.coordinates.size])
        )
        handle = (
            placed.placement
            * placed.object.link_placement(grasp.link, row[order])
            * grasp.placement
        )
        offset = handle.actInv(data.oMf[tool])
        drift.append(
            (np.linalg.norm(offset.translation), np.linalg.norm(pin.log3(offset.rotation)))
        )
    return np.array(drift)


def test_the_grasp_drifts_away(door_plan: vkc.Plan) -> None:
    grasp = door_plan.scene.objects["door"].object.attachments["handle"]
    there = pin.SE3(
        grasp.placement.rotation, grasp.placement.translation + np.array([0.0, 0.002, 0.0])
    )
    scene = with_attachments(
        door_plan.scene, {"handle": dataclasses.replace(grasp, placement=there)}
    )
    report = check(door_plan, scene=scene)
    found, drift = only(report), tool_drift(door_plan, scene)[:, 0]
    assert (found.constraint, found.subject, found.unit) == ("closure", "door.handle", "m")
    between = check(door_plan).closure_error  # the plan's own drift
    assert drift.max() - 1e-3 - 1e-9 <= found.amount <= drift.max() - 1e-3 + between
    assert report.closure_error == pytest.approx(found.amount + 1e-3)
    assert found.waypoint >= door_plan.trajectory.phases[1].first


def test_the_grasp_turns(door_plan: vkc.Plan) -> None:
    grasp = door_plan.scene.objects["door"].object.attachments["handle"]
    turned = grasp.placement * pin.SE3(pin.exp3(np.array([0.0, 0.0, 0.003])), np.zeros(3))
    scene = with_attachments(
        door_plan.scene, {"handle": dataclasses.replace(grasp, placement=turned)}
    )
    report = check(door_plan, scene=scene)
    found, drift = only(report), tool_drift(door_plan, scene)[:, 1]
    assert (found.constraint, found.subject, found.unit) == ("closure", "door.handle", "rad")
    between = check(door_plan).closure_angle
    assert drift.max() - 1e-3 - 1e-9 <= found.amount <= drift.max() - 1e-3 + between + 1e-6
    assert report.closure_angle == pytest.approx(found.amount + 1e-3)


def thinned(plan: vkc.Plan, every: int) -> Trajectory:
    """Return the planned motion with only every so many of the waypoints of its last phase, at their times."""
    full, last = plan.trajectory, plan.trajectory.phases[-1]
    keep = np.unique([*range(last.first + 1), *range(last.first, last.last, every), last.last])
    phases = (*full.phases[:-1], dataclasses.replace(last, last=len(keep) - 1))
    return dataclasses.replace(
        full, times=full.times[keep], positions=full.positions[keep], phases=phases, curve=None
    )


def test_the_grasp_drifts_only_between_waypoints(door_plan: vkc.Plan) -> None:
    sparse = thinned(door_plan, 10)
    report = check(door_plan, trajectory=sparse)
    drifts = [found for found in report.violations if found.constraint == "closure"]
    assert drifts, "\n".join(report.lines())
    assert {found.constraint for found in report.violations} <= {
        "closure",
        "clearance",
        "penetration",
        "velocity",
        "acceleration",
    }
    for found in drifts:
        assert sparse.times[found.waypoint] < found.time < sparse.times[found.waypoint + 1]
    assert (
        tool_drift(dataclasses.replace(door_plan, trajectory=sparse), door_plan.scene).max() <= 1e-3
    )


def test_two_kinds_of_drift_are_both_told(door_plan: vkc.Plan) -> None:
    grasp = door_plan.scene.objects["door"].object.attachments["handle"]
    off = grasp.placement * pin.SE3(
        pin.exp3(np.array([0.0, 0.0, 0.003])), np.array([0.0, 0.0, 0.003])
    )
    report = check(
        door_plan,
        scene=with_attachments(
            door_plan.scene, {"handle": dataclasses.replace(grasp, placement=off)}
        ),
    )
    assert names(report) == {("closure", "door.handle")}
    assert {found.unit for found in report.violations} == {"m", "rad"}


def test_the_hinge_leaves_before_the_knob_is_turned(door_plan: vkc.Plan) -> None:
    (latch,) = door_plan.scene.objects["door"].object.latches
    knob, hinge = (
        door_plan.trajectory.column("door.knob"),
        door_plan.trajectory.column("door.hinge"),
    )
    leaving = np.flatnonzero((hinge[1:] > 1e-4) & (hinge[:-1] <= latch.engaged_within))
    turned = min(knob[leaving].min(), knob[leaving + 1].min())
    scene = with_object(
        door_plan.scene, latches=(dataclasses.replace(latch, threshold=turned + 0.05),)
    )
    found = only(check(door_plan, scene=scene))
    assert (found.constraint, found.subject, found.unit) == ("latch", "door.hinge", "rad")
    assert found.waypoint in leaving
    assert 0.0 < found.amount <= 0.05 + 1e-9
    scene = with_object(
        door_plan.scene, latches=(dataclasses.replace(latch, threshold=turned - 1e-6),)
    )
    assert check(door_plan, scene=scene).ok


def by_itself(scene: Scene, hinge: np.ndarray, knob: np.ndarray) -> Trajectory:
    """Return a motion in which the door moves and the robot stands still."""
    rows = np.column_stack([np.tile(scene.start, (len(hinge), 1)), hinge, knob])
    names = (*scene.robot.coordinates.names, "door.hinge", "door.knob")
    return Trajectory(
        names,
        2.0 * np.arange(len(rows)),
        rows,
        (PhaseSpan("stand", 0, len(rows) - 1),),
        len(scene.start),
    )


@pytest.mark.parametrize(
    ("hinge", "knob", "short"),
    [
        ([0.0, 0.0, 0.3], [0.0, 0.5, 0.5], 0.0),  # turned, then pushed
        ([0.0, 0.3, 0.3], [0.0, 0.6, 0.6], 0.5),  # both at once: it leaves with the knob at 0
        ([0.0, 0.0, 0.3], [0.0, 0.4, 0.4], 0.1),
        (
            [0.0, 0.0, 0.3],
            [0.0, 0.6, 0.0],
            0.0,
        ),  # 0.6 − 0.6 · 0.05 / 0.3 = 0.5 where the latch's reach ends
        ([0.0, 0.0, 0.3], [0.0, 0.58, 0.0], 0.5 - 0.58 * 5 / 6),
        ([0.0, 0.0, -0.3], [0.0, 0.3, 0.3], 0.2),  # pulled
        ([0.3, 0.0, 0.0], [0.0, 0.0, 0.0], 0.0),  # shutting needs no turned knob
        ([0.3, 0.0, 0.3], [0.0, 0.0, 0.0], 0.5),  # shut and opened again
        ([0.3, -0.3, -0.3], [0.0, 0.0, 0.0], 0.5),  # through the frame to the other side
        ([0.1, 0.3, 0.3], [0.0, 0.0, 0.0], 0.0),  # ajar: the bolt is out of the lock
        ([0.04, 0.3, 0.3], [0.2, 0.2, 0.2], 0.3),  # ajar, but within the latch's reach
        ([0.04, 0.04, 0.3], [0.0, 0.6, 0.6], 0.0),  # it may rest ajar until the knob is turned
        (
            [0.0, 0.04, 0.3],
            [0.7, 0.5, 0.7],
            0.0,
        ),  # released as long as it is within reach, though on its way back
    ],
)
def test_latch(door_plan: vkc.Plan, hinge: list[float], knob: list[float], short: float) -> None:
    assert latch_shortfall(door_plan.scene, hinge, knob) == pytest.approx(
        short, abs=5e-3 if hinge[1] * knob[1] > 0 else 1e-6
    )


def test_a_latch_shorter_than_a_sample(door_plan: vkc.Plan) -> None:
    """It is not jumped over: 2 mrad lie between two samples."""
    assert latch_shortfall(
        door_plan.scene, [0.0, 0.0, 0.3], [0.0, 0.4, 0.4], reach=0.002
    ) == pytest.approx(0.1)
    assert latch_shortfall(
        door_plan.scene, [0.3, -0.305, -0.305], [0.0, 0.0, 0.0], reach=0.002
    ) == pytest.approx(0.5)
    assert latch_shortfall(door_plan.scene, [0.0, 0.0, 0.3], [0.0, 0.5, 0.5], reach=0.002) == 0.0
    assert latch_shortfall(door_plan.scene, [0.0, 0.0, 0.3], [0.0, 0.51, 0.0], reach=0.002) == 0.0


def latch_shortfall(
    base: Scene, hinge: list[float], knob: list[float], *, reach: float = 0.05
) -> float:
    """Return by how much the knob is not turned far enough, as validation sees it."""
    (latch,) = base.objects["door"].object.latches
    scene = with_object(base, latches=(dataclasses.replace(latch, engaged_within=reach),))
    scene = scene.with_state("door", {"hinge": hinge[0], "knob": knob[0]})
    report = validate(
        scene,
        [vkc.Actuate("door", {"hinge": hinge[-1]})],
        by_itself(scene, np.array(hinge), np.array(knob)),
    )
    found = [violation for violation in report.violations if violation.constraint == "latch"]
    assert {violation.subject for violation in found} <= {"door.hinge"}
    return sum(violation.amount for violation in found)


def test_a_rest_that_is_too_short_for_the_hand(door_plan: vkc.Plan) -> None:
    """The robot stands still for as long as was asked for when the motion was planned."""
    rests = door_plan.options.grasp_time
    assert check(door_plan, grasp_time=rests - 1e-9).ok
    found = only(check(door_plan, grasp_time=rests + 0.25))
    grasp = door_plan.trajectory.phases[1].first
    assert (found.constraint, found.subject, found.unit, found.waypoint) == (
        "dwell",
        "door.handle",
        "s",
        grasp,
    )
    assert found.time == pytest.approx(door_plan.trajectory.times[grasp])
    assert 0.0 < found.amount <= 0.25 + 1e-9
    assert not check(door_plan, grasp_time=rests + 0.25 - found.amount + 1e-4).ok


def test_nobody_holds_what_moves(door_plan: vkc.Plan) -> None:
    let_go = tuple(dataclasses.replace(phase, holds=()) for phase in door_plan.trajectory.phases)
    report = check(door_plan, trajectory=dataclasses.replace(door_plan.trajectory, phases=let_go))
    unheld = {found.subject: found for found in report.violations if found.constraint == "unheld"}
    assert set(unheld) == {"door.hinge", "door.knob"}
    assert {found.constraint for found in report.violations} <= {
        "unheld",
        "clearance",
    }  # the hand touches what it grasps
    hinge = door_plan.trajectory.column("door.hinge")
    assert unheld["door.hinge"].amount == pytest.approx(np.abs(hinge).max())
    assert hinge[unheld["door.hinge"].waypoint] == pytest.approx(hinge[np.argmax(np.abs(hinge))])
    assert "door is not grasped" in unheld["door.hinge"].detail


def test_a_joint_that_the_grasp_cannot_drive_moves(door_plan: vkc.Plan) -> None:
    """Whoever holds the panel does not turn the lever."""
    grasp = dataclasses.replace(
        door_plan.scene.objects["door"].object.attachments["handle"], link="panel"
    )
    report = check(door_plan, scene=with_attachments(door_plan.scene, {"handle": grasp}))
    assert "door.knob" in {
        found.subject for found in report.violations if found.constraint == "unheld"
    }
    assert "door.hinge" not in {
        found.subject for found in report.violations if found.constraint == "unheld"
    }


# --- goals and their order
# ----------------------------------------------------------------------------------------


# --- clearance
# ----------------------------------------------------------------------------------------------------


def beside_the_goal(gap: float) -> tuple[Scene, Trajectory]:
    """Return a hall with a crate so that the robot that stops at x = 1 has `gap` in front of it, and that drive."""
    crate = {"name": "crate", "type": "box", "size": [0.4, 2.0, 0.3], "position": [2.5, 0.0, 0.15]}
    scene = hall(obstacles=[crate])
    there = moved(scene.start, x=1.0)
    crate["position"] = [2.5 - scene.with_start(base=there[:3]).start_clearance() + gap, 0.0, 0.15]
    scene = hall(obstacles=[crate])
    assert scene.with_start(base=there[:3]).start_clearance() == pytest.approx(gap, abs=1e-6)
    return scene, through(scene, scene.start, there)


@pytest.mark.parametrize(
    ("gap", "short"), [(0.0195, 0.0), (0.0191, 0.0), (0.0185, 0.0005), (0.015, 0.004)]
)
def test_too_close_at_a_waypoint(gap: float, short: float) -> None:
    scene, motion = beside_the_goal(gap)
    report = validate(scene, [vkc.GoTo(1.0, 0.0)], motion, Options(dist_safe=0.02))
    assert report.clearance == pytest.approx(gap, abs=1e-5)
    if not short:
        assert report.ok, "\n".join(report.lines())
        return
    found = only(report)
    assert (found.constraint, found.subject, found.waypoint, found.unit) == (
        "clearance",
        "base_link – crate",
        40,
        "m",
    )
    assert found.amount == pytest.approx(short, abs=1e-5)


def test_penetration_at_a_waypoint() -> None:
    scene, motion = beside_the_goal(-0.03)
    found = only(validate(scene, [vkc.GoTo(1.0, 0.0)], motion))
    assert (found.constraint, found.subject, found.waypoint) == (
        "penetration",
        "base_link – crate",
        40,
    )
    assert found.amount == pytest.approx(0.03, abs=1e-5)


def test_penetration_between_waypoints_only() -> None:
    """A thin board across the way, both waypoints clear of it."""
    board = {"name": "board", "type": "box", "size": [0.005, 1.0, 0.2], "position": [2.0, 0.0, 0.1]}
    scene = hall(obstacles=[board])
    rows = np.array([scene.start, moved(scene.start, x=4.0)])
    motion = of_rows(scene, rows, dt=20.0)
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
    assert validate(hall(), [vkc.GoTo(4.0, 0.0)], motion).ok


def test_a_door_that_opens_into_something(door_plan: vkc.Plan) -> None:
    """What is held must keep clear too."""
    shape = coal.Box(0.3, 0.3, 1.0)
    place = pin.SE3(
        np.eye(3), np.array([3.35, 0.3, 1.5])
    )  # where the panel swings to, above the robot's base
    obstacles = (*door_plan.scene.obstacles, pin.GeometryObject("pillar", 0, place, shape))
    labels = (*door_plan.scene.obstacle_labels, "pillar")
    scene = dataclasses.replace(door_plan.scene, obstacles=obstacles, obstacle_labels=labels)
    assert ("penetration", "door.panel – pillar") in names(check(door_plan, scene=scene))


@pytest.mark.parametrize("name", ["base_x", "shoulder_pan_joint", "door.hinge"])
@pytest.mark.parametrize("jump", [1e3, 1e9])
def test_a_motion_that_jumps_is_refused_and_not_swept(
    door_plan: vkc.Plan, name: str, jump: float
) -> None:
    """A look every 5 mm and 10 mrad would be one at some hundred thousand configurations and more."""
    positions = door_plan.trajectory.positions.copy()
    positions[40:, door_plan.trajectory.names.index(name)] += jump
    report = check(
        door_plan,
        trajectory=dataclasses.replace(door_plan.trajectory, positions=positions, curve=None),
    )
    found = {v.constraint: v for v in report.violations}
    assert {"sampling", "velocity", "limit"} <= set(found)
    assert (found["sampling"].subject, found["sampling"].waypoint) == ("motion", 39)
    assert "collisions not checked" in found["sampling"].detail
    assert report.states == len(positions)


def fatter_lever(scene: Scene, by: float) -> Scene:
    """Return the scene with a lever that is thicker by `by` [m] all round."""
    placed: PlacedObject = scene.objects["door"]
    collision = placed.object.collision.copy()
    for shape in collision.geometryObjects:
        if shape.name.startswith("lever"):
            cylinder = shape.geometry
            shape.geometry = coal.Cylinder(cylinder.radius + by, 2 * cylinder.halfLength)
    return with_object(scene, collision=collision)


def test_the_hand_may_come_near_what_it_grasps_but_not_into_it(door_plan: vkc.Plan) -> None:
    """With a thicker lever the fingers are closer to it than dist_safe, then in it."""
    hand, times = door_plan.scene.robot.touch_links, door_plan.trajectory.times
    curves = compute_clearance_curves(door_plan.scene, door_plan.trajectory, times)
    gap = next(
        curve for curve in curves if curve.name == "gripper – what it grasps"
    ).distances.min()
    near = check(door_plan, scene=fatter_lever(door_plan.scene, gap - 0.008))
    assert not {subject for _, subject in names(near) if subject.split(" – ")[0] in hand}, (
        "\n".join(near.lines())
    )
    assert near.clearance < 0.0085
    inside = check(door_plan, scene=fatter_lever(door_plan.scene, gap + 0.008))
    found = [v for v in inside.violations if v.subject.split(" – ")[0] in hand]
    assert {v.constraint for v in found} == {"penetration"}
    assert {v.subject.split(" – ")[1] for v in found} == {"door.lever"}
    assert max(v.amount for v in found) == pytest.approx(0.008, abs=1e-3)
    grasp = validate(
        fatter_lever(door_plan.scene, gap - 0.008), [vkc.Grasp("door")], until_the_grasp(door_plan)
    )
    assert {v.constraint for v in grasp.violations if v.subject.split(" – ")[0] in hand} == set()


# --- what is no motion of this scene
# ------------------------------------------------------------------------------


def test_bad_trajectories(door_plan: vkc.Plan, empty: Scene) -> None:
    motion, steps = door_plan.trajectory, door_plan.steps
    with pytest.raises(UnknownNameError, match="coordinate") as caught:
        check(
            door_plan,
            trajectory=dataclasses.replace(motion, names=(*motion.names[:-1], "door.hing")),
        )
    assert caught.value.nearest == "door.hinge"
    with pytest.raises(InputError) as other:
        check(
            door_plan,
            trajectory=dataclasses.replace(
                motion, names=(motion.names[1], motion.names[0], *motion.names[2:])
            ),
        )
    assert other.value.field == "trajectory.names"
    for held, kind in (({"dor": "handle"}, "object"), ({"door": "handl"}, "attachment")):
        phases = (
            *motion.phases[:-1],
            dataclasses.replace(motion.phases[-1], holds=make_holds(held)),
        )
        with pytest.raises(UnknownNameError, match=kind) as caught:
            check(door_plan, trajectory=dataclasses.replace(motion, phases=phases))
        assert caught.value.field == "trajectory.phases[2].held"
        assert caught.value.nearest in ("door", "handle")
    phases = (
        *motion.phases[:-1],
        dataclasses.replace(motion.phases[-1], holds=make_holds({"door": "handle_free"})),
    )
    with pytest.raises(InputError, match="missing") as other:
        check(door_plan, trajectory=dataclasses.replace(motion, phases=phases))
    assert other.value.expected == "door.handle_free"
    with pytest.raises(UnknownNameError):
        validate(empty, steps, motion)
