"""Which frames must be where and when: closures (eq. 2), grasps and the approaches to them, and the steps' own goals (eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pinocchio as pin

from vkc_pin.options import Options
from vkc_pin.planning.chain.chain import VirtualKinematicChain
from vkc_pin.planning.chain.pose import PoseRow
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Task

__all__ = ["PoseGoal", "approach_at", "chosen_freedoms", "pose_goals"]


@dataclass(frozen=True, eq=False)
class PoseGoal:
    """A frame that must be somewhere.

    Attributes:
        row: The frame, and the waypoints at which it must be there.
        target: Where, in the world.
        kind: "closure" of what stands fixed and is held; "grasp" of a free object; "approach":
            where the straight path to a grasp begins; "level": what something rides on; "goal" of a
            step.
        about: What it is about, for people: an object, a hold or a frame.
        object: The object that is held or grasped; None for the goal of a step.
    """

    row: PoseRow
    target: pin.SE3
    kind: Literal["closure", "grasp", "approach", "level", "goal"]
    about: str
    object: str | None = None

    @property
    def name(self) -> str:
        """What people call it, e.g. "closure door" or "approach door.handle"."""
        return f"{self.kind} {self.about}"


def pose_goals(
    scene: Scene, chain: VirtualKinematicChain, task: Task, options: Options
) -> tuple[PoseGoal, ...]:
    """Return the frames that must be somewhere: grasps and closures, then the approaches to grasps and the steps' own goals.

    Args:
        scene: Where objects stand.
        chain: The chain.
        task: What is held when, and what must be where at the ends of its phases.
        options: How long the straight approach to a grasp is.
    """
    goals: list[PoseGoal] = []
    ends = np.cumsum([phase.segments for phase in task.phases])
    starts = np.concatenate([[0], ends[:-1]])
    for hold in task.holds:
        closure, waypoints = chain.closures[hold], []
        for phase, first, last in zip(task.phases, starts, ends, strict=True):
            if hold in phase.grasps and scene.objects[hold.object].object.free:
                row = PoseRow(closure.joint, closure.local, (int(last),))
                goals.append(
                    PoseGoal(row, phase.standing[hold.object], "grasp", str(hold), hold.object)
                )
            elif hold in phase.grasps:
                waypoints.append(last)
            elif hold in phase.held:
                waypoints += range(first + 1, last + 1)
        if waypoints and not scene.objects[hold.object].object.free:
            row = PoseRow(closure.joint, closure.local, tuple(int(t) for t in waypoints))
            goals.append(PoseGoal(row, closure.target, "closure", hold.object, hold.object))
    for phase, first, last in zip(task.phases, starts, ends, strict=True):
        for hold in phase.grasps:  # short of the grasp, straight back along the hand's approach
            closure, target = (
                chain.closures[hold],
                phase.standing.get(hold.object, chain.closures[hold].target),
            )
            joint, frame = chain.holder(hold)
            x, y, z = (options.approach * frame.rotation[:, 2]).tolist()
            at = approach_at(int(first), int(last), options)
            if at == last:  # no room for it
                continue
            row = PoseRow(closure.joint, closure.local, (at,), shift=(joint, (x, y, z)))
            goals.append(PoseGoal(row, target, "approach", str(hold), hold.object))
        for hold, ride in {ride.hold: ride for ride in phase.rides}.items():
            thing = scene.objects[hold.object].object
            if thing.free:
                row = PoseRow(
                    *chain.frame(thing.base_link, hold),
                    tuple(range(int(first) + 1, int(last) + 1)),
                    "level",
                )
                goals.append(PoseGoal(row, ride.carrier, "level", hold.object, hold.object))
        for goal in phase.frames:
            row = PoseRow(
                *chain.frame(goal.frame, goal.hold, opening=phase.opening), (int(last),), goal.kind
            )
            goals.append(PoseGoal(row, goal.placement, "goal", str(goal)))
    return tuple(goals)


def approach_at(first: int, last: int, options: Options) -> int:
    """Return the waypoint from which a hand goes straight to a grasp, in a phase from waypoint `first` to `last`."""
    return max(first + 1, last - options.steps(options.approach_time))


def pushed_steps(chain: VirtualKinematicChain, task: Task) -> tuple[tuple[int, int, int, int], ...]:
    """Return column, first and last waypoint, and way (1 or -1), for every coordinate that a phase pushes."""
    ends = np.cumsum([phase.segments for phase in task.phases]).tolist()
    phases = zip(task.phases, [0, *ends[:-1]], ends, strict=True)
    return tuple(
        (chain.index(name), first, last, way)
        for phase, first, last in phases
        for name, way in phase.pushed.items()
    )


def chosen_freedoms(
    scene: Scene, chain: VirtualKinematicChain, task: Task
) -> tuple[tuple[int, int, int], ...]:
    """Return column, waypoint of the grasp and last waypoint of the hold, for every freedom that is chosen when a hand clamps.

    Args:
        scene: Whose objects they are.
        chain: The chain.
        task: What is held when.
    """
    found, ends = [], np.cumsum([phase.segments for phase in task.phases])
    for hold, names in chain.virtual.items():
        attachment = scene.objects[hold.object].object.attachments[hold.attachment]
        for number, phase in enumerate(task.phases):
            if not attachment.firm or hold not in phase.grasps:
                continue
            last = number
            while last + 1 < len(task.phases) and hold in task.phases[last + 1].held:
                last += 1
            found += [(chain.index(name), int(ends[number]), int(ends[last])) for name in names]
    return tuple(found)
