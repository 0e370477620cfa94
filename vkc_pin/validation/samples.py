"""Samples a motion densely on the plain kinematic tree of robot and objects."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_choice
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.validation.report import Violation
from vkc_pin.world.models.articulated_object import Attachment, Freedom
from vkc_pin.world.models.gripper import WIDTH_TOLERANCE
from vkc_pin.world.scene.contact_rules import compute_hand_frame
from vkc_pin.world.scene.hold import Hold, get_attachment
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.free_objects import FreeObjects
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

LENGTH_STEP, ANGLE_STEP = 5e-3, 1e-2  # largest step between two samples [m], [rad]
CHORD_DEVIATION = 0.1  # largest deviation of a curve from its chord, as a fraction of the step
MAX_SAMPLES = 100_000
"""Most samples of a motion: half a kilometre of the base, or 160 turns of a joint."""
_MAX_COORDINATE = 1e12  # [m] or [rad]


class Samples:
    """A motion in a scene, sampled at most 5 mm and 0.01 rad apart.

    The steps hold for the base and prismatic joints, and for revolute joints, respectively. Between
    two samples a curve deviates from its chord by at most a tenth of a step. A motion that would
    need more than `MAX_SAMPLES` samples is sampled at its waypoints or knots only.

    Attributes:
        world: The scene as one plain tree.
        free_objects: Free objects along the motion.
        times: Sample times, shape (S,) [s]; evenly spaced between waypoints, or knots of the curve.
        waypoint_rows: Rows of `times` that are the waypoints, shape (T,).
        z: Minimal coordinates of the world, shape (S, n).
        grasp_freedoms: Coordinate name → freedom of a grasp.
        required_count: Number of samples required by the steps above.
        is_truncated: Whether only the waypoints or knots are sampled.

    Raises:
        UnknownNameError: The trajectory names something that the scene does not have.
        InputError: The trajectory lacks coordinates, or a coordinate is out of range.
    """

    def __init__(self, scene: Scene, trajectory: Trajectory) -> None:
        self.scene, self.trajectory = scene, trajectory
        self.world = World(scene)
        self.grasp_freedoms: dict[str, Freedom] = {
            f"{owner}.{name}": freedom
            for owner, placed in scene.objects.items()
            for attachment in placed.object.attachments.values()
            for name, freedom in zip(attachment.coordinates, attachment.freedoms, strict=True)
        }
        self._check_names()
        self._check_phases()
        far = np.argwhere(np.abs(trajectory.positions) > _MAX_COORDINATE)
        if len(far):
            field, expected = f"trajectory.positions{far[0].tolist()}", f"up to {_MAX_COORDINATE:g}"
            got = trajectory.positions[tuple(far[0])]
            raise InputError("out of range", field=field, expected=expected, got=got)
        self.times, self.waypoint_rows = self._choose_times()
        self.free_objects = FreeObjects(scene, trajectory)
        self.z = self.world.compute_positions(trajectory, self.times, self.free_objects)

    def _check_names(self) -> None:
        names, robot = self.trajectory.names, self.scene.robot.coordinates.names
        if names[: len(robot)] != robot or self.trajectory.robot_size != len(robot):
            raise InputError(
                "not this robot's coordinates",
                field="trajectory.names",
                expected=robot,
                got=names[: len(robot)],
            )
        known = [*self.world.coordinates.names, *self.grasp_freedoms]
        for name in names:
            check_choice(name, known, "coordinate", "trajectory.names")

    def _check_phases(self) -> None:
        measured = {hold for hold in self.scene.holds if hold.deviation}
        for number, phase in enumerate(self.trajectory.phases):
            measured &= set(phase.holds)
            if phase.opening is not None:
                self._check_opening(phase.opening, f"trajectory.phases[{number}].opening")
            for hold in phase.holds:
                owner, attachment = hold.object, hold.attachment
                field = f"trajectory.phases[{number}].held"
                if hold.deviation and hold not in measured:
                    raise InputError(
                        "only grasps of the scene's start deviate, until they end",
                        field=field.replace("held", "deviation"),
                        got=str(hold),
                    )
                check_choice(owner, self.scene.objects, "object", field)
                attachments = self.scene.objects[owner].object.attachments
                check_choice(attachment, attachments, f"attachment of '{owner}'", field)
                if hold.frame is not None:
                    self.check_frame(hold.frame, field.replace("held", "by"))
                for name in attachments[attachment].coordinates:
                    if f"{owner}.{name}" not in self.trajectory.names:
                        problem = "this grasp's coordinate is missing"
                        raise InputError(
                            problem, field="trajectory.names", expected=f"{owner}.{name}"
                        )

    def _check_opening(self, opening: float, field: str) -> None:
        gripper = self.scene.robot.gripper
        if gripper is None:
            expected = "a `gripper` in its robot.yaml"
            raise InputError(
                "the robot's gripper does not open", field=field, expected=expected, got=opening
            )
        if abs(gripper.clamp_opening(opening) - opening) > WIDTH_TOLERANCE:
            expected = f"{gripper.min_opening:.4g} to {gripper.max_opening:.4g} m"
            raise InputError(
                "the gripper cannot be so far open", field=field, expected=expected, got=opening
            )

    def check_frame(self, frame: str, field: str) -> None:
        """Check that "<object>.<link>" exists. Raises `UnknownNameError` if it does not."""
        owner, _, link = frame.partition(".")
        check_choice(owner, self.scene.objects, "object", field)
        item = self.scene.objects[owner].object
        if not item.free:
            raise InputError(
                "it stands fixed in the world",
                field=field,
                expected="a link of a free object",
                got=frame,
            )
        check_choice(link, item.links, f"link of '{owner}'", field)

    def make_violation(
        self,
        constraint: str,
        subject: str,
        amount: float,
        unit: str,
        detail: str,
        *,
        waypoint: int | None = None,
        row: int | None = None,
        time: float | None = None,
    ) -> Violation:
        """Make a violation at a waypoint, at sample `row`, or at a time [s] after its waypoint."""
        if row is not None:
            waypoint, time = self.find_waypoint(row), self.times[row]
        if waypoint is None:
            assert time is not None
            waypoint = int(np.searchsorted(self.trajectory.times, time, side="right")) - 1
        return Violation(
            constraint,
            subject,
            waypoint=waypoint,
            time=float(self.trajectory.times[waypoint] if time is None else time),
            amount=float(amount),
            unit=unit,
            detail=detail,
        )

    @cached_property
    def ranges(self) -> tuple[Floats, Floats]:
        """Lower and upper ends of the coordinates in each segment; see `Trajectory.ranges`."""
        return self.trajectory.ranges()

    def _choose_times(self) -> tuple[Floats, Ints]:
        """Return the sample times [s] and the rows of the waypoints."""
        curve, edges = self.trajectory.curve, self.trajectory.times
        if curve is None:
            steps = np.abs(np.diff(self.trajectory.positions, axis=0))
            bends = np.zeros_like(steps)
        else:  # bounds of the travel and of the chord deviation from the largest rates per cubic
            edges, spans = curve.times, np.diff(curve.times)[:, None]
            speeds, accelerations = curve.compute_max_rates()
            steps, bends = speeds * spans, accelerations * spans**2 / 8.0
        coordinates, default = self.world.coordinates, {"m": LENGTH_STEP, "rad": ANGLE_STEP}
        largest = coordinates.compute_max_steps(LENGTH_STEP, ANGLE_STEP)
        known = dict(zip(coordinates.names, largest, strict=True))
        names = self.trajectory.names
        units = np.array([known.get(name, default[self.get_unit(name)]) for name in names])
        planar = np.linalg.norm(steps[:, :2], axis=1) / LENGTH_STEP
        bent = np.sqrt((bends / (CHORD_DEVIATION * units)).max(axis=1))
        counts = np.maximum(
            1, np.ceil(np.maximum.reduce([planar, (steps / units).max(axis=1), bent]) - 1e-9)
        )
        self.required_count = float(counts.sum())
        self.is_truncated = self.required_count > max(MAX_SAMPLES, len(counts))
        counts = np.ones(len(counts), int) if self.is_truncated else counts.astype(int)
        rows = np.concatenate([[0], np.cumsum(counts)])
        numbers = np.arange(rows[-1]) - np.repeat(rows[:-1], counts)
        times = np.repeat(edges[:-1], counts) + numbers * np.repeat(np.diff(edges) / counts, counts)
        return np.append(times, edges[-1]), rows[np.searchsorted(edges, self.trajectory.times)]

    def get_unit(self, name: str) -> str:
        """Return the unit of a coordinate, "m" or "rad"."""
        if name in self.grasp_freedoms:
            return self.grasp_freedoms[name].unit
        return self.world.coordinates.units[self.world.coordinates.index(name)]

    def get_limits(self, name: str) -> tuple[float, float, float, float]:
        """Return the lower, upper, velocity and acceleration limit of a trajectory coordinate."""
        robot = self.scene.robot
        if name in robot.coordinates.names:
            i = robot.coordinates.index(name)
            lower, upper = float(robot.lower[i]), float(robot.upper[i])
            if i < 3 and robot.base == "fixed":
                lower = upper = float(self.scene.start[i])
            if i < 2:
                begin, end = self.scene.arena[2 * i : 2 * i + 2]
                lower, upper = max(lower, begin), min(upper, end)
            return lower, upper, float(robot.velocity[i]), float(robot.acceleration[i])
        if name in self.grasp_freedoms:
            return self.grasp_freedoms[name].lower, self.grasp_freedoms[name].upper, np.inf, np.inf
        owner, _, joint = name.partition(".")
        item = self.scene.objects[owner].object
        i, limits = item.coordinates.index(joint), (item.lower, item.upper)
        lower, upper, velocity, acceleration = (
            float(values[i]) for values in (*limits, item.velocity, item.acceleration)
        )
        return lower, upper, velocity, acceleration

    def find_waypoint(self, row: int) -> int:
        """Return the last waypoint at or before a sample."""
        return int(np.searchsorted(self.waypoint_rows, row, side="right")) - 1

    def get_rows(self, phase: PhaseSpan) -> Ints:
        """Return the rows of a phase's samples, including both ends."""
        return np.arange(self.waypoint_rows[phase.first], self.waypoint_rows[phase.last] + 1)

    def find_driven_coordinates(self, holds: Iterable[Hold]) -> set[str]:
        """Return the object coordinates that holds drive: the joints from base to attachment."""
        model, names = self.world.model, set()
        for hold in holds:
            link = self.scene.objects[hold.object].object.attachments[hold.attachment].link
            joint = model.frames[model.getFrameId(f"{hold.object}.{link}")].parentJoint
            while joint:
                names.add(str(model.names[joint]))
                joint = model.parents[joint]
        return names

    def compute_placements(self, rows: Iterable[int], frame: str) -> list[pin.SE3]:
        """Return the placements of a frame in the world at the given samples."""
        turns, origins = self._compute_frames(self.z[np.asarray(rows)], frame)
        return [pin.SE3(*both) for both in zip(turns[:, 0], origins[:, 0], strict=True)]

    def _compute_frames(self, z: Floats, *names: str) -> tuple[Floats, Floats]:
        """Compute rotations, shape (K, F, 3, 3), and origins, shape (K, F, 3) [m], of F frames."""
        model, data = self.world.model, self.world.model.createData()
        frames = [model.getFrameId(name) for name in names]
        turns, origins = np.empty((len(z), len(frames), 3, 3)), np.empty((len(z), len(frames), 3))
        for k, q in enumerate(self.world.coordinates.q(z)):
            pin.forwardKinematics(model, data, q)
            for f, frame in enumerate(frames):
                placed = pin.updateFramePlacement(model, data, frame)
                turns[k, f], origins[k, f] = placed.rotation, placed.translation
        return turns, origins

    def compute_grasp_errors(self, hold: Hold, rows: Ints) -> Floats:
        """Compute position [m] and angle [rad] errors of a grasp at samples, shape (K, 2)."""
        return self._compute_grasp_errors(hold, self.times[rows], self.z[rows])

    def compute_grasp_errors_at(self, hold: Hold, times: Floats) -> Floats:
        """Compute the errors of a grasp at increasing times, shape (K,) [s]."""
        z = self.world.compute_positions(self.trajectory, times, self.free_objects)
        return self._compute_grasp_errors(hold, times, z)

    def _compute_grasp_errors(self, hold: Hold, times: Floats, z: Floats) -> Floats:
        owner, attachment = hold.object, get_attachment(self.scene.objects, hold)
        hand = compute_hand_frame(self.scene.robot, attachment)
        turns, origins = self._compute_frames(
            z, hold.frame or self.scene.robot.tool_frame, f"{owner}.{attachment.link}"
        )
        positions, names = self.trajectory.at(times), self.trajectory.names
        values = np.zeros((len(times), len(attachment.coordinates)))
        for column, suffix in enumerate(attachment.coordinates):
            if f"{owner}.{suffix}" in names:
                values[:, column] = positions[:, names.index(f"{owner}.{suffix}")]
        turn, origin = _compute_tools(attachment, values)
        aimed = origins[:, 1] + np.einsum("kij,kj->ki", turns[:, 1], origin)
        off = origins[:, 0] + turns[:, 0] @ hand.translation - aimed
        rotation = np.swapaxes(turns[:, 1] @ turn, 1, 2) @ turns[:, 0] @ hand.rotation
        return np.column_stack([np.linalg.norm(off, axis=1), _compute_angles(rotation)])


def _compute_tools(attachment: Attachment, values: Floats) -> tuple[Floats, Floats]:
    """Compute `Attachment.tool` for K rows of values: rotations (K, 3, 3), origins (K, 3) [m]."""
    turns = np.broadcast_to(attachment.placement.rotation, (len(values), 3, 3))
    origins = np.broadcast_to(attachment.placement.translation, (len(values), 3))
    for freedom, steps in zip(attachment.freedoms, values.T, strict=True):
        if freedom.unit == "rad":
            cross, amounts = pin.skew(freedom.axis), steps[:, None, None]
            turn = np.eye(3) + np.sin(amounts) * cross + (1.0 - np.cos(amounts)) * cross @ cross
            shifts = freedom.through - turn @ freedom.through
        else:
            turn, shifts = np.eye(3), steps[:, None] * freedom.axis
        origins = origins + np.einsum("kij,kj->ki", turns, shifts)
        turns = turns @ turn
    offset = attachment.offset
    return turns @ offset.rotation, origins + turns @ offset.translation


def _compute_angles(rotations: Floats) -> Floats:
    """Compute rotation angles, shape (K, 3, 3) → (K,) [rad]; accurate near 0 and near π."""
    skew = rotations - np.swapaxes(rotations, 1, 2)
    sine = 0.5 * np.linalg.norm(skew[:, [2, 0, 1], [1, 2, 0]], axis=1)
    return np.arctan2(sine, 0.5 * (np.trace(rotations, axis1=1, axis2=2) - 1.0))
