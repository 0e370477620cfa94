"""Reads planning scenes of MoveIt (`.scene`), the text that `saveGeometryToStream` writes.

Each object has a pose, shapes with poses in its frame, and subframes. Older files have neither the
pose nor subframes.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.importing.description import Colour, Description, Joint, Link, Part
from vkc_pin.utils.arrays import MAX_COORDINATE, Floats
from vkc_pin.world.files.documents import read_text

if TYPE_CHECKING:
    import trimesh

_MAX_SIZE = 20_000_000  # [bytes] of a file
_SIZES = {
    "box": ("x", "y", "z"),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "cone": ("radius", "length"),
}
"""Type of a shape with sizes → their names [m]."""
_TYPES = (*_SIZES, "mesh", "plane")
_SIDES = 48  # facets of a cone
_NORM_TOLERANCE = 1e-3  # of lengths of quaternions, and of normals of the floor
_FLOOR_TOLERANCE = 1e-6  # [m]
_WORLD = "world"
_WORD = re.compile(r"\S+")


def read_moveit_scene(file: Path) -> Description:
    """Read the objects of a planning scene as links that are fixed in the world.

    Meshes and cones become triangles. A horizontal plane at z = 0 is the floor of a scene, other
    planes are refused. Subframes are left out, with a note.

    Args:
        file: The file.

    Raises:
        InputError: The text ends early, or a value or a shape is invalid.
    """
    return _Reader(file).read()


class _Reader:
    def __init__(self, file: Path) -> None:
        self._file = file
        self._text = read_text(file, "MoveIt .scene", _MAX_SIZE)
        self._place = 0  # index of the next character
        self._begin = 0  # index of the last word
        self._field = ""
        self._notes = list[str]()

    def read(self) -> Description:
        """Return the description."""
        self._read_rest_of_line()  # the name of the scene
        self._has_poses = _has_poses(self._text[self._place :])
        objects = dict[str, tuple[pin.SE3, tuple[Part, ...]]]()
        while True:
            self._field = "the next object"
            marker = self._read_word("* and a name, or . at the end")
            if marker == ".":
                break
            if marker != "*":
                raise self._make_error(
                    "unknown marker", "* and a name, or . at the end of the scene", marker
                )
            name = self._read_rest_of_line().strip()
            self._field = name
            if not name or name in objects:
                raise self._make_error("not a new name", "a name for each object", repr(name))
            objects[name] = self._read_object(name)
        return self._make_description(objects)

    def _read_object(self, name: str) -> tuple[pin.SE3, tuple[Part, ...]]:
        """Return the pose of an object and its shapes."""
        placement = self._read_pose() if self._has_poses else pin.SE3.Identity()
        parts = list[Part]()
        colour: Colour | None = None
        for number in range(self._read_count("number of shapes")):
            self._field = f"{name}, shape {number + 1}"
            part = self._read_shape(placement)
            red, green, blue, opacity = self._read_numbers(4, "colour").clip(0.0, 1.0).tolist()
            # MoveIt stores one colour for each object, and none for 0 0 0 0.
            if max(red, green, blue, opacity) > 0.0:
                colour = (red, green, blue, opacity)
            if part is not None:
                parts.append(part)
        self._field = name
        if self._has_poses:
            self._skip_subframes(name)
        coloured = tuple(replace(part, colour=colour) for part in parts)
        return placement, coloured

    def _read_shape(self, placement: pin.SE3) -> Part | None:
        """Return a shape in the frame of its object; None for a plane that is the floor.

        Args:
            placement: Pose of the object.
        """
        kind = self._read_word("the type of a shape")
        if kind not in _TYPES:
            raise UnknownNameError(
                "type of shape",
                kind,
                _TYPES,
                file=self._file,
                line=self._find_line(),
                field=self._field,
            )
        size: tuple[float, ...] = (1.0, 1.0, 1.0)
        triangles = None
        plane = np.zeros(4)
        if kind == "mesh":
            triangles = self._read_mesh()
        elif kind == "plane":
            plane = self._read_numbers(4, "a, b, c and d")
        else:
            size = tuple(self._read_sizes(kind))
        pose = self._read_pose()
        if kind == "plane":
            self._check_floor(plane, placement * pose)
            return None
        if kind == "cone":
            triangles = _make_cone(*size)
            size = (1.0, 1.0, 1.0)
        return Part(
            name="",
            placement=pose,
            kind="mesh" if kind == "cone" else kind,
            size=size,
            triangles=triangles,
        )

    def _check_floor(self, plane: Floats, placement: pin.SE3) -> None:
        """Refuse a plane ax + by + cz + d = 0 that is not the floor, and note the others."""
        norm = np.linalg.norm(plane[:3])
        normal = placement.rotation @ plane[:3] / (norm or 1.0)
        height = float((placement.translation @ normal) - plane[3] / (norm or 1.0))
        is_level = abs(normal[2]) > 1.0 - _NORM_TOLERANCE**2
        if not is_level or abs(height) > _FLOOR_TOLERANCE:
            raise self._make_error(
                "a plane is no obstacle of a scene",
                "a box instead, or the plane z = 0, which is the floor",
                f"plane {' '.join(f'{value:g}' for value in plane)}",
            )
        self._notes.append(f"{self._field} is the plane z = 0: the floor of the scene")

    def _read_sizes(self, kind: str) -> list[float]:
        names = _SIZES[kind]
        values = self._read_numbers(len(names), f"{' and '.join(names)} of the {kind}")
        if values.min() <= 0.0:
            raise self._make_error("not a size", "numbers above 0", values.tolist())
        return values.tolist()

    def _read_mesh(self) -> trimesh.Trimesh:
        import trimesh

        vertex_count = self._read_count("number of vertices")
        triangle_count = self._read_count("number of triangles")
        vertices = self._read_numbers(3 * vertex_count, "vertices")
        corners = self._read_numbers(3 * triangle_count, "triangles")
        is_index = (corners == np.floor(corners)) & (corners >= 0) & (corners < vertex_count)
        if not triangle_count or not is_index.all():
            wrong = corners[~is_index]
            expected = f"triangles of vertices from 0 to {vertex_count - 1}"
            got = float(wrong[0]) if len(wrong) else "no triangle"
            raise self._make_error("not a mesh", expected, got)
        faces = corners.astype(int).reshape(-1, 3)
        return trimesh.Trimesh(vertices.reshape(-1, 3), faces, process=False)

    def _skip_subframes(self, name: str) -> None:
        names = list[str]()
        for _ in range(self._read_count("number of subframes")):
            names.append(self._read_word("the name of a subframe"))
            self._read_pose()
        if names:
            self._notes.append(f"left out the subframes of {name}: {', '.join(names)}")

    def _read_pose(self) -> pin.SE3:
        values = self._read_numbers(7, "position and quaternion (x, y, z, w)")
        norm = math.hypot(*values[3:])
        if abs(norm - 1.0) > _NORM_TOLERANCE:
            expected = "a quaternion x y z w of length 1"
            raise self._make_error("not a rotation", expected, values[3:].tolist())
        rotation = pin.Quaternion(values[3:] / norm).matrix()
        return pin.SE3(rotation, values[:3].copy())

    def _read_numbers(self, count: int, what: str) -> Floats:
        """Return the next numbers, shape (count,)."""
        # Each takes two characters.
        if 2 * count > len(self._text) - self._place + 1:
            raise self._make_error("the text ends early", what, "its end")
        values = np.empty(count)
        for k in range(count):
            word = self._read_word(what)
            try:
                values[k] = float(word)
            except ValueError:
                raise self._make_error("not a number", what, word) from None
            if not abs(values[k]) <= MAX_COORDINATE:
                raise self._make_error("out of range", what, word)
        return values

    def _read_count(self, what: str) -> int:
        word = self._read_word(what)
        if not (word.isascii() and word.isdigit() and len(word) < 10):
            raise self._make_error("not a count", what, word)
        return int(word)

    def _read_word(self, what: str) -> str:
        match = _WORD.search(self._text, self._place)
        if match is None:
            self._begin = len(self._text)
            raise self._make_error("the text ends early", what, "its end")
        self._begin, self._place = match.span()
        return match.group()

    def _read_rest_of_line(self) -> str:
        end = self._text.find("\n", self._place)
        end = len(self._text) if end < 0 else end
        rest = self._text[self._place : end]
        self._place = end + 1
        return rest

    def _find_line(self) -> int:
        return self._text.count("\n", 0, self._begin) + 1

    def _make_error(self, problem: str, expected: object, got: object) -> InputError:
        return InputError(
            problem,
            file=self._file,
            line=self._find_line(),
            field=self._field,
            expected=expected,
            got=got,
        )

    def _make_description(
        self, objects: dict[str, tuple[pin.SE3, tuple[Part, ...]]]
    ) -> Description:
        root = _WORLD
        while root in objects:
            root += "_"
        links = {root: Link(root)}
        joints = dict[str, Joint]()
        for name, (placement, parts) in objects.items():
            if not parts:
                # What remains of an object that is the floor.
                continue
            links[name] = Link(name, parts, parts)
            joints[name] = Joint(
                name=name, kind="fixed", parent=root, child=name, placement=placement
            )
        return Description(
            self._file,
            links,
            joints,
            notes=tuple(self._notes),
            format="MoveIt .scene",
            is_world=True,
        )


def _has_poses(text: str) -> bool:
    """Return whether objects have poses and subframes, as MoveIt decides it once for a file.

    The line after that of the first object is its pose, or else the number of its shapes.

    Args:
        text: The file without its first line.
    """
    lines = iter(text.split("\n"))
    for line in lines:
        if line.startswith("*"):
            return " " in next(lines, "").strip()
    return False


def _make_cone(radius: float, length: float) -> trimesh.Trimesh:
    """Return a cone along z, whose origin is halfway between base and tip."""
    import trimesh

    cone = trimesh.creation.cone(radius, length, sections=_SIDES)
    return cone.apply_translation((0.0, 0.0, -0.5 * length))
