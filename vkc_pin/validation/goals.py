"""Checks that a motion reaches the goals of its steps in their order."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arguments import check_choice
from vkc_pin.validation.report import Violation
from vkc_pin.validation.samples import Samples
from vkc_pin.validation.tolerances import Tolerances
from vkc_pin.world.models.coordinates import wrap_angle
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.scene.scene import Scene
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
)

MOTION_TOLERANCE = 1e-5  # smaller displacements do not count as motion [m] or [rad]


class GoalError(NamedTuple):
    """An unmet part of a step's goal."""

    subject: str
    amount: float
    unit: str
    detail: str


def check_steps(samples: Samples, steps: Sequence[Step]) -> None:
    """Check that objects, joints, attachments and frames named by steps exist.

    Raises:
        UnknownNameError: An object, joint, attachment or frame does not exist.
    """
    for number, step in enumerate(steps):
        where = f"steps[{number}]"
        if isinstance(step, Actuate | Grasp | Place | Release):
            if step.object is not None:
                _check_object_step(samples, step, where)
        elif isinstance(step, Touch) and step.frame.partition(".")[0] in samples.scene.objects:
            samples.check_frame(step.frame, f"{where}.frame")
            _check_attachment(samples, step.frame.partition(".")[0], step.attachment, where)
        elif isinstance(step, Configure):
            joints = samples.scene.robot.planned_joints
            for joint in step.joints:
                check_choice(joint, joints, "joint of the robot", f"{where}.joints")
        elif isinstance(step, Reach | Touch) and step.frame is not None:
            frames = samples.scene.robot.frame_names
            check_choice(step.frame, frames, "frame of the robot", f"{where}.frame")


def _check_object_step(
    samples: Samples, step: Actuate | Grasp | Place | Release, where: str
) -> None:
    name = step.object or ""
    check_choice(name, samples.scene.objects, "object", f"{where}.object")
    item = samples.scene.objects[name].object
    if isinstance(step, Release):
        return
    if isinstance(step, Grasp) and step.by is not None:
        samples.check_frame(step.by, f"{where}.by")
    _check_attachment(samples, name, step.attachment, where)
    for joint in step.joints if isinstance(step, Actuate) else ():
        check_choice(joint, item.coordinates.names, f"joint of '{name}'", f"{where}.joints")


def _check_attachment(samples: Samples, name: str, attachment: str | None, where: str) -> None:
    if attachment is not None:
        known, kind = samples.scene.objects[name].object.attachments, f"attachment of '{name}'"
        check_choice(attachment, known, kind, f"{where}.attachment")


def check_goals(samples: Samples, steps: Sequence[Step], tolerances: Tolerances) -> list[Violation]:
    """Check that the steps are carried out in their order: constraints "goal" and "order".

    For each step there must be a phase at whose end the goal of the step holds and everything that
    the steps have grasped so far is still grasped; for the last step it is the last phase. Between
    the phases of two steps no object may move except the one that the step actuates, and free
    objects named by steps may be carried only while they should be grasped.
    """
    phases = samples.trajectory.phases
    ends = [0, *(phase.last for phase in phases)]  # a goal may hold at the start
    hands = find_grasped_objects(samples, steps)
    misses = [
        [
            _compute_goal_errors(samples, step, k, tolerances)
            + _find_missing_grasps(samples, steps, hands, number, k)
            for k in range(len(ends))
        ]
        for number, step in enumerate(steps)
    ]
    found, reached = [], 0
    for number in range(len(steps)):
        candidates = [len(ends) - 1] if number == len(steps) - 1 else range(reached, len(ends))
        fit = next((k for k in candidates if not misses[number][k]), None)
        if fit is None:
            best = min(
                (k for k in candidates if k), key=lambda k: max(m.amount for m in misses[number][k])
            )
            found += [
                samples.make_violation("goal", *miss, waypoint=ends[best])
                for miss in misses[number][best]
            ]
        else:
            reached = fit
    holds = [[not missing for missing in row] for row in misses]
    return found or _check_order(samples, steps, hands, holds)


def find_grasped_objects(samples: Samples, steps: Sequence[Step]) -> list[set[str]]:
    """Return the free objects that must be grasped before the first and after each step."""
    objects = samples.scene.objects
    held = {
        hold.object: hold.frame or ""
        for hold in samples.scene.holds
        if objects[hold.object].object.free
    }
    hands = [set(held)]
    for step in steps:
        owner = (
            step.frame.partition(".")[0]
            if isinstance(step, Touch)
            else getattr(step, "object", None)
        )
        if (
            isinstance(step, Grasp | Touch)
            and owner is not None
            and owner in objects
            and objects[owner].object.free
        ):
            held.setdefault(owner, (step.by or "") if isinstance(step, Grasp) else "")
        if isinstance(step, Place | Release):
            released = set(held) if owner is None else {owner}
            while (
                more := {name for name, by in held.items() if by.partition(".")[0] in released}
                - released
            ):
                released |= more
            held = {name: by for name, by in held.items() if name not in released}
        hands.append(set(held))
    return hands


def _find_missing_grasps(
    samples: Samples, steps: Sequence[Step], hands: list[set[str]], number: int, end: int
) -> list[GoalError]:
    """Return the objects that are not grasped after `end` phases although the step needs them."""
    phases = samples.trajectory.phases
    near = {owner for phase in phases[max(end - 1, 0) : end + 1] for owner in phase.held}
    near |= set() if end else set(samples.scene.held)
    wanted = set(hands[number + 1])
    step = steps[number]
    if isinstance(step, Grasp):
        after = next(iter(steps[number + 1 :]), None)
        ends_at_once = isinstance(after, Release) and after.object in (None, step.object)
        if end == len(phases) or ends_at_once:
            wanted.discard(step.object)  # no phase with the grasp follows
    return [GoalError(name, 1.0, "holds", "is not grasped") for name in sorted(wanted - near)]


def _check_order(
    samples: Samples, steps: Sequence[Step], hands: list[set[str]], holds: list[list[bool]]
) -> list[Violation]:
    """Check the order of object motions; `holds[i][k]`: step i holds when phase k begins."""
    phases = samples.trajectory.phases
    named = set().union(*hands, *({step.object} for step in steps if isinstance(step, Place)))
    moved = [
        _measure_joint_motion(samples, k) | _measure_transport(samples, k, named)
        for k in range(len(phases))
    ]
    own = [
        hands[i] | hands[i + 1] | ({step.object} if isinstance(step, Actuate | Place) else set())
        for i, step in enumerate(steps)
    ]
    turns = {0}  # steps that may be in progress
    for k in range(len(phases) + 1):
        for turn in range(len(steps) - 1):
            if turn in turns and holds[turn][k]:
                turns.add(turn + 1)
        if k == len(phases):
            break
        left = {turn for turn in turns if moved[k].keys() <= own[turn]}
        if not left:
            last, phase = max(turns), phases[k]
            name = next(owner for owner in moved[k] if owner not in own[last])
            amount, unit = moved[k][name]
            instead = f"when it is the turn of step {last + 1}, {type(steps[last]).__name__}"
            detail = f"moves by {amount:.4f} {unit} in '{phase.name}', {instead}"
            return [
                samples.make_violation("order", name, amount, unit, detail, waypoint=phase.first)
            ]
        turns = left
    if len(steps) - 1 in turns:
        return []
    first, end = max(turns), phases[-1].last
    detail = f"{type(steps[first]).__name__} is undone before the next step begins"
    return [
        samples.make_violation("order", f"step {first + 1}", 1.0, "steps", detail, waypoint=end)
    ]


def _measure_transport(
    samples: Samples, number: int, named: set[str]
) -> dict[str, tuple[float, str]]:
    """Return the named objects that are grasped in a phase, with their path lengths."""
    phase, world = samples.trajectory.phases[number], samples.world
    rows = samples.z[samples.get_rows(phase)]
    carried = {}
    for owner in phase.held:
        if owner in named:
            moves = np.diff(rows[:, world.get_placement_columns(owner)][:, :3], axis=0)
            carried[owner] = (float(np.linalg.norm(moves, axis=1).sum()), "m")
    return carried


def _measure_joint_motion(samples: Samples, number: int) -> dict[str, tuple[float, str]]:
    """Return the objects whose joints a hand moves in a phase, with the largest joint motion."""
    phase = samples.trajectory.phases[number]
    moved: dict[str, tuple[float, str]] = {}
    driven = samples.find_driven_coordinates(phase.holds)
    for column, name in enumerate(samples.trajectory.names):
        if name not in driven:
            continue
        owner = name.partition(".")[0]
        low, high = (side[phase.first : phase.last, column] for side in samples.ranges)
        if (spread := float(high.max() - low.min())) > MOTION_TOLERANCE:
            moved[owner] = max(moved.get(owner, (0.0, "")), (spread, samples.get_unit(name)))
    return moved


def _compute_goal_errors(
    samples: Samples, step: Step, end: int, tolerances: Tolerances
) -> list[GoalError]:
    """Return the unmet parts of a step's goal after `end` phases."""
    phases = samples.trajectory.phases
    row = int(samples.waypoint_rows[phases[end - 1].last if end else 0])
    tolerance = {"m": tolerances.goal_position, "rad": tolerances.goal_angle}
    misses = list[GoalError]()
    for subject, error, unit, detail in _compute_errors(samples, step, end, row):
        if not error <= tolerance[unit]:
            misses.append(GoalError(subject, error - tolerance[unit], unit, detail))
    if isinstance(step, Place | Release):
        held = phases[min(end, len(phases) - 1)].held  # grasps of the next phase
        for name in [step.object] if step.object is not None else list(held):
            if name in held:
                misses.append(GoalError(name, 1.0, "holds", "is still grasped"))
    return misses


def _compute_errors(samples: Samples, step: Step, end: int, row: int) -> Iterator[GoalError]:
    """Yield how far everything that a step sets is from its goal in a row, after `end` phases."""
    if isinstance(step, Actuate):
        for joint, goal in step.joints.items():
            name = f"{step.object}.{joint}"
            value = float(samples.z[row, samples.world.coordinates.index(name)])
            unit = samples.get_unit(name)
            detail = f"{value:.4f} {unit} instead of {goal:.4f} {unit}"
            yield GoalError(name, abs(value - goal), unit, detail)
    elif isinstance(step, Configure):
        yield from _compute_joint_errors(samples, step, row)
    elif isinstance(step, Grasp):
        phases = samples.trajectory.phases
        near = phases[max(end - 1, 0) : end + 1]  # those that end or begin here
        holds = [hold for phase in near for hold in phase.holds if hold.frame == step.by]
        attachment, (distance, turn) = _find_closest_grasp(samples, step, row, holds)
        name = f"{step.object}.{attachment}"
        yield GoalError(name, distance, "m", f"the tool is {distance:.4f} m from the grasp")
        yield GoalError(name, turn, "rad", f"the tool is turned {turn:.4f} rad from the grasp")
    elif isinstance(step, Reach | Touch | Place):
        frame, target, free = _get_target(samples, step)
        placement = samples.compute_placements([row], frame)[0]
        distance = float(np.linalg.norm(placement.translation - target.translation))
        yield GoalError(frame, distance, "m", f"{distance:.4f} m from its target")
        turn = _compute_angle_error(placement, target, free)
        detail = f"turned {turn:.4f} rad from its target orientation"
        yield GoalError(frame, turn, "rad", detail)
    elif isinstance(step, GoTo):
        x, y, yaw = samples.z[row, :3]
        distance = float(np.hypot(x - step.x, y - step.y))
        yield GoalError("base", distance, "m", f"{distance:.4f} m from its target")
        if step.yaw is not None:
            turn = float(abs(wrap_angle(yaw - step.yaw)))
            detail = f"turned {turn:.4f} rad from its target heading"
            yield GoalError("base heading", turn, "rad", detail)


def _compute_joint_errors(samples: Samples, step: Configure, row: int) -> Iterator[GoalError]:
    """Yield how far each joint of a step is outside its tolerance."""
    robot = samples.scene.robot
    for joint, goal in step.joints.items():
        move = robot.planned_joints[joint]
        value = move.factor * float(samples.z[row, move.coordinate]) + move.offset
        error = value - goal
        if robot.is_periodic(move.coordinate):
            error = float(wrap_angle(error))
        unit = "m" if move.slides else "rad"
        detail = f"{value:.4f} {unit} instead of {goal:.4f} {unit}"
        yield GoalError(joint, abs(error) - step.get_tolerance(joint), unit, detail)


def _get_target(samples: Samples, step: Reach | Touch | Place) -> tuple[str, pin.SE3, str]:
    """Return a step's frame, its target and its free orientation: "", "heading" or "all"."""
    if isinstance(step, Reach):
        return step.frame or samples.scene.robot.tool_frame, step.pose, ""
    goal = step.target if isinstance(step, Touch) else step.pose
    frame = (
        step.frame
        if isinstance(step, Touch)
        else f"{step.object}.{samples.scene.objects[step.object].object.base_link}"
    )
    if isinstance(goal, pin.SE3):
        return frame, goal, ""
    if isinstance(step, Touch):
        return frame, pin.SE3(np.eye(3), np.array(goal)), "all"
    placed = samples.scene.objects[step.object]
    stands = np.eye(3) if step.object in samples.scene.held else placed.placement.rotation
    return frame, pin.SE3(stands, np.array(goal)), "heading"


def _compute_angle_error(placement: pin.SE3, target: pin.SE3, free: str) -> float:
    """Compute the angle [rad] between two placements, ignoring the free part."""
    if free == "all":
        return 0.0
    if free == "heading":  # the angle between the two vertical axes in the body frame
        one, other = placement.rotation[2], target.rotation[2]
        return float(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))
    return float(np.linalg.norm(pin.log3(target.rotation.T @ placement.rotation)))


def make_hold(scene: Scene, step: Grasp, attachment: str) -> Hold:
    """Make the hold that a step establishes; holds of the object in between are ignored."""
    owner, _, link = (step.by or "").partition(".")
    through = Hold(owner, scene.objects[owner].object.attachment().name) if step.by else None
    return Hold(step.object, attachment, through, link or None)


def _find_closest_grasp(
    samples: Samples, step: Grasp, row: int, holds: Iterable[Hold]
) -> tuple[str, tuple[float, float]]:
    """Return a grasp step's attachment and the tool's distance [m] and angle [rad] from it.

    Without a name, it is the nearest attachment that is used at the start or in a phase. The
    distance from one of `holds`, those just before and after, is that from the grasp as measured.
    """
    used = [samples.scene.held, *(phase.held for phase in samples.trajectory.phases)]
    names = (
        [step.attachment]
        if step.attachment is not None
        else [held[step.object] for held in used if step.object in held]
    )
    names = names or [samples.scene.objects[step.object].object.attachment().name]
    known = {hold.attachment: hold for hold in holds if hold.object == step.object}
    errors = {
        name: samples.compute_grasp_errors(
            known.get(name) or make_hold(samples.scene, step, name), np.array([row])
        )[0]
        for name in names
    }
    name = min(errors, key=lambda key: float(errors[key].max()))
    return name, (float(errors[name][0]), float(errors[name][1]))
