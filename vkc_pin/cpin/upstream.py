"""The backend on upstream's `pinocchio.casadi`, where that can be imported (conda-forge)."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import casadi
import pinocchio as pin

__all__ = ["center_of_mass", "frame_jacobian", "frame_placements", "joint_placements", "rnea"]


def joint_placements(model: pin.Model) -> casadi.Function:
    """Return q → M; see `vkc_pin.cpin.joint_placements`."""
    cpin, symbolic, data, q = _prepare(model)
    cpin.forwardKinematics(symbolic, data, q)
    return _function("joint_placements", {"q": q}, _columns([data.oMi[i] for i in range(1, model.njoints)]), "M")


def frame_placements(model: pin.Model, frames: list[int]) -> casadi.Function:
    """Return q → M; see `vkc_pin.cpin.frame_placements`."""
    cpin, symbolic, data, q = _prepare(model)
    cpin.forwardKinematics(symbolic, data, q)
    cpin.updateFramePlacements(symbolic, data)
    return _function("frame_placements", {"q": q}, _columns([data.oMf[i] for i in frames]), "M")


def frame_jacobian(model: pin.Model, frame: int, reference: int) -> casadi.Function:
    """Return q → J; see `vkc_pin.cpin.frame_jacobian`."""
    cpin, symbolic, data, q = _prepare(model)
    cpin.computeJointJacobians(symbolic, data, q)
    cpin.updateFramePlacements(symbolic, data)
    jacobian = cpin.getFrameJacobian(symbolic, data, frame, pin.ReferenceFrame.values[reference])
    return _function("frame_jacobian", {"q": q}, jacobian, "J")


def rnea(model: pin.Model) -> casadi.Function:
    """Return (q, v, a) → tau; see `vkc_pin.cpin.rnea`."""
    cpin, symbolic, data, q = _prepare(model)
    v, a = casadi.SX.sym("v", model.nv, 1), casadi.SX.sym("a", model.nv, 1)
    return _function("rnea", {"q": q, "v": v, "a": a}, cpin.rnea(symbolic, data, q, v, a), "tau")


def center_of_mass(model: pin.Model) -> casadi.Function:
    """Return q → com; see `vkc_pin.cpin.center_of_mass`."""
    cpin, symbolic, data, q = _prepare(model)
    return _function("center_of_mass", {"q": q}, cpin.centerOfMass(symbolic, data, q), "com")


def _prepare(model: pin.Model) -> tuple[Any, Any, Any, casadi.SX]:
    cpin = import_module("pinocchio.casadi")
    symbolic = cpin.Model(model)
    return cpin, symbolic, symbolic.createData(), casadi.SX.sym("q", model.nq, 1)


def _columns(placements: Sequence[Any]) -> casadi.SX:
    columns = [casadi.vertcat(casadi.vec(casadi.SX(m.rotation)), casadi.SX(m.translation)) for m in placements]
    return casadi.horzcat(casadi.SX(12, 0), *columns)


def _function(name: str, inputs: dict[str, casadi.SX], output: casadi.SX, output_name: str) -> casadi.Function:
    lean = casadi.cse(casadi.sparsify(casadi.SX(output)))
    return casadi.Function(name, list(inputs.values()), [lean], list(inputs), [output_name])
