"""Reads mesh files and converts them to coal shapes, whose volume and area are checked.

Meshes are read with trimesh: coal 3.0.3 restarts the triangle indices at every object of an OBJ
file and at every material of a COLLADA file. Only COLLADA files (`.dae`) are read by
`vkc_pin.world.files.collada`. In glTF files y points up, by their specification; as in RViz 2,
Drake and Blender, they are turned such that z does.
"""

from __future__ import annotations

import codecs
import contextlib
import hashlib
import io
import json
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import coal
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arrays import MAX_COORDINATE, Floats, Ints
from vkc_pin.utils.disk_cache import load_or_build
from vkc_pin.utils.interrupt import defer_interrupt
from vkc_pin.utils.optional_imports import import_optional
from vkc_pin.world.files.collada import read_collada
from vkc_pin.world.files.gltf import GLTF_SUFFIXES, GLTF_TO_Z_UP, check_gltf
from vkc_pin.world.files.hulls import SHEET_THICKNESS, compute_hull, compute_outer_hull, thicken
from vkc_pin.world.files.polygon_files import (
    divide_polygons,
    is_plain_obj,
    normalize_obj,
    read_off,
)
from vkc_pin.world.files.resources import check_path

if TYPE_CHECKING:
    import trimesh


_MAX_NEIGHBOURS = 255  # coal's corners have no more
_MAX_CACHED_HULLS = 512  # that a process keeps: robots are loaded again and again
# Of the hulls on disk: increase it whenever the same file would get another hull.
_HULL_VERSION = 1
_MAX_KEPT_MESHES = 256  # for display, likewise: a robot has 20
_SMALLEST = 1e-6  # [m] size of meshes, below which triangles have no area in floating point
_HULL_TOLERANCE = 1e-6  # relative difference between coal's volume and area and trimesh's
_SMALL_HULL_VERTICES = 60  # of hulls that replace those with corners of too many neighbours


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Triangles of one colour.

    Attributes:
        vertices: Shape (n, 3) [m].
        faces: Shape (m, 3), indices of vertices.
        colour: Red, green, blue, opacity in [0, 1], or None if the file has none.
    """

    vertices: Floats
    faces: NDArray[np.int64]
    colour: tuple[float, float, float, float] | None = None


def load_mesh(
    path: str | Path, scale: ArrayLike = (1.0, 1.0, 1.0), *, submesh: str | None = None
) -> trimesh.Trimesh:
    """Return a mesh file as one mesh of all its objects, in the file's frame [m].

    glTF files are turned from y up to z up.

    Args:
        path: OBJ, STL, PLY, OFF, glTF or COLLADA file.
        scale: Factor from the file's unit to [m], or one for each axis, of glTF files after they
            are turned. COLLADA files state their unit, which counts as well.
        submesh: Name of an object, group or node, to read it alone.

    Raises:
        InputError: There is no such file, or it is not a valid mesh.
        UnknownNameError: The file has no such submesh.
    """
    # trimesh catches Ctrl-C while it imports others, and would go on without them.
    with defer_interrupt():
        import trimesh

    file = check_path(path, "path", "a mesh file")
    factors = _check_scale(file, scale)
    if not file.is_file():
        raise InputError("there is no such mesh", file=file, expected="a mesh file")
    try:
        mesh = _read_mesh(file, submesh)
    except InputError:
        raise
    except ModuleNotFoundError as error:
        purpose = "a mesh file with text that is not UTF-8"  # trimesh guesses its encoding
        import_optional(error.name or "", "import", purpose=purpose, file=file)
        raise
    except Exception as error:  # readers raise any type
        expected = "an OBJ, STL, PLY, OFF, glTF or COLLADA file"
        raise InputError(f"cannot read the mesh: {error}", file=file, expected=expected) from error
    if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
        raise InputError("the mesh is empty", file=file, expected="at least one triangle")
    if np.shape(mesh.vertices)[1:] != (3,):
        raise InputError(
            "cannot read the mesh: its vertices have no three coordinates",
            file=file,
            expected="x, y and z of each",
        )
    if not np.isfinite(mesh.vertices).all():
        raise InputError(
            "the mesh has vertices that are no numbers", file=file, expected="finite coordinates"
        )
    with np.errstate(over="ignore"):
        farthest = float(np.abs(mesh.vertices * factors).max())
    if farthest > MAX_COORDINATE:
        raise InputError(
            "the mesh is out of range",
            file=file,
            expected=f"coordinates up to {MAX_COORDINATE:g} m",
            got=f"{farthest:g}",
        )
    mesh.apply_transform(np.diag([*factors, 1.0]))
    return mesh


def _read_mesh(file: Path, submesh: str | None) -> Any:
    """Return trimesh's object of a file, normally a mesh, with z up if the format states its axes.

    Files without faces become other objects, such as point clouds.
    """
    import trimesh

    kind = file.suffix.lower()
    if kind == ".dae":
        vertices, faces, unit = read_collada(file, submesh)
        # Vertices that coincide are merged in the file's unit.
        return trimesh.Trimesh(vertices, faces).apply_scale(unit)
    if kind == ".off":
        return trimesh.Trimesh(*read_off(file.read_bytes(), file))
    source, settings = _open_mesh(file, submesh)
    scene = trimesh.load_scene(source, force="mesh", skip_materials=True, **settings)
    if submesh is not None and kind != ".obj":
        scene = _extract_submesh(scene, file, submesh)
    mesh = scene.to_mesh()
    if kind == ".ply":
        vertices, polygons = _find_polygons(mesh)
        if polygons:
            mesh = trimesh.Trimesh(vertices, divide_polygons(vertices, polygons, file))
    if kind in GLTF_SUFFIXES:
        mesh.apply_transform(GLTF_TO_Z_UP)
    return mesh


def _find_polygons(mesh: trimesh.Trimesh) -> tuple[Floats, list[Ints]]:
    """Return vertices and polygons of a PLY file as trimesh keeps them beside its triangles.

    There are none if all are triangles.
    """
    elements = mesh.metadata.get("_ply_raw", {})
    if not {"vertex", "face"} <= set(elements):
        return np.empty((0, 3)), []
    points = elements["vertex"]["data"]
    vertices = np.column_stack([np.asarray(points[axis], float) for axis in "xyz"])
    faces = elements["face"]["data"]
    is_text = isinstance(faces, dict)
    names = list(faces) if is_text else list(faces.dtype.names)
    # The property is called vertex_index or vertex_indices.
    vertex_names = [name for name in names if name.startswith("vertex_ind")]
    indices = faces[vertex_names[0] if vertex_names else names[0]]
    # Lists in binary files hold their length and their items.
    polygons = indices if is_text else indices["f1"]
    are_triangles = np.shape(polygons) == (len(polygons), 3)
    if are_triangles:
        return vertices, []
    return vertices, [np.array(polygon, np.int64) for polygon in polygons]


def _extract_submesh(scene: trimesh.Scene, file: Path, submesh: str) -> trimesh.Scene:
    """Return the part of a scene whose node or geometry has a name."""
    import trimesh

    found = trimesh.Scene()
    names = dict[str, None]()
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        names[str(node)] = None
        names[str(geometry)] = None
        if submesh in (str(node), str(geometry)):
            found.add_geometry(scene.geometry[geometry], transform=transform)
    if not found.geometry:
        raise UnknownNameError("submesh", submesh, names, file=file)
    return found


def _open_mesh(file: Path, submesh: str | None = None) -> tuple[Path | io.BytesIO, dict[str, Any]]:
    """Return the file or data that trimesh reads, and its settings.

    Files that trimesh would misread are changed in memory.
    """
    settings: dict[str, Any] = {"resolver": _make_resolver(file)}
    kind = file.suffix.lower()[1:]
    if f".{kind}" in GLTF_SUFFIXES:
        check_gltf(file)
    if kind not in ("obj", "gltf"):
        return file, settings
    data = file.read_bytes()
    is_utf16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if is_utf16:
        data = data.decode("utf-16").encode()
    if kind == "obj" and (submesh is not None or not is_plain_obj(data)):
        data = normalize_obj(data, file, submesh)
    elif is_utf16 or data.startswith(codecs.BOM_UTF8):
        data = data.removeprefix(codecs.BOM_UTF8)
    else:
        return file, settings
    settings["file_type"] = kind
    return io.BytesIO(data), settings


def _make_resolver(file: Path) -> Any:
    """Return trimesh's reader of materials and buffers that a mesh names, without pipes.

    glTF files name them by URIs, whose reserved characters are escaped.
    """
    import trimesh

    resolver: Any = trimesh.resolvers.FilePathResolver(str(file))
    is_gltf = file.suffix.lower() in GLTF_SUFFIXES
    read = resolver.get

    def get(name: str) -> bytes:
        if is_gltf and not (file.parent / name).exists():
            name = unquote(name)
        for place in _list_places(file, name):
            # A pipe or a device may be endless.
            if place.exists() and not place.is_file():
                raise FileNotFoundError(f"{place} is not a regular file")
        return bytes(read(name))

    resolver.get = get
    return resolver


def _list_places(file: Path, name: str) -> tuple[Path, Path]:
    """Return the places at which trimesh looks for a file that a mesh names."""
    return file.parent / name.strip(), file.parent / Path(name).name


def load_convex(
    path: str | Path, scale: ArrayLike = (1.0, 1.0, 1.0), *, about: str | None = None
) -> coal.Convex:
    """Return the convex hull of a mesh file as a coal shape, in the file's frame [m].

    Args:
        path: Mesh file; see `load_mesh`.
        scale: Factor from the file's unit to [m], or one for each axis.
        about: Link or obstacle of the mesh, for warnings and errors.
    """
    file = check_path(path, "path", "a mesh file")
    if file.is_file():
        stat = file.stat()
        version = (stat.st_mtime_ns, stat.st_size)
        # An error is raised below, with `about`.
        with contextlib.suppress(InputError):
            factors = tuple(_check_scale(file, scale).tolist())
            hull = _load_hull(file.absolute(), version, factors)
            if hull is not None:
                return hull
    points = load_mesh(path, scale).vertices
    return make_convex_hull(points, file=path, about=about)


@lru_cache(maxsize=_MAX_CACHED_HULLS)
def _load_hull(
    file: Path, version: tuple[int, int], scale: tuple[float, ...]
) -> coal.Convex | None:
    """Return the hull of a version of a mesh file; None if it is flat, since each use warns.

    Corners and triangles are cached on disk: neither trimesh nor SciPy is imported for a hull that
    is cached. glTF files are read again, because their buffers may be in other files.
    """

    def build() -> tuple[list[list[float]], list[list[int]]] | None:
        points = load_mesh(file, scale).vertices
        _, is_flat = thicken(np.asarray(points, float))
        if is_flat:
            return None
        hull = make_convex_hull(points, file=file)
        return np.asarray(hull.points()).tolist(), get_triangles(hull).tolist()

    kind = file.suffix.lower()
    if kind == ".gltf":
        found = build()
    else:
        content = hashlib.sha256(file.read_bytes()).hexdigest()
        key = json.dumps(("hull", _HULL_VERSION, kind, scale, content))
        found = load_or_build(key.encode(), build)
    return None if found is None else _make_convex(*found)


def _make_convex(vertices: ArrayLike, triangles: Iterable[Iterable[int]]) -> coal.Convex:
    """Return a coal shape of the corners, shape (n, 3) [m], and triangles of a hull."""
    corners = coal.StdVec_Vec3s()
    corners.extend(np.asarray(vertices, float))
    faces = coal.StdVec_Triangle()
    faces.extend(coal.Triangle(*triangle) for triangle in triangles)
    shape = coal.Convex(corners, faces)
    shape.computeLocalAABB()
    return shape


def make_convex_hull(
    points: ArrayLike, *, file: str | Path | None = None, about: str | None = None
) -> coal.Convex:
    """Return the convex hull of points, shape (n, 3) [m], as a coal shape.

    Coplanar points, such as those of a picture, become a plate of 1 mm, with a warning.

    Args:
        points: The points.
        file: File of the points, for warnings and errors.
        about: Link or obstacle of the points, for warnings and errors.
    """
    given = np.asarray(points, float)
    if not len(given):
        raise InputError("a hull of nothing", file=file, field=about, expected="at least one point")
    given, was_flat = thicken(given)
    size = float(np.ptp(given, axis=0).max())
    if size < _SMALLEST:
        raise InputError(
            "the mesh is too small: is its unit or scale wrong?",
            file=file,
            field=about,
            expected=f"a size of at least {_SMALLEST:g} m",
            got=f"{size:.3g}",
        )
    if was_flat:
        names = [str(part) for part in (about, file) if part is not None]
        name = " of ".join(names) or "a mesh"
        warnings.warn(
            f"{name} is flat: it collides as a plate, {1e3 * SHEET_THICKNESS:g} mm thick",
            stacklevel=2,
        )
    hull = compute_hull(given)
    # The tip of a finely meshed cone, and the middle of a fine disc, have many neighbours.
    faces_per_corner = np.bincount(np.asarray(hull.faces).ravel())
    if faces_per_corner.max() > _MAX_NEIGHBOURS:
        hull = compute_outer_hull(hull.vertices, vertices=_SMALL_HULL_VERTICES)
    shape = _make_convex(hull.vertices, np.asarray(hull.faces).tolist())
    volume, area = _measure(shape)
    for quantity, measured, expected in (
        ("volume", volume, hull.volume),
        ("area", area, hull.area),
    ):
        is_equal = abs(measured - expected) <= _HULL_TOLERANCE * abs(expected)
        if not is_equal or expected <= 0.0:
            problem = f"coal does not hold this hull: wrong {quantity}"
            raise InputError(problem, file=file, field=about, expected=expected, got=measured)
    return shape


def _measure(shape: coal.Convex) -> tuple[float, float]:
    """Return the volume [m³] and the area [m²] of a coal shape.

    The triangle a, b, c has the area |(b − a) × (c − a)| / 2, and spans with the origin the volume
    a · (b × c) / 6. Volumes of small hulls far from the origin are inexact; therefore the origin is
    the mean of the corners.
    """
    corners = np.asarray(shape.points())
    centered = corners - corners.mean(axis=0)
    a, b, c = centered[get_triangles(shape)].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0
    return volume, area


Versions = dict[Path, tuple[int, int] | None]
"""Times of change [ns] and sizes [bytes] of files, None where there is no file."""
_kept_parts: dict[tuple[Path, tuple[float, ...], float], tuple[Versions, list[MeshPart]]] = {}
"""Parts by file, scale and detail, with the versions of all files that were read for them."""


def load_parts(
    path: str | Path, scale: ArrayLike = (1.0, 1.0, 1.0), *, detail: float = 0.0
) -> list[MeshPart]:
    """Read a mesh file for display: one part per colour, with the mean colour of textures.

    Args:
        path: Mesh file; see `load_mesh`.
        scale: Factor from the file's unit to [m], or one for each axis.
        detail: Cell size of `simplify_mesh` [m]; 0 keeps all triangles.
    """
    file = Path(path)
    if file.suffix.lower() != ".obj" or not file.is_file():
        mesh = load_mesh(file, scale)
        whole = MeshPart(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        return [simplify_mesh(whole, detail)]
    factors = _check_scale(file, scale)
    key = (file.absolute(), tuple(factors.tolist()), detail)
    versions, parts = _kept_parts.pop(key, ({}, []))
    if not versions or versions != _read_versions(versions):
        versions = _read_versions([file])
        fine_parts = _read_obj_parts(file, factors, versions)
        parts = [simplify_mesh(part, detail) for part in fine_parts]
    # The parts used last come last; the first ones are forgotten.
    _kept_parts[key] = (versions, parts)
    while len(_kept_parts) > _MAX_KEPT_MESHES:
        del _kept_parts[next(iter(_kept_parts))]
    return list(parts)


def _read_versions(files: Iterable[Path]) -> Versions:
    found: Versions = {}
    for file in files:
        found[file] = None
        with contextlib.suppress(OSError):
            stat = file.stat()
            found[file] = (stat.st_mtime_ns, stat.st_size)
    return found


def _read_obj_parts(file: Path, factors: Floats, versions: Versions) -> list[MeshPart]:
    """Read the parts of an OBJ file, and add its materials and textures to `versions`."""
    import trimesh

    try:
        source, settings = _open_mesh(file)
        resolver = settings["resolver"]
        read = resolver.get

        def get(name: str) -> bytes:
            versions.update(_read_versions(_list_places(file, name)))
            return bytes(read(name))

        resolver.get = get
        scene = trimesh.load_scene(
            source, process=False, group_material=True, split_object=False, **settings
        )
        parts = list[MeshPart]()
        for mesh in scene.geometry.values():
            if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
                vertices = np.asarray(mesh.vertices) * factors
                parts.append(MeshPart(vertices, np.asarray(mesh.faces), _find_colour(mesh)))
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            f"cannot read the mesh: {error}", file=file, expected="an OBJ file"
        ) from error
    if not parts:
        raise InputError("the mesh is empty", file=file, expected="at least one triangle")
    return parts


def simplify_mesh(part: MeshPart, detail: float) -> MeshPart:
    """Return a mesh whose vertices in each cell of a grid of width `detail` [m] are merged."""
    if detail <= 0.0:
        return part
    cells = np.round(part.vertices / detail).astype(np.int64)
    _, group, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    sums = np.zeros((len(count), 3))
    np.add.at(sums, group, part.vertices)
    means = sums / count[:, None]
    faces = group[part.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    if len(faces) == 0:
        return part
    # Of triangles with the same corners, the first remains.
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return MeshPart(means, faces[np.sort(first)], part.colour)


def make_bvh(part: MeshPart | trimesh.Trimesh) -> coal.BVHModelOBBRSS:
    """Return the triangles of `part` as a coal shape for display."""
    shape = coal.BVHModelOBBRSS()
    shape.beginModel(len(part.faces), len(part.vertices))
    shape.addVertices(np.asarray(part.vertices, float))
    shape.addTriangles(np.asarray(part.faces, np.int32))
    shape.endModel()
    return shape


def _check_scale(file: Path, scale: ArrayLike) -> Floats:
    factors = np.asarray(scale, float)
    has_valid_shape = factors.shape in ((), (1,), (3,))
    if not has_valid_shape or not np.isfinite(factors).all() or (factors == 0.0).any():
        raise InputError(
            "wrong scale of a mesh",
            file=file,
            field="scale",
            expected="3 finite numbers other than 0",
            got=scale,
        )
    return np.broadcast_to(factors, (3,)).astype(float)


def get_triangles(shape: coal.Convex | coal.BVHModelBase) -> Ints:
    """Return the vertex indices of the triangles of a coal shape, shape (m, 3)."""
    if isinstance(shape, coal.Convex):
        triangles = [shape.polygons(k) for k in range(shape.num_polygons)]
    else:
        triangles = [shape.tri_indices(k) for k in range(shape.num_tris)]
    rows = [(triangle[0], triangle[1], triangle[2]) for triangle in triangles]
    return np.array(rows, np.int64).reshape(-1, 3)


def _find_colour(mesh: trimesh.Trimesh) -> tuple[float, float, float, float] | None:
    material = getattr(mesh.visual, "material", None)
    if material is None:
        return None
    image = getattr(material, "image", None)
    if image is not None:
        rgb = np.asarray(image.convert("RGB"), float).reshape(-1, 3).mean(axis=0)
        return (*(rgb / 255.0).tolist(), 1.0)
    rgba = np.asarray(material.main_color, float) / 255.0
    return (float(rgba[0]), float(rgba[1]), float(rgba[2]), float(rgba[3]))


def _fix_box_support() -> None:
    """Fix the support function of boxes for this process.

    The first direction in which coal 3.0.3 supports a box decides whether all boxes are 1e-10
    larger on their negative sides: they are if a component is zero (a `static` in
    `getShapeSupport`). These queries, without such a component, precede all others.
    """
    rotation = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    placement = coal.Transform3s(rotation, np.array([3.0, 0.4, 0.2]))
    identity = coal.Transform3s()
    box = coal.Box(1.0, 1.0, 1.0)
    capsule = coal.Capsule(0.1, 0.5)
    request = coal.DistanceRequest()
    coal.distance(capsule, identity, box, placement, request, coal.DistanceResult())
    # For the other support function, of shapes with a swept sphere.
    plane = coal.Halfspace(np.array([0.36, 0.48, 0.8]), 0.0)
    coal.distance(plane, identity, box, identity, request, coal.DistanceResult())


_fix_box_support()
