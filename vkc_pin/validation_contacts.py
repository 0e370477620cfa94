"""Which pairs may touch: a hand and what it grasps, a thing and what it rests on, a frame and what it is told to touch."""

from __future__ import annotations

from collections.abc import Sequence

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.geometry import shape_distance
from vkc_pin.scene import Scene
from vkc_pin.steps import Grasp, Step, Touch
from vkc_pin.trajectory import Trajectory
from vkc_pin.world import World

__all__ = ["may_touch"]

CONTACT = 1e-4  # [m] of overlap that is contact: what rests on a table overlaps it by rounding


def may_touch(
    scene: Scene, world: World, trajectory: Trajectory, steps: Sequence[Step], dist_safe: float
) -> dict[tuple[int, int], float]:
    """Return pairs of geometries (indices in the world's collision model) → overlap that counts as contact [m].

    These pairs need no clearance: the robot's touch links and the link that is grasped; what is held through something and
    the link that holds it; a free object that is carried, and what is within `dist_safe` of it where it is taken or left;
    the link that a `Touch` brings somewhere, and what is within `dist_safe` of the target at the end of some phase.

    Args:
        scene: Where it happens.
        world: The scene as one plain tree.
        trajectory: The motion.
        steps: What was asked for.
        dist_safe: [m].
    """
    labels, shapes = world.collision_labels, world.collision.geometryObjects
    allowed: dict[tuple[int, int], float] = {}

    def allow(first: set[str], second: set[str], overlap: float) -> None:
        for i, one in enumerate(labels):
            if one in first:
                for j, other in enumerate(labels):
                    if other in second:
                        allowed.setdefault((min(i, j), max(i, j)), overlap)

    hands = set(scene.robot.touch_links)
    grips = [(step.object, step.attachment, step.by) for step in steps if isinstance(step, Grasp)]
    grips += [(owner, attachment, phase.by.get(owner)) for phase in trajectory.phases for owner, attachment in phase.held.items()]
    grips += [(owner, attachment, scene.held_by.get(owner)) for owner, attachment in scene.held.items()]
    for owner, attachment, by in grips:
        grasped = f"{owner}.{scene.objects[owner].object.attachment(attachment).link}"
        allow({by} if by else hands, {grasped}, CONTACT if by else 0.0)

    robots = len(scene.robot.collision.geometryObjects)
    data, geometry = world.model.createData(), world.collision.createData()
    rows = world.positions(trajectory)
    for owner, waypoint in _taken_and_left(scene, trajectory):
        pin.updateGeometryPlacements(world.model, data, world.collision, geometry, world.coordinates.q(rows[waypoint]))
        mine = [i for i, label in enumerate(labels) if label.partition(".")[0] == owner]
        for i in mine:
            for j in range(len(labels)):
                if j in mine or j < robots:
                    continue
                if shape_distance(shapes[i].geometry, geometry.oMg[i], shapes[j].geometry, geometry.oMg[j]) < dist_safe:
                    allowed.setdefault((min(i, j), max(i, j)), CONTACT)

    touches = [step for step in steps if isinstance(step, Touch)]
    for row in rows[[phase.last for phase in trajectory.phases]] if touches else ():
        pin.updateGeometryPlacements(world.model, data, world.collision, geometry, world.coordinates.q(row))
        for step in touches:
            target = step.target.translation if isinstance(step.target, pin.SE3) else np.array(step.target)
            point, where = coal.Sphere(1e-4), pin.SE3(np.eye(3), target)
            near = {
                labels[j]
                for j in range(robots, len(labels))
                if labels[j].partition(".")[0] != step.frame.partition(".")[0]
                and shape_distance(point, where, shapes[j].geometry, geometry.oMg[j]) < dist_safe
            }
            allow(_links_of(scene, step.frame), near, CONTACT)
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
