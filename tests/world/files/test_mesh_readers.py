"""Compares every format of meshes with assimp in bounds, area and volume."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import files
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest
import trimesh
from helpers.assimp import measure, read_triangles
from helpers.expected_errors import expect_error
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from vkc_pin.world.files.meshes import load_convex, load_mesh, load_parts

SEEDS = st.integers(0, 2**32 - 1)
# Files are written again for each example.
REPEATED = settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def check_file(file: Path) -> trimesh.Trimesh:
    """Compare a file with assimp, as one mesh, as parts to draw and as hull; return the mesh."""
    expected = read_triangles(file)
    assert len(expected)
    bounds, area, volume = measure(expected)
    size = float(np.ptp(bounds, axis=0).max())
    mesh = load_mesh(file)
    parts = load_parts(file)
    drawn = np.concatenate([np.asarray(part.vertices)[part.faces] for part in parts])
    for found in (np.asarray(mesh.triangles), drawn):
        found_bounds, found_area, found_volume = measure(found)
        np.testing.assert_allclose(found_bounds, bounds, atol=2e-5 * size)  # assimp: 32 bits
        assert found_area == pytest.approx(area, rel=2e-4)
        # The volume of a surface that is not closed depends on the point about which it is taken.
        closed = trimesh.Trimesh(mesh.vertices, mesh.faces)
        closed.merge_vertices(digits_vertex=6)
        if closed.is_watertight:
            assert found_volume == pytest.approx(volume, rel=1e-3, abs=1e-5 * size**3)
    hull = np.asarray(load_convex(file).points())
    np.testing.assert_allclose([hull.min(axis=0), hull.max(axis=0)], bounds, atol=2e-5 * size)
    return mesh


def make_random_outline(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return a polygon with `count` corners about the origin, shape (n, 2), mostly concave."""
    angles = 2.0 * np.pi * (np.arange(count) + rng.uniform(0.0, 0.45, count)) / count
    radii = rng.uniform(0.2, 1.0, count)
    return radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])


def make_random_prism(rng: np.random.Generator) -> tuple[np.ndarray, list[list[int]]]:
    """Return vertices and polygons of a prism over a polygon, in a random place."""
    count = int(rng.integers(3, 8))
    outline = make_random_outline(rng, count)
    low = np.column_stack([outline, np.zeros(count)])
    high = np.column_stack([outline, np.ones(count)])
    turn = trimesh.transformations.random_rotation_matrix(rng.random(3))[:3, :3]
    vertices = np.vstack([low, high]) @ turn.T + rng.uniform(-2.0, 2.0, 3)
    sides = [[k, (k + 1) % count, count + (k + 1) % count, count + k] for k in range(count)]
    ends = [list(range(count))[::-1], list(range(count, 2 * count))]
    return vertices.round(4), ends + sides


def join(numbers: np.ndarray | list[int]) -> str:
    return " ".join(f"{number:.9g}" for number in np.ravel(numbers))


# COLLADA


def make_geometry(name: str, vertices: np.ndarray, *primitives: str) -> str:
    """Return a <geometry>; its primitives have inputs VERTEX and, at offset 1, NORMAL."""
    corners = join(vertices)
    return f"""<geometry id="{name}" name="{name} mesh"><mesh>
<source id="{name}-p"><float_array id="{name}-a" count="{vertices.size}">{corners}</float_array>
<technique_common><accessor source="#{name}-a" count="{len(vertices)}" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
</accessor></technique_common></source>
<source id="{name}-n"><float_array id="{name}-b" count="3">0 0 1</float_array>
<technique_common><accessor source="#{name}-b" count="1" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
</accessor></technique_common></source>
<vertices id="{name}-v"><input semantic="POSITION" source="#{name}-p"/></vertices>
{"".join(primitives).replace("NAME", name)}</mesh></geometry>"""


def make_primitive(kind: str, content: str, count: int, material: str = "none") -> str:
    return f"""<{kind} count="{count}" material="{material}">
<input semantic="VERTEX" source="#NAME-v" offset="0"/>
<input semantic="NORMAL" source="#NAME-n" offset="1"/>{content}</{kind}>"""


def write_indices(corners: list[int] | np.ndarray) -> str:
    """Return the indices of corners, each with the index of its normal."""
    return " ".join(f"{corner} 0" for corner in corners)


def make_polylist(polygons: list[list[int]], material: str = "none") -> str:
    counts = join([len(polygon) for polygon in polygons])
    indices = " ".join(map(write_indices, polygons))
    content = f"<vcount>{counts}</vcount><p>{indices}</p>"
    return make_primitive("polylist", content, len(polygons), material)


def make_polygons(polygons: list[list[int]], material: str = "none") -> str:
    content = "".join(f"<p>{write_indices(polygon)}</p>" for polygon in polygons)
    return make_primitive("polygons", content, len(polygons), material)


def make_collada(geometries: str, nodes: str, *, library: str = "", asset: str = "") -> str:
    return f"""<?xml version="1.0" encoding="utf-8"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset>{asset}</asset><library_geometries>{geometries}</library_geometries>
<library_nodes>{library}</library_nodes><library_visual_scenes><visual_scene id="scene">{nodes}
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#scene"/></scene>
</COLLADA>"""


BOX = np.array([[x, y, z] for z in (0, 1) for y in (0, 2) for x in (0, 3)], float)
BOX_SIDES = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
BOX_TRIANGLES = [[a, *pair] for a, b, c, d in BOX_SIDES for pair in ((b, c), (c, d))]
SHOW = '<node id="n"><instance_geometry url="#g"/></node>'
STRIPS = [[0, 1, 4, 5, 6, 7, 2, 3, 0, 1], [0, 4, 2, 6], [1, 3, 5, 7]]
TRIANGLES_OF_BOX = {
    "triangles": make_primitive(
        "triangles", f"<p>{write_indices(np.ravel(BOX_TRIANGLES))}</p>", len(BOX_TRIANGLES)
    ),
    "polylist": make_polylist(BOX_SIDES),
    "polygons": make_polygons(BOX_SIDES),
    "tristrips": make_primitive(
        "tristrips", "".join(f"<p>{write_indices(strip)}</p>" for strip in STRIPS), len(STRIPS)
    ),
    "trifans": make_primitive(
        "trifans", "".join(f"<p>{write_indices(side)}</p>" for side in BOX_SIDES), len(BOX_SIDES)
    ),
    "two materials": make_polylist(BOX_SIDES[:2], "a") + make_polylist(BOX_SIDES[2:], "b"),
    "one material of two": make_primitive("polylist", "<vcount/><p/>", 0, "a")
    + make_polylist(BOX_SIDES, "b"),
    "three kinds": make_polygons(BOX_SIDES[:1], "a")
    + make_polylist(BOX_SIDES[1:3], "b")
    + make_primitive("triangles", f"<p>{write_indices(np.ravel(BOX_TRIANGLES[6:]))}</p>", 6, "c"),
    "lines among them": make_primitive("lines", f"<p>{write_indices([0, 7])}</p>", 1, "a")
    + make_polylist(BOX_SIDES, "b")
    + make_primitive("linestrips", f"<p>{write_indices([0, 7, 1])}</p>", 1, "c"),
    "polygons of two corners": make_polylist([[0, 7], *BOX_SIDES, [3]]),
}


@pytest.mark.parametrize("kind", TRIANGLES_OF_BOX)
def test_every_primitive_of_collada_files_counts(tmp_path: Path, kind: str) -> None:
    file = tmp_path / "box.dae"
    file.write_text(make_collada(make_geometry("g", BOX, TRIANGLES_OF_BOX[kind]), SHOW))
    mesh = load_mesh(file)
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [3, 2, 1]])
    assert mesh.area == pytest.approx(22.0)
    assert mesh.volume == pytest.approx(6.0)
    if kind not in ("tristrips", "polygons of two corners"):  # which assimp misreads or refuses
        check_file(file)


def test_polygons_with_holes_are_filled_around_them(tmp_path: Path) -> None:
    square = np.array([[0, 0, 0], [4, 0, 0], [4, 4, 0], [0, 4, 0]], float)
    hole = np.array([[1, 1, 0], [1, 2, 0], [3, 2, 0], [3, 1, 0]], float)
    rings = f"<p>{write_indices([0, 1, 2, 3])}</p><h>{write_indices([4, 5, 6, 7])}</h>"
    polygons = make_primitive("polygons", f"<ph>{rings}</ph>", 1)
    file = tmp_path / "frame.dae"
    file.write_text(make_collada(make_geometry("g", np.vstack([square, hole]), polygons), SHOW))
    assert load_mesh(file).area == pytest.approx(16.0 - 2.0)


def make_random_axis(rng: np.random.Generator) -> np.ndarray:
    axis = rng.normal(size=3)
    return axis / np.linalg.norm(axis)


TRANSFORMATIONS: dict[str, Callable[[np.random.Generator], np.ndarray]] = {
    "translate": lambda rng: rng.uniform(-1.0, 1.0, 3),
    "rotate": lambda rng: np.append(make_random_axis(rng), rng.uniform(-180.0, 180.0)),
    "scale": lambda rng: rng.uniform(0.3, 1.5, 3),  # assimp turns mirrored surfaces inside out
    "matrix": lambda rng: trimesh.transformations.random_rotation_matrix(rng.random(3)),
}


def make_transformations(rng: np.random.Generator) -> str:
    kinds = rng.choice(list(TRANSFORMATIONS), int(rng.integers(0, 4)))
    return "".join(f"<{kind}>{join(TRANSFORMATIONS[kind](rng))}</{kind}>" for kind in kinds)


def make_random_collada(rng: np.random.Generator) -> str:
    """Return geometries of several primitives that nested nodes, also of a library, show."""
    geometries, names = "", [f"g{k}" for k in range(int(rng.integers(1, 4)))]
    for name in names:
        vertices, polygons = make_random_prism(rng)
        groups = np.array_split(np.arange(len(polygons)), int(rng.integers(1, 4)))
        primitives = [
            (make_polylist if rng.random() < 0.7 else make_polygons)(
                [polygons[k] for k in group], f"m{number}"
            )
            for number, group in enumerate(groups)
        ]
        geometries += make_geometry(name, vertices, *primitives)

    def make_node(name: str, depth: int) -> str:
        content = make_transformations(rng)
        for number in range(int(rng.integers(1, 3))):
            if depth and rng.random() < 0.5:
                content += make_node(f"{name}_{number}", depth - 1)
            elif rng.random() < 0.3 and not name.startswith("library"):
                content += '<instance_node url="#library"/>'
            else:
                content += f'<instance_geometry url="#{rng.choice(names)}"/>'
        return f'<node id="{name}">{content}</node>'

    unit, axis = rng.choice([1.0, 0.01, 0.0254]), rng.choice(["Y_UP", "Z_UP"])
    return make_collada(
        geometries,
        "".join(make_node(f"n{k}", 2) for k in range(int(rng.integers(1, 4)))),
        library=make_node("library", 1),
        asset=f'<unit meter="{unit}"/><up_axis>{axis}</up_axis>',
    )


@given(SEEDS)
@REPEATED
def test_collada_scenes_are_read_as_assimp_reads_them(tmp_path: Path, seed: int) -> None:
    file = tmp_path / "scene.dae"
    file.write_text(make_random_collada(np.random.default_rng(seed)))
    check_file(file)


def find_collada_files() -> list[Path]:
    """Return the small COLLADA files with several primitives in the packages of robots."""
    found = list[Path]()
    for package in ("example-robot-data", "airo-models"):
        for path in files(package) or ():
            file = Path(str(path.locate()))
            if file.suffix.lower() != ".dae" or file.stat().st_size > 200_000:
                continue
            text = file.read_text(encoding="utf-8", errors="replace")
            if sum(text.count(f"<{kind} ") for kind in ("triangles", "polylist", "lines")) > 1:
                found.append(file)
    return found


@pytest.mark.parametrize("file", find_collada_files(), ids=lambda file: file.stem)
def test_collada_files_of_robots_are_read_as_assimp_reads_them(file: Path) -> None:
    check_file(file)


def test_skins_are_read_as_they_were_bound(tmp_path: Path) -> None:
    skin = """<library_controllers><controller id="c"><skin source="#g">
<bind_shape_matrix>1 0 0 5 0 1 0 0 0 0 1 0 0 0 0 1</bind_shape_matrix></skin></controller>
</library_controllers><library_visual_scenes>"""
    node = '<node><translate>0 0 7</translate><instance_controller url="#c"/></node>'
    text = make_collada(make_geometry("g", BOX, TRIANGLES_OF_BOX["polylist"]), node)
    file = tmp_path / "box.dae"
    file.write_text(text.replace("<library_visual_scenes>", skin))
    np.testing.assert_allclose(load_mesh(file).bounds, [[5, 0, 7], [8, 2, 8]])


def test_mirrored_surfaces_face_outward(tmp_path: Path) -> None:
    node = '<node><scale>1 -2 1</scale><instance_geometry url="#g"/></node>'
    file = tmp_path / "box.dae"
    file.write_text(make_collada(make_geometry("g", BOX, TRIANGLES_OF_BOX["polylist"]), node))
    mesh = load_mesh(file)
    np.testing.assert_allclose(mesh.bounds, [[0, -4, 0], [3, 0, 1]])
    assert mesh.volume == pytest.approx(12.0)


def test_only_what_the_scene_shows_counts(tmp_path: Path) -> None:
    shown = make_geometry("g", BOX, TRIANGLES_OF_BOX["polylist"])
    hidden = make_geometry("h", 9.0 * BOX, TRIANGLES_OF_BOX["polylist"])
    file = tmp_path / "box.dae"
    file.write_text(make_collada(shown + hidden, SHOW))
    np.testing.assert_allclose(load_mesh(file).bounds, [[0, 0, 0], [3, 2, 1]])


@pytest.mark.parametrize("indices", ["0 0 1 0 ~ 0", "0 0 1 0 1.5 0", "0 0 1 0 2x 0"])
def test_invalid_indices_raise(tmp_path: Path, indices: str) -> None:
    primitive = make_primitive("triangles", f"<p>{indices}</p>", 1)
    file = tmp_path / "box.dae"
    file.write_text(make_collada(make_geometry("g", BOX, primitive), SHOW))
    with expect_error("<p>: not indices.*whole numbers", file=file):
        load_mesh(file)


BOX_GEOMETRY = make_geometry("g", BOX, TRIANGLES_OF_BOX["polylist"])


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("<COLLADA", "not valid XML"),
        ("<robot/>", "no COLLADA file"),
        (make_collada("", SHOW), "geometry 'g'"),
        (make_collada(BOX_GEOMETRY, SHOW.replace("#g", "#f")), "no geometry 'f'; there are: g"),
        (make_collada(BOX_GEOMETRY, SHOW.replace("#g", "other.dae#g")), "within the file"),
        (make_collada(BOX_GEOMETRY, ""), "the mesh is empty"),
        (make_collada(BOX_GEOMETRY.replace("0 0 2 0", "0 0 8 0"), SHOW), "no such vertex.*0 to 7"),
        (make_collada(BOX_GEOMETRY.replace("0 0 2 0", "0 0 2"), SHOW), "wrong number"),
        (make_collada(BOX_GEOMETRY.replace("<vcount>4", "<vcount>5"), SHOW), "wrong number"),
        (make_collada(BOX_GEOMETRY.replace('stride="3"', 'stride="2"'), SHOW), "three numbers"),
        (make_collada(BOX_GEOMETRY.replace('stride="3"', 'stride="x"'), SHOW), "not a number"),
        (make_collada(BOX_GEOMETRY.replace(">0 0 0 3", ">0,0 0 0 3"), SHOW), "not numbers"),
        (
            make_collada(BOX_GEOMETRY, "<node><skew>45 0 1 0 1 0 0</skew></node>"),
            "transformation is not supported",
        ),
        (make_collada(BOX_GEOMETRY, "<node><scale>1 2</scale></node>"), "3 numbers.*got 2"),
        (
            make_collada(
                BOX_GEOMETRY,
                '<node><instance_node url="#a"/></node>',
                library='<node id="a"><instance_node url="#a"/></node>',
            ),
            "a node shows itself",
        ),
        (
            make_collada(
                BOX_GEOMETRY,
                '<node><instance_node url="#a29"/></node>',
                library='<node id="a0"><instance_geometry url="#g"/></node>'
                + "".join(
                    f'<node id="a{k + 1}">' + 2 * f'<instance_node url="#a{k}"/>' + "</node>"
                    for k in range(29)
                ),
            ),
            "too many triangles",
        ),
    ],
)
def test_invalid_collada_files_raise(tmp_path: Path, text: str, problem: str) -> None:
    file = tmp_path / "wrong.dae"
    file.write_text(text)
    with expect_error(problem, file=file):
        load_mesh(file)


# OBJ, PLY, OFF and STL


def test_lines_and_points_of_obj_files_have_no_surface(tmp_path: Path) -> None:
    rows = [f"v {join(vertex)}" for vertex in BOX] + ["v 9 9 9"]
    rows += [f"f {join(np.array(side) + 1)}" for side in BOX_SIDES] + ["l 1 9", "p 9"]
    file = tmp_path / "box.obj"
    file.write_text("\n".join(rows))
    mesh = load_mesh(file)
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [3, 2, 1]])
    assert mesh.volume == pytest.approx(6.0)


def make_random_obj(rng: np.random.Generator) -> str:
    """Return objects, groups and materials, with indices from the start or from the end."""
    text, before = "mtllib none.mtl\nvt 0.5 0.5\nvn 0 0 1\n", 0
    for k in range(int(rng.integers(1, 5))):
        vertices, polygons = make_random_prism(rng)
        text += f"o object{k}\n" + "".join(f"v {join(vertex)}\n" for vertex in vertices)
        start = 1 + before if rng.random() < 0.5 else -len(vertices)
        form = str(rng.choice(["{}", "{}/1", "{}//1", "{}/1/1"]))
        for number, polygon in enumerate(polygons):
            if rng.random() < 0.3:
                text += f"g group{k}_{number}\nusemtl material{int(rng.integers(3))}\ns off\n"
            text += "f " + " ".join(form.format(start + corner) for corner in polygon) + "\n"
        before += len(vertices)
    return text


@given(SEEDS)
@REPEATED
def test_obj_files_are_read_as_assimp_reads_them(tmp_path: Path, seed: int) -> None:
    file = tmp_path / "objects.obj"
    file.write_text(make_random_obj(np.random.default_rng(seed)))
    check_file(file)


def write_ply(path: Path, vertices: np.ndarray, polygons: list[list[int]]) -> Path:
    header = f"""ply
format ascii 1.0
comment a prism
element vertex {len(vertices)}
property float x
property float y
property float z
property uchar red
element face {len(polygons)}
property list uchar int vertex_indices
end_header
"""
    rows = [f"{join(vertex)} 255" for vertex in vertices]
    rows += [f"{len(polygon)} {join(polygon)}" for polygon in polygons]
    path.write_text(header + "\n".join(rows) + "\n")
    return path


def write_binary_ply(path: Path, vertices: np.ndarray, polygons: list[list[int]]) -> Path:
    header = f"""ply
format binary_little_endian 1.0
element vertex {len(vertices)}
property double x
property double y
property double z
element face {len(polygons)}
property list uchar int vertex_indices
end_header
"""
    data = vertices.astype("<f8").tobytes()
    for polygon in polygons:
        data += struct.pack(f"<B{len(polygon)}i", len(polygon), *polygon)
    path.write_bytes(header.encode() + data)
    return path


def write_off(path: Path, vertices: np.ndarray, polygons: list[list[int]]) -> Path:
    rows = [join(vertex) for vertex in vertices]
    rows += [f"{len(polygon)} {join(polygon)}" for polygon in polygons]
    counts = f"{len(vertices)} {len(polygons)} 0"
    path.write_text("\n".join(["OFF", counts, *rows]) + "\n")
    return path


@given(SEEDS)
@REPEATED
def test_polygons_of_ply_and_off_files_are_read_as_assimp_reads_them(
    tmp_path: Path, seed: int
) -> None:
    prism = make_random_prism(np.random.default_rng(seed))
    check_file(write_ply(tmp_path / "prism.ply", *prism))
    check_file(write_off(tmp_path / "prism.off", *prism))


def test_binary_ply_files_of_concave_polygons_are_read_as_assimp_reads_them(tmp_path: Path) -> None:
    arrow = np.array([[0, 0, 0], [3, 1, 0], [0, 2, 0], [1, 1, 0], [0, 0, 1], [3, 1, 1]], float)
    polygons = [[0, 1, 2, 3], [0, 4, 5, 1]]
    mesh = check_file(write_binary_ply(tmp_path / "arrow.ply", arrow, polygons))
    assert mesh.area == pytest.approx(2.0 + np.hypot(3.0, 1.0))


@pytest.mark.parametrize("header", ["OFF", "OFF # a mesh", "COFF", "  OFF\n\n# counts"])
def test_dialects_of_off_files_give_the_same_mesh(tmp_path: Path, header: str) -> None:
    rows = [f"{join(vertex)} 0.1 0.2 0.3 1" for vertex in BOX]
    rows += [f"4 {join(side)} 255 0 0" for side in BOX_SIDES]
    file = tmp_path / "box.off"
    file.write_text("\n".join([header, "8 6 12", *rows]))
    assert load_mesh(file).volume == pytest.approx(6.0)
    file.write_text("\n".join([header, "8 6 12", *rows[:-1]]))
    with expect_error("wrong number of lines.*6 faces.*5", file=file):
        load_mesh(file)


@pytest.mark.parametrize("is_text", [True, False])
def test_stl_files_are_read_as_assimp_reads_them(tmp_path: Path, is_text: bool) -> None:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.3)
    ring = trimesh.creation.torus(0.5, 0.1).apply_translation((0.0, 2.0, 0.0))
    file = tmp_path / "two.stl"
    if is_text:  # two solids
        texts = [str(part.export(file_type="stl_ascii")) for part in (ball, ring)]
        file.write_text("\n".join(texts))
    else:
        trimesh.util.concatenate([ball, ring]).export(file)
    check_file(file)


# glTF


def test_lines_of_gltf_files_have_no_surface(tmp_path: Path) -> None:
    gltf = Gltf()
    triangles = gltf.add_primitive(BOX, np.array(BOX_TRIANGLES))
    lines = gltf.add_primitive(9.0 * BOX[:2], None, mode=1)
    gltf.document |= {"meshes": [{"primitives": [lines, triangles]}], "nodes": [{"mesh": 0}]}
    mesh = load_mesh(gltf.write(tmp_path / "box.glb", [0]))
    np.testing.assert_allclose(mesh.bounds, [[0, -1, 0], [3, 0, 2]])


@dataclass
class Gltf:
    """A glTF document in the making, with its binary data."""

    data: bytes = b""
    document: dict = field(
        default_factory=lambda: {
            "asset": {"version": "2.0"},
            "accessors": [],
            "bufferViews": [],
            "meshes": [],
            "nodes": [],
        }
    )

    def add_array(self, array: np.ndarray, kind: str, component: int) -> int:
        """Add an accessor; return its number."""
        blob = array.tobytes()
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(blob)}
        self.data += blob + b"\0" * (-len(blob) % 4)
        self.document["bufferViews"].append(view)
        accessor = {
            "bufferView": len(self.document["bufferViews"]) - 1,
            "componentType": component,
            "count": len(array),
            "type": kind,
        }
        if kind == "VEC3":
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        self.document["accessors"].append(accessor)
        return len(self.document["accessors"]) - 1

    def add_primitive(self, vertices: np.ndarray, faces: np.ndarray | None, **more: object) -> dict:
        """Return a primitive of triangles, or of a strip if `mode` is 5."""
        position = self.add_array(vertices.astype("<f4"), "VEC3", 5126)
        primitive = {"attributes": {"POSITION": position}, **more}
        if faces is not None:
            primitive["indices"] = self.add_array(faces.ravel().astype("<u2"), "SCALAR", 5123)
        return primitive

    def write(self, path: Path, roots: list[int]) -> Path:
        self.document |= {"scene": 0, "scenes": [{"nodes": roots}]}
        buffer: dict[str, object] = {"byteLength": len(self.data)}
        self.document["buffers"] = [buffer]
        if path.suffix == ".gltf":
            text = base64.b64encode(self.data).decode()
            buffer["uri"] = f"data:application/octet-stream;base64,{text}"
            path.write_text(json.dumps(self.document))
        else:
            text = json.dumps(self.document).encode()
            text += b" " * (-len(text) % 4)
            chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
            chunks += struct.pack("<II", len(self.data), 0x004E4942) + self.data
            path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


def make_random_gltf(rng: np.random.Generator) -> tuple[Gltf, list[int]]:
    """Return meshes of several primitives, which nested nodes share, and the root nodes."""
    gltf = Gltf()
    for number in range(int(rng.integers(1, 4))):
        primitives = []
        for _ in range(int(rng.integers(1, 4))):
            shape = trimesh.creation.box(rng.uniform(0.1, 1.0, 3))
            shape.apply_translation(rng.uniform(-1.0, 1.0, 3))
            kind = rng.choice(["indexed", "plain", "strip"])
            if kind == "indexed":
                primitives.append(gltf.add_primitive(shape.vertices, shape.faces))
            elif kind == "plain":
                primitives.append(gltf.add_primitive(shape.triangles.reshape(-1, 3), None))
            else:
                strip = np.array([0, 1, 2, 3, 7, 1, 5, 4, 7, 6, 2, 4, 0, 1])
                primitives.append(gltf.add_primitive(shape.vertices, strip, mode=5))
        gltf.document["meshes"].append({"name": f"mesh{number}", "primitives": primitives})
    nodes = gltf.document["nodes"]

    def add_node(depth: int) -> int:
        node: dict = {"name": f"node{len(nodes)}"}
        place = len(nodes)
        nodes.append(node)
        if rng.random() < 0.5:
            matrix = trimesh.transformations.random_rotation_matrix(rng.random(3))
            matrix[:3, 3] = rng.uniform(-2.0, 2.0, 3)
            node["matrix"] = matrix.T.ravel().tolist()
        else:
            quaternion = rng.normal(size=4)
            node["rotation"] = (quaternion / np.linalg.norm(quaternion)).tolist()
            node["translation"] = rng.uniform(-2.0, 2.0, 3).tolist()
            node["scale"] = rng.uniform(0.3, 2.0, 3).tolist()
        if depth == 0 or rng.random() < 0.6:
            node["mesh"] = int(rng.integers(len(gltf.document["meshes"])))
        if depth:
            node["children"] = [add_node(depth - 1) for _ in range(int(rng.integers(1, 3)))]
        return place

    return gltf, [add_node(2) for _ in range(int(rng.integers(1, 3)))]


@given(SEEDS, st.sampled_from(["scene.gltf", "scene.glb"]))
@REPEATED
def test_gltf_scenes_are_read_as_assimp_reads_them(tmp_path: Path, seed: int, name: str) -> None:
    gltf, roots = make_random_gltf(np.random.default_rng(seed))
    check_file(gltf.write(tmp_path / name, roots))


@pytest.mark.parametrize("name", ["table.glb", "table.gltf"])
def test_y_is_up_in_gltf_files(tmp_path: Path, name: str) -> None:
    """The front of glTF files, +z, is the front of a scene seen along y: −y."""
    top = trimesh.creation.box((1.2, 0.04, 0.8)).apply_translation((0.0, 0.73, 0.1))
    gltf = Gltf()
    gltf.document["meshes"] = [{"primitives": [gltf.add_primitive(top.vertices, top.faces)]}]
    gltf.document["nodes"] = [{"mesh": 0, "name": "top"}]
    file = gltf.write(tmp_path / name, [0])
    low, high = [-0.6, -0.5, 0.71], [0.6, 0.3, 0.75]
    bounds = np.array([low, high])
    np.testing.assert_allclose(load_mesh(file).bounds, bounds, atol=1e-6)
    np.testing.assert_allclose(load_mesh(file, submesh="top").bounds, bounds, atol=1e-6)
    # The scale is along the axes in which the mesh is used.
    scaled = load_mesh(file, (1.0, 2.0, 3.0)).bounds
    np.testing.assert_allclose(scaled, bounds * (1.0, 2.0, 3.0), atol=1e-6)
    (part,) = load_parts(file)
    np.testing.assert_allclose([part.vertices.min(0), part.vertices.max(0)], bounds, atol=1e-6)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "required.*not supported.*draco"),
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "required.*not supported.*meshopt"),
        ({"nodes": [{"mesh": 0, "extensions": {"EXT_mesh_gpu_instancing": {}}}]}, "instancing"),
        ({"mode": 6}, "mode 6"),
        ({"normalized": True}, "normalized positions"),
        ({"sparse": "POSITION"}, "sparse accessor"),
        ({"sparse": "indices"}, "sparse accessor"),
    ],
)
def test_surfaces_of_gltf_files_that_cannot_be_read_raise(
    tmp_path: Path, change: dict, problem: str
) -> None:
    gltf = Gltf()
    more = {"mode": change["mode"]} if "mode" in change else {}
    primitive = gltf.add_primitive(BOX, np.array(BOX_TRIANGLES), **more)
    gltf.document |= {"meshes": [{"primitives": [primitive]}], "nodes": [{"mesh": 0}]}
    if "normalized" in change:
        gltf.document["accessors"][0]["normalized"] = True
    if "sparse" in change:
        number = {**primitive["attributes"], **primitive}[change["sparse"]]
        indices = {"bufferView": 1, "componentType": 5123}
        values = {"bufferView": 0}
        gltf.document["accessors"][number]["sparse"] = {
            "count": 1,
            "indices": indices,
            "values": values,
        }
    gltf.document |= {key: value for key, value in change.items() if key in ("nodes",)}
    gltf.document |= {k: value for k, value in change.items() if k == "extensionsRequired"}
    file = gltf.write(tmp_path / "box.glb", [0])
    with expect_error(problem, file=file):
        load_mesh(file)


@pytest.mark.parametrize("name", ["my box.bin", "box+1.bin", "100%.bin", "schön.bin"])
def test_buffers_of_gltf_files_are_named_by_uris(tmp_path: Path, name: str) -> None:
    gltf = Gltf()
    primitive = gltf.add_primitive(BOX, np.array(BOX_TRIANGLES))
    gltf.document |= {"meshes": [{"primitives": [primitive]}], "nodes": [{"mesh": 0}]}
    file = gltf.write(tmp_path / "box.gltf", [0])
    document = json.loads(file.read_text())
    (tmp_path / name).write_bytes(gltf.data)
    for uri in (name, quote(name)):
        document["buffers"][0]["uri"] = uri
        file.write_text(json.dumps(document))
        np.testing.assert_allclose(load_mesh(file).extents, [3, 1, 2])


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("\nf", " # corner\nf"),
        ("\nf", "\t#corner\nf"),
        ("\nf", " # f 1 2 3\n# f 1 2 3\nf"),
        ("v 3", "v 3.0e0"),
        (" 0\n", " 0 # on the floor\n"),
        ("v 0 0 0", "v -0.0E+00 0 0. #"),
    ],
)
def test_comments_of_obj_files_are_left_out(tmp_path: Path, old: str, new: str) -> None:
    """Neither trimesh nor assimp reads those behind faces."""
    lines = [f"v {x:g} {y:g} {z:g}" for x, y, z in BOX]
    lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in BOX_TRIANGLES]
    text = "\n".join(lines) + "\n"
    assert old in text
    file = tmp_path / "box.obj"
    file.write_text(text.replace(old, new))
    mesh = load_mesh(file)
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [3, 2, 1]])
    assert mesh.volume == pytest.approx(6.0)
