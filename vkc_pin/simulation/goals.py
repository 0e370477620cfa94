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
    Hold,
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
from vkc_pin.world.trajectory.free_objects import FreeObjects
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

# [m] or [rad] within which a plan counts as having completed a step
_TOLERANCE = 2e-3
# steps after which objects stay where they are
_LASTING = (Actuate, Place, Release)


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
    measured at the end. Objects that are moved or released must stay where the plan leaves them,
    and those that are carried along must stay on their supports: they are measured when the plan
    moves them on, or else at the end.

    Args:
        scene: Scene of the plan.
        steps: Steps of the task.
        trajectory: The plan.
        world: World of the execution, where objects may stand elsewhere.
        times: Times of the executed motion, shape (K,) [s].
        rows: World coordinates at these times, shape (K, n).
    """
    goals = _Goals(World(scene), world, trajectory)
    last = len(goals.edges) - 1
    misses: list[Miss] = []

    def find_row(edge: int) -> int:
        if edge == last:
            return len(times) - 1
        time = float(trajectory.times[goals.edges[edge]])
        return int(np.argmin(np.abs(times - time)))

    def add_misses(number: int, row: int, errors: Errors) -> None:
        for subject, amount, unit in errors:
            misses.append(Miss(number, subject, amount, unit, float(times[row])))

    completed = 0  # the edge at which the plan has completed the step
    for number, step in enumerate(steps, start=1):
        before = completed
        if number == len(steps):
            completed = last
        while completed < last and not goals.is_completed(step, completed):
            completed += 1
        measured = completed
        if isinstance(step, _LASTING):
            while measured < last and goals.is_completed(step, measured + 1):
                measured += 1
        row = find_row(measured)
        add_misses(number, row, goals.compute_errors(step, completed, measured, rows[row]))
        for name, support in goals.list_supported_objects(before, completed).items():
            edge = goals.find_rest(name, completed)
            row = find_row(edge)
            add_misses(number, row, goals.compute_support_errors(name, support, edge, rows[row]))
    return tuple(misses)


class _Goals:
    """Goals of steps, in a plan and in its execution.

    Attributes:
        planned: World of the plan.
        world: World of the execution.
        trajectory: The plan.
        edges: Waypoints between phases, the first and the last one included.
        ends: World coordinates of the plan there, shape (edges, n).
        supports: For every phase, supported free object → supporting link.
    """

    def __init__(self, planned: World, world: World, trajectory: Trajectory) -> None:
        self.planned = planned
        self.world = world
        self.trajectory = trajectory
        self.edges = [0, *(phase.last for phase in trajectory.phases)]
        free = FreeObjects(planned.scene, trajectory)
        self.ends = planned.compute_positions(trajectory, trajectory.times[self.edges], free)
        self.supports = free.supports

    def is_completed(self, step: Step, edge: int) -> bool:
        """Return whether the plan has completed a step at an edge."""
        if isinstance(step, Grasp):
            return self._find_grasp(step, edge) is not None
        if isinstance(step, Release):
            held = {hold.object for hold in self._get_holds_after(edge)}
            return not held if step.object is None else step.object not in held
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
            yield from self._compute_grasp_errors(step, edge, row)
        elif isinstance(step, Release):
            yield from self._compute_release_errors(step, completed, edge, row)
        else:
            yield from _compute_goal_errors(self.world, self.planned.scene, step, row)

    def list_supported_objects(self, before: int, completed: int) -> Mapping[str, str]:
        """Return the free objects that others carry along between two edges, and on which link."""
        found: dict[str, str] = {}
        for supports in self.supports[before:completed]:
            found |= supports
        return found

    def find_rest(self, name: str, edge: int) -> int:
        """Return the last edge until which the plan leaves a free object where it is at `edge`."""
        there = self.planned.get_placement(name, self.ends[edge])
        while edge + 1 < len(self.edges):
            later = self.planned.get_placement(name, self.ends[edge + 1])
            if np.abs(pin.log6(there.actInv(later)).vector).max() > _TOLERANCE:
                break
            edge += 1
        return edge

    def compute_support_errors(self, name: str, support: str, edge: int, row: Floats) -> Errors:
        """Yield how far a free object has moved on its support, and tilted, since the plan's edge.

        Contacts let an object turn about the vertical by some 10 mrad, which does not count.

        Args:
            name: The object.
            support: Link that it is on, "<object>.<link>".
            edge: Edge of the plan.
            row: World coordinates of the execution there, shape (n,).
        """
        planned_support = compute_placement(self.planned, self.ends[edge], support)
        actual_support = compute_placement(self.world, row, support)
        # The object's placements on its support.
        planned = planned_support.actInv(self.planned.get_placement(name, self.ends[edge]))
        actual = actual_support.actInv(self.world.get_placement(name, row))
        shift = float(np.linalg.norm(actual.translation - planned.translation))
        vertical = planned_support.rotation[2]  # in the support's frame
        cosine = (planned.rotation.T @ vertical) @ (actual.rotation.T @ vertical)
        tilt = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        subject = f"{name} on {support}"
        yield subject, shift, "m"
        yield subject, tilt, "rad"

    def _get_holds_after(self, edge: int) -> Sequence[Hold]:
        """Return the holds of the phase that begins at an edge; at the end, those of the last."""
        phases = self.trajectory.phases
        return phases[min(edge, len(phases) - 1)].holds

    def _find_grasp(self, step: Grasp, edge: int) -> Attachment | None:
        """Return the attachment at which the plan grasps an object at an edge; None: it does not.

        The plan holds the object after the edge, or the hand is at an attachment but lets go of it
        at once, so that no phase holds the object. A grasp that is held has the plan's deviation.
        """
        item = self.planned.scene.objects[step.object].object
        planned = self.ends[edge]
        for hold in self._get_holds_after(edge):
            is_wanted = step.attachment in (None, hold.attachment) and step.by == hold.frame
            if hold.object != step.object or not is_wanted:
                continue
            attachment = item.attachment(hold.attachment)
            deviation = _measure_grasp(self.planned, step, attachment, planned)
            if is_within_grasp(*compute_distances(deviation)):
                return apply_deviation(attachment, deviation.tolist())
            return attachment
        names = item.attachments if step.attachment is None else [step.attachment]
        for name in names:
            attachment = item.attachment(name)
            deviation = _measure_grasp(self.planned, step, attachment, planned)
            if max(compute_distances(deviation)) <= _TOLERANCE:
                return attachment
        return None

    def _compute_grasp_errors(self, step: Grasp, edge: int, row: Floats) -> Errors:
        """Yield how far the hand is from the attachment, compared with the plan.

        Freedoms of the attachment are free.
        """
        attachment = self._find_grasp(step, edge)
        if attachment is None:  # the plan does not complete the step
            attachment = self.planned.scene.objects[step.object].object.attachment(step.attachment)
        distance, angle = compute_distances(_measure_grasp(self.world, step, attachment, row))
        yield f"grasp of {step.object}", distance, "m"
        yield f"grasp of {step.object}", angle, "rad"

    def _compute_release_errors(
        self, step: Release, completed: int, edge: int, row: Floats
    ) -> Errors:
        """Yield how far released objects are from where the plan leaves them.

        Levers that release a latch may return.
        """
        released = self._find_released(step, completed)
        coordinates = self.planned.coordinates
        for name, placed in self.planned.scene.objects.items():
            if name not in released:
                continue
            if placed.object.free:
                planned = self.planned.get_placement(name, self.ends[edge])
                offset = planned.actInv(self.world.get_placement(name, row))
                yield name, float(np.linalg.norm(offset.translation)), "m"
                yield name, float(np.linalg.norm(pin.log3(offset.rotation))), "rad"
            levers = {latch.released_by for latch in placed.object.latches}
            for joint in placed.object.coordinates.names:
                if joint not in levers:
                    column = coordinates.index(f"{name}.{joint}")
                    error = abs(float(row[column] - self.ends[edge][column]))
                    yield f"{name}.{joint}", error, coordinates.units[column]

    def _find_released(self, step: Release, completed: int) -> set[str]:
        """Return the objects that a step releases: those that were held last before."""
        held = self.planned.scene.held
        for phase in self.trajectory.phases[:completed]:
            if phase.held:
                held = phase.held
        return {name for name in held if step.object in (None, name)}


def _measure_grasp(world: World, step: Grasp, attachment: Attachment, row: Floats) -> Floats:
    """Return how far the grasping frame is from an attachment; see `measure_deviation`."""
    robot = world.scene.robot
    hand = compute_placement(world, row, step.by or robot.tool_frame)
    if step.by is None:
        hand = hand * compute_hand_frame(robot, attachment)
    link = compute_placement(world, row, f"{step.object}.{attachment.link}")
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
    names = world.coordinates.names
    units = world.coordinates.units
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
    placement = compute_placement(world, row, frame)
    has_pose = isinstance(goal, pin.SE3)
    position = goal.translation if has_pose else np.asarray(goal)
    yield frame, float(np.linalg.norm(placement.translation - position)), "m"
    if has_pose:
        rotation = goal.rotation.T @ placement.rotation
        yield frame, float(np.linalg.norm(pin.log3(rotation))), "rad"
    elif isinstance(step, Place):  # any heading, the same tilt as at the start
        # the world's vertical axis in the object's frame
        vertical = scene.objects[step.object].placement.rotation[2]
        if step.object in scene.held:
            vertical = np.array([0.0, 0.0, 1.0])
        cosine = np.clip(placement.rotation[2] @ vertical, -1.0, 1.0)
        yield frame, float(np.arccos(cosine)), "rad"


def compute_placement(world: World, row: Floats, frame: str) -> pin.SE3:
    """Return the placement of a frame at configuration `row`."""
    model = world.model
    data = model.createData()
    pin.forwardKinematics(model, data, world.coordinates.q(row))
    return pin.updateFramePlacement(model, data, model.getFrameId(frame)).copy()
