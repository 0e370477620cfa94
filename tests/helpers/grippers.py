"""Writes a robot with a gripper: five joints and two fingers, one of which mimics the other."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

from helpers.arm_urdf import HEIGHT, write_arms
from vkc_pin.world.scene.scene import Scene

__all__ = ["MAX_OPENING", "describe_cheeks_drawer", "write_cheeks_scene", "write_gripper"]

MAX_OPENING = 0.08  # largest opening between the faces of the fingers [m]
_GRIPPER = "gripper:\n  finger_a_joint: {closed: 0.0, open: 0.04}\n"
_FLOOR = (
    "<link name='floor'/><joint name='floor_joint' type='fixed'><parent link='floor'/><child "
    "link='body'/>"
    f"<origin xyz='0 0 {HEIGHT}'/></joint>"
)
_TOOL = (
    "<link name='tool'/><joint name='tool_joint' type='fixed'><parent link='hand'/><child "
    "link='tool'/>"
    "<origin xyz='0 0 0.125' rpy='0 0 1.5707963267948966'/></joint>"
)


def write_gripper(folder: Path, *, gripper: str = _GRIPPER, more: str = "") -> Path:
    """Write the robot's URDF, SRDF and robot.yaml into a folder, and return the last.

    At home the arm is bent forwards and points the hand along x of the base, 1.22 m up. Fingers
    close along the tool's x axis, the world's y.

    Args:
        folder: Output folder.
        gripper: Lines of robot.yaml about the gripper.
        more: Further lines of robot.yaml.
    """
    file = write_arms(folder)
    text = file.read_text(encoding="utf-8")
    before, joint, after = text.partition('<joint name="finger_b_joint"')
    body, end, rest = after.partition("</joint>")
    mimic = "<mimic joint='finger_a_joint'/>"
    text = (before + joint + body + mimic + end + rest).replace(
        "</robot>", _FLOOR + _TOOL + "</robot>"
    )
    with_visuals = re.sub(
        r"<collision>(.*?)</collision>", r"<visual>\1</visual><collision>\1</collision>", text
    )
    file.write_text(with_visuals, encoding="utf-8")
    links = ["body", *(f"arm_{k + 1}" for k in range(5)), "hand", "finger_a", "finger_b"]
    pairs = [
        *itertools.pairwise(links),
        ("hand", "finger_b"),
        ("arm_5", "finger_a"),
        ("arm_5", "finger_b"),
        ("body", "arm_2"),
    ]
    disabled = "".join(
        f'<disable_collisions link1="{one}" link2="{other}" reason="Adjacent"/>'
        for one, other in pairs
    )
    (folder / "robot.srdf").write_text(f'<robot name="robot">{disabled}</robot>', encoding="utf-8")
    lines = [
        "urdf: robot.urdf",
        "srdf: robot.srdf",
        "tool_frame: tool",
        "touch_links: [hand, finger_a, finger_b]",
    ]
    lines += [
        "home: {arm_1_joint: 0.0, arm_2_joint: -0.4, arm_3_joint: 1.0, arm_4_joint: 0.0, "
        "arm_5_joint: 0.97}"
    ]
    yaml = folder / "robot.yaml"
    yaml.write_text("\n".join(lines) + f"\n{gripper}{more}", encoding="utf-8")
    return yaml


_DRAWER = """<robot name="drawer">
  <link name="frame"/>
  <link name="front">
    <visual><origin xyz="0.01 0 0"/><geometry><box size="0.02 0.08 0.2"/></geometry></visual>
    <visual>
      <origin xyz="-0.05 0 0"/><geometry><box size="0.02 0.02 0.1"/></geometry>
      <material name="orange"><color rgba="0.87 0.53 0.24 1"/></material>
    </visual>
    <collision><origin xyz="0.01 0 0"/><geometry><box size="0.02 0.08 0.2"/></geometry></collision>
    <collision><origin xyz="-0.05 0 0"/><geometry><box size="0.02 0.02 0.1"/></geometry></collision>
  </link>
  <joint name="slide" type="prismatic">
    <parent link="frame"/><child link="front"/><axis xyz="-1 0 0"/>
    <limit lower="0" upper="0.2" velocity="0.5" effort="10"/>
  </joint>
</robot>"""


def write_cheeks_scene(
    robot: Path,
    *,
    opening: Any = None,
    start: Any = None,
    gap: float = 0.06,
    other: tuple[float, ...] | None = None,
    height: float = 1.1,
) -> Scene:
    """Return a scene with a drawer's handle, 20 mm thick, between two separate cheeks.

    Args:
        robot: The robot's robot.yaml.
        opening: The attachment's opening [m], or None.
        start: Opening of the gripper at the start [m]. Default: the robot's rest opening.
        gap: Distance from the middle of the handle to either cheek [m]. The default leaves 10 mm
            beside fully open fingers.
        other: Position of another drawer, whose attachment states no opening.
        height: Height of the drawer [m].
    """
    plain: dict[str, Any] = {"name": "grip", "link": "front", "position": [-0.05, 0.0, 0.0]}
    plain |= {"approach": [1.0, 0.0, 0.0], "closing": [0.0, 1.0, 0.0]}
    grip = plain if opening is None else {**plain, "opening": opening}
    drawers = [
        ("drawer", grip, [1.2, 0.0, height]),
        *([("other", plain, list(other))] if other else []),
    ]
    cheeks = [
        {
            "name": name,
            "type": "box",
            "size": [0.08, 0.04, 0.2],
            "position": [1.16, side * (gap + 0.02), height],
        }
        for name, side in (("left", 1.0), ("right", -1.0))
    ]
    document = {
        "name": "cheeks",
        "robot": robot.name,
        "start": {"base": [0.0, 0.0, 0.0], **({} if start is None else {"opening": start})},
        "obstacles": cheeks,
        "objects": [
            {
                "name": name,
                "type": {"urdf": _DRAWER, "attachments": [attachment]},
                "position": place,
            }
            for name, attachment, place in drawers
        ],
    }
    return Scene.from_document(document, robot.parent)


def describe_cheeks_drawer(gap: float = 0.06) -> dict[str, Any]:
    """Return a drawer without attachments; `gap` is between its handle's middle and posts [m]."""
    posts = "".join(
        f'<collision><origin xyz="-0.04 {side * (gap + 0.02)} 0"/>'
        '<geometry><box size="0.08 0.04 0.2"/></geometry></collision>'
        for side in (1.0, -1.0)
    )
    return {
        "urdf": _DRAWER.replace('<link name="frame"/>', f'<link name="frame">{posts}</link>'),
        "attachments": [],
    }
