"""Builds descriptions of imported objects and homes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.importing.description import Description, Joint, Link, Part

CUBE = (0.1, 0.1, 0.1)


def make_placement(at: Sequence[float] | pin.SE3) -> pin.SE3:
    return at if isinstance(at, pin.SE3) else pin.SE3(np.eye(3), np.array(at, float))


def make_part(
    kind: str = "box",
    size: tuple[float, ...] = CUBE,
    at: Sequence[float] | pin.SE3 = (0, 0, 0),
    name: str = "",
    **more: Any,
) -> Part:
    """Return a shape; `at` is a position or a placement."""
    return Part(name=name, kind=kind, size=size, placement=make_placement(at), **more)


def make_mesh_part(triangles: Any, at: Sequence[float] | pin.SE3 = (0, 0, 0), **more: Any) -> Part:
    return make_part("mesh", (1.0, 1.0, 1.0), at, triangles=triangles, **more)


def make_joint(
    parent: str,
    child: str,
    kind: str = "revolute",
    at: Sequence[float] | pin.SE3 = (0, 0, 0),
    limits: tuple[float, float] | None = (0.0, 1.0),
    **more: Any,
) -> Joint:
    """Return a joint that is named after its child; fixed joints have no limits."""
    return Joint(
        name=f"to_{child}",
        kind=kind,
        parent=parent,
        child=child,
        placement=make_placement(at),
        limits=limits if kind != "fixed" else None,
        **more,
    )


def make_description(links: Sequence[Link], joints: Sequence[Joint] = ()) -> Description:
    return Description(
        Path("home.urdf"),
        {link.name: link for link in links},
        {joint.child: joint for joint in joints},
    )
