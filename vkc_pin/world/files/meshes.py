"""Reads mesh files and converts them to coal shapes, whose volume and area are checked.

Meshes are read with trimesh: coal 3.0.3 restarts the triangle indices at every object of an OBJ
file. Only COLLADA files (`.dae`), for which trimesh would need another package, are read by coal,
which ignores their unit. As in RViz and Gazebo, the unit counts and the upward axis does not.
"""

from __future__ import annotations

import codecs
import contextlib
import io
import re
import tempfile
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import coal
import numpy as np
from numpy.typing import ArrayLike, NDArray

from vkc_pin.errors import InputError, UnknownNameError
from vkc_pin.utils.arrays import MAX_COORDINATE, Floats, Ints
from vkc_pin.utils.isolation import run_isolated
from vkc_pin.world.files.documents import read_text
from vkc_pin.world.files.hulls import SHEET_THICKNESS, compute_hull, compute_outer_hull, thicken
from vkc_pin.world.files.resources import check_path
from vkc_pin.world.files.xml import check_collada, parse_xml

if TYPE_CHECKING:
    import trimesh

__all__ = [
    "MeshPart",
    "get_triangles",
    "load_convex",
    "load_mesh",
    "load_parts",
    "make_bvh",
    "make_convex_hull",
    "simplify_mesh",
]

_MAX_NEIGHBOURS = 255  # coal's corners have no more
_MAX_CACHED_HULLS = 512  # that a process keeps: robots are loaded again and again
_SMALLEST = 1e-6  # [m] size of meshes, below which triangles have no area in floating point
# Faces of OBJ files whose corners count from the end, or from 0
_NOT_FROM_ONE = re.compile(rb"\nf[^\n]*[ /][-0]")
_HULL_TOLERANCE = 1e-6  # how far, relatively, coal's volume and area may be from trimesh's


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

    Args:
        path: OBJ, STL, PLY, OFF, glTF or COLLADA file.
        scale: Factor from the file's unit to [m], or one for each axis. COLLADA files state their
            unit, which counts as well.
        submesh: Name of an object, group or node, to read it alone.

    Raises:
        InputError: There is no such file, or it is not a valid mesh.
        UnknownNameError: The file has no such submesh.
    """
    import trimesh

    file = check_path(path, "path", "a mesh file")
    factors = _check_scale(file, scale)
    if not file.is_file():
        raise InputError("there is no such mesh", file=file, expected="a mesh file")
    by_coal = file.suffix.lower() == ".dae"
    if by_coal:
        factors = factors * check_collada(file)
    try:
        if by_coal:
            mesh = _read_collada(file, submesh)
        else:
            source, settings = _open_mesh(file, submesh)
            mesh = trimesh.load_scene(source, force="mesh", skip_materials=True, **settings)
            if submesh is not None and file.suffix.lower() != ".obj":
                mesh = _extract_submesh(mesh, file, submesh)
            mesh = mesh.to_mesh()
    except InputError:
        raise
    except Exception as error:  # readers raise any type
        expected = "a COLLADA file" if by_coal else "an OBJ, STL, PLY, OFF, glTF or COLLADA file"
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


def _read_collada(file: Path, submesh: str | None) -> trimesh.Trimesh:
    """Return a COLLADA file, or the geometry of one of its nodes, in the file's unit."""
    import trimesh

    with tempfile.TemporaryDirectory() as scratch:
        source = file.absolute()
        if submesh is not None:
            source = Path(scratch, "submesh.dae")
            _copy_submesh(file, submesh, source)
        # It is compiled code, which invalid files crash.
        vertices, faces = run_isolated(
            _parse_collada, source, program="the COLLADA reader", file=file
        )
    return trimesh.Trimesh(vertices, faces)


def _copy_submesh(file: Path, submesh: str, copy: Path) -> None:
    """Write a COLLADA file without the geometry of all nodes but those with a name."""
    root = parse_xml(read_text(file, "COLLADA"), file)
    labels = {
        f"#{geometry.get('id')}": {geometry.get("id", ""), geometry.get("name", "")}
        for geometry in root.iter("geometry")
    }
    names, is_found = dict[str, None](), False
    for node in root.iter("node"):
        for instance in node.findall("instance_geometry"):
            own = {node.get("name", ""), node.get("id", "")}
            own |= labels.get(instance.get("url", ""), set())
            names.update(dict.fromkeys(sorted(own - {""})))
            is_found |= submesh in own
            if submesh not in own:
                node.remove(instance)
    if not is_found:
        raise UnknownNameError("submesh", submesh, names, file=file)
    ElementTree.ElementTree(root).write(copy, encoding="utf-8", xml_declaration=True)


def _parse_collada(file: Path) -> tuple[Floats, Ints]:
    shape = coal.MeshLoader().load(str(file), np.ones(3))
    return np.array(shape.vertices()), get_triangles(shape)


def _extract_submesh(scene: trimesh.Scene, file: Path, submesh: str) -> trimesh.Scene:
    """Return the part of a scene whose node or geometry has a name."""
    import trimesh

    found, names = trimesh.Scene(), dict[str, None]()
    for node in scene.graph.nodes_geometry:
        transform, geometry = scene.graph[node]
        names.update({str(node): None, str(geometry): None})
        if submesh in (str(node), str(geometry)):
            found.add_geometry(scene.geometry[geometry], transform=transform)
    if not found.geometry:
        raise UnknownNameError("submesh", submesh, names, file=file)
    return found


def _open_mesh(file: Path, submesh: str | None = None) -> tuple[Path | io.BytesIO, dict[str, Any]]:
    """Return what trimesh reads a mesh from, changed where it would misread it, and settings."""
    settings: dict[str, Any] = {"resolver": _make_resolver(file)}
    kind = file.suffix.lower()[1:]
    if kind not in ("obj", "gltf"):
        return file, settings
    data = file.read_bytes()
    if is_utf16 := data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        data = data.decode("utf-16").encode()
    is_usual = (
        submesh is None
        and not data.startswith((codecs.BOM_UTF8, b" "))
        and not any(text in data for text in (b"\t", b"\n ", b"\\\n", b"\\\r"))
        and data.count(b"\r") == data.count(b"\r\n")
        and not _NOT_FROM_ONE.search(data)
    )
    if kind == "obj" and not is_usual:
        data = _normalize_obj(data, file, submesh)
    elif is_utf16 or data.startswith(codecs.BOM_UTF8):
        data = data.removeprefix(codecs.BOM_UTF8)
    else:
        return file, settings
    return io.BytesIO(data), {**settings, "file_type": kind}


def _make_resolver(file: Path) -> Any:
    """Return trimesh's reader of materials and buffers that a mesh names, without pipes."""
    import trimesh

    resolver: Any = trimesh.resolvers.FilePathResolver(str(file))
    read = resolver.get

    def get(name: str) -> bytes:
        for place in (file.parent / name.strip(), file.parent / Path(name).name):
            if place.exists() and not place.is_file():
                raise FileNotFoundError(f"{place} is not a regular file")  # it may be endless
        return bytes(read(name))

    resolver.get = get
    return resolver


def _normalize_obj(data: bytes, file: Path, submesh: str | None) -> bytes:
    """Return an OBJ file with plain lines, faces that count from 1, and one object if named."""
    for old, new in ((b"\r\n", b"\n"), (b"\r", b"\n"), (b"\\\n", b" ")):
        data = data.replace(old, new)
    counts = {b"v": 0, b"vt": 0, b"vn": 0}
    wanted = None if submesh is None else submesh.encode()
    lines, names = list[bytes](), dict[str, None]()
    is_kept = is_found = wanted is None
    for number, line in enumerate(data.removeprefix(codecs.BOM_UTF8).split(b"\n"), 1):
        key, *values = line.split() or [b""]
        if key in counts:
            counts[key] += 1
        elif key in (b"o", b"g"):  # a group may have several names
            own = {b" ".join(values), *values}
            names.update(dict.fromkeys(name.decode(errors="replace") for name in sorted(own)))
            is_kept = wanted is None or wanted in own
        elif key == b"f":
            if not is_kept:
                continue
            is_found = True
            corners = line.partition(b"#")[0].split()[1:]
            values = [_count_from_start(corner, counts, file, number) for corner in corners]
        lines.append(b" ".join([key, *values]))
    if not is_found:
        raise UnknownNameError("submesh", str(submesh), names, file=file)
    return b"\n".join(lines)


def _count_from_start(corner: bytes, counts: Mapping[bytes, int], file: Path, line: int) -> bytes:
    """Return a corner of a face, such as `-3/-3/1`, with indices that count from 1."""
    indices = list[bytes]()
    for text, count in zip(corner.split(b"/"), counts.values(), strict=False):
        if text.startswith(b"-"):
            text = b"%d" % (count + 1 + int(text))
        if not indices and int(text) < 1:
            problem, expected = "no such vertex", f"1 to {count}, or -1 to {-count} from the last"
            got = corner.decode(errors="replace")
            raise InputError(problem, file=file, line=line, field="f", expected=expected, got=got)
        indices.append(text)
    return b"/".join(indices)


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
        with contextlib.suppress(InputError):  # raised below, with `about`
            kept = _load_hull(
                file.absolute(),
                (stat.st_mtime_ns, stat.st_size),
                tuple(_check_scale(file, scale).tolist()),
            )
            if kept is not None:
                return kept
    return make_convex_hull(load_mesh(path, scale).vertices, file=path, about=about)


@lru_cache(maxsize=_MAX_CACHED_HULLS)
def _load_hull(
    file: Path, version: tuple[int, int], scale: tuple[float, ...]
) -> coal.Convex | None:
    """Return the hull of a version of a mesh file; None if it is flat, since each use warns."""
    points = load_mesh(file, scale).vertices
    return None if thicken(np.asarray(points, float))[1] else make_convex_hull(points, file=file)


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
    if (size := float(np.ptp(given, axis=0).max())) < _SMALLEST:
        raise InputError(
            "the mesh is too small: is its unit or scale wrong?",
            file=file,
            field=about,
            expected=f"a size of at least {_SMALLEST:g} m",
            got=f"{size:.3g}",
        )
    if was_flat:
        named = " of ".join(str(part) for part in (about, file) if part is not None) or "a mesh"
        warnings.warn(
            f"{named} is flat: it collides as a plate, {1e3 * SHEET_THICKNESS:g} mm thick",
            stacklevel=2,
        )
    hull = compute_hull(given)
    if (
        np.bincount(np.asarray(hull.faces).ravel()).max() > _MAX_NEIGHBOURS
    ):  # the tip of a finely meshed cone, a fine disc
        hull = compute_outer_hull(hull.vertices, vertices=60)
    vertices, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    vertices.extend(np.asarray(hull.vertices, float))
    triangles.extend(coal.Triangle(*face) for face in np.asarray(hull.faces).tolist())
    shape = coal.Convex(vertices, triangles)
    corners = np.asarray(shape.points())[get_triangles(shape)]
    area = (
        np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        ).sum()
        / 2.0
    )
    for what, held, wanted in (
        ("volume", shape.computeVolume(), hull.volume),
        ("area", area, hull.area),
    ):
        if not abs(held - wanted) <= _HULL_TOLERANCE * abs(wanted) or wanted <= 0.0:
            problem = f"coal does not hold this hull: wrong {what}"
            raise InputError(problem, file=file, field=about, expected=wanted, got=held)
    shape.computeLocalAABB()
    return shape


def load_parts(
    path: str | Path, scale: ArrayLike = (1.0, 1.0, 1.0), *, detail: float = 0.0
) -> list[MeshPart]:
    """Read a mesh file for display: one part per colour, with the mean colour of textures.

    Args:
        path: Mesh file; see `load_mesh`.
        scale: Factor from the file's unit to [m], or one for each axis.
        detail: Cell size of `simplify_mesh` [m]; 0 keeps all triangles.
    """
    import trimesh

    file = Path(path)
    if file.suffix.lower() != ".obj" or not file.is_file():
        whole = load_mesh(file, scale)
        return [
            simplify_mesh(MeshPart(np.asarray(whole.vertices), np.asarray(whole.faces)), detail)
        ]
    factors = _check_scale(file, scale)
    try:
        source, settings = _open_mesh(file)
        scene = trimesh.load_scene(
            source, process=False, group_material=True, split_object=False, **settings
        )
        parts = [
            MeshPart(
                np.asarray(mesh.vertices) * factors, np.asarray(mesh.faces), _find_colour(mesh)
            )
            for mesh in scene.geometry.values()
            if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)
        ]
    except InputError:
        raise
    except Exception as error:
        raise InputError(
            f"cannot read the mesh: {error}", file=file, expected="an OBJ file"
        ) from error
    if not parts:
        raise InputError("the mesh is empty", file=file, expected="at least one triangle")
    return [simplify_mesh(part, detail) for part in parts]


def simplify_mesh(part: MeshPart, detail: float) -> MeshPart:
    """Return a mesh whose vertices in each cell of a grid of width `detail` [m] are merged."""
    if detail <= 0.0:
        return part
    cells = np.round(part.vertices / detail).astype(np.int64)
    _, group, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    group = group.reshape(-1)
    means = np.zeros((len(count), 3))
    np.add.at(means, group, part.vertices)
    faces = group[part.faces]
    faces = faces[
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    ]
    if len(faces) == 0:
        return part
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    return MeshPart(means / count[:, None], faces[np.sort(first)], part.colour)


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
    if factors.shape not in ((), (1,), (3,)) or not (
        np.isfinite(factors).all() and (factors != 0.0).all()
    ):
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
    convex = isinstance(shape, coal.Convex)
    count, item = (
        (shape.num_polygons, shape.polygons) if convex else (shape.num_tris, shape.tri_indices)
    )
    return np.array(
        [[triangle[i] for i in range(3)] for triangle in map(item, range(count))], np.int64
    ).reshape(-1, 3)


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
    turned = np.array([[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]])
    box, here, there = (
        coal.Box(1.0, 1.0, 1.0),
        coal.Transform3s(),
        coal.Transform3s(turned, np.array([3.0, 0.4, 0.2])),
    )
    plane = coal.Halfspace(
        np.array([0.36, 0.48, 0.8]), 0.0
    )  # for the other one, of shapes with a swept sphere
    for shape, where in ((coal.Capsule(0.1, 0.5), there), (plane, here)):
        coal.distance(shape, here, box, where, coal.DistanceRequest(), coal.DistanceResult())


_fix_box_support()
