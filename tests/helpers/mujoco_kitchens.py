"""Generates MuJoCo models of kitchens with a robot in them."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

import vkc_pin as vkc
from vkc_pin.simulation.contacts import Pairs
from vkc_pin.simulation.model import Builder
from vkc_pin.simulation.physics import complete_inertias
from vkc_pin.simulation.servos import make_servos
from vkc_pin.world.trajectory.world_model import World

KITCHEN = """
<mujoco model="kitchen">
  <compiler angle="radian"/>
  <default><geom contype="1" conaffinity="1"/></default>
  <worldbody>
    <geom name="ground" type="plane" size="5 5 0.1"/>
    <body name="table" pos="-0.5 2.2 0.35"><geom name="top" type="box" size="0.4 0.3 0.35"/></body>
    <body name="cabinet" pos="1.6 0 0.4" euler="0 0 3.14159265358979">
      <geom name="left" type="box" pos="0 0.29 0" size="0.25 0.01 0.4"/>
      <geom name="right" type="box" pos="0 -0.29 0" size="0.25 0.01 0.4"/>
      <geom name="back" type="box" pos="-0.24 0 0" size="0.01 0.28 0.4"/>
      <body name="drawer" pos="0 0 0.2">
        <joint name="drawer slide" type="slide" axis="1 0 0" range="0 0.35" damping="2"/>
        <geom name="front" type="box" pos="0.26 0 0" size="0.01 0.27 0.12" mass="1"/>
        <geom name="tray" type="box" pos="0.02 0 -0.1" size="0.2 0.25 0.01" mass="1"/>
        <geom name="bar" type="cylinder" pos="0.32 0 0" size="0.008 0.08"
              euler="1.5707963267949 0 0" mass="0.1"/>
        <geom name="post1" type="box" pos="0.295 0.07 0" size="0.025 0.006 0.006" mass="0.05"/>
        <geom name="post2" type="box" pos="0.295 -0.07 0" size="0.025 0.006 0.006" mass="0.05"/>
      </body>
    </body>
    <body name="oven" pos="1.6 1.2 0.5">
      <geom name="box" type="box" pos="0.05 0 0" size="0.2 0.28 0.25"/>
      <body name="oven door" pos="-0.18 0.28 0">
        <joint name="oven.hinge" axis="0 0 1" range="-1.5 0.05" ref="-0.1" damping="1"/>
        <geom name="panel" type="box" pos="0 -0.28 0" size="0.012 0.27 0.24" mass="2"/>
      </body>
    </body>
    <body name="cup" pos="-0.4 2.1 0.76" euler="0 0 0.4">
      <freejoint name="cup free"/>
      <geom name="wall" type="cylinder" size="0.03 0.06" mass="0.2"/>
    </body>
    <body name="marker" pos="0 0 1">
      <geom type="sphere" size="0.2" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
</mujoco>
"""


def make_kitchen_spec(text: str = KITCHEN) -> Any:
    """Return the `mujoco.MjSpec` of a kitchen without a robot."""
    return mujoco.MjSpec.from_string(text)


def make_kitchen(
    robot: str = "husky_ur5e",
    *,
    text: str = KITCHEN,
    base: str = "omni",
    prefix: str = "",
    mount: np.ndarray | None = None,
    axes: np.ndarray | None = None,
) -> Any:
    """Return the compiled model of a kitchen with a robot on servos.

    A weld between the hand and each link of a drawer is ready, and not active.

    Args:
        robot: Name of the robot.
        text: The kitchen.
        base: Type of the base.
        prefix: Prefix of all names of the robot.
        mount: Place of the base's joints in the world: x, y, z [m] and yaw [rad], shape (4,).
        axes: Axes of the base's joints there, shape (3, 3).
    """
    document = {
        "robot": {"name": robot, "base": base},
        "start": {"base": [0.0, 0.0, 0.0]},
        "floor": False,
    }
    scene = vkc.Scene.from_document(document)
    world = World(scene)
    physics = vkc.Physics(timestep=0.002)
    complete_inertias(world, physics)
    servos = make_servos(world, world.start[None], physics)
    builder = Builder(world, physics)
    none = np.zeros(len(world.shapes), int)
    pairs = Pairs(np.zeros((0, 2), int), none, none, {}, ())
    builder.build(pairs, servos, [], [])
    spec = builder.spec
    body, placement = builder.find_frame(scene.robot.tool_frame)
    tool = body.add_body(name="tool", pos=placement.translation)
    tool.mass = 1e-3
    tool.inertia = np.full(3, 1e-6)
    tool.explicitinertial = True
    kitchen = make_kitchen_spec(text)
    frame = spec.worldbody.add_frame()
    for child in list(kitchen.worldbody.bodies):
        frame.attach_body(child, "home/", "")
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5.0, 5.0, 0.1])
    weld = spec.add_equality(
        type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY, active=False
    )
    weld.name = "grip"
    weld.name1 = "tool"
    weld.name2 = "home/drawer"
    weld.data = [0.0] * len(weld.data)
    weld.data[10] = 1.0
    if mount is not None:
        first = spec.body("body 1")
        first.pos = mount[:3]
        first.quat = [np.cos(mount[3] / 2.0), 0.0, 0.0, np.sin(mount[3] / 2.0)]
    for name, axis in zip(world.coordinates.names, () if axes is None else axes, strict=False):
        spec.joint(name).axis = axis
    if prefix:
        for joint in spec.joints:
            if joint.name in world.coordinates.names:
                joint.name = prefix + joint.name
        for actuator in spec.actuators:
            actuator.target = prefix + actuator.target
    return spec.compile()
