"""Tracks which objects rest on carried or moving links in the course of a task."""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import replace

import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.world.models.shapes import get_link_name
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.scene.support import (
    MAX_TILT,
    SupportedObject,
    compute_tilt,
    find_supported_objects,
    find_supports,
)

_LEVEL = 1e-3  # [rad] tilt up to which a goal counts as level: the tolerance of goals


class SupportTracker:
    """Free objects that rest on links which a robot carries or moves.

    Attributes:
        carried: Objects that rest on held free objects.
        moved: Names of the objects that have moved with their support.
    """

    def __init__(self, scene: Scene, resting: dict[str, pin.SE3]) -> None:
        self.scene = scene
        self.resting = resting
        self.carried: tuple[SupportedObject, ...] = ()
        self.moved: set[str] = set()
        self._on_moving: tuple[SupportedObject, ...] = ()
        self._put_down: dict[str, pin.SE3] = {}  # placements where last put down

    def add_carried(self, hold: Hold, state: Mapping[str, float], where: str) -> None:
        """Add the objects that rest on an object that is grasped, if that is free."""
        self._put_down.pop(hold.object, None)
        placed = self.scene.objects[hold.object]
        if placed.object.free:
            now = {hold.object: placed, **place_objects(self.scene, state, self.resting)}
            supported = find_objects_supported_by(self.scene, now, hold, set(), where)
            self.carried += supported
            for one in supported:
                self.resting.pop(one.object)
                self.moved.add(one.object)

    def check_level(self, hold: Hold, placement: pin.SE3, where: str) -> None:
        """Check that a goal of a carried object keeps the objects on it level."""
        for one in self.carried:
            if one.hold == hold:
                _check_tilt(one, compute_tilt(one.carrier_placement, placement), _LEVEL, where)

    def release_carried(self, hold: Hold, placement: pin.SE3) -> list[str]:
        """Release the objects on a free object released at `placement`; return their names."""
        placed = replace(self.scene.objects[hold.object], placement=placement)
        ended = [one for one in self.carried if one.hold == hold]
        for one in ended:
            self.resting[one.object] = placed.link_placement(one.link) * one.placement_in_link
        self.carried = tuple(one for one in self.carried if one.hold != hold)
        return [one.object for one in ended]

    def begin_motion(
        self, hold: Hold, joints: Set[str], state: Mapping[str, float], where: str
    ) -> None:
        """Add the objects that rest on a fixed object of which joints begin to move."""
        before = place_objects(self.scene, state, self.resting)
        self._on_moving = find_objects_supported_by(self.scene, before, hold, joints, where)
        for one in self._on_moving:
            self._put_down.setdefault(one.object, self.resting[one.object])
            self.moved.add(one.object)

    def end_motion(self, state: Mapping[str, float], where: str) -> None:
        """Release the objects added by `begin_motion` at their new placements."""
        for one in self._on_moving:
            after = place_objects(self.scene, state, self.resting)
            self.resting[one.object] = compute_placement_after_motion(
                one, self._put_down[one.object], after[one.hold.object], where
            )
        self._on_moving = ()

    @property
    def supported(self) -> tuple[SupportedObject, ...]:
        """Objects that rest on moving links at present."""
        return (*self.carried, *self._on_moving)


def place_objects(
    scene: Scene, state: Mapping[str, float], resting: Mapping[str, pin.SE3]
) -> dict[str, PlacedObject]:
    """Return the objects that are not held at some time of a task, in their states.

    Args:
        scene: Scene at the start.
        state: Object coordinate → value, where it differs from the scene's.
        resting: Free object → its placement, for free objects that are not held.
    """
    found = {}
    for name, placed in scene.objects.items():
        if placed.object.free and name not in resting:
            continue
        values = dict[str, float]()
        for coordinate, value in state.items():
            owner, _, joint = coordinate.partition(".")
            if owner == name:
                values[joint] = value
        moved = replace(placed, placement=resting.get(name, placed.placement))
        found[name] = moved.with_state(values)
    return found


def find_objects_supported_by(
    scene: Scene, now: Mapping[str, PlacedObject], hold: Hold, joints: Set[str], where: str
) -> tuple[SupportedObject, ...]:
    """Return the objects that will rest on a held object while it moves."""
    item = now[hold.object].object
    links = set(item.links) if item.free else item.links_moved_by(joints)
    free = [name for name, placed in now.items() if placed.object.free and name != hold.object]
    supported = find_supported_objects(now, {hold.object: links}, free)
    if not supported:
        return ()
    static_shapes = list[tuple[str, pin.GeometryObject]]()
    for name, placed in now.items():
        if name in supported:
            continue
        for shape in make_world_shapes(placed):
            link = get_link_name(shape.name)
            is_moving = name == hold.object and link in links
            if not is_moving:
                static_shapes.append((f"{name}.{link}", shape))
    static_shapes += zip(scene.obstacle_labels, scene.obstacles, strict=True)
    carrier = now[hold.object]
    found = []
    for name, label in supported.items():
        static_support = min(find_supports(now[name], static_shapes), default=None)
        if static_support is not None and not item.free:
            raise InputError(
                f"'{name}' rests both on a moving and on a fixed link: '{label}' and "
                f"'{static_support}'",
                field=where,
                expected="that it is removed, or rests on one of them only",
            )
        _, _, link = label.partition(".")
        placement_in_link = carrier.link_placement(link).actInv(now[name].placement)
        found.append(SupportedObject(name, hold, link, placement_in_link, carrier.placement))
    return tuple(found)


def compute_placement_after_motion(
    one: SupportedObject, put_down: pin.SE3, after: PlacedObject, where: str
) -> pin.SE3:
    """Return the placement of a supported object after a joint of its support has moved.

    The motion must not tilt the object too much from `put_down`, where it was last put down.
    """
    placement = after.link_placement(one.link) * one.placement_in_link
    _check_tilt(one, compute_tilt(put_down, placement), MAX_TILT, where)
    return placement


def _check_tilt(one: SupportedObject, angle: float, max_angle: float, where: str) -> None:
    if angle > max_angle:
        problem = f"'{one.object}' rests on '{one.support}', which would tilt too much"
        expected = f"that it is removed before, or at most {max_angle:g} rad"
        raise InputError(problem, field=where, expected=expected, got=f"{angle:.3g} rad")
