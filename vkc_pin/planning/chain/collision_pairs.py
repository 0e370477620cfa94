"""Selects the collision pairs of each phase and their margins (eqs. 6 and 7), eased at contacts."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.chain.chain import VirtualKinematicChain
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.budget import record_evaluations
from vkc_pin.world.collision.boxes import Boxes
from vkc_pin.world.collision.distances import MarginRegion, Margins
from vkc_pin.world.models.shapes import (
    compute_bounding_box,
    compute_shape_distance,
    compute_world_box,
    get_link_name,
    get_local_name,
)
from vkc_pin.world.scene.clearance_exemptions import (
    ACCEPTED_SHORTFALL,
    CONTACT_DEPTH,
    find_clearance_exemptions,
    make_shape_keys,
)
from vkc_pin.world.scene.contact_rules import (
    CONTACT_WINDOW,
    compute_hand_clearance,
    find_grasp_distances,
    find_grasped_link,
    find_touch_links,
    is_rigid_grasp,
)
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.scene.support import SupportedObject
from vkc_pin.world.task.lookup import find_joint_limits
from vkc_pin.world.task.phases import Phase, Task

REDUCED_MARGIN_RATIO = 0.5  # margin relative to the distance at the contact
_POINT_RADIUS = 1e-4  # [m], of the sphere that stands for the target of a touch
ReducedMargins = dict[int, list[tuple[int, int, float]]]


class _Contact(NamedTuple):
    """A geometry where it touches something at the begin or the end of a phase.

    Attributes:
        geometry: Geometry of the chain.
        shape: Its shape, or a point for one that touches a target.
        placement: Placement of the shape in the world at the contact.
        begins: Whether the contact is at the begin of the phase; otherwise it is at the end.
        may_overlap: Whether the shapes may overlap there.
    """

    geometry: int
    shape: coal.CollisionGeometry
    placement: pin.SE3
    begins: bool
    may_overlap: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class PhaseGeometry:
    """Geometry and collision pairs of one phase.

    Attributes:
        shapes: Geometry of the robot, of attached links, then of all that is fixed in the world.
        labels: Link or obstacle of each geometry, e.g. "wrist_3_link", "door.panel", "sofa".
        pairs: Geometry indices, shape (P, 2); at least the first of each pair moves.
        margins: Required clearance of each pair, shape (P,) [m].
        joint: Parent joint of each geometry, shape (G,); 0: fixed in the world.
        center, half: Bounding boxes in the geometries' frames, shape (G, 3) [m].
        rotation, translation: Placements on the joints, shapes (G, 3, 3) and (G, 3).
        reduced_margins: Pair → (first waypoint, last waypoint, margin [m] that applies between
            them).
        margin_regions: Joint ranges in which pairs are exempt from their margins.
        released: Object → its geometries, for objects released where the motion chooses.
    """

    shapes: Sequence[pin.GeometryObject]
    labels: tuple[str, ...]
    pairs: Ints
    margins: Floats
    joint: Ints
    center: Floats
    half: Floats
    rotation: Floats
    translation: Floats
    reduced_margins: Mapping[int, Sequence[tuple[int, int, float]]] = field(default_factory=dict)
    margin_regions: Sequence[MarginRegion] = ()
    released: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def with_placements(self, placements: Mapping[int, pin.SE3]) -> PhaseGeometry:
        """Return a copy with some static geometries at other placements in the world."""
        shapes = list(self.shapes)
        rotation = self.rotation.copy()
        translation = self.translation.copy()
        for geometry, placement in placements.items():
            shapes[geometry] = pin.GeometryObject(shapes[geometry])
            shapes[geometry].placement = placement
            rotation[geometry] = placement.rotation
            translation[geometry] = placement.translation
        moved = replace(self, shapes=tuple(shapes), rotation=rotation, translation=translation)
        # Keep cached properties that do not depend on these placements.
        for name in ("_n_moving", "_pair_numbers", "margin_table"):
            moved.__dict__[name] = getattr(self, name)
        which = np.array(list(placements), int)
        boxes = self.boxes.move_fixed(which, rotation[which], moved._box_centers[which])
        moved.__dict__["boxes"] = boxes
        return moved

    def find_static_near(self, reach: float, lower: Floats, upper: Floats) -> Ints:
        """Return static geometries within `reach` [m] of a box with given corners, (3,)."""
        lows, highs = self._static_boxes
        overlaps = (lows < (upper + reach)[:, None]) & (highs > (lower - reach)[:, None])
        return np.flatnonzero(overlaps.all(axis=0)) + self._n_moving

    def find_pairs(self, first: int, seconds: Ints) -> Ints:
        """Return the existing pairs of a moving geometry with some static ones."""
        numbers = self._pair_numbers[first, seconds - self._n_moving]
        return numbers[numbers >= 0]

    @cached_property
    def margin_table(self) -> Margins:
        """Margins of all pairs with their exceptions."""
        return Margins(self.margins, self.reduced_margins, self.margin_regions)

    @cached_property
    def _n_moving(self) -> int:
        """Number of geometries on joints; these come first, the others are static."""
        return int(np.count_nonzero(self.joint))

    @cached_property
    def _box_centers(self) -> Floats:
        """Centre of each geometry's box in its joint's frame, shape (G, 3) [m]."""
        return np.einsum("gij,gj->gi", self.rotation, self.center) + self.translation

    @cached_property
    def boxes(self) -> Boxes:
        """Boxes of all geometries, for the broad phase."""
        return Boxes(self.joint, self.rotation, self._box_centers, self.half, self.pairs)

    @cached_property
    def _pair_numbers(self) -> Ints:
        """Pair number of each moving with each static geometry, shape (M, S); -1: no pair."""
        moving = self._n_moving
        numbers = np.full((moving, len(self.joint) - moving), -1)
        is_static = self.joint[self.pairs[:, 1]] == 0
        with_static = np.flatnonzero(is_static)
        first, second = self.pairs[with_static].T
        numbers[first, second - moving] = with_static
        return numbers

    @cached_property
    def _static_boxes(self) -> tuple[Floats, Floats]:
        """Lower and upper corners of the static axis-aligned boxes, shape (3, S) each [m].

        A box of half extents h with the rotation R extends by |R| h along the world's axes.
        """
        static = slice(self._n_moving, None)
        extents = np.einsum("gij,gj->gi", np.abs(self.rotation[static]), self.half[static])
        centers = self._box_centers[static]
        return (centers - extents).T, (centers + extents).T


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
    phase = task.phases[number]
    reduced = ReducedMargins()
    first = sum(p.segments for p in task.phases[:number])
    last = first + phase.segments
    steps = options.steps(CONTACT_WINDOW)
    at_begin = (first, first + steps)
    at_end = (last - steps, last)
    for holds, window in ((phase.released, at_begin), (phase.grasps, at_end)):
        for hold in holds:
            margins: dict[str, float] = {}
            for k in _find_pairs_with_hand(scene, hold, part):
                link = part.labels[part.pairs[k, 1]]
                if link not in margins:
                    margins[link] = _compute_hand_margin(scene, hold, link, options)
                reduced.setdefault(k, []).append((*window, margins[link]))
    reach = float(part.margins.max())
    supports = _find_supports(scene, chain, task, number, part)
    touches = _find_touches(chain, task, number, part)
    for contact in itertools.chain(supports, touches):
        shape = contact.shape
        window = at_begin if contact.begins else at_end
        lower, upper = compute_world_box(shape, contact.placement)
        nearby = part.find_static_near(reach, lower, upper)
        for k in part.find_pairs(contact.geometry, nearby).tolist():
            other = part.shapes[int(part.pairs[k, 1])]
            distance = compute_shape_distance(
                shape, contact.placement, other.geometry, other.placement
            )
            margin = REDUCED_MARGIN_RATIO * max(distance, 0.0)
            if contact.may_overlap and distance < -CONTACT_DEPTH:
                margin = distance
            if distance < part.margins[k]:
                reduced.setdefault(k, []).append((*window, margin))
    return reduced


def _find_pairs_with_hand(scene: Scene, hold: Hold, part: PhaseGeometry) -> list[int]:
    """Return the pairs of the hand (first) with the object that it grasps or releases."""
    is_hand = np.isin(part.labels, list(find_touch_links(scene, hold)))
    is_object = np.array([label.startswith(f"{hold.object}.") for label in part.labels])
    first, second = part.pairs.T
    return np.flatnonzero(is_hand[first] & is_object[second]).tolist()


def _compute_hand_margin(scene: Scene, hold: Hold, link: str, options: Options) -> float:
    """Return the clearance that a hand keeps from a link of the object that it grasps [m].

    Where the grasp fixes a smaller distance that validation still accepts, no motion improves it;
    the solver, which tolerates half as much, could not converge.
    """
    margin = compute_hand_clearance(scene, hold, link, options)
    fixed = find_grasp_distances(scene, hold).get(link, np.inf)
    return min(margin, max(fixed, margin - ACCEPTED_SHORTFALL / 2))


def _find_touches(
    chain: VirtualKinematicChain, task: Task, number: int, part: PhaseGeometry
) -> Iterator[_Contact]:
    """Yield geometry that touches a target at the end or the begin of a phase."""
    goals = [(goal, False) for goal in task.phases[number].frames]
    if number:
        goals += [(goal, True) for goal in task.phases[number - 1].frames]
    for goal, begins in goals:
        if not goal.touches:
            continue
        point = coal.Sphere(_POINT_RADIUS)
        where = pin.SE3(np.eye(3), goal.placement.translation)
        joint, _ = chain.frame(goal.frame, goal.hold)
        for i in range(len(chain.collision.geometryObjects)):
            if goal.hold:
                touches = part.labels[i] == str(goal)
            else:
                touches = part.shapes[i].parentJoint == joint
            if touches:
                yield _Contact(i, point, where, begins, may_overlap=False)


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
            yield _Contact(i, part.shapes[i].geometry, where, begins, may_overlap)


def _find_lift_and_place_moments(
    scene: Scene, chain: VirtualKinematicChain, task: Task, number: int
) -> Iterator[tuple[Sequence[int], PlacedObject, bool]]:
    """Yield geometries, their object as placed, and whether it is lifted or placed then.

    These are the objects whose transport begins (True) or ends (False) in a phase. Transport of an
    object grasped at the start begins in the first phase.
    """
    phase = task.phases[number]
    at_start = {}
    if number == 0:
        for hold in phase.held:
            if hold in scene.holds:
                at_start[hold] = scene.objects[hold.object].placement
    for moments, begins in ((at_start, True), (phase.lifted, True), (phase.lowered, False)):
        for hold, placement in moments.items():
            if not scene.objects[hold.object].object.free:
                continue
            placed = replace(scene.objects[hold.object], placement=placement)
            yield chain.grasped_geometries[hold], placed, begins
            for supported in phase.supported:
                if supported.hold == hold:
                    placed_on_it = _place_supported_object(scene, supported, placed)
                    yield chain.supported_geometries[supported], placed_on_it, begins
    for supported in phase.supported:
        carrier = scene.objects[supported.hold.object]
        if carrier.object.free:
            continue
        final_values = _predict_final_values(phase, carrier)
        for values, begins in ((phase.initial_values, True), (final_values, False)):
            carrier_then = carrier.with_state(_select_joint_values(values, carrier.name))
            placed_on_it = _place_supported_object(scene, supported, carrier_then)
            yield chain.supported_geometries[supported], placed_on_it, begins


def _predict_final_values(phase: Phase, placed: PlacedObject) -> dict[str, float]:
    """Return coordinate → value at the end of a phase, with the goals of one object reached."""
    final_values = dict(phase.initial_values)
    for name, value in phase.values.items():
        if name.partition(".")[0] == placed.name:
            lower, upper = find_joint_limits(placed, name)
            final_values[name] = float(np.clip(value, lower, upper))
    return final_values


def _place_supported_object(
    scene: Scene, supported: SupportedObject, carrier: PlacedObject
) -> PlacedObject:
    """Return the supported object, placed on its carrier."""
    placement = carrier.link_placement(supported.link) * supported.placement_in_link
    return replace(scene.objects[supported.object], placement=placement)


def _select_joint_values(values: Mapping[str, float], owner: str) -> dict[str, float]:
    """Return joint → value of one object, of values by "<object>.<joint>"."""
    selected = {}
    for name, value in values.items():
        object_name, _, joint = name.partition(".")
        if object_name == owner:
            selected[joint] = value
    return selected


def build_phase_geometries(
    scene: Scene, chain: VirtualKinematicChain, task: Task, options: Options
) -> list[PhaseGeometry]:
    """Return the geometry of each phase of a task, with the pairs that can collide.

    Raises:
        InputError: In some phase there is no pair that can collide.
    """
    builder = _PairBuilder(scene, chain, task, options)
    return [builder.build_phase(number) for number in range(len(task.phases))]


class _PairBuilder:
    def __init__(
        self, scene: Scene, chain: VirtualKinematicChain, task: Task, options: Options
    ) -> None:
        self.scene = scene
        self.chain = chain
        self.task = task
        self.options = options
        geometries = chain.collision.geometryObjects
        self._robot_geometries = range(len(scene.robot.collision.geometryObjects))
        self._labels = [scene.robot.link_of(i) for i in self._robot_geometries]
        for moved in (chain.grasped_geometries, chain.supported_geometries):
            for hold_or_supported, indices in moved.items():
                for i in indices:
                    link = get_link_name(get_local_name(geometries[i].name))
                    self._labels.append(f"{hold_or_supported.object}.{link}")
        own_margins = scene.robot.own_margins(options.self_distance)
        self._own_pairs = [(i, j, margin) for (i, j), margin in own_margins.items()]
        # of a hold and the labels of two shapes [m]
        self._attached_margins: dict[tuple[Hold, str, str], float] = {}
        self._exemptions = find_clearance_exemptions(scene, options.dist_safe)
        self._obstacles = scene.obstacles
        self._boxes_of_chain = _compute_boxes([*geometries])
        self._boxes_of_obstacles = _compute_boxes(self._obstacles)

    def _pair_moving_shapes(
        self, phase: Phase, shapes: Sequence[pin.GeometryObject]
    ) -> tuple[list[tuple[int, int, float]], dict[str, tuple[int, ...]]]:
        """Return the pairs of the robot and the objects that it moves.

        Returns:
            Pairs of shapes with their margins [m], and attached or supported object → its shapes.
        """
        chain = self.chain
        labels = self._labels
        margin = self.options.dist_safe
        pairs = list(self._own_pairs)
        attached_shapes: dict[str, tuple[int, ...]] = {}
        moving = list(self._robot_geometries)
        for hold in phase.held:
            grasped = chain.grasped_geometries[hold]
            attached_shapes[hold.object] = grasped
            for i, j in itertools.product(moving, grasped):
                pairs.append((i, j, self._get_attached_margin(hold, labels[i], labels[j])))
            for i, j in itertools.combinations(grasped, 2):
                if self._can_self_collide(hold.object, labels[i], labels[j]):
                    pairs.append((i, j, margin))
            moving += grasped
        for supported in phase.supported:
            on_it = chain.supported_geometries[supported]
            attached_shapes[supported.object] = on_it
            # The object moves rigidly with geometry on these joints.
            same_joint = {shapes[j].parentJoint for j in on_it}
            for i, j in itertools.product(moving, on_it):
                if shapes[i].parentJoint not in same_joint:
                    pairs.append((i, j, margin))
            moving += on_it
        return pairs, attached_shapes

    def build_phase(self, number: int) -> PhaseGeometry:
        phase = self.task.phases[number]
        shapes = list(self.chain.get_collision_geometry(phase.opening).geometryObjects)
        boxes_of_chain = self._boxes_of_chain
        if phase.opening is not None:
            boxes_of_chain = _compute_boxes(shapes)
        pairs, attached_shapes = self._pair_moving_shapes(phase, shapes)
        pairs = [pair for pair in pairs if np.isfinite(pair[2])]
        moving = [
            *self._robot_geometries,
            *itertools.chain.from_iterable(attached_shapes.values()),
        ]

        labels = list(self._labels)
        static_shapes = list[pin.GeometryObject]()
        released: dict[str, tuple[int, ...]] = {}
        holds = {hold.object: hold for hold in phase.held}
        for name, placed in self.scene.objects.items():
            if placed.object.free and name in attached_shapes:
                continue  # all of it moves
            static_of_object = self._make_static_shapes(phase, name, shapes, attached_shapes)
            first = len(shapes) + len(static_shapes)
            if name in phase.released_by:
                released[name] = tuple(range(first, first + len(static_of_object)))
            for index, shape in enumerate(static_of_object, start=first):
                label = f"{name}.{get_link_name(shape.name)}"
                for i in moving:
                    is_same_object = i in attached_shapes.get(name, ())
                    if is_same_object and not self._can_self_collide(name, labels[i], label):
                        continue
                    margin = self.options.dist_safe
                    if name in holds:  # the hand moves only some of its joints
                        margin = self._get_attached_margin(holds[name], labels[i], label)
                    pairs.append((i, index, margin))
                shape.name = f"{name}.{shape.name}"
                static_shapes.append(shape)
                labels.append(label)
        record_evaluations()

        boxes_of_static = _compute_boxes(static_shapes)
        boxes = zip(boxes_of_chain, boxes_of_static, self._boxes_of_obstacles, strict=True)
        center, half, rotation, translation = (np.concatenate(parts) for parts in boxes)
        first_obstacle = len(shapes) + len(static_shapes)
        floor_movers = self._find_floor_movers(shapes, moving, attached_shapes)
        with_obstacles = self._pair_with_obstacles(first_obstacle, moving, floor_movers)
        table = np.concatenate([np.array(pairs).reshape(-1, 3), with_obstacles])
        shapes += [*static_shapes, *self._obstacles]
        labels += self.scene.obstacle_labels
        keys = make_shape_keys(labels, [shape.name for shape in shapes])
        table, margin_regions = self._apply_exemptions(phase, table, labels, keys)
        if not len(table):
            expected = "collision geometry in robot or scene"
            raise InputError(
                "no pair of geometries can collide", field=phase.name, expected=expected
            )
        part = PhaseGeometry(
            shapes=tuple(shapes),
            labels=tuple(labels),
            pairs=table[:, :2].astype(int),
            margins=table[:, 2],
            joint=np.array([shape.parentJoint for shape in shapes]),
            center=center,
            half=half,
            rotation=rotation,
            translation=translation,
            margin_regions=margin_regions,
            released=released,
        )
        reduced_margins = find_reduced_margins(
            self.scene, self.chain, self.task, number, part, self.options
        )
        return replace(part, reduced_margins=reduced_margins)

    def _make_static_shapes(
        self,
        phase: Phase,
        name: str,
        shapes: Sequence[pin.GeometryObject],
        attached_shapes: Mapping[str, tuple[int, ...]],
    ) -> list[pin.GeometryObject]:
        """Return the geometry of an object that is fixed in the world during a phase."""
        placed = self.scene.objects[name]
        if placed.object.free:
            placed = replace(placed, placement=phase.resting.get(name, placed.placement))
        values = _select_joint_values(phase.initial_values, name)
        static = make_world_shapes(placed.with_state(values))
        if name in attached_shapes:  # its static links; the others move with the hand
            moving_names = {get_local_name(shapes[i].name) for i in attached_shapes[name]}
            static = [shape for shape in static if shape.name not in moving_names]
        return static

    def _find_floor_movers(
        self,
        shapes: Sequence[pin.GeometryObject],
        moving: Sequence[int],
        attached_shapes: Mapping[str, tuple[int, ...]],
    ) -> list[int]:
        """Return the moving geometry that must not touch the floor: arm and free objects."""
        movers = {i for i in self._robot_geometries if shapes[i].parentJoint > 1}
        for name, indices in attached_shapes.items():
            if self.scene.objects[name].object.free:
                movers.update(indices)
        return [i for i in moving if i in movers]

    def _get_attached_margin(self, hold: Hold, one: str, link: str) -> float:
        key = (hold, one, link)
        if key not in self._attached_margins:
            self._attached_margins[key] = self._find_attached_margin(hold, one, link)
        return self._attached_margins[key]

    def _find_attached_margin(self, hold: Hold, one: str, link: str) -> float:
        """Return the clearance [m] between label `one` and label `link` of a grasped object.

        The hand and the link it grasps move together, so that they need no margin unless the grasp
        leaves a freedom.
        """
        if one not in find_touch_links(self.scene, hold):
            return self.options.dist_safe
        if link != find_grasped_link(self.scene, hold):
            return _compute_hand_margin(self.scene, hold, link, self.options)
        if is_rigid_grasp(self.scene, hold):
            return -np.inf
        return compute_hand_clearance(self.scene, hold, link, self.options) or -CONTACT_DEPTH

    def _apply_exemptions(
        self, phase: Phase, table: Floats, labels: Sequence[str], keys: Sequence[str]
    ) -> tuple[Floats, list[MarginRegion]]:
        """Return pairs with the scene's margins, and the joint-dependent exemptions."""
        if not self._exemptions:
            return table, []
        # A pair (i, j), i < j, of G geometries has the key i·G + j.
        count = len(labels)
        pairs = table[:, :2].astype(int)
        pair_keys = pairs.min(axis=1) * count + pairs.max(axis=1)
        rows = {}
        for exemption in self._exemptions:
            exempt = np.array(exemption.find_shape_pairs(labels, keys), int).reshape(-1, 2)
            exempt_keys = exempt[:, 0] * count + exempt[:, 1]
            rows[exemption] = np.flatnonzero(np.isin(pair_keys, exempt_keys))
        for exemption in self._exemptions:
            if not exemption.ranges:
                exempt_rows = rows[exemption]
                table[exempt_rows, 2] = np.minimum(table[exempt_rows, 2], exemption.margin)
        is_kept = np.isfinite(table[:, 2])
        new_rows = np.cumsum(is_kept) - 1  # of the pairs that are kept
        margin_regions = []
        for exemption in self._exemptions:
            exempt_rows = rows[exemption]
            exempt_pairs = new_rows[exempt_rows[is_kept[exempt_rows]]]
            resolved = self._resolve_ranges(phase, exemption.ranges)
            if exemption.ranges and len(exempt_pairs) and resolved is not None:
                margin = exemption.margin
                if margin >= 0.0:
                    margin = REDUCED_MARGIN_RATIO * max(exemption.nearest, 0.0)
                margin_regions.append(MarginRegion(exempt_pairs, margin, *resolved))
        return table[is_kept], margin_regions

    def _resolve_ranges(
        self, phase: Phase, ranges: Mapping[str, tuple[float, float]]
    ) -> tuple[Ints, Floats, Floats] | None:
        """Return columns of the chain and their limits, shape (m,) each.

        Returns None if a coordinate that is not in the chain is outside its range.
        """
        columns = list[int]()
        lower_limits = list[float]()
        upper_limits = list[float]()
        for name, (lower, upper) in ranges.items():
            if name in self.chain.names:
                columns.append(self.chain.index(name))
                lower_limits.append(lower)
                upper_limits.append(upper)
                continue
            owner, _, joint = name.partition(".")
            placed = self.scene.objects[owner]
            at_start = float(placed.state[placed.object.coordinates.index(joint)])
            value = phase.initial_values.get(name, at_start)
            if not lower <= value <= upper:
                return None
        return np.array(columns, int), np.array(lower_limits), np.array(upper_limits)

    def _can_self_collide(self, name: str, first: str, second: str) -> bool:
        """Return whether two links of an object, given by labels, can collide."""
        links = frozenset(label.partition(".")[2] for label in (first, second))
        return links in self.scene.objects[name].object.own_pairs

    def _pair_with_obstacles(
        self, first: int, moving: Sequence[int], floor_movers: Sequence[int]
    ) -> Floats:
        """Return the pairs of moving geometries with obstacles, and their margins, shape (P, 3).

        Only `floor_movers` are paired with the floor: wheels stand on it, and the gap below doors
        is as modelled.
        """
        obstacle_count = len(self._obstacles)
        movers = np.tile(np.array(moving, int), obstacle_count)
        obstacles = np.repeat(np.arange(obstacle_count), len(moving))
        is_floor = np.array([label == FLOOR for label in self.scene.obstacle_labels], bool)
        is_pair = ~is_floor[obstacles] | np.isin(movers, floor_movers)
        movers = movers[is_pair]
        obstacles = obstacles[is_pair]
        margins = np.full(len(movers), self.options.dist_safe)
        return np.column_stack([movers, first + obstacles, margins])


def _compute_boxes(shapes: Sequence[pin.GeometryObject]) -> tuple[Floats, ...]:
    """Return box centres and half extents, and placements as rotations and translations.

    See `PhaseGeometry`.
    """
    boxes = [compute_bounding_box(shape) for shape in shapes]
    return (
        np.array([center for center, _ in boxes]).reshape(-1, 3),
        np.array([half for _, half in boxes]).reshape(-1, 3),
        np.array([shape.placement.rotation for shape in shapes]).reshape(-1, 3, 3),
        np.array([shape.placement.translation for shape in shapes]).reshape(-1, 3),
    )
