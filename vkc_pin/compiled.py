"""Compiled modules of the package, imported when they are first needed, and what to do where that fails."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from vkc_pin.errors import BuildError

__all__ = ["REBUILD", "compiled_module"]

REBUILD = "build vkc-pin again: pip install --force-reinstall --no-deps --no-cache-dir vkc-pin (in a checkout: '.')"


def compiled_module(name: str) -> Any:
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
            f"which needs a C++17 compiler (Debian, Ubuntu: apt install g++); then {REBUILD}"
        ) from error
