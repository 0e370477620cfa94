"""Defines robots: a URDF on a planar virtual base, with limits and convex collision shapes."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from vkc_pin.errors import InputError
from vkc_pin.utils.arguments import check_integer
from vkc_pin.utils.arrays import Floats
from vkc_pin.world.files.urdf import UrdfFile
from vkc_pin.world.models.coordinates import Coordinates, MovedJoint, wrap_angle
from vkc_pin.world.models.dynamics import TorqueLimits, compute_torque_limits
from vkc_pin.world.models.grafting import round_placement
from vkc_pin.world.models.gripper import Gripper
from vkc_pin.world.models.robot_model import load_visual_geometry
from vkc_pin.world.models.robot_schema import Wheels
from vkc_pin.world.models.shapes import (
    compute_bounding_box,
    compute_shape_distance,
    get_link_name,
    triangulate,
)

_MIN_LEVER = 0.1  # [m/rad] about the size of a hand
_FRONT_DISTANCE = 10.0  # [m] larger than any hand
_LEVER_SAMPLES = 200  # random configurations over which the lever is averaged
_TIGHT_FACTOR = 0.5  # margin of links that are always close, relative to their largest distance

Base = Literal["omni", "differential", "ackermann", "fixed"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Robot:
    """A mobile manipulator.

    Its n coordinates z are (base_x, base_y, base_yaw, arm joints), [m] and [rad].

    Attributes:
        name: Name of the robot.
        urdf: Path of its URDF.
        model: Pinocchio model. Joint 1, named "base", is planar; the planned joints follow. All
            other joints of the URDF are locked.
        collision: Convex shapes named `<link>_<k>`, with the pairs to check for self-collision.
        coordinates: Minimal coordinates of `model`.
        lower, upper: Position limits, shape (n,) [m], [rad]; infinite for the yaw and for
            continuous joints.
        velocity, acceleration: Velocity and acceleration limits, shape (n,).
        home: Home configuration of the arm, shape (n − 3,) [m], [rad].
        tool_frame: Frame of `model` that grasps: z is the direction of approach, x the direction
            in which fingers close.
        base: Type of the base: "omni" moves in any direction, "differential" moves along its x
            axis and turns, "ackermann" moves along its x axis and turns no tighter than
            `turning_radius`, "fixed" does not move.
        touch_links: Links that may touch grasped objects.
        height: Height of the root link above the floor [m].
        gripper: Model of the fingers, if the description has one. Otherwise they are locked.
        wheels: Wheels of the base, if the description has them. They limit the velocity of bases
            of type "differential" and "ackermann".
        turning_radius: Minimum turning radius of the base's origin, for "ackermann" bases [m].
        payload: Largest mass of grasped objects and of those that rest on them [kg]; None: unknown.
        tight: Pairs of links, each sorted, that are less than 50 mm apart in all configurations,
            or at home → their largest distance, or that at home [m].
        file: The parsed URDF.
    """

    name: str
    urdf: Path
    model: pin.Model
    collision: pin.GeometryModel
    coordinates: Coordinates
    lower: Floats
    upper: Floats
    velocity: Floats
    acceleration: Floats
    home: Floats
    tool_frame: str
    base: Base
    touch_links: tuple[str, ...] = ()
    height: float = 0.0
    gripper: Gripper | None = field(default=None, repr=False)
    wheels: Wheels | None = None
    turning_radius: float = 0.0
    payload: float | None = None
    tight: Mapping[tuple[str, str], float] = field(default_factory=dict, repr=False)
    file: UrdfFile = field(repr=False)
    _opened: dict[float, Robot] = field(default_factory=dict, repr=False)

    @cached_property
    def visual(self) -> pin.GeometryModel:
        """Visual geometry, loaded on first access, since display meshes are large.

        Raises:
            InputError: A mesh cannot be read.
        """
        return load_visual_geometry(self.model, self.file)

    @cached_property
    def lever(self) -> float:
        """Mean motion of the hand per radian, over the arm's joints and configurations [m/rad].

        Searches use it to weigh rotations against translations of the base. All rotations have the
        same weight: with cheaper wrist rotations, searches would find long ones.
        """
        rng = np.random.default_rng(0)
        data = self.model.createData()
        frame = self.model.getFrameId(self.tool_frame)
        turns = [k for k, unit in enumerate(self.coordinates.units) if k > 2 and unit == "rad"]
        if not turns:
            return _MIN_LEVER
        low = np.maximum(self.lower, -np.pi)
        high = np.maximum(low, np.minimum(self.upper, np.pi))
        squares = np.zeros(len(turns))
        for z in rng.uniform(low, high, (_LEVER_SAMPLES, len(low))):
            q = self.coordinates.q(z)
            jacobian = pin.computeFrameJacobian(self.model, data, q, frame, pin.LOCAL_WORLD_ALIGNED)
            # Columns of the translational part are the hand's velocities at 1 rad/s.
            squares += (jacobian[:3, turns] ** 2).sum(axis=0)
        root_mean_squares = np.sqrt(squares / _LEVER_SAMPLES)
        return max(float(root_mean_squares.mean()), _MIN_LEVER)

    @cached_property
    def frame_names(self) -> tuple[str, ...]:
        """Names of its frames, without that of the world."""
        return tuple(str(frame.name) for frame in self.model.frames if frame.name != "universe")

    @cached_property
    def planned_joints(self) -> Mapping[str, MovedJoint]:
        """Coordinate, or joint coupled to one → the coordinate that drives it, and how."""
        coordinates = self.coordinates
        found = {}
        for column, name in enumerate(coordinates.names):
            slides = coordinates.units[column] == "m"
            found[name] = MovedJoint(column, coordinates.joints[column], 1.0, 0.0, slides)
        for move in coordinates.followers:
            found[str(self.model.names[move.joint])] = move
        return found

    def is_periodic(self, coordinate: int) -> bool:
        """Return whether full turns of a coordinate make no difference."""
        is_angle = self.coordinates.units[coordinate] == "rad"
        return is_angle and bool(np.isinf(self.upper[coordinate]))

    def unwrap(self, positions: ArrayLike, near: ArrayLike) -> Floats:
        """Return coordinates, shape (n,), whose periodic ones count turns as others do.

        Who measures an angle may not count turns: odometry states headings from -π to π [rad].
        """
        unwrapped = np.array(positions, float)
        near = np.asarray(near, float)
        for column in range(len(unwrapped)):
            if self.is_periodic(column):
                turned = wrap_angle(unwrapped[column] - near[column])
                unwrapped[column] = near[column] + turned
        return unwrapped

    @cached_property
    def torque_limits(self) -> TorqueLimits:
        """Torque limits of the joints, as far as the description is plausible."""
        return compute_torque_limits(self.model, self.coordinates, self.lower, self.upper)

    @cached_property
    def front(self) -> pin.SE3:
        """Foremost point of the hand in the tool frame, with the same axes.

        It is the largest extent of the touch links along the direction of approach.
        """
        tool = self.model.frames[self.model.getFrameId(self.tool_frame)]
        # The half-space z ≥ D of the tool frame, beyond the hand: a shape with the largest
        # extent e along z is D − e away from it.
        wall = coal.Halfspace(np.array([0.0, 0.0, -1.0]), -_FRONT_DISTANCE)
        gaps = list[float]()
        for shape in self.collision.geometryObjects:
            is_on_hand = shape.parentJoint == tool.parentJoint
            if is_on_hand and get_link_name(shape.name) in self.touch_links:
                shape_in_tool = tool.placement.actInv(shape.placement)
                distance = compute_shape_distance(
                    shape.geometry, shape_in_tool, wall, pin.SE3.Identity()
                )
                gaps.append(distance)
        extent = _FRONT_DISTANCE - min(gaps, default=_FRONT_DISTANCE)
        return pin.SE3(np.eye(3), np.array([0.0, 0.0, extent]))

    @cached_property
    def fingerprint(self) -> str:
        """Digest of all that the distances between links depend on.

        It covers shapes and their placements, limits, home, links and joints.
        """
        digest = hashlib.sha256()
        for joint in self.file.root.findall("joint"):
            ends = []
            for key in ("parent", "child"):
                element = joint.find(key)
                if element is not None:
                    ends.append(element.get("link"))
            digest.update(repr((joint.get("name"), joint.get("type"), ends)).encode())
        digest.update(repr((self.coordinates.names, list(self.model.parents))).encode())
        for values in (self.lower, self.upper, self.home):
            digest.update(np.asarray(values, float).tobytes())
        # Placements at three configurations capture axes and placements of joints.
        data = self.model.createData()
        configurations = np.random.default_rng(0).uniform(-3.0, 3.0, (3, len(self.lower)))
        for z in configurations:
            pin.forwardKinematics(self.model, data, self.coordinates.q(z))
            placements = np.array([placement.homogeneous for placement in data.oMi])
            digest.update(placements.tobytes())
        for shape in self.collision.geometryObjects:
            solid = shape.geometry
            digest.update(repr((shape.name, shape.parentJoint, type(solid).__name__)).encode())
            digest.update(shape.placement.homogeneous.tobytes())
            if isinstance(solid, coal.Convex | coal.BVHModelBase):
                points, faces = triangulate(solid)
                digest.update(repr((points.shape, faces.shape)).encode())
                digest.update(points.tobytes() + faces.tobytes())
            else:
                # The bounding box has all dimensions of boxes, cylinders and the like.
                _, half_extents = compute_bounding_box(shape)
                digest.update(half_extents.tobytes())
        return digest.hexdigest()

    def opening(self, asked: float | None) -> float | None:
        """Return the feasible gripper opening nearest to `asked` [m].

        Returns None, which stands for the rest position, if `asked` is None or there is no gripper.
        """
        if asked is None or self.gripper is None:
            return None
        return self.gripper.clamp_opening(asked)

    def opened(self, opening: float | None) -> Robot:
        """Return a copy of the robot with its fingers locked at an opening.

        Collision pairs and margins stay the same.

        Args:
            opening: Gripper opening [m]. None stands for the rest position: the robot itself.

        Raises:
            InputError: The robot has no gripper, or the opening is out of its range.
        """
        if opening is None:
            return self
        if self.gripper is None:
            expected = "a `gripper` in its robot.yaml"
            raise InputError(
                f"robot '{self.name}' has no gripper that opens",
                field="opening",
                expected=expected,
                got=opening,
            )
        if opening not in self._opened:
            model = pin.Model(self.model)
            for name, placement in self.gripper.compute_frames(opening).items():
                model.frames[model.getFrameId(name)].placement = placement
            collision = self.collision.copy()
            for shape in collision.geometryObjects:
                before = self.model.frames[shape.parentFrame].placement
                after = model.frames[shape.parentFrame].placement
                if before != after:
                    shape_in_link = before.actInv(shape.placement)
                    shape.placement = round_placement(after * shape_in_link)
            self._opened[opening] = dataclasses.replace(
                self, model=model, collision=collision, _opened={}
            )
        return self._opened[opening]

    @property
    def start_limits(self) -> tuple[Floats, Floats]:
        """Limits of start configurations, shape (n,) each [m], [rad].

        They are the robot's position limits, but a fixed base may be placed anywhere.
        """
        lower = self.lower.copy()
        upper = self.upper.copy()
        if self.base == "fixed":
            lower[:3] = -np.inf
            upper[:3] = np.inf
        return lower, upper

    def __repr__(self) -> str:
        return (
            f"<Robot {self.name}: {len(self.home)} joints, {self.base} base, "
            f"tool frame {self.tool_frame}>"
        )

    def link_of(self, geometry: int) -> str:
        """Return the link of shape number `geometry` of `collision`.

        Raises:
            InputError: The shape does not exist.
        """
        shapes = self.collision.geometryObjects
        geometry = check_integer(geometry, "geometry", low=0, high=len(shapes) - 1)
        return get_link_name(shapes[geometry].name)

    def own_margin(self, links: tuple[str, str], margin: float) -> float:
        """Return the margin of a sorted pair of links: `margin` or half of `tight`, if less [m]."""
        return min(margin, _TIGHT_FACTOR * self.tight.get(links, np.inf))

    def own_margins(self, margin: float) -> dict[tuple[int, int], float]:
        """Return the margin of each collision pair, by the indices of its shapes [m].

        Both the NLP and the validation use it.

        Args:
            margin: Margin of pairs that are not tight: `Options.self_distance` [m].
        """
        links = [get_link_name(shape.name) for shape in self.collision.geometryObjects]
        margins = {}
        for pair in self.collision.collisionPairs:
            one, other = sorted((links[pair.first], links[pair.second]))
            margins[pair.first, pair.second] = self.own_margin((one, other), margin)
        return margins

    @property
    def links(self) -> tuple[str, ...]:
        """Links that have collision geometry, each once."""
        names = [get_link_name(shape.name) for shape in self.collision.geometryObjects]
        return tuple(dict.fromkeys(names))
