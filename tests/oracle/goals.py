"""Checks that each step's goal is reached at the end of a phase, the last at the motion's end."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import coal
import numpy as np

from .plan import Violation
from .poses import Poses, compute_angle, make_pose
from .riding import compute_distance
from .stage import Stage, World

__all__ = ["check_goals", "find_touched"]

POINT = coal.Sphere(1e-4)


class End:
    """The moment after `number` phases; before the first that is the start."""

    def __init__(self, world: World, stages: list[Stage], number: int) -> None:
        self.world, self.number = world, number
        self.stage = stages[max(number - 1, 0)]
        self.row = len(self.stage.times) - 1 if number else 0
        self.time = float(self.stage.times[self.row])
        self.after = stages[min(number, len(stages) - 1)].phase.holds
        self.before = stages[number - 1].phase.holds if number else tuple(world.held)

    def frame(self, name: str | None) -> Poses:
        owner, _, link = (name or self.world.robot.tool).partition(".")
        key = (
            (owner, link)
            if owner in self.world.objects and link
            else ("robot", name or self.world.robot.tool)
        )
        return self.stage.links[key].row(self.row)

    def value(self, name: str) -> float:
        index = self.world.plan.index(name)
        return (
            self.world.start[name] if index is None else float(self.stage.columns[self.row, index])
        )


def _parse_target(goal: Any) -> Poses:
    array = np.array(goal, float)
    return make_pose(array) if array.shape == (3,) else make_pose(array[:3, 3], array[:3, :3])


FAR, TURN = 1e-3, 1e-3  # [m], [rad]
Miss = tuple[str, float, str]
"""Subject, excess over the tolerance, detail."""


def find_misses(world: World, step: dict[str, Any], end: End) -> list[Miss]:
    """Return the parts of a step's goal that are not reached at the end of a phase."""
    kind, found = step["step"], []
    for subject, error, limit, what in _compute_errors(world, step, end):
        if not error <= limit + 1e-7:
            found.append((subject, error - limit, f"{kind}: {what} off by {error:.5f}"))
    if kind == "Grasp":
        found += _find_grasp_misses(world, step, end)
    if kind in ("Place", "Release"):
        for hold in end.after:
            if step["object"] in (None, hold.object):
                found.append((hold.object, 1.0, f"{kind}: is held still"))
    return found


def _compute_errors(
    world: World, step: dict[str, Any], end: End
) -> Iterator[tuple[str, float, float, str]]:
    """Yield the subjects, errors, tolerances and names of what a step sets by value or pose."""
    kind = step["step"]
    if kind == "Actuate":
        for joint, goal in step["joints"].items():
            name = f"{step['object']}.{joint}"
            limit = FAR if world.objects[step["object"]].slides(joint) else TURN
            yield name, abs(end.value(name) - goal), limit, "value"
    elif kind == "GoTo":
        x, y = end.value("base_x") - step["x"], end.value("base_y") - step["y"]
        yield "base", float(np.hypot(x, y)), FAR, "place"
        if step["yaw"] is not None:
            off = abs((end.value("base_yaw") - step["yaw"] + np.pi) % (2 * np.pi) - np.pi)
            yield "base heading", off, TURN, "heading"
    elif kind in ("Reach", "Touch", "Place"):
        yield from _compute_pose_errors(world, step, end)


def _compute_pose_errors(
    world: World, step: dict[str, Any], end: End
) -> Iterator[tuple[str, float, float, str]]:
    """Yield the errors of a frame that a step brings to a pose or point."""
    frame, goal = step.get("frame"), step.get("pose", step.get("target"))
    if step["step"] == "Place":
        frame = f"{step['object']}.{world.objects[step['object']].tree.urdf.base}"
    here, there = end.frame(frame), _parse_target(goal)
    yield frame or "tool", float(np.linalg.norm(here.at - there.at)), FAR, "place"
    if np.shape(goal) == (4, 4):
        angle = float(compute_angle(here.turn, there.turn)[0])
        yield frame or "tool", angle, TURN, "orientation"
    elif step["step"] == "Place":
        held = step["object"] in {hold.object for hold in world.held}
        stood = world.objects[step["object"]].at.turn[0]
        up = np.array([0.0, 0.0, 1.0]) if held else stood[2]
        now = here.turn[0, 2]  # the world's vertical, seen from the object
        tilt = float(np.arctan2(np.linalg.norm(np.cross(up, now)), up @ now))
        yield frame or "", tilt, TURN, "vertical"


def _find_grasp_misses(world: World, step: dict[str, Any], end: End) -> list[Miss]:
    """Return the distance and the angle between the hand and the grasp, if they are too large."""
    obj = world.objects[step["object"]]
    used = {
        hold.attachment: hold for hold in (*end.before, *end.after) if hold.object == step["object"]
    }
    name = step["attachment"] or next(iter(used), None)
    grasp, row = world.grasp(used[name]) if name in used else obj.grasp(name), end.row
    values = {}
    for freedom, *_ in grasp.freedoms:
        index = world.plan.index(f"{step['object']}.{freedom}")
        values[freedom] = np.array([0.0 if index is None else end.stage.columns[row, index]])
    right = end.frame(f"{step['object']}.{grasp.link}") @ grasp.tool(values)
    hand = end.frame(step["by"])
    hand = hand @ world.front(grasp.opening) if grasp.pushed else hand
    off = float(np.linalg.norm(hand.at - right.at))
    angle = float(compute_angle(hand.turn, right.turn)[0])
    subject, found = f"{step['object']}.{grasp.name}", []
    if off > FAR + 1e-7:
        found.append((subject, off - FAR, f"Grasp: {off:.5f} m away"))
    if angle > TURN + 1e-7:
        found.append((subject, angle - TURN, f"Grasp: turned by {angle:.5f} rad"))
    return found


def find_touched(world: World, stage: Stage) -> Iterator[tuple[set[str], set[str]]]:
    """Yield the brought links and the targets of every `Touch` done at the end of a phase."""
    row = len(stage.times) - 1
    for step in world.plan.steps:
        if step["step"] != "Touch" or find_misses(world, step, End(world, [stage], 1)):
            continue
        target, owner = _parse_target(step["target"]), step["frame"].partition(".")[0]
        links = {step["frame"]}
        if owner not in world.objects:
            owner, tree = "robot", world.robot.tree
            above = {
                tree.model.names[joint]
                for joint in tree.model.supports[tree.frame(step["frame"]).parentJoint]
            }
            links = {
                link
                for link, joints in world.robot.moved_by.items()
                if set(joints) == above & {*world.robot.arm, *world.robot.coupled}
            }
        safe = world.plan.options["dist_safe"]
        others = [part for part in stage.solids if part.owner not in (owner, "robot")]
        near = {
            part.label
            for part in others
            if compute_distance(POINT, target, part.shape.solid, part.at, row) < safe
        }
        yield links, near


def check_goals(world: World, stages: list[Stage]) -> Iterator[Violation]:
    """Check that the steps are done at ends of phases, in order, and nothing moves out of turn."""
    steps, ends = (
        world.plan.steps,
        [End(world, stages, number) for number in range(len(stages) + 1)],
    )
    missing = [[find_misses(world, step, end) for end in ends] for step in steps]
    moved = [_find_moved(world, stage) for stage in stages]
    own = [{step["object"]} if step["step"] == "Actuate" else set() for step in steps]
    never = False
    for number, row in enumerate(missing):
        last = number == len(steps) - 1
        if not any(not found for found in (row[-1:] if last else row)):
            best = (
                len(ends) - 1
                if last
                else min(range(1, len(ends)), key=lambda k: max(m[1] for m in row[k]))
            )
            for subject, amount, detail in row[best]:
                yield Violation(
                    "goal", subject, ends[best].time, amount, f"step {number + 1}, {detail}"
                )
            never = True
    if never:
        return
    reached = {0}  # how many steps may be done
    for number in range(len(ends)):
        if number:  # in a phase, only what the step moves that is being done
            reached = {n for n in reached if n < len(steps) and moved[number - 1] <= own[n]} | (
                {n for n in reached if n == len(steps) and not moved[number - 1]}
            )
        for n in range(len(steps)):
            if n in reached and not missing[n][number]:
                reached.add(n + 1)
    if len(steps) not in reached:
        yield Violation(
            "order",
            "steps",
            float(stages[-1].times[-1]),
            1.0,
            "steps are not done one after the other",
        )


def _find_moved(world: World, stage: Stage) -> set[str]:
    """Return objects whose joints move in a phase."""
    found = set()
    for k, name in enumerate(world.plan.names):
        owner, _, joint = name.partition(".")
        if joint and joint in world.objects[owner].limits and np.ptp(stage.columns[:, k]) > 1e-5:
            found.add(owner)
    return found
