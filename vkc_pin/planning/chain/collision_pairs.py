"""Selects the collision pairs of each phase of a task and their margins (eqs. 6 and 7)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.planning.chain.chain import VirtualKinematicChain
from vkc_pin.planning.chain.easing import REDUCED_MARGIN_RATIO, find_reduced_margins
from vkc_pin.planning.chain.phase_geometry import PhaseGeometry
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.utils.budget import record_evaluations
from vkc_pin.world.collision.margins import MarginRegion
from vkc_pin.world.models.shapes import compute_bounding_box, get_link_name, get_local_name
from vkc_pin.world.scene.clearance_exemptions import find_clearance_exemptions, make_shape_keys
from vkc_pin.world.scene.contact_rules import (
    CONTACT_DEPTH,
    compute_hand_clearance,
    find_grasped_link,
    find_touch_links,
    is_rigid_grasp,
)
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.obstacles import FLOOR
from vkc_pin.world.scene.placed_object import make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Phase, Task

__all__ = ["build_phase_geometries"]


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

    def build_phase(self, number: int) -> PhaseGeometry:
        phase, scene, chain = self.task.phases[number], self.scene, self.chain
        holds = {hold.object: hold for hold in phase.held}
        shapes, labels = (
            list(chain.get_collision_geometry(phase.opening).geometryObjects),
            list(self._labels),
        )
        of_chain = self._compute_boxes[0] if phase.opening is None else _compute_boxes(shapes)
        robots, own, margin = (
            range(len(scene.robot.collision.geometryObjects)),
            len(shapes),
            self.options.dist_safe,
        )
        pairs = [
            (*pair, own_margin)
            for pair, own_margin in scene.robot.own_margins(self.options.self_distance).items()
        ]
        moving, attached_shapes = list(robots), dict[str, tuple[int, ...]]()
        for hold in phase.held:
            attached_shapes[hold.object] = chain.held_geometries[hold]
            pairs += [
                (i, j, self._find_attached_margin(hold, labels[i], labels[j]))
                for i in moving
                for j in attached_shapes[hold.object]
            ]
            pairs += [
                (i, j, margin)
                for i, j in combinations(attached_shapes[hold.object], 2)
                if self._can_self_collide(hold.object, labels[i], labels[j])
            ]
            moving += attached_shapes[hold.object]
        for ride in phase.supported:
            attached_shapes[ride.object] = chain.ride_geometries[ride]
            same_joint = {
                shapes[j].parentJoint for j in attached_shapes[ride.object]
            }  # it moves rigidly with geometry on the same joint
            pairs += [
                (i, j, margin)
                for i in moving
                if shapes[i].parentJoint not in same_joint
                for j in attached_shapes[ride.object]
            ]
            moving += attached_shapes[ride.object]
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
                placed = dataclasses.replace(
                    placed, placement=phase.resting.get(name, placed.placement)
                )
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
        attached = {
            i
            for name, indices in attached_shapes.items()
            if scene.objects[name].object.free
            for i in indices
        }
        floor_movers = [
            i for i in moving if i in attached or (i in robots and shapes[i].parentJoint > 1)
        ]
        table = np.concatenate(
            [
                np.array(pairs).reshape(-1, 3),
                self._pair_with_obstacles(len(shapes), moving, floor_movers),
            ]
        )
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
        return dataclasses.replace(
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
            return compute_hand_clearance(self.scene, hold, link, self.options)
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
            exempt_pairs, resolved = (
                place[rows[one]][kept[rows[one]]],
                self._resolve_ranges(phase, one.ranges),
            )
            if one.ranges and len(exempt_pairs) and resolved is not None:
                margin = (
                    one.margin
                    if one.margin < 0.0
                    else REDUCED_MARGIN_RATIO * max(one.distance, 0.0)
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
