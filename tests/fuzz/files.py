"""Corrupts one file at a time in a copy of all robots and scenes."""

from __future__ import annotations

import atexit
import functools
import random
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

import vkc_pin as vkc
from vkc_pin.world.files.resources import find_resource_folder

from . import odd
from .calls import TINY
from .mutate import apply_changes, choose_changes, corrupt

__all__ = ["DAE", "make_case", "make_document_case", "run", "run_document"]

MESHES = {"stl": "box.stl", "obj": "box.obj", "ply": "box.ply", "dae": "box.dae"}
PLANNING_SHARE = 0.02  # share of cases that also plan in the loaded scene


@functools.cache
def copy_resources() -> Path:
    """Copy all robots and scenes, and add a mesh of each format and a scene with these meshes."""
    root = Path(tempfile.mkdtemp(prefix="vkc_fuzz_files_"))
    atexit.register(shutil.rmtree, root, ignore_errors=True)
    for kind in ("robots", "scenes"):
        shutil.copytree(find_resource_folder(kind), root / kind)
    for name in MESHES.values():
        if not name.endswith("dae"):
            trimesh.creation.box(extents=(0.5, 0.4, 0.3)).export(root / "scenes" / name)
    (root / "scenes" / "box.dae").write_text(DAE, encoding="utf-8")
    entries = [
        f"  - {{name: {kind}, type: mesh, file: {name}, position: [{k}, 2.0, 0.5]}}"
        for k, (kind, name) in enumerate(MESHES.items())
    ]
    obstacles = "\n".join(entries)
    text = (
        "robot: ../robots/husky_ur5e/robot.yaml\nstart: {base: [0, 0, 0]}\n"
        "arena: {x: [-9, 9], y: [-9, 9]}\nobstacles:\n"
    )
    (root / "scenes" / "meshes.yaml").write_text(f"{text}{obstacles}\n", encoding="utf-8")
    return root


@functools.cache
def _list_files() -> tuple[str, ...]:
    files = [
        path
        for path in sorted(copy_resources().rglob("*"))
        if path.suffix in (".yaml", ".urdf", ".srdf", ".stl", ".obj", ".ply", ".dae")
    ]
    return tuple(str(path.relative_to(copy_resources())) for path in files)


def make_case(rng: random.Random) -> dict[str, Any]:
    """Return a case: a file and its new contents."""
    name = rng.choice(_list_files())
    if name.endswith(".stl") and rng.random() < 0.7:  # most files are STL meshes
        name = rng.choice([other for other in _list_files() if not other.endswith(".stl")])
    data = corrupt(rng, (copy_resources() / name).read_bytes())
    return {"file": name, "content": data.decode("latin-1"), "plan": rng.random() < PLANNING_SHARE}


def run(case: dict[str, Any]) -> str:
    """Load and check the scene or robot to which the corrupted file belongs."""
    file = copy_resources() / case["file"]
    original = file.read_bytes() if file.is_file() else None
    file.parent.mkdir(parents=True, exist_ok=True)
    try:
        file.write_bytes(case["content"].encode("latin-1"))
        return _check(_load(file), with_plan=case.get("plan", False))
    finally:
        if original is None:
            file.unlink()
        else:
            file.write_bytes(original)


def _load(file: Path) -> vkc.Scene:
    scenes, robot = copy_resources() / "scenes", "../robots/husky_ur5e/robot.yaml"
    base: dict[str, Any] = {
        "robot": "husky_ur5e",
        "start": {"base": [0, 0, 0]},
        "arena": {"x": [-9, 9], "y": [-9, 9]},
    }
    parts = file.relative_to(copy_resources()).parts
    if parts[0] == "robots":
        vkc.load_robot(
            file if file.suffix in (".yaml", ".urdf") else file.parent / "husky_ur5e.urdf"
        )
        return vkc.Scene.from_document({**base, "robot": robot}, scenes)
    if parts[1] == "objects":
        file = file.with_suffix(".yaml")
        vkc.load_object(file)
        entry = {"name": "thing", "type": f"objects/{file.name}", "position": [3.0, 0.0, 0.5]}
        return vkc.Scene.from_document({**base, "objects": [entry]}, scenes)
    if parts[1] == "furniture":
        entry = {
            "name": "thing",
            "type": "urdf",
            "file": f"furniture/{file.name}",
            "position": [3.0, 0.0, 0.0],
        }
        return vkc.Scene.from_document({**base, "obstacles": [entry]}, scenes)
    return vkc.load_scene(file if file.suffix == ".yaml" else scenes / "meshes.yaml")


def _check(scene: vkc.Scene, *, with_plan: bool) -> str:
    assert not np.isnan(scene.start_clearance()), "the clearance is not a number"
    repr(scene)
    vkc.Scene.from_document(scene.document, scene.folder)
    if not with_plan:
        return "loaded"
    steps: list[Any] = [vkc.GoTo(float(scene.start[0]), float(scene.start[1]), 0.5)]
    for name, placed in scene.objects.items():
        if not placed.object.free and placed.object.coordinates.names:
            steps = [vkc.Actuate(name, {placed.object.coordinates.names[0]: 0.1})]
    plan = vkc.plan(scene, steps, options=vkc.Options(**TINY), time_limit=0.2)
    plan.summary()
    return "planned"


@functools.cache
def _load_documents() -> dict[str, Any]:
    names = ("door", "drawer", "fetch", "household", "init_1", "gap_table")
    stick = vkc.Hold("stick", "grip", deviation=(0.001, 0.0, 0.002, 0.0, 0.1, 0.0))
    measured = vkc.load_scene("init_1").with_held([stick]).document
    return {name: vkc.load_scene(name).document for name in names} | {"measured": measured}


def make_document_case(rng: random.Random) -> dict[str, Any]:
    """Return a case: a scene and changes of its description."""
    name = rng.choice(tuple(_load_documents()))
    values = odd.VALUES if rng.random() < 0.2 else tuple(odd.JSON_VALUES)
    return {
        "scene": name,
        "changes": choose_changes(rng, _load_documents()[name], values),
        "plan": rng.random() < PLANNING_SHARE,
    }


def run_document(case: dict[str, Any]) -> str:
    """Load and check a scene from its changed description."""
    document = apply_changes(_load_documents()[case["scene"]], case["changes"])
    return _check(
        vkc.Scene.from_document(document, find_resource_folder("scenes")),
        with_plan=case.get("plan", False),
    )


DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="1"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">0 0 0 1 0 0 0 1 0 0 0 1</float_array>
<technique_common><accessor source="#a" count="4" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/>
<p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles></mesh>
</geometry></library_geometries><library_visual_scenes><visual_scene id="s">
<node><instance_geometry url="#g"/></node></visual_scene>
</library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>
"""
