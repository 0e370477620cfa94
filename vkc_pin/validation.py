"""The independent check of a motion, continuous in time.

It knows nothing of the optimiser: numeric Pinocchio on the plain tree of robot and objects side by side (`world`), coal
on every pair, at most 5 mm and 0.01 rad apart along the whole motion.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.articulation import Attachment
from vkc_pin.options import Options
from vkc_pin.report import Report, Violation
from vkc_pin.scene import Scene
from vkc_pin.steps import Actuate, GoTo, Grasp, Reach, Step
from vkc_pin.trajectory import PhaseSpan, Trajectory
from vkc_pin.validation_pairs import PairTable
from vkc_pin.world import World

__all__ = ["validate"]

LENGTH_STEP, ANGLE_STEP = 5e-3, 1e-2  # [m], [rad] between two configurations that are looked at
LIMIT_TOLERANCE = 1e-5  # [m] or [rad]
RATE_TOLERANCE = 1e-3  # relative to the limit
LATCH_TOLERANCE = 1e-4
WAYPOINT_TOLERANCE = 1e-3  # [m] that clearance at a waypoint may fall short of dist_safe
SLIP_TOLERANCE = 1e-4  # [m] per step


def validate(scene: Scene, steps: Sequence[Step], trajectory: Trajectory, options: Options) -> Report:
    """Check a motion against everything that was asked of it.

    Args:
        scene: Where it happens; its start is where the motion must start.
        steps: What it must bring about, in this order.
        trajectory: The motion, linear between waypoints.
        options: Tolerances and dist_safe.

    Returns:
        Every violated constraint: start, limits, velocity, acceleration, slip of a differential base, closure, latches,
        joints of objects that nobody holds, goals, clearance at waypoints and penetration anywhere.
    """
    return _Check(scene, steps, trajectory, options).report()


class _Check:
    def __init__(self, scene: Scene, steps: Sequence[Step], trajectory: Trajectory, options: Options) -> None:
        self.scene, self.steps, self.trajectory, self.options = scene, steps, trajectory, options
        self.world = World(scene)
        self.times, self.waypoint_rows = self._sample()
        self.z = self.world.positions(trajectory, self.times)
        self.found: list[Violation] = []

    def report(self) -> Report:
        """Run every check."""
        self._start()
        self._limits()
        self._rates()
        self._unheld()
        self._latches()
        self._goals()
        error, angle = self._closure()
        clearance = self._clearance()
        worst: dict[tuple[str, str], Violation] = {}
        for violation in self.found:
            key = (violation.constraint, violation.subject)
            if key not in worst or worst[key].amount < violation.amount:
                worst[key] = violation
        ordered = tuple(sorted(worst.values(), key=lambda v: (v.time, v.constraint, v.subject)))
        return Report(ordered, clearance, error, angle, len(self.times))

    def _sample(self) -> tuple[NDArray[np.float64], NDArray[np.int_]]:
        """Return the times to look at, and where among them the waypoints are."""
        steps = np.abs(np.diff(self.trajectory.positions, axis=0))
        units = np.array([LENGTH_STEP if self._is_length(name) else ANGLE_STEP for name in self.trajectory.names])
        planar = np.linalg.norm(steps[:, :2], axis=1) / LENGTH_STEP
        counts = np.maximum(1, np.ceil(np.maximum(planar, (steps / units).max(axis=1)) - 1e-9)).astype(int)
        edges = itertools.pairwise(self.trajectory.times)
        times = [np.linspace(a, b, n, endpoint=False) for (a, b), n in zip(edges, counts, strict=True)]
        rows = np.concatenate([[0], np.cumsum(counts)])
        return np.concatenate([*times, self.trajectory.times[-1:]]), rows

    def _is_length(self, name: str) -> bool:
        if name in self.world.coordinates.names:
            index = self.world.coordinates.names.index(name)
            kind = str(self.world.model.joints[self.world.coordinates.joints[index]].shortname())
            return index < 2 or "JointModelP" in kind and "Planar" not in kind
        attachment = self._virtual(name)
        return attachment is not None and attachment.joint == "prismatic"

    def _virtual(self, name: str) -> Attachment | None:
        """Return the attachment whose virtual joint a coordinate is."""
        owner, _, rest = name.partition(".")
        placed = self.scene.objects.get(owner)
        if placed is None:
            return None
        return next((a for key, a in placed.object.attachments.items() if rest == key or rest[:-2] == key), None)

    def _unit(self, name: str) -> str:
        return "m" if self._is_length(name) else "rad"

    def _add(self, constraint: str, subject: str, waypoint: int, amount: float, unit: str, detail: str, time: float | None = None) -> None:
        moment = float(self.trajectory.times[waypoint]) if time is None else float(time)
        self.found.append(Violation(constraint, subject, int(waypoint), moment, float(amount), unit, detail))

    def _start(self) -> None:
        for name, value, right in zip(self.trajectory.names, self.trajectory.positions[0], self._expected_start(), strict=True):
            if np.isfinite(right) and not abs(value - right) <= 1e-9:
                unit = self._unit(name)
                self._add("start", name, 0, abs(value - right), unit, f"{value:.6g} {unit} instead of {right:.6g} {unit}")

    def _expected_start(self) -> list[float]:
        index = {name: i for i, name in enumerate(self.world.coordinates.names)}
        return [float(self.world.start[index[name]]) if name in index else np.nan for name in self.trajectory.names]

    def _bounds(self, name: str) -> tuple[float, float, float, float]:
        """Return lower, upper, velocity and acceleration limit of a coordinate."""
        robot = self.scene.robot
        if name in robot.coordinates.names:
            i = robot.coordinates.names.index(name)
            lower, upper = float(robot.lower[i]), float(robot.upper[i])
            if i < 2:
                lower, upper = max(lower, self.scene.arena[2 * i]), min(upper, self.scene.arena[2 * i + 1])
            if i < 3 and robot.base == "fixed":  # wherever it stands
                lower = upper = float(self.scene.start[i])
            return lower, upper, float(robot.velocity[i]), float(robot.acceleration[i])
        owner, _, joint = name.partition(".")
        item = self.scene.objects[owner].object
        if joint in item.coordinates.names:
            i = item.coordinates.names.index(joint)
            return float(item.lower[i]), float(item.upper[i]), float(item.velocity[i]), float(item.acceleration[i])
        attachment = self._virtual(name)
        assert attachment is not None
        return attachment.lower, attachment.upper, np.inf, np.inf

    def _limits(self) -> None:
        for name, column in zip(self.trajectory.names, self.trajectory.positions.T, strict=True):
            lower, upper, _, _ = self._bounds(name)
            excess = np.maximum(lower - column, column - upper)
            excess[0] = 0.0 if excess[0] < 1e-2 else excess[0]  # a start slightly outside is where the robot is
            worst = int(np.argmax(excess))
            if not excess[worst] <= LIMIT_TOLERANCE:
                unit = self._unit(name)
                detail = f"{column[worst]:.4f} {unit} is outside {lower:.4f} to {upper:.4f} {unit} by {excess[worst]:.4f} {unit}"
                self._add("limit", name, worst, excess[worst], unit, detail)

    def _rates(self) -> None:
        velocities, accelerations = self.trajectory.velocities(), self.trajectory.accelerations()
        for i, name in enumerate(self.trajectory.names):
            _, _, fastest, strongest = self._bounds(name)
            unit = self._unit(name)
            for kind, values, limit, per in (
                ("velocity", velocities[:, i], fastest, "s"),
                ("acceleration", accelerations[:, i], strongest, "s²"),
            ):
                worst = int(np.argmax(np.abs(values)))
                value = abs(float(values[worst]))
                if not value <= limit * (1 + RATE_TOLERANCE) + 1e-9:
                    detail = f"{value:.3f} {unit}/{per} is more than {limit:.3f} {unit}/{per}"
                    self._add(kind, name, worst, value - limit, f"{unit}/{per}", detail)
        if self.scene.robot.base == "differential":
            step = np.diff(self.trajectory.positions[:, :3], axis=0)
            heading = self.trajectory.positions[:-1, 2] + step[:, 2] / 2
            slip = np.abs(-np.sin(heading) * step[:, 0] + np.cos(heading) * step[:, 1])
            worst = int(np.argmax(slip))
            if not slip[worst] <= SLIP_TOLERANCE:
                self._add("slip", "base", worst, slip[worst], "m", f"the base slips sideways by {1e3 * slip[worst]:.2f} mm in a step")

    def _phase_rows(self, phase: PhaseSpan) -> NDArray[np.int_]:
        return np.arange(self.waypoint_rows[phase.first], self.waypoint_rows[phase.last] + 1)

    def _waypoint(self, row: int) -> int:
        return int(np.searchsorted(self.waypoint_rows, row, side="right")) - 1

    def _unheld(self) -> None:
        """What nobody holds does not move."""
        for phase in self.trajectory.phases:
            for i, name in enumerate(self.trajectory.names):
                owner, _, joint = name.partition(".")
                if owner not in self.scene.objects or owner in phase.held:
                    continue
                if joint not in self.scene.objects[owner].object.coordinates.names:
                    continue
                column = self.trajectory.positions[phase.first : phase.last + 1, i]
                moved = np.abs(column - column[0])
                worst = int(np.argmax(moved))
                if not moved[worst] <= LIMIT_TOLERANCE:
                    detail = f"moves by {moved[worst]:.4f} {self._unit(name)} while nobody holds {owner}"
                    self._add("unheld", name, phase.first + worst, moved[worst], self._unit(name), detail)

    def _latches(self) -> None:
        names = self.world.coordinates.names
        for owner, placed in self.scene.objects.items():
            for latch in placed.object.latches:
                joint = self.z[:, names.index(f"{owner}.{latch.joint}")]
                release = self.z[:, names.index(f"{owner}.{latch.released_by}")]
                away = np.abs(joint - latch.held_at)
                leaving = np.diff(away, prepend=away[0]) > 1e-9
                locked = (away > LATCH_TOLERANCE) & (away <= latch.engaged_within) & leaving
                short = np.where(locked, latch.threshold - release, 0.0)
                row = int(np.argmax(short))
                if not short[row] <= LATCH_TOLERANCE:
                    subject = f"{owner}.{latch.joint}"
                    detail = (
                        f"leaves {latch.held_at:g} while {latch.released_by} is at {release[row]:.3f}, "
                        f"{short[row]:.3f} short of {latch.threshold:g}"
                    )
                    self._add("latch", subject, self._waypoint(row), short[row], "rad", detail, self.times[row])

    def _placements(self, z: NDArray[np.float64], frame: str) -> list[pin.SE3]:
        model, data = self.world.model, self.world.model.createData()
        index = model.getFrameId(frame)
        out = []
        for q in self.world.coordinates.q(z):
            pin.forwardKinematics(model, data, q)
            out.append(pin.updateFramePlacement(model, data, index).copy())
        return out

    def _grasp_errors(self, owner: str, attachment_name: str, rows: NDArray[np.int_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return how far the tool is from where the attachment has it, at sampled rows: position [m] and angle [rad]."""
        attachment = self.scene.objects[owner].object.attachments[attachment_name]
        tools = self._placements(self.z[rows], self.scene.robot.tool_frame)
        links = self._placements(self.z[rows], f"{owner}.{attachment.link}")
        positions = self.trajectory.at(self.times[rows])
        columns = [i for i, n in enumerate(self.trajectory.names) if n.startswith(f"{owner}.") and self._virtual(n) is attachment]
        error = np.empty((len(rows), 2))
        for k, (tool, link) in enumerate(zip(tools, links, strict=True)):
            offset = (link * attachment.placement * _virtual_motion(attachment, positions[k, columns])).actInv(tool)
            error[k] = np.linalg.norm(offset.translation), np.linalg.norm(pin.log3(offset.rotation))
        return error[:, 0], error[:, 1]

    def _closure(self) -> tuple[float, float]:
        worst = np.zeros(2)
        for phase in self.trajectory.phases:
            rows = self._phase_rows(phase)
            for owner, attachment in phase.held.items():
                for k, (errors, limit, unit) in enumerate(
                    zip(
                        self._grasp_errors(owner, attachment, rows),
                        (self.options.closure_position, self.options.closure_angle),
                        ("m", "rad"),
                        strict=True,
                    )
                ):
                    row = int(np.argmax(errors))
                    worst[k] = max(worst[k], errors[row])
                    if not errors[row] <= limit:
                        detail = f"the grasp drifts by {1e3 * errors[row]:.3f} m{unit}, more than {1e3 * limit:g} m{unit}"
                        waypoint = self._waypoint(int(rows[row]))
                        self._add("closure", f"{owner}.{attachment}", waypoint, errors[row] - limit, unit, detail, self.times[rows[row]])
        return float(worst[0]), float(worst[1])

    def _goals(self) -> None:
        """Every step's goal must hold at the end of some phase, in the order of the steps, the last one's at the end."""
        ends = [phase.last for phase in self.trajectory.phases]
        reached = 0
        for number, step in enumerate(self.steps):
            last = number == len(self.steps) - 1
            candidates = [len(ends) - 1] if last else range(reached, len(ends))
            misses = {k: self._misses(step, ends[k]) for k in candidates}
            fit = next((k for k in candidates if not misses[k]), None)
            if fit is None:
                best = min(misses, key=lambda k: max(m[1] for m in misses[k]))
                for subject, amount, unit, detail in misses[best]:
                    self._add("goal", subject, ends[best], amount, unit, detail)
            else:
                reached = fit

    def _misses(self, step: Step, waypoint: int) -> list[tuple[str, float, str, str]]:
        """Return what of a step's goal does not hold at a waypoint: subject, amount, unit, detail."""
        o, misses = self.options, []
        row = int(self.waypoint_rows[waypoint])

        def expect(subject: str, error: float, tolerance: float, unit: str, detail: str) -> None:
            if not error <= tolerance:
                misses.append((subject, error - tolerance, unit, detail))

        if isinstance(step, Actuate):
            names = self.world.coordinates.names
            for joint, goal in step.joints.items():
                name = f"{step.object}.{joint}"
                value, unit = float(self.z[row, names.index(name)]), self._unit(name)
                expect(name, abs(value - goal), o.goal_position if unit == "m" else o.goal_angle, unit, f"{value:.4f} {unit} instead of {goal:.4f} {unit}")
        elif isinstance(step, Grasp):
            attachment = step.attachment or next(iter(self.scene.objects[step.object].object.attachments))
            position, angle = self._grasp_errors(step.object, attachment, np.array([row]))
            expect(f"{step.object}.{attachment}", float(position[0]), o.goal_position, "m", f"the tool is {position[0]:.4f} m from the grasp")
            expect(f"{step.object}.{attachment}", float(angle[0]), o.goal_angle, "rad", f"the tool is turned {angle[0]:.4f} rad from the grasp")
        elif isinstance(step, Reach):
            frame = step.frame or self.scene.robot.tool_frame
            offset = step.pose.actInv(self._placements(self.z[[row]], frame)[0])
            distance, angle_off = float(np.linalg.norm(offset.translation)), float(np.linalg.norm(pin.log3(offset.rotation)))
            expect(frame, distance, o.goal_position, "m", f"{distance:.4f} m from the pose to reach")
            expect(frame, angle_off, o.goal_angle, "rad", f"turned {angle_off:.4f} rad from the pose to reach")
        elif isinstance(step, GoTo):
            x, y, yaw = self.z[row, :3]
            distance = float(np.hypot(x - step.x, y - step.y))
            expect("base", distance, o.goal_position, "m", f"{distance:.4f} m from the place to go to")
            if step.yaw is not None:
                turn = abs((yaw - step.yaw + np.pi) % (2 * np.pi) - np.pi)
                expect("base heading", turn, o.goal_angle, "rad", f"turned {turn:.4f} rad from the heading asked for")
        return misses

    def _clearance(self) -> float:
        pairs = PairTable(self.scene, self.world, self.trajectory, self.options.dist_safe)
        smallest = np.inf
        for hit in pairs.sweep(self.z, self.waypoint_rows):
            smallest = min(smallest, hit.distance)
            at_waypoint = hit.row == self.waypoint_rows[self._waypoint(hit.row)]
            required = max(hit.margin - WAYPOINT_TOLERANCE, 0.0) if at_waypoint else 0.0
            if hit.distance < required:
                kind = "penetration" if hit.distance < 0 else "clearance"
                word = "overlap by" if hit.distance < 0 else "are only"
                tail = "" if hit.distance < 0 else f" apart, {1e3 * hit.margin:.0f} mm are asked for"
                detail = f"{word} {1e3 * abs(hit.distance):.1f} mm{tail}"
                subject = f"{hit.first} – {hit.second}"
                self._add(kind, subject, self._waypoint(hit.row), required - hit.distance, "m", detail, self.times[hit.row])
        return float(smallest)


def _virtual_motion(attachment: Attachment, values: NDArray[np.float64]) -> pin.SE3:
    """Return J(v), the motion of a grasp's virtual joint; a spherical one turns about x, then y, then z."""
    axis = np.asarray(attachment.axis, float)
    if attachment.joint == "revolute":
        return pin.SE3(pin.exp3(axis * values[0]), np.zeros(3))
    if attachment.joint == "prismatic":
        return pin.SE3(np.eye(3), axis * values[0])
    if attachment.joint == "spherical":
        z, y, x = values  # the chain runs from tool to object
        return pin.SE3(pin.exp3(np.array([x, 0, 0])) @ pin.exp3(np.array([0, y, 0])) @ pin.exp3(np.array([0, 0, z])), np.zeros(3))
    return pin.SE3.Identity()
