"""Scores grasps by geometry, and checks whether an open hand has clearance at them."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import dataclass

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from vkc_pin.importing.proposals.candidates import Candidate, Piece
from vkc_pin.importing.proposals.hand import Hand
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.models.articulated_object import ArticulatedObject, Freedom
from vkc_pin.world.models.shapes import compute_bounding_box, compute_shape_distance, get_link_name

_WORDS = ("handle", "knob", "lever", "grip", "pull")
_KINDS = {"bar": 1.0, "knob": 0.8, "edge": 0.4}
_UNNAMED = 0.6  # factor for pieces that are not named as handles
_THIN = 0.008  # [m] thickness below which a piece is rather a screw or a rim than a handle
_UPWARDS = 0.5  # factor for grasps from below: few arms reach up from the floor
_ASSUMED_TRAVEL = 2.0 * np.pi / 3.0  # [rad] assumed travel of joints without limits
# [m] of a forearm: radius, length, and distance of its end behind the tool frame
_ARM_RADIUS, _ARM_LENGTH, _ARM_START = 0.05, 0.4, 0.2
Bools = NDArray[np.bool_]
_SLIDE, _TURN = 0.01, 0.2  # steps, [m] and [rad]
_LONGEST = 0.3  # [m] largest slide to either side
_MIN_SLIDE, _MIN_TURN = 0.02, 0.3  # smallest ranges of a degree of freedom, [m] and [rad]
_SAMPLES = 8  # positions of a joint at which the clearance is checked
_BAR = np.array([0.0, 1.0, 0.0])  # direction of the bar in the tool frame


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
        coordinate = item.coordinates.index(name)
        closed = float(state[coordinate])
        low, high = float(item.lower[coordinate]), float(item.upper[coordinate])
        low = max(low, closed - _ASSUMED_TRAVEL) if np.isinf(low) else low
        high = min(high, closed + _ASSUMED_TRAVEL) if np.isinf(high) else high
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
        pull = np.cross(opening.axis, arm)
        leverage = float(np.linalg.norm(arm)) / max(opening.reach, 1e-3)
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


@dataclass(frozen=True)
class Obstruction:
    """Reason why a hand has no clearance.

    Attributes:
        what: "fingers": the grasped link is too close to them; "others": another link is; "floor":
            the hand would be below the object's support.
        link: The obstructing link of the object.
    """

    what: str
    link: str = ""


class HandClearance:
    """Clearance between a hand and an object at some joint positions."""

    def __init__(
        self, item: ArticulatedObject, hand: Hand, dist_safe: float, grasp_clearance: float
    ) -> None:
        self.item, self.hand = item, hand
        self._safe, self._close = dist_safe, grasp_clearance
        self._shapes = list(item.collision.geometryObjects)
        self.links = np.array([get_link_name(shape.name) for shape in self._shapes])
        self._joints = [shape.parentJoint for shape in self._shapes]
        self._boxes = [compute_bounding_box(shape) for shape in self._shapes]
        self._touch = np.array([True] * len(hand.touch) + [False] * len(hand.others))
        self._hand = [*hand.touch, *hand.others]
        self._hand_boxes = [
            compute_bounding_box(pin.GeometryObject("", 0, where, shape))
            for shape, where in self._hand
        ]
        self._data = item.model.createData()
        self.place(np.clip(np.zeros(len(item.lower)), item.lower, item.upper))
        self.floor = float(self._low[:, 2].min()) if len(self._shapes) else -np.inf

    def place(self, state: Floats) -> None:
        """Set the object's joint positions, shape (n,), [rad] or [m]."""
        self.state = np.array(state, float)
        pin.forwardKinematics(self.item.model, self._data, self.item.coordinates.q(self.state))
        self._at = [
            self._data.oMi[joint] * shape.placement
            for joint, shape in zip(self._joints, self._shapes, strict=True)
        ]
        corners = np.array(
            [_transform_box(box, where) for box, where in zip(self._boxes, self._at, strict=True)]
        ).reshape(-1, 2, 3)
        self._low, self._high = corners[:, 0], corners[:, 1]

    def joint(self, number: int) -> pin.SE3:
        """Return the placement of a joint of the object's model in its base frame."""
        return self._data.oMi[number]

    def find_obstruction(
        self, tool: pin.SE3, link: str, *, extra_clearance: float = 0.0
    ) -> Obstruction | None:
        """Return what obstructs a hand at `tool`, in the object's base frame, or None."""
        is_held = self.links == link
        for (shape, where), box, touches in zip(
            self._hand, self._hand_boxes, self._touch, strict=True
        ):
            placed = tool * where
            low, high = _transform_box(box, placed)
            if low[2] < self.floor:
                return Obstruction("floor")
            margins = np.where(is_held & touches, self._close, self._safe + extra_clearance)
            gaps = np.maximum(self._low - high, low - self._high).max(axis=1)
            for k in np.flatnonzero(gaps < margins).tolist():
                if (
                    compute_shape_distance(shape, placed, self._shapes[k].geometry, self._at[k])
                    < margins[k]
                ):
                    return Obstruction(
                        "fingers" if is_held[k] and touches else "others", str(self.links[k])
                    )
        return None

    def is_hidden(self, tool: pin.SE3) -> bool:
        """Return whether the object blocks a forearm straight behind a hand at `tool`."""
        arm = coal.Capsule(_ARM_RADIUS, _ARM_LENGTH)
        middle = -(_ARM_START + _ARM_LENGTH / 2.0)
        where = tool * pin.SE3(np.eye(3), np.array([0.0, 0.0, middle]))
        return any(
            compute_shape_distance(arm, where, shape.geometry, at) <= 0.0
            for shape, at in zip(self._shapes, self._at, strict=True)
        )


def _transform_box(box: tuple[Floats, Floats], where: pin.SE3) -> tuple[Floats, Floats]:
    """Return the lower and upper corner, in the world, of a box (centre, half extents)."""
    centre, extent = where.rotation @ box[0] + where.translation, np.abs(where.rotation) @ box[1]
    return centre - extent, centre + extent


class GraspMotion:
    """Motion of a hand that grasps an object."""

    def __init__(self, clearance: HandClearance, grasp: Candidate, standoff: float) -> None:
        self._clearance, self._grasp = clearance, grasp
        self._offset = pin.SE3(np.eye(3), np.array([0.0, 0.0, -standoff]))
        self._state = clearance.state.copy()
        self._joint = int(
            clearance.item.model.frames[clearance.item.link_frame(grasp.piece.link)].parentJoint
        )
        self._angles = _TURN * np.arange(-round(1.6 / _TURN), round(1.6 / _TURN) + 1)
        self._angles = self._angles[np.abs(self._angles) <= grasp.round + 1e-9]
        half = clearance.hand.width / 2.0
        self._low = 0.0 - _march(
            lambda distance: self._is_free(-distance, 0.0), min(_LONGEST, -grasp.span[0] - half)
        )
        self._high = _march(
            lambda distance: self._is_free(distance, 0.0), min(_LONGEST, grasp.span[1] - half)
        )
        self._turned = self._grow(self._find_free_angles(), self._angles == 0.0)

    @property
    def slack(self) -> float:
        """Smaller of the slides to either side [m]."""
        return min(-self._low, self._high)

    def follow(self, opening: Opening) -> float:
        """Return how far a joint opens, [rad] or [m], before the hand is obstructed."""
        reached = opening.closed
        reachable = self._grow(self._find_free_angles(), self._angles == 0.0)
        start = float(self._state[opening.coordinate])
        for value in np.linspace(start, opening.opened, _SAMPLES + 1)[1:].tolist():
            state = self._state.copy()
            state[opening.coordinate] = value
            self._clearance.place(state)
            reachable = self._grow(self._find_free_angles(), reachable)
            if not reachable.any():
                break
            reached, self._turned = value, self._turned | reachable
        self._clearance.place(self._state)
        return float(reached)

    def freedoms(self) -> tuple[str, tuple[Freedom, ...]]:
        """Return the kind of the virtual joint and its degrees of freedom.

        Their ranges are those in which the hand has clearance at the start or while it follows a
        joint.
        """
        angles = self._angles[self._turned]
        slides, turns = self._high - self._low >= _MIN_SLIDE, np.ptp(angles) >= _MIN_TURN
        low, high = round(float(angles.min()), 6) + 0.0, round(float(angles.max()), 6) + 0.0
        if slides and turns:
            slide = Freedom("_slide", "prismatic", _BAR, self._low, self._high)
            return "cylindrical", (slide, Freedom("_turn", "revolute", _BAR, low, high))
        if slides:
            return "prismatic", (Freedom("", "prismatic", _BAR, self._low, self._high),)
        return ("revolute", (Freedom("", "revolute", _BAR, low, high),)) if turns else ("fixed", ())

    def _is_free(self, slide: float, turn: float) -> bool:
        tool = (
            self._clearance.joint(self._joint)
            * self._grasp.placement
            * pin.SE3(pin.exp3(_BAR * turn), _BAR * slide)
        )
        return self._clearance.find_obstruction(tool * self._offset, self._grasp.piece.link) is None

    def _find_free_angles(self) -> Bools:
        return np.array([self._is_free(0.0, angle) for angle in self._angles])

    def _grow(self, free: Bools, start: Bools) -> Bools:
        """Return the free angles connected to `start` through free angles, masks of shape (n,)."""
        reachable, before = free & start, np.zeros_like(start)
        while (reachable != before).any():
            before = reachable.copy()
            reachable[1:] |= before[:-1]
            reachable[:-1] |= before[1:]
            reachable &= free
        return reachable


def _march(free: Callable[[float], bool], furthest: float) -> float:
    """Return how far the hand slides in steps before it is obstructed [m]."""
    count = 0
    while (count + 1) * _SLIDE <= furthest + 1e-9 and free((count + 1) * _SLIDE):
        count += 1
    return round(count * _SLIDE, 6) + 0.0
