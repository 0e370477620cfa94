"""Reads URDF files: the text for Pinocchio's own reader, and the shapes of links for coal."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import coal
import numpy as np
import trimesh

from .plan import NotJudged
from .poses import Poses, make_pose, rotate_rpy

__all__ = ["Shape", "Urdf", "load_mesh_hull", "make_solid", "read_urdf"]


@dataclass(frozen=True)
class Shape:
    """A convex solid on a link, with a ball and a box around it.

    `place` is its placement in the link's frame; `centre` and `half` are the box in the shape's own
    frame, `radius` that of the ball around its centre [m].
    """

    link: str
    solid: Any
    place: Poses
    centre: np.ndarray
    half: np.ndarray
    radius: float

    @classmethod
    def make(cls, link: str, body: Any, place: Poses) -> Shape:
        if isinstance(body, coal.Convex):
            corners = np.array(body.points())
            low, high = corners.min(axis=0), corners.max(axis=0)
            centre, half = (low + high) / 2, (high - low) / 2
            return cls(
                link,
                body,
                place,
                centre,
                half,
                float(np.linalg.norm(corners - centre, axis=1).max()),
            )
        if isinstance(body, coal.Box):
            half = np.array(body.halfSide)
            radius = float(np.linalg.norm(half))
        elif isinstance(body, coal.Sphere):
            half, radius = np.full(3, body.radius), body.radius
        elif isinstance(body, coal.Capsule):
            radius = body.halfLength + body.radius
            half = np.array([body.radius, body.radius, radius])
        else:
            half, radius = (
                np.array([body.radius, body.radius, body.halfLength]),
                float(np.hypot(body.radius, body.halfLength)),
            )
        return cls(link, body, place, np.zeros(3), half, radius)


def load_mesh_hull(file: Path, scale: np.ndarray) -> coal.Convex:
    """Return the convex hull of a mesh file."""
    if not file.is_file():
        raise FileNotFoundError(file)
    if file.suffix.lower() == ".dae":  # for which trimesh wants another package
        loaded = coal.MeshLoader().load(str(file), np.ones(3))
        points = np.array(loaded.vertices())
    else:
        points = np.asarray(trimesh.load(file, force="mesh", skip_materials=True).vertices)
    hull = trimesh.convex.convex_hull(_thicken(points * scale))
    if np.bincount(hull.faces.ravel()).max() > 255:
        raise NotJudged(f"{file.name}: a corner with more neighbours than coal can hold")
    corners, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    corners.extend(np.asarray(hull.vertices, float))
    faces.extend(coal.Triangle(*face) for face in hull.faces.tolist())
    return coal.Convex(corners, faces)


def _thicken(points: np.ndarray) -> np.ndarray:
    """Return the points of a flat sheet as a plate 1 mm thick; others unchanged."""
    axes = np.linalg.svd(np.cov(points.T))[2]
    widths = [np.ptp(points @ axis) for axis in axes]
    for axis, width in zip(axes, widths, strict=True):
        if width <= 1e-5 * max(widths):
            points = np.vstack([points + half * axis for half in (-5e-4, 5e-4)])
    return points


def make_solid(kind: str, about: dict[str, Any]) -> Any:
    """Return the coal shape of a description with `size`, `radius` and `length`."""
    if kind == "box":
        return coal.Box(*map(float, about["size"]))
    if kind == "sphere":
        return coal.Sphere(float(about["radius"]))
    made = {"cylinder": coal.Cylinder, "capsule": coal.Capsule}[kind]
    return made(float(about["radius"]), float(about["length"]))


def _parse_numbers(text: str | None, default: tuple[float, ...]) -> np.ndarray:
    return np.array(default if text is None else [float(part) for part in text.split()])


def read_urdf(path: Path) -> Urdf:
    """Return a URDF file, whose hulls are made once as long as it does not change."""
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
        """The root link."""
        children = {joint.find("child").get("link") for joint in self.joints.values()}
        return next(link for link in self.links if link not in children)

    def path_to(self, link: str) -> list[str]:
        """Return the joints from the root to a link."""
        above = {joint.find("child").get("link"): name for name, joint in self.joints.items()}
        found: list[str] = []
        while link in above:
            found.insert(0, above[link])
            link = self.joints[above[link]].find("parent").get("link")
        return found

    def kind(self, joint: str) -> str:
        return str(self.joints[joint].get("type"))

    def moves(self, joint: str) -> bool:
        return self.kind(joint) in ("revolute", "continuous", "prismatic")

    def effort(self, joint: str) -> float:
        """Return the effort limit of a joint; 0: not given."""
        limit = self.joints[joint].find("limit")
        return 0.0 if limit is None else float(limit.get("effort", 0.0))

    def weight(self, link: str) -> tuple[float, np.ndarray, np.ndarray]:
        """Return mass [kg], centre of mass [m] and central inertia [kg·m²] in the link's frame."""
        inertial = next(
            item for item in self.root.findall("link") if item.get("name") == link
        ).find("inertial")
        if inertial is None:
            return 0.0, np.zeros(3), np.zeros((3, 3))
        origin, about = inertial.find("origin"), inertial.find("inertia").attrib
        i = {key: float(about[key]) for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")}
        tensor = np.array(
            [
                [i["ixx"], i["ixy"], i["ixz"]],
                [i["ixy"], i["iyy"], i["iyz"]],
                [i["ixz"], i["iyz"], i["izz"]],
            ]
        )
        turn = (
            np.eye(3)
            if origin is None
            else rotate_rpy(*_parse_numbers(origin.get("rpy"), (0.0, 0.0, 0.0)))
        )
        centre = (
            np.zeros(3) if origin is None else _parse_numbers(origin.get("xyz"), (0.0, 0.0, 0.0))
        )
        return float(inertial.find("mass").get("value")), centre, turn @ tensor @ turn.T

    def limits(self, joint: str) -> tuple[float, float, float]:
        """Return lower, upper and velocity limit; infinite where there are none."""
        limit = self.joints[joint].find("limit")
        about = {} if limit is None else {key: float(value) for key, value in limit.attrib.items()}
        low, high = (
            (about.get("lower", 0.0), about.get("upper", 0.0))
            if self.kind(joint) != "continuous"
            else (-np.inf, np.inf)
        )
        return low, high, about.get("velocity", np.inf)

    def mimics(self, joint: str) -> tuple[str, float, float] | None:
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
        """All collision shapes."""
        found = []
        for link in self.root.findall("link"):
            for element in link.findall("collision"):
                geometry = element.find("geometry")
                assert geometry is not None
                (shape,) = list(geometry)[:1]
                if shape.tag == "mesh":
                    body = load_mesh_hull(
                        self._file(shape.get("filename", "")),
                        _parse_numbers(shape.get("scale"), (1.0, 1.0, 1.0)),
                    )
                else:
                    about: dict[str, Any] = dict(shape.attrib)
                    body = make_solid(shape.tag, {**about, "size": about.get("size", "").split()})
                origin = element.find("origin")
                given = {} if origin is None else origin.attrib
                angles = _parse_numbers(given.get("rpy"), (0.0, 0.0, 0.0))
                place = make_pose(
                    _parse_numbers(given.get("xyz"), (0.0, 0.0, 0.0)), rotate_rpy(*angles)
                )
                found.append(Shape.make(link.get("name", ""), body, place))
        return found

    def _file(self, address: str) -> Path:
        if not address.startswith("package://"):
            plain = Path(address.removeprefix("file://"))
            return plain if plain.is_absolute() else self.path.parent / plain
        package, _, inside = address.removeprefix("package://").partition("/")
        for folder in [*(above / package for above in self.path.parents), *self.path.parents[:2]]:
            if (folder / inside).is_file():
                return folder / inside
        raise NotJudged(f"{self.path.name}: no mesh {address}")
