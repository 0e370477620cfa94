"""Reads an object from an SDF file (http://sdformat.org/spec) with one model."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.objects.description import Description, Joint, Link, Part, make_inertia
from vkc_pin.world.files.documents import read_text
from vkc_pin.world.files.kinematic_tree import MOMENTS, parse_numbers
from vkc_pin.world.files.xml import find_line, parse_xml

__all__ = ["read_object_sdf"]

_NO_LIMIT = 1e15  # limits above this are none; SDF's default is 1e16
_BASE = "world"


def read_object_sdf(file: Path) -> Description:
    """Read the description of an object from an SDF file."""
    root = parse_xml(read_text(file, "SDF"), file)
    models = root.findall("model") or root.findall("world/model")
    if root.tag != "sdf" or len(models) != 1:
        got = f"<{root.tag}> with {len(models)} models"
        raise InputError(
            "the SDF does not hold exactly one model",
            file=file,
            expected="<sdf> with one <model>",
            got=got,
        )
    for nested in (*models[0].findall("model"), *models[0].findall("include")):
        problem = "nested models are not supported"
        raise InputError(
            problem,
            file=file,
            line=find_line(nested),
            field=nested.tag,
            expected="links and joints in one model",
        )
    return _Reader(file, models[0], float(root.get("version", "1.7").split(".")[1] or 0)).read()


class _Reader:
    def __init__(self, file: Path, model: ElementTree.Element, version: float) -> None:
        self.file, self.model, self.version = file, model, version
        self.elements = {
            element.get("name", ""): element
            for tag in ("link", "joint", "frame")
            for element in model.findall(tag)
        }
        self.notes = list[str]()
        self._found: dict[str, pin.SE3] = {}

    def read(self) -> Description:
        elements = self.model.findall("joint")
        joints = {self._read_text(joint, "child"): joint for joint in elements}
        names = [link.get("name", "") for link in self.model.findall("link")]
        if repeated := [name for name in names if names.count(name) > 1]:
            problem, name = "two links have the same name", repeated[0]
            raise InputError(problem, file=self.file, field=name, expected="a name for each link")
        for child, joint in joints.items():
            for link in (child, self._read_text(joint, "parent")):
                if link not in (*names, _BASE):
                    raise UnknownNameError(
                        "link",
                        link,
                        names,
                        file=self.file,
                        line=find_line(joint),
                        field=joint.get("name"),
                    )
        roots = [name for name in names if name not in joints]
        has_world_link = any(self._read_text(joint, "parent") == _BASE for joint in elements)
        if len(roots) + has_world_link != 1:
            got = ", ".join([*roots, *([_BASE] if has_world_link else [])]) or "a circle"
            raise InputError(
                "the links do not form one tree",
                file=self.file,
                field="model",
                expected="one tree",
                got=got,
            )
        # Link frames are moved to their joints, so that axes pass through origins.
        frames = {
            name: self.pose(joints[name].get("name", "") if name in joints else name)
            for name in names
        }
        links = dict[str, Link]()
        for name in names:
            visual, collision = (
                self._read_shapes(name, kind, frames[name]) for kind in ("visual", "collision")
            )
            links[name] = Link(name, visual, collision, self._read_inertia(name, frames[name]))
        if has_world_link:
            frames[_BASE], links = pin.SE3.Identity(), {_BASE: Link(_BASE), **links}
        return Description(
            self.file,
            links,
            {child: self._read_joint(child, joint, frames) for child, joint in joints.items()},
            tuple(self.notes),
        )

    def pose(self, name: str, visited: tuple[str, ...] = ()) -> pin.SE3:
        """Return the frame of a link, joint or frame in the model's frame."""
        if name in ("", "__model__", _BASE):
            return pin.SE3.Identity()
        if name not in self.elements:
            raise UnknownNameError("frame", name, self.elements, file=self.file)
        if name in visited:
            raise InputError(
                "frames form a cycle",
                file=self.file,
                field=name,
                got=" → ".join((*visited, name)),
            )
        if name not in self._found:
            element = self.elements[name]
            to = element.get("attached_to", "") if element.tag == "frame" else ""
            if element.tag == "joint":
                to = self._read_text(element, "child")
            self._found[name] = self._read_pose(element, to, (*visited, name))
        return self._found[name]

    def _read_pose(
        self, element: ElementTree.Element, default_frame: str, visited: tuple[str, ...] = ()
    ) -> pin.SE3:
        """Return the <pose> of an element in the model's frame."""
        pose = element.find("pose")
        if pose is None:
            return self.pose(default_frame, visited)
        text = ElementTree.Element("pose", {"numbers": pose.text or ""})
        values = parse_numbers(
            self.file,
            text,
            "numbers",
            6,
            default="0 0 0 0 0 0",
            where=element.get("name", element.tag),
        )
        angles = np.radians(values[3:]) if pose.get("degrees") == "true" else np.array(values[3:])
        return self.pose(pose.get("relative_to", default_frame), visited) * pin.SE3(
            pin.rpy.rpyToMatrix(*angles), np.array(values[:3])
        )

    def _read_joint(
        self, child: str, joint: ElementTree.Element, frames: dict[str, pin.SE3]
    ) -> Joint:
        name, kind = joint.get("name", ""), joint.get("type", "")
        parent = self._read_text(joint, "parent")
        axis, limits, velocity = np.array([0.0, 0.0, 1.0]), None, None
        resistance = dict.fromkeys(("damping", "friction"), 0.0)
        if kind not in ("fixed", "revolute", "continuous", "prismatic"):
            self.notes.append(f"joint '{name}' is {kind}: taken as fixed")
            kind = "fixed"
        element = joint.find("axis")
        if element is not None and kind != "fixed":
            axis = np.array(self._read_numbers(element, "xyz", 3, "0 0 1", name))
            xyz, expressed = element.find("xyz"), name
            if self.version < 7 and self._read_text(element, "use_parent_model_frame") in (
                "1",
                "true",
            ):
                expressed = "__model__"
            elif xyz is not None:
                expressed = xyz.get("expressed_in", name)
            axis = frames[child].rotation.T @ self.pose(expressed).rotation @ axis
            axis /= np.linalg.norm(axis)
            if (limit := element.find("limit")) is not None:
                low, high = (
                    self._read_numbers(limit, key, 1, default, name)[0]
                    for key, default in (("lower", "-1e16"), ("upper", "1e16"))
                )
                if max(abs(low), abs(high)) < _NO_LIMIT:
                    limits = min(low, high), max(low, high)
                velocity = self._read_numbers(limit, "velocity", 1, "-1", name)[0]
            if (dynamics := element.find("dynamics")) is not None:
                resistance = {
                    key: max(0.0, self._read_numbers(dynamics, key, 1, "0", name)[0])
                    for key in resistance
                }
        if kind == "revolute" and limits is None:
            kind = "continuous"
        return Joint(
            name=name,
            kind=kind,
            parent=parent,
            child=child,
            placement=frames[parent].inverse() * frames[child],
            axis=axis,
            limits=None if kind == "continuous" else limits,
            velocity=velocity if velocity is not None and velocity > 0.0 else None,
            **resistance,
        )

    def _read_shapes(self, link: str, kind: str, frame: pin.SE3) -> tuple[Part, ...]:
        parts = []
        for element in self.elements[link].findall(kind):
            name, geometry = element.get("name", ""), element.find("geometry")
            shape = next(iter(geometry), None) if geometry is not None else None
            placement = frame.inverse() * self._read_pose(element, link)
            colour = self._read_colour(element, name)
            if shape is not None and shape.tag == "mesh":
                file = self._find_mesh(shape, name)
                size = self._read_numbers(shape, "scale", 3, "1 1 1", name)
            elif shape is not None and shape.tag in ("box", "sphere", "cylinder", "capsule"):
                keys = {"box": (("size", 3),), "sphere": (("radius", 1),)}.get(
                    shape.tag, (("radius", 1), ("length", 1))
                )
                file = None
                size = tuple(
                    value
                    for key, count in keys
                    for value in self._read_numbers(shape, key, count, None, name)
                )
            else:
                content = "empty" if shape is None else shape.tag
                self.notes.append(f"{kind} '{name}' of link '{link}' is {content}: left out")
                continue
            settings: dict[str, Any] = {"size": size, "file": file, "colour": colour}
            parts.append(Part(name=name, placement=placement, kind=shape.tag, **settings))
        return tuple(parts)

    def _read_inertia(self, link: str, frame: pin.SE3) -> pin.Inertia:
        """Return a link's inertia; an incomplete <inertial> counts as none, with a note."""
        element = self.elements[link].find("inertial")
        if element is None:
            return pin.Inertia.Zero()
        moments = element.find("inertia")
        try:
            if element.find("mass") is None or moments is None:
                raise InputError("an <inertial> needs both <mass> and <inertia>", field=link)
            (mass,) = self._read_numbers(element, "mass", 1, None, link)
            entries = (self._read_numbers(moments, key, 1, "0", link)[0] for key in MOMENTS)
            return make_inertia(mass, entries, frame.inverse() * self._read_pose(element, link))
        except InputError as error:
            self.notes.append(f"link '{link}': {error}: its <inertial> counts as none")
            return pin.Inertia.Zero()

    def _read_colour(
        self, element: ElementTree.Element, name: str
    ) -> tuple[float, float, float, float] | None:
        material = element.find("material")
        if material is None or material.find("diffuse") is None:
            return None
        rgba = (material.findtext("diffuse") or "").split()
        values = self._read_numbers(material, "diffuse", len(rgba), None, name)
        red, green, blue, opacity = (*values, 1.0)[:4] if len(values) >= 3 else (0.8, 0.8, 0.8, 1.0)
        return red, green, blue, opacity

    def _find_mesh(self, shape: ElementTree.Element, name: str) -> Path:
        """Return a mesh file: beside the SDF, or `model://NAME/...` in a folder NAME above it."""
        uri = self._read_text(shape, "uri")
        inside = (
            uri.partition("://")[2]
            if uri.startswith(("model://", "package://"))
            else uri.removeprefix("file://")
        )
        folders = [self.file.resolve().parent, *self.file.resolve().parents]
        candidates = [folder / inside for folder in folders] + [
            folder / inside.partition("/")[2] for folder in folders[:2]
        ]
        for candidate in candidates:
            if candidate.is_file():
                return candidate
        raise InputError(
            "the mesh file does not exist",
            file=self.file,
            line=find_line(shape),
            field=name,
            expected="a mesh file",
            got=uri,
        )

    def _read_numbers(
        self, element: ElementTree.Element, key: str, count: int, default: str | None, where: str
    ) -> tuple[float, ...]:
        found = element.findtext(key)
        text = ElementTree.Element(element.tag, {} if found is None else {key: found})
        return parse_numbers(
            self.file, text, key, count, default=default, where=where, largest=1e308
        )

    def _read_text(self, element: ElementTree.Element, key: str) -> str:
        return (element.findtext(key) or "").strip()
