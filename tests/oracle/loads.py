"""Checks that released objects stay where they are, and that none is heavier than the payload.

Contacts are found by dense sampling: points in the object, lowered by 6 mm, and in something else.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator

import coal
import numpy as np

from .plan import Violation
from .poses import Poses, make_pose
from .stage import Solid, Stage, World
from .supports import compute_distance

__all__ = ["check_loads"]

DROP = 6e-3  # [m] by which an object is lowered: 5 mm, and the tolerance of goals
SAME = 1e-3  # [m] and [rad] within which an object is where it was before
_GRID = 25  # points along each side of the region that two shapes share
_LAYERS = 5
_POINT = coal.Sphere(1e-5)
_DIRECTIONS = 48
_SMALLEST = 3e-3  # [m] between centre of mass and contacts that sampling may miss


def check_loads(world: World, stages: list[Stage]) -> Iterator[Violation]:
    """Check the objects that are released between two phases, and the mass in the hand."""
    counts: dict[str, int] = {}
    held_before = {hold.object for hold in world.held}
    for before, stage in itertools.pairwise([None, *stages]):
        assert stage is not None
        held = {hold.object for hold in stage.phase.holds}
        for name in sorted(held_before - held):
            if not world.objects[name].free:
                continue
            number = counts.get(name, 0)
            counts[name] = number + 1
            flags = _list_permissions(world, name)
            may_fall = flags[number] if number < len(flags) else False
            if may_fall or _is_where_it_was(world, stages, stage, name):
                continue
            gap = _measure_overhang(world, before, stage, name, held)
            if gap > 0.0:
                time = float(stage.times[0])
                yield Violation("support", name, time, gap, "it falls or tips where it is released")
        held_before = held
        yield from _check_mass(world, stage, held)


def _list_permissions(world: World, name: str) -> list[bool]:
    """Return whether the step of each release of an object, in order, is `unsupported`."""
    flags: list[bool] = []
    carriers = {hold.object: hold.by for hold in world.held}
    for step in world.plan.steps:
        kind = step["step"]
        owner = step["frame"].partition(".")[0] if kind == "Touch" else step.get("object")
        if kind in ("Grasp", "Touch") and owner is not None:
            carriers.setdefault(owner, step.get("by"))
        if kind in ("Place", "Release"):
            carrier = (carriers.get(name) or "").partition(".")[0]
            is_placed = kind == "Place" and owner == name
            if is_placed or (name in carriers and owner in (None, name, carrier)):
                flags.append(bool(step.get("unsupported", False)))
                carriers.pop(name, None)
    releases = [step for step in world.plan.steps if step["step"] == "Release"]
    return flags or [bool(step.get("unsupported", False)) for step in releases]


def _is_where_it_was(world: World, stages: list[Stage], now: Stage, name: str) -> bool:
    """Return whether an object is where it was lifted or where the scene has it, up to heading."""
    base = (name, world.objects[name].tree.urdf.base)
    pose = now.links[base].get_sample(0)
    number = now.number
    while number > 0 and name in {hold.object for hold in stages[number - 1].phase.holds}:
        number -= 1
    known = []
    if name not in {hold.object for hold in world.held}:
        known.append(world.objects[name].placement)
    if number > 0 or known:
        known.append(stages[number].links[base].get_sample(0))
    for other in known:
        shift = np.linalg.norm(pose.translation[0] - other.translation[0])
        tilt = np.linalg.norm(pose.rotation[0, 2] - other.rotation[0, 2])
        if shift <= SAME + 1e-7 and tilt <= SAME + 1e-7:
            return True
    return False


def _measure_overhang(
    world: World, before: Stage | None, stage: Stage, name: str, held: set[str]
) -> float:
    """Return how far an object's centre of mass is outside its contacts [m]; 1 without any."""
    on_it = set()
    if before is not None:
        on_it = {one for one, (owner, _) in before.supports.items() if owner == name}
    own = [solid for solid in stage.solids if solid.owner == name]
    apart = {"robot", name, *held, *on_it}
    others = [solid for solid in stage.solids if solid.owner not in apart]
    points = [
        point
        for one in own
        for other in others
        for point in _sample_common_points(one, other, stage)
    ]
    if not points:
        return 1.0
    centre = _compute_centre(world, stage, {name, *on_it})
    angles = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    reach = (np.array(points)[:, :2] - centre[:2]) @ directions.T
    return float(max(0.0, -reach.max(axis=0).min() - _SMALLEST))


def _sample_common_points(one: Solid, other: Solid, stage: Stage) -> Iterator[np.ndarray]:
    """Yield points of a lowered shape that are also in another one."""
    lowered = make_pose((0.0, 0.0, -DROP)) @ one.poses.get_sample(0)
    there = other.poses.get_sample(0)
    boxes = [_compute_box(one, lowered), _compute_box(other, there)]
    low = np.maximum(boxes[0][0], boxes[1][0])
    high = np.minimum(boxes[0][1], boxes[1][1])
    if (
        not (low < high).all()
        or compute_distance(one.shape.solid, lowered, other.shape.solid, there) >= 0
    ):
        return
    sides = [np.linspace(low[k], high[k], count) for k, count in enumerate((_GRID, _GRID, _LAYERS))]
    for point in itertools.product(*sides):
        place = make_pose(point)
        if all(
            compute_distance(_POINT, place, solid.shape.solid, pose) <= 0.0
            for solid, pose in ((one, lowered), (other, there))
        ):
            yield np.array(point)


def _compute_box(solid: Solid, pose: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a shape's box in the world frame [m]."""
    centre = pose.transform_point(solid.shape.centre)[0]
    half = np.abs(pose.rotation[0]) @ solid.shape.half
    return centre - half, centre + half


def _compute_centre(world: World, stage: Stage, names: set[str]) -> np.ndarray:
    """Return the common centre of mass of objects; boxes of water where no mass is stated."""
    total, moment = 0.0, np.zeros(3)
    for name in names:
        urdf = world.objects[name].tree.urdf
        parts = [
            (mass, stage.links[name, link].get_sample(0).transform_point(centre)[0])
            for link in urdf.links
            for mass, centre, _ in [urdf.get_inertial(link)]
            if mass > 0.0
        ]
        factor = _get_mass(world, name) / sum(mass for mass, _ in parts) if parts else 1.0
        parts = [(factor * mass, centre) for mass, centre in parts] or [
            (
                8e3 * np.prod(solid.shape.half),
                solid.poses.get_sample(0).transform_point(solid.shape.centre)[0],
            )
            for solid in stage.solids
            if solid.owner == name
        ]
        for mass, centre in parts:
            total += mass
            moment += mass * centre
    return moment / total


def _check_mass(world: World, stage: Stage, held: set[str]) -> Iterator[Violation]:
    """Check the mass of the free objects in the hand, and of those that rest on them."""
    payload = world.robot.payload
    if payload is None:
        return
    carried = {name for name in held if world.objects[name].free}
    carried |= {name for name, (owner, _) in stage.supports.items() if owner in carried}
    mass = sum(_get_mass(world, name) for name in carried)
    excess = mass - payload * world.plan.options.get("payload_factor", 1.0)
    if excess > 1e-9:
        time = float(stage.times[0])
        yield Violation("payload", min(carried), time, excess, f"{mass:.3f} kg are carried")


def _get_mass(world: World, name: str) -> float:
    stated = world.objects[name].mass
    urdf = world.objects[name].tree.urdf
    masses = [urdf.get_inertial(link)[0] for link in urdf.links]
    return sum(masses) if stated is None else stated
