"""What stands closer to something than others may come, and as long as which joints are where it may be that close.

Homes are built tightly: a door's leaf stands in its wall, a refrigerator's door beside the kitchen. Such neighbours are found in
the scene alone: links of objects against what else stands there, where they stand and with all joints at zero, as they were
built. They stay neighbours on the stretch of joint values around that on which they are closer than the margin: how close they
are there depends on these joints alone, so that no motion could do better. Beyond its end they are things like any others.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Collection, Hashable, Iterator, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
import pinocchio as pin

from vkc_pin.arrays import Bools, Floats
from vkc_pin.distances.shapes import Shapes
from vkc_pin.models.shapes import link_name, shape_distance, world_box
from vkc_pin.scene.obstacles import FLOOR
from vkc_pin.scene.placed import PlacedObject, link_shapes, moved_shapes, standing_geometry

__all__ = ["CONTACT", "Allowance", "Close", "Standing", "Surroundings", "allowances", "close_pairs", "warn_of_overlaps"]

CONTACT = 1e-4
"""Overlap that is contact: what stands on a table overlaps it by rounding [m]."""
_NEARLY = 1e-3  # [m] short of the margin that counts as having it: motions end as close
_STEPS = 64  # in which the way of a joint to its limit is looked at, and each of them once more
_TURN = np.pi  # [rad] how far one without a limit is looked at


T = TypeVar("T")
_TOLD = 6  # pairs that a warning names
_MOST = 4096  # things that a scene remembers


class Surroundings(Protocol):
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


class Close(NamedTuple):
    """Two links that stand close to each other.

    Attributes:
        first, second: Their labels, the first that of a link that can move.
        distance: Signed [m].
    """

    first: str
    second: str
    distance: float

    def __str__(self) -> str:
        apart = f"are {1e3 * self.distance:.1f} mm apart" if self.distance >= 0.0 else f"overlap by {-1e3 * self.distance:.1f} mm"
        return f"{self.first} – {self.second} {apart}"


@dataclasses.dataclass(frozen=True, eq=False)
class Allowance:
    """Two links that may be closer to each other than others.

    Attributes:
        first, second: Their labels.
        margin: What they must keep [m]; -inf: their distance says nothing.
        distance: How far apart they are where they stand [m]; `margin` for what the scene's description allows.
        ranges: Coordinate "<object>.<joint>" → (lower, upper) between which it holds, [rad] or [m]; none: always.
    """

    first: str
    second: str
    margin: float
    distance: float
    ranges: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)

    def between(self, one: str, other: str) -> bool:
        """Return whether it is about two links, by their labels."""
        return {one, other} == {self.first, self.second}

    def holds(self, names: Sequence[str], states: Floats) -> Bools:
        """Return whether it holds at states, shape (S, n), of coordinates that are called like this: shape (S,)."""
        inside = np.ones(len(states), bool)
        for name, (lower, upper) in self.ranges.items():
            column = states[:, names.index(name)]
            inside &= (lower <= column) & (column <= upper)
        return inside


def allowances(scene: Surroundings, dist_safe: float) -> tuple[Allowance, ...]:
    """Return all pairs of links that may be closer than `dist_safe` [m]: those that the scene allows, and neighbours."""

    def found() -> tuple[Allowance, ...]:
        listed = [Allowance(min(pair), max(pair), margin, margin) for pair, margin in scene.allowed.items() if len(pair) == 2]
        return *listed, *_neighbours(scene, dist_safe)

    return _kept(scene, ("allowances", dist_safe, *(_key(placed) for placed in scene.objects.values())), found)


def close_pairs(scene: Surroundings, reach: float) -> list[Close]:
    """Return what can move and stands closer than `reach` [m] to something, but for what the hand holds.

    Links of one object, what a scene allows, and the floor below what is not free do not count; nor does what a free object
    stands on, unless it stands in it.
    """
    labels, found = Standing(scene, scene.objects).near(reach), []
    for (first, second), distance in labels.items():
        free = any(scene.objects[label.partition(".")[0]].object.free for label in (first, second) if "." in label)
        if frozenset((first, second)) not in scene.allowed and (not free or distance < -CONTACT):
            found.append(Close(first, second, distance))
    return sorted(found, key=lambda pair: pair.distance)


def warn_of_overlaps(scene: Surroundings, name: str) -> None:
    """Warn of what stands inside something else and can move, if there is any, in a scene that is called so."""
    found = [pair for pair in close_pairs(scene, 0.0) if pair.distance < -CONTACT]
    if found:
        told = "; ".join(map(str, found[:_TOLD])) + (f"; and {len(found) - _TOLD} more" if len(found) > _TOLD else "")
        hint = "They may, until they have been apart; `allow:` in the scene says that they may touch, `vkc-pin check` names all."
        warnings.warn(f"{name}: things that can move stand in others: {told}. {hint}", stacklevel=4)


def _neighbours(scene: Surroundings, dist_safe: float) -> Iterator[Allowance]:
    """Yield links of objects that stand fixed and are closer than `dist_safe` to something, there or with all joints at zero."""
    jointed = {name: placed for name, placed in scene.objects.items() if not placed.object.free}
    neutral = {name: np.clip(0.0, placed.object.lower, placed.object.upper) for name, placed in jointed.items()}
    zero = {name: dataclasses.replace(placed, state=neutral[name]) for name, placed in jointed.items()}
    states = [jointed, *([zero] if any(np.any(zero[name].state != jointed[name].state) for name in zero) else [])]
    known = set[tuple[str, str, float, tuple[tuple[str, tuple[float, float]], ...]]]()
    for objects in states:
        standing = Standing(scene, objects)
        for (first, second), distance in standing.near(dist_safe - _NEARLY).items():
            margin = 0.0 if distance > -CONTACT else -np.inf
            ranges = standing.ranges(first, second, dist_safe)
            key = (first, second, margin, tuple(ranges.items()))
            if key not in known:
                known.add(key)
                yield Allowance(first, second, margin, distance, ranges)


class Standing:
    """The shapes of objects and obstacles where they stand, by the labels of their links, all of them in `labels`.

    Args:
        scene: The scene.
        objects: Which objects, and how they stand.
    """

    def __init__(self, scene: Surroundings, objects: Mapping[str, PlacedObject]) -> None:
        self.scene, self.objects = scene, {n: p for n, p in objects.items() if not (p.object.free and n in scene.held)}
        self._shapes, self._labels = list[pin.GeometryObject](), list[str]()
        for name, placed in self.objects.items():
            shapes = standing_geometry(placed)
            self._shapes += shapes
            self._labels += [f"{name}.{link_name(shape.name)}" for shape in shapes]
        free = {name for name, placed in self.objects.items() if placed.object.free}
        self._moving = {label for label in set(self._labels) if label.partition(".")[0] in free or self.joints(label)}
        if self._moving:
            self._shapes += scene.obstacles
            self._labels += scene.obstacle_labels
        self.labels = set(self._labels)

    def near(self, reach: float) -> dict[tuple[str, str], float]:
        """Return pairs of links, the first of which can move, that are closer than so much: their distance [m]."""
        if not self._moving:
            return {}
        boxes = [world_box(shape.geometry, shape.placement) for shape in self._shapes]
        lower, upper = (np.array(side).T for side in zip(*boxes, strict=True))
        owners = np.array([label.partition(".")[0] for label in self._labels])
        floor, found = owners == FLOOR, dict[tuple[str, str], float]()
        for i, (label, shape) in enumerate(zip(self._labels, self._shapes, strict=True)):
            if label not in self._moving:
                continue
            close = ((lower < upper[:, [i]] + reach) & (upper > lower[:, [i]] - reach)).all(axis=0) & (owners != owners[i])
            if not self.objects[str(owners[i])].object.free:
                close &= ~floor  # it hangs as its makers hung it
            for j in np.flatnonzero(close).tolist():
                key = (label, self._labels[j])
                if key[::-1] in found:
                    continue
                other = self._shapes[j]
                distance = shape_distance(shape.geometry, shape.placement, other.geometry, other.placement)
                if distance < found.get(key, reach):
                    found[key] = distance
        return found

    def ranges(self, first: str, second: str, reach: float) -> dict[str, tuple[float, float]]:
        """Return coordinate → (lower, upper): how far each joint alone can go until two links are `reach` [m] apart.

        A limit of the joint before that is infinite here.
        """
        found: dict[str, tuple[float, float]] = {}
        for label, other in ((first, second), (second, first)):
            owner = label.partition(".")[0]
            for joint in self.joints(label):
                where = [self.objects[name] for name in (owner, other.partition(".")[0]) if name in self.objects]
                key = ("neighbours", label, other, joint, reach, *(_key(placed) for placed in where))
                found[f"{owner}.{joint}"] = _kept(self.scene, key, partial(self._limits, label, other, joint, reach))
        return found

    def _limits(self, label: str, other: str, joint: str, reach: float) -> tuple[float, float]:
        placed = self.objects[label.partition(".")[0]]
        index = placed.object.coordinates.index(joint)
        distance, at = self.distance(label, other, index, reach), float(placed.state[index])
        ends = []
        for limit, beyond in ((placed.object.lower[index], -_TURN), (placed.object.upper[index], _TURN)):
            end = float(limit) if np.isfinite(limit) else at + beyond
            low, high, left = at, end, False
            for _ in range(2):
                values = np.linspace(low, high, _STEPS + 1)
                apart = distance(values) >= reach
                if not apart.any():
                    break
                left, k = True, int(np.argmax(apart))
                low, high = (float(values[max(k - 1, 0)]), float(values[k]))
            ends.append((low + high) / 2.0 if left else float(np.copysign(np.inf, beyond)))
        return ends[0], ends[1]

    def distance(self, label: str, other: str, index: int, reach: float) -> Callable[[Floats], Floats]:
        """Return the function that says how far two links are apart at values of one of the first's coordinates [m].

        Where it is more than `reach` [m], it may say that it is infinite.
        """
        own = link_shapes(self.objects[label.partition(".")[0]], label.partition(".")[2])
        others = [shape for shape, one in zip(self._shapes, self._labels, strict=True) if one == other]
        shapes = Shapes([shape.geometry for shape in (*own, *others)], [shape.placement for shape in others])

        def apart(values: Floats) -> Floats:
            where, near = self._moved(label, index, values, others, reach)
            row, k, j = np.nonzero(near)
            found = np.full(len(values), np.inf)
            np.minimum.at(found, row, shapes.distances(where, row, np.column_stack([k, len(own) + j])))
            return found

        return apart

    def reached(self, label: str, index: int, values: Floats) -> set[str]:
        """Return the labels of what the boxes of a link meet while one of its object's coordinates takes values, shape (V,)."""
        _, near = self._moved(label, index, values, self._shapes, 0.0)
        return {self._labels[j] for j in np.flatnonzero(near.any(axis=(0, 1)))}

    def _moved(
        self, label: str, index: int, values: Floats, others: Sequence[pin.GeometryObject], reach: float
    ) -> tuple[Floats, Bools]:
        """Return where a link's shapes are at values of a coordinate, (V, K, 12), and which are near `others`, (V, K, others)."""
        owner, _, link = label.partition(".")
        where, lower, upper = moved_shapes(self.objects[owner], link, index, values)
        lows, highs = (np.array(side) for side in zip(*(world_box(s.geometry, s.placement) for s in others), strict=True))
        near = (lows < upper[:, :, None] + reach) & (highs > lower[:, :, None] - reach)
        return where, np.asarray(near.all(axis=3))

    def joints(self, label: str) -> list[str]:
        """Return the joints that move a link of an object that stands fixed; none for any other."""
        owner, _, link = label.partition(".")
        if owner not in self.objects or self.objects[owner].object.free:
            return []
        thing = self.objects[owner].object
        support = thing.model.supports[thing.model.frames[thing.link_frame(link)].parentJoint]
        return [str(thing.model.names[joint]) for joint in support if joint]


def _kept(scene: Surroundings, key: Hashable, make: Callable[[], T]) -> T:
    """Return what a scene remembers under a key, made if it does not."""
    found: T | None = scene.memory.get(key)
    if found is None:
        if len(scene.memory) >= _MOST:
            scene.memory.clear()
        found = scene.memory[key] = make()
    return found


def _key(placed: PlacedObject) -> tuple[bytes, bytes]:
    return placed.placement.homogeneous.tobytes(), placed.state.tobytes()
