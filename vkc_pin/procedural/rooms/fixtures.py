"""Defines the objects of a room that can be opened: their type, size and support."""

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
from vkc_pin.world.files.resources import list_resources
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.object_file import load_object
from vkc_pin.world.models.shapes import compute_world_box
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes

OPENABLE = {
    "door": 0.4,
    "narrow_door": 0.4,
    "wide_door": 0.4,
    "drawer": 0.5,
    "low_drawer": 0.5,
    "refrigerator": 0.7,
    "cabinet": 0.7,
}
"""Types of objects that can be opened → free floor in front of them on either side [m].

The robot and the object's doors need it.
"""
RANDOM = "random_"
"""Prefix of the types of random objects: `random_oven`."""
_IN_WALL = ("door", "narrow_door", "wide_door")
# [m] as in `OPENABLE`, for objects known by their description only
_BESIDE = 0.7
# [m] above a door's panel, if its frame has no lintel
_SLIT = 0.03
# [m] between an object and the counter
_ON = 0.001


@dataclass(frozen=True)
class Counter:
    """A counter against a wall that supports a small object.

    Attributes:
        size: Depth, width and height [m].
        setback: Distance of the object's front behind the counter's edge [m].
    """

    size: tuple[float, float, float]
    setback: float


@dataclass(frozen=True)
class Fixture:
    """An object that can be opened, before it is placed.

    Attributes:
        type: Type of the object in a scene: a name, a path, or a description.
        low, high: Corners of the bounding box of the closed object in its own frame, shape (3,)
            each [m]. For a door in a wall it is that of the frame alone, as handles stick out of
            the wall, raised to the height that the panel needs.
        in_wall: Whether it is in an opening of a wall.
        beside: Width of the free floor in front of it on either side [m].
        lift: Height of its frame above its support [m].
        counter: Counter that supports it; None: the floor.
        face: x of the front of its fixed part, in its own frame [m].
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
    """Return the names of all types of objects that can be opened."""
    random = [RANDOM + kind for kind in KINDS]
    described = list_resources("scenes", "objects/*.yaml")
    return [*OPENABLE, *random, *(name for name in described if name not in OPENABLE)]


def make_fixture_name(kind: str | Mapping[str, Any]) -> str:
    """Return the name of an object in a room: its type, file stem, or name in its URDF."""
    if isinstance(kind, Mapping):
        return load_object(kind).name.replace(".", "_")
    return Path(kind).stem.replace(".", "_") if _is_path(kind) else kind.removeprefix(RANDOM)


def make_fixture(kind: str | Mapping[str, Any], seed: int = 0) -> Fixture:
    """Return an object that can be opened."""
    if not isinstance(kind, str):
        return _make_described_fixture(dict(kind), load_object(kind))
    if kind.startswith(RANDOM):
        name = kind.removeprefix(RANDOM)
        if name not in KINDS:
            raise UnknownNameError(
                "object that opens", kind, list_openable_types(), field="objects"
            )
        return _make_random_fixture(name, seed)
    if _is_path(kind):
        return _make_described_fixture(str(Path(kind).resolve()), load_object(kind))
    return _make_named_fixture(kind)


@functools.cache
def _make_named_fixture(kind: str) -> Fixture:
    """Return an object of the package; cached."""
    if kind not in list_openable_types():
        raise UnknownNameError("object that opens", kind, list_openable_types(), field="objects")
    own = load_object(kind)
    if kind not in OPENABLE:
        return _make_described_fixture(kind, own)
    low, high = _compute_extent(own, in_wall=kind in _IN_WALL)
    return Fixture(kind, low, high, kind in _IN_WALL, OPENABLE[kind])


def _make_described_fixture(kind: str | dict[str, Any], own: ArticulatedObject) -> Fixture:
    """Return an object that is known by its description only.

    It stands on the floor with its back to a wall.
    """
    if own.free:
        raise InputError(
            "a free object cannot be a fixture",
            field="objects",
            expected="a fixed object",
            got=own.name,
        )
    low, high = _compute_extent(own, in_wall=False)
    fronts: list[float] = []  # of the shapes of the fixed part
    for shape in own.collision.geometryObjects:
        if shape.parentJoint == 0:
            lower, _ = compute_world_box(shape.geometry, shape.placement)
            fronts.append(float(lower[0]))
    face = min(fronts, default=float(low[0]))
    lift = float(-low[2])
    return Fixture(kind, low, high, False, _BESIDE, lift=round(lift, 4), face=round(face, 4))


def _make_random_fixture(kind: str, seed: int) -> Fixture:
    """Return an object of random sizes, on a random counter if it needs one."""
    description = random_object(kind, seed)
    about = KINDS[kind]
    in_wall = about.place == "wall"
    low, high = _compute_extent(load_object(description), in_wall=in_wall)
    counter = None
    lift = 0.0
    if about.place == "counter":
        counter = _sample_counter(low, high, seed)
        lift = _ON
    return Fixture(description, low, high, in_wall, about.beside, lift, counter)


def _sample_counter(low: Floats, high: Floats, seed: int) -> Counter:
    """Return a random counter for an object between two corners, shape (3,) each [m]."""
    rng = np.random.default_rng([5, seed])
    before = float(rng.uniform(0.01, 0.06))
    behind = float(rng.uniform(0.0, 0.1))
    beside = float(rng.uniform(0.2, 0.8))
    height = float(rng.uniform(0.72, 0.9))
    # No part of it, levers and handles included, is beyond the counter's edge.
    setback = float(-low[0]) + before
    depth = max(0.5, setback + float(high[0]) + 0.02) + behind
    width = high[1] - low[1] + beside
    size = (_round_up(depth), _round_up(width), _round_up(height))
    return Counter(size, round(setback, 3))


def _round_up(size: float) -> float:
    """Round a length up to the centimetre [m]."""
    return math.ceil(100.0 * size) / 100.0


def _is_path(kind: str) -> bool:
    """Return whether a type is the path of an object's file."""
    return kind.endswith((".yaml", ".yml")) or "/" in kind


def _compute_extent(own: ArticulatedObject, *, in_wall: bool) -> tuple[Floats, Floats]:
    """Return lowest and highest corner, shape (3,) each [m]; see `Fixture`."""
    placed = PlacedObject("it", own, pin.SE3.Identity(), np.clip(0.0, own.lower, own.upper))
    shapes = make_world_shapes(placed)
    boxes = np.array([compute_world_box(shape.geometry, shape.placement) for shape in shapes])
    low = boxes[:, 0].min(axis=0)
    high = boxes[:, 1].max(axis=0)
    if in_wall:
        panel_top = high[2]
        is_frame = [shape.parentJoint == 0 for shape in own.collision.geometryObjects]
        low = boxes[is_frame, 0].min(axis=0)
        high = boxes[is_frame, 1].max(axis=0)
        high[2] = max(high[2], panel_top + _SLIT)
    return low.round(4), high.round(4)
