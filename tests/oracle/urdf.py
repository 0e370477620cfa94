"""Reads URDF files: text for the parser of Pinocchio, and shapes of links for coal."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import coal
import numpy as np
import trimesh

from tests.helpers.assimp import read_triangles

from .plan import NotJudged
from .poses import Poses, make_pose, rotate_rpy

__all__ = ["Points", "Shape", "Urdf", "load_mesh_hull", "make_solid", "read_urdf"]


@dataclass(frozen=True)
class Points:
    """Measured points, shape (n, 3) [m], each a ball of a radius [m]."""

    points: np.ndarray
    radius: float


@dataclass(frozen=True)
class Shape:
    """A convex solid on a link, with a bounding box and a bounding sphere.

    `placement` is that of the solid in the link's frame. `centre` and `half` are the centre and the
    half sides of the box in the solid's frame; `radius` is that of the sphere around `centre` [m].
    """

    link: str
    solid: Any
    placement: Poses
    centre: np.ndarray
    half: np.ndarray
    radius: float

    @classmethod
    def make(cls, link: str, solid: Any, placement: Poses) -> Shape:
        if isinstance(solid, coal.Convex):
            corners = np.array(solid.points())
            low, high = corners.min(axis=0), corners.max(axis=0)
            centre, half = (low + high) / 2, (high - low) / 2
            return cls(
                link,
                solid,
                placement,
                centre,
                half,
                float(np.linalg.norm(corners - centre, axis=1).max()),
            )
        if isinstance(solid, Points):
            low, high = solid.points.min(axis=0), solid.points.max(axis=0)
            centre, half = (low + high) / 2, (high - low) / 2 + solid.radius
            return cls(link, solid, placement, centre, half, float(np.linalg.norm(half)))
        if isinstance(solid, coal.Box):
            half = np.array(solid.halfSide)
            radius = float(np.linalg.norm(half))
        elif isinstance(solid, coal.Sphere):
            half, radius = np.full(3, solid.radius), solid.radius
        elif isinstance(solid, coal.Capsule):
            radius = solid.halfLength + solid.radius
            half = np.array([solid.radius, solid.radius, radius])
        else:
            half = np.array([solid.radius, solid.radius, solid.halfLength])
            radius = float(np.hypot(solid.radius, solid.halfLength))
        return cls(link, solid, placement, np.zeros(3), half, radius)


def load_mesh_hull(file: Path, scale: np.ndarray) -> coal.Convex:
    """Return the convex hull of a mesh file."""
    if not file.is_file():
        raise FileNotFoundError(file)
    if file.suffix.lower() == ".dae":  # trimesh needs an optional dependency
        points = read_triangles(file).reshape(-1, 3)
    else:
        points = np.asarray(trimesh.load(file, force="mesh", skip_materials=True).vertices)
    if file.suffix.lower() in (".gltf", ".glb"):  # y is up
        points = points[:, [0, 2, 1]] * (1.0, -1.0, 1.0)
    hull = trimesh.convex.convex_hull(_thicken(points * scale))
    if np.bincount(hull.faces.ravel()).max() > 255:
        raise NotJudged(f"{file.name}: a vertex has more neighbours than coal supports")
    corners, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    corners.extend(np.asarray(hull.vertices, float))
    faces.extend(coal.Triangle(*face) for face in hull.faces.tolist())
    return coal.Convex(corners, faces)


def _thicken(points: np.ndarray) -> np.ndarray:
    """Return points with flat sheets thickened to plates of 1 mm."""
    axes = np.linalg.svd(np.cov(points.T))[2]
    widths = [np.ptp(points @ axis) for axis in axes]
    for axis, width in zip(axes, widths, strict=True):
        if width <= 1e-5 * max(widths):
            points = np.vstack([points + half * axis for half in (-5e-4, 5e-4)])
    return points


def make_solid(kind: str, description: dict[str, Any]) -> Any:
    """Return the coal shape with the `size`, `radius` and `length` of a description."""
    if kind == "box":
        return coal.Box(*map(float, description["size"]))
    if kind == "sphere":
        return coal.Sphere(float(description["radius"]))
    make_shape = {"cylinder": coal.Cylinder, "capsule": coal.Capsule}[kind]
    return make_shape(float(description["radius"]), float(description["length"]))


def _parse_numbers(text: str | None, default: tuple[float, ...]) -> np.ndarray:
    return np.array(default if text is None else [float(part) for part in text.split()])


def read_urdf(path: Path) -> Urdf:
    """Return a URDF file, cached until it changes."""
    return _read(path.resolve(), path.stat().st_mtime_ns)


@lru_cache(maxsize=64)
def _read(path: Path, _: int) -> Urdf:
    return Urdf(path)


class Urdf:
    """A URDF file."""

    def __init__(self, path: Path, text: str | None = None) -> None:
        self.path = path
        self.text = path.read_text(encoding="utf-8") if text is None else text
        self.root = ElementTree.fromstring(self.text)

    @cached_property
    def joints(self) -> dict[str, ElementTree.Element]:
        return {joint.get("name", ""): joint for joint in self.root.findall("joint")}

    @cached_property
    def links(self) -> list[str]:
        return [link.get("name", "") for link in self.root.findall("link")]

    @cached_property
    def base(self) -> str:
        """Name of the root link."""
        children = {joint.find("child").get("link") for joint in self.joints.values()}
        return next(link for link in self.links if link not in children)

    def find_joint_path(self, link: str) -> list[str]:
        """Return the joints from the root to a link."""
        parents = {joint.find("child").get("link"): name for name, joint in self.joints.items()}
        path: list[str] = []
        while link in parents:
            path.insert(0, parents[link])
            link = self.joints[parents[link]].find("parent").get("link")
        return path

    def get_joint_type(self, joint: str) -> str:
        return str(self.joints[joint].get("type"))

    def is_movable(self, joint: str) -> bool:
        return self.get_joint_type(joint) in ("revolute", "continuous", "prismatic")

    def get_effort_limit(self, joint: str) -> float:
        """Return the effort limit of a joint, or 0 without one."""
        limit = self.joints[joint].find("limit")
        return 0.0 if limit is None else float(limit.get("effort", 0.0))

    def get_inertial(self, link: str) -> tuple[float, np.ndarray, np.ndarray]:
        """Return mass [kg], centre of mass [m] and central inertia [kg·m²] in the link's frame."""
        inertial = next(
            item for item in self.root.findall("link") if item.get("name") == link
        ).find("inertial")
        if inertial is None:
            return 0.0, np.zeros(3), np.zeros((3, 3))
        origin, attributes = inertial.find("origin"), inertial.find("inertia").attrib
        i = {key: float(attributes[key]) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")}
        tensor = np.array(
            [
                [i["ixx"], i["ixy"], i["ixz"]],
                [i["ixy"], i["iyy"], i["iyz"]],
                [i["ixz"], i["iyz"], i["izz"]],
            ]
        )
        rotation = (
            np.eye(3)
            if origin is None
            else rotate_rpy(*_parse_numbers(origin.get("rpy"), (0.0, 0.0, 0.0)))
        )
        centre = (
            np.zeros(3) if origin is None else _parse_numbers(origin.get("xyz"), (0.0, 0.0, 0.0))
        )
        return float(inertial.find("mass").get("value")), centre, rotation @ tensor @ rotation.T

    def get_limits(self, joint: str) -> tuple[float, float, float]:
        """Return the lower, upper and velocity limits, with the defaults of URDF."""
        limit = self.joints[joint].find("limit")
        attributes = (
            {} if limit is None else {key: float(value) for key, value in limit.attrib.items()}
        )
        low, high = (
            (attributes.get("lower", 0.0), attributes.get("upper", 0.0))
            if self.get_joint_type(joint) != "continuous"
            else (-np.inf, np.inf)
        )
        return low, high, attributes.get("velocity", np.inf)

    def get_mimic(self, joint: str) -> tuple[str, float, float] | None:
        """Return the leading joint, multiplier and offset of a mimic joint."""
        mimic = self.joints[joint].find("mimic")
        if mimic is None:
            return None
        return (
            str(mimic.get("joint")),
            float(mimic.get("multiplier", 1.0)),
            float(mimic.get("offset", 0.0)),
        )

    @cached_property
    def shapes(self) -> list[Shape]:
        """Collision shapes of all links."""
        shapes = []
        for link in self.root.findall("link"):
            for element in link.findall("collision"):
                geometry = element.find("geometry")
                assert geometry is not None
                (shape,) = list(geometry)[:1]
                if shape.tag == "mesh":
                    solid = load_mesh_hull(
                        self._find_mesh(shape.get("filename", "")),
                        _parse_numbers(shape.get("scale"), (1.0, 1.0, 1.0)),
                    )
                else:
                    description: dict[str, Any] = dict(shape.attrib)
                    solid = make_solid(
                        shape.tag, {**description, "size": description.get("size", "").split()}
                    )
                origin = element.find("origin")
                attributes = {} if origin is None else origin.attrib
                angles = _parse_numbers(attributes.get("rpy"), (0.0, 0.0, 0.0))
                placement = make_pose(
                    _parse_numbers(attributes.get("xyz"), (0.0, 0.0, 0.0)), rotate_rpy(*angles)
                )
                shapes.append(Shape.make(link.get("name", ""), solid, placement))
        return shapes

    def _find_mesh(self, address: str) -> Path:
        if not address.startswith("package://"):
            path = Path(address.removeprefix("file://"))
            return path if path.is_absolute() else self.path.parent / path
        package, _, relative = address.removeprefix("package://").partition("/")
        for folder in [*(above / package for above in self.path.parents), *self.path.parents[:2]]:
            if (folder / relative).is_file():
                return folder / relative
        raise NotJudged(f"{self.path.name}: no mesh {address}")
