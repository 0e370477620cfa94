"""Handles of furniture, and the attachments that a hand takes them by.

A finger reaches some 0.02 beyond the tool's origin: what stands 0.05 and more before its face is
taken with air behind it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vkc_pin.procedural.furniture.building import LinkBuilder, ObjectBuilder, Point

__all__ = ["add_knob", "add_level_bar", "add_upright_bar"]

_POST = 0.02  # [m] from a bar's ends to the posts that carry it
_THUMB = 0.03  # [m] from a post to the middle of the hand
_TILT = 0.6  # [rad] to which a hand may tilt about a bar
_SWING = 0.8  # [rad] to which it may swing about an upright bar, or in any direction about a knob
# [m] height from which on a hand comes level; to lower handles it comes obliquely from above
_LEVEL = 0.55
_STEEPEST = 0.65  # [rad] to which it does so


def add_upright_bar(
    builder: ObjectBuilder,
    link: LinkBuilder,
    at: Point,
    length: float,
    out: float,
    name: str = "handle",
) -> None:
    """Add an upright bar before a face that looks along -x, and its attachments `name` and `<name>_free`.

    Args:
        builder: What is being built.
        link: That the bar belongs to.
        at: Where on the face its middle is, in the link's frame [m].
        length: Of the bar, at least 0.1 [m].
        out: From the face to the bar's centre line [m].
        name: Of the attachment.
    """
    middle, reach = _bar(link, at, length, out, "z")
    where: tuple[LinkBuilder, Point, Point, Point] = (link, middle, (1, 0, 0), (0, 1, 0))
    builder.add_attachment(name, *where)
    limits, turn = _interval(reach), _interval(_SWING)
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
    """Add a level bar before a face that looks along -x, and its attachments `name` and `<name>_free`.

    Args:
        builder: What is being built.
        link: That the bar belongs to.
        at: Where on the face its middle is, in the link's frame [m].
        length: Of the bar, at least 0.1 [m].
        out: From the face to the bar's centre line [m].
        height: Of the bar above the floor [m].
        name: Of the attachment.
        turn: How far a hand may turn about the bar [rad]; None: as far as it may tilt.
    """
    middle, reach = _bar(link, at, length, out, "y")
    down = _STEEPEST * float(np.clip((_LEVEL - height) / 0.25, 0.0, 1.0))
    approach, closing = (
        (math.cos(down), 0.0, -math.sin(down)),
        (math.sin(down), 0.0, math.cos(down)),
    )
    where: tuple[LinkBuilder, Point, Point, Point] = (link, middle, approach, closing)
    builder.add_attachment(name, *where)
    limits = list(turn) if turn is not None else _interval(_TILT)
    builder.add_attachment(
        f"{name}_free",
        *where,
        joint="cylindrical",
        axis=[0, 1, 0],
        limits=_interval(reach),
        turn=limits,
    )


def add_knob(
    builder: ObjectBuilder, link: LinkBuilder, at: Point, out: float, name: str = "handle"
) -> None:
    """Add a round knob before a face that looks along -x, and its attachments `name` and `<name>_free`.

    Args:
        builder: What is being built.
        link: That the knob belongs to.
        at: Where on the face it is, in the link's frame [m].
        out: From the face to the knob's centre [m].
        name: Of the attachment.
    """
    x, y, z = at
    link.add_sphere((x - out, y, z), 0.016, "steel")
    link.add_cylinder((x - out / 2.0, y, z), 0.007, out, "x", "steel")
    where: tuple[LinkBuilder, Point, Point, Point] = (link, (x - out, y, z), (1, 0, 0), (0, 1, 0))
    builder.add_attachment(name, *where)
    builder.add_attachment(f"{name}_free", *where, joint="spherical", limits=_interval(_SWING))


def _bar(link: LinkBuilder, at: Point, length: float, out: float, axis: str) -> tuple[Point, float]:
    """Add a bar along an axis on two posts; return its middle, and how far a hand may slide from there to either side [m]."""
    x, y, z = at
    middle, end = (x - out, y, z), length / 2.0 - _POST
    link.add_cylinder(middle, 0.01, length, axis, "steel")
    for shift in (-end, end):
        post = (x - out / 2.0, y, z + shift) if axis == "z" else (x - out / 2.0, y + shift, z)
        link.add_cylinder(post, 0.006, out, "x", "steel")
    return middle, max(end - _THUMB, 0.0)


def _interval(reach: float) -> list[float]:
    return [-round(reach, 4), round(reach, 4)]
