"""Selects the collision pairs of each phase and their margins (eqs. 6 and 7), eased at contacts."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

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
ReducedMargins = dict[int, list[tuple[int, int, float]]]
# geometry of the chain, shape and placement at a contact, whether it is at the begin of the phase,
# and whether the shapes may overlap
_Contact = tuple[int, coal.CollisionGeometry, pin.SE3, bool, bool]


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
        rotation, translation = self.rotation.copy(), self.translation.copy()
        for geometry, placement in placements.items():
            shapes[geometry] = pin.GeometryObject(shapes[geometry])
            shapes[geometry].placement = placement
            rotation[geometry], translation[geometry] = placement.rotation, placement.translation
        moved = replace(self, shapes=tuple(shapes), rotation=rotation, translation=translation)
        for name in ("_n_moving", "_pair_numbers", "margin_table"):  # independent of the placements
            moved.__dict__[name] = getattr(self, name)
        which = np.array(list(placements), int)
        moved.__dict__["boxes"] = self.boxes.move_fixed(
            which, rotation[which], moved._box_centers[which]
        )
        return moved

    def find_static_near(self, reach: float, lower: Floats, upper: Floats) -> Ints:
        """Return static geometries within `reach` [m] of a box with given corners, (3,)."""
        lows, highs = self._static_boxes
        near = (lows < (upper + reach)[:, None]) & (highs > (lower - reach)[:, None])
        return np.flatnonzero(near.all(axis=0)) + self._n_moving

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
        number = np.full((moving, len(self.joint) - moving), -1)
        (standing,) = np.nonzero(self.joint[self.pairs[:, 1]] == 0)
        number[self.pairs[standing, 0], self.pairs[standing, 1] - moving] = standing
        return number

    @cached_property
    def _static_boxes(self) -> tuple[Floats, Floats]:
        """Lower and upper corners of the static axis-aligned boxes, shape (3, S) each [m]."""
        standing = slice(self._n_moving, None)
        extents = np.einsum("gij,gj->gi", np.abs(self.rotation[standing]), self.half[standing])
        return (self._box_centers[standing] - extents).T, (self._box_centers[standing] + extents).T


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
    phase, reduced = task.phases[number], ReducedMargins()
    first, steps = sum(p.segments for p in task.phases[:number]), options.steps(CONTACT_WINDOW)
    last = first + phase.segments
    windows = {True: (first, first + steps), False: (last - steps, last)}
    for holds, begins in ((phase.released, True), (phase.grasps, False)):
        for hold in holds:
            is_hand = np.isin(part.labels, list(find_touch_links(scene, hold)))
            is_object = np.array([label.startswith(f"{hold.object}.") for label in part.labels])
            found = np.flatnonzero(is_hand[part.pairs[:, 0]] & is_object[part.pairs[:, 1]])
            for k in found.tolist():
                margin = _compute_hand_margin(scene, hold, part.labels[part.pairs[k, 1]], options)
                reduced.setdefault(k, []).append((*windows[begins], margin))
    reach = float(part.margins.max())
    for moving, shape, where, begins, may_overlap in itertools.chain(
        _find_supports(scene, chain, task, number, part), _find_touches(chain, task, number, part)
    ):
        nearby = part.find_static_near(reach, *compute_world_box(shape, where))
        for k in part.find_pairs(moving, nearby).tolist():
            other = part.shapes[int(part.pairs[k, 1])]
            distance = compute_shape_distance(shape, where, other.geometry, other.placement)
            margin = REDUCED_MARGIN_RATIO * max(distance, 0.0)
            if may_overlap and distance < -CONTACT_DEPTH:
                margin = distance
            if distance < part.margins[k]:
                reduced.setdefault(k, []).append((*windows[begins], margin))
    return reduced


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
    before = task.phases[number - 1].frames if number else ()
    goals = [(goal, False) for goal in task.phases[number].frames]
    for goal, begins in (*goals, *((goal, True) for goal in before)):
        if not goal.touches:
            continue
        point, where = coal.Sphere(1e-4), pin.SE3(np.eye(3), goal.placement.translation)
        joint, _ = chain.frame(goal.frame, goal.hold)
        for i in range(len(chain.collision.geometryObjects)):
            if part.labels[i] == str(goal) if goal.hold else part.shapes[i].parentJoint == joint:
                yield i, point, where, begins, False


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
            yield i, part.shapes[i].geometry, where, begins, may_overlap


def _find_lift_and_place_moments(
    scene: Scene, chain: VirtualKinematicChain, task: Task, number: int
) -> Iterator[tuple[Sequence[int], PlacedObject, bool]]:
    """Yield geometries, their object as placed, and whether it is lifted or placed then.

    These are the objects whose transport begins (True) or ends (False) in a phase. Transport of an
    object held at the start begins in the first phase.
    """
    phase = task.phases[number]
    at_start = {
        hold: scene.objects[hold.object].placement
        for hold in phase.held
        if number == 0 and hold in scene.holds
    }
    for moments, begins in ((at_start, True), (phase.lifted, True), (phase.lowered, False)):
        for hold, placement in moments.items():
            if not scene.objects[hold.object].object.free:
                continue
            placed = replace(scene.objects[hold.object], placement=placement)
            yield chain.held_geometries[hold], placed, begins
            for ride in phase.supported:
                if ride.hold == hold:
                    supported = _place_supported_object(scene, ride, placed)
                    yield chain.ride_geometries[ride], supported, begins
    for ride in phase.supported:
        carrier = scene.objects[ride.hold.object]
        if not carrier.object.free:
            goals = {
                name: float(np.clip(value, *find_joint_limits(carrier, name)))
                for name, value in phase.values.items()
                if name.partition(".")[0] == carrier.name
            }
            final_values = {**phase.initial_values, **goals}
            for state, begins in ((phase.initial_values, True), (final_values, False)):
                placed = _with_joint_positions(carrier, state)
                placed = _place_supported_object(scene, ride, placed)
                yield chain.ride_geometries[ride], placed, begins


def _place_supported_object(
    scene: Scene, ride: SupportedObject, carrier: PlacedObject
) -> PlacedObject:
    """Return the supported object, placed on its carrier."""
    return replace(
        scene.objects[ride.object],
        placement=carrier.link_placement(ride.link) * ride.placement_in_link,
    )


def _with_joint_positions(placed: PlacedObject, state: Mapping[str, float]) -> PlacedObject:
    """Return an object with those of the positions "<object>.<joint>" that are its own."""
    return placed.with_state(
        {c.partition(".")[2]: v for c, v in state.items() if c.partition(".")[0] == placed.name}
    )


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
        self.scene, self.chain, self.task, self.options = scene, chain, task, options
        self.first_waypoint = np.concatenate(
            [[0], np.cumsum([phase.segments for phase in task.phases])]
        )
        self._labels = [
            scene.robot.link_of(i) for i in range(len(scene.robot.collision.geometryObjects))
        ]
        held = [(hold.object, indices) for hold, indices in chain.held_geometries.items()]
        supported = [(ride.object, indices) for ride, indices in chain.ride_geometries.items()]
        for name, indices in (*held, *supported):
            self._labels += [
                f"{name}.{get_link_name(get_local_name(chain.collision.geometryObjects[i].name))}"
                for i in indices
            ]
        self._allowances = find_clearance_exemptions(scene, options.dist_safe)
        self._obstacles = scene.obstacles
        self._compute_boxes = (
            _compute_boxes([*chain.collision.geometryObjects]),
            _compute_boxes(self._obstacles),
        )

    def _pair_moving_shapes(
        self, phase: Phase, shapes: Sequence[pin.GeometryObject]
    ) -> tuple[list[tuple[int, int, float]], dict[str, tuple[int, ...]]]:
        """Return the pairs of the robot and the objects that it moves.

        Returns:
            Pairs of shapes with their margins [m], and attached or supported object → its shapes.
        """
        scene, chain, labels = self.scene, self.chain, self._labels
        margin = self.options.dist_safe
        pairs = [
            (*pair, own_margin)
            for pair, own_margin in scene.robot.own_margins(self.options.self_distance).items()
        ]
        attached_shapes: dict[str, tuple[int, ...]] = {}
        moving = list(range(len(scene.robot.collision.geometryObjects)))
        for hold in phase.held:
            attached_shapes[hold.object] = chain.held_geometries[hold]
            pairs += [
                (i, j, self._find_attached_margin(hold, labels[i], labels[j]))
                for i in moving
                for j in attached_shapes[hold.object]
            ]
            pairs += [
                (i, j, margin)
                for i, j in itertools.combinations(attached_shapes[hold.object], 2)
                if self._can_self_collide(hold.object, labels[i], labels[j])
            ]
            moving += attached_shapes[hold.object]
        for ride in phase.supported:
            attached_shapes[ride.object] = chain.ride_geometries[ride]
            # The object moves rigidly with geometry on these joints.
            same_joint = {shapes[j].parentJoint for j in attached_shapes[ride.object]}
            pairs += [
                (i, j, margin)
                for i in moving
                if shapes[i].parentJoint not in same_joint
                for j in attached_shapes[ride.object]
            ]
            moving += attached_shapes[ride.object]
        return pairs, attached_shapes

    def build_phase(self, number: int) -> PhaseGeometry:
        phase, scene, chain = self.task.phases[number], self.scene, self.chain
        holds = {hold.object: hold for hold in phase.held}
        shapes = list(chain.get_collision_geometry(phase.opening).geometryObjects)
        labels = list(self._labels)
        of_chain = self._compute_boxes[0] if phase.opening is None else _compute_boxes(shapes)
        robots = range(len(scene.robot.collision.geometryObjects))
        own = len(shapes)
        margin = self.options.dist_safe
        pairs, attached_shapes = self._pair_moving_shapes(phase, shapes)
        moving = [*robots, *itertools.chain.from_iterable(attached_shapes.values())]
        pairs = [pair for pair in pairs if np.isfinite(pair[2])]
        left: dict[str, tuple[int, ...]] = {}
        for name, placed in scene.objects.items():
            state = {
                c.removeprefix(f"{name}."): v
                for c, v in phase.initial_values.items()
                if c.startswith(f"{name}.")
            }
            if placed.object.free:
                if name in attached_shapes:
                    continue
                placed = replace(placed, placement=phase.resting.get(name, placed.placement))
            standing = make_world_shapes(placed.with_state(state))
            if name in attached_shapes:  # its static links; the others move with the hand
                held_shapes = {get_local_name(shapes[i].name) for i in attached_shapes[name]}
                standing = [shape for shape in standing if shape.name not in held_shapes]
            if name in phase.released_by:
                left[name] = tuple(range(len(shapes), len(shapes) + len(standing)))
            for shape in standing:
                label = f"{name}.{get_link_name(shape.name)}"
                others = [
                    i
                    for i in moving
                    if i not in attached_shapes.get(name, ())
                    or self._can_self_collide(name, labels[i], label)
                ]
                held = holds.get(name)  # the hand moves only some of its joints
                pairs += [
                    (
                        i,
                        len(shapes),
                        self._find_attached_margin(held, labels[i], label) if held else margin,
                    )
                    for i in others
                ]
                shape.name = f"{name}.{shape.name}"
                shapes.append(shape)
                labels.append(label)
        record_evaluations()
        free_shapes = {
            i
            for name, indices in attached_shapes.items()
            if scene.objects[name].object.free
            for i in indices
        }
        arm_shapes = {i for i in robots if shapes[i].parentJoint > 1}
        floor_movers = [i for i in moving if i in free_shapes | arm_shapes]
        with_obstacles = self._pair_with_obstacles(len(shapes), moving, floor_movers)
        table = np.concatenate([np.array(pairs).reshape(-1, 3), with_obstacles])
        labels += scene.obstacle_labels
        names = [shape.name for shape in shapes] + [shape.name for shape in self._obstacles]
        table, margin_regions = self._apply_exemptions(
            phase, table, labels, make_shape_keys(labels, names)
        )
        if not len(table):
            expected = "collision geometry in robot or scene"
            raise InputError(
                "no pair of geometries can collide", field=phase.name, expected=expected
            )
        boxes = zip(of_chain, _compute_boxes(shapes[own:]), self._compute_boxes[1], strict=True)
        center, half, rotation, translation = (np.concatenate(parts) for parts in boxes)
        shapes += self._obstacles
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
            released=left,
        )
        return replace(
            part,
            reduced_margins=find_reduced_margins(
                self.scene, self.chain, self.task, number, part, self.options
            ),
        )

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
        if not self._allowances:
            return table, []
        base = len(labels)
        pairs = table[:, :2].astype(int)
        own = pairs.min(axis=1) * base + pairs.max(axis=1)
        rows = {}
        for one in self._allowances:
            exempt = np.array(one.find_shape_pairs(labels, keys), int).reshape(-1, 2)
            rows[one] = np.flatnonzero(np.isin(own, exempt[:, 0] * base + exempt[:, 1]))
        for one in self._allowances:
            if not one.ranges:
                table[rows[one], 2] = np.minimum(table[rows[one], 2], one.margin)
        kept = np.isfinite(table[:, 2])
        place, margin_regions = np.where(kept, np.cumsum(kept) - 1, -1), []
        for one in self._allowances:
            exempt_pairs = place[rows[one]][kept[rows[one]]]
            resolved = self._resolve_ranges(phase, one.ranges)
            if one.ranges and len(exempt_pairs) and resolved is not None:
                margin = (
                    one.margin if one.margin < 0.0 else REDUCED_MARGIN_RATIO * max(one.nearest, 0.0)
                )
                margin_regions.append(MarginRegion(exempt_pairs, margin, *resolved))
        return table[kept], margin_regions

    def _resolve_ranges(
        self, phase: Phase, ranges: Mapping[str, tuple[float, float]]
    ) -> tuple[Ints, Floats, Floats] | None:
        """Return columns of the chain and their limits, shape (m,) each.

        Returns None if a coordinate that is not in the chain is outside its range.
        """
        columns, limits = list[int](), list[tuple[float, float]]()
        for name, (lower, upper) in ranges.items():
            if name in self.chain.names:
                columns.append(self.chain.index(name))
                limits.append((lower, upper))
                continue
            owner, _, joint = name.partition(".")
            placed = self.scene.objects[owner]
            value = phase.initial_values.get(
                name, float(placed.state[placed.object.coordinates.index(joint)])
            )
            if not lower <= value <= upper:
                return None
        low, high = np.array(limits).reshape(-1, 2).T
        return np.array(columns, int), low, high

    def _can_self_collide(self, name: str, first: str, second: str) -> bool:
        """Return whether two links of an object, given by labels, can collide."""
        return (
            frozenset(label.partition(".")[2] for label in (first, second))
            in self.scene.objects[name].object.own_pairs
        )

    def _pair_with_obstacles(
        self, first: int, moving: Sequence[int], floor_movers: Sequence[int]
    ) -> Floats:
        """Return the pairs of moving geometries with obstacles, and their margins, shape (P, 3).

        Only `floor_movers` are paired with the floor: wheels stand on it, and the gap below doors
        is as modelled.
        """
        ones, others = np.array(moving, int), np.arange(len(self._obstacles))
        is_floor = np.array([label == FLOOR for label in self.scene.obstacle_labels], bool)
        pairs = np.column_stack([np.tile(ones, len(others)), np.repeat(others, len(ones))])
        pairs = pairs[~is_floor[pairs[:, 1]] | np.isin(pairs[:, 0], floor_movers)]
        return np.column_stack(
            [pairs[:, 0], first + pairs[:, 1], np.full(len(pairs), self.options.dist_safe)]
        )


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
