"""Chooses a viewpoint from which obstacles hide as little of a motion as possible."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vkc_pin.utils.arrays import Bools, Floats

FIELD_OF_VIEW = 40.0
"""Vertical opening angle of the camera [degrees]."""
LANDSCAPE = 1.5
"""Assumed width over height of a picture on a screen."""
PORTRAIT = 0.5
"""Assumed width over height of a picture on a telephone."""
_ELEVATIONS = {LANDSCAPE: np.radians(38.0), PORTRAIT: np.radians(50.0)}
# The first of equal azimuths is chosen: x to the right, y away.
_AZIMUTHS = np.radians(np.arange(-90.0, 270.0, 15.0))
# Weights of hidden points, and of azimuths that differ from the first, against the extent.
_HIDDEN_WEIGHT = 3.0
_AZIMUTH_WEIGHT = 0.10
# Fraction of the picture for the motion; the rest is a margin, and space for the control bar.
_FILLED = 0.80
# [m] smallest distance of the camera from its target
_MIN_DISTANCE = 1.0
# [m] up to which a point counts as on a box, which does not hide it
_ON_BOX = 0.05


def choose_viewpoint(
    points: Floats, boxes: Sequence[tuple[Floats, Floats, float]], aspect: float = LANDSCAPE
) -> tuple[Floats, Floats]:
    """Choose the target and position of a camera in the world, shape (3,) each [m].

    Args:
        points: Points of the motion, shape (n, 3) [m]. All of them will be in the picture.
        boxes: Boxes that may hide them: lower and upper corner, shape (3,) each [m], and opacity
            from 0 to 1.
        aspect: Width over height of the picture, `LANDSCAPE` or `PORTRAIT`. The motion extends
            along its longer side.
    """
    elevation = _ELEVATIONS[aspect]
    lower = points.min(axis=0)
    upper = points.max(axis=0)
    target = (lower + upper) / 2.0
    size = max(1e-9, float(np.linalg.norm(np.ptp(points[:, :2], axis=0))))
    scores: list[float] = []
    for azimuth in _AZIMUTHS:
        towards = _compute_direction(azimuth, elevation)
        hidden = _compute_hidden_fraction(points, towards, boxes)
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        away = np.array([-np.cos(azimuth), -np.sin(azimuth), 0.0])
        extent = np.ptp(points @ (right if aspect > 1.0 else away)) / size
        turn = 1.0 - np.cos(azimuth - _AZIMUTHS[0])
        scores.append(extent - _HIDDEN_WEIGHT * hidden - _AZIMUTH_WEIGHT * turn)
    azimuth = float(_AZIMUTHS[int(np.argmax(np.round(scores, 6)))])
    towards = _compute_direction(azimuth, elevation)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    up = np.cross(towards, right)
    # A point at the offset o from the target is in the picture of a camera at the distance d if
    # |o · up| <= tangent (d − o · towards), and likewise to the right.
    offsets = points - target
    tangent = np.tan(np.radians(FIELD_OF_VIEW) / 2.0) * _FILLED
    vertical = np.abs(offsets @ up) / tangent
    horizontal = np.abs(offsets @ right) / (tangent * aspect)
    distances = np.maximum(vertical, horizontal) + offsets @ towards
    distance = max(_MIN_DISTANCE, float(distances.max()))
    return target, target + towards * distance


def _compute_hidden_fraction(
    points: Floats, towards: Floats, boxes: Sequence[tuple[Floats, Floats, float]]
) -> float:
    """Return the fraction of points, weighted by opacity, that boxes hide from a direction."""
    columns = np.ascontiguousarray(points.T)
    hidden = np.zeros(len(points))
    last = float((points @ towards).min())
    for low, high, opacity in boxes:
        # Other boxes are behind all points.
        if np.maximum(low * towards, high * towards).sum() > last:
            np.maximum(hidden, opacity * _find_hidden(columns, towards, low, high), out=hidden)
    return float(hidden.mean())


def _compute_direction(azimuth: float, elevation: float) -> Floats:
    """Return the unit vector from the target to the camera, shape (3,)."""
    level = np.cos(elevation)
    return np.array([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)])


def _find_hidden(points: Floats, direction: Floats, lower: Floats, upper: Floats) -> Bools:
    """Return which points, shape (3, n), have rays along `direction` that meet the box.

    A ray is inside the box where it is between both planes of all three axes.
    """
    enter = np.full(points.shape[1], -np.inf)
    leave = np.full(points.shape[1], np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        # + 0 avoids negative zeros.
        for values, slope, low, high in zip(points, direction + 0.0, lower, upper, strict=True):
            near, far = (low, high) if slope >= 0.0 else (high, low)
            # NaN, for a ray along a face, is no bound.
            np.fmax(enter, (near - values) / slope, out=enter)
            np.fmin(leave, (far - values) / slope, out=leave)
    # A box does not hide the points in it or on it.
    return np.asarray((leave > enter) & (enter > _ON_BOX))
