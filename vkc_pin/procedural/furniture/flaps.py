"""What has drawers, or leaves on level hinges: chests of drawers, dishwashers, ovens, chests with a lid."""

from __future__ import annotations

from vkc_pin.procedural.furniture.building import Article, Link
from vkc_pin.procedural.furniture.draws import Draws
from vkc_pin.procedural.furniture.handles import knob, level_bar

__all__ = ["chest", "dishwasher", "drawers", "oven"]

_GAP = 0.006  # [m] of air between a leaf and its case
_FRONTS = ("white", "shade", "sage", "sand", "slate", "oak", "walnut")
_DOWN, _UP = (
    (-1.7, 0.5),
    (-0.5, 1.7),
)  # [rad] a hand turns about a bar that goes down or up with its leaf, and stays level


def drawers(draws: Draws) -> Article:
    """Return a chest of one to four drawers above each other."""
    count, width, depth = draws.whole(1, 4), draws.size(0.4, 0.9), draws.size(0.42, 0.6)
    foot, front = draws.size(0.06, 0.1), draws.size(0.17, 0.26)
    low = (
        foot if count > 2 else draws.size(0.35, 0.55)
    )  # a single drawer is under the top of a higher case
    height = round(low + count * front + 0.025, 3)
    made = Article("drawers", Link("case"))
    colour = draws.one_of(_FRONTS)
    made.base.case((0, -width / 2, foot), (depth, width / 2, height), 0.02, colour, "shade")
    made.base.box((0.04, -width / 2 + 0.02, 0), (depth - 0.02, width / 2 - 0.02, foot), "dark")
    if low > foot:
        made.base.box(
            (0, -width / 2 + 0.02, foot + 0.02), (depth - 0.02, width / 2 - 0.02, low), colour
        )
    bars, length, out = (
        draws.chance(0.7),
        min(draws.size(0.14, 0.3), width - 0.12),
        draws.size(0.055, 0.075),
    )
    own, reach = draws.one_of(_FRONTS), round(draws.size(0.6, 0.8) * depth, 3)
    for k in range(count):
        name = "" if count == 1 else f"_{k + 1}"
        middle = height - 0.025 - (k + 0.5) * front
        tray = made.joint(
            f"slide{name}", "prismatic", (0, 0, middle), (-1, 0, 0), reach, link=f"drawer{name}"
        )
        half, side = front / 2 - 0.003, width / 2 - 0.03
        tray.box((-_GAP - 0.018, -width / 2 + 0.002, -half), (-_GAP, width / 2 - 0.002, half), own)
        bottom, top, back = -half + 0.02, half - 0.03, depth - 0.05
        tray.box((-_GAP, -side, bottom), (back, -side + 0.012, top), "oak")
        tray.box((-_GAP, side - 0.012, bottom), (back, side, top), "oak")
        tray.box((back - 0.012, -side + 0.012, bottom), (back, side - 0.012, top), "oak")
        tray.box(
            (-_GAP, -side + 0.012, bottom), (back - 0.012, side - 0.012, bottom + 0.008), "oak"
        )
        at = (-_GAP - 0.018, 0.0, 0.0)
        if bars or middle < 0.55:  # a knob is taken level
            level_bar(made, tray, at, length, out, height=middle, name=f"handle{name}")
        else:
            knob(made, tray, at, out, f"handle{name}")
    return made


def dishwasher(draws: Draws) -> Article:
    """Return a dishwasher, 0.45 or 0.6 wide, whose leaf opens downwards."""
    width, height, depth = (
        draws.one_of((0.448, 0.598)),
        draws.size(0.82, 0.88),
        draws.size(0.52, 0.58),
    )
    made = Article("dishwasher", Link("body"))
    colour, foot = draws.one_of(("white", "steel", "dark", "slate")), draws.size(0.09, 0.12)
    made.base.case((0, -width / 2, foot), (depth, width / 2, height), 0.03, colour, "steel")
    made.base.box((0.05, -width / 2 + 0.02, 0), (depth - 0.02, width / 2 - 0.02, foot), "dark")
    _flap(made, width, (foot + 0.01, height), 0.03, colour, draws)
    return made


def oven(draws: Draws) -> Article:
    """Return an oven whose leaf opens downwards: under a hob, or in a high case."""
    width, depth, high = draws.size(0.56, 0.62), draws.size(0.54, 0.6), draws.chance(0.5)
    low = draws.size(0.6, 0.75) if high else draws.size(0.2, 0.28)
    top = round(low + draws.size(0.42, 0.48), 3)
    height = draws.size(1.9, 2.1) if high else round(top + 0.14, 3)
    made = Article("oven", Link("body"))
    colour, case = (
        draws.one_of(("steel", "dark")),
        draws.one_of(("white", "shade", "oak")) if high else "steel",
    )
    made.base.case((0, -width / 2, low - 0.02), (depth, width / 2, top + 0.02), 0.03, case, "dark")
    made.base.box((0.0, -width / 2, 0.0), (depth, width / 2, low - 0.02), case)
    made.base.box((0.0, -width / 2, top + 0.02), (depth, width / 2, height), case)
    _flap(made, width, (low, top), 0.035, colour, draws)
    return made


def chest(draws: Draws) -> Article:
    """Return a chest on the floor with a lid."""
    width, depth, height = draws.size(0.6, 1.1), draws.size(0.42, 0.58), draws.size(0.45, 0.7)
    made = Article("chest", Link("body"))
    colour, wall, thick = draws.one_of(_FRONTS), 0.025, 0.035
    for low, high in (
        ((0, -width / 2, 0), (wall, width / 2, height)),
        ((depth - wall, -width / 2, 0), (depth, width / 2, height)),
        ((wall, -width / 2, 0), (depth - wall, -width / 2 + wall, height)),
        ((wall, width / 2 - wall, 0), (depth - wall, width / 2, height)),
        ((wall, -width / 2 + wall, 0), (depth - wall, width / 2 - wall, wall)),
    ):
        made.base.box(low, high, colour)
    hinge = (
        depth - 0.06,
        0.0,
        height + _GAP + thick,
    )  # so that the lid, open, stays before the chest's back
    lid = made.joint("lid", "revolute", hinge, (0, 1, 0), draws.size(1.2, 1.4), link="lid")
    lid.box(
        (-hinge[0] - 0.02, -width / 2 - 0.005, -thick),
        (0.0, width / 2 + 0.005, 0.0),
        draws.one_of(_FRONTS),
    )
    made.base.box(
        (depth - 0.055, -width / 2, height), (depth, width / 2, height + _GAP + thick), colour
    )
    length = draws.size(0.14, 0.3)
    at = (-hinge[0] - 0.02, 0.0, -thick / 2)
    level_bar(made, lid, at, length, draws.size(0.055, 0.075), height=height, turn=_UP)
    return made


def _flap(
    made: Article, width: float, z: tuple[float, float], thick: float, colour: str, draws: Draws
) -> None:
    """Add a leaf that opens downwards, with a bar near its upper edge."""
    low, high = z
    origin = (-_GAP - thick / 2, 0.0, low)
    leaf = made.joint("door", "revolute", origin, (0, -1, 0), draws.size(1.45, 1.55), link="door")
    leaf.box((-thick / 2, -width / 2, 0.0), (thick / 2, width / 2, high - low), colour)
    at = (-thick / 2, 0.0, high - low - draws.size(0.05, 0.09))
    length = min(draws.size(0.3, 0.5), width - 0.08)
    level_bar(made, leaf, at, length, draws.size(0.055, 0.07), height=low + at[2], turn=_DOWN)
