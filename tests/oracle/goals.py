"""Checks that steps reach their goals at phase ends, and the last step at the motion's end."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import coal
import numpy as np

from .plan import Violation
from .poses import Poses, compute_angle, make_pose
from .stage import Stage, World
from .supports import compute_distance

__all__ = ["check_goals", "find_touched"]

POINT = coal.Sphere(1e-4)


class End:
    """The end of the first `number` phases; 0: the start of the motion."""

    def __init__(self, world: World, stages: list[Stage], number: int) -> None:
        self.world, self.number = world, number
        self.stage = stages[max(number - 1, 0)]
        self.sample = len(self.stage.times) - 1 if number else 0
        self.time = float(self.stage.times[self.sample])
        self.after = stages[min(number, len(stages) - 1)].phase.holds
        self.before = stages[number - 1].phase.holds if number else tuple(world.held)

    def get_pose(self, name: str | None) -> Poses:
        """Return the pose of a frame; None: of the tool."""
        owner, _, link = (name or self.world.robot.tool).partition(".")
        key = (
            (owner, link)
            if owner in self.world.objects and link
            else ("robot", name or self.world.robot.tool)
        )
        return self.stage.links[key].get_sample(self.sample)

    def get_value(self, name: str) -> float:
        """Return the value of a coordinate."""
        index = self.world.plan.find_index(name)
        return (
            self.world.start[name]
            if index is None
            else float(self.stage.columns[self.sample, index])
        )


def _parse_target(goal: Any) -> Poses:
    array = np.array(goal, float)
    return make_pose(array) if array.shape == (3,) else make_pose(array[:3, 3], array[:3, :3])


POSITION_TOLERANCE, ANGLE_TOLERANCE = 1e-3, 1e-3  # [m], [rad]
Miss = tuple[str, float, str]
"""Subject, excess over the tolerance, detail."""


def find_misses(world: World, step: dict[str, Any], end: End) -> list[Miss]:
    """Return the constraints of a step's goal that are violated at the end of a phase."""
    kind, misses = step["step"], []
    for subject, error, limit, quantity in _compute_errors(world, step, end):
        if not error <= limit + 1e-7:
            misses.append((subject, error - limit, f"{kind}: {quantity} off by {error:.5f}"))
    if kind == "Grasp":
        misses += _find_grasp_misses(world, step, end)
    if kind in ("Place", "Release"):
        for hold in end.after:
            if step["object"] in (None, hold.object):
                misses.append((hold.object, 1.0, f"{kind}: is still held"))
    return misses


def _compute_errors(
    world: World, step: dict[str, Any], end: End
) -> Iterator[tuple[str, float, float, str]]:
    """Yield the subject, error, tolerance and quantity of each value or pose that a step sets."""
    kind = step["step"]
    if kind == "Actuate":
        for joint, goal in step["joints"].items():
            name = f"{step['object']}.{joint}"
            limit = (
                POSITION_TOLERANCE
                if world.objects[step["object"]].is_prismatic(joint)
                else ANGLE_TOLERANCE
            )
            yield name, abs(end.get_value(name) - goal), limit, "value"
    elif kind == "Configure":
        for joint, goal in step["joints"].items():
            position, is_angle, is_endless = _find_joint_position(world, joint, end)
            error = position - goal
            if is_endless:
                error = (error + np.pi) % (2 * np.pi) - np.pi
            deviation = step["tolerance"]
            if isinstance(deviation, dict):
                deviation = deviation.get(joint, 0.0)
            limit = ANGLE_TOLERANCE if is_angle else POSITION_TOLERANCE
            yield joint, abs(error), limit + deviation, "joint"
    elif kind == "GoTo":
        x, y = end.get_value("base_x") - step["x"], end.get_value("base_y") - step["y"]
        yield "base", float(np.hypot(x, y)), POSITION_TOLERANCE, "place"
        if step["yaw"] is not None:
            error = abs((end.get_value("base_yaw") - step["yaw"] + np.pi) % (2 * np.pi) - np.pi)
            yield "base heading", error, ANGLE_TOLERANCE, "heading"
    elif kind in ("Reach", "Touch", "Place"):
        yield from _compute_pose_errors(world, step, end)


def _find_joint_position(world: World, joint: str, end: End) -> tuple[float, bool, bool]:
    """Return the position of a joint of the robot, whether it turns, and whether without limits."""
    robot = world.robot
    leader, factor, offset = robot.coupled.get(joint, (joint, 1.0, 0.0))
    if joint.startswith("base_"):
        is_angle = joint == "base_yaw"
    else:
        is_angle = robot.tree.urdf.joints[joint].get("type") != "prismatic"
    is_endless = is_angle and bool(np.isinf(robot.limits[leader][1]))
    return factor * end.get_value(leader) + offset, is_angle, is_endless


def _compute_pose_errors(
    world: World, step: dict[str, Any], end: End
) -> Iterator[tuple[str, float, float, str]]:
    """Yield the errors of a frame that a step moves to a pose or point."""
    frame, goal = step.get("frame"), step.get("pose", step.get("target"))
    if step["step"] == "Place":
        frame = f"{step['object']}.{world.objects[step['object']].tree.urdf.base}"
    pose, target = end.get_pose(frame), _parse_target(goal)
    yield (
        frame or "tool",
        float(np.linalg.norm(pose.translation - target.translation)),
        POSITION_TOLERANCE,
        "place",
    )
    if np.shape(goal) == (4, 4):
        angle = float(compute_angle(pose.rotation, target.rotation)[0])
        yield frame or "tool", angle, ANGLE_TOLERANCE, "orientation"
    elif step["step"] == "Place":
        grasped = step["object"] in {hold.object for hold in world.held}
        initial = world.objects[step["object"]].placement.rotation[0]
        up = np.array([0.0, 0.0, 1.0]) if grasped else initial[2]
        vertical = pose.rotation[0, 2]  # the vertical in the object's frame
        tilt = float(np.arctan2(np.linalg.norm(np.cross(up, vertical)), up @ vertical))
        yield frame or "", tilt, ANGLE_TOLERANCE, "vertical"


def _find_grasp_misses(world: World, step: dict[str, Any], end: End) -> list[Miss]:
    """Return the errors of position and orientation between hand and grasp above tolerance."""
    obj = world.objects[step["object"]]
    used = {
        hold.attachment: hold for hold in (*end.before, *end.after) if hold.object == step["object"]
    }
    name = step["attachment"] or next(iter(used), None)
    grasp, sample = world.get_grasp(used[name]) if name in used else obj.get_grasp(name), end.sample
    values = {}
    for freedom, *_ in grasp.freedoms:
        index = world.plan.find_index(f"{step['object']}.{freedom}")
        values[freedom] = np.array([0.0 if index is None else end.stage.columns[sample, index]])
    target = end.get_pose(f"{step['object']}.{grasp.link}") @ grasp.compute_tool(values)
    hand = end.get_pose(step["by"])
    hand = hand @ world.compute_front(grasp.opening) if grasp.pushed else hand
    distance = float(np.linalg.norm(hand.translation - target.translation))
    angle = float(compute_angle(hand.rotation, target.rotation)[0])
    subject, misses = f"{step['object']}.{grasp.name}", []
    if distance > POSITION_TOLERANCE + 1e-7:
        misses.append((subject, distance - POSITION_TOLERANCE, f"Grasp: {distance:.5f} m away"))
    if angle > ANGLE_TOLERANCE + 1e-7:
        misses.append((subject, angle - ANGLE_TOLERANCE, f"Grasp: turned by {angle:.5f} rad"))
    return misses


def find_touched(world: World, stage: Stage) -> Iterator[tuple[set[str], set[str]]]:
    """Yield the moved links and the touched links of every `Touch` at the end of a phase."""
    sample = len(stage.times) - 1
    for step in world.plan.steps:
        if step["step"] != "Touch" or find_misses(world, step, End(world, [stage], 1)):
            continue
        target, owner = _parse_target(step["target"]), step["frame"].partition(".")[0]
        links = {step["frame"]}
        if owner not in world.objects:
            owner, tree = "robot", world.robot.tree
            joints_above = {
                tree.model.names[joint]
                for joint in tree.model.supports[tree.find_frame(step["frame"]).parentJoint]
            }
            links = {
                link
                for link, joints in world.robot.planned_joints.items()
                if set(joints) == joints_above & {*world.robot.arm, *world.robot.coupled}
            }
        safe = world.plan.options["dist_safe"]
        other_parts = [part for part in stage.solids if part.owner not in (owner, "robot")]
        touched = {
            part.label
            for part in other_parts
            if compute_distance(POINT, target, part.shape.solid, part.poses, sample) < safe
        }
        yield links, touched


def check_goals(world: World, stages: list[Stage]) -> Iterator[Violation]:
    """Check that steps are completed in order at phase ends, and move no other object's joints."""
    steps = world.plan.steps
    ends = [End(world, stages, number) for number in range(len(stages) + 1)]
    misses = [[find_misses(world, step, end) for end in ends] for step in steps]
    moved = [_find_moved_objects(world, stage) for stage in stages]
    actuated = [{step["object"]} if step["step"] == "Actuate" else set() for step in steps]
    failed = False
    for number, misses_of_step in enumerate(misses):
        last = number == len(steps) - 1
        if not any(
            not misses_at_end for misses_at_end in (misses_of_step[-1:] if last else misses_of_step)
        ):
            best = (
                len(ends) - 1
                if last
                else min(
                    range(1, len(ends)), key=lambda k: max(miss[1] for miss in misses_of_step[k])
                )
            )
            for subject, amount, detail in misses_of_step[best]:
                yield Violation(
                    "goal", subject, ends[best].time, amount, f"step {number + 1}, {detail}"
                )
            failed = True
    if failed:
        return
    reached = {0}  # possible numbers of completed steps
    for number in range(len(ends)):
        if number:  # only the current step may move joints of objects
            reached = {
                n for n in reached if n < len(steps) and moved[number - 1] <= actuated[n]
            } | ({n for n in reached if n == len(steps) and not moved[number - 1]})
        for n in range(len(steps)):
            if n in reached and not misses[n][number]:
                reached.add(n + 1)
    if len(steps) not in reached:
        yield Violation(
            "order",
            "steps",
            float(stages[-1].times[-1]),
            1.0,
            "steps are not done one after the other",
        )


def _find_moved_objects(world: World, stage: Stage) -> set[str]:
    """Return the objects whose joints move in a phase."""
    moved = set()
    for k, name in enumerate(world.plan.names):
        owner, _, joint = name.partition(".")
        if joint and joint in world.objects[owner].limits and np.ptp(stage.columns[:, k]) > 1e-5:
            moved.add(owner)
    return moved
