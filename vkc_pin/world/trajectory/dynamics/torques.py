"""Computes the arm's joint torques along a motion, with carried objects and contact wrenches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.models.articulated_object import ArticulatedObject
from vkc_pin.world.models.dynamics.torque_limits import TorqueLimits
from vkc_pin.world.scene.scene import Scene
from vkc_pin.world.trajectory.curve import Curve, sample_intervals
from vkc_pin.world.trajectory.dynamics.handles import Handle, Motion
from vkc_pin.world.trajectory.free_objects import FreeObjects
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.wheels import rotate_into_base_frame

__all__ = ["MotionSamples", "Torques", "sample_curve", "transform_to_base_axes"]

_SHARES = np.array([0.0, 0.5, 1.0])  # of each cubic: accelerations jump at both ends


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
    begin, middle = (
        curve.acceleration(curve.times[:-1]),
        curve.acceleration(curve.times[:-1] + 0.5 * spans),
    )
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
            jacobians = np.empty((len(positions), 6, load.model.nv))
            turns = np.empty((len(positions), 3, 3))
            for k, q in enumerate(configurations):
                jacobians[k] = pin.computeFrameJacobian(
                    load.model, data, q, frame, pin.LOCAL_WORLD_ALIGNED
                )
                turns[k] = data.oMf[frame].rotation
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
