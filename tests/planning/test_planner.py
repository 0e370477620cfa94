"""Plans of all kinds of steps succeed, and arguments of `plan` are checked."""

from __future__ import annotations

import dataclasses
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import (
    BALL,
    STICK,
    compute_grasp_pose,
    describe_stand,
    describe_table,
    lift,
    make_room,
)
from helpers.drives import make_hall

import vkc_pin as vkc
from vkc_pin.validation.validate import validate
from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.trajectory.wheels import make_rolling_limits
from vkc_pin.world.trajectory.world_model import World

HINGE = 1.2
FEW = vkc.Options(reach_waypoints=20)


@pytest.fixture(scope="module")
def demo() -> vkc.Plan:
    return vkc.plan(vkc.load_scene("door"), [vkc.Actuate("door", {"hinge": HINGE})])


def compute_tool_placement(scene: vkc.Scene, row: np.ndarray) -> pin.SE3:
    """Return the tool's placement at one row of a trajectory, by numeric Pinocchio."""
    model = scene.robot.model
    data = model.createData()
    q = np.concatenate([row[:2], [np.cos(row[2]), np.sin(row[2])], row[3 : model.nv]])
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId(scene.robot.tool_frame)].copy()


def compute_handle_placement(hinge: float, knob: float) -> pin.SE3:
    """Return the tool's placement at the door's handle, from the URDF."""
    model = pin.buildModelFromUrdf(str(find_resource_folder("scenes") / "objects" / "door.urdf"))
    data, q = model.createData(), pin.neutral(model)
    for name, value in (("hinge", hinge), ("knob", knob)):
        q[model.joints[model.getJointId(name)].idx_q] = value
    pin.framesForwardKinematics(model, data, q)
    lever = data.oMf[model.getFrameId("lever")]
    # The tool closes (x) along the lever's z axis and approaches (z) along the lever's x axis.
    grasp = pin.SE3(
        np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]),
        np.array([-0.105, 0.07, 0.0]),
    )
    return pin.SE3(np.eye(3), np.array([2.55, 0.44, 0.0])) * lever * grasp


def measure_error(first: pin.SE3, second: pin.SE3) -> tuple[float, float]:
    """Return the distance [m] and the angle [rad] between two placements."""
    error = first.inverse() * second
    return float(np.linalg.norm(error.translation)), float(np.linalg.norm(pin.log3(error.rotation)))


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


def test_demo_holds_the_handle(demo: vkc.Plan) -> None:
    reach, *holds = demo.trajectory.phases
    assert reach.held == {}
    assert [dict(phase.held) for phase in holds] == [{"door": "handle"}] * len(holds)
    times = np.linspace(demo.trajectory.times[holds[0].first], demo.trajectory.times[-1], 150)
    index = [demo.trajectory.names.index(name) for name in ("door.hinge", "door.knob")]
    for row in demo.trajectory.at(times):
        distance, angle = measure_error(
            compute_tool_placement(demo.scene, row), compute_handle_placement(*row[index])
        )
        assert distance <= 1e-3
        assert angle <= 1e-3


def test_demo_keeps_velocity_and_acceleration_limits(demo: vkc.Plan) -> None:
    trajectory, robot = demo.trajectory, demo.scene.robot
    np.testing.assert_allclose(trajectory.positions[0, :9], demo.scene.start, atol=1e-9)
    times = np.linspace(trajectory.times[0], trajectory.times[-1], 20_001)
    rows, step = trajectory(times)[:, :9], times[1] - times[0]
    speeds = np.diff(rows, axis=0) / step  # finite differences, so that jumps would show
    assert np.all(np.abs(speeds) <= robot.velocity * 1.001 + 1e-9)
    speeds = np.vstack([np.zeros(9), speeds, np.zeros(9)])
    assert np.all(np.abs(np.diff(speeds, axis=0)) <= robot.acceleration * step * 1.001 + 1e-9)
    # The robot waits at the handle for the gripper to close.
    grasp = trajectory.phases[0].last
    np.testing.assert_array_equal(trajectory.positions[grasp], trajectory.positions[grasp + 1])
    assert trajectory.times[grasp + 1] - trajectory.times[grasp] == pytest.approx(
        demo.options.grasp_time
    )
    # The base drives to the handle and along the door's arc without detours.
    assert trajectory.base_path_length() < 6.0


def test_metrics(demo: vkc.Plan) -> None:
    m = demo.metrics
    assert m["duration"] == demo.trajectory.times[-1]
    assert m["clearance"] == demo.report.clearance > 0.0
    assert m["closure_error"] == demo.report.closure_error
    stages = ("initialization", "coal", "casadi", "ipopt", "validation")
    parts = sum(m[f"time_{stage}"] for stage in stages)
    assert 0.0 < parts <= m["planning_time"] * 1.05
    assert m["rounds"] == len(demo.history)
    ends = [*(k for k, row in enumerate(demo.history) if row["round"] == 1), len(demo.history)]
    assert m["iterations"] == sum(demo.history[k - 1]["iterations"] for k in ends[1:])


def test_tool_reaches_a_pose() -> None:
    scene = vkc.load_scene("door")
    target = pin.SE3(pin.rpy.rpyToMatrix(0.0, np.pi / 2, 0.3), np.array([1.5, 0.5, 1.0]))
    plan = vkc.plan(scene, [vkc.Reach(target)], options=FEW)
    check_success(plan)
    distance, angle = measure_error(
        compute_tool_placement(scene, plan.trajectory.positions[-1]), target
    )
    assert distance <= 1e-3
    assert angle <= 1e-3


@pytest.mark.parametrize("yaw", [1.0])
def test_base_reaches_a_goal(yaw: float | None) -> None:
    plan = vkc.plan(vkc.load_scene("door"), [vkc.GoTo(0.5, 0.0, yaw)], options=FEW)
    check_success(plan)
    x, y, heading = plan.trajectory.positions[-1, :3]
    assert np.hypot(x - 0.5, y) <= 1e-3
    if yaw is not None:
        assert abs((heading - yaw + np.pi) % (2 * np.pi) - np.pi) <= 1e-3


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


def move_back(scene: vkc.Scene) -> vkc.Scene:
    return scene.with_start(base=[-0.8, -0.2, 0.3], arm=scene.robot.home)


def compute_final_placement(plan: vkc.Plan, name: str) -> pin.SE3:
    world = World(plan.scene)
    return world.get_placement(name, world.compute_positions(plan.trajectory)[-1])


@pytest.mark.parametrize("simultaneous", [True, False], ids=["jointly", "step by step"])
def test_pick_and_place(simultaneous: bool) -> None:
    scene, aside = move_back(make_room(describe_table())), lift(STICK, [0.0, 0.5, 0.0])
    plan = vkc.plan(
        scene,
        [vkc.Grasp("stick"), vkc.Place("stick", aside), vkc.GoTo(-1.0, 0.0)],
        options=FEW,
        simultaneous=simultaneous,
    )
    check_success(plan)
    assert max(measure_error(compute_final_placement(plan, "stick"), aside)) <= 1e-3
    held = [phase for phase in plan.trajectory.phases if phase.held]
    assert {tuple(phase.held.items()) for phase in held} == {(("stick", "grip"),)}
    values = [get_column(plan, f"stick.grip_{name}")[held[0].first] for name in ("slide", "turn")]
    first, last = plan.trajectory.positions[held[0].first], plan.trajectory.positions[held[-1].last]
    assert (
        max(
            measure_error(
                compute_tool_placement(scene, first), compute_grasp_pose(STICK, values=values)
            )
        )
        <= 1e-3
    )
    assert (
        max(
            measure_error(
                compute_tool_placement(scene, last), compute_grasp_pose(aside, values=values)
            )
        )
        <= 2e-3
    )
    assert np.hypot(*(plan.trajectory.positions[-1, :2] - [-1.0, 0.0])) <= 1e-3


def test_touch_and_release() -> None:
    scene, point = move_back(make_room(describe_table())), np.array([0.8, 1.0, 0.9])
    plan = vkc.plan(
        scene, [vkc.Touch("stick.tip", point), vkc.Release(), vkc.GoTo(-1.0, 0.0)], options=FEW
    )
    check_success(plan)
    last = plan.trajectory.phases[-1]
    assert dict(last.held) == {}
    tip = compute_final_placement(plan, "stick").act(
        np.array([0.0, 0.25, 0.0])
    )  # it stays at the release
    np.testing.assert_allclose(tip, point, rtol=0.0, atol=1e-3)


def test_object_is_fetched_with_a_tool() -> None:
    scene = make_room(
        describe_stand(), describe_stand("stand_2", aside=0.3), objects=("stick", "ball")
    ).with_held({"stick": "grip"})
    aside = lift(BALL, [0.0, 0.3, 0.0])
    steps = [vkc.Grasp("ball", "pull", "stick.tip"), vkc.Place("ball", aside), vkc.GoTo(-0.6, -0.3)]
    plan = vkc.plan(scene.with_start(base=[-0.6, -0.3, 0.0]), steps, options=FEW)
    check_success(plan)
    assert max(measure_error(compute_final_placement(plan, "ball"), aside)) <= 1e-3
    assert {"ball": "stick.tip"} in [phase["by"] for phase in plan.trajectory.to_dict()["phases"]]
    assert dict(plan.trajectory.phases[-1].held) == {"stick": "grip"}


def test_object_placed_at_a_point_is_upright() -> None:
    plan = vkc.plan(
        move_back(make_room(describe_table())),
        [vkc.Place("stick", (0.8, 0.6, 0.551))],
        options=FEW,
    )
    check_success(plan)
    placement = compute_final_placement(plan, "stick")
    np.testing.assert_allclose(placement.translation, [0.8, 0.6, 0.551], rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(placement.rotation[2], [0.0, 0.0, 1.0], rtol=0.0, atol=2e-3)


def test_callback_is_called_in_every_round() -> None:
    rows: list[vkc.Iteration] = []
    plan = vkc.plan(vkc.load_scene("door"), [vkc.Grasp("door")], callback=rows.append)
    assert [dataclasses.asdict(row) for row in rows] == list(plan.history)
    assert all(isinstance(row, vkc.Iteration) for row in rows)
    assert [row.round for row in rows] == list(range(1, len(rows) + 1))
    columns = {
        "round",
        "iterations",
        "objective",
        "clearance",
        "shortfall",
        "pose_error",
        "step",
        "radius",
        "penalty",
    }
    assert columns <= {field.name for field in dataclasses.fields(vkc.Iteration)}


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
    arm = scene.start[3:].copy()
    arm[0], arm[5] = scene.robot.lower[3], scene.robot.upper[8]
    outside = arm + np.array([-1e-8, 0.0, 0.0, 0.0, 0.0, 1e-8])
    check_success(vkc.plan(scene.with_start(arm=outside), [vkc.GoTo(-1.0, 0.5)], options=FEW))
    # A scene that is constructed directly keeps the rounding.
    raw = dataclasses.replace(scene, start=np.concatenate([scene.start[:3], outside]))
    plan = vkc.plan(raw, [vkc.GoTo(-1.0, 0.5)], options=FEW)
    check_success(plan)
    np.testing.assert_array_equal(plan.trajectory.positions[0], raw.start)


@pytest.mark.parametrize("gap", [0.0005])
def test_start_closer_than_dist_safe_is_accepted(gap: float) -> None:
    wall = {
        "name": "wall",
        "type": "box",
        "size": [0.1, 2.0, 0.5],
        "position": [0.545 + gap, 0.0, 0.25],
    }
    scene = make_hall(obstacles=[wall])
    assert 0.0 < scene.start_clearance() < FEW.dist_safe / 2 + 1e-6
    plan = vkc.plan(scene, [vkc.GoTo(-1.0, 0.5)], options=FEW)
    check_success(plan)
    assert plan.report.clearance == pytest.approx(scene.start_clearance(), abs=1e-6)


@pytest.mark.parametrize(
    "step",
    [vkc.Reach((1.5, 1.0, 0.9, 0.0, np.pi / 2, 0.0)), vkc.GoTo(0.0, 1.0, 0.0)],
    ids=repr,
)
def test_differential_base_does_not_slip(step: Any) -> None:
    plan = vkc.plan(make_hall(base="differential"), [step])
    check_success(plan)
    x, y, yaw = plan.trajectory.positions[:, :3].T
    heading = (yaw[1:] + yaw[:-1]) / 2
    sideways = np.cos(heading) * np.diff(y) - np.sin(heading) * np.diff(x)
    assert np.abs(sideways).max() < 1e-4
    assert plan.metrics["base_path_length"] > 0.3
    slipping = vkc.plan(make_hall(base="omni"), [step])
    x, y, yaw = slipping.trajectory.positions[:, :3].T
    heading = (yaw[1:] + yaw[:-1]) / 2
    assert np.abs(np.cos(heading) * np.diff(y) - np.sin(heading) * np.diff(x)).max() > 1e-3


@pytest.mark.parametrize(
    "step",
    [vkc.Reach((1.5, 1.0, 0.9, 0.0, np.pi / 2, 0.0)), vkc.GoTo(0.0, 1.0, 0.0)],
    ids=repr,
)
def test_steered_base_keeps_its_turning_radius(step: Any) -> None:
    plan = vkc.plan(make_hall(base="ackermann", turning_radius=0.8), [step])
    check_success(plan)
    along, aside, turn = make_rolling_limits(plan.scene.robot).compute_steps(
        plan.trajectory.positions
    )
    assert np.abs(aside).max() < 1e-4
    assert (0.8 * np.abs(turn) - np.abs(along)).max() < 1e-4
    assert plan.metrics["base_path_length"] > 0.3


def test_wheel_speed_limits_the_motion(tmp_path: Path) -> None:
    files = find_resource_folder("robots") / "husky_ur5e"
    text = (
        (files / "robot.yaml").read_text(encoding="utf-8").replace("speed: 6.057", "speed: 1.2114")
    )
    for file in files.iterdir():
        if file.name != "robot.yaml":
            (tmp_path / file.name).symlink_to(file)
    (tmp_path / "robot.yaml").write_text(text, encoding="utf-8")
    quick = make_hall(base="differential")
    slow = dataclasses.replace(quick, robot=vkc.load_robot(tmp_path, base="differential"))
    rim_speeds = []
    for scene in (quick, slow):
        plan = vkc.plan(scene, [vkc.GoTo(4.0, 1.0, 1.0)])
        check_success(plan)
        along, _, turn = make_rolling_limits(scene.robot).compute_steps(plan.trajectory.positions)
        rim_speeds.append(
            (np.abs(along) + scene.robot.wheels.track / 2 * np.abs(turn))
            / np.diff(plan.trajectory.times)
        )
    assert rim_speeds[0].max() > 0.3
    assert 0.1 < rim_speeds[1].max() <= 0.2 * 1.001


def test_fixed_base_stays() -> None:
    plan = vkc.plan(
        make_hall(base="fixed"), [vkc.Reach((0.5, 0.4, 1.0, 0.0, np.pi / 2, 0.0))], options=FEW
    )
    check_success(plan)
    assert np.ptp(plan.trajectory.positions[:, :3], axis=0).max() == 0.0


def test_another_robot_reaches_a_pose() -> None:
    document = {
        "robot": "panda",
        "start": {"base": [0.0, 0.0, 0.0], "arm": "home"},
        "obstacles": [
            {"name": "post", "type": "box", "size": [0.1, 0.1, 1.0], "position": [0.9, -0.5, 0.5]}
        ],
    }
    scene = vkc.Scene.from_document(document)
    target = pin.SE3(pin.rpy.rpyToMatrix(np.pi, 0.0, 0.0), np.array([1.2, 0.3, 0.6]))
    plan = vkc.plan(scene, [vkc.Reach(target)])
    check_success(plan)
    assert plan.trajectory.names[:4] == ("base_x", "base_y", "base_yaw", "panda_joint1")
    assert (
        max(measure_error(compute_tool_placement(scene, plan.trajectory.positions[-1]), target))
        <= 1e-3
    )


INVALID_ARGUMENTS: dict[str, tuple[dict[str, Any], str, str]] = {
    "unknown initialization": (
        {"initialization": "interpolate"},
        "initialization",
        "did you mean 'interpolated'",
    ),
    "no time": ({"time_limit": 0.0}, "time_limit", "more than 0"),
    "negative time": ({"time_limit": -1.0}, "time_limit", "-1.0"),
    "endless time": ({"time_limit": float("inf")}, "time_limit", "inf"),
    "no effort": ({"max_evaluations": 0}, "max_evaluations", "at least 1"),
    "half a unit": ({"max_evaluations": 1.5}, "max_evaluations", "1.5"),
    "no number": ({"time_limit": float("nan")}, "time_limit", "nan"),
    "time as text": ({"time_limit": "5"}, "time_limit", "'5'"),
    "options as a dictionary": ({"options": {"dt": 0.1}}, "options", "Options"),
    "negative seed": ({"seed": -1}, "seed", "-1"),
    "seed in between": ({"seed": 0.5}, "seed", "0.5"),
    "no list": ({"steps": 5}, "steps", "a list of steps"),
    "None": ({"steps": None}, "steps", "a list of steps"),
    "one step alone": ({"steps": vkc.GoTo(0.0, 0.0)}, "steps", "a list of steps"),
    "no steps": ({"steps": []}, "steps", "at least one step"),
    "not a step": (
        {"steps": [vkc.GoTo(0.0, 0.0), "open"]},
        "steps[1]",
        "Reach, Grasp, Actuate, GoTo, Touch, Place, Release",
    ),
    "scene by name": ({"scene": "door"}, "scene", "a Scene"),
    "unknown object": ({"steps": [vkc.Actuate("dor", {"hinge": 1.0})]}, "steps[0].object", "dor"),
}


@pytest.mark.parametrize("case", INVALID_ARGUMENTS.values(), ids=INVALID_ARGUMENTS)
def test_invalid_arguments(case: tuple[dict[str, Any], str, str]) -> None:
    arguments, field, text = case
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
    assert plan.success, plan.summary()
    assert compute_tool_placement(scene, plan.trajectory.positions[-1]).isApprox(target, 2e-3)
    motion, steps = plan.trajectory, plan.steps
    assert validate(plan.scene, steps, motion, FEW).ok
    stricter = validate(plan.scene, steps, motion, dataclasses.replace(FEW, self_distance=0.2))
    assert {violation.constraint for violation in stricter.violations} == {"clearance"}
