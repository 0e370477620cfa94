"""Provides Pinocchio's algorithms as CasADi functions of a model's q, v and a.

Every function takes a numeric `pinocchio.Model` and returns a `casadi.Function` of SX expressions.
q is Pinocchio's configuration (a planar joint has x, y, cos θ, sin θ); v and a are in its tangent
space. Entries that vanish at every configuration are structural zeros. Upstream's
`pinocchio.casadi` builds the functions if it can be imported, otherwise a small compiled module;
`BuildError` says if that is missing or does not fit the installed packages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arguments import check_choice, check_instance, check_integer, check_list

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

_ROTATION_ROUNDING = 4e-16  # of the entries of a rotation matrix
# values of pinocchio.ReferenceFrame
_REFERENCE_FRAMES = {"world": 0, "local": 1, "local_world_aligned": 2}


@cache
def _get_backend() -> Callable[..., casadi.Function]:
    """Return the backend, chosen at the first use so that importing this package is fast."""
    from vkc_pin.planning.kinematics import backends

    try:
        import_module("pinocchio.casadi")
    except ImportError:
        return backends.build_compiled
    return backends.build_upstream


def backend_name() -> str:
    """Return the name of the backend in use.

    Returns:
        "upstream" (`pinocchio.casadi`) or "compiled" (this package's own module).
    """
    return _get_backend().__name__.removeprefix("build_")


def joint_placements(model: pin.Model, given: Sequence[int] = ()) -> casadi.Function:
    """Return the function q → M of the placements of all joints in the world.

    Args:
        model: The model, with nq configuration entries and njoints joints including the universe.
        given: Joints whose placement on their parent is an argument P of the function, instead of
            the model's. So one function serves all models that differ in these placements.

    Returns:
        q, shape (nq, 1), and if any joints are `given`, P, shape (12, len(given)) → M, shape (12,
        njoints - 1). Column i belongs to joint i + 1 (the universe is omitted) and stacks the
        columns of the rotation matrix and the translation [m]: [R[:, 0]; R[:, 1]; R[:, 2]; t]; so
        do the columns of P.

    Raises:
        InputError: A given joint is not one of 1 to njoints - 1, or given twice.
    """
    listed: tuple[Any, ...] = check_list(given, "given", "a list of joints")
    indices = [check_integer(joint, "given", low=1) for joint in listed]
    if len(set(indices)) < len(indices) or max(indices, default=0) >= model.njoints:
        expected = f"different joints from 1 to {model.njoints - 1}"
        raise InputError("wrong joints", field="given", expected=expected, got=indices)
    return _get_backend()("joint_placements", _round_quarter_turns(model), indices)


def frame_placements(model: pin.Model, frames: Sequence[str | int]) -> casadi.Function:
    """Return the function q → M of the placements of selected frames in the world.

    Args:
        model: The model.
        frames: Names or indices of the frames, in the order of the columns.

    Returns:
        q, shape (nq, 1) → M, shape (12, len(frames)), columns as in `joint_placements`.

    Raises:
        UnknownNameError: The model has no such frame.
        InputError: Several different frames of the model have this name.
    """
    if isinstance(frames, str):
        frames = [frames]
    listed: tuple[Any, ...] = check_list(frames, "frames", "a list of frames")
    indices = [_find_frame(model, frame, f"frames[{i}]") for i, frame in enumerate(listed)]
    return _get_backend()("frame_placements", _round_quarter_turns(model), indices)


def frame_jacobian(
    model: pin.Model,
    frame: str | int,
    reference: Literal["local_world_aligned", "local", "world"] = "local_world_aligned",
) -> casadi.Function:
    """Return the function q → J of the Jacobian of a frame; its spatial velocity is J·v.

    Args:
        model: The model.
        frame: Name or index of the frame.
        reference: Point and axes of the velocity: frame origin and world axes
            ("local_world_aligned"), frame origin and frame axes ("local"), or world origin and
            world axes ("world").

    Returns:
        q, shape (nq, 1) → J, shape (6, nv); rows 0-2 linear [m/s], rows 3-5 angular [rad/s] per
        unit of v.

    Raises:
        UnknownNameError: The model has no such frame, or there is no such reference.
        InputError: Several different frames of the model have this name.
    """
    check_choice(reference, _REFERENCE_FRAMES, "reference", "reference")
    index = _find_frame(model, frame, "frame")
    return _get_backend()(
        "frame_jacobian", _round_quarter_turns(model), index, _REFERENCE_FRAMES[reference]
    )


def rnea(model: pin.Model) -> casadi.Function:
    """Return the function (q, v, a) → tau of inverse dynamics (recursive Newton-Euler).

    Args:
        model: The model, with inertias.

    Returns:
        q, shape (nq, 1), v [rad/s, m/s] and a [rad/s², m/s²], shape (nv, 1) → tau [N·m, N], shape
        (nv, 1).
    """
    return _get_backend()("rnea", _round_quarter_turns(model))


def center_of_mass(model: pin.Model) -> casadi.Function:
    """Return the function q → com of the centre of mass of the model.

    Args:
        model: The model, with inertias.

    Returns:
        q, shape (nq, 1) → com [m] in the world frame, shape (3, 1).
    """
    return _get_backend()("center_of_mass", _round_quarter_turns(model))


def _find_frame(model: pin.Model, frame: str | int, field: str) -> int:
    """Return the checked index of `frame` in `model.frames`."""
    names = [f.name for f in _round_quarter_turns(model).frames]
    if not isinstance(frame, str):
        number = check_integer(frame, field, low=-1)
        if not 0 <= number < len(names):
            raise UnknownNameError("frame", str(number), [f"0 to {len(names) - 1}"], field=field)
        return number
    found = [index for index, name in enumerate(names) if name == frame]
    if not found:
        raise UnknownNameError("frame", frame, names, field=field)
    first = model.frames[found[0]]
    # In a URDF a joint and a link may have frames of the same name. As long as they coincide,
    # either one will do.
    for index in found[1:]:
        other = model.frames[index]
        if other.parentJoint != first.parentJoint or other.placement != first.placement:
            raise InputError(
                f"several frames are named '{frame}'", field=field, expected="an index", got=found
            )
    return found[0]


def _round_quarter_turns(model: pin.Model) -> pin.Model:
    """Return a copy of `model` with exact quarter turns instead of cos(π/2) = 6e-17.

    Numbers other than 0 and ±1 make the functions of a UR5e on a planar base ten per cent slower.
    """
    import numpy as np
    import pinocchio as pin

    copy = check_instance(model, pin.Model, "model").copy()
    placements_of_frames = [frame.placement for frame in copy.frames]
    for placement in [*copy.jointPlacements, *placements_of_frames]:
        rotation = placement.rotation
        nearest = np.round(rotation)
        is_rounding = np.abs(rotation - nearest) <= _ROTATION_ROUNDING
        placement.rotation = np.where(is_rounding, nearest, rotation)
    return copy
