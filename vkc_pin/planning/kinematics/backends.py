"""Builds CasADi functions of Pinocchio's algorithms with `_cpin` or `pinocchio.casadi`."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import Any

# CasADi and Pinocchio are imported first, so that the compiled module uses the libraries that these
# packages have loaded, wherever they are installed.
import casadi
import pinocchio as pin

from vkc_pin.errors import BuildError
from vkc_pin.utils.optional_imports import REBUILD_HINT, import_compiled


def build_compiled(name: str, model: pin.Model, *arguments: Any) -> casadi.Function:
    """Return the named function, built by the compiled module.

    Args:
        name: Name of the function in `vkc_pin.planning.kinematics`.
        model: The model.
        arguments: Its further arguments; frames and references as numbers.
    """
    build = getattr(_import_extension(), name)
    return casadi.Function.deserialize(build(model.saveToString(), *arguments))


def check_versions(built: dict[str, str], installed: dict[str, str]) -> None:
    """Check that the compiled module fits the installed libraries, up to the minor release.

    Args:
        built: Package name → version that the module was compiled against.
        installed: Package name → installed version.

    Raises:
        BuildError: A release differs; the message says which, and what to install.
    """
    mismatches = []
    requirements = []
    for name, version in built.items():
        major, minor = _parse_release(version)
        if (major, minor) == _parse_release(installed[name]):
            continue
        mismatches.append(f"{name} {version}, but {installed[name]} is installed")
        requirements.append(f"'{name}=={major}.{minor}.*'")
    if mismatches:
        raise BuildError(
            f"vkc_pin.planning.kinematics was compiled against {' and '.join(mismatches)}. "
            f"Either pip install {' '.join(requirements)}, or {REBUILD_HINT}"
        )


def _parse_release(version: str) -> tuple[int, int]:
    """Return (major, minor) of `version` as numbers, since as text 3.10 precedes 3.9."""
    parts = version.split("+")[0].split(".")
    try:
        return int(parts[0]), int(parts[1])
    except (IndexError, ValueError):
        raise BuildError(
            f"cannot read the version '{version}' of a library that "
            f"vkc_pin.planning.kinematics needs; {REBUILD_HINT}"
        ) from None


@cache
def _import_extension() -> Any:
    """Import the compiled module once and check its versions."""
    extension = import_compiled("vkc_pin.planning.kinematics._cpin")
    check_versions(
        {"pin": extension.PINOCCHIO_VERSION, "casadi": extension.CASADI_VERSION},
        {"pin": pin.__version__, "casadi": casadi.__version__},
    )
    return extension


def build_upstream(name: str, model: pin.Model, *arguments: Any) -> casadi.Function:
    """Return the named function, built by `pinocchio.casadi`; see `build_compiled`."""
    cpin = import_module("pinocchio.casadi")
    symbolic = cpin.Model(model)
    data = symbolic.createData()
    q = casadi.SX.sym("q", model.nq, 1)
    inputs = {"q": q}
    if name == "joint_placements" and arguments[0]:
        inputs["P"] = casadi.SX.sym("P", 12, len(arguments[0]))
        for column, joint in enumerate(arguments[0]):
            mount = inputs["P"][:, column]
            rotation = casadi.reshape(mount[:9], 3, 3)
            symbolic.jointPlacements[joint] = cpin.SE3(rotation, mount[9:])
    if name == "rnea":
        inputs["v"] = casadi.SX.sym("v", model.nv, 1)
        inputs["a"] = casadi.SX.sym("a", model.nv, 1)
        output = cpin.rnea(symbolic, data, q, inputs["v"], inputs["a"])
        output_name = "tau"
    elif name == "center_of_mass":
        output = cpin.centerOfMass(symbolic, data, q)
        output_name = "com"
    elif name == "frame_jacobian":
        frame, reference = arguments
        cpin.computeJointJacobians(symbolic, data, q)
        cpin.updateFramePlacements(symbolic, data)
        axes = pin.ReferenceFrame.values[reference]
        output = cpin.getFrameJacobian(symbolic, data, frame, axes)
        output_name = "J"
    else:
        cpin.forwardKinematics(symbolic, data, q)
        cpin.updateFramePlacements(symbolic, data)
        if name == "joint_placements":
            placements = [data.oMi[i] for i in range(1, model.njoints)]
        else:
            placements = [data.oMf[i] for i in arguments[0]]
        output = casadi.SX(12, 0)
        for placement in placements:
            rotation = casadi.vec(casadi.SX(placement.rotation))
            column = casadi.vertcat(rotation, casadi.SX(placement.translation))
            output = casadi.horzcat(output, column)
        output_name = "M"
    simplified = casadi.cse(casadi.sparsify(casadi.SX(output)))
    return casadi.Function(name, list(inputs.values()), [simplified], list(inputs), [output_name])
