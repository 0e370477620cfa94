"""Pinocchio's algorithms as CasADi functions: their arguments are a model's q, v, a.

Every function here takes a numeric `pinocchio.Model` and returns a `casadi.Function` built from SX
expressions, with exact derivatives of any order. q is Pinocchio's configuration (a planar joint is
x, y, cos θ, sin θ), v and a are in its tangent space. Entries that vanish at every configuration
are structural zeros of the result.

Where upstream's `pinocchio.casadi` can be imported (conda-forge), it does the work; otherwise the
small module that is compiled when this package is installed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arguments import instance, items, known, whole

if TYPE_CHECKING:
    import casadi
    import pinocchio as pin

__all__ = [
    "backend_name",
    "center_of_mass",
    "frame_jacobian",
    "frame_placements",
    "joint_placements",
    "rnea",
]

# The numbers are those of pinocchio.ReferenceFrame.
_REFERENCES = {"world": 0, "local": 1, "local_world_aligned": 2}


@cache
def _backend() -> Callable[..., casadi.Function]:
    """Return what does the work, chosen at the first use: importing this package stays quick."""
    from vkc_pin.planning.kinematics import backends

    try:
        import_module("pinocchio.casadi")
    except ImportError:
        return backends.compiled
    return backends.upstream


def backend_name() -> str:
    """Return what does the work here: "upstream" (`pinocchio.casadi`) or "compiled" (this package's own module)."""
    return _backend().__name__


def joint_placements(model: pin.Model) -> casadi.Function:
    """Return the function q → M of the placements of all joints in the world.

    Args:
        model: The model; nq configuration entries, njoints joints counting the universe.

    Returns:
        q, shape (nq, 1) → M, shape (12, njoints - 1). Column i belongs to joint i + 1 (the universe
        is left out) and stacks the columns of its rotation matrix and its translation [m]: [R[:,
        0]; R[:, 1]; R[:, 2]; t].

    Raises:
        BuildError: The compiled module is missing or does not fit the installed packages.
    """
    return _backend()("joint_placements", _exact(model))


def frame_placements(model: pin.Model, frames: Sequence[str | int]) -> casadi.Function:
    """Return the function q → M of the placements of chosen frames in the world.

    Args:
        model: The model.
        frames: Names or indices of the frames, in the order of the columns.

    Returns:
        q, shape (nq, 1) → M, shape (12, len(frames)), columns as in `joint_placements`.

    Raises:
        UnknownNameError: The model has no such frame.
        InputError: Several different frames of the model share the name.
        BuildError: The compiled module is missing or does not fit the installed packages.
    """
    listed: tuple[Any, ...] = items(
        [frames] if isinstance(frames, str) else frames, "frames", "a list of frames"
    )
    indices = [_frame_index(model, frame, f"frames[{i}]") for i, frame in enumerate(listed)]
    return _backend()("frame_placements", _exact(model), indices)


def frame_jacobian(
    model: pin.Model,
    frame: str | int,
    reference: Literal["local_world_aligned", "local", "world"] = "local_world_aligned",
) -> casadi.Function:
    """Return the function q → J of the Jacobian of a frame: its spatial velocity is J·v.

    Args:
        model: The model.
        frame: Name or index of the frame.
        reference: Where the velocity is expressed: at the frame's origin in world axes
            ("local_world_aligned"), at the frame's origin in its own axes ("local"), or at the
            world's origin in world axes ("world").

    Returns:
        q, shape (nq, 1) → J, shape (6, nv); rows 0-2 linear [m/s], rows 3-5 angular [rad/s] per
        unit of v.

    Raises:
        UnknownNameError: The model has no such frame, or there is no such reference.
        InputError: Several different frames of the model share the name.
        BuildError: The compiled module is missing or does not fit the installed packages.
    """
    known(reference, _REFERENCES, "reference", "reference")
    index = _frame_index(model, frame, "frame")
    return _backend()("frame_jacobian", _exact(model), index, _REFERENCES[reference])


def rnea(model: pin.Model) -> casadi.Function:
    """Return the function (q, v, a) → tau of the inverse dynamics (recursive Newton-Euler).

    Args:
        model: The model, with inertias.

    Returns:
        q, shape (nq, 1), v [rad/s, m/s] and a [rad/s², m/s²], shape (nv, 1) → tau [N·m, N], shape
        (nv, 1).

    Raises:
        BuildError: The compiled module is missing or does not fit the installed packages.
    """
    return _backend()("rnea", _exact(model))


def center_of_mass(model: pin.Model) -> casadi.Function:
    """Return the function q → com of the centre of mass of the whole model.

    Args:
        model: The model, with inertias.

    Returns:
        q, shape (nq, 1) → com [m] in the world frame, shape (3, 1).

    Raises:
        BuildError: The compiled module is missing or does not fit the installed packages.
    """
    return _backend()("center_of_mass", _exact(model))


def _frame_index(model: pin.Model, frame: str | int, field: str) -> int:
    """Return the index of `frame` in `model.frames`, checked."""
    names = [f.name for f in _exact(model).frames]
    if not isinstance(frame, str):
        number = whole(frame, field, low=-1)
        if not 0 <= number < len(names):
            raise UnknownNameError("frame", str(number), [f"0 to {len(names) - 1}"], field=field)
        return number
    found = [index for index, name in enumerate(names) if name == frame]
    if not found:
        raise UnknownNameError("frame", frame, names, field=field)
    first = model.frames[found[0]]
    # A URDF gives a joint and its link frames of one name now and then; as long as they coincide,
    # either will do.
    for other in (model.frames[index] for index in found[1:]):
        if other.parentJoint != first.parentJoint or other.placement != first.placement:
            raise InputError(
                f"several frames are named '{frame}'", field=field, expected="an index", got=found
            )
    return found[0]


def _exact(model: pin.Model) -> pin.Model:
    """Return a copy of `model` whose quarter turns are exact.

    They come as cos(π/2) = 6e-17, and a number that is neither 0 nor ±1 stays in every expression
    it enters: without this a UR5e on a planar base takes a tenth more. The change is below the
    rounding of the numeric algorithms.
    """
    import numpy as np
    import pinocchio as pin

    copy = instance(model, pin.Model, "model").copy()
    for placement in [*copy.jointPlacements, *(frame.placement for frame in copy.frames)]:
        rotation, nearest = placement.rotation, np.round(placement.rotation)
        placement.rotation = np.where(np.abs(rotation - nearest) <= 4e-16, nearest, rotation)
    return copy
