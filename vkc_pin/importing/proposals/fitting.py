"""Scores grasps by geometry, and checks whether an open hand has clearance at them."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
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
# A forearm [m]
_ARM_RADIUS = 0.05
_ARM_LENGTH = 0.4
_ARM_START = 0.2  # distance of its end behind the tool frame
Bools = NDArray[np.bool_]
Box = tuple[Floats, Floats]
_SLIDE = 0.01  # [m] step along a bar
_TURN = 0.2  # [rad] step of the rotation about a bar
_LONGEST = 0.3  # [m] largest slide to either side
_LARGEST_TURN = 1.6  # [rad] rotation to either side
# Smallest ranges of a degree of freedom
_MIN_SLIDE = 0.02  # [m]
_MIN_TURN = 0.3  # [rad]
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
    openings = dict[int, Opening]()
    model = item.model
    data = model.createData()
    state = np.clip(np.zeros(len(item.lower)), item.lower, item.upper)
    pin.computeJointJacobians(model, data, item.coordinates.q(state))
    for number in range(1, model.njoints):
        name = str(model.names[number])
        coordinate = item.coordinates.index(name)
        closed = float(state[coordinate])
        low = float(item.lower[coordinate])
        high = float(item.upper[coordinate])
        if np.isinf(low):
            low = closed - _ASSUMED_TRAVEL
        if np.isinf(high):
            high = closed + _ASSUMED_TRAVEL
        opened = high if high - closed >= closed - low else low
        # The joint's motion in its own frame is its column of the Jacobian (v, ω), where ω is a
        # unit vector for a hinge and zero for a slide.
        jacobian = pin.getJointJacobian(model, data, number, pin.LOCAL)
        # For a model of one joint, Pinocchio returns a vector.
        column = np.reshape(jacobian, (6, -1))[:, model.joints[number].idx_v]
        turns = bool(np.linalg.norm(column[3:]) > 0.5)
        direction = column[3:] if turns else column[:3]
        sign = np.sign(opened - closed or 1.0)
        axis = data.oMi[number].rotation @ direction * sign
        origin = np.array(data.oMi[number].translation)
        points = _collect_moved_vertices(model, data, pieces, number)
        offsets = points - origin
        offsets -= np.outer(offsets @ axis, axis)
        reach = float(np.linalg.norm(offsets, axis=1).max(initial=0.0))
        corners = points if len(points) else origin[None]
        openings[number] = Opening(
            joint=name,
            number=number,
            coordinate=coordinate,
            turns=turns,
            closed=closed,
            opened=opened,
            axis=axis,
            origin=origin,
            low=corners.min(axis=0),
            high=corners.max(axis=0),
            reach=reach,
        )
    return openings


def _collect_moved_vertices(
    model: pin.Model, data: pin.Data, pieces: dict[int, list[Piece]], joint: int
) -> Floats:
    """Return the vertices of all pieces that a joint moves, in the base frame, shape (n, 3) [m]."""
    moved = [np.zeros((0, 3))]
    for number, pieces_of_joint in pieces.items():
        if joint in model.supports[number]:
            placement = data.oMi[number]
            for piece in pieces_of_joint:
                moved.append(piece.vertices @ placement.rotation.T + placement.translation)
    return np.vstack(moved)


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
    along = tool.rotation[:, 1]
    approach = tool.rotation[:, 2]
    place = tool.translation
    size = np.maximum(opening.high - opening.low, 1e-3)
    offset = place - (opening.low + opening.high) / 2.0
    if opening.turns:
        # The arm of the pull is perpendicular to the hinge; off the centre counts along it.
        arm = place - opening.origin
        arm -= (arm @ opening.axis) * opening.axis
        pull = np.cross(opening.axis, arm)
        leverage = float(np.linalg.norm(arm)) / max(opening.reach, 1e-3)
        pull /= max(float(np.linalg.norm(pull)), 1e-9)
        eccentricity = abs(offset @ opening.axis) / (np.abs(opening.axis) @ size / 2.0)
    else:
        pull = opening.axis
        leverage = 1.0
        across = offset - (offset @ pull) * pull
        eccentricity = float(np.linalg.norm(across / (size / 2.0)))
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
    is_handle = dict[str, bool]()
    for link in root.findall("link"):
        link_name = link.get("name", "")
        for number, element in enumerate(link.findall("collision")):
            mesh = element.find("geometry/mesh")
            file = "" if mesh is None else mesh.get("filename", "").rpartition("/")[2]
            text = " ".join((link_name, element.get("name", ""), file)).lower()
            is_handle[f"{link_name}_{number}"] = any(word in text for word in _WORDS)
    return is_handle


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
        self.item = item
        self.hand = hand
        self._safe = dist_safe
        self._close = grasp_clearance
        self._shapes = list(item.collision.geometryObjects)
        self.links = np.array([get_link_name(shape.name) for shape in self._shapes])
        self._joints = [shape.parentJoint for shape in self._shapes]
        self._boxes = [compute_bounding_box(shape) for shape in self._shapes]
        self._hand = [*hand.touch, *hand.others]
        self._touch = np.arange(len(self._hand)) < len(hand.touch)
        self._hand_boxes = list[Box]()
        for shape, where in self._hand:
            self._hand_boxes.append(compute_bounding_box(pin.GeometryObject("", 0, where, shape)))
        self._data = item.model.createData()
        self.place(np.clip(np.zeros(len(item.lower)), item.lower, item.upper))
        self.floor = float(self._low[:, 2].min()) if len(self._shapes) else -np.inf

    def place(self, state: Floats) -> None:
        """Set the object's joint positions, shape (n,), [rad] or [m]."""
        self.state = np.array(state, float)
        pin.forwardKinematics(self.item.model, self._data, self.item.coordinates.q(self.state))
        self._at = list[pin.SE3]()
        corners = list[Box]()
        for joint, shape, box in zip(self._joints, self._shapes, self._boxes, strict=True):
            where = self._data.oMi[joint] * shape.placement
            self._at.append(where)
            corners.append(_transform_box(box, where))
        corner_array = np.array(corners).reshape(-1, 2, 3)
        self._low = corner_array[:, 0]
        self._high = corner_array[:, 1]

    def joint(self, number: int) -> pin.SE3:
        """Return the placement of a joint of the object's model in its base frame."""
        return self._data.oMi[number]

    def find_obstruction(
        self, tool: pin.SE3, link: str, *, extra_clearance: float = 0.0
    ) -> Obstruction | None:
        """Return what obstructs a hand at `tool`, in the object's base frame, or None."""
        is_grasped = self.links == link
        for (shape, where), box, touches in zip(
            self._hand, self._hand_boxes, self._touch, strict=True
        ):
            placed = tool * where
            low, high = _transform_box(box, placed)
            if low[2] < self.floor:
                return Obstruction("floor")
            margins = np.where(is_grasped & touches, self._close, self._safe + extra_clearance)
            gaps = np.maximum(self._low - high, low - self._high).max(axis=1)
            for k in np.flatnonzero(gaps < margins).tolist():
                other = self._shapes[k].geometry
                distance = compute_shape_distance(shape, placed, other, self._at[k])
                if distance < margins[k]:
                    what = "fingers" if is_grasped[k] and touches else "others"
                    return Obstruction(what, str(self.links[k]))
        return None

    def is_hidden(self, tool: pin.SE3) -> bool:
        """Return whether the object blocks a forearm straight behind a hand at `tool`."""
        arm = coal.Capsule(_ARM_RADIUS, _ARM_LENGTH)
        middle = -(_ARM_START + _ARM_LENGTH / 2.0)
        where = tool * pin.SE3(np.eye(3), np.array([0.0, 0.0, middle]))
        for shape, at in zip(self._shapes, self._at, strict=True):
            if compute_shape_distance(arm, where, shape.geometry, at) <= 0.0:
                return True
        return False


def _transform_box(box: Box, where: pin.SE3) -> Box:
    """Return the lower and upper corner, in the world, of a box (centre, half extents).

    The half extents of the box around a rotated one are |R| h.
    """
    centre, half_extents = box
    middle = where.rotation @ centre + where.translation
    extent = np.abs(where.rotation) @ half_extents
    return middle - extent, middle + extent


class GraspMotion:
    """Motion of a hand that grasps an object."""

    def __init__(self, clearance: HandClearance, grasp: Candidate, standoff: float) -> None:
        self._clearance = clearance
        self._grasp = grasp
        self._offset = pin.SE3(np.eye(3), np.array([0.0, 0.0, -standoff]))
        self._state = clearance.state.copy()
        frame = clearance.item.link_frame(grasp.piece.link)
        self._joint = int(clearance.item.model.frames[frame].parentJoint)
        steps = round(_LARGEST_TURN / _TURN)
        angles = _TURN * np.arange(-steps, steps + 1)
        self._angles = angles[np.abs(angles) <= grasp.round + 1e-9]
        # The fingers stay on the bar.
        half = clearance.hand.width / 2.0
        low, high = grasp.span
        self._low = 0.0 - self._slide_until_obstructed(-1.0, -low - half)
        self._high = self._slide_until_obstructed(1.0, high - half)
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
            reached = value
            self._turned = self._turned | reachable
        self._clearance.place(self._state)
        return float(reached)

    def freedoms(self) -> tuple[str, tuple[Freedom, ...]]:
        """Return the kind of the virtual joint and its degrees of freedom.

        Their ranges are those in which the hand has clearance at the start or while it follows a
        joint.
        """
        angles = self._angles[self._turned]
        slides = self._high - self._low >= _MIN_SLIDE
        turns = np.ptp(angles) >= _MIN_TURN
        # -0.0 + 0.0 is 0.0.
        low = round(float(angles.min()), 6) + 0.0
        high = round(float(angles.max()), 6) + 0.0
        if slides and turns:
            slide = Freedom("_slide", "prismatic", _BAR, self._low, self._high)
            turn = Freedom("_turn", "revolute", _BAR, low, high)
            return "cylindrical", (slide, turn)
        if slides:
            return "prismatic", (Freedom("", "prismatic", _BAR, self._low, self._high),)
        if turns:
            return "revolute", (Freedom("", "revolute", _BAR, low, high),)
        return "fixed", ()

    def _slide_until_obstructed(self, sign: float, furthest: float) -> float:
        """Return how far the hand slides in steps before it is obstructed [m].

        Args:
            sign: Direction along the bar, 1 or -1.
            furthest: Distance from the grasp to the end of the bar [m].
        """
        longest = min(_LONGEST, furthest) + 1e-9
        count = 0
        while (count + 1) * _SLIDE <= longest:
            if not self._is_free(sign * ((count + 1) * _SLIDE), 0.0):
                break
            count += 1
        return round(count * _SLIDE, 6) + 0.0

    def _is_free(self, slide: float, turn: float) -> bool:
        """Return whether the hand has clearance after a slide [m] and a rotation [rad]."""
        motion = pin.SE3(pin.exp3(_BAR * turn), _BAR * slide)
        tool = self._clearance.joint(self._joint) * self._grasp.placement * motion
        return self._clearance.find_obstruction(tool * self._offset, self._grasp.piece.link) is None

    def _find_free_angles(self) -> Bools:
        return np.array([self._is_free(0.0, angle) for angle in self._angles])

    def _grow(self, free: Bools, start: Bools) -> Bools:
        """Return the free angles connected to `start` through free angles, masks of shape (n,)."""
        reachable = free & start
        before = np.zeros_like(start)
        while (reachable != before).any():
            before = reachable.copy()
            reachable[1:] |= before[:-1]
            reachable[:-1] |= before[1:]
            reachable &= free
        return reachable
