"""Placements as twelve numbers: the columns of the rotation, then the translation [m]."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.collision.solids import load_compiled

__all__ = ["ShapePlacements", "flatten_placements"]

_NUMBERS = 12


def flatten_placements(placements: Sequence[pin.SE3]) -> Floats:
    """Return placements as numbers, shape (n, 12): the columns of each rotation, then the translation [m]."""
    columns = np.empty((len(placements), _NUMBERS))
    for row, placement in zip(columns, placements, strict=True):
        row[:9], row[9:] = placement.rotation.T.ravel(), placement.translation
    return columns


class ShapePlacements:
    """Where the shapes of a model are, at one configuration after the other: Pinocchio's kinematics, to the last bit.

    Args:
        model: The model.
        geometry: The shapes on its joints, M of them.

    Raises:
        BuildError: See `solids.load_compiled`.
    """

    def __init__(self, model: pin.Model, geometry: pin.GeometryModel) -> None:
        shapes, described = geometry.geometryObjects, pin.serialization.StreamBuffer()
        model.saveToBinary(described)
        content = bytes(described.view())  # as tobytes() does, which leaks a view at every call
        joints = np.array([shape.parentJoint for shape in shapes], np.int64)
        self.compiled: Any = load_compiled().Bodies(
            content, joints, flatten_placements([shape.placement for shape in shapes])
        )

    def at(self, q: Floats) -> Floats:
        """Return the placements of the shapes in the world frame, shape (W, M, 12).

        Args:
            q: Configurations, shape (W, nq).

        Returns:
            Placements in the format of `flatten_placements`.
        """
        return np.asarray(self.compiled.placements(q), float)
