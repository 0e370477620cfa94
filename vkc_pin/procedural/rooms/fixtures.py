"""What opens in a room: which object it is, how large, and where such a thing stands."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.procedural.furniture.catalogue import KINDS, random_object
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.resources import available
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes

__all__ = [
    "OPENABLE",
    "RANDOM",
    "Counter",
    "Fixture",
    "list_openable_types",
    "make_fixture",
    "make_fixture_name",
]

OPENABLE = {
    "door": 0.4,
    "narrow_door": 0.4,
    "wide_door": 0.4,
    "drawer": 0.5,
    "low_drawer": 0.5,
    "refrigerator": 0.7,
    "cabinet": 0.7,
}
"""Objects that open: type → how far to either side of it the floor before it stays free, for the robot and for a door [m]."""
RANDOM = "random_"
"""What the names of objects begin with that are made at random: `random_oven`."""
_IN_WALL = ("door", "narrow_door", "wide_door")
_BESIDE = 0.7  # [m] as `OPENABLE`, for objects that only their file describes
_SLIT = 0.03  # [m] of air above a door's panel, where its frame has no lintel
_ON = 0.001  # [m] of air below what stands on a counter


@dataclass(frozen=True)
class Counter:
    """What a small thing stands on, against a wall.

    Attributes:
        size: Depth, width and height [m].
        setback: How far behind the counter's edge the thing's face is [m].
    """

    size: tuple[float, float, float]
    setback: float


@dataclass(frozen=True)
class Fixture:
    """Something that opens, before it has a place.

    Attributes:
        type: Of the object in a scene: a name, a path, or a description.
        low, high: Corners of its base link and of what is shut, in its own frame, shape (3,) each
            [m]. Of a door in a wall it is the frame alone, as handles stick out of the wall, and as
            high as the panel needs it.
        in_wall: Whether it stands in an opening of a wall.
        beside: How far to either side of it the floor before it stays free [m].
        lift: How high its frame is above what it stands on [m].
        counter: What it stands on, if not on the floor.
        face: Where it ends towards the room without what moves and sticks out, in its own frame,
            along x [m].
    """

    type: str | dict[str, Any]
    low: Floats
    high: Floats
    in_wall: bool
    beside: float
    lift: float = 0.0
    counter: Counter | None = None
    face: float = 0.0


def list_openable_types() -> list[str]:
    """Return the names of all objects that a room can be asked for."""
    return [
        *OPENABLE,
        *(RANDOM + kind for kind in KINDS),
        *(name for name in available("scenes", "objects/*.yaml") if name not in OPENABLE),
    ]


def make_fixture_name(kind: str | Mapping[str, Any]) -> str:
    """Return what something that opens is called in a room: its type, the stem of its file, or the name in its URDF."""
    if isinstance(kind, Mapping):
        return load_object(kind).name.replace(".", "_")
    return Path(kind).stem.replace(".", "_") if _is_path(kind) else kind.removeprefix(RANDOM)


def make_fixture(kind: str | Mapping[str, Any], seed: int = 0) -> Fixture:
    """Return something that opens.

    Args:
        kind: One of `known_objects()`, the path of a description (.yaml), or a description.
        seed: Of sizes that are random.

    Raises:
        UnknownNameError: There is no such object.
        InputError: Its description is wrong, or it is carried and not opened.
    """
    if isinstance(kind, str) and kind.startswith(RANDOM):
        if kind.removeprefix(RANDOM) not in KINDS:
            raise UnknownNameError(
                "object that opens", kind, list_openable_types(), field="objects"
            )
        return _random(kind.removeprefix(RANDOM), seed)
    if isinstance(kind, str) and not _is_path(kind):
        return _named(kind)
    own = load_object(kind)
    return _other(str(Path(kind).resolve()) if isinstance(kind, str) else dict(kind), own)


@functools.cache
def _named(kind: str) -> Fixture:
    if kind not in list_openable_types():
        raise UnknownNameError("object that opens", kind, list_openable_types(), field="objects")
    own = load_object(kind)
    if kind not in OPENABLE:
        return _other(kind, own)
    low, high = _extent(own, in_wall=kind in _IN_WALL)
    return Fixture(kind, low, high, kind in _IN_WALL, OPENABLE[kind])


def _other(kind: str | dict[str, Any], own: ArticulatedObject) -> Fixture:
    """Return an object that only its description tells of: it stands on the floor, with its back to a wall."""
    if own.free:
        raise InputError(
            "this is carried, not opened",
            field="objects",
            expected="an object that is not free",
            got=own.name,
        )
    low, high = _extent(own, in_wall=False)
    fixed = [
        compute_world_box(shape.geometry, shape.placement)[0]
        for shape in own.collision.geometryObjects
        if shape.parentJoint == 0
    ]
    face = min((float(lowest[0]) for lowest in fixed), default=float(low[0]))
    return Fixture(
        kind, low, high, False, _BESIDE, lift=round(float(-low[2]), 4), face=round(face, 4)
    )


def _random(kind: str, seed: int) -> Fixture:
    own, about = random_object(kind, seed), KINDS[kind]
    low, high = _extent(load_object(own), in_wall=about.place == "wall")
    counter = None
    if about.place == "counter":
        rng = np.random.default_rng([5, seed])
        before, extra, width, height = (
            float(rng.uniform(*interval))
            for interval in ((0.01, 0.06), (0.0, 0.1), (0.2, 0.8), (0.72, 0.9))
        )
        setback = (
            float(-low[0]) + before
        )  # so that nothing of it, levers and handles too, is beyond the counter's edge
        depth = max(0.5, setback + float(high[0]) + 0.02) + extra
        sizes = [
            math.ceil(100.0 * size) / 100.0 for size in (depth, high[1] - low[1] + width, height)
        ]
        counter = Counter((sizes[0], sizes[1], sizes[2]), round(setback, 3))
    return Fixture(
        own, low, high, about.place == "wall", about.beside, _ON if counter else 0.0, counter
    )


def _is_path(kind: str) -> bool:
    return kind.endswith((".yaml", ".yml")) or "/" in kind


def _extent(own: ArticulatedObject, *, in_wall: bool) -> tuple[Floats, Floats]:
    """Return lowest and highest corner, shape (3,) each [m]; see `Fixture`."""
    placed = PlacedObject("it", own, pin.SE3.Identity(), np.clip(0.0, own.lower, own.upper))
    boxes = np.array(
        [compute_world_box(shape.geometry, shape.placement) for shape in make_world_shapes(placed)]
    )
    low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
    if in_wall:
        fixed = [shape.parentJoint == 0 for shape in own.collision.geometryObjects]
        top = max(boxes[fixed, 1].max(axis=0)[2], high[2] + _SLIT)
        low, high = boxes[fixed, 0].min(axis=0), boxes[fixed, 1].max(axis=0)
        high[2] = top
    return low.round(4), high.round(4)
