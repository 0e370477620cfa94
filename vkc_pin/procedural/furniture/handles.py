"""Builds handles of furniture, and the attachments for grasping them.

A finger reaches some 0.02 m beyond the tool's origin: a handle 0.05 m or more in front of its face
leaves room behind it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vkc_pin.procedural.furniture.building import LinkBuilder, ObjectBuilder, Point

__all__ = ["add_knob", "add_level_bar", "add_upright_bar"]

_POST = 0.02  # [m] from a bar's ends to the posts that carry it
_HALF_HAND = 0.03  # [m] from a post to the middle of the hand
_TILT = 0.6  # [rad] largest tilt of a hand about a bar
_SWING = 0.8  # [rad] largest rotation about an upright bar, or in any direction about a knob
# [m] height above which a hand approaches horizontally; lower handles obliquely from above
_LEVEL = 0.55
_STEEPEST = 0.65  # [rad] largest slope of such an approach


def add_upright_bar(
    builder: ObjectBuilder,
    link: LinkBuilder,
    at: Point,
    length: float,
    out: float,
    name: str = "handle",
) -> None:
    """Add a vertical bar in front of a face, with attachments `name` and `<name>_free`.

    The face looks along -x.
    """
    middle, reach = _add_posts_and_bar(link, at, length, out, "z")
    where: tuple[LinkBuilder, Point, Point, Point] = (link, middle, (1, 0, 0), (0, 1, 0))
    builder.add_attachment(name, *where)
    limits, turn = _make_interval(reach), _make_interval(_SWING)
    builder.add_attachment(
        f"{name}_free", *where, joint="cylindrical", axis=[0, 1, 0], limits=limits, turn=turn
    )


def add_level_bar(
    builder: ObjectBuilder,
    link: LinkBuilder,
    at: Point,
    length: float,
    out: float,
    *,
    height: float,
    name: str = "handle",
    turn: Sequence[float] | None = None,
) -> None:
    """Add a horizontal bar in front of a face, with attachments `name` and `<name>_free`.

    The face looks along -x.

    Args:
        builder: Object under construction.
        link: Link of the bar.
        at: Middle of the bar on the face, in the link's frame [m].
        length: Length of the bar, at least 0.1 [m].
        out: Distance from the face to the bar's centre line [m].
        height: Height of the bar above the floor [m].
        name: Name of the attachment.
        turn: Range of the hand's rotation about the bar [rad]. Default: its tilt.
    """
    middle, reach = _add_posts_and_bar(link, at, length, out, "y")
    down = _STEEPEST * float(np.clip((_LEVEL - height) / 0.25, 0.0, 1.0))
    c, s = math.cos(down), math.sin(down)
    approach, closing = (c, 0.0, -s), (s, 0.0, c)
    where: tuple[LinkBuilder, Point, Point, Point] = (link, middle, approach, closing)
    builder.add_attachment(name, *where)
    limits = list(turn) if turn is not None else _make_interval(_TILT)
    builder.add_attachment(
        f"{name}_free",
        *where,
        joint="cylindrical",
        axis=[0, 1, 0],
        limits=_make_interval(reach),
        turn=limits,
    )


def add_knob(
    builder: ObjectBuilder, link: LinkBuilder, at: Point, out: float, name: str = "handle"
) -> None:
    """Add a round knob in front of a face, with attachments `name` and `<name>_free`.

    The face looks along -x.
    """
    x, y, z = at
    link.add_sphere((x - out, y, z), 0.016, "steel")
    link.add_cylinder((x - out / 2.0, y, z), 0.007, out, "x", "steel")
    where: tuple[LinkBuilder, Point, Point, Point] = (link, (x - out, y, z), (1, 0, 0), (0, 1, 0))
    builder.add_attachment(name, *where)
    builder.add_attachment(f"{name}_free", *where, joint="spherical", limits=_make_interval(_SWING))


def _add_posts_and_bar(
    link: LinkBuilder, at: Point, length: float, out: float, axis: str
) -> tuple[Point, float]:
    """Add a bar along an axis on two posts."""
    x, y, z = at
    middle, end = (x - out, y, z), length / 2.0 - _POST
    link.add_cylinder(middle, 0.01, length, axis, "steel")
    for shift in (-end, end):
        post = (x - out / 2.0, y, z + shift) if axis == "z" else (x - out / 2.0, y + shift, z)
        link.add_cylinder(post, 0.006, out, "x", "steel")
    return middle, max(end - _HALF_HAND, 0.0)


def _make_interval(reach: float) -> list[float]:
    return [-round(reach, 4), round(reach, 4)]
