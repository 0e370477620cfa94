"""Fingers that close on what is to be held: those of a gripper that is described, or else the two sides of a hand.

A hand whose robot.yaml says nothing of a `gripper` has fingers that do not move. For holding by
friction its pads slide towards each other: the shapes of the touch links that the x axis of the
tool frame meets, on either side. Fingers of one hand are coupled, as by one motor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.simulation.model import Builder, PhysicalWorld, quaternion
from vkc_pin.simulation.physics import Physics
from vkc_pin.simulation.servos import Servo, position_servo
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.models.grippers.bar_width import check_bar_fits, find_widest_bar
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.trajectory.world_model import World

__all__ = ["Fingers", "Sides", "fingers_of", "limited"]

_MASS = 0.1  # [kg] of a finger that slides
_FURTHEST = 0.2  # [m]: what is further from the tool frame is none of a finger
_COUPLING = (0.004, 1.0)  # time constant [s] and damping ratio of what couples fingers


@dataclass(frozen=True, eq=False)
class Sides:
    """The sides of a hand that slide towards each other.

    Attributes:
        shapes: The world's shapes on either side, by number.
        tool: The tool frame on the joint that carries it.
        joint: That joint.
        travel: How far each side goes until they meet [m].
    """

    shapes: tuple[tuple[int, ...], tuple[int, ...]]
    tool: pin.SE3
    joint: int
    travel: float


@dataclass(frozen=True, eq=False)
class Fingers:
    """Fingers and what drives them.

    Attributes:
        names: MuJoCo's joints, k of them.
        closed: Where they are when nothing is between them and they are closed, shape (k,), [m] or
            [rad].
        open: The same when they are fully open.
        sides: What slides, if they are the sides of a hand; None: they are joints of the robot.
        servos: Of the sides.
    """

    names: tuple[str, ...]
    closed: Floats
    open: Floats
    sides: Sides | None = None
    servos: tuple[Servo, ...] = ()

    def add_bodies(self, builder: Builder) -> None:
        """Add the bodies of sides that slide, which take their shapes along."""
        if self.sides is None:
            return
        hand, kinds = builder.bodies[self.sides.joint], builder.mj.mjtJoint
        for name, servo, sign, shapes in zip(
            self.names, self.servos, (1.0, -1.0), self.sides.shapes, strict=True
        ):
            tool = self.sides.tool
            body = hand.add_body(
                name=name, pos=tool.translation, quat=quaternion(tool), gravcomp=1.0
            )
            body.mass, body.inertia, body.explicitinertial = _MASS, np.full(3, 1e-4), True
            joint = body.add_joint(name=name, type=kinds.mjJNT_SLIDE, axis=[-sign, 0.0, 0.0])
            servo.give_motor(joint, builder.mj)
            joint.limited, joint.range = (
                builder.mj.mjtLimited.mjLIMITED_TRUE,
                [0.0, self.sides.travel],
            )
            for number in shapes:
                builder.moved[number] = (body, tool.actInv(builder.world.shapes[number].placement))

    def add_drives(self, builder: Builder) -> None:
        """Add the motors of sides that slide, and what couples all fingers."""
        for servo in self.servos:
            servo.add_to(builder.spec, builder.mj)
        kind, of = builder.mj.mjtEq.mjEQ_JOINT, builder.mj.mjtObj.mjOBJ_JOINT
        for k in range(1, len(self.names)):
            slope = (self.closed[k] - self.open[k]) / (self.closed[0] - self.open[0])
            couple = builder.spec.add_equality(
                type=kind, objtype=of, name1=self.names[k], name2=self.names[0], active=True
            )
            couple.data[:2] = [self.open[k] - slope * self.open[0], slope]
            couple.solref = _COUPLING

    def addresses(self, physical: PhysicalWorld) -> tuple[Ints, Ints]:
        """Return where they are in MuJoCo's positions, and where their commands are, shape (k,) each."""
        model: Any = physical.model
        columns = [int(model.joint(name).qposadr[0]) for name in self.names]
        return np.array(columns), np.array([int(model.actuator(name).id) for name in self.names])


def fingers_of(world: World, physics: Physics) -> Fingers:
    """Return the fingers of a robot.

    Args:
        world: The scene.
        physics: How hard they close.

    Raises:
        InputError: The hand has none that could close.
    """
    gripper = world.scene.robot.gripper
    if gripper is not None:
        return Fingers(gripper.names, gripper.closed, gripper.open)
    sides = _sides(world)
    names = ("side 0", "side 1")
    bandwidth, ratio = physics.arm_bandwidth, physics.damping_ratio
    servos = tuple(
        position_servo(name, _MASS, physics.closing_force, "m", bandwidth, ratio) for name in names
    )
    return Fingers(names, np.full(2, sides.travel), np.zeros(2), sides, servos)


def limited(
    servos: Sequence[Servo], fingers: Fingers, world: World, physics: Physics
) -> tuple[Servo, ...]:
    """Return servos of which those of fingers close no harder than a hand does.

    Raises:
        InputError: A finger turns, and nobody states how strong its motor is.
    """
    units = dict(zip(world.coordinates.names, world.coordinates.units, strict=True))
    found = []
    for servo in servos:
        name = servo.coordinate
        if name in fingers.names:
            if units[name] == "m":
                limit = min(servo.limit, physics.closing_force)
            elif np.isfinite(servo.limit):
                limit = servo.limit
            else:
                problem = (
                    "a finger that turns, and the URDF states no effort: it cannot hold by friction"
                )
                raise InputError(
                    problem, field="grasp", expected='an effort, or grasp="weld"', got=name
                )
            moved, bandwidth, ratio = (
                servo.inertia - servo.armature,
                physics.arm_bandwidth,
                physics.damping_ratio,
            )
            servo = position_servo(name, moved, limit, units[name], bandwidth, ratio)
        found.append(servo)
    return tuple(found)


def _sides(world: World) -> Sides:
    robot, labels = world.scene.robot, world.collision_labels
    frame = world.model.frames[world.model.getFrameId(robot.tool_frame)]
    back, sides = frame.placement.inverse(), (list[int](), list[int]())
    hand = [
        (number, shape)
        for number, shape in enumerate(world.bodies.geometryObjects)
        if labels[number] in robot.touch_links and shape.parentJoint == frame.parentJoint
    ]
    for number, shape in hand:
        place = back * shape.placement
        x = _across(place, shape)
        if (x.min() > 0.0 or x.max() < 0.0) and not check_bar_fits(
            2.0 * _FURTHEST, [(shape.geometry, place)]
        ):
            sides[0 if x.min() > 0.0 else 1].append(number)
    travel = (
        find_widest_bar([(shape.geometry, back * shape.placement) for _, shape in hand]) / 2.0
        if all(sides)
        else 0.0
    )
    if not (all(sides) and 0.0 < travel < _FURTHEST):
        expected = "a robot.yaml with a `gripper`, or touch_links on both sides of the tool frame, along its x axis"
        raise InputError(
            f"the hand of '{robot.name}' has no fingers that close",
            field="grasp",
            expected=expected,
            got="friction",
        )
    return Sides(
        (tuple(sides[0]), tuple(sides[1])), frame.placement, int(frame.parentJoint), travel
    )


def _across(place: pin.SE3, shape: pin.GeometryObject) -> Floats:
    """Return where the corners of a shape are along the x axis of the tool frame."""
    points = triangulate(shape.geometry)[0]
    return np.asarray(points @ place.rotation[0] + place.translation[0])
