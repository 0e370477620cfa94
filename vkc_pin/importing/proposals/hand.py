"""Describes a robot's open hand in its tool frame."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.world.models.gripper import BAR_THICKNESS, WIDEST_BAR, find_widest_bar
from vkc_pin.world.models.robot import Robot
from vkc_pin.world.models.shapes import compute_world_box, list_placed_shapes

_RIM = 0.005  # [m] ahead of the tool frame, largest height of a flange's rim

Placed = tuple[coal.CollisionGeometry, pin.SE3]


@dataclass(frozen=True, eq=False)
class Hand:
    """An open hand.

    Attributes:
        robot: The robot's name.
        touch: Shapes of the links that may touch a grasped object, with placements in the tool
            frame.
        others: Shapes of other links that move with the tool frame, with placements in it.
        opening: Width of the widest bar between the fingers, at the tool's origin along its x axis
            [m].
        tip: Distance by which the fingers extend beyond the tool's origin along its z axis [m].
        width: Width of the fingers along the tool's y axis [m].
    """

    robot: str
    touch: tuple[Placed, ...]
    others: tuple[Placed, ...]
    opening: float
    tip: float
    width: float


def has_fingers(robot: Robot) -> bool:
    """Return whether joints that are not planned move links of a hand."""
    joints = dict[str, tuple[ElementTree.Element, str]]()  # and parent, by the child link
    for element in robot.file.root.findall("joint"):
        parent = element.find("parent")
        child = element.find("child")
        if parent is not None and child is not None:
            joints[child.get("link", "")] = (element, parent.get("link", ""))
    for touch_link in robot.touch_links:
        link = touch_link
        while link in joints:
            joint, parent_link = joints[link]
            if joint.get("name") in robot.coordinates.names:
                break
            if joint.get("type") != "fixed":
                return True
            link = parent_link
    return False


def make_hand(robot: Robot) -> Hand:
    """Return the open hand of a robot.

    Raises:
        InputError: The hand is undefined, or there is no room between its fingers.
    """
    if not robot.touch_links:
        problem = f"the hand of '{robot.name}' is undefined"
        expected = "touch_links in a robot.yaml, such as `vkc-pin import-robot` writes"
        raise InputError(
            problem, file=robot.urdf, field="touch_links", expected=expected, got="none"
        )
    touch, others = _place_shapes(robot)
    opening = _measure_opening(robot, touch)
    boxes = [compute_world_box(geometry, where) for geometry, where in touch]
    beyond_origin = [(low, high) for low, high in boxes if high[2] > 0.0]
    ends = beyond_origin or boxes
    width = max(high[1] for _, high in ends) - min(low[1] for low, _ in ends)
    tip = max(high[2] for _, high in ends)
    return Hand(
        robot=robot.name,
        touch=touch,
        others=others,
        opening=opening,
        tip=max(0.0, float(tip)),
        width=float(width),
    )


def _place_shapes(robot: Robot) -> tuple[tuple[Placed, ...], tuple[Placed, ...]]:
    """Return the shapes of touch links, and of others that move with the tool, in its frame."""
    data = robot.model.createData()
    frame = robot.model.frames[robot.model.getFrameId(robot.tool_frame)]
    at_home = np.concatenate([np.zeros(3), robot.home])
    pin.framesForwardKinematics(robot.model, data, robot.coordinates.q(at_home))
    tool = data.oMi[frame.parentJoint] * frame.placement
    touch = list[pin.GeometryObject]()
    others = list[pin.GeometryObject]()
    for number, shape in enumerate(robot.collision.geometryObjects):
        placed = pin.GeometryObject(shape)
        placed.placement = tool.inverse() * data.oMi[shape.parentJoint] * shape.placement
        if robot.link_of(number) in robot.touch_links:
            touch.append(placed)
        elif frame.parentJoint in robot.model.supports[shape.parentJoint]:
            others.append(placed)
    return tuple(list_placed_shapes(touch)), tuple(list_placed_shapes(others))


def _measure_opening(robot: Robot, touch: tuple[Placed, ...]) -> float:
    """Return the width of the widest bar between the fingers [m].

    Raises:
        InputError: There is none, because they are closed or not on both sides of the tool frame.
    """
    opening = find_widest_bar(touch)
    is_one_link = len(robot.touch_links) == 1
    if is_one_link and not has_fingers(robot):
        # A flange, whose rim has nothing ahead of it
        ahead = pin.SE3(np.eye(3), np.array([0.0, 0.0, -_RIM]))
        opening = max(opening, find_widest_bar([(solid, ahead * at) for solid, at in touch]))
    if 2.0 * BAR_THICKNESS <= opening < WIDEST_BAR:
        return opening
    problem = f"the hand of '{robot.name}' has no fingers"
    if opening < WIDEST_BAR and (not is_one_link or has_fingers(robot)):
        problem = (
            f"there is no room between the fingers of '{robot.name}' "
            f"at its tool frame '{robot.tool_frame}'"
        )
    elif has_fingers(robot):
        problem = (
            f"the tool frame '{robot.tool_frame}' of '{robot.name}' is not between its fingers"
        )
    expected = "an open hand around its origin, with x as the closing direction"
    raise InputError(problem, file=robot.urdf, field="tool_frame", expected=expected)
