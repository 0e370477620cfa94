"""Describes a robot's open hand in its tool frame."""

from __future__ import annotations

from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.world.models.gripper import (
    BAR_THICKNESS,
    WIDEST_BAR,
    find_widest_bar,
)
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
    above = {}
    for joint in robot.file.root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            above[child.get("link", "")] = joint, parent.get("link", "")
    for link in robot.touch_links:
        while link in above and above[link][0].get("name") not in robot.coordinates.names:
            if above[link][0].get("type") != "fixed":
                return True
            link = above[link][1]
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
    data = robot.model.createData()
    frame = robot.model.frames[robot.model.getFrameId(robot.tool_frame)]
    pin.framesForwardKinematics(
        robot.model, data, robot.coordinates.q(np.concatenate([np.zeros(3), robot.home]))
    )
    tool = data.oMi[frame.parentJoint] * frame.placement
    touch, others = list[pin.GeometryObject](), list[pin.GeometryObject]()
    for number, shape in enumerate(robot.collision.geometryObjects):
        placed = pin.GeometryObject(shape)
        placed.placement = tool.inverse() * data.oMi[shape.parentJoint] * shape.placement
        if robot.link_of(number) in robot.touch_links:
            touch.append(placed)
        elif frame.parentJoint in robot.model.supports[shape.parentJoint]:
            others.append(placed)
    fingers, others_placed = tuple(list_placed_shapes(touch)), tuple(list_placed_shapes(others))
    opening, parts = find_widest_bar(fingers), len(robot.touch_links)
    if parts == 1 and not has_fingers(robot):  # a flange, whose rim has nothing ahead of it
        ahead = pin.SE3(np.eye(3), np.array([0.0, 0.0, -_RIM]))
        opening = max(opening, find_widest_bar([(solid, ahead * at) for solid, at in fingers]))
    if not 2.0 * BAR_THICKNESS <= opening < WIDEST_BAR:  # closed, or nothing on either side
        problem = f"the hand of '{robot.name}' has no fingers"
        if opening < WIDEST_BAR and (parts > 1 or has_fingers(robot)):
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
    boxes = [compute_world_box(geometry, where) for geometry, where in fingers]
    beyond_origin = [(low, high) for low, high in boxes if high[2] > 0.0]
    ends = beyond_origin or boxes
    width = max(high[1] for _, high in ends) - min(low[1] for low, _ in ends)
    return Hand(
        robot.name,
        fingers,
        others_placed,
        opening,
        max(0.0, float(max(high[2] for _, high in ends))),
        float(width),
    )
