"""Where pairs may come closer than dist_safe: what is picked up, put down or touched is in contact for a moment."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.chain import VirtualKinematicChain
from vkc_pin.geometry import own_name, shape_distance, standing_geometry
from vkc_pin.scene import Scene
from vkc_pin.task import Phase

__all__ = ["eased_pairs"]

NEAR = 4  # waypoints from a contact within which the shapes may still be close
SHARE = 0.5  # of the distance there is at the contact itself


def eased_pairs(
    scene: Scene,
    chain: VirtualKinematicChain,
    phase: Phase,
    geometry: pin.GeometryModel,
    labels: Sequence[str],
    pairs: Sequence[tuple[int, int, float]],
    first: int,
    before: Phase | None,
) -> dict[int, list[tuple[int, int, float]]]:
    """Return pair → (first waypoint, last waypoint, margin [m]) for what may be close for a while.

    A free object rests on something where it is lifted from and where it is put down; a frame that touches a target may
    come close to what the target is on. The margin is half the distance at the contact.

    Args:
        scene: Where it happens.
        chain: The chain.
        phase: The phase that `pairs` belong to.
        geometry: Its geometry; what stands has parent joint 0.
        labels: Of each geometry.
        pairs: (first geometry, second geometry, margin [m]).
        first: The waypoint at which the phase begins.
        before: The phase before it.
    """
    shapes, last = geometry.geometryObjects, first + phase.segments
    eased: dict[int, list[tuple[int, int, float]]] = {}
    moments = [(h, p, first, first + NEAR) for h, p in phase.lifted.items()]
    moments += [(h, p, last - NEAR, last) for h, p in phase.lowered.items()]
    for hold, placement, begin, end in moments:
        placed = dataclasses.replace(scene.objects[hold.object], placement=placement)
        rests = {shape.name: shape.placement for shape in standing_geometry(placed)}
        held = set(chain.held_geometries[hold])
        for k, (i, j, margin) in enumerate(pairs):
            if i in held and shapes[j].parentJoint == 0:
                where = rests[own_name(shapes[i].name)]
                distance = shape_distance(shapes[i].geometry, where, shapes[j].geometry, shapes[j].placement)
                if distance < margin:
                    eased.setdefault(k, []).append((begin, end, SHARE * max(distance, 0.0)))
    touches = [(goal, last - NEAR, last) for goal in phase.frames]
    touches += [(goal, first, first + NEAR) for goal in (before.frames if before else ())]
    for goal, begin, end in touches:
        if not goal.touches:
            continue
        point, where = coal.Sphere(1e-4), pin.SE3(np.eye(3), goal.placement.translation)
        joint, _ = chain.frame(goal.frame, goal.hold)
        for k, (i, j, margin) in enumerate(pairs):
            touching = labels[i] == str(goal) if goal.hold else shapes[i].parentJoint == joint
            if touching and shapes[j].parentJoint == 0:
                distance = shape_distance(point, where, shapes[j].geometry, shapes[j].placement)
                if distance < margin:
                    eased.setdefault(k, []).append((begin, end, SHARE * max(distance, 0.0)))
    return eased
