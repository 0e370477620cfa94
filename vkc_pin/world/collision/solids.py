"""Converts coal shapes and their placements to the arrays of the compiled module."""

from __future__ import annotations

import os
import weakref
from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import BuildError, InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import REBUILD_HINT, import_compiled
from vkc_pin.utils.system import count_cores
from vkc_pin.world.collision.point_cloud import PointCloud
from vkc_pin.world.files.meshes import get_triangles

_MAX_THREADS = 8
_PLACEMENT_SIZE = 12
FIRST_TRANSLATION = 9
"""Index of the translation among the numbers of a placement."""


class _Cached(NamedTuple):
    """A solid of a shape, with the values of the shape when it was converted."""

    owner: weakref.ref[Any]
    points: bytes
    radius: float
    solid: Any


_cache: dict[int, _Cached] = {}  # id of the shape → its solid


def count_threads() -> int:
    """Return the number of threads to use.

    That is the number of cores available to this process, limited to 8 and to `OMP_NUM_THREADS`.
    """
    threads = min(count_cores(), _MAX_THREADS)
    requested = os.environ.get("OMP_NUM_THREADS", "")
    if requested.isdigit():
        threads = min(threads, int(requested))
    return max(1, threads)


@cache
def load_compiled() -> Any:
    """Return the compiled module, after importing coal and Pinocchio, whose libraries it uses."""
    module = import_compiled("vkc_pin.world.collision._distances")
    _check_version("coal", module.COAL_VERSION, coal.__version__)
    _check_version("pin", module.PINOCCHIO_VERSION, pin.__version__)
    return module


def _check_version(package: str, version: str, installed: str) -> None:
    """Raise `BuildError` if the compiled module was built with another minor version."""
    built = version.split(".")[:2]
    if built != installed.split(".")[:2]:
        raise BuildError(
            f"vkc_pin.world.collision was compiled against {package} {version}, "
            f"but {installed} is installed. "
            f"Either pip install '{package}=={'.'.join(built)}.*', or {REBUILD_HINT}"
        )


def convert_solid(shape: coal.CollisionGeometry) -> Any:
    """Return a coal shape as an object of the compiled module, with its swept sphere radius.

    Convex shapes, meshes and points are cached as long as the shape lives and its points do not
    change.
    """
    if isinstance(shape, PointCloud):
        return _convert_with_cache(shape, shape.points, shape.radius)
    if isinstance(shape, coal.Convex):
        points = np.asarray(shape.points(), np.float64)
        return _convert_with_cache(shape, points, float(shape.getSweptSphereRadius()))
    if isinstance(shape, coal.BVHModelOBBRSS):
        vertices = np.asarray(shape.vertices(), np.float64)
        return _convert_with_cache(shape, vertices, 0.0)
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
        supported = "a primitive, a convex shape or a mesh (BVHModelOBBRSS)"
        raise InputError(
            "distances to this kind of shape are not known",
            expected=supported,
            got=type(shape).__name__,
        )
    return load_compiled().primitive(
        type(shape).__name__,
        np.asarray(numbers, float).tolist(),
        float(shape.getSweptSphereRadius()),
    )


def _convert_with_cache(shape: Any, points: Floats, radius: float) -> Any:
    key = id(shape)
    content = points.tobytes()
    cached = _cache.get(key)
    if cached is not None:
        # Python gives the id of a deleted shape to a later one.
        is_owner = cached.owner() is shape
        if is_owner and cached.points == content and cached.radius == radius:
            return cached.solid
    if isinstance(shape, PointCloud):
        solid = load_compiled().points(points, radius)
    elif isinstance(shape, coal.Convex):
        solid = load_compiled().convex(points, get_triangles(shape), radius)
    else:
        solid = load_compiled().mesh(points, get_triangles(shape))
    owner = weakref.ref(shape, lambda _: _cache.pop(key, None))
    _cache[key] = _Cached(owner, content, radius, solid)
    return solid


def flatten_placements(placements: Sequence[pin.SE3]) -> Floats:
    """Return placements as rows of numbers, shape (n, 12).

    Each row has the columns of the rotation, then the translation [m].
    """
    rows = np.empty((len(placements), _PLACEMENT_SIZE))
    for row, placement in zip(rows, placements, strict=True):
        row[:FIRST_TRANSLATION] = placement.rotation.T.ravel()
        row[FIRST_TRANSLATION:] = placement.translation
    return rows
