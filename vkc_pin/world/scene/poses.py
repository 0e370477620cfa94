"""Converts poses and points given by users to Pinocchio placements."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, format_value
from vkc_pin.utils.arguments import check_array
from vkc_pin.utils.arrays import MAX_COORDINATE

_POSE = "a pinocchio.SE3, a 4 x 4 matrix, (x, y, z, roll, pitch, yaw) or (x, y, z, qx, qy, qz, qw)"
_NORM_TOLERANCE = 1e-3  # of a unit quaternion


def as_placement(pose: Any, *, name: str = "pose") -> pin.SE3:
    """Return `pose` as a `pinocchio.SE3`."""
    array = check_array(
        pose.homogeneous if isinstance(pose, pin.SE3) else pose, name, _POSE, problem="not a pose"
    )
    if array.shape not in ((6,), (7,), (4, 4)):
        got = f"an array of shape {array.shape}" if array.ndim else format_value(pose)
        raise InputError("not a pose", field=name, expected=_POSE, got=got)
    if not np.all(np.isfinite(array)):
        raise InputError("not finite", field=name, expected=_POSE, got=array.tolist())
    if np.abs(array).max() > MAX_COORDINATE:
        expected = f"metres and radians from {-MAX_COORDINATE:g} to {MAX_COORDINATE:g}"
        raise InputError("out of range", field=name, expected=expected, got=array.tolist())
    if array.shape == (6,):
        return pin.SE3(pin.rpy.rpyToMatrix(*array[3:]), array[:3])
    if array.shape == (7,):
        norm = float(np.linalg.norm(array[3:]))
        if abs(norm - 1.0) > _NORM_TOLERANCE:
            raise InputError(
                "not a rotation",
                field=name,
                expected="a unit quaternion (x, y, z, w)",
                got=array[3:].tolist(),
            )
        return pin.SE3(pin.Quaternion(array[3:] / norm).matrix(), array[:3])
    rotation = array[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0:
        raise InputError(
            "its upper left 3 x 3 block is not a rotation", field=name, got=rotation.tolist()
        )
    if np.abs(array[3] - (0.0, 0.0, 0.0, 1.0)).max() > 1e-6:
        raise InputError(
            "its last row is wrong", field=name, expected=[0, 0, 0, 1], got=array[3].tolist()
        )
    return pin.SE3(rotation, array[:3, 3])


def as_target(target: Any, *, name: str) -> pin.SE3 | tuple[float, float, float]:
    """Return a point [m] for three numbers, and a placement otherwise; see `as_placement`."""
    if isinstance(target, pin.SE3):
        return as_placement(target, name=name)
    point = check_array(
        target, name, f"a point (x, y, z), or a pose: {_POSE}", problem="not a pose or a point"
    )
    if point.ndim < 2 and point.shape not in ((3,), (6,), (7,)):
        expected = f"a point (x, y, z), or a pose: {_POSE}"
        raise InputError(
            "not a pose or a point", field=name, expected=expected, got=format_value(target)
        )
    if point.shape != (3,):
        return as_placement(target, name=name)
    if not np.abs(point).max() <= MAX_COORDINATE:
        expected = f"a point (x, y, z) of metres from {-MAX_COORDINATE:g} to {MAX_COORDINATE:g}"
        problem = "out of range" if np.isfinite(point).all() else "not finite"
        raise InputError(problem, field=name, expected=expected, got=point.tolist())
    return (float(point[0]), float(point[1]), float(point[2]))
