"""Checks that released objects rest on something, and that no load exceeds the payload."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
import pinocchio as pin

from vkc_pin.options import Options
from vkc_pin.validation.goals import find_grasped_objects, measure_tilt
from vkc_pin.validation.report import Violation
from vkc_pin.validation.samples import Samples
from vkc_pin.validation.tolerances import Tolerances
from vkc_pin.world.models.shapes import get_link_name
from vkc_pin.world.scene.footing import Footing, find_footing
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes
from vkc_pin.world.task.steps import Place, Release, Step

# [m] at which a fall counts that nothing ends
_MAX_FALL = 10.0


@dataclasses.dataclass(frozen=True)
class LoadCheck:
    """Result of the check: violations, and exceptions that a step or option allows, as texts."""

    violations: tuple[Violation, ...]
    allowed: tuple[str, ...]


def check_loads(
    samples: Samples, steps: Sequence[Step], options: Options, tolerances: Tolerances
) -> LoadCheck:
    """Check that released objects neither fall nor tip over, and that none is too heavy.

    Args:
        samples: Sampled motion.
        steps: Steps, of which `Place` and `Release` may allow that objects are unsupported.
        options: `payload_factor` is checked.
        tolerances: Accepted errors of goals, which may leave an object that much higher.
    """
    violations: list[Violation] = []
    allowed: list[str] = []
    permissions = _find_permissions(samples, steps)
    for number, owner in _list_releases(samples):
        may_fall = bool(permissions.get(owner)) and permissions[owner].pop(0)
        footing = _find_footing(samples, number, owner, tolerances)
        if footing is None:
            continue
        if may_fall:
            allowed.append(f"'{owner}' is released although {footing}")
            continue
        amount = footing.overhang if footing.supports else min(footing.height, _MAX_FALL)
        begin = samples.trajectory.phases[number].first
        text = f"is released, but {footing}"
        violations.append(
            samples.make_violation("support", owner, amount, "m", text, waypoint=begin)
        )
    allowed_overloads: list[str] = []
    for overload in _find_overloads(samples, options):
        if isinstance(overload, Violation):
            violations.append(overload)
        elif overload not in allowed_overloads:
            allowed_overloads.append(overload)
    return LoadCheck(tuple(violations), (*allowed, *allowed_overloads))


def _list_releases(samples: Samples) -> Iterator[tuple[int, str]]:
    """Yield the number of each phase before which a free object is released, and the object."""
    before = samples.scene.held
    for number, phase in enumerate(samples.trajectory.phases):
        for owner in sorted(before.keys() - phase.held.keys()):
            if samples.scene.objects[owner].object.free:
                yield number, owner
        before = phase.held


def _find_permissions(samples: Samples, steps: Sequence[Step]) -> dict[str, list[bool]]:
    """Return for each object whether it may fall at its first release, at its second, and so on."""
    grasped = find_grasped_objects(samples, steps)
    permissions: dict[str, list[bool]] = {}
    for step, before, after in zip(steps, grasped[:-1], grasped[1:], strict=True):
        in_hand = set(before)
        if isinstance(step, Place):
            in_hand.add(step.object)
        for owner in in_hand - after:
            may_fall = isinstance(step, Place | Release) and step.unsupported
            permissions.setdefault(owner, []).append(may_fall)
    # Steps need not say how an object came into the hand.
    releases = [step.unsupported for step in steps if isinstance(step, Release)]
    for owner in samples.scene.objects.keys() - permissions.keys():
        permissions[owner] = list(releases)
    return permissions


def _find_footing(
    samples: Samples, number: int, owner: str, tolerances: Tolerances
) -> Footing | None:
    """Return how an object is released before a phase; None if it stays where it is."""
    phase = samples.trajectory.phases[number]
    row = int(samples.waypoint_rows[phase.first])
    placed = _place(samples, owner, row)
    if _is_put_back(samples, number, owner, placed, tolerances):
        return None
    supports = samples.free_objects.supports[number - 1] if number else {}
    load_names = [name for name, label in supports.items() if label.partition(".")[0] == owner]
    load = [_place(samples, name, row) for name in load_names]
    others: list[tuple[str, pin.GeometryObject]] = []
    for name in samples.scene.objects:
        if name == owner or name in phase.held or name in load_names:
            continue
        for shape in make_world_shapes(_place(samples, name, row)):
            others.append((f"{name}.{get_link_name(shape.name)}", shape))
    scene = samples.scene
    others += zip(scene.obstacle_labels, scene.obstacles, strict=True)
    footing = find_footing(placed, others, load)
    # An object may be released by the tolerance of its goal too high.
    shift = pin.SE3(np.eye(3), np.array([0.0, 0.0, -tolerances.goal_position]))
    lower = dataclasses.replace(placed, placement=shift * placed.placement)
    most = 2.0 * tolerances.goal_position
    if footing.is_stable(most) or find_footing(lower, others, load).is_stable(most):
        return None
    return footing


def _place(samples: Samples, name: str, row: int) -> PlacedObject:
    """Return an object as it is at a sample."""
    placed = samples.scene.objects[name]
    coordinates = samples.world.coordinates
    joints = placed.object.coordinates.names
    values = [samples.z[row, coordinates.index(f"{name}.{joint}")] for joint in joints]
    (pose,) = samples.compute_placements([row], f"{name}.{placed.object.base_link}")
    return dataclasses.replace(placed, placement=pose, state=np.array(values, float))


def _is_put_back(
    samples: Samples, number: int, owner: str, placed: PlacedObject, tolerances: Tolerances
) -> bool:
    """Return whether an object is where it was lifted, or where the scene has it, at any heading.

    Other objects, which it rested on, may have moved since; these have been checked themselves.
    """
    phases = samples.trajectory.phases
    first = number
    while first > 0 and owner in phases[first - 1].held:
        first -= 1
    is_held_from_start = owner in samples.scene.held
    known = [] if is_held_from_start else [samples.scene.objects[owner]]
    if first > 0 or not is_held_from_start:
        known.append(_place(samples, owner, int(samples.waypoint_rows[phases[first].first])))
    for before in known:
        now = placed.placement
        then = before.placement
        shift = float(np.linalg.norm(now.translation - then.translation))
        tilt = measure_tilt(now, then)
        if shift <= tolerances.goal_position and tilt <= tolerances.goal_angle:
            return True
    return False


def _find_overloads(samples: Samples, options: Options) -> Iterator[Violation | str]:
    """Yield every phase in which the hand carries more than the payload, as a text if allowed."""
    payload = samples.scene.robot.payload
    objects = samples.scene.objects
    if payload is None:
        return
    phases = zip(samples.trajectory.phases, samples.free_objects.supports, strict=True)
    for phase, supports in phases:
        held = [name for name in phase.held if objects[name].object.free]
        resting = [name for name, label in supports.items() if label.partition(".")[0] in held]
        carried = [*held, *resting]
        mass = sum(objects[name].object.mass for name in carried)
        if mass <= payload:
            continue
        text = f"{mass:.3g} kg, more than the robot's payload of {payload:.3g} kg"
        excess = mass - payload * options.payload_factor
        if excess > 0.0:
            yield samples.make_violation(
                "payload", held[0], excess, "kg", f"carries {text}", waypoint=phase.first
            )
            continue
        names = " and ".join(f"'{name}'" for name in carried)
        verb = "together are" if resting else "is"
        yield f"{names} {verb} carried: {text}"
