"""Measures the opening of a gripper as the width of a bar that fits between its fingers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats

__all__ = [
    "BAR_THICKNESS",
    "WIDEST_BAR",
    "WIDTH_TOLERANCE",
    "PlacedShape",
    "check_bar_fits",
    "find_thickest_rod",
    "find_widest_bar",
]

BAR_THICKNESS = 2e-3
"""Thickness of the bar across the measured direction [m]."""
WIDTH_TOLERANCE = 1e-4
"""Accuracy of the width of the widest bar [m]."""
_MAX_WIDTH = 0.5  # [m]: larger than any opening
_ROD_LENGTH = 0.12  # [m]: longer than fingers are wide
_ALONG_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
WIDEST_BAR = _MAX_WIDTH - WIDTH_TOLERANCE
"""Width from which no shape limits a bar [m]."""

PlacedShape = tuple[coal.CollisionGeometry, pin.SE3]
"""A shape and its placement."""


def check_bar_fits(width: float, shapes: Sequence[PlacedShape]) -> bool:
    """Return whether a bar at the tool's origin collides with none of the shapes.

    Args:
        width: Width of the bar along the tool's x axis [m].
        shapes: Shapes with their placements in the tool frame.
    """
    return _is_free(coal.Box(width, BAR_THICKNESS, BAR_THICKNESS), np.eye(3), shapes)


def find_widest_bar(shapes: Sequence[PlacedShape]) -> float:
    """Return the width of the widest bar that fits at the tool's origin [m]; 0 if none does."""
    return _find_largest(lambda width: check_bar_fits(width, shapes))


def find_thickest_rod(shapes: Sequence[PlacedShape]) -> float:
    """Return the largest diameter of a rod along the tool's y axis that fits at its origin [m].

    It is 0 if none fits.
    """
    return _find_largest(
        lambda width: _is_free(coal.Cylinder(width / 2.0, _ROD_LENGTH), _ALONG_Y, shapes)
    )


def _is_free(solid: coal.ShapeBase, rotation: Floats, shapes: Sequence[PlacedShape]) -> bool:
    where = coal.Transform3s(rotation, np.zeros(3))
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    for geometry, placement in shapes:
        result.clear()
        at = coal.Transform3s(placement.rotation, placement.translation)
        if coal.collide(solid, where, geometry, at, request, result):
            return False
    return True


def _find_largest(check: Callable[[float], bool]) -> float:
    low, high = 0.0, _MAX_WIDTH
    while high - low > WIDTH_TOLERANCE:
        middle = (low + high) / 2.0
        low, high = (middle, high) if check(middle) else (low, middle)
    return low
