"""Changes settings of the planner: fields of `Options`, and constants of its modules."""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import importlib
import inspect
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Any

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.options import Options

_FORM = "Options.field=value, or module:NAME=value such as solver.loop:PROGRESS=0.6"
_PACKAGE = "vkc_pin.planning"  # whose modules have the constants


@dataclass(frozen=True)
class Change:
    """A changed setting.

    Attributes:
        module: Module of a constant within `vkc_pin.planning`, such as "solver.loop"; "Options"
            for a field of `Options`; "" for no change.
        name: Name of the constant or field.
        value: New value.
    """

    module: str = ""
    name: str = ""
    value: Any = None

    def __str__(self) -> str:
        if not self.module:
            return "unchanged"
        return f"{self.module}{'.' if self.module == 'Options' else ':'}{self.name}={self.value!r}"

    @property
    def options(self) -> Options:
        """Options to plan with."""
        return (
            dataclasses.replace(Options(), **{self.name: self.value})
            if self.module == "Options"
            else Options()
        )

    @contextlib.contextmanager
    def apply(self) -> Iterator[None]:
        """Change the constant meanwhile, wherever it is imported by name.

        Values derived from it at import stay. Plan with a new `Planner`: caches hold the old value.
        """
        places = _places(self.module, self.name) if self.module not in ("", "Options") else []
        before = [(module, name, getattr(module, name)) for module, name in places]
        try:
            for module, name, _ in before:
                setattr(module, name, self.value)
            yield
        finally:
            for module, name, value in before:
                setattr(module, name, value)


UNCHANGED = Change()


def parse_change(text: str) -> Change:
    """Return the change of a text, such as `Options.dt=0.3` or `solver.loop:PROGRESS=0.6`.

    Raises:
        InputError: The text is malformed, names no setting, or has a value of another type.
    """
    place, equals, value = text.partition("=")
    try:
        new = ast.literal_eval(value.strip())
    except (ValueError, SyntaxError):
        equals = ""
    if not equals:
        raise InputError("not a change", field="change", expected=_FORM, got=repr(text))
    if place.startswith("Options."):
        change = Change("Options", place.removeprefix("Options.").strip(), new)
        known = [item.name for item in dataclasses.fields(Options)]
        if change.name not in known:
            raise UnknownNameError("field of Options", change.name, known, field="change")
        _ = change.options  # raises an error for invalid values
        return change
    module, _, name = (part.strip() for part in place.partition(":"))
    if not name:
        raise InputError("not a change", field="change", expected=_FORM, got=repr(text))
    found = _module(module)
    constants = [
        key
        for key, there in vars(found).items()
        if key.strip("_").isupper() and not isinstance(there, ModuleType)
    ]
    if name not in constants:
        raise UnknownNameError(f"constant of {module}", name, constants, field="change")
    old = getattr(found, name)
    number = (
        isinstance(old, int | float) and isinstance(new, int | float) and not isinstance(old, bool)
    )
    if not number and not isinstance(new, type(old)):
        raise InputError(
            "of another kind",
            field=str(Change(module, name, new)),
            expected=repr(old),
            got=repr(new),
        )
    return Change(module, name, new)


def _module(name: str) -> ModuleType:
    try:
        return importlib.import_module(f"{_PACKAGE}.{name}")
    except ModuleNotFoundError:
        raise InputError(
            f"no such module in {_PACKAGE}", field="change", expected=_FORM, got=name
        ) from None


def _places(module: str, name: str) -> list[tuple[ModuleType, str]]:
    """Return (module, name) of all bindings of a constant."""
    # With it, all is imported that may import the constant.
    importlib.import_module("vkc_pin.planning.prepare")
    home = _module(module)
    found = [(home, name)]
    for other in [
        one
        for key, one in sorted(sys.modules.items())
        if key.startswith("vkc_pin.") and one is not home
    ]:
        try:
            tree = ast.parse(inspect.getsource(other))
        except (OSError, TypeError):
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module == home.__name__:
                bound = [alias.asname or alias.name for alias in node.names if alias.name == name]
                found += [(other, one) for one in bound if hasattr(other, one)]
    return found
