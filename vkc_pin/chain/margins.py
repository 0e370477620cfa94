"""Where pairs may come closer than dist_safe: what is picked up, put down or touched is in contact for a moment."""

from __future__ import annotations

import dataclasses

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.chain.broadphase import PhaseGeometry
from vkc_pin.chain.chain import VirtualKinematicChain
from vkc_pin.models.shapes import own_name, shape_distance, world_box
from vkc_pin.scene.placed import standing_geometry
from vkc_pin.scene.scene import Scene
from vkc_pin.task.phases import Phase

__all__ = ["eased_pairs"]

EASED_TIME = 1.0  # [s] before and after a contact in which the shapes may be close, at `Options.dt` a waypoint
EASED_SHARE = 0.5  # margin, as a share of the distance at the contact itself


def eased_pairs(
    scene: Scene, chain: VirtualKinematicChain, phase: Phase, part: PhaseGeometry, *, first: int, before: Phase | None, steps: int
) -> dict[int, list[tuple[int, int, float]]]:
    """Return pair → (first waypoint, last waypoint, margin [m]) for what may be close for a while.

    A free object rests on something where it is lifted from and where it is put down; a frame that touches a target may
    come close to what the target is on. The margin is half the distance at the contact.

    Args:
        scene: Where it happens.
        chain: The chain.
        phase: The phase.
        part: Its geometry and pairs.
        first: The waypoint at which the phase begins.
        before: The phase before it.
        steps: The waypoints of `EASED_TIME`.
    """
    shapes, last = part.shapes, first + phase.segments
    eased: dict[int, list[tuple[int, int, float]]] = {}

    def ease(moving: int, shape: coal.CollisionGeometry, where: pin.SE3, begin: int, end: int) -> None:
        """Ease the pairs of a geometry that moves with what stands next to a shape."""
        beside = part.within(float(part.margins.max()), *world_box(shape, where))
        for k in part.pairs_of(moving, beside).tolist():
            other = shapes[int(part.pairs[k, 1])]
            distance = shape_distance(shape, where, other.geometry, other.placement)
            if distance < part.margins[k]:
                eased.setdefault(k, []).append((begin, end, EASED_SHARE * max(distance, 0.0)))

    moments = [(h, p, first, first + steps) for h, p in phase.lifted.items()]
    moments += [(h, p, last - steps, last) for h, p in phase.lowered.items()]
    for hold, placement, begin, end in moments:
        placed = dataclasses.replace(scene.objects[hold.object], placement=placement)
        stands = {shape.name: shape.placement for shape in standing_geometry(placed)}
        for i in chain.held_geometries[hold]:
            ease(i, shapes[i].geometry, stands[own_name(shapes[i].name)], begin, end)
    touches = [(goal, last - steps, last) for goal in phase.frames]
    touches += [(goal, first, first + steps) for goal in (before.frames if before else ())]
    for goal, begin, end in touches:
        if not goal.touches:
            continue
        point, where = coal.Sphere(1e-4), pin.SE3(np.eye(3), goal.placement.translation)
        joint, _ = chain.frame(goal.frame, goal.hold)
        for i in range(len(chain.collision.geometryObjects)):
            if part.labels[i] == str(goal) if goal.hold else shapes[i].parentJoint == joint:
                ease(i, point, where, begin, end)
    return eased
