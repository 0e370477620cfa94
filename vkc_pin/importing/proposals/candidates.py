"""Places of an object that fingers could close on, by thickness alone: bars, knobs and edges of its convex pieces."""

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
"""Deeper than this [m], seen along the approach, a piece is no bar that fingers reach around but an edge that they take."""
_DEPTH = 0.02  # [m]: how far the tool's origin goes beyond an edge
_TURNS = 8  # directions of approach around a bar: every 45°
_LONG = 0.12  # [m]: longer ones are taken in several places
_PLACES = (0.5, 0.3, 0.7, 0.1, 0.9)  # of the length of a long one
_LEVEL = 0.3  # sine of the slope up to which a direction counts as level
_ROUND = (
    1.5  # a hand may turn about a bar as long as that changes its thickness by no larger factor
)
_ANGLES = np.arange(0.1, 1.61, 0.1)  # [rad]


@dataclass(frozen=True, eq=False)
class Candidate:
    """A grasp of a piece.

    Attributes:
        piece: What is grasped.
        kind: "bar", "knob" or "edge".
        placement: The tool frame in the frame of the piece's joint, the grasped bar's middle in its
            origin.
        thickness: Of what is between the fingers [m].
        span: How far the piece goes on to both sides along the tool's y axis [m], lower and upper.
        round: How far the hand may turn about that axis to either side for the piece's shape alone
            [rad].
    """

    piece: Piece
    kind: str
    placement: pin.SE3
    thickness: float
    span: tuple[float, float]
    round: float


@dataclass
class Thickness:
    """What was looked at: how many places fingers could close on, how many were too thick, and the thinnest of those [m]."""

    tried: int = 0
    too_thick: int = 0
    thinnest: float = np.inf


def find_candidates(
    piece: Piece, hand: Hand, clearance: float, up: Floats, seen: Thickness
) -> Iterator[Candidate]:
    """Yield the grasps of a piece that its thickness allows.

    Args:
        piece: The piece.
        hand: The hand that shall take it.
        clearance: What the open fingers keep from it on either side [m].
        up: Upwards, in the frame of the piece's joint, shape (3,).
        seen: Is added to.
    """
    widest = hand.opening - 2.0 * clearance
    for axis in range(3):
        low, high = piece.extents[axis].tolist()
        for share in _PLACES if high - low > _LONG else _PLACES[:1]:
            at = low + share * (high - low)
            section = piece.cut(axis, at)
            if section is None:
                continue
            for turn in np.arange(_TURNS) * 2.0 * np.pi / _TURNS:
                approach = np.array([np.cos(turn), np.sin(turn)])
                found = _grasp(section, approach, hand, widest, seen)
                if found is None:
                    continue
                centre, thickness, deep = found
                placement = pin.SE3(
                    _tool(section.axes, approach, up), section.to_joint_frame(centre)
                )
                ends = (
                    (low - at, high - at)
                    if (placement.rotation[:, 1] @ piece.axes[axis]) > 0.0
                    else (at - high, at - low)
                )
                kind = "edge" if deep else "bar" if high - low > DEEP else "knob"
                turned = 0.0 if deep else _round(section, approach, thickness, widest)
                yield Candidate(piece, kind, placement, thickness, ends, turned)


def _grasp(
    section: Section, approach: Floats, hand: Hand, widest: float, seen: Thickness
) -> tuple[Floats, float, bool] | None:
    """Return where in a section the hand's origin is, how thick that is, and whether it is an edge; None if it does not fit."""
    closing = np.array([-approach[1], approach[0]])
    near, far = section.extent(approach)
    deep = far - near > DEEP
    between = section.clip(approach, near + _DEPTH + hand.tip) if deep else section
    if between is None or not between.is_graspable(closing):
        return None
    low, high = between.extent(closing)
    seen.tried += 1
    if high - low > widest:
        seen.too_thick, seen.thinnest = seen.too_thick + 1, min(seen.thinnest, high - low)
        return None
    depth = near + _DEPTH if deep else (near + far) / 2.0
    return depth * approach + (low + high) / 2.0 * closing, high - low, deep


def _tool(axes: Floats, approach: Floats, up: Floats) -> Floats:
    """Return the tool's axes as columns, shape (3, 3), for a direction of approach in the plane of two axes.

    Of the two ways to hold a hand, half a turn apart, it is the one with the closing, or else the
    bar, pointing upwards.
    """
    z, x = approach @ axes, np.array([-approach[1], approach[0]]) @ axes
    y = np.cross(z, x)
    way = x @ up if abs(x @ up) > _LEVEL else y @ up
    return np.column_stack([x, y, z] if way >= 0.0 else [-x, -y, z])


def _round(section: Section, approach: Floats, thickness: float, widest: float) -> float:
    """Return how far a hand may turn about a bar to both sides [rad] for its thickness to stay about what it is."""
    turned = 0.0
    for angle in _ANGLES:
        for way in (angle, -angle):
            a = np.array([[np.cos(way), -np.sin(way)], [np.sin(way), np.cos(way)]]) @ approach
            low, high = section.extent(np.array([-a[1], a[0]]))
            if high - low > min(widest, _ROUND * thickness) or _ROUND * (high - low) < thickness:
                return turned
        turned = float(angle)
    return turned
