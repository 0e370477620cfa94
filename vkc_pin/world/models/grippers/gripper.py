"""Grippers: the joints of the fingers, and where these stand when they are so far open.

A hand is as far open as the widest bar is that fits between its fingers, see `bars`. All joints go
from where they are closed to where they are open by the same fraction of their ways, as with one
motor; joints that mimic others follow them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.utils import arguments
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.documents import Document
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.models.coordinates import Coordinates
from vkc_pin.world.models.couplings.coupled_joints import find_followers
from vkc_pin.world.models.grippers.bar_width import (
    WIDTH_TOLERANCE,
    PlacedShape,
    check_bar_fits,
    find_widest_bar,
)
from vkc_pin.world.models.robot_model import build_unlocked_model
from vkc_pin.world.models.robot_schema import FingerSchema
from vkc_pin.world.models.shapes import LIMIT_SLACK

__all__ = ["Gripper", "build_gripper"]

_BISECTION_STEPS = 30  # of the way between closed and open: 1e-9 of it


@dataclass(frozen=True, eq=False, kw_only=True)
class Gripper:
    """The fingers of a robot's hand.

    Attributes:
        model: The robot's model with the joints of the fingers, k of them, which come last, instead
            of locked ones.
        names: Of these joints; those that mimic others are among them.
        closed, open: Where they are when the gripper is closed and fully open, shape (k,), [m] or
            [rad].
        rest: Where they are if nobody asks for an opening, shape (k,).
        tool_frame: The robot's.
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
        """Its opening when it is closed [m]."""
        return find_widest_bar(self._place_hand(self.closed))

    @cached_property
    def max_opening(self) -> float:
        """Its opening when it is fully open [m]."""
        return find_widest_bar(self._place_hand(self.open))

    @cached_property
    def rest_opening(self) -> float:
        """Its opening if nobody asks for one [m]."""
        return find_widest_bar(self._place_hand(self.rest))

    def clamp_opening(self, opening: float) -> float:
        """Return the opening that it can stand at and is nearest to one that is asked for [m]."""
        return min(max(opening, self.min_opening), self.max_opening)

    def compute_positions(self, opening: float | None) -> Floats:
        """Return where the joints of its fingers are, shape (k,), [m] or [rad], when it is so far open [m]; None: at rest.

        Raises:
            InputError: It cannot be so far open, or that is no number.
        """
        if opening is None:
            return self.rest
        opening = arguments.number(opening, "opening", "between the fingers [m]")
        if not self.min_opening - WIDTH_TOLERANCE <= opening <= self.max_opening + WIDTH_TOLERANCE:
            expected = f"{self.min_opening:.4g} to {self.max_opening:.4g} m"
            raise InputError(
                "the gripper cannot be so far open",
                field="opening",
                expected=expected,
                got=f"{opening:g} m",
            )
        if opening not in self._fractions:
            self._fractions[opening] = self._find_open_fraction(opening)
        fraction = self._fractions[opening]
        return np.asarray((1.0 - fraction) * self.closed + fraction * self.open)

    def compute_frames(self, opening: float | None) -> dict[str, pin.SE3]:
        """Return where the frames on its fingers are when it is so far open [m], by name, in the frame of the robot's joint."""
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
        """Return shapes on the joints of `model`, the robot's, as shapes on those of this gripper's model."""
        return _attach_shapes(shapes, model, self.model)

    @property
    def _first_finger_joint(self) -> int:
        """The first joint of the fingers."""
        return int(self.model.njoints - len(self.names))

    def _compute_data(self, fingers: Floats) -> pin.Data:
        """Return where all is with the fingers at some positions, and all other joints at zero."""
        data, coordinates = self.model.createData(), Coordinates(self.model)
        z = np.append(np.zeros(coordinates.size - len(fingers)), fingers)
        pin.framesForwardKinematics(self.model, data, coordinates.q(z))
        return data

    def _place_hand(self, fingers: Floats) -> list[PlacedShape]:
        """Return the shapes of fingers and palm in the tool frame, with the fingers at some positions."""
        data, frame = self._compute_data(fingers), self.model.getFrameId(self.tool_frame)
        back, palm = data.oMf[frame].inverse(), self.model.frames[frame].parentJoint
        shapes = [
            shape
            for shape in self.collision.geometryObjects
            if shape.parentJoint == palm or shape.parentJoint >= self._first_finger_joint
        ]
        return [
            (shape.geometry, back * data.oMi[shape.parentJoint] * shape.placement)
            for shape in shapes
        ]

    def _find_open_fraction(self, opening: float) -> float:
        """Return the least fraction of the way from closed to open at which a bar so wide fits."""
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
    """Return shapes on the joints of `model` as shapes on those of `unlocked`, which begins with the same joints."""
    found = []
    for shape in shapes:
        twin, old = pin.GeometryObject(shape), model.frames[shape.parentFrame]
        twin.parentFrame = unlocked.getFrameId(old.name, pin.FrameType.BODY)
        new = unlocked.frames[twin.parentFrame]
        if new.parentJoint >= model.njoints:
            twin.placement = new.placement * old.placement.actInv(shape.placement)
        twin.parentJoint = new.parentJoint
        found.append(twin)
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
    """Return the gripper that a robot.yaml describes; None: it says nothing of one.

    Args:
        full: The robot with all its joints, see `robot_model.build_full_model`.
        file: Its URDF.
        model: The same with all joints locked but those that are planned.
        collision: The robot's shapes on that.
        tool_frame: Its frame that grasps.
        rest: Where all joints are if nobody says otherwise, [m] or [rad].
        stated: Joint of a finger → where it is closed and open; joints that the robot has.
        document: The robot.yaml.
        height: Of the root link above the floor [m].

    Raises:
        InputError: A joint is none of a finger: it is part of the arm, mimics another, cannot be
            where it is said to be, or does not move; or there is no more room between the fingers
            where they are open than where they are closed.
    """
    if not stated:
        return None
    follows, palm = (
        find_followers(file.root),
        list(full.supports[full.frames[full.getFrameId(tool_frame)].parentJoint]),
    )
    arm = max(j for j in palm if full.names[j] in list(model.names))
    for joint, finger in stated.items():
        where = ("gripper", joint)
        if joint in follows:
            problem, leader = "this joint follows another one", follows[joint].leader
            raise document.error(
                where, problem, expected=f"'{leader}', which it follows", got=joint
            )
        number = full.getJointId(joint)
        if number in palm or arm not in list(full.supports[number]):
            expected = f"a joint of the hand, beyond '{full.names[arm]}'"
            raise document.error(
                where, "this joint is none of a finger", expected=expected, got=joint
            )
        moving = full.joints[number]
        low, high = (-np.inf, np.inf)
        if moving.nq == 1:
            low, high = full.lowerPositionLimit[moving.idx_q], full.upperPositionLimit[moving.idx_q]
        for key, value in (("closed", finger.closed), ("open", finger.open)):
            if not low - LIMIT_SLACK <= value <= high + LIMIT_SLACK:
                problem = "a finger outside its limits"
                raise document.error(
                    (*where, key), problem, expected=f"between {low:g} and {high:g}", got=value
                )
        if finger.closed == finger.open:
            raise document.error(
                where,
                "a finger that does not move",
                expected="two positions, closed and open",
                got=finger.open,
            )
    moved = [
        name
        for name in rest
        if name in stated or (name in follows and follows[name].leader in stated)
    ]
    names = tuple(sorted(moved, key=full.getJointId))
    unlocked, shapes = (
        build_unlocked_model(full, file, model, names, rest, height),
        pin.GeometryModel(),
    )
    for shape in _attach_shapes(list(collision.geometryObjects), model, unlocked):
        shapes.addGeometryObject(shape)

    def at(position: str) -> Floats:
        own = {joint: float(getattr(finger, position)) for joint, finger in stated.items()}
        own |= {
            name: led.factor * own[led.leader] + led.offset
            for name, led in follows.items()
            if led.leader in own
        }
        return np.array([own[name] for name in names])

    gripper = Gripper(
        model=unlocked,
        names=names,
        closed=at("closed"),
        open=at("open"),
        rest=np.array([rest[name] for name in names]),
        tool_frame=tool_frame,
        collision=shapes,
    )
    if not gripper.max_opening > gripper.min_opening:
        expected = f"more room where it is open than where it is closed, around the frame '{tool_frame}' and along its x axis"
        got = f"{1e3 * gripper.min_opening:.1f} mm closed, {1e3 * gripper.max_opening:.1f} mm open"
        raise document.error(("gripper",), "the gripper does not open", expected=expected, got=got)
    return gripper
