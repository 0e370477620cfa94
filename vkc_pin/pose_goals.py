"""Which frames must be where and when: closures (eq. 2), grasps and the ways to them, and the steps' own goals (eq. 3)."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from vkc_pin.chain import VirtualKinematicChain
from vkc_pin.options import Options
from vkc_pin.pose import PoseRow
from vkc_pin.scene import Scene
from vkc_pin.task import Task

__all__ = ["approach_at", "pose_goals"]


def pose_goals(
    scene: Scene, chain: VirtualKinematicChain, task: Task, options: Options
) -> tuple[list[PoseRow], list[pin.SE3], list[str]]:
    """Return the frames that must be somewhere, where, and their names.

    Args:
        scene: Where things stand.
        chain: The chain.
        task: What is held when, and what must be where at the ends of its phases.
        options: How long the straight way to a grasp is.
    """
    rows, targets, names = [], [], []
    ends = np.cumsum([phase.segments for phase in task.phases])
    starts = np.concatenate([[0], ends[:-1]])
    for hold in task.holds:
        closure, waypoints = chain.closures[hold], []
        for phase, first, last in zip(task.phases, starts, ends, strict=True):
            if hold in phase.grasps and scene.objects[hold.object].object.free:
                rows.append(PoseRow(closure.joint, closure.local, (int(last),)))
                targets.append(phase.standing[hold.object])
                names.append(f"grasp {hold}")
            elif hold in phase.grasps:
                waypoints.append(last)
            elif hold in phase.held:
                waypoints += range(first + 1, last + 1)
        if waypoints and not scene.objects[hold.object].object.free:
            rows.append(PoseRow(closure.joint, closure.local, tuple(int(t) for t in waypoints)))
            targets.append(closure.target)
            names.append(f"closure {hold.object}")
    for phase, first, last in zip(task.phases, starts, ends, strict=True):
        for hold in phase.grasps:  # short of the grasp, straight back along the hand's approach
            closure, target = chain.closures[hold], phase.standing.get(hold.object, chain.closures[hold].target)
            joint, frame = chain.holder(hold)
            x, y, z = (options.approach * frame.rotation[:, 2]).tolist()
            at = approach_at(int(first), int(last), options)
            if at == last:  # no room for it
                continue
            rows.append(PoseRow(closure.joint, closure.local, (at,), shift=(joint, (x, y, z))))
            targets.append(target)
            names.append(f"approach {hold}")
        for goal in phase.frames:
            rows.append(PoseRow(*chain.frame(goal.frame, goal.hold), (int(last),), goal.kind))
            targets.append(goal.placement)
            names.append(f"goal {goal}")
    return rows, targets, names


def approach_at(first: int, last: int, options: Options) -> int:
    """Return the waypoint from which a hand goes straight to a grasp, in a phase from waypoint `first` to `last`."""
    return max(first + 1, last - options.approach_waypoints)
