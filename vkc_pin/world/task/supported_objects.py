"""What rides along while something is moved or carried: as `world.scene.support` finds it, in the state of a task."""

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

__all__ = [
    "SupportTracker",
    "compute_placement_after_motion",
    "find_objects_supported_by",
    "place_objects",
]


class SupportTracker:
    """What stands on what a robot carries or moves, along a task.

    Attributes:
        carried: What rides on what is in the hand.
        moved: What is or has been moved with what it stands on.

    Args:
        scene: The scene at the start.
        standing: Free object → its placement, for those that nobody holds; kept up to date here.
    """

    def __init__(self, scene: Scene, standing: dict[str, pin.SE3]) -> None:
        self.scene, self.standing = scene, standing
        self.carried: tuple[SupportedObject, ...] = ()
        self.moved: set[str] = set()
        self._rides: tuple[SupportedObject, ...] = ()
        self._before: dict[str, PlacedObject] = {}

    def load(self, hold: Hold, state: Mapping[str, float], where: str) -> None:
        """Let ride what stands on something that is taken hold of, if that is free."""
        placed = self.scene.objects[hold.object]
        if placed.object.free:
            now = {hold.object: placed, **place_objects(self.scene, state, self.standing)}
            riding = find_objects_supported_by(self.scene, now, hold, set(), where)
            self.carried += riding
            for ride in riding:
                self.standing.pop(ride.object)
                self.moved.add(ride.object)

    def unload(self, hold: Hold, placement: pin.SE3) -> list[str]:
        """Let stand what rode on something free that is let go of at `placement`; return it."""
        placed = replace(self.scene.objects[hold.object], placement=placement)
        ended = [ride for ride in self.carried if ride.hold == hold]
        for ride in ended:
            self.standing[ride.object] = placed.link_placement(ride.link) * ride.placement_in_link
        self.carried = tuple(ride for ride in self.carried if ride.hold != hold)
        return [ride.object for ride in ended]

    def begin(self, hold: Hold, joints: Set[str], state: Mapping[str, float], where: str) -> None:
        """Let ride what stands on something fixed, joints of which begin to move; see `find_objects_supported_by`."""
        self._before = place_objects(self.scene, state, self.standing)
        self._rides = find_objects_supported_by(self.scene, self._before, hold, joints, where)
        self.moved |= {ride.object for ride in self._rides}

    def end(self, state: Mapping[str, float], where: str) -> None:
        """Let stand what rode since `begin`; see `compute_placement_after_motion`."""
        for ride in self._rides:
            name, after = ride.hold.object, place_objects(self.scene, state, self.standing)
            self.standing[ride.object] = compute_placement_after_motion(
                ride, self._before[name], after[name], where
            )
        self._rides = ()

    @property
    def rides(self) -> tuple[SupportedObject, ...]:
        """What rides now."""
        return (*self.carried, *self._rides)


def place_objects(
    scene: Scene, state: Mapping[str, float], standing: Mapping[str, pin.SE3]
) -> dict[str, PlacedObject]:
    """Return the objects that stand somewhere at some time of a task, free or not.

    Args:
        scene: The scene at the start.
        state: Object coordinate → value, for those that differ from the scene's.
        standing: Free object → its placement, for those that stand.
    """
    found = {}
    for name, placed in scene.objects.items():
        if placed.object.free and name not in standing:
            continue
        values = {
            c.removeprefix(f"{name}."): v for c, v in state.items() if c.startswith(f"{name}.")
        }
        found[name] = replace(placed, placement=standing.get(name, placed.placement)).with_state(
            values
        )
    return found


def find_objects_supported_by(
    scene: Scene, now: Mapping[str, PlacedObject], hold: Hold, joints: Set[str], where: str
) -> tuple[SupportedObject, ...]:
    """Return what will ride on an object that is held.

    Args:
        scene: The scene.
        now: The objects that stand somewhere when that begins, and the one that is held.
        hold: What is held.
        joints: Its joints that will move, of an object that stands fixed; a free one moves with all
            of its links.
        where: The step, for messages.

    Raises:
        InputError: Something stands on what moves and on what does not.
    """
    thing = now[hold.object].object
    links = set(thing.links) if thing.free else thing.links_moved_by(joints)
    free = [name for name, placed in now.items() if placed.object.free and name != hold.object]
    riding = find_supported_objects(now, {hold.object: links}, free)
    if not riding:
        return ()
    still = [
        (f"{name}.{get_link_name(shape.name)}", shape)
        for name, placed in now.items()
        if name not in riding
        for shape in make_world_shapes(placed)
        if name != hold.object or get_link_name(shape.name) not in links
    ]
    still += zip(scene.obstacle_labels, scene.obstacles, strict=True)
    found = []
    for name, label in riding.items():
        other = min(find_supports(now[name], still), default=None)
        if other is not None and not thing.free:
            problem = f"'{name}' stands on what moves and on what does not: '{label}' and '{other}'"
            raise InputError(
                problem,
                field=where,
                expected="that it is taken off, or stands on one of them alone",
            )
        link = label.partition(".")[2]
        carrier = now[hold.object]
        found.append(
            SupportedObject(
                name,
                hold,
                link,
                carrier.link_placement(link).actInv(now[name].placement),
                carrier.placement,
            )
        )
    return tuple(found)


def compute_placement_after_motion(
    ride: SupportedObject, before: PlacedObject, after: PlacedObject, where: str
) -> pin.SE3:
    """Return where an object stands after a ride on a joint of what stands fixed, which moves from `before` to `after`.

    Raises:
        InputError: The link that it stands on tips.
    """
    link = after.link_placement(ride.link)
    if (angle := compute_tilt(before.link_placement(ride.link), link)) > MAX_TILT:
        problem, got = (
            f"'{ride.object}' stands on '{ride.support}', which would tip",
            f"{angle:.2f} rad",
        )
        raise InputError(
            problem,
            field=where,
            expected=f"that it is taken off before, or at most {MAX_TILT:g} rad",
            got=got,
        )
    return link * ride.placement_in_link
