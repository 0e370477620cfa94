"""Which pairs of a phase may be closer than others for a while, where something is taken, put down or touched."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.options import Options
from vkc_pin.planning.chain.chain import VirtualKinematicChain
from vkc_pin.planning.chain.phase_geometry import PhaseGeometry
from vkc_pin.world.models.shapes import compute_shape_distance, compute_world_box, get_local_name
from vkc_pin.world.scene.contact_rules import (
    CONTACT_DEPTH,
    CONTACT_WINDOW,
    compute_hand_clearance,
    find_touch_links,
)
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.scene.support import SupportedObject
from vkc_pin.world.task.phases import Task

__all__ = ["REDUCED_MARGIN_RATIO", "find_reduced_margins"]

REDUCED_MARGIN_RATIO = 0.5  # margin, as a share of the distance at the contact itself

Eased = dict[int, list[tuple[int, int, float]]]


def find_reduced_margins(
    scene: Scene,
    chain: VirtualKinematicChain,
    task: Task,
    number: int,
    part: PhaseGeometry,
    options: Options,
) -> Eased:
    """Return pair → (first waypoint, last waypoint, margin [m]) of pairs with a temporarily smaller margin.

    See `world.scene.contact_rules`.

    A hand keeps the attachment's clearance from the object that it takes or lets go of. A free
    object rests on something where it is lifted from and where it is put down, and may still do so
    in the hand at the start, with what rides on it; a frame that touches a target may come close to
    what the target is on: there the margin is half the distance at the contact. What a free object
    stands in at the start it may stand in then.

    Args:
        scene: Where it happens.
        chain: The chain.
        task: What is held when.
        number: Of the phase.
        part: Its geometry and pairs.
        options: Waypoints' time, and clearances.
    """
    phase, before = task.phases[number], task.phases[number - 1] if number else None
    first = sum(earlier.segments for earlier in task.phases[:number])
    last, steps = first + phase.segments, options.steps(CONTACT_WINDOW)
    shapes, eased = part.shapes, Eased()

    def ease(
        moving: int,
        shape: coal.CollisionGeometry,
        where: pin.SE3,
        begin: int,
        end: int,
        *,
        inside: bool = False,
    ) -> None:
        """Ease the pairs of a geometry that moves with what stands next to a shape, or in it."""
        beside = part.within(float(part.margins.max()), *compute_world_box(shape, where))
        for k in part.pairs_of(moving, beside).tolist():
            other = shapes[int(part.pairs[k, 1])]
            distance = compute_shape_distance(shape, where, other.geometry, other.placement)
            share = REDUCED_MARGIN_RATIO * max(distance, 0.0)
            if distance < part.margins[k]:
                eased.setdefault(k, []).append(
                    (begin, end, distance if inside and distance < -CONTACT_DEPTH else share)
                )

    for holds, begin, end in (
        (phase.released, first, first + steps),
        (phase.grasps, last - steps, last),
    ):
        for hold in holds:
            hand = np.isin(part.labels, list(find_touch_links(scene, hold)))
            its = np.array([label.startswith(f"{hold.object}.") for label in part.labels])
            for k in np.flatnonzero(hand[part.pairs[:, 0]] & its[part.pairs[:, 1]]).tolist():
                margin = compute_hand_clearance(scene, hold, part.labels[part.pairs[k, 1]], options)
                eased.setdefault(k, []).append((begin, end, margin))
    for geometries, placed, begins in _moments(scene, chain, task, number):
        stands = {shape.name: shape.placement for shape in make_world_shapes(placed)}
        for i in geometries:
            begin, end = (first, first + steps) if begins else (last - steps, last)
            new = begins and placed.name not in {
                hold.object for earlier in task.phases[:number] for hold in earlier.held
            }
            ease(
                i,
                shapes[i].geometry,
                stands[get_local_name(shapes[i].name)],
                begin,
                end,
                inside=new,
            )
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


def _moments(
    scene: Scene, chain: VirtualKinematicChain, task: Task, number: int
) -> Iterator[tuple[Sequence[int], PlacedObject, bool]]:
    """Yield the geometries, and where their object stands, of what begins or ends to be carried in a phase: (..., begins).

    What is in the hand at the start begins there.
    """
    phase = task.phases[number]
    at_start = {
        hold: scene.objects[hold.object].placement
        for hold in phase.held
        if number == 0 and hold in scene.holds
    }
    for moments, begins in ((at_start, True), (phase.lifted, True), (phase.lowered, False)):
        for hold, placement in moments.items():
            if not scene.objects[hold.object].object.free:
                continue
            placed = dataclasses.replace(scene.objects[hold.object], placement=placement)
            yield chain.held_geometries[hold], placed, begins
            for ride in phase.supported:
                if ride.hold == hold:
                    yield chain.ride_geometries[ride], _ridden(scene, ride, placed), begins
    for ride in phase.supported:
        carrier = scene.objects[ride.hold.object]
        if not carrier.object.free:
            goals = {
                name: float(np.clip(value, *phase.ranges[name]))
                for name, value in phase.values.items()
            }
            for state, begins in (
                (phase.initial_values, True),
                ({**phase.initial_values, **goals}, False),
            ):
                yield (
                    chain.ride_geometries[ride],
                    _ridden(scene, ride, _with(carrier, state)),
                    begins,
                )


def _ridden(scene: Scene, ride: SupportedObject, carrier: PlacedObject) -> PlacedObject:
    """Return what rides, where it stands on a carrier."""
    return dataclasses.replace(
        scene.objects[ride.object],
        placement=carrier.link_placement(ride.link) * ride.placement_in_link,
    )


def _with(placed: PlacedObject, state: Mapping[str, float]) -> PlacedObject:
    """Return an object with those of some values, by coordinate "<object>.<joint>", that are its own."""
    return placed.with_state(
        {c.partition(".")[2]: v for c, v in state.items() if c.partition(".")[0] == placed.name}
    )
