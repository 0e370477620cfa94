"""The compiled module of this wing, imported when it is first needed."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

from vkc_pin.errors import BuildError

__all__ = ["compiled"]


@cache
def compiled() -> Any:
    """Return the compiled module.

    Raises:
        BuildError: It is missing.
    """
    try:
        return import_module("vkc_pin.driving._driving")
    except ImportError as error:
        raise BuildError(
            f"the compiled module vkc_pin.driving._driving cannot be imported ({error}). It is built when vkc-pin is installed, "
            "which needs a C++17 compiler (Debian, Ubuntu: apt install g++); then build vkc-pin again: "
            "pip install --force-reinstall --no-deps --no-cache-dir vkc-pin (in a checkout: '.')"
        ) from error
