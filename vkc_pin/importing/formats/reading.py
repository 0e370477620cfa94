"""Reads a file of any format as a description.

A new format is a module with a reader, and a line in `_READERS`.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

from vkc_pin.importing.description import Description
from vkc_pin.importing.formats.detection import (
    check_no_arguments,
    detect_format,
    list_formats,
)
from vkc_pin.importing.formats.mjcf import read_mjcf_description
from vkc_pin.importing.formats.moveit_scene import read_moveit_scene
from vkc_pin.importing.formats.sdf import read_sdf_description
from vkc_pin.importing.formats.urdf import read_urdf_description
from vkc_pin.importing.formats.usd import read_usd_description
from vkc_pin.importing.formats.xacro import expand_xacro
from vkc_pin.utils.arguments import check_mapping
from vkc_pin.world.files.resources import check_path

Folders = Mapping[str, Path]
"""Folders of packages by name."""
Arguments = Mapping[str, str]
"""Arguments of a xacro file by name."""


def _read_xacro(file: Path, packages: Folders, arguments: Arguments) -> Description:
    text = expand_xacro(file, packages, arguments)
    description = read_urdf_description(file, packages, text=text)
    return dataclasses.replace(description, format="xacro")


_READERS: Mapping[str, Callable[[Path, Folders, Arguments], Description]] = {
    "URDF": lambda file, packages, _: read_urdf_description(file, packages),
    "xacro": _read_xacro,
    "MJCF": lambda file, packages, _: read_mjcf_description(file),
    "SDF": lambda file, packages, _: read_sdf_description(file, packages),
    "USD": lambda file, packages, _: read_usd_description(file, packages),
    "MoveIt .scene": lambda file, *_: read_moveit_scene(file),
}
"""Reader of each format; `detect_format` names the formats."""
FORMATS = list_formats(_READERS)
"""The formats that are read, as part of a sentence."""


def read_description(
    file: str | Path,
    *,
    packages: Mapping[str, str | Path] | None = None,
    arguments: Mapping[str, str] | None = None,
) -> Description:
    """Read a file of one of `FORMATS`, which its first element or its first bytes tell.

    Warnings become notes of the description.

    Args:
        file: The file.
        packages: Folders of packages by name; others are searched for around the file.
        arguments: Arguments of a xacro file.

    Raises:
        InputError: The file cannot be read, or has another format, which is named.
        UnknownNameError: The file refers to an unknown name, or does not know an argument.
    """
    path = check_path(file, "file", f"a {FORMATS} file")
    folders = dict[str, Path]()
    for name, folder in check_mapping(packages or {}, "packages").items():
        folders[name] = check_path(folder, f"packages['{name}']", "a folder")
    texts = dict[str, str]()
    for name, value in check_mapping(arguments or {}, "arguments").items():
        texts[name] = str(value)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        name = detect_format(path, _READERS)
        if name != "xacro":
            check_no_arguments(path, texts)
        description = _READERS[name](path, folders, texts)
    notes = dict.fromkeys(str(warning.message) for warning in caught)
    return description.add_notes(*notes)
