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
from vkc_pin.simulation.welds import Grip, compute_planned_freedoms, measure_hand
from vkc_pin.utils.arrays import Bools, Floats, Ints
from vkc_pin.world.models.gripper import check_bar_fits, find_widest_bar
from vkc_pin.world.models.shapes import triangulate
from vkc_pin.world.scene.contact_rules import find_grasped_link, find_touch_links
from vkc_pin.world.scene.hold import Hold
from vkc_pin.world.trajectory.curve import Curve
from vkc_pin.world.trajectory.trajectory import Trajectory
from vkc_pin.world.trajectory.world_model import World

_MASS = 0.1  # [kg] of a sliding finger
_REACH = 0.2  # [m] largest distance of a finger's shapes from the tool frame
_COUPLING = (0.004, 1.0)  # time constant [s] and damping ratio of the coupling of fingers
Span = tuple[Hold, float, float]
"""A hold with its begin and end [s]."""
# Fingers are commanded this fraction of their travel beyond the closed position, so that thin
# objects are pressed too.
_OVERTRAVEL = 0.15
_LOST_TIME = 0.1  # [s] without contact after which the object counts as lost
_AVERAGED_SAMPLES = 2  # number of samples over which forces are averaged
_REST = 1e-6  # [m/s] or [rad/s] up to which the robot is at rest


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


def find_grip_changes(trajectory: Trajectory, spans: Sequence[Span]) -> list[int]:
    """Return the waypoints at which the hand closes or opens."""
    moments = {time for _, begin, end in spans for time in (begin, end) if np.isfinite(time)}
    return [
        phase.first
        for phase in trajectory.phases
        if float(trajectory.times[phase.first]) in moments
    ]


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
        self._physical, self._fingers = physical, fingers
        self._physics, self._period, self._trajectory = physics, period, trajectory
        self._engine = import_mujoco()
        first, last = float(trajectory.times[0]), float(trajectory.times[-1])
        world, scene = physical.world, physical.world.scene
        labels = np.full(physical.model.ngeom, "", object)
        labels[physical.geoms] = world.collision_labels
        self._squeezes = []
        for hold, begin, end in spans:
            hands, link = frozenset(find_touch_links(scene, hold)), find_grasped_link(scene, hold)
            pairs = frozenset((min(hand, link), max(hand, link)) for hand in hands)
            own, held = np.isin(labels, list(hands)), np.asarray(labels == link)
            grip = Grip(str(hold), max(begin, first), min(end, last))
            self._squeezes.append(_Squeeze(hold, begin, end, own, held, pairs, grip))
        tree = world.model
        self._tool = tree.frames[tree.getFrameId(scene.robot.tool_frame)]

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
        shares, time = np.zeros(len(times)), self._physics.grip_time
        for squeeze in self._squeezes:
            begin = max(squeeze.begin, float(times[0]))
            end = max(squeeze.end, begin + time)
            corners = [begin, begin + time, end, end + time]
            shares = np.maximum(shares, np.interp(times, corners, [0.0, 1.0, 1.0, 0.0]))
        fingers = self._fingers
        closed = fingers.closed + _OVERTRAVEL * (fingers.closed - fingers.open)
        return np.asarray(planned + shares[:, None] * (closed - planned))

    def allowed_contacts(self, clock: float) -> set[tuple[str, str]]:
        """Return the label pairs that may touch at a time [s] because of a grasp."""
        time = self._physics.grip_time
        return {
            pair
            for one in self._squeezes
            if one.begin <= clock <= one.end + time
            for pair in one.pairs
        }

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
            pull = self._compute_wrench(data, squeeze, tool)
            squeeze.missing = 0 if pull is not None else squeeze.missing + 1
            squeeze.forces.append(np.zeros(6) if pull is None else pull)
            mean = np.mean(squeeze.forces, axis=0)
            grip = squeeze.grip
            force = max(grip.force, float(np.linalg.norm(mean[:3])))
            torque = max(grip.torque, float(np.linalg.norm(mean[3:])))
            slip = max(grip.slip, float(np.linalg.norm(place - squeeze.place)))
            lost_time = clock if squeeze.missing * self._period >= _LOST_TIME else None
            squeeze.grip = replace(grip, force=force, torque=torque, slip=slip, broken=lost_time)

    def _measure_hand(self, data: Any, squeeze: _Squeeze, clock: float) -> None:
        """Record where the closed hand is at the attachment."""
        scene = self._physical.world.scene
        planned = compute_planned_freedoms(scene, self._trajectory, squeeze.hold, clock)
        _, distance, angle = measure_hand(self._physical, data, squeeze.hold, planned)
        squeeze.grip = replace(squeeze.grip, distance=distance, angle=angle)

    def _find_tool(self, data: Any, squeeze: _Squeeze) -> tuple[Floats, Floats]:
        """Return the tool's position in the world and in the grasped body's frame [m]."""
        tool = int(self._physical.bodies[self._tool.parentJoint])
        where = (
            data.xpos[tool]
            + np.asarray(data.xmat[tool]).reshape(3, 3) @ self._tool.placement.translation
        )
        body = int(self._physical.model.geom_bodyid[np.flatnonzero(squeeze.link)[0]])
        turn = np.asarray(data.xmat[body]).reshape(3, 3)
        return np.asarray(where), np.asarray(turn.T @ (where - data.xpos[body]))

    def _compute_wrench(self, data: Any, squeeze: _Squeeze, tool: Floats) -> Floats | None:
        """Return the hand's wrench on the grasped link at the tool's origin, shape (6,)."""
        pairs = np.asarray(data.contact.geom).reshape(-1, 2)
        ahead = squeeze.hand[pairs[:, 0]] & squeeze.link[pairs[:, 1]]
        back = squeeze.link[pairs[:, 0]] & squeeze.hand[pairs[:, 1]]
        total, pushed, wrench = np.zeros(6), False, np.zeros(6)
        for i in np.flatnonzero(ahead | back).tolist():
            self._engine.mj_contactForce(self._physical.model, data, i, wrench)
            pushed |= bool(wrench[0] > 0.0)
            axes = np.asarray(data.contact.frame[i]).reshape(3, 3)
            force, torque = (1.0 if ahead[i] else -1.0) * (wrench.reshape(2, 3) @ axes)
            total[:3] += force
            total[3:] += torque + np.cross(np.asarray(data.contact.pos[i]) - tool, force)
        return total if pushed else None


def split_spans(spans: Sequence[Span], begin: float) -> tuple[list[Span], list[Span]]:
    """Divide holds into welds and grasps by friction.

    The robot's own hand grasps by friction. An object that it holds at the start is welded until
    the fingers have closed.

    Args:
        spans: All holds.
        begin: Begin of the trajectory [s].
    """
    own = [span for span in spans if span[0].by is None]
    others = [span for span in spans if span[0].by is not None]
    return [*((hold, first, begin) for hold, first, _ in own if first < begin), *others], own


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
        moving = np.abs(curve.rates[knots]).max(axis=1) > _REST
        if moving.any():
            got = f"moving at {trajectory.times[at[moving]][0]:.2f} s"
            raise InputError(
                "the hand closes or opens while the robot moves",
                field="trajectory",
                expected="a trajectory at rest",
                got=got,
            )
        rates = np.insert(curve.rates, knots + 1, 0.0, axis=0)
        rates[knots + np.arange(len(knots))] = 0.0
        positions = np.insert(curve.positions, knots + 1, curve.positions[knots], axis=0)
        curve = Curve(_insert_delays(curve.times, knots, seconds), positions, rates)

    def shift_index(waypoint: int) -> int:
        return waypoint + int(np.searchsorted(at, waypoint))

    return replace(
        trajectory,
        times=_insert_delays(trajectory.times, at, seconds),
        positions=np.insert(trajectory.positions, at + 1, trajectory.positions[at], axis=0),
        phases=tuple(
            replace(phase, first=shift_index(phase.first), last=shift_index(phase.last))
            for phase in trajectory.phases
        ),
        curve=curve,
    )


def _insert_delays(times: Floats, at: Ints, seconds: float) -> Floats:
    """Return times with those at indices `at` doubled, `seconds` apart, and later ones delayed."""
    delays = seconds * np.searchsorted(at, np.arange(len(times)))
    return np.asarray(np.insert(times + delays, at + 1, (times + delays)[at] + seconds))
