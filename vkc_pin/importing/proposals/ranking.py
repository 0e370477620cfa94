"""Scores grasps for opening a joint by geometry, before clearances are checked."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.importing.proposals.candidates import Candidate, Piece
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.articulated_object import ArticulatedObject

__all__ = ["Opening", "find_named_handles", "find_openings", "score_grasp"]

_WORDS = ("handle", "knob", "lever", "grip", "pull")
_KINDS = {"bar": 1.0, "knob": 0.8, "edge": 0.4}
_UNNAMED = 0.6  # factor for pieces that are not named as handles
_THIN = 0.008  # [m] thickness below which a piece is rather a screw or a rim than a handle
_UPWARDS = 0.5  # factor for grasps from below: few arms reach up from the floor
_TURN = 2.0 * np.pi / 3.0  # [rad] assumed travel of joints without limits


@dataclass(frozen=True, eq=False)
class Opening:
    """Opening motion of a joint.

    Attributes:
        joint: Joint name.
        number: Joint number in the object's model.
        coordinate: Number of its coordinate.
        turns: Whether it is revolute; otherwise it is prismatic.
        closed, opened: Positions, [rad] or [m]: zero or the nearest limit, and the limit further
            away.
        axis: Unit direction of the opening motion, or its rotation axis, in the base frame.
        origin: A point on the axis in the base frame [m].
        low, high: Bounding box of the links that it moves, in the base frame [m], shape (3,) each.
        reach: Largest distance of these links from the axis [m].
    """

    joint: str
    number: int
    coordinate: int
    turns: bool
    closed: float
    opened: float
    axis: Floats
    origin: Floats
    low: Floats
    high: Floats
    reach: float


def find_openings(item: ArticulatedObject, pieces: dict[int, list[Piece]]) -> dict[int, Opening]:
    """Return the opening motions of an object's joints, by their numbers in its model."""
    data, openings = item.model.createData(), {}
    state = np.clip(np.zeros(len(item.lower)), item.lower, item.upper)
    pin.computeJointJacobians(item.model, data, item.coordinates.q(state))
    for number in range(1, item.model.njoints):
        name = str(item.model.names[number])
        coordinate, closed = (
            item.coordinates.index(name),
            float(state[item.coordinates.index(name)]),
        )
        low, high = float(item.lower[coordinate]), float(item.upper[coordinate])
        low, high = (
            max(low, closed - _TURN) if np.isinf(low) else low,
            min(high, closed + _TURN) if np.isinf(high) else high,
        )
        opened = high if high - closed >= closed - low else low
        # For a model of one joint, Pinocchio returns a vector.
        jacobian = np.reshape(pin.getJointJacobian(item.model, data, number, pin.LOCAL), (6, -1))
        column = jacobian[:, item.model.joints[number].idx_v]
        turns = bool(np.linalg.norm(column[3:]) > 0.5)
        axis = (
            data.oMi[number].rotation
            @ (column[3:] if turns else column[:3])
            * np.sign(opened - closed or 1.0)
        )
        moved_vertices = [
            piece.vertices @ data.oMi[k].rotation.T + data.oMi[k].translation
            for k, mine in pieces.items()
            if number in item.model.supports[k]
            for piece in mine
        ]
        points = np.vstack([np.zeros((0, 3)), *moved_vertices])
        origin = np.array(data.oMi[number].translation)
        offsets = points - origin
        offsets -= np.outer(offsets @ axis, axis)
        reach = float(np.linalg.norm(offsets, axis=1).max(initial=0.0))
        corners = points if len(points) else origin[None]
        ends = corners.min(axis=0), corners.max(axis=0)
        openings[number] = Opening(
            name, number, coordinate, turns, closed, opened, axis, origin, ends[0], ends[1], reach
        )

    return openings


def score_grasp(grasp: Candidate, tool: pin.SE3, opening: Opening, *, named: bool) -> float:
    """Return the quality of a grasp for opening a joint, from 0 to 1.

    It is the product of factors for the kind; the name; the leverage; a sufficient thickness; the
    distance from the centre, off which the part would jam; the direction of the pull, against the
    fingers rather than along the bar, on which they would slip; and the side of approach, from
    where the part moves to.

    Args:
        grasp: The grasp.
        tool: Tool frame in the base frame of the closed object.
        opening: Opening motion of the joint.
        named: Whether the piece is named as a handle.
    """
    along, approach = tool.rotation[:, 1], tool.rotation[:, 2]
    place, size = tool.translation, np.maximum(opening.high - opening.low, 1e-3)
    offset = place - (opening.low + opening.high) / 2.0
    if opening.turns:
        arm = place - opening.origin
        arm -= (arm @ opening.axis) * opening.axis
        pull, leverage = (
            np.cross(opening.axis, arm),
            float(np.linalg.norm(arm)) / max(opening.reach, 1e-3),
        )
        pull /= max(float(np.linalg.norm(pull)), 1e-9)
        eccentricity = abs(offset @ opening.axis) / (np.abs(opening.axis) @ size / 2.0)
    else:
        pull, leverage = opening.axis, 1.0
        eccentricity = float(np.linalg.norm((offset - (offset @ pull) * pull) / (size / 2.0)))
    return float(
        _KINDS[grasp.kind]
        * (1.0 if named else _UNNAMED)
        * max(leverage, 0.02)
        * min(grasp.thickness / _THIN, 1.0)
        * (1.0 - 0.4 * min(eccentricity, 1.0))
        * (1.0 - 0.8 * (pull @ along) ** 2)
        * (0.65 - 0.35 * (pull @ approach))
        * (_UPWARDS if approach[2] > 0.5 else 1.0)
    )


def find_named_handles(root: ElementTree.Element) -> dict[str, bool]:
    """Map each collision element `<link>_<k>` of a URDF to whether it is named as a handle.

    The names are those of the element, its link and its mesh.
    """
    found = {}
    for link in root.findall("link"):
        for number, element in enumerate(link.findall("collision")):
            mesh = element.find("geometry/mesh")
            file = "" if mesh is None else mesh.get("filename", "").rpartition("/")[2]
            text = " ".join((link.get("name", ""), element.get("name", ""), file)).lower()
            found[f"{link.get('name', '')}_{number}"] = any(word in text for word in _WORDS)
    return found
