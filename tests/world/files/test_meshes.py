from __future__ import annotations

import sys
import warnings
from pathlib import Path

import coal
import numpy as np
import pytest
import trimesh

from vkc_pin.errors import InputError
from vkc_pin.world.files.meshes import (
    load_convex,
    load_mesh,
    load_parts,
    make_bvh,
    make_convex_hull,
)

# Two cubes of edge 1, one metre apart; in an OBJ file the indices go on counting through all
# objects.
FACES = np.array(
    [[1, 2, 4, 3], [5, 7, 8, 6], [1, 5, 6, 2], [3, 4, 8, 7], [1, 3, 7, 5], [2, 6, 8, 4]]
)
CORNERS = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])


def two_cubes(path: Path, materials: bool = False) -> Path:
    lines = ["mtllib two.mtl"] if materials else []
    for k in range(2):
        lines += [f"o cube{k}", *(f"v {x + 2 * k} {y} {z}" for x, y, z in CORNERS)]
        lines += [f"usemtl colour{k}"] if materials else []
        lines += ["f " + " ".join(str(i + 8 * k) for i in face) for face in FACES]
    path.write_text("\n".join(lines) + "\n")
    (path.parent / "two.mtl").write_text(
        "newmtl colour0\nKd 1.0 0.0 0.0\nnewmtl colour1\nKd 0.0 0.0 1.0\n"
    )
    return path


def test_objects_of_an_obj_file_stay_apart(tmp_path: Path) -> None:
    mesh = load_mesh(two_cubes(tmp_path / "two.obj"))
    assert mesh.area == pytest.approx(12.0)
    assert abs(mesh.volume) == pytest.approx(2.0)
    np.testing.assert_allclose(mesh.bounds, [[0, 0, 0], [3, 1, 1]])


def test_convex_hull_is_what_coal_holds(tmp_path: Path) -> None:
    shape = load_convex(two_cubes(tmp_path / "two.obj"), (0.5, 1.0, 2.0))
    assert isinstance(shape, coal.Convex)
    assert shape.computeVolume() == pytest.approx(1.5 * 1.0 * 2.0)
    assert shape.num_points == 8
    result = coal.DistanceResult()
    at = coal.Transform3s(np.eye(3), np.array([1.5 + 0.7 + 0.25, 0.5, 0.5]))
    distance = coal.distance(
        shape, coal.Transform3s.Identity(), coal.Sphere(0.25), at, coal.DistanceRequest(), result
    )
    assert distance == pytest.approx(0.7, abs=1e-6)


def test_hull_of_many_points() -> None:
    points = np.random.default_rng(0).standard_normal((500, 3))
    assert make_convex_hull(points).computeVolume() == pytest.approx(
        trimesh.convex.convex_hull(points).volume
    )


def test_finely_meshed_cone_has_more_neighbours_than_coal_takes() -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    rim = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(400)])
    shape = make_convex_hull(np.vstack([rim, [0.0, 0.0, 2.0]]))
    assert np.pi * 2.0 / 3.0 - 1e-3 < shape.computeVolume() < 1.1 * np.pi * 2.0 / 3.0
    hull = trimesh.convex.convex_hull(np.asarray(shape.points()))
    assert (
        rim @ hull.face_normals.T - np.einsum("ij,ij->i", hull.face_normals, hull.triangles[:, 0])
    ).max() < 1e-7


def test_colours_are_parts(tmp_path: Path) -> None:
    parts = load_parts(two_cubes(tmp_path / "two.obj", materials=True), 2.0)
    assert sorted(part.colour or () for part in parts) == [
        (0.0, 0.0, 1.0, 1.0),
        (1.0, 0.0, 0.0, 1.0),
    ]
    assert sum(len(part.faces) for part in parts) == 24
    assert max(part.vertices.max() for part in parts) == pytest.approx(6.0)
    shape = make_bvh(parts[0])
    assert shape.num_tris == len(parts[0].faces)


def test_less_detail_keeps_the_shape(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    ball.export(tmp_path / "ball.stl")
    (fine,) = load_parts(tmp_path / "ball.stl")
    (coarse,) = load_parts(tmp_path / "ball.stl", detail=0.01)
    assert len(coarse.faces) < 0.2 * len(fine.faces)
    assert np.abs(np.linalg.norm(coarse.vertices, axis=1) - 0.1).max() < 0.01


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("none.obj", None, "there is no such mesh"),
        ("empty.obj", "", "empty|cannot read"),
        ("points.obj", "v 0 0 0\nv 1 0 0\n", "empty|cannot read"),
        ("broken.stl", "not an STL file", "empty|cannot read"),
        ("thing.xyz3", "?", "cannot read"),
        ("number.obj", "v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "no numbers|cannot|empty"),
        ("flat.obj", "v 0 0\nv 1 0\nv 0 1\nv 1 1\nf 1 2 3\nf 2 3 4\n", "cannot read"),
        (
            "far.obj",
            "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1e300\nf 1 2 3\nf 1 2 4\nf 2 3 4\nf 3 1 4\n",
            "out of range",
        ),
    ],
)
def test_bad_meshes_are_named(tmp_path: Path, name: str, text: str | None, problem: str) -> None:
    file = tmp_path / name
    if text is not None:
        file.write_text(text)
    with pytest.raises(InputError, match=problem) as caught:
        load_convex(file)
    assert caught.value.file == file


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", (1.0, 1.0, 1e-3)),
        ("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3\nf 1 3 4\n", (1.0, 1.0, 1e-3)),
        (
            "v 0 0 1\nv 1 0 1\nv 0 1 1\nv 4 0 1\nv 5 0 1\nv 4 3 1\nf 1 2 3\nf 4 5 6\n",
            (5.0, 3.0, 1e-3),
        ),
        ("v 0 0 0\nv 1 0 0\nv 1 1 1e-7\nv 0 1 0\nf 1 2 3\nf 1 3 4\n", (1.0, 1.0, 1e-3)),
        ("v 0 2 0\nv 1 2 0\nv 3 2 0\nf 1 2 3\n", (3.0, 1e-3, 1e-3)),  # a line
    ],
    ids=["triangle", "square", "two", "nearly", "line"],
)
def test_flat_meshes_are_thickened_with_a_warning(
    tmp_path: Path, text: str, size: tuple[float, float, float]
) -> None:
    file = tmp_path / "picture.obj"
    file.write_text(text)
    with pytest.warns(
        UserWarning, match=r"hall of .*picture\.obj is flat: it collides as a plate, 1 mm thick"
    ):
        shape = load_convex(file, about="hall")
    corners = np.asarray(shape.points())
    assert np.ptp(corners, axis=0) == pytest.approx(
        size, rel=0.42 if size[1] == 1e-3 else 1e-3
    )  # a bar may stand on its edge
    given = load_mesh(file).vertices
    for point in np.asarray(given):  # the sheet is in its middle
        ball = coal.distance(
            shape, coal.Transform3s(), coal.Sphere(1e-5), coal.Transform3s(np.eye(3), point), coal.DistanceRequest(),
            coal.DistanceResult(),
        )  # fmt: skip
        assert ball < 0.0


def test_few_triangles_of_any_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """trimesh asks for networkx where Qhull shakes flat points into a hull; it is none of our dependencies."""
    monkeypatch.setitem(sys.modules, "networkx", None)
    rng, file = np.random.default_rng(0), tmp_path / "few.off"
    said = 0
    for number in range(60):
        points = rng.normal(size=(6, 3))
        points[:, 2] *= (1.0, 0.0, 10.0 ** -rng.integers(3, 14))[number % 3]
        rows = "\n".join(" ".join(map(repr, row)) for row in points.tolist())
        file.write_text(f"OFF\n6 2 0\n{rows}\n3 0 1 2\n3 3 4 5\n")
        assert len(load_mesh(file).faces) == 2
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            shape = load_convex(file)
        said += len(caught)
        least = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[-1]
        assert shape.computeVolume() > 0.0
        assert len(caught) == (least < 1e-5 * np.ptp(points, axis=0).max()) or 1e-6 < least < 1e-4
    assert 20 <= said <= 40


@pytest.mark.parametrize("scale", [(1.0, 0.0, 1.0), (1.0, 2.0), (np.nan, 1.0, 1.0)])
def test_bad_scale(tmp_path: Path, scale: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="scale"):
        load_mesh(two_cubes(tmp_path / "two.obj"), scale)
