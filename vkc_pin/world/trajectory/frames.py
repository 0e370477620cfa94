"""Expresses motions of a base in another frame on the floor."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.wheels import rotate_into_base_frame


def place_base(frame: Floats, rows: Floats) -> Floats:
    """Return configurations whose base is given in a frame on the floor, in the frame's parent.

    Args:
        frame: The frame in its parent: x, y [m], yaw [rad], shape (3,).
        rows: Configurations, the base's x, y [m] and yaw [rad] first, shape (..., n).
    """
    placed = turn_base(frame[2], rows)
    placed[..., :3] += frame
    return placed


def turn_base(yaw: float, rows: Floats) -> Floats:
    """Return configurations or velocities whose base's x and y are turned by a yaw [rad]."""
    turned = np.array(rows, float)
    # The inverse of a rotation into frames with this yaw
    turned[..., 0], turned[..., 1] = rotate_into_base_frame(rows[..., 0], rows[..., 1], -yaw)
    return turned


def invert_frame(frame: Floats) -> Floats:
    """Return the parent of a frame on the floor in this frame: x, y [m], yaw [rad], shape (3,)."""
    return -turn_base(-frame[2], frame)


def place_motion(frame: Floats, motion: Trajectory) -> Trajectory:
    """Return a motion whose base is given in a frame on the floor, in the frame's parent.

    Args:
        frame: The frame in its parent: x, y [m], yaw [rad], shape (3,).
        motion: The motion.
    """
    curve = motion.curve
    if curve is not None:
        rates = turn_base(frame[2], curve.rates)
        curve = Curve(curve.times, place_base(frame, curve.positions), rates)
    return replace(motion, positions=place_base(frame, motion.positions), curve=curve)
