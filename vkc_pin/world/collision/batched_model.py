"""Evaluates Pinocchio's algorithms for many configurations at once, in compiled code."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.collision.solids import FIRST_TRANSLATION, flatten_placements, load_compiled


class BatchedModel:
    """A model with M frames at W configurations at once; results are Pinocchio's, bit by bit.

    Args:
        model: The model, with nq coordinates and nv velocities.
        joints: Joint of each frame, shape (M,).
        placements: Placements of the frames on their joints, see `flatten_placements`, (M, 12).
    """

    def __init__(self, model: pin.Model, joints: Ints, placements: Floats) -> None:
        serialized = pin.serialization.StreamBuffer()
        model.saveToBinary(serialized)
        content = bytes(serialized.view())  # tobytes() would leak a view at every call
        self.compiled: Any = load_compiled().Bodies(content, joints, placements)

    @classmethod
    def of_shapes(cls, model: pin.Model, geometry: pin.GeometryModel) -> Self:
        """Return a model with its shapes as frames."""
        shapes = geometry.geometryObjects
        joints = np.array([shape.parentJoint for shape in shapes], np.int64)
        return cls(model, joints, flatten_placements([shape.placement for shape in shapes]))

    @classmethod
    def of_frames(cls, model: pin.Model, numbers: Sequence[int]) -> Self:
        """Return a model with some of its frames."""
        frames = [model.frames[number] for number in numbers]
        joints = np.array([frame.parentJoint for frame in frames], np.int64)
        return cls(model, joints, flatten_placements([frame.placement for frame in frames]))

    def compute_placements(self, q: Floats) -> Floats:
        """Return the placements of the frames in the world, shape (W, M, 12).

        Args:
            q: Pinocchio configurations, shape (W, nq).

        Returns:
            Placements in the format of `flatten_placements`.
        """
        return np.asarray(self.compiled.placements(q), float)

    def compute_poses(self, q: Floats) -> tuple[Floats, Floats]:
        """Return rotations, shape (W, M, 3, 3), and origins, shape (W, M, 3) [m], in the world."""
        placements = self.compute_placements(q)
        columns = placements[..., :FIRST_TRANSLATION]
        rotations = columns.reshape(*columns.shape[:-1], 3, 3).swapaxes(-1, -2)
        return rotations, placements[..., FIRST_TRANSLATION:]

    def compute_jacobians(self, q: Floats) -> Floats:
        """Return the Jacobians at the frames' origins in the axes of the world, (W, M, 6, nv)."""
        return np.asarray(self.compiled.jacobians(q), float)

    def compute_inverse_dynamics(self, q: Floats, v: Floats, a: Floats) -> Floats:
        """Return the joint torques by recursive Newton-Euler, shape (W, nv) [N·m], [N].

        Args:
            q: Pinocchio configurations, shape (W, nq).
            v: Velocities, shape (W, nv).
            a: Accelerations, shape (W, nv).
        """
        return np.asarray(self.compiled.inverse_dynamics(q, v, a), float)
