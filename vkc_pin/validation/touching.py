"""Which pairs may touch: a hand and what it grasps, an object and what it stands on, a frame and what it is told to touch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from vkc_pin.motion.trajectory import Trajectory
from vkc_pin.scene.scene import Scene
from vkc_pin.task.steps import Grasp, Step, Touch
from vkc_pin.validation.distances import Solids

__all__ = ["may_touch"]

CONTACT = 1e-4  # [m] of overlap that is contact: what stands on a table overlaps it by rounding


def may_touch(
    scene: Scene, solids: Solids, trajectory: Trajectory, steps: Sequence[Step], dist_safe: float
) -> dict[tuple[int, int], float]:
    """Return pairs of geometries (indices in the world's collision model) → overlap that counts as contact [m].

    These pairs need no clearance: the robot's touch links and the link that is grasped; what is held through something and
    the link that holds it; a free object that is carried, and what is within `dist_safe` of it where it is taken or left;
    the link that a `Touch` brings somewhere, and what is within `dist_safe` of the target at the end of some phase.

    Args:
        scene: Where it happens.
        solids: The shapes of the scene as one plain tree.
        trajectory: The motion.
        steps: What was asked for.
        dist_safe: [m].
    """
    world = solids.world
    labels = world.collision_labels
    allowed: dict[tuple[int, int], float] = {}

    def allow(first: set[str], second: set[str], overlap: float) -> None:
        for i, one in enumerate(labels):
            if one in first:
                for j, other in enumerate(labels):
                    if other in second:
                        allowed.setdefault((min(i, j), max(i, j)), overlap)

    hands = set(scene.robot.touch_links)
    grips = [(step.object, step.attachment, step.by) for step in steps if isinstance(step, Grasp)]
    holds = [*(hold for phase in trajectory.phases for hold in phase.holds), *scene.holds]
    grips += [(hold.object, hold.attachment, hold.frame) for hold in holds]
    for owner, attachment, by in grips:
        grasped = f"{owner}.{scene.objects[owner].object.attachment(attachment).link}"
        allow({by} if by else hands, {grasped}, CONTACT if by else 0.0)

    robots = len(scene.robot.collision.geometryObjects)
    rows = world.positions(trajectory)
    for owner, waypoint in _taken_and_left(scene, trajectory):
        placed = solids.at(world.coordinates.q(rows[[waypoint]]))
        mine = [i for i, label in enumerate(labels) if label.partition(".")[0] == owner]
        others = [j for j in range(robots, len(labels)) if j not in mine]
        pairs = np.array([(min(i, j), max(i, j)) for i in mine for j in others], int).reshape(-1, 2)
        pairs = pairs[placed.bounds(np.zeros(len(pairs), int), pairs) < dist_safe]
        for i, j in pairs[placed.distances(np.zeros(len(pairs), int), pairs) < dist_safe].tolist():
            allowed.setdefault((i, j), CONTACT)

    touches = [step for step in steps if isinstance(step, Touch)]
    for phase in trajectory.phases if touches else ():
        placed = solids.at(world.coordinates.q(rows[[phase.last]]))
        for step in touches:
            target = step.target.translation if isinstance(step.target, pin.SE3) else np.array(step.target)
            owner = step.frame.partition(".")[0]
            close = [int(j) for j in placed.around(target, dist_safe) if j >= robots and labels[j].partition(".")[0] != owner]
            allow(_links_of(scene, step.frame), {labels[j] for j in close}, CONTACT)
    return allowed


def _links_of(scene: Scene, frame: str) -> set[str]:
    """Return the labels of the links that a `Touch` brings somewhere: those that its frame is fixed to."""
    if frame.partition(".")[0] in scene.objects:
        return {frame}
    robot = scene.robot
    joint = robot.model.frames[robot.model.getFrameId(frame)].parentJoint
    return {robot.link_of(i) for i, shape in enumerate(robot.collision.geometryObjects) if shape.parentJoint == joint}


def _taken_and_left(scene: Scene, trajectory: Trajectory) -> list[tuple[str, int]]:
    """Return every free object that is carried, with the waypoints at which it is taken or left."""
    found, phases = [], trajectory.phases
    for number, phase in enumerate(phases):
        for owner in phase.held:
            if not scene.objects[owner].object.free:
                continue
            before = phases[number - 1].held if number else scene.held
            after = phases[number + 1].held if number + 1 < len(phases) else phase.held
            if owner not in before:
                found.append((owner, phase.first))
            if owner not in after:
                found.append((owner, phase.last))
    return found
