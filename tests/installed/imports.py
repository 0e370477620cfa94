"""Imports a home, an object and robots whose meshes include a thin pole and a concave body."""

from __future__ import annotations

from pathlib import Path

from helpers.arm_urdf import write_arms
from helpers.homes import HOME_MJCF
from helpers.poles import write_pole

import vkc_pin as vkc

SAMPLES = 50
L_SHAPE = [(0.05, 0.05), (-0.3, 0.05), (-0.3, -0.3), (0.3, -0.3), (0.3, 0.3), (0.05, 0.3)]
"""Corners of a concave prism, [m], starting with the one from which all others are visible."""
HOME = """<robot name="home"><link name="world">
<collision name="north"><origin xyz="0 3 1"/><geometry><box size="6 0.1 2"/></geometry></collision>
<collision name="south"><origin xyz="0 -3 1"/><geometry><box size="6 0.1 2"/></geometry></collision>
</link>
<link name="lamp"><collision><geometry><mesh filename="pole.obj"/></geometry></collision></link>
<joint name="lamp_stands" type="fixed"><parent link="world"/><child link="lamp"/></joint>
<link name="cupboard"><collision><geometry><box size="0.4 0.6 0.8"/></geometry></collision></link>
<joint name="cupboard_stands" type="fixed"><parent link="world"/><child link="cupboard"/>
<origin xyz="2.5 0 0.4"/></joint>
<link name="leaf">
<collision><origin xyz="0 0.3 0"/><geometry><box size="0.02 0.6 0.8"/></geometry></collision>
<collision name="handle"><origin xyz="-0.08 0.5 0"/>
<geometry><cylinder radius="0.01" length="0.3"/></geometry></collision></link>
<joint name="hinge" type="revolute"><parent link="cupboard"/><child link="leaf"/>
<origin xyz="-0.25 -0.3 0"/><axis xyz="0 0 -1"/>
<limit lower="-1.5" upper="0" effort="1" velocity="1"/></joint></robot>"""
BOX = """<robot name="box"><link name="body">
<collision><geometry><mesh filename="pole.obj"/></geometry></collision>
<collision><origin xyz="0 0 0.4"/>
<geometry><mesh filename="prism.obj"/></geometry></collision></link>
<link name="leaf">
<collision><origin xyz="0 0.3 0"/><geometry><box size="0.02 0.6 0.3"/></geometry></collision>
<collision name="handle"><origin xyz="-0.08 0.5 0"/>
<geometry><cylinder radius="0.01" length="0.3"/></geometry></collision></link>
<joint name="hinge" type="revolute"><parent link="body"/><child link="leaf"/>
<origin xyz="-0.35 -0.3 0.4"/><axis xyz="0 0 -1"/>
<limit lower="-1.5" upper="0" effort="1" velocity="1"/></joint></robot>"""


def write_prism(file: Path) -> None:
    """Write a concave prism, 0.3 m high, as an OBJ file."""
    count = len(L_SHAPE)
    lines = [f"v {x} {y} {z}" for z in (-0.15, 0.15) for x, y in L_SHAPE]
    lines.append("f " + " ".join(str(k) for k in range(count, 0, -1)))
    lines.append("f " + " ".join(str(count + k) for k in range(1, count + 1)))
    for k in range(count):
        a, b = k + 1, (k + 1) % count + 1
        lines.append(f"f {a} {b} {b + count} {a + count}")
    file.write_text("\n".join(lines) + "\n", encoding="utf-8")


def write_xacro(folder: Path, shape: str) -> Path:
    """Write a robot with a mesh as its base as a xacro file, and return it."""
    text = write_arms(folder, mesh="${shape}.obj").read_text(encoding="utf-8")
    head = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="robot">'
    head += f'<xacro:property name="shape" value="{shape}"/>'
    file = folder / "robot.urdf.xacro"
    file.write_text(text.replace('<robot name="robot">', head), encoding="utf-8")
    return file


def main() -> None:
    write_pole(Path("pole.obj"))
    write_prism(Path("prism.obj"))
    Path("home.urdf").write_text(HOME, encoding="utf-8")
    Path("home.xml").write_text(HOME_MJCF, encoding="utf-8")
    Path("box.urdf").write_text(BOX, encoding="utf-8")
    home = vkc.importing.import_home("home.urdf", "urdf_home")
    assert "lamp" in vkc.load_scene(home.file).obstacle_names
    assert vkc.load_scene(vkc.importing.import_home("home.xml", "mjcf_home").file).objects
    assert vkc.importing.import_object("box.urdf", "box").proposals.opening("hinge")
    for shape in ("pole", "prism"):
        file = write_xacro(Path(), shape)
        assert vkc.importing.import_robot(file, f"robot_{shape}", samples=SAMPLES).pieces


if __name__ == "__main__":
    main()
