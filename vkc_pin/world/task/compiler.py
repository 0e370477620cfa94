"""Compiles steps to phases."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError, format_value
from vkc_pin.options import Options
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actuation import (
    find_blocking_latches,
    find_closing_latches,
    find_driven_coordinates,
    find_push_directions,
    find_shared_coordinate,
    list_driving_attachments,
)
from vkc_pin.world.task.configurations import check_pose_is_unambiguous, find_configuration
from vkc_pin.world.task.lookup import (
    check_link,
    compute_openings,
    find_attachment,
    find_joint_limits,
    find_object,
    find_path_joints,
    find_robot_frame,
    list_graspable_attachments,
)
from vkc_pin.world.task.phases import (
    FrameGoal,
    OpenAttachment,
    Phase,
    PhaseKind,
    StepBoundary,
    Task,
)
from vkc_pin.world.task.steps import (
    Actuate,
    Configure,
    GoTo,
    Grasp,
    Place,
    Reach,
    Release,
    Step,
    Touch,
    as_steps,
)
from vkc_pin.world.task.supported_objects import SupportTracker

LATCH_MARGIN = 0.02  # [rad] or [m] past the threshold at which a latch is released
LATCH_GAP = 1e-3  # [rad] or [m] outside the range of a latch, where a joint is still free


class _Compiler:
    """State of the task while its steps are compiled.

    Attributes:
        phases, holds: Phases and holds of the task so far.
        held: Holds at the end of the last phase.
        initial: Object coordinate → value at the start of the task.
        state: Object coordinate → value at the end of the last phase.
        resting: Free object → placement, for those not held.
        released_by: See `Phase`.
        step: Number of the step that is compiled, from 0.
        open: Hold → its attachment that no step names.
    """

    def __init__(self, scene: Scene, options: Options) -> None:
        self.scene, self.options = scene, options
        self.phases: list[Phase] = []
        self.held: tuple[Hold, ...] = scene.holds
        self.holds: list[Hold] = list(self.held)
        self.initial: dict[str, float] = {}
        self.state: dict[str, float] = {}
        self.resting = {
            n: p.placement
            for n, p in scene.objects.items()
            if p.object.free and n not in scene.held
        }
        self.released_by: dict[str, tuple[Hold, int]] = {}
        self.step = 0
        self.open: dict[Hold, OpenAttachment] = {}
        self.supports = SupportTracker(scene, self.resting)
        for hold in self.held:
            self._add_coordinates(scene.objects[hold.object], hold.attachment)
            self.supports.add_carried(hold, self.state, "held")

    def _add_coordinates(self, placed: PlacedObject, attachment: str) -> None:
        """Add the joints that a grasp can move to the coordinates, with their initial values."""
        for joint in find_path_joints(placed, placed.object.attachments[attachment]):
            value = float(placed.state[placed.object.coordinates.index(joint)])
            self.initial.setdefault(f"{placed.name}.{joint}", value)
            self.state.setdefault(f"{placed.name}.{joint}", value)

    def _append_motion(
        self,
        kind: PhaseKind,
        hold: Hold,
        where: str,
        values: dict[str, float],
        ranges: Mapping[str, tuple[float, float]],
    ) -> None:
        """Add a phase that moves joints of a fixed object, with all objects that rest on it."""
        self.supports.begin_motion(
            hold, {coordinate.partition(".")[2] for coordinate in ranges}, self.state, where
        )
        segments = self.options.move_waypoints if kind == "move" else self.options.turn_waypoints
        placed = self.scene.objects[hold.object]
        grasp = placed.object.attachments[hold.attachment]
        directions = find_push_directions(placed, grasp, self.state, values, f"{where}.joints")
        self._append(kind, tuple(values), segments, ranges=ranges, values=values, pushed=directions)
        self.supports.end_motion(self.state, where)

    def _append(
        self, kind: PhaseKind, about: tuple[str, ...], segments: int, **details: Any
    ) -> None:
        last = self.phases[-1] if self.phases else None
        before = (*last.held, *last.grasps) if last else self.scene.holds
        released = tuple(hold for hold in before if hold not in self.held)
        lifted = (
            {hold: last.resting[hold.object] for hold in last.grasps if hold.object in last.resting}
            if last
            else {}
        )
        phase = Phase(
            kind,
            about,
            segments,
            held=self.held,
            released=released,
            initial_values=dict(self.state),
            resting=dict(self.resting),
            released_by={
                name: how
                for name, how in self.released_by.items()
                if name not in self.supports.moved
            },
            lifted={hold: where for hold, where in lifted.items() if hold in self.held},
            supported=self.supports.supported,
            **details,
        )
        self.phases.append(phase)
        # A goal beyond a limit is approached as far as the limit.
        for coordinate, value in phase.values.items():
            lower, upper = find_joint_limits(
                self.scene.objects[coordinate.split(".", 1)[0]], coordinate
            )
            self.state[coordinate] = min(max(value, lower), upper)

    def _find_hold(self, name: str) -> Hold | None:
        return next((hold for hold in self.held if hold.object == name), None)

    def _release_fixed_objects(self) -> None:
        """Release all fixed objects, which the robot cannot carry along."""
        self.held = tuple(hold for hold in self.held if self.scene.objects[hold.object].object.free)

    def grasp(
        self, name: str, attachment_name: str | None, where: str, by: str | None = None
    ) -> Hold:
        """Add the phase that grasps an object, unless it is held; return the hold."""
        placed = find_object(self.scene, name, f"{where}.object")
        if attachment_name is not None:
            named = find_attachment(placed, attachment_name, f"{where}.attachment")
            return self._grasp_at([named.name], placed, where, by)
        fit = list_graspable_attachments(placed, by, f"{where}.attachment")
        known = (*self.held, *self.holds)
        used = [hold.attachment for hold in known if (hold.object, hold.frame) == (name, by)]
        return self._grasp_at(list(dict.fromkeys([*used[:1], *fit])), placed, where, by)

    def _grasp_at(
        self, attachments: Sequence[str], placed: PlacedObject, where: str, by: str | None = None
    ) -> Hold:
        """Grasp an object at the first of some attachments; the others are left open.

        An attachment that an earlier step has chosen is kept.
        """
        name = placed.name
        through = self._find_holder(by, name, f"{where}.by") if by is not None else None
        hold = Hold(name, attachments[0], *(through or (None, None)))
        same = next((one for one in self.held if one.nominal == hold.nominal), None)
        if same is not None:
            if same in self.open:
                kept = [other for other in self.open[same].others if other in attachments]
                self.open[same] = replace(self.open[same], others=tuple(kept))
            return same
        if (held := self._find_hold(name)) is not None and placed.object.free:
            raise InputError(
                f"'{name}' is held already, as {held}",
                field=where,
                expected="Release or Place before",
            )
        if through is None:
            self._release_fixed_objects()
            if self.held:
                kind = "the robot has one hand, and it holds"
                raise InputError(
                    f"{kind} {self.held[0]}",
                    field=f"{where}.object",
                    expected="Place or Release before",
                    got=name,
                )
        if not placed.object.free and through is not None:
            raise InputError(
                f"'{name}' is fixed in the world",
                field=f"{where}.by",
                expected="the hand itself",
                got=format_value(by),
            )
        if name in self.released_by:
            problem = f"the placement of '{name}' at this step is known only after planning"
            expected = "Place with a full pose before, or a second plan from where the first ends"
            raise InputError(problem, field=f"{where}.object", expected=expected)
        if any(one.object == name for one in self.supports.carried):
            problem = f"'{name}' rests on an object that the robot carries"
            raise InputError(problem, field=f"{where}.object", expected="Place or Release before")
        if not any(hold in phase.grasps for phase in self.phases):
            others = [other for other in placed.object.attachments if other in attachments[1:]]
            self.open[hold] = OpenAttachment(self.step, name, tuple(others))
        if hold not in self.holds:
            self._drop_unused_holds(hold)
            self.holds.append(hold)
        self._add_coordinates(placed, hold.attachment)
        about = (hold.object, hold.attachment, hold.frame or "")
        self._append("grasp", about, self.options.reach_waypoints, grasps=(hold,))
        self.held = (*self.held, hold)
        self.supports.add_carried(hold, self.state, where)
        self.resting.pop(name, None)
        return hold

    def _drop_unused_holds(self, hold: Hold) -> None:
        """Drop holds of the start that no phase uses and that move the joints of a new hold.

        A kinematic chain can contain these joints only once.
        """
        used = {*self.held, *(one for phase in self.phases for one in (*phase.held, *phase.grasps))}
        used_holds = [
            one
            for one in self.holds
            if one in used or find_shared_coordinate(self.scene, (one, hold)) is None
        ]
        if len(used_holds) < len(self.holds):
            self.holds = used_holds
            remaining = {
                name for one in used_holds for name in find_driven_coordinates(self.scene, one)
            }
            for values in (self.initial, self.state):
                for name in values.keys() - remaining:
                    del values[name]

    def _find_holder(self, frame: str, name: str, where: str) -> tuple[Hold, str]:
        """Return hold and link of `frame`, "<object>.<link>", which is to hold `name`."""
        owner, dot, link = str(frame).partition(".")
        if not dot:
            raise InputError(
                "not a link of an object",
                field=where,
                expected="<object>.<link>, e.g. stick.tip",
                got=format_value(frame),
            )
        placed = find_object(self.scene, owner, where)
        hold = self._find_hold(owner)
        if hold is None or not placed.object.free:
            held = (
                ", ".join(str(h) for h in self.held if self.scene.objects[h.object].object.free)
                or "nothing"
            )
            problem = (
                f"'{name}' cannot be grasped through '{owner}', which the robot does not carry"
            )
            raise InputError(
                problem,
                field=where,
                expected=f"a link of what it carries ({held})",
                got=format_value(frame),
            )
        check_link(placed, link, where)
        return hold, link

    def actuate(self, step: Actuate, where: str) -> None:
        placed = find_object(self.scene, step.object, f"{where}.object")
        if placed.object.free:
            problem = f"'{step.object}' is a free object: a hand cannot drive its joints"
            raise InputError(problem, field=f"{where}.object", expected="a fixed object")
        names = placed.object.coordinates.names
        for joint in step.joints:
            if joint not in names:
                raise UnknownNameError(
                    f"joint of '{step.object}'", joint, names, field=f"{where}.joints"
                )
        values = {f"{step.object}.{joint}": value for joint, value in step.joints.items()}
        used = [
            one.attachment
            for one in (*self.held, *reversed(self.holds))
            if one.object == step.object
        ]
        fit = list_driving_attachments(placed, step.attachment, used, self.state, values, where)
        hold = self._grasp_at(fit, placed, where)
        ranges = {coordinate: find_joint_limits(placed, coordinate) for coordinate in values}
        path = find_path_joints(placed, placed.object.attachments[hold.attachment])
        after: dict[str, float] = {}
        for latch in find_blocking_latches(placed, self.state, values):
            release = f"{step.object}.{latch.released_by}"
            if latch.released_by not in path:  # and it is past the threshold
                continue
            lower, upper = find_joint_limits(placed, release)
            turned = min(latch.threshold + LATCH_MARGIN, upper)
            if self.state[release] < turned:
                self._append_motion(
                    "turn", hold, where, {release: turned}, {release: (lower, upper)}
                )
            if values.get(release, upper) < turned:  # must wait until the latch has disengaged
                after[release] = values[release]
            ranges[release] = (turned, upper)
            values[release] = turned if release in after else values.get(release, turned)
        # Once a joint is in the range of its latch, it can only move on to the latched position.
        for latch in find_closing_latches(placed, self.state, values):
            name = f"{step.object}.{latch.joint}"
            (lower, upper), distance = ranges[name], self.state[name] - latch.held_at
            away = min(abs(distance), latch.engaged_within + LATCH_GAP)
            if distance > 0.0:
                ranges[name] = max(lower, latch.held_at + away), upper
            else:
                ranges[name] = lower, min(upper, latch.held_at - away)
        self._append_motion("move", hold, where, values, ranges)
        if after:
            limits = {release: find_joint_limits(placed, release) for release in after}
            self._append_motion("turn", hold, where, after, limits)

    def touch(self, step: Touch, where: str) -> None:
        """Add the phase that brings a frame to its target; free held objects are carried along."""
        owner, dot, link = str(step.frame).partition(".")
        hold = None
        if dot and owner in self.scene.objects:
            placed = self.scene.objects[owner]
            if not placed.object.free:
                problem = f"'{owner}' is fixed in the world and cannot be carried"
                expected = "a link of a free object, or a frame of the robot"
                raise InputError(problem, field=f"{where}.frame", expected=expected)
            check_link(placed, link, f"{where}.frame")
            hold = self._find_or_grasp(owner, step.attachment, where)
        elif dot and step.frame not in self.scene.robot.frame_names:
            raise UnknownNameError("object", owner, self.scene.objects, field=f"{where}.frame")
        elif owner in self.scene.objects and owner not in self.scene.robot.frame_names:
            links = self.scene.objects[owner].object.links
            expected = f"one of {', '.join(f'{owner}.{name}' for name in links)}"
            problem = "this is an object, not one of its links"
            raise InputError(problem, field=f"{where}.frame", expected=expected, got=owner)
        else:
            link = find_robot_frame(self.scene, step.frame, f"{where}.frame")
        if hold is None and step.attachment is not None:
            problem = f"'{step.frame}' is no link of an object that can be grasped"
            field, got = f"{where}.attachment", step.attachment
            raise InputError(problem, field=field, expected="no attachment", got=got)
        self._release_fixed_objects()
        point = not isinstance(step.target, pin.SE3)
        target = pin.SE3(np.eye(3), np.array(step.target)) if point else step.target
        if hold is not None and not point:
            self._check_level(hold, link, target, f"{where}.target")
        goal = FrameGoal(link, target, "point" if point else "pose", hold, touches=True)
        self._append("touch", (step.frame,), self.options.reach_waypoints, frames=(goal,))

    def place(self, step: Place, where: str) -> None:
        """Add the phases that bring an object to its goal and release it there."""
        placed = find_object(self.scene, step.object, f"{where}.object")
        if not placed.object.free:
            problem = f"'{step.object}' is fixed in the world"
            raise InputError(problem, field=f"{where}.object", expected="a free object")
        hold = self._find_or_grasp(step.object, step.attachment, where)
        upright = not isinstance(step.pose, pin.SE3)
        # As it rests now; an object held from the start, with its z axis up.
        rotation = np.eye(3) if step.object in self.scene.held else placed.placement.rotation
        pose = pin.SE3(rotation, np.array(step.pose)) if upright else step.pose
        self._check_level(hold, placed.object.base_link, pose, f"{where}.pose")
        goal = FrameGoal(placed.object.base_link, pose, "upright" if upright else "pose", hold)
        about, count = (step.object,), self.options.reach_waypoints
        self._append("place", about, count, frames=(goal,), lowered={hold: pose})
        self._release(hold, pose, nearly=upright)

    def _find_or_grasp(self, name: str, attachment: str | None, where: str) -> Hold:
        """Return the present hold of a free object, which is grasped if there is none."""
        hold = self._find_hold(name) or self.grasp(name, attachment, where)
        if attachment not in (None, hold.attachment):
            field, expected = f"{where}.attachment", hold.attachment
            problem = "it is held elsewhere"
            raise InputError(problem, field=field, expected=expected, got=attachment)
        return hold

    def _check_level(self, hold: Hold, link: str, goal: pin.SE3, where: str) -> None:
        """Check that no object on a carried one would tilt with `link` at a goal."""
        placed = self.scene.objects[hold.object]
        local = placed.object.link_placement(link, placed.state)
        self.supports.check_level(hold, goal * local.inverse(), where)

    def release(self, step: Release, where: str) -> None:
        """Release one object, or all."""
        if not self.held:
            raise InputError(
                "the hand is empty", field=where, expected="something held", got=format_value(step)
            )
        if step.object is not None and self._find_hold(step.object) is None:
            held = [hold.object for hold in self.held]
            raise UnknownNameError("held object", step.object, held, field=f"{where}.object")
        released: list[Hold] = []  # with what is held through them, which is released first
        for hold in self.held:
            if step.object in (None, hold.object) or hold.by in released:
                released.insert(0, hold)
        if not (has_moved := bool(self.phases)):
            objects = self.scene.objects
            lowered = {
                hold: objects[hold.object].placement
                for hold in released
                if objects[hold.object].object.free
            }
            self._append("stand", (), self.options.turn_waypoints, lowered=lowered)
        for hold in released:
            if hold in self.held:
                self._release(hold, self.scene.objects[hold.object].placement, nearly=has_moved)

    def _release(self, hold: Hold, where: pin.SE3, *, nearly: bool = True) -> None:
        """Remove a hold, and the holds through it.

        If `nearly`, the motion decides where exactly the object rests.
        """
        for other in [h for h in self.held if h.by == hold]:
            self._release(other, self.scene.objects[other.object].placement)
        self.held = tuple(h for h in self.held if h != hold)
        if self.scene.objects[hold.object].object.free:
            self.resting[hold.object] = where
            supported = self.supports.release_carried(hold, where)
            if nearly:
                self.released_by |= dict.fromkeys(
                    (hold.object, *supported), (hold, len(self.phases) - 1)
                )

    def add(self, step: Step, where: str) -> None:
        own: dict[type, Callable[[Any, str], None]]
        own = {Actuate: self.actuate, Touch: self.touch, Place: self.place, Release: self.release}
        if type(step) in own:
            own[type(step)](step, where)
        elif isinstance(step, Grasp):
            self.grasp(step.object, step.attachment, where, step.by)
        elif isinstance(step, Reach):
            check_pose_is_unambiguous(self.scene, step, f"{where}.pose")
            frame = find_robot_frame(self.scene, step.frame, f"{where}.frame")
            self._release_fixed_objects()
            goals = (FrameGoal(frame, step.pose),)
            self._append("reach", (frame,), self.options.reach_waypoints, frames=goals)
        elif isinstance(step, Configure):
            configuration = find_configuration(self.scene, step, where)
            self._release_fixed_objects()
            self._append("configure", (), self.options.reach_waypoints, configuration=configuration)
        elif isinstance(step, GoTo):
            self._release_fixed_objects()
            base = zip(self.scene.robot.coordinates.names, (step.x, step.y, step.yaw), strict=False)
            goal = {name: (value, value) for name, value in base if value is not None}
            self._append("go", (), self.options.reach_waypoints, configuration=goal)


def compile_task(
    scene: Scene, steps: Sequence[Step], options: Options, *, nothing: bool = False, first: int = 0
) -> Task:
    """Compile steps to phases, beginning at the scene's start."""
    steps = as_steps(steps)
    compiler, marks = _Compiler(scene, options), list[StepBoundary]()
    for index, step in enumerate(steps):
        compiler.step = index
        compiler.add(step, f"steps[{first + index}]")
        phases, holds = len(compiler.phases), len(compiler.holds)
        marks.append(StepBoundary(phases, holds, len(compiler.initial), compiler.held))
    if not compiler.phases and not nothing:
        raise make_nothing_to_do_error()
    # Objects that are grasped later keep their initial values until then.
    initial, found = compiler.initial, list[Phase]()
    openings = compute_openings(scene, compiler.phases)
    for phase, opening in zip(compiler.phases, openings, strict=True):
        known = {name: value for name, value in phase.initial_values.items() if name in initial}
        found.append(replace(phase, initial_values={**initial, **known}, opening=opening))
    every = tuple(compiler.holds)
    left_open = tuple(one for one in compiler.open.values() if one.others)
    return Task(steps, tuple(found), every, initial, compiler.held, tuple(marks), left_open)


def make_nothing_to_do_error() -> InputError:
    """Return the error for steps that change nothing."""
    expected, got = "a step that changes something", "only steps that are done already"
    return InputError("there is nothing to do", field="steps", expected=expected, got=got)
