"""The backend on upstream's `pinocchio.casadi`, where that can be imported (conda-forge)."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import casadi
import pinocchio as pin

__all__ = ["build"]


def build(name: str, model: pin.Model, *arguments: Any) -> casadi.Function:
    """Return the function of `vkc_pin.cpin` that is called so; frames and references among its arguments are numbers."""
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
        output, result = cpin.getFrameJacobian(symbolic, data, frame, pin.ReferenceFrame.values[reference]), "J"
    else:
        cpin.forwardKinematics(symbolic, data, q)
        cpin.updateFramePlacements(symbolic, data)
        joints = name == "joint_placements"
        placements = [data.oMi[i] for i in range(1, model.njoints)] if joints else [data.oMf[i] for i in arguments[0]]
        columns = [casadi.vertcat(casadi.vec(casadi.SX(m.rotation)), casadi.SX(m.translation)) for m in placements]
        output, result = casadi.horzcat(casadi.SX(12, 0), *columns), "M"
    lean = casadi.cse(casadi.sparsify(casadi.SX(output)))
    return casadi.Function(name, list(inputs.values()), [lean], list(inputs), [result])
