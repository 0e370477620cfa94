"""Task: what steps ask for, in phases. What is held when, which joints move, and what must hold at the end (f_task of eq. 3)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Literal

import pinocchio as pin

from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.support import SupportedObject
from vkc_pin.world.task.steps import Step

__all__ = [
    "FrameGoal",
    "Phase",
    "PhaseKey",
    "PhaseKind",
    "StepBoundary",
    "Task",
    "summarize_phases",
]

PhaseKind = Literal["grasp", "reach", "touch", "place", "turn", "move", "go", "stand"]
PhaseKey = tuple[PhaseKind, tuple[str, ...]]
_VERBS: Mapping[PhaseKind, str] = {
    "grasp": "reach",
    "reach": "reach with",
    "touch": "touch with",
    "place": "place",
    "turn": "turn",
    "move": "move",
    "go": "go to",
    "stand": "stand still",
}


@dataclass(frozen=True)
class FrameGoal:
    """A frame that must be somewhere in the world.

    Attributes:
        frame: Of the robot, or a link of the object that `hold` holds.
        placement: Where; of a point only the translation counts.
        kind: "pose", "point", or "upright": the point, and the vertical as `placement` has it, at
            any heading.
        hold: What holds the object that the frame belongs to; None for a frame of the robot.
        touches: Whether the frame's link may come as close to what is there as it likes.
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
    """A stretch of the motion in which the same things are held.

    Attributes:
        kind: What happens in it: "grasp", "reach" of a frame, "touch", "place", "turn" what
            releases a latch, "move" joints of an object, "go" of the base, or "stand" still.
        about: What that happens to: object and attachment (and the link that holds it, or ""),
            frame, object or coordinates.
        segments: Steps of time; the phase has `segments + 1` waypoints, the first shared with the
            phase before.
        held: What is held, each after the hold it depends on.
        ranges: Object coordinate → (lower, upper) for every waypoint after the first; all others
            stand still.
        values: Object coordinate → value at the last waypoint.
        pushed: Object coordinate → 1 or -1, for those that may only go up or down, because the hand
            pushes.
        frames: Frame goals at the last waypoint.
        base: (x, y, yaw or None) at the last waypoint, in the world.
        grasps: What is grasped at the last waypoint.
        leaves: What was let go of just before.
        before: Object coordinate → value at the first waypoint, for the joints that this task's
            grasps can move.
        standing: Free object → its placement, for those that nobody holds and this task has to do
            with.
        left: Free object → the hold that left it where it stands, and the number of the phase at
            whose end it did, for those of `standing` that stand there only nearly: where exactly,
            the motion decides.
        lifted: Hold → placement in which its free object stood when it was grasped just before.
        lowered: Hold → placement in which its free object stands when it is let go of at the end.
        rides: What stands on something that moves, and moves along.
        opening: How far the gripper is open [m]; None: as the robot rests.
    """

    kind: PhaseKind
    about: tuple[str, ...]
    segments: int
    held: tuple[Hold, ...] = ()
    ranges: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    values: Mapping[str, float] = field(default_factory=dict)
    pushed: Mapping[str, int] = field(default_factory=dict)
    frames: tuple[FrameGoal, ...] = ()
    base: tuple[float, float, float | None] | None = None
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
        """What people call it, e.g. "reach door.handle", "turn door.knob" or "go to"."""
        about = ", ".join(map(str, self.grasps) if self.kind == "grasp" else self.about)
        return f"{_VERBS[self.kind]} {about}".rstrip()

    @property
    def key(self) -> PhaseKey:
        """What is equal for phases in which the same happens."""
        return self.kind, self.about


@dataclass(frozen=True)
class StepBoundary:
    """How much of a task there is when a step is done.

    Attributes:
        phases, holds, state: Number of the task's phases, holds and coordinates up to there.
        after: What is held then.
    """

    phases: int
    holds: int
    state: int
    after: tuple[Hold, ...]


@dataclass(frozen=True)
class Task:
    """What the steps ask for, in phases.

    Attributes:
        steps: The user's steps.
        phases: In order; at least one.
        holds: Everything that is held at any time, each after the hold it depends on.
        state: Object coordinate (`<object>.<joint>`) → value at the start, for the joints that
            `holds` can move.
        after: What is held when all is done.
        marks: For every step, how much of the task there is when it is done.
    """

    steps: tuple[Step, ...]
    phases: tuple[Phase, ...]
    holds: tuple[Hold, ...]
    state: Mapping[str, float]
    after: tuple[Hold, ...] = ()
    boundaries: tuple[StepBoundary, ...] = ()

    @property
    def segments(self) -> int:
        """Steps of time of the whole task; it has one waypoint more."""
        return sum(phase.segments for phase in self.phases)

    @property
    def supported(self) -> tuple[SupportedObject, ...]:
        """All rides of its phases."""
        return tuple(dict.fromkeys(ride for phase in self.phases for ride in phase.supported))

    def truncate(self, count: int) -> Task:
        """Return the task of the first `count` steps, at least 1, as if there were no others."""
        mark = self.boundaries[count - 1]
        state = dict(islice(self.state.items(), mark.state))
        phases = (
            replace(
                phase,
                initial_values={
                    name: value for name, value in phase.initial_values.items() if name in state
                },
            )
            for phase in self.phases[: mark.phases]
        )
        return Task(
            self.steps[:count],
            tuple(phases),
            self.holds[: mark.holds],
            state,
            mark.after,
            self.boundaries[:count],
        )


def summarize_phases(task: Task) -> list[tuple[str, tuple[str, ...]]]:
    """Return the phases' names and the objects that are held in them."""
    return [(phase.name, tuple(hold.object for hold in phase.held)) for phase in task.phases]
