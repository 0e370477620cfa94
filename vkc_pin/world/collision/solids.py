"""Converts coal shapes and their placements to the arrays of the compiled module."""

from __future__ import annotations

import os
import weakref
from collections.abc import Sequence
from functools import cache
from typing import Any

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import BuildError, InputError
from vkc_pin.utils.arrays import Floats
from vkc_pin.utils.optional_imports import REBUILD_HINT, import_compiled
from vkc_pin.utils.system import count_cores
from vkc_pin.world.files.meshes import get_triangles

_MAX_THREADS = 8
_cache: dict[int, tuple[weakref.ref[Any], bytes, float, Any]] = {}  # by the id of the shape
_SIZE = 12


def count_threads() -> int:
    """Return the number of threads to use.

    That is the number of cores available to this process, limited to 8 and to `OMP_NUM_THREADS`.
    """
    requested = os.environ.get("OMP_NUM_THREADS", "")
    cores = count_cores()
    return max(1, min(int(requested) if requested.isdigit() else cores, cores, _MAX_THREADS))


@cache
def load_compiled() -> Any:
    """Return the compiled module, after importing coal and Pinocchio, whose libraries it uses."""
    module = import_compiled("vkc_pin.world.collision._distances")
    for package, version, installed in (
        ("coal", module.COAL_VERSION, coal.__version__),
        ("pin", module.PINOCCHIO_VERSION, pin.__version__),
    ):
        built = version.split(".")[:2]
        if built != installed.split(".")[:2]:
            raise BuildError(
                f"vkc_pin.world.collision was compiled against {package} {version}, "
                f"but {installed} is installed. "
                f"Either pip install '{package}=={'.'.join(built)}.*', or {REBUILD_HINT}"
            )
    return module


def convert_solid(shape: coal.CollisionGeometry) -> Any:
    """Return a coal shape as an object of the compiled module, with its swept sphere radius.

    Convex shapes and meshes are cached as long as the shape lives and its points do not change.
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


def _convert_cached(shape: Any, points: Floats, radius: float) -> Any:
    key, content = id(shape), points.tobytes()
    if key in _cache:
        owner, before, swept, solid = _cache[key]
        if owner() is shape and before == content and swept == radius:
            return solid
    faces = get_triangles(shape)
    solid = (
        load_compiled().convex(points, faces, radius)
        if isinstance(shape, coal.Convex)
        else load_compiled().mesh(points, faces)
    )
    _cache[key] = (weakref.ref(shape, lambda _: _cache.pop(key, None)), content, radius, solid)
    return solid


def flatten_placements(placements: Sequence[pin.SE3]) -> Floats:
    """Return placements as rows of numbers, shape (n, 12).

    Each row has the columns of the rotation, then the translation [m].
    """
    rows = np.empty((len(placements), _SIZE))
    for row, placement in zip(rows, placements, strict=True):
        row[:9], row[9:] = placement.rotation.T.ravel(), placement.translation
    return rows


class ShapePlacements:
    """Forward kinematics of the shapes of a model, equal to Pinocchio's bit for bit.

    Args:
        model: The model.
        geometry: The M shapes on its joints.
    """

    def __init__(self, model: pin.Model, geometry: pin.GeometryModel) -> None:
        shapes, serialized = geometry.geometryObjects, pin.serialization.StreamBuffer()
        model.saveToBinary(serialized)
        content = bytes(serialized.view())  # tobytes() would leak a view at every call
        joints = np.array([shape.parentJoint for shape in shapes], np.int64)
        self.compiled: Any = load_compiled().Bodies(
            content, joints, flatten_placements([shape.placement for shape in shapes])
        )

    def compute_placements(self, q: Floats) -> Floats:
        """Return the placements of the shapes in the world frame, shape (W, M, 12).

        Args:
            q: Pinocchio configurations, shape (W, nq).

        Returns:
            Placements in the format of `flatten_placements`.
        """
        return np.asarray(self.compiled.placements(q), float)
