"""Expands xacro files. Packages are found around the file, as for the meshes of URDFs, not through an installation of ROS."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from vkc_pin.errors import InputError
from vkc_pin.utils.optional_imports import optional_package

__all__ = ["expand_xacro"]


def expand_xacro(file: Path, packages: Mapping[str, Path], arguments: Mapping[str, str]) -> str:
    """Return the URDF that a xacro file stands for.

    Args:
        file: The file.
        packages: Package name → folder, for `$(find NAME)`; others are looked for in the folders
            around the file.
        arguments: What `<xacro:arg>` get, instead of their defaults.

    Raises:
        InputError: xacro is not installed, or the file is not understood; the error says what xacro
            says.
    """
    xacro = optional_package("xacro", "import", what="a xacro file", file=file)
    substitution = optional_package(
        "xacro.substitution_args", "import", what="a xacro file", file=file
    )
    said = io.StringIO()
    try:
        with _finding(substitution, file, packages), contextlib.redirect_stderr(said):
            document = xacro.process_file(str(file), mappings=dict(arguments))
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # of macros, Python expressions and XML: any kind
        raise InputError(
            f"xacro does not understand this: {error or said.getvalue().strip()}", file=file
        ) from error
    return str(document.toprettyxml(indent="  "))


@contextlib.contextmanager
def _finding(substitution: ModuleType, file: Path, packages: Mapping[str, Path]) -> Iterator[None]:
    """Let `$(find NAME)` look around `file`; xacro itself would ask ROS."""

    def find(name: str) -> str:
        places = [packages[name]] if name in packages else []
        for folder in file.resolve().parents:
            places += [folder / name, folder] if folder.name == name else [folder / name]
        for place in places:
            if place.is_dir():
                return str(place)
        expected = f"a folder {name} around the file, or packages={{'{name}': folder}}"
        raise InputError(
            "there is no such package", file=file, field=f"$(find {name})", expected=expected
        )

    module: Any = substitution
    before = module._eval_find
    module._eval_find = find
    try:
        yield
    finally:
        module._eval_find = before
