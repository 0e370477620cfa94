"""Generates objects with drawers or with doors on horizontal hinges."""

from __future__ import annotations

from vkc_pin.procedural.furniture.building import LinkBuilder, ObjectBuilder
from vkc_pin.procedural.furniture.draws import Sampler
from vkc_pin.procedural.furniture.handles import add_knob, add_level_bar

__all__ = ["make_chest", "make_dishwasher", "make_drawers", "make_oven"]

_GAP = 0.006  # [m] between a door or drawer and its case
_FRONTS = ("white", "shade", "sage", "sand", "slate", "oak", "walnut")
# [rad] turns of a hand about a bar that moves down or up with its door while the hand stays level
_DOWN, _UP = (-1.7, 0.5), (-0.5, 1.7)


def make_drawers(sampler: Sampler) -> ObjectBuilder:
    """Return a chest of one to four drawers, one above the other."""
    count, width, depth = (
        sampler.sample_integer(1, 4),
        sampler.sample_length(0.4, 0.9),
        sampler.sample_length(0.42, 0.6),
    )
    foot, front = sampler.sample_length(0.06, 0.1), sampler.sample_length(0.17, 0.26)
    # One or two drawers are under the top of a taller case.
    low = foot if count > 2 else sampler.sample_length(0.35, 0.55)
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
    bars, length, out = (
        sampler.sample_bool(0.7),
        min(sampler.sample_length(0.14, 0.3), width - 0.12),
        sampler.sample_length(0.055, 0.075),
    )
    own, reach = sampler.choose(_FRONTS), round(sampler.sample_length(0.6, 0.8) * depth, 3)
    for k in range(count):
        name = "" if count == 1 else f"_{k + 1}"
        middle = height - 0.025 - (k + 0.5) * front
        tray = builder.add_joint(
            f"slide{name}", "prismatic", (0, 0, middle), (-1, 0, 0), reach, link=f"drawer{name}"
        )
        half, side = front / 2 - 0.003, width / 2 - 0.03
        tray.add_box(
            (-_GAP - 0.018, -width / 2 + 0.002, -half), (-_GAP, width / 2 - 0.002, half), own
        )
        bottom, top, back = -half + 0.02, half - 0.03, depth - 0.05
        tray.add_box((-_GAP, -side, bottom), (back, -side + 0.012, top), "oak")
        tray.add_box((-_GAP, side - 0.012, bottom), (back, side, top), "oak")
        tray.add_box((back - 0.012, -side + 0.012, bottom), (back, side - 0.012, top), "oak")
        tray.add_box(
            (-_GAP, -side + 0.012, bottom), (back - 0.012, side - 0.012, bottom + 0.008), "oak"
        )
        at = (-_GAP - 0.018, 0.0, 0.0)
        if bars or middle < 0.55:  # a knob is grasped horizontally
            add_level_bar(builder, tray, at, length, out, height=middle, name=f"handle{name}")
        else:
            add_knob(builder, tray, at, out, f"handle{name}")
    return builder


def make_dishwasher(sampler: Sampler) -> ObjectBuilder:
    """Return a dishwasher, 0.45 or 0.6 m wide, whose door opens downwards."""
    width, height, depth = (
        sampler.choose((0.448, 0.598)),
        sampler.sample_length(0.82, 0.88),
        sampler.sample_length(0.52, 0.58),
    )
    builder = ObjectBuilder("dishwasher", LinkBuilder("body"))
    colour, foot = (
        sampler.choose(("white", "steel", "dark", "slate")),
        sampler.sample_length(0.09, 0.12),
    )
    builder.base.add_case((0, -width / 2, foot), (depth, width / 2, height), 0.03, colour, "steel")
    builder.base.add_box(
        (0.05, -width / 2 + 0.02, 0), (depth - 0.02, width / 2 - 0.02, foot), "dark"
    )
    _add_flap(builder, width, (foot + 0.01, height), 0.03, colour, sampler)
    return builder


def make_oven(sampler: Sampler) -> ObjectBuilder:
    """Return an oven whose door opens downwards: under a hob, or in a tall cabinet."""
    width, depth, high = (
        sampler.sample_length(0.56, 0.62),
        sampler.sample_length(0.54, 0.6),
        sampler.sample_bool(0.5),
    )
    low = sampler.sample_length(0.6, 0.75) if high else sampler.sample_length(0.2, 0.28)
    top = round(low + sampler.sample_length(0.42, 0.48), 3)
    height = sampler.sample_length(1.9, 2.1) if high else round(top + 0.14, 3)
    builder = ObjectBuilder("oven", LinkBuilder("body"))
    colour, case = (
        sampler.choose(("steel", "dark")),
        sampler.choose(("white", "shade", "oak")) if high else "steel",
    )
    builder.base.add_case(
        (0, -width / 2, low - 0.02), (depth, width / 2, top + 0.02), 0.03, case, "dark"
    )
    builder.base.add_box((0.0, -width / 2, 0.0), (depth, width / 2, low - 0.02), case)
    builder.base.add_box((0.0, -width / 2, top + 0.02), (depth, width / 2, height), case)
    _add_flap(builder, width, (low, top), 0.035, colour, sampler)
    return builder


def make_chest(sampler: Sampler) -> ObjectBuilder:
    """Return a chest on the floor with a lid."""
    width, depth, height = (
        sampler.sample_length(0.6, 1.1),
        sampler.sample_length(0.42, 0.58),
        sampler.sample_length(0.45, 0.7),
    )
    builder = ObjectBuilder("chest", LinkBuilder("body"))
    colour, wall, thick = sampler.choose(_FRONTS), 0.025, 0.035
    for low, high in (
        ((0, -width / 2, 0), (wall, width / 2, height)),
        ((depth - wall, -width / 2, 0), (depth, width / 2, height)),
        ((wall, -width / 2, 0), (depth - wall, -width / 2 + wall, height)),
        ((wall, width / 2 - wall, 0), (depth - wall, width / 2, height)),
        ((wall, -width / 2 + wall, 0), (depth - wall, width / 2 - wall, wall)),
    ):
        builder.base.add_box(low, high, colour)
    # The open lid does not reach beyond the chest's back.
    hinge = (depth - 0.06, 0.0, height + _GAP + thick)
    lid = builder.add_joint(
        "lid", "revolute", hinge, (0, 1, 0), sampler.sample_length(1.2, 1.4), link="lid"
    )
    lid.add_box(
        (-hinge[0] - 0.02, -width / 2 - 0.005, -thick),
        (0.0, width / 2 + 0.005, 0.0),
        sampler.choose(_FRONTS),
    )
    builder.base.add_box(
        (depth - 0.055, -width / 2, height), (depth, width / 2, height + _GAP + thick), colour
    )
    length = sampler.sample_length(0.14, 0.3)
    at = (-hinge[0] - 0.02, 0.0, -thick / 2)
    add_level_bar(
        builder, lid, at, length, sampler.sample_length(0.055, 0.075), height=height, turn=_UP
    )
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
        "door", "revolute", origin, (0, -1, 0), sampler.sample_length(1.45, 1.55), link="door"
    )
    leaf.add_box((-thick / 2, -width / 2, 0.0), (thick / 2, width / 2, high - low), colour)
    at = (-thick / 2, 0.0, high - low - sampler.sample_length(0.05, 0.09))
    length = min(sampler.sample_length(0.3, 0.5), width - 0.08)
    add_level_bar(
        builder,
        leaf,
        at,
        length,
        sampler.sample_length(0.055, 0.07),
        height=low + at[2],
        turn=_DOWN,
    )
