"""The packages of the extra `import`, which importing needs and planning does not."""

from __future__ import annotations

import importlib
from types import ModuleType

from vkc_pin.errors import InputError

__all__ = ["extra"]


def extra(package: str, *, what: str, file: object = None) -> ModuleType:
    """Return a package of the extra `import`.

    Args:
        package: Its name.
        what: What it is needed for, for the message.
        file: The file that needs it, for the message.

    Raises:
        InputError: It is not installed, or cannot be imported.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        got = "not installed" if isinstance(error, ModuleNotFoundError) and error.name == package else str(error)
        problem, expected = f"{what} needs the Python package {package}", 'pip install "vkc-pin[import]"'
        raise InputError(problem, file=None if file is None else str(file), expected=expected, got=got) from error
