"""Loads a thin pole from every documented mesh format, and its hull in a scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from helpers.poles import write_pole

import vkc_pin as vkc
from vkc_pin.world.files.meshes import load_convex, load_mesh, load_parts

FORMATS = ("obj", "stl", "ply", "off", "gltf", "glb", "dae")
DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="1"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="{numbers}">{points}</float_array>
<technique_common><accessor source="#a" count="{vertices}" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="{triangles}"><input semantic="VERTEX" source="#v" offset="0"/><p>{corners}</p>
</triangles></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node><instance_geometry url="#g"/></node>
</visual_scene></library_visual_scenes><scene><instance_visual_scene url="#s"/></scene></COLLADA>
"""


def write_formats(folder: Path) -> None:
    """Write the pole in every format; OBJ and MTL files in Latin-1 with non-ASCII comments."""
    pole = load_mesh(write_pole(folder / "pole.obj"))
    for name in ("stl", "ply", "off", "glb"):
        pole.export(folder / f"pole.{name}")
    for name, content in pole.export(file_type="gltf").items():
        (folder / ("pole.gltf" if name.endswith(".gltf") else name)).write_bytes(content)
    faces = np.asarray(pole.faces)
    text = DAE.format(
        numbers=pole.vertices.size,
        points=" ".join(map(repr, pole.vertices.ravel().tolist())),
        vertices=len(pole.vertices),
        triangles=len(faces),
        corners=" ".join(map(str, faces.ravel().tolist())),
    )
    (folder / "pole.dae").write_text(text, encoding="utf-8")
    text = write_pole(folder / "pole.obj").read_text(encoding="utf-8")
    material = "# grün\nnewmtl green\nKd 0 1 0\n"
    (folder / "pole.mtl").write_text(material, encoding="latin-1")
    (folder / "pole.obj").write_text(
        f"# Größe in Metern\nmtllib pole.mtl\nusemtl green\n{text}", encoding="latin-1"
    )


def main() -> None:
    write_formats(Path())
    volume = load_convex("pole.obj").computeVolume()
    for name in FORMATS:
        file = Path(f"pole.{name}")
        assert len(load_mesh(file).faces) == 44, file
        assert abs(load_convex(file).computeVolume() / volume - 1.0) < 1e-3, file
    assert load_parts("pole.obj")[0].colour == (0.0, 1.0, 0.0, 1.0)
    obstacles = [
        {"name": name, "type": "mesh", "file": f"pole.{name}", "position": [k, 1.0, 0.5]}
        for k, name in enumerate(FORMATS)
    ]
    document = {"robot": "husky_ur5e", "start": {"base": [0, 0, 0]}, "obstacles": obstacles}
    scene = vkc.Scene.from_document(document)
    assert scene.obstacle_names == FORMATS


if __name__ == "__main__":
    main()
