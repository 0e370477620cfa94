"""How wide a bar fits between the fingers of a hand: the measure of how far it is open."""

from __future__ import annotations

from collections.abc import Sequence

import coal
import numpy as np
import pinocchio as pin

__all__ = ["BAR_THICKNESS", "WIDTH_TOLERANCE", "PlacedShape", "check_bar_fits", "find_widest_bar"]

BAR_THICKNESS = 2e-3
"""How thick the bar is, across the direction that is measured [m]."""
WIDTH_TOLERANCE = 1e-4
"""How exactly the widest bar is known [m]."""
_MAX_WIDTH = 0.5  # [m]: no hand opens wider

PlacedShape = tuple[coal.CollisionGeometry, pin.SE3]
"""A shape, and where it is."""


def check_bar_fits(width: float, shapes: Sequence[PlacedShape]) -> bool:
    """Return whether a bar at the tool's origin, so wide along its x axis [m], hits none of some shapes in the tool frame."""
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
    """Return how wide a bar at the tool's origin may be [m], 0 if none fits: all narrower ones fit."""
    low, high = 0.0, _MAX_WIDTH
    while high - low > WIDTH_TOLERANCE:
        middle = (low + high) / 2.0
        low, high = (middle, high) if check_bar_fits(middle, shapes) else (low, middle)
    return low
