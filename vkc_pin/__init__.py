"""Whole-body planning for mobile manipulators on virtual kinematic chains.

Public names are listed in `__init__.pyi` and loaded on first use (as SPEC 1 of
Scientific Python has it), so that `import vkc_pin` costs little in a process that needs a part of
it, and type checkers see everything.
"""

import sys
from typing import Any

import lazy_loader

from vkc_pin.utils import notebook
from vkc_pin.utils.optional_imports import explain_unfit_libraries

_public, _names, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__ += ["__version__", "cpin"]
notebook.register_card_module("vkc_pin.visualization.plots.notebook_cards")


def __dir__() -> list[str]:
    return [*_names(), "cpin"]


def __getattr__(name: str) -> Any:
    if name == "cpin":  # the public name of the kinematics
        from vkc_pin.planning import kinematics

        return globals().setdefault(name, kinematics)
    if name != "__version__":
        with explain_unfit_libraries():
            try:
                return _public(name)
            except AttributeError as error:
                error.name = name  # so that Python names the nearest attribute
                error.obj = sys.modules[__name__]
                raise
    from importlib.metadata import PackageNotFoundError, version  # takes longer than all the rest

    try:
        found = version("vkc-pin")
    except PackageNotFoundError:  # a source tree that was never installed
        found = "0+unknown"
    return globals().setdefault(name, found)
