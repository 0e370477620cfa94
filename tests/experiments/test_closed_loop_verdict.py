"""Tests the verdict on motions in physics."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

import vkc_pin as vkc
from vkc_pin.experiments.closed_loop_verdict import Knowledge, Person, judge_execution
from vkc_pin.experiments.tasks import TASKS, make_start
from vkc_pin.simulation.contacts import Contact
from vkc_pin.simulation.recording import GraspForce, ObjectState

FINGER = "gripper_left_finger"


def make_contact(first: str, second: str, time: float, depth: float = 2e-4) -> Contact:
    return Contact(first, second, time, time, 0.05, depth)


@dataclass
class MadeUpRobot:
    """A robot that has moved a cup as planned, and pushed it before.

    Attributes:
        plan: The plan.
        touches: All contacts, which no motion has.
        pushed_at: When the cup is pushed [s], by 7 mm.
        held: Whether a hand holds it then.
    """

    plan: vkc.Plan
    touches: Sequence[Contact]
    pushed_at: float = np.inf
    held: bool = False
    grips: tuple[Any, ...] = ()
    known: list[tuple[vkc.Scene, float, float]] = field(default_factory=list)

    def contacts(self, scene: vkc.Scene, *, begin: float, end: float) -> tuple[Contact, ...]:
        self.known.append((scene, begin, end))
        return tuple(contact for contact in self.touches if begin <= contact.time < end)

    def object_states(self, time: float | None = None) -> dict[str, ObjectState]:
        placement = self.plan.end_scene().objects["cup"].placement.copy()
        if time is not None and time > self.pushed_at:
            placement.translation += np.array([0.007, 0.0, 0.0])
        return {"cup": ObjectState({}, placement)}

    @property
    def grasp_forces(self) -> tuple[GraspForce, ...]:
        hold = self.plan.trajectory.phases[-2].holds[0]
        return (GraspForce(self.pushed_at, hold, 1.0, 0.1),) if self.held else ()

    def trajectory(self) -> vkc.Trajectory:
        return self.plan.trajectory


@pytest.fixture(scope="module")
def cup_plan() -> vkc.Plan:
    found = vkc.plan(make_start("household_cup", 1, 0), TASKS["household_cup"].steps)
    assert found.success, found.summary()
    return found


@pytest.mark.parametrize(
    ("knowledge", "contact", "covers"),
    [
        (Knowledge(), make_contact(FINGER, "cup.cup", 1.0), True),
        (Knowledge("cup", 2.0), make_contact(FINGER, "cup.cup", 1.9), False),
        (Knowledge("cup", 2.0), make_contact("cup.cup", FINGER, 2.0), True),
        (Knowledge("cup", np.inf), make_contact(FINGER, "cup.cup", 9.0), False),
        # The places of other obstacles and of the robot are known.
        (Knowledge("cup", np.inf), make_contact("base_link", "sofa", 0.1), True),
        (Knowledge("cup", 1.0, 3.0), make_contact("base_link", "sofa", 2.9), False),
        (Knowledge("cup", 1.0, 3.0), make_contact(FINGER, "cup.cup", 3.1), True),
    ],
)
def test_contacts_count_once_they_could_be_avoided(
    knowledge: Knowledge, contact: Contact, covers: bool
) -> None:
    assert knowledge.covers(contact) is covers


@pytest.mark.parametrize(
    ("depth", "pushed_at", "held", "since", "deepest", "problem"),
    [
        (2e-4, np.inf, False, 0.0, 2e-4, ""),
        (2e-3, np.inf, False, 0.0, 2e-3, "2.0 mm deep"),
        (2e-4, 1.02, False, 0.0, 7e-3, "pushed by 7.0 mm"),
        (2e-4, 1.02, True, 0.0, 2e-4, ""),  # carried
        (2e-3, 1.02, False, 1.5, 0.0, ""),  # not known at that time
    ],
)
def test_collisions_are_deep_or_push_something(
    cup_plan: vkc.Plan,
    depth: float,
    pushed_at: float,
    held: bool,
    since: float,
    deepest: float,
    problem: str,
) -> None:
    touch = make_contact("cup.cup", FINGER, 1.0, depth)
    robot: Any = MadeUpRobot(cup_plan, [touch], pushed_at, held)
    reasons, found = judge_execution(cup_plan, robot, [(0.1, cup_plan)], Knowledge("cup", since))
    assert found == pytest.approx(deepest, abs=1e-9)
    assert bool(reasons) is bool(problem)
    assert all(problem in reason for reason in reasons)


def test_motions_are_compared_with_the_worlds_of_their_plans(cup_plan: vkc.Plan) -> None:
    """A motion that brakes belongs to the world of the motion before."""
    motion = cup_plan.trajectory
    elsewhere = cup_plan.scene.objects["cup"].placement * pin.SE3(np.eye(3), np.full(3, 0.01))
    seen = cup_plan.scene.with_placement("cup", elsewhere)
    stop = dataclasses.replace(cup_plan, scene=seen, status="rejected")
    second = dataclasses.replace(cup_plan, scene=seen)
    robot: Any = MadeUpRobot(cup_plan, [])
    sent = [(0.1, cup_plan), (1.1, stop), (2.5, second)]
    judge_execution(cup_plan, robot, sent, Knowledge())
    scenes, begins, ends = zip(*robot.known, strict=True)
    assert begins == (-np.inf, 1.1, 2.5)
    assert ends == (1.1, 2.5, np.inf)
    assert scenes[0] is cup_plan.scene
    known = cup_plan.scene.objects["cup"].placement
    assert scenes[1].objects["cup"].placement.isApprox(known, 1e-9)
    np.testing.assert_allclose(scenes[1].start, motion.at(motion.times[0] + 1.0)[:9], atol=1e-9)
    assert scenes[2] is seen


def test_who_walks_into_a_robot_that_stands_is_not_counted(cup_plan: vkc.Plan) -> None:
    motion = cup_plan.trajectory
    robot: Any = MadeUpRobot(cup_plan, [])
    closing = motion.phases[0].last  # the robot rests while its hand closes
    for waypoint, counts in ((closing, False), (closing // 2, True)):
        moment = float(motion.times[waypoint])
        there = np.array([*motion.at(moment)[:2], 0.8])

        def locate(clock: float, there: Any = there, moment: float = moment) -> Any:
            is_there = abs(clock - moment) < 0.02
            return there if is_there else there + np.array([0.0, 0.0, 50.0])

        person = Person("person", 0.2, 1.6, locate)
        sent = [(0.0, cup_plan)]
        reasons, depth = judge_execution(cup_plan, robot, sent, Knowledge(), person)
        assert bool(reasons) is counts
        assert (depth > 0.1) is counts
