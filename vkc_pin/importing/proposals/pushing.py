"""Finds faces of a link on which a hand can push a joint open."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.importing.proposals.candidates import Piece
from vkc_pin.importing.proposals.fitting import Opening
from vkc_pin.utils.arrays import Floats

_AREA = 4e-4  # [m²] smallest face: as of two fingertips
_ALIGNED = 0.9  # smallest cosine between the inward normal and the motion of the face
_FRACTIONS = (0.5, 0.25, 0.75, 0.1, 0.9)  # relative positions on a face
_LEVER = 0.1  # [m] smallest distance from a hinge
_SLIDE = 0.1  # [m] largest slide to either side
_NO_AREA = 1e-12  # [m²] up to which twice the area of a triangle counts as none


@dataclass(frozen=True, eq=False)
class Push:
    """A place on a face, to be pushed along its inward normal.

    Attributes:
        piece: The pushed piece.
        placement: Frame in that of the piece's joint: z is the inward normal, x the longer side.
        slide: Lower and upper slide along x on the face [m].
        quality: Leverage and alignment with the motion, from 0 to 1.
    """

    piece: Piece
    placement: pin.SE3
    slide: tuple[float, float]
    quality: float


def find_pushes(piece: Piece, at: pin.SE3, opening: Opening, width: float) -> Iterator[Push]:
    """Yield places on the faces of a piece that move ahead of a hand when a joint opens.

    Args:
        piece: The piece.
        at: Frame of its joint in the base frame of the object.
        opening: Opening motion of the joint.
        width: Width of the fingers [m].
    """
    for normal, corners in _find_faces(piece):
        low, high, rotation = _measure_face(normal, corners)
        half = (high - low) / 2.0
        if 4.0 * half[0] * half[1] < _AREA:
            continue
        inward = rotation[:, 2]
        depth = float(corners[0] @ inward)
        for fraction_x, fraction_y in itertools.product(_FRACTIONS, _FRACTIONS):
            place = low + np.array([fraction_x, fraction_y]) * (high - low)
            point = rotation @ np.append(place, depth)
            motion, lever = _find_motion(opening, at.act(point))
            alignment = float((at.rotation @ inward) @ motion)
            if alignment < _ALIGNED or lever < _LEVER:
                continue
            # The fingers stay on the face.
            longest = min(_SLIDE, 0.5 * lever)
            slide_low = max(-longest, min(0.0, low[0] - place[0] + width / 2.0))
            slide_high = min(longest, max(0.0, high[0] - place[0] - width / 2.0))
            leverage = lever / max(opening.reach, 1e-3) if opening.turns else 1.0
            centrality = 1.0 - 0.4 * max(abs(fraction_x - 0.5), abs(fraction_y - 0.5))
            quality = alignment * min(leverage, 1.0) * centrality
            yield Push(piece, pin.SE3(rotation, point), (slide_low, slide_high), quality)


def _find_motion(opening: Opening, point: Floats) -> tuple[Floats, float]:
    """Return the direction in which a point moves, and its distance from a hinge [m].

    With the hinge's unit axis a and the arm r from the axis to the point, the velocity is along
    a × r.
    """
    if not opening.turns:
        return opening.axis, np.inf
    arm = point - opening.origin
    arm = arm - (arm @ opening.axis) * opening.axis
    lever = float(np.linalg.norm(arm))
    return np.cross(opening.axis, arm) / max(lever, 1e-9), lever


def _find_faces(piece: Piece) -> Iterator[tuple[Floats, Floats]]:
    """Yield the outward normal and the corners, shape (n, 3) [m], of each face of a piece."""
    triangles = piece.vertices[piece.faces]
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    has_area = np.linalg.norm(normals, axis=1) > _NO_AREA
    triangles = triangles[has_area]
    normals = normals[has_area]
    normals = normals / np.linalg.norm(normals, axis=1)[:, None]
    # Of a convex piece, they point away from its middle.
    outward = np.einsum("ij,ij->i", normals, triangles[:, 0] - piece.vertices.mean(axis=0))
    normals *= np.where(outward < 0.0, -1.0, 1.0)[:, None]
    # A face is all triangles of about the same normal.
    _, groups = np.unique(normals.round(3), axis=0, return_inverse=True)
    for group in range(groups.max(initial=-1) + 1):
        members = groups.ravel() == group
        yield normals[members][0], triangles[members].reshape(-1, 3)


def _measure_face(normal: Floats, corners: Floats) -> tuple[Floats, Floats, Floats]:
    """Return lower and upper corner along x and y, shape (2,) each, and the axes as columns."""
    z = -normal
    first = np.eye(3)[np.abs(normal).argmin()]
    first = first - (first @ normal) * normal
    first /= np.linalg.norm(first)
    second = np.cross(z, first)
    if np.ptp(corners @ second) > np.ptp(corners @ first):
        first, second = second, -first
    along = corners @ np.column_stack([first, second])
    return along.min(axis=0), along.max(axis=0), np.column_stack([first, second, z])
