"""Judges real motions of robots in physics: goals, grasps, and collisions that were avoidable."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.planning.plan import Plan
from vkc_pin.simulation.contacts import Contact
from vkc_pin.simulation.robot import SimulatedRobot
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, Place

_FAR = 1.5  # [m] from a person to the origin of a shape; none is larger
_MOVING = 0.02  # [m/s] or [rad/s]; slower, a robot stands, and who walks into it does so himself
_REACHED = {"m": 0.01, "rad": 0.02}  # accepted miss of a goal, as in `execution`
_DEEPEST = 1e-3  # [m] of collisions that count as none
_SETTLING = 0.1  # [s] after a contact, in which a pushed object still moves


@dataclass(frozen=True)
class Person:
    """A cylinder that moves.

    Attributes:
        name: Its name.
        radius, height: Its size [m].
        locate: Time [s] → centre, shape (3,).
    """

    name: str
    radius: float
    height: float
    locate: Callable[[float], Floats]


@dataclass(frozen=True)
class Knowledge:
    """Since when the program knows how the world differs from the plan.

    Attributes:
        object: Object that is elsewhere; "" if none is.
        object_since: When its place became known [s]; inf: never. Contacts with it before do not
            count.
        robot_since: When the robot's own place became known [s]. No contacts before count.
    """

    object: str = ""
    object_since: float = 0.0
    robot_since: float = 0.0

    def covers(self, contact: Contact) -> bool:
        """Return whether enough was known to avoid a contact."""
        since = self.robot_since
        owners = [label.partition(".")[0] for label in (contact.first, contact.second)]
        if self.object in owners:
            since = max(since, self.object_since)
        return contact.time >= since


def judge_execution(
    found: Plan,
    robot: SimulatedRobot,
    sent: Sequence[tuple[float, Plan]],
    knowledge: Knowledge,
    person: Person | None = None,
) -> tuple[list[str], float]:
    """Judge how a robot really moved.

    Args:
        found: The plan whose goals count.
        robot: The robot, which has come to rest.
        sent: Begin on the robot's clock [s] and plan of all motions that were sent.
        knowledge: Since when the program knew of differences.
        person: Somebody who moved there.

    Returns:
        Why it is no success, and the depth of the deepest collision that could have been avoided
            [m]: how deep two bodies were in each other, or how far a free object was pushed.
    """
    reasons = _find_misses(found, robot)
    reasons += [grip.problem for grip in robot.grips if grip.problem]
    deepest = 0.0
    for contact in _find_contacts(found, robot, sent):
        if not knowledge.covers(contact):
            continue
        pushed = _measure_push(robot, found.scene, contact)
        deepest = max(deepest, contact.depth, pushed)
        if pushed > _DEEPEST:
            reasons.append(f"{contact}, pushed by {1e3 * pushed:.1f} mm")
        elif contact.depth > _DEEPEST:
            reasons.append(str(contact))
    if person is not None:
        overlap = _measure_depth(found.scene, robot, person)
        deepest = max(deepest, overlap)
        if overlap > _DEEPEST:
            reasons.append(f"overlaps the {person.name} by {1e3 * overlap:.1f} mm")
    return reasons, deepest


def _find_contacts(
    found: Plan, robot: SimulatedRobot, sent: Sequence[tuple[float, Plan]]
) -> list[Contact]:
    """Return the contacts that no motion has in the world in which it was planned.

    A motion that brakes on the path of the one before may touch what that one touches in its world.
    """
    contacts = list[Contact]()
    begins = [begin for begin, _ in sent]
    begins[0] = -np.inf
    ends = [*begins[1:], np.inf]
    planned_begin, planned = sent[0][0], found
    for (sent_at, plan), begin, end in zip(sent, begins, ends, strict=True):
        known = plan.scene
        if plan.success:
            planned_begin, planned = sent_at, plan
        else:
            times = planned.trajectory.times
            time = float(times[0]) + sent_at - planned_begin
            known = planned.scene_at(min(time, float(times[-1])))
        contacts += robot.contacts(known, begin=begin, end=end)
    return contacts


def _measure_push(robot: SimulatedRobot, scene: Scene, contact: Contact) -> float:
    """Return how far a contact pushed a free object that no hand held [m]."""
    end = contact.begin + contact.duration + _SETTLING
    held = {load.hold.object for load in robot.grasp_forces if contact.begin <= load.time <= end}
    before, after = robot.object_states(contact.begin), robot.object_states(end)
    pushed = 0.0
    for label in (contact.first, contact.second):
        name = label.partition(".")[0]
        if name in scene.objects and scene.objects[name].object.free and name not in held:
            moved = after[name].placement.translation - before[name].placement.translation
            pushed = max(pushed, float(np.linalg.norm(moved)))
    return pushed


def _find_misses(found: Plan, robot: SimulatedRobot) -> list[str]:
    """Return by how much the goals of a task's only step are missed, where they are."""
    step = found.steps[0]
    states = robot.object_states()
    missed = []
    if isinstance(step, Actuate):
        item = found.scene.objects[step.object].object
        for joint, value in step.joints.items():
            unit = item.coordinates.units[item.coordinates.index(joint)]
            miss = abs(states[step.object].joints[joint] - value)
            if miss > _REACHED[unit]:
                missed.append(f"{step.object}.{joint} misses its goal by {miss:.3g} {unit}")
    elif isinstance(step, Place):
        goal = found.end_scene().objects[step.object].placement
        there = states[step.object].placement
        miss = float(np.linalg.norm(there.translation - goal.translation))
        if miss > _REACHED["m"]:
            missed.append(f"{step.object} misses its place by {miss:.3g} m")
    else:
        raise InputError("cannot be judged", field="steps", got=repr(step))
    return missed


def _measure_depth(scene: Scene, robot: SimulatedRobot, person: Person) -> float:
    """Return how deep the robot, while it moved, was in a moving cylinder [m]."""
    model, shapes = scene.robot.model, scene.robot.collision.geometryObjects
    data = model.createData()
    solid = coal.Cylinder(person.radius, person.height)
    request, answer = coal.DistanceRequest(), coal.DistanceResult()
    request.enable_signed_distance = True
    motion = robot.trajectory()
    positions = motion.positions[:, : motion.robot_size]
    speeds = np.abs(np.diff(positions, axis=0)).max(axis=1) / np.diff(motion.times)
    deepest = 0.0
    for number in np.flatnonzero(speeds > _MOVING).tolist():
        centre = person.locate(float(motion.times[number]))
        q = scene.robot.coordinates.q(positions[number])
        pin.forwardKinematics(model, data, q)
        for shape in shapes:
            placement = data.oMi[shape.parentJoint] * shape.placement
            if np.linalg.norm(placement.translation[:2] - centre[:2]) > _FAR:
                continue
            answer.clear()
            distance = coal.distance(
                shape.geometry,
                coal.Transform3s(placement.rotation, placement.translation),
                solid,
                coal.Transform3s(np.eye(3), centre),
                request,
                answer,
            )
            deepest = max(deepest, -distance)
    return deepest
