"""The torques of an arm along a motion: its own weight and inertia, what it carries, and what it pulls and pushes."""

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

_SHARES = np.array(
    [0.0, 0.5, 1.0]
)  # of each cubic at which it is looked at: accelerations jump at both ends


@dataclass(frozen=True, eq=False)
class MotionSamples:
    """A motion at K moments.

    Attributes:
        times: Shape (K,) [s].
        pieces: Which cubic of the curve each belongs to, shape (K,); without a curve, which
            segment.
        positions, velocities, accelerations: Shape (K, n) each.
    """

    times: Floats
    pieces: Ints
    positions: Floats
    velocities: Floats
    accelerations: Floats


def sample_curve(curve: Curve) -> MotionSamples:
    """Return the ends and the middle of every cubic of a curve, with its own accelerations at its ends."""
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
    """What the arm has to do with in a phase: the robot with what it carries, and what it moves."""

    model: pin.Model
    handles: tuple[Handle, ...]


class Torques:
    """The torques of an arm in the phases of a motion, by recursive Newton-Euler on the robot's model.

    What is in the hand, and what rides on that, is part of the hand. Where the hand moves joints of
    what stands fixed, it exerts the least wrench that does so; see `Handle`. Friction and rotors of
    the arm's own joints are left out, as descriptions hardly know them, and where a grasp leaves
    freedoms to what is carried, it is where it is in the middle of the phase.

    Args:
        scene: Robot and objects.
        trajectory: A motion; of its times nothing matters but that its phases follow each other.
        free: Its free objects, if somebody has them already.
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
        """Return the torques of the robot's coordinates, shape (K, robot's) [N·m], [N]; those of the base are 0.

        Args:
            phases: In which phase of the motion each moment is, shape (K,).
            positions: Of the motion's coordinates, shape (K, n).
            velocities: Shape (K, n).
            accelerations: Shape (K, n).
        """
        found = np.zeros((len(positions), self.trajectory.robot_size))
        for number in np.unique(phases).tolist():
            rows = np.flatnonzero(phases == number)
            found[rows] = self._in_phase(
                self._load(number), *(part[rows] for part in (positions, velocities, accelerations))
            )
        return found

    def along(self, times: Floats) -> Floats:
        """Return the torques of the robot's coordinates at times [s], shape (K,), within the motion: shape (K, robot's)."""
        trajectory = self.trajectory
        steps = np.clip(
            np.searchsorted(trajectory.times, times, side="right") - 1, 0, len(trajectory.times) - 2
        )
        motion = (
            read(times) for read in (trajectory.at, trajectory.velocity, trajectory.acceleration)
        )
        return self.at(self.phases_of(steps), *motion)

    def phases_of(self, waypoints: Ints) -> Ints:
        """Return the phases of the steps after some waypoints."""
        return np.searchsorted(
            [phase.last for phase in self.trajectory.phases[:-1]], waypoints, side="right"
        )

    @cached_property
    def massless_objects(self) -> tuple[str, ...]:
        """What is carried in some phase though nobody says what it weighs."""
        phases = zip(self.trajectory.phases, self._free.supports, strict=True)
        carried = dict.fromkeys(name for phase, rides in phases for name in (*phase.held, *rides))
        things = {name: self.scene.objects[name].object for name in carried}
        return tuple(name for name, thing in things.items() if thing.free and not thing.mass > 0.0)

    def _in_phase(
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
            jacobians, turns = (
                np.empty((len(positions), 6, load.model.nv)),
                np.empty((len(positions), 3, 3)),
            )
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

    def _load(self, number: int) -> _Load:
        """Return what the arm has to do with in a phase."""
        if number not in self._loads:
            phase, objects = self.trajectory.phases[number], self.scene.objects
            fixed = [hold for hold in phase.holds if not objects[hold.object].object.free]
            riders: dict[str, list[tuple[int, pin.Inertia]]] = {hold.object: [] for hold in fixed}
            model = pin.Model(self.scene.robot.model)
            if self._free.names:
                self._carry(number, model, riders)
            moved = [hold for hold in fixed if objects[hold.object].object.coordinates.size]
            self._loads[number] = _Load(
                model, tuple(Handle(self.scene, hold, riders[hold.object]) for hold in moved)
            )
        return self._loads[number]

    def _carry(
        self, number: int, model: pin.Model, riders: dict[str, list[tuple[int, pin.Inertia]]]
    ) -> None:
        """Add what is carried in a phase to the hand, and what rides on objects that stand fixed to those."""
        phase, rides, objects = (
            self.trajectory.phases[number],
            self._free.supports[number],
            self.scene.objects,
        )
        middle = self.trajectory.times[[phase.first, phase.last]].mean(keepdims=True)
        carried = [hold.object for hold in phase.holds if objects[hold.object].object.free]
        if not (carried or rides):
            return
        where, (row,) = self._free.at(middle), self.trajectory.at(middle)
        data, values = (
            model.createData(),
            dict(zip(self.trajectory.names, row.tolist(), strict=True)),
        )
        pin.forwardKinematics(
            model, data, self.scene.robot.coordinates.q(row[: self.trajectory.robot_size])
        )
        hand = model.frames[model.getFrameId(self.scene.robot.tool_frame)].parentJoint
        for name in (*carried, *rides):
            body = pin.XYZQUATToSE3(where[name][0]).act(
                _whole(objects[name].object, objects[name].state)
            )
            owner, _, link = rides.get(name, "").partition(".")
            if name in carried or owner in carried:
                model.inertias[hand] += data.oMi[hand].actInv(body)
            elif owner in riders:
                thing, own = objects[owner].object, objects[owner].placement.actInv(body)
                joints = zip(thing.coordinates.names, objects[owner].state.tolist(), strict=True)
                state = np.array([values.get(f"{owner}.{joint}", value) for joint, value in joints])
                inside = thing.model.createData()
                pin.forwardKinematics(thing.model, inside, thing.coordinates.q(state))
                joint = thing.model.frames[thing.link_frame(link)].parentJoint
                riders[owner].append((joint, inside.oMi[joint].actInv(own)))


def _whole(thing: ArticulatedObject, state: Floats) -> pin.Inertia:
    """Return the inertia of all links of an object in its base link's frame, its joints at `state`, shape (n,)."""
    data = thing.model.createData()
    pin.forwardKinematics(thing.model, data, thing.coordinates.q(state))
    return sum(
        (data.oMi[j].act(inertia) for j, inertia in enumerate(thing.model.inertias)),
        pin.Inertia.Zero(),
    )


def transform_to_base_axes(
    yaws: Floats, velocities: Floats, accelerations: Floats
) -> tuple[Floats, Floats]:
    """Return velocities and accelerations of the base in the world, shape (K, n), as those of Pinocchio's planar joint.

    Its velocity is that in its own axes, which turn; its acceleration is the derivative of these
    numbers.
    """
    v, a = velocities.copy(), accelerations.copy()
    for rows in (v, a):
        rows[:, :2] = np.transpose(rotate_into_base_frame(rows[:, 0], rows[:, 1], yaws))
    a[:, 0] += v[:, 2] * v[:, 1]
    a[:, 1] -= v[:, 2] * v[:, 0]
    return v, a
