"""Computes the wrenches that a hand exerts on a fixed object to move its joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.scene.contact_rules import compute_hand_frame
from vkc_pin.world.scene.hold import Hold, get_attachment
from vkc_pin.world.scene.scene import Scene

__all__ = ["Handle", "Loads"]

Loads = Sequence[tuple[int, pin.Inertia]]
"""Supported loads: joint of the object's model, and inertia in the frame of that joint."""
_GRIP = 0.1  # lever arm of a hand, for the weighting of torques [m]
_SINGULAR = 1e-9  # relative cutoff for joints that the hand cannot move
# Velocity of a joint at rest [m/s], [rad/s], and distance from its latch or stop [m], [rad].
_STILL = 1e-6


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
        own, loaded = pin.Model(item.model), pin.Model(item.model)
        for joint, inertia in loads:
            loaded.inertias[joint] += inertia
        own.gravity.linear = loaded.gravity.linear = (
            self.placed.placement.rotation.T @ item.model.gravity.linear
        )
        self._own, self._loaded = own, loaded
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
        data, links = self._own.createData(), list[pin.SE3]()
        jacobians = np.empty((len(z), 6, self._own.nv))
        for k, q in enumerate(item.coordinates.q(z)):
            pin.computeJointJacobians(self._own, data, q)
            links.append(pin.updateFramePlacement(self._own, data, self._frame).copy())
            jacobians[k] = pin.getFrameJacobian(
                self._own, data, self._frame, pin.LOCAL_WORLD_ALIGNED
            ).reshape(6, -1)
        turns = np.array([link.rotation for link in links])
        origins = np.array([link.translation for link in links])
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
        data, found = self._own.createData(), np.empty(z.shape)
        for k, q in enumerate(item.coordinates.q(z)):
            carried = pin.computeGeneralizedGravity(self._own, data, q)
            found[k] = pin.rnea(self._loaded, data, q, v[k], a[k]) - carried
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
