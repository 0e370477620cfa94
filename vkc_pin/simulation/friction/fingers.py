"""Models fingers that close on an object: those of a described gripper, or the two sides of a hand.

A hand whose robot.yaml describes no `gripper` has rigid fingers. For grasps by friction its pads
slide towards each other: the shapes of the touch links that the x axis of the tool frame
intersects, on either side. Fingers of one hand are coupled as if by one motor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.simulation.model import Builder, PhysicalWorld, to_mujoco_quaternion
from vkc_pin.simulation.physics import Physics
from vkc_pin.simulation.servos import Servo, make_servo
from vkc_pin.utils.arrays import Floats, Ints
from vkc_pin.world.models.grippers.bar_width import check_bar_fits, find_widest_bar
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.trajectory.world_model import World

__all__ = ["Fingers", "Sides", "find_fingers", "limit_finger_servos"]

_MASS = 0.1  # [kg] of a sliding finger
_REACH = 0.2  # [m] largest distance of a finger's shapes from the tool frame
_COUPLING = (0.004, 1.0)  # time constant [s] and damping ratio of the coupling of fingers


@dataclass(frozen=True, eq=False)
class Sides:
    """Sides of a hand that slide towards each other.

    Attributes:
        shapes: Numbers of the world's shapes on either side.
        tool: Placement of the tool frame on its parent joint.
        joint: Parent joint of the tool frame.
        travel: Distance that each side moves until they meet [m].
    """

    shapes: tuple[tuple[int, ...], tuple[int, ...]]
    tool: pin.SE3
    joint: int
    travel: float


@dataclass(frozen=True, eq=False)
class Fingers:
    """Fingers and their drives.

    Attributes:
        names: Names of the k joints in MuJoCo.
        closed: Joint positions of closed fingers with nothing between them, shape (k,), [m] or
            [rad].
        open: Joint positions of fully open fingers, shape (k,).
        sides: Sliding sides of the hand; None if the fingers are joints of the robot.
        servos: Servos of the sides.
    """

    names: tuple[str, ...]
    closed: Floats
    open: Floats
    sides: Sides | None = None
    servos: tuple[Servo, ...] = ()

    def add_bodies(self, builder: Builder) -> None:
        """Add the bodies of sliding sides, to which their shapes move."""
        if self.sides is None:
            return
        hand, kinds = builder.bodies[self.sides.joint], builder.mj.mjtJoint
        for name, servo, sign, shapes in zip(
            self.names, self.servos, (1.0, -1.0), self.sides.shapes, strict=True
        ):
            tool = self.sides.tool
            body = hand.add_body(
                name=name, pos=tool.translation, quat=to_mujoco_quaternion(tool), gravcomp=1.0
            )
            body.mass, body.inertia, body.explicitinertial = _MASS, np.full(3, 1e-4), True
            joint = body.add_joint(name=name, type=kinds.mjJNT_SLIDE, axis=[-sign, 0.0, 0.0])
            servo.configure_joint(joint, builder.mj)
            limited = builder.mj.mjtLimited.mjLIMITED_TRUE
            joint.limited, joint.range = limited, [0.0, self.sides.travel]
            for number in shapes:
                place = tool.actInv(builder.world.shapes[number].placement)
                builder.moved_shapes[number] = body, place

    def add_drives(self, builder: Builder) -> None:
        """Add the motors of sliding sides and the coupling of all fingers."""
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

    def find_addresses(self, physical: PhysicalWorld) -> tuple[Ints, Ints]:
        """Return the indices of positions and of commands in MuJoCo, shape (k,) each."""
        model: Any = physical.model
        columns = [int(model.joint(name).qposadr[0]) for name in self.names]
        return np.array(columns), np.array([int(model.actuator(name).id) for name in self.names])


def find_fingers(world: World, physics: Physics) -> Fingers:
    """Return the fingers of a robot."""
    gripper = world.scene.robot.gripper
    if gripper is not None:
        return Fingers(gripper.names, gripper.closed, gripper.open)
    sides = _find_sides(world)
    names = ("side 0", "side 1")
    bandwidth, ratio = physics.arm_bandwidth, physics.damping_ratio
    servos = tuple(
        make_servo(name, _MASS, physics.closing_force, "m", bandwidth, ratio) for name in names
    )
    return Fingers(names, np.full(2, sides.travel), np.zeros(2), sides, servos)


def limit_finger_servos(
    servos: Sequence[Servo], fingers: Fingers, world: World, physics: Physics
) -> tuple[Servo, ...]:
    """Return the servos, those of fingers limited to the hand's closing force."""
    units = dict(zip(world.coordinates.names, world.coordinates.units, strict=True))
    limited = []
    for servo in servos:
        name = servo.coordinate
        if name in fingers.names:
            if units[name] == "m":
                limit = min(servo.limit, physics.closing_force)
            elif np.isfinite(servo.limit):
                limit = servo.limit
            else:
                problem = (
                    "a revolute finger without an effort limit in the URDF cannot hold by friction"
                )
                raise InputError(
                    problem, field="grasp", expected='an effort limit, or grasp="weld"', got=name
                )
            moved, ratio = servo.inertia - servo.armature, physics.damping_ratio
            servo = make_servo(name, moved, limit, units[name], physics.arm_bandwidth, ratio)
        limited.append(servo)
    return tuple(limited)


def _find_sides(world: World) -> Sides:
    """Return the shapes of a hand on either side of its tool frame, and their travel."""
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
        x = _project_on_x(place, shape)
        beside = x.min() > 0.0 or x.max() < 0.0
        if beside and not check_bar_fits(2.0 * _REACH, [(shape.geometry, place)]):
            sides[0 if x.min() > 0.0 else 1].append(number)
    placed = [(shape.geometry, back * shape.placement) for _, shape in hand]
    travel = find_widest_bar(placed) / 2.0 if all(sides) else 0.0
    if not (all(sides) and 0.0 < travel < _REACH):
        expected = (
            "a robot.yaml with a `gripper`, "
            "or touch_links on both sides of the tool frame, along its x axis"
        )
        raise InputError(
            f"the hand of '{robot.name}' has no fingers that close",
            field="grasp",
            expected=expected,
            got="friction",
        )
    return Sides(
        (tuple(sides[0]), tuple(sides[1])), frame.placement, int(frame.parentJoint), travel
    )


def _project_on_x(place: pin.SE3, shape: pin.GeometryObject) -> Floats:
    """Return the x coordinates of a shape's vertices in the tool frame."""
    points = triangulate(shape.geometry)[0]
    return np.asarray(points @ place.rotation[0] + place.translation[0])
