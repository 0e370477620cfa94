"""Models grippers: maps the opening between the fingers to the positions of their joints.

The opening is the width of the widest bar that fits between the fingers. All finger joints move
from closed to open by the same fraction of their range, as with one motor; mimic joints follow.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import coal
import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils import arguments
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.documents import Document
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.couplings import find_followers
from vkc_pin.world.models.robot_model import build_unlocked_model, find_joint_limits
from vkc_pin.world.models.robot_schema import FingerSchema
from vkc_pin.world.models.shapes import LIMIT_SLACK

BAR_THICKNESS = 2e-3
"""Thickness of the bar across the measured direction [m]."""
WIDTH_TOLERANCE = 1e-4
"""Accuracy of the width of the widest bar [m]."""
_MAX_WIDTH = 0.5  # [m]: larger than any opening
_ROD_LENGTH = 0.12  # [m]: longer than fingers are wide
_ALONG_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
WIDEST_BAR = _MAX_WIDTH - WIDTH_TOLERANCE
"""Width from which no shape limits a bar [m]."""

PlacedShape = tuple[coal.CollisionGeometry, pin.SE3]
"""A shape and its placement."""

_BISECTION_STEPS = 30  # bisection of the range between closed and open, to 1e-9 of it


def check_bar_fits(width: float, shapes: Sequence[PlacedShape]) -> bool:
    """Return whether a bar at the tool's origin collides with none of the shapes.

    Args:
        width: Width of the bar along the tool's x axis [m].
        shapes: Shapes with their placements in the tool frame.
    """
    return _is_free(coal.Box(width, BAR_THICKNESS, BAR_THICKNESS), np.eye(3), shapes)


def find_widest_bar(shapes: Sequence[PlacedShape]) -> float:
    """Return the width of the widest bar that fits at the tool's origin [m]; 0 if none does."""
    return _find_largest(lambda width: check_bar_fits(width, shapes))


def find_thickest_rod(shapes: Sequence[PlacedShape]) -> float:
    """Return the largest diameter of a rod along the tool's y axis that fits at its origin [m].

    It is 0 if none fits.
    """
    return _find_largest(
        lambda width: _is_free(coal.Cylinder(width / 2.0, _ROD_LENGTH), _ALONG_Y, shapes)
    )


def _is_free(solid: coal.ShapeBase, rotation: Floats, shapes: Sequence[PlacedShape]) -> bool:
    where = coal.Transform3s(rotation, np.zeros(3))
    request, result = coal.CollisionRequest(), coal.CollisionResult()
    for geometry, placement in shapes:
        result.clear()
        at = coal.Transform3s(placement.rotation, placement.translation)
        if coal.collide(solid, where, geometry, at, request, result):
            return False
    return True


def _find_largest(check: Callable[[float], bool]) -> float:
    low, high = 0.0, _MAX_WIDTH
    while high - low > WIDTH_TOLERANCE:
        middle = (low + high) / 2.0
        low, high = (middle, high) if check(middle) else (low, middle)
    return low


@dataclass(frozen=True, eq=False, kw_only=True)
class Gripper:
    """Fingers of a robot's gripper.

    Attributes:
        model: The robot's model with the k finger joints unlocked, which come last.
        names: Names of the finger joints, including mimic joints.
        closed, open: Joint positions with the gripper closed and fully open, shape (k,), [m] or
            [rad].
        rest: Default joint positions, shape (k,), [m] or [rad].
        tool_frame: The robot's tool frame.
        collision: The robot's collision shapes on `model`.
    """

    model: pin.Model
    names: tuple[str, ...]
    closed: Floats
    open: Floats
    rest: Floats
    tool_frame: str
    collision: pin.GeometryModel = field(repr=False)
    _fractions: dict[float, float] = field(default_factory=dict, repr=False)

    @cached_property
    def min_opening(self) -> float:
        """Opening with the gripper closed [m]."""
        return find_widest_bar(self._place_hand(self.closed))

    @cached_property
    def max_opening(self) -> float:
        """Opening with the gripper fully open [m]."""
        return find_widest_bar(self._place_hand(self.open))

    @cached_property
    def rest_opening(self) -> float:
        """Opening at the default joint positions [m]."""
        return find_widest_bar(self._place_hand(self.rest))

    def clamp_opening(self, opening: float) -> float:
        """Return the feasible opening nearest to `opening` [m]."""
        return min(max(opening, self.min_opening), self.max_opening)

    def compute_positions(self, opening: float | None) -> Floats:
        """Return the positions of the finger joints, shape (k,), [m] or [rad].

        Args:
            opening: Opening [m]. Default: the rest positions.
        """
        if opening is None:
            return self.rest
        opening = arguments.check_number(opening, "opening", "between the fingers [m]")
        if not self.min_opening - WIDTH_TOLERANCE <= opening <= self.max_opening + WIDTH_TOLERANCE:
            expected = f"{self.min_opening:.4g} to {self.max_opening:.4g} m"
            raise InputError(
                "the opening is out of the gripper's range",
                field="opening",
                expected=expected,
                got=f"{opening:g} m",
            )
        if opening not in self._fractions:
            self._fractions[opening] = self._find_open_fraction(opening)
        fraction = self._fractions[opening]
        return np.asarray((1.0 - fraction) * self.closed + fraction * self.open)

    def compute_frames(self, opening: float | None) -> dict[str, pin.SE3]:
        """Return the placements of the finger frames at an opening [m], by name.

        Placements are in the frame of the robot's joint that carries the finger.
        """
        data, first = self._compute_data(self.compute_positions(opening)), self._first_finger_joint
        found = {}
        for frame in self.model.frames:
            joint = frame.parentJoint
            if joint >= first:
                carrier = max(j for j in self.model.supports[joint] if j < first)
                found[str(frame.name)] = data.oMi[carrier].actInv(data.oMi[joint]) * frame.placement
        return found

    def attach_shapes(
        self, shapes: Sequence[pin.GeometryObject], model: pin.Model
    ) -> list[pin.GeometryObject]:
        """Return copies of shapes on the robot's `model`, attached to the gripper's model."""
        return _attach_shapes(shapes, model, self.model)

    @property
    def _first_finger_joint(self) -> int:
        """Index of the first finger joint."""
        return int(self.model.njoints - len(self.names))

    def _compute_data(self, fingers: Floats) -> pin.Data:
        """Return kinematics data with given finger positions, and all other joints at zero."""
        data, coordinates = self.model.createData(), Coordinates(self.model)
        z = np.append(np.zeros(coordinates.size - len(fingers)), fingers)
        pin.framesForwardKinematics(self.model, data, coordinates.q(z))
        return data

    def _place_hand(self, fingers: Floats) -> list[PlacedShape]:
        """Return the shapes of fingers and palm in the tool frame, with given finger positions."""
        data, frame = self._compute_data(fingers), self.model.getFrameId(self.tool_frame)
        tool_inverse, palm = data.oMf[frame].inverse(), self.model.frames[frame].parentJoint
        shapes = [
            shape
            for shape in self.collision.geometryObjects
            if shape.parentJoint == palm or shape.parentJoint >= self._first_finger_joint
        ]
        return [
            (shape.geometry, tool_inverse * data.oMi[shape.parentJoint] * shape.placement)
            for shape in shapes
        ]

    def _find_open_fraction(self, opening: float) -> float:
        """Return the smallest fraction of the range from closed to open at which a bar fits."""
        low, high = 0.0, 1.0
        if opening <= self.min_opening or check_bar_fits(opening, self._place_hand(self.closed)):
            return low
        for _ in range(_BISECTION_STEPS):
            middle = (low + high) / 2.0
            fits = check_bar_fits(
                opening, self._place_hand((1.0 - middle) * self.closed + middle * self.open)
            )
            low, high = (low, middle) if fits else (middle, high)
        return high


def _attach_shapes(
    shapes: Sequence[pin.GeometryObject], model: pin.Model, unlocked: pin.Model
) -> list[pin.GeometryObject]:
    """Return copies of the shapes on the joints of the model with unlocked fingers."""
    found = []
    for shape in shapes:
        copy, old = pin.GeometryObject(shape), model.frames[shape.parentFrame]
        copy.parentFrame = unlocked.getFrameId(old.name, pin.FrameType.BODY)
        new = unlocked.frames[copy.parentFrame]
        if new.parentJoint >= model.njoints:
            copy.placement = new.placement * old.placement.actInv(shape.placement)
        copy.parentJoint = new.parentJoint
        found.append(copy)
    return found


def build_gripper(
    full: pin.Model,
    file: UrdfFile,
    model: pin.Model,
    collision: pin.GeometryModel,
    tool_frame: str,
    rest: Mapping[str, float],
    stated: Mapping[str, FingerSchema],
    document: Document,
    *,
    height: float,
) -> Gripper | None:
    """Return the gripper described in a robot.yaml, or None if it describes none.

    Args:
        full: The robot with all joints.
        file: The robot's URDF.
        model: The robot with the planned joints.
        collision: Collision shapes on `model`.
        tool_frame: The tool frame.
        rest: Rest positions of all joints, [m] or [rad].
        stated: Finger joint → its closed and open positions.
        document: The robot.yaml.
        height: Height of the root link [m].
    """
    if not stated:
        return None
    follows = find_followers(file.root)
    palm = list(full.supports[full.frames[full.getFrameId(tool_frame)].parentJoint])
    arm = max(j for j in palm if full.names[j] in list(model.names))
    for joint, finger in stated.items():
        where = ("gripper", joint)
        if joint in follows:
            problem, leader = "this joint follows another one", follows[joint].leader
            raise document.make_error(
                where, problem, expected=f"'{leader}', which it follows", got=joint
            )
        joint_index = full.getJointId(joint)
        if joint_index in palm or arm not in list(full.supports[joint_index]):
            expected = f"a joint of the hand, a descendant of '{full.names[arm]}'"
            raise document.make_error(
                where, "this is not a finger joint", expected=expected, got=joint
            )
        low, high = find_joint_limits(full, joint)
        for key, value in (("closed", finger.closed), ("open", finger.open)):
            if not low - LIMIT_SLACK <= value <= high + LIMIT_SLACK:
                problem = "this finger position is outside the joint's limits"
                raise document.make_error(
                    (*where, key), problem, expected=f"between {low:g} and {high:g}", got=value
                )
        if finger.closed == finger.open:
            raise document.make_error(
                where,
                "this finger joint does not move",
                expected="different positions for closed and open",
                got=finger.open,
            )
    finger_joints = [
        name
        for name in rest
        if name in stated or (name in follows and follows[name].leader in stated)
    ]
    names = tuple(sorted(finger_joints, key=full.getJointId))
    unlocked = build_unlocked_model(full, file, model, names, rest, height)
    shapes = pin.GeometryModel()
    for shape in _attach_shapes(list(collision.geometryObjects), model, unlocked):
        shapes.addGeometryObject(shape)

    def collect_positions(state: str) -> Floats:
        positions = {joint: float(getattr(finger, state)) for joint, finger in stated.items()}
        positions |= {
            name: coupling.factor * positions[coupling.leader] + coupling.offset
            for name, coupling in follows.items()
            if coupling.leader in positions
        }
        return np.array([positions[name] for name in names])

    gripper = Gripper(
        model=unlocked,
        names=names,
        closed=collect_positions("closed"),
        open=collect_positions("open"),
        rest=np.array([rest[name] for name in names]),
        tool_frame=tool_frame,
        collision=shapes,
    )
    if not gripper.max_opening > gripper.min_opening:
        expected = (
            f"a larger opening when open than when closed, along the x axis of '{tool_frame}'"
        )
        got = f"{1e3 * gripper.min_opening:.1f} mm closed, {1e3 * gripper.max_opening:.1f} mm open"
        raise document.make_error(
            ("gripper",), "the gripper does not open", expected=expected, got=got
        )
    return gripper
