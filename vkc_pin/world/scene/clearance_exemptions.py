"""Finds pairs of shapes that violate the clearance margin in the initial scene, and where they are exempt from it.

Homes are built tightly: a door's leaf stands in its wall, a refrigerator's door beside the kitchen.
Such neighbours are found in the scene alone: shapes of articulated objects against all other fixed
shapes, in the initial state and with all joints at zero, as they were built. A pair of shapes stays
exempt on the range of joint values around that state on which it is closer than the margin: its
distance there depends on these joints alone, so that no motion could do better. An exemption never
extends to other shapes of the same links.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Bools, Floats
from vkc_pin.world.collision.shapes import Shapes
from vkc_pin.world.models.shapes import compute_shape_distance, compute_world_box, get_link_name
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import (
    PlacedObject,
    find_link_shapes,
    make_world_shapes,
    sweep_link_shapes,
)

__all__ = [
    "CONTACT_DEPTH",
    "ClearanceExemption",
    "ClosePair",
    "PlacedShapes",
    "SceneLike",
    "find_clearance_exemptions",
    "find_close_pairs",
    "make_shape_keys",
    "warn_of_overlaps",
]

CONTACT_DEPTH = 1e-4
"""Overlap that is contact: what stands on a table overlaps it by rounding [m]."""
_NEARLY = 1e-3  # [m] short of the margin that counts as having it: motions end as close
_STEPS = 64  # in which the way of a joint to its limit is looked at, and each of them once more
_TURN = np.pi  # [rad] how far one without a limit is looked at


T = TypeVar("T")
_TOLD = 6  # pairs that a warning names
_MOST = 4096  # things that a scene remembers


class SceneLike(Protocol):
    """What of a scene is asked for here; see `Scene`."""

    @property
    def objects(self) -> Mapping[str, PlacedObject]:
        """Name → object."""

    @property
    def obstacles(self) -> Sequence[pin.GeometryObject]:
        """What does not move."""

    @property
    def obstacle_labels(self) -> Sequence[str]:
        """Whose shape each of these is."""

    @property
    def held(self) -> Collection[str]:
        """What the robot holds."""

    @property
    def allowed(self) -> Mapping[frozenset[str], float]:
        """Pairs of links that may be close, with their margins [m]."""

    @property
    def memory(self) -> dict[Any, Any]:
        """What is known of it already."""


class ClosePair(NamedTuple):
    """Two links that stand close to each other.

    Attributes:
        first, second: Their labels, the first that of a link that can move.
        distance: Signed [m].
    """

    first: str
    second: str
    distance: float

    def __str__(self) -> str:
        apart = (
            f"are {1e3 * self.distance:.1f} mm apart"
            if self.distance >= 0.0
            else f"overlap by {-1e3 * self.distance:.1f} mm"
        )
        return f"{self.first} – {self.second} {apart}"


@dataclasses.dataclass(frozen=True, eq=False)
class ClearanceExemption:
    """Two links, or one shape of each, that are exempt from the clearance margin.

    Attributes:
        first, second: The links' labels.
        margin: The clearance they must keep instead [m]; negative: an allowed penetration; -inf:
            any distance.
        distance: Their distance in the initial state, or as built [m]; `margin` for what the
            scene's description allows.
        ranges: Coordinate "<object>.<joint>" → (lower, upper) between which the exemption holds,
            [rad] or [m]; none: always.
        shapes: The exempt shape of each link, see `make_shape_keys`; None: all shapes of both links.
    """

    first: str
    second: str
    margin: float
    distance: float
    ranges: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    shapes: tuple[str, str] | None = None

    def is_between(self, one: str, other: str) -> bool:
        """Return whether it is about two links, by their labels."""
        return {one, other} == {self.first, self.second}

    def find_shape_pairs(self, labels: Sequence[str], keys: Sequence[str]) -> list[tuple[int, int]]:
        """Return the pairs (i, j), i < j, of shapes that it exempts.

        Args:
            labels: The label of each shape.
            keys: The key of each shape, see `make_shape_keys`.
        """
        wanted = (None, None) if self.shapes is None else self.shapes
        ones, others = (
            [k for k, name in enumerate(labels) if name == label and key in (None, keys[k])]
            for label, key in zip((self.first, self.second), wanted, strict=True)
        )
        return [(min(i, j), max(i, j)) for i in ones for j in others]

    def is_active(self, names: Sequence[str], states: Floats) -> Bools:
        """Return whether it holds at states, shape (S, n), of coordinates that are called like this: shape (S,)."""
        inside = np.ones(len(states), bool)
        for name, (lower, upper) in self.ranges.items():
            column = states[:, names.index(name)]
            inside &= (lower <= column) & (column <= upper)
        return inside

    def __str__(self) -> str:
        return " – ".join(self.shapes or (self.first, self.second))


def make_shape_keys(labels: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return a key of each shape that is the same in every model of a scene.

    It is the shape's own name, with its object before it: "door.leaf_0", "wall_2".

    Args:
        labels: Of each shape, "<object>.<link>" or the name of an obstacle or of a link of the
            robot.
        names: Of each shape, in the model of its object or in one that has several.
    """
    keys = []
    for label, name in zip(labels, names, strict=True):
        owner, dot, link = label.partition(".")
        keys.append(f"{owner}.{link}_{name.rpartition('_')[2]}" if dot else name)
    return keys


def find_clearance_exemptions(scene: SceneLike, dist_safe: float) -> tuple[ClearanceExemption, ...]:
    """Return all pairs that may be closer than `dist_safe` [m]: links that the scene allows, and neighbouring shapes."""

    def found() -> tuple[ClearanceExemption, ...]:
        listed = [
            ClearanceExemption(min(pair), max(pair), margin, margin)
            for pair, margin in scene.allowed.items()
            if len(pair) == 2
        ]
        return *listed, *_neighbours(scene, dist_safe)

    return _kept(
        scene,
        (
            "clearance_exemptions",
            dist_safe,
            *(_key(placed) for placed in scene.objects.values()),
        ),
        found,
    )


def find_close_pairs(scene: SceneLike, reach: float) -> list[ClosePair]:
    """Return what can move and stands closer than `reach` [m] to something, but for what the hand holds.

    Links of one object, what a scene allows, and the floor below what is not free do not count; nor
    does what a free object stands on, unless it stands in it.
    """
    standing, found = PlacedShapes(scene, scene.objects), []
    for (first, second), distance in standing.find_near_links(reach).items():
        free = any(
            scene.objects[label.partition(".")[0]].object.free
            for label in (first, second)
            if "." in label
        )
        if frozenset((first, second)) not in scene.allowed and (
            not free or distance < -CONTACT_DEPTH
        ):
            found.append(ClosePair(first, second, distance))
    return sorted(found, key=lambda pair: pair.distance)


def warn_of_overlaps(scene: SceneLike, name: str) -> None:
    """Warn of what stands inside something else and can move, if there is any, in a scene that is called so."""
    found = [pair for pair in find_close_pairs(scene, 0.0) if pair.distance < -CONTACT_DEPTH]
    if found:
        told = "; ".join(map(str, found[:_TOLD])) + (
            f"; and {len(found) - _TOLD} more" if len(found) > _TOLD else ""
        )
        hint = "They may, until they have been apart; `allow:` in the scene says that they may touch, `vkc-pin check` names all."
        warnings.warn(f"{name}: things that can move stand in others: {told}. {hint}", stacklevel=4)


def _neighbours(scene: SceneLike, dist_safe: float) -> Iterator[ClearanceExemption]:
    """Yield shapes of fixed objects that are closer than `dist_safe` to another, there or with all joints at zero."""
    jointed = {name: placed for name, placed in scene.objects.items() if not placed.object.free}
    neutral = {
        name: np.clip(0.0, placed.object.lower, placed.object.upper)
        for name, placed in jointed.items()
    }
    zero = {
        name: dataclasses.replace(placed, state=neutral[name]) for name, placed in jointed.items()
    }
    states = [
        jointed,
        *([zero] if any(np.any(zero[name].state != jointed[name].state) for name in zero) else []),
    ]
    known = set[tuple[tuple[str, str], float, tuple[tuple[str, tuple[float, float]], ...]]]()
    for objects in states:
        standing = PlacedShapes(scene, objects)
        for (i, j), distance in standing.find_near_shapes(dist_safe - _NEARLY).items():
            ranges, least = standing.find_exempt_ranges(i, j, dist_safe)
            # The distance is a function of one joint; with several, each alone shows how deep they
            # may be.
            deep = -np.inf if len(ranges) == 1 else min(least, distance)
            margin = 0.0 if distance > -CONTACT_DEPTH else deep
            shapes = (standing.keys[i], standing.keys[j])
            key = (shapes, margin, tuple(ranges.items()))
            if key not in known:
                known.add(key)
                yield ClearanceExemption(
                    standing.labels[i], standing.labels[j], margin, distance, ranges, shapes
                )


class PlacedShapes:
    """The shapes of objects and obstacles in the world, S of them.

    Args:
        scene: The scene.
        objects: Which objects, and in what state.

    Attributes:
        labels: Of each shape, its link or obstacle.
        keys: Of each shape, see `make_shape_keys`.
    """

    def __init__(self, scene: SceneLike, objects: Mapping[str, PlacedObject]) -> None:
        self.scene, self.objects = (
            scene,
            {n: p for n, p in objects.items() if not (p.object.free and n in scene.held)},
        )
        self._shapes, self.labels = list[pin.GeometryObject](), list[str]()
        for name, placed in self.objects.items():
            shapes = make_world_shapes(placed)
            self._shapes += shapes
            self.labels += [f"{name}.{get_link_name(shape.name)}" for shape in shapes]
        free = {name for name, placed in self.objects.items() if placed.object.free}
        self._moving = {
            label
            for label in set(self.labels)
            if label.partition(".")[0] in free or self.find_joints(label)
        }
        if self._moving:
            self._shapes += scene.obstacles
            self.labels += scene.obstacle_labels
        self.keys = make_shape_keys(self.labels, [shape.name for shape in self._shapes])

    def find_near_shapes(self, reach: float) -> dict[tuple[int, int], float]:
        """Return pairs of shapes, the first of which can move, that are closer than so much: their distance [m]."""
        if not self._moving:
            return {}
        boxes = [compute_world_box(shape.geometry, shape.placement) for shape in self._shapes]
        lower, upper = (np.array(side).T for side in zip(*boxes, strict=True))
        owners = np.array([label.partition(".")[0] for label in self.labels])
        floor, found = owners == FLOOR, dict[tuple[int, int], float]()
        for i, (label, shape) in enumerate(zip(self.labels, self._shapes, strict=True)):
            if label not in self._moving:
                continue
            close = ((lower < upper[:, [i]] + reach) & (upper > lower[:, [i]] - reach)).all(
                axis=0
            ) & (owners != owners[i])
            if not self.objects[str(owners[i])].object.free:
                close &= ~floor  # it hangs as its makers hung it
            for j in np.flatnonzero(close).tolist():
                if (j, i) in found:
                    continue
                other = self._shapes[j]
                distance = compute_shape_distance(
                    shape.geometry, shape.placement, other.geometry, other.placement
                )
                if distance < reach:
                    found[i, j] = distance
        return found

    def find_near_links(self, reach: float) -> dict[tuple[str, str], float]:
        """Return pairs of links, by their labels, that are closer than so much: the distance of their closest shapes [m]."""
        found: dict[tuple[str, str], float] = {}
        for (i, j), distance in self.find_near_shapes(reach).items():
            pair = (self.labels[i], self.labels[j])
            pair = pair[::-1] if pair[::-1] in found else pair
            found[pair] = min(distance, found.get(pair, np.inf))
        return found

    def find_exempt_ranges(
        self, i: int, j: int, reach: float
    ) -> tuple[dict[str, tuple[float, float]], float]:
        """Return coordinate → (lower, upper): how far each joint alone can go until two shapes are `reach` [m] apart.

        A limit of the joint before that is infinite here. The second result is the least distance
        on these ranges [m].
        """
        found, least = dict[str, tuple[float, float]](), np.inf
        for own, other in ((i, j), (j, i)):
            owner = self.labels[own].partition(".")[0]
            for joint in self.find_joints(self.labels[own]):
                names = (owner, self.labels[other].partition(".")[0])
                where = [self.objects[name] for name in names if name in self.objects]
                key = (
                    "neighbours",
                    self.keys[own],
                    self.labels[other],
                    self.keys[other],
                    joint,
                    reach,
                    *map(_key, where),
                )
                lower, upper, deepest = _kept(
                    self.scene, key, partial(self._range, own, other, joint, reach)
                )
                found[f"{owner}.{joint}"] = (lower, upper)
                least = min(least, deepest)
        return found, least

    def _range(self, own: int, other: int, joint: str, reach: float) -> tuple[float, float, float]:
        placed = self.objects[self.labels[own].partition(".")[0]]
        index = placed.object.coordinates.index(joint)
        at, ends, least = float(placed.state[index]), list[float](), np.inf

        def distance(values: Floats) -> Floats:
            found: Floats = self.compute_distances(self.labels[own], index, values, [other], reach)[
                :, self._number(own), 0
            ]
            return found

        for limit, beyond in (
            (placed.object.lower[index], -_TURN),
            (placed.object.upper[index], _TURN),
        ):
            end = float(limit) if np.isfinite(limit) else at + beyond
            low, high, left = at, end, False
            for _ in range(2):
                values = np.linspace(low, high, _STEPS + 1)
                apart = distance(values)
                inside = (
                    apart[: int(np.argmax(apart >= reach))] if (apart >= reach).any() else apart
                )
                if len(inside) and not left:
                    k = int(np.argmin(inside))
                    around = np.linspace(
                        values[max(k - 1, 0)], values[min(k + 1, _STEPS)], _STEPS + 1
                    )
                    least = min(least, float(inside[k]), float(distance(around).min()))
                if len(inside) == len(apart):
                    break
                left, k = True, len(inside)
                low, high = (float(values[max(k - 1, 0)]), float(values[k]))
            ends.append((low + high) / 2.0 if left else float(np.copysign(np.inf, beyond)))
        return ends[0], ends[1], least

    def _number(self, shape: int) -> int:
        """Return which of the shapes of its link a shape is."""
        return self.labels[:shape].count(self.labels[shape])

    def find_shapes(self, labels: Collection[str]) -> list[int]:
        """Return the shapes of links or obstacles, by their labels."""
        return [k for k, label in enumerate(self.labels) if label in labels]

    def compute_distances(
        self, label: str, index: int, values: Floats, others: Sequence[int], reach: float
    ) -> Floats:
        """Return the distances of a link's shapes from others while one of its coordinates takes values [m].

        Args:
            label: The link, with K shapes.
            index: Of the coordinate of its object.
            values: Shape (V,) [rad] or [m].
            others: Which other shapes, O of them.
            reach: Distances larger than this may be infinite in the result [m].

        Returns:
            Shape (V, K, O).
        """
        own = find_link_shapes(self.objects[label.partition(".")[0]], label.partition(".")[2])
        standing = [self._shapes[k] for k in others]
        shapes = Shapes(
            [shape.geometry for shape in (*own, *standing)], [shape.placement for shape in standing]
        )
        where, near = self._moved(label, index, values, standing, reach)
        row, k, j = np.nonzero(near)
        found = np.full(near.shape, np.inf)
        found[row, k, j] = shapes.compute_distances(where, row, np.column_stack([k, len(own) + j]))
        return found

    def find_links_near_sweep(self, label: str, index: int, values: Floats) -> set[str]:
        """Return the labels of what the boxes of a link meet while one of its object's coordinates takes values, shape (V,)."""
        _, near = self._moved(label, index, values, self._shapes, 0.0)
        return {self.labels[j] for j in np.flatnonzero(near.any(axis=(0, 1)))}

    def _moved(
        self,
        label: str,
        index: int,
        values: Floats,
        others: Sequence[pin.GeometryObject],
        reach: float,
    ) -> tuple[Floats, Bools]:
        """Return where a link's shapes are at values of a coordinate, (V, K, 12), and which are near `others`, (V, K, others)."""
        owner, _, link = label.partition(".")
        where, lower, upper = sweep_link_shapes(self.objects[owner], link, index, values)
        lows, highs = (
            np.array(side)
            for side in zip(
                *(compute_world_box(s.geometry, s.placement) for s in others), strict=True
            )
        )
        near = (lows < upper[:, :, None] + reach) & (highs > lower[:, :, None] - reach)
        return where, np.asarray(near.all(axis=3))

    def find_joints(self, label: str) -> list[str]:
        """Return the joints that move a link of an object that stands fixed; none for any other."""
        owner, _, link = label.partition(".")
        if owner not in self.objects or self.objects[owner].object.free:
            return []
        thing = self.objects[owner].object
        support = thing.model.supports[thing.model.frames[thing.link_frame(link)].parentJoint]
        return [str(thing.model.names[joint]) for joint in support if joint]


def _kept(scene: SceneLike, key: Hashable, make: Callable[[], T]) -> T:
    """Return what a scene remembers under a key, made if it does not."""
    found: T | None = scene.memory.get(key)
    if found is None:
        if len(scene.memory) >= _MOST:
            scene.memory.clear()
        found = scene.memory[key] = make()
    return found


def _key(placed: PlacedObject) -> tuple[bytes, bytes]:
    return placed.placement.homogeneous.tobytes(), placed.state.tobytes()
