"""Generates furniture and appliances of random sizes."""

from __future__ import annotations

import math

import numpy as np

from vkc_pin.procedural.furniture.building import (
    LinkBuilder,
    ObjectBuilder,
    Sampler,
    add_knob,
    add_level_bar,
    add_upright_bar,
)

# [m] between a door or drawer and its case
_GAP = 0.006
# [m] width of a door's posts
_POST = 0.05
# [m] between a door's panel and its frame: more than a plan's clearance
_AIR = 0.025
_FRONTS = ("white", "shade", "sage", "sand", "slate", "oak", "walnut")
# [rad] turns of a hand about a bar that moves down or up with its door while the hand stays level
_DOWN = (-1.7, 0.5)
_UP = (-0.5, 1.7)
# rods that form a hand wheel's rim
_SIDES = 8
# [m] height of a drawer below which a knob, which is grasped horizontally, would be too low
_MIN_KNOB = 0.55


def make_door(sampler: Sampler) -> ObjectBuilder:
    """Return a door in its frame, which is pushed or pulled open.

    It has levers and a latch, or a bar. The base link's frame is on the hinge line, in the middle
    of a wall about 0.1 m thick. Dimensions are those of DIN 18101, with door widths from 0.735 to
    0.985 m.
    """
    width = sampler.draw(0.735, 0.985)
    height = sampler.draw(1.95, 2.05)
    thick = 0.04
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
        "hinge", "revolute", (0, 0, 0), axis, sampler.draw(1.4, 1.55), link="panel"
    )
    ends = sorted((0.0, to * width))
    panel.add_box(
        (-thick / 2, ends[0], 0.01),
        (thick / 2, ends[1], 0.01 + height),
        sampler.choose(("oak", "white", "walnut", "sand")),
    )
    grip = sampler.draw(0.95, 1.08)
    if sampler.flip(0.3):
        length = sampler.draw(0.25, 0.5)
        add_upright_bar(builder, panel, (-thick / 2, to * (width - 0.1), grip), length, 0.075)
        return builder
    turn = sampler.draw(0.35, 0.55)
    spindle = (0.0, to * (width - 0.08), grip)
    lever = builder.add_joint(
        "knob", "revolute", spindle, (to, 0, 0), 0.8, link="lever", parent="panel", acceleration=4.0
    )
    out = thick / 2 + 0.085
    length = sampler.draw(0.125, 0.145)
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
    has_two = sampler.flip(0.4)
    width = sampler.draw(0.7, 1.1) if has_two else sampler.draw(0.4, 0.65)
    height = sampler.draw(0.8, 1.9)
    depth = sampler.draw(0.35, 0.6)
    foot = sampler.draw(0.06, 0.12)
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
    front = sampler.choose(_FRONTS)
    bars = sampler.flip(0.7)
    length = sampler.draw(0.14, 0.34)
    out = sampler.draw(0.055, 0.075)
    grip = sampler.draw(0.85, 1.1)
    names = ("left", "right") if has_two else (sampler.choose(("left", "right")),)
    upper = sampler.draw(1.7, 1.9)
    for name in names:
        y0 = -width / 2
        y1 = width / 2
        suffix = ""
        if has_two:
            suffix = f"_{name}"
            if name == "left":
                y0 = 0.002
            else:
                y1 = -0.002
        leaf = _add_leaf(builder, (y0, y1, foot, height), 0.02, name, suffix, front, upper)
        bar = (length if bars else 0.0, out)
        _add_handle(builder, leaf, (y1 - y0, foot, height), 0.02, name, grip, bar, has_two)
    return builder


def make_refrigerator(sampler: Sampler) -> ObjectBuilder:
    """Return a refrigerator with one door, a separate freezer, or two doors side by side."""
    kind = sampler.choose(("single", "stacked", "stacked", "side_by_side"))
    width = sampler.draw(0.8, 0.92) if kind == "side_by_side" else sampler.draw(0.55, 0.7)
    height = sampler.draw(1.5, 1.95)
    depth = sampler.draw(0.52, 0.64)
    builder = ObjectBuilder("refrigerator", LinkBuilder("body"))
    colour = sampler.choose(("white", "steel", "slate", "sand"))
    builder.base.add_case((0, -width / 2, 0.05), (depth, width / 2, height), 0.04, colour, "white")
    builder.base.add_box(
        (0.04, -width / 2 + 0.03, 0), (depth - 0.04, width / 2 - 0.03, 0.05), "dark"
    )
    length = sampler.draw(0.3, 0.55)
    out = sampler.draw(0.06, 0.075)
    grip = sampler.draw(0.95, 1.1)
    upper = sampler.draw(1.7, 2.0)
    side = sampler.choose(("left", "right"))
    split = sampler.draw(0.62, 0.8) if sampler.flip(0.5) else sampler.draw(1.1, 1.2)
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
    low = 0.06
    half = width / 2
    # Suffix of the names, side of the hinge, and extent along y and z of each door.
    if kind == "single":
        doors = [("", side, (-half, half, low, height))]
    elif kind == "stacked":
        doors = [
            ("_upper", side, (-half, half, split + 0.004, height)),
            ("_lower", side, (-half, half, low, split - 0.004)),
        ]
    else:
        doors = [
            ("_left", "left", (0.003, half, low, height)),
            ("_right", "right", (-half, -0.003, low, height)),
        ]
    for suffix, hinge, extent in doors:
        y0, y1, z0, z1 = extent
        leaf = _add_leaf(builder, extent, 0.05, hinge, suffix, colour, upper)
        bar = (min(length, round(0.5 * (z1 - z0), 3)), out)
        name = suffix.strip("_")
        _add_handle(builder, leaf, (y1 - y0, z0, z1), 0.05, hinge, grip, bar, bool(suffix), name)
    return builder


def make_microwave(sampler: Sampler) -> ObjectBuilder:
    """Return a microwave oven for a counter.

    Its door opens to the left, its panel is on the right.
    """
    width = sampler.draw(0.45, 0.56)
    height = sampler.draw(0.27, 0.34)
    depth = sampler.draw(0.33, 0.42)
    panel = sampler.draw(0.1, 0.13)
    builder = ObjectBuilder("microwave", LinkBuilder("body"))
    colour = sampler.choose(("white", "steel", "dark"))
    edge = -width / 2 + panel
    builder.base.add_case((0, edge, 0.02), (depth, width / 2, height), 0.02, colour, "shade")
    builder.base.add_box((-0.03, -width / 2, 0.02), (depth, edge, height), colour)
    for y in (-width / 2 + 0.04, width / 2 - 0.04):
        builder.base.add_box((0.03, y - 0.02, 0), (depth - 0.03, y + 0.02, 0.02), "dark")  # feet
    extent = (edge + 0.003, width / 2, 0.03, height - 0.005)
    upper = sampler.draw(1.6, 1.9)
    leaf = _add_leaf(builder, extent, 0.03, "left", "", "glass", upper)
    length = round(min(sampler.draw(0.14, 0.2), height - 0.12), 3)
    bar = (length, sampler.draw(0.055, 0.065))
    size = (width / 2 - edge, 0.03, height)
    _add_handle(builder, leaf, size, 0.03, "left", height / 2, bar, False)
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
    """
    y0, y1, z0, z1 = extent
    if side == "right":
        hinge_y = y0
        direction = 1  # from the hinge along y
    else:
        hinge_y = y1
        direction = -1
    origin = (-_GAP - thick / 2, hinge_y, (z0 + z1) / 2)
    axis = (0, 0, direction)
    link = builder.add_joint(
        f"hinge{suffix}", "revolute", origin, axis, upper, link=f"door{suffix}"
    )
    low, high = sorted((0.0, (y1 - y0) * direction))
    half = (z1 - z0) / 2
    link.add_box((-thick / 2, low, -half), (thick / 2, high, half), colour)
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
    """Add a bar, or a knob for a bar of length 0, to a door."""
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


def make_drawers(sampler: Sampler) -> ObjectBuilder:
    """Return a chest of one to four drawers, one above the other."""
    count = sampler.draw_integer(1, 4)
    width = sampler.draw(0.4, 0.9)
    depth = sampler.draw(0.42, 0.6)
    foot = sampler.draw(0.06, 0.1)
    front = sampler.draw(0.17, 0.26)
    # One or two drawers are under the top of a taller case.
    low = foot if count > 2 else sampler.draw(0.35, 0.55)
    height = round(low + count * front + 0.025, 3)
    builder = ObjectBuilder("drawers", LinkBuilder("case"))
    colour = sampler.choose(_FRONTS)
    builder.base.add_case((0, -width / 2, foot), (depth, width / 2, height), 0.02, colour, "shade")
    builder.base.add_box(
        (0.04, -width / 2 + 0.02, 0), (depth - 0.02, width / 2 - 0.02, foot), "dark"
    )
    if low > foot:
        builder.base.add_box(
            (0, -width / 2 + 0.02, foot + 0.02), (depth - 0.02, width / 2 - 0.02, low), colour
        )
    bars = sampler.flip(0.7)
    length = min(sampler.draw(0.14, 0.3), width - 0.12)
    out = sampler.draw(0.055, 0.075)
    front_colour = sampler.choose(_FRONTS)
    reach = round(sampler.draw(0.6, 0.8) * depth, 3)
    for k in range(count):
        name = "" if count == 1 else f"_{k + 1}"
        middle = height - 0.025 - (k + 0.5) * front
        tray = builder.add_joint(
            f"slide{name}", "prismatic", (0, 0, middle), (-1, 0, 0), reach, link=f"drawer{name}"
        )
        _add_tray(tray, (depth, width, front), front_colour)
        at = (-_GAP - 0.018, 0.0, 0.0)
        if bars or middle < _MIN_KNOB:
            add_level_bar(builder, tray, at, length, out, height=middle, name=f"handle{name}")
        else:
            add_knob(builder, tray, at, out, f"handle{name}")
    return builder


def _add_tray(tray: LinkBuilder, size: tuple[float, float, float], colour: str) -> None:
    """Add a drawer's front, two sides, back and bottom.

    Args:
        tray: Link of the drawer, whose frame is in the middle of its front.
        size: Depth and width of the case, and height of the front [m].
        colour: Colour of the front.
    """
    depth, width, front = size
    half = front / 2 - 0.003
    tray.add_box(
        (-_GAP - 0.018, -width / 2 + 0.002, -half), (-_GAP, width / 2 - 0.002, half), colour
    )
    side = width / 2 - 0.03
    inner = side - 0.012
    bottom = -half + 0.02
    top = half - 0.03
    back = depth - 0.05
    tray.add_box((-_GAP, -side, bottom), (back, -inner, top), "oak")
    tray.add_box((-_GAP, inner, bottom), (back, side, top), "oak")
    tray.add_box((back - 0.012, -inner, bottom), (back, inner, top), "oak")
    tray.add_box((-_GAP, -inner, bottom), (back - 0.012, inner, bottom + 0.008), "oak")


def make_dishwasher(sampler: Sampler) -> ObjectBuilder:
    """Return a dishwasher, 0.45 or 0.6 m wide, whose door opens downwards."""
    width = sampler.choose((0.448, 0.598))
    height = sampler.draw(0.82, 0.88)
    depth = sampler.draw(0.52, 0.58)
    builder = ObjectBuilder("dishwasher", LinkBuilder("body"))
    colour = sampler.choose(("white", "steel", "dark", "slate"))
    foot = sampler.draw(0.09, 0.12)
    builder.base.add_case((0, -width / 2, foot), (depth, width / 2, height), 0.03, colour, "steel")
    builder.base.add_box(
        (0.05, -width / 2 + 0.02, 0), (depth - 0.02, width / 2 - 0.02, foot), "dark"
    )
    _add_flap(builder, width, (foot + 0.01, height), 0.03, colour, sampler)
    return builder


def make_oven(sampler: Sampler) -> ObjectBuilder:
    """Return an oven whose door opens downwards: under a hob, or in a tall cabinet."""
    width = sampler.draw(0.56, 0.62)
    depth = sampler.draw(0.54, 0.6)
    high = sampler.flip(0.5)
    low = sampler.draw(0.6, 0.75) if high else sampler.draw(0.2, 0.28)
    top = round(low + sampler.draw(0.42, 0.48), 3)
    height = sampler.draw(1.9, 2.1) if high else round(top + 0.14, 3)
    builder = ObjectBuilder("oven", LinkBuilder("body"))
    colour = sampler.choose(("steel", "dark"))
    case = sampler.choose(("white", "shade", "oak")) if high else "steel"
    builder.base.add_case(
        (0, -width / 2, low - 0.02), (depth, width / 2, top + 0.02), 0.03, case, "dark"
    )
    builder.base.add_box((0.0, -width / 2, 0.0), (depth, width / 2, low - 0.02), case)
    builder.base.add_box((0.0, -width / 2, top + 0.02), (depth, width / 2, height), case)
    _add_flap(builder, width, (low, top), 0.035, colour, sampler)
    return builder


def make_chest(sampler: Sampler) -> ObjectBuilder:
    """Return a chest on the floor with a lid."""
    width = sampler.draw(0.6, 1.1)
    depth = sampler.draw(0.42, 0.58)
    height = sampler.draw(0.45, 0.7)
    builder = ObjectBuilder("chest", LinkBuilder("body"))
    colour = sampler.choose(_FRONTS)
    wall = 0.025
    thick = 0.035  # of the lid
    base = builder.base
    half = width / 2
    base.add_box((0, -half, 0), (wall, half, height), colour)
    base.add_box((depth - wall, -half, 0), (depth, half, height), colour)
    base.add_box((wall, -half, 0), (depth - wall, -half + wall, height), colour)
    base.add_box((wall, half - wall, 0), (depth - wall, half, height), colour)
    base.add_box((wall, -half + wall, 0), (depth - wall, half - wall, wall), colour)
    # The open lid does not reach beyond the chest's back.
    hinge = (depth - 0.06, 0.0, height + _GAP + thick)
    lid = builder.add_joint("lid", "revolute", hinge, (0, 1, 0), sampler.draw(1.2, 1.4), link="lid")
    lid.add_box(
        (-hinge[0] - 0.02, -width / 2 - 0.005, -thick),
        (0.0, width / 2 + 0.005, 0.0),
        sampler.choose(_FRONTS),
    )
    builder.base.add_box(
        (depth - 0.055, -width / 2, height), (depth, width / 2, height + _GAP + thick), colour
    )
    length = sampler.draw(0.14, 0.3)
    at = (-hinge[0] - 0.02, 0.0, -thick / 2)
    add_level_bar(builder, lid, at, length, sampler.draw(0.055, 0.075), height=height, turn=_UP)
    return builder


def _add_flap(
    builder: ObjectBuilder,
    width: float,
    z: tuple[float, float],
    thick: float,
    colour: str,
    sampler: Sampler,
) -> None:
    """Add a door that opens downwards, with a bar near its upper edge."""
    low, high = z
    origin = (-_GAP - thick / 2, 0.0, low)
    leaf = builder.add_joint(
        "door", "revolute", origin, (0, -1, 0), sampler.draw(1.45, 1.55), link="door"
    )
    leaf.add_box((-thick / 2, -width / 2, 0.0), (thick / 2, width / 2, high - low), colour)
    at = (-thick / 2, 0.0, high - low - sampler.draw(0.05, 0.09))
    length = min(sampler.draw(0.3, 0.5), width - 0.08)
    add_level_bar(
        builder,
        leaf,
        at,
        length,
        sampler.draw(0.055, 0.07),
        height=low + at[2],
        turn=_DOWN,
    )


def make_faucet(sampler: Sampler) -> ObjectBuilder:
    """Return a tap for a counter with one or two levers, which turn about vertical axes.

    One lever is above the spout; two are beside it.
    """
    builder = ObjectBuilder("faucet", LinkBuilder("spout"))
    height = sampler.draw(0.16, 0.24)
    reach = sampler.draw(0.14, 0.2)
    has_two = sampler.flip(0.4)
    builder.base.add_cylinder((0, 0, height / 2), 0.022, height, "z", "steel")
    # Suffix of the names, and y, of each lever; their height, their range, and the spout's height.
    levers: tuple[tuple[str, float], ...]
    if has_two:
        levers = (("_left", 0.14), ("_right", -0.14))
        low = sampler.draw(0.12, 0.16)
        lower = 0.0
        upper = 1.2
        spout = height - 0.015
    else:
        levers = (("", 0.0),)
        low = round(height + 0.03, 3)
        lower = -0.8
        upper = 0.8
        spout = height - 0.06
    builder.base.add_cylinder((-reach / 2, 0, spout), 0.012, reach, "x", "steel")
    length = sampler.draw(0.11, 0.16)
    if not has_two:  # the hand stays in front of the spout
        length += max(reach - 0.1, 0.0)
    for suffix, y in levers:
        if has_two:
            builder.base.add_cylinder((0, y, low / 2 - 0.01), 0.018, low - 0.02, "z", "steel")
        axis = (0, 0, -1 if y > 0.0 else 1)  # two levers turn away from the spout
        lever = builder.add_joint(
            f"turn{suffix}",
            "revolute",
            (0, y, low),
            axis,
            upper,
            lower=lower,
            link=f"lever{suffix}",
        )
        lever.add_cylinder((0, 0, -0.0125), 0.02, 0.015, "z", "steel")
        lever.add_cylinder((-length / 2, 0, 0), 0.008, length, "x", "steel")
        held = (-length + 0.015, 0.0, 0.0)
        builder.add_attachment(f"handle{suffix}", lever, held, (1, 0, 0), (0, 1, 0))
        free = {"joint": "revolute", "axis": [0, 1, 0], "limits": [-1.0, 1.0]}
        builder.add_attachment(f"handle{suffix}_free", lever, held, (1, 0, 0), (0, 1, 0), **free)
    return builder


def make_valve(sampler: Sampler) -> ObjectBuilder:
    """Return a valve on a pipe in front of a wall, with a hand wheel or a lever.

    Its axis is horizontal.
    """
    builder = ObjectBuilder("valve", LinkBuilder("pipe"))
    height = sampler.draw(0.7, 1.15)
    out = sampler.draw(0.1, 0.16)
    thick = sampler.draw(0.03, 0.05)
    back = out + thick
    builder.base.add_cylinder((back, 0, (height + 0.3) / 2), thick, height + 0.3, "z", "slate")
    spindle = back - thick - 0.017  # to the hub, which is 0.03 long
    builder.base.add_cylinder((back - spindle / 2, 0, height), 0.018, spindle, "x", "steel")
    turned = builder.add_joint(
        "turn", "revolute", (thick, 0, height), (1, 0, 0), 1.5, lower=-0.2, link="wheel"
    )
    turned.add_cylinder((0, 0, 0), 0.025, 0.03, "x", "dark")
    if sampler.flip(0.5):
        length = sampler.draw(0.16, 0.24)
        turned.add_box((-0.006, -0.011, 0.0), (0.006, 0.011, length), "sage")
        held = (0.0, 0.0, length - 0.03)
        closing = (0, 1, 0)
        bend: dict[str, object] = {"joint": "revolute", "axis": [1, 0, 0], "limits": [-0.5, 0.5]}
    else:
        radius = sampler.draw(0.11, 0.17)
        angles = [math.pi * (2 * k + 1) / _SIDES for k in range(_SIDES)]
        outer = radius / math.cos(math.pi / _SIDES)
        corners = [(0.0, outer * math.sin(angle), outer * math.cos(angle)) for angle in angles]
        for one, other in zip(corners, [*corners[1:], corners[0]], strict=True):
            turned.add_rod(one, other, 0.011, "sage")
        turned.add_box((-0.006, -0.01, -radius), (0.006, 0.01, radius), "slate")
        turned.add_box((-0.006, -radius, -0.01), (0.006, radius, 0.01), "slate")
        held = (0.0, radius * math.sin(math.pi / 4), radius * math.cos(math.pi / 4))
        closing = (0, 1, 1)
        bend = {"joint": "revolute", "axis": [0, 1, 0], "limits": [-0.5, 0.5]}
    builder.add_attachment("handle", turned, held, (1, 0, 0), closing)
    builder.add_attachment("handle_free", turned, held, (1, 0, 0), closing, **bend)
    return builder
