from __future__ import annotations

import subprocess
import sys
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from helpers.expected_errors import expect_error
from helpers.meshes import compute_excess
from helpers.poles import POLE
from scipy.spatial import ConvexHull

from vkc_pin.utils import disk_cache
from vkc_pin.world.files import meshes
from vkc_pin.world.files.hulls import compute_hull, compute_outer_hull
from vkc_pin.world.files.meshes import (
    get_triangles,
    load_convex,
    load_mesh,
    load_parts,
    make_bvh,
    make_convex_hull,
)

# Two cubes of edge length 1, one metre apart. Vertex indices of OBJ files run through all objects.
FACES = np.array(
    [[1, 2, 4, 3], [5, 7, 8, 6], [1, 5, 6, 2], [3, 4, 8, 7], [1, 3, 7, 5], [2, 6, 8, 4]]
)
CORNERS = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])


VERTICES = ["\n".join(f"v {x + 2 * k} {y} {z}" for x, y, z in CORNERS) + "\n" for k in range(2)]


INTERRUPTED = """
import signal, sys
import numpy, coal

class Finder:
    def find_spec(self, name, *rest):
        if name == "networkx":  # trimesh catches everything that is raised here
            sys.meta_path.remove(self)
            signal.raise_signal(signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)
sys.meta_path.insert(0, Finder())
from vkc_pin.world.files.meshes import load_mesh
from vkc_pin.world.models.shapes import triangulate
assert "trimesh" not in sys.modules
try:
    print("not interrupted", CALL)
except KeyboardInterrupt:
    print("interrupted")
"""


@pytest.mark.parametrize(
    "call",
    [
        "load_mesh('no.obj')",
        pytest.param("triangulate(coal.Sphere(1.0))", marks=pytest.mark.long),
    ],
)
def test_interrupts_during_imports_are_not_lost(call: str) -> None:
    code = [sys.executable, "-c", INTERRUPTED.replace("CALL", call)]
    done = subprocess.run(code, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout == "interrupted\n"


def format_faces(first: int, corner: str = "{}") -> str:
    """Return the faces of a cube whose first vertex has index `first`, which may be negative."""
    return "".join(
        "f " + " ".join(corner.format(i - 1 + first) for i in face) + "\n" for face in FACES
    )


TWO_CUBES = VERTICES[0] + VERTICES[1] + format_faces(1) + format_faces(9)


def write_two_cubes(path: Path) -> Path:
    """Write two objects of different colours."""
    cubes = (f"o cube{k}\n{VERTICES[k]}usemtl colour{k}\n{format_faces(1 + 8 * k)}" for k in (0, 1))
    path.write_text("mtllib two.mtl\n" + "".join(cubes))
    (path.parent / "two.mtl").write_text(
        "newmtl colour0\nKd 1.0 0.0 0.0\nnewmtl colour1\nKd 0.0 0.0 1.0\n"
    )
    return path


@pytest.mark.parametrize(
    "text",
    [
        VERTICES[0] + format_faces(-8) + VERTICES[1] + format_faces(-8),
        VERTICES[0] + VERTICES[1] + format_faces(-16) + format_faces(-8),
        VERTICES[0] + format_faces(1) + VERTICES[1] + format_faces(-8),
        "vt 0 0\n" + "".join(part + format_faces(-8, "{}/-1") for part in VERTICES),
        "vn 1 0 0\n" + "".join(part + format_faces(-8, "{}//1") for part in VERTICES),
        VERTICES[0]
        + format_faces(-8).replace("f ", "f  ").replace("\n", "  # a-b\n", 1)
        # the second cube has continued lines
        + VERTICES[1]
        + format_faces(-8).replace(" -1 ", " \\\n-1 "),
        "\ufeff" + TWO_CUBES,
        TWO_CUBES.replace("\n", "\r"),
        TWO_CUBES.replace("v ", "v\t").replace("f ", "f\t"),
        TWO_CUBES.replace("v ", "  v ").replace("f ", "\tf "),
    ],
    ids=[
        "interleaved",
        "at the end",
        "mixed",
        "textures",
        "normals",
        "comments and continued lines",
        "byte-order mark",
        "carriage returns as line ends",
        "tabs",
        "indented",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_obj_dialects_give_the_same_mesh(tmp_path: Path, text: str, encoding: str) -> None:
    file = tmp_path / "two.obj"
    file.write_bytes(text.encode(encoding))
    mesh = load_mesh(file)
    assert mesh.area == pytest.approx(12.0)
    assert abs(mesh.volume) == pytest.approx(2.0)
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [3, 1, 1]])
    assert sum(len(part.faces) for part in load_parts(file)) == 24


@pytest.mark.parametrize("index", ["0", "-9", "0/1"])
def test_faces_with_invalid_vertex_indices_are_rejected(tmp_path: Path, index: str) -> None:
    file = tmp_path / "cube.obj"
    file.write_text(f"{VERTICES[0]}f 1 2 {index}\n")
    with expect_error(r"cube\.obj:9: f: no such vertex.*1 to 8.*got " + index):
        load_mesh(file)


COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
 <asset>{unit}<up_axis>Y_UP</up_axis></asset>
 <library_geometries><geometry id="g" name="block"><mesh>
  <source id="p"><float_array id="pa" count="24">{corners}</float_array><technique_common>
   <accessor source="#pa" count="8" stride="3"><param name="X" type="float"/>
    <param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common>
  </source>
  <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
  <triangles count="12"><input semantic="VERTEX" source="#v" offset="0"/><p>{faces}</p></triangles>
 </mesh></geometry></library_geometries>
 <library_visual_scenes><visual_scene id="s">
  <node id="n" name="first"><instance_geometry url="#g"/></node>
  <node id="m" name="second"><translate>5 0 0</translate><instance_geometry url="#g"/></node>
 </visual_scene></library_visual_scenes>
 <scene><instance_visual_scene url="#s"/></scene>
</COLLADA>"""


def write_collada(path: Path, unit: str) -> Path:
    """Write two blocks of 1 × 2 × 3 units, at 0 and 5 along x."""
    corners = " ".join(f"{x:g} {2 * y:g} {3 * z:g}" for x, y, z in CORNERS)
    faces = " ".join(
        f"{a - 1} {b - 1} {c - 1} {a - 1} {c - 1} {d - 1}" for a, b, c, d in FACES.tolist()
    )
    path.write_text(COLLADA.format(unit=unit, corners=corners, faces=faces), "utf-8")
    return path


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        ("", 1.0),
        ('<unit name="meter" meter="1"/>', 1.0),
        ('<unit meter="0.01" name="cm"/>', 0.01),
        ('<unit meter="1e-3"/>', 1e-3),
        ("<unit name='inch' meter='0.0254'/>", 0.0254),
        ('<unit meter=" 0.3048 "/>', 0.3048),
        ('<unit name="meter"/>', 1.0),
    ],
)
def test_the_unit_of_collada_files_is_applied(tmp_path: Path, unit: str, metres: float) -> None:
    file = write_collada(tmp_path / "block.dae", unit)
    size = np.array([6.0, 2.0, 3.0]) * metres
    np.testing.assert_allclose(load_mesh(file).extents, size)
    np.testing.assert_allclose(load_mesh(file, (2.0, 1.0, 1.0)).extents, size * (2, 1, 1))
    np.testing.assert_allclose(np.ptp(np.asarray(load_convex(file).points()), axis=0), size)
    (part,) = load_parts(file)
    np.testing.assert_allclose(np.ptp(part.vertices, axis=0), size)


@pytest.mark.parametrize("unit", ["1e-300", "1e-9", "1e-7"])
def test_tiny_meshes_are_rejected(tmp_path: Path, unit: str) -> None:
    file = write_collada(tmp_path / "block.dae", f'<unit meter="{unit}"/>')
    with expect_error(r"block\.dae: tip: .*too small: is its unit or scale"):
        load_convex(file, about="tip")


@pytest.mark.parametrize("unit", ["0", "-1", "inch", "nan", "1e400", "0,01"])
def test_invalid_collada_units_are_rejected(tmp_path: Path, unit: str) -> None:
    file = write_collada(tmp_path / "block.dae", f'<unit meter="{unit}"/>')
    with expect_error(rf"block\.dae: <unit> meter: .*got {unit}"):
        load_mesh(file)


def test_submeshes_can_be_read_by_name(tmp_path: Path) -> None:
    two = write_two_cubes(tmp_path / "two.obj")
    named = tmp_path / "named.obj"
    named.write_text(two.read_text().replace("o cube", "g all cube"))
    block = write_collada(tmp_path / "block.dae", '<unit meter="0.1"/>')
    scene, pot = trimesh.Scene(), tmp_path / "pot.glb"
    for name, at in (("lid", 0.0), ("pot", 4.0)):
        scene.add_geometry(trimesh.creation.box().apply_translation((at, 0, 0)), node_name=name)
    scene.export(pot)
    for file, name, low, high in (
        (two, "cube1", 2.0, 3.0),
        (named, "cube0", 0.0, 1.0),
        (named, "all", 0.0, 3.0),
        (block, "first", 0.0, 0.1),
        (block, "second", 0.5, 0.6),
        (block, "m", 0.5, 0.6),
        (block, "block", 0.0, 0.6),
        (pot, "pot", 3.5, 4.5),
    ):
        bounds = load_mesh(file, submesh=name).bounds
        np.testing.assert_allclose(bounds[:, 0], [low, high], atol=1e-9)
    for file, word in ((two, "cube1"), (block, "second"), (pot, "lid")):
        with expect_error(f"submesh 'cub'.*{word}", file=file):
            load_mesh(file, submesh="cub")


def test_hulls_with_many_neighbours_are_simplified() -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 260, endpoint=False)
    rim = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(260)])
    shape = make_convex_hull(np.vstack([rim, [0.0, 0.0, 2.0]]))
    assert np.pi * 2.0 / 3.0 - 1e-3 < shape.computeVolume() < 1.1 * np.pi * 2.0 / 3.0
    hull = trimesh.convex.convex_hull(np.asarray(shape.points()))
    assert compute_excess(rim, hull).max() < 1e-7


def test_colours_divide_meshes_into_parts(tmp_path: Path) -> None:
    parts = load_parts(write_two_cubes(tmp_path / "two.obj"), 2.0)
    assert {part.colour for part in parts} == {(0.0, 0.0, 1.0, 1.0), (1.0, 0.0, 0.0, 1.0)}
    assert sum(len(part.faces) for part in parts) == 24
    assert max(part.vertices.max() for part in parts) == pytest.approx(6.0)
    shape = make_bvh(parts[0])
    assert shape.num_tris == len(parts[0].faces)


def test_changed_files_are_read_again(tmp_path: Path) -> None:
    """What a process keeps of a mesh is compared with the files of the mesh and its materials."""
    file, materials = write_two_cubes(tmp_path / "two.obj"), tmp_path / "two.mtl"
    texts = {path: path.read_text(encoding="utf-8") for path in (file, materials)}
    blue, red, green = (0.0, 0.0, 1.0, 1.0), (1.0, 0.0, 0.0, 1.0), (0.0, 1.0, 0.0, 1.0)
    assert {part.colour for part in load_parts(file)} == {blue, red}
    materials.write_text(texts[materials].replace("Kd 1.0 0.0", "Kd 0.0 1.0"), encoding="utf-8")
    assert {part.colour for part in load_parts(file)} == {blue, green}
    materials.unlink()
    assert not {part.colour for part in load_parts(file)} & {blue, red, green}
    materials.write_text(texts[materials], encoding="utf-8")
    assert {part.colour for part in load_parts(file)} == {blue, red}
    file.write_text(texts[file] + "f 1 2 3\n", encoding="utf-8")
    assert sum(len(part.faces) for part in load_parts(file)) == 25


def test_simplified_meshes_keep_their_shape(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    ball.export(tmp_path / "ball.stl")
    (fine,) = load_parts(tmp_path / "ball.stl")
    (coarse,) = load_parts(tmp_path / "ball.stl", detail=0.01)
    assert len(coarse.faces) < 0.2 * len(fine.faces)
    assert np.abs(np.linalg.norm(coarse.vertices, axis=1) - 0.1).max() < 0.01


def test_hulls_of_thin_meshes_need_no_optional_dependency(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """For flat points trimesh would import networkx, which is not a dependency."""
    monkeypatch.setitem(sys.modules, "networkx", None)
    rng, file = np.random.default_rng(0), tmp_path / "few.off"
    for thickness in (1.0, 0.0, 1e-3, 1e-4, 1e-8, 1e-13) * 4:
        points = rng.normal(size=(6, 3)) * (1.0, 1.0, thickness)
        rows = "\n".join(" ".join(map(repr, row)) for row in points.tolist())
        file.write_text(f"OFF\n6 2 0\n{rows}\n3 0 1 2\n3 3 4 5\n")
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            assert load_convex(file).computeVolume() > 0.0
        assert len(caught) == (thickness < 1e-5)


@pytest.mark.parametrize("scale", [(1.0, 0.0, 1.0), (1.0, 2.0), (np.nan, 1.0, 1.0)])
def test_invalid_scales_raise(tmp_path: Path, scale: tuple[float, ...]) -> None:
    with expect_error("scale"):
        load_mesh(write_two_cubes(tmp_path / "two.obj"), scale)


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("none.obj", None, "there is no such mesh"),
        ("points.obj", "v 0 0 0\nv 1 0 0\n", "empty|cannot read"),
        ("broken.stl", "not an STL file", "empty|cannot read"),
        ("number.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "no numbers|cannot|empty"),
        ("flat.obj", "v 0 0\nv 1 0\nv 0 1\nv 1 1\nf 1 2 3\nf 2 3 4\n", "cannot read"),
        ("far.obj", "v 0 0 0\nv 1 0 0\nv 0 1e300 0\nf 1 2 3\n", "out of range"),
    ],
)
def test_invalid_meshes_raise(tmp_path: Path, name: str, text: str | None, problem: str) -> None:
    file = tmp_path / name
    if text is not None:
        file.write_text(text)
    with expect_error(problem, file=file):
        load_convex(file)


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("v 0 0 2\nv 1 0 2\nv 0 1 2\nf 1 2 3\n", (1.0, 1.0, 1e-3)),
        ("v 0 0 2\nv 1 0 2\nv 1 1 2.0000001\nv 0 1 2\nf 1 2 3\nf 1 3 4\n", (1.0, 1.0, 1e-3)),
        ("v 0 2 2\nv 1 2 2\nv 3 2 2\nf 1 2 3\n", (3.0, 1e-3, 1e-3)),
    ],
    ids=["triangle", "nearly flat", "line"],
)
def test_flat_meshes_become_plates_with_a_warning(
    tmp_path: Path, text: str, size: tuple[float, float, float]
) -> None:
    file = tmp_path / "picture.obj"
    file.write_text(text)
    with pytest.warns(UserWarning, match=r"hall of .*picture\.obj is flat: .*plate, 1 mm thick"):
        corners = np.asarray(load_convex(file, about="hall").points())
    tolerance = 0.42 if size[1] == 1e-3 else 1e-3  # a bar may be rotated about its axis
    assert np.ptp(corners, axis=0) == pytest.approx(size, rel=tolerance)
    assert corners[:, 2].min() + corners[:, 2].max() == pytest.approx(4.0, abs=1e-6)


def test_hulls_of_thin_poles_are_closed_and_face_outward() -> None:
    hull = compute_hull(POLE)
    assert hull.is_volume
    assert hull.volume == pytest.approx(ConvexHull(POLE).volume, rel=1e-12)
    assert hull.area == pytest.approx(ConvexHull(POLE).area, rel=1e-12)
    assert compute_excess(POLE, hull).max() < 1e-12


@pytest.mark.parametrize(
    "mesh",
    [
        trimesh.creation.box((0.1, 0.02, 1.3)),
        trimesh.creation.cylinder(0.05, height=0.4, sections=100),
        trimesh.creation.icosphere(subdivisions=2),
        trimesh.creation.torus(0.3, 0.02),
    ],
    ids=["box", "cylinder", "ball", "ring"],
)
def test_hulls_equal_those_of_trimesh(mesh: trimesh.Trimesh) -> None:
    points = mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])).vertices
    hull, expected = compute_hull(points), trimesh.convex.convex_hull(points)
    np.testing.assert_array_equal(hull.vertices, expected.vertices)
    np.testing.assert_array_equal(hull.faces, expected.faces)
    np.testing.assert_array_equal(hull.face_normals, expected.face_normals)


@pytest.mark.parametrize("count", [1, 3, 4, 20])
def test_coplanar_points_raise(count: int) -> None:
    points = np.random.default_rng(0).uniform(size=(count, 3)) * (1.0, 1.0, 0.0)
    with expect_error("span no volume"):
        compute_hull(points)


@pytest.mark.parametrize("vertices", [16, 40])
def test_outer_hulls_contain_their_points(vertices: int) -> None:
    tube = trimesh.creation.cylinder(0.05, height=0.4, sections=100)
    points = np.asarray(
        tube.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])).vertices
    )
    hull = compute_outer_hull(points, vertices=vertices)
    assert len(hull.vertices) <= vertices
    assert compute_excess(points, hull).max() < 1e-9
    assert 1.0 < hull.volume / tube.volume < (1.2 if vertices == 40 else 1.35)


def test_outer_hulls_of_dense_meshes_need_little_memory() -> None:
    """A matrix of all 81 920 facets by all 40 962 vertices would need 27 GB."""
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.1)
    tracemalloc.start()
    hull = compute_outer_hull(ball.vertices)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 300e6
    assert len(hull.vertices) <= 40
    assert compute_excess(ball.vertices, hull).max() < 1e-9
    assert 1.0 < hull.volume / ball.volume < 1.2


@pytest.mark.parametrize("size", [1.0, 1e-2, 1e-3, 1e-4, 1e-5])
@pytest.mark.parametrize("middle", [0.0, 1.0])
def test_hulls_of_small_parts_are_closed(size: float, middle: float) -> None:
    """Points of cut meshes lie almost in the same planes: facets are slivers."""
    rng = np.random.default_rng(0)
    for count in (5, 21, 60):
        points = rng.normal(size=(count, 3))
        twins = points + 1e-6 * rng.normal(size=points.shape)
        almost_flat = np.column_stack([points[:, :2], 1.0 + 1e-8 * points[:, 2]])
        for chosen in (points, np.vstack([points, twins]), np.vstack([points, almost_flat])):
            placed = (size * chosen + middle).astype(np.float32).astype(float)
            shape = make_convex_hull(placed)
            held = np.asarray(shape.points())
            # About the middle: volumes of small bodies far from the origin are inexact.
            expected = ConvexHull(placed - placed.mean(axis=0)).volume
            hull = trimesh.Trimesh(held - placed.mean(axis=0), get_triangles(shape))
            assert hull.volume == pytest.approx(expected, rel=1e-5)
            assert compute_excess(placed, compute_hull(placed)).max() < 2e-8


def test_hull_on_disk_is_that_of_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(disk_cache.CACHE_VARIABLE, str(tmp_path / "cache"))
    file = tmp_path / "part.stl"
    trimesh.creation.icosphere(subdivisions=2).export(file)
    meshes._load_hull.cache_clear()
    built = load_convex(file)
    meshes._load_hull.cache_clear()
    read = load_convex(file)
    np.testing.assert_array_equal(built.points(), read.points())
    np.testing.assert_array_equal(get_triangles(built), get_triangles(read))
    assert read.computeVolume() == built.computeVolume()
    assert len(list((tmp_path / "cache").rglob("*.json"))) == 1
    np.testing.assert_allclose(load_convex(file, 2.0).points(), 2.0 * np.asarray(built.points()))
    trimesh.creation.box().export(file)
    assert load_convex(file).computeVolume() == pytest.approx(1.0)
    assert len(list((tmp_path / "cache").rglob("*.json"))) == 3


def test_flat_mesh_warns_at_each_use(tmp_path: Path) -> None:
    file = tmp_path / "sheet.stl"
    corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]]).export(file)
    for _ in range(2):
        meshes._load_hull.cache_clear()
        with pytest.warns(UserWarning, match="flat"):
            load_convex(file)
