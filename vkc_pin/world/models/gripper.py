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
from vkc_pin.world.models.couplings import JointCoupling, find_followers
from vkc_pin.world.models.robot_model import build_unlocked_model, find_joint_limits
from vkc_pin.world.models.robot_schema import FingerSchema
from vkc_pin.world.models.shapes import LIMIT_SLACK

BAR_THICKNESS = 2e-3
"""Thickness of the bar across the measured direction [m]."""
WIDTH_TOLERANCE = 1e-4
"""Accuracy of the width of the widest bar [m]."""
_MAX_WIDTH = 0.5  # [m]: larger than any opening
_ROD_LENGTH = 0.12  # [m]: longer than fingers are wide
# Rotation that turns the z axis, the axis of coal's cylinders, into the y axis.
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
    return _find_largest_width(lambda width: check_bar_fits(width, shapes))


def find_thickest_rod(shapes: Sequence[PlacedShape]) -> float:
    """Return the largest diameter of a rod along the tool's y axis that fits at its origin [m].

    It is 0 if none fits.
    """

    def fits(diameter: float) -> bool:
        return _is_free(coal.Cylinder(diameter / 2.0, _ROD_LENGTH), _ALONG_Y, shapes)

    return _find_largest_width(fits)


def _is_free(solid: coal.ShapeBase, rotation: Floats, shapes: Sequence[PlacedShape]) -> bool:
    """Return whether a solid at the tool's origin collides with none of the shapes."""
    solid_placement = coal.Transform3s(rotation, np.zeros(3))
    request = coal.CollisionRequest()
    result = coal.CollisionResult()
    for geometry, placement in shapes:
        result.clear()
        shape_placement = coal.Transform3s(placement.rotation, placement.translation)
        if coal.collide(solid, solid_placement, geometry, shape_placement, request, result):
            return False
    return True


def _find_largest_width(fits: Callable[[float], bool]) -> float:
    """Return the largest width that fits [m], found by bisection; 0 if none does."""
    low = 0.0
    high = _MAX_WIDTH
    while high - low > WIDTH_TOLERANCE:
        middle = (low + high) / 2.0
        if fits(middle):
            low = middle
        else:
            high = middle
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
        data = self._compute_data(self.compute_positions(opening))
        first_finger = self._first_finger_joint
        found = {}
        for frame in self.model.frames:
            joint = frame.parentJoint
            if joint < first_finger:
                continue
            carrier = max(j for j in self.model.supports[joint] if j < first_finger)
            joint_in_carrier = data.oMi[carrier].actInv(data.oMi[joint])
            found[str(frame.name)] = joint_in_carrier * frame.placement
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
        coordinates = Coordinates(self.model)
        others = np.zeros(coordinates.size - len(fingers))
        z = np.append(others, fingers)
        data = self.model.createData()
        pin.framesForwardKinematics(self.model, data, coordinates.q(z))
        return data

    def _place_hand(self, fingers: Floats) -> list[PlacedShape]:
        """Return the shapes of fingers and palm in the tool frame, with given finger positions."""
        data = self._compute_data(fingers)
        frame = self.model.getFrameId(self.tool_frame)
        world_in_tool = data.oMf[frame].inverse()
        palm = self.model.frames[frame].parentJoint
        placed = list[PlacedShape]()
        for shape in self.collision.geometryObjects:
            joint = shape.parentJoint
            if joint == palm or joint >= self._first_finger_joint:
                placement = world_in_tool * data.oMi[joint] * shape.placement
                placed.append((shape.geometry, placement))
        return placed

    def _find_open_fraction(self, opening: float) -> float:
        """Return the smallest fraction of the range from closed to open at which a bar fits."""
        low = 0.0
        high = 1.0
        if opening <= self.min_opening or check_bar_fits(opening, self._place_hand(self.closed)):
            return low
        for _ in range(_BISECTION_STEPS):
            middle = (low + high) / 2.0
            fingers = (1.0 - middle) * self.closed + middle * self.open
            if check_bar_fits(opening, self._place_hand(fingers)):
                high = middle
            else:
                low = middle
        return high


def _attach_shapes(
    shapes: Sequence[pin.GeometryObject], model: pin.Model, unlocked: pin.Model
) -> list[pin.GeometryObject]:
    """Return copies of the shapes on the joints of the model with unlocked fingers."""
    found = []
    for shape in shapes:
        link = model.frames[shape.parentFrame]
        copy = pin.GeometryObject(shape)
        copy.parentFrame = unlocked.getFrameId(link.name, pin.FrameType.BODY)
        unlocked_link = unlocked.frames[copy.parentFrame]
        # Joints of the fingers come last; links on all others have the same placement.
        if unlocked_link.parentJoint >= model.njoints:
            shape_in_link = link.placement.actInv(shape.placement)
            copy.placement = unlocked_link.placement * shape_in_link
        copy.parentJoint = unlocked_link.parentJoint
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
    couplings = find_followers(file.root)
    _check_fingers(full, model, tool_frame, stated, couplings, document)
    finger_joints = list[str]()
    for name in rest:
        follows_finger = name in couplings and couplings[name].leader in stated
        if name in stated or follows_finger:
            finger_joints.append(name)
    names = tuple(sorted(finger_joints, key=full.getJointId))
    unlocked = build_unlocked_model(full, file, model, names, rest, height)
    shapes = pin.GeometryModel()
    for shape in _attach_shapes(list(collision.geometryObjects), model, unlocked):
        shapes.addGeometryObject(shape)
    closed = {joint: float(finger.closed) for joint, finger in stated.items()}
    opened = {joint: float(finger.open) for joint, finger in stated.items()}
    _add_followers(closed, couplings)
    _add_followers(opened, couplings)
    gripper = Gripper(
        model=unlocked,
        names=names,
        closed=np.array([closed[name] for name in names]),
        open=np.array([opened[name] for name in names]),
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


def _add_followers(positions: dict[str, float], couplings: Mapping[str, JointCoupling]) -> None:
    """Add the positions of joints that follow those with a position.

    No follower has followers of its own: couplings lead to the end of their chain.
    """
    for name, coupling in couplings.items():
        if coupling.leader in positions:
            positions[name] = coupling.factor * positions[coupling.leader] + coupling.offset


def _check_fingers(
    full: pin.Model,
    model: pin.Model,
    tool_frame: str,
    stated: Mapping[str, FingerSchema],
    couplings: Mapping[str, JointCoupling],
    document: Document,
) -> None:
    """Check that the joints of a `gripper` in a robot.yaml are joints of the hand that move."""
    tool = full.frames[full.getFrameId(tool_frame)]
    palm_support = list(full.supports[tool.parentJoint])
    planned = list(model.names)
    last_arm_joint = max(joint for joint in palm_support if full.names[joint] in planned)
    for joint, finger in stated.items():
        field = ("gripper", joint)
        if joint in couplings:
            raise document.make_error(
                field,
                "this joint follows another one",
                expected=f"'{couplings[joint].leader}', which it follows",
                got=joint,
            )
        index = full.getJointId(joint)
        is_on_hand = last_arm_joint in list(full.supports[index])
        if index in palm_support or not is_on_hand:
            expected = f"a joint of the hand, a descendant of '{full.names[last_arm_joint]}'"
            raise document.make_error(
                field, "this is not a finger joint", expected=expected, got=joint
            )
        low, high = find_joint_limits(full, joint)
        for key, value in (("closed", finger.closed), ("open", finger.open)):
            if not low - LIMIT_SLACK <= value <= high + LIMIT_SLACK:
                problem = "this finger position is outside the joint's limits"
                expected = f"between {low:g} and {high:g}"
                raise document.make_error((*field, key), problem, expected=expected, got=value)
        if finger.closed == finger.open:
            raise document.make_error(
                field,
                "this finger joint does not move",
                expected="different positions for closed and open",
                got=finger.open,
            )
