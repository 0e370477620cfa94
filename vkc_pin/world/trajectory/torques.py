"""Computes the arm's joint torques along a motion, with carried objects and contact wrenches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.batched_model import BatchedModel
from vkc_pin.world.models.dynamics import TorqueLimits, compute_inertia
from vkc_pin.world.scene.contact_rules import compute_hand_frame
from vkc_pin.world.scene.hold import Hold, get_attachment
from vkc_pin.world.scene.placed_object import PlacedObject
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.curve import Curve, sample_intervals
from vkc_pin.world.trajectory.free_objects import FreeObjects
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.wheels import rotate_into_base_frame

Loads = Sequence[tuple[int, pin.Inertia]]
"""Supported loads: joint of the object's model, and inertia in the frame of that joint."""
_GRIP = 0.1  # lever arm of a hand, for the weighting of torques [m]
_SINGULAR = 1e-9  # relative cutoff for joints that the hand cannot move
# Velocity of a joint at rest [m/s], [rad/s], and distance from its latch or stop [m], [rad].
_STILL = 1e-6
_FRACTIONS = np.array([0.0, 0.5, 1.0])  # of each cubic: accelerations jump at both ends


class Motion(NamedTuple):
    """A motion at K times: coordinate → positions, velocities, accelerations, shape (K,) each."""

    positions: Mapping[str, Floats]
    velocities: Mapping[str, Floats]
    accelerations: Mapping[str, Floats]


class Handle:
    """A hand at an attachment of a fixed object."""

    def __init__(self, scene: Scene, hold: Hold, loads: Loads = ()) -> None:
        self.name = hold.object
        self.placed = scene.objects[hold.object]
        item = self.placed.object
        self.attachment = get_attachment(scene.objects, hold)
        self.point = compute_hand_frame(scene.robot, self.attachment)
        # Springs carry the object itself, not its loads: they have a model with gravity.
        own = pin.Model(item.model)
        own.gravity.linear = np.zeros(3)
        frame = item.link_frame(self.attachment.link)
        self._own = BatchedModel.of_frames(own, [frame])
        self._loaded: BatchedModel | None = None
        if loads:
            loaded = pin.Model(item.model)
            loaded.gravity.linear = self.placed.placement.rotation.T @ item.model.gravity.linear
            for joint in range(loaded.njoints):
                loaded.inertias[joint] = pin.Inertia.Zero()
            for joint, inertia in loads:
                loaded.inertias[joint] += inertia
            self._loaded = BatchedModel.of_frames(loaded, [])
        path = list(own.supports[own.frames[frame].parentJoint])
        self._moved = [k for k, joint in enumerate(item.coordinates.joints) if joint in path]

    def wrenches(self, motion: Motion) -> Floats:
        """Compute the hand's wrenches at `point` in world axes, shape (K, 6) [N], [N·m].

        With D the twists of the hand at unit velocities of the joints that it moves, the wrench w
        and the joint forces τ do the same work if D w = τ. In the free directions F of the grasp,
        the hand exerts no force: F w = 0. Of all solutions w = B s, with the basis B, that with
        the least |s| is taken.
        """
        item = self.placed.object
        forces = self.forces(motion)[:, self._moved]
        z = self._collect_columns(motion.positions, self.placed.state)
        freedoms = [np.zeros((len(z), 0))]
        for name in self.attachment.coordinates:
            freedoms.append(motion.positions[f"{self.name}.{name}"])
        q = item.coordinates.q(z)
        jacobians = self._own.compute_jacobians(q)[:, 0]
        rotations, origins = (poses[:, 0] for poses in self._own.compute_poses(q))
        points, free = self._place_hand(rotations, origins, np.column_stack(freedoms))
        # Twists of the link's frame, shape (K, joints, 6); v + ω × (p − o) at the hand.
        twists = np.swapaxes(jacobians[:, :, self._moved], 1, 2)
        twists[..., :3] += np.cross(twists[..., 3:], (points - origins)[:, None])
        maps = np.concatenate([twists, free], axis=1)
        required = np.pad(forces, ((0, 0), (0, maps.shape[1] - forces.shape[1])))
        basis = self._make_bases(rotations)
        weights = np.linalg.pinv(maps @ basis, rcond=_SINGULAR) @ required[..., None]
        wrenches = (basis @ weights)[..., 0]
        to_world = np.kron(np.eye(2), self.placed.placement.rotation)
        return np.asarray(wrenches @ to_world.T)

    def _place_hand(
        self, rotations: Floats, origins: Floats, values: Floats
    ) -> tuple[Floats, Floats]:
        """Compute positions of the hand and the free directions of its grasp, in the object's axes.

        The hand exerts no force in a free direction. Firm grasps and pushes have none.

        Args:
            rotations: Rotations of the grasped link, shape (K, 3, 3).
            origins: Origins of its frame, shape (K, 3) [m].
            values: Values of the f freedoms of the grasp, shape (K, f), [m] or [rad].

        Returns:
            Positions, shape (K, 3) [m], and twists of the free directions, shape (K, f, 6) or
                (K, 0, 6).
        """
        attachment = self.attachment
        rotation = rotations @ attachment.placement.rotation
        origin = origins + rotations @ attachment.placement.translation
        axes = list[tuple[Floats, Floats | None]]()  # direction, and a point if it is revolute
        for freedom, value in zip(attachment.freedoms, values.T, strict=True):
            axis = rotation @ freedom.axis
            if freedom.kind == "revolute":
                through = origin + rotation @ freedom.through
                rotation_vectors = np.outer(value, freedom.axis)
                rotation = rotation @ np.array([pin.exp3(vector) for vector in rotation_vectors])
                origin = through - rotation @ freedom.through
                axes.append((axis, through))
            else:
                origin = origin + axis * value[:, None]
                axes.append((axis, None))
        points = origin + rotation @ attachment.offset.translation
        if attachment.firm or attachment.contact == "push":
            axes = []
        twists = np.zeros((len(rotations), len(axes), 6))
        for k, (axis, through_point) in enumerate(axes):
            if through_point is None:
                twists[:, k, :3] = axis
            else:
                twists[:, k, :3] = np.cross(axis, points - through_point)
                twists[:, k, 3:] = axis
        return points, twists

    def forces(self, motion: Motion) -> Floats:
        """Compute the joint forces, shape (K, joints) [N], [N·m]; springs carry the weight."""
        item = self.placed.object
        rest = np.zeros(len(self.placed.state))
        z = self._collect_columns(motion.positions, self.placed.state)
        v = self._collect_columns(motion.velocities, rest)
        a = self._collect_columns(motion.accelerations, rest)
        q = item.coordinates.q(z)
        found = self._own.compute_inverse_dynamics(q, v, a)
        if self._loaded is not None:
            found += self._loaded.compute_inverse_dynamics(q, v, a)
        held = {latch.joint: latch.held_at for latch in item.latches}
        for k, name in enumerate(item.coordinates.names):
            is_still = np.abs(v[:, k]) <= _STILL
            resistance = item.resistance.get(name)
            if resistance is not None:
                found[:, k] += resistance.force(z[:, k], np.where(is_still, 0.0, v[:, k]))
            # The latch or the stop carries the forces of a joint at rest there.
            is_carried = np.abs(z[:, k] - held.get(name, np.inf)) <= _STILL
            is_carried |= (z[:, k] <= item.lower[k] + _STILL) & (found[:, k] > 0.0)
            is_carried |= (z[:, k] >= item.upper[k] - _STILL) & (found[:, k] < 0.0)
            is_resting = is_still & (np.abs(a[:, k]) <= _STILL)
            found[is_resting & is_carried, k] = 0.0
        return found

    def _collect_columns(self, part: Mapping[str, Floats], otherwise: Floats) -> Floats:
        """Collect the object's coordinates as columns, shape (K, joints)."""
        size = len(next(iter(part.values())))
        columns = [np.zeros((size, 0))]
        names = self.placed.object.coordinates.names
        for name, value in zip(names, otherwise, strict=True):
            columns.append(part.get(f"{self.name}.{name}", np.full(size, value)))
        return np.column_stack(columns)

    def _make_bases(self, rotations: Floats) -> Floats:
        """Make bases of equally weighted wrenches, (K, 6, r); for a push, its direction."""
        if self.attachment.contact == "push":
            normals = rotations @ self.attachment.placement.rotation[:, 2]
            no_moments = ((0, 0), (0, 3))
            return np.pad(normals, no_moments)[..., None]
        weights = np.diag([1.0, 1.0, 1.0, _GRIP, _GRIP, _GRIP])
        return np.tile(weights, (len(rotations), 1, 1))


@dataclass(frozen=True, eq=False)
class MotionSamples:
    """A motion at K times.

    Attributes:
        times: Shape (K,) [s].
        pieces: Cubic of the curve at each time, shape (K,); without a curve, the segment.
        positions, velocities, accelerations: Shape (K, n) each.
    """

    times: Floats
    pieces: Ints
    positions: Floats
    velocities: Floats
    accelerations: Floats


def sample_curve(curve: Curve) -> MotionSamples:
    """Sample every cubic of a curve at its ends and middle, with its own accelerations there."""
    times = sample_intervals(curve.times, _FRACTIONS)
    # Accelerations of a cubic are linear: a(s) = a(0) + 2 s (a(1/2) − a(0)) at the fraction s.
    durations = np.diff(curve.times)
    begin = curve.acceleration(curve.times[:-1])
    middle = curve.acceleration(curve.times[:-1] + 0.5 * durations)
    accelerations = begin[:, None] + 2.0 * _FRACTIONS[None, :, None] * (middle - begin)[:, None]
    return MotionSamples(
        times=times,
        pieces=np.repeat(np.arange(len(durations)), len(_FRACTIONS)),
        positions=curve.at(times),
        velocities=curve.velocity(times),
        accelerations=accelerations.reshape(len(times), -1),
    )


@dataclass(frozen=True, eq=False)
class _Load:
    """The robot of a phase with its carried objects, and the handles that the arm moves.

    The only frame of the robot is its tool.
    """

    robot: BatchedModel
    handles: tuple[Handle, ...]


class Torques:
    """The joint torques of an arm, by recursive Newton-Euler on the robot's model.

    Grasped objects, and objects that rest on them, are part of the hand. To move joints of a fixed
    object, the hand exerts the smallest sufficient wrench; see `Handle`. Friction and rotor
    inertias of the arm's joints are neglected, since robot descriptions rarely give them. An object
    in a grasp with freedoms is placed as in the middle of the phase.
    """

    def __init__(
        self, scene: Scene, trajectory: Trajectory, free: FreeObjects | None = None
    ) -> None:
        self.scene = scene
        self.trajectory = trajectory
        self._free = FreeObjects(scene, trajectory) if free is None else free
        self.torque_limits: TorqueLimits = scene.robot.torque_limits
        self._loads: dict[int, _Load] = {}

    def at(
        self, phases: Ints, positions: Floats, velocities: Floats, accelerations: Floats
    ) -> Floats:
        """Compute torques of the robot's coordinates; those of the base are 0.

        Args:
            phases: Phase of each state, shape (K,).
            positions: Positions of the motion's coordinates, shape (K, n) [m], [rad].
            velocities: Shape (K, n) [m/s], [rad/s].
            accelerations: Shape (K, n) [m/s²], [rad/s²].

        Returns:
            Torques, shape (K, robot coordinates) [N·m], [N].
        """
        found = np.zeros((len(positions), self.trajectory.robot_size))
        for number in np.unique(phases).tolist():
            rows = np.flatnonzero(phases == number)
            found[rows] = self._compute_in_phase(
                self._get_load(number), positions[rows], velocities[rows], accelerations[rows]
            )
        return found

    def along(self, times: Floats) -> Floats:
        """Compute torques of the robot's coordinates at times [s] in the motion, shape (K,)."""
        trajectory = self.trajectory
        last_segment = len(trajectory.times) - 2
        segments = np.searchsorted(trajectory.times, times, side="right") - 1
        segments = np.clip(segments, 0, last_segment)
        return self.at(
            self.phases_of(segments),
            trajectory.at(times),
            trajectory.velocity(times),
            trajectory.acceleration(times),
        )

    def phases_of(self, waypoints: Ints) -> Ints:
        """Return the phases of the segments after waypoints."""
        ends = [phase.last for phase in self.trajectory.phases[:-1]]
        return np.searchsorted(ends, waypoints, side="right")

    @cached_property
    def massless_objects(self) -> tuple[str, ...]:
        """Carried objects without mass data."""
        names = dict[str, None]()
        for phase, supports in zip(self.trajectory.phases, self._free.supports, strict=True):
            names.update(dict.fromkeys((*phase.held, *supports)))
        massless = list[str]()
        for name in names:
            item = self.scene.objects[name].object
            if item.free and not item.mass > 0.0:
                massless.append(name)
        return tuple(massless)

    def _compute_in_phase(
        self, load: _Load, positions: Floats, velocities: Floats, accelerations: Floats
    ) -> Floats:
        robot = self.scene.robot
        size = self.trajectory.robot_size
        names = self.trajectory.names
        v, a = transform_to_base_axes(
            positions[:, 2], velocities[:, :size], accelerations[:, :size]
        )
        q = robot.coordinates.q(positions[:, :size])
        found = load.robot.compute_inverse_dynamics(q, v, a)
        motion = Motion(
            positions=dict(zip(names, positions.T, strict=True)),
            velocities=dict(zip(names, velocities.T, strict=True)),
            accelerations=dict(zip(names, accelerations.T, strict=True)),
        )
        for handle in load.handles:
            jacobians = load.robot.compute_jacobians(q)[:, 0]
            rotations, _ = load.robot.compute_poses(q)
            wrenches = handle.wrenches(motion)
            # A force f at the point r of the hand has the moment r × f about the tool's origin.
            arms = rotations[:, 0] @ handle.point.translation
            wrenches[:, 3:] += np.cross(arms, wrenches[:, :3])
            # τ = Jᵀ w
            found += np.einsum("kij,ki->kj", jacobians, wrenches)
        found[:, :3] = 0.0
        return found

    def _get_load(self, number: int) -> _Load:
        """Return the load of a phase."""
        if number in self._loads:
            return self._loads[number]
        phase = self.trajectory.phases[number]
        objects = self.scene.objects
        fixed = [hold for hold in phase.holds if not objects[hold.object].object.free]
        loads: dict[str, list[tuple[int, pin.Inertia]]] = {hold.object: [] for hold in fixed}
        model = pin.Model(self.scene.robot.model)
        if self._free.names:
            self._add_inertias(number, model, loads)
        handles = list[Handle]()
        for hold in fixed:
            if objects[hold.object].object.coordinates.size:
                handles.append(Handle(self.scene, hold, loads[hold.object]))
        tool = model.getFrameId(self.scene.robot.tool_frame)
        self._loads[number] = _Load(BatchedModel.of_frames(model, [tool]), tuple(handles))
        return self._loads[number]

    def _add_inertias(
        self, number: int, model: pin.Model, loads: dict[str, list[tuple[int, pin.Inertia]]]
    ) -> None:
        """Add the inertias of carried objects to the hand, of supported ones to their supports."""
        phase = self.trajectory.phases[number]
        supports = self._free.supports[number]
        objects = self.scene.objects
        carried = [hold.object for hold in phase.holds if objects[hold.object].object.free]
        if not carried and not supports:
            return
        middle = self.trajectory.times[[phase.first, phase.last]].mean(keepdims=True)
        placements = self._free.at(middle)
        (row,) = self.trajectory.at(middle)
        values = dict(zip(self.trajectory.names, row.tolist(), strict=True))
        data = model.createData()
        q = self.scene.robot.coordinates.q(row[: self.trajectory.robot_size])
        pin.forwardKinematics(model, data, q)
        tool = model.frames[model.getFrameId(self.scene.robot.tool_frame)]
        hand = tool.parentJoint
        for name in (*carried, *supports):
            item = objects[name].object
            own_inertia = compute_inertia(item.model, item.coordinates.q(objects[name].state))
            placement = pin.XYZQUATToSE3(placements[name][0])
            world_inertia = placement.act(own_inertia)
            owner, _, link = supports.get(name, "").partition(".")
            if name in carried or owner in carried:
                model.inertias[hand] += data.oMi[hand].actInv(world_inertia)
            elif owner in loads:
                load = _express_in_joint(objects[owner], link, values, world_inertia)
                loads[owner].append(load)


def _express_in_joint(
    placed: PlacedObject, link: str, values: Mapping[str, float], inertia: pin.Inertia
) -> tuple[int, pin.Inertia]:
    """Return the joint of an object that carries a link, and an inertia in that joint's frame.

    Args:
        placed: The object.
        link: The link.
        values: Coordinate "<object>.<joint>" → value, where it differs from the object's state.
        inertia: The inertia in the world frame.
    """
    item = placed.object
    state = placed.state.astype(float)
    for column, joint_name in enumerate(item.coordinates.names):
        state[column] = values.get(f"{placed.name}.{joint_name}", state[column])
    data = item.model.createData()
    pin.forwardKinematics(item.model, data, item.coordinates.q(state))
    joint = item.model.frames[item.link_frame(link)].parentJoint
    in_object = placed.placement.actInv(inertia)
    return joint, data.oMi[joint].actInv(in_object)


def transform_to_base_axes(
    yaws: Floats, velocities: Floats, accelerations: Floats
) -> tuple[Floats, Floats]:
    """Transform world velocities and accelerations, shape (K, n), to Pinocchio's planar joint.

    The joint's velocity is expressed in the rotating base frame; its acceleration is the time
    derivative of these components.
    """
    v = velocities.copy()
    a = accelerations.copy()
    for rows in (v, a):
        along, aside = rotate_into_base_frame(rows[:, 0], rows[:, 1], yaws)
        rows[:, 0] = along
        rows[:, 1] = aside
    # With v in the base frame, which turns at ω, dv/dt = Rᵀ a − ω × v.
    a[:, 0] += v[:, 2] * v[:, 1]
    a[:, 1] -= v[:, 2] * v[:, 0]
    return v, a
