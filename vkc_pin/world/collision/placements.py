"""Computes the placements of a model's shapes as arrays of twelve numbers each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.collision.solids import load_compiled

__all__ = ["ShapePlacements", "flatten_placements"]

_SIZE = 12


def flatten_placements(placements: Sequence[pin.SE3]) -> Floats:
    """Return placements as rows of numbers, shape (n, 12).

    Each row has the columns of the rotation, then the translation [m].
    """
    rows = np.empty((len(placements), _SIZE))
    for row, placement in zip(rows, placements, strict=True):
        row[:9], row[9:] = placement.rotation.T.ravel(), placement.translation
    return rows


class ShapePlacements:
    """Forward kinematics of the shapes of a model, equal to Pinocchio's bit for bit.

    Args:
        model: The model.
        geometry: The M shapes on its joints.
    """

    def __init__(self, model: pin.Model, geometry: pin.GeometryModel) -> None:
        shapes, serialized = geometry.geometryObjects, pin.serialization.StreamBuffer()
        model.saveToBinary(serialized)
        content = bytes(serialized.view())  # tobytes() would leak a view at every call
        joints = np.array([shape.parentJoint for shape in shapes], np.int64)
        self.compiled: Any = load_compiled().Bodies(
            content, joints, flatten_placements([shape.placement for shape in shapes])
        )

    def compute_placements(self, q: Floats) -> Floats:
        """Return the placements of the shapes in the world frame, shape (W, M, 12).

        Args:
            q: Pinocchio configurations, shape (W, nq).

        Returns:
            Placements in the format of `flatten_placements`.
        """
        return np.asarray(self.compiled.placements(q), float)
