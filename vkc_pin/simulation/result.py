"""Defines SimulationResult, the outcome of an executed motion."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.options import Options
from vkc_pin.simulation.contacts import Contact
from vkc_pin.simulation.goals import Miss, compute_placement
from vkc_pin.simulation.physics import Physics
from vkc_pin.simulation.replay import write_page
from vkc_pin.simulation.servos import Servo
from vkc_pin.simulation.snapshots import write_snapshots, write_video
from vkc_pin.simulation.welds import Grip
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.scene.hold import (
    Hold,
    compute_distances,
    get_attachment,
    is_within_grasp,
    measure_deviation,
    measure_grasp,
)
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.task.actions import compile_each_step
from vkc_pin.world.task.steps import Step, step_to_dict
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World, make_scene_at

GOAL = {"m": 0.01, "rad": 0.02}
"""Tolerances within which a goal counts as reached."""
DEPTH = 1e-3
"""Penetration depth up to which an unplanned contact is harmless [m]."""
# contacts in a report
_LISTED_CONTACTS = 8
# motors in a report, by decreasing load
_LISTED_MOTORS = 4


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
        """Compute the tracking errors from samples.

        Args:
            times: Times of the samples, shape (K,) [s].
            errors: Tracking errors, shape (K, servos), [m] or [rad].
            efforts: Forces of the motors, shape (K, servos), [N·m] or [N].
            servos: Servos of base, arm and fingers.
            size: Number of coordinates of base and arm.
        """
        names = [servo.coordinate for servo in servos]
        arm = errors[:, 3:size]
        worst_joint = ""
        worst_time = float(times[0])
        if arm.size:
            row, column = np.unravel_index(int(np.argmax(np.abs(arm))), arm.shape)
            worst_joint = names[3 + int(column)]
            worst_time = float(times[int(row)])
        peaks = np.abs(efforts).max(axis=0)
        shares: dict[str, float] = {}
        for servo, peak in zip(servos, peaks, strict=True):
            if np.isfinite(servo.limit):
                shares[servo.coordinate] = float(peak / servo.limit)
        return cls(
            arm=_compute_max_and_rms(arm),
            base=_compute_max_and_rms(np.hypot(errors[:, 0], errors[:, 1])),
            heading=_compute_max_and_rms(errors[:, 2]),
            worst=(worst_joint, worst_time),
            efforts=dict(zip(names, peaks.tolist(), strict=True)),
            shares=shares,
        )


def _compute_max_and_rms(values: Floats) -> tuple[float, float]:
    """Compute the largest magnitude of values and their root mean square; 0 without values."""
    if not values.size:
        return 0.0, 0.0
    return float(np.abs(values).max()), float(np.sqrt(np.mean(np.square(values))))


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
        """Whether all goals are reached and grasps kept, and no contact is deeper than 1 mm."""
        return self.reached and not self.problems()

    def end_scene(self) -> Scene:
        """Return the scene as it really is at the end, from which planning can continue.

        Robot and objects are where the execution left them. Grasps are as measured there; objects
        that were pushed or missed, or pulled out of the hand, are not held.

        Raises:
            InputError: The integration diverged, or an object slipped by more than 20 mm or
                0.2 rad.
        """
        if self.diverged is not None:
            raise InputError(
                "the integration diverged",
                field="end_scene",
                expected="an execution that ended",
                got=f"diverged at {self.diverged:.2f} s",
            )
        world = World(self.scene)
        row = self.rows[-1]
        values = dict(zip(world.coordinates.names, row.tolist(), strict=True))
        scene = make_scene_at(self.scene, world, row, values)
        tool = compute_placement(world, row, scene.robot.tool_frame)
        lost = {grip.what: grip.problem is not None for grip in self.grips}  # the last time
        kept = {str(hold) for hold in self.planned.phases[-1].holds}
        holds: list[Hold] = []
        measured: dict[str, pin.SE3] = {}
        for hold in compile_each_step(self.scene, self.steps, Options())[-1].after:
            attachment = get_attachment(scene.objects, hold)
            if attachment.contact == "push" or hold.by not in (None, *holds):
                continue
            # The scene's robot is within limits that the real one may exceed a little. A free
            # object stays where it is in the hand, an articulated one where it is in the world.
            is_free = scene.objects[hold.object].object.free
            place_tool = (lambda: tool) if is_free else scene.tool_placement
            grasp = measure_grasp(scene.objects, hold, place_tool)
            if str(hold) in kept:
                is_lost = lost.get(str(hold), False)
            else:  # the hand closes at the end
                _, deviation = measure_deviation(attachment, grasp)
                is_lost = not is_within_grasp(*compute_distances(deviation))
            if not is_lost:
                holds.append(hold)
                measured[hold.object] = grasp
        held = scene.with_held([hold.nominal for hold in holds], measured=measured)
        return replace(held, opening=self.planned.phases[-1].opening)

    def problems(self) -> list[str]:
        """Return what failed, one line each."""
        problems: list[str] = []
        if self.diverged is not None:
            problems.append(f"the integration diverged at {self.diverged:.2f} s")
        problems += [str(miss) for miss in self.misses if miss.amount > GOAL[miss.unit]]
        problems += [grip.problem for grip in self.grips if grip.problem is not None]
        problems += [str(contact) for contact in self.contacts if contact.depth > DEPTH]
        return problems

    def summary(self) -> str:
        """Return a readable report."""
        problems = self.problems()
        verdict = "ok" if self.ok else f"FAILED, {len(problems)} problem(s)"
        phases = ", ".join(phase.name for phase in self.planned.phases)
        lines = [f"{self.scene.name} in physics: {verdict} — {phases}"]
        lines += [f"  goal        {miss}" for miss in self.misses]
        lines.append(self._describe_tracking())
        lines += [_describe_grip(grip) for grip in self.grips]
        shares = sorted(self.tracking.shares.items(), key=lambda item: -item[1])
        if shares:
            loads = [f"{name} {100.0 * share:.0f} %" for name, share in shares[:_LISTED_MOTORS]]
            lines.append(f"  motors      at most {', '.join(loads)} of their limits")
        count = f"{len(self.contacts)} not planned" if self.contacts else "as planned"
        lines.append(f"  contacts    {count}")
        lines += [f"  - {contact}" for contact in self.contacts[:_LISTED_CONTACTS]]
        more = len(self.contacts) - _LISTED_CONTACTS
        if more > 0:
            lines.append(f"  ... and {more} more")
        lines += [f"  note        {note}" for note in self.notes]
        lines += [f"  because     {problem}" for problem in problems]
        return "\n".join(lines)

    def _describe_tracking(self) -> str:
        """Return the line of a report about tracking errors."""
        tracking = self.tracking
        arm, arm_rms = np.degrees(tracking.arm)
        heading, _ = np.degrees(tracking.heading)
        base, base_rms = tracking.base
        joint, time = tracking.worst
        return (
            f"  tracking    arm within {arm:.2f}° ({arm_rms:.3f}° rms; worst {joint} at "
            f"{time:.2f} s), base within {1e3 * base:.1f} mm ({1e3 * base_rms:.2f} mm rms), "
            f"heading within {heading:.2f}°"
        )

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
        text = json.dumps(self.to_dict(), indent=1) + "\n"
        return write_atomically(path, text.encode("utf-8"))

    def to_html(self, path: str | Path) -> Path:
        """Write a web page with the executed motion and the plan as a ghost; return its path."""
        notes = [(str(contact), contact.time) for contact in self.contacts if contact.depth > DEPTH]
        for grip in self.grips:
            if grip.missed:
                notes.append((f"the hand misses {grip.what}", grip.begin))
            elif grip.broken is not None:
                notes.append((f"{grip.what} is pulled out of the hand", grip.broken))
        verdict = "ok" if self.ok else "FAILED"
        headline = f"{self.scene.name} in physics: {verdict}"
        return write_page(self, path, headline=headline, notes=notes)

    def plot(self, path: str | Path, *, count: int = 6) -> Path:
        """Write an image (.png) of `count` snapshots, and return its path."""
        return write_snapshots(self, path, count=count)

    def to_mp4(self, path: str | Path, *, rate: float = 25.0) -> Path:
        """Write a video (.mp4) with a frame `rate` [Hz] by ffmpeg, and return its path."""
        return write_video(self, path, rate=rate)

    def __repr__(self) -> str:
        verdict = "ok" if self.ok else "FAILED"
        return f"<SimulationResult {self.scene.name}: {verdict}, {len(self.contacts)} contacts>"


def _describe_grip(grip: Grip) -> str:
    """Return the line of a report about a grasp."""
    if grip.missed:
        end = ", MISSED"
    elif grip.broken is not None:
        end = f", PULLED OUT OF THE HAND at {grip.broken:.2f} s"
    else:
        end = ""
    span = f"{grip.begin:.1f} to {grip.end:.1f} s"
    force = f"{grip.force:.0f} N and {grip.torque:.1f} N·m at most"
    slip = f", slips by {1e3 * grip.slip:.1f} mm" if grip.slip else ""
    return f"  grasp       {grip.what}, {span}: {force}{slip}{end}"
