"""Finds pairs of shapes that are exempt from the clearance margin, and the joint ranges for it.

Homes are built tightly: a door panel stands in its wall, a refrigerator's door beside the kitchen.
Such neighbours follow from the scene alone: shapes of articulated objects are compared with all
other fixed shapes, in the initial state and with all joints at zero, as they were built. A pair is
exempt on the range of joint values around that state on which it is closer than the margin: its
distance there depends on these joints alone, so that no motion could increase it. An exemption
never extends to other shapes of the same links.

How deep a pair may overlap depends on the evidence. The initial state exists, so that an overlap
there is an error of the model, and as deep a one may remain. The state at zero is an assumption:
what overlaps there alone is an obstacle, unless a small error of the model explains it.
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
from vkc_pin.world.collision.distances import Shapes
from vkc_pin.world.models.shapes import (
    compute_bounding_box,
    compute_shape_distance,
    compute_world_box,
    get_link_name,
)
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import (
    PlacedObject,
    find_link_shapes,
    make_world_shapes,
    sweep_link_shapes,
)

CONTACT_DEPTH = 1e-4
"""Largest overlap that counts as contact [m]: resting objects overlap their support by rounding."""
ACCEPTED_SHORTFALL = 1e-3
"""Shortfall of a required clearance that is accepted at a waypoint [m].

Whatever judges a configuration uses it: checks of scenes, explanations of failures and validation.
Searches for initial guesses and the solver aim at the full clearance.
"""
MODEL_ERROR = 5e-3
"""Overlap of closed furniture with its neighbours that counts as an error of the model [m].

In the kitchens of robohive 0.5 and d4rl 1.1, doors that leave their neighbours when they open
overlap them by 2.0 mm in the closed state, and others by 4.0 mm. The scenes and the generated
furniture of this repository have no such overlaps.
"""
_STEPS = 64  # samples of a joint's path to its limit, and of each refinement
_TURN = np.pi  # [rad] range examined of joints without limits


T = TypeVar("T")
_MAX_NAMED = 6  # pairs that a warning names
_MAX_CACHED = 4096  # results in a scene's cache


class _Scene(Protocol):
    """The attributes of a `Scene` that are used here; `scene` imports this module."""

    @property
    def objects(self) -> Mapping[str, PlacedObject]: ...
    @property
    def obstacles(self) -> Sequence[pin.GeometryObject]: ...
    @property
    def obstacle_labels(self) -> Sequence[str]: ...
    @property
    def held(self) -> Collection[str]: ...
    @property
    def allowed(self) -> Mapping[frozenset[str], float]: ...
    @property
    def memory(self) -> dict[Any, Any]: ...


class ClosePair(NamedTuple):
    """Two links that are close to each other.

    Attributes:
        first, second: Their labels; the first link can move.
        distance: Signed distance [m].
    """

    first: str
    second: str
    distance: float

    def __str__(self) -> str:
        if self.distance >= 0.0:
            relation = f"are {1e3 * self.distance:.1f} mm apart"
        else:
            relation = f"overlap by {-1e3 * self.distance:.1f} mm"
        return f"{self.first} – {self.second} {relation}"


@dataclasses.dataclass(frozen=True, eq=False)
class ClearanceExemption:
    """Two links, or one shape of each, that are exempt from the clearance margin.

    Attributes:
        first, second: Labels of the links.
        margin: Clearance that they keep instead [m]; negative: an allowed penetration; -inf: none.
        distance: Their distance in the initial state, or as built [m]; `margin` for pairs that the
            scene's description allows.
        ranges: Coordinate "<object>.<joint>" → (lower, upper) on which the exemption is active,
            [rad] or [m]; empty: always.
        shapes: Exempt shape of each link, see `make_shape_keys`; None: all shapes of both links.
        nearest: Smallest distance on the ranges of single joints [m]; infinite for pairs that the
            scene's description allows.
    """

    first: str
    second: str
    margin: float
    distance: float
    ranges: Mapping[str, tuple[float, float]] = dataclasses.field(default_factory=dict)
    shapes: tuple[str, str] | None = None
    nearest: float = np.inf

    def is_between(self, one: str, other: str) -> bool:
        """Return whether the exemption is between two links, given by their labels."""
        return {one, other} == {self.first, self.second}

    def find_shape_pairs(self, labels: Sequence[str], keys: Sequence[str]) -> list[tuple[int, int]]:
        """Return the exempt pairs (i, j), i < j, of shapes.

        Args:
            labels: Label of each shape.
            keys: Key of each shape, see `make_shape_keys`.
        """
        first_key, second_key = (None, None) if self.shapes is None else self.shapes

        def find_shapes(label: str, key: str | None) -> list[int]:
            own = [k for k, name in enumerate(labels) if name == label]
            return [k for k in own if key is None or keys[k] == key]

        first_shapes = find_shapes(self.first, first_key)
        second_shapes = find_shapes(self.second, second_key)
        return [(min(i, j), max(i, j)) for i in first_shapes for j in second_shapes]

    def is_active(self, names: Sequence[str], states: Floats) -> Bools:
        """Return at which states the exemption is active, shape (S,)."""
        inside = np.ones(len(states), bool)
        for name, (lower, upper) in self.ranges.items():
            column = states[:, names.index(name)]
            inside &= (lower <= column) & (column <= upper)
        return inside

    def __str__(self) -> str:
        return " – ".join(self.shapes or (self.first, self.second))


def make_shape_keys(labels: Sequence[str], names: Sequence[str]) -> list[str]:
    """Return a key for each shape that is the same in every model of a scene.

    The key is the shape's own name, after that of its object: "door.leaf_0", "wall_2".

    Args:
        labels: Label of each shape: "<object>.<link>", or the name of an obstacle or robot link.
        names: Name of each shape in the model of its object, or in a model of several objects.
    """
    keys = []
    for label, name in zip(labels, names, strict=True):
        owner, dot, link = label.partition(".")
        _, _, number = name.rpartition("_")
        keys.append(f"{owner}.{link}_{number}" if dot else name)
    return keys


def find_clearance_exemptions(scene: _Scene, dist_safe: float) -> tuple[ClearanceExemption, ...]:
    """Return all pairs that may be closer than the clearance margin.

    These are the links that the scene allows, and neighbouring shapes.
    """

    def find() -> tuple[ClearanceExemption, ...]:
        found = list[ClearanceExemption]()
        for pair, margin in scene.allowed.items():
            # A pair of a link with itself has one label.
            if len(pair) == 2:
                found.append(ClearanceExemption(min(pair), max(pair), margin, margin))
        found += _find_neighbours(scene, dist_safe)
        return tuple(found)

    states = [make_state_key(placed) for placed in scene.objects.values()]
    return get_cached(scene, ("clearance_exemptions", dist_safe, *states), find)


def find_close_pairs(scene: _Scene, reach: float) -> list[ClosePair]:
    """Return the pairs of links closer than `reach` [m] of which one can move.

    Held objects, pairs of links of one object, pairs that the scene allows, and fixed objects on
    the floor are left out; so are free objects on their support, unless they overlap it.
    """
    shapes = PlacedShapes(scene, scene.objects)
    found = []
    for (first, second), distance in shapes.find_near_links(reach).items():
        if frozenset((first, second)) in scene.allowed:
            continue
        has_free = _is_on_free_object(scene, first) or _is_on_free_object(scene, second)
        if not has_free or distance < -CONTACT_DEPTH:
            found.append(ClosePair(first, second, distance))
    return sorted(found, key=lambda pair: pair.distance)


def _is_on_free_object(scene: _Scene, label: str) -> bool:
    """Return whether a label is that of a link of a free object."""
    owner, dot, _ = label.partition(".")
    return bool(dot) and scene.objects[owner].object.free


def warn_of_overlaps(scene: _Scene, name: str) -> None:
    """Warn of movable links that overlap other shapes in the scene called `name`."""
    found = [pair for pair in find_close_pairs(scene, 0.0) if pair.distance < -CONTACT_DEPTH]
    if not found:
        return
    pairs = "; ".join(map(str, found[:_MAX_NAMED]))
    if len(found) > _MAX_NAMED:
        pairs += f"; and {len(found) - _MAX_NAMED} more"
    warnings.warn(
        f"{name}: movable links overlap other shapes: {pairs}. They may stay that deep in each "
        "other. `allow:` in the scene permits contact; `vkc-pin check` lists all pairs.",
        stacklevel=4,
    )


def _find_neighbours(scene: _Scene, dist_safe: float) -> Iterator[ClearanceExemption]:
    """Yield exemptions of shapes of fixed objects closer than `dist_safe` to others.

    Two states are examined: the initial one, and that with all joints at zero.
    """
    initial = {name: placed for name, placed in scene.objects.items() if not placed.object.free}
    zero = dict[str, PlacedObject]()
    differs = False
    for name, placed in initial.items():
        state = np.clip(0.0, placed.object.lower, placed.object.upper)
        zero[name] = dataclasses.replace(placed, state=state)
        differs = differs or bool(np.any(state != placed.state))
    known = set[Hashable]()
    for objects in [initial, zero] if differs else [initial]:
        is_initial = objects is initial
        fixed = PlacedShapes(scene, objects)
        near = fixed.find_near_shapes(dist_safe - ACCEPTED_SHORTFALL)
        for (i, j), distance in near.items():
            # Such a shape is an obstacle: either the initial state has this overlap, too, or none.
            if not is_initial and distance < -MODEL_ERROR:
                continue
            stretches = fixed.find_near_stretches(i, j, dist_safe)
            if distance >= -CONTACT_DEPTH:
                margin = 0.0
            elif is_initial:
                margin = -fixed.find_allowed_depth(i, j, distance, stretches)
            else:
                margin = -MODEL_ERROR
            ranges = {name: (one.lower, one.upper) for name, one in stretches.items()}
            shapes = (fixed.keys[i], fixed.keys[j])
            key = (shapes, margin, tuple(ranges.items()))
            if key not in known:
                known.add(key)
                yield ClearanceExemption(
                    fixed.labels[i],
                    fixed.labels[j],
                    margin,
                    distance,
                    ranges,
                    shapes,
                    nearest=min([distance, *(one.nearest for one in stretches.values())]),
                )


class NearStretch(NamedTuple):
    """The values of a joint on which it alone keeps two shapes close.

    Attributes:
        lower, upper: Ends of the range, [rad] or [m]; infinite where a joint limit comes first.
        nearest, farthest: Smallest and largest distance on it [m].
        turns: Whether the joint is revolute.
    """

    lower: float
    upper: float
    nearest: float
    farthest: float
    turns: bool

    @property
    def overlaps_throughout(self) -> bool:
        """Whether the shapes overlap at every value of the joint."""
        is_unbounded = self.lower == -np.inf and self.upper == np.inf
        return is_unbounded and self.farthest < -CONTACT_DEPTH


class PlacedShapes:
    """The S shapes of objects and obstacles in the world.

    Attributes:
        labels: Link or obstacle of each shape.
        keys: Key of each shape, see `make_shape_keys`.
    """

    def __init__(self, scene: _Scene, objects: Mapping[str, PlacedObject]) -> None:
        self.scene = scene
        self.objects = dict[str, PlacedObject]()
        for name, placed in objects.items():
            is_in_hand = placed.object.free and name in scene.held
            if not is_in_hand:
                self.objects[name] = placed
        self._shapes = list[pin.GeometryObject]()
        self.labels = list[str]()
        for name, placed in self.objects.items():
            shapes = make_world_shapes(placed)
            self._shapes += shapes
            self.labels += [f"{name}.{get_link_name(shape.name)}" for shape in shapes]
        self._moving = set[str]()  # labels of links of free objects, and of those moved by joints
        for label in set(self.labels):
            if self._get_owner(label).object.free or self.find_joints(label):
                self._moving.add(label)
        if self._moving:
            self._shapes += scene.obstacles
            self.labels += scene.obstacle_labels
        self.keys = make_shape_keys(self.labels, [shape.name for shape in self._shapes])

    def find_near_shapes(self, reach: float) -> dict[tuple[int, int], float]:
        """Return pairs of shapes closer than `reach` [m] → distance [m]; the first can move."""
        if not self._moving:
            return {}
        boxes = [compute_world_box(shape.geometry, shape.placement) for shape in self._shapes]
        lower = np.array([low for low, _ in boxes])
        upper = np.array([high for _, high in boxes])
        owners = np.array([label.partition(".")[0] for label in self.labels])
        is_floor = owners == FLOOR
        found = dict[tuple[int, int], float]()
        for i, (label, shape) in enumerate(zip(self.labels, self._shapes, strict=True)):
            if label not in self._moving:
                continue
            boxes_meet = (lower < upper[i] + reach) & (upper > lower[i] - reach)
            is_close = boxes_meet.all(axis=1) & (owners != owners[i])
            # The height of a fixed object above the floor is given.
            if not self._get_owner(label).object.free:
                is_close &= ~is_floor
            for j in np.flatnonzero(is_close).tolist():
                if (j, i) in found:
                    continue
                other = self._shapes[j]
                distance = compute_shape_distance(
                    shape.geometry, shape.placement, other.geometry, other.placement
                )
                if distance < reach:
                    found[i, j] = distance
        return found

    def _get_owner(self, label: str) -> PlacedObject:
        """Return the object of a link, given by its label."""
        name, _, _ = label.partition(".")
        return self.objects[name]

    def find_near_links(self, reach: float) -> dict[tuple[str, str], float]:
        """Return pairs of link labels closer than `reach` [m] → smallest distance [m]."""
        found: dict[tuple[str, str], float] = {}
        for (i, j), distance in self.find_near_shapes(reach).items():
            pair = (self.labels[i], self.labels[j])
            reverse = (self.labels[j], self.labels[i])
            if reverse in found:
                pair = reverse
            found[pair] = min(distance, found.get(pair, np.inf))
        return found

    def find_near_stretches(self, i: int, j: int, reach: float) -> dict[str, NearStretch]:
        """Return the ranges on which each joint alone keeps two shapes closer than `reach` [m].

        Args:
            i: Index of one shape.
            j: Index of the other shape.
            reach: Distance at which a stretch ends [m].
        """
        found = dict[str, NearStretch]()
        for own, other in ((i, j), (j, i)):
            owner, _, _ = self.labels[own].partition(".")
            other_owner, _, _ = self.labels[other].partition(".")
            states = list[Hashable]()
            for name in (owner, other_owner):
                if name in self.objects:
                    states.append(make_state_key(self.objects[name]))
            for joint in self.find_joints(self.labels[own]):
                key = (
                    "neighbours",
                    self.keys[own],
                    self.labels[other],
                    self.keys[other],
                    joint,
                    reach,
                    *states,
                )
                find = partial(self._find_near_stretch, own, other, joint, reach)
                found[f"{owner}.{joint}"] = get_cached(self.scene, key, find)
        return found

    def _find_near_stretch(self, own: int, other: int, joint: str, reach: float) -> NearStretch:
        label = self.labels[own]
        placed = self._get_owner(label)
        index = placed.object.coordinates.index(joint)
        number_in_link = self.labels[:own].count(label)

        def measure(values: Floats) -> Floats:
            """Return the distances of the two shapes for values of the joint, shape (V,) [m]."""
            distances = self.compute_distances(label, index, values, [other], reach)
            return np.asarray(distances[:, number_in_link, 0])

        position = float(placed.state[index])
        lower = float(placed.object.lower[index])
        upper = float(placed.object.upper[index])
        lowest = lower if np.isfinite(lower) else position - _TURN
        highest = upper if np.isfinite(upper) else position + _TURN
        low_end, low_nearest, low_farthest = _follow_joint(measure, position, lowest, reach)
        high_end, high_nearest, high_farthest = _follow_joint(measure, position, highest, reach)
        return NearStretch(
            lower=-np.inf if low_end is None else low_end,
            upper=np.inf if high_end is None else high_end,
            nearest=min(low_nearest, high_nearest),
            farthest=max(low_farthest, high_farthest),
            turns=placed.object.coordinates.units[index] == "rad",
        )

    def find_allowed_depth(
        self, i: int, j: int, distance: float, stretches: Mapping[str, NearStretch]
    ) -> float:
        """Return how deep two shapes may overlap that overlap in these states [m].

        They may overlap as deep as they do, and by `MODEL_ERROR`. A leaf that its hinge keeps in a
        post at every angle turns in it, by which it gets deeper by its thickness at most: its edge
        takes the place of its face.

        Args:
            i: Index of one shape.
            j: Index of the other shape.
            distance: Their distance, which is negative [m].
            stretches: Result of `find_near_stretches`.

        Returns:
            The depth; infinite where no value of their only joint could exceed it.
        """
        depth = -distance + CONTACT_DEPTH
        is_hinged_inside = all(one.turns and one.overlaps_throughout for one in stretches.values())
        if not is_hinged_inside:
            return max(depth, MODEL_ERROR)
        thicknesses = []
        for k in (i, j):
            if self.find_joints(self.labels[k]):
                _, half_extents = compute_bounding_box(self._shapes[k])
                thicknesses.append(2.0 * float(half_extents.min()))
        depth += min(thicknesses)
        deepest = max(-one.nearest for one in stretches.values())
        if len(stretches) == 1 and deepest <= depth:
            return np.inf
        return max(depth, MODEL_ERROR)

    def find_shapes(self, labels: Collection[str]) -> list[int]:
        """Return the indices of the shapes of links or obstacles, given by their labels."""
        return [k for k, label in enumerate(self.labels) if label in labels]

    def compute_distances(
        self, label: str, index: int, values: Floats, others: Sequence[int], reach: float
    ) -> Floats:
        """Return the distances of a link's shapes from others for values of one coordinate [m].

        Args:
            label: Link, with K shapes.
            index: Index of the coordinate of its object.
            values: Values of the coordinate, shape (V,), [rad] or [m].
            others: Indices of the other shapes, O of them.
            reach: Larger distances may be infinite in the result [m].

        Returns:
            Shape (V, K, O).
        """
        _, _, link = label.partition(".")
        own = find_link_shapes(self._get_owner(label), link)
        targets = [self._shapes[k] for k in others]
        geometries = [shape.geometry for shape in (*own, *targets)]
        shapes = Shapes(geometries, [shape.placement for shape in targets])
        placements, is_near = self._sweep_link(label, index, values, targets, reach)
        row, k, j = np.nonzero(is_near)
        pairs = np.column_stack([k, len(own) + j])
        found = np.full(is_near.shape, np.inf)
        found[row, k, j] = shapes.compute_distances(placements, row, pairs)
        return found

    def find_links_near_sweep(self, label: str, index: int, values: Floats) -> set[str]:
        """Return the labels of shapes whose bounding boxes meet those of a moving link.

        Args:
            label: Link.
            index: Index of the coordinate of its object.
            values: Values of the coordinate, shape (V,), [rad] or [m].
        """
        _, is_near = self._sweep_link(label, index, values, self._shapes, 0.0)
        return {self.labels[j] for j in np.flatnonzero(is_near.any(axis=(0, 1)))}

    def _sweep_link(
        self,
        label: str,
        index: int,
        values: Floats,
        others: Sequence[pin.GeometryObject],
        reach: float,
    ) -> tuple[Floats, Bools]:
        """Return placements of a link's shapes for values of a coordinate, and near pairs.

        Returns:
            Placements of the K shapes at V values, shape (V, K, 12), and whether their bounding
                boxes are closer to those of the O others than `reach`, shape (V, K, O).
        """
        _, _, link = label.partition(".")
        placements, lower, upper = sweep_link_shapes(self._get_owner(label), link, index, values)
        boxes = [compute_world_box(shape.geometry, shape.placement) for shape in others]
        other_lower = np.array([low for low, _ in boxes])
        other_upper = np.array([high for _, high in boxes])
        is_below = other_lower < upper[:, :, None] + reach
        is_above = other_upper > lower[:, :, None] - reach
        return placements, np.asarray((is_below & is_above).all(axis=3))

    def find_joints(self, label: str) -> list[str]:
        """Return the joints that move a link of a fixed object; for other links, none."""
        owner, _, link = label.partition(".")
        if owner not in self.objects or self.objects[owner].object.free:
            return []
        item = self.objects[owner].object
        frame = item.model.frames[item.link_frame(link)]
        support = item.model.supports[frame.parentJoint]
        return [str(item.model.names[joint]) for joint in support if joint]


def _follow_joint(
    measure: Callable[[Floats], Floats], start: float, end: float, reach: float
) -> tuple[float | None, float, float]:
    """Follow the distance of two shapes while a joint moves until they are apart.

    Args:
        measure: Returns the distances [m] for values of the joint, shape (V,) each.
        start: Value at which the joint starts, [rad] or [m].
        end: Last value.
        reach: Distance at which the shapes are apart [m].

    Returns:
        The value at which they get apart, or None; and the smallest and the largest distance on
            the path to it [m], or inf and -inf if they are apart from the start.
    """
    values = np.linspace(start, end, _STEPS + 1)
    distances = measure(values)
    count = _count_near(distances, reach)
    nearest = np.inf
    farthest = -np.inf
    if count:
        near = distances[:count]
        k = int(np.argmin(near))
        around = np.linspace(values[max(k - 1, 0)], values[min(k + 1, _STEPS)], _STEPS + 1)
        nearest = min(float(near[k]), float(measure(around).min()))
        farthest = float(near.max())
    if count == len(values):
        return None, nearest, farthest
    low = float(values[max(count - 1, 0)])
    high = float(values[count])
    values = np.linspace(low, high, _STEPS + 1)
    count = _count_near(measure(values), reach)
    if count < len(values):
        low = float(values[max(count - 1, 0)])
        high = float(values[count])
    return (low + high) / 2.0, nearest, farthest


def _count_near(distances: Floats, reach: float) -> int:
    """Return how many distances precede the first one of at least `reach` [m]."""
    is_apart = distances >= reach
    return int(np.argmax(is_apart)) if is_apart.any() else len(distances)


def get_cached(scene: _Scene, key: Hashable, make: Callable[[], T]) -> T:
    """Return the value cached under a key in a scene, computed if there is none."""
    found: T | None = scene.memory.get(key)
    if found is None:
        if len(scene.memory) >= _MAX_CACHED:
            scene.memory.clear()
        found = make()
        scene.memory[key] = found
    return found


def make_state_key(placed: PlacedObject) -> tuple[bytes, ...]:
    """Return a key of an object's placement, joint values and measured joints."""
    key = [placed.placement.homogeneous.tobytes(), placed.state.tobytes()]
    for joint, measured in sorted(placed.measured.items()):
        key.append(joint.encode())
        key.append(measured.placement.homogeneous.tobytes())
        key.append(measured.link.homogeneous.tobytes())
    return tuple(key)
