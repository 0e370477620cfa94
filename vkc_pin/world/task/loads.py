"""Checks that objects do not fall where they are released, and are not too heavy to carry."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.shapes import compute_world_box, get_link_name
from vkc_pin.world.scene.footing import Footing, LabelledShape, find_footing
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.placed_object import PlacedObject, make_world_shapes
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.scene.support import RESTING_DISTANCE
from vkc_pin.world.task.phases import Phase, Task
from vkc_pin.world.task.supported_objects import place_objects

_HEADINGS = 16  # of an object whose heading at the goal is free
_SAME_PLACE = 1e-3  # [m] and [rad] within which an object is put back where it was


def check_footings(scene: Scene, tasks: Sequence[Task]) -> None:
    """Check that every free object rests on something where it is released.

    A placement that only the motion decides is left to the validation of the motion, as is that of
    an object that is put down where such an object may be. An object may be put back where the
    scene has it.

    Args:
        scene: Scene in which the first task starts.
        tasks: Consecutive tasks.

    Raises:
        InputError: An object would fall or tip over, and its step does not say `unsupported`.
    """
    turned = set[str]()  # objects whose heading is unknown
    lost = set[str]()  # objects whose placement is unknown
    number = 0
    for task in tasks:
        for boundary, (step, phases) in enumerate(_divide_by_step(task)):
            is_allowed = getattr(step, "unsupported", False)
            for phase in phases:
                # Later, an object is released wherever the motion has brought it.
                is_known = phase.kind != "stand" or number == 0
                if is_known and not is_allowed and not lost:
                    _check_lowered(scene, phase, turned, f"steps[{number}]")
            released = _list_released(scene, task, boundary, phases)
            exact = _list_goals(phases, "pose")
            upright = _list_goals(phases, "upright")
            turned = (turned | (released & upright)) - exact
            lost = (lost | (released - upright)) - exact - upright
            number += 1


def _check_lowered(scene: Scene, phase: Phase, turned: set[str], where: str) -> None:
    """Check that the objects that are put down in a phase rest on something.

    Args:
        scene: Scene in which the first task starts.
        phase: The phase.
        turned: Objects whose headings are unknown; an object near them may rest on them.
        where: Field of the step, for the error.
    """
    for hold, pose in phase.lowered.items():
        if _is_put_back(scene, hold, pose):
            continue
        footing = _find_best_footing(scene, phase, hold, pose)
        # Planning explains overlaps of an object at its goal better.
        is_fine = footing.is_stable() or footing.is_blocked
        if not is_fine and not _is_near(scene, phase, hold, pose, turned):
            raise _make_error(hold.object, footing, where)


def _list_goals(phases: Sequence[Phase], kind: str) -> set[str]:
    """Return the objects that are put down at a goal of a kind, "pose" or "upright"."""
    found = set[str]()
    for phase in phases:
        for goal in phase.frames:
            if goal.hold is not None and goal.hold in phase.lowered and goal.kind == kind:
                found.add(goal.hold.object)
    return found


def _divide_by_step(task: Task) -> Iterator[tuple[object, tuple[Phase, ...]]]:
    """Yield every step of a task with its phases."""
    first = 0
    for step, boundary in zip(task.steps, task.boundaries, strict=True):
        yield step, task.phases[first : boundary.phases]
        first = boundary.phases


def _list_released(scene: Scene, task: Task, number: int, phases: Sequence[Phase]) -> set[str]:
    """Return the free objects that a step releases, without those on them."""
    held = {*(task.boundaries[number - 1].after if number else scene.holds)}
    for phase in phases:
        held.update(phase.held, phase.grasps)
    released = held - {*task.boundaries[number].after}
    return {hold.object for hold in released if scene.objects[hold.object].object.free}


def _is_near(scene: Scene, phase: Phase, hold: Hold, pose: pin.SE3, others: set[str]) -> bool:
    """Return whether an object may touch one of others, whose headings are unknown."""
    own = _Cylinder.around(scene.objects[hold.object], pose)
    for name in others & phase.resting.keys():
        other = _Cylinder.around(scene.objects[name], phase.resting[name])
        if own.touches(other):
            return True
    return False


class _Cylinder(NamedTuple):
    """An upright cylinder around an object at any heading: axis (x, y), radius, and height [m]."""

    axis: Floats
    radius: float
    low: float
    high: float

    @classmethod
    def around(cls, placed: PlacedObject, pose: pin.SE3) -> _Cylinder:
        """Return the cylinder about the origin of the base link at a pose."""
        shapes = make_world_shapes(replace(placed, placement=pose))
        # Lower and upper corners of the shapes, shape (n, 2, 3).
        boxes = np.array([compute_world_box(one.geometry, one.placement) for one in shapes])
        axis = pose.translation[:2]
        farthest_corners = np.abs(boxes[:, :, :2] - axis).max(axis=1)
        radius = np.linalg.norm(farthest_corners, axis=1).max()
        low = boxes[:, 0, 2].min()
        high = boxes[:, 1, 2].max()
        return cls(axis, float(radius), float(low), float(high))

    def touches(self, other: _Cylinder) -> bool:
        """Return whether two cylinders are closer than an object is to its support."""
        gap = float(np.linalg.norm(self.axis - other.axis)) - self.radius - other.radius
        height = max(self.low - other.high, other.low - self.high)
        return max(gap, height) < RESTING_DISTANCE


def _is_put_back(scene: Scene, hold: Hold, pose: pin.SE3) -> bool:
    """Return whether an object ends where it is at the start of the scene, at any heading."""
    if hold.object in scene.held:
        return False
    before = scene.objects[hold.object].placement
    shift = float(np.linalg.norm(pose.translation - before.translation))
    tilt = float(np.linalg.norm(np.cross(pose.rotation[2], before.rotation[2])))
    is_same_side = float(pose.rotation[2] @ before.rotation[2]) > 0.0
    return shift <= _SAME_PLACE and tilt <= _SAME_PLACE and is_same_side


def _find_best_footing(scene: Scene, phase: Phase, hold: Hold, pose: pin.SE3) -> Footing:
    """Return how an object stands where a phase ends; if its heading is free, at the best one."""
    name = hold.object
    state = {**phase.initial_values, **phase.values}
    others = list[LabelledShape]()
    for other, placed in place_objects(scene, state, phase.resting).items():
        if other != name:
            for shape in make_world_shapes(placed):
                others.append((f"{other}.{get_link_name(shape.name)}", shape))
    others += zip(scene.obstacle_labels, scene.obstacles, strict=True)
    is_free = any(goal.hold == hold and goal.kind == "upright" for goal in phase.frames)
    headings = 2.0 * np.pi * np.arange(_HEADINGS if is_free else 1) / _HEADINGS
    found = list[Footing]()
    for heading in headings:
        rotation = pin.exp3(np.array([0.0, 0.0, heading])) @ pose.rotation
        placed = replace(scene.objects[name], placement=pin.SE3(rotation, pose.translation))
        load = list(_place_load(scene, phase, hold, placed))
        footing = find_footing(placed, others, load)
        if footing.is_stable():
            return footing
        found.append(footing)
    return found[0]


def _make_error(name: str, footing: Footing, where: str) -> InputError:
    problem = f"'{name}' would not stay where it is released: {footing}"
    expected = "a pose at which it rests on something, or the step with unsupported=True"
    return InputError(problem, field=where, expected=expected)


def _place_load(
    scene: Scene, phase: Phase, hold: Hold, placed: PlacedObject
) -> Iterator[PlacedObject]:
    """Yield the objects that rest on a held object, which is `placed` somewhere."""
    for one in phase.supported:
        if one.hold == hold:
            pose = placed.link_placement(one.link) * one.placement_in_link
            yield replace(scene.objects[one.object], placement=pose)


def check_loads(scene: Scene, tasks: Iterable[Task], options: Options) -> None:
    """Check that the robot carries no more than its description allows.

    Raises:
        InputError: Held objects, with those that rest on them, have more than
            `Options.payload_factor` times the robot's payload.
    """
    payload = scene.robot.payload
    if payload is None:
        return
    max_mass = payload * options.payload_factor
    number = 0
    for task in tasks:
        for _, phases in _divide_by_step(task):
            for phase in phases:
                names = _list_carried_objects(scene, phase)
                mass = sum(scene.objects[name].object.mass for name in names)
                if mass > max_mass:
                    objects = " and ".join(f"'{name}'" for name in names)
                    raise InputError(
                        f"the hand would carry {mass:.3g} kg, {objects}",
                        field=f"steps[{number}]",
                        expected=f"at most {max_mass:.3g} kg, the payload of '{scene.robot.name}', "
                        "or a larger Options.payload_factor",
                    )
            number += 1


def _list_carried_objects(scene: Scene, phase: Phase) -> list[str]:
    """Return the free objects that the hand carries in a phase, or grasps at its end."""
    holds = [*phase.held, *phase.grasps]
    held = [hold.object for hold in holds if scene.objects[hold.object].object.free]
    resting = [one.object for one in phase.supported if one.hold.object in held]
    return list(dict.fromkeys([*held, *resting]))
