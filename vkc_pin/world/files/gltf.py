"""Checks that trimesh reads all surfaces of a glTF file, and states the file's axes.

In glTF files y points up and the unit is the metre, by their specification.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from vkc_pin.errors import InputError

GLTF_SUFFIXES = (".gltf", ".glb")
"""Extensions of glTF files in lower case."""
GLTF_TO_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], float)
"""Rotation by a right angle about x, from y up to z up, shape (4, 4)."""
# Modes of primitives
_TRIANGLES = 4  # the default
_TRIANGLE_FAN = 6
_MODES = range(7)  # points, lines and triangles
# Extensions without effect on surfaces, or that trimesh reads as the specification demands; a file
# may require others, which move or compress its vertices.
_KNOWN_PREFIXES = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "EXT_lights_")
_KNOWN = ("KHR_mesh_quantization", "KHR_xmp_json_ld", "MSFT_texture_dds")
_COPIES = "EXT_mesh_gpu_instancing"  # places a node's mesh many times


def check_gltf(file: Path) -> None:
    """Raise an `InputError` if a glTF file holds surfaces that trimesh would leave out or misplace.

    These are triangle fans, normalized positions, sparse accessors, instances on the graphics card,
    and extensions that the file requires. Invalid files are left to trimesh.
    """
    document = _read_document(file)
    unknown = list[str]()
    for name in _get_list(document, "extensionsRequired"):
        if not isinstance(name, str) or name in _KNOWN:
            continue
        if not name.startswith(_KNOWN_PREFIXES):
            unknown.append(name)
    if unknown:
        raise _make_error(file, "a required extension", ", ".join(unknown))
    for node in _get_list(document, "nodes"):
        if isinstance(node, dict) and _COPIES in (node.get("extensions") or {}):
            raise _make_error(file, "an extension of a node", _COPIES)
    accessors = _get_list(document, "accessors")
    for mesh in _get_list(document, "meshes"):
        for primitive in _get_list(mesh, "primitives"):
            if isinstance(primitive, dict):
                _check_primitive(file, primitive, accessors, mesh.get("name", "a mesh"))


def _check_primitive(
    file: Path, primitive: dict[str, Any], accessors: list[Any], mesh: str
) -> None:
    """Raise an `InputError` if trimesh would misread a primitive of a mesh of that name."""
    mode = primitive.get("mode", _TRIANGLES)
    if mode == _TRIANGLE_FAN or mode not in _MODES:
        raise _make_error(file, "this kind of primitive", f"{mesh}: mode {mode}")
    attributes: Any = primitive.get("attributes") or {}
    positions: Any = attributes.get("POSITION")
    indices: Any = primitive.get("indices")
    for number in (positions, indices):
        if not isinstance(number, int) or not 0 <= number < len(accessors):
            continue
        if accessors[number].get("normalized"):
            raise _make_error(file, "normalized positions", mesh)
        if accessors[number].get("sparse"):
            raise _make_error(file, "a sparse accessor", mesh)


def _read_document(file: Path) -> Any:
    """Return the JSON document of a file; None if there is no valid one."""
    data = file.read_bytes()
    # A binary file has a header of 12 bytes, then the length of the first chunk, which is the
    # document, and its type, of 4 bytes each.
    if data.startswith(b"glTF") and len(data) >= 20:
        (length,) = struct.unpack_from("<I", data, 12)
        data = data[20 : 20 + length]
    try:
        return json.loads(data.decode(json.detect_encoding(data)))
    except (ValueError, RecursionError):
        return None


def _get_list(document: Any, key: str) -> list[Any]:
    value = document.get(key) if isinstance(document, dict) else None
    return value if isinstance(value, list) else []


def _make_error(file: Path, what: str, got: str) -> InputError:
    return InputError(
        f"{what} of the glTF file is not supported",
        file=file,
        expected="triangles and strips of triangles, without compression",
        got=got,
    )
