"""How good a place is for opening a joint, by geometry alone: before anything is known of the room around it."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from vkc_pin.importing.proposals.candidates import Candidate
from vkc_pin.importing.proposals.sections import Piece
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.articulated_object import ArticulatedObject

__all__ = ["Opening", "find_named_handles", "find_openings", "score_grasp"]

_WORDS = ("handle", "knob", "lever", "grip", "pull")
_KINDS = {"bar": 1.0, "knob": 0.8, "edge": 0.4}
_UNNAMED = 0.6  # of what is not called a handle
_UPWARDS = 0.5  # of what is taken from below: few arms reach up from the floor
_TURN = 2.0 * np.pi / 3.0  # [rad]: how far a joint without limits is to be turned


@dataclass(frozen=True, eq=False)
class Opening:
    """How a joint opens, seen from where it is closed.

    Attributes:
        joint: Its name.
        number: Its number in the object's model.
        coordinate: Its number among the object's coordinates.
        turns: Whether it turns; otherwise it slides.
        closed, opened: Its values, [rad] or [m]: zero, or the limit next to it, and the limit that
            is further from there.
        axis: Unit direction in which it slides, or about which it turns (by the right hand) as it
            opens, in the base's frame.
        origin: A point on the axis, in the base's frame [m].
        low, high: A box around all that it moves, in the base's frame [m], shape (3,) each.
        reach: How far that is from the axis at most [m].
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
    """Return how the joints of an object open, by their numbers in its model.

    Args:
        item: The object.
        pieces: Its pieces by the number of their joint.
    """
    data, found = item.model.createData(), {}
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
        jacobian = np.reshape(
            pin.getJointJacobian(item.model, data, number, pin.LOCAL), (6, -1)
        )  # of one joint, it is a vector
        column = jacobian[:, item.model.joints[number].idx_v]
        turns = bool(np.linalg.norm(column[3:]) > 0.5)
        axis = (
            data.oMi[number].rotation
            @ (column[3:] if turns else column[:3])
            * np.sign(opened - closed or 1.0)
        )
        moved = [
            piece.vertices @ data.oMi[k].rotation.T + data.oMi[k].translation
            for k, mine in pieces.items()
            if number in item.model.supports[k]
            for piece in mine
        ]
        points = np.vstack([np.zeros((0, 3)), *moved])
        origin = np.array(data.oMi[number].translation)
        away = points - origin
        away -= np.outer(away @ axis, axis)
        reach = float(np.linalg.norm(away, axis=1).max(initial=0.0))
        corners = points if len(points) else origin[None]
        ends = corners.min(axis=0), corners.max(axis=0)
        found[number] = Opening(
            name, number, coordinate, turns, closed, opened, axis, origin, ends[0], ends[1], reach
        )
    return found


def score_grasp(grasp: Candidate, tool: pin.SE3, opening: Opening, *, named: bool) -> float:
    """Return how good a grasp is for opening a joint, from 0 to 1.

    A product: of its kind; its name; its leverage; how near to the middle it pulls, where off it
    would jam; whether the pull goes against the fingers instead of along the bar, on which they
    slip; and whether the hand comes from where the part moves to.

    Args:
        grasp: The grasp.
        tool: Its tool frame in the frame of the object's base, the object closed.
        opening: The joint.
        named: Whether it is called a handle.
    """
    along, approach = tool.rotation[:, 1], tool.rotation[:, 2]
    place, size = tool.translation, np.maximum(opening.high - opening.low, 1e-3)
    off = place - (opening.low + opening.high) / 2.0
    if opening.turns:
        arm = place - opening.origin
        arm -= (arm @ opening.axis) * opening.axis
        pull, leverage = (
            np.cross(opening.axis, arm),
            float(np.linalg.norm(arm)) / max(opening.reach, 1e-3),
        )
        pull /= max(float(np.linalg.norm(pull)), 1e-9)
        aside = abs(off @ opening.axis) / (np.abs(opening.axis) @ size / 2.0)
    else:
        pull, leverage = opening.axis, 1.0
        aside = float(np.linalg.norm((off - (off @ pull) * pull) / (size / 2.0)))
    return float(
        _KINDS[grasp.kind]
        * (1.0 if named else _UNNAMED)
        * max(leverage, 0.02)
        * (1.0 - 0.4 * min(aside, 1.0))
        * (1.0 - 0.8 * (pull @ along) ** 2)
        * (0.65 - 0.35 * (pull @ approach))
        * (_UPWARDS if approach[2] > 0.5 else 1.0)
    )


def find_named_handles(root: ElementTree.Element) -> dict[str, bool]:
    """Return which collision elements of a URDF are called handles: `<link>_<k>` → whether it, its link or its mesh is."""
    found = {}
    for link in root.findall("link"):
        for number, element in enumerate(link.findall("collision")):
            mesh = element.find("geometry/mesh")
            file = "" if mesh is None else mesh.get("filename", "").rpartition("/")[2]
            text = " ".join((link.get("name", ""), element.get("name", ""), file)).lower()
            found[f"{link.get('name', '')}_{number}"] = any(word in text for word in _WORDS)
    return found
