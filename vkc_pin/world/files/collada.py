"""Reads the surface of COLLADA files: all geometry that the file's scene shows.

Read are <triangles>, <polylist>, <polygons> with holes, <tristrips> and <trifans> of every
material, all transformations of nodes, <instance_node>, and the geometry of skins and morphs in
the shape in which they were bound. Lines have no surface. As in RViz and Gazebo, the unit counts
and the upward axis does not: descriptions of robots are made for these.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.files.documents import read_bytes
from vkc_pin.world.files.polygons import triangulate_polygon, triangulate_polygons
from vkc_pin.world.files.xml import find_line, make_element_error, parse_xml

_MAX_FILE_SIZE = 500_000_000  # [bytes], of which the parsed file takes about six times
# Triangles of a file: a few lines of nodes that show each other twice grow without bound.
_MAX_TRIANGLES = 5_000_000
_PRIMITIVES = ("polygons", "polylist", "triangles", "trifans", "tristrips")
_OTHER_GEOMETRY = ("brep", "spline")

Surface = tuple[Floats, Ints]  # vertices, shape (n, 3), and triangles, shape (m, 3)
_EMPTY: Surface = (np.empty((0, 3)), np.empty((0, 3), np.int64))


def read_collada(file: Path, submesh: str | None = None) -> tuple[Floats, Ints, float]:
    """Return vertices and triangles of a COLLADA file or of a submesh, and the file's unit [m].

    Args:
        file: The file.
        submesh: Name or identifier of nodes or of a geometry, to read these alone.

    Raises:
        InputError: The file is not valid, or refers to another file.
        UnknownNameError: The file has no such submesh, or refers to an identifier that it lacks.
    """
    return _Reader(file, submesh).read()


class _Reader:
    """Reads one file. Surfaces of nodes and geometries are made once, whoever shows them."""

    def __init__(self, file: Path, submesh: str | None) -> None:
        self.file = file
        self.submesh = submesh
        self.root = parse_xml(read_bytes(file, "COLLADA", _MAX_FILE_SIZE), file)
        self.is_found = submesh is None
        self.names = dict[str, None]()
        self._elements = dict[tuple[str, str], ElementTree.Element]()
        for element in self.root.iter():
            _, _, element.tag = element.tag.rpartition(":")
            identifier = element.get("id")
            if identifier:
                self._elements.setdefault((element.tag, identifier), element)
        self._surfaces = dict[int, Surface]()  # by the id of a node's or geometry's element
        self._positions = dict[int, Floats]()  # by the id of an accessor
        self._ancestors = list[ElementTree.Element]()  # nodes that are being read

    def read(self) -> tuple[Floats, Ints, float]:
        if self.root.tag != "COLLADA":
            raise InputError(
                "this is no COLLADA file",
                file=self.file,
                expected="an element <COLLADA>",
                got=f"<{self.root.tag}>",
            )
        unit = self._read_unit()
        surfaces = [self._read_node(node) for node in self._list_roots()]
        if not self.is_found:
            raise UnknownNameError("submesh", str(self.submesh), self.names, file=self.file)
        vertices, triangles = self._concatenate(surfaces)
        return vertices, triangles, unit

    def _read_unit(self) -> float:
        element = self.root.find("asset/unit")
        text = "1" if element is None else element.get("meter", "1")
        try:
            metres = float(text)
        except ValueError:
            metres = math.nan
        if not 0.0 < metres < math.inf:
            raise InputError(
                "not a unit",
                file=self.file,
                field="<unit> meter",
                expected="a positive number",
                got=text,
            )
        return metres

    def _list_roots(self) -> list[ElementTree.Element]:
        """Return the nodes of the scene; of a file without <scene>, those of its first one."""
        instance = self.root.find("scene/instance_visual_scene")
        if instance is not None:
            return self._find(instance, "url", "visual_scene").findall("node")
        scene = self.root.find("library_visual_scenes/visual_scene")
        return [] if scene is None else scene.findall("node")

    def _read_node(self, node: ElementTree.Element) -> Surface:
        """Return the surface of a node and of those below it, in the frame that contains it."""
        if id(node) in self._surfaces:
            return self._surfaces[id(node)]
        if node in self._ancestors:
            raise make_element_error(
                self.file, node, "a node shows itself", field="node", got=node.get("id", "")
            )
        self._ancestors.append(node)
        surfaces = list[Surface]()
        for child in node:
            if child.tag == "node":
                surfaces.append(self._read_node(child))
            elif child.tag == "instance_node":
                surfaces.append(self._read_node(self._find(child, "url", "node")))
            elif child.tag in ("instance_geometry", "instance_controller"):
                surfaces.append(self._read_instance(node, child))
        self._ancestors.pop()
        own_surface = self._concatenate(surfaces)
        surface = _transform(own_surface, self._read_placement(node))
        self._surfaces[id(node)] = surface
        return surface

    def _read_instance(self, node: ElementTree.Element, instance: ElementTree.Element) -> Surface:
        """Return the geometry or controller that a node shows; nothing if not asked for."""
        bound = np.eye(4)
        if instance.tag == "instance_geometry":
            geometry = self._find(instance, "url", "geometry")
        else:
            geometry, bound = self._find_skinned(self._find(instance, "url", "controller"))
        names = [node.get("name"), node.get("id"), geometry.get("name"), geometry.get("id")]
        self.names.update(dict.fromkeys(name for name in names if name))
        if self.submesh is not None and self.submesh not in names:
            return _EMPTY
        self.is_found = True
        if id(geometry) not in self._surfaces:
            self._surfaces[id(geometry)] = self._read_geometry(geometry)
        return _transform(self._surfaces[id(geometry)], bound)

    def _find_skinned(self, controller: ElementTree.Element) -> tuple[ElementTree.Element, Floats]:
        """Return the geometry of a skin or morph, and the matrix with which it was bound."""
        bound = np.eye(4)
        visited = list[ElementTree.Element]()
        while controller.tag == "controller":
            if controller in visited:
                raise make_element_error(self.file, controller, "a controller controls itself")
            visited.append(controller)
            kinds = [child for child in controller if child.tag in ("skin", "morph")]
            if not kinds:
                raise make_element_error(
                    self.file, controller, "a controller without <skin> or <morph>"
                )
            kind = kinds[0]
            matrix = kind.find("bind_shape_matrix")
            if matrix is not None:
                bound = bound @ self._read_floats(matrix, 16).reshape(4, 4)
            controller = self._find(kind, "source", "geometry", "controller")
        return controller, bound

    def _read_placement(self, node: ElementTree.Element) -> Floats:
        """Return the product of a node's transformations, shape (4, 4)."""
        placement = np.eye(4)
        for element in node:
            if element.tag == "skew":
                raise make_element_error(
                    self.file,
                    element,
                    "this transformation is not supported",
                    field="<skew>",
                    expected=", ".join(_TRANSFORMATIONS),
                )
            if element.tag in _TRANSFORMATIONS:
                count, make = _TRANSFORMATIONS[element.tag]
                placement = placement @ make(self._read_floats(element, count))
        return placement

    def _read_geometry(self, geometry: ElementTree.Element) -> Surface:
        surfaces = list[Surface]()
        for mesh in geometry:
            if mesh.tag in _OTHER_GEOMETRY or mesh.get("convex_hull_of") is not None:
                raise make_element_error(
                    self.file,
                    mesh,
                    "this geometry is not supported",
                    field=geometry.get("id"),
                    expected="<mesh>",
                    got=f"<{mesh.tag}>",
                )
            if mesh.tag in ("mesh", "convex_mesh"):
                for element in mesh:
                    if element.tag in _PRIMITIVES:
                        surfaces.append(self._read_primitive(mesh, element))
        return self._concatenate(surfaces)

    def _read_primitive(self, mesh: ElementTree.Element, primitive: ElementTree.Element) -> Surface:
        inputs = primitive.findall("input")
        sources = [one for one in inputs if one.get("semantic") in ("VERTEX", "POSITION")]
        if not sources:
            return _EMPTY
        positions = self._read_positions(mesh, sources[0])
        offset = self._read_count(sources[0], "offset", 0)
        width = 1 + max(self._read_count(element, "offset", 0) for element in inputs)

        def read_corners(element: ElementTree.Element) -> Ints:
            """Return the vertices that a list of indices, `width` for each corner, names."""
            indices = self._read_integers(element)
            if len(indices) % width:
                raise self._make_count_error(element, f"{width} for each corner", len(indices))
            corners = indices[offset::width]
            self._check_range(element, corners, len(positions))
            return corners

        _, no_triangles = _EMPTY
        triangles = [no_triangles]
        for element in primitive:
            if element.tag == "ph":
                outline_and_holes = (*element.findall("p"), *element.findall("h"))
                rings = [read_corners(ring) for ring in outline_and_holes]
                triangles.append(triangulate_polygon(positions, rings))
            elif element.tag == "p":
                triangles += self._divide(primitive, positions, read_corners(element))
        return positions, np.concatenate(triangles)

    def _divide(
        self, primitive: ElementTree.Element, positions: Floats, corners: Ints
    ) -> Iterator[Ints]:
        """Yield the triangles of the corners in a <p> of a primitive."""
        if primitive.tag == "polygons":
            yield triangulate_polygons(positions, corners[None])
        elif primitive.tag == "polylist":
            element = primitive.find("vcount")
            counts = np.empty(0, np.int64) if element is None else self._read_integers(element)
            if counts.sum() != len(corners) or (counts < 0).any():
                expected = f"{counts.sum()} corners as in <vcount>"
                raise self._make_count_error(primitive, expected, len(corners))
            starts = np.cumsum(counts) - counts
            # All polygons of the same number of corners at once.
            for count in np.unique(counts):
                first = starts[counts == count]
                polygons = corners[first[:, None] + np.arange(count)]
                yield triangulate_polygons(positions, polygons)
        elif primitive.tag == "triangles":
            if len(corners) % 3:
                raise self._make_count_error(primitive, "3 corners each", len(corners))
            yield corners.reshape(-1, 3)
        else:
            triangles = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
            if primitive.tag == "trifans":
                # All triangles of a fan share its first corner.
                triangles[:, 0] = corners[0] if len(corners) else 0
            else:
                # Every other triangle of a strip has the opposite orientation.
                triangles[1::2] = triangles[1::2, [1, 0, 2]]
            yield triangles

    def _read_positions(self, mesh: ElementTree.Element, source: ElementTree.Element) -> Floats:
        """Return the vertices that an <input> of a mesh refers to, in the file's unit."""
        element = self._find(source, "source", "vertices", "source", within=mesh)
        if element.tag == "vertices":
            positions = element.find("input[@semantic='POSITION']")
            if positions is None:
                raise make_element_error(self.file, element, "vertices without positions")
            element = self._find(positions, "source", "source", within=mesh)
        accessor = element.find("technique_common/accessor")
        if accessor is None:
            raise make_element_error(self.file, element, "a <source> without <accessor>")
        if id(accessor) in self._positions:
            return self._positions[id(accessor)]
        array = self._find(accessor, "source", "float_array", "int_array", within=mesh)
        numbers = self._read_floats(array)
        # Numbers without a name are to be skipped.
        columns = list[int]()
        for k, parameter in enumerate(accessor.findall("param")):
            if parameter.get("name"):
                columns.append(k)
        if not columns:
            columns = [0, 1, 2]
        stride = self._read_count(accessor, "stride", 1)
        offset = self._read_count(accessor, "offset", 0)
        if len(columns) < 3 or stride <= columns[2]:
            raise make_element_error(
                self.file,
                accessor,
                "positions that are not three numbers each",
                field="<accessor>",
                expected="x, y and z",
            )
        # Position k is at offset + stride · k + columns. As many are available as fit.
        available = max(len(numbers) - offset + stride - 1 - columns[2], 0) // stride
        count = min(self._read_count(accessor, "count", available), available)
        rows = offset + stride * np.arange(count)
        positions = numbers[rows[:, None] + np.array(columns[:3])]
        self._positions[id(accessor)] = positions
        return positions

    def _concatenate(self, surfaces: list[Surface]) -> Surface:
        count = sum(len(faces) for _, faces in surfaces)
        if count > _MAX_TRIANGLES:
            raise InputError(
                "too many triangles",
                file=self.file,
                expected=f"at most {_MAX_TRIANGLES}",
                got=count,
            )
        no_vertices, no_triangles = _EMPTY
        all_vertices = [no_vertices]
        all_triangles = [no_triangles]
        start = 0  # index of the first vertex of a surface among all
        for vertices, triangles in surfaces:
            if len(triangles):
                all_vertices.append(vertices)
                all_triangles.append(triangles + start)
                start += len(vertices)
        return np.concatenate(all_vertices), np.concatenate(all_triangles)

    def _find(
        self,
        element: ElementTree.Element,
        attribute: str,
        *kinds: str,
        within: ElementTree.Element | None = None,
    ) -> ElementTree.Element:
        """Return the element of some `kinds` that an attribute such as url="#name" names.

        Some programs use the same identifiers in every mesh: elements `within` one come first.
        """
        address = element.get(attribute, "")
        _, mark, name = address.rpartition("#")
        if not mark or not address.startswith("#"):
            raise make_element_error(
                self.file,
                element,
                "not a reference within the file",
                field=f"<{element.tag}> {attribute}",
                expected="#name",
                got=address,
            )
        for kind in kinds:
            inner = () if within is None else within.iter(kind)
            for candidate in inner:
                if candidate.get("id") == name:
                    return candidate
            if (kind, name) in self._elements:
                return self._elements[kind, name]
        known = [known_name for kind, known_name in self._elements if kind in kinds]
        raise UnknownNameError(
            kinds[0], name, known, file=self.file, line=find_line(element), field=f"<{element.tag}>"
        )

    def _read_floats(self, element: ElementTree.Element, count: int | None = None) -> Floats:
        words = (element.text or "").split()
        try:
            numbers = np.array(words, np.float64)
        except ValueError as error:
            raise make_element_error(
                self.file, element, f"not numbers: {error}", field=f"<{element.tag}>"
            ) from error
        if count is not None and len(numbers) != count:
            raise self._make_count_error(element, f"{count} numbers", len(numbers))
        return numbers

    def _read_integers(self, element: ElementTree.Element) -> Ints:
        words = (element.text or "").split()
        try:
            return np.array(words, np.int64)
        except (ValueError, OverflowError) as error:
            wrong_words = [word for word in words if not word.lstrip("+-").isdecimal()]
            raise make_element_error(
                self.file,
                element,
                "not indices",
                field=f"<{element.tag}>",
                expected="whole numbers",
                got=wrong_words[0] if wrong_words else str(error),
            ) from error

    def _check_range(self, element: ElementTree.Element, corners: Ints, count: int) -> None:
        """Raise if corners are not among `count` vertices."""
        outside = corners[(corners < 0) | (corners >= count)]
        if len(outside):
            raise make_element_error(
                self.file,
                element,
                "no such vertex",
                field=f"<{element.tag}>",
                expected=f"0 to {count - 1}",
                got=int(outside[0]),
            )

    def _read_count(self, element: ElementTree.Element, attribute: str, default: int) -> int:
        text = element.get(attribute, str(default))
        if not text.strip().isdecimal():
            raise make_element_error(
                self.file,
                element,
                "not a number",
                field=f"<{element.tag}> {attribute}",
                expected="a whole number of at least 0",
                got=text,
            )
        return int(text)

    def _make_count_error(
        self, element: ElementTree.Element, expected: str, got: int
    ) -> InputError:
        return make_element_error(
            self.file, element, "wrong number", field=f"<{element.tag}>", expected=expected, got=got
        )


def _transform(surface: Surface, placement: Floats) -> Surface:
    """Return a surface after a transformation; mirrored triangles still face outward."""
    vertices, faces = surface
    linear = placement[:3, :3]
    if np.linalg.det(linear) < 0.0:
        faces = faces[:, ::-1]
    return vertices @ linear.T + placement[:3, 3], faces


def _make_translation(numbers: Floats) -> Floats:
    matrix = np.eye(4)
    matrix[:3, 3] = numbers
    return matrix


def _make_rotation(numbers: Floats) -> Floats:
    """Return the rotation about an axis by an angle in degrees (Rodrigues' formula)."""
    length = np.linalg.norm(numbers[:3])
    x, y, z = numbers[:3] / (length or 1.0)
    # R = I + sin θ [a]× + (1 − cos θ) [a]×², with [a]× v = a × v
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.deg2rad(numbers[3])
    matrix = np.eye(4)
    matrix[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
    return matrix


def _make_look_at(numbers: Floats) -> Floats:
    """Return the placement of a camera at a point that looks along −z at another, with y up."""
    eye, target, up = numbers.reshape(3, 3)
    z = eye - target
    x = np.cross(up, z)
    y = np.cross(z, x)
    matrix = np.eye(4)
    for column, axis in enumerate((x, y, z)):
        matrix[:3, column] = axis / (np.linalg.norm(axis) or 1.0)
    matrix[:3, 3] = eye
    return matrix


def _make_scaling(numbers: Floats) -> Floats:
    return np.diag([*numbers, 1.0])


# Number of values and matrix of each transformation of a node
_TRANSFORMATIONS: dict[str, tuple[int, Callable[[Floats], Floats]]] = {
    "matrix": (16, lambda numbers: numbers.reshape(4, 4)),
    "translate": (3, _make_translation),
    "rotate": (4, _make_rotation),
    "scale": (3, _make_scaling),
    "lookat": (9, _make_look_at),
}
