"""Describes free blocks, and the scenes on whose surfaces they are put down."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from helpers.carrying import describe_box
from vkc_pin.world.scene.scene import Scene

TOP = 0.5  # height of the table [m]
TABLE = describe_box("table", [0.6, 0.6, 0.02], [1.0, 0.0, TOP - 0.01])
"""A table whose edges are at x = 0.7 and 1.3 and at y = ±0.3."""
ABOVE = 1e-3  # [m] of air below a block


def describe_block(
    name: str = "block",
    *,
    size: Sequence[float] = (0.06, 0.06, 0.1),
    mass: float | None = 0.2,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    at: Sequence[float] = (1.0, 0.0, TOP + ABOVE),
) -> dict[str, Any]:
    """Return a block that is grasped from above or from its side.

    Args:
        name: Its name.
        size: Along x, y and z [m].
        mass: Its mass [kg]; None: not stated.
        centre: Centre of mass relative to its middle [m].
        at: Middle of its underside [m].
    """
    x, y, z = size
    inertia = 'ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"'
    origin = " ".join(str(value) for value in (centre[0], centre[1], centre[2] + z / 2))
    inertial = f'<inertial><origin xyz="{origin}"/><mass value="{mass}"/><inertia {inertia}/>'
    urdf = (
        f'<robot name="{name}"><link name="body">{"" if mass is None else inertial + "</inertial>"}'
        f'<collision><origin xyz="0 0 {z / 2}"/><geometry><box size="{x} {y} {z}"/></geometry>'
        "</collision></link></robot>"
    )
    top = {"name": "top", "link": "body", "position": [0, 0, z - 0.01]}
    side = {"name": "side", "link": "body", "position": [0, 0, z / 2]}
    attachments = [
        {**top, "approach": [0, 0, -1], "closing": [0, 1, 0]},
        {**side, "approach": [1, 0, 0], "closing": [0, 1, 0]},
    ]
    kind = {"urdf": urdf, "free": True, "attachments": attachments}
    return {"name": name, "type": kind, "position": list(at)}


def make_block_scene(
    *objects: Mapping[str, Any],
    obstacles: Sequence[Mapping[str, Any]] = (TABLE,),
    **document: Any,
) -> Scene:
    """Return a Husky before a table with blocks."""
    fields = {
        "robot": "husky_ur5e",
        "arena": {"x": [-3.0, 3.0], "y": [-3.0, 3.0]},
        "start": {"base": [-0.5, 0.0, 0.0]},
        "objects": list(objects or [describe_block()]),
        "obstacles": list(obstacles),
        **document,
    }
    return Scene.from_document(fields)
