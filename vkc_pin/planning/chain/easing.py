"""Finds pairs whose margin is temporarily reduced, at grasps, placements and touches."""

from __future__ import annotations

import dataclasses
import itertools
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

REDUCED_MARGIN_RATIO = 0.5  # margin relative to the distance at the contact

ReducedMargins = dict[int, list[tuple[int, int, float]]]
# geometry of the chain, shape and placement at a contact, whether it is at the begin of the phase,
# and whether the shapes may overlap
_Contact = tuple[int, coal.CollisionGeometry, pin.SE3, bool, bool]


def find_reduced_margins(
    scene: Scene,
    chain: VirtualKinematicChain,
    task: Task,
    number: int,
    part: PhaseGeometry,
    options: Options,
) -> ReducedMargins:
    """Return pair → (first waypoint, last waypoint, margin [m]) of temporarily reduced margins.

    A hand keeps the attachment's clearance from what it grasps or releases. A free object is close
    to its support where it is lifted and placed, and so are the objects it supports; a frame that
    touches a target is close to the surface there. The margin then is half the distance at the
    contact. An initial penetration of a grasped object is allowed at the start. See
    `world.scene.contact_rules`.
    """
    phase, reduced = task.phases[number], ReducedMargins()
    first, steps = sum(p.segments for p in task.phases[:number]), options.steps(CONTACT_WINDOW)
    last = first + phase.segments
    windows = {True: (first, first + steps), False: (last - steps, last)}
    for holds, begins in ((phase.released, True), (phase.grasps, False)):
        for hold in holds:
            is_hand = np.isin(part.labels, list(find_touch_links(scene, hold)))
            is_object = np.array([label.startswith(f"{hold.object}.") for label in part.labels])
            found = np.flatnonzero(is_hand[part.pairs[:, 0]] & is_object[part.pairs[:, 1]])
            for k in found.tolist():
                margin = compute_hand_clearance(scene, hold, part.labels[part.pairs[k, 1]], options)
                reduced.setdefault(k, []).append((*windows[begins], margin))
    reach = float(part.margins.max())
    for moving, shape, where, begins, may_overlap in itertools.chain(
        _find_supports(scene, chain, task, number, part), _find_touches(chain, task, number, part)
    ):
        nearby = part.find_static_near(reach, *compute_world_box(shape, where))
        for k in part.find_pairs(moving, nearby).tolist():
            other = part.shapes[int(part.pairs[k, 1])]
            distance = compute_shape_distance(shape, where, other.geometry, other.placement)
            margin = REDUCED_MARGIN_RATIO * max(distance, 0.0)
            if may_overlap and distance < -CONTACT_DEPTH:
                margin = distance
            if distance < part.margins[k]:
                reduced.setdefault(k, []).append((*windows[begins], margin))
    return reduced


def _find_touches(
    chain: VirtualKinematicChain, task: Task, number: int, part: PhaseGeometry
) -> Iterator[_Contact]:
    """Yield geometry that touches a target at the end or the begin of a phase."""
    before = task.phases[number - 1].frames if number else ()
    goals = [(goal, False) for goal in task.phases[number].frames]
    for goal, begins in (*goals, *((goal, True) for goal in before)):
        if not goal.touches:
            continue
        point, where = coal.Sphere(1e-4), pin.SE3(np.eye(3), goal.placement.translation)
        joint, _ = chain.frame(goal.frame, goal.hold)
        for i in range(len(chain.collision.geometryObjects)):
            if part.labels[i] == str(goal) if goal.hold else part.shapes[i].parentJoint == joint:
                yield i, point, where, begins, False


def _find_supports(
    scene: Scene, chain: VirtualKinematicChain, task: Task, number: int, part: PhaseGeometry
) -> Iterator[_Contact]:
    """Yield geometry of objects that are lifted or placed; initially they may overlap others."""
    earlier = {hold.object for phase in task.phases[:number] for hold in phase.held}
    for geometries, placed, begins in _find_lift_and_place_moments(scene, chain, task, number):
        placements = {shape.name: shape.placement for shape in make_world_shapes(placed)}
        for i in geometries:
            where = placements[get_local_name(part.shapes[i].name)]
            may_overlap = begins and placed.name not in earlier
            yield i, part.shapes[i].geometry, where, begins, may_overlap


def _find_lift_and_place_moments(
    scene: Scene, chain: VirtualKinematicChain, task: Task, number: int
) -> Iterator[tuple[Sequence[int], PlacedObject, bool]]:
    """Yield geometries, their object as placed, and whether it is lifted or placed then.

    These are the objects whose transport begins (True) or ends (False) in a phase. Transport of an
    object held at the start begins in the first phase.
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
                    supported = _place_supported_object(scene, ride, placed)
                    yield chain.ride_geometries[ride], supported, begins
    for ride in phase.supported:
        carrier = scene.objects[ride.hold.object]
        if not carrier.object.free:
            goals = {c: float(np.clip(v, *phase.ranges[c])) for c, v in phase.values.items()}
            final_values = {**phase.initial_values, **goals}
            for state, begins in ((phase.initial_values, True), (final_values, False)):
                placed = _with_joint_positions(carrier, state)
                placed = _place_supported_object(scene, ride, placed)
                yield chain.ride_geometries[ride], placed, begins


def _place_supported_object(
    scene: Scene, ride: SupportedObject, carrier: PlacedObject
) -> PlacedObject:
    """Return the supported object, placed on its carrier."""
    return dataclasses.replace(
        scene.objects[ride.object],
        placement=carrier.link_placement(ride.link) * ride.placement_in_link,
    )


def _with_joint_positions(placed: PlacedObject, state: Mapping[str, float]) -> PlacedObject:
    """Return an object with those of the positions "<object>.<joint>" that are its own."""
    return placed.with_state(
        {c.partition(".")[2]: v for c, v in state.items() if c.partition(".")[0] == placed.name}
    )
