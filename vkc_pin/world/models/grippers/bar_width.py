"""Measures the opening of a gripper as the width of a bar that fits between its fingers."""

from __future__ import annotations

from collections.abc import Sequence

import coal
import numpy as np
import pinocchio as pin

__all__ = ["BAR_THICKNESS", "WIDTH_TOLERANCE", "PlacedShape", "check_bar_fits", "find_widest_bar"]

BAR_THICKNESS = 2e-3
"""Thickness of the bar across the measured direction [m]."""
WIDTH_TOLERANCE = 1e-4
"""Accuracy of the width of the widest bar [m]."""
_MAX_WIDTH = 0.5  # [m]: larger than any opening

PlacedShape = tuple[coal.CollisionGeometry, pin.SE3]
"""A shape and its placement."""


def check_bar_fits(width: float, shapes: Sequence[PlacedShape]) -> bool:
    """Return whether a bar at the tool's origin collides with none of the shapes.

    Args:
        width: Width of the bar along the tool's x axis [m].
        shapes: Shapes with their placements in the tool frame.
    """
    bar, where = (
        coal.Box(width, BAR_THICKNESS, BAR_THICKNESS),
        coal.Transform3s(np.eye(3), np.zeros(3)),
    )
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    for geometry, placement in shapes:
        result.clear()
        if coal.collide(
            bar,
            where,
            geometry,
            coal.Transform3s(placement.rotation, placement.translation),
            request,
            result,
        ):
            return False
    return True


def find_widest_bar(shapes: Sequence[PlacedShape]) -> float:
    """Return the width of the widest bar that fits at the tool's origin [m]; 0 if none does."""
    low, high = 0.0, _MAX_WIDTH
    while high - low > WIDTH_TOLERANCE:
        middle = (low + high) / 2.0
        low, high = (middle, high) if check_bar_fits(middle, shapes) else (low, middle)
    return low
