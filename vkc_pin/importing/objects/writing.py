"""Writes an object as a folder with a URDF, its meshes and the object's description."""

from __future__ import annotations

import dataclasses
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import yaml

from vkc_pin.importing.description import Colour, Description, Joint, Link, Part
from vkc_pin.importing.targets import format_comment
from vkc_pin.importing.urdf_writing import make_urdf
from vkc_pin.world.files.meshes import load_parts
from vkc_pin.world.files.resources import choose_file_names
from vkc_pin.world.files.writing import write_atomically
from vkc_pin.world.models.articulated_object import DEFAULT_VELOCITY

_EFFORT = 100.0  # [N], [N·m] effort limit of joints for which a file states none
_GREY: Colour = (0.75, 0.75, 0.75, 1.0)


def write_urdf(description: Description, file: Path) -> None:
    """Write a URDF, and its meshes in the folders `collision` and `visual` beside it.

    Mesh files are named after their links, see `choose_file_names`. Capsules are written as
    cylinders and spheres, and joints without velocity and effort limits get usual ones, for other
    programs.
    """
    stems = choose_file_names(description.links)
    links = dict[str, Link]()
    for stem, (name, link) in zip(stems, description.links.items(), strict=True):
        visual = _write_meshes(_merge_visuals(link), file.parent / "visual", stem)
        collision = _write_meshes(
            _replace_capsules(link.collision), file.parent / "collision", stem
        )
        links[name] = Link(link.name, visual, collision, link.inertia)
    joints = dict[str, Joint]()
    for child, joint in description.joints.items():
        velocity = joint.velocity or DEFAULT_VELOCITY
        effort = joint.effort or _EFFORT
        joints[child] = dataclasses.replace(joint, velocity=velocity, effort=effort)
    written = dataclasses.replace(description, links=links, joints=joints)
    root = make_urdf(written, file.stem, file.parent)
    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode")
    write_atomically(file, f'<?xml version="1.0"?>\n{text}\n'.encode())


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
    springs = dict[str, dict[str, float]]()
    for joint in joints:
        if joint.stiffness > 0.0:
            springs[joint.name] = {
                "stiffness": round(joint.stiffness, 9),
                "springref": round(joint.springref, 9),
            }
    data: dict[str, Any] = {"urdf": urdf}
    if springs:
        data["joints"] = springs
    if free:
        data["free"] = True
    data["attachments"] = [dict(item) for item in attachments]
    body = yaml.safe_dump(data, sort_keys=False, width=130)
    write_atomically(file, (head + body).encode())


def _merge_visuals(link: Link) -> list[Part]:
    """Return the visual shapes of a link, its meshes merged by their colours."""
    import trimesh

    shapes = list[Part]()
    meshes = dict[Colour, list[trimesh.Trimesh]]()
    for part in _replace_capsules(link.visual):
        if part.kind != "mesh":
            shapes.append(dataclasses.replace(part, name="", colour=part.colour or _GREY))
        elif part.file is not None and part.colour is None:
            # The file may have a colour for each of its parts.
            for coloured in load_parts(part.file, part.size):
                mesh = trimesh.Trimesh(coloured.vertices, coloured.faces, process=False)
                mesh.apply_transform(part.placement.homogeneous)
                meshes.setdefault(coloured.colour or _GREY, []).append(mesh)
        else:
            meshes.setdefault(part.colour or _GREY, []).append(part.make_mesh())
    for colour, same in meshes.items():
        merged = trimesh.util.concatenate(same)
        shapes.append(Part.from_triangles("", merged, colour))
    return shapes


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
            placement = part.placement * pin.SE3(np.eye(3), np.array([0.0, 0.0, end]))
            shapes.append(
                dataclasses.replace(part, kind="sphere", size=(radius,), placement=placement)
            )
    return shapes


def _write_meshes(parts: Sequence[Part], folder: Path, stem: str) -> tuple[Part, ...]:
    """Write the meshes among some parts as `<stem>_<k>.stl`, and return the parts."""
    written = list[Part]()
    for number, part in enumerate(parts):
        written.append(_write_mesh(part, folder / f"{stem}_{number}.stl"))
    return tuple(written)


def _write_mesh(part: Part, file: Path) -> Part:
    """Write a mesh in the frame of its link, and return the part with this file."""
    if part.kind != "mesh":
        return part
    write_atomically(file, part.make_mesh().export(file_type="stl"))
    return dataclasses.replace(
        part, placement=pin.SE3.Identity(), size=(1.0, 1.0, 1.0), file=file, triangles=None
    )
