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
from vkc_pin.world.collision.batched_model import BatchedModel
from vkc_pin.world.models.articulated_object import Attachment, Freedom
from vkc_pin.world.models.gripper import WIDTH_TOLERANCE
from vkc_pin.world.scene.contact_rules import compute_hand_frame
from vkc_pin.world.scene.hold import Hold, get_attachment
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.free_objects import FreeObjects
from vkc_pin.world.trajectory.phase_span import PhaseSpan
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

# largest step between two samples [m], [rad]
LENGTH_STEP = 5e-3
ANGLE_STEP = 1e-2
# largest deviation of a curve from its chord, as a fraction of the step
CHORD_DEVIATION = 0.1
MAX_SAMPLES = 100_000
"""Most samples of a motion: half a kilometre of the base, or 160 turns of a joint."""
# [m] or [rad]
_MAX_COORDINATE = 1e12
# A count of steps that exceeds an integer by rounding is that integer.
_COUNT_ROUNDING = 1e-9


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
        self.scene = scene
        self.trajectory = trajectory
        self.world = World(scene)
        self._frames: dict[tuple[str, ...], BatchedModel] = {}  # by their names
        self.grasp_freedoms: dict[str, Freedom] = {}
        for owner, placed in scene.objects.items():
            for attachment in placed.object.attachments.values():
                names = [f"{owner}.{name}" for name in attachment.coordinates]
                self.grasp_freedoms.update(zip(names, attachment.freedoms, strict=True))
        self._check_names()
        self._check_phases()
        self._check_positions()
        self.times, self.waypoint_rows = self._choose_times()
        self.free_objects = FreeObjects(scene, trajectory)
        self.z = self.world.compute_positions(trajectory, self.times, self.free_objects)

    def _check_names(self) -> None:
        robot_names = self.scene.robot.coordinates.names
        size = len(robot_names)
        first_names = self.trajectory.names[:size]
        if first_names != robot_names or self.trajectory.robot_size != size:
            raise InputError(
                "not this robot's coordinates",
                field="trajectory.names",
                expected=robot_names,
                got=first_names,
            )
        known = [*self.world.coordinates.names, *self.grasp_freedoms]
        for name in self.trajectory.names:
            check_choice(name, known, "coordinate", "trajectory.names")

    def _check_phases(self) -> None:
        measured = {hold for hold in self.scene.holds if hold.deviation}
        for number, phase in enumerate(self.trajectory.phases):
            where = f"trajectory.phases[{number}]"
            measured &= set(phase.holds)
            if phase.opening is not None:
                self._check_opening(phase.opening, f"{where}.opening")
            for hold in phase.holds:
                if hold.deviation and hold not in measured:
                    raise InputError(
                        "only grasps of the scene's start deviate, until they end",
                        field=f"{where}.deviation",
                        got=str(hold),
                    )
                self._check_hold(hold, where)

    def _check_hold(self, hold: Hold, where: str) -> None:
        """Check object, attachment, frame and coordinates of a hold; `where` is the phase."""
        owner = hold.object
        check_choice(owner, self.scene.objects, "object", f"{where}.held")
        attachments = self.scene.objects[owner].object.attachments
        check_choice(hold.attachment, attachments, f"attachment of '{owner}'", f"{where}.held")
        if hold.frame is not None:
            self.check_frame(hold.frame, f"{where}.by")
        for name in attachments[hold.attachment].coordinates:
            coordinate = f"{owner}.{name}"
            if coordinate not in self.trajectory.names:
                raise InputError(
                    "this grasp's coordinate is missing",
                    field="trajectory.names",
                    expected=coordinate,
                )

    def _check_positions(self) -> None:
        positions = self.trajectory.positions
        far = np.argwhere(np.abs(positions) > _MAX_COORDINATE)
        if len(far):
            raise InputError(
                "out of range",
                field=f"trajectory.positions{far[0].tolist()}",
                expected=f"up to {_MAX_COORDINATE:g}",
                got=positions[tuple(far[0])],
            )

    def _check_opening(self, opening: float, field: str) -> None:
        gripper = self.scene.robot.gripper
        if gripper is None:
            raise InputError(
                "the robot's gripper does not open",
                field=field,
                expected="a `gripper` in its robot.yaml",
                got=opening,
            )
        if abs(gripper.clamp_opening(opening) - opening) > WIDTH_TOLERANCE:
            raise InputError(
                "the gripper cannot be so far open",
                field=field,
                expected=f"{gripper.min_opening:.4g} to {gripper.max_opening:.4g} m",
                got=opening,
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
            waypoint = self.find_waypoint(row)
            time = self.times[row]
        if waypoint is None:
            assert time is not None
            waypoint = int(np.searchsorted(self.trajectory.times, time, side="right")) - 1
        if time is None:
            time = self.trajectory.times[waypoint]
        return Violation(
            constraint,
            subject,
            waypoint=waypoint,
            time=float(time),
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
        curve = self.trajectory.curve
        edges = self.trajectory.times if curve is None else curve.times
        required = self._count_samples()
        self.required_count = float(required.sum())
        self.is_truncated = self.required_count > max(MAX_SAMPLES, len(required))
        counts = np.ones(len(required), int) if self.is_truncated else required.astype(int)
        rows = np.concatenate([[0], np.cumsum(counts)])  # those of the edges
        numbers = np.arange(rows[-1]) - np.repeat(rows[:-1], counts)  # since the edge before
        steps = np.repeat(np.diff(edges) / counts, counts)
        inner = np.repeat(edges[:-1], counts) + numbers * steps
        times = np.append(inner, edges[-1])
        return times, rows[np.searchsorted(edges, self.trajectory.times)]

    def _count_samples(self) -> Floats:
        """Count the samples that each segment, or cubic of the curve, requires, shape (K,).

        In a time h a coordinate with |q̇| ≤ v travels at most h v. If |q̈| ≤ a, it deviates from its
        chord by at most a h² / 8. In each of n equal parts the deviation is 1 / n² of that.
        """
        curve = self.trajectory.curve
        if curve is None:
            travel = np.abs(np.diff(self.trajectory.positions, axis=0))
            deviation = np.zeros_like(travel)
        else:
            spans = np.diff(curve.times)[:, None]
            speeds, accelerations = curve.compute_max_rates()
            travel = speeds * spans
            deviation = accelerations * spans**2 / 8.0
        max_steps = self._list_max_steps()
        planar = np.linalg.norm(travel[:, :2], axis=1) / LENGTH_STEP
        single = (travel / max_steps).max(axis=1)
        bent = np.sqrt((deviation / (CHORD_DEVIATION * max_steps)).max(axis=1))
        most = np.maximum.reduce([planar, single, bent])
        return np.asarray(np.maximum(1, np.ceil(most - _COUNT_ROUNDING)))

    def _list_max_steps(self) -> Floats:
        """Return the largest step between two samples for each coordinate, shape (n,)."""
        coordinates = self.world.coordinates
        of_world = coordinates.compute_max_steps(LENGTH_STEP, ANGLE_STEP)
        known = dict(zip(coordinates.names, of_world, strict=True))
        by_unit = {"m": LENGTH_STEP, "rad": ANGLE_STEP}
        names = self.trajectory.names
        return np.array([known.get(name, by_unit[self.get_unit(name)]) for name in names])

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
            lower = float(robot.lower[i])
            upper = float(robot.upper[i])
            if i < 3 and robot.base == "fixed":
                lower = upper = float(self.scene.start[i])
            if i < 2:
                begin, end = self.scene.arena[2 * i : 2 * i + 2]
                lower = max(lower, begin)
                upper = min(upper, end)
            return lower, upper, float(robot.velocity[i]), float(robot.acceleration[i])
        if name in self.grasp_freedoms:
            freedom = self.grasp_freedoms[name]
            return freedom.lower, freedom.upper, np.inf, np.inf
        owner, _, joint = name.partition(".")
        item = self.scene.objects[owner].object
        i = item.coordinates.index(joint)
        return (
            float(item.lower[i]),
            float(item.upper[i]),
            float(item.velocity[i]),
            float(item.acceleration[i]),
        )

    @cached_property
    def start_velocity(self) -> Floats:
        """Velocity of the trajectory's coordinates with which the motion must begin, shape (n,).

        That of a held object's joints and of its grasp follows from the hand's, which the closure
        determines: it is NaN if the robot moves.
        """
        velocity = np.zeros(len(self.trajectory.names))
        robot_velocity = self.scene.start_velocity
        if not robot_velocity.any():
            return velocity
        velocity[: len(robot_velocity)] = robot_velocity
        for k, name in enumerate(self.trajectory.names):
            owner, separator, _ = name.partition(".")
            if separator and owner in self.scene.held:
                velocity[k] = np.nan
        return velocity

    @cached_property
    def start_acceleration(self) -> Floats:
        """Acceleration of the trajectory's coordinates before the start, shape (n,).

        Only that of a base on wheels is not zero, which follows an arc: θ̇ (−ẏ, ẋ).
        """
        acceleration = np.zeros(len(self.trajectory.names))
        if self.scene.robot.base in ("differential", "ackermann"):
            vx, vy, turn = self.scene.start_velocity[:3]
            acceleration[:2] = (-turn * vy, turn * vx)
        return acceleration

    def estimate_start_velocity(self) -> Floats:
        """Return `start_velocity`, with the first segment's mean velocity where that is unknown."""
        is_known = ~np.isnan(self.start_velocity)
        return np.where(is_known, self.start_velocity, self.trajectory.velocities()[0])

    def find_waypoint(self, row: int) -> int:
        """Return the last waypoint at or before a sample."""
        return int(np.searchsorted(self.waypoint_rows, row, side="right")) - 1

    def get_rows(self, phase: PhaseSpan) -> Ints:
        """Return the rows of a phase's samples, including both ends."""
        return np.arange(self.waypoint_rows[phase.first], self.waypoint_rows[phase.last] + 1)

    def find_driven_coordinates(self, holds: Iterable[Hold]) -> set[str]:
        """Return the object coordinates that holds drive: the joints from base to attachment."""
        model = self.world.model
        names = set[str]()
        for hold in holds:
            link = self.scene.objects[hold.object].object.attachments[hold.attachment].link
            joint = model.frames[model.getFrameId(f"{hold.object}.{link}")].parentJoint
            while joint:
                names.add(str(model.names[joint]))
                joint = model.parents[joint]
        return names

    def compute_placements(self, rows: Iterable[int], frame: str) -> list[pin.SE3]:
        """Return the placements of a frame in the world at the given samples."""
        rotations, origins = self._compute_frames(self.z[np.asarray(rows)], frame)
        poses = zip(rotations[:, 0], origins[:, 0], strict=True)
        return [pin.SE3(rotation, origin) for rotation, origin in poses]

    def _compute_frames(self, z: Floats, *names: str) -> tuple[Floats, Floats]:
        """Compute rotations, shape (K, F, 3, 3), and origins, shape (K, F, 3) [m], of F frames."""
        model = self.world.model
        if names not in self._frames:
            numbers = [model.getFrameId(name) for name in names]
            self._frames[names] = BatchedModel.of_frames(model, numbers)
        return self._frames[names].compute_poses(self.world.coordinates.q(z))

    def compute_grasp_errors(self, hold: Hold, rows: Ints) -> Floats:
        """Compute position [m] and angle [rad] errors of a grasp at samples, shape (K, 2)."""
        return self._compute_grasp_errors(hold, self.times[rows], self.z[rows])

    def compute_grasp_errors_at(self, hold: Hold, times: Floats) -> Floats:
        """Compute the errors of a grasp at increasing times, shape (K,) [s]."""
        z = self.world.compute_positions(self.trajectory, times, self.free_objects)
        return self._compute_grasp_errors(hold, times, z)

    def _compute_grasp_errors(self, hold: Hold, times: Floats, z: Floats) -> Floats:
        """Compute the errors at times, shape (K,), with the world's coordinates there, (K, n).

        The hand H holds the link L at the attachment's tool frame A. In the world frame the
        position error is |p_H − (p_L + R_L p_A)|, the rotation from A to H is (R_L R_A)ᵀ R_H.
        """
        owner = hold.object
        attachment = get_attachment(self.scene.objects, hold)
        holder_frame = hold.frame or self.scene.robot.tool_frame
        link_frame = f"{owner}.{attachment.link}"
        rotations, origins = self._compute_frames(z, holder_frame, link_frame)
        hand = compute_hand_frame(self.scene.robot, attachment)
        hand_origins = origins[:, 0] + rotations[:, 0] @ hand.translation
        link_origins = origins[:, 1]
        link_rotations = rotations[:, 1]
        tool_rotations, tool_origins = _compute_tools(
            attachment, self._get_grasp_values(owner, attachment, times)
        )
        targets = link_origins + np.einsum("kij,kj->ki", link_rotations, tool_origins)
        offsets = hand_origins - targets
        target_rotations = link_rotations @ tool_rotations
        errors = np.swapaxes(target_rotations, 1, 2) @ rotations[:, 0] @ hand.rotation
        return np.column_stack([np.linalg.norm(offsets, axis=1), _compute_angles(errors)])

    def _get_grasp_values(self, owner: str, attachment: Attachment, times: Floats) -> Floats:
        """Return the coordinates of a grasp at times, shape (K, freedoms); 0 where unplanned."""
        names = self.trajectory.names
        positions = self.trajectory.at(times)
        values = np.zeros((len(times), len(attachment.coordinates)))
        for column, suffix in enumerate(attachment.coordinates):
            name = f"{owner}.{suffix}"
            if name in names:
                values[:, column] = positions[:, names.index(name)]
        return values


def _compute_tools(attachment: Attachment, values: Floats) -> tuple[Floats, Floats]:
    """Compute `Attachment.tool` for K rows of values: rotations (K, 3, 3), origins (K, 3) [m].

    A revolute freedom of angle θ about the unit axis a through the point c turns by
    R = I + sin θ [a] + (1 − cos θ) [a]² (Rodrigues) and moves the origin to c − R c. A prismatic
    one displaces it by its value along a.
    """
    rotations = np.broadcast_to(attachment.placement.rotation, (len(values), 3, 3))
    origins = np.broadcast_to(attachment.placement.translation, (len(values), 3))
    for freedom, amounts in zip(attachment.freedoms, values.T, strict=True):
        if freedom.unit == "rad":
            cross = pin.skew(freedom.axis)
            angles = amounts[:, None, None]
            rotation = np.eye(3) + np.sin(angles) * cross + (1.0 - np.cos(angles)) * cross @ cross
            shifts = freedom.through - rotation @ freedom.through
        else:
            rotation = np.eye(3)
            shifts = amounts[:, None] * freedom.axis
        origins = origins + np.einsum("kij,kj->ki", rotations, shifts)
        rotations = rotations @ rotation
    offset = attachment.offset
    return rotations @ offset.rotation, origins + rotations @ offset.translation


def _compute_angles(rotations: Floats) -> Floats:
    """Compute rotation angles, shape (K, 3, 3) → (K,) [rad]; accurate near 0 and near π.

    R − Rᵀ = 2 sin θ [a] and tr R = 1 + 2 cos θ.
    """
    skew = rotations - np.swapaxes(rotations, 1, 2)
    sine = 0.5 * np.linalg.norm(skew[:, [2, 0, 1], [1, 2, 0]], axis=1)
    cosine = 0.5 * (np.trace(rotations, axis1=1, axis2=2) - 1.0)
    return np.arctan2(sine, cosine)
