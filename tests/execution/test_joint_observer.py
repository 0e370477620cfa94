"""Tests that the closed loop finds joints elsewhere, and ends pulls."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import vkc_pin as vkc
from vkc_pin.errors import InputError
from vkc_pin.execution import ExecutionResult, IdealRobot, RobotState, SimulatedRobot, execute
from vkc_pin.world.scene.estimated_joints import find_axis

NOISE = (0.001, float(np.radians(0.3)))
TILT = np.radians(5.0)


@cache
def plan_drawer() -> vkc.Plan:
    plan = vkc.plan(vkc.load_scene("drawer"), [vkc.Actuate("drawer", {"slide": 0.3})])
    assert plan.success, plan.summary()
    return plan


@cache
def make_tilted_scene() -> vkc.Scene:
    """Return the scene with a drawer that really slides in another direction."""
    scene = plan_drawer().scene
    placed = scene.objects["drawer"]
    kind, axis, point = find_axis(placed, "slide")
    actual = vkc.JointEstimate(
        kind=kind,
        axis=pin.utils.rotate("z", TILT) @ axis,
        point=point,
        link=placed.link_placement("tray"),
        positions=np.zeros(1),
        axis_deviation=0.0,
        point_deviation=0.0,
        information={},
    )
    return scene.with_measured_joint("drawer", "slide", actual, link="tray")


def add_noise(pose: pin.SE3, rng: np.random.Generator) -> pin.SE3:
    turn = pin.exp3(rng.normal(0.0, NOISE[1], 3))
    return pin.SE3(pose.rotation @ turn, pose.translation + rng.normal(0.0, NOISE[0], 3))


def measure_tilt(result: ExecutionResult) -> float:
    """Return the angle between the slide of the last plan and that of the real drawer [rad]."""
    _, found, _ = find_axis(result.plans[-1][1].scene.objects["drawer"], "slide")
    _, real, _ = find_axis(make_tilted_scene().objects["drawer"], "slide")
    return float(np.arccos(np.clip(found @ real, -1.0, 1.0)))


class GuidedRobot(IdealRobot):
    """A robot whose hand the drawer guides without any force; its motion is not looked at."""

    def locate(self) -> pin.SE3:
        """Return where the tray is, pulled as far as the hand is away from where it closed."""
        plan = plan_drawer()
        closed = plan.trajectory.phases[0].last
        start = plan.pose(None, float(plan.trajectory.times[closed])).translation
        state = self.read().positions
        hand = plan.scene.with_start(base=state[:3], arm=state[3:]).tool_placement()
        _, axis, _ = find_axis(make_tilted_scene().objects["drawer"], "slide")
        grasped = any(motion.phases[-1].holds for _, motion in self.motions)
        travel = axis @ (hand.translation - start) if grasped else 0.0
        slide = float(np.clip(travel, 0.0, 0.3)) if np.abs(travel) < 0.5 else 0.0
        opened = make_tilted_scene().with_state("drawer", {"slide": slide})
        return opened.objects["drawer"].link_placement("tray")


def test_drawer_that_slides_elsewhere_is_measured_and_followed() -> None:
    plan = plan_drawer()
    robot = GuidedRobot(plan.scene, is_simulated=True)
    rng = np.random.default_rng(0)
    asked = set[tuple[str, str]]()

    def see(name: str, link: str) -> pin.SE3:
        asked.add((name, link))
        return add_noise(robot.locate(), rng)

    result = execute(plan, robot, observe_link=see, link_noise=NOISE, time_limit=60.0)
    assert result.success, result.summary()
    assert asked == {("drawer", "tray")}
    reasons = [cycle.reason for cycle in result.cycles if cycle.decision == "brake"]
    assert all("drawer.slide is" in reason and "elsewhere" in reason for reason in reasons)
    assert 1 <= len(reasons) <= 4
    assert measure_tilt(result) < 0.25 * TILT
    # The grasp is kept: the hand moves with the tray from the last replan to the end.
    last = result.plans[-1][1]
    begin, end = (float(last.trajectory.times[k]) for k in (0, -1))
    grasps = [last.pose("drawer.tray", t).actInv(last.pose(None, t)) for t in (begin, end)]
    assert grasps[0].isApprox(grasps[1], 1e-3)


def test_drawer_as_described_is_left_alone() -> None:
    plan = plan_drawer()
    robot = IdealRobot(plan.scene, is_simulated=True)
    rng = np.random.default_rng(1)

    def see(name: str, link: str) -> pin.SE3:
        time = np.clip(robot.time - 0.05, 0.0, plan.trajectory.times[-1])
        return add_noise(plan.pose(f"{name}.{link}", float(time)), rng)

    result = execute(plan, robot, observe_link=see, link_noise=NOISE, time_limit=60.0)
    assert result.success, result.summary()
    assert result.count_decisions() == {"go on": len(result.cycles)}


def test_link_that_turns_instead_stops_the_robot() -> None:
    plan = plan_drawer()
    robot = IdealRobot(plan.scene, is_simulated=True)

    def see(name: str, link: str) -> pin.SE3:
        time = float(np.clip(robot.time - 0.05, 0.0, plan.trajectory.times[-1]))
        start = plan.pose(f"{name}.{link}", 0.0)
        travel = plan.pose(f"{name}.{link}", time).translation - start.translation
        turn = pin.utils.rotate("z", 2.0 * float(np.linalg.norm(travel)))
        return pin.SE3(turn @ start.rotation, start.translation + travel)

    result = execute(plan, robot, observe_link=see, link_noise=NOISE, time_limit=60.0)
    assert not result.success
    assert result.reason == "drawer.slide is revolute, and described as prismatic"


class PullingRobot(IdealRobot):
    """A robot that measures 143 N from 3.5 s on."""

    def read(self) -> RobotState:
        state = super().read()
        force = 143.0 if self.time > 3.5 else 5.0
        return RobotState(state.time, state.positions, state.velocities, force, 1.0)


@pytest.mark.parametrize("sees", [False, True])
def test_limit_of_force_ends_a_pull(sees: bool) -> None:
    """With or without a camera: the drawer is where it should be, and does not move."""
    plan = plan_drawer()
    robot = PullingRobot(plan.scene, is_simulated=True)
    options: dict[str, Any] = {"observe_link": lambda *_: None} if sees else {}
    result = execute(plan, robot, force_limit=100.0, patience=0.5, **options)
    assert not result.success
    assert result.reason == "pulls against the mechanism with 143 N"
    assert result.count_decisions()["brake"] == 1
    np.testing.assert_array_equal(robot.read().velocities, 0.0)
    assert robot.time < 6.0


class HamperedRobot(IdealRobot):
    """A robot that measures 143 N once the drawer is open by 0.1 m, for two tenths of a second."""

    def read(self) -> RobotState:
        state = super().read()
        motion = plan_drawer().trajectory
        opens = float(motion.times[np.argmax(motion.column("drawer.slide") > 0.1)])
        force = 143.0 if 0.0 < self.time - opens < 0.2 else 5.0
        return RobotState(state.time, state.positions, state.velocities, force, 1.0)


def test_mechanism_that_has_moved_is_moved_on_after_a_pull() -> None:
    """It is not blocked, although the joint cannot be estimated yet."""
    plan = plan_drawer()
    robot = HamperedRobot(plan.scene, is_simulated=True)
    result = execute(
        plan,
        robot,
        force_limit=100.0,
        patience=5.0,
        time_limit=60.0,
        observe_link=lambda *_: None,
    )
    assert result.success, result.summary()
    counts = result.count_decisions()
    assert (counts["brake"], counts["replan"]) == (1, 1)
    _, last = result.plans[-1]
    slide = last.trajectory.column("drawer.slide")
    assert 0.05 < slide[0] < 0.25
    assert slide[-1] == pytest.approx(0.3, abs=1e-3)
    reason = next(cycle.reason for cycle in result.cycles if cycle.decision == "brake")
    assert reason == "pulls against the mechanism with 143 N"


def test_drawer_in_physics_is_opened_where_it_really_slides() -> None:
    plan = plan_drawer()
    actual = make_tilted_scene()
    broken = SimulatedRobot(plan.scene, actual=actual, counts_planning=False)
    broken.send(plan.trajectory, 0.05)
    broken.wait(plan.trajectory.times[-1] + 1.0)
    assert broken.grips[0].broken is not None
    robot = SimulatedRobot(plan.scene, actual=actual, counts_planning=False)
    rng = np.random.default_rng(0)
    result = execute(
        plan,
        robot,
        observe_link=lambda name, link: add_noise(robot.locate(name, link), rng),
        link_noise=NOISE,
        force_limit=93.0,
        torque_limit=10.0,
        time_limit=60.0,
    )
    assert result.success, result.summary()
    assert [grip.problem for grip in robot.grips] == [None]
    assert robot.grips[0].torque < 25.0
    assert robot.object_states()["drawer"].joints["slide"] == pytest.approx(0.3, abs=0.01)
    assert measure_tilt(result) < 0.25 * TILT


@pytest.mark.parametrize(
    ("options", "error"),
    [
        ({"observe_link": "camera"}, "observe_link.*function of object and link"),
        ({"observe_link": lambda *_: None, "link_noise": (0.001, 0.0)}, "link_noise.*more than 0"),
        ({"force_limit": 100.0}, "does not measure the force.*grasp_force"),
        ({"torque_limit": 10.0}, "does not measure the torque.*grasp_torque"),
        ({"observe_link": lambda *_: "here"}, "observe_link"),
    ],
)
def test_wrong_arguments_are_named(options: dict[str, Any], error: str) -> None:
    plan = plan_drawer()
    with pytest.raises(InputError, match=error):
        execute(plan, IdealRobot(plan.scene, is_simulated=True), **options)
