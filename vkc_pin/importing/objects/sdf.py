"""Reads the SDF of an object (Gazebo's format; http://sdformat.org/spec): one model, whose frames may refer to each other."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.objects.description import Description, Joint, Link, Part, make_inertia
from vkc_pin.world.files.documents import read_text
from vkc_pin.world.files.kinematic_tree import MOMENTS, numbers_of
from vkc_pin.world.files.xml import line_of, parse_xml

__all__ = ["read_object_sdf"]

_NO_LIMIT = 1e15  # SDF's own default is 1e16
_BASE = "world"


def read_object_sdf(file: Path) -> Description:
    """Return what an SDF file says about an object.

    Raises:
        InputError: It cannot be read, holds no model or several, or one made of others.
        UnknownNameError: It names a frame or link that does not exist.
    """
    root = parse_xml(read_text(file, "SDF"), file)
    models = root.findall("model") or root.findall("world/model")
    if root.tag != "sdf" or len(models) != 1:
        got = f"<{root.tag}> with {len(models)} models"
        raise InputError(
            "this is no SDF of one object", file=file, expected="<sdf> with one <model>", got=got
        )
    for nested in (*models[0].findall("model"), *models[0].findall("include")):
        problem = "a model made of other models is not supported"
        raise InputError(
            problem,
            file=file,
            line=line_of(nested),
            field=nested.tag,
            expected="links and joints in one model",
        )
    return _Reader(
        file, models[0], float(root.get("version", "1.7").split(".")[1] or 0)
    ).description()


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

    def description(self) -> Description:
        elements = self.model.findall("joint")
        joints = {self._text(joint, "child"): joint for joint in elements}
        names = [link.get("name", "") for link in self.model.findall("link")]
        if repeated := [name for name in names if names.count(name) > 1]:
            problem, name = "two links of one name", repeated[0]
            raise InputError(problem, file=self.file, field=name, expected="a name for each link")
        for child, joint in joints.items():
            for link in (child, self._text(joint, "parent")):
                if link not in (*names, _BASE):
                    raise UnknownNameError(
                        "link",
                        link,
                        names,
                        file=self.file,
                        line=line_of(joint),
                        field=joint.get("name"),
                    )
        roots = [name for name in names if name not in joints]
        grounded = any(self._text(joint, "parent") == _BASE for joint in elements)
        if len(roots) + grounded != 1:
            got = ", ".join([*roots, *([_BASE] if grounded else [])]) or "a circle"
            raise InputError(
                "links that nothing connects",
                file=self.file,
                field="model",
                expected="one tree",
                got=got,
            )
        # A link's frame becomes that of its joint, so that axes go through origins.
        frames = {
            name: self.pose(joints[name].get("name", "") if name in joints else name)
            for name in names
        }
        links = dict[str, Link]()
        for name in names:
            looks, solid = (
                self._parts(name, kind, frames[name]) for kind in ("visual", "collision")
            )
            links[name] = Link(name, looks, solid, self._inertia(name, frames[name]))
        if grounded:
            frames[_BASE], links = pin.SE3.Identity(), {_BASE: Link(_BASE), **links}
        return Description(
            self.file,
            links,
            {child: self._joint(child, joint, frames) for child, joint in joints.items()},
            tuple(self.notes),
        )

    def pose(self, name: str, asked: tuple[str, ...] = ()) -> pin.SE3:
        """Return the frame of a link, joint or frame in that of the model."""
        if name in ("", "__model__", _BASE):
            return pin.SE3.Identity()
        if name not in self.elements:
            raise UnknownNameError("frame", name, self.elements, file=self.file)
        if name in asked:
            raise InputError(
                "frames that refer to each other in a circle",
                file=self.file,
                field=name,
                got=" → ".join((*asked, name)),
            )
        if name not in self._found:
            element = self.elements[name]
            to = element.get("attached_to", "") if element.tag == "frame" else ""
            if element.tag == "joint":
                to = self._text(element, "child")
            self._found[name] = self._own(element, to, (*asked, name))
        return self._found[name]

    def _own(
        self, element: ElementTree.Element, otherwise: str, asked: tuple[str, ...] = ()
    ) -> pin.SE3:
        """Return what an element's <pose> says, in the frame of the model."""
        pose = element.find("pose")
        if pose is None:
            return self.pose(otherwise, asked)
        text = ElementTree.Element("pose", {"numbers": pose.text or ""})
        values = numbers_of(
            self.file,
            text,
            "numbers",
            6,
            default="0 0 0 0 0 0",
            where=element.get("name", element.tag),
        )
        angles = np.radians(values[3:]) if pose.get("degrees") == "true" else np.array(values[3:])
        return self.pose(pose.get("relative_to", otherwise), asked) * pin.SE3(
            pin.rpy.rpyToMatrix(*angles), np.array(values[:3])
        )

    def _joint(self, child: str, joint: ElementTree.Element, frames: dict[str, pin.SE3]) -> Joint:
        name, kind, parent = (
            joint.get("name", ""),
            joint.get("type", ""),
            self._text(joint, "parent"),
        )
        axis, limits, velocity = np.array([0.0, 0.0, 1.0]), None, None
        resists = dict.fromkeys(("damping", "friction"), 0.0)
        if kind not in ("fixed", "revolute", "continuous", "prismatic"):
            self.notes.append(f"joint '{name}' is {kind}: taken as fixed")
            kind = "fixed"
        stated = joint.find("axis")
        if stated is not None and kind != "fixed":
            axis = np.array(self._numbers(stated, "xyz", 3, "0 0 1", name))
            direction, old = (
                stated.find("xyz"),
                self.version < 7
                and (stated.findtext("use_parent_model_frame") or "").strip() in ("1", "true"),
            )
            expressed = (
                "__model__"
                if old
                else direction.get("expressed_in", name)
                if direction is not None
                else name
            )
            axis = frames[child].rotation.T @ self.pose(expressed).rotation @ axis
            axis /= np.linalg.norm(axis)
            if (limit := stated.find("limit")) is not None:
                low, high = (
                    self._numbers(limit, key, 1, default, name)[0]
                    for key, default in (("lower", "-1e16"), ("upper", "1e16"))
                )
                limits = (
                    (min(low, high), max(low, high))
                    if max(abs(low), abs(high)) < _NO_LIMIT
                    else None
                )
                velocity = self._numbers(limit, "velocity", 1, "-1", name)[0]
            if (dynamics := stated.find("dynamics")) is not None:
                resists = {
                    key: max(0.0, self._numbers(dynamics, key, 1, "0", name)[0]) for key in resists
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
            **resists,
        )

    def _parts(self, link: str, kind: str, frame: pin.SE3) -> tuple[Part, ...]:
        parts = []
        for element in self.elements[link].findall(kind):
            name, geometry = element.get("name", ""), element.find("geometry")
            shape = next(iter(geometry), None) if geometry is not None else None
            placement = frame.inverse() * self._own(element, link)
            colour = self._colour(element, name)
            if shape is not None and shape.tag == "mesh":
                file, scale = (
                    self._file(shape, name),
                    self._numbers(shape, "scale", 3, "1 1 1", name),
                )
                parts.append(
                    Part(
                        name=name,
                        placement=placement,
                        kind="mesh",
                        size=scale,
                        file=file,
                        colour=colour,
                    )
                )
            elif shape is not None and shape.tag in ("box", "sphere", "cylinder", "capsule"):
                keys = {"box": (("size", 3),), "sphere": (("radius", 1),)}.get(
                    shape.tag, (("radius", 1), ("length", 1))
                )
                size = tuple(
                    value
                    for key, count in keys
                    for value in self._numbers(shape, key, count, None, name)
                )
                parts.append(
                    Part(name=name, placement=placement, kind=shape.tag, size=size, colour=colour)
                )
            else:
                self.notes.append(
                    f"{kind} '{name}' of link '{link}' is {'empty' if shape is None else shape.tag}: left out"
                )
        return tuple(parts)

    def _inertia(self, link: str, frame: pin.SE3) -> pin.Inertia:
        """Return what a link weighs; nothing if its <inertial> is not whole, which is noted."""
        stated = self.elements[link].find("inertial")
        if stated is None:
            return pin.Inertia.Zero()
        moments = stated.find("inertia")
        try:
            if stated.find("mass") is None or moments is None:
                raise InputError("an <inertial> without both <mass> and <inertia>", field=link)
            (mass,) = self._numbers(stated, "mass", 1, None, link)
            entries = (self._numbers(moments, key, 1, "0", link)[0] for key in MOMENTS)
            return make_inertia(mass, entries, frame.inverse() * self._own(stated, link))
        except InputError as error:
            self.notes.append(f"link '{link}': {error}: its <inertial> counts as none")
            return pin.Inertia.Zero()

    def _colour(
        self, element: ElementTree.Element, name: str
    ) -> tuple[float, float, float, float] | None:
        material = element.find("material")
        if material is None or material.find("diffuse") is None:
            return None
        rgba = (material.findtext("diffuse") or "").split()
        values = self._numbers(material, "diffuse", len(rgba), None, name)
        red, green, blue, opacity = (*values, 1.0)[:4] if len(values) >= 3 else (0.8, 0.8, 0.8, 1.0)
        return red, green, blue, opacity

    def _file(self, shape: ElementTree.Element, name: str) -> Path:
        """Return a mesh's file: beside the SDF, or `model://NAME/...` in a folder of that name around it."""
        uri = self._text(shape, "uri")
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
            "there is no such mesh",
            file=self.file,
            line=line_of(shape),
            field=name,
            expected="a mesh file",
            got=uri,
        )

    def _numbers(
        self, element: ElementTree.Element, key: str, count: int, default: str | None, where: str
    ) -> tuple[float, ...]:
        found = element.findtext(key)
        text = ElementTree.Element(element.tag, {} if found is None else {key: found})
        return numbers_of(self.file, text, key, count, default=default, where=where, largest=1e308)

    def _text(self, element: ElementTree.Element, key: str) -> str:
        return (element.findtext(key) or "").strip()
