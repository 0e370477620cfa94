"""Whole-body planning for mobile manipulators on virtual kinematic chains.

What is public is listed in `__init__.pyi` and loaded when it is first asked for (as SPEC 1 of Scientific Python has it), so
that `import vkc_pin` costs little in a process that needs a part of it, and type checkers see everything.
"""

from importlib.metadata import PackageNotFoundError, version

import lazy_loader

from vkc_pin import notebook

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
__all__.append("__version__")
notebook.cards_from("vkc_pin.plotting.cards")

try:
    __version__ = version("vkc-pin")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"
