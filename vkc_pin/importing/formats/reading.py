"""Reads a file of any format as a description.

A new format is a module with a reader, and a line in `_READERS`.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path

from vkc_pin.errors import InputError
from vkc_pin.importing.description import Description
from vkc_pin.importing.formats.detection import check_no_arguments, read_root
from vkc_pin.importing.formats.mjcf import read_mjcf_description
from vkc_pin.importing.formats.sdf import read_sdf_description
from vkc_pin.importing.formats.urdf import read_urdf_description
from vkc_pin.importing.formats.xacro import expand_xacro, uses_xacro
from vkc_pin.utils.arguments import check_mapping
from vkc_pin.world.files.resources import check_path

FORMATS = "URDF, xacro, MJCF or SDF"
"""The formats that are read."""
_READERS: Mapping[str, Callable[[Path, Mapping[str, Path]], Description]] = {
    "robot": read_urdf_description,
    "mujoco": lambda file, packages: read_mjcf_description(file),
    "sdf": read_sdf_description,
}
"""Reader by the first element of a file; it gets the folders of packages by name."""


def read_description(
    file: str | Path,
    *,
    packages: Mapping[str, str | Path] | None = None,
    arguments: Mapping[str, str] | None = None,
) -> Description:
    """Read a URDF, xacro, MJCF or SDF file, whose first element tells its format.

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
        description = _read_format(path, folders, texts)
    notes = dict.fromkeys(str(warning.message) for warning in caught)
    return description.add_notes(*notes)


def _read_format(
    path: Path, packages: Mapping[str, Path], arguments: Mapping[str, str]
) -> Description:
    _, root = read_root(path, FORMATS)
    if root.tag == "robot" and uses_xacro(root, path):
        text = expand_xacro(path, packages, arguments)
        description = read_urdf_description(path, packages, text=text)
        return dataclasses.replace(description, format="xacro")
    check_no_arguments(path, arguments)
    if root.tag not in _READERS:
        raise InputError(
            "the file does not describe a robot, an object or a home",
            file=path,
            expected="a URDF or xacro (<robot>), MJCF (<mujoco>) or SDF (<sdf>) file",
            got=f"<{root.tag}>",
        )
    return _READERS[root.tag](path, packages)
