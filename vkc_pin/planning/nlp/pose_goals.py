"""Collects the pose goals of a task: closures (eq. 2), grasps, approaches, step goals (eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import pinocchio as pin

from vkc_pin.options import Options
from vkc_pin.planning.chain.chain import VirtualKinematicChain
from vkc_pin.planning.chain.pose import PoseRow
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.phases import Phase, Task


@dataclass(frozen=True, eq=False)
class PoseGoal:
    """A frame with a target pose.

    Attributes:
        row: The joint of the frame, and the waypoints at which the goal applies.
        local: Placement of the frame on its joint.
        target: Target placement in the world.
        kind: "closure" of a grasped object that is fixed in the world; "grasp" of a free object;
            "approach", the start of the straight path to a grasp; "level", for a carrier on which
            another object rests; "goal" of a step.
        about: Subject for messages: an object, a hold or a frame.
        object: The grasped object; None for the goal of a step.
    """

    row: PoseRow
    local: pin.SE3
    target: pin.SE3
    kind: Literal["closure", "grasp", "approach", "level", "goal"]
    about: str
    object: str | None = None

    @property
    def name(self) -> str:
        """Name for messages, e.g. "closure door" or "approach door.handle"."""
        return f"{self.kind} {self.about}"


def find_phase_spans(task: Task) -> list[tuple[Phase, int, int]]:
    """Return each phase with its first and last waypoint."""
    spans = []
    first = 0
    for phase in task.phases:
        last = first + phase.segments
        spans.append((phase, first, last))
        first = last
    return spans


def make_pose_goals(
    scene: Scene, chain: VirtualKinematicChain, task: Task, options: Options
) -> tuple[PoseGoal, ...]:
    """Return the pose goals of a task: grasps and closures, then approaches and goals of steps."""
    spans = find_phase_spans(task)
    goals = list[PoseGoal]()
    for hold in task.holds:
        goals += _make_grasp_goals(scene, chain, hold, spans)
    for phase, first, last in spans:
        at = find_approach_waypoint(first, last, options)
        if at < last:  # otherwise the phase is too short for an approach
            for hold in phase.grasps:
                goals.append(_make_approach_goal(chain, phase, hold, at, options.approach))
        supported_by_hold = {supported.hold: supported for supported in phase.supported}
        for hold, supported in supported_by_hold.items():
            carrier = scene.objects[hold.object].object
            if carrier.free:
                joint, local = chain.frame(carrier.base_link, hold)
                row = PoseRow(joint, tuple(range(first + 1, last + 1)), "level")
                level = supported.carrier_placement
                goals.append(PoseGoal(row, local, level, "level", hold.object, hold.object))
        for goal in phase.frames:
            joint, local = chain.frame(goal.frame, goal.hold, opening=phase.opening)
            row = PoseRow(joint, (last,), goal.kind)
            goals.append(PoseGoal(row, local, goal.placement, "goal", str(goal)))
    return tuple(goals)


def _make_approach_goal(
    chain: VirtualKinematicChain, phase: Phase, hold: Hold, waypoint: int, distance: float
) -> PoseGoal:
    """Return the goal that the hand is straight behind its grasp by a `distance` [m].

    The object is where it would be after a retreat along the approach direction, the z axis n of
    the holder: p + distance·n = p* for the object's position p and its target p*.
    """
    closure = chain.closures[hold]
    target = phase.resting.get(hold.object, closure.target)
    joint, frame = chain.holder(hold)
    x, y, z = (distance * frame.rotation[:, 2]).tolist()
    row = PoseRow(closure.joint, (waypoint,), shift=(joint, (x, y, z)))
    return PoseGoal(row, closure.local, target, "approach", str(hold), hold.object)


def _make_grasp_goals(
    scene: Scene, chain: VirtualKinematicChain, hold: Hold, spans: list[tuple[Phase, int, int]]
) -> list[PoseGoal]:
    """Return the goals of the grasps of a free object, or the closure of another one."""
    closure = chain.closures[hold]
    name = hold.object
    goals = list[PoseGoal]()
    if scene.objects[name].object.free:
        for phase, _, last in spans:
            if hold in phase.grasps:
                row = PoseRow(closure.joint, (last,))
                resting = phase.resting[name]
                goals.append(PoseGoal(row, closure.local, resting, "grasp", str(hold), name))
        return goals
    waypoints = list[int]()
    for phase, first, last in spans:
        if hold in phase.grasps:
            waypoints.append(last)
        elif hold in phase.held:
            waypoints += range(first + 1, last + 1)
    if waypoints:
        row = PoseRow(closure.joint, tuple(waypoints))
        goals.append(PoseGoal(row, closure.local, closure.target, "closure", name, name))
    return goals


def find_approach_waypoint(first: int, last: int, options: Options) -> int:
    """Return the waypoint at which the straight approach to a grasp at waypoint `last` begins."""
    return max(first + 1, last - options.steps(options.approach_time))


def find_end_of_hold(hold: Hold, spans: list[tuple[Phase, int, int]], end: int) -> int:
    """Return the last waypoint of the first phases, all of which hold; without any, `end`."""
    for phase, _, last in spans:
        if hold not in phase.held:
            break
        end = last
    return end


def find_pushed_coordinates(
    chain: VirtualKinematicChain, task: Task
) -> tuple[tuple[int, int, int, int], ...]:
    """Return (column, first waypoint, last waypoint, direction ±1) of each pushed coordinate."""
    pushed = []
    for phase, first, last in find_phase_spans(task):
        for name, direction in phase.pushed.items():
            pushed.append((chain.index(name), first, last, direction))
    return tuple(pushed)


def find_chosen_freedoms(
    scene: Scene, chain: VirtualKinematicChain, task: Task
) -> tuple[tuple[int, int, int], ...]:
    """Return (column, grasp waypoint, last waypoint held) of each freedom chosen when clamping."""
    freedoms = []
    spans = find_phase_spans(task)
    for hold, names in chain.virtual.items():
        attachment = scene.objects[hold.object].object.attachments[hold.attachment]
        for number, (phase, _, grasp) in enumerate(spans):
            if attachment.firm and hold in phase.grasps:
                last = find_end_of_hold(hold, spans[number + 1 :], grasp)
                freedoms += [(chain.index(name), grasp, last) for name in names]
    return tuple(freedoms)
