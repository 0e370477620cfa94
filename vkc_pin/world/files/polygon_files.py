"""Prepares files of polygons for trimesh, which takes every polygon for convex.

Concave polygons are divided into triangles here: trimesh would make fans of them, which cover more
than the polygon. It would also misread some dialects of OBJ files.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.files.polygons import triangulate_polygons

# Faces of OBJ files whose corners count from the end, or from 0
_NOT_FROM_ONE = re.compile(rb"\nf[^\n]*[ /][-0]")
# Comments behind the numbers of a line
_COMMENTED = re.compile(rb"\n(?:v|vt|vn|f)[ \t][^\n#]*#")
_POLYGON = re.compile(rb"\nf(?: +[0-9/]+){4}")  # a face with more than three corners
_OFF_HEADER = re.compile(r"\s*(?:ST)?C?N?OFF\b")


def is_plain_obj(data: bytes) -> bool:
    """Return whether trimesh reads an OBJ file as it is."""
    return (
        not data.startswith((codecs.BOM_UTF8, b" "))
        and not any(text in data for text in (b"\t", b"\n ", b"\\\n", b"\\\r"))
        and data.count(b"\r") == data.count(b"\r\n")
        and not _NOT_FROM_ONE.search(data)
        and not _POLYGON.search(data)
        and not _COMMENTED.search(b"\n" + data)
    )


def normalize_obj(data: bytes, file: Path, submesh: str | None) -> bytes:
    """Return an OBJ file with plain lines, faces that count from 1, and convex polygons.

    Args:
        data: Contents of the file, in UTF-8 or a superset of ASCII.
        file: The file, for messages.
        submesh: Name of an object or group, to keep its faces alone.
    """
    data = data.removeprefix(codecs.BOM_UTF8)
    data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    data = data.replace(b"\\\n", b" ")
    counts = {b"v": 0, b"vt": 0, b"vn": 0}
    wanted = None if submesh is None else submesh.encode()
    lines = list[bytes]()
    names = dict[str, None]()
    vertices = list[list[bytes]]()
    polygons = dict[int, list[bytes]]()  # corners of faces with more than three, by line
    is_kept = wanted is None
    is_found = wanted is None
    for number, line in enumerate(data.split(b"\n"), 1):
        key, *values = line.split() or [b""]
        if key in (*counts, b"f"):
            values = line.partition(b"#")[0].split()[1:]
        if key in counts:
            counts[key] += 1
            if key == b"v":
                vertices.append(values[:3])
        elif key in (b"o", b"g"):
            # A group may have several names.
            own_names = {b" ".join(values), *values}
            for name in sorted(own_names):
                names[name.decode(errors="replace")] = None
            is_kept = wanted is None or wanted in own_names
        elif key == b"f":
            if not is_kept:
                continue
            is_found = True
            values = [_count_from_start(corner, counts, file, number) for corner in values]
            if len(values) > 3:
                polygons[len(lines)] = values
        lines.append(b" ".join([key, *values]))
    if not is_found:
        raise UnknownNameError("submesh", str(submesh), names, file=file)
    for place, faces in _divide_faces(vertices, polygons).items():
        lines[place] = b"\n".join(faces)
    return b"\n".join(lines)


def _count_from_start(corner: bytes, counts: Mapping[bytes, int], file: Path, line: int) -> bytes:
    """Return a corner of a face, such as `-3/-3/1`, with indices that count from 1."""
    indices = list[bytes]()
    for text, count in zip(corner.split(b"/"), counts.values(), strict=False):
        if text.startswith(b"-"):
            text = b"%d" % (count + 1 + int(text))
        if not indices and int(text) < 1:
            raise InputError(
                "no such vertex",
                file=file,
                line=line,
                field="f",
                expected=f"1 to {count}, or -1 to {-count} from the last",
                got=corner.decode(errors="replace"),
            )
        indices.append(text)
    return b"/".join(indices)


def _divide_faces(
    vertices: Sequence[Sequence[bytes]], polygons: Mapping[int, Sequence[bytes]]
) -> dict[int, list[bytes]]:
    """Return the lines of triangles that replace polygons, by the polygon's line."""
    if not polygons:
        return {}
    positions = np.array(vertices, float)
    divided = dict[int, list[bytes]]()
    for line, corners in polygons.items():
        indices = np.array([int(corner.partition(b"/")[0]) - 1 for corner in corners])
        # trimesh reports vertices that do not exist.
        if indices.max() >= len(positions):
            continue
        triangles = triangulate_polygons(positions[indices], np.arange(len(indices))[None])
        divided[line] = []
        for triangle in triangles:
            triangle_corners = [corners[k] for k in triangle]
            divided[line].append(b" ".join([b"f", *triangle_corners]))
    return divided


def read_off(data: bytes, file: Path) -> tuple[Floats, Ints]:
    """Return vertices and triangles of an OFF file in text; colours and normals are skipped.

    Raises:
        InputError: The file is not one, or its numbers do not fit together.
    """
    lines = [line.partition("#")[0] for line in data.decode("latin-1").splitlines()]
    text = "\n".join(lines)
    header = _OFF_HEADER.match(text)
    if header is None:
        expected = "OFF in its first line"
        raise InputError("this is no OFF file", file=file, expected=expected, got=text[:20])
    rows = list[list[str]]()
    for line in text[header.end() :].splitlines():
        words = line.split()
        if words:
            rows.append(words)
    # The first row has the numbers of vertices and faces, and of edges, which nothing needs.
    vertex_count, face_count = (int(word) for word in rows[0][:2])
    first_face = 1 + vertex_count
    vertices = np.array([row[:3] for row in rows[1:first_face]], float)
    faces = list[Ints]()
    for row in rows[first_face : first_face + face_count]:
        corner_count = int(row[0])
        faces.append(np.array(row[1 : 1 + corner_count], np.int64))
    if len(vertices) != vertex_count or len(faces) != face_count:
        raise InputError(
            "wrong number of lines",
            file=file,
            expected=f"{vertex_count} vertices and {face_count} faces",
            got=f"{len(vertices)} and {len(faces)}",
        )
    return vertices.reshape(-1, 3), divide_polygons(vertices, faces, file)


def divide_polygons(vertices: Floats, polygons: Sequence[Ints], file: Path) -> Ints:
    """Return the triangles of polygons, shape (k, 3); see `triangulate_polygons`.

    Args:
        vertices: Shape (n, 3).
        polygons: Vertices of each polygon.
        file: File of the polygons, for messages.
    """
    by_count = dict[int, list[Ints]]()
    for polygon in polygons:
        same_count = by_count.setdefault(len(polygon), [])
        same_count.append(polygon)
    found = [np.empty((0, 3), np.int64)]
    for same_count in by_count.values():
        corners = np.array(same_count, np.int64)
        outside = corners[(corners < 0) | (corners >= len(vertices))]
        if len(outside):
            expected = f"0 to {len(vertices) - 1}"
            raise InputError("no such vertex", file=file, expected=expected, got=int(outside[0]))
        found.append(triangulate_polygons(vertices, corners))
    return np.concatenate(found)
