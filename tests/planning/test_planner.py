"""Plans of all kinds of steps succeed, and arguments of `plan` are checked."""

from __future__ import annotations

import dataclasses
import os
import signal
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import (
    BALL,
    STICK,
    compute_grasp_pose,
    describe_box,
    describe_stand,
    describe_table,
    lift,
    make_room,
)
from helpers.drawers import compute_tool_pose
from helpers.drives import make_hall

import vkc_pin as vkc
from vkc_pin.world.trajectory.world_model import World

HINGE = 1.2
FEW = vkc.Options(reach_waypoints=20)


@pytest.fixture(scope="module")
def demo() -> vkc.Plan:
    return vkc.plan(vkc.load_scene("door"), [vkc.Actuate("door", {"hinge": HINGE})])


def measure_error(first: pin.SE3, second: pin.SE3) -> float:
    """Return the distance [m] or the angle [rad] between two placements; the larger counts."""
    error = first.inverse() * second
    return float(max(np.linalg.norm(error.translation), np.linalg.norm(pin.log3(error.rotation))))


def get_column(plan: vkc.Plan, name: str) -> np.ndarray:
    return plan.trajectory.column(name)


def check_success(plan: vkc.Plan) -> None:
    assert plan.success, plan.summary()
    assert plan.status == "success"
    again = vkc.validate(plan.scene, plan.steps, plan.trajectory, plan.options)
    assert again.ok, again.lines()
    assert again.clearance == plan.report.clearance


def test_demo_opens_the_door(demo: vkc.Plan) -> None:
    check_success(demo)
    hinge, knob = get_column(demo, "door.hinge"), get_column(demo, "door.knob")
    assert (hinge[0], knob[0]) == (0.0, 0.0)
    assert hinge[-1] == pytest.approx(HINGE, abs=1e-3)
    assert np.all(knob[hinge > 1e-4] >= 0.5 - 1e-4)  # the latch holds until the lever is turned
    motion = demo.trajectory
    reach, *holds = motion.phases
    assert reach.held == {}
    assert [dict(phase.held) for phase in holds] == [{"door": "handle"}] * len(holds)
    # The robot waits at the handle for the gripper to close.
    np.testing.assert_array_equal(motion.positions[reach.last], motion.positions[reach.last + 1])
    waited = motion.times[reach.last + 1] - motion.times[reach.last]
    assert waited == pytest.approx(demo.options.grasp_time)
    # The base drives to the handle and along the door's arc without detours.
    assert motion.base_path_length() < 6.0
    metrics = demo.metrics
    assert metrics["duration"] == motion.times[-1]
    assert metrics["clearance"] == demo.report.clearance > 0.0
    assert metrics["closure_error"] == demo.report.closure_error


def test_drive_through_the_opened_door() -> None:
    scene = vkc.load_scene("door").with_start(base=[0.8, -0.2, 0.0])
    plan = vkc.plan(scene, [vkc.Actuate("door", {"hinge": 1.5}), vkc.GoTo(3.9, -0.3)])
    check_success(plan)
    assert get_column(plan, "base_x")[-1] > 3.8  # beyond the wall at x = 2.55
    crossing = int(np.argmax(get_column(plan, "base_x") > 2.55))
    assert -0.535 < get_column(plan, "base_y")[crossing] < 0.44  # through the opening
    let_go = plan.trajectory.phases[-1]
    assert let_go.held == {}
    assert np.ptp(get_column(plan, "door.hinge")[let_go.first :]) == 0.0
    assert get_column(plan, "door.hinge")[-1] == pytest.approx(1.5, abs=1e-3)


def make_room_behind() -> vkc.Scene:
    """Return a room with a stick on a table, and the robot 0.8 m behind its usual place."""
    scene = make_room(describe_table())
    return scene.with_start(base=[-0.8, -0.2, 0.3], arm=scene.robot.home)


def compute_final_placement(plan: vkc.Plan, name: str) -> pin.SE3:
    world = World(plan.scene)
    return world.get_placement(name, world.compute_positions(plan.trajectory)[-1])


@pytest.mark.parametrize("simultaneous", [True, False], ids=["jointly", "step by step"])
def test_pick_and_place(simultaneous: bool) -> None:
    scene, aside = make_room_behind(), lift(STICK, [0.0, 0.5, 0.0])
    steps = [vkc.Grasp("stick"), vkc.Place("stick", aside), vkc.GoTo(-1.0, 0.0)]
    plan = vkc.plan(scene, steps, options=FEW, simultaneous=simultaneous)
    check_success(plan)
    assert measure_error(compute_final_placement(plan, "stick"), aside) <= 1e-3
    held = [phase for phase in plan.trajectory.phases if phase.held]
    assert {tuple(phase.held.items()) for phase in held} == {(("stick", "grip"),)}
    values = [get_column(plan, f"stick.grip_{name}")[held[0].first] for name in ("slide", "turn")]
    for waypoint, placement in ((held[0].first, STICK), (held[-1].last, aside)):
        tool = compute_tool_pose(scene, plan.trajectory.positions[waypoint])
        assert measure_error(tool, compute_grasp_pose(placement, values=values)) <= 2e-3
    assert np.hypot(*(plan.trajectory.positions[-1, :2] - [-1.0, 0.0])) <= 1e-3


def test_touch_and_release() -> None:
    point = np.array([0.8, 1.0, 0.9])
    release = vkc.Release(unsupported=True)
    steps = [vkc.Touch("stick.tip", point), release, vkc.GoTo(-1.0, 0.0)]
    plan = vkc.plan(make_room_behind(), steps, options=FEW)
    check_success(plan)
    assert dict(plan.trajectory.phases[-1].held) == {}
    # The stick stays where it is released.
    tip = compute_final_placement(plan, "stick").act(np.array([0.0, 0.25, 0.0]))
    np.testing.assert_allclose(tip, point, rtol=0.0, atol=1e-3)


def test_object_is_fetched_with_a_tool() -> None:
    stands = (describe_stand(), describe_stand("stand_2", aside=0.3))
    scene = make_room(*stands, objects=("stick", "ball")).with_held({"stick": "grip"})
    aside = lift(BALL, [0.0, 0.3, 0.0])
    steps = [vkc.Grasp("ball", "pull", "stick.tip"), vkc.Place("ball", aside), vkc.GoTo(-0.6, -0.3)]
    plan = vkc.plan(scene.with_start(base=[-0.6, -0.3, 0.0]), steps, options=FEW)
    check_success(plan)
    assert measure_error(compute_final_placement(plan, "ball"), aside) <= 1e-3
    assert {"ball": "stick.tip"} in [phase["by"] for phase in plan.trajectory.to_dict()["phases"]]
    assert dict(plan.trajectory.phases[-1].held) == {"stick": "grip"}


def test_callback_is_called_in_every_round() -> None:
    rows: list[vkc.Iteration] = []
    plan = vkc.plan(vkc.load_scene("door"), [vkc.Grasp("door")], callback=rows.append)
    assert [dataclasses.asdict(row) for row in rows] == list(plan.history)
    assert [row.round for row in rows] == list(range(1, len(rows) + 1))


def test_errors_of_the_callback_are_raised() -> None:
    def fail(row: vkc.Iteration) -> None:
        raise RuntimeError("mine")

    with pytest.raises(RuntimeError, match="mine"):
        vkc.plan(make_hall(), [vkc.GoTo(1.0, 0.0)], callback=fail, options=FEW)


@pytest.mark.parametrize("rounds", [0, 2])
def test_time_limit_bounds_the_rounds(
    demo: vkc.Plan, rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the patched clock every round takes a day."""
    real, day, done = time.perf_counter, 86400.0, list[vkc.Iteration]()
    monkeypatch.setattr(time, "perf_counter", lambda: real() + day * len(done))
    limit = (rounds - 0.5) * day if rounds else 1e-9
    plan = vkc.plan(
        demo.scene, demo.steps, initialization="stationary", time_limit=limit, callback=done.append
    )
    assert plan.status == "time limit"
    assert not plan.success
    assert len(done) == plan.metrics["rounds"] == rounds
    assert plan.metrics["planning_time"] > limit
    assert np.isfinite(plan.trajectory.positions).all()
    assert plan.report.violations
    assert "FAILED, time limit" in plan.summary()


@pytest.fixture
def ctrl_c() -> Iterator[Any]:
    """Return a function that sends SIGINT from another thread after a delay [s]."""
    timers: list[threading.Timer] = []

    def press(delay: float) -> None:
        timer = threading.Timer(delay, os.kill, (os.getpid(), signal.SIGINT))
        timers.append(timer)
        timer.start()

    yield press
    for timer in timers:
        timer.join()


@pytest.mark.parametrize("delay", [0.0, 0.2])
def test_ctrl_c_returns_the_best_trajectory(demo: vkc.Plan, ctrl_c: Any, delay: float) -> None:
    rows: list[vkc.Iteration] = []

    def callback(row: vkc.Iteration) -> None:
        rows.append(row)
        if len(rows) == 2:
            ctrl_c(delay)
            if not delay:
                time.sleep(0.1)

    before = signal.getsignal(signal.SIGINT)
    options = dataclasses.replace(demo.options, max_outer=100)
    plan = vkc.plan(
        demo.scene, demo.steps, initialization="stationary", callback=callback, options=options
    )
    assert plan.status == "interrupted"
    assert not plan.success
    assert plan.report.violations
    assert 2 <= len(rows) < 50
    assert signal.getsignal(signal.SIGINT) is before


def test_start_outside_its_limits_by_rounding_is_accepted() -> None:
    scene = make_hall()
    outside = scene.start.copy()
    outside[3] = scene.robot.lower[3] - 1e-8
    outside[8] = scene.robot.upper[8] + 1e-8
    # A scene that is constructed directly keeps the rounding.
    raw = dataclasses.replace(scene, start=outside)
    for start in (scene.with_start(arm=outside[3:]), raw):
        plan = vkc.plan(start, [vkc.GoTo(-1.0, 0.5)], options=FEW)
        check_success(plan)
    np.testing.assert_array_equal(plan.trajectory.positions[0], outside)


def test_start_closer_than_dist_safe_is_accepted() -> None:
    wall = describe_box("wall", [0.1, 2.0, 0.5], [0.5455, 0.0, 0.25])
    scene = make_hall(obstacles=[wall])
    assert 0.0 < scene.start_clearance() < FEW.dist_safe / 2 + 1e-6
    plan = vkc.plan(scene, [vkc.GoTo(-1.0, 0.5)], options=FEW)
    check_success(plan)
    assert plan.report.clearance == pytest.approx(scene.start_clearance(), abs=1e-6)


@pytest.mark.parametrize("goal", [0.0, -0.8])
def test_door_is_closed_onto_its_latch_or_swung_past_it(goal: float) -> None:
    scene = vkc.load_scene("door").with_state("door", {"hinge": 0.6})
    plan = vkc.plan(scene, [vkc.Actuate("door", {"hinge": goal})])
    check_success(plan)
    hinge, knob = (get_column(plan, f"door.{name}") for name in ("hinge", "knob"))
    assert hinge[-1] == goal
    within = np.abs(hinge) <= 0.05  # where the latch acts
    if goal == 0.0:
        assert np.flatnonzero(within).tolist() == [len(hinge) - 1]
        assert knob.max() < 0.5
    else:
        assert within.any()
        assert knob[within].min() > 0.5


def compute_rolling(plan: vkc.Plan) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the distance ahead and aside and the turn of every step, along the mean heading."""
    dx, dy, turn = np.diff(plan.trajectory.positions[:, :3], axis=0).T
    heading = plan.trajectory.positions[:-1, 2] + turn / 2
    ahead = np.cos(heading) * dx + np.sin(heading) * dy
    return ahead, np.cos(heading) * dy - np.sin(heading) * dx, turn


@pytest.mark.parametrize(
    "step",
    [vkc.Reach((1.5, 1.0, 0.9, 0.0, np.pi / 2, 0.0)), vkc.GoTo(0.0, 1.0, 0.0)],
    ids=repr,
)
def test_wheels_do_not_slip_and_keep_the_turning_radius(step: Any) -> None:
    for radius, scene in (
        (0.0, make_hall(base="differential")),
        (0.8, make_hall(base="ackermann", turning_radius=0.8)),
    ):
        plan = vkc.plan(scene, [step])
        check_success(plan)
        ahead, aside, turn = compute_rolling(plan)
        assert np.abs(aside).max() < 1e-4
        # Arcs are longer than their chords.
        assert (radius * np.abs(turn) - np.abs(ahead / np.sinc(turn / 2 / np.pi))).max() < 1e-4
        assert plan.metrics["base_path_length"] > 0.3
    _, slip, _ = compute_rolling(vkc.plan(make_hall(base="omni"), [step]))
    assert np.abs(slip).max() > 1e-3


def test_wheel_speed_limits_the_motion() -> None:
    quick = make_hall(base="differential")
    wheels = quick.robot.wheels
    assert wheels is not None
    slower = wheels.model_copy(update={"speed": 0.2 * wheels.speed})
    slow = dataclasses.replace(quick, robot=dataclasses.replace(quick.robot, wheels=slower))
    rim_speeds = []
    for scene in (quick, slow):
        plan = vkc.plan(scene, [vkc.GoTo(4.0, 1.0, 1.0)])
        check_success(plan)
        ahead, _, turn = compute_rolling(plan)
        rims = np.abs(ahead) + wheels.track / 2 * np.abs(turn)
        rim_speeds.append((rims / np.diff(plan.trajectory.times)).max())
    assert rim_speeds[0] > 0.3
    assert 0.1 < rim_speeds[1] <= slower.rim_speed * 1.001


def test_fixed_base_stays() -> None:
    plan = vkc.plan(
        make_hall(base="fixed"), [vkc.Reach((0.5, 0.4, 1.0, 0.0, np.pi / 2, 0.0))], options=FEW
    )
    check_success(plan)
    assert np.ptp(plan.trajectory.positions[:, :3], axis=0).max() == 0.0


def test_another_robot_reaches_a_pose() -> None:
    post = describe_box("post", [0.1, 0.1, 1.0], [0.9, -0.5, 0.5])
    start = {"base": [0.0, 0.0, 0.0], "arm": "home"}
    scene = vkc.Scene.from_document({"robot": "panda", "start": start, "obstacles": [post]})
    target = pin.SE3(pin.rpy.rpyToMatrix(np.pi, 0.0, 0.0), np.array([1.2, 0.3, 0.6]))
    plan = vkc.plan(scene, [vkc.Reach(target)])
    check_success(plan)
    assert plan.trajectory.names[:4] == ("base_x", "base_y", "base_yaw", "panda_joint1")
    tool = compute_tool_pose(scene, plan.trajectory.positions[-1])
    assert measure_error(tool, target) <= 1e-3


@pytest.mark.parametrize(
    ("arguments", "field", "text"),
    [
        ({"initialization": "interpolate"}, "initialization", "did you mean 'interpolated'"),
        ({"time_limit": 0.0}, "time_limit", "more than 0"),
        ({"time_limit": float("-inf")}, "time_limit", "-inf"),
        ({"time_limit": float("nan")}, "time_limit", "nan"),
        ({"time_limit": "5"}, "time_limit", "'5'"),
        ({"max_evaluations": 0}, "max_evaluations", "at least 1"),
        ({"options": {"dt": 0.1}}, "options", "Options"),
        ({"seed": -1}, "seed", "-1"),
        ({"progress": 1}, "progress", "wrong type of argument"),
        ({"perturbation": -0.1}, "perturbation", "-0.1"),
        ({"perturbation": float("inf")}, "perturbation", "inf"),
        ({"steps": 5}, "steps", "a list of steps"),
        ({"steps": vkc.GoTo(0.0, 0.0)}, "steps", "a list of steps"),
        ({"steps": []}, "steps", "at least one step"),
        ({"steps": [vkc.GoTo(0.0, 0.0), "open"]}, "steps[1]", "Reach, Grasp, Actuate, GoTo"),
        ({"scene": "door"}, "scene", "a Scene"),
        ({"steps": [vkc.Actuate("dor", {"hinge": 1.0})]}, "steps[0].object", "dor"),
    ],
    ids=str,
)
def test_invalid_arguments(arguments: dict[str, Any], field: str, text: str) -> None:
    call: dict[str, Any] = {"scene": make_hall(), "steps": [vkc.GoTo(1.0, 0.0)], **arguments}
    with pytest.raises(vkc.InputError) as caught:
        vkc.plan(call.pop("scene"), call.pop("steps"), **call)
    assert caught.value.field == field
    assert text in str(caught.value)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:.*links overlap at the default home")
def test_robot_from_a_urdf_alone_reaches_a_pose() -> None:
    scene = vkc.Scene.from_document({"robot": "tiago", "start": {"base": [0.0, 0.0, 0.0]}})
    assert scene.robot.tight["arm_2_link", "torso_lift_link"] == pytest.approx(0.0188, abs=1e-4)
    target = pin.SE3(np.eye(3), np.array([1.5, 0.4, 0.9]))
    plan = vkc.plan(scene, [vkc.Reach(target)], options=FEW)
    check_success(plan)
    assert compute_tool_pose(scene, plan.trajectory.positions[-1]).isApprox(target, 2e-3)
    stricter = dataclasses.replace(FEW, self_distance=0.2)
    violations = vkc.validate(scene, plan.steps, plan.trajectory, stricter).violations
    assert {violation.constraint for violation in violations} == {"clearance"}
