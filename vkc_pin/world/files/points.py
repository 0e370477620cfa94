"""Reads measured points from PLY, PCD and OctoMap files.

The point formats have a text header that states the numbers of each point. Nothing else than these
numbers is read; each count is compared with the size of the file before memory is allocated.
"""

from __future__ import annotations

import base64
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vkc_pin.errors import InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.documents import read_bytes
from vkc_pin.world.files.octomap import read_octomap
from vkc_pin.world.files.resources import check_path

DEFAULT_RADIUS = 0.01
"""Radius of points whose file states none [m]."""
MAX_POINTS = 2_000_000
"""Largest number of points of an obstacle: as text, about 32 MB in the file of a scene or plan."""
MAX_FILE_SIZE = 400_000_000  # [bytes]; a million points with colours and normals take 40 MB
_MAX_HEADER_SIZE = 10_000  # [bytes]
_MAX_ROWS = 20_000_000  # points, before the bound of a scene
_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_PCD_KINDS = {"F": "f", "I": "i", "U": "u"}
_AXES = ("x", "y", "z")
_NUMBERS = np.dtype("<f4")  # of points in files of scenes and plans


class PointFile(NamedTuple):
    """Points of a file.

    Attributes:
        points: Finite points in the frame of the file, shape (n, 3) [m].
        dropped: Number of points that were left out since a coordinate is not finite.
        radius: Radius that the file implies, of an octree [m]; None if it implies none.
    """

    points: Floats
    dropped: int = 0
    radius: float | None = None


class _Format(NamedTuple):
    """How the points of a file are stored: names and types of their numbers, and how many."""

    names: list[str]
    types: list[str]
    row_count: int
    encoding: str


def read_points(path: str | Path) -> PointFile:
    """Read the points of a file, in its own frame.

    PLY files may be "ascii" or "binary_little_endian"; PCD files "ascii", "binary" or
    "binary_compressed". The VIEWPOINT of a PCD file is the pose of the sensor, and is not applied.
    Occupied cells of an OctoMap (.bt, .ot) become points at the centres of cells of the map's
    resolution, whose `radius` is half of a cell's diagonal: they contain the occupied cells.

    Raises:
        InputError: There is no such file, it is of another format, damaged or too large, or has no
            finite point.
    """
    file = check_path(path, "path", "the path of a PLY, PCD, .bt or .ot file")
    kind = file.suffix.lower()
    if kind not in (".ply", ".pcd", ".bt", ".ot"):
        expected = "a file with the ending .ply, .pcd, .bt or .ot"
        raise InputError("unknown format of points", file=file, expected=expected, got=kind)
    if not file.is_file():
        raise InputError("there is no such file", file=file, field="path", expected="a file")
    content = read_bytes(file, "file of points", MAX_FILE_SIZE)
    radius = None
    if kind in (".bt", ".ot"):
        points, radius = read_octomap(content, file)
    elif kind == ".ply":
        points = _read_ply(content, file)
    else:
        points = _read_pcd(content, file)
    is_finite = np.isfinite(points).all(axis=1)
    if not is_finite.any():
        raise InputError("no finite points", file=file, expected="points", got=len(points))
    return PointFile(points[is_finite], int(np.count_nonzero(~is_finite)), radius)


def _split_header(content: bytes, last: str, file: Path) -> tuple[list[list[str]], bytes]:
    """Return the words of each header line, the `last` of which begins so, and what follows."""
    lines = list[list[str]]()
    position = 0
    while position < min(len(content), _MAX_HEADER_SIZE):
        end = content.find(b"\n", position)
        if end < 0:
            break
        text = content[position:end].decode("ascii", "replace")
        lines.append(text.split())
        position = end + 1
        if lines[-1] and lines[-1][0] == last:
            return lines, content[position:]
    raise InputError("the header does not end", file=file, expected=f"a line with '{last}'")


def _parse_count(text: str, file: Path, field: str) -> int:
    count = int(text) if text.isascii() and text.isdecimal() and len(text) < 12 else -1
    if not 0 <= count <= _MAX_ROWS:
        expected = f"a number from 0 to {_MAX_ROWS}"
        raise InputError(
            "invalid number of points", file=file, field=field, expected=expected, got=text
        )
    return count


def _read_ply(content: bytes, file: Path) -> Floats:
    """Return the points of a PLY file, shape (n, 3) [m]."""
    lines, data = _split_header(content, "end_header", file)
    if lines[0] != ["ply"]:
        raise InputError("not a PLY file", file=file, line=1, expected="ply")
    encoding = ""
    element = ""
    count = 0
    names = list[str]()
    types = list[str]()
    for number, words in enumerate(lines, start=1):
        match words:
            case ["format", encoding, *_]:
                pass
            case ["element", "vertex", text]:
                if element:
                    expected = "vertex as first element"
                    raise InputError(
                        "another element comes before the points",
                        file=file,
                        line=number,
                        expected=expected,
                        got=element,
                    )
                element = "vertex"
                count = _parse_count(text, file, "element vertex")
            case ["element", other, *_]:
                element = element or other
                # Of later elements nothing is read.
                if element == "vertex":
                    break
            case ["property", kind, name] if element == "vertex" and kind in _PLY_TYPES:
                names.append(name)
                types.append(_PLY_TYPES[kind])
            case ["property", kind, *_] if element == "vertex":
                raise InputError(
                    "unknown type of a property of points",
                    file=file,
                    line=number,
                    expected=", ".join(_PLY_TYPES),
                    got=kind,
                )
    encodings = {"ascii": "ascii", "binary_little_endian": "binary"}
    if encoding not in encodings:
        expected = " or ".join(encodings)
        raise InputError(
            "unknown encoding", file=file, field="format", expected=expected, got=encoding
        )
    return _read_rows(data, _Format(names, types, count, encodings[encoding]), file)


def _read_pcd(content: bytes, file: Path) -> Floats:
    """Return the points of a PCD file, shape (n, 3) [m]; its VIEWPOINT is not applied."""
    lines, data = _split_header(content, "DATA", file)
    header = {words[0]: words[1:] for words in lines if words and not words[0].startswith("#")}
    names = header.get("FIELDS", [])
    sizes = header.get("SIZE", [])
    kinds = header.get("TYPE", [])
    repeats = header.get("COUNT", ["1"] * len(names))
    if not len(names) == len(sizes) == len(kinds) == len(repeats):
        expected = "as many of SIZE, TYPE and COUNT"
        raise InputError(
            "incomplete fields", file=file, field="FIELDS", expected=expected, got=names
        )
    types = list[str]()
    unique_names = list[str]()
    for name, size, kind, repeat in zip(names, sizes, kinds, repeats, strict=True):
        known_sizes = ("4", "8") if kind == "F" else ("1", "2", "4", "8")
        if kind not in _PCD_KINDS or size not in known_sizes or not repeat.isdecimal():
            got = f"TYPE {kind}, SIZE {size}, COUNT {repeat}"
            expected = "TYPE F, I or U, and SIZE 1, 2, 4 or 8"
            raise InputError("unknown type", file=file, field=name, expected=expected, got=got)
        for k in range(_parse_count(repeat, file, f"COUNT {name}")):
            if len(types) >= _MAX_HEADER_SIZE:
                raise InputError("too many fields", file=file, field="COUNT", got=repeat)
            unique_names.append(name if k == 0 else f"{name}.{k}")
            types.append(_PCD_KINDS[kind] + size)
    count = _parse_count(" ".join(header.get("POINTS", ["none"])), file, "POINTS")
    encoding = " ".join(header["DATA"])
    if encoding not in ("ascii", "binary", "binary_compressed"):
        expected = "ascii, binary or binary_compressed"
        raise InputError(
            "unknown encoding", file=file, field="DATA", expected=expected, got=encoding
        )
    return _read_rows(data, _Format(unique_names, types, count, encoding), file)


def _read_rows(data: bytes, form: _Format, file: Path) -> Floats:
    """Return the points in the data of a file, shape (n, 3) [m]."""
    for axis in _AXES:
        if form.names.count(axis) != 1:
            expected = "x, y and z once each"
            raise InputError("no coordinates", file=file, expected=expected, got=form.names)
    columns = [form.names.index(axis) for axis in _AXES]
    if form.encoding == "ascii":
        return _read_text(data, form, columns, file)
    row_size = sum(int(kind[1:]) for kind in form.types)
    size = row_size * form.row_count
    if form.encoding == "binary_compressed":
        data = _decompress(data, size, file)
    if len(data) < size:
        expected = f"{size} bytes of {form.row_count} points"
        raise InputError("the file is incomplete", file=file, expected=expected, got=len(data))
    found = np.empty((form.row_count, 3))
    if form.encoding == "binary":
        names = [f"field {k}" for k in range(len(form.types))]
        layout = np.dtype(
            [(name, f"<{kind}") for name, kind in zip(names, form.types, strict=True)]
        )
        rows = np.frombuffer(data, layout, form.row_count)
        for number, column in enumerate(columns):
            found[:, number] = rows[names[column]]
        return found
    # Compressed files have all values of the first field, then those of the next.
    offsets = np.cumsum([0, *(int(kind[1:]) * form.row_count for kind in form.types)]).tolist()
    for number, column in enumerate(columns):
        kind = f"<{form.types[column]}"
        found[:, number] = np.frombuffer(data, kind, form.row_count, offsets[column])
    return found


def _read_text(data: bytes, form: _Format, columns: list[int], file: Path) -> Floats:
    lines = data.split(b"\n", form.row_count)[: form.row_count]
    found = np.empty((form.row_count, 3))
    for row in range(form.row_count):
        words = lines[row].split() if row < len(lines) else []
        try:
            if len(words) != len(form.names):
                raise ValueError
            found[row] = [float(words[column]) for column in columns]
        except ValueError:
            raise InputError(
                f"point {row} is damaged",
                file=file,
                expected=f"{len(form.names)} numbers: {', '.join(form.names[:8])}",
                got=b" ".join(words[:8]).decode("ascii", "replace"),
            ) from None
    return found


def _decompress(data: bytes, expected_size: int, file: Path) -> bytes:
    """Return the content of LZF compressed data, after two sizes.

    A byte below 32 is followed by that many bytes and one more. Otherwise its upper three bits (7:
    and the next byte) are the length, less two, of a copy of earlier output; its lower five bits
    and the next byte are how far back that begins, less one.
    """
    problem = "damaged compressed data"
    if len(data) < 8:
        raise InputError(problem, file=file, expected="two sizes", got=f"{len(data)} bytes")
    compressed_size, size = np.frombuffer(data, "<u4", 2).tolist()
    end = 8 + compressed_size
    if size != expected_size or end > len(data):
        got = f"{compressed_size} and {size} bytes"
        raise InputError(problem, file=file, expected=f"{expected_size} bytes", got=got)
    out = bytearray()
    position = 8
    try:
        while position < end and len(out) <= size:
            control = data[position]
            position += 1
            if control < 32:
                out += data[position : position + control + 1]
                position += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[position]
                position += 1
            begin = len(out) - ((control & 31) << 8) - data[position] - 1
            position += 1
            if begin < 0:
                raise IndexError
            for k in range(begin, begin + length + 2):  # the copied bytes may overlap their source
                out.append(out[k])
    except IndexError:
        raise InputError(problem, file=file, expected=f"{size} bytes", got=len(out)) from None
    if len(out) != size:
        raise InputError(problem, file=file, expected=f"{size} bytes", got=len(out))
    return bytes(out)


def encode_points(points: Floats) -> str:
    """Return points, shape (n, 3) [m], as text: base64 of little-endian single precision."""
    return base64.b64encode(points.astype(_NUMBERS).tobytes()).decode("ascii")


def decode_points(text: str) -> Floats:
    """Return the points of `encode_points`, shape (n, 3) [m]; ValueError if it is no such text."""
    numbers = np.frombuffer(base64.b64decode(text, validate=True), _NUMBERS)
    return numbers.reshape(-1, 3).astype(float)
