"""Tests of readers of points, against pypcd4, trimesh and pyoctomap."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import vkc_pin as vkc

POINTS = np.array([[0.1, -2.5, 3.25], [1e-3, 7.0, -0.5], [4.0, 5.0, 6.0]], np.float32)
SENSOR = (1.0, 2.0, 3.0, 0.70710678, 0.0, 0.0, 0.70710678)


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_ply_equals_what_trimesh_reads(encoding: str, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    content = trimesh.exchange.ply.export_ply(
        trimesh.creation.box(),
        encoding={"ascii": "ascii", "binary_little_endian": "binary"}[encoding],
    )
    file = tmp_path / "box.ply"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    read = vkc.read_points(file)
    expected = trimesh.load(file).vertices
    np.testing.assert_allclose(read.points, expected, atol=1e-7)
    assert read.dropped == 0
    assert read.radius is None


def test_ply_reads_other_properties_and_doubles(tmp_path: Path) -> None:
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment of a scanner\nelement vertex 2\n"
        "property uchar red\nproperty double z\nproperty float x\nproperty double y\n"
        "element face 0\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = b"".join(struct.pack("<Bdfd", 7, 3.0 + k, 1.0, 2.0) for k in range(2))
    file = tmp_path / "scan.ply"
    file.write_bytes(header.encode() + rows)
    np.testing.assert_array_equal(vkc.read_points(file).points, [[1.0, 2.0, 3.0], [1.0, 2.0, 4.0]])


@pytest.mark.parametrize("encoding", ["ascii", "binary", "binary_compressed"])
def test_pcd_equals_what_pypcd4_writes(encoding: str, tmp_path: Path) -> None:
    pypcd4 = pytest.importorskip("pypcd4")
    rng = np.random.default_rng(4)
    # Repeated values exercise copies of earlier output in compressed files.
    points = np.round(rng.normal(size=(500, 3)), 1).astype(np.float32)
    points[17] = np.nan
    colours = np.zeros((500, 1), np.float32)
    cloud = pypcd4.PointCloud.from_xyzrgb_points(np.hstack([points, colours]))
    cloud.metadata.viewpoint = SENSOR
    file = tmp_path / "cloud.pcd"
    cloud.save(file, pypcd4.Encoding(encoding))
    assert "VIEWPOINT 1" in file.read_bytes()[:600].decode("ascii", "replace")
    read = vkc.read_points(file)
    assert read.dropped == 1
    np.testing.assert_allclose(read.points, np.delete(points, 17, axis=0), atol=1e-6)


def _write_octomap(file: Path, occupied: np.ndarray, resolution: float, *, binary: bool) -> object:
    pyoctomap = pytest.importorskip("pyoctomap")
    tree = pyoctomap.OcTree(resolution)
    for point in occupied:
        tree.updateNode(point.tolist(), True)
    tree.updateNode([1.05, 1.05, 1.05], False)
    tree.updateInnerOccupancy()
    assert tree.writeBinary(str(file)) if binary else tree.write(str(file))
    return tree


@pytest.mark.parametrize("binary", [True, False])
def test_octomap_has_the_occupied_cells(binary: bool, tmp_path: Path) -> None:
    resolution = 0.1
    rng = np.random.default_rng(6)
    cells = np.unique(rng.integers(-30, 30, (300, 3)), axis=0)
    # Eight cells of an aligned cube become one leaf of twice the size.
    block = np.array([40, 40, 40]) + np.indices((2, 2, 2)).reshape(3, -1).T
    cells = np.concatenate([cells, block])
    centers = (cells + 0.5) * resolution
    file = tmp_path / ("map.bt" if binary else "map.ot")
    _write_octomap(file, centers, resolution, binary=binary)
    read = vkc.read_points(file)
    assert read.radius == pytest.approx(resolution * np.sqrt(3.0) / 2.0)
    found = read.points[np.lexsort(read.points.T)]
    expected = centers[np.lexsort(centers.T)]
    assert len(found) == len(expected)
    order = np.lexsort(np.round(found, 6).T)
    other = np.lexsort(np.round(expected, 6).T)
    np.testing.assert_allclose(found[order], expected[other], atol=1e-9)


PLY = b"ply\nformat ascii 1.0\nelement vertex 1\n"
XYZ = b"property float x\nproperty float y\nproperty float z\nend_header\n"
PCD = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 1\n"
BT = b"# Octomap OcTree binary file\nid OcTree\nsize 1\nres 0.1\ndata\n"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.xyz", b"", "unknown format of points .*got .xyz"),
        ("a.ply", b"obj\nend_header\n", "not a PLY file"),
        ("a.ply", b"ply\n", "the header does not end"),
        ("a.ply", PLY + b"property float x\nend_header\n1\n", "no coordinates"),
        ("a.ply", PLY + XYZ + b"1 2\n", "point 0 is damaged"),
        ("a.ply", PLY + XYZ + b"nan 1 2\n", "no finite points"),
        ("a.ply", PLY.replace(b"ascii", b"binary_big_endian") + XYZ, "unknown encoding"),
        ("a.ply", PLY.replace(b"vertex 1", b"vertex 99999999999999") + XYZ, "invalid number"),
        ("a.ply", PLY.replace(b"ascii", b"binary_little_endian") + XYZ, "incomplete .*12 bytes"),
        ("a.pcd", PCD + b"DATA binary\n123", "incomplete"),
        ("a.pcd", PCD + b"DATA zip\n", "unknown encoding"),
        ("a.pcd", PCD.replace(b"SIZE 4", b"SIZE 3") + b"DATA ascii\n1 2 3\n", "unknown type"),
        ("a.pcd", PCD + b"DATA binary_compressed\n" + struct.pack("<II", 9, 9), "damaged"),
        (
            "a.pcd",
            PCD + b"DATA binary_compressed\n" + struct.pack("<II", 2, 12) + b"\xff\xff",
            "damaged compressed data",
        ),
        ("a.bt", b"hello", "not an OctoMap file"),
        ("a.bt", BT.replace(b"id OcTree", b"id ColorOcTree"), "another kind of tree"),
        ("a.bt", BT.replace(b"0.1", b"x"), "invalid resolution"),
        ("a.bt", BT + b"\x03", "the file is incomplete"),
        ("a.bt", BT + b"\x03\x00" * 40, "the file is incomplete"),
        ("a.bt", BT + b"\x02\x00", "too many occupied cells"),
        ("a.bt", BT + b"\x00\x00", "no occupied cells"),
    ],
)
def test_damaged_files_are_refused(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    file = tmp_path / name
    file.write_bytes(content)
    with pytest.raises(vkc.InputError, match=message) as caught:
        vkc.read_points(file)
    assert caught.value.file == file


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(vkc.InputError, match="there is no such file"):
        vkc.read_points(tmp_path / "none.ply")


@settings(
    max_examples=150,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    head=st.sampled_from(
        [
            ("a.bt", BT),
            ("a.ot", BT.replace(b"binary ", b"")),
            ("a.pcd", PCD + b"DATA binary_compressed\n"),
            ("a.pcd", PCD + b"DATA ascii\n"),
            ("a.ply", PLY + XYZ),
            ("a.ply", b""),
        ]
    ),
    rest=st.binary(max_size=80),
)
def test_any_bytes_are_points_or_an_input_error(
    head: tuple[str, bytes], rest: bytes, tmp_path: Path
) -> None:
    file = tmp_path / head[0]
    file.write_bytes(head[1] + rest)
    try:
        read = vkc.read_points(file)
    except vkc.InputError:
        return
    assert np.isfinite(read.points).all()
