"""Checks that a motion reaches the goals of its steps in their order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arguments import check_choice
from vkc_pin.utils.arrays import Floats
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

# smaller displacements do not count as motion [m] or [rad]
MOTION_TOLERANCE = 1e-5


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
        elif isinstance(step, Touch) and _get_owner(step.frame) in samples.scene.objects:
            samples.check_frame(step.frame, f"{where}.frame")
            _check_attachment(samples, _get_owner(step.frame), step.attachment, where)
        elif isinstance(step, Configure):
            joints = samples.scene.robot.planned_joints
            for joint in step.joints:
                check_choice(joint, joints, "joint of the robot", f"{where}.joints")
        elif isinstance(step, Reach | Touch) and step.frame is not None:
            frames = samples.scene.robot.frame_names
            check_choice(step.frame, frames, "frame of the robot", f"{where}.frame")


def _get_owner(name: str) -> str:
    """Return the object of a name "<object>.<link>" or "<object>.<joint>"."""
    return name.partition(".")[0]


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
    if isinstance(step, Actuate):
        for joint in step.joints:
            check_choice(joint, item.coordinates.names, f"joint of '{name}'", f"{where}.joints")


def _check_attachment(samples: Samples, name: str, attachment: str | None, where: str) -> None:
    if attachment is not None:
        known = samples.scene.objects[name].object.attachments
        check_choice(attachment, known, f"attachment of '{name}'", f"{where}.attachment")


def check_goals(samples: Samples, steps: Sequence[Step], tolerances: Tolerances) -> list[Violation]:
    """Check that the steps are carried out in their order: constraints "goal" and "order".

    For each step there must be a phase at whose end the goal of the step holds and everything that
    the steps have grasped so far is still grasped; for the last step it is the last phase. Between
    the phases of two steps no object may move except the one that the step actuates, and free
    objects named by steps may be carried only while they should be grasped.
    """
    phases = samples.trajectory.phases
    ends = [0, *(phase.last for phase in phases)]  # a goal may hold at the start
    grasped = find_grasped_objects(samples, steps)
    last_step = len(steps) - 1
    found: list[Violation] = []
    holds: list[list[bool]] = []
    reached = 0  # the number of phases after which the goal of the step before holds first
    for number, step in enumerate(steps):
        misses: list[list[GoalError]] = []  # by the number of phases before
        for end in range(len(ends)):
            errors = _compute_goal_errors(samples, step, end, tolerances)
            errors += _find_missing_grasps(samples, steps, grasped, number, end)
            misses.append(errors)
        is_met = [not errors for errors in misses]
        holds.append(is_met)
        begin = len(ends) - 1 if number == last_step else reached
        if True in is_met[begin:]:
            reached = is_met.index(True, begin)
            continue
        best = _find_nearest_end(misses, max(begin, 1))
        for miss in misses[best]:
            found.append(samples.make_violation("goal", *miss, waypoint=ends[best]))
    return found or _check_order(samples, steps, grasped, holds)


def _find_nearest_end(misses: list[list[GoalError]], begin: int) -> int:
    """Return the first number of phases, from `begin` on, with the smallest largest miss."""

    def find_largest(end: int) -> float:
        return max(miss.amount for miss in misses[end])

    return min(range(begin, len(misses)), key=find_largest)


def find_grasped_objects(samples: Samples, steps: Sequence[Step]) -> list[set[str]]:
    """Return the free objects that must be grasped before the first and after each step."""
    objects = samples.scene.objects
    # The grasped objects, with the frame by which each is grasped; "" is the hand.
    frames: dict[str, str] = {}
    for hold in samples.scene.holds:
        if objects[hold.object].object.free:
            frames[hold.object] = hold.frame or ""
    grasped = [set(frames)]
    for step in steps:
        if isinstance(step, Grasp):
            owner = step.object
            frame = step.by or ""
        elif isinstance(step, Touch):
            owner = _get_owner(step.frame)
            frame = ""
        else:
            owner = ""
            frame = ""
        if owner in objects and objects[owner].object.free:
            frames.setdefault(owner, frame)
        if isinstance(step, Place | Release):
            released = set(frames) if step.object is None else _list_held_by(frames, step.object)
            frames = {name: frame for name, frame in frames.items() if name not in released}
        grasped.append(set(frames))
    return grasped


def _list_held_by(frames: dict[str, str], owner: str) -> set[str]:
    """Return an object and all objects that it holds, that these hold, and so on."""
    found = {owner}
    while True:
        more = {name for name, frame in frames.items() if _get_owner(frame) in found}
        if more <= found:
            return found
        found |= more


def _find_missing_grasps(
    samples: Samples, steps: Sequence[Step], grasped: list[set[str]], number: int, end: int
) -> list[GoalError]:
    """Return the objects that are not grasped after `end` phases although the step needs them."""
    phases = samples.trajectory.phases
    present = set[str]()
    for phase in phases[max(end - 1, 0) : end + 1]:
        present.update(phase.held)
    if end == 0:
        present.update(samples.scene.held)
    wanted = set(grasped[number + 1])
    step = steps[number]
    if isinstance(step, Grasp):
        after = steps[number + 1] if number + 1 < len(steps) else None
        ends_at_once = isinstance(after, Release) and after.object in (None, step.object)
        if end == len(phases) or ends_at_once:
            wanted.discard(step.object)  # no phase with the grasp follows
    return [GoalError(name, 1.0, "holds", "is not grasped") for name in sorted(wanted - present)]


def _check_order(
    samples: Samples, steps: Sequence[Step], grasped: list[set[str]], holds: list[list[bool]]
) -> list[Violation]:
    """Check the order of object motions; `holds[i][k]`: step i holds when phase k begins.

    The motion is read phase by phase. Several steps may be in progress then, since the goals of
    some may hold already. A step remains if it may move all that moves in the phase.
    """
    phases = samples.trajectory.phases
    named = set[str]().union(*grasped)
    movable: list[set[str]] = []  # the objects that each step may move
    for number, step in enumerate(steps):
        owners = grasped[number] | grasped[number + 1]
        if isinstance(step, Actuate | Place):
            owners.add(step.object)
        if isinstance(step, Place):
            named.add(step.object)
        movable.append(owners)
    last_step = len(steps) - 1
    current = {0}  # steps that may be in progress
    for k, phase in enumerate(phases):
        _advance(current, holds, k, last_step)
        moved = _measure_joint_motion(samples, k)
        moved.update(_measure_transport(samples, k, named))
        remaining = {number for number in current if moved.keys() <= movable[number]}
        if not remaining:
            latest = max(current)
            name = next(owner for owner in moved if owner not in movable[latest])
            amount, unit = moved[name]
            instead = f"when it is the turn of step {latest + 1}, {type(steps[latest]).__name__}"
            detail = f"moves by {amount:.4f} {unit} in '{phase.name}', {instead}"
            return [
                samples.make_violation("order", name, amount, unit, detail, waypoint=phase.first)
            ]
        current = remaining
    _advance(current, holds, len(phases), last_step)
    if last_step in current:
        return []
    latest = max(current)
    detail = f"{type(steps[latest]).__name__} is undone before the next step begins"
    return [
        samples.make_violation(
            "order", f"step {latest + 1}", 1.0, "steps", detail, waypoint=phases[-1].last
        )
    ]


def _advance(current: set[int], holds: list[list[bool]], phase: int, last_step: int) -> None:
    """Add the steps that may begin when a phase begins, since those before them hold."""
    for number in range(last_step):
        if number in current and holds[number][phase]:
            current.add(number + 1)


def _measure_transport(
    samples: Samples, number: int, named: set[str]
) -> dict[str, tuple[float, str]]:
    """Return the named objects that are grasped in a phase, with their path lengths."""
    phase = samples.trajectory.phases[number]
    z = samples.z[samples.get_rows(phase)]
    carried: dict[str, tuple[float, str]] = {}
    for owner in phase.held:
        if owner in named:
            placements = z[:, samples.world.get_placement_columns(owner)]
            steps = np.diff(placements[:, :3], axis=0)
            carried[owner] = (float(np.linalg.norm(steps, axis=1).sum()), "m")
    return carried


def _measure_joint_motion(samples: Samples, number: int) -> dict[str, tuple[float, str]]:
    """Return the objects whose joints a hand moves in a phase, with the largest joint motion."""
    phase = samples.trajectory.phases[number]
    moved: dict[str, tuple[float, str]] = {}
    driven = samples.find_driven_coordinates(phase.holds)
    for column, name in enumerate(samples.trajectory.names):
        if name not in driven:
            continue
        owner = _get_owner(name)
        low, high = (side[phase.first : phase.last, column] for side in samples.ranges)
        spread = float(high.max() - low.min())
        if spread > MOTION_TOLERANCE:
            known = moved.get(owner, (0.0, ""))
            moved[owner] = max(known, (spread, samples.get_unit(name)))
    return moved


def _compute_goal_errors(
    samples: Samples, step: Step, end: int, tolerances: Tolerances
) -> list[GoalError]:
    """Return the unmet parts of a step's goal after `end` phases."""
    phases = samples.trajectory.phases
    waypoint = phases[end - 1].last if end else 0
    row = int(samples.waypoint_rows[waypoint])
    tolerance = {"m": tolerances.goal_position, "rad": tolerances.goal_angle}
    misses: list[GoalError] = []
    for subject, error, unit, detail in _compute_errors(samples, step, end, row):
        if not error <= tolerance[unit]:
            misses.append(GoalError(subject, error - tolerance[unit], unit, detail))
    if isinstance(step, Place | Release):
        held = phases[min(end, len(phases) - 1)].held  # grasps of the next phase
        for name in held:
            if step.object in (None, name):
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
        attachment, distance, turn = _find_closest_grasp(samples, step, end, row)
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
    if isinstance(step, Touch):
        if isinstance(step.target, pin.SE3):
            return step.frame, step.target, ""
        return step.frame, pin.SE3(np.eye(3), np.array(step.target)), "all"
    placed = samples.scene.objects[step.object]
    frame = f"{step.object}.{placed.object.base_link}"
    if isinstance(step.pose, pin.SE3):
        return frame, step.pose, ""
    upright = np.eye(3) if step.object in samples.scene.held else placed.placement.rotation
    return frame, pin.SE3(upright, np.array(step.pose)), "heading"


def _compute_angle_error(placement: pin.SE3, target: pin.SE3, free: str) -> float:
    """Compute the angle [rad] between two placements, ignoring the free part."""
    if free == "all":
        return 0.0
    if free == "heading":
        return measure_tilt(placement, target)
    return float(np.linalg.norm(pin.log3(target.rotation.T @ placement.rotation)))


def measure_tilt(placement: pin.SE3, other: pin.SE3) -> float:
    """Return the angle between the world's vertical axes in the frames of two placements [rad]."""
    vertical = placement.rotation[2]
    other_vertical = other.rotation[2]
    sine = float(np.linalg.norm(np.cross(vertical, other_vertical)))
    return float(np.arctan2(sine, vertical @ other_vertical))


def make_hold(scene: Scene, step: Grasp, attachment: str) -> Hold:
    """Make the hold that a step establishes; holds of the object in between are ignored."""
    owner, _, link = (step.by or "").partition(".")
    through = Hold(owner, scene.objects[owner].object.attachment().name) if step.by else None
    return Hold(step.object, attachment, through, link or None)


def _find_closest_grasp(
    samples: Samples, step: Grasp, end: int, row: int
) -> tuple[str, float, float]:
    """Return a grasp step's attachment and the tool's distance [m] and angle [rad] from it.

    Without a name, it is the nearest attachment that is used at the start or in a phase. The
    distance from a hold of the phases that end or begin after `end` phases is that from the grasp
    as measured.
    """
    phases = samples.trajectory.phases
    known: dict[str, Hold] = {}
    for phase in phases[max(end - 1, 0) : end + 1]:
        for hold in phase.holds:
            if hold.frame == step.by and hold.object == step.object:
                known[hold.attachment] = hold
    errors: dict[str, Floats] = {}
    for name in _list_candidates(samples, step):
        hold = known[name] if name in known else make_hold(samples.scene, step, name)
        errors[name] = samples.compute_grasp_errors(hold, np.array([row]))[0]
    name = min(errors, key=lambda key: float(errors[key].max()))
    distance, angle = errors[name]
    return name, float(distance), float(angle)


def _list_candidates(samples: Samples, step: Grasp) -> list[str]:
    """Return the attachments that a grasp step may mean, without repetition."""
    if step.attachment is not None:
        return [step.attachment]
    used = [samples.scene.held, *(phase.held for phase in samples.trajectory.phases)]
    names = dict.fromkeys(held[step.object] for held in used if step.object in held)
    return list(names) or [samples.scene.objects[step.object].object.attachment().name]
