"""Writes an object as a folder: a URDF with convex pieces, meshes to look at, and the description that scenes name."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
import yaml

from vkc_pin.importing.objects.description import Colour, Description, Joint, Link, Part
from vkc_pin.importing.targets import format_comment
from vkc_pin.world.files.meshes import load_parts
from vkc_pin.world.files.resources import choose_file_names
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.files.xml import quote
from vkc_pin.world.models.articulated_object import DEFAULT_VELOCITY

if TYPE_CHECKING:
    import trimesh

__all__ = ["write_description", "write_urdf"]

_EFFORT = 100.0  # [N], [N m]: nothing here reads it, but other programs want one
_GREY: Colour = (0.75, 0.75, 0.75, 1.0)


def write_urdf(description: Description, file: Path) -> None:
    """Write a URDF, and beside it the folders `collision` and `visual` with its meshes.

    Files of meshes are named after their links, see `choose_file_names`.

    Args:
        description: The object; what collides is convex.
        file: The URDF to write.
    """
    lines = ['<?xml version="1.0"?>', f"<robot name={quote(file.stem)}>"]
    stems = choose_file_names(description.links)
    for stem, link in zip(stems, description.links.values(), strict=True):
        lines.append(f"  <link name={quote(link.name)}>")
        for number, (part, mesh, colour) in enumerate(_looks(link)):
            address = None if mesh is None else _mesh(file, f"visual/{stem}_{number}.stl", mesh)
            lines += _element("visual", "", part, address, colour)
        for number, part in enumerate(_plain_shapes(link.collision)):
            piece = None
            if part.kind == "mesh":
                piece = _mesh(file, f"collision/{stem}_{number}.stl", part.mesh())
            lines += _element("collision", part.name, part, piece, None)
        lines += _inertial(link.inertia)
        lines.append("  </link>")
    for joint in description.joints.values():
        lines += _joint(joint)
    write_atomically(file, ("\n".join([*lines, "</robot>"]) + "\n").encode())


def write_description(
    file: Path,
    urdf: str,
    attachments: Sequence[Mapping[str, Any]],
    *,
    about: Sequence[str],
    free: bool = False,
) -> None:
    """Write the description of an object.

    Args:
        file: The .yaml to write.
        urdf: Its URDF, from the folder of `file`.
        attachments: As data, best first.
        about: Lines for its head.
        free: Whether it can be carried away.
    """
    head = "".join(map(format_comment, about))
    data = {
        "urdf": urdf,
        **({"free": True} if free else {}),
        "attachments": [dict(item) for item in attachments],
    }
    body = yaml.safe_dump(data, sort_keys=False, width=130)
    write_atomically(file, (head + body).encode())


def _looks(link: Link) -> list[tuple[Part | None, trimesh.Trimesh | None, Colour]]:
    """Return what a link looks like: shapes as they are, and meshes in its frame, those of one colour together."""
    import trimesh

    found: list[tuple[Part | None, trimesh.Trimesh | None, Colour]] = []
    meshes: dict[Colour, list[trimesh.Trimesh]] = {}
    for part in _plain_shapes(link.visual):
        if part.kind != "mesh":
            found.append((part, None, part.colour or _GREY))
        elif part.file is not None and part.colour is None:
            for coloured in load_parts(part.file, part.size):
                mesh = trimesh.Trimesh(coloured.vertices, coloured.faces, process=False)
                mesh.apply_transform(part.placement.homogeneous)
                meshes.setdefault(coloured.colour or _GREY, []).append(mesh)
        else:
            meshes.setdefault(part.colour or _GREY, []).append(part.mesh())
    return found + [
        (None, trimesh.util.concatenate(same), colour) for colour, same in meshes.items()
    ]


def _plain_shapes(parts: Sequence[Part]) -> list[Part]:
    """Return parts with a cylinder and two balls for each capsule, which URDF has not: many readers then drop the whole link."""
    found = list[Part]()
    for part in parts:
        if part.kind != "capsule":
            found.append(part)
            continue
        radius, length = part.size
        found.append(dataclasses.replace(part, kind="cylinder"))
        for end in (-length / 2.0, length / 2.0):
            ball = part.placement * pin.SE3(np.eye(3), np.array([0.0, 0.0, end]))
            found.append(dataclasses.replace(part, kind="sphere", size=(radius,), placement=ball))
    return found


def _mesh(urdf: Path, address: str, mesh: trimesh.Trimesh) -> str:
    write_atomically(urdf.parent / address, mesh.export(file_type="stl"))
    return address


def _element(
    kind: str, name: str, part: Part | None, address: str | None, colour: Colour | None
) -> list[str]:
    lines = [f"    <{kind}{f' name={quote(name)}' if name else ''}>"]
    if part is not None and address is None:
        lines.append(f"      {_origin(part.placement)}")
        keys = {"box": f'size="{_numbers(part.size)}"', "sphere": f'radius="{_numbers(part.size)}"'}
        size = (
            keys.get(part.kind)
            or f'radius="{_numbers(part.size[:1])}" length="{_numbers(part.size[1:])}"'
        )
        lines.append(f"      <geometry><{part.kind} {size}/></geometry>")
    else:
        lines.append(f"      <geometry><mesh filename={quote(address or '')}/></geometry>")
    if colour is not None:
        name = "_".join(f"{round(255 * c):02x}" for c in colour)
        lines.append(f'      <material name="{name}"><color rgba="{_numbers(colour)}"/></material>')
    return [*lines, f"    </{kind}>"]


def _inertial(inertia: pin.Inertia) -> list[str]:
    """Return what a link weighs, about its centre of mass along the link's axes; nothing if it has no mass."""
    if not inertia.mass > 0.0:
        return []
    entries = " ".join(
        f'i{"xyz"[i]}{"xyz"[j]}="{inertia.inertia[i, j]:.9g}"'
        for i in range(3)
        for j in range(i, 3)
    )
    origin, mass = (
        f'<origin xyz="{_numbers(inertia.lever)}"/>',
        f'<mass value="{inertia.mass:.9g}"/>',
    )
    return [f"    <inertial>{origin}{mass}<inertia {entries}/></inertial>"]


def _joint(joint: Joint) -> list[str]:
    lines = [
        f"  <joint name={quote(joint.name)} type={quote(joint.kind)}>",
        f"    <parent link={quote(joint.parent)}/><child link={quote(joint.child)}/>",
        f"    {_origin(joint.placement)}",
        f'    <axis xyz="{_numbers(joint.axis)}"/>',
    ]
    velocity = joint.velocity or DEFAULT_VELOCITY
    ends = (
        ""
        if joint.limits is None
        else f'lower="{_numbers(joint.limits[:1])}" upper="{_numbers(joint.limits[1:])}" '
    )
    if joint.damping or joint.friction:
        lines.append(
            f'    <dynamics damping="{_numbers([joint.damping])}" friction="{_numbers([joint.friction])}"/>'
        )
    return [
        *lines,
        f'    <limit {ends}velocity="{_numbers([velocity])}" effort="{_numbers([_EFFORT])}"/>',
        "  </joint>",
    ]


def _origin(placement: pin.SE3) -> str:
    return f'<origin xyz="{_numbers(placement.translation)}" rpy="{_numbers(pin.rpy.matrixToRpy(placement.rotation))}"/>'


def _numbers(values: Any) -> str:
    return " ".join(f"{value + 0.0:.9g}" for value in np.asarray(values, float).round(9).tolist())
