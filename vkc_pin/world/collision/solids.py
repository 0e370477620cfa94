"""coal's shapes rebuilt in compiled code, from their numbers."""

from __future__ import annotations

import weakref
from functools import cache
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import BuildError, InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import REBUILD, compiled_module
from vkc_pin.world.files.meshes import indices

__all__ = ["convert_solid", "load_compiled"]


@cache
def load_compiled() -> Any:
    """Return the compiled module, imported once and after coal and Pinocchio, whose libraries it uses.

    Raises:
        BuildError: It is missing, or was compiled against another release of one of these than is
            installed.
    """
    module = compiled_module("vkc_pin.world.collision._distances")
    for package, version, installed in (
        ("coal", module.COAL_VERSION, coal.__version__),
        ("pin", module.PINOCCHIO_VERSION, pin.__version__),
    ):
        built = version.split(".")[:2]
        if built != installed.split(".")[:2]:
            raise BuildError(
                f"vkc_pin.world.collision was compiled against {package} {version}, but {installed} is installed. "
                f"Either pip install '{package}=={'.'.join(built)}.*', or {REBUILD}"
            )
    return module


def convert_solid(shape: coal.CollisionGeometry) -> Any:
    """Return a coal shape as the compiled module has it, with the same numbers and the radius that is swept around it.

    What is made of points and faces is kept as long as the shape lives and its points stay the
    same.

    Raises:
        InputError: It is of a kind that is not known here.
        BuildError: See `load_compiled`.
    """
    if isinstance(shape, coal.Convex):
        return _convert_cached(
            shape, np.asarray(shape.points(), np.float64), float(shape.getSweptSphereRadius())
        )
    if isinstance(shape, coal.BVHModelOBBRSS):
        return _convert_cached(shape, np.asarray(shape.vertices(), np.float64), 0.0)
    if isinstance(shape, coal.Box):
        numbers = shape.halfSide
    elif isinstance(shape, coal.Sphere):
        numbers = (shape.radius,)
    elif isinstance(shape, coal.Ellipsoid):
        numbers = shape.radii
    elif isinstance(shape, coal.Capsule | coal.Cone | coal.Cylinder):
        numbers = (shape.radius, shape.halfLength)
    elif isinstance(shape, coal.TriangleP):
        numbers = (*shape.a, *shape.b, *shape.c)
    elif isinstance(shape, coal.Halfspace | coal.Plane):
        numbers = (*shape.n, shape.d)
    else:
        known = "a primitive, a convex shape or a mesh (BVHModelOBBRSS)"
        raise InputError(
            "distances to this kind of shape are not known",
            expected=known,
            got=type(shape).__name__,
        )
    return load_compiled().primitive(
        type(shape).__name__,
        np.asarray(numbers, float).tolist(),
        float(shape.getSweptSphereRadius()),
    )


_known: dict[int, tuple[weakref.ref[Any], bytes, float, Any]] = {}  # by the id of a shape


def _convert_cached(shape: Any, points: Floats, radius: float) -> Any:
    """Return a shape of points and faces, rebuilt if it is not known with these points: faces are slow to read."""
    key, content = id(shape), points.tobytes()
    if key in _known:
        owner, before, swept, solid = _known[key]
        if owner() is shape and before == content and swept == radius:
            return solid
    faces = indices(shape)
    solid = (
        load_compiled().convex(points, faces, radius)
        if isinstance(shape, coal.Convex)
        else load_compiled().mesh(points, faces)
    )
    _known[key] = (weakref.ref(shape, lambda _: _known.pop(key, None)), content, radius, solid)
    return solid
