"""Writes robots on wheels: an arm on a body that is 0.35 m above the floor."""

from __future__ import annotations

from pathlib import Path

from helpers.arm_urdf import HEIGHT, write_arms
from helpers.telescopes import format_joint, format_link
from helpers.texts import replace_in_file

__all__ = ["format_steered_wheel", "format_wheel", "write_wheeled_robot"]

_RADIUS = 0.1  # [m]


def format_wheel(
    name: str,
    x: float,
    y: float,
    *,
    axis: str = "0 1 0",
    parent: str = "body",
    z: float = _RADIUS - HEIGHT,
    kind: str = "continuous",
) -> str:
    """Return a wheel on a link, by default on the body, with its joint `<name>_joint`."""
    size = 2.0 * _RADIUS
    link = format_link(name, f"{size} 0.04 {size}")
    return link + format_joint(
        f"{name}_joint", kind, parent, name, f"{x} {y} {z}", axis, (-1e16, 1e16)
    )


def format_steered_wheel(
    name: str, x: float, y: float, *, limit: float | None = None, trail: float = 0.0
) -> str:
    """Return a wheel on a fork that turns about the vertical, without limits for a caster."""
    fork = f"{name}_fork"
    kind = "continuous" if limit is None else "revolute"
    at = f"{x} {y} {_RADIUS - HEIGHT}"
    limits = (-1.0, 1.0) if limit is None else (-limit, limit)
    turn = format_joint(f"{fork}_joint", kind, "body", fork, at, limits=limits)
    return format_link(fork) + turn + format_wheel(name, -trail, 0.0, parent=fork, z=0.0)


def write_wheeled_robot(folder: Path, *wheels: str) -> Path:
    """Write a URDF with an arm and some wheels, see `format_wheel`, and return it."""
    return replace_in_file(write_arms(folder), ("</robot>", "".join((*wheels, "</robot>"))))
