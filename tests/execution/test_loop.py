"""Tests the closed loop with a robot that follows motions exactly."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import vkc_pin as vkc
from vkc_pin.errors import InputError
from vkc_pin.execution import ExecutionResult, IdealRobot, RobotState, execute, loop
from vkc_pin.world.trajectory.trajectory import Trajectory

# The clock of simulated robots stands still while a motion is found, however slow the machine is.
CALM = {"lead": 0.5, "time_limit": 60.0}
SIZE = 9


@cache
def plan_door() -> vkc.Plan:
    plan = vkc.plan(vkc.load_scene("door"), [vkc.Actuate("door", {"hinge": 1.2})])
    assert plan.success, plan.summary()
    return plan


def run(
    observe: Callable[[vkc.Scene, float], vkc.Scene] | None = None, **options: Any
) -> tuple[ExecutionResult, IdealRobot]:
    """Execute the door's plan; `observe` gets a scene and the robot's time."""
    plan = plan_door()
    robot = IdealRobot(plan.scene, is_simulated=True)
    look = None if observe is None else lambda scene: observe(scene, robot.time)
    result = execute(plan, robot, observe=look, **{**CALM, **options})
    return result, robot


def sample_motion(robot: IdealRobot, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Return times and positions of the robot."""
    times = np.arange(0.0, end, 1e-3)
    return times, np.array([robot.compute_state(time).positions for time in times])


def check_smooth(robot: IdealRobot, result: ExecutionResult) -> None:
    """Check that a robot's motion has neither jumps of position nor of velocity."""
    times, positions = sample_motion(robot, result.cycles[-1].time)
    velocities = np.diff(positions, axis=0) / np.diff(times)[:, None]
    limits = plan_door().scene.robot
    assert (np.abs(velocities) <= 1.01 * limits.velocity).all()
    accelerations = np.diff(velocities, axis=0) / 1e-3
    assert (np.abs(accelerations) <= 1.2 * limits.acceleration + 0.05).all()


def test_undisturbed_plan_is_executed_as_it_is() -> None:
    result, robot = run(lambda scene, _: scene)
    assert result.success, result
    assert result.count_decisions() == {"go on": len(result.cycles)}
    ((begin, motion),) = robot.motions
    assert motion is plan_door().trajectory
    period = np.diff([cycle.time for cycle in result.cycles])
    np.testing.assert_allclose(period, 0.05, atol=1e-9)
    assert result.cycles[-1].time == pytest.approx(begin + motion.times[-1], abs=0.05)


def test_door_that_turns_out_to_be_elsewhere_is_opened() -> None:
    at = plan_door().scene.objects["door"].placement
    shift = np.array([0.02, 0.03, 0.0])
    moved = pin.SE3(at.rotation @ pin.utils.rotate("z", 0.05), at.translation + shift)

    def observe(scene: vkc.Scene, time: float) -> vkc.Scene:
        return scene.with_placement("door", moved) if time > 1.0 else scene

    result, robot = run(observe)
    assert result.success, result
    assert result.count_decisions()["replan"] >= 1
    first = next(cycle for cycle in result.cycles if cycle.decision == "replan")
    assert first.reason == "door is elsewhere"
    assert first.time == pytest.approx(1.0, abs=0.06)
    last = result.plans[-1][1]
    assert last.scene.objects["door"].placement == moved
    assert last.trajectory.column("door.hinge")[-1] == pytest.approx(1.2, abs=1e-3)
    check_smooth(robot, result)


def test_robot_brakes_at_once_before_an_object_that_is_seen_late() -> None:
    """The hand is already near: there is no time to look for another motion first."""
    plan = plan_door()
    motion = plan.trajectory
    closing = float(motion.times[next(phase.first for phase in motion.phases if phase.holds)])
    at = plan.scene.objects["door"].placement
    moved = pin.SE3(at.rotation, at.translation + np.array([-0.03, 0.0, 0.0]))

    def observe(scene: vkc.Scene, time: float) -> vkc.Scene:
        return scene.with_placement("door", moved) if time > closing - 0.4 else scene

    result, _ = run(observe)
    assert result.success, result
    reacted = [cycle for cycle in result.cycles if cycle.reason]
    assert (reacted[0].decision, reacted[0].reason) == ("brake", "door is elsewhere")


def test_robot_goes_round_what_appears_on_its_path() -> None:
    x, y = plan_door().trajectory.at(2.0)[:2]
    pose = [x, y + 0.55, 0.3, 0.0, 0.0, 0.0]

    def observe(scene: vkc.Scene, time: float) -> vkc.Scene:
        return scene.with_obstacle("stool", pose) if time > 0.3 else scene

    result, robot = run(observe)
    assert result.success, result
    assert "stool" in next(cycle.reason for cycle in result.cycles if cycle.reason)
    _, last = result.plans[-1]
    there = last.scene.with_obstacle("stool", pose)
    assert vkc.validate(there, last.steps, last.trajectory, last.options).ok
    check_smooth(robot, result)


def test_robot_brakes_before_a_wall_and_gives_up() -> None:
    """Something blocks the door for good: the robot stops before it, and execution fails."""
    at = plan_door().scene.objects["door"].placement.translation

    def observe(scene: vkc.Scene, time: float) -> vkc.Scene:
        pose = [at[0] - 0.4, at[1] - 0.5, 0.25, 0.0, 0.0, 0.0]
        return scene.with_obstacle("sofa", pose) if time > 1.0 else scene

    result, robot = run(observe, patience=0.3, time_limit=1.0)
    assert not result.success
    assert "no motion was found from rest" in result.reason
    decisions = result.count_decisions()
    assert decisions["brake"] == 1
    state = robot.read()
    np.testing.assert_allclose(state.velocities, 0.0, atol=1e-9)
    check_smooth(robot, result)


def test_searches_take_longer_after_those_that_time_has_ended(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not after those that failed for another reason; at most as long as the patience."""
    at = plan_door().scene.objects["door"].placement.translation
    statuses = ["infeasible", "time limit", "infeasible", "time limit", "time limit", "time limit"]
    limits = list[float]()
    seeds = list[int]()

    class Prepared:
        def solve(self, *, time_limit: float, seed: int, **_: Any) -> vkc.Plan:
            status = statuses[min(len(limits), len(statuses) - 1)]
            limits.append(time_limit)
            seeds.append(seed)
            return dataclasses.replace(plan_door(), status=status)

    monkeypatch.setattr(loop, "prepare", lambda *_, **__: Prepared())

    def observe(scene: vkc.Scene, time: float) -> vkc.Scene:
        pose = [at[0] - 0.4, at[1] - 0.5, 0.25, 0.0, 0.0, 0.0]
        return scene.with_obstacle("sofa", pose) if time > 1.0 else scene

    result, _ = run(observe, patience=3.0, time_limit=0.5)
    assert not result.success
    assert limits[:8] == [0.5, 0.5, 1.0, 1.0, 2.0, 3.0, 3.0, 3.0]
    assert seeds == list(range(seeds[0], seeds[0] + len(seeds)))


def test_robot_waits_for_a_free_start() -> None:
    """Somebody stands in the robot when it is to begin: it stays until he has left."""
    plan = plan_door()
    x, y = plan.scene.start[:2]

    def observe(scene: vkc.Scene, time: float) -> vkc.Scene:
        place = [x, y] if time < 2.0 else [0.95, 0.85]
        return scene.with_obstacle("stool", [*place, 0.225, 0.0, 0.0, 0.0])

    result, robot = run(observe)
    assert result.success, result
    times, positions = sample_motion(robot, 2.0)
    np.testing.assert_allclose(positions, np.tile(plan.scene.start, (len(times), 1)), atol=1e-12)
    assert {cycle.decision for cycle in result.cycles if cycle.time < 2.0} == {"wait"}


def test_motion_that_is_blocked_meanwhile_is_not_begun() -> None:
    """Somebody steps onto the new path while it is searched: the robot stays at rest."""
    plan = plan_door()
    looks = 0

    def observe(scene: vkc.Scene, time: float) -> vkc.Scene:
        nonlocal looks
        looks += 1
        here, ahead = plan.scene.start[:2], plan.trajectory.at(1.5)[:2]
        # He stands in the robot, leaves when it plans, and stands before it when it has planned.
        place = {1: here, 2: here, 4: ahead}.get(looks, (0.95, 0.85))
        return scene.with_obstacle("stool", [*place, 0.225, 0.0, 0.0, 0.0])

    result, robot = run(observe)
    blocked = [cycle for cycle in result.cycles if cycle.reason == "blocked meanwhile"]
    assert blocked
    assert blocked[0].decision == "wait"
    assert result.success, result
    check_smooth(robot, result)


def test_robot_leaves_what_it_touches_a_little() -> None:
    """A measured stool overlaps the base by a few millimetres where it stands: it goes on."""
    scene = plan_door().scene
    x, y = scene.start[:2]
    place = [x - 1.2, y, 0.225, 0.0, 0.0, 0.0]
    while scene.with_obstacle("stool", place).start_clearance() > -1e-3:
        place[0] += 2e-3
    assert place[0] < x

    def observe(scene: vkc.Scene, time: float) -> vkc.Scene:
        return scene.with_obstacle("stool", place)

    result, _ = run(observe)
    assert result.success, result
    assert any(cycle.reason == "infeasible" for cycle in result.cycles)
    last = result.plans[-1][1]
    assert any("stool" in pair for pair in last.scene.allowed)


def test_plan_from_rest_keeps_the_terms_of_the_user() -> None:
    """Somebody stands on the path for a while: the robot brakes, and goes on later."""
    elbow = vkc.Cost("elbow", lambda s: (s.coordinate("elbow_joint") - 1.5) ** 2, weight=0.1)
    plan = vkc.plan(plan_door().scene, plan_door().steps, terms=[elbow])
    assert plan.success, plan.summary()
    robot = IdealRobot(plan.scene, is_simulated=True)
    x, y = plan.trajectory.at(2.0)[:2]

    def observe(scene: vkc.Scene) -> vkc.Scene:
        is_there = 1.0 < robot.time < 2.5
        place = [x, y] if is_there else [0.95, 0.85]
        return scene.with_obstacle("stool", [*place, 0.225, 0.0, 0.0, 0.0])

    result = execute(plan, robot, observe=observe, lead=0.5, time_limit=1e-3)
    assert result.success, result.summary()
    first = next(cycle for cycle in result.cycles if cycle.reason)
    # There is no time to look for another motion first, which would be part of the reason.
    assert (first.decision, first.reason) == ("brake", "base_link – stool")
    assert result.plans[-1][1].terms == plan.terms


def test_heading_is_measured_modulo_whole_turns() -> None:
    """Odometry states headings from -π to π; the motion passes π."""

    class Odometry(IdealRobot):
        def read(self) -> RobotState:
            state = super().read()
            positions = state.positions.copy()
            positions[2] = (positions[2] + np.pi) % (2.0 * np.pi) - np.pi
            return dataclasses.replace(state, positions=positions)

    start = vkc.load_scene("door").with_start(base=[0.0, 0.0, 2.9])
    plan = vkc.plan(start, [vkc.GoTo(-0.3, 0.0, 3.6)])
    assert plan.success, plan.summary()
    yaw = plan.trajectory.positions[:, 2]
    assert yaw.min() < np.pi < yaw.max()
    robot = Odometry(plan.scene, is_simulated=True)
    result = execute(plan, robot, **CALM)
    assert result.success, result
    assert result.count_decisions() == {"go on": len(result.cycles)}


def test_robot_off_its_motion_is_brought_back() -> None:
    class Drifting(IdealRobot):
        """A robot that is 50 mm off for a while, by its own measurement."""

        def read(self) -> RobotState:
            state = super().read()
            if 1.0 < state.time < 1.2:
                state.positions[0] += 0.05
            return state

    plan = plan_door()
    robot = Drifting(plan.scene, is_simulated=True)
    result = execute(plan, robot, **CALM)
    assert result.success, result
    reasons = [cycle.reason for cycle in result.cycles if cycle.decision == "replan"]
    assert any("base_x is 0.05 m off" in reason for reason in reasons)


def test_robot_off_its_motion_brakes_where_it_is() -> None:
    """A motion that began on the path would jump by the tracking error."""

    class Displaced(IdealRobot):
        def read(self) -> RobotState:
            state = super().read()
            if state.time > 1.0 and len(self.motions) == 1:
                state.positions[0] += 0.05
            return state

    plan = plan_door()
    robot = Displaced(plan.scene, is_simulated=True)
    result = execute(plan, robot, lead=0.5, time_limit=1e-6)
    assert result.success, result
    assert result.count_decisions()["brake"] == 1
    (first, planned), (begin, stop) = robot.motions[:2]
    there = planned.at(begin - first)[:SIZE]
    there[0] += 0.05
    np.testing.assert_allclose(stop.positions[0, :SIZE], there, atol=1e-9)


def test_robot_that_has_slipped_at_rest_goes_on_from_there() -> None:
    class Slipping(IdealRobot):
        """A robot that is pushed aside by 50 mm while it waits."""

        def read(self) -> RobotState:
            state = super().read()
            if len(self.motions) == 1 and state.time > 0.5:
                state.positions[1] -= 0.05
            return state

    plan = plan_door()
    x, y = plan.scene.start[:2]
    robot = Slipping(plan.scene, is_simulated=True)

    def observe(scene: vkc.Scene) -> vkc.Scene:
        place = [x, y] if robot.time < 1.0 else [0.95, 0.85]
        return scene.with_obstacle("stool", [*place, 0.225, 0.0, 0.0, 0.0])

    result = execute(plan, robot, observe=observe, **CALM)
    assert result.success, result
    _, motion = robot.motions[-1]
    there = plan.scene.start.copy()
    there[1] -= 0.05
    np.testing.assert_allclose(motion.positions[0, :SIZE], there, atol=1e-9)


def test_robot_that_stops_answering_is_stopped() -> None:
    class Silent(IdealRobot):
        """A robot whose measurements end at 1 s, and that notes when it is stopped."""

        stopped = False

        def read(self) -> RobotState:
            return self.compute_state(min(self.time, 1.0))

        def stop(self) -> None:
            self.stopped = True

    plan = plan_door()
    robot = Silent(plan.scene, is_simulated=True)
    result = execute(plan, robot, tracking=10.0, **CALM)
    assert not result.success
    assert "the robot's state is 0.5" in result.reason
    assert robot.stopped
    assert robot.time < 1.7


def test_robot_is_stopped_if_the_program_fails() -> None:
    class Broken(IdealRobot):
        """A robot whose connection breaks at 1 s."""

        stopped = False

        def read(self) -> RobotState:
            if self.time > 1.0:
                raise ConnectionError("no route to the robot")
            return super().read()

        def stop(self) -> None:
            self.stopped = True

    plan = plan_door()
    robot = Broken(plan.scene, is_simulated=True)
    with pytest.raises(ConnectionError, match="no route"):
        execute(plan, robot, **CALM)
    assert robot.stopped


def test_robot_must_stand_at_the_start_of_the_plan() -> None:
    plan = plan_door()
    elsewhere = plan.scene.with_start(base=(0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="not at its start"):
        execute(plan, IdealRobot(elsewhere, is_simulated=True))


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"rate": 0.0}, "rate"),
        ({"rate": np.nan}, "rate"),
        ({"lead": 0.0}, "lead"),
        ({"patience": -1.0}, "patience"),
        ({"tracking": 0.0}, "tracking"),
        ({"observe": "camera"}, "observe"),
    ],
)
def test_wrong_arguments_are_named(options: dict[str, Any], error: str) -> None:
    plan = plan_door()
    with pytest.raises(InputError, match=error):
        execute(plan, IdealRobot(plan.scene, is_simulated=True), **options)


def test_robot_must_have_the_methods_of_a_robot() -> None:
    with pytest.raises(InputError, match=r"robot.*methods of `Robot`"):
        execute(plan_door(), object())  # type: ignore[arg-type]


def test_plan_must_be_a_success() -> None:
    failed = vkc.plan(vkc.load_scene("door"), [vkc.GoTo(2.55, 1.3)], max_evaluations=1000)
    with pytest.raises(InputError, match="no success"):
        execute(failed, IdealRobot(failed.scene, is_simulated=True))


# --- the ideal robot
# ------------------------------------------------------------------------------------------------


def make_line(length: float) -> Trajectory:
    plan = plan_door()
    positions = np.tile(plan.scene.start, (2, 1))
    positions[1, 0] += length
    names = plan.scene.robot.coordinates.names
    phases = (vkc.PhaseSpan("go to", 0, 1),)
    return Trajectory(names, np.array([0.0, 1.0]), positions, phases, SIZE)


def test_later_motion_replaces_what_follows() -> None:
    robot = IdealRobot(plan_door().scene, is_simulated=True)
    x = robot.read().positions[0]
    robot.send(make_line(1.0), 0.5)
    robot.send(make_line(-1.0), 1.0)
    expected = {0.2: x, 0.75: x + 0.25, 1.5: x - 0.5, 9.0: x - 1.0}
    for time, position in expected.items():
        assert robot.compute_state(time).positions[0] == pytest.approx(position)
    robot.send(make_line(0.5), 0.2)  # discards both
    assert robot.compute_state(9.0).positions[0] == pytest.approx(x + 0.5)


def test_motion_cannot_begin_in_the_past_and_stop_stays() -> None:
    robot = IdealRobot(plan_door().scene, is_simulated=True)
    robot.send(make_line(1.0), 0.0)
    robot.wait(0.5)
    with pytest.raises(InputError, match="this is over"):
        robot.send(make_line(1.0), 0.4)
    robot.stop()
    there = robot.read().positions
    robot.wait(3.0)
    np.testing.assert_array_equal(robot.read().positions, there)
    np.testing.assert_array_equal(robot.read().velocities, 0.0)


def test_clock_of_the_computer_goes_on() -> None:
    robot = IdealRobot(plan_door().scene)
    before = robot.time
    robot.wait(before + 0.02)
    assert robot.time >= before + 0.02
