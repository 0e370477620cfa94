"""Computes the arm's joint torques along a motion, with carried objects and contact wrenches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.dynamics import TorqueLimits
from vkc_pin.world.scene.contact_rules import compute_hand_frame
from vkc_pin.world.scene.hold import Hold, get_attachment
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
_SHARES = np.array([0.0, 0.5, 1.0])  # of each cubic: accelerations jump at both ends


class Motion(NamedTuple):
    """A motion at K times: coordinate → positions, velocities, accelerations, shape (K,) each."""

    positions: Mapping[str, Floats]
    velocities: Mapping[str, Floats]
    accelerations: Mapping[str, Floats]


class Handle:
    """A hand at an attachment of a fixed object."""

    def __init__(self, scene: Scene, hold: Hold, loads: Loads = ()) -> None:
        self.name, self.placed = hold.object, scene.objects[hold.object]
        item = self.placed.object
        self.attachment = get_attachment(scene.objects, hold)
        self.point = compute_hand_frame(scene.robot, self.attachment)
        own = pin.Model(item.model)
        own.gravity.linear = np.zeros(3)  # springs carry the object itself, not its loads
        self._models = [own]
        if loads:
            loaded = pin.Model(item.model)
            loaded.gravity.linear = self.placed.placement.rotation.T @ item.model.gravity.linear
            for joint in range(loaded.njoints):
                loaded.inertias[joint] = pin.Inertia.Zero()
            for joint, inertia in loads:
                loaded.inertias[joint] += inertia
            self._models.append(loaded)
        self._frame = item.link_frame(self.attachment.link)
        path = list(own.supports[own.frames[self._frame].parentJoint])
        self._moved = [k for k, joint in enumerate(item.coordinates.joints) if joint in path]

    def wrenches(self, motion: Motion) -> Floats:
        """Compute the hand's wrenches at `point` in world axes, shape (K, 6) [N], [N·m]."""
        item, turn = self.placed.object, self.placed.placement.rotation
        forces = self.forces(motion)[:, self._moved]
        z = self._rows(motion.positions, self.placed.state)
        columns = [f"{self.name}.{name}" for name in self.attachment.coordinates]
        values = np.column_stack(
            [np.zeros((len(z), 0)), *(motion.positions[name] for name in columns)]
        )
        jacobians, turns, origins = _compute_jacobians(
            self._models[0], self._frame, item.coordinates.q(z)
        )
        points, free = self._grasp(turns, origins, values)
        directions = np.swapaxes(jacobians[:, :, self._moved], 1, 2)
        directions[..., :3] += np.cross(directions[..., 3:], (points - origins)[:, None])
        maps = np.concatenate([directions, free], axis=1)
        required = np.pad(forces, ((0, 0), (0, maps.shape[1] - forces.shape[1])))
        basis = self._bases(turns)
        shares = np.linalg.pinv(maps @ basis, rcond=_SINGULAR) @ required[..., None]
        return np.asarray((basis @ shares)[..., 0] @ np.kron(np.eye(2), turn).T)

    def _grasp(self, turns: Floats, origins: Floats, values: Floats) -> tuple[Floats, Floats]:
        """Compute positions of the hand and the free directions of its grasp, in the object's axes.

        The hand exerts no force in a free direction. Firm grasps and pushes have none.
        """
        at, axes = self.attachment, list[tuple[Floats, Floats | None]]()
        rotation, origin = turns @ at.placement.rotation, origins + turns @ at.placement.translation
        for freedom, value in zip(at.freedoms, values.T, strict=True):
            axis = rotation @ freedom.axis
            if freedom.kind == "revolute":
                through = origin + rotation @ freedom.through
                rotation = rotation @ np.array(
                    [pin.exp3(turn) for turn in np.outer(value, freedom.axis)]
                )
                origin = through - rotation @ freedom.through
                axes.append((axis, through))
            else:
                origin = origin + axis * value[:, None]
                axes.append((axis, None))
        points = origin + rotation @ at.offset.translation
        directions = np.zeros((len(turns), 0 if at.firm or at.contact == "push" else len(axes), 6))
        for k, (axis, center) in enumerate(axes[: directions.shape[1]]):
            directions[:, k, :3] = axis if center is None else np.cross(axis, points - center)
            directions[:, k, 3:] = 0.0 if center is None else axis
        return points, directions

    def forces(self, motion: Motion) -> Floats:
        """Compute the joint forces, shape (K, joints) [N], [N·m]; springs carry the weight."""
        item = self.placed.object
        z = self._rows(motion.positions, self.placed.state)
        v, a = (
            self._rows(part, np.zeros(len(self.placed.state)))
            for part in (motion.velocities, motion.accelerations)
        )
        found, configurations = np.zeros(z.shape), item.coordinates.q(z)
        for model in self._models:
            data = model.createData()
            for k, q in enumerate(configurations):
                found[k] += pin.rnea(model, data, q, v[k], a[k])
        held = {latch.joint: latch.held_at for latch in item.latches}
        for k, name in enumerate(item.coordinates.names):
            resistance, rests = item.resistance.get(name), np.abs(v[:, k]) <= _STILL
            if resistance is not None:
                found[:, k] += resistance.force(z[:, k], np.where(rests, 0.0, v[:, k]))
            shut = np.abs(z[:, k] - held.get(name, np.inf)) <= _STILL
            # Its stop or its bolt carries such forces.
            shut |= (z[:, k] <= item.lower[k] + _STILL) & (found[:, k] > 0.0)
            shut |= (z[:, k] >= item.upper[k] - _STILL) & (found[:, k] < 0.0)
            found[rests & shut & (np.abs(a[:, k]) <= _STILL), k] = 0.0
        return found

    def _rows(self, part: Mapping[str, Floats], otherwise: Floats) -> Floats:
        """Collect the object's coordinates as columns, shape (K, joints)."""
        size = len(next(iter(part.values())))
        names = self.placed.object.coordinates.names
        columns = (
            part.get(f"{self.name}.{name}", np.full(size, value))
            for name, value in zip(names, otherwise, strict=True)
        )
        return np.column_stack([np.zeros((size, 0)), *columns])

    def _bases(self, turns: Floats) -> Floats:
        """Compute bases of equally weighted wrenches, (K, 6, r); for a push, its direction."""
        if self.attachment.contact == "push":
            return np.pad(turns @ self.attachment.placement.rotation[:, 2], ((0, 0), (0, 3)))[
                ..., None
            ]
        return np.tile(np.diag([1.0] * 3 + [_GRIP] * 3), (len(turns), 1, 1))


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
    spans, count = np.diff(curve.times), len(curve.times) - 1
    times = sample_intervals(curve.times, _SHARES)
    begin = curve.acceleration(curve.times[:-1])
    middle = curve.acceleration(curve.times[:-1] + 0.5 * spans)
    accelerations = begin[:, None] + 2.0 * _SHARES[None, :, None] * (middle - begin)[:, None]
    return MotionSamples(
        times,
        np.repeat(np.arange(count), len(_SHARES)),
        curve.at(times),
        curve.velocity(times),
        accelerations.reshape(len(times), -1),
    )


@dataclass(frozen=True, eq=False)
class _Load:
    """The robot model of a phase with its carried objects, and the handles that the arm moves."""

    model: pin.Model
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
        self.scene, self.trajectory = scene, trajectory
        self._free = FreeObjects(scene, trajectory) if free is None else free
        self.torque_limits: TorqueLimits = scene.robot.efforts
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
                self._get_load(number),
                *(part[rows] for part in (positions, velocities, accelerations)),
            )
        return found

    def along(self, times: Floats) -> Floats:
        """Compute torques of the robot's coordinates at times [s] in the motion, shape (K,)."""
        trajectory = self.trajectory
        steps = np.clip(
            np.searchsorted(trajectory.times, times, side="right") - 1, 0, len(trajectory.times) - 2
        )
        motion = (
            read(times) for read in (trajectory.at, trajectory.velocity, trajectory.acceleration)
        )
        return self.at(self.phases_of(steps), *motion)

    def phases_of(self, waypoints: Ints) -> Ints:
        """Return the phases of the segments after waypoints."""
        return np.searchsorted(
            [phase.last for phase in self.trajectory.phases[:-1]], waypoints, side="right"
        )

    @cached_property
    def massless_objects(self) -> tuple[str, ...]:
        """Carried objects without mass data."""
        phases = zip(self.trajectory.phases, self._free.supports, strict=True)
        names = dict.fromkeys(
            name for phase, supports in phases for name in (*phase.held, *supports)
        )
        items = {name: self.scene.objects[name].object for name in names}
        return tuple(name for name, item in items.items() if item.free and not item.mass > 0.0)

    def _compute_in_phase(
        self, load: _Load, positions: Floats, velocities: Floats, accelerations: Floats
    ) -> Floats:
        robot, size = self.scene.robot, self.trajectory.robot_size
        v, a = transform_to_base_axes(
            positions[:, 2], velocities[:, :size], accelerations[:, :size]
        )
        data, found = load.model.createData(), np.empty((len(positions), size))
        configurations = robot.coordinates.q(positions[:, :size])
        for k, q in enumerate(configurations):
            found[k] = pin.rnea(load.model, data, q, v[k], a[k])
        parts = (
            dict(zip(self.trajectory.names, part.T, strict=True))
            for part in (positions, velocities, accelerations)
        )
        motion, frame = Motion(*parts), load.model.getFrameId(robot.tool_frame)
        for handle in load.handles:
            jacobians, turns, _ = _compute_jacobians(load.model, frame, configurations)
            wrenches = handle.wrenches(motion)
            wrenches[:, 3:] += np.cross(turns @ handle.point.translation, wrenches[:, :3])
            found += np.einsum("kij,ki->kj", jacobians, wrenches)
        found[:, :3] = 0.0
        return found

    def _get_load(self, number: int) -> _Load:
        """Return the load of a phase."""
        if number not in self._loads:
            phase, objects = self.trajectory.phases[number], self.scene.objects
            fixed = [hold for hold in phase.holds if not objects[hold.object].object.free]
            loads: dict[str, list[tuple[int, pin.Inertia]]] = {hold.object: [] for hold in fixed}
            model = pin.Model(self.scene.robot.model)
            if self._free.names:
                self._add_inertias(number, model, loads)
            moved = [hold for hold in fixed if objects[hold.object].object.coordinates.size]
            self._loads[number] = _Load(
                model, tuple(Handle(self.scene, hold, loads[hold.object]) for hold in moved)
            )
        return self._loads[number]

    def _add_inertias(
        self, number: int, model: pin.Model, loads: dict[str, list[tuple[int, pin.Inertia]]]
    ) -> None:
        """Add the inertias of carried objects to the hand, of supported ones to their supports."""
        phase, supports = self.trajectory.phases[number], self._free.supports[number]
        objects = self.scene.objects
        middle = self.trajectory.times[[phase.first, phase.last]].mean(keepdims=True)
        carried = [hold.object for hold in phase.holds if objects[hold.object].object.free]
        if not (carried or supports):
            return
        where, (row,) = self._free.at(middle), self.trajectory.at(middle)
        data = model.createData()
        values = dict(zip(self.trajectory.names, row.tolist(), strict=True))
        pin.forwardKinematics(
            model, data, self.scene.robot.coordinates.q(row[: self.trajectory.robot_size])
        )
        hand = model.frames[model.getFrameId(self.scene.robot.tool_frame)].parentJoint
        for name in (*carried, *supports):
            whole = _compute_inertia(objects[name].object, objects[name].state)
            body = pin.XYZQUATToSE3(where[name][0]).act(whole)
            owner, _, link = supports.get(name, "").partition(".")
            if name in carried or owner in carried:
                model.inertias[hand] += data.oMi[hand].actInv(body)
            elif owner in loads:
                item, own = objects[owner].object, objects[owner].placement.actInv(body)
                joints = zip(item.coordinates.names, objects[owner].state.tolist(), strict=True)
                state = np.array([values.get(f"{owner}.{joint}", value) for joint, value in joints])
                inside = item.model.createData()
                pin.forwardKinematics(item.model, inside, item.coordinates.q(state))
                joint = item.model.frames[item.link_frame(link)].parentJoint
                loads[owner].append((joint, inside.oMi[joint].actInv(own)))


def _compute_jacobians(
    model: pin.Model, frame: int, configurations: Floats
) -> tuple[Floats, Floats, Floats]:
    """Compute Jacobians of a frame at its origin, in the model's root axes, shape (K, 6, nv).

    Also returns the frame's rotations, shape (K, 3, 3), and origins, shape (K, 3) [m].
    """
    data, count = model.createData(), len(configurations)
    placement = data.oMf[frame]  # both are views, which every evaluation updates
    turn, origin = placement.rotation, placement.translation
    jacobians = np.empty((count, 6, model.nv))
    turns, origins = np.empty((count, 3, 3)), np.empty((count, 3))
    for k, q in enumerate(configurations):
        found = pin.computeFrameJacobian(model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
        jacobians[k], turns[k], origins[k] = found.reshape(6, -1), turn, origin
    return jacobians, turns, origins


def _compute_inertia(item: ArticulatedObject, state: Floats) -> pin.Inertia:
    """Compute an object's total inertia in the base frame at joint values `state`, (n,)."""
    data = item.model.createData()
    pin.forwardKinematics(item.model, data, item.coordinates.q(state))
    own = (data.oMi[j].act(inertia) for j, inertia in enumerate(item.model.inertias))
    return sum(own, pin.Inertia.Zero())


def transform_to_base_axes(
    yaws: Floats, velocities: Floats, accelerations: Floats
) -> tuple[Floats, Floats]:
    """Transform world velocities and accelerations, shape (K, n), to Pinocchio's planar joint.

    The joint's velocity is expressed in the rotating base frame; its acceleration is the time
    derivative of these components.
    """
    v, a = velocities.copy(), accelerations.copy()
    for rows in (v, a):
        rows[:, :2] = np.transpose(rotate_into_base_frame(rows[:, 0], rows[:, 1], yaws))
    a[:, 0] += v[:, 2] * v[:, 1]
    a[:, 1] -= v[:, 2] * v[:, 0]
    return v, a
