"""Reads URDF files: geometry, and Pinocchio models of objects without a root joint."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.kinematic_tree import check_tree, parse_numbers, simplify_tree
from vkc_pin.world.files.meshes import load_convex, load_mesh, make_bvh
from vkc_pin.world.files.resources import find_mesh_file
from vkc_pin.world.files.xml import make_element_error, read_xml

if TYPE_CHECKING:
    import trimesh


Colour = tuple[float, float, float, float]
_LIGHT_GREY: Colour = (0.9, 0.9, 0.9, 1.0)
# Shapes of a kind that become one model: the time in which Pinocchio's models grow is proportional
# to the third power of their number.
_MAX_SHAPES = 1000
_JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed")


@dataclass(frozen=True)
class UrdfShape:
    """A <visual> or <collision> element.

    Attributes:
        link: Its link.
        name: `<link>_<k>` for the k-th element of that kind of the link.
        placement: Placement in the link's frame.
        kind: "box", "sphere", "cylinder", "capsule" or "mesh".
        size: Edge lengths of a box, radius of a sphere, radius and length of a cylinder or capsule
            [m]; scale of a mesh.
        file: The mesh file.
        colour: Red, green, blue, opacity, or None.
    """

    link: str
    name: str
    placement: pin.SE3
    kind: str
    size: tuple[float, ...]
    _: KW_ONLY
    file: Path | None = None
    colour: Colour | None = None

    def make_solid(self) -> coal.CollisionGeometry:
        """Return the element as a coal shape in its own frame; meshes become convex hulls."""
        if self.file is not None:
            return load_convex(self.file, self.size, about=self.link)
        kinds = {
            "box": coal.Box,
            "sphere": coal.Sphere,
            "cylinder": coal.Cylinder,
            "capsule": coal.Capsule,
        }
        return kinds[self.kind](*self.size)

    def make_mesh(self) -> trimesh.Trimesh:
        """Return its triangles in the link's frame [m]; 64 tangent planes replace round sides."""
        import trimesh

        if self.file is not None:
            mesh = load_mesh(self.file, self.size)
        elif self.kind == "box":
            mesh = trimesh.creation.box(self.size)
        elif self.kind == "sphere":
            (radius,) = self.size
            mesh = trimesh.creation.icosphere(subdivisions=3, radius=1.005 * radius)
        else:
            radius, length = self.size
            # Sides of the polygon touch the circle.
            corner_radius = radius / np.cos(np.pi / 64)
            if self.kind == "capsule":
                mesh = trimesh.creation.capsule(height=length, radius=corner_radius, count=[64, 64])
            else:
                mesh = trimesh.creation.cylinder(corner_radius, height=length, sections=64)
        return mesh.apply_transform(self.placement.homogeneous)


@dataclass(frozen=True, eq=False)
class UrdfFile:
    """A URDF file: text, XML, and folders of packages for `package://` addresses."""

    path: Path
    text: str
    root: ElementTree.Element
    packages: Mapping[str, Path] = field(default_factory=dict)

    def __repr__(self) -> str:
        counts = f"{len(self.links)} links, {len(self.root.findall('joint'))} joints"
        return f"<UrdfFile {self.path}: {counts}>"

    @property
    def links(self) -> tuple[str, ...]:
        """The names of the links, in the file's order."""
        return tuple(link.get("name", "") for link in self.root.findall("link"))

    def read_shapes(self, kind: str) -> list[UrdfShape]:
        """Return all elements of `kind`, "visual" or "collision"."""
        colours = dict[str, Colour]()
        # Of several materials of one name, the first one counts.
        for material in reversed(list(self.root.iter("material"))):
            colour = self._read_colour(material)
            if colour is not None:
                colours[material.get("name", "")] = colour
        shapes = []
        for link in self.root.findall("link"):
            name = link.get("name", "")
            for index, element in enumerate(link.findall(kind)):
                shapes.append(self._read_shape(name, f"{name}_{index}", element, colours))
        return shapes

    def read_shapes_for_model(self, kind: str) -> list[UrdfShape]:
        """Return the elements of a kind for one model; see `read_shapes`."""
        shapes = self.read_shapes(kind)
        if len(shapes) > _MAX_SHAPES:
            raise InputError(
                f"too many <{kind}> elements",
                file=self.path,
                expected=f"at most {_MAX_SHAPES}",
                got=len(shapes),
            )
        return shapes

    def resolve(self, address: str) -> Path:
        """Return the file of a mesh's address; see `find_mesh_file`."""
        return find_mesh_file(address, self.path, self.packages)

    def _read_shape(
        self, link: str, name: str, element: ElementTree.Element, colours: Mapping[str, Colour]
    ) -> UrdfShape:
        geometry = element.find("geometry")
        shape = None if geometry is None else geometry.find("*")
        if shape is None:
            raise make_element_error(
                self.path,
                element,
                "an element without geometry",
                field=name,
                expected="<geometry> with a shape",
            )
        origin = element.find("origin")
        placement = pin.SE3.Identity()
        if origin is not None:
            position = self._parse_numbers(origin, "xyz", 3, "0 0 0", name)
            angles = self._parse_numbers(origin, "rpy", 3, "0 0 0", name)
            placement = pin.SE3(_compute_rotation(*angles), np.array(position))
        colour = None
        material = element.find("material")
        if material is not None:
            colour = self._read_colour(material) or colours.get(material.get("name", ""))
        if shape.tag == "mesh":
            file = self.resolve(shape.get("filename", ""))
            scale = self._parse_numbers(shape, "scale", 3, "1 1 1", name)
            return UrdfShape(link, name, placement, "mesh", scale, file=file, colour=colour)
        if shape.tag == "box":
            size = self._parse_numbers(shape, "size", 3, None, name)
        elif shape.tag == "sphere":
            size = self._parse_numbers(shape, "radius", 1, None, name)
        elif shape.tag in ("cylinder", "capsule"):
            radius = self._parse_numbers(shape, "radius", 1, None, name)
            length = self._parse_numbers(shape, "length", 1, None, name)
            size = radius + length
        else:
            raise make_element_error(
                self.path,
                element,
                "this shape is not supported",
                field=name,
                expected="box, sphere, cylinder, capsule or mesh",
                got=shape.tag,
            )
        if min(size) <= 0.0:
            raise make_element_error(
                self.path,
                element,
                "a shape without volume",
                field=name,
                expected="sizes above 0",
                got=size,
            )
        return UrdfShape(link, name, placement, shape.tag, size, colour=colour)

    def _read_colour(self, material: ElementTree.Element) -> Colour | None:
        colour = material.find("color")
        if colour is None or colour.get("rgba") is None:
            return None
        name = material.get("name", "material")
        red, green, blue, opacity = self._parse_numbers(colour, "rgba", 4, None, name)
        return (red, green, blue, opacity)

    def _parse_numbers(
        self, element: ElementTree.Element, key: str, count: int, default: str | None, where: str
    ) -> tuple[float, ...]:
        return parse_numbers(self.path, element, key, count, default=default, where=where)


def read_urdf(
    path: str | Path, packages: Mapping[str, Path] | None = None, *, text: str | None = None
) -> UrdfFile:
    """Read a URDF file.

    Args:
        path: The file.
        packages: Package name → folder. Others are searched in the folders above the file.
        text: Contents, if not to be read from `path`; meshes are relative to `path` all the same.
    """
    file = Path(path)
    text, root = read_xml(file, "URDF", text)
    check_tree(file, root)
    return UrdfFile(file.absolute(), text, root, dict(packages or {}))


def build_model(file: UrdfFile, *root: pin.JointModelPlanar | str) -> pin.Model:
    """Return the Pinocchio model of all links and joints of a URDF; it ignores effort limits.

    Args:
        file: The URDF.
        *root: A joint that carries the root link, and its name. Default: the root link is fixed.
    """
    text, without_velocity = simplify_tree(file.path, file.root)
    try:
        model = pin.buildModelFromXML(text, *root)
    except (ValueError, RuntimeError) as error:
        raise InputError(f"not a valid URDF: {error}", file=file.path) from error
    velocity = model.velocityLimit
    for j in range(1, model.njoints):
        if model.names[j] in without_velocity:
            joint = model.joints[j]
            velocity[joint.idx_v : joint.idx_v + joint.nv] = np.inf
    model.velocityLimit = velocity
    return model


def load_urdf(
    path: str | Path, *, text: str | None = None
) -> tuple[pin.Model, pin.GeometryModel, pin.GeometryModel]:
    """Return model, collision and visual geometry of a URDF; its root link's frame is the universe.

    Collision meshes become convex hulls.

    Args:
        path: The file.
        text: Contents, if they are not to be read from `path`.
    """
    file = read_urdf(path, text=text)
    for joint in file.root.findall("joint"):
        name = joint.get("name")
        kind = joint.get("type")
        if kind not in _JOINT_TYPES:
            problem = "this joint type is not supported"
            expected = ", ".join(_JOINT_TYPES)
            raise make_element_error(path, joint, problem, field=name, expected=expected, got=kind)
        # Pinocchio's parser would let it move on its own.
        if joint.find("mimic") is not None:
            problem = "joints that mimic others are not supported"
            raise make_element_error(path, joint, problem, field=name, expected="no <mimic>")
    model = build_model(file)
    collision = _build_geometry(model, file, "collision")
    visual = _build_geometry(model, file, "visual")
    if len(visual.geometryObjects) > 0 and len(collision.geometryObjects) == 0:
        raise InputError(
            "nothing in this URDF can collide",
            file=path,
            expected="<collision> elements",
            got="only <visual> ones",
        )
    return model, collision, visual


def _build_geometry(model: pin.Model, file: UrdfFile, kind: str) -> pin.GeometryModel:
    """Return the "visual" or "collision" shapes in the order of the model's frames."""

    def find_frame(shape: UrdfShape) -> int:
        return int(model.getFrameId(shape.link, pin.FrameType.BODY))

    geometry = pin.GeometryModel()
    for shape in sorted(file.read_shapes_for_model(kind), key=find_frame):
        index = find_frame(shape)
        link = model.frames[index]
        if kind == "visual" and shape.file is not None:
            solid = make_bvh(load_mesh(shape.file, shape.size))
        else:
            solid = shape.make_solid()
        placement = link.placement * shape.placement
        added = pin.GeometryObject(shape.name, link.parentJoint, index, placement, solid)
        added.meshColor = np.array(shape.colour or _LIGHT_GREY)
        added.overrideMaterial = shape.colour is not None
        # Viewers draw the file.
        if shape.file is not None:
            added.meshPath = str(shape.file)
            added.meshScale = np.array(shape.size)
        geometry.addGeometryObject(added)
    return geometry


def _compute_rotation(roll: float, pitch: float, yaw: float) -> Floats:
    """Return the rotation of fixed-axis angles [rad], equal to Pinocchio's parser bit for bit.

    It is the quaternion s + x i + y j + z k, the product of (w + c k), (v + b j) and (u + a i) with
    the sines a, b, c and the cosines u, v, w of half of roll, pitch and yaw.
    """
    a = math.sin(roll / 2.0)
    b = math.sin(pitch / 2.0)
    c = math.sin(yaw / 2.0)
    u = math.cos(roll / 2.0)
    v = math.cos(pitch / 2.0)
    w = math.cos(yaw / 2.0)
    x = a * v * w - u * b * c
    y = u * b * w + a * v * c
    z = u * v * c - a * b * w
    s = u * v * w + a * b * c
    norm = math.sqrt(x * x + y * y + z * z + s * s)
    return np.array(pin.Quaternion(s / norm, x / norm, y / norm, z / norm).matrix())
