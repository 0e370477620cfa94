"""Writes files of whole homes: one URDF or MJCF with rooms, furniture and free objects."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import numpy as np
import trimesh

import vkc_pin as vkc

PLACES = {  # kind of furniture → x, y, yaw of its base in the world, and its seed
    "refrigerator": (3.9, 1.6, 0.0, 1),
    "drawers": (3.9, 0.2, 0.0, 3),
    "dishwasher": (3.9, -1.4, 0.0, 2),
    "door": (0.0, 3.0, np.pi / 2.0, 2),
}
"""Furniture is against the east wall; the door is between the living room and the bedroom."""
WALLS = {  # name → x from, to; y from, to [m]
    "wall_east": (4.7, 4.8, -4.0, 6.0),
    "wall_west": (-4.8, -4.7, -4.0, 6.0),
    "wall_north": (-4.8, 4.8, 6.0, 6.1),
    "wall_south": (-4.8, 4.8, -4.1, -4.0),
    "wall_bath": (-1.55, -1.45, -4.0, -1.5),
    "wall_bath_north": (-4.7, -2.6, -1.5, -1.4),
}


def write_home_urdf(folder: Path) -> tuple[Path, int]:
    """Write a home of three rooms as one URDF; return it and the number of its collision shapes.

    Walls are shapes of the root. Refrigerator, drawers, dishwasher and door are fixed to the root.
    The sofa is a concave mesh, the table has several shapes. Two cups and a lump that is too thick
    for the hand are floating; a carpet lies on the floor.
    """
    folder.mkdir(parents=True, exist_ok=True)
    robot = ElementTree.Element("robot", name="home")
    world = ElementTree.SubElement(robot, "link", name="world")
    for name, (x0, x1, y0, y1) in (WALLS | _compute_walls_beside_door()).items():
        _add_box(world, (x1 - x0, y1 - y0, 2.5), ((x0 + x1) / 2, (y0 + y1) / 2, 1.25), name)
    _add_box(world, (9.6, 10.2, 0.1), (0.0, 1.0, -0.05), "slab")
    for kind, (x, y, yaw, seed) in PLACES.items():
        source = ElementTree.fromstring(str(vkc.procedural.random_object(kind, seed)["urdf"]))
        links = [link.get("name", "") for link in source.findall("link")]
        for element in (*source.findall("link"), *source.findall("joint")):
            for name in [element, *element.findall("parent"), *element.findall("child")]:
                for key in ("name", "link"):
                    if name.get(key) is not None:
                        name.set(key, f"{kind}_{name.get(key)}")
            robot.append(element)
        _add_joint(
            robot, f"{kind}_stands", "fixed", "world", f"{kind}_{links[0]}", (x, y, 0.0), yaw
        )
    table = _add_link(robot, "table", "fixed", (0.0, 0.5, 0.0))
    _add_box(table, (0.8, 1.2, 0.04), (0.0, 0.0, 0.73))
    for k, (x, y) in enumerate(((-0.35, -0.55), (-0.35, 0.55), (0.35, -0.55), (0.35, 0.55))):
        _add_box(table, (0.05, 0.05, 0.71), (x, y, 0.355), f"leg_{k}")
    sofa = trimesh.util.concatenate(
        [
            trimesh.creation.box((0.9, 2.0, 0.4)).apply_translation((0.0, 0.0, 0.2)),
            trimesh.creation.box((0.2, 1.9, 0.6)).apply_translation((-0.34, 0.0, 0.65)),
        ]
    )
    sofa.export(folder / "sofa.stl")
    seat = ElementTree.SubElement(_add_link(robot, "sofa", "fixed", (-4.1, 1.0, 0.0)), "collision")
    ElementTree.SubElement(ElementTree.SubElement(seat, "geometry"), "mesh", filename="sofa.stl")
    _add_box(
        _add_link(robot, "carpet", "fixed", (0.0, -1.5, 0.0)), (2.0, 1.0, 0.01), (0.0, 0.0, 0.005)
    )
    for k, y in enumerate((0.2, 0.6)):
        # Cups are 1 mm inside the table.
        _add_cylinder(_add_link(robot, f"cup_{k}", "floating", (0.25, y, 0.749)), 0.03, 0.1)
    _add_box(
        _add_link(robot, "lump", "floating", (2.0, 5.0, 0.0)), (0.4, 0.4, 0.4), (0.0, 0.0, 0.2)
    )
    file = folder / "flat.urdf"
    ElementTree.ElementTree(robot).write(file)
    return file, len(robot.findall("link/collision"))


HOME_MJCF = """<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <geom name="ground" type="plane" size="5 5 0.1"/>
    <geom name="north" type="box" size="3 0.05 1.2" pos="0 3 1.2"/>
    <geom name="south" type="box" size="3 0.05 1.2" pos="0 -3 1.2"/>
    <geom name="east" type="box" size="0.05 3 1.2" pos="3 0 1.2"/>
    <geom name="west" type="box" size="0.05 3 1.2" pos="-3 0 1.2"/>
    <body name="cupboard" pos="2.5 0 0.4">
      <geom type="box" size="0.2 0.3 0.4"/>
      <body name="leaf" pos="-0.25 -0.3 0">
        <joint name="hinge" axis="0 0 -1" range="-1.5 0"/>
        <geom type="box" size="0.01 0.3 0.4" pos="0 0.3 0"/>
        <geom name="handle" type="capsule" fromto="-0.08 0.5 -0.15 -0.08 0.5 0.15" size="0.01"/>
      </body>
    </body>
    <body name="board" pos="0 2.4 0.35"><geom type="box" size="0.4 0.3 0.35"/></body>
    <body name="mug" pos="0 2.3 0.75"><freejoint/><geom type="cylinder" size="0.03 0.05"/></body>
  </worldbody>
</mujoco>"""


def _compute_walls_beside_door() -> dict[str, tuple[float, float, float, float]]:
    """Return the walls on both sides of the door leaf, which extends from its hinge."""
    door = vkc.load_object(vkc.procedural.random_object("door", PLACES["door"][3]))
    import pinocchio as pin

    data = door.model.createData()
    yaw = PLACES["door"][2]
    pin.forwardKinematics(door.model, data, door.coordinates.q(np.zeros(door.coordinates.size)))
    xs = []
    for shape in door.collision.geometryObjects:
        shape.geometry.computeLocalAABB()
        box = shape.geometry.aabb_local
        at = data.oMi[shape.parentJoint] * shape.placement
        for corner in np.array(np.meshgrid(*zip(box.min_, box.max_, strict=True))).reshape(3, -1).T:
            xs.append(
                (
                    pin.SE3(
                        pin.rpy.rpyToMatrix(0.0, 0.0, yaw), np.array([*PLACES["door"][:2], 0.0])
                    )
                    * at
                ).act(corner)[0]
            )
    return {
        "wall_beside": (-4.7, min(xs) - 0.005, 2.95, 3.05),
        "wall_beyond": (max(xs) + 0.005, 4.7, 2.95, 3.05),
    }


def _add_link(
    robot: ElementTree.Element, name: str, kind: str, at: tuple[float, ...]
) -> ElementTree.Element:
    _add_joint(robot, f"{name}_stands", kind, "world", name, at)
    return ElementTree.SubElement(robot, "link", name=name)


def _add_joint(
    robot: ElementTree.Element,
    name: str,
    kind: str,
    parent: str,
    child: str,
    at: tuple[float, ...],
    yaw: float = 0.0,
) -> None:
    joint = ElementTree.SubElement(robot, "joint", name=name, type=kind)
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=" ".join(map(str, at)), rpy=f"0 0 {yaw}")


def _add_box(
    link: ElementTree.Element, size: tuple[float, ...], at: tuple[float, ...], name: str = ""
) -> None:
    shape = ElementTree.SubElement(link, "collision", **({"name": name} if name else {}))
    ElementTree.SubElement(shape, "origin", xyz=" ".join(map(str, at)))
    ElementTree.SubElement(
        ElementTree.SubElement(shape, "geometry"), "box", size=" ".join(map(str, size))
    )


def _add_cylinder(link: ElementTree.Element, radius: float, length: float) -> None:
    shape = ElementTree.SubElement(link, "collision")
    ElementTree.SubElement(shape, "origin", xyz=f"0 0 {length / 2}")
    ElementTree.SubElement(
        ElementTree.SubElement(shape, "geometry"),
        "cylinder",
        radius=str(radius),
        length=str(length),
    )
