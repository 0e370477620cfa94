"""The backend on this package's own compiled module."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

# CasADi and Pinocchio come first: the compiled module then uses the libraries these packages have loaded, wherever
# they are installed.
import casadi
import pinocchio as pin

from vkc_pin.errors import BuildError

__all__ = ["center_of_mass", "check_versions", "frame_jacobian", "frame_placements", "joint_placements", "rnea"]

_REBUILD = "build vkc-pin again: pip install --force-reinstall --no-deps --no-cache-dir vkc-pin (in a checkout: '.')"


def joint_placements(model: pin.Model) -> casadi.Function:
    """Return q → M; see `vkc_pin.cpin.joint_placements`."""
    return _unpack(_extension().joint_placements(_pack(model)))


def frame_placements(model: pin.Model, frames: list[int]) -> casadi.Function:
    """Return q → M; see `vkc_pin.cpin.frame_placements`."""
    return _unpack(_extension().frame_placements(_pack(model), frames))


def frame_jacobian(model: pin.Model, frame: int, reference: int) -> casadi.Function:
    """Return q → J; see `vkc_pin.cpin.frame_jacobian`."""
    return _unpack(_extension().frame_jacobian(_pack(model), frame, reference))


def rnea(model: pin.Model) -> casadi.Function:
    """Return (q, v, a) → tau; see `vkc_pin.cpin.rnea`."""
    return _unpack(_extension().rnea(_pack(model)))


def center_of_mass(model: pin.Model) -> casadi.Function:
    """Return q → com; see `vkc_pin.cpin.center_of_mass`."""
    return _unpack(_extension().center_of_mass(_pack(model)))


def check_versions(built: dict[str, str], installed: dict[str, str]) -> None:
    """Check that the compiled module fits what is installed: the same major and minor release of each library.

    Args:
        built: Package name → version it was compiled against.
        installed: Package name → version that is installed.

    Raises:
        BuildError: A release differs; the message says which, and what to install.
    """
    wrong = [name for name in built if _release(built[name]) != _release(installed[name])]
    if wrong:
        what = " and ".join(f"{name} {built[name]}, but {installed[name]} is installed" for name in wrong)
        wanted = " ".join(f"'{name}=={'.'.join(map(str, _release(built[name])))}.*'" for name in wrong)
        raise BuildError(f"vkc_pin.cpin was compiled against {what}. Either pip install {wanted}, or {_REBUILD}")


def _release(version: str) -> tuple[int, int]:
    """Return (major, minor) of `version`, as numbers: text would put 3.10 before 3.9."""
    parts = version.split("+")[0].split(".")
    try:
        return int(parts[0]), int(parts[1])
    except (IndexError, ValueError):
        raise BuildError(f"cannot read the version '{version}' of a library that vkc_pin.cpin needs; {_REBUILD}") from None


@cache
def _extension() -> Any:
    """Import the compiled module, once, and check that it fits."""
    try:
        extension = import_module("vkc_pin.cpin._cpin")
    except ImportError as error:
        raise BuildError(
            f"the compiled module vkc_pin.cpin._cpin cannot be imported ({error}). It is built when vkc-pin is installed, "
            f"which needs a C++17 compiler (Debian, Ubuntu: apt install g++); then {_REBUILD}"
        ) from error
    check_versions(
        {"pin": extension.PINOCCHIO_VERSION, "casadi": extension.CASADI_VERSION},
        {"pin": pin.__version__, "casadi": casadi.__version__},
    )
    return extension


def _pack(model: pin.Model) -> str:
    text: str = model.saveToString()
    return text


def _unpack(text: str) -> casadi.Function:
    return casadi.Function.deserialize(text)
