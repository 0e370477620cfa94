"""Generates objects that are turned: taps on a counter, and valves on a pipe in front of a wall."""

from __future__ import annotations

import math

from vkc_pin.procedural.furniture.building import LinkBuilder, ObjectBuilder
from vkc_pin.procedural.furniture.draws import Sampler

__all__ = ["make_faucet", "make_valve"]

_SIDES = 8  # rods that form a hand wheel's rim


def make_faucet(sampler: Sampler) -> ObjectBuilder:
    """Return a tap for a counter with one or two levers, which turn about vertical axes.

    One lever is above the spout; two are beside it.
    """
    builder = ObjectBuilder("faucet", LinkBuilder("spout"))
    height, reach, two = (
        sampler.sample_length(0.16, 0.24),
        sampler.sample_length(0.14, 0.2),
        sampler.sample_bool(0.4),
    )
    builder.base.add_cylinder((0, 0, height / 2), 0.022, height, "z", "steel")
    names = (("_left", 0.14), ("_right", -0.14)) if two else (("", 0.0),)
    low = sampler.sample_length(0.12, 0.16) if two else round(height + 0.03, 3)
    builder.base.add_cylinder(
        (-reach / 2, 0, height - 0.015 if two else height - 0.06), 0.012, reach, "x", "steel"
    )
    # The hand stays in front of the spout.
    length = sampler.sample_length(0.11, 0.16) + (0.0 if two else max(reach - 0.1, 0.0))
    for suffix, y in names:
        if two:
            builder.base.add_cylinder((0, y, low / 2 - 0.01), 0.018, low - 0.02, "z", "steel")
        lower, upper = (0.0, 1.2) if two else (-0.8, 0.8)
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
    height, out, thick = (
        sampler.sample_length(0.7, 1.15),
        sampler.sample_length(0.1, 0.16),
        sampler.sample_length(0.03, 0.05),
    )
    back = out + thick
    builder.base.add_cylinder((back, 0, (height + 0.3) / 2), thick, height + 0.3, "z", "slate")
    spindle = back - thick - 0.017  # to the hub, which is 0.03 long
    builder.base.add_cylinder((back - spindle / 2, 0, height), 0.018, spindle, "x", "steel")
    turned = builder.add_joint(
        "turn", "revolute", (thick, 0, height), (1, 0, 0), 1.5, lower=-0.2, link="wheel"
    )
    turned.add_cylinder((0, 0, 0), 0.025, 0.03, "x", "dark")
    if sampler.sample_bool(0.5):
        length = sampler.sample_length(0.16, 0.24)
        turned.add_box((-0.006, -0.011, 0.0), (0.006, 0.011, length), "sage")
        held, closing = (0.0, 0.0, length - 0.03), (0, 1, 0)
        bend: dict[str, object] = {"joint": "revolute", "axis": [1, 0, 0], "limits": [-0.5, 0.5]}
    else:
        radius = sampler.sample_length(0.11, 0.17)
        angles = [math.pi * (2 * k + 1) / _SIDES for k in range(_SIDES)]
        outer = radius / math.cos(math.pi / _SIDES)
        corners = [(0.0, outer * math.sin(angle), outer * math.cos(angle)) for angle in angles]
        for one, other in zip(corners, [*corners[1:], corners[0]], strict=True):
            turned.add_rod(one, other, 0.011, "sage")
        turned.add_box((-0.006, -0.01, -radius), (0.006, 0.01, radius), "slate")
        turned.add_box((-0.006, -radius, -0.01), (0.006, radius, 0.01), "slate")
        held, closing = (
            (0.0, radius * math.sin(math.pi / 4), radius * math.cos(math.pi / 4)),
            (0, 1, 1),
        )
        bend = {"joint": "revolute", "axis": [0, 1, 0], "limits": [-0.5, 0.5]}
    builder.add_attachment("handle", turned, held, (1, 0, 0), closing)
    builder.add_attachment("handle_free", turned, held, (1, 0, 0), closing, **bend)
    return builder
