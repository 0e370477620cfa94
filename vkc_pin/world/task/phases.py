"""Defines tasks as sequences of phases: holds, moving joints and goals (f_task of eq. 3)."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Literal

import pinocchio as pin

from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.support import SupportedObject
from vkc_pin.world.task.steps import Step

PhaseKind = Literal["grasp", "reach", "touch", "place", "turn", "move", "go", "configure", "stand"]
PhaseKey = tuple[PhaseKind, tuple[str, ...]]
_VERBS: Mapping[PhaseKind, str] = {
    "grasp": "reach",
    "reach": "reach with",
    "touch": "touch with",
    "place": "place",
    "turn": "turn",
    "move": "move",
    "go": "go to",
    "configure": "configure",
    "stand": "stand still",
}


@dataclass(frozen=True)
class FrameGoal:
    """A goal placement of a frame in the world.

    Attributes:
        frame: Frame of the robot, or link of the object that `hold` holds.
        placement: Goal placement; of a point only the translation counts.
        kind: "pose", "point", or "upright": position and vertical of `placement`, any heading.
        hold: Hold of the object that the frame belongs to; None for a frame of the robot.
        touches: Whether the frame's link is exempt from the clearance to what is at the goal.
    """

    frame: str
    placement: pin.SE3
    kind: str = "pose"
    hold: Hold | None = None
    touches: bool = False

    def __str__(self) -> str:
        return f"{self.hold.object}.{self.frame}" if self.hold else self.frame


@dataclass(frozen=True)
class Phase:
    """A part of the motion with constant holds.

    Attributes:
        kind: Kind of phase: "grasp", "reach" of a frame, "touch", "place", "turn" (a joint that
            releases a latch), "move" (joints of an object), "go" (of the base), "configure" (joints
            of the robot), or "stand" (still).
        about: Subject of the phase: object and attachment (and the link that holds it, or ""),
            frame, object or coordinates; empty for "go", "configure" and "stand".
        segments: Number of time steps; the phase has `segments + 1` waypoints, the first of which
            is the last of the previous phase.
        held: Holds during the phase, each after the one it depends on.
        ranges: Object coordinate → (lower, upper) at all waypoints between the first and the last;
            all other coordinates are constant.
        values: Object coordinate → value at the last waypoint.
        pushed: Object coordinate → 1 or -1, for coordinates that are pushed and can only increase
            or decrease.
        frames: Frame goals at the last waypoint.
        configuration: Coordinate of the robot → (lower, upper) at the last waypoint. An angle
            without limits may differ by full turns.
        velocities: Coordinate of the robot → velocity at the last waypoint, which is that of the
            motion, [m/s] or [rad/s]; all others are 0.
        grasps: Holds that begin at the last waypoint.
        released: Holds that ended just before the phase.
        initial_values: Object coordinate → value at the first waypoint, for the joints that the
            task's grasps can move.
        resting: Free object → its placement, for free objects of the task that are not held.
        released_by: Free object → the hold that released it, and the number of the phase at whose
            end it did, for objects of `resting` whose exact placement the motion decides.
        lifted: Hold → placement of its free object when it was grasped just before the phase.
        lowered: Hold → placement of its free object when it is released at the end of the phase.
        supported: Free objects that rest on moving links and move with them.
        opening: Gripper opening [m]; None: as in the robot's rest configuration.
    """

    kind: PhaseKind
    about: tuple[str, ...]
    segments: int
    held: tuple[Hold, ...] = ()
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)
    pushed: Mapping[str, int] = field(default_factory=dict)
    frames: tuple[FrameGoal, ...] = ()
    configuration: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    velocities: Mapping[str, float] = field(default_factory=dict)
    grasps: tuple[Hold, ...] = ()
    released: tuple[Hold, ...] = ()
    initial_values: Mapping[str, float] = field(default_factory=dict)
    resting: Mapping[str, pin.SE3] = field(default_factory=dict)
    released_by: Mapping[str, tuple[Hold, int]] = field(default_factory=dict)
    lifted: Mapping[Hold, pin.SE3] = field(default_factory=dict)
    lowered: Mapping[Hold, pin.SE3] = field(default_factory=dict)
    supported: tuple[SupportedObject, ...] = ()
    opening: float | None = None

    @property
    def name(self) -> str:
        """Name for users, e.g. "reach door.handle", "turn door.knob" or "go to"."""
        subjects = map(str, self.grasps) if self.kind == "grasp" else self.about
        return f"{_VERBS[self.kind]} {', '.join(subjects)}".rstrip()

    @property
    def key(self) -> PhaseKey:
        """Kind and subject, which are equal for phases that do the same."""
        return self.kind, self.about


@dataclass(frozen=True)
class StepBoundary:
    """Extent of a task at the end of a step.

    Attributes:
        phases, holds, state: Number of the task's phases, holds and coordinates so far.
        after: Holds at the end of the step.
    """

    phases: int
    holds: int
    state: int
    after: tuple[Hold, ...]


@dataclass(frozen=True)
class OpenAttachment:
    """A grasp of a task whose attachment no step names.

    Attributes:
        step: Number of the step that grasps, from 0.
        object: Name of the grasped object.
        others: Attachments that could be grasped in place of the one in the task, in the object's
            order; at least one.
    """

    step: int
    object: str
    others: tuple[str, ...]


@dataclass(frozen=True)
class Task:
    """The phases that bring about a list of steps.

    Attributes:
        steps: Steps.
        phases: Phases in order; at least one.
        holds: All holds of the task, each after the one it depends on.
        state: Object coordinate (`<object>.<joint>`) → value at the start, for the joints that
            `holds` can move.
        after: Holds at the end.
        boundaries: Extent of the task at the end of each step.
        open_attachments: Grasps whose attachment the steps leave open.
    """

    steps: tuple[Step, ...]
    phases: tuple[Phase, ...]
    holds: tuple[Hold, ...]
    state: Mapping[str, float]
    after: tuple[Hold, ...] = ()
    boundaries: tuple[StepBoundary, ...] = ()
    open_attachments: tuple[OpenAttachment, ...] = ()

    @property
    def segments(self) -> int:
        """Number of time steps of the task; it has one waypoint more."""
        return sum(phase.segments for phase in self.phases)

    @property
    def supported(self) -> tuple[SupportedObject, ...]:
        """Objects that rest on moving links in any phase."""
        found = dict[SupportedObject, None]()
        for phase in self.phases:
            found |= dict.fromkeys(phase.supported)
        return tuple(found)

    def refine(self, numbers: Collection[int]) -> Task:
        """Return the task with twice as many segments in the phases of some numbers, from 0."""
        phases = list[Phase]()
        for number, phase in enumerate(self.phases):
            segments = 2 * phase.segments if number in numbers else phase.segments
            phases.append(replace(phase, segments=segments))
        return replace(self, phases=tuple(phases))

    def truncate(self, count: int) -> Task:
        """Return the task of the first `count` steps (at least 1) alone."""
        boundary = self.boundaries[count - 1]
        state = dict(islice(self.state.items(), boundary.state))
        phases = list[Phase]()
        for phase in self.phases[: boundary.phases]:
            values = phase.initial_values
            known = {name: value for name, value in values.items() if name in state}
            phases.append(replace(phase, initial_values=known))
        return Task(
            steps=self.steps[:count],
            phases=tuple(phases),
            holds=self.holds[: boundary.holds],
            state=state,
            after=boundary.after,
            boundaries=self.boundaries[:count],
            open_attachments=tuple(one for one in self.open_attachments if one.step < count),
        )


def summarize_phases(task: Task) -> list[tuple[str, tuple[str, ...]]]:
    """Return the names of the phases and of the objects held in them."""
    return [(phase.name, tuple(hold.object for hold in phase.held)) for phase in task.phases]
