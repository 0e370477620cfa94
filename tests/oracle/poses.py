"""Placements at many samples: rotations (S, 3, 3) and translations (S, 3) [m]; S = 1: constant."""

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
    """Placements over time."""

    turn: np.ndarray
    at: np.ndarray

    def __matmul__(self, other: Poses) -> Poses:
        return Poses(self.turn @ other.turn, (self.turn @ other.at[:, :, None])[:, :, 0] + self.at)

    def inverse(self) -> Poses:
        back = self.turn.transpose(0, 2, 1)
        return Poses(back, -np.einsum("kij,kj->ki", back, self.at))

    def points(self, point: np.ndarray) -> np.ndarray:
        """Where a point of the frame is, shape (S, 3)."""
        return self.turn @ point + self.at

    def row(self, k: int) -> Poses:
        """The placement at moment k alone."""
        k = 0 if len(self.turn) == 1 else k
        return Poses(self.turn[k][None], self.at[k][None])

    @property
    def is_constant(self) -> bool:
        """Whether it does not change."""
        return bool(
            np.ptp(self.turn, axis=0).max() < 1e-12 and np.ptp(self.at, axis=0).max() < 1e-12
        )


def rotate_rpy(roll: float, pitch: float, yaw: float) -> np.ndarray:
    """Return the rotation by roll about x, then pitch about y, then yaw about z, shape (3, 3)."""
    (a, b, c), (u, v, w) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_x = np.array([[1, 0, 0], [0, a, -u], [0, u, a]])
    about_y = np.array([[b, 0, v], [0, 1, 0], [-v, 0, b]])
    about_z = np.array([[c, -w, 0], [w, c, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def read_orientation(about: Mapping[str, Any]) -> np.ndarray:
    """Return the rotation that `rpy`, `yaw` or `quaternion` of a description says, shape (3, 3)."""
    if about.get("quaternion"):
        x, y, z, w = np.array(about["quaternion"], float) / np.linalg.norm(about["quaternion"])
        across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        return np.eye(3) + 2.0 * w * across + 2.0 * across @ across
    return rotate_rpy(*(about.get("rpy") or (0.0, 0.0, about.get("yaw") or 0.0)))


def make_pose(position: object = (0.0, 0.0, 0.0), turn: np.ndarray | None = None) -> Poses:
    """Return one placement."""
    return Poses(
        (np.eye(3) if turn is None else np.asarray(turn, float))[None],
        np.asarray(position, float)[None],
    )


def rotate_about_axis(axis: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return rotations about an axis by angles, shape (S,): shape (S, 3, 3) (Rodrigues)."""
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return (
        np.eye(3)
        + np.sin(angles)[:, None, None] * cross
        + (1 - np.cos(angles))[:, None, None] * (cross @ cross)
    )


def compute_angle(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the angles between rotations, shape (S,) [rad]; precise where they are small."""
    return 2.0 * np.arcsin(
        np.clip(np.linalg.norm(one - other, axis=(1, 2)) / np.sqrt(8.0), 0.0, 1.0)
    )


IDENTITY = make_pose()
