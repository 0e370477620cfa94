"""Builds CasADi functions of Pinocchio's algorithms, with the compiled module or upstream's `pinocchio.casadi`."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

# CasADi and Pinocchio come first: the compiled module then uses the libraries these packages have
# loaded, wherever they are installed.
import casadi
import pinocchio as pin

from vkc_pin.errors import BuildError
from vkc_pin.utils.optional_imports import REBUILD, compiled_module

__all__ = ["check_versions", "compiled", "upstream"]


def compiled(name: str, model: pin.Model, *arguments: Any) -> casadi.Function:
    """Return the kinematics function of this name; frames and references among its arguments are numbers."""
    return casadi.Function.deserialize(
        getattr(_extension(), name)(model.saveToString(), *arguments)
    )


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
        what = " and ".join(
            f"{name} {built[name]}, but {installed[name]} is installed" for name in wrong
        )
        wanted = " ".join(
            f"'{name}=={'.'.join(map(str, _release(built[name])))}.*'" for name in wrong
        )
        raise BuildError(
            f"vkc_pin.planning.kinematics was compiled against {what}. Either pip install {wanted}, or {REBUILD}"
        )


def _release(version: str) -> tuple[int, int]:
    """Return (major, minor) of `version`, as numbers: text would put 3.10 before 3.9."""
    parts = version.split("+")[0].split(".")
    try:
        return int(parts[0]), int(parts[1])
    except (IndexError, ValueError):
        raise BuildError(
            f"cannot read the version '{version}' of a library that vkc_pin.planning.kinematics needs; {REBUILD}"
        ) from None


@cache
def _extension() -> Any:
    """Import the compiled module, once, and check that it fits."""
    extension = compiled_module("vkc_pin.planning.kinematics._cpin")
    check_versions(
        {"pin": extension.PINOCCHIO_VERSION, "casadi": extension.CASADI_VERSION},
        {"pin": pin.__version__, "casadi": casadi.__version__},
    )
    return extension


def upstream(name: str, model: pin.Model, *arguments: Any) -> casadi.Function:
    """Return the same, made by Pinocchio's own bindings."""
    cpin = import_module("pinocchio.casadi")
    symbolic, inputs = cpin.Model(model), {"q": casadi.SX.sym("q", model.nq, 1)}
    data, q = symbolic.createData(), inputs["q"]
    if name == "rnea":
        inputs |= {part: casadi.SX.sym(part, model.nv, 1) for part in ("v", "a")}
        output, result = cpin.rnea(symbolic, data, *inputs.values()), "tau"
    elif name == "center_of_mass":
        output, result = cpin.centerOfMass(symbolic, data, q), "com"
    elif name == "frame_jacobian":
        frame, reference = arguments
        cpin.computeJointJacobians(symbolic, data, q)
        cpin.updateFramePlacements(symbolic, data)
        output, result = (
            cpin.getFrameJacobian(symbolic, data, frame, pin.ReferenceFrame.values[reference]),
            "J",
        )
    else:
        cpin.forwardKinematics(symbolic, data, q)
        cpin.updateFramePlacements(symbolic, data)
        joints = name == "joint_placements"
        placements = (
            [data.oMi[i] for i in range(1, model.njoints)]
            if joints
            else [data.oMf[i] for i in arguments[0]]
        )
        columns = [
            casadi.vertcat(casadi.vec(casadi.SX(m.rotation)), casadi.SX(m.translation))
            for m in placements
        ]
        output, result = casadi.horzcat(casadi.SX(12, 0), *columns), "M"
    lean = casadi.cse(casadi.sparsify(casadi.SX(output)))
    return casadi.Function(name, list(inputs.values()), [lean], list(inputs), [result])
