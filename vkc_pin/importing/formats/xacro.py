"""Calls xacro in a child process.

This module imports little, since the child process imports it.
"""

from __future__ import annotations

import contextlib
import io
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.isolation import run_isolated
from vkc_pin.utils.optional_imports import import_optional
from vkc_pin.utils.system import is_file
from vkc_pin.world.files.resources import find_package

_FIND = re.compile(r"\$\(find\s+([^\s()$]+)\s*\)")  # NAME in $(find NAME)
_COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
# NAME in <xacro:arg name="NAME" ...>, $(arg NAME) and xacro.arg('NAME')
_ARGUMENTS = (
    re.compile(r"<xacro:arg\s[^>]*?\bname\s*=\s*[\"']([^\"']+)[\"']"),
    re.compile(r"\$\(arg\s+([^\s()$]+)\s*\)"),
    re.compile(r"\bxacro\.arg\(\s*[\"']([^\"']+)[\"']"),
)


def uses_xacro(root: ElementTree.Element, file: Path) -> bool:
    """Return whether xacro must process a file.

    Files that it wrote declare its namespace, too, but have nothing that it would replace.
    """
    if file.suffix == ".xacro":
        return True
    if "xmlns:xacro" not in root.attrib:
        return False
    return any(_is_for_xacro(element) for element in root.iter())


def _is_for_xacro(element: ElementTree.Element) -> bool:
    """Return whether xacro would replace an element, or a text of it such as `$(arg NAME)`."""
    if element.tag.startswith("xacro:"):
        return True
    texts = (element.text or "", *element.attrib.values())
    return any("$" in text for text in texts)


def expand_xacro(file: Path, packages: Mapping[str, Path], arguments: Mapping[str, str]) -> str:
    """Return the URDF of a xacro file.

    Raises:
        InputError: xacro is not installed or cannot read the file, or a package is not found.
        UnknownNameError: Neither the file nor those that it includes know an argument.
    """
    import_optional("xacro", "import", purpose="a xacro file", file=file)
    return run_isolated(
        _expand_xacro,
        file.absolute(),
        file,
        dict(packages),
        dict(arguments),
        program="xacro",
        file=file,
    )


def _expand_xacro(
    path: Path, file: Path, packages: Mapping[str, Path], arguments: Mapping[str, str]
) -> str:
    """Return the URDF of the xacro file at an absolute `path`; messages name `file`."""
    import xacro
    from xacro import substitution_args

    messages = io.StringIO()
    # xacro lists the files that it includes in a global variable, never emptied.
    known = len(xacro.all_includes)
    try:
        with (
            _search_packages(substitution_args, path, packages),
            contextlib.redirect_stderr(messages),
        ):
            document = xacro.process_file(str(path), mappings=dict(arguments))
            expanded = str(document.toprettyxml(indent="  "))
    except MemoryError:
        raise
    # Macros, expressions and XML raise any type.
    except (Exception, SystemExit) as error:
        cause = _find_cause(error)
        # An expression may have needed the memory.
        if isinstance(cause, MemoryError):
            raise MemoryError from error
        files = [path, *map(Path, xacro.all_includes[known:])]
        _check_packages(files, path, file, packages)
        # So an argument fails that is not given.
        if isinstance(cause, (substitution_args.ArgException, KeyError)):
            _check_arguments(files, file, arguments)
        message = str(error) or messages.getvalue()
        problem = " ".join(message.split())
        # The number of an error repeats the sentence before.
        problem = problem.partition(" [Errno")[0]
        raise InputError(f"xacro cannot process the file: {problem}", file=file) from error
    files = [path, *map(Path, xacro.all_includes[known:])]
    _check_arguments(files, file, arguments)
    return expanded


def _find_cause(error: BaseException) -> BaseException:
    """Return the error that an error of xacro wraps, if any."""
    cause: Any = error
    while isinstance(getattr(cause, "exc", None), BaseException):
        cause = cause.exc
    found: BaseException = cause
    return found


@contextlib.contextmanager
def _search_packages(
    substitution: ModuleType, path: Path, packages: Mapping[str, Path]
) -> Iterator[None]:
    """Let `$(find NAME)` search around a file; xacro itself would ask ROS."""

    def find(name: str) -> str:
        place = find_package(name, path, packages)
        if place is None:
            raise LookupError(f"package '{name}' was not found")
        return str(place)

    module: Any = substitution
    original = module._eval_find
    module._eval_find = find
    try:
        yield
    finally:
        module._eval_find = original


def _check_arguments(files: Iterable[Path], file: Path, arguments: Iterable[str]) -> None:
    """Raise an error about the first argument that some files neither declare nor use.

    xacro itself ignores such arguments. Names that an expression computes may be any.
    """
    names = set[str]()
    for each in files:
        text = _COMMENT.sub("", _read_quietly(each))
        for pattern in _ARGUMENTS:
            names.update(pattern.findall(text))
    if any("$" in name for name in names):
        return
    for argument in arguments:
        if argument not in names:
            raise UnknownNameError(
                "xacro argument", argument, sorted(names), file=file, field="arguments"
            )


def _read_quietly(file: Path) -> str:
    """Return the text of a file; empty if there is none."""
    return file.read_text(encoding="utf-8", errors="replace") if is_file(file) else ""


def _check_packages(
    files: Iterable[Path], path: Path, file: Path, packages: Mapping[str, Path]
) -> None:
    """Raise an error that lists all packages in `$(find NAME)` of some files that are missing."""
    names = dict[str, None]()  # an ordered set
    for each in files:
        names |= dict.fromkeys(_FIND.findall(_read_quietly(each)))
    missing = [name for name in names if find_package(name, path, packages) is None]
    if missing:
        raise InputError(
            f"packages were not found: {', '.join(missing)}",
            file=file,
            field="$(find ...)",
            expected="folders around the file with these names, or with a package.xml that states "
            "them; or state their folders (packages, --package NAME=FOLDER)",
        )
