"""Provides object files in the style of public datasets."""

from __future__ import annotations

from pathlib import Path

import trimesh


def write_partnet_object(folder: Path) -> Path:
    """Write a cabinet in the style of PartNet-Mobility, and return its `mobility.urdf`.

    The cabinet is about one unit high with y up; a fixed joint below the empty link `base` sets it
    upright. Its many small meshes are visual and collision shapes, and only visuals have names. It
    has a drawer with a flat decoration, a door without limits and a wheel without shape. No joint
    has effort or velocity limits.
    """
    meshes = folder / "textured_objs"
    meshes.mkdir(parents=True)

    def write_box(name: str, size: tuple[float, ...], at: tuple[float, ...]) -> str:
        trimesh.creation.box(size).apply_translation(at).export(meshes / f"{name}.obj")
        return name

    def format_shapes(parts: dict[str, str], xyz: str = "0 0 0") -> str:
        shapes = {
            file: f'<origin xyz="{xyz}"/><geometry>'
            f'<mesh filename="textured_objs/{file}.obj"/></geometry>'
            for file in parts
        }
        visuals = "".join(
            f'<visual name="{name}">{shapes[file]}</visual>' for file, name in parts.items()
        )
        return visuals + "".join(f"<collision>{shape}</collision>" for shape in shapes.values())

    # x to the right, y up, z to the front
    case = {
        write_box("original-1", (0.04, 1.0, 0.6), (-0.38, 0.0, 0.0)): "frame-1",
        write_box("original-2", (0.04, 1.0, 0.6), (0.38, 0.0, 0.0)): "frame-2",
        write_box("original-3", (0.8, 1.0, 0.04), (0.0, 0.0, -0.28)): "frame-3",
        write_box("original-4", (0.8, 0.04, 0.6), (0.0, 0.48, 0.0)): "frame-4",
    }
    drawer = {
        write_box("original-5", (0.7, 0.3, 0.02), (0.0, 0.25, 0.35)): "board-5",
        write_box("original-7", (0.2, 0.02, 0.02), (0.0, 0.25, 0.45)): "handle-7",
        write_box("original-8", (0.02, 0.02, 0.08), (-0.1, 0.25, 0.4)): "handle-8",
        write_box("original-9", (0.02, 0.02, 0.08), (0.1, 0.25, 0.4)): "handle-9",
    }
    front = trimesh.Trimesh(
        [[-0.3, 0.12, 0.361], [0.3, 0.12, 0.361], [0.3, 0.38, 0.361], [-0.3, 0.38, 0.361]],
        [[0, 1, 2], [0, 2, 3]],
    )
    front.export(meshes / "original-6.obj")
    drawer["original-6"] = "decoration-6"
    door = {
        write_box("original-10", (0.7, 0.4, 0.02), (0.0, -0.2, 0.35)): "board-10",
        write_box("original-11", (0.02, 0.2, 0.02), (0.3, -0.2, 0.45)): "bar-11",
    }
    text = f"""<?xml version="1.0" ?>
<robot name="partnet_cabinet">
  <link name="base"/>
  <link name="link_2">{format_shapes(case)}</link>
  <joint name="joint_2" type="fixed"><origin rpy="1.570796326794897 0 -1.570796326794897"/>
    <child link="link_2"/><parent link="base"/></joint>
  <link name="link_0">{format_shapes(drawer)}</link>
  <joint name="joint_0" type="prismatic">
    <origin xyz="0 0 0"/><axis xyz="0 0 1"/><child link="link_0"/><parent link="link_2"/>
    <limit lower="0" upper="0.36"/></joint>
  <link name="link_1">{format_shapes(door, "0.38 0 -0.3")}</link>
  <joint name="joint_1" type="revolute"><origin xyz="-0.38 0 0.3"/><axis xyz="0 -1 0"/>
    <child link="link_1"/><parent link="link_2"/></joint>
  <link name="link_3"/>
  <joint name="joint_3" type="continuous"><axis xyz="0 1 0"/>
    <child link="link_3"/><parent link="link_2"/></joint>
</robot>"""
    (folder / "mobility.urdf").write_text(text)
    return folder / "mobility.urdf"


MJCF = """<mujoco>
  <compiler angle="radian"/>
  <asset><mesh name="wedge" vertex="0 0 0  0.1 0 0  0 0.1 0  0 0 0.1"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 0.1"/>
    <body name="case" pos="1 0 0.4">
      <geom type="box" size="0.2 0.3 0.4"/>
      <body name="door" pos="-0.25 -0.3 0">
        <joint name="hinge" axis="0 0 -1" range="-1.5 0" pos="0 0 0"/>
        <geom name="leaf" type="box" size="0.01 0.3 0.4" pos="0 0.3 0"/>
        <geom name="handle" type="capsule" fromto="-0.08 0.5 -0.15 -0.08 0.5 0.15" size="0.01"/>
        <geom name="looks" type="mesh" mesh="wedge" pos="-0.02 0.1 0" contype="0" conaffinity="0"/>
      </body>
    </body>
    <body name="cup" pos="2 0 0"><freejoint/><geom type="sphere" size="0.04"/></body>
  </worldbody>
</mujoco>"""

SDF = """<?xml version="1.0"?>
<sdf version="1.7">
  <model name="box">
    <link name="case"><pose>1 0 0.4 0 0 0</pose>
      <collision name="body">
        <geometry><box><size>0.4 0.6 0.8</size></box></geometry></collision></link>
    <link name="door"><pose relative_to="case">-0.25 0 0 0 0 0</pose>
      <collision name="leaf"><geometry><box><size>0.02 0.6 0.8</size></box></geometry></collision>
      <collision name="handle"><pose>-0.08 0.2 0 0 0 0</pose>
        <geometry><cylinder><radius>0.01</radius><length>0.3</length></cylinder></geometry></collision></link>
    <joint name="hinge" type="revolute">
      <pose>0 -0.3 0 0 0 1.0</pose><parent>case</parent><child>door</child>
      <axis><xyz>0 0 -1</xyz><limit><lower>-1.5</lower><upper>0</upper></limit></axis></joint>
  </model>
</sdf>"""
