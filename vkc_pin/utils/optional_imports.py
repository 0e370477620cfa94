"""Imports compiled modules and optional packages at first use, with helpful errors."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from importlib import import_module
from typing import Any

from vkc_pin.errors import BuildError, InputError

REBUILD_HINT = (
    "build vkc-pin again: pip install --force-reinstall --no-deps --no-cache-dir vkc-pin "
    "(in a checkout: '.')"
)


def import_compiled(name: str) -> Any:
    """Return a compiled module of this package by its full name.

    Raises:
        BuildError: The module cannot be imported.
    """
    try:
        with explain_unfit_libraries():
            return import_module(name)
    except ImportError as error:
        raise BuildError(
            f"the compiled module {name} cannot be imported ({error}). It is in the wheels of "
            "vkc-pin; installing from sources builds it, which needs a C++17 compiler (Debian, "
            f"Ubuntu: apt install g++); then {REBUILD_HINT}"
        ) from error


@contextlib.contextmanager
def explain_unfit_libraries() -> Iterator[None]:
    """Turn a failed import into a `BuildError` if libraries of other releases are installed.

    Compiled modules of this package and of Pinocchio then lack their libraries, or symbols.
    """
    try:
        yield
    except ImportError as error:
        unfit = _find_unfit_libraries()
        if not unfit:
            raise
        installed = " and ".join(f"{name} {version}" for name, version in unfit.values())
        needed = " ".join(f"'{requirement}'" for requirement in unfit)
        raise BuildError(
            f"vkc-pin does not fit the installed {installed} ({error}). Either pip install "
            f"{needed}, or {REBUILD_HINT}"
        ) from error


def _find_unfit_libraries() -> dict[str, tuple[str, str]]:
    """Return the requirements of this package that are not met: name and installed version."""
    from importlib.metadata import PackageNotFoundError, requires, version

    from packaging.requirements import Requirement

    found = {}
    with contextlib.suppress(PackageNotFoundError):  # a source tree that was never installed
        for requirement in map(Requirement, requires("vkc-pin") or ()):
            with contextlib.suppress(PackageNotFoundError):
                installed = version(requirement.name)
                if not (requirement.marker or requirement.specifier.contains(installed)):
                    text = f"{requirement.name}{requirement.specifier}"
                    found[text] = (requirement.name, installed)
    return found


def _list_requirements(extra: str) -> str:
    """Return the packages of an extra for pip, which works for any installation of this package."""
    from importlib.metadata import PackageNotFoundError, requires

    from packaging.requirements import Requirement

    found = list[str]()
    with contextlib.suppress(PackageNotFoundError):  # a source tree that was never installed
        for requirement in map(Requirement, requires("vkc-pin") or ()):
            marker = requirement.marker
            if marker and marker.evaluate({"extra": extra}) and not marker.evaluate({"extra": ""}):
                found.append(f'"{requirement.name}{requirement.specifier}"')
    return " ".join(found) or f'"vkc-pin[{extra}]"'


def import_optional(
    name: str, extra: str, *, purpose: str, file: object = None, field: str | None = None
) -> Any:
    """Return a package, or a module in one, that an extra of this package installs.

    Args:
        name: Name of the package or module.
        extra: Name of the extra, such as `sim`.
        purpose: Use of the package, for the message: "reading MJCF".
        file: File that needs it, for the message.
        field: Option that needs it, for the message.

    Raises:
        InputError: The package is not installed or cannot be imported.
    """
    try:
        return import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        is_missing = isinstance(error, ModuleNotFoundError) and error.name == package
        raise InputError(
            f"{purpose} needs the Python package {package}",
            file=None if file is None else str(file),
            field=field,
            expected=f"pip install {_list_requirements(extra)} (the extra `{extra}`)",
            got="not installed" if is_missing else str(error),
        ) from error
