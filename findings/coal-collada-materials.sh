#!/bin/sh
# coal 3.0.3: MeshLoader reads the first material of a COLLADA mesh alone.
#
# Behaviour: a <mesh> with two <triangles>, one for each material, becomes a BVH with the triangles
# of both and the vertices of the first: the triangles of the second index the first's vertices. Of
# a box from x = 0 to 0.1 and one from 0.5 to 0.6, nothing is left beyond 0.1. No error or warning.
#
# One would guess: both boxes, x from 0 to 0.6, as when each is a mesh of its own node, and as
# assimp, which coal reads files with, returns them.
#
# Source: coal-library/coal, src/mesh_loader/assimp.cpp, recurseBuildMesh; assimp makes one aiMesh
# of each material, all in one node.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet coal==3.0.3 numpy==2.4.6
"$folder/venv/bin/python" - "$folder/boxes.dae" <<'PYTHON'
import sys

import coal
import numpy as np

CORNERS = [(x, y, z) for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.1)]
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
FACES = [face for a, b, c, d in SIDES for face in ((a, b, c), (a, c, d))]


def format_triangles(first, material):
    indices = " ".join(str(first + corner) for face in FACES for corner in face)
    return (
        f'<triangles count="12" material="{material}">'
        f'<input semantic="VERTEX" source="#v" offset="0"/><p>{indices}</p></triangles>'
    )


points = CORNERS + [(x + 0.5, y, z) for x, y, z in CORNERS]
numbers = " ".join(str(number) for point in points for number in point)
with open(sys.argv[1], "w") as file:
    file.write(
        f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="1"/><up_axis>Y_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh><source id="s">
<float_array id="a" count="48">{numbers}</float_array><technique_common>
<accessor source="#a" count="16" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#s"/></vertices>
{format_triangles(0, "red")}{format_triangles(8, "blue")}</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="w"><node><instance_geometry url="#g"/></node>
</visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#w"/></scene></COLLADA>"""
    )
mesh = coal.MeshLoader().load(sys.argv[1], np.ones(3))
corners = np.array(mesh.vertices())
used = sorted({mesh.tri_indices(k)[i] for k in range(mesh.num_tris) for i in range(3)})
print("triangles:", mesh.num_tris, "x up to", corners[used, 0].max(), "expected: 24, 0.6")
sys.exit(0 if mesh.num_tris == 24 and corners[used, 0].max() < 0.11 else 1)
PYTHON
