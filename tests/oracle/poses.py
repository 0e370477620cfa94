"""Computes with placements at samples: rotations (S, 3, 3) and translations (S, 3) [m]."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

__all__ = [
    "IDENTITY",
    "Poses",
    "compute_angle",
    "make_pose",
    "read_orientation",
    "rotate_about_axis",
    "rotate_rpy",
]


class Poses(NamedTuple):
    """Placements over time; S = 1: constant."""

    rotation: np.ndarray
    translation: np.ndarray

    def __matmul__(self, other: Poses) -> Poses:
        return Poses(
            self.rotation @ other.rotation,
            (self.rotation @ other.translation[:, :, None])[:, :, 0] + self.translation,
        )

    def inverse(self) -> Poses:
        inverse_rotation = self.rotation.transpose(0, 2, 1)
        return Poses(inverse_rotation, -np.einsum("kij,kj->ki", inverse_rotation, self.translation))

    def transform_point(self, point: np.ndarray) -> np.ndarray:
        """Return a point of the frame in the parent frame, shape (S, 3)."""
        return self.rotation @ point + self.translation

    def get_sample(self, k: int) -> Poses:
        """Return the placement at sample k."""
        k = 0 if len(self.rotation) == 1 else k
        return Poses(self.rotation[k][None], self.translation[k][None])

    @property
    def is_constant(self) -> bool:
        """Whether all placements are equal."""
        return bool(
            np.ptp(self.rotation, axis=0).max() < 1e-12
            and np.ptp(self.translation, axis=0).max() < 1e-12
        )


def rotate_rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return the rotation by roll about x, then pitch about y, then yaw about z, shape (3, 3)."""
    (a, b, c), (u, v, w) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_x = np.array([[1, 0, 0], [0, a, -u], [0, u, a]])
    about_y = np.array([[b, 0, v], [0, 1, 0], [-v, 0, b]])
    about_z = np.array([[c, -w, 0], [w, c, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def read_orientation(description: Mapping[str, Any]) -> np.ndarray:
    """Return the rotation of a description's `rpy`, `yaw` or `quaternion`, shape (3, 3)."""
    if description.get("quaternion"):
        x, y, z, w = np.array(description["quaternion"], float) / np.linalg.norm(
            description["quaternion"]
        )
        skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.eye(3) + 2.0 * w * skew + 2.0 * skew @ skew
    return rotate_rpy(*(description.get("rpy") or (0.0, 0.0, description.get("yaw") or 0.0)))


def make_pose(position: object = (0.0, 0.0, 0.0), rotation: np.ndarray | None = None) -> Poses:
    """Return a constant placement."""
    return Poses(
        (np.eye(3) if rotation is None else np.asarray(rotation, float))[None],
        np.asarray(position, float)[None],
    )


def rotate_about_axis(axis: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return rotations about an axis, shape (S, 3, 3), by angles of shape (S,) (Rodrigues)."""
    x, y, z = axis / np.linalg.norm(axis)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return (
        np.eye(3)
        + np.sin(angles)[:, None, None] * skew
        + (1 - np.cos(angles))[:, None, None] * (skew @ skew)
    )


def compute_angle(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angles between rotations, shape (S,) [rad]; accurate for small angles."""
    return 2.0 * np.arcsin(
        np.clip(np.linalg.norm(one - other, axis=(1, 2)) / np.sqrt(8.0), 0.0, 1.0)
    )


IDENTITY = make_pose()
