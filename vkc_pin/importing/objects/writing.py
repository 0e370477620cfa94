"""Writes an object as a folder with a URDF, its meshes and the object's description."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
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


_EFFORT = 100.0  # [N], [N·m] effort limit, which other programs require
_GREY: Colour = (0.75, 0.75, 0.75, 1.0)


def write_urdf(description: Description, file: Path) -> None:
    """Write a URDF, and its meshes in the folders `collision` and `visual` beside it.

    Mesh files are named after their links, see `choose_file_names`.
    """
    lines = ['<?xml version="1.0"?>', f"<robot name={quote(file.stem)}>"]
    stems = choose_file_names(description.links)
    for stem, link in zip(stems, description.links.values(), strict=True):
        lines.append(f"  <link name={quote(link.name)}>")
        for number, (part, mesh, colour) in enumerate(_collect_visuals(link)):
            mesh_file = (
                None if mesh is None else _write_mesh(file, f"visual/{stem}_{number}.stl", mesh)
            )
            lines += _format_shape("visual", "", part, mesh_file, colour)
        for number, part in enumerate(_replace_capsules(link.collision)):
            piece = None
            if part.kind == "mesh":
                piece = _write_mesh(file, f"collision/{stem}_{number}.stl", part.make_mesh())
            lines += _format_shape("collision", part.name, part, piece, None)
        lines += _format_inertia(link.inertia)
        lines.append("  </link>")
    for joint in description.joints.values():
        lines += _format_joint(joint)
    write_atomically(file, ("\n".join([*lines, "</robot>"]) + "\n").encode())


def write_description(
    file: Path,
    urdf: str,
    attachments: Sequence[Mapping[str, Any]],
    *,
    about: Sequence[str],
    joints: Iterable[Joint] = (),
    free: bool = False,
) -> None:
    """Write the description of an object, with the springs of its joints."""
    head = "".join(map(format_comment, about))
    springs = {
        joint.name: {"stiffness": round(joint.stiffness, 9), "springref": round(joint.springref, 9)}
        for joint in joints
        if joint.stiffness > 0.0
    }
    data = {
        "urdf": urdf,
        **({"joints": springs} if springs else {}),
        **({"free": True} if free else {}),
        "attachments": [dict(item) for item in attachments],
    }
    body = yaml.safe_dump(data, sort_keys=False, width=130)
    write_atomically(file, (head + body).encode())


def _collect_visuals(link: Link) -> list[tuple[Part | None, trimesh.Trimesh | None, Colour]]:
    """Return the visual shapes of a link."""
    import trimesh

    shapes: list[tuple[Part | None, trimesh.Trimesh | None, Colour]] = []
    meshes: dict[Colour, list[trimesh.Trimesh]] = {}
    for part in _replace_capsules(link.visual):
        if part.kind != "mesh":
            shapes.append((part, None, part.colour or _GREY))
        elif part.file is not None and part.colour is None:
            for coloured in load_parts(part.file, part.size):
                mesh = trimesh.Trimesh(coloured.vertices, coloured.faces, process=False)
                mesh.apply_transform(part.placement.homogeneous)
                meshes.setdefault(coloured.colour or _GREY, []).append(mesh)
        else:
            meshes.setdefault(part.colour or _GREY, []).append(part.make_mesh())
    return shapes + [
        (None, trimesh.util.concatenate(same), colour) for colour, same in meshes.items()
    ]


def _replace_capsules(parts: Sequence[Part]) -> list[Part]:
    """Replace each capsule by a cylinder and two spheres."""
    shapes = list[Part]()
    for part in parts:
        if part.kind != "capsule":
            shapes.append(part)
            continue
        radius, length = part.size
        shapes.append(dataclasses.replace(part, kind="cylinder"))
        for end in (-length / 2.0, length / 2.0):
            ball = part.placement * pin.SE3(np.eye(3), np.array([0.0, 0.0, end]))
            shapes.append(dataclasses.replace(part, kind="sphere", size=(radius,), placement=ball))
    return shapes


def _write_mesh(urdf: Path, mesh_file: str, mesh: trimesh.Trimesh) -> str:
    write_atomically(urdf.parent / mesh_file, mesh.export(file_type="stl"))
    return mesh_file


def _format_shape(
    kind: str, name: str, part: Part | None, mesh_file: str | None, colour: Colour | None
) -> list[str]:
    lines = [f"    <{kind}{f' name={quote(name)}' if name else ''}>"]
    if part is not None and mesh_file is None:
        lines.append(f"      {_format_origin(part.placement)}")
        names = ("size",) if part.kind == "box" else ("radius", "length")
        values = (part.size,) if part.kind == "box" else zip(part.size)
        size = " ".join(
            f'{name}="{_format_numbers(value)}"' for name, value in zip(names, values, strict=False)
        )
        lines.append(f"      <geometry><{part.kind} {size}/></geometry>")
    else:
        lines.append(f"      <geometry><mesh filename={quote(mesh_file or '')}/></geometry>")
    if colour is not None:
        name = "_".join(f"{round(255 * c):02x}" for c in colour)
        lines.append(
            f'      <material name="{name}"><color rgba="{_format_numbers(colour)}"/></material>'
        )
    return [*lines, f"    </{kind}>"]


def _format_inertia(inertia: pin.Inertia) -> list[str]:
    """Format a link's inertia about its centre of mass; empty if it has no mass."""
    if not inertia.mass > 0.0:
        return []
    entries = " ".join(
        f'i{"xyz"[i]}{"xyz"[j]}="{inertia.inertia[i, j]:.9g}"'
        for i in range(3)
        for j in range(i, 3)
    )
    origin = f'<origin xyz="{_format_numbers(inertia.lever)}"/>'
    mass = f'<mass value="{inertia.mass:.9g}"/>'
    return [f"    <inertial>{origin}{mass}<inertia {entries}/></inertial>"]


def _format_joint(joint: Joint) -> list[str]:
    lines = [
        f"  <joint name={quote(joint.name)} type={quote(joint.kind)}>",
        f"    <parent link={quote(joint.parent)}/><child link={quote(joint.child)}/>",
        f"    {_format_origin(joint.placement)}",
        f'    <axis xyz="{_format_numbers(joint.axis)}"/>',
    ]
    velocity = joint.velocity or DEFAULT_VELOCITY
    ends = ""
    if joint.limits is not None:
        lower, upper = _format_numbers(joint.limits[:1]), _format_numbers(joint.limits[1:])
        ends = f'lower="{lower}" upper="{upper}" '
    if joint.damping or joint.friction:
        damping, friction = _format_numbers([joint.damping]), _format_numbers([joint.friction])
        lines.append(f'    <dynamics damping="{damping}" friction="{friction}"/>')
    return [
        *lines,
        f'    <limit {ends}velocity="{_format_numbers([velocity])}" '
        f'effort="{_format_numbers([_EFFORT])}"/>',
        "  </joint>",
    ]


def _format_origin(placement: pin.SE3) -> str:
    xyz = _format_numbers(placement.translation)
    rpy = _format_numbers(pin.rpy.matrixToRpy(placement.rotation))
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'


def _format_numbers(values: Any) -> str:
    return " ".join(f"{value + 0.0:.9g}" for value in np.asarray(values, float).round(9).tolist())
