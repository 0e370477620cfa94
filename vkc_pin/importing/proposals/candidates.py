"""Finds bars, knobs and edges of convex pieces whose thickness fits between the fingers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.importing.proposals.hand import Hand
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.shapes import get_link_name, triangulate

DEEP = 0.06
"""Depth along the approach above which a piece is an edge rather than a bar [m]."""
_DEPTH = 0.02  # [m] by which the tool's origin lies behind an edge
_DIRECTIONS = 8  # directions of approach around a bar: every 45°
_LONG = 0.12  # [m] length above which a piece is grasped at several positions
_POSITIONS = (0.5, 0.3, 0.7, 0.1, 0.9)  # relative positions along a long piece
_LEVEL = 0.3  # sine of the slope up to which a direction counts as horizontal
_ROUND = 1.5  # a hand may rotate about a bar while the thickness changes by at most this factor
_ANGLES = np.arange(0.1, 1.61, 0.1)  # [rad]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A candidate grasp of a piece.

    Attributes:
        piece: The grasped piece.
        kind: "bar", "knob" or "edge".
        placement: Tool frame in the frame of the piece's joint, with the bar's centre at its
            origin.
        thickness: Thickness between the fingers [m].
        span: Lower and upper extent of the piece along the tool's y axis [m].
        round: Largest rotation of the hand about that axis in both directions that the piece's
            shape allows [rad].
    """

    piece: Piece
    kind: str
    placement: pin.SE3
    thickness: float
    span: tuple[float, float]
    round: float


@dataclass
class Thickness:
    """Counts grasps that were checked and those that are too thick; thinnest of the latter [m]."""

    tried: int = 0
    too_thick: int = 0
    thinnest: float = np.inf


def find_candidates(
    piece: Piece, hand: Hand, clearance: float, up: Floats, counts: Thickness
) -> Iterator[Candidate]:
    """Yield the grasps of a piece that its thickness allows.

    Args:
        piece: The piece.
        hand: The hand.
        clearance: Clearance of the open fingers on either side [m].
        up: Upward direction in the frame of the piece's joint, shape (3,).
        counts: Statistics, which are updated.
    """
    widest = hand.opening - 2.0 * clearance
    for axis in range(3):
        low, high = piece.extents[axis].tolist()
        for fraction in _POSITIONS if high - low > _LONG else _POSITIONS[:1]:
            at = low + fraction * (high - low)
            section = piece.compute_section(axis, at)
            if section is None:
                continue
            for turn in np.arange(_DIRECTIONS) * 2.0 * np.pi / _DIRECTIONS:
                approach = np.array([np.cos(turn), np.sin(turn)])
                grasp = _find_grasp(section, approach, hand, widest, counts)
                if grasp is None:
                    continue
                centre, thickness, is_edge = grasp
                placement = pin.SE3(
                    _make_tool_axes(section.axes, approach, up), section.to_joint_frame(centre)
                )
                ends = (
                    (low - at, high - at)
                    if (placement.rotation[:, 1] @ piece.axes[axis]) > 0.0
                    else (at - high, at - low)
                )
                kind = "edge" if is_edge else "bar" if high - low > DEEP else "knob"
                rotation = (
                    0.0 if is_edge else _measure_rotation(section, approach, thickness, widest)
                )
                yield Candidate(piece, kind, placement, thickness, ends, rotation)


def _find_grasp(
    section: Section, approach: Floats, hand: Hand, widest: float, counts: Thickness
) -> tuple[Floats, float, bool] | None:
    """Return centre, thickness, and whether it is an edge, of a grasp; None if it does not fit."""
    closing = np.array([-approach[1], approach[0]])
    near, far = section.extent(approach)
    is_edge = far - near > DEEP
    between = section.clip(approach, near + _DEPTH + hand.tip) if is_edge else section
    if between is None or not between.is_graspable(closing):
        return None
    low, high = between.extent(closing)
    counts.tried += 1
    if high - low > widest:
        counts.too_thick, counts.thinnest = counts.too_thick + 1, min(counts.thinnest, high - low)
        return None
    depth = near + _DEPTH if is_edge else (near + far) / 2.0
    return depth * approach + (low + high) / 2.0 * closing, high - low, is_edge


def _make_tool_axes(axes: Floats, approach: Floats, up: Floats) -> Floats:
    """Return the tool's axes as columns, shape (3, 3), for an approach in the plane of two axes."""
    z, x = approach @ axes, np.array([-approach[1], approach[0]]) @ axes
    y = np.cross(z, x)
    direction = x @ up if abs(x @ up) > _LEVEL else y @ up
    return np.column_stack([x, y, z] if direction >= 0.0 else [-x, -y, z])


def _measure_rotation(section: Section, approach: Floats, thickness: float, widest: float) -> float:
    """Return the largest rotation about a bar [rad] at which its thickness is about the same."""
    rotation = 0.0
    for angle in _ANGLES:
        for direction in (angle, -angle):
            a = (
                np.array(
                    [
                        [np.cos(direction), -np.sin(direction)],
                        [np.sin(direction), np.cos(direction)],
                    ]
                )
                @ approach
            )
            low, high = section.extent(np.array([-a[1], a[0]]))
            if high - low > min(widest, _ROUND * thickness) or _ROUND * (high - low) < thickness:
                return rotation
        rotation = float(angle)
    return rotation


# Relative difference up to which widths are equal. The frame's own axes are preferred then, as
# round bars have no axes of their own.
_EQUAL_WIDTH = 0.03
# Largest angle between the closing direction and a face normal: rubber on smooth paint, friction
# 0.36.
_SLIP = np.radians(20.0)
_SAME = 1e-9  # [m]


@dataclass(frozen=True, eq=False)
class Section:
    """A planar cross-section of a convex piece.

    Attributes:
        centre: Origin of the plane's coordinates, in the frame of the piece's joint, shape (3,)
            [m].
        axes: Two directions that span the plane, shape (2, 3).
        polygon: Vertices in order, in the plane's coordinates, shape (n, 2) [m].
    """

    centre: Floats
    axes: Floats
    polygon: Floats

    def extent(self, direction: Floats) -> tuple[float, float]:
        """Return the extent along a unit direction in the plane, shape (2,) [m]."""
        along = self.polygon @ direction
        return float(along.min()), float(along.max())

    def clip(self, direction: Floats, limit: float) -> Section | None:
        """Return the part up to `limit` [m] along a unit direction, shape (2,); None if empty."""
        along, corners = self.polygon @ direction - limit, list[Floats]()
        for k, (here, there) in enumerate(zip(along, np.roll(along, -1), strict=True)):
            if here <= 0.0:
                corners.append(self.polygon[k])
            if here * there < 0.0:
                corners.append(
                    self.polygon[k]
                    + here / (here - there) * (self.polygon[(k + 1) % len(along)] - self.polygon[k])
                )
        return Section(self.centre, self.axes, np.array(corners)) if len(corners) > 2 else None

    def is_graspable(self, closing: Floats) -> bool:
        """Return whether fingers that close along a unit direction, shape (2,), do not slip."""
        edges = np.roll(self.polygon, -1, axis=0) - self.polygon
        lengths = np.linalg.norm(edges, axis=1)
        edges = edges[lengths > 1e-5] / lengths[lengths > 1e-5, None]
        # Outward normals, as the vertices are ordered counter-clockwise.
        facing = np.column_stack([edges[:, 1], -edges[:, 0]]) @ closing
        return bool(
            len(facing) and facing.max() >= np.cos(_SLIP) and facing.min() <= -np.cos(_SLIP)
        )

    def to_joint_frame(self, place: Floats) -> Floats:
        """Return a point of the plane, shape (2,), in the frame of the joint, shape (3,) [m]."""
        return np.asarray(self.centre + place @ self.axes)


@dataclass(frozen=True, eq=False)
class Piece:
    """A convex shape of a link.

    Attributes:
        link: Its link.
        name: Its name, `<link>_<k>`.
        vertices: Vertices in the frame of its joint, shape (n, 3) [m].
        faces: Triangles, shape (m, 3).
    """

    link: str
    name: str
    vertices: Floats
    faces: NDArray[np.int64]

    @classmethod
    def from_shape(cls, shape: pin.GeometryObject) -> Piece:
        """Return the piece of an object's shape."""
        vertices, faces = triangulate(shape.geometry)
        placed = vertices @ shape.placement.rotation.T + shape.placement.translation
        return cls(get_link_name(shape.name), str(shape.name), np.asarray(placed), faces)

    @cached_property
    def axes(self) -> Floats:
        """Perpendicular axes of a tight box, by rows, the thinnest last, shape (3, 3)."""
        corners = self.vertices[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        normals = normals[lengths > 1e-12] / lengths[lengths > 1e-12, None]
        _, first = np.unique(normals.round(4), axis=0, return_index=True)
        normals = np.vstack([np.eye(3), normals[np.sort(first)]])
        thin = self._find_narrowest(normals)
        across = normals - np.outer(normals @ thin, thin)
        lengths = np.linalg.norm(across, axis=1)
        second = self._find_narrowest(across[lengths > 0.3] / lengths[lengths > 0.3, None])
        return np.array([np.cross(second, thin), second, thin])

    def _find_narrowest(self, directions: Floats) -> Floats:
        """Return the first direction, of shape (n, 3), along which the width is about minimal."""
        widths = np.ptp(self.vertices @ directions.T, axis=0)
        return np.asarray(
            directions[int(np.argmax(widths <= (1.0 + _EQUAL_WIDTH) * widths.min() + _SAME))]
        )

    @cached_property
    def extents(self) -> Floats:
        """Lower and upper extent along each of `axes`, shape (3, 2) [m]."""
        along = self.vertices @ self.axes.T
        return np.column_stack([along.min(axis=0), along.max(axis=0)])

    @cached_property
    def _edges(self) -> NDArray[np.int64]:
        pairs = np.sort(
            np.vstack([self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]]]), axis=1
        )
        return np.unique(pairs, axis=0)

    def compute_section(self, axis: int, at: float) -> Section | None:
        """Return the cross-section normal to `axes[axis]` at `at` [m]; None if there is none."""
        normal, plane = self.axes[axis], np.delete(self.axes, axis, axis=0)
        height = self.vertices @ normal - at
        first, second = height[self._edges].T
        cut = (first < 0.0) != (second < 0.0)
        if cut.sum() < 3:
            return None
        ends, fraction = self._edges[cut], (first[cut] / (first[cut] - second[cut]))[:, None]
        points = (1.0 - fraction) * self.vertices[ends[:, 0]] + fraction * self.vertices[ends[:, 1]]
        flat = points @ plane.T
        centre = (flat.min(axis=0) + flat.max(axis=0)) / 2.0
        flat -= centre
        inside = flat - flat.mean(axis=0)
        flat = flat[np.argsort(np.arctan2(inside[:, 1], inside[:, 0]))]
        if np.ptp(flat, axis=0).min() <= _SAME:
            return None
        return Section(np.asarray(at * normal + centre @ plane), plane, flat)
