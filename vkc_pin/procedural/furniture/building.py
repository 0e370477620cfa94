"""Builds articulated objects of random sizes and their handles from simple shapes, as URDF.

A finger reaches some 0.02 m beyond the tool's origin: a handle 0.05 m or more in front of its face
leaves room behind it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin

from vkc_pin.utils.arrays import Floats

T = TypeVar("T")
Point = Sequence[float]

_COLOURS: dict[str, tuple[float, float, float]] = {
    "dark": (0.2, 0.21, 0.23),
    "glass": (0.30, 0.36, 0.40),
    "oak": (0.76, 0.60, 0.42),
    "sage": (0.55, 0.64, 0.56),
    "sand": (0.84, 0.79, 0.68),
    "shade": (0.84, 0.83, 0.79),
    "slate": (0.38, 0.45, 0.52),
    "steel": (0.62, 0.64, 0.66),
    "walnut": (0.45, 0.31, 0.20),
    "white": (0.93, 0.92, 0.89),
}
# [kg/m³], wood; hollow bodies are built of their walls
_DENSITY = 500.0
_NO_ROTATION = (0.0, 0.0, 0.0)
# Roll, pitch and yaw of a cylinder along each axis.
_CYLINDER_RPY = {
    "x": (0.0, math.pi / 2.0, 0.0),
    "y": (math.pi / 2.0, 0.0, 0.0),
    "z": _NO_ROTATION,
}
# [rad/s], [m/s]
_VELOCITY = {"revolute": 1.0, "prismatic": 0.5}
# [N·m], [N]
_EFFORT = {"revolute": 30.0, "prismatic": 40.0}
# [m] from a bar's ends to the posts that carry it
_POST = 0.02
# [m] from a post to the middle of the hand
_HALF_HAND = 0.03
# [rad] largest tilt of a hand about a bar
_TILT = 0.6
# [rad] largest rotation about an upright bar, or in any direction about a knob
_SWING = 0.8
# [m] height above which a hand approaches horizontally; lower handles obliquely from above
_LEVEL = 0.55
# [m] below it, the height at which the slope is largest
_DESCENT = 0.25
# [rad] largest slope of such an approach
_STEEPEST = 0.65


@dataclass(frozen=True)
class _Shape:
    """A box (edges), cylinder (radius, length) or sphere (radius) in the link's frame."""

    kind: str
    size: tuple[float, ...]
    centre: tuple[float, ...]
    rpy: tuple[float, float, float]
    colour: str

    def make_xml(self, element: str) -> str:
        """Return the URDF element `<visual>` or `<collision>`."""
        if self.kind == "box":
            size = f'size="{_format_numbers(self.size)}"'
        else:
            size = f'radius="{_format_numbers(self.size[:1])}"'
            if self.kind == "cylinder":
                size += f' length="{_format_numbers(self.size[1:])}"'
        rpy = f' rpy="{_format_numbers(self.rpy, 6)}"' if any(self.rpy) else ""
        material = f"<material name={quoteattr(self.colour)}/>" if element == "visual" else ""
        geometry = f"<geometry><{self.kind} {size}/></geometry>"
        origin = f'<origin xyz="{_format_numbers(self.centre)}"{rpy}/>'
        return f"    <{element}>{origin}{geometry}{material}</{element}>"

    @property
    def inertia(self) -> pin.Inertia:
        """Inertia in the link's frame."""
        if self.kind == "box":
            own = pin.Inertia.FromBox(_DENSITY * math.prod(self.size), *self.size)
        elif self.kind == "cylinder":
            radius, length = self.size
            own = pin.Inertia.FromCylinder(_DENSITY * math.pi * radius**2 * length, radius, length)
        else:
            (radius,) = self.size
            own = pin.Inertia.FromSphere(_DENSITY * 4.0 / 3.0 * math.pi * radius**3, radius)
        placement = pin.SE3(pin.rpy.rpyToMatrix(*self.rpy), np.array(self.centre, float))
        return placement.act(own)


@dataclass
class LinkBuilder:
    """A link under construction; lengths in metres, in its own frame."""

    name: str
    shapes: list[_Shape] = field(default_factory=list)

    def add_box(self, low: Point, high: Point, colour: str) -> None:
        """Add a box between two corners."""
        ends = list(zip(low, high, strict=True))
        size = tuple(b - a for a, b in ends)
        centre = tuple((a + b) / 2.0 for a, b in ends)
        self.shapes.append(_Shape("box", size, centre, _NO_ROTATION, colour))

    def add_cylinder(
        self, centre: Point, radius: float, length: float, axis: str, colour: str
    ) -> None:
        """Add a cylinder along an axis of the link: "x", "y" or "z"."""
        self.shapes.append(
            _Shape("cylinder", (radius, length), tuple(centre), _CYLINDER_RPY[axis], colour)
        )

    def add_rod(self, one: Point, other: Point, radius: float, colour: str) -> None:
        """Add a cylinder between two points."""
        axis = np.subtract(other, one)
        length = float(np.linalg.norm(axis))
        pitch = float(np.arccos(axis[2] / length))
        yaw = float(np.arctan2(axis[1], axis[0]))
        centre = tuple(np.add(one, other) / 2.0)
        self.shapes.append(_Shape("cylinder", (radius, length), centre, (0.0, pitch, yaw), colour))

    def add_sphere(self, centre: Point, radius: float, colour: str) -> None:
        """Add a sphere."""
        self.shapes.append(_Shape("sphere", (radius,), tuple(centre), _NO_ROTATION, colour))

    def add_case(self, low: Point, high: Point, wall: float, colour: str, inside: str) -> None:
        """Add a case that is open towards -x: two sides, top, bottom and back."""
        x0, y0, z0 = low
        x1, y1, z1 = high
        self.add_box((x0, y0, z0), (x1, y0 + wall, z1), colour)
        self.add_box((x0, y1 - wall, z0), (x1, y1, z1), colour)
        self.add_box((x0, y0 + wall, z1 - wall), (x1, y1 - wall, z1), colour)
        self.add_box((x0, y0 + wall, z0), (x1, y1 - wall, z0 + wall), colour)
        self.add_box((x1 - wall, y0 + wall, z0 + wall), (x1, y1 - wall, z1 - wall), inside)

    def make_xml(self) -> str:
        """Return the URDF element `<link>`, with mass and inertia of the shapes."""
        whole = sum((shape.inertia for shape in self.shapes), pin.Inertia.Zero())
        entries: list[str] = []
        for i, j in itertools.combinations_with_replacement(range(3), 2):
            moment = _format_numbers([whole.inertia[i, j]], 6)
            entries.append(f'i{"xyz"[i]}{"xyz"[j]}="{moment}"')
        inertia = f"<inertia {' '.join(entries)}/>"
        mass = f'<mass value="{_format_numbers([whole.mass])}"/>'
        origin = f'<origin xyz="{_format_numbers(whole.lever)}"/>'
        lines = [
            f"  <link name={quoteattr(self.name)}>",
            f"    <inertial>{origin}{mass}{inertia}</inertial>",
        ]
        lines += [shape.make_xml("visual") for shape in self.shapes]
        lines += [shape.make_xml("collision") for shape in self.shapes]
        return "\n".join([*lines, "  </link>"])


@dataclass
class ObjectBuilder:
    """An articulated object under construction; `description` is the input of `load_object`.

    The base frame lies on the support, below the middle of the object's front: x points away from
    the user, z up.
    """

    name: str
    base: LinkBuilder
    links: list[tuple[LinkBuilder, str]] = field(default_factory=list)
    accelerations: dict[str, float] = field(default_factory=dict)
    attachments: list[dict[str, Any]] = field(default_factory=list)
    latches: list[dict[str, Any]] = field(default_factory=list)

    def add_joint(
        self,
        name: str,
        kind: str,
        origin: Point,
        axis: Point,
        upper: float,
        *,
        lower: float = 0.0,
        link: str,
        parent: str | None = None,
        acceleration: float = 1.0,
    ) -> LinkBuilder:
        """Add a joint, and return the link that it moves."""
        child = LinkBuilder(link)
        limits = f'lower="{_format_numbers([lower])}" upper="{_format_numbers([upper])}"'
        velocity = _format_numbers([_VELOCITY[kind]])
        effort = _format_numbers([_EFFORT[kind]])
        rates = f'velocity="{velocity}" effort="{effort}"'
        parent_name = quoteattr(parent or self.base.name)
        lines = [
            f'  <joint name={quoteattr(name)} type="{kind}">',
            f"    <parent link={parent_name}/><child link={quoteattr(link)}/>",
            f'    <origin xyz="{_format_numbers(origin)}"/><axis xyz="{_format_numbers(axis)}"/>',
            f"    <limit {limits} {rates}/>",
            "  </joint>",
        ]
        self.links.append((child, "\n".join(lines)))
        self.accelerations[name] = acceleration
        return child

    def add_attachment(
        self,
        name: str,
        link: LinkBuilder,
        position: Point,
        approach: Point,
        closing: Point,
        **freedom: Any,
    ) -> None:
        """Add an attachment of a link, given in the link's frame; see `Attachment`."""
        self.attachments.append(
            {
                "name": name,
                "link": link.name,
                "position": _round_all(position),
                "approach": _round_all(approach),
                "closing": _round_all(closing),
                **freedom,
            }
        )

    @property
    def urdf(self) -> str:
        """The object as a URDF."""
        used = {shape.colour for shape in self.base.shapes}
        for link, _ in self.links:
            used.update(shape.colour for shape in link.shapes)
        lines = ['<?xml version="1.0"?>', f"<robot name={quoteattr(self.name)}>"]
        for name in sorted(used):
            colour = _format_numbers(_COLOURS[name])
            lines.append(f'  <material name="{name}"><color rgba="{colour} 1"/></material>')
        lines.append(self.base.make_xml())
        for link, joint in self.links:
            lines += [joint, link.make_xml()]
        lines.append("</robot>")
        return "\n".join(lines) + "\n"

    @property
    def description(self) -> dict[str, Any]:
        """The object's description as plain data, including its URDF."""
        plain: dict[str, Any] = {
            "urdf": self.urdf,
            "joints": {name: {"acceleration": a} for name, a in self.accelerations.items()},
            "attachments": [_to_plain_data(item) for item in self.attachments],
        }
        if self.latches:
            plain["latches"] = self.latches
        return plain


class Sampler:
    """Random sizes and choices from a random number generator."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def draw(self, low: float, high: float) -> float:
        """Return a length [m] or angle [rad] between two, rounded to three decimals."""
        return round(float(self._rng.uniform(low, high)), 3)

    def draw_integer(self, low: int, high: int) -> int:
        """Return an integer from `low` to `high`, both included."""
        return int(self._rng.integers(low, high + 1))

    def flip(self, probability: float) -> bool:
        """Return True with a probability."""
        return bool(self._rng.random() < probability)

    def choose(self, choices: Sequence[T]) -> T:
        """Return one of the choices."""
        return choices[int(self._rng.integers(len(choices)))]


def _format_numbers(values: Sequence[float] | Floats, digits: int = 4) -> str:
    """Format rounded numbers, separated by spaces; + 0.0 avoids negative zeros."""
    return " ".join(f"{round(float(value), digits) + 0.0:.10g}" for value in values)


def _round_all(values: Point) -> list[float]:
    """Round numbers; + 0.0 avoids negative zeros."""
    return [round(float(value), 6) + 0.0 for value in values]


def _to_plain_data(item: Mapping[str, Any]) -> dict[str, Any]:
    """Return an item with lists in place of tuples."""
    return {key: list(value) if isinstance(value, tuple) else value for key, value in item.items()}


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
    builder.add_attachment(
        f"{name}_free",
        *where,
        joint="cylindrical",
        axis=[0, 1, 0],
        limits=_make_interval(reach),
        turn=_make_interval(_SWING),
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
    slope = _STEEPEST * float(np.clip((_LEVEL - height) / _DESCENT, 0.0, 1.0))
    c = math.cos(slope)
    s = math.sin(slope)
    approach = (c, 0.0, -s)
    closing = (s, 0.0, c)
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
    """Add a bar along "y" or "z" on two posts.

    Returns:
        The bar's middle, and how far the hand may slide from there [m].
    """
    x, y, z = at
    middle = (x - out, y, z)
    end = length / 2.0 - _POST
    link.add_cylinder(middle, 0.01, length, axis, "steel")
    for shift in (-end, end):
        post = (x - out / 2.0, y, z + shift) if axis == "z" else (x - out / 2.0, y + shift, z)
        link.add_cylinder(post, 0.006, out, "x", "steel")
    return middle, max(end - _HALF_HAND, 0.0)


def _make_interval(reach: float) -> list[float]:
    """Return the interval of a reach to both sides."""
    return [-round(reach, 4), round(reach, 4)]
