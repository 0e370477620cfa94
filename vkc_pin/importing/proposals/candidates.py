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
_ANGLES = np.arange(0.1, 1.61, 0.1)  # [rad] rotations about a bar that are checked
# Relative difference up to which widths are equal. The frame's own axes are preferred then, as
# round bars have no axes of their own.
_EQUAL_WIDTH = 0.03
# Largest angle between the closing direction and a face normal: rubber on smooth paint, friction
# 0.36.
_SLIP = np.radians(20.0)
_SAME = 1e-9  # [m] below which lengths are equal
_SHORT_EDGE = 1e-5  # [m] up to which an edge of a section has no direction
_NO_AREA = 1e-12  # [m²] up to which twice the area of a triangle counts as none
_ACROSS = 0.3  # smallest sine of the angle between a normal and the narrowest direction


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
    """Counts of grasps of a body by the thickness between the fingers.

    Attributes:
        tried: Number of grasps that were checked.
        too_thick: Number of those that do not fit between the fingers.
        thinnest: Smallest thickness of the latter [m].
    """

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
        length = high - low
        for fraction in _POSITIONS if length > _LONG else _POSITIONS[:1]:
            at = low + fraction * length
            section = piece.compute_section(axis, at)
            if section is None:
                continue
            for turn in np.arange(_DIRECTIONS) * 2.0 * np.pi / _DIRECTIONS:
                approach = np.array([np.cos(turn), np.sin(turn)])
                grasp = _find_grasp(section, approach, hand, widest, counts)
                if grasp is None:
                    continue
                centre, thickness, is_edge = grasp
                tool_axes = _make_tool_axes(section.axes, approach, up)
                placement = pin.SE3(tool_axes, section.to_joint_frame(centre))
                # The tool's y axis is along the piece, in its direction or against it.
                is_along = placement.rotation[:, 1] @ piece.axes[axis] > 0.0
                span = (low - at, high - at) if is_along else (at - high, at - low)
                rotation = 0.0
                if is_edge:
                    kind = "edge"
                else:
                    kind = "bar" if length > DEEP else "knob"
                    rotation = _measure_rotation(section, approach, thickness, widest)
                yield Candidate(piece, kind, placement, thickness, span, rotation)


def _find_grasp(
    section: Section, approach: Floats, hand: Hand, widest: float, counts: Thickness
) -> tuple[Floats, float, bool] | None:
    """Return centre, thickness, and whether it is an edge, of a grasp; None if it does not fit."""
    closing = _turn_left(approach)
    near, far = section.extent(approach)
    is_edge = far - near > DEEP
    # Of an edge, only the part ahead of the fingertips is between the fingers.
    between = section.clip(approach, near + _DEPTH + hand.tip) if is_edge else section
    if between is None or not between.is_graspable(closing):
        return None
    low, high = between.extent(closing)
    thickness = high - low
    counts.tried += 1
    if thickness > widest:
        counts.too_thick += 1
        counts.thinnest = min(counts.thinnest, thickness)
        return None
    depth = near + _DEPTH if is_edge else (near + far) / 2.0
    return depth * approach + (low + high) / 2.0 * closing, thickness, is_edge


def _turn_left(direction: Floats) -> Floats:
    """Return a direction in a plane, shape (2,), rotated by a right angle."""
    return np.array([-direction[1], direction[0]])


def _make_tool_axes(axes: Floats, approach: Floats, up: Floats) -> Floats:
    """Return the tool's axes as columns, shape (3, 3), for an approach in the plane of two axes.

    z is the approach, x the direction in which the fingers close, y = z × x. The fingers can also
    close along -x, with -y. Of both, that one is taken whose x points upwards, or whose y does if
    x is horizontal.
    """
    z = approach @ axes
    x = _turn_left(approach) @ axes
    y = np.cross(z, x)
    upwards = x @ up if abs(x @ up) > _LEVEL else y @ up
    if upwards >= 0.0:
        return np.column_stack([x, y, z])
    return np.column_stack([-x, -y, z])


def _measure_rotation(section: Section, approach: Floats, thickness: float, widest: float) -> float:
    """Return the largest rotation about a bar [rad] at which its thickness is about the same."""
    thickest = min(widest, _ROUND * thickness)
    rotation = 0.0
    for angle in _ANGLES:
        for signed_angle in (angle, -angle):
            cos = np.cos(signed_angle)
            sin = np.sin(signed_angle)
            turned = np.array([[cos, -sin], [sin, cos]]) @ approach
            low, high = section.extent(_turn_left(turned))
            if high - low > thickest or _ROUND * (high - low) < thickness:
                return rotation
        rotation = float(angle)
    return rotation


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
        """Return the part up to `limit` [m] along a unit direction, shape (2,); None if empty.

        An edge from p to p' crosses the limit at p + h / (h - h') (p' - p), with the signed
        distances h and h' of its ends beyond the limit.
        """
        heights = self.polygon @ direction - limit
        next_heights = np.roll(heights, -1)
        next_corners = np.roll(self.polygon, -1, axis=0)
        corners = list[Floats]()
        for k, corner in enumerate(self.polygon):
            here = heights[k]
            there = next_heights[k]
            if here <= 0.0:
                corners.append(corner)
            if here * there < 0.0:
                corners.append(corner + here / (here - there) * (next_corners[k] - corner))
        return Section(self.centre, self.axes, np.array(corners)) if len(corners) > 2 else None

    def is_graspable(self, closing: Floats) -> bool:
        """Return whether fingers that close along a unit direction, shape (2,), do not slip.

        Each finger needs a face whose normal is within the friction cone around the direction.
        """
        edges = np.roll(self.polygon, -1, axis=0) - self.polygon
        lengths = np.linalg.norm(edges, axis=1)
        has_length = lengths > _SHORT_EDGE
        edges = edges[has_length] / lengths[has_length, None]
        if not len(edges):
            return False
        # Outward normals, as the vertices are ordered counter-clockwise.
        facing = np.column_stack([edges[:, 1], -edges[:, 0]]) @ closing
        return bool(facing.max() >= np.cos(_SLIP) and facing.min() <= -np.cos(_SLIP))

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
        """Perpendicular axes of a tight box, by rows, the thinnest last, shape (3, 3).

        The last one is the narrowest of the faces' normals, the second the narrowest of their
        projections on the plane across it.
        """
        corners = self.vertices[self.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        lengths = np.linalg.norm(normals, axis=1)
        has_area = lengths > _NO_AREA
        normals = normals[has_area] / lengths[has_area, None]
        _, first = np.unique(normals.round(4), axis=0, return_index=True)
        normals = np.vstack([np.eye(3), normals[np.sort(first)]])
        thin = self._find_narrowest(normals)
        across = normals - np.outer(normals @ thin, thin)
        lengths = np.linalg.norm(across, axis=1)
        is_across = lengths > _ACROSS
        second = self._find_narrowest(across[is_across] / lengths[is_across, None])
        return np.array([np.cross(second, thin), second, thin])

    def _find_narrowest(self, directions: Floats) -> Floats:
        """Return the first direction, of shape (n, 3), along which the width is about minimal."""
        widths = np.ptp(self.vertices @ directions.T, axis=0)
        is_narrow = widths <= (1.0 + _EQUAL_WIDTH) * widths.min() + _SAME
        return np.asarray(directions[int(np.argmax(is_narrow))])

    @cached_property
    def extents(self) -> Floats:
        """Lower and upper extent along each of `axes`, shape (3, 2) [m]."""
        along = self.vertices @ self.axes.T
        return np.column_stack([along.min(axis=0), along.max(axis=0)])

    @cached_property
    def _edges(self) -> NDArray[np.int64]:
        """Pairs of vertices, each once, shape (n, 2)."""
        sides = (self.faces[:, [0, 1]], self.faces[:, [1, 2]], self.faces[:, [2, 0]])
        pairs = np.sort(np.vstack(sides), axis=1)
        return np.unique(pairs, axis=0)

    def compute_section(self, axis: int, at: float) -> Section | None:
        """Return the cross-section normal to `axes[axis]` at `at` [m]; None if there is none.

        Its corners are where edges cross the plane. An edge from p to p', with signed distances h
        and h' from the plane, does at (1 - t) p + t p' with t = h / (h - h').
        """
        normal = self.axes[axis]
        plane = np.delete(self.axes, axis, axis=0)
        height = self.vertices @ normal - at
        first, second = height[self._edges].T
        is_cut = (first < 0.0) != (second < 0.0)
        if is_cut.sum() < 3:
            return None
        start, end = self._edges[is_cut].T
        fraction = (first[is_cut] / (first[is_cut] - second[is_cut]))[:, None]
        points = (1.0 - fraction) * self.vertices[start] + fraction * self.vertices[end]
        flat = points @ plane.T
        centre = (flat.min(axis=0) + flat.max(axis=0)) / 2.0
        flat -= centre
        # Corners of a convex section are in order by their angle around a point inside it.
        inside = flat - flat.mean(axis=0)
        flat = flat[np.argsort(np.arctan2(inside[:, 1], inside[:, 0]))]
        if np.ptp(flat, axis=0).min() <= _SAME:
            return None
        return Section(np.asarray(at * normal + centre @ plane), plane, flat)
