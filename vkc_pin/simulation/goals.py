"""Measures the goal errors of an executed motion."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.coordinates import wrap_angle
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.steps import Actuate, GoTo, Grasp, Place, Reach, Release, Step, Touch
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

__all__ = ["Miss", "measure_goal_errors"]

_TOLERANCE = 2e-3  # [m] or [rad] within which a plan counts as having completed a step


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
    measured at the end.
    """
    planned = World(scene)
    edges = [0, *(phase.last for phase in trajectory.phases)]
    ends = planned.compute_positions(trajectory, trajectory.times[edges])
    start, errors, last = 0, list[Miss](), len(ends) - 1

    def is_completed(step: Step, k: int) -> bool:
        if isinstance(step, Grasp | Release):
            held = trajectory.phases[k].held
            return (
                (step.object in held) == isinstance(step, Grasp)
                if step.object is not None
                else not held
            )
        return all(
            amount <= _TOLERANCE
            for _, amount, _ in _compute_errors(planned, step, ends[k], ends[k])
        )

    for number, step in enumerate(steps):
        completed = (k for k in range(start, last) if is_completed(step, k))
        start = last if number == len(steps) - 1 else next(completed, last)
        at = float(trajectory.times[edges[start]])
        row = len(times) - 1 if start == last else int(np.argmin(np.abs(times - at)))
        for subject, amount, unit in _compute_errors(world, step, rows[row], ends[start]):
            errors.append(Miss(number + 1, subject, amount, unit, float(times[row])))
    return tuple(errors)


def _compute_errors(
    world: World, step: Step, row: Floats, planned: Floats
) -> Iterator[tuple[str, float, str]]:
    """Yield the error of each subject of a step at configuration `row`."""
    names, units = world.coordinates.names, world.coordinates.units
    if isinstance(step, Actuate):
        for joint, goal in step.joints.items():
            column = names.index(f"{step.object}.{joint}")
            yield names[column], abs(float(row[column]) - goal), units[column]
    elif isinstance(step, GoTo):
        yield "base", float(np.hypot(row[0] - step.x, row[1] - step.y)), "m"
        if step.yaw is not None:
            yield "base heading", float(abs(wrap_angle(row[2] - step.yaw))), "rad"
    elif isinstance(step, Grasp):
        scene = world.scene
        link = f"{step.object}.{scene.objects[step.object].object.attachment(step.attachment).link}"
        hand = step.by or scene.robot.tool_frame
        one, other = (
            _compute_placement(world, at, link).actInv(_compute_placement(world, at, hand))
            for at in (row, planned)
        )
        offset = float(np.linalg.norm(one.translation - other.translation))
        yield f"grasp of {step.object}", offset, "m"
    elif isinstance(step, Reach | Touch | Place):
        yield from _compute_pose_errors(world, step, row)


def _compute_pose_errors(
    world: World, step: Reach | Touch | Place, row: Floats
) -> Iterator[tuple[str, float, str]]:
    """Yield the position and orientation errors of a step with a pose goal."""
    robot = world.scene.robot
    if isinstance(step, Place):
        frame = f"{step.object}.{world.scene.objects[step.object].object.base_link}"
    else:
        frame = step.frame or robot.tool_frame
    goal: Any = step.target if isinstance(step, Touch) else step.pose
    placement, has_pose = _compute_placement(world, row, frame), isinstance(goal, pin.SE3)
    position = goal.translation if has_pose else np.asarray(goal)
    yield frame, float(np.linalg.norm(placement.translation - position)), "m"
    if has_pose:
        yield frame, float(np.linalg.norm(pin.log3(goal.rotation.T @ placement.rotation))), "rad"
    elif isinstance(step, Place):  # any heading, the same tilt as at the start
        is_held = step.object in world.scene.held
        at_start = world.scene.objects[step.object].placement.rotation[2]
        vertical = np.array([0.0, 0.0, 1.0]) if is_held else at_start
        yield frame, float(np.arccos(np.clip(placement.rotation[2] @ vertical, -1.0, 1.0))), "rad"


def _compute_placement(world: World, row: Floats, frame: str) -> pin.SE3:
    """Return the placement of a frame at configuration `row`."""
    data = world.model.createData()
    pin.forwardKinematics(world.model, data, world.coordinates.q(row))
    return pin.updateFramePlacement(world.model, data, world.model.getFrameId(frame)).copy()
