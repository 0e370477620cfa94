"""Measures by how much an execution misses the goals of its steps, where objects really are."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.articulated_object import Attachment
from vkc_pin.world.models.coordinates import wrap_angle
from vkc_pin.world.scene.contact_rules import compute_hand_frame
from vkc_pin.world.scene.hold import (
    apply_deviation,
    compute_distances,
    is_within_grasp,
    measure_deviation,
)
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
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

__all__ = ["Miss", "measure_goal_errors"]

_TOLERANCE = 2e-3  # [m] or [rad] within which a plan counts as having completed a step
_LASTING = (Actuate, Place, Release)  # steps after which objects stay where they are


@dataclass(frozen=True)
class Miss:
    """Distance of a subject from the goal of a step.

    Attributes:
        step: Number of the step, from 1.
        subject: Coordinate, frame or object.
        amount: Distance from the goal, in `unit`.
        unit: "m" or "rad".
        time: Time of the measurement [s].
    """

    step: int
    subject: str
    amount: float
    unit: str
    time: float

    def __str__(self) -> str:
        amount = f"{1e3 * self.amount:.1f} mm" if self.unit == "m" else f"{self.amount:.4f} rad"
        return f"step {self.step}: {self.subject} misses its goal by {amount} at {self.time:.2f} s"

    def to_dict(self) -> dict[str, Any]:
        """Return the miss as plain data."""
        return asdict(self)


Errors = Iterator[tuple[str, float, str]]
"""Subjects, each with its distance from the goal and the unit."""


def measure_goal_errors(
    scene: Scene,
    steps: Sequence[Step],
    trajectory: Trajectory,
    world: World,
    times: Floats,
    rows: Floats,
) -> tuple[Miss, ...]:
    """Return the error of every goal.

    Each step is measured when the plan completes it for the first time, in order; the last step is
    measured at the end. Objects that are moved or released must stay where the plan leaves them:
    they are measured when it moves them on, or else at the end.

    Args:
        scene: Scene of the plan.
        steps: Steps of the task.
        trajectory: The plan.
        world: World of the execution, where objects may stand elsewhere.
        times: Times of the executed motion, shape (K,) [s].
        rows: World coordinates at these times, shape (K, n).
    """
    goals = _Goals(World(scene), world, trajectory)
    completed, errors, last = 0, list[Miss](), len(goals.edges) - 1
    for number, step in enumerate(steps):
        if number == len(steps) - 1:
            completed = last
        while completed < last and not goals.is_completed(step, completed):
            completed += 1
        edge = completed
        if isinstance(step, _LASTING):
            while edge < last and goals.is_completed(step, edge + 1):
                edge += 1
        at = float(trajectory.times[goals.edges[edge]])
        row = len(times) - 1 if edge == last else int(np.argmin(np.abs(times - at)))
        for subject, amount, unit in goals.compute_errors(step, completed, edge, rows[row]):
            errors.append(Miss(number + 1, subject, amount, unit, float(times[row])))
    return tuple(errors)


class _Goals:
    """Goals of steps, in a plan and in its execution.

    Attributes:
        planned: World of the plan.
        world: World of the execution.
        trajectory: The plan.
        edges: Waypoints between phases, the first and the last one included.
        ends: World coordinates of the plan there, shape (edges, n).
    """

    def __init__(self, planned: World, world: World, trajectory: Trajectory) -> None:
        self.planned, self.world, self.trajectory = planned, world, trajectory
        self.edges = [0, *(phase.last for phase in trajectory.phases)]
        self.ends = planned.compute_positions(trajectory, trajectory.times[self.edges])

    def is_completed(self, step: Step, edge: int) -> bool:
        """Return whether the plan has completed a step at an edge."""
        if isinstance(step, Grasp | Release):
            phases = self.trajectory.phases
            held = phases[min(edge, len(phases) - 1)].held  # after the edge
            if step.object is None:
                return not held
            return (step.object in held) == isinstance(step, Grasp)
        errors = _compute_goal_errors(self.planned, self.planned.scene, step, self.ends[edge])
        return all(amount <= _TOLERANCE for _, amount, _ in errors)

    def compute_errors(self, step: Step, completed: int, edge: int, row: Floats) -> Errors:
        """Yield the errors of a step in the execution.

        Args:
            step: The step.
            completed: Edge at which the plan completes it.
            edge: Edge at which it is measured.
            row: World coordinates of the execution there, shape (n,).
        """
        if isinstance(step, Grasp):
            yield from self._compute_grasp_errors(step, self.ends[edge], row)
        elif isinstance(step, Release):
            yield from self._compute_release_errors(step, completed, self.ends[edge], row)
        else:
            yield from _compute_goal_errors(self.world, self.planned.scene, step, row)

    def _compute_grasp_errors(self, step: Grasp, planned: Floats, row: Floats) -> Errors:
        """Yield how far the hand is from the attachment, compared with the plan.

        The attachment is the first one that the plan grasps there; its freedoms are free.
        """
        item = self.planned.scene.objects[step.object].object
        attachment = item.attachment(step.attachment)
        candidates = item.attachments.values() if step.attachment is None else [attachment]
        for candidate in candidates:
            deviation = _measure_grasp(self.planned, step, candidate, planned)
            if is_within_grasp(*compute_distances(deviation)):
                attachment = apply_deviation(candidate, deviation.tolist())
                break
        distance, angle = compute_distances(_measure_grasp(self.world, step, attachment, row))
        yield f"grasp of {step.object}", distance, "m"
        yield f"grasp of {step.object}", angle, "rad"

    def _compute_release_errors(
        self, step: Release, completed: int, planned: Floats, row: Floats
    ) -> Errors:
        """Yield how far released free objects are from where the plan leaves them."""
        released = self._find_released(step, completed)
        for name, placed in self.planned.scene.objects.items():
            if name in released and placed.object.free:
                goal = self.planned.get_placement(name, planned)
                off = goal.actInv(self.world.get_placement(name, row))
                yield name, float(np.linalg.norm(off.translation)), "m"
                yield name, float(np.linalg.norm(pin.log3(off.rotation))), "rad"

    def _find_released(self, step: Release, completed: int) -> Mapping[str, str]:
        """Return the objects that a step releases: those that were held last before."""
        before = [self.planned.scene.held]
        before += [phase.held for phase in self.trajectory.phases[:completed]]
        held = next((held for held in reversed(before) if held), {})
        return {name: held[name] for name in held if step.object in (None, name)}


def _measure_grasp(world: World, step: Grasp, attachment: Attachment, row: Floats) -> Floats:
    """Return how far the grasping frame is from an attachment; see `measure_deviation`."""
    robot = world.scene.robot
    hand = _compute_placement(world, row, step.by or robot.tool_frame)
    if step.by is None:
        hand = hand * compute_hand_frame(robot, attachment)
    link = _compute_placement(world, row, f"{step.object}.{attachment.link}")
    _, deviation = measure_deviation(attachment, hand.actInv(link * attachment.placement))
    return deviation


def _compute_goal_errors(world: World, scene: Scene, step: Step, row: Floats) -> Errors:
    """Yield the error of each subject of a step with a goal at configuration `row`.

    Args:
        world: The world that `row` is of.
        scene: Scene of the plan.
        step: The step.
        row: World coordinates, shape (n,).
    """
    names, units = world.coordinates.names, world.coordinates.units
    if isinstance(step, Actuate):
        for joint, goal in step.joints.items():
            column = names.index(f"{step.object}.{joint}")
            yield names[column], abs(float(row[column]) - goal), units[column]
    elif isinstance(step, Configure):
        robot = world.scene.robot
        for joint, goal in step.joints.items():
            move = robot.planned_joints[joint]
            error = move.factor * float(row[move.coordinate]) + move.offset - goal
            if robot.is_periodic(move.coordinate):
                error = float(wrap_angle(error))
            beyond = max(abs(error) - step.get_tolerance(joint), 0.0)
            yield joint, beyond, "m" if move.slides else "rad"
    elif isinstance(step, GoTo):
        yield "base", float(np.hypot(row[0] - step.x, row[1] - step.y)), "m"
        if step.yaw is not None:
            yield "base heading", float(abs(wrap_angle(row[2] - step.yaw))), "rad"
    elif isinstance(step, Reach | Touch | Place):
        yield from _compute_pose_errors(world, scene, step, row)


def _compute_pose_errors(
    world: World, scene: Scene, step: Reach | Touch | Place, row: Floats
) -> Errors:
    """Yield the position and orientation errors of a step with a pose goal."""
    if isinstance(step, Place):
        frame = f"{step.object}.{scene.objects[step.object].object.base_link}"
    else:
        frame = step.frame or scene.robot.tool_frame
    goal: Any = step.target if isinstance(step, Touch) else step.pose
    placement, has_pose = _compute_placement(world, row, frame), isinstance(goal, pin.SE3)
    position = goal.translation if has_pose else np.asarray(goal)
    yield frame, float(np.linalg.norm(placement.translation - position)), "m"
    if has_pose:
        yield frame, float(np.linalg.norm(pin.log3(goal.rotation.T @ placement.rotation))), "rad"
    elif isinstance(step, Place):  # any heading, the same tilt as at the start
        is_held = step.object in scene.held
        at_start = scene.objects[step.object].placement.rotation[2]
        vertical = np.array([0.0, 0.0, 1.0]) if is_held else at_start
        yield frame, float(np.arccos(np.clip(placement.rotation[2] @ vertical, -1.0, 1.0))), "rad"


def _compute_placement(world: World, row: Floats, frame: str) -> pin.SE3:
    """Return the placement of a frame at configuration `row`."""
    data = world.model.createData()
    pin.forwardKinematics(world.model, data, world.coordinates.q(row))
    return pin.updateFramePlacement(world.model, data, world.model.getFrameId(frame)).copy()
