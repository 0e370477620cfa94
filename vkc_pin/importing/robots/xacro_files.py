"""Expands xacro files, with packages in folders around the file and without a ROS installation."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from vkc_pin.errors import InputError
from vkc_pin.utils.optional_imports import import_optional

__all__ = ["expand_xacro"]


def expand_xacro(file: Path, packages: Mapping[str, Path], arguments: Mapping[str, str]) -> str:
    """Return the URDF of a xacro file.

    Args:
        file: The file.
        packages: Maps package names to folders, for `$(find NAME)`; others are searched for in the
            folders around the file.
        arguments: Values of `<xacro:arg>` elements, instead of their defaults.

    Raises:
        InputError: xacro is not installed, or it cannot process the file; the error contains its
            message.
    """
    xacro = import_optional("xacro", "import", purpose="a xacro file", file=file)
    substitution = import_optional(
        "xacro.substitution_args", "import", purpose="a xacro file", file=file
    )
    messages = io.StringIO()
    try:
        with _search_packages(substitution, file, packages), contextlib.redirect_stderr(messages):
            document = xacro.process_file(str(file), mappings=dict(arguments))
    except InputError:
        raise
    except (Exception, SystemExit) as error:  # macros, expressions and XML raise any type
        raise InputError(
            f"xacro cannot process the file: {error or messages.getvalue().strip()}", file=file
        ) from error
    return str(document.toprettyxml(indent="  "))


@contextlib.contextmanager
def _search_packages(
    substitution: ModuleType, file: Path, packages: Mapping[str, Path]
) -> Iterator[None]:
    """Let `$(find NAME)` search around `file`; xacro itself would ask ROS."""

    def find(name: str) -> str:
        places = [packages[name]] if name in packages else []
        for folder in file.resolve().parents:
            places += [folder / name, folder] if folder.name == name else [folder / name]
        for place in places:
            if place.is_dir():
                return str(place)
        expected = f"a folder {name} around the file, or packages={{'{name}': folder}}"
        raise InputError(
            f"package '{name}' was not found", file=file, field=f"$(find {name})", expected=expected
        )

    module: Any = substitution
    original = module._eval_find
    module._eval_find = find
    try:
        yield
    finally:
        module._eval_find = original
