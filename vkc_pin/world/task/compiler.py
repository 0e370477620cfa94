"""Compiles steps to phases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from vkc_pin.world.task.configurations import (
    check_pose_is_unambiguous,
    find_configuration,
    find_end_velocities,
)
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
        self.scene = scene
        self.options = options
        self.phases: list[Phase] = []
        self.held: tuple[Hold, ...] = scene.holds
        self.holds: list[Hold] = list(self.held)
        self.initial: dict[str, float] = {}
        self.state: dict[str, float] = {}
        self.resting: dict[str, pin.SE3] = {}
        for name, placed in scene.objects.items():
            if placed.object.free and name not in scene.held:
                self.resting[name] = placed.placement
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
        joints = {coordinate.partition(".")[2] for coordinate in ranges}
        self.supports.begin_motion(hold, joints, self.state, where)
        segments = self.options.move_waypoints if kind == "move" else self.options.turn_waypoints
        placed = self.scene.objects[hold.object]
        grasp = placed.object.attachments[hold.attachment]
        directions = find_push_directions(placed, grasp, self.state, values, f"{where}.joints")
        self._append(kind, tuple(values), segments, ranges=ranges, values=values, pushed=directions)
        self.supports.end_motion(self.state, where)

    def _append(
        self, kind: PhaseKind, about: tuple[str, ...], segments: int, **details: Any
    ) -> None:
        """Add a phase to the state of the task, and bring the state to the end of the phase."""
        before = self.scene.holds
        lifted = dict[Hold, pin.SE3]()  # free objects that the last phase grasped
        if self.phases:
            last = self.phases[-1]
            before = (*last.held, *last.grasps)
            for hold in last.grasps:
                if hold.object in last.resting and hold in self.held:
                    lifted[hold] = last.resting[hold.object]
        released_by = dict(self.released_by)
        for name in self.supports.moved:
            released_by.pop(name, None)
        phase = Phase(
            kind,
            about,
            segments,
            held=self.held,
            released=tuple(hold for hold in before if hold not in self.held),
            initial_values=dict(self.state),
            resting=dict(self.resting),
            released_by=released_by,
            lifted=lifted,
            supported=self.supports.supported,
            **details,
        )
        self.phases.append(phase)
        # A goal beyond a limit is approached as far as the limit.
        for coordinate, value in phase.values.items():
            name, _, _ = coordinate.partition(".")
            lower, upper = find_joint_limits(self.scene.objects[name], coordinate)
            self.state[coordinate] = min(max(value, lower), upper)

    def _find_hold(self, name: str) -> Hold | None:
        for hold in self.held:
            if hold.object == name:
                return hold
        return None

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
        # The attachment at which the task has grasped the object already is preferred.
        for hold in (*self.held, *self.holds):
            if hold.object == name and hold.frame == by:
                fit = list(dict.fromkeys([hold.attachment, *fit]))
                break
        return self._grasp_at(fit, placed, where, by)

    def _grasp_at(
        self, attachments: Sequence[str], placed: PlacedObject, where: str, by: str | None = None
    ) -> Hold:
        """Grasp an object at the first of some attachments; the others are left open.

        An attachment that an earlier step has chosen is kept.
        """
        name = placed.name
        if by is None:
            hold = Hold(name, attachments[0])
        else:
            carrier, link = self._find_holder(by, name, f"{where}.by")
            hold = Hold(name, attachments[0], carrier, link)
        for same in self.held:
            if same.nominal == hold.nominal:
                if same in self.open:
                    open_attachment = self.open[same]
                    others = [other for other in open_attachment.others if other in attachments]
                    self.open[same] = replace(open_attachment, others=tuple(others))
                return same
        self._prepare_grasp(placed, by, where)
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

    def _prepare_grasp(self, placed: PlacedObject, by: str | None, where: str) -> None:
        """Check that an object can be grasped now, after the hand has released fixed objects.

        A held object that grasps, `by`, leaves the other holds as they are.
        """
        name = placed.name
        held = self._find_hold(name)
        if held is not None and placed.object.free:
            raise InputError(
                f"'{name}' is held already, as {held}",
                field=where,
                expected="Release or Place before",
            )
        if by is None:
            self._release_fixed_objects()
            if self.held:
                raise InputError(
                    f"the robot has one hand, and it holds {self.held[0]}",
                    field=f"{where}.object",
                    expected="Place or Release before",
                    got=name,
                )
        elif not placed.object.free:
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

    def _drop_unused_holds(self, hold: Hold) -> None:
        """Drop holds of the start that no phase uses and that move the joints of a new hold.

        A kinematic chain can contain these joints only once.
        """
        used = {*self.held}
        for phase in self.phases:
            used.update(phase.held, phase.grasps)
        remaining = list[Hold]()
        for one in self.holds:
            if one in used or find_shared_coordinate(self.scene, (one, hold)) is None:
                remaining.append(one)
        if len(remaining) == len(self.holds):
            return
        self.holds = remaining
        coordinates = set[str]()
        for one in remaining:
            coordinates.update(find_driven_coordinates(self.scene, one))
        for values in (self.initial, self.state):
            for name in values.keys() - coordinates:
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
            objects = self.scene.objects
            carried = [str(one) for one in self.held if objects[one.object].object.free]
            raise InputError(
                f"'{name}' cannot be grasped through '{owner}', which the robot does not carry",
                field=where,
                expected=f"a link of what it carries ({', '.join(carried) or 'nothing'})",
                got=format_value(frame),
            )
        check_link(placed, link, where)
        return hold, link

    def actuate(self, step: Actuate, where: str) -> None:
        """Add the phases that grasp an object, release its latches and bring joints to values."""
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
        latest_first = (*self.held, *reversed(self.holds))
        used = [one.attachment for one in latest_first if one.object == step.object]
        fit = list_driving_attachments(placed, step.attachment, used, self.state, values, where)
        hold = self._grasp_at(fit, placed, where)
        ranges = {coordinate: find_joint_limits(placed, coordinate) for coordinate in values}
        path = find_path_joints(placed, placed.object.attachments[hold.attachment])
        asked = dict(values)
        after: dict[str, float] = {}
        for latch in find_blocking_latches(placed, self.state, values):
            release = f"{step.object}.{latch.released_by}"
            # A joint that the hand does not move is past the threshold: the grasp was checked.
            if latch.released_by not in path:
                continue
            lower, upper = find_joint_limits(placed, release)
            turned = min(latch.threshold + LATCH_MARGIN, upper)
            if self.state[release] < turned:
                turn_ranges = {release: (lower, upper)}
                self._append_motion("turn", hold, where, {release: turned}, turn_ranges)
            # A value below the threshold must wait until the latch has disengaged.
            if asked.get(release, upper) < turned:
                after[release] = asked[release]
            # One joint may release several latches: the largest threshold counts.
            values[release] = max(values.get(release, turned), turned)
            lowest, _ = ranges.get(release, (turned, upper))
            ranges[release] = (max(lowest, turned), upper)
        self._keep_out_of_latches(placed, values, ranges)
        self._append_motion("move", hold, where, values, ranges)
        if after:
            limits = {release: find_joint_limits(placed, release) for release in after}
            self._append_motion("turn", hold, where, after, limits)

    def _keep_out_of_latches(
        self,
        placed: PlacedObject,
        values: Mapping[str, float],
        ranges: dict[str, tuple[float, float]],
    ) -> None:
        """Limit the ranges of joints that move into their latches to the side they are on.

        Once a joint is in the range of its latch, it can only move on to the latched position.
        """
        for latch in find_closing_latches(placed, self.state, values):
            name = f"{placed.name}.{latch.joint}"
            lower, upper = ranges[name]
            distance = self.state[name] - latch.held_at
            gap = min(abs(distance), latch.engaged_within + LATCH_GAP)
            if distance > 0.0:
                ranges[name] = (max(lower, latch.held_at + gap), upper)
            else:
                ranges[name] = (lower, min(upper, latch.held_at - gap))

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
            labels = [f"{owner}.{name}" for name in self.scene.objects[owner].object.links]
            raise InputError(
                "this is an object, not one of its links",
                field=f"{where}.frame",
                expected=f"one of {', '.join(labels)}",
                got=owner,
            )
        else:
            link = find_robot_frame(self.scene, step.frame, f"{where}.frame")
        if hold is None and step.attachment is not None:
            raise InputError(
                f"'{step.frame}' is no link of an object that can be grasped",
                field=f"{where}.attachment",
                expected="no attachment",
                got=step.attachment,
            )
        self._release_fixed_objects()
        if isinstance(step.target, pin.SE3):
            if hold is not None:
                self._check_level(hold, link, step.target, f"{where}.target")
            goal = FrameGoal(link, step.target, "pose", hold, touches=True)
        else:
            point = pin.SE3(np.eye(3), np.array(step.target))
            goal = FrameGoal(link, point, "point", hold, touches=True)
        self._append("touch", (step.frame,), self.options.reach_waypoints, frames=(goal,))

    def place(self, step: Place, where: str) -> None:
        """Add the phases that bring an object to its goal and release it there."""
        placed = find_object(self.scene, step.object, f"{where}.object")
        if not placed.object.free:
            problem = f"'{step.object}' is fixed in the world"
            raise InputError(problem, field=f"{where}.object", expected="a free object")
        hold = self._find_or_grasp(step.object, step.attachment, where)
        has_pose = isinstance(step.pose, pin.SE3)
        if has_pose:
            pose = step.pose
        else:
            # As it rests now; an object held from the start, with its z axis up.
            rotation = np.eye(3) if step.object in self.scene.held else placed.placement.rotation
            pose = pin.SE3(rotation, np.array(step.pose))
        self._check_level(hold, placed.object.base_link, pose, f"{where}.pose")
        goal = FrameGoal(placed.object.base_link, pose, "pose" if has_pose else "upright", hold)
        segments = self.options.reach_waypoints
        self._append("place", (step.object,), segments, frames=(goal,), lowered={hold: pose})
        self._release(hold, pose, nearly=not has_pose)

    def _find_or_grasp(self, name: str, attachment: str | None, where: str) -> Hold:
        """Return the present hold of a free object, which is grasped if there is none."""
        hold = self._find_hold(name) or self.grasp(name, attachment, where)
        if attachment not in (None, hold.attachment):
            raise InputError(
                "it is held elsewhere",
                field=f"{where}.attachment",
                expected=hold.attachment,
                got=attachment,
            )
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
        # Objects held through a released one are released before it.
        released: list[Hold] = []
        for hold in self.held:
            if step.object in (None, hold.object) or hold.by in released:
                released.insert(0, hold)
        has_moved = bool(self.phases)
        if not has_moved:
            lowered = dict[Hold, pin.SE3]()
            for hold in released:
                placed = self.scene.objects[hold.object]
                if placed.object.free:
                    lowered[hold] = placed.placement
            self._append("stand", (), self.options.turn_waypoints, lowered=lowered)
        for hold in released:
            if hold in self.held:
                self._release(hold, self.scene.objects[hold.object].placement, nearly=has_moved)

    def _release(self, hold: Hold, where: pin.SE3, *, nearly: bool = True) -> None:
        """Remove a hold, and the holds through it.

        If `nearly`, the motion decides where exactly the object rests.
        """
        through = [other for other in self.held if other.by == hold]
        for other in through:
            self._release(other, self.scene.objects[other.object].placement)
        self.held = tuple(other for other in self.held if other != hold)
        if self.scene.objects[hold.object].object.free:
            self.resting[hold.object] = where
            supported = self.supports.release_carried(hold, where)
            if nearly:
                for name in (hold.object, *supported):
                    self.released_by[name] = (hold, len(self.phases) - 1)

    def add(self, step: Step, where: str) -> None:
        """Add the phases of a step; `where` is its field in error messages."""
        match step:
            case Actuate():
                self.actuate(step, where)
            case Touch():
                self.touch(step, where)
            case Place():
                self.place(step, where)
            case Release():
                self.release(step, where)
            case Grasp():
                self.grasp(step.object, step.attachment, where, step.by)
            case Reach():
                self.reach(step, where)
            case Configure():
                self.configure(step, where)
            case GoTo():
                self.go(step)

    def reach(self, step: Reach, where: str) -> None:
        """Add the phase that brings a frame of the robot to a pose."""
        check_pose_is_unambiguous(self.scene, step, f"{where}.pose")
        frame = find_robot_frame(self.scene, step.frame, f"{where}.frame")
        self._release_fixed_objects()
        goals = (FrameGoal(frame, step.pose),)
        self._append("reach", (frame,), self.options.reach_waypoints, frames=goals)

    def configure(self, step: Configure, where: str) -> None:
        """Add the phase that brings joints of the robot to values."""
        configuration = find_configuration(self.scene, step, where)
        velocities = find_end_velocities(self.scene, step, where)
        self._release_fixed_objects()
        self._append(
            "configure",
            (),
            self.options.reach_waypoints,
            configuration=configuration,
            velocities=velocities,
        )

    def go(self, step: GoTo) -> None:
        """Add the phase that brings the base to a position."""
        self._release_fixed_objects()
        x_name, y_name, yaw_name = self.scene.robot.coordinates.names[:3]
        goal = {x_name: (step.x, step.x), y_name: (step.y, step.y)}
        if step.yaw is not None:
            goal[yaw_name] = (step.yaw, step.yaw)
        self._append("go", (), self.options.reach_waypoints, configuration=goal)


def compile_task(
    scene: Scene, steps: Sequence[Step], options: Options, *, nothing: bool = False, first: int = 0
) -> Task:
    """Compile steps to phases, beginning at the scene's start."""
    steps = as_steps(steps)
    compiler = _Compiler(scene, options)
    boundaries = list[StepBoundary]()
    for index, step in enumerate(steps):
        compiler.step = index
        compiler.add(step, f"steps[{first + index}]")
        boundary = StepBoundary(
            len(compiler.phases), len(compiler.holds), len(compiler.initial), compiler.held
        )
        boundaries.append(boundary)
    if not compiler.phases and not nothing:
        raise make_nothing_to_do_error()
    initial = compiler.initial
    openings = compute_openings(scene, compiler.phases)
    phases = list[Phase]()
    for phase, opening in zip(compiler.phases, openings, strict=True):
        # Objects that are grasped later keep their initial values until then.
        values = dict(initial)
        for name, value in phase.initial_values.items():
            if name in initial:
                values[name] = value
        phases.append(replace(phase, initial_values=values, opening=opening))
    open_attachments = [one for one in compiler.open.values() if one.others]
    return Task(
        steps,
        tuple(phases),
        tuple(compiler.holds),
        initial,
        compiler.held,
        tuple(boundaries),
        tuple(open_attachments),
    )


def make_nothing_to_do_error() -> InputError:
    """Return the error for steps that change nothing."""
    return InputError(
        "there is nothing to do",
        field="steps",
        expected="a step that changes something",
        got="only steps that are done already",
    )
