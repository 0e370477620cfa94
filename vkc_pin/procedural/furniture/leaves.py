"""Generates objects with doors on vertical hinges: doors in walls, cabinets and appliances."""

from __future__ import annotations

import numpy as np

from vkc_pin.procedural.furniture.building import LinkBuilder, ObjectBuilder
from vkc_pin.procedural.furniture.draws import Sampler
from vkc_pin.procedural.furniture.handles import add_knob, add_upright_bar

__all__ = ["make_cabinet", "make_door", "make_microwave", "make_refrigerator"]

_GAP = 0.006  # [m] between a door and its case
_POST = 0.05  # [m] width of a door's posts
_AIR = 0.025  # [m] between a door's panel and its frame: more than a plan's clearance
_FRONTS = ("white", "shade", "sage", "sand", "slate", "oak", "walnut")


def make_door(sampler: Sampler) -> ObjectBuilder:
    """Return a door in its frame, which is pushed or pulled open.

    It has levers and a latch, or a bar. The base link's frame is on the hinge line, in the middle
    of a wall about 0.1 m thick. Dimensions are those of DIN 18101, with door widths from 0.735 to
    0.985 m.
    """
    width, height, thick = (
        sampler.sample_length(0.735, 0.985),
        sampler.sample_length(1.95, 2.05),
        0.04,
    )
    to = sampler.choose((-1.0, 1.0))  # direction from the hinge to the lock, along y
    away = sampler.choose((-1.0, 1.0))  # 1: pushed open; -1: pulled
    builder = ObjectBuilder("door", LinkBuilder("frame"))
    top = 0.01 + height + _AIR
    for low, high in ((-_AIR - 0.02 - _POST, -_AIR - 0.02), (width + _AIR, width + _AIR + _POST)):
        ends = sorted((to * low, to * high))
        builder.base.add_box((-0.06, ends[0], 0.0), (0.06, ends[1], top + _POST), "white")
    inside = sorted((to * (-_AIR - 0.02), to * (width + _AIR)))
    builder.base.add_box((-0.06, inside[0], top), (0.06, inside[1], top + _POST), "white")
    axis = (0, 0, -to * away)
    panel = builder.add_joint(
        "hinge", "revolute", (0, 0, 0), axis, sampler.sample_length(1.4, 1.55), link="panel"
    )
    ends = sorted((0.0, to * width))
    panel.add_box(
        (-thick / 2, ends[0], 0.01),
        (thick / 2, ends[1], 0.01 + height),
        sampler.choose(("oak", "white", "walnut", "sand")),
    )
    grip = sampler.sample_length(0.95, 1.08)
    if sampler.sample_bool(0.3):
        length = sampler.sample_length(0.25, 0.5)
        add_upright_bar(builder, panel, (-thick / 2, to * (width - 0.1), grip), length, 0.075)
        return builder
    turn = sampler.sample_length(0.35, 0.55)
    spindle = (0.0, to * (width - 0.08), grip)
    lever = builder.add_joint(
        "knob", "revolute", spindle, (to, 0, 0), 0.8, link="lever", parent="panel", acceleration=4.0
    )
    out, length = thick / 2 + 0.085, sampler.sample_length(0.125, 0.145)
    lever.add_cylinder((0, 0, 0), 0.011, 2 * out, "x", "steel")
    for side in (-1, 1):
        lever.add_cylinder((side * out, -to * (length / 2 - 0.01), 0), 0.012, length, "y", "steel")
    # Far enough from the spindle for the wrist to pass the post.
    held = (-out, -to * 0.085, 0.0)
    builder.add_attachment("handle", lever, held, (1, 0, 0), (0, 0, 1))
    builder.add_attachment(
        "handle_free",
        lever,
        held,
        (1, 0, 0),
        (0, 0, 1),
        joint="revolute",
        axis=[0, 1, 0],
        limits=[-0.6, 0.6],
    )
    builder.latches.append(
        {
            "joint": "hinge",
            "held_at": 0.0,
            "released_by": "knob",
            "threshold": turn,
            "engaged_within": 0.05,
        }
    )
    return builder


def make_cabinet(sampler: Sampler) -> ObjectBuilder:
    """Return a cabinet or wardrobe with one or two doors, bars or knobs, and shelves."""
    has_two = sampler.sample_bool(0.4)
    width = sampler.sample_length(0.7, 1.1) if has_two else sampler.sample_length(0.4, 0.65)
    height, depth, foot = (
        sampler.sample_length(0.8, 1.9),
        sampler.sample_length(0.35, 0.6),
        sampler.sample_length(0.06, 0.12),
    )
    builder = ObjectBuilder("cabinet", LinkBuilder("case"))
    builder.base.add_case(
        (0, -width / 2, foot), (depth, width / 2, height), 0.02, sampler.choose(_FRONTS), "shade"
    )
    builder.base.add_box(
        (0.04, -width / 2 + 0.02, 0), (depth - 0.02, width / 2 - 0.02, foot), "dark"
    )
    for z in np.linspace(foot, height, 2 + int((height - foot) / 0.4))[1:-1]:
        builder.base.add_box(
            (0.03, -width / 2 + 0.02, z - 0.01), (depth - 0.02, width / 2 - 0.02, z + 0.01), "oak"
        )
    front, bars, length, out = (
        sampler.choose(_FRONTS),
        sampler.sample_bool(0.7),
        sampler.sample_length(0.14, 0.34),
        sampler.sample_length(0.055, 0.075),
    )
    grip = sampler.sample_length(0.85, 1.1)
    names = ("left", "right") if has_two else (sampler.choose(("left", "right")),)
    upper = sampler.sample_length(1.7, 1.9)
    for name in names:
        y = (
            (0.002, width / 2)
            if has_two and name == "left"
            else (-width / 2, -0.002)
            if has_two
            else (-width / 2, width / 2)
        )
        leaf = _add_leaf(
            builder,
            (y[0], y[1], foot, height),
            0.02,
            name,
            f"_{name}" if has_two else "",
            front,
            upper,
        )
        _add_handle(
            builder,
            leaf,
            (y[1] - y[0], foot, height),
            0.02,
            name,
            grip,
            (length if bars else 0.0, out),
            has_two,
        )
    return builder


def make_refrigerator(sampler: Sampler) -> ObjectBuilder:
    """Return a refrigerator with one door, a separate freezer, or two doors side by side."""
    kind = sampler.choose(("single", "stacked", "stacked", "side_by_side"))
    width = (
        sampler.sample_length(0.8, 0.92)
        if kind == "side_by_side"
        else sampler.sample_length(0.55, 0.7)
    )
    height, depth = sampler.sample_length(1.5, 1.95), sampler.sample_length(0.52, 0.64)
    builder = ObjectBuilder("refrigerator", LinkBuilder("body"))
    colour = sampler.choose(("white", "steel", "slate", "sand"))
    builder.base.add_case((0, -width / 2, 0.05), (depth, width / 2, height), 0.04, colour, "white")
    builder.base.add_box(
        (0.04, -width / 2 + 0.03, 0), (depth - 0.04, width / 2 - 0.03, 0.05), "dark"
    )
    length, out, grip, upper = (
        sampler.sample_length(0.3, 0.55),
        sampler.sample_length(0.06, 0.075),
        sampler.sample_length(0.95, 1.1),
        sampler.sample_length(1.7, 2.0),
    )
    side = sampler.choose(("left", "right"))
    split = (
        sampler.sample_length(0.62, 0.8)
        if sampler.sample_bool(0.5)
        else sampler.sample_length(1.1, 1.2)
    )
    if kind == "stacked":
        builder.base.add_box(
            (0, -width / 2 + 0.04, split - 0.02),
            (depth - 0.04, width / 2 - 0.04, split + 0.02),
            "white",
        )
    for z in np.arange(split + 0.3, height - 0.2, 0.3):
        builder.base.add_box(
            (0.12, -width / 2 + 0.04, z - 0.006),
            (depth - 0.04, width / 2 - 0.04, z + 0.006),
            "glass",
        )
    low, high = 0.06, height
    parts = {
        "single": [("", side, (-width / 2, width / 2, low, high))],
        "stacked": [
            ("_upper", side, (-width / 2, width / 2, split + 0.004, high)),
            ("_lower", side, (-width / 2, width / 2, low, split - 0.004)),
        ],
        "side_by_side": [
            ("_left", "left", (0.003, width / 2, low, high)),
            ("_right", "right", (-width / 2, -0.003, low, high)),
        ],
    }[kind]
    for suffix, hinge, (y0, y1, z0, z1) in parts:
        leaf = _add_leaf(builder, (y0, y1, z0, z1), 0.05, hinge, suffix, colour, upper)
        own = min(length, round(0.5 * (z1 - z0), 3))
        _add_handle(
            builder,
            leaf,
            (y1 - y0, z0, z1),
            0.05,
            hinge,
            grip,
            (own, out),
            bool(suffix),
            suffix.strip("_"),
        )
    return builder


def make_microwave(sampler: Sampler) -> ObjectBuilder:
    """Return a microwave oven for a counter.

    Its door opens to the left, its panel is on the right.
    """
    width, height, depth = (
        sampler.sample_length(0.45, 0.56),
        sampler.sample_length(0.27, 0.34),
        sampler.sample_length(0.33, 0.42),
    )
    panel = sampler.sample_length(0.1, 0.13)
    builder = ObjectBuilder("microwave", LinkBuilder("body"))
    colour = sampler.choose(("white", "steel", "dark"))
    edge = -width / 2 + panel
    builder.base.add_case((0, edge, 0.02), (depth, width / 2, height), 0.02, colour, "shade")
    builder.base.add_box((-0.03, -width / 2, 0.02), (depth, edge, height), colour)
    for y in (-width / 2 + 0.04, width / 2 - 0.04):
        builder.base.add_box((0.03, y - 0.02, 0), (depth - 0.03, y + 0.02, 0.02), "dark")  # feet
    leaf = _add_leaf(
        builder,
        (edge + 0.003, width / 2, 0.03, height - 0.005),
        0.03,
        "left",
        "",
        "glass",
        sampler.sample_length(1.6, 1.9),
    )
    length = round(min(sampler.sample_length(0.14, 0.2), height - 0.12), 3)
    _add_handle(
        builder,
        leaf,
        (width / 2 - edge, 0.03, height),
        0.03,
        "left",
        height / 2,
        (length, sampler.sample_length(0.055, 0.065)),
        False,
    )
    return builder


def _add_leaf(
    builder: ObjectBuilder,
    extent: tuple[float, float, float, float],
    thick: float,
    side: str,
    suffix: str,
    colour: str,
    upper: float,
) -> LinkBuilder:
    """Add a door in front of a case, hinged on the left or right as seen by the user.

    The door's frame is on the hinge line, at half the door's height.

    Args:
        builder: Object under construction.
        extent: Lowest and highest y, lowest and highest z [m].
        thick: Thickness [m].
        side: Side of the hinge: "left" or "right".
        suffix: Suffix of the names of joint and link.
        colour: Colour.
        upper: Upper limit of the joint [rad].
    """
    y0, y1, z0, z1 = extent
    right = side == "right"
    origin, axis = (
        (-_GAP - thick / 2, y0 if right else y1, (z0 + z1) / 2),
        (0, 0, 1 if right else -1),
    )
    link = builder.add_joint(
        f"hinge{suffix}", "revolute", origin, axis, upper, link=f"door{suffix}"
    )
    ends = sorted((0.0, (y1 - y0) * (1 if right else -1)))
    half = (z1 - z0) / 2
    link.add_box((-thick / 2, ends[0], -half), (thick / 2, ends[1], half), colour)
    return link


def _add_handle(
    builder: ObjectBuilder,
    leaf: LinkBuilder,
    extent: tuple[float, float, float],
    thick: float,
    side: str,
    height: float,
    bar: tuple[float, float],
    named: bool,
    name: str | None = None,
) -> None:
    """Add a bar, or a knob for a bar of length 0, to a door.

    Args:
        builder: Object under construction.
        leaf: Door.
        extent: Width of the door, and its lowest and highest z [m].
        thick: Thickness of the door [m].
        side: Side of the hinge: "left" or "right".
        height: Desired height of the handle [m].
        bar: Length of the bar and distance to the face [m].
        named: Whether the attachment's name has the suffix `name` or, by default, `side`.
        name: Suffix.
    """
    width, z0, z1 = extent
    length, out = bar
    margin = length / 2 + 0.04
    z = float(np.clip(height, z0 + margin, z1 - margin)) - (z0 + z1) / 2
    at = (-thick / 2, (width - 0.05) * (1 if side == "right" else -1), z)
    own = f"handle_{name or side}" if named else "handle"
    if length:
        add_upright_bar(builder, leaf, at, length, out, own)
    else:
        add_knob(builder, leaf, at, out, own)
