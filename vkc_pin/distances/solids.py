"""coal's shapes rebuilt in compiled code, from their numbers."""

from __future__ import annotations

import weakref
from functools import cache
from importlib import import_module
from typing import Any

import coal
import numpy as np

from vkc_pin.arrays import Floats, Ints
from vkc_pin.errors import BuildError, InputError

__all__ = ["compiled", "indices", "solid_of"]

_REBUILD = "build vkc-pin again: pip install --force-reinstall --no-deps --no-cache-dir vkc-pin (in a checkout: '.')"


def _settle_boxes() -> None:
    """Let coal take boxes as they are, whatever it is asked first.

    coal 3.0.3 decides once per process, from the first direction in which it looks for a box's furthest corner, whether boxes are
    1e-10 larger on their negative sides: yes if a component is zero (a `static` in `getShapeSupport`, gone in later versions). So
    the first question of a process would decide on the last digits of every distance to a box. This one has no such component.
    The compiled module asks the same library, so that it holds there as well.
    """
    turned = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    box, here, there = coal.Box(1.0, 1.0, 1.0), coal.Transform3s(), coal.Transform3s(turned, np.array([3.0, 0.4, 0.2]))
    plane = coal.Halfspace(np.array([0.36, 0.48, 0.8]), 0.0)  # for the other one, of shapes with a swept sphere
    for shape, where in ((coal.Capsule(0.1, 0.5), there), (plane, here)):
        coal.distance(shape, here, box, where, coal.DistanceRequest(), coal.DistanceResult())


_settle_boxes()


@cache
def compiled() -> Any:
    """Return the compiled module, imported once and after coal, whose library it uses.

    Raises:
        BuildError: It is missing, or was compiled against another release of coal than is installed.
    """
    try:
        module = import_module("vkc_pin.distances._distances")
    except ImportError as error:
        raise BuildError(
            f"the compiled module vkc_pin.distances._distances cannot be imported ({error}). It is built when vkc-pin is "
            f"installed, which needs a C++17 compiler (Debian, Ubuntu: apt install g++); then {_REBUILD}"
        ) from error
    built, installed = (version.split(".")[:2] for version in (module.COAL_VERSION, coal.__version__))
    if built != installed:
        raise BuildError(
            f"vkc_pin.distances was compiled against coal {module.COAL_VERSION}, but {coal.__version__} is installed. "
            f"Either pip install 'coal=={'.'.join(built)}.*', or {_REBUILD}"
        )
    return module


def solid_of(shape: coal.CollisionGeometry) -> Any:
    """Return a coal shape as the compiled module has it, with the same numbers and the radius that is swept around it.

    What is made of points and faces is kept as long as the shape lives and its points stay the same.

    Raises:
        InputError: It is of a kind that is not known here.
        BuildError: See `compiled`.
    """
    if isinstance(shape, coal.Convex):
        return _kept(shape, np.asarray(shape.points(), np.float64), float(shape.getSweptSphereRadius()))
    if isinstance(shape, coal.BVHModelOBBRSS):
        return _kept(shape, np.asarray(shape.vertices(), np.float64), 0.0)
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
        raise InputError("distances to this kind of shape are not known", expected=known, got=type(shape).__name__)
    return compiled().primitive(type(shape).__name__, np.asarray(numbers, float).tolist(), float(shape.getSweptSphereRadius()))


_known: dict[int, tuple[weakref.ref[Any], bytes, float, Any]] = {}  # by the id of a shape


def _kept(shape: Any, points: Floats, radius: float) -> Any:
    """Return a shape of points and faces, rebuilt if it is not known with these points: faces are slow to read."""
    key, content = id(shape), points.tobytes()
    if key in _known:
        owner, before, swept, solid = _known[key]
        if owner() is shape and before == content and swept == radius:
            return solid
    faces = indices(shape)
    solid = compiled().convex(points, faces, radius) if isinstance(shape, coal.Convex) else compiled().mesh(points, faces)
    _known[key] = (weakref.ref(shape, lambda _: _known.pop(key, None)), content, radius, solid)
    return solid


def indices(shape: coal.Convex | coal.BVHModelBase) -> Ints:
    """Return the corners of the triangles of a coal shape, shape (m, 3)."""
    convex = isinstance(shape, coal.Convex)
    count, item = (shape.num_polygons, shape.polygons) if convex else (shape.num_tris, shape.tri_indices)
    return np.array([[triangle[i] for i in range(3)] for triangle in map(item, range(count))], np.int64).reshape(-1, 3)
