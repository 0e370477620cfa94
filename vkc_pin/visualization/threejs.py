"""Builds triangle meshes, and three.js elements that meshcat-python lacks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import coal
import meshcat.geometry as g
import numpy as np
import pinocchio as pin
from meshcat.path import Path
from numpy.typing import NDArray

from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.meshes import MeshPart, simplify_mesh
from vkc_pin.world.models.shapes import triangulate

# Faces that meet at a larger angle keep an edge between them.
_CREASE = np.radians(35.0)
# sides of a tube
_SIDES = 8
# [m] rounding of vertices, and rounding of normals, for better compression
_GRAIN = 2.0**-14
_NORMAL_GRAIN = 2.0**-6
# that a process keeps: robots are drawn again and again
_MAX_CACHED_SOLIDS = 512
_GHOST_OPACITY = 0.30
# [m] distance of the sun
_SUN_DISTANCE = 20.0


@dataclass(frozen=True, eq=False)
class Solid:
    """A triangle mesh with a normal at every vertex.

    Attributes:
        vertices: Shape (n, 3), float32 [m].
        faces: Shape (m, 3), uint32, indices of vertices, counter-clockwise seen from outside.
        normals: Unit vectors, shape (n, 3), float32.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.uint32]
    normals: NDArray[np.float32]

    def transform(self, placement: pin.SE3) -> Solid:
        """Return the mesh transformed by `placement`."""
        rotation = np.asarray(placement.rotation)
        vertices = self.vertices @ rotation.T + np.asarray(placement.translation)
        normals = self.normals @ rotation.T
        return Solid(vertices.astype(np.float32), self.faces, normals.astype(np.float32))


def to_solid(shape: coal.CollisionGeometry) -> Solid:
    """Convert a coal shape to a mesh with smooth surfaces and sharp edges."""
    return shade(*triangulate(shape))


def shade(vertices: Floats, faces: NDArray[np.int64]) -> Solid:
    """Add normals to triangles; vertices on sharp edges are duplicated."""
    return _shade(np.asarray(vertices, float).tobytes(), np.asarray(faces, np.int64).tobytes())


@lru_cache(maxsize=_MAX_CACHED_SOLIDS)
def _shade(vertices: bytes, faces: bytes) -> Solid:
    """Add normals to triangles that are given by their bytes, for the cache."""
    import trimesh

    triangles = trimesh.Trimesh(
        np.frombuffer(vertices).reshape(-1, 3),
        np.frombuffer(faces, np.int64).reshape(-1, 3),
        process=False,
    )
    mesh = trimesh.graph.smooth_shade(triangles, angle=_CREASE)
    points = _round(mesh.vertices, _GRAIN)
    normals = _round(mesh.vertex_normals, _NORMAL_GRAIN)
    indices = np.asarray(mesh.faces, np.uint32)
    for array in (points, normals, indices):
        array.flags.writeable = False
    return Solid(points, indices, normals)


def _round(values: Any, grain: float) -> NDArray[np.float32]:
    """Round values to multiples of a power of two."""
    return (np.round(np.asarray(values) / grain) * grain).astype(np.float32)


def simplify(solid: Solid, width: float) -> Solid:
    """Simplify a mesh by merging the vertices in each cell of a grid of `width` [m]."""
    part = MeshPart(solid.vertices.astype(float), solid.faces.astype(np.int64))
    simple = simplify_mesh(part, width)
    return shade(simple.vertices, simple.faces)


def merge_solids(solids: list[Solid]) -> Solid:
    """Merge meshes into one."""
    faces: list[NDArray[np.uint32]] = []
    offset = 0  # vertices of the meshes before
    for solid in solids:
        faces.append(solid.faces + np.uint32(offset))
        offset += len(solid.vertices)
    return Solid(
        np.concatenate([solid.vertices for solid in solids]),
        np.concatenate(faces),
        np.concatenate([solid.normals for solid in solids]),
    )


def make_box(lower: Floats, upper: Floats, sides: tuple[int, ...] = (0, 1, 2, 3, 4, 5)) -> Solid:
    """Build sides of the box between two corners: 0, 1: −x, +x; 2, 3: −y, +y; 4, 5: −z, +z."""
    vertices: list[Floats] = []
    faces: list[NDArray[np.int64]] = []
    normals: list[Floats] = []
    for k, side in enumerate(sides):
        axis, is_positive = divmod(side, 2)
        u = (axis + 1) % 3
        v = (axis + 2) % 3
        # Around the side: (0, 0), (1, 0), (1, 1), (0, 1) along u and v.
        corners = np.tile(lower, (4, 1)).astype(float)
        corners[1:3, u] = upper[u]
        corners[2:4, v] = upper[v]
        if is_positive:
            corners[:, axis] = upper[axis]
            order = [[0, 1, 2], [0, 2, 3]]
            normal = np.eye(3)[axis]
        else:
            corners[:, axis] = lower[axis]
            order = [[0, 2, 1], [0, 3, 2]]
            normal = -np.eye(3)[axis]
        vertices.append(corners)
        faces.append(np.array(order) + 4 * k)
        normals.append(np.tile(normal, (4, 1)))
    return _make_solid(np.concatenate(vertices), np.concatenate(faces), np.concatenate(normals))


def make_tube(points: Floats, radius: float) -> Solid | None:
    """Build a tube of `radius` [m] along `points`, shape (n, 3) [m]; browsers draw lines too thin.

    Returns:
        The tube, or None if the points lie within a radius of each other.
    """
    kept = [0]
    for i in range(1, len(points)):
        if np.linalg.norm(points[i] - points[kept[-1]]) > radius / 2.0:
            kept.append(i)
    line = np.asarray(points, float)[kept]
    if len(line) < 2:
        return None
    along = np.gradient(line, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    # A direction across the line at each point, carried along without twist.
    across = np.empty_like(line)
    side = np.eye(3)[int(np.argmin(np.abs(along[0])))]
    for i, direction in enumerate(along):
        side = side - direction * (side @ direction)
        side /= max(float(np.linalg.norm(side)), 1e-9)
        across[i] = side
    other = np.cross(along, across)
    angles = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    cosines = np.cos(angles)[None, :, None]
    sines = np.sin(angles)[None, :, None]
    normals = cosines * across[:, None] + sines * other[:, None]
    vertices = line[:, None] + radius * normals
    # Two triangles between neighbouring vertices a and b of a ring and those of the next ring.
    ring, k = np.meshgrid(np.arange(len(line) - 1) * _SIDES, np.arange(_SIDES), indexing="ij")
    a = ring + k
    b = ring + (k + 1) % _SIDES
    first = np.stack([a, b, b + _SIDES], axis=-1)
    second = np.stack([a, b + _SIDES, a + _SIDES], axis=-1)
    faces = np.concatenate([first, second])
    return _make_solid(vertices.reshape(-1, 3), faces.reshape(-1, 3), normals.reshape(-1, 3))


def _make_solid(vertices: NDArray[Any], faces: NDArray[Any], normals: NDArray[Any]) -> Solid:
    return Solid(vertices.astype(np.float32), faces.astype(np.uint32), normals.astype(np.float32))


class Triangles(g.TriangularMeshGeometry):
    """Triangles with the normals of a `Solid`."""

    def __init__(self, solid: Solid) -> None:
        super().__init__(solid.vertices, solid.faces)
        self.normals = solid.normals

    def lower(self, object_data: dict[str, Any]) -> dict[str, Any]:
        """Return three.js JSON."""
        data: dict[str, Any] = super().lower(object_data)
        data["data"]["attributes"]["normal"] = g.pack_numpy_array(self.normals.T)
        return data


class Ghost(g.Object):
    """A translucent body without visible back faces: it is drawn into the depth buffer first."""

    def __init__(self, solid: Solid, colour: Sequence[float]) -> None:
        flat = g.MeshLambertMaterial(
            color=encode_colour(colour), opacity=_GHOST_OPACITY, transparent=True, side=2
        )
        super().__init__(Triangles(solid), flat)
        self.depth = g.MeshBasicMaterial(transparent=True, side=2, colorWrite=False)

    def lower(self) -> dict[str, Any]:
        """Return three.js JSON."""
        data: dict[str, Any] = {
            "metadata": {"version": 4.5, "type": "Object"},
            "geometries": [],
            "materials": [],
        }
        self.geometry.lower_in_object(data)
        children = []
        for order, layer in enumerate((self.depth, self.material)):
            layer.lower_in_object(data)
            mesh = {
                "type": "Mesh",
                "geometry": self.geometry.uuid,
                "material": layer.uuid,
                "renderOrder": order + 1,
            }
            children.append({"uuid": f"{self.uuid}-{order}", **mesh})
        data["object"] = {"uuid": self.uuid, "type": "Group", "children": children}
        return data


class Sun(g.Object):
    """A distant light that casts shadows over a room.

    Args:
        centre: Centre of the room, shape (3,) [m].
        reach: Radius of the room [m].
        camera: From the camera's target to the camera, shape (3,): the light comes from the left of
            there, and from above.
    """

    def __init__(self, centre: Floats, reach: float, camera: Floats) -> None:
        g.SceneElement.__init__(self)
        x, y, _ = camera
        towards = np.array([x, y, 0.0]) / max(1e-9, float(np.hypot(x, y)))
        left = np.array([towards[1], -towards[0], 0.0])
        up = np.array([0.0, 0.0, 1.0])
        direction = 0.35 * towards + 0.40 * left + 0.85 * up
        self.position = centre + _SUN_DISTANCE * direction
        self.reach = reach + 2.0

    def lower(self) -> dict[str, Any]:
        """Return three.js JSON."""
        matrix = np.eye(4)
        matrix[:3, 3] = self.position
        size = self.reach + float(np.linalg.norm(self.position[:2])) * 0.1
        box = {
            "left": -size,
            "right": size,
            "top": size,
            "bottom": -size,
            "near": 1.0,
            "far": 60.0,
        }
        camera = {"uuid": f"{self.uuid}-camera", "type": "OrthographicCamera", "zoom": 1.0, **box}
        shadow = {
            "bias": -0.0004,
            "normalBias": 0.02,
            "radius": 2.5,
            "mapSize": [2048, 2048],
            "camera": camera,
        }
        light = {
            "uuid": self.uuid,
            "type": "DirectionalLight",
            "color": 0xFFFFFF,
            "intensity": 0.5,
            "matrix": matrix.T.ravel().tolist(),
            "shadow": shadow,
        }
        return {
            "metadata": {"version": 4.5, "type": "Object"},
            "geometries": [],
            "materials": [],
            "object": light,
        }


class Unshadow:
    """A command that disables the shadow at `path`; meshcat's SetProperty lowers names."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def lower(self) -> dict[str, Any]:
        """Return the command as it is sent."""
        where = self.path.append("<object>").lower()
        return {"type": "set_property", "path": where, "property": "castShadow", "value": False}


def make_material(
    colour: Sequence[float], opacity: float = 1.0, *, one_sided: bool = False
) -> g.Material:
    """Make a slightly shiny material; translucent ones do not write to the depth buffer."""
    return g.MeshPhongMaterial(
        color=encode_colour(colour),
        opacity=opacity,
        depthWrite=opacity >= 1.0,
        shininess=25,
        specular=0x1A1A1A,
        side=0 if one_sided else 2,
    )


def encode_colour(colour: Sequence[float]) -> int:
    """Encode red, green and blue in [0, 1] as one integer."""
    red, green, blue = (round(255.0 * min(1.0, max(0.0, float(c)))) for c in colour[:3])
    return (red << 16) + (green << 8) + blue


def add_node(taken: set[str], above: str, *names: str) -> str:
    """Return the path of a new node in the viewer's tree, and add it to `taken`.

    Invalid characters become "_", and "_" is appended until the path is unique.
    """
    valid = [re.sub(r"[^\w.\-]", "_", name) for name in names]
    path = "/".join([above, *valid])
    while path in taken:
        path += "_"
    taken.add(path)
    return path
