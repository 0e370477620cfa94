"""Collects the pose goals of a task: closures (eq. 2), grasps, approaches, step goals (eq. 3)."""

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

__all__ = ["PoseGoal", "find_approach_waypoint", "find_chosen_freedoms", "make_pose_goals"]


@dataclass(frozen=True, eq=False)
class PoseGoal:
    """A frame with a target pose.

    Attributes:
        row: The frame, and the waypoints at which the goal applies.
        target: Target placement in the world.
        kind: "closure" of a grasped object that is fixed in the world; "grasp" of a free object;
            "approach", the start of the straight path to a grasp; "level", for a carrier on which
            another object rests; "goal" of a step.
        about: Subject for messages: an object, a hold or a frame.
        object: The object that is held or grasped; None for the goal of a step.
    """

    row: PoseRow
    target: pin.SE3
    kind: Literal["closure", "grasp", "approach", "level", "goal"]
    about: str
    object: str | None = None

    @property
    def name(self) -> str:
        """Name for messages, e.g. "closure door" or "approach door.handle"."""
        return f"{self.kind} {self.about}"


def make_pose_goals(
    scene: Scene, chain: VirtualKinematicChain, task: Task, options: Options
) -> tuple[PoseGoal, ...]:
    """Return the pose goals of a task: grasps and closures, then approaches and goals of steps.

    Args:
        scene: Scene with the objects.
        chain: Virtual kinematic chain.
        task: Grasps and goals of each phase.
        options: Options; the length of the straight approach.
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
                    PoseGoal(row, phase.resting[hold.object], "grasp", str(hold), hold.object)
                )
            elif hold in phase.grasps:
                waypoints.append(last)
            elif hold in phase.held:
                waypoints += range(first + 1, last + 1)
        if waypoints and not scene.objects[hold.object].object.free:
            row = PoseRow(closure.joint, closure.local, tuple(int(t) for t in waypoints))
            goals.append(PoseGoal(row, closure.target, "closure", hold.object, hold.object))
    for phase, first, last in zip(task.phases, starts, ends, strict=True):
        # retreat from the grasp, straight back along the approach direction
        for hold in phase.grasps:
            closure, target = (
                chain.closures[hold],
                phase.resting.get(hold.object, chain.closures[hold].target),
            )
            joint, frame = chain.holder(hold)
            x, y, z = (options.approach * frame.rotation[:, 2]).tolist()
            at = find_approach_waypoint(int(first), int(last), options)
            if at == last:  # the phase is too short for an approach
                continue
            row = PoseRow(closure.joint, closure.local, (at,), shift=(joint, (x, y, z)))
            goals.append(PoseGoal(row, target, "approach", str(hold), hold.object))
        for hold, ride in {ride.hold: ride for ride in phase.supported}.items():
            carrier = scene.objects[hold.object].object
            if carrier.free:
                row = PoseRow(
                    *chain.frame(carrier.base_link, hold),
                    tuple(range(int(first) + 1, int(last) + 1)),
                    "level",
                )
                goals.append(
                    PoseGoal(row, ride.carrier_placement, "level", hold.object, hold.object)
                )
        for goal in phase.frames:
            row = PoseRow(
                *chain.frame(goal.frame, goal.hold, opening=phase.opening), (int(last),), goal.kind
            )
            goals.append(PoseGoal(row, goal.placement, "goal", str(goal)))
    return tuple(goals)


def find_approach_waypoint(first: int, last: int, options: Options) -> int:
    """Return the waypoint at which the straight approach to a grasp begins.

    Args:
        first: First waypoint of the phase.
        last: Last waypoint of the phase, at which the hand grasps.
        options: Options; the duration of the approach.
    """
    return max(first + 1, last - options.steps(options.approach_time))


def find_pushed_coordinates(
    chain: VirtualKinematicChain, task: Task
) -> tuple[tuple[int, int, int, int], ...]:
    """Return (column, first waypoint, last waypoint, direction ±1) of each pushed coordinate."""
    ends = np.cumsum([phase.segments for phase in task.phases]).tolist()
    phases = zip(task.phases, [0, *ends[:-1]], ends, strict=True)
    return tuple(
        (chain.index(name), first, last, direction)
        for phase, first, last in phases
        for name, direction in phase.pushed.items()
    )


def find_chosen_freedoms(
    scene: Scene, chain: VirtualKinematicChain, task: Task
) -> tuple[tuple[int, int, int], ...]:
    """Return (column, grasp waypoint, last waypoint held) of each freedom chosen when clamping.

    Args:
        scene: Scene with the objects.
        chain: Virtual kinematic chain.
        task: Grasps of each phase.
    """
    freedoms, ends = [], np.cumsum([phase.segments for phase in task.phases])
    for hold, names in chain.virtual.items():
        attachment = scene.objects[hold.object].object.attachments[hold.attachment]
        for number, phase in enumerate(task.phases):
            if not attachment.firm or hold not in phase.grasps:
                continue
            last = number
            while last + 1 < len(task.phases) and hold in task.phases[last + 1].held:
                last += 1
            freedoms += [(chain.index(name), int(ends[number]), int(ends[last])) for name in names]
    return tuple(freedoms)
