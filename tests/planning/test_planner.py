from __future__ import annotations

import dataclasses
import hashlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from helpers.carrying import BALL, STICK, lifted, room, stand, table, tool_at
from helpers.drives import hall

import vkc_pin as vkc
from vkc_pin.validation.validate import validate
from vkc_pin.world.files.resources import find_resource_folder
from vkc_pin.world.trajectory.wheels import make_rolling_limits
from vkc_pin.world.trajectory.world_model import World

ROOT = Path(__file__).resolve().parents[2]
HINGE = 1.2
SEEN = vkc.Options(reach_waypoints=20)


@pytest.fixture(scope="module")
def demo() -> vkc.Plan:
    """What `make demo` plans."""
    return vkc.plan(vkc.load_scene("door"), [vkc.Actuate("door", {"hinge": HINGE})])


def tool(scene: vkc.Scene, row: np.ndarray) -> pin.SE3:
    """Return the tool's placement in the world at one row of a trajectory, by numeric Pinocchio."""
    model = scene.robot.model
    data = model.createData()
    q = np.concatenate([row[:2], [np.cos(row[2]), np.sin(row[2])], row[3 : model.nv]])
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId(scene.robot.tool_frame)].copy()


def handle(hinge: float, knob: float) -> pin.SE3:
    """Return where a tool holds the door's lever: the door's URDF, its place in the scene and its grasp, by hand."""
    model = pin.buildModelFromUrdf(str(find_resource_folder("scenes") / "objects" / "door.urdf"))
    data, q = model.createData(), pin.neutral(model)
    for name, value in (("hinge", hinge), ("knob", knob)):
        q[model.joints[model.getJointId(name)].idx_q] = value
    pin.framesForwardKinematics(model, data, q)
    lever = data.oMf[model.getFrameId("lever")]
    # The tool's x axis, in which the fingers close, along the lever's z; its z axis, along which it
    # comes, along x.
    grasp = pin.SE3(
        np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]]),
        np.array([-0.105, 0.07, 0.0]),
    )
    return pin.SE3(np.eye(3), np.array([2.55, 0.44, 0.0])) * lever * grasp


def apart(first: pin.SE3, second: pin.SE3) -> tuple[float, float]:
    """Return the distance [m] and the angle [rad] between two placements."""
    error = first.inverse() * second
    return float(np.linalg.norm(error.translation)), float(np.linalg.norm(pin.log3(error.rotation)))


def column(plan: vkc.Plan, name: str) -> np.ndarray:
    return plan.trajectory.column(name)


def confirm(plan: vkc.Plan) -> None:
    """Success, and an independent second look agrees."""
    assert plan.success, plan.summary()
    assert plan.status == "success"
    again = vkc.validate(plan.scene, plan.steps, plan.trajectory, plan.options)
    assert again.ok, again.lines()
    assert again.clearance == plan.report.clearance


def test_the_demo_opens_the_door(demo: vkc.Plan) -> None:
    confirm(demo)
    hinge, knob = column(demo, "door.hinge"), column(demo, "door.knob")
    assert (hinge[0], knob[0]) == (0.0, 0.0)
    assert hinge[-1] == pytest.approx(HINGE, abs=1e-3)
    assert np.all(knob[hinge > 1e-4] >= 0.5 - 1e-4)  # the bolt holds until the lever is turned


def test_the_demo_holds_the_handle(demo: vkc.Plan) -> None:
    reach, *holds = demo.trajectory.phases
    assert reach.held == {}
    assert [dict(phase.held) for phase in holds] == [{"door": "handle"}] * len(holds)
    times = np.linspace(demo.trajectory.times[holds[0].first], demo.trajectory.times[-1], 150)
    index = [demo.trajectory.names.index(name) for name in ("door.hinge", "door.knob")]
    for row in demo.trajectory.at(times):
        distance, angle = apart(tool(demo.scene, row), handle(*row[index]))
        assert distance <= 1e-3
        assert angle <= 1e-3


def test_the_demo_is_one_unbroken_motion(demo: vkc.Plan) -> None:
    trajectory, robot = demo.trajectory, demo.scene.robot
    np.testing.assert_allclose(trajectory.positions[0, :9], demo.scene.start, atol=1e-9)
    times = np.linspace(trajectory.times[0], trajectory.times[-1], 20_001)
    rows, step = trajectory(times)[:, :9], times[1] - times[0]
    speeds = np.diff(rows, axis=0) / step  # in numbers alone; nowhere a gap, and from rest to rest
    assert np.all(np.abs(speeds) <= robot.velocity * 1.001 + 1e-9)
    speeds = np.vstack([np.zeros(9), speeds, np.zeros(9)])
    assert np.all(np.abs(np.diff(speeds, axis=0)) <= robot.acceleration * step * 1.001 + 1e-9)
    # The robot waits at the handle for the gripper to close.
    grasp = trajectory.phases[0].last
    np.testing.assert_array_equal(trajectory.positions[grasp], trajectory.positions[grasp + 1])
    assert trajectory.times[grasp + 1] - trajectory.times[grasp] == pytest.approx(
        demo.options.grasp_time
    )
    # It does not wander: from the start to the handle and on by the door's width.
    assert trajectory.base_path_length() < 6.0


def test_metrics_are_the_trajectorys(demo: vkc.Plan) -> None:
    m, positions = (
        demo.metrics,
        demo.trajectory(np.linspace(0.0, demo.trajectory.times[-1], 50_001)),
    )
    base = np.diff(positions[:, :2], axis=0)
    assert m["base_path_length"] == pytest.approx(np.sqrt((base**2).sum(axis=1)).sum(), rel=1e-3)
    assert m["base_path_length_l1"] == pytest.approx(np.abs(base).sum(), rel=1e-3)
    assert m["arm_path_length"] == pytest.approx(
        np.abs(np.diff(positions[:, 3:9], axis=0)).sum(), rel=1e-3
    )
    assert m["duration"] == demo.trajectory.times[-1]
    assert m["clearance"] == demo.report.clearance
    assert m["clearance"] > 0.0
    assert m["closure_error"] == demo.report.closure_error
    parts = sum(
        m[f"time_{part}"] for part in ("initialization", "coal", "casadi", "ipopt", "validation")
    )
    assert 0.0 < parts <= m["planning_time"] * 1.05
    assert m["rounds"] == len(demo.history)
    assert m["iterations"] == _iterations(demo)


def _iterations(plan: vkc.Plan) -> float:
    """Ipopt iterations of all seeds: the last row of each, the rounds of a seed counting from 1."""
    ends = [
        row
        for row, after in zip(plan.history, [*plan.history[1:], {"round": 1}], strict=True)
        if after["round"] == 1
    ]
    return sum(row["iterations"] for row in ends)


def test_reach() -> None:
    scene = vkc.load_scene("door")
    target = pin.SE3(pin.rpy.rpyToMatrix(0.0, np.pi / 2, 0.3), np.array([1.5, 0.5, 1.0]))
    plan = vkc.plan(scene, [vkc.Reach(target)], options=SEEN)
    confirm(plan)
    distance, angle = apart(tool(scene, plan.trajectory.positions[-1]), target)
    assert distance <= 1e-3
    assert angle <= 1e-3


def test_grasp() -> None:
    plan = vkc.plan(vkc.load_scene("door"), [vkc.Grasp("door")])
    confirm(plan)
    assert max(apart(tool(plan.scene, plan.trajectory.positions[-1]), handle(0.0, 0.0))) <= 1e-3
    assert np.ptp(column(plan, "door.hinge")) == 0.0
    assert np.ptp(column(plan, "door.knob")) == 0.0


@pytest.mark.parametrize("yaw", [None, 1.0])
def test_go_to(yaw: float | None) -> None:
    plan = vkc.plan(vkc.load_scene("door"), [vkc.GoTo(0.5, 0.0, yaw)], options=SEEN)
    confirm(plan)
    x, y, heading = plan.trajectory.positions[-1, :3]
    assert np.hypot(x - 0.5, y) <= 1e-3
    if yaw is not None:
        assert abs((heading - yaw + np.pi) % (2 * np.pi) - np.pi) <= 1e-3


def test_the_drawer() -> None:
    plan = vkc.plan(vkc.load_scene("drawer"), [vkc.Actuate("drawer", {"slide": 0.3})])
    confirm(plan)
    assert column(plan, "drawer.slide")[-1] == pytest.approx(0.3, abs=1e-3)
    hold = plan.trajectory.phases[-1]
    x = [
        tool(plan.scene, row).translation[0]
        for row in plan.trajectory.positions[[hold.first, hold.last]]
    ]
    assert x[1] - x[0] == pytest.approx(-0.3, abs=2e-3)  # pulled towards the robot


def test_through_the_door_that_was_opened() -> None:
    scene = vkc.load_scene("door").with_start(base=[0.8, -0.2, 0.0])
    plan = vkc.plan(scene, [vkc.Actuate("door", {"hinge": 1.5}), vkc.GoTo(3.9, -0.3)])
    confirm(plan)
    assert column(plan, "base_x")[-1] > 3.8  # beyond the wall at x = 2.55
    crossing = int(np.argmax(column(plan, "base_x") > 2.55))
    assert -0.535 < column(plan, "base_y")[crossing] < 0.44  # through the opening
    let_go = plan.trajectory.phases[-1]
    assert let_go.held == {}
    assert np.ptp(column(plan, "door.hinge")[let_go.first :]) == 0.0
    assert column(plan, "door.hinge")[-1] == pytest.approx(1.5, abs=1e-3)


# --- with something in the hand
# ---------------------------------------------------------------------------------------


def at_a_distance(scene: vkc.Scene) -> vkc.Scene:
    return scene.with_start(base=[-0.8, -0.2, 0.3], arm=scene.robot.home)


def left_at(plan: vkc.Plan, name: str) -> pin.SE3:
    """Return where a free object is at the end."""
    world = World(plan.scene)
    return world.get_placement(name, world.compute_positions(plan.trajectory)[-1])


@pytest.mark.parametrize("joint", [True, False], ids=["jointly", "step by step"])
def test_a_stick_is_put_elsewhere(joint: bool) -> None:
    scene, aside = at_a_distance(room(table())), lifted(STICK, [0.0, 0.5, 0.0])
    plan = vkc.plan(
        scene,
        [vkc.Grasp("stick"), vkc.Place("stick", aside), vkc.GoTo(-1.0, 0.0)],
        options=SEEN,
        simultaneous=joint,
    )
    confirm(plan)
    assert max(apart(left_at(plan, "stick"), aside)) <= 1e-3
    held = [phase for phase in plan.trajectory.phases if phase.held]
    assert {tuple(phase.held.items()) for phase in held} == {(("stick", "grip"),)}
    values = [column(plan, f"stick.grip_{name}")[held[0].first] for name in ("slide", "turn")]
    first, last = plan.trajectory.positions[held[0].first], plan.trajectory.positions[held[-1].last]
    assert max(apart(tool(scene, first), tool_at(STICK, values=values))) <= 1e-3
    assert max(apart(tool(scene, last), tool_at(aside, values=values))) <= 2e-3
    assert np.hypot(*(plan.trajectory.positions[-1, :2] - [-1.0, 0.0])) <= 1e-3


def test_a_stick_touches_and_is_let_go_of() -> None:
    scene, point = at_a_distance(room(table())), np.array([0.8, 1.0, 0.9])
    plan = vkc.plan(
        scene, [vkc.Touch("stick.tip", point), vkc.Release(), vkc.GoTo(-1.0, 0.0)], options=SEEN
    )
    confirm(plan)
    last = plan.trajectory.phases[-1]
    assert dict(last.held) == {}
    tip = left_at(plan, "stick").act(np.array([0.0, 0.25, 0.0]))  # it stays where it was let go of
    np.testing.assert_allclose(tip, point, rtol=0.0, atol=1e-3)


def test_a_ball_is_fetched_with_a_stick() -> None:
    scene = room(stand(), stand("stand_2", aside=0.3), objects=("stick", "ball")).with_held(
        {"stick": "grip"}
    )
    aside = lifted(BALL, [0.0, 0.3, 0.0])
    steps = [vkc.Grasp("ball", "pull", "stick.tip"), vkc.Place("ball", aside), vkc.GoTo(-0.6, -0.3)]
    plan = vkc.plan(scene.with_start(base=[-0.6, -0.3, 0.0]), steps, options=SEEN)
    confirm(plan)
    assert max(apart(left_at(plan, "ball"), aside)) <= 1e-3
    assert {"ball": "stick.tip"} in [phase["by"] for phase in plan.trajectory.to_dict()["phases"]]
    assert dict(plan.trajectory.phases[-1].held) == {"stick": "grip"}


def test_what_is_put_at_a_point_stays_upright() -> None:
    plan = vkc.plan(
        at_a_distance(room(table())), [vkc.Place("stick", (0.8, 0.6, 0.551))], options=SEEN
    )
    confirm(plan)
    there = left_at(plan, "stick")
    np.testing.assert_allclose(there.translation, [0.8, 0.6, 0.551], rtol=0.0, atol=1e-3)
    np.testing.assert_allclose(there.rotation[2], [0.0, 0.0, 1.0], rtol=0.0, atol=2e-3)


def digest(plan: vkc.Plan) -> str:
    return hashlib.sha256(
        plan.trajectory.positions.tobytes() + plan.trajectory.times.tobytes()
    ).hexdigest()


def test_the_same_seed_gives_the_same_motion(demo: vkc.Plan) -> None:
    """Again in this process, and in two others that do the same."""
    again = vkc.plan(vkc.load_scene("door"), demo.steps)
    np.testing.assert_array_equal(again.trajectory.positions, demo.trajectory.positions)
    code = (
        "import hashlib, vkc_pin as vkc\n"
        "t = vkc.plan(vkc.load_scene('door'), [vkc.Actuate('door', {'hinge': 1.2})]).trajectory\n"
        "print(hashlib.sha256(t.positions.tobytes() + t.times.tobytes()).hexdigest())"
    )
    digests = set()
    for hash_seed in ("7", "8"):
        environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
        other = subprocess.run(
            [sys.executable, "-c", code],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=True,
            timeout=120,
            env=environment,
        )
        digests.add(other.stdout.split()[-1])
    assert len(digests) == 1


def test_another_seed_is_as_good(demo: vkc.Plan) -> None:
    other = vkc.plan(demo.scene, demo.steps, seed=5)
    confirm(other)
    assert other.seed == 5


def test_the_callback_sees_every_round() -> None:
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


def test_an_error_in_the_callback_is_not_hidden() -> None:
    def fail(row: vkc.Iteration) -> None:
        raise RuntimeError("mine")

    with pytest.raises(RuntimeError, match="mine"):
        vkc.plan(hall(), [vkc.GoTo(1.0, 0.0)], callback=fail, options=SEEN)


@pytest.mark.parametrize("rounds", [0, 1, 2])
def test_a_time_limit_ends_planning_with_the_best_so_far(
    demo: vkc.Plan, rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a clock by which every round takes a day."""
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


def test_a_time_limit_that_is_not_reached_changes_nothing(demo: vkc.Plan) -> None:
    plan = vkc.plan(demo.scene, demo.steps, time_limit=60.0)
    assert plan.success
    assert digest(plan) == digest(demo)


@pytest.fixture
def ctrl_c() -> Iterator[Any]:
    """Ctrl-C a while after the first round began, from another thread."""
    timers: list[threading.Timer] = []

    def press(delay: float) -> None:
        timer = threading.Timer(delay, os.kill, (os.getpid(), signal.SIGINT))
        timers.append(timer)
        timer.start()

    yield press
    for timer in timers:
        timer.join()


@pytest.mark.parametrize("delay", [0.0, 0.2])
def test_ctrl_c_returns_the_best_so_far(demo: vkc.Plan, ctrl_c: Any, delay: float) -> None:
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


def test_ctrl_c_is_not_for_other_threads(demo: vkc.Plan) -> None:
    plans: list[vkc.Plan] = []
    thread = threading.Thread(target=lambda: plans.append(vkc.plan(demo.scene, demo.steps)))
    thread.start()
    thread.join(60.0)
    assert digest(plans[0]) == digest(demo)


def test_a_start_outside_its_limits_by_rounding() -> None:
    scene = hall()
    arm = scene.start[3:].copy()
    arm[0], arm[5] = scene.robot.lower[3], scene.robot.upper[8]
    outside = arm + np.array([-1e-8, 0.0, 0.0, 0.0, 0.0, 1e-8])
    confirm(vkc.plan(scene.with_start(arm=outside), [vkc.GoTo(-1.0, 0.5)], options=SEEN))
    # A scene that was made by other means keeps the rounding.
    raw = dataclasses.replace(scene, start=np.concatenate([scene.start[:3], outside]))
    plan = vkc.plan(raw, [vkc.GoTo(-1.0, 0.5)], options=SEEN)
    confirm(plan)
    np.testing.assert_array_equal(plan.trajectory.positions[0], raw.start)


@pytest.mark.parametrize("gap", [0.01, 0.002, 0.0005])
def test_a_start_closer_than_dist_safe(gap: float) -> None:
    wall = {
        "name": "wall",
        "type": "box",
        "size": [0.1, 2.0, 0.5],
        "position": [0.545 + gap, 0.0, 0.25],
    }
    scene = hall(obstacles=[wall])
    assert 0.0 < scene.start_clearance() < SEEN.dist_safe / 2 + 1e-6
    plan = vkc.plan(scene, [vkc.GoTo(-1.0, 0.5)], options=SEEN)
    confirm(plan)
    assert plan.report.clearance == pytest.approx(scene.start_clearance(), abs=1e-6)


@pytest.mark.parametrize(
    "step",
    [vkc.Reach((1.5, 1.0, 0.9, 0.0, np.pi / 2, 0.0)), vkc.GoTo(0.0, 1.0, 0.0), vkc.GoTo(-1.0, 1.0)],
    ids=repr,
)
def test_a_differential_base_does_not_slip(step: Any) -> None:
    plan = vkc.plan(hall(base="differential"), [step])
    confirm(plan)
    x, y, yaw = plan.trajectory.positions[:, :3].T
    heading = (yaw[1:] + yaw[:-1]) / 2
    sideways = np.cos(heading) * np.diff(y) - np.sin(heading) * np.diff(x)
    assert np.abs(sideways).max() < 1e-4
    assert plan.metrics["base_path_length"] > 0.3
    slipping = vkc.plan(hall(base="omni"), [step])
    x, y, yaw = slipping.trajectory.positions[:, :3].T
    heading = (yaw[1:] + yaw[:-1]) / 2
    assert np.abs(np.cos(heading) * np.diff(y) - np.sin(heading) * np.diff(x)).max() > 1e-3


@pytest.mark.parametrize(
    "step",
    [vkc.Reach((1.5, 1.0, 0.9, 0.0, np.pi / 2, 0.0)), vkc.GoTo(0.0, 1.0, 0.0), vkc.GoTo(-1.0, 1.0)],
    ids=repr,
)
def test_a_steered_base_drives_as_a_car(step: Any) -> None:
    plan = vkc.plan(hall(base="ackermann", turning_radius=0.8), [step])
    confirm(plan)
    along, aside, turn = make_rolling_limits(plan.scene.robot).compute_steps(
        plan.trajectory.positions
    )
    assert np.abs(aside).max() < 1e-4
    assert (0.8 * np.abs(turn) - np.abs(along)).max() < 1e-4
    assert plan.metrics["base_path_length"] > 0.3


def test_wheels_make_a_motion_slow(tmp_path: Path) -> None:
    """Wheels that go 0.2 m/s, where those of the robot as it is go faster."""
    files = find_resource_folder("robots") / "husky_ur5e"
    text = (
        (files / "robot.yaml").read_text(encoding="utf-8").replace("speed: 6.057", "speed: 1.2114")
    )
    for file in files.iterdir():
        if file.name != "robot.yaml":
            (tmp_path / file.name).symlink_to(file)
    (tmp_path / "robot.yaml").write_text(text, encoding="utf-8")
    quick = hall(base="differential")
    slow = dataclasses.replace(quick, robot=vkc.load_robot(tmp_path, base="differential"))
    rims = []
    for scene in (quick, slow):
        plan = vkc.plan(scene, [vkc.GoTo(4.0, 1.0, 1.0)])
        confirm(plan)
        along, _, turn = make_rolling_limits(scene.robot).compute_steps(plan.trajectory.positions)
        rims.append(
            (np.abs(along) + scene.robot.wheels.track / 2 * np.abs(turn))
            / np.diff(plan.trajectory.times)
        )
    assert rims[0].max() > 0.3
    assert 0.1 < rims[1].max() <= 0.2 * 1.001


def test_a_fixed_base_stays() -> None:
    plan = vkc.plan(
        hall(base="fixed"), [vkc.Reach((0.5, 0.4, 1.0, 0.0, np.pi / 2, 0.0))], options=SEEN
    )
    confirm(plan)
    assert np.ptp(plan.trajectory.positions[:, :3], axis=0).max() == 0.0


def test_another_robot() -> None:
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
    confirm(plan)
    assert plan.trajectory.names[:4] == ("base_x", "base_y", "base_yaw", "panda_joint1")
    assert max(apart(tool(scene, plan.trajectory.positions[-1]), target)) <= 1e-3


MISUSES: dict[str, tuple[dict[str, Any], str, str]] = {
    "unknown initialization": (
        {"initialization": "interpolate"},
        "initialization",
        "did you mean 'interpolated'",
    ),
    "no time": ({"time_limit": 0.0}, "time_limit", "more than 0"),
    "negative time": ({"time_limit": -1.0}, "time_limit", "-1.0"),
    "endless time": ({"time_limit": float("inf")}, "time_limit", "inf"),
    "no evaluations": ({"max_evaluations": 0}, "max_evaluations", "at least 1"),
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


@pytest.mark.parametrize("case", MISUSES.values(), ids=MISUSES)
def test_misuse_raises(case: tuple[dict[str, Any], str, str]) -> None:
    arguments, field, text = case
    call: dict[str, Any] = {"scene": hall(), "steps": [vkc.GoTo(1.0, 0.0)], **arguments}
    with pytest.raises(vkc.InputError) as caught:
        vkc.plan(call.pop("scene"), call.pop("steps"), **call)
    assert caught.value.field == field
    assert text in str(caught.value)


def test_steps_may_come_from_anywhere() -> None:
    plan = vkc.plan(hall(), (step for step in [vkc.GoTo(0.5, 0.0)]), options=SEEN)  # type: ignore[arg-type]
    confirm(plan)
    assert plan.steps == (vkc.GoTo(0.5, 0.0),)


@pytest.mark.filterwarnings("ignore:.*links overlap at the default home")
def test_a_robot_that_nobody_prepared_reaches() -> None:
    """Tiago, from a URDF alone: free at its home, and where links always are as close as 18.8 mm it keeps half of that."""
    scene = vkc.Scene.from_document({"robot": "tiago", "start": {"base": [0.0, 0.0, 0.0]}})
    assert scene.robot.tight["arm_2_link", "torso_lift_link"] == pytest.approx(0.0188, abs=1e-4)
    target = pin.SE3(np.eye(3), np.array([1.5, 0.4, 0.9]))
    plan = vkc.plan(scene, [vkc.Reach(target)], options=SEEN)
    assert plan.success, plan.summary()
    assert tool(scene, plan.trajectory.positions[-1]).isApprox(target, 2e-3)
    motion, steps = plan.trajectory, plan.steps
    assert validate(plan.scene, steps, motion, SEEN).ok
    held_back = validate(plan.scene, steps, motion, dataclasses.replace(SEEN, self_distance=0.2))
    assert {violation.constraint for violation in held_back.violations} == {"clearance"}
