"""Who can hit whom in each phase of a task, and how close they may come: the pairs of eqs. 6 and 7."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.arrays import Floats
from vkc_pin.chain.chain import VirtualKinematicChain
from vkc_pin.chain.phase_geometry import PhaseGeometry
from vkc_pin.errors import InputError
from vkc_pin.models.shapes import bounding_box, link_name, own_name, shape_distance, world_box
from vkc_pin.options import Options
from vkc_pin.scene.hold import Hold
from vkc_pin.scene.obstacles import FLOOR
from vkc_pin.scene.placed import standing_geometry
from vkc_pin.scene.scene import Scene
from vkc_pin.task.phases import Phase, Task

__all__ = ["eased_pairs", "phase_geometries"]

EASED_TIME = 1.0  # [s] before and after a contact in which the shapes may be close, at `Options.dt` a waypoint
EASED_SHARE = 0.5  # margin, as a share of the distance at the contact itself


def phase_geometries(scene: Scene, chain: VirtualKinematicChain, task: Task, options: Options) -> list[PhaseGeometry]:
    """Return the geometry of every phase of a task, and the pairs that can collide in it.

    Args:
        scene: Robot, objects and obstacles.
        chain: The chain.
        task: What is held when.
        options: Which clearances to keep.

    Raises:
        InputError: In some phase nothing can collide with anything.
    """
    pairing = _Pairing(scene, chain, task, options)
    return [pairing.phase(number) for number in range(len(task.phases))]


class _Pairing:
    def __init__(self, scene: Scene, chain: VirtualKinematicChain, task: Task, options: Options) -> None:
        self.scene, self.chain, self.task, self.options = scene, chain, task, options
        self.first_waypoint = np.concatenate([[0], np.cumsum([phase.segments for phase in task.phases])])
        self._obstacles = tuple(scene.obstacles.geometryObjects)
        self._boxes = _boxes([*chain.collision.geometryObjects]), _boxes(self._obstacles)

    def phase(self, number: int) -> PhaseGeometry:
        phase, before = self.task.phases[number], self.task.phases[number - 1] if number else None
        scene, chain, robot, margin = self.scene, self.chain, self.scene.robot, self.options.dist_safe
        shapes = list(chain.collision.geometryObjects)
        robots, own = range(len(robot.collision.geometryObjects)), len(shapes)
        labels = [robot.link_of(i) for i in robots]
        for hold, indices in chain.held_geometries.items():
            labels += [f"{hold.object}.{link_name(own_name(shapes[i].name))}" for i in indices]
        pairs = [(pair.first, pair.second, margin) for pair in robot.collision.collisionPairs]
        moving = list(robots)
        for hold in phase.held:
            grasped, touching = self._grasped(hold), self._touching(hold)
            held = chain.held_geometries[hold]
            # The hand and what it grasps move together: nothing to plan there.
            pairs += [(i, j, margin) for i in moving for j in held if not (labels[i] in touching and labels[j] == grasped)]
            moving += held
        mine = {hold.object: chain.held_geometries[hold] for hold in phase.held}
        left: dict[str, tuple[int, ...]] = {}
        for name, placed in scene.objects.items():
            state = {c.removeprefix(f"{name}."): v for c, v in phase.before.items() if c.startswith(f"{name}.")}
            if placed.object.free:
                if name in mine:
                    continue
                placed = dataclasses.replace(placed, placement=phase.standing.get(name, placed.placement))
            standing = standing_geometry(placed.with_state(state))
            if name in mine:  # its frame stands on, the rest is in the hand
                held_shapes = {own_name(shapes[i].name) for i in mine[name]}
                standing = [shape for shape in standing if shape.name not in held_shapes]
            near = {  # what is held through something touches it; a hand's fingers are on both sides
                self._grasped(hold): (self._touching(hold), 0.0 if hold.by else self.options.grasp_clearance)
                for hold in (*phase.leaves, *phase.grasps)
                if hold.object == name
            }
            if name in phase.left:
                left[name] = tuple(range(len(shapes), len(shapes) + len(standing)))
            for shape in standing:
                label = f"{name}.{link_name(shape.name)}"
                close, least = near.get(label, ((), margin))
                pairs += [
                    (i, len(shapes), least if labels[i] in close else margin) for i in moving if i not in mine.get(name, ())
                ]
                shape.name = f"{name}.{shape.name}"
                shapes.append(shape)
                labels.append(label)
        attached = {i for hold in phase.held if scene.objects[hold.object].object.free for i in mine[hold.object]}
        above = [i for i in moving if i in attached or (i in robots and shapes[i].parentJoint > 1)]
        table = np.concatenate([np.array(pairs).reshape(-1, 3), self._with_obstacles(len(shapes), moving, above)])
        if not len(table):
            expected = "collision geometry in robot or scene"
            raise InputError("no pair of geometries can collide", field=phase.name, expected=expected)
        boxes = zip(self._boxes[0], _boxes(shapes[own:]), self._boxes[1], strict=True)
        center, half, rotation, translation = (np.concatenate(parts) for parts in boxes)
        shapes += self._obstacles
        part = PhaseGeometry(
            shapes=tuple(shapes),
            labels=(*labels, *scene.obstacle_labels),
            pairs=table[:, :2].astype(int),
            margins=table[:, 2],
            joint=np.array([shape.parentJoint for shape in shapes]),
            center=center,
            half=half,
            rotation=rotation,
            translation=translation,
            left=left,
        )
        first, steps = int(self.first_waypoint[number]), self.options.steps(EASED_TIME)
        return dataclasses.replace(part, eased=eased_pairs(scene, chain, phase, part, before=before, first=first, steps=steps))

    def _with_obstacles(self, first: int, moving: Sequence[int], above: Sequence[int]) -> Floats:
        """Return the pairs of what moves with the obstacles, the first of which is geometry `first`, and their margins.

        Of `moving`, only those that are `above` the floor can hit it: wheels stand on it, and doors hang above it as their
        makers hung them.
        """
        ones, others = np.array(moving, int), np.arange(len(self._obstacles))
        floor = np.array([label == FLOOR for label in self.scene.obstacle_labels], bool)
        pairs = np.column_stack([np.tile(ones, len(others)), np.repeat(others, len(ones))])
        pairs = pairs[~floor[pairs[:, 1]] | np.isin(pairs[:, 0], above)]
        return np.column_stack([pairs[:, 0], first + pairs[:, 1], np.full(len(pairs), self.options.dist_safe)])

    def _grasped(self, hold: Hold) -> str:
        """Return the label of the link that a hold takes hold of."""
        return f"{hold.object}.{self.scene.objects[hold.object].object.attachments[hold.attachment].link}"

    def _touching(self, hold: Hold) -> Collection[str]:
        """Return the labels of the links that take hold."""
        return self.scene.robot.touch_links if hold.frame is None else (hold.frame,)


def _boxes(shapes: Sequence[pin.GeometryObject]) -> tuple[Floats, ...]:
    """Return centres and half extents of bounding boxes, and placements as rotations and translations; see `PhaseGeometry`."""
    boxes = [bounding_box(shape) for shape in shapes]
    return (
        np.array([center for center, _ in boxes]).reshape(-1, 3),
        np.array([half for _, half in boxes]).reshape(-1, 3),
        np.array([shape.placement.rotation for shape in shapes]).reshape(-1, 3, 3),
        np.array([shape.placement.translation for shape in shapes]).reshape(-1, 3),
    )


def eased_pairs(
    scene: Scene, chain: VirtualKinematicChain, phase: Phase, part: PhaseGeometry, *, first: int, before: Phase | None, steps: int
) -> dict[int, list[tuple[int, int, float]]]:
    """Return pair → (first waypoint, last waypoint, margin [m]) for what may be close for a while.

    A free object rests on something where it is lifted from and where it is put down; a frame that touches a target may
    come close to what the target is on. The margin is half the distance at the contact.

    Args:
        scene: Where it happens.
        chain: The chain.
        phase: The phase.
        part: Its geometry and pairs.
        first: The waypoint at which the phase begins.
        before: The phase before it.
        steps: The waypoints of `EASED_TIME`.
    """
    shapes, last = part.shapes, first + phase.segments
    eased: dict[int, list[tuple[int, int, float]]] = {}

    def ease(moving: int, shape: coal.CollisionGeometry, where: pin.SE3, begin: int, end: int) -> None:
        """Ease the pairs of a geometry that moves with what stands next to a shape."""
        beside = part.within(float(part.margins.max()), *world_box(shape, where))
        for k in part.pairs_of(moving, beside).tolist():
            other = shapes[int(part.pairs[k, 1])]
            distance = shape_distance(shape, where, other.geometry, other.placement)
            if distance < part.margins[k]:
                eased.setdefault(k, []).append((begin, end, EASED_SHARE * max(distance, 0.0)))

    moments = [(h, p, first, first + steps) for h, p in phase.lifted.items()]
    moments += [(h, p, last - steps, last) for h, p in phase.lowered.items()]
    for hold, placement, begin, end in moments:
        placed = dataclasses.replace(scene.objects[hold.object], placement=placement)
        stands = {shape.name: shape.placement for shape in standing_geometry(placed)}
        for i in chain.held_geometries[hold]:
            ease(i, shapes[i].geometry, stands[own_name(shapes[i].name)], begin, end)
    touches = [(goal, last - steps, last) for goal in phase.frames]
    touches += [(goal, first, first + steps) for goal in (before.frames if before else ())]
    for goal, begin, end in touches:
        if not goal.touches:
            continue
        point, where = coal.Sphere(1e-4), pin.SE3(np.eye(3), goal.placement.translation)
        joint, _ = chain.frame(goal.frame, goal.hold)
        for i in range(len(chain.collision.geometryObjects)):
            if part.labels[i] == str(goal) if goal.hold else shapes[i].parentJoint == joint:
                ease(i, point, where, begin, end)
    return eased
