"""Recognises the files that importers read, and names those that they do not."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from pathlib import Path

from vkc_pin.errors import InputError
from vkc_pin.importing.formats.xacro import uses_xacro
from vkc_pin.world.files.documents import read_head, read_text
from vkc_pin.world.files.xml import parse_xml

_HEAD = 4096  # bytes in which the first element of an XML file begins
_BYTE_ORDER_MARK = b"\xef\xbb\xbf"  # of UTF-8, with which editors of Windows begin files
_ELEMENTS = {"robot": "URDF", "mujoco": "MJCF", "sdf": "SDF"}
"""First element of an XML file → its format."""
_SIGNATURES = {
    b"#usda": "USD",
    b"PXR-USDC": "USD",
    b"glTF": "glTF",
    b"ply": "PLY",
    b"# .PCD": "PCD",
    b"# Octomap": "OctoMap",
    b"solid ": "STL",
    b"Kaydara FBX": "FBX",
    b"ISO-10303-21": "STEP",
    b"BLENDER": "Blender",
    b"#VRML": "VRML or Webots",
}
"""First bytes of a file → its format."""
_SUFFIXES = {
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), "USD"),
    **dict.fromkeys((".glb", ".gltf"), "glTF"),
    **dict.fromkeys((".bt", ".ot"), "OctoMap"),
    **dict.fromkeys((".step", ".stp"), "STEP"),
    **dict.fromkeys((".wbt", ".proto"), "Webots"),
    **dict.fromkeys((".yaml", ".yml"), "YAML (such as a map of nav2)"),
    ".blend": "Blender",
    ".fbx": "FBX",
    ".json": "JSON",
    ".mjb": "MuJoCo's binary format",
    ".obj": "OBJ",
    ".pcd": "PCD",
    ".pgm": "an image of a map",
    ".ply": "PLY",
    ".scene": "MoveIt .scene",
    ".stl": "STL",
    ".ttt": "CoppeliaSim",
    ".ttm": "CoppeliaSim",
}
"""Suffix of a file that is no XML → its format."""


def detect_format(file: Path, formats: Collection[str]) -> str:
    """Return the format of a file, by its first element or its first bytes.

    Args:
        file: The file.
        formats: Names of the formats that are read.

    Raises:
        InputError: The file cannot be read, or has another format, which is named if it is known.
    """
    readable = list_formats(formats)
    head = read_head(file, readable, _HEAD).removeprefix(_BYTE_ORDER_MARK).lstrip()
    if head and not head.startswith(b"<"):
        name = _recognise_format(head, file)
        if name in formats:
            return str(name)
        if name is not None:
            problem = f"{name} is not supported"
            expected = f"{readable}: export or convert it to one of these"
            raise InputError(problem, file=file, expected=expected)
    text = read_text(file, readable)
    if text.strip() and not text.lstrip().startswith("<"):
        expected = f"a {readable} file, which begins with an element"
        first = text.split(maxsplit=1)[0]
        raise InputError("the file is not XML", file=file, expected=expected, got=first[:40])
    root = parse_xml(text, file)
    name = "xacro" if root.tag == "robot" and uses_xacro(root, file) else _ELEMENTS.get(root.tag)
    if name not in formats:
        raise InputError(
            "the file does not describe a robot, an object or a home",
            file=file,
            expected="a URDF or xacro (<robot>), MJCF (<mujoco>) or SDF (<sdf>) file",
            got=f"<{root.tag}>",
        )
    return str(name)


def list_formats(formats: Collection[str]) -> str:
    """Return names of formats as part of a sentence."""
    *first, last = formats
    return f"{', '.join(first)} or {last}"


def _recognise_format(head: bytes, file: Path) -> str | None:
    """Return the format of a file that is no XML by its first bytes, else by its suffix."""
    for signature, name in _SIGNATURES.items():
        if head.startswith(signature):
            return name
    return _SUFFIXES.get(file.suffix.lower())


def check_no_arguments(file: Path, arguments: Mapping[str, str]) -> None:
    """Check that no arguments are given for a file that is not xacro."""
    if arguments:
        raise InputError(
            "only xacro files have arguments",
            file=file,
            field="arguments",
            expected="no arguments, or a xacro file",
            got=", ".join(arguments),
        )
