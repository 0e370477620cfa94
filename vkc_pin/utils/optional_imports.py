"""What is imported when it is first needed, modules that are compiled and packages of extras, and what to do where that fails."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from vkc_pin.errors import BuildError, InputError

__all__ = ["REBUILD_HINT", "import_compiled", "import_optional"]

REBUILD_HINT = "build vkc-pin again: pip install --force-reinstall --no-deps --no-cache-dir vkc-pin (in a checkout: '.')"


def import_compiled(name: str) -> Any:
    """Return a compiled module of this package.

    Args:
        name: Its full name.

    Raises:
        BuildError: It cannot be imported; the message says why, and what to install.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise BuildError(
            f"the compiled module {name} cannot be imported ({error}). It is built when vkc-pin is installed, "
            f"which needs a C++17 compiler (Debian, Ubuntu: apt install g++); then {REBUILD_HINT}"
        ) from error


def import_optional(
    name: str, extra: str, *, purpose: str, file: object = None, field: str | None = None
) -> Any:
    """Return a package, or a module of one, that only an extra of this package asks for.

    Args:
        name: Its name.
        extra: The extra: `import`, `sim`.
        purpose: What needs it, for the message: "reading MJCF".
        file: The file that needs it, for the message.
        field: The option that needs it, for the message.

    Raises:
        InputError: It is not installed, or cannot be imported.
    """
    try:
        return import_module(name)
    except ImportError as error:
        package = name.partition(".")[0]
        missing = isinstance(error, ModuleNotFoundError) and error.name == package
        raise InputError(
            f"{purpose} needs the Python package {package}",
            file=None if file is None else str(file),
            field=field,
            expected=f'pip install "vkc-pin[{extra}]"',
            got="not installed" if missing else str(error),
        ) from error
