"""Tests scenes and robots with a changed file, and changed descriptions of scenes."""

from __future__ import annotations

import copy
import functools
import shutil
import tempfile
from pathlib import Path
from typing import Any

import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

import vkc_pin as vkc
from fuzz.bounds import PLANNING_SECONDS, expect_result_or_error, take_share
from fuzz.calls import SMALL
from fuzz.changes import change_bytes, change_data, get_value
from fuzz.values import JSON, VALUES
from vkc_pin.world.files.resources import find_resource_folder

DAE = Path(__file__).with_name("box.dae")
SUFFIXES = (".yaml", ".urdf", ".srdf", ".stl", ".obj", ".ply", ".dae")
ARENA = {"start": {"base": [0, 0, 0]}, "arena": {"x": [-9, 9], "y": [-9, 9]}}
PLANNED = st.integers(0, 49).map(lambda number: number == 0)  # also plan in the loaded scene


@functools.cache
def copy_resources() -> Path:
    """Copy all robots and scenes, and add a mesh of each format and a scene with these meshes."""
    root = Path(tempfile.mkdtemp())
    others = shutil.ignore_patterns("recipes")  # of datasets
    for kind in ("robots", "scenes"):
        shutil.copytree(find_resource_folder(kind), root / kind, ignore=others)
    scenes = root / "scenes"
    box = trimesh.creation.box(extents=(0.5, 0.4, 0.3))
    for kind in ("stl", "obj", "ply"):
        box.export(scenes / f"box.{kind}")
    shutil.copy(DAE, scenes)
    lines = ["robot: ../robots/husky_ur5e/robot.yaml", "start: {base: [0, 0, 0]}"]
    lines += ["arena: {x: [-9, 9], y: [-9, 9]}", "obstacles:"]
    for k, kind in enumerate(("stl", "obj", "ply", "dae")):
        lines.append(
            f"  - {{name: {kind}, type: mesh, file: box.{kind}, position: [{k}, 2.0, 0.5]}}"
        )
    (scenes / "meshes.yaml").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return root


@functools.cache
def list_files() -> list[str]:
    """Return the files of all robots and scenes."""
    root = copy_resources()
    files = [path for path in root.rglob("*") if path.suffix in SUFFIXES]
    return sorted(str(path.relative_to(root)) for path in files)


@functools.cache
def load_documents() -> dict[str, Any]:
    """Load the descriptions of some scenes."""
    names = ("door", "drawer", "fetch", "household", "init_1", "gap_table")
    documents = {name: vkc.load_scene(name).document for name in names}
    stick = vkc.Hold("stick", "grip", deviation=(0.001, 0.0, 0.002, 0.0, 0.1, 0.0))
    documents["measured"] = vkc.load_scene("init_1").with_held([stick]).document
    return documents


@st.composite
def changed_files(draw: st.DrawFn) -> tuple[str, bytes]:
    """Return the name and the changed content of a file."""
    name = draw(st.sampled_from(list_files()))
    return name, draw(change_bytes((copy_resources() / name).read_bytes()))


@st.composite
def changed_documents(draw: st.DrawFn) -> Any:
    """Return a changed description of a scene."""
    name = draw(st.sampled_from(sorted(load_documents())))
    values = draw(st.sampled_from((JSON, JSON, JSON, VALUES)))
    return draw(change_data(load_documents()[name], values))


def load_with_file(name: str, content: bytes, is_planned: bool = False) -> None:
    """Load, check and restore the scene or robot to which a changed file belongs."""
    file = copy_resources() / name
    original = file.read_bytes()
    try:
        file.write_bytes(content)
        with expect_result_or_error(PLANNING_SECONDS if is_planned else 2.0):
            check_scene(load_described_scene(file), is_planned)
    finally:
        file.write_bytes(original)


def load_described_scene(file: Path) -> vkc.Scene:
    """Load a robot, object or scene alone, and a scene that contains it."""
    scenes = copy_resources() / "scenes"
    entry: dict[str, Any] = {"name": "thing", "position": [3.0, 0.0, 0.5]}
    document: dict[str, Any] = {"robot": "husky_ur5e", **ARENA}
    match file.relative_to(copy_resources()).parts[:2]:
        case "robots", _:
            urdf = copy_resources() / "robots" / "husky_ur5e" / "husky_ur5e.urdf"
            vkc.load_robot(file if file.suffix in (".yaml", ".urdf") else urdf)
            document["robot"] = "../robots/husky_ur5e/robot.yaml"
        case _, "objects":
            vkc.load_object(file.with_suffix(".yaml"))
            document["objects"] = [{**entry, "type": f"objects/{file.stem}.yaml"}]
        case _, "furniture":
            document["obstacles"] = [{**entry, "type": "urdf", "file": f"furniture/{file.name}"}]
        case _:
            return vkc.load_scene(file if file.suffix == ".yaml" else scenes / "meshes.yaml")
    return vkc.Scene.from_document(document, scenes)


def check_scene(scene: vkc.Scene, is_planned: bool) -> None:
    """Use a loaded scene."""
    clearance = scene.start_clearance()
    assert clearance == clearance, "the clearance is not a number"
    repr(scene)
    vkc.Scene.from_document(scene.document, scene.folder)
    if not is_planned:
        return
    x, y, _ = scene.start[:3].tolist()
    steps: list[Any] = [vkc.GoTo(x, y, 0.5)]
    for name, placed in scene.objects.items():
        joints = placed.object.coordinates.names
        if joints and not placed.object.free:
            steps = [vkc.Actuate(name, {joints[0]: 0.1})]
    vkc.plan(scene, steps, **SMALL).summary()


@take_share(0.25)
@given(changed_files(), PLANNED)
def test_changed_files_yield_a_scene_or_an_error(file: tuple[str, bytes], is_planned: bool) -> None:
    load_with_file(*file, is_planned)


@take_share(0.15)
@given(changed_documents(), PLANNED)
def test_changed_documents_yield_a_scene_or_an_error(document: Any, is_planned: bool) -> None:
    with expect_result_or_error(PLANNING_SECONDS if is_planned else 2.0):
        scene = vkc.Scene.from_document(document, find_resource_folder("scenes"))
        check_scene(scene, is_planned)


@pytest.mark.parametrize(
    ("name", "before", "after"),
    [
        ("scenes/box.dae", "<p>0 2 1", "<p>0 2.5 1"),  # assimp read on for ever
        ("scenes/box.dae", "<p>0 2 1", "<p>0 ~ 1"),  # assimp took 12 GB in a minute
        # OSError
        (
            "robots/husky_ur5e/husky_ur5e.urdf",
            "package://husky_ur5e/collision/base_link_0.stl",
            "x" * 10_000,
        ),
    ],
    ids=["fraction as index", "tilde as index", "long file name"],
)
def test_past_failures_of_files_yield_a_scene_or_an_error(
    name: str, before: str, after: str
) -> None:
    content = (copy_resources() / name).read_text(encoding="utf-8")
    assert before in content
    load_with_file(name, content.replace(before, after).encode())


@pytest.mark.parametrize(
    ("scene", "path", "change"),
    [
        ("household", ("obstacles", 36), {"file": "x" * 10_000}),  # OSError
        ("household", ("obstacles", 29), {"name": "a\ud800b"}),  # UnicodeEncodeError
        ("door", ("obstacles", 0), {"\ud800": "red"}),  # UnicodeEncodeError
    ],
    ids=["long file name", "surrogate in a name", "surrogate in a key"],
)
def test_past_failures_of_documents_yield_a_scene_or_an_error(
    scene: str, path: tuple[Any, ...], change: dict[str, Any]
) -> None:
    document = copy.deepcopy(load_documents()[scene])
    get_value(document, path).update(change)
    with expect_result_or_error():
        vkc.Scene.from_document(document, find_resource_folder("scenes"))


@pytest.mark.long
def test_unchanged_files_and_documents_yield_a_scene() -> None:
    for name in list_files():
        check_scene(load_described_scene(copy_resources() / name), name == "scenes/door.yaml")
    for document in load_documents().values():
        scene = vkc.Scene.from_document(document, find_resource_folder("scenes"))
        check_scene(scene, is_planned=False)
