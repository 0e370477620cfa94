"""Models fingers that grasp by friction, commands them, and measures their load and slip.

A hand whose robot.yaml describes no `gripper` has rigid fingers. For grasps by friction its pads
slide towards each other: the shapes of the touch links that the x axis of the tool frame
intersects, on either side. Fingers of one hand are coupled as if by one motor.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pinocchio as pin

from vkc_pin.errors import InputError
from vkc_pin.simulation.model import Builder, PhysicalWorld, to_mujoco_quaternion
from vkc_pin.simulation.physics import Physics, import_mujoco
from vkc_pin.simulation.servos import Servo, make_servo
from vkc_pin.simulation.welds import Grip, Span, compute_planned_freedoms, measure_hand
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.world.models.gripper import PlacedShape, check_bar_fits, find_widest_bar
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.scene.contact_rules import find_grasped_link, find_touch_links
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

# [kg], [kg·m²] of a sliding finger
_MASS = 0.1
_INERTIA = 1e-4
# [m] largest distance of a finger's shapes from the tool frame
_REACH = 0.2
# time constant [s] and damping ratio of the coupling of fingers
_COUPLING = (0.004, 1.0)
# Fingers are commanded this fraction of their travel beyond the closed position, so that thin
# objects are pressed too.
_OVERTRAVEL = 0.15
# [s] without contact after which the object counts as lost
_LOST_TIME = 0.1
# number of samples over which forces are averaged
_AVERAGED_SAMPLES = 2
# [m/s] or [rad/s] up to which the robot is at rest
_REST = 1e-6


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
        mj = builder.mj
        tool = self.sides.tool
        hand = builder.bodies[self.sides.joint]
        # The first side is on the positive x axis of the tool frame; both move towards x = 0.
        sides = zip(self.names, self.servos, (-1.0, 1.0), self.sides.shapes, strict=True)
        for name, servo, direction, shapes in sides:
            body = hand.add_body(
                name=name, pos=tool.translation, quat=to_mujoco_quaternion(tool), gravcomp=1.0
            )
            body.mass = _MASS
            body.inertia = np.full(3, _INERTIA)
            body.explicitinertial = True
            joint = body.add_joint(
                name=name, type=mj.mjtJoint.mjJNT_SLIDE, axis=[direction, 0.0, 0.0]
            )
            servo.configure_joint(joint, mj)
            joint.limited = mj.mjtLimited.mjLIMITED_TRUE
            joint.range = [0.0, self.sides.travel]
            for number in shapes:
                place = tool.actInv(builder.world.shapes[number].placement)
                builder.moved_shapes[number] = (body, place)

    def add_drives(self, builder: Builder) -> None:
        """Add the motors of sliding sides and the coupling of all fingers.

        Finger k follows the first one linearly: x_k = open_k + slope (x_0 − open_0).
        """
        mj = builder.mj
        for servo in self.servos:
            servo.add_to(builder.spec, mj)
        first_travel = self.closed[0] - self.open[0]
        for k in range(1, len(self.names)):
            slope = (self.closed[k] - self.open[k]) / first_travel
            coupling = builder.spec.add_equality(
                type=mj.mjtEq.mjEQ_JOINT,
                objtype=mj.mjtObj.mjOBJ_JOINT,
                name1=self.names[k],
                name2=self.names[0],
                active=True,
            )
            coupling.data[:2] = [self.open[k] - slope * self.open[0], slope]
            coupling.solref = _COUPLING

    def find_addresses(self, physical: PhysicalWorld) -> tuple[Ints, Ints]:
        """Return the indices of positions and of commands in MuJoCo, shape (k,) each."""
        model: Any = physical.model
        columns = [int(model.joint(name).qposadr[0]) for name in self.names]
        motors = [int(model.actuator(name).id) for name in self.names]
        return np.array(columns), np.array(motors)


def find_fingers(world: World, physics: Physics) -> Fingers:
    """Return the fingers of a robot."""
    gripper = world.scene.robot.gripper
    if gripper is not None:
        return Fingers(gripper.names, gripper.closed, gripper.open)
    sides = _find_sides(world)
    names = ("side 0", "side 1")
    servos: list[Servo] = []
    for name in names:
        servo = make_servo(
            name,
            _MASS,
            physics.closing_force,
            "m",
            physics.arm_bandwidth,
            physics.damping_ratio,
        )
        servos.append(servo)
    return Fingers(names, np.full(2, sides.travel), np.zeros(2), sides, tuple(servos))


def limit_finger_servos(
    servos: Sequence[Servo], fingers: Fingers, world: World, physics: Physics
) -> tuple[Servo, ...]:
    """Return the servos, those of fingers limited to the hand's closing force."""
    units = dict(zip(world.coordinates.names, world.coordinates.units, strict=True))
    limited: list[Servo] = []
    for servo in servos:
        name = servo.coordinate
        if name not in fingers.names:
            limited.append(servo)
            continue
        if units[name] == "m":
            limit = min(servo.limit, physics.closing_force)
        elif np.isfinite(servo.limit):
            limit = servo.limit
        else:
            raise InputError(
                "a revolute finger without an effort limit in the URDF cannot hold by friction",
                field="grasp",
                expected='an effort limit, or grasp="weld"',
                got=name,
            )
        load_inertia = servo.inertia - servo.armature
        finger_servo = make_servo(
            name, load_inertia, limit, units[name], physics.arm_bandwidth, physics.damping_ratio
        )
        limited.append(finger_servo)
    return tuple(limited)


def _find_sides(world: World) -> Sides:
    """Return the shapes of a hand on either side of its tool frame, and their travel."""
    robot = world.scene.robot
    labels = world.collision_labels
    frame = world.model.frames[world.model.getFrameId(robot.tool_frame)]
    to_tool = frame.placement.inverse()
    placed: list[PlacedShape] = []  # the hand's shapes in the tool frame
    positive: list[int] = []
    negative: list[int] = []
    for number, shape in enumerate(world.bodies.geometryObjects):
        if labels[number] not in robot.touch_links or shape.parentJoint != frame.parentJoint:
            continue
        place = to_tool * shape.placement
        placed.append((shape.geometry, place))
        if check_bar_fits(2.0 * _REACH, [(shape.geometry, place)]):
            continue  # the x axis does not intersect it near the tool frame
        x = _project_on_x(place, shape)
        if x.min() > 0.0:
            positive.append(number)
        elif x.max() < 0.0:
            negative.append(number)
    travel = find_widest_bar(placed) / 2.0 if positive and negative else 0.0
    if not 0.0 < travel < _REACH:
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
    shapes = (tuple(positive), tuple(negative))
    return Sides(shapes, frame.placement, int(frame.parentJoint), travel)


def _project_on_x(place: pin.SE3, shape: pin.GeometryObject) -> Floats:
    """Return the x coordinates of a shape's vertices in the tool frame."""
    points = triangulate(shape.geometry)[0]
    return np.asarray(points @ place.rotation[0] + place.translation[0])


def find_grip_changes(trajectory: Trajectory, spans: Sequence[Span]) -> list[int]:
    """Return the waypoints at which the hand closes or opens."""
    changes = set[float]()
    for _, begin, end in spans:
        changes.update((begin, end))
    firsts = [phase.first for phase in trajectory.phases]
    return [first for first in firsts if float(trajectory.times[first]) in changes]


@dataclass(eq=False)
class _Squeeze:
    """One grasp by friction.

    Attributes:
        hold: The hold.
        begin, end: Begin and end of the hold [s].
        hand, link: Masks of the geoms of hand and grasped link, shape (geoms,).
        pairs: Pairs of their labels, which may touch.
        grip: Measurements so far.
        forces: Latest forces and torques, shape (6,) each.
        place: Tool position in the link's frame when the fingers had closed [m]; None before.
        missing: Number of consecutive samples without contact.
    """

    hold: Hold
    begin: float
    end: float
    hand: Bools
    link: Bools
    pairs: frozenset[tuple[str, str]]
    grip: Grip
    forces: deque[Floats] = field(default_factory=lambda: deque(maxlen=_AVERAGED_SAMPLES))
    place: Floats | None = None
    missing: int = 0


class Squeezes:
    """Grasps by friction that follow a schedule."""

    def __init__(
        self,
        physical: PhysicalWorld,
        fingers: Fingers,
        spans: Sequence[Span],
        trajectory: Trajectory,
        physics: Physics,
        period: float,
    ) -> None:
        self._physical = physical
        self._fingers = fingers
        self._physics = physics
        self._period = period
        self._trajectory = trajectory
        self._engine = import_mujoco()
        tree = physical.world.model
        tool_frame = physical.world.scene.robot.tool_frame
        self._tool = tree.frames[tree.getFrameId(tool_frame)]
        labels = np.full(physical.model.ngeom, "", object)
        labels[physical.geoms] = physical.world.collision_labels
        self._squeezes = [self._make_squeeze(*span, labels) for span in spans]

    def _make_squeeze(self, hold: Hold, begin: float, end: float, labels: Any) -> _Squeeze:
        """Make a grasp from begin to end [s]; `labels` are those of the geoms, shape (geoms,)."""
        scene = self._physical.world.scene
        first, last = self._trajectory.times[[0, -1]].tolist()
        hands = frozenset(find_touch_links(scene, hold))
        link = find_grasped_link(scene, hold)
        return _Squeeze(
            hold,
            begin,
            end,
            hand=np.isin(labels, list(hands)),
            link=np.asarray(labels == link),
            pairs=frozenset((min(hand, link), max(hand, link)) for hand in hands),
            grip=Grip(str(hold), max(begin, first), min(end, last)),
        )

    @property
    def grips(self) -> list[Grip]:
        """Grips so far."""
        return [squeeze.grip for squeeze in self._squeezes]

    def compute_commands(self, times: Floats, planned: Floats) -> Floats:
        """Return the finger commands at times [s], shape (K, k).

        Args:
            times: Times, shape (K,) [s].
            planned: Planned finger positions, shape (K, k).
        """
        grip_time = self._physics.grip_time
        closing = np.zeros(len(times))  # 0 as planned, 1 closed
        for squeeze in self._squeezes:
            begin = max(squeeze.begin, float(times[0]))
            end = max(squeeze.end, begin + grip_time)
            corners = [begin, begin + grip_time, end, end + grip_time]
            closing = np.maximum(closing, np.interp(times, corners, [0.0, 1.0, 1.0, 0.0]))
        fingers = self._fingers
        closed = fingers.closed + _OVERTRAVEL * (fingers.closed - fingers.open)
        return np.asarray(planned + closing[:, None] * (closed - planned))

    def list_allowed_contacts(self, clock: float) -> set[tuple[str, str]]:
        """Return the label pairs that may touch at a time [s] because of a grasp."""
        allowed = set[tuple[str, str]]()
        for squeeze in self._squeezes:
            if squeeze.begin <= clock <= squeeze.end + self._physics.grip_time:
                allowed |= squeeze.pairs
        return allowed

    def measure(self, data: Any, clock: float) -> None:
        """Record the load and slip of each grasp."""
        for squeeze in self._squeezes:
            begin = max(squeeze.begin + self._physics.grip_time, squeeze.grip.begin)
            is_over = squeeze.grip.broken is not None or squeeze.grip.missed
            if is_over or not begin <= clock < squeeze.end:
                continue
            tool, place = self._find_tool(data, squeeze)
            if squeeze.place is None:
                squeeze.place = place
                self._measure_hand(data, squeeze, clock)
            wrench = self._compute_wrench(data, squeeze, tool)
            if wrench is None:
                wrench = np.zeros(6)
                squeeze.missing += 1
            else:
                squeeze.missing = 0
            squeeze.forces.append(wrench)
            mean = np.mean(squeeze.forces, axis=0)
            force = float(np.linalg.norm(mean[:3]))
            torque = float(np.linalg.norm(mean[3:]))
            slip = float(np.linalg.norm(place - squeeze.place))
            is_lost = squeeze.missing * self._period >= _LOST_TIME
            grip = squeeze.grip
            squeeze.grip = replace(
                grip,
                force=max(grip.force, force),
                torque=max(grip.torque, torque),
                slip=max(grip.slip, slip),
                broken=clock if is_lost else None,
            )

    def _measure_hand(self, data: Any, squeeze: _Squeeze, clock: float) -> None:
        """Record where the closed hand is at the attachment."""
        scene = self._physical.world.scene
        planned = compute_planned_freedoms(scene, self._trajectory, squeeze.hold, clock)
        _, distance, angle = measure_hand(self._physical, data, squeeze.hold, planned)
        squeeze.grip = replace(squeeze.grip, distance=distance, angle=angle)

    def _find_tool(self, data: Any, squeeze: _Squeeze) -> tuple[Floats, Floats]:
        """Return the tool's position in the world and in the grasped body's frame [m]."""
        hand = int(self._physical.bodies[self._tool.parentJoint])
        hand_rotation = np.asarray(data.xmat[hand]).reshape(3, 3)
        tool = data.xpos[hand] + hand_rotation @ self._tool.placement.translation
        geom = np.flatnonzero(squeeze.link)[0]
        body = int(self._physical.model.geom_bodyid[geom])
        rotation = np.asarray(data.xmat[body]).reshape(3, 3)
        return np.asarray(tool), np.asarray(rotation.T @ (tool - data.xpos[body]))

    def _compute_wrench(self, data: Any, squeeze: _Squeeze, tool: Floats) -> Floats | None:
        """Return the hand's wrench on the grasped link at the tool's origin, shape (6,).

        Without a contact force it is None. MuJoCo states a contact's wrench on its second geom in
        the contact's frame, whose axes are the rows of `frame`, the normal first.
        """
        pairs = np.asarray(data.contact.geom).reshape(-1, 2)
        first = pairs[:, 0]
        second = pairs[:, 1]
        is_hand_first = squeeze.hand[first] & squeeze.link[second]
        is_link_first = squeeze.link[first] & squeeze.hand[second]
        total = np.zeros(6)
        wrench = np.zeros(6)
        is_pushed = False
        for i in np.flatnonzero(is_hand_first | is_link_first).tolist():
            self._engine.mj_contactForce(self._physical.model, data, i, wrench)
            is_pushed |= bool(wrench[0] > 0.0)
            axes = np.asarray(data.contact.frame[i]).reshape(3, 3)
            sign = 1.0 if is_hand_first[i] else -1.0
            force, torque = sign * (wrench.reshape(2, 3) @ axes)
            lever = np.asarray(data.contact.pos[i]) - tool
            total[:3] += force
            total[3:] += torque + np.cross(lever, force)
        return total if is_pushed else None


def split_spans(spans: Sequence[Span], begin: float) -> tuple[list[Span], list[Span]]:
    """Divide holds into welds and grasps by friction.

    The robot's own hand grasps by friction. An object that it holds at the start is welded until
    the fingers have closed.

    Args:
        spans: All holds.
        begin: Begin of the trajectory [s].
    """
    by_hand: list[Span] = []
    by_objects: list[Span] = []
    at_start: list[Span] = []
    for hold, first, last in spans:
        if hold.by is not None:
            by_objects.append((hold, first, last))
            continue
        by_hand.append((hold, first, last))
        if first < begin:
            at_start.append((hold, first, begin))
    return [*at_start, *by_objects], by_hand


def insert_pauses(trajectory: Trajectory, waypoints: Iterable[int], seconds: float) -> Trajectory:
    """Insert a pause at some waypoints.

    Each of these waypoints is duplicated; both copies belong to the phase that begins there.

    Args:
        trajectory: The trajectory.
        waypoints: Waypoints at which to pause, none of them the last one.
        seconds: Duration of each pause [s].
    """
    at = np.array(sorted(set(waypoints)), int)
    if not len(at):
        return trajectory
    curve = trajectory.curve
    if curve is not None:
        knots = np.searchsorted(curve.times, trajectory.times[at])
        is_moving = np.abs(curve.rates[knots]).max(axis=1) > _REST
        if is_moving.any():
            time = trajectory.times[at[is_moving]][0]
            raise InputError(
                "the hand closes or opens while the robot moves",
                field="trajectory",
                expected="a trajectory at rest",
                got=f"moving at {time:.2f} s",
            )
        rates = np.insert(curve.rates, knots + 1, 0.0, axis=0)
        rates[knots + np.arange(len(knots))] = 0.0
        positions = np.insert(curve.positions, knots + 1, curve.positions[knots], axis=0)
        curve = Curve(_insert_delays(curve.times, knots, seconds), positions, rates)

    def shift_index(waypoint: int) -> int:
        return waypoint + int(np.searchsorted(at, waypoint))

    phases = [
        replace(phase, first=shift_index(phase.first), last=shift_index(phase.last))
        for phase in trajectory.phases
    ]
    return replace(
        trajectory,
        times=_insert_delays(trajectory.times, at, seconds),
        positions=np.insert(trajectory.positions, at + 1, trajectory.positions[at], axis=0),
        phases=tuple(phases),
        curve=curve,
    )


def _insert_delays(times: Floats, at: Ints, seconds: float) -> Floats:
    """Return times with those at indices `at` doubled, `seconds` apart, and later ones delayed."""
    delays = seconds * np.searchsorted(at, np.arange(len(times)))
    delayed = times + delays
    return np.asarray(np.insert(delayed, at + 1, delayed[at] + seconds))
