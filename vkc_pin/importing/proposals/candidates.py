"""Finds bars, knobs and edges of convex pieces whose thickness fits between the fingers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.importing.proposals.hand import Hand
from vkc_pin.importing.proposals.sections import Piece, Section
from vkc_pin.utils.arrays import Floats

__all__ = ["Candidate", "Thickness", "find_candidates"]

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
            section = piece.cut(axis, at)
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
    """Return the tool's axes as columns, shape (3, 3), for an approach in the plane of two axes.

    Of the two possible orientations, it has the closing direction, or else the bar, pointing up.
    """
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
