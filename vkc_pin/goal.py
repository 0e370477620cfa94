"""Turns steps into phases: what is held when, which joints move, and what must hold at the end (f_task of eq. 3)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import pinocchio as pin

from vkc_pin.articulation import Attachment
from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.options import Options
from vkc_pin.scene import PlacedObject, Scene
from vkc_pin.steps import Actuate, GoTo, Grasp, Reach, Step

__all__ = ["FrameGoal", "Phase", "Task", "compile_task"]

LATCH_MARGIN = 0.02  # [rad] or [m] past the threshold at which a latch lets go


@dataclass(frozen=True)
class FrameGoal:
    """A frame of the robot at a placement in the world."""

    frame: str
    placement: pin.SE3


@dataclass(frozen=True)
class Phase:
    """A stretch of the motion in which the same things are held.

    Attributes:
        name: What happens in it.
        segments: Steps of time; the phase has `segments + 1` waypoints, the first shared with the phase before.
        held: Object → attachment.
        ranges: Object coordinate → (lower, upper) for every waypoint after the first; all others stand still.
        values: Object coordinate → value at the last waypoint.
        frames: Frame goals at the last waypoint.
        base: (x, y, yaw or None) at the last waypoint, in the world.
        grasps: Objects (→ attachment) that are grasped at the last waypoint.
        leaves: Objects (→ attachment) that were let go of just before.
        before: Object coordinate → value at the first waypoint, for the joints that this task's grasps can move.
    """

    name: str
    segments: int
    held: Mapping[str, str] = field(default_factory=dict)
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)
    frames: tuple[FrameGoal, ...] = ()
    base: tuple[float, float, float | None] | None = None
    grasps: Mapping[str, str] = field(default_factory=dict)
    leaves: Mapping[str, str] = field(default_factory=dict)
    before: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Task:
    """What the steps ask for, in phases.

    Attributes:
        steps: The user's steps.
        phases: In order; at least one.
        grasps: Object → attachment, for every object that is held at any time.
        state: Object coordinate (`<object>.<joint>`) → value at the start, for the joints that `grasps` can move.
    """

    steps: tuple[Step, ...]
    phases: tuple[Phase, ...]
    grasps: Mapping[str, str]
    state: Mapping[str, float]

    @property
    def segments(self) -> int:
        """Steps of time of the whole task; it has one waypoint more."""
        return sum(phase.segments for phase in self.phases)


def _placed(scene: Scene, name: str, field_name: str) -> PlacedObject:
    if name not in scene.objects:
        raise UnknownNameError("object", name, scene.objects, field=field_name)
    return scene.objects[name]


def _attachment(placed: PlacedObject, name: str | None, field_name: str) -> Attachment:
    attachments = placed.object.attachments
    if name is None:
        if not attachments:
            raise InputError(f"object '{placed.name}' has no attachment, so it cannot be grasped", field=field_name)
        return next(iter(attachments.values()))
    if name not in attachments:
        raise UnknownNameError(f"attachment of '{placed.name}'", name, attachments, field=field_name)
    return attachments[name]


def path_joints(placed: PlacedObject, attachment: Attachment) -> list[str]:
    """Return the names of the object's joints between its base and the attachment's link, base first."""
    model = placed.object.model
    joint = model.frames[model.getFrameId(attachment.link, pin.FrameType.BODY)].parentJoint
    names: list[str] = []
    while joint:
        names.insert(0, str(model.names[joint]))
        joint = model.parents[joint]
    return names


class _Compiler:
    def __init__(self, scene: Scene, options: Options) -> None:
        self.scene, self.options = scene, options
        self.phases: list[Phase] = []
        self.held: dict[str, str] = dict(scene.held)
        self.grasps: dict[str, str] = dict(scene.held)
        self.initial: dict[str, float] = {}
        self.state: dict[str, float] = {}
        for name, attachment in self.grasps.items():
            if scene.objects[name].object.free:
                raise InputError(
                    f"'{name}' is held and would have to be carried, which is not possible yet",
                    field=f"scene.held.{name}",
                    expected="objects that stand fixed in the world",
                )
            self._enter(scene.objects[name], attachment)

    def _enter(self, placed: PlacedObject, attachment: str) -> None:
        """Make the joints that a grasp can move coordinates of the task, with the values they have at its start."""
        for joint in path_joints(placed, placed.object.attachments[attachment]):
            value = float(placed.state[placed.object.coordinates.index(joint)])
            self.initial.setdefault(f"{placed.name}.{joint}", value)
            self.state.setdefault(f"{placed.name}.{joint}", value)

    def _append(self, name: str, segments: int, **details: Any) -> None:
        before = {**self.phases[-1].held, **self.phases[-1].grasps} if self.phases else self.scene.held
        leaves = {key: value for key, value in before.items() if key not in self.held}
        self.phases.append(Phase(name, segments, held=dict(self.held), leaves=leaves, before=dict(self.state), **details))
        for coordinate, value in details.get("values", {}).items():  # a goal beyond a limit is approached as far as it goes
            lower, upper = self._limits(self.scene.objects[coordinate.split(".", 1)[0]], coordinate)
            self.state[coordinate] = min(max(value, lower), upper)

    def grasp(self, name: str, attachment_name: str | None, where: str) -> str:
        """Add the phase that takes hold of an object, unless it is held; return the attachment."""
        placed = _placed(self.scene, name, f"{where}.object")
        attachment = _attachment(placed, attachment_name or self.grasps.get(name), f"{where}.attachment")
        if self.held.get(name) == attachment.name:
            return attachment.name
        if placed.object.free:
            raise InputError(f"'{name}' stands free; only what is fixed in the world can be grasped", field=f"{where}.object")
        if self.grasps.get(name, attachment.name) != attachment.name:
            raise InputError(
                f"object '{name}' is grasped by two different attachments in one plan",
                field=f"{where}.attachment",
                expected=self.grasps[name],
                got=attachment.name,
            )
        self.grasps[name] = attachment.name
        self._enter(placed, attachment.name)
        self.held = {}  # one hand: whatever it held before is let go
        self._append(f"reach {name}.{attachment.name}", self.options.reach_waypoints, grasps={name: attachment.name})
        self.held = {name: attachment.name}
        return attachment.name

    def actuate(self, step: Actuate, where: str) -> None:
        placed = _placed(self.scene, step.object, f"{where}.object")
        names = placed.object.coordinates.names
        for joint in step.joints:
            if joint not in names:
                raise UnknownNameError(f"joint of '{step.object}'", joint, names, field=f"{where}.joints")
        attachment = placed.object.attachments[self.grasp(step.object, step.attachment, where)]
        path = path_joints(placed, attachment)
        for joint in step.joints:
            if joint not in path:
                raise InputError(
                    f"joint '{joint}' does not move when '{step.object}' is held at '{attachment.name}'",
                    field=f"{where}.joints",
                    expected=f"one of {', '.join(path)}" if path else "an attachment that moves with it",
                )
        values = {f"{step.object}.{joint}": value for joint, value in step.joints.items()}
        ranges = {coordinate: self._limits(placed, coordinate) for coordinate in values}
        after: dict[str, float] = {}  # what must wait until the latch is left behind
        for latch in placed.object.latches:
            held, release = f"{step.object}.{latch.joint}", f"{step.object}.{latch.released_by}"
            if held not in values or values[held] == self.state[held]:
                continue
            if abs(self.state[held] - latch.held_at) > latch.engaged_within:
                continue
            if latch.released_by not in path:
                if placed.state[names.index(latch.released_by)] >= latch.threshold:
                    continue
                raise InputError(
                    f"'{latch.joint}' is latched, and '{latch.released_by}', which releases it, does not move when "
                    f"'{step.object}' is held at '{attachment.name}'",
                    field=f"{where}.attachment",
                    expected=f"an attachment that moves '{latch.released_by}'",
                )
            lower, upper = self._limits(placed, release)
            turned = min(latch.threshold + LATCH_MARGIN, upper)
            if self.state[release] < turned:
                self._append(
                    f"turn {release}", self.options.turn_waypoints, ranges={release: (lower, upper)}, values={release: turned}
                )
            if values.get(release, upper) < turned:
                after[release] = values[release]
            ranges[release] = (turned, upper)
            values[release] = turned if release in after else values.get(release, turned)
        self._append(f"move {', '.join(values)}", self.options.move_waypoints, ranges=ranges, values=values)
        if after:
            limits = {release: self._limits(placed, release) for release in after}
            self._append(f"turn {', '.join(after)}", self.options.turn_waypoints, ranges=limits, values=after)

    def _limits(self, placed: PlacedObject, coordinate: str) -> tuple[float, float]:
        index = placed.object.coordinates.names.index(coordinate.split(".", 1)[1])
        return float(placed.object.lower[index]), float(placed.object.upper[index])

    def add(self, step: Step, where: str) -> None:
        if isinstance(step, Grasp):
            self.grasp(step.object, step.attachment, where)
        elif isinstance(step, Actuate):
            self.actuate(step, where)
        elif isinstance(step, Reach):
            frame = step.frame or self.scene.robot.tool_frame
            frames = [f.name for f in self.scene.robot.model.frames]
            if frame not in frames:
                raise UnknownNameError("frame of the robot", frame, frames, field=f"{where}.frame")
            self.held = {}  # an articulated object cannot come along
            self._append(f"reach with {frame}", self.options.reach_waypoints, frames=(FrameGoal(frame, step.pose),))
        elif isinstance(step, GoTo):
            self.held = {}
            self._append("go to", self.options.reach_waypoints, base=(step.x, step.y, step.yaw))
        else:
            raise InputError("not a step", field=where, expected="Reach, Grasp, Actuate or GoTo", got=repr(step))


def compile_task(scene: Scene, steps: Sequence[Step], options: Options) -> Task:
    """Return the phases that bring about `steps`, beginning at the scene's start.

    Raises:
        InputError: No steps, an unknown object, joint, attachment or frame, or a joint that cannot be moved that way.
    """
    if isinstance(steps, Reach | Grasp | Actuate | GoTo):
        raise InputError("one step alone", field="steps", expected="a list of steps", got=repr(steps))
    try:
        steps = tuple(steps)
    except TypeError:
        raise InputError("not steps", field="steps", expected="a list of steps", got=repr(steps)) from None
    if not steps:
        raise InputError("there is nothing to do", field="steps", expected="at least one step", got="an empty list")
    compiler = _Compiler(scene, options)
    for index, step in enumerate(steps):
        compiler.add(step, f"steps[{index}]")
    if not compiler.phases:
        expected, got = "a step that changes something", "only what holds already"
        raise InputError("there is nothing to do", field="steps", expected=expected, got=got)
    # Objects that are grasped later stand as they are at the start until then.
    phases = tuple(replace(phase, before={**compiler.initial, **phase.before}) for phase in compiler.phases)
    return Task(tuple(steps), phases, compiler.grasps, compiler.initial)
