"""Defines SimulationResult, the outcome of an executed motion, and measures its goal errors."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.simulation.contacts import Contact
from vkc_pin.simulation.physics import Physics
from vkc_pin.simulation.replay import write_page
from vkc_pin.simulation.servos import Servo
from vkc_pin.simulation.snapshots import write_snapshots, write_video
from vkc_pin.simulation.welds import Grip
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.models.coordinates import wrap_angle
from vkc_pin.world.scene.hold import Hold, get_attachment, measure_grasp
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import compile_each_step
from vkc_pin.world.task.steps import (
    Actuate,
    GoTo,
    Grasp,
    Place,
    Reach,
    Release,
    Step,
    Touch,
    step_to_dict,
)
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World, make_scene_at

__all__ = ["Miss", "SimulationResult", "Tracking", "measure_goal_errors"]

_TOLERANCE = 2e-3  # [m] or [rad] within which a plan counts as having completed a step
GOAL = {"m": 0.01, "rad": 0.02}
"""Tolerances within which a goal counts as reached."""
DEPTH = 1e-3
"""Penetration depth up to which an unplanned contact is harmless [m]."""
_LISTED_CONTACTS = 8  # contacts in a report
_LISTED_MOTORS = 4  # motors in a report, by decreasing load


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


@dataclass(frozen=True)
class Tracking:
    """Tracking errors and forces of the servos.

    Attributes:
        arm: Largest and root mean square error of an arm joint [rad]; 1 m of a prismatic joint
            counts as 1 rad.
        base: Largest and root mean square error of the base's position [m].
        heading: Largest and root mean square error of the base's heading [rad].
        worst: Arm joint with the largest error, and its time [s].
        efforts: Maps each coordinate to the largest force of its motor, [N·m] or [N].
        shares: Maps each coordinate that has a limit to the largest force relative to this limit.
    """

    arm: tuple[float, float]
    base: tuple[float, float]
    heading: tuple[float, float]
    worst: tuple[str, float]
    efforts: dict[str, float]
    shares: dict[str, float]

    @classmethod
    def from_samples(
        cls, times: Floats, errors: Floats, efforts: Floats, servos: Sequence[Servo], size: int
    ) -> Tracking:
        """Compute the tracking errors from samples."""

        def compute_max_and_rms(values: Floats) -> tuple[float, float]:
            return float(np.abs(values).max(initial=0.0)), float(
                np.sqrt(np.mean(np.square(values)))
            ) if values.size else 0.0

        names = [servo.coordinate for servo in servos]
        peaks = np.abs(efforts).max(axis=0)
        arm = errors[:, 3:size]
        at = np.unravel_index(int(np.argmax(np.abs(arm))), arm.shape) if arm.size else (0, 0)
        return cls(
            arm=compute_max_and_rms(arm),
            base=compute_max_and_rms(np.hypot(errors[:, 0], errors[:, 1])),
            heading=compute_max_and_rms(errors[:, 2]),
            worst=(names[3 + int(at[1])] if arm.size else "", float(times[int(at[0])])),
            efforts=dict(zip(names, peaks.tolist(), strict=True)),
            shares={
                s.coordinate: float(p / s.limit)
                for s, p in zip(servos, peaks, strict=True)
                if np.isfinite(s.limit)
            },
        )


@dataclass(frozen=True, eq=False)
class SimulationResult:
    """Outcome of an executed motion.

    Attributes:
        scene: Scene of the execution.
        steps: Steps of the task.
        planned: The plan, with pauses if the hand grasps by friction.
        trajectory: Executed trajectory every 20 ms in the plan's coordinates; degrees of freedom of
            grasps are as planned.
        rows: Executed world coordinates, including placements of free objects, shape (K, n); see
            `world.trajectory.world_model.World`.
        misses: Error of each goal.
        tracking: Tracking errors of the servos.
        grips: Grasps and their loads.
        contacts: Unplanned contacts.
        physics: Physical settings.
        notes: Further assumptions, one line each.
        diverged: Time at which the integration diverged [s]; None if it did not.
    """

    scene: Scene
    steps: tuple[Step, ...]
    planned: Trajectory
    trajectory: Trajectory
    rows: Floats = field(repr=False)
    misses: tuple[Miss, ...]
    tracking: Tracking
    grips: tuple[Grip, ...]
    contacts: tuple[Contact, ...]
    physics: Physics
    notes: tuple[str, ...] = ()
    diverged: float | None = None

    @property
    def reached(self) -> bool:
        """Whether all goals are reached within 10 mm and 0.02 rad."""
        return all(miss.amount <= GOAL[miss.unit] for miss in self.misses)

    @property
    def ok(self) -> bool:
        """Whether all goals are reached, no grasp is lost, and no contact is deeper than 1 mm."""
        return self.reached and not self.problems()

    def end_scene(self) -> Scene:
        """Return the scene as it really is at the end, from which planning can continue.

        Robot and objects are where the execution left them. Grasps are as measured there; objects
        that were pushed, or pulled out of the hand, are not held.

        Raises:
            InputError: The integration diverged, or an object slipped by more than 20 mm or
                0.2 rad.
        """
        if self.diverged is not None:
            problem, expected = "the integration diverged", "an execution that ended"
            got = f"diverged at {self.diverged:.2f} s"
            raise InputError(problem, field="end_scene", expected=expected, got=got)
        world, row = World(self.scene), self.rows[-1]
        values = dict(zip(world.coordinates.names, row.tolist(), strict=True))
        scene = make_scene_at(self.scene, world, row, values)
        lost = {grip.what: grip.broken is not None for grip in self.grips}  # the last time
        holds, measured = list[Hold](), dict[str, pin.SE3]()
        for hold in compile_each_step(self.scene, self.steps, Options())[-1].after:
            pushes = get_attachment(scene.objects, hold).contact == "push"
            if not (lost.get(str(hold)) or pushes) and hold.by in (None, *holds):
                holds.append(hold)
                measured[hold.object] = measure_grasp(scene.objects, hold, scene.tool_placement)
        held = scene.with_held([hold.nominal for hold in holds], measured=measured)
        return replace(held, opening=self.planned.phases[-1].opening)

    def problems(self) -> list[str]:
        """Return what failed, one line each."""
        problems = (
            [] if self.diverged is None else [f"the integration diverged at {self.diverged:.2f} s"]
        )
        problems += [str(miss) for miss in self.misses if miss.amount > GOAL[miss.unit]]
        problems += [
            f"{grip.what} was pulled out of the hand at {grip.broken:.2f} s"
            for grip in self.grips
            if grip.broken is not None
        ]
        return problems + [str(contact) for contact in self.contacts if contact.depth > DEPTH]

    def summary(self) -> str:
        """Return a readable report."""
        t, problems = self.tracking, self.problems()
        head = "ok" if self.ok else f"FAILED, {len(problems)} problem(s)"
        degrees = [np.degrees(value) for value in (*t.arm, *t.heading)]
        lines = [
            f"{self.scene.name} in physics: {head} — "
            + ", ".join(phase.name for phase in self.planned.phases),
            *(f"  goal        {miss}" for miss in self.misses),
            f"  tracking    arm within {degrees[0]:.2f}° ({degrees[1]:.3f}° rms; "
            f"worst {t.worst[0]} at {t.worst[1]:.2f} s), "
            f"base within {1e3 * t.base[0]:.1f} mm ({1e3 * t.base[1]:.2f} mm rms), "
            f"heading within {degrees[2]:.2f}°",
        ]
        for grip in self.grips:
            broken = (
                "" if grip.broken is None else f", PULLED OUT OF THE HAND at {grip.broken:.2f} s"
            )
            force = f"{grip.force:.0f} N and {grip.torque:.1f} N·m at most"
            slip = f", slips by {1e3 * grip.slip:.1f} mm" if grip.slip else ""
            span = f"{grip.begin:.1f} to {grip.end:.1f} s"
            lines.append(f"  grasp       {grip.what}, {span}: {force}{slip}{broken}")
        shares = sorted(t.shares.items(), key=lambda item: -item[1])
        if shares:
            loads = ", ".join(
                f"{name} {100.0 * share:.0f} %" for name, share in shares[:_LISTED_MOTORS]
            )
            lines.append(f"  motors      at most {loads} of their limits")
        count = f"{len(self.contacts)} not planned" if self.contacts else "as planned"
        lines.append(f"  contacts    {count}")
        lines += [f"  - {contact}" for contact in self.contacts[:_LISTED_CONTACTS]]
        if (more := len(self.contacts) - _LISTED_CONTACTS) > 0:
            lines.append(f"  ... and {more} more")
        lines += [f"  note        {note}" for note in self.notes]
        lines += [f"  because     {problem}" for problem in problems]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as plain data, e.g. for JSON."""
        return {
            "scene": self.scene.name,
            "steps": [step_to_dict(step) for step in self.steps],
            "ok": self.ok,
            "problems": self.problems(),
            "misses": [miss.to_dict() for miss in self.misses],
            "tracking": asdict(self.tracking),
            "grips": [grip.to_dict() for grip in self.grips],
            "contacts": [contact.to_dict() for contact in self.contacts],
            "physics": asdict(self.physics),
            "notes": list(self.notes),
            "diverged": self.diverged,
            "trajectory": self.trajectory.to_dict(),
        }

    def to_json(self, path: str | Path) -> Path:
        """Write `to_dict` as JSON atomically, and return the path."""
        return write_atomically(path, (json.dumps(self.to_dict(), indent=1) + "\n").encode("utf-8"))

    def to_html(self, path: str | Path) -> Path:
        """Write a web page with the executed motion and the plan as a ghost; return its path."""
        notes = [(str(contact), contact.time) for contact in self.contacts if contact.depth > DEPTH]
        notes += [
            (f"{grip.what} is pulled out of the hand", grip.broken)
            for grip in self.grips
            if grip.broken is not None
        ]
        return write_page(
            self,
            path,
            headline=f"{self.scene.name} in physics: {'ok' if self.ok else 'FAILED'}",
            notes=notes,
        )

    def plot(self, path: str | Path, *, count: int = 6) -> Path:
        """Write an image (.png) of `count` snapshots, and return its path."""
        return write_snapshots(self, path, count=count)

    def to_mp4(self, path: str | Path, *, rate: float = 25.0) -> Path:
        """Write a video (.mp4) with a frame `rate` [Hz] by ffmpeg, and return its path."""
        return write_video(self, path, rate=rate)

    def __repr__(self) -> str:
        verdict = "ok" if self.ok else "FAILED"
        return f"<SimulationResult {self.scene.name}: {verdict}, {len(self.contacts)} contacts>"
